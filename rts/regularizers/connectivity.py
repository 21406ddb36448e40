"""Connectivity of a mesh, computed once: edges, pairs of faces, cotangents. NumPy."""

from __future__ import annotations

from typing import Any

import numpy as np

from rts.arrays.argument_checks import quoted
from rts.errors import InputError

LARGEST_COTANGENT = 1e3
"""The cotangent of a twentieth of a degree; bounds those of narrower angles and of triangles without area."""

WEIGHTS = ("cotangent", "uniform")


def edges_of(faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The edges of a mesh, each once even if several faces share it, and the edges of each face.

    Args:
        faces: (T, 3) integers.

    Returns:
        Edges (E, 2) int32, the lower vertex first, sorted; and (T, 3) int64, the index of the edge opposite each
        corner, or −1 where its ends are one vertex.

    Raises:
        InputError: there is no edge, since the corners of every face are one vertex.
    """
    ends = np.stack([np.roll(faces, -1, axis=1), np.roll(faces, -2, axis=1)], axis=-1).astype(np.int64)
    low, high = ends.min(axis=-1), ends.max(axis=-1)
    count, proper = int(faces.max()) + 1, low < high
    keys, numbers = np.unique((low * count + high)[proper], return_inverse=True)
    if not len(keys):
        raise InputError("faces have no edge: the corners of each are one vertex; expected triangles")
    sides = np.full(faces.shape, -1, np.int64)
    sides[proper] = numbers.reshape(-1)
    return np.stack(np.divmod(keys, count), axis=-1).astype(np.int32), sides


def pairs_of(faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pairs of faces that share an edge: one pair at most edges, all pairs where more faces meet, none at a border.

    Args:
        faces: (T, 3) integers.

    Returns:
        Pairs (P, 2) int32 of indices of faces; and (P,) float64, 1 where the faces are oriented alike, so that they
        pass their edge in opposite directions, and −1 elsewhere.

    Raises:
        InputError: there is no edge.
    """
    sides = edges_of(faces)[1].reshape(-1)
    forward = (np.roll(faces, -1, axis=1) < np.roll(faces, -2, axis=1)).reshape(-1)
    order = np.argsort(sides, kind="stable")
    order = order[np.searchsorted(sides[order], 0) :]
    first, pairs = np.arange(len(order)), [np.zeros((0, 2), np.int64)]
    while len(first):  # Faces of an edge are neighbours in this order: pairs one apart, two apart, …
        stride = len(pairs)
        first = first[first + stride < len(order)]
        first = first[sides[order[first]] == sides[order[first + stride]]]
        pairs.append(order[np.stack([first, first + stride], axis=-1)])
    halves = np.concatenate(pairs)
    # A face whose corners are two vertices passes its edge twice.
    halves = halves[halves[:, 0] // 3 != halves[:, 1] // 3]
    alike = np.where(forward[halves[:, 0]] != forward[halves[:, 1]], 1.0, -1.0)
    return (halves // 3).astype(np.int32), alike


def cotangents(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """(T, 3) the bounded cotangent of the angle at each corner; 0 where a side of the angle has no length."""
    corners = vertices[faces]
    a, b = np.roll(corners, -1, axis=1) - corners, np.roll(corners, -2, axis=1) - corners
    along = (a * b).sum(axis=-1)
    across = np.linalg.norm(np.cross(a, b), axis=-1)
    across = np.maximum(across, np.abs(along) / LARGEST_COTANGENT)
    return np.divide(along, across, out=np.zeros_like(along), where=across > 0)


def edge_weights(kind: Any, vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Edges (E, 2), and the weight (E,) of each: half the sum of the cotangents opposite to it, or 1.

    Args:
        kind: "cotangent" or "uniform".
        vertices: (V, 3) float64.
        faces: (T, 3) integers.

    Raises:
        InputError: another kind, or faces without an edge.
    """
    if not isinstance(kind, str) or kind not in WEIGHTS:
        raise InputError(f"weights is {quoted(kind)}; expected one of {', '.join(WEIGHTS)}")
    edges, sides = edges_of(faces)
    if kind == "uniform":
        return edges, np.ones(len(edges))
    proper = sides >= 0
    return edges, np.bincount(sides[proper], cotangents(vertices, faces)[proper] / 2, minlength=len(edges))


def both_ways(edges: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Each edge from both of its ends, ordered by first vertex: (2E, 2) vertices, and (2E,) the number of the edge."""
    directed, number = np.concatenate([edges, edges[:, ::-1]]), np.tile(np.arange(len(edges)), 2)
    order = np.argsort(directed[:, 0], kind="stable")
    return np.ascontiguousarray(directed[order]), number[order]
