"""Marks of cells from row to row, for loops that look at 3 × 3 windows.

Rows are handed over one by one, which the compiler needs to see that they do not overlap.
"""

from __future__ import annotations

import numpy as np

from rts.compiling.loops import compiled


@compiled
def add(marks, more):
    """Add the marks of `more` (W,) to a row of marks, uint8."""
    for x in range(len(more)):
        marks[x] |= np.uint8(more[x])


@compiled
def spread(found, above, level, below):
    """Mark the cells of a row (W,) with a mark in their 3 × 3 window; the other rows have a cell more at each side."""
    for x in range(len(found)):
        around = above[x] | above[x + 1] | above[x + 2] | level[x] | level[x + 1] | level[x + 2]
        found[x] = around | below[x] | below[x + 1] | below[x + 2]


@compiled
def unite(found, a, b, c):
    """Mark the cells of `found` that any of three rows marks, uint8; these rows may be longer."""
    for x in range(len(found)):
        found[x] = a[x] | b[x] | c[x]
