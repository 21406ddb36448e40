"""Rows by index, and sums of rows that share one, compiled."""

from __future__ import annotations

from rts.compiling.loops import loop


@loop
def put(start, stop, rows, index, shift, out, bad):
    """Fill rows [start, stop) of out (M, C) with those of (V, C) that (M,) integers name, plus a shift if it has rows.

    `bad` (1,) is marked where there is no such row.
    """
    count, channels = rows.shape
    for m in range(start, stop):
        i = index[m]
        if not 0 <= i < count:
            bad[0] = True
            continue
        for c in range(channels):
            out[m, c] = rows[i, c] + shift[m, c] if len(shift) > 0 else rows[i, c]


@loop
def add(values, index, total):
    """Add the rows of (M, C) to those of (V, C) that (M,) integers name, in their order; indices of no row are left."""
    for m in range(len(index)):
        if 0 <= index[m] < len(total):
            for c in range(values.shape[1]):
                total[index[m], c] += values[m, c]
