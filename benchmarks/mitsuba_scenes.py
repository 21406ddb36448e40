"""Mitsuba 3 with the camera of the benchmarks, and meshes that shine in flat colours.

It comes with the extra `bench`, and compiles with the shared library of LLVM: 16 or newer (Debian's libllvm19), which
DRJIT_LIBLLVM_PATH may name.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np

from benchmarks.camera import DISTANCE, FOV


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


def sensor(size: tuple[int, int], pixel_format: str) -> dict:
    """The camera of the benchmarks, for an image (height, width) of "rgb" or "luminance"."""
    film = {
        "type": "hdrfilm",
        "width": size[1],
        "height": size[0],
        "rfilter": {"type": "box"},
        "pixel_format": pixel_format,
        "component_format": "float32",
        "sample_border": True,
    }
    return {
        "type": "perspective",
        "fov": FOV,
        "fov_axis": "y",
        "near_clip": 0.5,
        "far_clip": 10.0,
        "to_world": mitsuba().ScalarTransform4f().look_at([0, 0, DISTANCE], [0, 0, 0], [0, 1, 0]),
        "film": film,
    }


def integrator() -> Any:
    """Derivatives with visibility; nothing is lit by anything, so there are no indirect boundaries to sample."""
    return mitsuba().load_dict({"type": "direct_projective", "sppi": 0})


def emitter(vertices: np.ndarray, faces: np.ndarray, path: str, colors: np.ndarray | None = None) -> dict:
    """A mesh that emits its vertex colours, white where there are none, on a black material.

    By way of a PLY file at the path, the only road by which a mesh gets both colours and an emitter.
    """
    mi = mitsuba()
    mesh = mi.Mesh("mesh", len(vertices), len(faces))
    arrays = mi.traverse(mesh)
    arrays["vertex_positions"] = np.ravel(vertices).astype(np.float32)
    arrays["faces"] = np.ravel(faces).astype(np.uint32)
    arrays.update()
    radiance: dict[str, Any] = {"type": "rgb", "value": 1.0}
    if colors is not None:
        mesh.add_attribute("vertex_color", 3, np.ravel(colors).astype(np.float32))
        radiance = {"type": "mesh_attribute", "name": "vertex_color"}
    mesh.write_ply(path)
    return {
        "type": "ply",
        "filename": path,
        "face_normals": True,
        "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.0}},
        "emitter": {"type": "area", "radiance": radiance},
    }
