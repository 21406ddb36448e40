"""A mesh that passes through itself, moved apart: parts that are inside out, overlaps, and faces that cross others."""

from __future__ import annotations

import warnings

import numpy as np
import scipy.sparse

from rts_reconstruct.crossings import crossing_pairs

ROUNDS, WIDEN = 100, 25
"""The most rounds; after so many, one more ring of vertices around faces that cross others is smoothed along."""
MARGIN, STEP = 0.05, 0.1
"""Distance of the points beside faces, and of a round's moves, in median lengths of edges."""
RELAXED, SOFT = 0.3, 0.1
"""Share of the way to the mean of their neighbours that vertices of crossing faces go, and those of pushed ones."""
FEW = 0.0005
"""The share of faces with a wrong side that may be left: some are so thin that points beside them are outside."""


def untangled(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Vertices (V, 3) float32 of a closed mesh with next to no faces that cross others or are inside out.

    The winding number tells which sides of a face are wrong: outside of a solid it is 0, inside 1. Sheets that have
    changed places, between which it is -1, are pushed outwards, and overlaps, where it is 2, inwards. Faces that cross
    others are smoothed. All else stays as it is. Of a mesh that is not closed, crossing faces are smoothed alone.

    Source of the winding number: Barill et al. 2018, *Fast Winding Numbers for Soups and Clouds*, by gpytoolbox.

    Args:
        vertices: (V, 3).
        faces: (T, 3), counter-clockwise seen from outside.
    """
    points, mean = np.asarray(vertices, np.float64), _means(faces, len(vertices))
    length = float(np.median(np.linalg.norm(points[faces[:, 1]] - points[faces[:, 0]], axis=1)))
    closed, pairs = _is_closed(faces), crossing_pairs(points, faces)
    for number in range(ROUNDS):
        normals = _normals(points, faces)
        ways = _wrong(points, faces, MARGIN * length * normals) if closed else np.zeros(len(faces))
        if len(pairs) == 0 and np.count_nonzero(ways) <= FEW * len(faces):
            break
        pushed, crossed = (_corners(faces, which, len(points)) for which in (ways != 0, np.unique(pairs)))
        sums = np.zeros_like(points)
        np.add.at(sums, faces.ravel(), np.repeat(ways[:, None] * normals, 3, axis=0))
        push = STEP * length * sums / np.maximum(pushed, 1)[:, None]
        for _ in range(2):
            push = (push + mean @ push) / 2
        for _ in range(1 + number // WIDEN):
            crossed = crossed + mean @ crossed
        share = np.maximum(SOFT * (pushed + mean @ pushed > 0), RELAXED * (crossed > 0))
        after = points + push + share[:, None] * (mean @ points - points)
        moved = (after != points).any(axis=1)[faces].any(axis=1)
        points = after
        kept = pairs[~moved[pairs].any(axis=1)]
        pairs = np.concatenate([kept, crossing_pairs(points, faces, np.flatnonzero(moved))])
    return points.astype(np.float32)


def _wrong(points: np.ndarray, faces: np.ndarray, beside: np.ndarray) -> np.ndarray:
    """1 for faces (T,) to be pushed outwards, -1 inwards; 0 where the outside is before and the inside behind.

    Args:
        points: (V, 3).
        faces: (T, 3).
        beside: (T, 3) from the middle of each face to a point before it.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # Its import takes old names of SciPy.
        from gpytoolbox import fast_winding_number
    middles = points[faces].mean(axis=1)
    numbers = fast_winding_number(np.concatenate([middles + beside, middles - beside]), points, faces)
    before, behind = np.round(numbers).reshape(2, -1)
    return np.where((before > 0) | (behind > 1), -1.0, np.where((before < 0) | (behind < 1), 1.0, 0.0))


def _normals(points: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Unit normals (T, 3)."""
    a, b, c = (points[faces[:, i]] for i in range(3))
    normals = np.cross(b - a, c - a)
    return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)


def _corners(faces: np.ndarray, chosen: np.ndarray, count: int) -> np.ndarray:
    """The number (V,) of chosen faces around each vertex."""
    return np.bincount(faces[chosen].ravel(), minlength=count).astype(np.float64)


def _means(faces: np.ndarray, count: int) -> scipy.sparse.csr_array:
    """The matrix (V, V) of means over the neighbours of each vertex; zero for those without any."""
    ends = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    rows, columns = np.unique(np.concatenate([ends, ends[:, ::-1]]), axis=0).T
    shares = 1 / np.bincount(rows, minlength=count)[rows]
    return scipy.sparse.csr_array((shares, (rows, columns)), (count, count))


def _is_closed(faces: np.ndarray) -> bool:
    """True if each edge has two faces."""
    edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    return bool((np.unique(edges, axis=0, return_counts=True)[1] == 2).all())
