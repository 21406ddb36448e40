"""Where the rasterizer may pass over triangles, if only some cells of the grid are asked for."""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np

from rts.records import Fragments

SIDE = 16
"""Cells along each side of a block, which are as many as rows of a band of the rasterizer."""

SMALL = 6
"""Boxes of fewer pixels along each side are looked at pixel by pixel."""

BOX = 4
"""Where the box of a listed triangle begins in what is listed of it: first and last column and row."""


class Blocks(NamedTuple):
    """The cells that are asked for, in blocks of the grid.

    Attributes:
        table: (Y, X) int32, the number of each block that holds any, or −1.
        numbers: (B, SIDE, SIDE) int32, where in the list each cell of such a block is, or −1.
    """

    table: np.ndarray
    numbers: np.ndarray

    @classmethod
    def of(cls, cells: np.ndarray, size: tuple[int, int]) -> Blocks:
        """The blocks of cells (L, C), flat indices in a grid of (height, width), or −1."""
        height, width = size
        table = np.full((-(-height // SIDE), -(-width // SIDE)), -1, np.int32)
        cells = np.ascontiguousarray(cells, np.int32).reshape(-1)
        numbers = np.full((_number(cells, width, table), SIDE, SIDE), -1, np.int32)
        _fill(cells, width, table, numbers)
        return cls(table, numbers)

    @staticmethod
    def nothing(cells: np.ndarray, layers: int) -> Fragments:
        """Empty fragments (K, L, C)."""
        shape = layers, *cells.shape
        ids, barycentrics = np.full(shape, -1, np.int32), np.zeros((*shape, 2), np.float32)
        return Fragments(ids, barycentrics, np.zeros(shape, np.float32))


@numba.njit(cache=True, nogil=True)
def _number(cells, width, table):
    """Number the blocks that hold any cells; how many there are."""
    count = 0
    for cell in cells:
        if cell >= 0:
            y, x = cell // width // SIDE, cell % width // SIDE
            if table[y, x] < 0:
                table[y, x] = count
                count += 1
    return count


@numba.njit(cache=True, nogil=True)
def _fill(cells, width, table, numbers):
    for m in range(len(cells)):
        if cells[m] >= 0:
            y, x = cells[m] // width, cells[m] % width
            numbers[table[y // SIDE, x // SIDE], y % SIDE, x % SIDE] = m


@numba.njit(cache=True, nogil=True)
def narrow(first, last, listed, table, members, spans, counts):
    """Leave out listed triangles whose box of pixels holds none of the cells, as far as that is seen at once.

    Args:
        first: first chunk.
        last: past the last chunk.
        listed: see `rts_backends.raster`.
        table: of `Blocks`.
        members: the `numbers` of `Blocks`.
        spans: (chunks, 2), where each chunk begins and ends in the list; ends are changed.
        counts: (bands, chunks), to be counted anew.
    """
    for chunk in range(first, last):
        counts[:, chunk] = 0
        found = spans[chunk, 0]
        for n in range(spans[chunk, 0], spans[chunk, 1]):
            left, right, top, bottom = listed[n, BOX], listed[n, BOX + 1], listed[n, BOX + 2], listed[n, BOX + 3]
            i0, i1, j0, j1 = left // SIDE, right // SIDE, top // SIDE, bottom // SIDE
            touches = False
            for j in range(j0, j1 + 1):
                for i in range(i0, i1 + 1):
                    touches |= table[j, i] >= 0
                if touches:
                    break
            if touches and right - left < SMALL and bottom - top < SMALL:
                touches = False
                for y in range(top, bottom + 1):
                    for x in range(left, right + 1):
                        block = table[y // SIDE, x // SIDE]
                        touches |= block >= 0 and members[block, y % SIDE, x % SIDE] >= 0
            if touches:
                listed[found] = listed[n]
                found += 1
                for j in range(j0, j1 + 1):
                    counts[j, chunk] += 1
        spans[chunk, 1] = found
