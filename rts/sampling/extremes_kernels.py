"""How large the numbers of an array are, compiled."""

from __future__ import annotations

import numpy as np

from rts.compiling import kernel

CHUNK = 1 << 14

UNSIGNED = np.int32(2**31 - 1)


@kernel
def find(first, last, bits, found):
    """Fill `found` with the largest of each chunk of floats without their signs; all are given as `bits`, int32.

    Bits are in the order of the floats then, and NaN comes last.
    """
    for chunk in range(first, last):
        most, block = np.int32(0), bits[chunk * CHUNK : (chunk + 1) * CHUNK]
        for i in range(len(block)):
            most = np.int32(max(most, np.int32(block[i] & UNSIGNED)))
        found[chunk] = most
