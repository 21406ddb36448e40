"""What the scenes are made of: motions, cards that are placed on screen, boxes, spheres, sheets."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np

import rts
from benchmarks.camera import DISTANCE, FOV


def pixel(depth: float, size: int) -> float:
    """World width of one pixel at a depth."""
    return 2 * depth * np.tan(np.radians(FOV / 2)) / size


def motion(depth: float, size: int, sign: float = 1.0) -> np.ndarray:
    """Derivative (4, 4) of a motion along +x by one pixel at a depth."""
    matrix = np.zeros((4, 4))
    matrix[0, 3] = sign * pixel(depth, size)
    return matrix


def unlit(vertices: np.ndarray, faces: Any, colors: Any, cull: str = "none") -> rts.Part:
    """Mesh with vertex colours (V, 3), or one colour (3,)."""
    colors = np.broadcast_to(np.asarray(colors, float), (len(vertices), 3)).copy()
    surface = rts.plugin("rts.surfaces", "mesh")(faces)
    return rts.Part(surface, {"vertices": np.asarray(vertices, float), "colors": colors}, "unlit", cull=cull)


def on_screen(xy: np.ndarray, depth: float, size: int) -> np.ndarray:
    """World points (N, 3) at a camera depth that are seen at pixels (N, 2): y down, the top left corner (0, 0)."""
    xy = (np.asarray(xy, float) - size / 2) * pixel(depth, size)
    return np.column_stack([xy[:, 0], -xy[:, 1], np.full(len(xy), DISTANCE - depth)])


QUAD = ((0, 1, 2), (0, 2, 3))


def rectangle(left: float, top: float, right: float, bottom: float, depth: float, size: int) -> np.ndarray:
    """Corners (4, 3) of an upright card that is seen between these pixel coordinates."""
    return on_screen(np.array([[left, bottom], [right, bottom], [right, top], [left, top]]), depth, size)


def box(low: Any, high: Any) -> tuple[np.ndarray, np.ndarray]:
    """Corners (24, 3), four a face, and triangles (12, 3) that face outwards."""
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
    """Unit sphere: vertices (V, 3) and faces (20 · 4ⁿ, 3)."""
    import trimesh

    sphere = trimesh.creation.icosphere(subdivisions=subdivisions)
    return np.asarray(sphere.vertices), np.asarray(sphere.faces)


def grid(count_u: int, count_v: int) -> tuple[np.ndarray, np.ndarray]:
    """Parameters (V, 2) in [−1, 1]² and triangles of a sheet of count_u × count_v cells."""
    u, v = np.meshgrid(np.linspace(-1, 1, count_u + 1), np.linspace(-1, 1, count_v + 1), indexing="ij")
    index = np.arange(u.size).reshape(u.shape)
    a, b, c, d = (i.ravel() for i in (index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]))
    return np.column_stack([u.ravel(), v.ravel()]), np.concatenate(
        [np.column_stack([a, b, c]), np.column_stack([a, c, d])]
    )
