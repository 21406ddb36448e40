"""Cells beside outlines, by depths alone: the pairing of `rts.splatting.Visible`, compiled."""

from __future__ import annotations

import numba

compiled = numba.njit(nogil=True)
kernel = numba.njit(nogil=True, cache=True)


@kernel
def mark(start, stop, row, depth, firsts, beyond, continued, marks):
    """Mark the cells of rows [start, stop) whose front ends towards a neighbour, or a neighbour's towards them.

    Args:
        start: first row.
        stop: end of the rows.
        row: (K, H, W) int32.
        depth: (K, H, W).
        firsts: (P − 1,) the first row of each part but the first.
        beyond: depth of layers that are not covered; no two layers are farther apart than each is from it.
        continued: share of the error of plain pairing below which a front continues another.
        marks: (H, W) uint8, to be filled.
    """
    layers, height, width = row.shape
    for y in range(start, stop):
        for x in range(width):
            marks[y, x] = 0
            i = row[0, y, x]
            for n in range(9):
                v, u = n // 3 - 1, n % 3 - 1
                py, px = y - v, x - u
                if n == 4 or not (0 <= py < height and 0 <= px < width):
                    continue
                j = row[0, py, px]
                if (i < 0) != (j < 0):
                    marks[y, x] = 1
                    break
                if i < 0:
                    continue
                if _part(firsts, i) != _part(firsts, j):
                    marks[y, x] = 1
                    break
                if layers > 1 and (row[1, y, x] >= 0 or row[1, py, px] >= 0):
                    if _parted(row, depth, y, x, v, u, beyond, continued):
                        marks[y, x] = 1
                        break


@compiled
def _part(firsts, i):
    part = 0
    for first in firsts:
        part += i >= first
    return part


@compiled
def _parted(row, depth, y, x, v, u, beyond, continued):
    """Whether the front of a covered target (y, x) and that of the source from which (u, v) leads to it do not pair."""
    layers, height, width = row.shape
    py, px = y - v, x - u
    source, target = depth[0, py, px], depth[0, y, x]
    plain = abs(source - target)
    best = plain
    for k in range(1, layers):
        p = depth[k, py, px] if row[k, py, px] >= 0 else beyond
        q = depth[k, y, x] if row[k, y, x] >= 0 else beyond
        best = min(best, abs(p - target), abs(q - source))
    if not best < plain:
        return False
    limit = continued * best
    for steps in (-1, 2):
        end, start = (source, target) if steps < 0 else (target, source)
        by, bx = y - steps * v, x - steps * u
        if 0 <= by < height and 0 <= bx < width and row[0, by, bx] >= 0:
            if abs(end - (start + start - depth[0, by, bx])) < limit:
                return False
    return True
