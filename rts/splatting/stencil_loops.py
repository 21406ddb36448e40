"""A stencil times colours, and its derivatives. Compiled."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rts.compiling.loops import compiled, loop


class Matrix(NamedTuple):
    """A stencil as the loops take it: the colour of each cell, then fields of `Stencil`. Host arrays.

    Attributes:
        front: (H, W) int32, or −1.
        joined: (2, H, W) bool.
        color_cell: (E,) int32.
        color_sample: (E,) int32.
        color_weight: (E,).
        motion_cell: (F,) int32.
        motion_sample: (F,) int32.
        motion_weight: (F, 3).
        motion_colors: (F, 2) int32.
    """

    front: np.ndarray
    joined: np.ndarray
    color_cell: np.ndarray
    color_sample: np.ndarray
    color_weight: np.ndarray
    motion_cell: np.ndarray
    motion_sample: np.ndarray
    motion_weight: np.ndarray
    motion_colors: np.ndarray


@compiled
def _used(weight):
    """The number of entries up to the last one that has an effect; `weight` is (E,) or (E, 3)."""
    flat = weight.reshape(-1)
    used, each = flat.size, flat.size // max(len(weight), 1)
    while used > 0 and flat[used - 1] == 0:
        used -= 1
    return (used + each - 1) // max(each, 1)


@compiled
def _first(cell, used, least):
    """The first of the `used` entries whose cell is at least `least`."""
    low, high = 0, used
    while low < high:
        middle = (low + high) // 2
        low, high = (middle + 1, high) if cell[middle] < least else (low, middle)
    return low


@compiled(inline="always")
def _line(cell, line, width, border):
    """The line of the image that a cell lies in, which is `line` or a later one."""
    while cell >= (line + border + 1) * width:
        line += 1
    return line


@compiled(inline="always")
def _pixel(cell, side):
    """The line or column of pixels in which one of cells lies: without a slow division where each pixel is a cell."""
    return cell if side == 1 else cell // side


@compiled(inline="always")
def _of(colors, n, c):
    """A channel of a colour; 0 for none."""
    return colors[np.uint32(n), c] if n >= 0 else 0.0


@compiled(inline="always")
def _beside(front, joined, y, x):
    """The colours of the next cells to the left and right, above and below.

    Where the next cell shows another surface, the cell's own colour stands in.
    """
    n = front[y, x]
    left = front[y, x - 1] if x > 0 and joined[0, y, x - 1] else n
    right = front[y, x + 1] if joined[0, y, x] else n
    above = front[y - 1, x] if y > 0 and joined[1, y - 1, x] else n
    below = front[y + 1, x] if joined[1, y, x] else n
    return left, right, above, below


@loop
def value(first, last, border, side, colors, matrix, out):
    """Fill lines `first` to `last` of `out` (h, w, C); other arguments as of `rts.splatting.stencil.splat`.

    `side` is its `supersample`; lines and columns of cells are counted without the border.
    """
    front, color_cell, color_sample = matrix.front, matrix.color_cell, matrix.color_sample
    color_weight = matrix.color_weight
    width, used, share = front.shape[1], _used(color_weight), 1 / side**2
    for i in range(first * side, last * side):
        row = _pixel(i, side)
        if row * side == i:
            out[row] = 0.0
        for j in range(out.shape[1]):
            for k in range(j * side, j * side + side):
                # Compiled code need not check for negative ones.
                n = front[np.uint32(i + border), np.uint32(k + border)]
                for c in range(out.shape[2]):
                    out[row, j, c] += share * _of(colors, n, c)
    line, last = first * side, last * side
    for e in range(_first(color_cell, used, (line + border) * width), used):
        line = _line(color_cell[e], line, width, border)
        j = color_cell[e] - (line + border) * width - border
        if line >= last:
            break
        if 0 <= j < out.shape[1] * side:
            row, at = _pixel(line, side), _pixel(j, side)
            for c in range(out.shape[2]):
                out[row, at, c] += share * color_weight[e] * _of(colors, color_sample[e], c)


@loop
def push(first, last, border, side, colors, matrix, t_positions, t_colors, out):
    """Fill lines of `out` (h, w, C) with the derivative of `value` along tangents; empty ones are zeros."""
    front, joined, color_cell, color_sample, color_weight, motion_cell, motion_sample, motion_weight, motion_colors = (
        matrix
    )
    width, share = front.shape[1], 1 / side**2
    out[first:last] = 0.0
    first, last = first * side, last * side
    for i in range(first, last):
        row = _pixel(i, side)
        for j in range(out.shape[1] * side):
            y, x = np.uint32(i + border), np.uint32(j + border)
            n, at = front[y, x], _pixel(j, side)
            for c in range(out.shape[2] if len(t_colors) else 0):
                out[row, at, c] += share * _of(t_colors, n, c)
            if n < 0 or not len(t_positions):
                continue
            left, right, above, below = _beside(front, joined, y, x)
            mx, my = share * t_positions[n, 0] / 2, share * t_positions[n, 1] / 2
            for c in range(out.shape[2] if left != right or above != below else 0):
                aside, down = colors[right, c] - colors[left, c], colors[below, c] - colors[above, c]
                out[row, at, c] -= aside * mx + down * my
    used, line = _used(color_weight) if len(t_colors) else 0, first
    for e in range(_first(color_cell, used, (first + border) * width), used):
        line = _line(color_cell[e], line, width, border)
        j = color_cell[e] - (line + border) * width - border
        if line >= last:
            break
        if 0 <= j < out.shape[1] * side:
            row, at = _pixel(line, side), _pixel(j, side)
            for c in range(out.shape[2]):
                out[row, at, c] += share * color_weight[e] * _of(t_colors, color_sample[e], c)
    used, line = _used(motion_weight) if len(t_positions) else 0, first
    for e in range(_first(motion_cell, used, (first + border) * width), used):
        line = _line(motion_cell[e], line, width, border)
        j = motion_cell[e] - (line + border) * width - border
        if line >= last:
            break
        if 0 <= j < out.shape[1] * side:
            row, at = _pixel(line, side), _pixel(j, side)
            rate = share * _rate(motion_weight, e, t_positions, motion_sample[e])
            for c in range(out.shape[2]):
                jump = _of(colors, motion_colors[e, 0], c) - _of(colors, motion_colors[e, 1], c)
                out[row, at, c] += rate * jump


@compiled(inline="always")
def _rate(motion_weight, e, t_positions, n):
    """The weight of an entry of motions along a tangent of positions (N, 3)."""
    x, y, z = t_positions[n, 0], t_positions[n, 1], t_positions[n, 2]
    return motion_weight[e, 0] * x + motion_weight[e, 1] * y + motion_weight[e, 2] * z


@loop
def pull(border, side, colors, matrix, g, g_positions, g_colors):
    """Add to gradients of positions and colours those of `g` (h, w, C); empty ones are not wanted."""
    front, joined, color_cell, color_sample, color_weight, motion_cell, motion_sample, motion_weight, motion_colors = (
        matrix
    )
    width, share, lines = front.shape[1], 1 / side**2, g.shape[0] * side
    for i in range(lines):
        row = _pixel(i, side)
        for j in range(g.shape[1] * side):
            y, x = np.uint32(i + border), np.uint32(j + border)
            n, at = front[y, x], _pixel(j, side)
            if n < 0:
                continue
            for c in range(g.shape[2] if len(g_colors) else 0):
                g_colors[n, c] += share * g[row, at, c]
            if not len(g_positions):
                continue
            left, right, above, below = _beside(front, joined, y, x)
            for c in range(g.shape[2] if left != right or above != below else 0):
                half = share * g[row, at, c] / 2
                g_positions[n, 0] -= (colors[right, c] - colors[left, c]) * half
                g_positions[n, 1] -= (colors[below, c] - colors[above, c]) * half
    used, line = _used(color_weight) if len(g_colors) else 0, 0
    for e in range(_first(color_cell, used, border * width), used):
        line = _line(color_cell[e], line, width, border)
        j, n = color_cell[e] - (line + border) * width - border, color_sample[e]
        if line >= lines:
            break
        if 0 <= j < g.shape[1] * side and n >= 0:
            row, at = _pixel(line, side), _pixel(j, side)
            for c in range(g.shape[2]):
                g_colors[n, c] += share * color_weight[e] * g[row, at, c]
    used, line = _used(motion_weight) if len(g_positions) else 0, 0
    for e in range(_first(motion_cell, used, border * width), used):
        line = _line(motion_cell[e], line, width, border)
        j, n = motion_cell[e] - (line + border) * width - border, motion_sample[e]
        if line >= lines:
            break
        if 0 <= j < g.shape[1] * side:
            row, at = _pixel(line, side), _pixel(j, side)
            total = 0.0
            for c in range(g.shape[2]):
                jump = _of(colors, motion_colors[e, 0], c) - _of(colors, motion_colors[e, 1], c)
                total += share * jump * g[row, at, c]
            for a in range(3):
                g_positions[n, a] += motion_weight[e, a] * total


@loop
def columns(cells, colors, matrix, t_positions, t_colors, out):
    """Fill `out` (T, n, C) with the derivatives of some cells along T directions.

    Args:
        cells: (n,) int64, y · W + x.
        colors: (M, C).
        matrix: the stencil.
        t_positions: (T, N, 3) tangents of positions.
        t_colors: (T, N, C), or (0, 0, C) for zeros.
        out: to fill.
    """
    front, joined, color_cell, color_sample, color_weight, motion_cell, motion_sample, motion_weight, motion_colors = (
        matrix
    )
    width, directions, channels = front.shape[1], len(t_positions), colors.shape[1]
    used_colors, used_motions = _used(color_weight) if len(t_colors) else 0, _used(motion_weight)
    for i in range(len(cells)):
        cell = cells[i]
        y, x = cell // width, cell % width
        n = front[y, x]
        for t in range(directions):
            for c in range(channels):
                out[t, i, c] = t_colors[t, n, c] if len(t_colors) and n >= 0 else 0.0
        if n >= 0:
            left, right, above, below = _beside(front, joined, y, x)
            for c in range(channels if left != right or above != below else 0):
                aside, down = (colors[right, c] - colors[left, c]) / 2, (colors[below, c] - colors[above, c]) / 2
                for t in range(directions):
                    out[t, i, c] -= aside * t_positions[t, n, 0] + down * t_positions[t, n, 1]
        e = _first(color_cell, used_colors, cell)
        while e < used_colors and color_cell[e] == cell:
            for t in range(directions):
                for c in range(channels):
                    out[t, i, c] += color_weight[e] * _of(t_colors[t], color_sample[e], c)
            e += 1
        e = _first(motion_cell, used_motions, cell)
        while e < used_motions and motion_cell[e] == cell:
            for t in range(directions):
                rate = _rate(motion_weight, e, t_positions[t], motion_sample[e])
                for c in range(channels):
                    jump = _of(colors, motion_colors[e, 0], c) - _of(colors, motion_colors[e, 1], c)
                    out[t, i, c] += rate * jump
            e += 1
