"""Composites of the stacks in cells, moved layer by layer, and their derivatives. Compiled.

The composite changes by Σ_k T_k (change of colour k − change of alpha k · B_k), where T_k is the light that passes to
layer k and B_k the composite behind it. Alpha is the last of C channels.
"""

from __future__ import annotations

import numpy as np

from rts.compiling.loops import compiled, loop


@compiled
def _weigh(rgba, row, y, x, through):
    """Fill `through` (K,), the light that passes to each layer of a cell; returns the number of layers it reaches."""
    light, count = 1.0, 0
    for k in range(len(row)):
        n = row[k, y, x]
        if n >= 0 and light > 0:
            through[k] = light
            light *= 1 - rgba[n, rgba.shape[1] - 1]
            count += 1
    return count


@compiled
def _stack(rgba, row, y, x, count, behind):
    """Fill `behind` (K, C), the composite behind each of the first layers of a cell."""
    alpha = rgba.shape[1] - 1
    for c in range(alpha + 1):
        back = 0.0
        for k in range(count - 1, -1, -1):
            n, behind[k, c] = row[k, y, x], back
            back = rgba[n, c] + (1 - rgba[n, alpha]) * back


@compiled
def _beside(row, joined, k, y, x, axis):
    """The samples of layer k in the cells before and after a cell along an axis; its own where they are not joined."""
    dy, dx, n = axis, 1 - axis, row[k, y, x]
    before = row[k, y - dy, x - dx] if y >= dy and x >= dx and joined[axis, y - dy, x - dx] else n
    after = row[k, y + dy, x + dx] if joined[axis, y, x] else n
    return before if before >= 0 else n, after if after >= 0 else n


@compiled
def _change(rgba, behind, k, light, before, after, c):
    """By how much channel c of a composite changes from cell to cell as a layer alone shifts.

    The layer's slope is the mean of the differences of its colour from and to the next cells.

    Args:
        rgba: (N, C).
        behind: (K, C), the composites behind layers.
        k: the layer.
        light: what passes to the layer.
        before: its sample in the cell before, see `_beside`.
        after: its sample in the cell after.
        c: the channel.
    """
    alpha = rgba.shape[1] - 1
    opacity = rgba[after, alpha] - rgba[before, alpha]
    return 0.5 * light * ((rgba[after, c] - rgba[before, c]) - opacity * behind[k, c])


@loop
def cells(first, last, positions, rgba, row, joined, out):
    """Fill lines `first` to `last` of `out` (H, W, 2 C): composites, and what moves along their slopes."""
    (most, _, width), count = row.shape, rgba.shape[1]
    through, behind = np.empty(most), np.empty((most, count))
    for i in range(first * width, last * width):
        y, x = i // width, i % width
        for c in range(2 * count):
            out[y, x, c] = 0.0
        layers = _weigh(rgba, row, y, x, through)
        if layers == 0:
            continue
        _stack(rgba, row, y, x, layers, behind)
        for k in range(layers):
            n = row[k, y, x]
            left, right = _beside(row, joined, k, y, x, 0)
            up, down = _beside(row, joined, k, y, x, 1)
            across, along = positions[n, 0] - (x + 0.5), positions[n, 1] - (y + 0.5)
            for c in range(count):
                aside = _change(rgba, behind, k, through[k], left, right, c) * across
                out[y, x, c] += through[k] * rgba[n, c]
                out[y, x, count + c] -= aside + _change(rgba, behind, k, through[k], up, down, c) * along


@loop
def push_cells(first, last, rgba, row, joined, t_positions, t_rgba, out):
    """Fill lines of `out` (H, W, 2 C) with the derivative of `cells` along tangents; empty ones are zeros."""
    (most, _, width), count = row.shape, rgba.shape[1]
    through, behind = np.empty(most), np.empty((most, count))
    for i in range(first * width, last * width):
        y, x = i // width, i % width
        for c in range(2 * count):
            out[y, x, c] = 0.0
        layers = _weigh(rgba, row, y, x, through)
        if layers == 0:
            continue
        _stack(rgba, row, y, x, layers, behind)
        for k in range(layers if len(t_rgba) else 0):
            n = row[k, y, x]
            for c in range(count):
                out[y, x, c] += through[k] * (t_rgba[n, c] - t_rgba[n, count - 1] * behind[k, c])
        for k in range(layers if len(t_positions) else 0):
            n = row[k, y, x]
            left, right = _beside(row, joined, k, y, x, 0)
            up, down = _beside(row, joined, k, y, x, 1)
            for c in range(count):
                aside = _change(rgba, behind, k, through[k], left, right, c) * t_positions[n, 0]
                out[y, x, count + c] -= aside + _change(rgba, behind, k, through[k], up, down, c) * t_positions[n, 1]


@loop
def pull_cells(rgba, row, joined, g, g_positions, g_rgba):
    """Add to gradients of samples those of `cells`; empty ones are not wanted."""
    (most, height, width), count = row.shape, rgba.shape[1]
    through, behind = np.empty(most), np.empty((most, count))
    for i in range(height * width):
        y, x = i // width, i % width
        layers = _weigh(rgba, row, y, x, through)
        if layers == 0:
            continue
        _stack(rgba, row, y, x, layers, behind)
        for k in range(layers if len(g_rgba) else 0):
            n, hidden = row[k, y, x], 0.0
            for c in range(count):
                g_rgba[n, c] += through[k] * g[y, x, c]
                hidden += behind[k, c] * g[y, x, c]
            g_rgba[n, count - 1] -= through[k] * hidden
        for k in range(layers if len(g_positions) else 0):
            n, across, along = row[k, y, x], 0.0, 0.0
            left, right = _beside(row, joined, k, y, x, 0)
            up, down = _beside(row, joined, k, y, x, 1)
            for c in range(count):
                across += _change(rgba, behind, k, through[k], left, right, c) * g[y, x, count + c]
                along += _change(rgba, behind, k, through[k], up, down, c) * g[y, x, count + c]
            g_positions[n, 0] -= across
            g_positions[n, 1] -= along
