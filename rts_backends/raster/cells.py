"""Blocks of requested cells; the rasterizer skips triangles that touch none of them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rts import InputError
from rts.plugin_api.loops import compiled, loop

SIDE = 16
"""Cells along each side of a block: as many as a band of the rasterizer has rows."""

ALL = np.uint32(2**SIDE - 1)


class Blocks(NamedTuple):
    """Requested cells, in Y × X blocks of SIDE × SIDE cells of the grid.

    Attributes:
        table: (Y, X) int32, the index in `numbers` of each block with requested cells; −1 for other blocks.
        numbers: (B, SIDE, SIDE) int32, the index of each cell of a block in the flat list of cells; −1 if not
            requested.
        bits: (H, X) uint16, a bit for each cell of a row of the grid, set if it is requested; SIDE bits to a number.
    """

    table: np.ndarray
    numbers: np.ndarray
    bits: np.ndarray

    @classmethod
    def of(cls, cells: np.ndarray, size: tuple[int, int]) -> Blocks:
        """The blocks of `cells` (L, C): flat indices in a grid of `size` (height, width); −1 is skipped.

        Raises:
            InputError: a cell lies beyond the grid's last, or is listed twice.
        """
        height, width = size
        table = np.full((-(-height // SIDE), -(-width // SIDE)), -1, np.int32)
        numbers = np.empty((table.size, SIDE, SIDE), np.int32)
        bits = np.zeros((height, table.shape[1]), np.uint16)
        flat = np.ascontiguousarray(cells, np.int32).reshape(-1)
        count, bad = _fill(flat, width, table, numbers, bits)
        if bad >= 0:
            wrong = f"beyond the grid's {height} × {width}" if flat[bad] >= height * width else "there twice"
            raise InputError(f"cells name cell {flat[bad]}, which is {wrong}")
        return cls(table, numbers[:count], bits)


EVERYTHING = Blocks(np.empty((0, 0), np.int32), np.empty((0, SIDE, SIDE), np.int32), np.empty((0, 0), np.uint16))
"""The blocks of a request for all cells: empty arrays, by which loops recognise it."""


@loop
def _fill(cells, width, table, numbers, bits):
    """Fill in the arrays of `Blocks`: at first `table` is −1, `bits` is 0, and `numbers` has room for all blocks.

    Returns the number of blocks that have requested cells; and the index in `cells` of a cell beyond the grid or listed
    twice, where the loop stops, or −1.
    """
    count, m, side, size = 0, 0, np.uint32(SIDE), len(bits) * width
    while m < len(cells):
        cell = cells[m]
        if cell < 0:
            m += 1
            continue
        if cell >= size:
            return count, m
        # Most cells follow one another: take a run within a line of a block at once.
        y, x = np.uint32(cell) // np.uint32(width), np.uint32(cell) % np.uint32(width)
        first = np.int64(x % side)
        some = _following(cells[m : m + min(SIDE - first, width - np.int64(x))], cell)
        if table[y // side, x // side] < 0:
            table[y // side, x // side] = count
            numbers[count] = -1
            count += 1
        own = numbers[table[y // side, x // side], y % side]
        asked = ((1 << some) - 1) << first
        twice = np.int64(bits[y, x // side]) & asked
        if twice:
            while not twice >> first & 1:
                first, m = first + 1, m + 1
            return count, m
        bits[y, x // side] |= np.uint16(asked)
        for n in range(some):
            own[first + n] = m + n
        m += some
    return count, -1


@compiled
def _following(cells, first):
    """The length of the run `first`, `first` + 1, … with which `cells` begin."""
    same = True
    for n in range(len(cells)):
        same &= cells[n] == first + n
    if same:
        return len(cells)
    some = 1
    while cells[some] == first + some:
        some += 1
    return some


@compiled
def touching(places, box, begin, end, bits):
    """Move those of the indices `places`, of boxes, that hold requested cells to the front. Returns their number.

    `box` (4, ·) has first and last column, and first and last row, of each box; only its rows from `begin` to `end` − 1
    are looked at. The other entries of `places` are overwritten. One loop does all, since compiled code counts
    references to arrays that it passes on.
    """
    count, side, one, three = 0, np.uint32(SIDE), np.uint32(1), np.uint32(3)
    for h in range(len(places)):
        n = places[h]
        left, right = np.uint32(box[0, n]), np.uint32(box[1, n])
        top = np.uint32(max(np.int32(box[2, n]), np.int32(begin)))
        bottom = np.uint32(min(np.int32(box[3, n]), np.int32(end - 1)))
        # Most boxes fit into two words of four lines. A branch would be mispredicted every other time.
        first, last, below, above = left // side, right // side, min(top + one, bottom), max(bottom, top + one) - one
        low = bits[top, first] | bits[below, first] | bits[above, first] | bits[bottom, first]
        high = bits[top, last] | bits[below, last] | bits[above, last] | bits[bottom, last]
        some = (np.uint32(low) | np.uint32(high) << side) >> left % side & (np.uint32(2) << right - left) - one
        if (right - left >= side) | (bottom - top > three):
            some = _some(bits, left, right, top, bottom)
        places[count] = n
        count += some != 0
    return count


@compiled
def _some(bits, left, right, top, bottom):
    """A number that is not zero if a box, ends included, holds requested cells."""
    side, one, some = np.uint32(SIDE), np.uint32(1), np.uint32(0)
    first, last = left // side, right // side
    for y in range(top, bottom + one):
        for i in range(first, last + one):
            begun = ALL << left % side & ALL if i == first else ALL
            some |= bits[y, i] & begun & (ALL >> (side - one - right % side) if i == last else ALL)
    return some
