"""Cells amid one colour, which no movement changes. Samples that affect only such cells are dropped."""

from __future__ import annotations

import numpy as np

from rts.arrays.extremes import places
from rts.compiling.loops import compiled, loop
from rts.compiling.threads import parallel
from rts.sampling.windows_loops import add, unite

LONG = 2
"""Nanoseconds of work for each cell of each layer."""


def settle(
    covered: np.ndarray,
    depth: np.ndarray,
    kept: np.ndarray,
    reach: int,
    wanted: np.ndarray | None = None,
) -> np.ndarray:
    """Find cells amid fronts: their 3 × 3 window is covered, without kept hidden samples. Drop samples only they need.

    Samples within reach of any other wanted cell stay. So do the nearest and the farthest front, since splatters
    measure differences of depth relative to these two.

    Args:
        covered: (K, H, W) bool.
        depth: (K, H, W) float, of one dtype.
        kept: (K, H, W) bool, samples that are needed where colours differ; changed in place.
        reach: of the splatter, in cells.
        wanted: (H, W) bool, the cells that are shown; None for all, those beyond the grid included.

    Returns:
        (H, W) bool, True for cells amid fronts; False in the outermost lines and columns.
    """
    layers, height, width = covered.shape
    wanted = np.empty((0, width), np.bool_) if wanted is None else np.ascontiguousarray(wanted)
    covered, depth = np.ascontiguousarray(covered), np.ascontiguousarray(depth)
    found, near = np.empty((height, width), np.bool_), np.empty((height, width), np.bool_)
    given = covered, kept, wanted, reach, found, near
    parallel(_settle, height, *given, work=LONG * covered.size)
    ends = places(depth[:1], kept[:1])
    parallel(_drop, height, near, kept, work=covered.size // 8)
    for end in ends:
        kept[end] = True
    return found


@loop
def _settle(start, stop, covered, kept, wanted, reach, found, near):
    """Fill lines [start, stop) of `found` and `near`. For other arguments see `settle`.

    Args:
        start: first line.
        stop: end of the lines.
        covered: (K, H, W) bool.
        kept: (K, H, W) bool.
        wanted: (H, W) bool; no rows for all cells, those beyond the grid included.
        reach: in cells.
        found: (H, W) bool: the cell is amid fronts.
        near: (H, W) bool: the cell is within reach of a wanted cell that is not amid fronts.
    """
    layers, height, width = covered.shape
    around = reach + 1
    rows = stop - start + 2 * around
    # The border counts as not amid fronts, as nothing is known there.
    loose, middle = np.ones((rows, width + 2 * around), np.uint8), slice(around, around + width)
    wide, far = np.ones((rows, width), np.uint8), 2 * around - 2
    # Cells that are not amid one colour come in blocks of 3 × 3; wanted ones among them lie anywhere.
    step = 1 if len(wanted) > 0 else 3
    column, nine = np.empty(width + 2 * around, np.uint8), np.empty(width + 2 * around - 2, np.uint8)
    for r in range(rows):
        y = start - around + r
        if 0 <= y < height:
            _load(loose[r, middle], covered[0, y])
            for k in range(1, layers):
                add(loose[r, middle], kept[k, y])
    for r in range(rows - 2):
        unite(column, loose[r], loose[r + 1], loose[r + 2])
        unite(nine, column, column[1:], column[2:])
        y = start - around + r + 1
        if start <= y < stop:
            _reverse(found[y], nine[around - 1 :])
        if len(wanted) > 0:
            nine[: around - 1], nine[around - 1 + width :] = 0, 0
            if 0 <= y < height:
                _mask(nine[around - 1 : around - 1 + width], wanted[y])
            else:
                nine[:] = 0
        unite(wide[r], nine, nine[min(step, far) :], nine[far:])
        for v in range(2 * step, far, step):
            _join(wide[r], nine[v:])
    for y in range(start, stop):
        r = y - start
        _near(near[y], wide[r], wide[r + min(step, far)], wide[r + far])
        for v in range(2 * step, far, step):
            _join(near[y], wide[r + v])


@loop
def _drop(start, stop, near, kept):
    """Clear lines [start, stop) of `kept` (K, H, W) bool, in all layers, in cells that `near` (H, W) does not mark."""
    for k in range(len(kept)):
        for y in range(start, stop):
            _mask(kept[k, y], near[y])


# Rows are handed over one by one, which the compiler needs to see that they do not overlap.


@compiled
def _load(loose, covered):
    for x in range(len(loose)):
        loose[x] = np.uint8(1) - np.uint8(covered[x])


@compiled
def _join(to, cells):
    for x in range(len(to)):
        to[x] |= cells[x]


@compiled
def _reverse(to, cells):
    for x in range(len(to)):
        to[x] = cells[x] == 0


@compiled
def _near(to, a, b, c):
    for x in range(len(to)):
        to[x] = (a[x] | b[x] | c[x]) != 0


@compiled
def _mask(kept, near):
    for x in range(len(kept)):
        kept[x] &= near[x]
