"""A solid from COLMAP's points: what lies before a point that a camera sees is empty, what lies behind it is not."""

from __future__ import annotations

from typing import Any, cast

import numpy as np
import scipy.ndimage
import scipy.sparse
import scipy.sparse.linalg
import trimesh

import rts
from rts_reconstruct.points import Points

LATTICE, REACH = 80, 1.1
"""Points of the lattice along each axis, and how far it reaches; the region is a ball of radius 1."""
CELL = 2 * REACH / (LATTICE - 1)
BEHIND = 3
"""Cells behind a point that it says are filled."""
NEAR = 1.6
"""Points farther out say nothing of what is filled."""
EMPTY, MOST, SURE = 0.25, 4.0, 100.0
"""Weight of a ray through a cell beside that of a point before it; the most weight of a cell; that of space outside."""


def solid_of(points: Points) -> trimesh.Trimesh | None:
    """The surface of the largest piece of what the points of a region fill; None if they fill nothing.

    Each cell of a lattice has a share between 0, empty, and 1, filled. Rays vote on it, and neighbours differ by
    little: the random walker of Grady 2006, *Random Walks for Image Segmentation*, with priors.

    Args:
        points: in the world of the region, whose ball has radius 1.
    """
    filled = _solved(*_votes(points))
    labels, count = cast(Any, scipy.ndimage.label(filled > 0.5))
    if count == 0:
        return None
    largest = 1 + int(np.argmax(np.bincount(labels.ravel())[1:]))
    filled = np.where(scipy.ndimage.binary_dilation(labels == largest), filled, 0)
    surface = rts.plugin("surfaces", "isosurface")(((-REACH,) * 3, (REACH,) * 3), 0.5, inside="above")
    found = surface.extract({"values": filled.astype(np.float32)})
    mesh = trimesh.Trimesh(found.vertices, found.faces)
    return max(mesh.split(only_watertight=False), key=lambda piece: len(piece.faces))


def _votes(points: Points) -> tuple[np.ndarray, np.ndarray]:
    """Numbers (N, N, N) of rays through each cell, and of rays that end just before it."""
    ends = points.positions[points.rows]
    ways = ends - points.eyes
    lengths = np.linalg.norm(ways, axis=1)
    ways = CELL * ways / np.maximum(lengths, 1e-12)[:, None]
    empty, filled = np.zeros(LATTICE**3), np.zeros(LATTICE**3)
    farthest = float(np.linalg.norm(ends, axis=1).max()) + 2 * REACH
    for step in range(1, int(farthest / CELL)):
        before = step * CELL < lengths
        _add(empty, (ends - step * ways)[before])
    near = np.linalg.norm(ends, axis=1) < NEAR
    for step in range(1, BEHIND + 1):
        _add(filled, (ends + step * ways)[near])
    shape = (LATTICE,) * 3
    return empty.reshape(shape), filled.reshape(shape)


def _add(votes: np.ndarray, places: np.ndarray) -> None:
    """Count places (M, 3) by the cell that they are in."""
    cells = np.rint((places + REACH) / CELL).astype(int)
    cells = cells[((cells >= 0) & (cells < LATTICE)).all(axis=1)]
    votes += np.bincount(np.ravel_multi_index(tuple(cells.T), (LATTICE,) * 3), minlength=votes.size)


def _solved(empty: np.ndarray, filled: np.ndarray) -> np.ndarray:
    """The shares (N, N, N) that fit the votes best, and differ least between neighbours; 0 outside of the region."""
    axis = np.linspace(-REACH, REACH, LATTICE) ** 2
    outside = axis[:, None, None] + axis[:, None] + axis > 1
    for_one = np.where(outside, 0, np.minimum(filled, MOST))
    for_zero = np.where(outside, SURE, np.minimum(EMPTY * empty, MOST))
    step = scipy.sparse.eye_array(LATTICE - 1, LATTICE, k=1) - scipy.sparse.eye_array(LATTICE - 1, LATTICE)
    one, second = scipy.sparse.eye_array(LATTICE), step.T @ step
    kron = scipy.sparse.kron
    smooth = kron(kron(second, one), one) + kron(kron(one, second), one) + kron(kron(one, one), second)
    matrix = (smooth + scipy.sparse.diags_array((for_one + for_zero).ravel())).tocsr()
    scale = scipy.sparse.diags_array(1 / matrix.diagonal())
    shares = scipy.sparse.linalg.cg(matrix, for_one.ravel(), rtol=1e-3, maxiter=400, M=scale)[0]
    return shares.reshape(empty.shape)
