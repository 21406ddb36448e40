"""Triangle meshes of fewer faces, by quadric errors (Garland and Heckbert 1997; the package fast-simplification)."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

FEWEST = 20_000
"""Meshes of fewer faces are left as they are: their faces take little of the time."""
SHARES = (1 / 16, 1 / 4)


class Decimated(NamedTuple):
    """A mesh of fewer faces.

    Attributes:
        faces: (T', 3) int32.
        vertices: (V', 3) in the dtype of the original vertices.
        nearest: (V',) int32, for each vertex the nearest original one among those merged into it.
    """

    faces: np.ndarray
    vertices: np.ndarray
    nearest: np.ndarray


def fewer_faces(vertices: np.ndarray, faces: np.ndarray) -> Iterator[Decimated]:
    """Copies of a mesh with about 1/16, then 1/4 of its faces.

    Yields none if the mesh has fewer than `FEWEST` faces, or if fast-simplification is not installed.

    Args:
        vertices: (V, 3) float.
        faces: (T, 3) integers.
    """
    try:
        import fast_simplification
    except ImportError:
        return
    if len(faces) < FEWEST:
        return
    points, triangles = np.ascontiguousarray(vertices, np.float64), np.array(faces, np.int32)
    for share in SHARES:
        simplified: Any = fast_simplification.simplify(points, triangles, 1 - share, return_collapses=True)
        merged, left, became = fast_simplification.replay_simplification(points, triangles, simplified[2])
        distance = np.linalg.norm(points - merged[became], axis=1)
        # The nearest vertices come last, and overwrite the others.
        order = np.argsort(-distance, kind="stable")
        nearest = np.zeros(len(merged), np.int32)
        nearest[became[order]] = order
        yield Decimated(np.asarray(left, np.int32), merged.astype(vertices.dtype), nearest)
