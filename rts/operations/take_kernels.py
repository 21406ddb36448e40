"""Sums of rows that share an index, compiled."""

from __future__ import annotations

from rts.compiling import kernel


@kernel
def add(values, index, total):
    """Add the rows of (M, C) to those of (V, C) that (M,) integers name, in their order; indices of no row are left."""
    for m in range(len(index)):
        if 0 <= index[m] < len(total):
            for c in range(values.shape[1]):
                total[index[m], c] += values[m, c]
