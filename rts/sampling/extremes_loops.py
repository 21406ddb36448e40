"""How large the numbers of an array are, compiled."""

from __future__ import annotations

import numpy as np

from rts.compiling.loops import loop

CHUNK = 1 << 14

UNSIGNED = np.int32(2**31 - 1)


@loop
def find(first, last, bits, found):
    """Fill `found` with the largest of each chunk of floats without their signs; all are given as `bits`, int32.

    Bits are in the order of the floats then, and NaN comes last.
    """
    for chunk in range(first, last):
        most, block = np.int32(0), bits[chunk * CHUNK : (chunk + 1) * CHUNK]
        for i in range(len(block)):
            most = np.int32(max(most, np.int32(block[i] & UNSIGNED)))
        found[chunk] = most


@loop
def ends(first, last, numbers, found, named):
    """Fill `found` (·, 2) with the least and the largest of each chunk of int32, and `named`, if any, with which name.

    Those do that are not negative.
    """
    for chunk in range(first, last):
        block = numbers[chunk * CHUNK : (chunk + 1) * CHUNK]
        low = high = block[0]
        for i in range(len(block)):
            low, high = np.int32(min(low, block[i])), np.int32(max(high, block[i]))
        found[chunk, 0], found[chunk, 1] = low, high
        there = named[chunk * CHUNK : (chunk + 1) * CHUNK]
        for i in range(len(there)):
            there[i] = block[i] >= 0


@loop
def bounds(first, last, bits, covered, found):
    """Fill `found` (·, 2) with how far floats of each chunk are below and above zero at most, as bits.

    Those count that are covered. Bits are below zero where the float has a sign.
    """
    zero = np.int32(0)
    for chunk in range(first, last):
        low, high = zero, zero
        block, taken = bits[chunk * CHUNK : (chunk + 1) * CHUNK], covered[chunk * CHUNK : (chunk + 1) * CHUNK]
        for i in range(len(block)):
            number = block[i] if taken[i] else zero
            high = np.int32(max(high, number))
            low = np.int32(max(low, np.int32(number & UNSIGNED) if number < zero else zero))
        found[chunk, 0], found[chunk, 1] = low, high
