"""Faces of a mesh that pass through others: found, and moved apart."""

from __future__ import annotations

import numpy as np
from scipy.spatial import KDTree

ENDS = np.array([[0, 1], [1, 2], [2, 0]])
"""Corners of a face's edges."""
INSIDE = 1e-9
"""The least share of an edge, and of a triangle's height, beyond a touch: faces that only touch do not cross."""


def crossing_pairs(vertices: np.ndarray, faces: np.ndarray, among: np.ndarray | None = None) -> np.ndarray:
    """Pairs (M, 2) of faces that cross each other. Faces that share an edge do not count, nor those that touch.

    Args:
        vertices: (V, 3).
        faces: (T, 3).
        among: numbers of faces; pairs without any of them are left out. None for all faces.
    """
    faces = np.asarray(faces)
    corners = np.asarray(vertices, np.float64)[faces]
    centers = corners.mean(axis=1)
    reach = np.linalg.norm(corners - centers[:, None], axis=2).max(axis=1)
    among = np.arange(len(faces)) if among is None else among
    near = KDTree(centers).query_ball_point(centers[among], reach[among] + reach.max())
    first = np.repeat(among, [len(found) for found in near])
    second = np.concatenate([np.asarray(found, np.int64) for found in near]) if len(among) else first
    pairs = np.stack([first, second], axis=1)
    chosen = np.zeros(len(faces), bool)
    chosen[among] = True
    pairs = pairs[(first < second) | (~chosen[second])]
    low, high = corners.min(axis=1), corners.max(axis=1)
    boxes = ((low[pairs[:, 0]] <= high[pairs[:, 1]]) & (low[pairs[:, 1]] <= high[pairs[:, 0]])).all(axis=1)
    pairs = pairs[boxes]
    same = faces[pairs[:, 0]][:, :, None] == faces[pairs[:, 1]][:, None, :]
    pairs, same = pairs[(shared := same.sum(axis=(1, 2))) < 2], same[shared < 2]
    cross = np.zeros(len(pairs), bool)
    for side in (0, 1):
        touched = same.any(axis=2 - side)  # Corners that belong to the other face, too.
        for edge in ENDS:
            free = ~touched[:, edge].any(axis=1) & ~cross
            ends = corners[pairs[free, side]][:, edge]
            cross[free] = _pierces(ends, corners[pairs[free, 1 - side]])
    return pairs[cross]


def _pierces(ends: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """True where a segment (N, 2, 3) passes through the inside of a triangle (N, 3, 3).

    Source: Möller and Trumbore 1997, *Fast, Minimum Storage Ray/Triangle Intersection*.
    """
    along, from_first = ends[:, 1] - ends[:, 0], ends[:, 0] - corners[:, 0]
    a, b = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    across, beside = np.cross(along, b), np.cross(from_first, a)
    volume = (a * across).sum(axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):  # Of segments parallel to their triangle, and nothing passes.
        u, v, t = ((x * y).sum(axis=1) / volume for x, y in ((from_first, across), (along, beside), (b, beside)))
        least = np.minimum(np.minimum(u, v), np.minimum(1 - u - v, np.minimum(t, 1 - t)))
    return least > INSIDE
