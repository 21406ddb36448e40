"""Means of a finer image put into an image, compiled."""

from __future__ import annotations

import numpy as np

from rts.compiling.loops import compiled, loop


@loop
def put(start, stop, image, color, row, settled, fine, pixel, side, out):
    """Fill rows [start, stop) of `out` with an image, and means of a finer one; see `rts.operations.inset`.

    Args:
        start: first row.
        stop: end of the rows.
        image: (H, W, C); no rows for the image that `color`, `row` and `settled` describe.
        color: (C,), of covered pixels. Others are 0.
        row: (H', W') int32, with the same border on opposite sides; a pixel is covered where this is not negative.
        settled: (H', W') integers; a pixel is covered where this is not negative, too.
        fine: (h · side, w · side, C).
        pixel: (H, W) integers, the index of a pixel among the h × w of `fine`, counted row by row; negative for none.
        side: cells along each side of a pixel.
        out: (H, W, C).
    """
    _, width, channels = out.shape
    across, share = fine.shape[1] // side, out.dtype.type(1) / out.dtype.type(side)
    over, down, there = (row.shape[1] - width) // 2, (len(row) - len(out)) // 2, np.empty(width, np.uint8)
    for y in range(start, stop):
        if len(image) == 0:
            _look(there, row[y + down, over : over + width], settled[y + down, over : over + width])
            for c in range(channels):
                _paint(out[y], c, color[c], there)
        for x in range(width):
            if pixel[y, x] < 0:
                for c in range(channels if len(image) > 0 else 0):
                    out[y, x, c] = image[y, x, c]
                continue
            top, left = pixel[y, x] // across * side, pixel[y, x] % across * side
            for c in range(channels):
                out[y, x, c] = _sum(fine, top, left, c, side, share) * share


@compiled
def _sum(fine, top, left, c, side, share):
    """The sum, in channel c, of the means of the `side` columns of a pixel's cells in `fine`; `share` is 1 / `side`.

    The pixel's first cell is in row `top` and column `left`.
    """
    # Rows first, for the same rounding as in the specification.
    total = fine.dtype.type(0)
    for u in range(left, left + side):
        column = fine.dtype.type(0)
        for v in range(top, top + side):
            column += fine[v, u, c]
        total += column * share
    return total


@compiled
def _look(there, row, settled):
    """Fill `there` with 1 for covered cells of a row, else 0."""
    for x in range(len(there)):
        there[x] = np.uint8(row[x] >= 0) | np.uint8(settled[x] >= 0)


@compiled
def _paint(out, c, value, there):
    """Fill channel c of a row of an image: `value` in covered cells, else 0."""
    nothing = out.dtype.type(0)
    for x in range(len(there)):
        out[x, c] = value if there[x] else nothing


@loop
def pull(start, stop, g, pixel, row, settled, side, image, sums, fine):
    """Pull back rows [start, stop) of the gradient `g` (H, W, C) of the result of `put`.

    Args:
        start: first row.
        stop: end of the rows.
        g: (H, W, C).
        pixel: see `put`.
        row: see `put`.
        settled: see `put`.
        side: see `put`.
        image: (H, W, C), zeros at the start; receives the image's gradient. No rows to leave it out.
        sums: (H, C), zeros at the start; receives the colour's gradient, summed over each row. No rows to leave it out.
        fine: (h · side, w · side, C), zeros at the start; receives the finer image's gradient. No rows to leave it out.
    """
    _, width, channels = g.shape
    across, share = fine.shape[1] // side, g.dtype.type(1) / g.dtype.type(side * side)
    over, down = (row.shape[1] - width) // 2, (len(row) - len(g)) // 2
    for y in range(start, stop):
        for x in range(width):
            if pixel[y, x] >= 0:
                if len(fine) > 0:
                    top, left = pixel[y, x] // across * side, pixel[y, x] % across * side
                    _share(fine, top, left, side, g, y, x, share)
            elif len(image) > 0:
                for c in range(channels):
                    image[y, x, c] = g[y, x, c]
            elif len(sums) > 0 and (row[y + down, x + over] >= 0 or settled[y + down, x + over] >= 0):
                for c in range(channels):
                    sums[y, c] += g[y, x, c]


@compiled
def _share(fine, top, left, side, g, y, x, share):
    """Fill the pixel's cells in `fine` with its gradient in `g` times `share`."""
    for v in range(top, top + side):
        for u in range(left, left + side):
            for c in range(g.shape[2]):
                fine[v, u, c] = g[y, x, c] * share
