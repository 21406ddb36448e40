"""Points and cells of narrow bands, compiled.

Blocks, and their corners, are those of `rts_surfaces.implicit.blocks_loops`.

Rows of corners, in tables of levels, are looked up in bricks of 4 × 4 × 4 corners: `directory` has the brick at each
place, or −1, and `bricks` (B, 64) int32 the row of each corner, or −1. It imports numba.
"""

from __future__ import annotations

import numpy as np

from rts.plugin_api.loops import compiled, loop

SHIFT = 2
MASK = (1 << SHIFT) - 1
BRICK = 1 << SHIFT
"""Corners along each side of a brick, a power of two."""


@compiled
def _copy(source, s, target, t):
    """Copy row s of `source` (·, n) to row t of `target`, faster than by slices."""
    for i in range(source.shape[1]):
        target[t, i] = source[s, i]


# ------------------------------------------------------------------------------------------------- corners


@compiled
def _grown(array, count):
    """A copy of an array with `2 * count + 64` rows: its first `count` rows, and others that are unset."""
    longer = np.empty((2 * count + 64, *array.shape[1:]), array.dtype)
    longer[:count] = array[:count]
    return longer


@compiled
def _brick(x, y, z, counts):
    """The index of a corner's brick in the directory, and of the corner in its brick; `counts` are those of blocks."""
    place = ((x >> SHIFT) * ((counts[1] >> SHIFT) + 1) + (y >> SHIFT)) * ((counts[2] >> SHIFT) + 1) + (z >> SHIFT)
    return place, (((x & MASK) << SHIFT | y & MASK) << SHIFT) | z & MASK


@loop
def numbered(blocks, side, shape, counts, directory, bricks, used, numbers, count):
    """Look up the rows of the corners of blocks; a corner that has none gets the next, from `count` on.

    Args:
        blocks: (B, 3) int32.
        side: cells along each side of a block.
        shape: the number of points of the lattice along each axis.
        counts: the number of blocks along each axis.
        directory: (D,) int32, changed.
        bricks: (·, 64) int32, changed, or replaced by a longer copy where it is full.
        used: the number of bricks in use.
        numbers: (·,) int64, the numbers in the lattice of the corners that have rows; changed or replaced, too.
        count: the number of corners that have rows.

    Returns:
        The rows (B, 8) int32 of the blocks' corners; then `bricks`, `used`, `numbers` and `count` as they are now.
    """
    rows = np.empty((len(blocks), 8), np.int32)
    for b in range(len(blocks)):
        if used + 8 > len(bricks):
            bricks = _grown(bricks, used)
        if count + 8 > len(numbers):
            numbers = _grown(numbers, count)
        for i in range(8):
            x, y, z = blocks[b, 0] + (i & 1), blocks[b, 1] + (i >> 1 & 1), blocks[b, 2] + (i >> 2 & 1)
            place, at = _brick(x, y, z, counts)
            brick = directory[place]
            if brick < 0:
                brick = directory[place] = used
                bricks[brick] = -1
                used += 1
            row = bricks[brick, at]
            if row < 0:
                row = bricks[brick, at] = count
                x, y, z = min(x * side, shape[0] - 1), min(y * side, shape[1] - 1), min(z * side, shape[2] - 1)
                numbers[count] = (x * shape[1] + y) * shape[2] + z
                count += 1
            rows[b, i] = row
    return rows, bricks, used, numbers, count


@loop
def given_rows(known, side, shape, counts, directory, bricks, used, numbers, count):
    """Give the rows from `count` on to M corners, in the order of `known`.

    `known` (M,) are their numbers in the lattice, all different, of corners that have no row. Other arguments and
    results are those of `numbered`, without the first result.
    """
    for m in range(len(known)):
        number = known[m]
        xy = number // shape[2]
        x = xy // shape[1]
        y, z = xy - x * shape[1], number - xy * shape[2]
        place, at = _brick((x + side - 1) // side, (y + side - 1) // side, (z + side - 1) // side, counts)
        if used == len(bricks):
            bricks = _grown(bricks, used)
        if count == len(numbers):
            numbers = _grown(numbers, count)
        brick = directory[place]
        if brick < 0:
            brick = directory[place] = used
            bricks[brick] = -1
            used += 1
        bricks[brick, at] = count
        numbers[count] = number
        count += 1
    return bricks, used, numbers, count


@compiled
def row_at(x, y, z, counts, directory, bricks):
    """The row of a corner, or −1 if it has none."""
    place, at = _brick(x, y, z, counts)
    brick = directory[place]
    return bricks[brick, at] if brick >= 0 else -1


@loop
def places_of(start, stop, numbers, shape, low, step, places):
    """Fill rows `start` to before `stop` of `places` (M, 3) float64: points of the lattice, in space.

    `numbers` (M,) int64 are the points' numbers in the lattice; `shape`, `low` and `step` as for `centres`.
    """
    for m in range(start, stop):
        number = numbers[m]
        xy = number // shape[2]
        x = xy // shape[1]
        places[m, 0] = low[0] + step[0] * x
        places[m, 1] = low[1] + step[1] * (xy - x * shape[1])
        places[m, 2] = low[2] + step[2] * (number - xy * shape[2])


# ------------------------------------------------------------------------------------------------- cells


UPPER = (0b10101010, 0b11001100, 0b11110000)
"""The corners on the upper side of a block along each axis, as bits; the others are on the lower side."""
ALL = 0b11111111
OPPOSITE = 0b111


@compiled
def _inside(rows, b, values):
    """The corners of block b whose levels are negative, that is inside: bit i is set for corner i.

    `rows` (B, 8) are indices into `values`. A level of NaN or 0 counts as outside.
    """
    inside = 0
    for i in range(8):
        inside |= (values[rows[b, i]] < 0) << i
    return inside


@compiled
def _border(blocks, b, counts):
    """The corners of block b that lie on the lattice's boundary, as bits; `counts` is the number of blocks."""
    border = 0
    for a in range(3):
        if blocks[b, a] == 0:
            border |= ALL ^ UPPER[a]
        if blocks[b, a] + 1 == counts[a]:
            border |= UPPER[a]
    return border


@loop
def uncertain(blocks, centre_numbers, centre_values, rows, values, counts, reach, closed):
    """Halve blocks of two cells a side into cells, and choose those whose corners may differ in sign.

    Each cell of a block that is not cropped has the block's centre and one of its corners as opposite corners.

    Args:
        blocks: (B, 3) int32.
        centre_numbers: (B,) int64, −1 where a block is cropped; all cells of such blocks are chosen.
        centre_values: (B,) the levels at centres.
        rows: (B, 8) int32, the indices into `values` of each block's corners.
        values: the levels at corners of blocks.
        counts: the number of cells along each axis.
        reach: (8,), how much the level may differ between corners of a cell, by the axes across which they lie, as
            bits; −1 for none.
        closed: True if the surface is capped at the lattice's boundary: cells inside and at the boundary are chosen,
            too.

    Returns:
        Cells (K, 3) int32, none beyond the lattice.
    """
    kept, count = np.empty((64, 3), np.int32), 0
    for b in range(len(blocks)):
        if count + 8 > len(kept):
            kept = _grown(kept, count)
        for i in range(8):
            outside = False
            for a in range(3):
                at = 2 * blocks[b, a] + (i >> a & 1)
                kept[count, a] = at
                outside |= at >= counts[a]
            if outside:
                continue
            first, second = values[rows[b, i]], centre_values[b]
            if centre_numbers[b] >= 0 and (first < 0) == (second < 0):
                certain = True
                for j in range(8):
                    certain &= abs(first) > reach[i ^ j] or abs(second) > reach[i ^ j ^ OPPOSITE]
                if certain and not (closed and first < 0 and _border(kept, count, counts)):
                    continue
            count += 1
    return kept[:count].copy()


@loop
def crossed(blocks, rows, values, counts, closed):
    """Choose the blocks whose corners differ in sign; if closed, also blocks with a corner inside on the boundary.

    Args:
        blocks: (B, 3) int32.
        rows: (B, 8) int32, the indices into `values` of each block's corners.
        values: the levels at corners.
        counts: the number of blocks along each axis.
        closed: True if the surface is capped at the lattice's boundary.

    Returns:
        The chosen ones of `blocks`, (K, 3), and of `rows`, (K, 8).
    """
    kept, kept_rows, count = np.empty_like(blocks), np.empty_like(rows), 0
    for b in range(len(blocks)):
        inside = _inside(rows, b, values)
        if 0 < inside < ALL or (closed and inside & _border(blocks, b, counts)):
            _copy(blocks, b, kept, count)
            _copy(rows, b, kept_rows, count)
            count += 1
    return kept[:count].copy(), kept_rows[:count].copy()


@compiled
def _mark(x, y, z, counts, directory, bricks, used):
    """Mark block (x, y, z) in `bricks`, see `marked`, which must have room for one more brick.

    Returns True if the block was not marked before, and the number of bricks now in use.
    """
    place, at = _brick(x, y, z, counts)
    brick = directory[place]
    if brick < 0:
        brick = directory[place] = used
        bricks[brick] = 0
        used += 1
    new = bricks[brick, at] == 0
    bricks[brick, at] = 1
    return new, used


@loop
def marked(blocks, counts, directory, bricks, used):
    """Mark blocks (B, 3) by ones in `bricks` (·, 64) uint8, which hold blocks here as they hold corners elsewhere.

    Args:
        blocks: (B, 3) int32.
        counts: the number of blocks along each axis.
        directory: (D,) int32, changed.
        bricks: (·, 64) uint8, changed, or replaced by a longer copy where it is full.
        used: the number of bricks in use.

    Returns:
        `bricks` and `used` as they are now.
    """
    for b in range(len(blocks)):
        if used == len(bricks):
            bricks = _grown(bricks, used)
        _, used = _mark(blocks[b, 0], blocks[b, 1], blocks[b, 2], counts, directory, bricks, used)
    return bricks, used


@loop
def beyond(blocks, rows, values, counts, closed, directory, bricks, used):
    """Find and mark the unmarked blocks into which the surface goes on, across sides that it crosses.

    The surface crosses a side whose four corners differ in sign.

    Args:
        blocks: (B, 3) int32.
        rows: (B, 8) int32, the indices into `values` of each block's corners.
        values: the levels at corners.
        counts: the number of blocks along each axis.
        closed: True if the surface is capped at the lattice's boundary: it then crosses sides with a corner inside and
            on the boundary, too.
        directory: (D,) int32, of `marked`.
        bricks: (·, 64) uint8, of `marked`; changed, or replaced by a longer copy where it is full.
        used: the number of bricks in use.

    Returns:
        The new blocks (K, 3) int32, each once; then `bricks` and `used`, as they are now.
    """
    found, count = np.empty((64, 3), np.int32), 0
    for b in range(len(blocks)):
        if count + 6 > len(found):
            found = _grown(found, count)
        if used + 6 > len(bricks):
            bricks = _grown(bricks, used)
        inside = _inside(rows, b, values)
        capped = inside & _border(blocks, b, counts) if closed else 0
        for way in range(6):
            a, far = way >> 1, way & 1
            side = UPPER[a] if far else ALL ^ UPPER[a]
            at = blocks[b, a] + (1 if far else -1)
            if 0 <= at < counts[a] and (capped & side or 0 < inside & side < side):
                _copy(blocks, b, found, count)
                found[count, a] = at
                x, y, z = found[count, 0], found[count, 1], found[count, 2]
                new, used = _mark(x, y, z, counts, directory, bricks, used)
                count += new
    return found[:count].copy(), bricks, used


@loop
def inner(blocks, rows, values, counts, directory, bricks, used):
    """Find and mark the unmarked blocks that have an inside corner of these blocks; see `beyond`. Returns (K, 3)."""
    found, count = np.empty((64, 3), np.int32), 0
    for b in range(len(blocks)):
        if count + 26 > len(found):
            found = _grown(found, count)
        if used + 26 > len(bricks):
            bricks = _grown(bricks, used)
        inside = _inside(rows, b, values)
        for way in range(27):
            shared, within = inside, True
            for a in range(3):
                step = (way // 3**a) % 3 - 1
                at = blocks[b, a] + step
                found[count, a] = at
                within &= 0 <= at < counts[a]
                shared &= UPPER[a] if step > 0 else ALL ^ UPPER[a] if step < 0 else ALL
            if within and shared:
                x, y, z = found[count, 0], found[count, 1], found[count, 2]
                new, used = _mark(x, y, z, counts, directory, bricks, used)
                count += new
    return found[:count].copy()


@loop
def compact(rows, numbers, values):
    """Drop the points that no cell has as a corner, and renumber `rows` (C, 8) accordingly, in place.

    Args:
        rows: (C, 8) int32, for each cell the indices of its corners in `numbers` and `values`; changed.
        numbers: the points' numbers in the lattice; not changed.
        values: the levels at the points; not changed.

    Returns:
        Numbers (M,) int64 and values (M,) of the points that are left, in order of first appearance in `rows`.
    """
    new = np.full(len(numbers), -1, np.int32)
    kept, levels, count = np.empty_like(numbers), np.empty_like(values), 0
    for c in range(len(rows)):
        for i in range(8):
            row = rows[c, i]
            if new[row] < 0:
                new[row] = count
                kept[count], levels[count] = numbers[row], values[row]
                count += 1
            rows[c, i] = new[row]
    return kept[:count].copy(), levels[:count].copy()
