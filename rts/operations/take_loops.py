"""Rows by index, and sums of rows that share an index, as compiled loops."""

from __future__ import annotations

from rts.compiling.loops import loop


@loop
def put(start, stop, rows, index, out, bad):
    """Fill rows [start, stop) of `out` (M, C) with the rows of (V, C) that `index` (M,) names.

    `bad` (1,) is set if an index names no row; that row of `out` is left unwritten.
    """
    count, channels = rows.shape
    for m in range(start, stop):
        i = index[m]
        if not 0 <= i < count:
            bad[0] = True
            continue
        for c in range(channels):
            out[m, c] = rows[i, c]


@loop
def add(values, index, total):
    """Add each row of `values` (M, C) to the row of `total` (V, C) that `index` (M,) names; skip indices of no row."""
    for m in range(len(index)):
        if 0 <= index[m] < len(total):
            for c in range(values.shape[1]):
                total[index[m], c] += values[m, c]
