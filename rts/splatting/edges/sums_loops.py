"""The image of `rts.splatting.edges` and its derivatives, as sums over cells, breaks and segments. Compiled.

The weights are those of `weights_loops`.
"""

from __future__ import annotations

import numpy as np

from rts.compiling.loops import compiled, loop


@compiled(inline="always")
def _beside(row, joined, y, x):
    """The samples of the next cells to the left and right, above and below; see `_slope`.

    Where the next cell shows another surface, the cell's own sample stands in.
    """
    n = row[y, x]
    left = row[y, x - 1] if x > 0 and joined[0, y, x - 1] else n
    right = row[y, x + 1] if joined[0, y, x] else n
    above = row[y - 1, x] if y > 0 and joined[1, y - 1, x] else n
    below = row[y + 1, x] if joined[1, y, x] else n
    return left, right, above, below


@compiled(inline="always")
def _slope(rgba, before, after, c):
    """The slope of a channel at a cell: the mean of the differences from and to the next cells of the same surface."""
    return (rgba[after, c] - rgba[before, c]) / 2


@loop
def inside(first, last, border, positions, rgba, row, joined, out):
    """Fill lines `first` to `last` of `out` (h, w, C): colours of cells, moved along their slopes."""
    for i in range(first, last):
        for j in range(out.shape[1]):
            y, x = np.uint32(i + border), np.uint32(j + border)  # Compiled code need not check for negative ones.
            n = row[y, x]
            if n < 0:
                for c in range(rgba.shape[1]):
                    out[i, j, c] = 0.0
                continue
            left, right, above, below = _beside(row, joined, y, x)
            if left == right and above == below:
                for c in range(rgba.shape[1]):
                    out[i, j, c] = rgba[n, c]
                continue
            mx, my = positions[n, 0] - (x + 0.5), positions[n, 1] - (y + 0.5)
            for c in range(rgba.shape[1]):
                moved = _slope(rgba, left, right, c) * mx + _slope(rgba, above, below, c) * my
                out[i, j, c] = rgba[n, c] - moved


@loop
def push_inside(first, last, border, rgba, row, joined, t_positions, t_rgba, out):
    """Fill lines of `out` (h, w, C) with the derivative of `inside` along tangents; empty ones are zeros."""
    for i in range(first, last):
        for j in range(out.shape[1]):
            y, x = np.uint32(i + border), np.uint32(j + border)  # Compiled code need not check for negative ones.
            n = row[y, x]
            for c in range(rgba.shape[1]):
                out[i, j, c] = t_rgba[n, c] if n >= 0 and len(t_rgba) else 0.0
            if n < 0 or not len(t_positions):
                continue
            left, right, above, below = _beside(row, joined, y, x)
            if left == right and above == below:
                continue
            mx, my = t_positions[n, 0], t_positions[n, 1]
            for c in range(rgba.shape[1]):
                out[i, j, c] -= _slope(rgba, left, right, c) * mx + _slope(rgba, above, below, c) * my


@loop
def pull_inside(border, rgba, row, joined, g, g_positions, g_rgba):
    """Add to gradients of samples those of `inside`; empty ones are not wanted."""
    for i in range(g.shape[0]):
        for j in range(g.shape[1]):
            y, x = np.uint32(i + border), np.uint32(j + border)  # Compiled code need not check for negative ones.
            n = row[y, x]
            if n < 0:
                continue
            if len(g_rgba):
                for c in range(rgba.shape[1]):
                    g_rgba[n, c] += g[i, j, c]
            if not len(g_positions):
                continue
            left, right, above, below = _beside(row, joined, y, x)
            if left != right or above != below:
                for c in range(rgba.shape[1]):
                    g_positions[n, 0] -= _slope(rgba, left, right, c) * g[i, j, c]
                    g_positions[n, 1] -= _slope(rgba, above, below, c) * g[i, j, c]


@compiled(inline="always")
def _is_in(image, i, j):
    """True for a pixel of an image (h, w, C); its cells have a border around it."""
    return 0 <= i < image.shape[0] and 0 <= j < image.shape[1]


@compiled(inline="always")
def _of(rgba, n, c):
    """A channel of a sample; 0 where nothing is seen."""
    return rgba[n, c] if n >= 0 else 0.0


@compiled(inline="always")
def _add_to(g_rgba, n, c, value):
    """Add to the gradient of a sample's channel."""
    if n >= 0:
        g_rgba[n, c] += value


@compiled(inline="always")
def _jump(rgba, shown, b, c):
    """A channel before a break, less that behind."""
    return _of(rgba, shown[b, 0], c) - _of(rgba, shown[b, 1], c)


@compiled(inline="always")
def _last(s, ties, m, beyond):
    """The m-th of the breaks that pull at a segment: the one before, its own two, the one after; or −1."""
    if m == 0:
        return beyond[s, 0]
    if m == 3:
        return beyond[s, 1]
    return ties[s, m - 1]


@loop
def jumps(rgba, shown, out):
    """Fill `out` (B, C): colours before breaks, less those behind."""
    for b in range(len(shown)):
        for c in range(rgba.shape[1]):
            out[b, c] = _jump(rgba, shown, b, c)


@loop
def motions(positions, rows, points, moves, out):
    """Fill `out` (B, 2): motions of breaks, for samples that were at `points` (B, 2, 2); of tangents if it is empty."""
    for b in range(len(rows)):
        out[b] = 0.0
        for i in range(2):
            n = rows[b, i]
            if n < 0:
                continue
            for a in range(2):
                x, y = positions[n, 0], positions[n, 1]
                if len(points):
                    out[b, a] += moves[b, i, 0, a] * (x - points[b, i, 0]) + moves[b, i, 1, a] * (y - points[b, i, 1])
                else:
                    out[b, a] += moves[b, i, 0, a] * x + moves[b, i, 1, a] * y + moves[b, i, 2, a] * positions[n, 2]


@compiled(inline="always")
def _rates(s, k, ties, beyond, flux, motion):
    """The flux through a segment in its cell k, for each of its two jumps."""
    first, second = 0.0, 0.0
    for m in range(4):
        b = _last(s, ties, m, beyond)
        if b >= 0:
            first += flux[s, k, 0, m, 0] * motion[b, 0] + flux[s, k, 0, m, 1] * motion[b, 1]
            second += flux[s, k, 1, m, 0] * motion[b, 0] + flux[s, k, 1, m, 1] * motion[b, 1]
    return first, second


@compiled(inline="always")
def _pull_rates(s, k, ties, beyond, flux, first, second, g_motion):
    """Add to gradients of motions those of `_rates`, given those of the two rates."""
    for m in range(4):
        b = _last(s, ties, m, beyond)
        if b >= 0:
            g_motion[b, 0] += first * flux[s, k, 0, m, 0] + second * flux[s, k, 1, m, 0]
            g_motion[b, 1] += first * flux[s, k, 0, m, 1] + second * flux[s, k, 1, m, 1]


@loop
def add_segments(
    border, square, ties, beyond, share, cell_side, lost, flux, row, shown, rgba, jump, steady, motion, out
):
    """Add to an image (h, w, C) the changes that segments make.

    Args:
        border: cells around the image.
        square: (S, 2) of outlines.
        ties: (S, 2).
        beyond: (S, 2).
        share: (S, 4, 2), see `weigh_segments`.
        cell_side: (S, 4, 2).
        lost: (S, 4, 2).
        flux: (S, 4, 2, 4, 2).
        row: (H, W) int32.
        shown: (B, 2), the samples that tell colours.
        rgba: (N, C) colours, or their tangents; empty for zeros.
        jump: (B, C) jumps of colours, or their tangents; empty for zeros.
        steady: (B, C) jumps that are constants in fluxes.
        motion: (B, 2) motions of breaks, or their tangents; empty for zeros.
        out: (h, w, C).
    """
    for s in range(len(square)):
        start = ties[s, 0]
        end = ties[s, 1] if ties[s, 1] >= 0 else start
        for k in range(4):
            y, x = square[s, 0] + (k >= 2), square[s, 1] + (k == 1 or k == 2)
            i, j = y - border, x - border
            if not _is_in(out, i, j):
                continue
            sides, first, second = cell_side[s, k], 0.0, 0.0
            if len(motion):
                first, second = _rates(s, k, ties, beyond, flux, motion)
            for c in range(out.shape[2]):
                value = first * steady[start, c] + second * steady[end, c]
                if len(jump):
                    value += share[s, k, 0] * jump[start, c] + share[s, k, 1] * jump[end, c]
                # What is taken away of the cell's own surface has the colour at its centre.
                if len(jump) and sides[0] >= 0:
                    value -= lost[s, k, 0] * (_of(rgba, row[y, x], c) - _of(rgba, shown[start, sides[0]], c))
                if len(jump) and sides[1] >= 0:
                    value -= lost[s, k, 1] * (_of(rgba, row[y, x], c) - _of(rgba, shown[end, sides[1]], c))
                out[i, j, c] += value


@loop
def settle(border, square, rounding, out):
    """Make alpha of cells beside segments at most 1 and at least 0; other numbers 0 that are below by rounding.

    Where many outlines meet, lines for them may cross inside a cell, and take a little of it twice.
    """
    for s in range(len(square)):
        for k in range(4):
            i, j = square[s, 0] + (k >= 2) - border, square[s, 1] + (k == 1 or k == 2) - border
            if not _is_in(out, i, j):
                continue
            for c in range(out.shape[2]):
                out[i, j, c] = 0.0 if -rounding < out[i, j, c] < 0 else out[i, j, c]
            out[i, j, out.shape[2] - 1] = min(max(out[i, j, out.shape[2] - 1], 0.0), 1.0)


@loop
def pull_segments(
    border, square, ties, beyond, share, cell_side, lost, flux, row, shown, steady, g, g_rgba, g_jump, g_motion
):  # fmt: skip
    """Add to gradients of colours, jumps (B, C) and motions (B, 2) those of `add_segments`; empty ones: not wanted."""
    for s in range(len(square)):
        start = ties[s, 0]
        end = ties[s, 1] if ties[s, 1] >= 0 else start
        for k in range(4):
            y, x = square[s, 0] + (k >= 2), square[s, 1] + (k == 1 or k == 2)
            i, j = y - border, x - border
            if not _is_in(g, i, j):
                continue
            sides, first, second = cell_side[s, k], 0.0, 0.0
            for c in range(g.shape[2]):
                first += g[i, j, c] * steady[start, c]
                second += g[i, j, c] * steady[end, c]
                if len(g_jump):
                    g_jump[start, c] += share[s, k, 0] * g[i, j, c]
                    g_jump[end, c] += share[s, k, 1] * g[i, j, c]
                if len(g_rgba) and sides[0] >= 0:
                    _add_to(g_rgba, shown[start, sides[0]], c, lost[s, k, 0] * g[i, j, c])
                    _add_to(g_rgba, row[y, x], c, -lost[s, k, 0] * g[i, j, c])
                if len(g_rgba) and sides[1] >= 0:
                    _add_to(g_rgba, shown[end, sides[1]], c, lost[s, k, 1] * g[i, j, c])
                    _add_to(g_rgba, row[y, x], c, -lost[s, k, 1] * g[i, j, c])
            if len(g_motion) and (first != 0 or second != 0):
                _pull_rates(s, k, ties, beyond, flux, first, second, g_motion)


@loop
def pull_motions(rows, moves, g_motion, g_positions):
    """Add to gradients of positions those of `motions`."""
    for b in range(len(rows)):
        for i in range(2):
            n = rows[b, i]
            if n >= 0:
                for r in range(3):
                    g_positions[n, r] += moves[b, i, r, 0] * g_motion[b, 0] + moves[b, i, r, 1] * g_motion[b, 1]


@loop
def pull_jumps(shown, g_jump, g_rgba):
    """Add to gradients of colours those of `jumps`."""
    for b in range(len(shown)):
        for i in range(2):
            n = shown[b, i]
            if n >= 0:
                for c in range(g_rgba.shape[1]):
                    g_rgba[n, c] += g_jump[b, c] if i == 0 else -g_jump[b, c]


@compiled(inline="always")
def _moved(positions, row, rows, points, sides, b, i, y, x):
    """The motion of the surface on a side of a break, by its last sample and that of the cell; see `weigh_sides`."""
    n, m = rows[b, i], row[y, x]
    mx, my = positions[n, 0] + positions[m, 0], positions[n, 1] + positions[m, 1]
    if len(points):
        mx, my = mx - points[b, i, 0] - (x + 0.5), my - points[b, i, 1] - (y + 0.5)
    return sides[b, i, 3] * mx + sides[b, i, 4] * my


@loop
def add_sides(border, row, rows, shown, cells, sides, steady, rgba, positions, points, out):
    """Add to an image (h, w, C) the changes beside breaks.

    Args:
        border: cells around the image.
        row: (H, W) int32.
        rows: (B, 2), the last samples.
        shown: (B, 2), those that tell colours.
        cells: (B, 2, 3), see `weigh_sides`.
        sides: (B, 2, 5).
        steady: (N, C) colours that are constants where surfaces move.
        rgba: (N, C) colours, or their tangents; empty for zeros.
        positions: (N, 3), or their tangents; empty for zeros.
        points: (B, 2, 2), see `motions`; empty for tangents.
        out: (h, w, C).
    """
    width = row.shape[1]
    for b in range(len(cells)):
        for i in range(2):
            if cells[b, i, 0] < 0:
                continue
            y, x = divmod(cells[b, i, 0], width)
            there_y, there_x = divmod(cells[b, i, 1], width)
            here_in = _is_in(out, y - border, x - border)
            there_in = _is_in(out, there_y - border, there_x - border)
            from_y, from_x = divmod(cells[b, i, 2], width)
            last, here, former = shown[b, i], row[y, x], row[from_y, from_x]
            move = _moved(positions, row, rows, points, sides, b, i, y, x) if len(positions) else 0.0
            for c in range(out.shape[2]):
                near, far = 0.0, 0.0
                if move != 0:
                    change = (steady[last, c] - steady[here, c]) * move
                    near, far = sides[b, i, 0] * change, (1 - sides[b, i, 0]) * change
                if len(rgba):
                    near += sides[b, i, 1] * (rgba[former, c] - rgba[here, c])
                    far += sides[b, i, 2] * (rgba[last, c] - rgba[former, c])
                if here_in:
                    out[y - border, x - border, c] += near
                if there_in:
                    out[there_y - border, there_x - border, c] += far


@loop
def pull_sides(border, row, rows, shown, cells, sides, steady, g, g_rgba, g_positions):
    """Add to gradients of colours and positions those of `add_sides`; empty ones are not wanted."""
    width = row.shape[1]
    for b in range(len(cells)):
        for i in range(2):
            if cells[b, i, 0] < 0:
                continue
            y, x = divmod(cells[b, i, 0], width)
            there_y, there_x = divmod(cells[b, i, 1], width)
            from_y, from_x = divmod(cells[b, i, 2], width)
            last, here, former, move = shown[b, i], row[y, x], row[from_y, from_x], 0.0
            y, x, there_y, there_x = y - border, x - border, there_y - border, there_x - border
            here_in, there_in = _is_in(g, y, x), _is_in(g, there_y, there_x)
            for c in range(g.shape[2]):
                near, far = g[y, x, c] if here_in else 0.0, g[there_y, there_x, c] if there_in else 0.0
                move += (sides[b, i, 0] * near + (1 - sides[b, i, 0]) * far) * (steady[last, c] - steady[here, c])
                if len(g_rgba):
                    g_near, g_far = sides[b, i, 1] * near, sides[b, i, 2] * far
                    g_rgba[last, c] += g_far
                    g_rgba[former, c] += g_near - g_far
                    g_rgba[here, c] -= g_near
            if len(g_positions) and move != 0:
                for a in range(2):
                    g_positions[rows[b, i], a] += sides[b, i, 3 + a] * move
                    g_positions[here, a] += sides[b, i, 3 + a] * move
