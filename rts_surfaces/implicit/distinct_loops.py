"""Distinct whole numbers among many, without sorting, compiled. It imports numba."""

from __future__ import annotations

import numpy as np

from rts.plugin_api.loops import loop

FIRST, SECOND = np.uint64(0xBF58476D1CE4E5B9), np.uint64(0x94D049BB133111EB)
"""Factors of splitmix64, which spreads neighbouring numbers evenly."""


@loop
def distinct(keys):
    """Find the different numbers among many, by open addressing.

    Args:
        keys: (M,) int64, M < 2**31.

    Returns:
        The different keys, in order of first appearance, (U,) int64, and the row of each key among them, (M,) int32.
    """
    bits = 1
    while 1 << bits < 2 * len(keys):
        bits += 1
    last, shift = (1 << bits) - 1, np.uint64(64 - bits)
    table = np.full(1 << bits, -1, np.int32)
    found, inverse = np.empty(len(keys), np.int64), np.empty(len(keys), np.int32)
    count = 0
    for m in range(len(keys)):
        key = keys[m]
        mixed = np.uint64(key)
        mixed = (mixed ^ (mixed >> np.uint64(30))) * FIRST
        mixed = (mixed ^ (mixed >> np.uint64(27))) * SECOND
        at = np.int64(mixed >> shift)
        row = table[at]
        while row >= 0 and found[row] != key:
            at = (at + 1) & last
            row = table[at]
        if row < 0:
            row = table[at] = count
            found[count] = key
            count += 1
        inverse[m] = row
    return found[:count].copy(), inverse
