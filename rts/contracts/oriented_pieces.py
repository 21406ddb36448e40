"""Consistently oriented pieces of triangle tables, which tell the two sides of a surface apart."""

from __future__ import annotations

import numpy as np

from rts.contracts.records import Cells
from rts.scene.topology import fixed


def pieces(faces: np.ndarray) -> np.ndarray:
    """Number the consistently oriented pieces of a triangle table, the largest first.

    Two triangles are joined if they alone share an edge and run along it in opposite directions; joined triangles make
    a piece. A piece has no sides if two of its triangles run along their edge in the same direction, as in a Möbius
    strip. Such a piece has the number 0, and so have pieces whose number would be `Cells.MORE_BEHIND` or more.

    Args:
        faces: (T, 3) integers.

    Returns:
        (T,) int16, read-only, for each triangle the number of its piece, from 1 on, or 0.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    count = len(faces)
    start, end = faces.reshape(-1).astype(np.int64), np.roll(faces, -1, axis=1).reshape(-1).astype(np.int64)
    low, high = np.minimum(start, end), np.maximum(start, end)
    key = low * (int(high.max(initial=0)) + 1) + high
    order = np.argsort(key, kind="stable")
    key, along, triangle = key[order], (start < end)[order], order // 3
    first = np.flatnonzero(np.r_[True, key[1:] != key[:-1]]) if len(key) else np.zeros(0, np.int64)
    first = first[np.diff(np.r_[first, len(key)]) == 2]
    alike, pairs = along[first] != along[first + 1], (triangle[first], triangle[first + 1])
    joined = coo_array((alike[alike], tuple(p[alike] for p in pairs)), shape=(count, count))
    _, labels = connected_components(joined, directed=False)
    sizes = np.bincount(labels)
    number = np.empty(len(sizes), np.int64)
    number[np.argsort(-sizes, kind="stable")] = np.arange(1, len(sizes) + 1)
    number[number >= Cells.MORE_BEHIND] = 0
    twisted = labels[pairs[0]][~alike & (labels[pairs[0]] == labels[pairs[1]])]
    number[twisted] = 0
    return fixed(number[labels].astype(np.int16))
