"""Cells beside outlines, found by the pairing of depths of `rts.splatting.Visible`. Compiled."""

from __future__ import annotations

import numpy as np

from rts.compiling.loops import compiled, loop


@loop
def mark(start, stop, row, settled, depth, firsts, beyond, margin, continued, marks):
    """Fill rows [start, stop) of `marks`: 1 where a cell's front ends towards a neighbour, or a neighbour's towards it.

    Args:
        start: first row.
        stop: end of the rows.
        row: (K, H, W) int32.
        settled: (H, W) int8, 0 at cells that the only part covers, even without a sample, else −1; or no rows.
        depth: (K, H, W).
        firsts: (P − 1,) the first row of each part but the first.
        beyond: depth for empty layers, at least as far from each layer as any two layers are apart.
        margin: the most by which rounding may change differences of depth.
        continued: a front continues another if it is off the other's line by less than this share of the paired depths'
            difference.
        marks: (H, W) uint8, to be filled with 0 or 1.
    """
    layers, height, width = row.shape
    # Of three rows of cells, repeated at the ends: the part seen, −1 for none, and whether there is a hidden layer.
    parts, hidden = np.empty((3, width + 2), np.int32), np.empty((3, width + 2), np.uint8)
    near = np.empty(width, np.uint8)
    for y in range(start - 1, stop + 1):
        at = min(max(y, 0), height - 1)
        seen, behind = parts[(y + 3) % 3], hidden[(y + 3) % 3]
        for x in range(width):
            i = row[0, at, x]
            if len(settled) > 0:
                i = max(i, np.int32(settled[at, x]))
            part = np.int32(-1 if i < 0 else 0)
            for first in firsts:
                part += i >= first
            seen[x + 1], behind[x + 1] = part, layers > 1 and row[min(1, layers - 1), at, x] >= 0
        seen[0], seen[width + 1], behind[0], behind[width + 1] = seen[1], seen[width], behind[1], behind[width]
        if y <= start:
            continue
        above, level, below = (y + 1) % 3, (y + 2) % 3, y % 3
        _differ(marks[y - 1], parts[above], parts[level], parts[below])
        if layers > 1:
            some = _unite(near, hidden[above], hidden[level], hidden[below])
            for x in range(width if some else 0):
                if near[x] and not marks[y - 1, x] and row[0, y - 1, x] >= 0:
                    marks[y - 1, x] = _ends(row, depth, y - 1, x, beyond, margin, continued)


@compiled
def _differ(marks, above, level, below):
    """Fill `marks` (W,): 1 for cells whose part differs from that of one of their eight neighbours, else 0.

    `above`, `level`, `below` (W + 2,) are the parts seen in three rows, −1 for none, with one more cell at each side.
    """
    for x in range(len(marks)):
        own = level[x + 1]
        found = (above[x] != own) | (above[x + 1] != own) | (above[x + 2] != own) | (level[x] != own)
        found |= (level[x + 2] != own) | (below[x] != own) | (below[x + 1] != own) | (below[x + 2] != own)
        marks[x] = found


@compiled
def _unite(near, above, level, below):
    """Fill `near` (W,): 1 for cells whose 3 × 3 window has a mark, else 0. Returns True if there are any.

    `above`, `level`, `below` (W + 2,) are marks of three rows, with one more cell at each side.
    """
    some = np.uint8(0)
    for x in range(len(near)):
        around = above[x] | above[x + 1] | above[x + 2] | level[x] | level[x + 1] | level[x + 2]
        near[x] = around | below[x] | below[x + 1] | below[x + 2]
    for x in range(len(near)):
        some |= near[x]
    return some != 0


@compiled
def _ends(row, depth, y, x, beyond, margin, continued):
    """True if the front of the cell (y, x) may end towards one of its neighbours. For arguments see `mark`.

    The cell and its neighbours in the image must be covered.
    """
    _, height, width = row.shape
    for n in range(9):
        v, u = n // 3 - 1, n % 3 - 1
        py, px = y - v, x - u
        inside = n != 4 and 0 <= py < height and 0 <= px < width
        if inside and _parted(row, depth, y, x, v, u, beyond, margin, continued):
            return True
    return False


@compiled
def _parted(row, depth, y, x, v, u, beyond, margin, continued):
    """True unless the front of a covered target (y, x) surely pairs with the front of the source (y − v, x − u).

    For other arguments see `mark`.
    """
    layers, height, width = row.shape
    py, px = y - v, x - u
    source, target = depth[0, py, px], depth[0, y, x]
    plain, hidden = abs(source - target), depth.dtype.type(np.inf)
    for k in range(1, layers):
        p = depth[k, py, px] if row[k, py, px] >= 0 else beyond
        q = depth[k, y, x] if row[k, y, x] >= 0 else beyond
        hidden = min(hidden, abs(p - target), abs(q - source))
    if hidden >= plain + margin:
        return False
    limit = continued * min(plain, hidden) - margin
    for steps in (-1, 2):
        end, start = (source, target) if steps < 0 else (target, source)
        by, bx = y - steps * v, x - steps * u
        if 0 <= by < height and 0 <= bx < width and row[0, by, bx] >= 0:
            if abs(end - (start + start - depth[0, by, bx])) < limit:
                return False
    return True
