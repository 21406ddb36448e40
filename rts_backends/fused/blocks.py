"""Blocks of columns near which there are samples: loops over cells pass over all others.

Most of an image is empty, or amid one colour and needs no samples.
"""

from __future__ import annotations

import numpy as np

from rts.compiling import compiled, kernel
from rts.threads import parallel

BLOCK = 16
"""Columns that share a note."""

REACH = 2
"""Cells between a target and the farthest samples that decide anything for it."""

SOME, FIRST, LAST = 1, 2, 4
"""Bits of a block of one row: whether there are samples, within reach of the block before, and of the one after."""


def live(row: np.ndarray) -> np.ndarray:
    """(H, B) uint8, whether a cell of row (K, H, W) that refers to a sample lies in a block or within reach of it."""
    _, height, width = row.shape
    bits = np.empty((height, -(-width // BLOCK)), np.uint8)
    parallel(_note, height, row, bits, work=row.size // 4)
    found = np.empty_like(bits)
    _spread(bits, found)
    return found


@kernel
def _note(start, stop, row, bits):
    """Fill the bits of rows [start, stop)."""
    layers, _, width = row.shape
    for y in range(start, stop):
        for b in range(bits.shape[1]):
            left, right = b * BLOCK, min((b + 1) * BLOCK, width)
            bits[y, b] = 0
            for k in range(layers):
                if _any(row[k, y, left:right]):
                    bits[y, b] |= SOME
                    bits[y, b] |= FIRST * _any(row[k, y, left : min(left + REACH, right)])
                    bits[y, b] |= LAST * _any(row[k, y, max(right - REACH, left) : right])


@compiled
def _any(cells):
    last = cells.dtype.type(-1)
    for i in cells:
        last = max(last, i)
    return last >= 0


@kernel
def _spread(bits, found):
    height, count = bits.shape
    for y in range(height):
        found[y] = 0
        for v in range(max(y - REACH, 0), min(y + REACH + 1, height)):
            for b in range(count):
                found[y, b] |= bits[v, b] & SOME
            for b in range(1, count):
                found[y, b] |= (bits[v, b - 1] & LAST) != 0
                found[y, b - 1] |= (bits[v, b] & FIRST) != 0


@compiled
def run(live, b):
    """The first and the last + 1 of the next live blocks of a row that lie side by side, from block b on."""
    first = b
    while first < len(live) and not live[first]:
        first += 1
    last = first
    while last < len(live) and live[last]:
        last += 1
    return first, last
