"""Which cells lie beside outlines, and where rays leave parts, compiled."""

from __future__ import annotations

import numpy as np

from rts.compiling import compiled, kernel
from rts.sampling.facing_kernels import is_front

NEAR, COVERED = np.uint8(1), np.uint8(2)


@kernel
def find(start, stop, kept, marks):
    """Mark in rows [start, stop) of `marks` (H, W) the fronts beside what may end them; see `exits.beside_outlines`."""
    layers, height, width = kept.shape
    ends = np.ones((3, width + 2), np.uint8)
    for y in range(start - 1, stop + 1):
        level = ends[(y + 3) % 3]
        level[:] = 0
        if 0 <= y < height:
            _empty(level[1:-1], kept[0, y])
            for k in range(1, layers):
                _add(level[1:-1], kept[k, y])
        if y > start:
            spread(marks[y - 1], ends[(y + 1) % 3], ends[(y + 2) % 3], level, kept[0, y - 1])


@kernel
def widen(start, stop, fronts, marks, wide, counts):
    """Mark in rows [start, stop) of `wide` the fronts (H, W) that are marked or beside such; and count them."""
    height, width = marks.shape
    near = np.empty((3, width + 2), np.uint8)
    for y in range(start - 1, stop + 1):
        level = near[(y + 3) % 3]
        level[:] = 0
        if 0 <= y < height:
            _add(level[1:-1], marks[y])
        if y > start:
            spread(wide[y - 1], near[(y + 1) % 3], near[(y + 2) % 3], level, fronts[y - 1])
            counts[y - 1] = wide[y - 1].sum()


@kernel
def gather(start, stop, marks, offsets, cells):
    """Fill `cells` (M,) with the places of marks in rows [start, stop), from `offsets` (H,) on."""
    width = marks.shape[1]
    for y in range(start, stop):
        n = offsets[y]
        for x in range(width):
            if marks[y, x]:
                cells[n] = y * width + x
                n += 1


# Rows are handed over one by one, which the compiler needs to see that they do not overlap.


@compiled
def _empty(level, covered):
    for x in range(len(covered)):
        level[x] = np.uint8(not covered[x])


@compiled
def _add(level, marks):
    for x in range(len(marks)):
        level[x] |= np.uint8(marks[x])


@compiled
def spread(near, above, level, below, where):
    """Cells of a row that have a mark in their 3 × 3 window, among those that count."""
    for x in range(len(near)):
        around = above[x] | above[x + 1] | above[x + 2] | level[x] | level[x + 1] | level[x + 2]
        near[x] = (around | below[x] | below[x + 1] | below[x + 2]) & np.uint8(where[x])


@kernel
def choose(cells, front, ids, vertices, faces, eye, there):
    """Whether rays leave a part (M,) at the second of two triangles `ids` (2, M), the first of which is the front's."""
    for m in range(len(cells)):
        behind = ids[1, m]
        there[m] = behind >= 0 and ids[0, m] == front[cells[m]] and not is_front(vertices, faces, behind, eye)
