"""Where the rasterizer may pass over triangles, if only some cells of the grid are asked for."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rts.compiling import kernel
from rts.records import Fragments

SIDE = 16
"""Cells along each side of a block, which are as many as rows of a band of the rasterizer."""

BOX, LISTED = 4, 8
"""Where the box of a listed triangle begins in what is listed of it, first and last column and row; and where it ends.
"""

ALL = np.uint32(2**SIDE - 1)


class Blocks(NamedTuple):
    """The cells that are asked for, in blocks of the grid.

    Attributes:
        table: (Y, X) int32, the number of each block that holds any, or −1.
        numbers: (B, SIDE, SIDE) int32, where in the list each cell of such a block is, or −1.
        bits: (H, X) uint16, the cells of each line of the grid that are asked for, a number for SIDE of them.
    """

    table: np.ndarray
    numbers: np.ndarray
    bits: np.ndarray

    @classmethod
    def of(cls, cells: np.ndarray, size: tuple[int, int]) -> Blocks:
        """The blocks of cells (L, C), flat indices in a grid of (height, width), or −1."""
        height, width = size
        table = np.full((-(-height // SIDE), -(-width // SIDE)), -1, np.int32)
        cells = np.ascontiguousarray(cells, np.int32).reshape(-1)
        numbers = np.full((_number(cells, width, table), SIDE, SIDE), -1, np.int32)
        bits = np.zeros((height, table.shape[1]), np.uint16)
        _fill(cells, width, table, numbers, bits)
        return cls(table, numbers, bits)

    @staticmethod
    def nothing(cells: np.ndarray, layers: int) -> Fragments:
        """Empty fragments (K, L, C)."""
        shape = layers, *cells.shape
        ids, barycentrics = np.full(shape, -1, np.int32), np.zeros((*shape, 2), np.float32)
        return Fragments(ids, barycentrics, np.zeros(shape, np.float32))


@kernel
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


@kernel
def _fill(cells, width, table, numbers, bits):
    for m in range(len(cells)):
        if cells[m] >= 0:
            y, x = cells[m] // width, cells[m] % width
            numbers[table[y // SIDE, x // SIDE], y % SIDE, x % SIDE] = m
            bits[y, x // SIDE] |= np.uint16(1 << x % SIDE)


@kernel
def narrow(first, last, listed, bits, spans, counts):
    """Leave out listed triangles whose box of pixels holds none of the cells.

    Args:
        first: first chunk.
        last: past the last chunk.
        listed: see `rts_backends.raster`.
        bits: of `Blocks`.
        spans: (chunks, 2), where each chunk begins and ends in the list; ends are changed.
        counts: (bands, chunks), to be counted anew.
    """
    for chunk in range(first, last):
        counts[:, chunk] = 0
        found = spans[chunk, 0]
        for n in range(spans[chunk, 0], spans[chunk, 1]):
            left, right = np.uint32(listed[n, BOX]), np.uint32(listed[n, BOX + 1])
            top, bottom = np.uint32(listed[n, BOX + 2]), np.uint32(listed[n, BOX + 3])
            i0, i1 = left // np.uint32(SIDE), right // np.uint32(SIDE)
            begin, end = ALL << left % np.uint32(SIDE) & ALL, ALL >> (np.uint32(SIDE - 1) - right % np.uint32(SIDE))
            touches = False
            for y in range(top, bottom + 1):
                for i in range(i0, i1 + 1):
                    mask = (begin if i == i0 else ALL) & (end if i == i1 else ALL)
                    touches |= (bits[y, i] & mask) != 0
                if touches:
                    break
            if touches:
                for r in range(LISTED):
                    listed[found, r] = listed[n, r]
                found += 1
                for j in range(top // np.uint32(SIDE), bottom // np.uint32(SIDE) + 1):
                    counts[j, chunk] += 1
        spans[chunk, 1] = found
