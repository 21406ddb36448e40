"""Marks of cells from row to row, for loops that look at 3 × 3 windows.

Rows are handed over one by one, which the compiler needs to see that they do not overlap.
"""

from __future__ import annotations

import numpy as np

from rts.compiling.loops import compiled


@compiled
def add(marks, more):
    """Add the marks of `more` (W,) to `marks` (W,) uint8."""
    for x in range(len(more)):
        marks[x] |= np.uint8(more[x])


@compiled
def spread(found, above, level, below):
    """Fill `found` (W,) with the marks of each cell's 3 × 3 window, in rows with one more cell at each side."""
    for x in range(len(found)):
        around = above[x] | above[x + 1] | above[x + 2] | level[x] | level[x + 1] | level[x + 2]
        found[x] = around | below[x] | below[x + 1] | below[x + 2]


@compiled
def unite(found, a, b, c):
    """Fill `found` (W,) uint8 with the marks of three rows together; these rows may be longer."""
    for x in range(len(found)):
        found[x] = a[x] | b[x] | c[x]
