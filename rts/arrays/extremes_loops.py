"""Extreme values of an array, as compiled loops."""

from __future__ import annotations

import numpy as np

from rts.compiling.loops import loop

CHUNK = 1 << 14

UNSIGNED = np.int32(2**31 - 1)


@loop
def find(first, last, bits, maxima):
    """Fill `maxima` (M,), for chunks [first, last) of `CHUNK` float32 numbers, with their largest absolute value.

    It is NaN if one is NaN. Numbers, `bits` (N,), are given and returned as their bits, int32. Without the sign bit,
    bits are in the order of the floats, and NaN comes last.
    """
    for chunk in range(first, last):
        most, block = np.int32(0), bits[chunk * CHUNK : (chunk + 1) * CHUNK]
        for i in range(len(block)):
            most = np.int32(max(most, np.int32(block[i] & UNSIGNED)))
        maxima[chunk] = most


@loop
def ends(first, last, numbers, extremes, mask):
    """Fill `extremes` (M, 2), for chunks [first, last) of `CHUNK` numbers (N,) int32, with the least and the largest.

    Unless empty, `mask` (N,) is filled with True where numbers are not negative, else False. No chunk may be empty.
    """
    for chunk in range(first, last):
        block = numbers[chunk * CHUNK : (chunk + 1) * CHUNK]
        low = high = block[0]
        for i in range(len(block)):
            low, high = np.int32(min(low, block[i])), np.int32(max(high, block[i]))
        extremes[chunk, 0], extremes[chunk, 1] = low, high
        marks = mask[chunk * CHUNK : (chunk + 1) * CHUNK]
        for i in range(len(marks)):
            marks[i] = block[i] >= 0


@loop
def bounds(first, last, bits, covered, sizes):
    """Fill `sizes` (M, 2), for chunks [first, last), with the largest distances of covered floats below and above zero.

    A chunk has `CHUNK` floats; without covered ones its distances are 0. Floats, `bits` (N,), are given and returned as
    their bits, int32, which are negative where the float is. `covered` is (N,) bool.
    """
    zero = np.int32(0)
    for chunk in range(first, last):
        low, high = zero, zero
        block, taken = bits[chunk * CHUNK : (chunk + 1) * CHUNK], covered[chunk * CHUNK : (chunk + 1) * CHUNK]
        for i in range(len(block)):
            number = block[i] if taken[i] else zero
            high = np.int32(max(high, number))
            low = np.int32(max(low, np.int32(number & UNSIGNED) if number < zero else zero))
        sizes[chunk, 0], sizes[chunk, 1] = low, high
