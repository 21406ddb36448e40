"""Covered cells beside outlines, compiled."""

from __future__ import annotations

import numpy as np

from rts.compiling.loops import compiled, loop
from rts.sampling.windows_loops import add, unite

BLOCK = 32
"""Cells that are passed over at once if none is marked."""


@loop
def find(kept, cells):
    """Write to the start of `cells` the indices that `exits.beside_outlines` returns. Returns their number.

    Args:
        kept: (K, H, W) bool, the samples that splatters need.
        cells: (H · W,) int32.
    """
    layers, height, width = kept.shape
    # With one more cell at each side, the cells of all rows follow on each other: loops over all are quick.
    pitch = width + 2
    size = (height + 2) * pitch
    fronts, marks, wide = np.zeros(size, np.uint8), np.zeros(size, np.uint8), np.zeros(size, np.uint8)
    for y in range(height):
        first = (y + 1) * pitch + 1
        _load(fronts[first : first + width], marks[first : first + width], kept[0, y])
        for k in range(1, layers):
            add(marks[first : first + width], kept[k, y])
    for _ in range(2):  # Fronts beside what ends them, and fronts beside those.
        unite(wide[1:-1], marks, marks[1:], marks[2:])
        _beside(marks[pitch:-pitch], wide, wide[pitch:], wide[2 * pitch :], fronts[pitch:])
    count = 0
    for y in range(height):
        first = (y + 1) * pitch + 1
        count = _list(cells, count, y * width, marks[first : first + width])
    return count


@loop
def mark_ends(start, stop, cells, covered, depth, ends):
    """Fill `ends` (M,) for cells [start, stop) of a list: bits of the neighbours towards which the front ends.

    Bit i stands for the i-th of the eight cells around, line by line. Neighbours outside of the grid do not count.
    `cells` (M,) are flat indices of covered cells. For `covered` and `depth` (K, H, W) see `exits.outline_cells`.
    """
    layers, height, width = covered.shape
    for i in range(start, stop):
        y, x = cells[i] // width, cells[i] % width
        bits = 0
        for n in range(9):
            v, u = y + n // 3 - 1, x + n % 3 - 1
            if n != 4 and 0 <= v < height and 0 <= u < width and _ends(covered, depth, y, x, v, u, layers):
                bits |= 1 << (n - (n > 4))
        ends[i] = bits


@compiled
def _ends(covered, depth, y, x, v, u, layers):
    """True if the front of a covered cell (y, x) ends towards its neighbour (v, u)."""
    if not covered[0, v, u]:
        return True
    z = depth[0, y, x]
    gap = abs(depth[0, v, u] - z)
    for k in range(1, layers):
        if covered[k, v, u] and abs(depth[k, v, u] - z) < gap:
            return True
        if covered[k, y, x] and abs(depth[k, y, x] - depth[0, v, u]) < gap:
            return True
    return False


@compiled
def _list(cells, count, first, marks):
    """Append the indices of a row's marked cells to `cells`; the first cell has index `first`. Returns the count."""
    for start in range(0, len(marks), BLOCK):
        if _any(marks[start : start + BLOCK]):
            for x in range(start, min(start + BLOCK, len(marks))):
                if marks[x]:
                    cells[count] = first + x
                    count += 1
    return count


@compiled
def _load(fronts, ends, covered):
    for x in range(len(covered)):
        fronts[x] = np.uint8(covered[x])
        ends[x] = np.uint8(1) - np.uint8(covered[x])


@compiled
def _beside(to, above, level, below, fronts):
    for x in range(len(to)):
        to[x] = (above[x] | level[x] | below[x]) & fronts[x]


@compiled
def _any(marks):
    some = np.uint8(0)
    for x in range(len(marks)):
        some |= marks[x]
    return some != 0
