"""How large the numbers of an array are, where the largest lie, and which indices name something."""

from __future__ import annotations

import numpy as np

from rts.threads import parallel, read_only


def largest(x: np.ndarray) -> float:
    """The largest size of a number in an array of floats; 0 for none, NaN where any is NaN."""
    from rts.arrays import extremes_loops

    if x.dtype != np.float32:
        return float(max(x.max(initial=0), -x.min(initial=0)))
    bits = read_only(x).reshape(-1).view(np.int32)
    found = np.zeros(max(1, -(-bits.size // extremes_loops.CHUNK)), np.int32)
    parallel(extremes_loops.find, len(found), bits, found, work=bits.size // 12)
    return float(found.max().view(np.float32))


def extent(x: np.ndarray) -> tuple[int, int]:
    """The least and the largest of an array of integers that is not empty."""
    if x.dtype != np.int32:
        return int(x.min()), int(x.max())
    return _ends(x, np.empty(0, np.bool_))


def named(x: np.ndarray) -> tuple[np.ndarray, int, int]:
    """Where an array of indices is not negative, bool; and the least and the largest of them, and −1."""
    if not x.size:
        return np.zeros(x.shape, np.bool_), -1, -1
    if x.dtype == np.int32:
        there = np.empty(x.shape, np.bool_)
        least, most = _ends(x, there)
    else:
        there, (least, most) = x >= 0, extent(x)
    return there, min(least, -1), max(most, -1)


def _ends(x: np.ndarray, there: np.ndarray) -> tuple[int, int]:
    """The least and the largest of int32; `there`, of their shape or empty, is filled with which are not negative."""
    from rts.arrays import extremes_loops

    numbers = read_only(x).reshape(-1)
    found = np.empty((-(-numbers.size // extremes_loops.CHUNK), 2), np.int32)
    parallel(extremes_loops.ends, len(found), numbers, found, there.reshape(-1), work=numbers.size // 8)
    return int(found[:, 0].min()), int(found[:, 1].max())


def places(x: np.ndarray, covered: np.ndarray) -> list[tuple[int, ...]]:
    """Where the least and the largest covered number first stand: of those that are below, and above, zero."""
    if x.dtype != np.float32:
        sizes = np.where(covered, x, 0).reshape(1, -1)
        found, length = np.concatenate([-sizes, sizes]).max(axis=1, initial=0)[None], x.size
    else:
        from rts.arrays.extremes_loops import CHUNK as length

        found = _sizes(x, covered).view(np.float32)
    numbers, there = x.reshape(-1), covered.reshape(-1)
    flat = []
    for sign, sizes in zip((-1, 1), found.T, strict=True):
        if size := sizes.max():
            first = int(sizes.argmax()) * length
            chunk = slice(first, first + length)
            flat.append(first + int(((numbers[chunk] == sign * size) & there[chunk]).argmax()))
    return list(zip(*(i.tolist() for i in np.unravel_index(np.array(flat, np.int64), x.shape)), strict=True))


def _sizes(x: np.ndarray, covered: np.ndarray) -> np.ndarray:
    """How far numbers (float32) of each chunk are below and above zero at most, as bits (·, 2) int32."""
    from rts.arrays import extremes_loops

    bits = read_only(x).reshape(-1).view(np.int32)
    found = np.zeros((max(1, -(-bits.size // extremes_loops.CHUNK)), 2), np.int32)
    given = bits, read_only(covered).reshape(-1), found
    parallel(extremes_loops.bounds, len(found), *given, work=bits.size // 12)
    return found
