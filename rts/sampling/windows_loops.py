"""Marks of cells from row to row, for loops that look at 3 × 3 windows.

Rows are handed over one by one, which the compiler needs to see that they do not overlap.
"""

from __future__ import annotations

import numpy as np

from rts.compiling.loops import compiled


@compiled
def add(marks, more):
    """Mark the cells (W,) of a row of uint8 that others mark."""
    for x in range(len(more)):
        marks[x] |= np.uint8(more[x])


@compiled
def spread(found, above, level, below):
    """Fill a row (W,) with whether there is a mark in the 3 × 3 window; marks have one cell more at each side."""
    for x in range(len(found)):
        around = above[x] | above[x + 1] | above[x + 2] | level[x] | level[x + 1] | level[x + 2]
        found[x] = around | below[x] | below[x + 1] | below[x + 2]


@compiled
def unite(found, a, b, c):
    """Fill uint8 with what is marked in any of three; each may be longer."""
    for x in range(len(found)):
        found[x] = a[x] | b[x] | c[x]
