"""Checks of cages of subdivision surfaces: a cage on which OpenSubdiv would crash never reaches it.

Half edge h is the side of a face from its corner h to the next one; H is the number of half edges.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rts import InputError

REPAIR = "repair the cage"


class Cage(NamedTuple):
    """The checked topology of a cage, in read-only host arrays.

    Attributes:
        scheme: "catmark" or "loop".
        sizes: (F,) int32, the number of corners of each face.
        first: (F + 1,) int32, the first half edge of each face.
        indices: (H,) int32, the vertices at the corners of all faces.
        twins: (H,) int32, the half edge of the neighbouring face on the same edge, or −1 at a boundary.
        creases: (C, 2) int32, the vertices of sharp edges.
        crease_sharpness: (C,) float32, from 0 to `INFINITE`.
        corners: (D,) int32, sharp vertices; not the corners of faces.
        corner_sharpness: (D,) float32, from 0 to `INFINITE`.
        holes: (E,) int32, faces that shape the surface but are not part of it.
    """

    scheme: str
    sizes: np.ndarray
    first: np.ndarray
    indices: np.ndarray
    twins: np.ndarray
    creases: np.ndarray
    crease_sharpness: np.ndarray
    corners: np.ndarray
    corner_sharpness: np.ndarray
    holes: np.ndarray

    def next(self) -> np.ndarray:
        """The half edge (H,) int64 that follows each half edge in its face."""
        after = np.arange(1, len(self.indices) + 1)
        after[self.first[1:] - 1] = self.first[:-1]
        return after

    def faces(self) -> np.ndarray:
        """The face (H,) int64 of each half edge."""
        return np.repeat(np.arange(len(self.sizes)), self.sizes)


def half_edge_ends(cage: Cage) -> tuple[np.ndarray, np.ndarray]:
    """The vertices (H,) at both ends of each half edge."""
    return cage.indices, cage.indices[cage.next()]


def edge_key(a: np.ndarray, b: np.ndarray, count: int) -> np.ndarray:
    """A number (n,) int64 for each edge between vertices a and b (n,), the same in both directions.

    `count` is greater than the number of any vertex, so that numbers of edges differ.
    """
    return np.minimum(a, b).astype(np.int64) * count + np.maximum(a, b)


def sorted_edges(cage: Cage) -> tuple[np.ndarray, np.ndarray]:
    """Half edges (H,) sorted by the key of their edges, see `edge_key`, and the sorted keys (H,)."""
    keys = edge_key(*half_edge_ends(cage), int(cage.indices.max()) + 1)
    order = np.argsort(keys, kind="stable")
    return order, keys[order]


def twins_of(cage: Cage, order: np.ndarray, keys: np.ndarray) -> np.ndarray:
    """`Cage.twins` (H,), from the result of `sorted_edges`; an InputError if the cage is no oriented manifold."""
    same = keys[1:] == keys[:-1]
    thrice = np.flatnonzero(same[1:] & same[:-1])
    (a, b), owner = half_edge_ends(cage), cage.faces()
    if len(thrice):
        h = order[thrice[0]]
        count = int((keys == keys[thrice[0]]).sum())
        raise InputError(f"{count} faces share the edge of vertices {a[h]} and {b[h]}; expected at most 2: {REPAIR}")
    left = np.flatnonzero(same)
    one, two = order[left], order[left + 1]
    aligned = np.flatnonzero(a[one] == a[two])
    if len(aligned):
        h, k = one[aligned[0]], two[aligned[0]]
        raise InputError(
            f"faces {owner[h]} and {owner[k]} both run from vertex {a[h]} to {b[h]}; expected one orientation: turn "
            f"one of them round"
        )
    twins = np.full(len(a), -1, np.int32)
    twins[one], twins[two] = two, one
    return twins
