"""Extreme values of an array, their positions, and the non-negative indices among integers."""

from __future__ import annotations

import numpy as np

from rts.compiling.threads import parallel, read_only

FEW = 1 << 14
"""Numbers of which NumPy finds extremes before a compiled loop has begun."""


def largest(x: np.ndarray) -> float:
    """The largest absolute value in an array of floats; 0 if it is empty, NaN if any value is NaN."""
    from rts.arrays import extremes_loops

    if x.dtype != np.float32 or x.size < FEW:
        return float(max(x.max(initial=0), -x.min(initial=0)))
    bits = read_only(x).reshape(-1).view(np.int32)
    maxima = np.zeros(max(1, -(-bits.size // extremes_loops.CHUNK)), np.int32)
    parallel(extremes_loops.find, len(maxima), bits, maxima, work=bits.size // 12)
    return float(maxima.max().view(np.float32))


def extent(x: np.ndarray) -> tuple[int, int]:
    """The least and the largest number in a non-empty array of integers."""
    if x.dtype != np.int32 or x.size < FEW:
        return int(x.min()), int(x.max())
    return _ends(x, np.empty(0, np.bool_))


def named(x: np.ndarray) -> tuple[np.ndarray, int, int]:
    """A bool mask, true where integers `x` are not negative; and the least and the largest number in `x` and −1."""
    if not x.size:
        return np.zeros(x.shape, np.bool_), -1, -1
    if x.dtype == np.int32 and x.size >= FEW:
        mask = np.empty(x.shape, np.bool_)
        least, most = _ends(x, mask)
    else:
        mask, (least, most) = x >= 0, extent(x)
    return mask, min(least, -1), max(most, -1)


def _ends(x: np.ndarray, mask: np.ndarray) -> tuple[int, int]:
    """The least and the largest number in x, int32. Also sets `mask`, of x's shape or empty, to x ≥ 0."""
    from rts.arrays import extremes_loops

    numbers = read_only(x).reshape(-1)
    bounds = np.empty((-(-numbers.size // extremes_loops.CHUNK), 2), np.int32)
    parallel(extremes_loops.ends, len(bounds), numbers, bounds, mask.reshape(-1), work=numbers.size // 8)
    return int(bounds[:, 0].min()), int(bounds[:, 1].max())


def places(x: np.ndarray, covered: np.ndarray) -> list[tuple[int, ...]]:
    """Index tuples of the least covered number, if negative, then of the largest, if positive; the first of equal ones.

    So there are none, one or two. `covered` is a bool mask of the shape of `x`, floats.
    """
    if x.dtype != np.float32:
        sizes = np.where(covered, x, 0).reshape(1, -1)
        extremes, length = np.concatenate([-sizes, sizes]).max(axis=1, initial=0)[None], x.size
    else:
        from rts.arrays.extremes_loops import CHUNK as length

        extremes = _sizes(x, covered).view(np.float32)
    numbers, mask = x.reshape(-1), covered.reshape(-1)
    flat = []
    for sign, sizes in zip((-1, 1), extremes.T, strict=True):
        if size := sizes.max():
            first = int(sizes.argmax()) * length
            chunk = slice(first, first + length)
            flat.append(first + int(((numbers[chunk] == sign * size) & mask[chunk]).argmax()))
    return list(zip(*(i.tolist() for i in np.unravel_index(np.array(flat, np.int64), x.shape)), strict=True))


def _sizes(x: np.ndarray, covered: np.ndarray) -> np.ndarray:
    """Largest distances below and above zero of covered float32 numbers, for each chunk: their bits (·, 2), int32."""
    from rts.arrays import extremes_loops

    bits = read_only(x).reshape(-1).view(np.int32)
    sizes = np.zeros((max(1, -(-bits.size // extremes_loops.CHUNK)), 2), np.int32)
    arguments = bits, read_only(covered).reshape(-1), sizes
    parallel(extremes_loops.bounds, len(sizes), *arguments, work=bits.size // 12)
    return sizes
