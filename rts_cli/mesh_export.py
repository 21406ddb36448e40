"""rts export: the mesh of any surface, written by trimesh."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from rts import Part
from rts.errors import InputError

FORMATS = (".obj", ".ply", ".stl", ".glb", ".off")


def write_mesh(path: Path, parts: Sequence[Part], tolerance: float) -> tuple[int, int]:
    """Write a mesh of parts of NumPy arrays, in the coordinates of their scene.

    Args:
        path: a name with an extension of `FORMATS`; missing folders are made.
        parts: the parts.
        tolerance: largest distance of triangles from the surface, in the units of the scene.

    Returns:
        The numbers of vertices and triangles.

    Raises:
        InputError: the transform of a part is singular.
    """
    import trimesh

    meshes = []
    for part in parts:
        m = np.eye(4) if part.transform is None else np.asarray(part.transform, np.float64)
        scale = np.abs(np.linalg.det(m[:3, :3])) ** (1 / 3)
        if not scale > 0:
            raise InputError("the transform of a part is singular; expected one that has an inverse")
        vertices, faces = part.surface.tessellate(part.theta, float(tolerance / scale))
        faces = faces[:, ::-1] if np.linalg.det(m[:3, :3]) < 0 else faces
        meshes.append(trimesh.Trimesh(vertices @ m[:3, :3].T + m[:3, 3], faces, process=False))
    whole: Any = trimesh.util.concatenate(meshes)
    path.parent.mkdir(parents=True, exist_ok=True)
    whole.export(path)
    return len(whole.vertices), len(whole.faces)
