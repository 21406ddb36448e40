"""Cells that show one colour whatever moves: they need no samples, nor do those that affect only such cells."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rts.compiling import compiled, kernel
from rts.sampling.extremes import places
from rts.sampling.windows_kernels import add, unite
from rts.threads import parallel, read_only

LONG = 2
"""Nanoseconds that a cell of a layer takes."""

LOOSE, RIGHT, BELOW = 1, 2, 4
"""Marks of cells that are no front of one colour alone, and of those whose neighbour has another colour."""


def settle(
    covered: np.ndarray,
    depth: np.ndarray,
    kept: np.ndarray,
    reach: int,
    wanted: np.ndarray | None = None,
    part: np.ndarray | None = None,
    colors: Sequence[int] = (),
) -> np.ndarray:
    """Cells (H, W) bool amid nine fronts of one colour and no hidden sample that is kept; other samples are left out.

    Those stay that are within reach of a cell that is wanted and not settled. So do the nearest and the farthest front,
    since splatters measure differences of depth by these.

    Args:
        covered: (K, H, W) bool.
        depth: (K, H, W) float, of one dtype.
        kept: (K, H, W) bool, samples that are needed where colours differ; changed in place.
        reach: cells.
        wanted: (H, W) bool, the cells that are looked at; None for all, and those beyond the border.
        part: (H, W) integers, the part of each front, or −1; None where all have one colour.
        colors: of each part the number of its colour, or −1 where it has several.
    """
    layers, height, width = covered.shape
    wanted = np.empty((0, width), np.bool_) if wanted is None else np.ascontiguousarray(wanted)
    covered, depth = np.ascontiguousarray(covered), np.ascontiguousarray(depth)
    found, near = np.empty((height, width), np.bool_), np.empty((height, width), np.bool_)
    told = read_only(np.empty((0, width)) if part is None else part, np.int32), read_only(np.array(colors, np.int32))
    given = covered, kept, wanted, *told, reach, found, near
    parallel(_settle, height, *given, work=LONG * covered.size)
    ends = places(depth[:1], kept[:1])
    parallel(_drop, height, near, kept, work=covered.size // 8)
    for end in ends:
        kept[end] = True
    return found


@kernel
def _settle(start, stop, covered, kept, wanted, part, colors, reach, found, near):
    """Fill rows [start, stop) of what is found, and of cells near any that are not."""
    layers, height, width = covered.shape
    around = reach + 1
    rows = stop - start + 2 * around
    # A border of cells that are not amid fronts, as nothing is known there.
    loose, middle = np.ones((rows, width + 2 * around), np.uint8), slice(around, around + width)
    wide, far = np.ones((rows, width), np.uint8), 2 * around - 2
    # What is not settled lies in blocks of 3 × 3 cells, at seams of 2 × 3; what is wanted of it, anywhere.
    step = 1 if len(wanted) > 0 else (2 if len(part) > 0 else 3)
    column, nine = np.empty(width + 2 * around, np.uint8), np.empty(width + 2 * around - 2, np.uint8)
    shown = np.empty((2, width), np.int32)  # The colours of two rows.
    for r in range(rows):
        y = start - around + r
        if 0 <= y < height:
            _load(loose[r, middle], covered[0, y])
            for k in range(1, layers):
                add(loose[r, middle], kept[k, y])
            if len(part) > 0:
                _color(shown[r % 2], loose[r, middle], part[y], colors)
                if r > 0:
                    _compare(loose[r - 1, middle], shown[1 - r % 2], shown[r % 2])
    for r in range(rows - 2):
        _join_rows(column, loose[r], loose[r + 1], loose[r + 2])
        _join_columns(nine, column, column[1:], column[2:])
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


@kernel
def _drop(start, stop, near, kept):
    """Leave out what is not near."""
    for k in range(len(kept)):
        for y in range(start, stop):
            _mask(kept[k, y], near[y])


# Rows are handed over one by one, which the compiler needs to see that they do not overlap.


@compiled
def _load(loose, covered):
    for x in range(len(loose)):
        loose[x] = np.uint8(1) - np.uint8(covered[x])


@compiled
def _color(shown, marks, part, colors):
    """Fill the colours of a row of fronts, and mark those of several, and those beside another colour."""
    for x in range(len(shown)):
        shown[x] = colors[part[x]] if part[x] >= 0 else -1
        marks[x] |= np.uint8(LOOSE) if shown[x] < 0 else np.uint8(0)
    for x in range(len(shown) - 1):
        marks[x] |= np.uint8(RIGHT) if shown[x] != shown[x + 1] else np.uint8(0)


@compiled
def _compare(marks, shown, below):
    """Mark the cells of a row that lie above another colour."""
    for x in range(len(shown)):
        marks[x] |= np.uint8(BELOW) if shown[x] != below[x] else np.uint8(0)


@compiled
def _join_rows(found, a, b, c):
    """Unite what is marked in three rows: what lies below the last is no concern."""
    for x in range(len(found)):
        found[x] = a[x] | b[x] | (c[x] & np.uint8(LOOSE | RIGHT))


@compiled
def _join_columns(found, a, b, c):
    """Whether there is a mark in any of three columns: what lies on the right of the last is no concern."""
    for x in range(len(found)):
        found[x] = np.uint8((a[x] | b[x] | (c[x] & np.uint8(LOOSE | BELOW))) != 0)


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
