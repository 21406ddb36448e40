"""Derivatives by Mitsuba 3, `direct_projective` (Zhang et al. 2023): Monte Carlo, noisier the fewer samples a pixel.

Every mesh is an area emitter of its vertex colours on a black material, which gives flat colours on the fronts of
triangles; their backs are black. Mitsuba compiles with the shared library of LLVM: 16 or newer (Debian's libllvm19),
which DRJIT_LIBLLVM_PATH may name.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from importlib import import_module
from typing import Any

import numpy as np

from rts_compare.derivative_scores import loss_weights
from rts_compare.other_renderers.renderer_input import Peer, RendererInput


@cache
def mitsuba() -> Any:
    """The module `mitsuba`, set once to its variant for CPUs, with log messages below errors silenced.

    Raises:
        ImportError: Mitsuba is not installed, or finds no LLVM of version 16 or newer.
    """
    found, drjit = import_module("mitsuba"), import_module("drjit")
    found.set_variant("llvm_ad_rgb")
    version = drjit.detail.llvm_version()
    if version < (16,):
        # Older ones know no fmaximum, and end the process instead of raising.
        raise ImportError(f"LLVM {version[0]} was found; Mitsuba needs 16 or newer, see DRJIT_LIBLLVM_PATH")
    drjit.set_log_level(drjit.LogLevel.Error)
    found.set_log_level(found.LogLevel.Error)
    return found


def sensor(
    size: tuple[int, int], fov: float, planes: tuple[float, float], distance: float = 0.0, pixel_format: str = "rgb"
) -> dict[str, Any]:
    """The dict from which Mitsuba makes a camera that looks along −z with +y up.

    Args:
        size: (height, width) of the image.
        fov: vertical field of view, degrees.
        planes: depths of the near and the far plane.
        distance: the camera's z; its x and y are 0.
        pixel_format: "rgb" or "luminance".
    """
    film = {
        "type": "hdrfilm",
        "width": size[1],
        "height": size[0],
        "rfilter": {"type": "box"},
        "pixel_format": pixel_format,
        "component_format": "float32",
        "sample_border": True,
    }
    look_at = mitsuba().ScalarTransform4f().look_at
    return {
        "type": "perspective",
        "fov": fov,
        "fov_axis": "y",
        "near_clip": planes[0],
        "far_clip": planes[1],
        "to_world": look_at([0, 0, distance], [0, 0, distance - 1], [0, 1, 0]),
        "film": film,
    }


def integrator() -> Any:
    """The integrator with derivatives of visibility. Nothing lights anything: indirect boundaries get no samples."""
    return mitsuba().load_dict({"type": "direct_projective", "sppi": 0})


def emitter(vertices: np.ndarray, faces: np.ndarray, path: str, colors: np.ndarray | None = None) -> dict[str, Any]:
    """The dict of a mesh that emits its vertex colours on a black material.

    Writes a PLY file, which Mitsuba reads with the scene: only so a mesh gets both colours and an emitter. Every
    version reads it, while `mitsuba.Mesh` is made in another way from 3.10 on.

    Args:
        vertices: (V, 3).
        faces: (T, 3).
        path: of the PLY file.
        colors: (V, 3); None for white.
    """
    radiance: dict[str, Any] = {"type": "rgb", "value": 1.0}
    if colors is not None:
        radiance = {"type": "mesh_attribute", "name": "vertex_color"}
    _write_ply(vertices, faces, path, colors)
    return {
        "type": "ply",
        "filename": path,
        "face_normals": True,
        "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.0}},
        "emitter": {"type": "area", "radiance": radiance},
    }


def _write_ply(vertices: np.ndarray, faces: np.ndarray, path: str, colors: np.ndarray | None) -> None:
    """Write a PLY file with colours in floating numbers, as Mitsuba reads them."""
    names = ["x", "y", "z", *("r", "g", "b")[: 0 if colors is None else 3]]
    rows = vertices if colors is None else np.concatenate([vertices, colors], axis=1)
    records = np.zeros(len(faces), [("count", "u1"), ("corners", "<i4", 3)])
    records["count"], records["corners"] = 3, faces
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {len(rows)}"]
    lines += [f"property float {name}" for name in names]
    lines += [f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header\n"]
    with open(path, "wb") as file:
        file.write("\n".join(lines).encode() + np.asarray(rows, "<f4").tobytes() + records.tobytes())


# Mitsuba 3.10 was not at hand: its names and shapes are those of its release notes, and were not tried with it.


def positions_of(parameters: Mapping[str, Any], mesh: str) -> str:
    """The name of a mesh's positions: "positions" from Mitsuba 3.10 on, "vertex_positions" before."""
    name = f"{mesh}.positions"
    return name if name in parameters else f"{mesh}.vertex_positions"


def flat(parameter: Any) -> Any:
    """A parameter of a mesh as a flat `mitsuba.Float`; from Mitsuba 3.10 on it is a tensor, a row a vertex."""
    return import_module("drjit").ravel(parameter)


def set_flat(parameters: Any, name: str, value: Any) -> None:
    """Set a parameter of a mesh to a flat `mitsuba.Float`, as a tensor where it was one."""
    dr, old = import_module("drjit"), parameters[name]
    parameters[name] = type(old)(value, dr.shape(old)) if dr.is_tensor_v(old) else value


class MitsubaScene:
    """A scene in Mitsuba, for any number of samples: each part a mesh that emits its colours.

    Args:
        given: the scene.

    Raises:
        ImportError: see `mitsuba`.
    """

    def __init__(self, given: RendererInput):
        mi = mitsuba()
        with tempfile.TemporaryDirectory() as folder:
            meshes = {
                f"part{i}": emitter(p.vertices, p.faces, f"{folder}/{i}.ply", p.colors)
                for i, p in enumerate(given.parts)
            }
            self.scene = mi.load_dict(
                {"type": "scene", "sensor": sensor(given.size, given.fov, given.planes), **meshes}
            )
        self.given, self.integrator, self.parameters = given, integrator(), mi.traverse(self.scene)
        self.moved: dict[str, Any] = {}

    def moving(self, mode: str) -> dict[str, tuple[Any, Any]]:
        """Name of a parameter that a mode changes → its value at rest and its velocity, as flat `mitsuba.Float`."""
        found = {}
        for index, velocity in enumerate(self.given.velocity(mode)):
            positions, colors = positions_of(self.parameters, f"part{index}"), f"part{index}.vertex_color"
            for key, change in ((positions, velocity.vertices), (colors, velocity.colors)):
                if change is not None:
                    rest = self.moved[key] if key in self.moved else mitsuba().Float(flat(self.parameters[key]))
                    found[key] = rest, mitsuba().Float(np.ravel(change).astype(np.float32))
        return found

    def render(self, values: Mapping[str, Any], rest: Mapping[str, Any], spp: int, seed: int) -> Any:
        """The image (H, W, 3), a tensor of Mitsuba.

        Args:
            values: name of each parameter that is not at rest → its value.
            rest: the same names → values at rest, which the next call restores.
            spp: samples a pixel.
            seed: of the samples.
        """
        for key, value in {**self.moved, **values}.items():
            set_flat(self.parameters, key, value)
        self.moved = dict(rest)
        self.parameters.update()
        return mitsuba().render(self.scene, self.parameters, integrator=self.integrator, spp=spp, seed=seed)


class Mitsuba(Peer):
    """Mitsuba with a scene and a number of samples.

    Args:
        scene: the scene.
        spp: samples a pixel.
    """

    name = "Mitsuba"

    def __init__(self, scene: MitsubaScene, spp: int):
        self.scene, self.spp, self.settings = scene, spp, {"spp": spp}

    def derivative(self, mode: str, seed: int = 0) -> np.ndarray:
        """See `Peer`; by forward mode. Zero if the mode changes nothing."""
        dr = import_module("drjit")
        moving = self.scene.moving(mode)
        if not moving:
            return np.zeros((*self.scene.given.size, 3))
        t = dr.opaque(mitsuba().Float, 0.0)  # A literal would take the length of what it is multiplied with.
        dr.enable_grad(t)
        values = {key: value + t * change for key, (value, change) in moving.items()}
        image = self.scene.render(values, {key: value for key, (value, _) in moving.items()}, self.spp, seed)
        dr.forward(t)
        return np.array(dr.grad(image), np.float64)

    def slopes(self, modes: Sequence[str], weigh: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
        """dL/dt (modes,) float64 along several modes, by one pass in reverse mode; always of the same samples.

        Args:
            modes: keys of the scene's `directions`.
            weigh: the image (H, W, 3) → the derivative of L with respect to it.
        """
        dr = import_module("drjit")
        moving = [self.scene.moving(mode) for mode in modes]
        rest = {key: value for found in moving for key, (value, _) in found.items()}
        values = {key: value + 0 for key, value in rest.items()}
        dr.enable_grad(list(values.values()))
        image = self.scene.render(values, rest, self.spp, 0)
        weights = mitsuba().TensorXf(np.asarray(weigh(np.array(image, np.float64)), np.float32))
        dr.backward(dr.sum(image * weights, axis=None))
        gradients = {key: np.array(dr.grad(value)) for key, value in values.items()}
        slopes = [sum(np.sum(gradients[k] * np.array(change)) for k, (_, change) in found.items()) for found in moving]
        return np.array(slopes, np.float64)

    def gradient(self, mode: str, weights: np.ndarray | None = None) -> Callable[[], float]:
        """See `Peer`; every call has the same samples."""
        dr = import_module("drjit")
        moving = self.scene.moving(mode)
        rest = {key: value for key, (value, _) in moving.items()}
        changes = {key: np.array(change) for key, (_, change) in moving.items()}
        weights = loss_weights(*self.scene.given.size)[0] if weights is None else weights
        w = mitsuba().TensorXf(np.asarray(weights, np.float32))

        def slope() -> float:
            values = {key: value + 0 for key, value in rest.items()}
            dr.enable_grad(list(values.values()))
            dr.backward(dr.sum(self.scene.render(values, rest, self.spp, 0) * w, axis=None))
            return float(sum(np.sum(np.array(dr.grad(value)) * changes[key]) for key, value in values.items()))

        return slope
