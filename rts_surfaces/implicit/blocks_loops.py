"""Blocks of cells near the surface of a field, halved and widened, compiled.

Blocks of `side` cells an axis lie at multiples of the side; the last ones are cropped at the lattice's end. A block is
named by its index (x, y, z) int32 in the grid of blocks. Corners of blocks form a grid, too: a corner (x, y, z) is the
lattice's point (min(x side, X − 1), …). Corner i of a block has the offsets (i & 1, i >> 1 & 1, i >> 2 & 1). It imports
numba.
"""

from __future__ import annotations

import numpy as np

from rts.plugin_api.loops import loop

RELATIVE = 1e-9
"""The share by which reaches, the most that a level can change over a distance, are enlarged for their rounding."""


@loop
def halved(blocks, counts):
    """Halve blocks (B, 3) along each axis: the blocks of half the side, (C, 3), without those beyond the end.

    Args:
        blocks: (B, 3) int32.
        counts: the number of smaller blocks along each axis.
    """
    total = 0
    for b in range(len(blocks)):
        inside = 1
        for a in range(3):
            inside *= min(2, counts[a] - 2 * blocks[b, a])
        total += inside
    children, c = np.empty((total, 3), np.int32), 0
    for b in range(len(blocks)):
        x, y, z = 2 * blocks[b, 0], 2 * blocks[b, 1], 2 * blocks[b, 2]
        for i in range(x, min(x + 2, counts[0])):
            for j in range(y, min(y + 2, counts[1])):
                for k in range(z, min(z + 2, counts[2])):
                    children[c, 0], children[c, 1], children[c, 2] = i, j, k
                    c += 1
    return children


@loop
def centres(start, stop, blocks, side, shape, low, step, places):
    """Fill rows `start` to before `stop` of `places` (B, 3) float64: the centres of blocks (B, 3), in space.

    The centre of a block that is cropped at the lattice's end is that of the rest.

    Args:
        start: first block.
        stop: one after the last.
        blocks: (B, 3) int32.
        side: cells along each side of a block.
        shape: the number of points of the lattice along each axis.
        low: the place of the lattice's first point.
        step: the distances of neighbours along each axis.
        places: (B, 3) float64 to be filled.
    """
    for b in range(start, stop):
        for a in range(3):
            first = blocks[b, a] * side
            places[b, a] = low[a] + step[a] * (0.5 * (first + min(first + side, shape[a] - 1)))


@loop
def centre_numbers(blocks, side, shape):
    """Flat indices (B,) int64 in the lattice of the centres of blocks (B, 3); −1 where the lattice ends inside a block.

    `side`, the cells along each side of a block, is even. `shape` is the number of points along each axis.
    """
    numbers = np.empty(len(blocks), np.int64)
    for b in range(len(blocks)):
        number, whole = 0, True
        for a in range(3):
            first = blocks[b, a] * side
            whole &= first + side < shape[a]
            number = number * shape[a] + first + side // 2
        numbers[b] = number if whole else -1
    return numbers


@loop
def near(blocks, values, side, shape, step, lipschitz, slack, closed):
    """Choose the blocks through which the surface may pass, judging by the levels at their centres.

    Args:
        blocks: (B, 3) int32.
        values: (B,) the levels at centres; where they are NaN a block stays.
        side: cells along each side of a block.
        shape: the number of points of the lattice along each axis.
        step: the distances of neighbours along each axis.
        lipschitz: how fast the level changes at most, per unit of length.
        slack: how far a level may be off by rounding.
        closed: True if the surface is capped at the lattice's boundary: blocks inside and at the boundary then stay.

    Returns:
        (B,) bool, True for a chosen block.
    """
    kept = np.empty(len(blocks), np.bool_)
    for b in range(len(blocks)):
        square, border = 0.0, False
        for a in range(3):
            first = blocks[b, a] * side
            last = min(first + side, shape[a] - 1)
            square += (0.5 * step[a] * (last - first)) ** 2
            border |= first == 0 or last == shape[a] - 1
        reach = lipschitz * np.sqrt(square) * (1 + RELATIVE) + slack
        kept[b] = not (values[b] > reach or (values[b] < -reach and not (closed and border)))
    return kept


@loop
def widened(blocks, margin, counts):
    """The blocks (B, 3), and all blocks at most `margin` blocks away along each axis.

    Returns (K, 3) int32, each block once, x changing slowest. `counts` is the number of blocks along each axis.
    """
    marked = np.zeros(counts, np.bool_)
    for b in range(len(blocks)):
        x, y, z = blocks[b]
        for i in range(max(x - margin, 0), min(x + margin + 1, counts[0])):
            for j in range(max(y - margin, 0), min(y + margin + 1, counts[1])):
                marked[i, j, max(z - margin, 0) : min(z + margin + 1, counts[2])] = True
    kept, count = np.empty((marked.sum(), 3), np.int32), 0
    for i in range(counts[0]):
        for j in range(counts[1]):
            for k in range(counts[2]):
                if marked[i, j, k]:
                    kept[count, 0], kept[count, 1], kept[count, 2] = i, j, k
                    count += 1
    return kept
