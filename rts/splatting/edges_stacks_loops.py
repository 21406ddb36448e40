"""Composites of the stacks in cells, moved layer by layer, and their derivatives. Compiled.

The composite changes by Σ_k T_k (change of colour k − change of alpha k · B_k), where T_k is the light that passes to
layer k and B_k the composite behind it.
"""

from __future__ import annotations

import numpy as np

from rts.compiling.loops import compiled, loop


@compiled
def _weigh(rgba, row, y, x, through, behind):
    """Fill `through` (K,) and `behind` (K, 4) of a cell; returns the number of layers that light reaches."""
    light, count = 1.0, 0
    while count < len(row) and row[count, y, x] >= 0 and light > 0:
        through[count] = light
        light *= 1 - rgba[row[count, y, x], 3]
        count += 1
    for k in range(count - 1, -1, -1):
        for c in range(4):
            if k == count - 1:
                behind[k, c] = 0.0
            else:
                n = row[k + 1, y, x]
                behind[k, c] = rgba[n, c] + (1 - rgba[n, 3]) * behind[k + 1, c]
    return count


@compiled
def _fill_slope(rgba, row, joined, k, y, x, axis, slope):
    """Fill `slope` (4,): the mean of the differences of a layer's colour from and to the next cells, if joined."""
    n, dy, dx = row[k, y, x], axis, 1 - axis
    after, before = n, n
    if joined[axis, y, x] and row[k, y + dy, x + dx] >= 0:
        after = row[k, y + dy, x + dx]
    if y - dy >= 0 and x - dx >= 0 and joined[axis, y - dy, x - dx] and row[k, y - dy, x - dx] >= 0:
        before = row[k, y - dy, x - dx]
    for c in range(4):
        slope[c] = (rgba[after, c] - rgba[before, c]) / 2


@loop
def cells(first, last, positions, rgba, row, joined, out):
    """Fill lines `first` to `last` of `out` (H, W, 8): composites, and what moves along their slopes."""
    most = len(row)
    through, behind, slope = np.empty(most), np.empty((most, 4)), np.empty(4)
    for y in range(first, last):
        for x in range(row.shape[2]):
            count = _weigh(rgba, row, y, x, through, behind)
            out[y, x] = 0.0
            for k in range(count):
                n = row[k, y, x]
                for c in range(4):
                    out[y, x, c] += through[k] * rgba[n, c]
                for axis in range(2):
                    moved = positions[n, axis] - ((x if axis == 0 else y) + 0.5)
                    _fill_slope(rgba, row, joined, k, y, x, axis, slope)
                    for c in range(4):
                        out[y, x, 4 + c] -= through[k] * (slope[c] - slope[3] * behind[k, c]) * moved


@loop
def push_cells(first, last, rgba, row, joined, t_positions, t_rgba, out):
    """Fill lines of `out` (H, W, 8) with the derivative of `cells` along tangents; empty ones are zeros."""
    most = len(row)
    through, behind, slope = np.empty(most), np.empty((most, 4)), np.empty(4)
    for y in range(first, last):
        for x in range(row.shape[2]):
            count = _weigh(rgba, row, y, x, through, behind)
            out[y, x] = 0.0
            for k in range(count):
                n = row[k, y, x]
                if len(t_rgba):
                    for c in range(4):
                        out[y, x, c] += through[k] * (t_rgba[n, c] - t_rgba[n, 3] * behind[k, c])
                if len(t_positions):
                    for axis in range(2):
                        _fill_slope(rgba, row, joined, k, y, x, axis, slope)
                        for c in range(4):
                            change = through[k] * (slope[c] - slope[3] * behind[k, c])
                            out[y, x, 4 + c] -= change * t_positions[n, axis]


@loop
def pull_cells(rgba, row, joined, g, g_positions, g_rgba):
    """Add to gradients of samples those of `cells`; empty ones are not wanted."""
    most = len(row)
    through, behind, slope = np.empty(most), np.empty((most, 4)), np.empty(4)
    for y in range(row.shape[1]):
        for x in range(row.shape[2]):
            count = _weigh(rgba, row, y, x, through, behind)
            for k in range(count):
                n = row[k, y, x]
                if len(g_rgba):
                    for c in range(4):
                        g_rgba[n, c] += through[k] * g[y, x, c]
                        g_rgba[n, 3] -= through[k] * behind[k, c] * g[y, x, c]
                if len(g_positions):
                    for axis in range(2):
                        _fill_slope(rgba, row, joined, k, y, x, axis, slope)
                        total = 0.0
                        for c in range(4):
                            total += (slope[c] - slope[3] * behind[k, c]) * g[y, x, 4 + c]
                        g_positions[n, axis] -= through[k] * total
