"""Composites of the stacks in cells, moved layer by layer, and their derivatives. Compiled.

The composite changes by Σ_k T_k (change of colour k − change of alpha k · B_k), where T_k is the light that passes to
layer k and B_k the composite behind it. Alpha is the last of C channels.
"""

from __future__ import annotations

import numpy as np

from rts.compiling.loops import compiled, loop


@compiled
def _weigh(rgba, row, y, x, samples, through):
    """Fill `samples` and `through` (K,), the layers of a cell that light reaches, and the light; returns their number.

    Empty layers come last.
    """
    light, count, alpha = 1.0, 0, rgba.shape[1] - 1
    for k in range(len(row)):
        n = row[k, y, x]
        if n >= 0 and light > 0:
            samples[count], through[count] = n, light
            light *= 1 - rgba[np.uint32(n), alpha]
            count += 1
    return count


@compiled
def _stack(rgba, samples, count, behind):
    """Fill `behind` (K, C), the composite behind each of the first layers of a cell."""
    alpha = rgba.shape[1] - 1
    for c in range(alpha + 1):
        behind[count - 1, c] = 0.0
    for k in range(count - 1, 0, -1):
        n = samples[k]
        passed = 1 - rgba[n, alpha]
        for c in range(alpha + 1):
            behind[k - 1, c] = rgba[n, c] + passed * behind[k, c]


@compiled
def _beside(row, joined, k, y, x, axis):
    """The samples of layer k in the cells before and after a cell along an axis; its own where they are not joined."""
    dy, dx, n = axis, 1 - axis, row[k, y, x]
    before = row[k, y - dy, x - dx] if y >= dy and x >= dx and joined[axis, y - dy, x - dx] else n
    after = row[k, y + dy, x + dx] if joined[axis, y, x] else n
    return np.uint32(before if before >= 0 else n), np.uint32(after if after >= 0 else n)


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
def cells(first, last, rgba, row, out):
    """Fill lines `first` to `last` of `out` (2, H, W, C): composites, and zeros."""
    alpha = rgba.shape[1] - 1
    for y in range(first, last):
        for x in range(row.shape[2]):
            for c in range(alpha + 1):
                out[0, y, x, c] = out[1, y, x, c] = 0.0
            light = 1.0
            for k in range(len(row)):
                if row[k, y, x] >= 0 and light > 0:
                    n = np.uint32(row[k, y, x])
                    for c in range(alpha + 1):
                        out[0, y, x, c] += light * rgba[n, c]
                    light *= 1 - rgba[n, alpha]


@loop
def push_cells(first, last, rgba, row, joined, t_positions, t_rgba, out):
    """Fill lines of `out` (2, H, W, C) with the derivative along tangents, see `pull_cells`; empty ones are zeros."""
    most, count = len(row), rgba.shape[1]
    samples, through, behind = np.empty(most, np.uint32), np.empty(most), np.empty((most, count))
    for y in range(first, last):
        for x in range(row.shape[2]):
            for c in range(count):
                out[0, y, x, c] = out[1, y, x, c] = 0.0
            layers = _weigh(rgba, row, y, x, samples, through)
            if layers == 0:
                continue
            _stack(rgba, samples, layers, behind)
            for k in range(layers if len(t_rgba) else 0):
                n = samples[k]
                for c in range(count):
                    out[0, y, x, c] += through[k] * (t_rgba[n, c] - t_rgba[n, count - 1] * behind[k, c])
            for k in range(layers if len(t_positions) else 0):
                n = samples[k]
                left, right = _beside(row, joined, k, y, x, 0)
                up, down = _beside(row, joined, k, y, x, 1)
                for c in range(count):
                    aside = _change(rgba, behind, k, through[k], left, right, c) * t_positions[n, 0]
                    out[1, y, x, c] -= aside + _change(rgba, behind, k, through[k], up, down, c) * t_positions[n, 1]


@loop
def pull_cells(rgba, row, joined, g, g_positions, g_rgba):
    """Add to gradients of samples those of `g` (2, H, W, C); empty ones are not wanted.

    The second half is what moves along the slopes of composites, which has a derivative alone.
    """
    most, height, width = row.shape
    count = rgba.shape[1]
    samples, through, behind = np.empty(most, np.uint32), np.empty(most), np.empty((most, count))
    for y in range(height):
        for x in range(width):
            layers = _weigh(rgba, row, y, x, samples, through)
            if layers == 0:
                continue
            _stack(rgba, samples, layers, behind)
            for k in range(layers if len(g_rgba) else 0):
                n, hidden = samples[k], 0.0
                for c in range(count):
                    g_rgba[n, c] += through[k] * g[0, y, x, c]
                    hidden += behind[k, c] * g[0, y, x, c]
                g_rgba[n, count - 1] -= through[k] * hidden
            for k in range(layers if len(g_positions) else 0):
                left, right = _beside(row, joined, k, y, x, 0)
                up, down = _beside(row, joined, k, y, x, 1)
                if left == right and up == down:
                    continue
                n, across, along = samples[k], 0.0, 0.0
                for c in range(count):
                    across += _change(rgba, behind, k, through[k], left, right, c) * g[1, y, x, c]
                    along += _change(rgba, behind, k, through[k], up, down, c) * g[1, y, x, c]
                g_positions[n, 0] -= across
                g_positions[n, 1] -= along
