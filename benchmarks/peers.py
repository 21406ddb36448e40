"""Derivatives of images by other renderers, on scenes of unlit vertex colours.

- DEODR (de La Gorce, Paragios and Fleet 2011): anti-aliased edges drawn over a rasterized image. It differentiates in
  reverse mode only; a derivative image is here the central difference of its own float64 image over a step so small
  that no pixel changes the triangle it sees, which its reverse mode agrees with to five digits.
- Mitsuba 3, `direct_projective` (Zhang et al. 2023), forward mode: Monte Carlo, noisier the fewer samples a pixel.
  Every mesh is an area emitter of its vertex colours on a black material, which gives flat colours.

Both see the fronts of triangles only. They come with the extra `bench`; Mitsuba also compiles with the shared library
of LLVM: 16 or newer (Debian's libllvm19), which DRJIT_LIBLLVM_PATH may name.
"""

from __future__ import annotations

import os
import tempfile
from functools import cache
from typing import Any

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # Spinning threads of two libraries take each other's cores.

import derivative_scenes as ds
import numpy as np
from scenes import DISTANCE, FOV

STEP = 1e-6
"""Length of DEODR's difference, pixels."""


def displacement(scene: ds.Scene) -> list[np.ndarray]:
    """Derivative in t of each part's vertices (V, 3)."""
    return [
        np.zeros_like(part.theta["vertices"]) if d is None else part.theta["vertices"] @ d[:3, :3].T + d[:3, 3]
        for part, d in zip(scene.rest, scene.directions, strict=True)
    ]


# --------------------------------------------------------------------------------------------------------------- DEODR


class Deodr:
    """A scene in DEODR: all parts as one mesh."""

    def __init__(self, scene: ds.Scene):
        import deodr
        from deodr.differentiable_renderer import Camera, Scene3D

        parts = [part.theta for part in scene.rest]
        first = np.cumsum([0, *(len(p["vertices"]) for p in parts)])
        faces = np.concatenate([p.surface.faces + f for p, f in zip(scene.rest, first, strict=False)])
        self.vertices = np.concatenate([p["vertices"] for p in parts])
        self.displacement = np.concatenate(displacement(scene))
        # Gradients are refused with perspective-correct interpolation, and where back faces are drawn.
        self.scene = Scene3D(sigma=1.0, perspective_correct=False, integer_pixel_centers=False)
        colors = np.concatenate([p["colors"] for p in parts])
        self.scene.set_mesh(deodr.ColoredTriMesh(faces.astype(np.int32), self.vertices, colors=colors))
        self.scene.set_light(None, 1.0)
        self.scene.set_background_color(np.zeros(3))
        height, width = scene.size
        focal = height / (2 * np.tan(np.radians(FOV / 2)))
        view = np.array([[1.0, 0, 0, 0], [0, -1, 0, 0], [0, 0, -1, DISTANCE]])
        self.camera = Camera(view, np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]]), height, width)

    def render(self, t: float) -> np.ndarray:
        """The image (H, W, 3) at t."""
        self.scene.mesh.set_vertices(self.vertices + t * self.displacement)
        return self.scene.render(self.camera)

    def derivative(self) -> np.ndarray:
        """The derivative image (H, W, 3) a pixel of motion."""
        return (self.render(STEP / 2) - self.render(-STEP / 2)) / STEP

    def gradient(self, weights: np.ndarray) -> float:
        """Reverse mode: the slope dL/dt of L = Σ weights · image, by the gradient in every vertex."""
        self.render(0.0)
        self.scene.clear_gradients()
        self.scene.render_backward(np.array(weights))  # It overwrites what it is given.
        return float((self.scene.mesh._vertices_b * self.displacement).sum())


# ------------------------------------------------------------------------------------------------------------- Mitsuba


@cache
def mitsuba() -> Any:
    """The package, in the variant for processors."""
    import drjit
    import mitsuba

    mitsuba.set_variant("llvm_ad_rgb")
    version = drjit.detail.llvm_version()
    if version < (16,):
        # Older ones know no fmaximum, and end the process instead of raising.
        raise ImportError(f"LLVM {version[0]} was found; Mitsuba needs 16 or newer, see DRJIT_LIBLLVM_PATH")
    drjit.set_log_level(drjit.LogLevel.Error)
    mitsuba.set_log_level(mitsuba.LogLevel.Error)
    return mitsuba


class Mitsuba:
    """A scene in Mitsuba: each part a mesh that emits its colours."""

    def __init__(self, scene: ds.Scene):
        mi = mitsuba()
        film = {
            "type": "hdrfilm",
            "width": scene.size[1],
            "height": scene.size[0],
            "rfilter": {"type": "box"},
            "pixel_format": "rgb",
            "component_format": "float32",
            "sample_border": True,
        }
        sensor = {
            "type": "perspective",
            "fov": FOV,
            "fov_axis": "y",
            "near_clip": 0.5,
            "far_clip": 10.0,
            "to_world": mi.ScalarTransform4f().look_at([0, 0, DISTANCE], [0, 0, 0], [0, 1, 0]),
            "film": film,
        }
        with tempfile.TemporaryDirectory() as folder:
            meshes = {f"part{i}": _emitter(mi, p, f"{folder}/{i}.ply") for i, p in enumerate(scene.rest)}
            self.scene = mi.load_dict({"type": "scene", "sensor": sensor, **meshes})
        # Nothing is lit by anything, so there are no indirect boundaries to sample.
        self.integrator = mi.load_dict({"type": "direct_projective", "sppi": 0})
        self.parameters = mi.traverse(self.scene)
        self.displacement = [mi.Float(np.ravel(d).astype(np.float32)) for d in displacement(scene)]
        self.keys = [f"part{i}.vertex_positions" for i, d in enumerate(scene.directions) if d is not None]
        self.moves = [d for d, moves in zip(self.displacement, scene.directions, strict=True) if moves is not None]
        self.vertices = [mi.Float(self.parameters[key]) for key in self.keys]

    def render(self, vertices: list, spp: int, seed: int) -> Any:
        """The image (H, W, 3), with the parts that move at these vertices."""
        for key, value in zip(self.keys, vertices, strict=True):
            self.parameters[key] = value
        self.parameters.update()
        return mitsuba().render(self.scene, self.parameters, integrator=self.integrator, spp=spp, seed=seed)

    def derivative(self, spp: int, seed: int) -> np.ndarray:
        """Forward mode (H, W, 3)."""
        import drjit as dr

        t = mitsuba().Float(0.0)
        dr.enable_grad(t)
        image = self.render([v + t * d for v, d in zip(self.vertices, self.moves, strict=True)], spp, seed)
        dr.forward(t)
        return np.array(dr.grad(image))

    def gradient(self, weights: np.ndarray, spp: int, seed: int) -> float:
        """Reverse mode: the slope dL/dt of L = Σ weights · image, by the gradient in every vertex that moves."""
        import drjit as dr

        vertices = [v + 0 for v in self.vertices]
        dr.enable_grad(vertices)
        image = self.render(vertices, spp, seed)
        dr.backward(dr.sum(image * mitsuba().TensorXf(weights.astype(np.float32)), axis=None))
        return float(sum(np.sum(np.array(dr.grad(v)) * np.array(d)) for v, d in zip(vertices, self.moves, strict=True)))


def _emitter(mi: Any, part: Any, path: str) -> dict:
    """Of a part, by way of a PLY file, the only road by which a mesh gets both colours and an emitter."""
    vertices, faces, colors = part.theta["vertices"], part.surface.faces, part.theta["colors"]
    mesh = mi.Mesh("part", len(vertices), len(faces))
    arrays = mi.traverse(mesh)
    arrays["vertex_positions"] = np.ravel(vertices).astype(np.float32)
    arrays["faces"] = np.ravel(faces).astype(np.uint32)
    arrays.update()
    mesh.add_attribute("vertex_color", 3, np.ravel(colors).astype(np.float32))
    mesh.write_ply(path)
    return {
        "type": "ply",
        "filename": path,
        "face_normals": True,
        "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.0}},
        "emitter": {"type": "area", "radiance": {"type": "mesh_attribute", "name": "vertex_color"}},
    }
