"""Means of a finer image put into an image, compiled."""

from __future__ import annotations

from rts.compiling import compiled, kernel


@kernel
def put(start, stop, image, color, row, settled, fine, pixel, side, out):
    """Fill rows [start, stop) of out (H, W, C); see `rts.operations.inset`.

    Where there is no `image`, there is a `color`, `row` and `settled`.
    """
    _, width, channels = out.shape
    across, share = fine.shape[1] // side, out.dtype.type(1) / out.dtype.type(side)
    for y in range(start, stop):
        for x in range(width):
            if pixel[y, x] < 0:
                if len(image) > 0:
                    for c in range(channels):
                        out[y, x, c] = image[y, x, c]
                else:
                    there = _there(row, settled, y, x, out)
                    for c in range(channels):
                        out[y, x, c] = color[c] if there else out.dtype.type(0)
                continue
            top, left = pixel[y, x] // across * side, pixel[y, x] % across * side
            for c in range(channels):
                # Rows first, as in the specification, whose rounding this has.
                total = out.dtype.type(0)
                for u in range(left, left + side):
                    column = out.dtype.type(0)
                    for v in range(top, top + side):
                        column += fine[v, u, c]
                    total += column * share
                out[y, x, c] = total * share


@compiled
def _there(row, settled, y, x, image):
    """Whether anything is seen in a pixel of an image, of which cells have more on each side."""
    v, u = y + (row.shape[0] - image.shape[0]) // 2, x + (row.shape[1] - image.shape[1]) // 2
    return (row[v, u] >= 0) | settled[v, u]


@kernel
def pull(start, stop, g, pixel, row, settled, side, image, sums, fine):
    """Gradients of both images, zeros to be filled, from rows [start, stop) of the result's; none without rows.

    Of the colour they are sums (H, C), of each row.
    """
    _, width, channels = g.shape
    across, share = fine.shape[1] // side, g.dtype.type(1) / g.dtype.type(side * side)
    for y in range(start, stop):
        for x in range(width):
            if pixel[y, x] < 0:
                if len(image) > 0:
                    for c in range(channels):
                        image[y, x, c] = g[y, x, c]
                elif len(sums) > 0 and _there(row, settled, y, x, g):
                    for c in range(channels):
                        sums[y, c] += g[y, x, c]
            elif len(fine):
                top, left = pixel[y, x] // across * side, pixel[y, x] % across * side
                for v in range(top, top + side):
                    for u in range(left, left + side):
                        for c in range(channels):
                            fine[v, u, c] = g[y, x, c] * share
