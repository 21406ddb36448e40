"""Example shapes from formulas: boxes, spheres, and unlit meshes of vertex colours."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np

from rts import Part, plugin

QUAD = ((0, 1, 2), (0, 2, 3))
"""Two triangles that make a face of four corners, listed counter-clockwise."""


def box(low: Any, high: Any) -> tuple[np.ndarray, np.ndarray]:
    """A box from corner `low` to corner `high`: vertices (24, 3), four a side, and faces (12, 3), seen from outside."""
    corners, faces = [], []
    for axis in range(3):
        for side in (0, 1):
            square = np.zeros((4, 3))
            square[:, (axis + 1) % 3] = [0, 1, 1, 0]
            square[:, (axis + 2) % 3] = [0, 0, 1, 1]
            square[:, axis] = side
            order = QUAD if side else [f[::-1] for f in QUAD]
            faces += [[4 * len(corners) + i for i in f] for f in order]
            corners.append(square)
    return np.asarray(low) + np.concatenate(corners) * (np.asarray(high, float) - low), np.array(faces)


@cache
def icosphere(subdivisions: int) -> tuple[np.ndarray, np.ndarray]:
    """Unit sphere: vertices (V, 3) and faces (20 · 4ⁿ, 3) for n subdivisions. Kept for later calls; read only."""
    import trimesh

    sphere = trimesh.creation.icosphere(subdivisions=subdivisions)
    return np.asarray(sphere.vertices), np.asarray(sphere.faces)


def mesh(vertices: np.ndarray, faces: Any, shader: str, cull: str = "none", **entries: Any) -> Part:
    """A part that is a mesh; `entries` are further entries of θ."""
    return Part(plugin("rts.surfaces", "mesh")(faces), {"vertices": vertices, **entries}, shader, cull=cull)


def unlit(vertices: np.ndarray, faces: Any, colors: Any, cull: str = "none") -> Part:
    """An unlit part that is a mesh, with vertex colours (V, 3), or one colour (3,)."""
    colors = np.broadcast_to(np.asarray(colors, float), (len(vertices), 3)).copy()
    return mesh(np.asarray(vertices, float), faces, "unlit", cull, colors=colors)
