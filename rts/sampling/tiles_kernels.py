"""Fine cells of active pixels laid out in tiles, and samples put into them. Compiled."""

from __future__ import annotations

import numpy as np

from rts.compiling import compiled, kernel

WANTED, NEAR = 1, 2
"""Bits of cells: inside of an active pixel, and within two cells of one."""


@kernel
def fill(active, corners, side, tile, apron, across, pitch, most, numbers, cells, place, kinds, pixel):
    """Lay out the cells that active pixels need, tile by tile; the number of tiles that fit, and of their cells.

    Args:
        active: (H, W) bool.
        corners: (T, 2), row and column of each tile among tiles.
        side: s, cells along each side of a pixel.
        tile: pixels along each side of a tile.
        apron: cells around active pixels that are needed.
        across: tiles in a line of the layout.
        pitch: cells from one tile of the layout to the next.
        most: cells that there is room for.
        numbers: (Y + 2, X + 2, st, st) int32 zeros, a number for each cell of the Y × X tiles and those around them.
        cells: (most,) int32, to be filled: flat index of each cell in the grid, which has the apron, too.
        place: (h, w) int32, −1, to be filled: which of the cells each place of the layout holds.
        kinds: (h, w) uint8 zeros, to be filled with bits.
        pixel: (H, W) int32, −1, to be filled: where in the layout, in pixels, an active pixel is.
    """
    height, width = active.shape
    inner = side * tile
    reach, count, line = inner + 2 * apron, 0, width * side + 2 * apron
    local, pixels = np.zeros((reach, reach), np.uint8), (place.shape[1] - 2 * apron) // side
    for t in range(len(corners)):
        top, left = corners[t, 0] * tile, corners[t, 1] * tile
        bottom, right = min(top + tile, height), min(left + tile, width)
        local[:] = 0
        for y in range(top, bottom):
            for x in range(left, right):
                if active[y, x]:
                    _spread(local, (y - top) * side, (x - left) * side, side, apron)
        before = count
        down, over = t // across * pitch, t % across * pitch
        for v in range(reach):
            # Places in the maps of this tile and of those around it: 0 for that before, 1 for this, 2 for that after.
            ty = (v >= apron) + (v >= apron + inner)
            rows = numbers[corners[t, 0] + ty, :, v - apron - (ty - 1) * inner]
            first = (top * side + v) * line + left * side
            for u in range(reach):
                if local[v, u] == 0:
                    continue
                tx = (u >= apron) + (u >= apron + inner)
                own = rows[corners[t, 1] + tx]
                m = own[u - apron - (tx - 1) * inner]
                if m == 0:
                    count += 1
                    if count > most:
                        break
                    m = count
                    cells[m - 1] = first + u
                    own[u - apron - (tx - 1) * inner] = m
                place[down + v, over + u] = m - 1
                kinds[down + v, over + u] = local[v, u] & 3
            if count > most:
                break
        if count > most:
            # What was begun is taken back: this tile's pixels stay coarse, and those of all that follow.
            cells[before:most] = -1
            place[down : down + reach, over : over + reach] = -1
            kinds[down : down + reach, over : over + reach] = 0
            return t, before
        for y in range(top, bottom):
            for x in range(left, right):
                if active[y, x]:
                    pixel[y, x] = (down // side + y - top) * pixels + over // side + x - left
    return len(corners), count


@compiled
def _spread(local, top, left, side, apron):
    """Mark the cells around a pixel, of which the first is (top, left) without the apron."""
    reach = side + 2 * apron
    for v in range(reach):
        row, inside = local[top + v], apron <= v < apron + side
        near = np.uint8(4 | NEAR) if apron - 2 <= v < apron + side + 2 else np.uint8(4)
        for u in range(left, left + reach):
            row[u] |= np.uint8(4)
        for u in range(left + apron - 2, left + apron + side + 2):
            row[u] |= near
        if inside:
            for u in range(left + apron, left + apron + side):
                row[u] |= np.uint8(WANTED)


@kernel
def count(start, stop, row, place, counts):
    """Count the samples of lines [start, stop) of a layout, counted over layers: counts (K · h,)."""
    height = len(place)
    for line in range(start, stop):
        k, found = line // height, 0
        for m in place[line % height]:
            found += m >= 0 and row[k, m] >= 0
        counts[line] = found


@kernel
def arrange(start, stop, row, place, cells, firsts, width, offsets, index, shift, laid, part):
    """Put samples into lines [start, stop) of a layout, counted over layers.

    Args:
        start: first line.
        stop: end of the lines.
        row: (K, M) int32, the sample of each cell.
        place: (h, w).
        cells: (M,), the flat index of each cell in the grid.
        firsts: (P − 1,) the first row of each part but the first.
        width: of the grid.
        offsets: (K · h,), the number of the first splat of each line.
        index: (N,) int32, to be filled: the sample of each splat.
        shift: (N, 3) float32, to be filled: from the grid to the layout.
        laid: (K, h, w) int32, to be filled: the splat of each place.
        part: (K, h, w) int32, to be filled: its part.
    """
    height = len(place)
    for line in range(start, stop):
        k, y, n = line // height, line % height, offsets[line]
        for x in range(place.shape[1]):
            m = place[y, x]
            i = row[k, m] if m >= 0 else -1
            laid[k, y, x], part[k, y, x] = -1, -1
            if i < 0:
                continue
            index[n], laid[k, y, x], part[k, y, x] = i, n, 0
            for first in firsts:
                part[k, y, x] += i >= first
            shift[n, 0], shift[n, 1], shift[n, 2] = x - cells[m] % width, y - cells[m] // width, 0
            n += 1


@kernel
def gather(start, stop, covered, depth, place, laid, deep):
    """What of (K, M) cells is covered, and how deep, in lines [start, stop) of a layout, counted over layers."""
    height = len(place)
    for line in range(start, stop):
        k, y = line // height, line % height
        for x in range(place.shape[1]):
            m = place[y, x]
            laid[k, y, x] = m >= 0 and covered[k, m]
            deep[k, y, x] = depth[k, m] if m >= 0 else 0


@kernel
def scatter(kept, kinds, place, found):
    """Mark the (K, M) cells that are kept (K, h, w) near wanted ones, anywhere in a layout."""
    for k in range(len(kept)):
        for y in range(len(place)):
            for x in range(place.shape[1]):
                if kept[k, y, x] and kinds[y, x] & NEAR:
                    found[k, place[y, x]] = True
