"""A checksum of an array's bytes at the speed of memory. Imported when first needed, since it imports numba."""

from __future__ import annotations

import numba
import numpy as np

FACTOR = np.uint64(0x9E3779B185EBCA87)
UP, DOWN = np.uint64(31), np.uint64(33)


@numba.njit(cache=True, nogil=True)
def checksum(words: np.ndarray) -> int:
    """64 bits of (N,) uint64: four interleaved multiply-and-rotate chains, as in xxHash, folded into one."""
    a, b, c, d = np.uint64(1), np.uint64(2), np.uint64(3), np.uint64(4)
    whole = len(words) // 4 * 4
    for i in range(0, whole, 4):
        a += words[i] * FACTOR
        b += words[i + 1] * FACTOR
        c += words[i + 2] * FACTOR
        d += words[i + 3] * FACTOR
        a, b = ((a << UP) | (a >> DOWN)) * FACTOR, ((b << UP) | (b >> DOWN)) * FACTOR
        c, d = ((c << UP) | (c >> DOWN)) * FACTOR, ((d << UP) | (d >> DOWN)) * FACTOR
    for i in range(whole, len(words)):
        a += words[i] * FACTOR
        a = ((a << UP) | (a >> DOWN)) * FACTOR
    result = np.uint64(len(words))
    for lane in (a, b, c, d):
        result = (result ^ lane) * FACTOR
        result ^= result >> DOWN
    return result
