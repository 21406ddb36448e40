"""Which cells lie beside outlines, compiled."""

from __future__ import annotations

import numpy as np

from rts.compiling import compiled, kernel
from rts.sampling.windows_kernels import add, spread


@kernel
def find(kept, cells):
    """Fill `cells` (H · W,) with the places that `exits.beside_outlines` returns; how many there are."""
    layers, height, width = kept.shape
    # Of three rows each, and one more cell at each side: what ends fronts, and fronts beside that.
    ends, near = np.zeros((3, width + 2), np.uint8), np.zeros((3, width + 2), np.uint8)
    wide, count = np.empty(width, np.uint8), 0
    for y in range(height + 2):
        level = ends[y % 3]
        level[:] = 0
        if y < height:
            _add_empty(level[1:-1], kept[0, y])
            for k in range(1, layers):
                add(level[1:-1], kept[k, y])
        beside = near[(y + 2) % 3]
        beside[:] = 0
        if 0 < y <= height:
            _beside(beside[1:-1], ends[(y + 1) % 3], ends[(y + 2) % 3], level, kept[0, y - 1])
        if y > 1 and _beside(wide, near[y % 3], near[(y + 1) % 3], beside, kept[0, y - 2]):
            for x in range(width):
                cells[count] = (y - 2) * width + x
                count += wide[x]
    return count


@compiled
def _add_empty(level, covered):
    for x in range(len(covered)):
        level[x] |= np.uint8(not covered[x])


@compiled
def _beside(found, above, level, below, where):
    """Mark the cells of a row that have a mark in their 3 × 3 window, among those that count; whether there is any."""
    spread(found, above, level, below)
    some = np.uint8(0)
    for x in range(len(found)):
        found[x] &= np.uint8(where[x])
        some |= found[x]
    return some != 0
