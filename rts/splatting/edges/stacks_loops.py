"""Composites of the stacks in cells, moved layer by layer, and their derivatives. Compiled.

The composite changes by Σ_k T_k (change of colour k − change of alpha k · B_k), where T_k is the light that passes to
layer k and B_k the composite behind it. Alpha is the last of C channels.
"""

from __future__ import annotations

import numpy as np

from rts.compiling.loops import compiled, loop


@compiled
def _weigh(rgba, row, y, x, through, behind):
    """Fill `through` (K,) and `behind` (K, C) of a cell; returns the number of layers that light reaches."""
    light, count, alpha = 1.0, 0, rgba.shape[1] - 1
    while count < len(row) and row[count, y, x] >= 0 and light > 0:
        through[count] = light
        light *= 1 - rgba[row[count, y, x], alpha]
        count += 1
    for k in range(count - 1, -1, -1):
        for c in range(alpha + 1):
            if k == count - 1:
                behind[k, c] = 0.0
            else:
                n = row[k + 1, y, x]
                behind[k, c] = rgba[n, c] + (1 - rgba[n, alpha]) * behind[k + 1, c]
    return count


@compiled
def _fill_change(rgba, row, joined, k, y, x, axis, through, behind, change):
    """Fill `change` (C,): by how much a composite changes along an axis as its layer k alone shifts.

    The layer's slope is the mean of the differences of its colour from and to the next cells, if joined.
    """
    n, dy, dx, alpha = row[k, y, x], axis, 1 - axis, rgba.shape[1] - 1
    after, before = n, n
    if joined[axis, y, x] and row[k, y + dy, x + dx] >= 0:
        after = row[k, y + dy, x + dx]
    if y - dy >= 0 and x - dx >= 0 and joined[axis, y - dy, x - dx] and row[k, y - dy, x - dx] >= 0:
        before = row[k, y - dy, x - dx]
    opacity = (rgba[after, alpha] - rgba[before, alpha]) / 2
    for c in range(alpha + 1):
        change[c] = through[k] * ((rgba[after, c] - rgba[before, c]) / 2 - opacity * behind[k, c])


@loop
def cells(first, last, positions, rgba, row, joined, out):
    """Fill lines `first` to `last` of `out` (H, W, 2 C): composites, and what moves along their slopes."""
    (most, _, width), at, count = row.shape, np.empty(2, np.int64), rgba.shape[1]
    through, behind, change = np.empty(most), np.empty((most, count)), np.empty(count)
    for i in range(first * width, last * width):
        y, x = i // width, i % width
        at[0], at[1], out[y, x] = x, y, 0.0
        for k in range(_weigh(rgba, row, y, x, through, behind)):
            n = row[k, y, x]
            for c in range(count):
                out[y, x, c] += through[k] * rgba[n, c]
            for axis in range(2):
                moved = positions[n, axis] - (at[axis] + 0.5)
                _fill_change(rgba, row, joined, k, y, x, axis, through, behind, change)
                for c in range(count):
                    out[y, x, count + c] -= change[c] * moved


@loop
def push_cells(first, last, rgba, row, joined, t_positions, t_rgba, out):
    """Fill lines of `out` (H, W, 2 C) with the derivative of `cells` along tangents; empty ones are zeros."""
    (most, _, width), count = row.shape, rgba.shape[1]
    through, behind, change = np.empty(most), np.empty((most, count)), np.empty(count)
    colors, axes = count if len(t_rgba) else 0, 2 if len(t_positions) else 0
    for i in range(first * width, last * width):
        y, x = i // width, i % width
        out[y, x] = 0.0
        for k in range(_weigh(rgba, row, y, x, through, behind)):
            n = row[k, y, x]
            for c in range(colors):
                out[y, x, c] += through[k] * (t_rgba[n, c] - t_rgba[n, count - 1] * behind[k, c])
            for axis in range(axes):
                _fill_change(rgba, row, joined, k, y, x, axis, through, behind, change)
                for c in range(count):
                    out[y, x, count + c] -= change[c] * t_positions[n, axis]


@loop
def pull_cells(rgba, row, joined, g, g_positions, g_rgba):
    """Add to gradients of samples those of `cells`; empty ones are not wanted."""
    (most, height, width), count = row.shape, rgba.shape[1]
    through, behind, change = np.empty(most), np.empty((most, count)), np.empty(count)
    colors, axes = count if len(g_rgba) else 0, 2 if len(g_positions) else 0
    for i in range(height * width):
        y, x = i // width, i % width
        for k in range(_weigh(rgba, row, y, x, through, behind)):
            n = row[k, y, x]
            for c in range(colors):
                g_rgba[n, c] += through[k] * g[y, x, c]
                g_rgba[n, count - 1] -= through[k] * behind[k, c] * g[y, x, c]
            for axis in range(axes):
                _fill_change(rgba, row, joined, k, y, x, axis, through, behind, change)
                for c in range(count):
                    g_positions[n, axis] -= change[c] * g[y, x, count + c]
