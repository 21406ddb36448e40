"""Meshes of Mitsuba's material `principled` in the light of an environment, as pictures of linear colours."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import rts


class Shape(NamedTuple):
    """A mesh, and what it is made of.

    Attributes:
        vertices: (V, 3), world.
        faces: (F, 3).
        normals: (V, 3).
        uv: (V, 2), v up.
        material: "color" (3,) or "texture" (h, w, 3), "metallic" and "roughness", () or (h, w, 1), "normal_map"
            (h, w, 3) and "emissive" (h, w, 3), as the shader `pbr` has them.
        colors: (V, 3), in place of a texture; or None.
    """

    vertices: np.ndarray
    faces: np.ndarray
    normals: np.ndarray
    uv: np.ndarray
    material: Mapping[str, np.ndarray]
    colors: np.ndarray | None = None

    @property
    def part(self) -> rts.Part:
        """The mesh with the shader `pbr`; textures are averaged over footprints."""
        own = {"vertices": self.vertices, "normals": self.normals, "uv": self.uv}
        own |= {} if self.colors is None else {"colors": self.colors}
        return rts.Part(rts.Mesh(self.faces), {**own, **self.material}, rts.plugin("shaders", "pbr")(mip=True))


def mitsuba() -> Any:
    """The module `mitsuba`, set to its scalar variant, which needs no LLVM."""
    found = import_module("mitsuba")
    found.set_variant("scalar_rgb")
    found.set_log_level(found.LogLevel.Error)
    return found


def pictures(
    shapes: Sequence[Shape], environment: np.ndarray, cameras: Sequence[rts.Camera], size: tuple[int, int], samples: int
) -> list[np.ndarray]:
    """Pictures (H, W, 4), linear premultiplied RGBA, by light that meets a surface once; shapes cast shadows.

    Args:
        shapes: the scene.
        environment: (h, w, 3), as in θ["light"]["environment"].
        cameras: made by `rts.Camera.look_at`.
        size: (H, W).
        samples: of a pixel.
    """
    mi = mitsuba()
    # Its middle is +z, ours −z.
    turned = np.roll(np.asarray(environment, np.float32), environment.shape[1] // 2, axis=1)
    scene: dict[str, Any] = {"type": "scene", "light": {"type": "envmap", "bitmap": mi.Bitmap(turned)}}
    with tempfile.TemporaryDirectory() as folder:
        for i, shape in enumerate(shapes):
            path = Path(folder) / f"{i}.ply"
            _write_ply(shape, path)
            scene[f"shape{i}"] = {"type": "ply", "filename": str(path), "bsdf": _principled(mi, shape)}
            if shape.colors is not None:
                scene[f"shape{i}"] = mi.load_dict(scene[f"shape{i}"])
                scene[f"shape{i}"].add_attribute("vertex_color", 3, shape.colors.astype(np.float32).ravel())
            if "emissive" in shape.material:
                radiance = _texture(mi, shape.material["emissive"])
                scene[f"shape{i}"]["emitter"] = {"type": "area", "radiance": radiance}
        scene = mi.load_dict(scene)
    integrator = mi.load_dict({"type": "direct", "hide_emitters": True, "bsdf_samples": 1, "emitter_samples": 1})
    film = {"type": "hdrfilm", "width": size[1], "height": size[0], "pixel_format": "rgba", "rfilter": {"type": "box"}}
    found = []
    for number, camera in enumerate(cameras):
        to_camera = np.asarray(camera.view, np.float64)
        fov = 2 * np.degrees(np.arctan(1 / float(np.asarray(camera.projection)[1, 1])))
        # Mitsuba's cameras look along +z, with +x to the left.
        to_world = np.linalg.inv(to_camera) @ np.diag([-1.0, 1, -1, 1])
        sensor = {"type": "perspective", "fov": fov, "fov_axis": "y", "near_clip": 0.01, "far_clip": 100.0}
        sensor = mi.load_dict(
            {**sensor, "film": film, "to_world": mi.ScalarTransform4f(to_world), "sampler": {"type": "independent"}}
        )
        found.append(np.array(mi.render(scene, sensor=sensor, integrator=integrator, spp=samples, seed=number)))
    return found


def _principled(mi: Any, shape: Shape) -> dict[str, Any]:
    """A material with glTF's numbers: dielectrics reflect 4 %."""
    material, attribute = shape.material, {"type": "mesh_attribute", "name": "vertex_color"}
    base = material["texture"] if "texture" in material else material.get("color")
    base = attribute if base is None else _texture(mi, base)
    bsdf: dict[str, Any] = {"type": "principled", "specular": 0.5, "base_color": base}
    for name in ("metallic", "roughness"):
        bsdf[name] = _texture(mi, material[name])
    if "normal_map" in material:
        bent = material["normal_map"] / np.linalg.norm(material["normal_map"], axis=-1, keepdims=True)
        bsdf = {"type": "normalmap", "normalmap": _texture(mi, 0.5 * bent + 0.5), "bsdf": bsdf}
    return {"type": "twosided", "bsdf": bsdf}


def _texture(mi: Any, values: np.ndarray) -> Any:
    """A number, a colour, or a bitmap without conversion."""
    values = np.asarray(values, np.float32)
    if values.ndim == 0:
        return float(values)
    if values.ndim == 1:
        return {"type": "rgb", "value": values.tolist()}
    return {"type": "bitmap", "bitmap": mi.Bitmap(np.ascontiguousarray(values)), "raw": True}


def _write_ply(shape: Shape, path: Path) -> None:
    """A PLY file with normals and uv; Mitsuba's v points down."""
    names = ("x", "y", "z", "nx", "ny", "nz", "u", "v")
    uv = shape.uv * [1, -1] + [0, 1]
    rows = np.concatenate([shape.vertices, shape.normals, uv], axis=1).astype("<f4")
    records = np.zeros(len(shape.faces), [("count", "u1"), ("corners", "<i4", 3)])
    records["count"], records["corners"] = 3, shape.faces
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {len(rows)}"]
    lines += [f"property float {name}" for name in names]
    lines += [f"element face {len(records)}", "property list uchar int vertex_indices", "end_header\n"]
    path.write_bytes("\n".join(lines).encode() + rows.tobytes() + records.tobytes())
