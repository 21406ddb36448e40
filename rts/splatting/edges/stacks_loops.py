"""Composites of the stacks in cells, moved layer by layer, and their derivatives. Compiled.

The composite changes by Σ_k T_k (change of colour k − change of alpha k · B_k), where T_k is the light that passes to
layer k and B_k the composite behind it. Alpha is the last of C channels.
"""

from __future__ import annotations

import numpy as np

from rts.compiling.loops import compiled, loop
from rts.splatting.edges.weights_loops import fill_normals


@compiled(inline="always")
def _weigh(rgba, row, y, x, samples, layers, through):
    """Fill in the samples (K,) of a cell that light reaches, their layers, and the light; returns their number."""
    light, count, alpha = 1.0, 0, rgba.shape[1] - 1
    for k in range(len(row)):
        n = row[k, y, x]
        if n >= 0 and light > 0:
            samples[count], layers[count], through[count] = n, k, light
            light *= 1 - rgba[np.uint32(n), alpha]
            count += 1
    return count


@compiled(inline="always")
def _rooms(most, count):
    """Room for `_weigh` and `_stack`."""
    return np.empty(most, np.uint32), np.empty(most, np.uint32), np.empty(most), np.empty((most, count))


@compiled(inline="always")
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


@compiled(inline="always")
def _beside(row, joined, k, y, x, axis):
    """The samples of layer k in the cells before and after a cell along an axis; its own where they are not joined."""
    dy, dx, n = axis, 1 - axis, row[k, y, x]
    before = row[k, y - dy, x - dx] if y >= dy and x >= dx and joined[axis, y - dy, x - dx] else n
    after = row[k, y + dy, x + dx] if joined[axis, y, x] else n
    return np.uint32(before if before >= 0 else n), np.uint32(after if after >= 0 else n)


@compiled(inline="always")
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


@compiled(inline="always")
def _laid(rgba, n, light, out, y, x):
    """Add a layer behind those of a cell in `out` (2, H, W, C); returns the light that passes."""
    for c in range(rgba.shape[1]):
        out[0, y, x, c] += light * rgba[n, c]
    return light * (1 - rgba[n, rgba.shape[1] - 1])


@loop
def cells(first, last, rgba, row, out):
    """Fill lines `first` to `last` of `out` (2, H, W, C): composites, and zeros."""
    out[:, first:last] = 0.0
    for y in range(first, last):
        for x in range(row.shape[2]):
            light = 1.0
            for k in range(len(row)):
                if row[k, y, x] >= 0 and light > 0:
                    light = _laid(rgba, np.uint32(row[k, y, x]), light, out, y, x)


@loop
def push_cells(first, last, rgba, row, joined, t_positions, t_rgba, out):
    """Fill lines of `out` (2, H, W, C) with the derivative along tangents, see `pull_cells`; empty ones are zeros."""
    most, count = len(row), rgba.shape[1]
    samples, layers, through, behind = _rooms(most, count)
    for y in range(first, last):
        for x in range(row.shape[2]):
            for c in range(count):
                out[0, y, x, c] = out[1, y, x, c] = 0.0
            reached = _weigh(rgba, row, y, x, samples, layers, through)
            if reached == 0:
                continue
            _stack(rgba, samples, reached, behind)
            for k in range(reached if len(t_rgba) else 0):
                n = samples[k]
                for c in range(count):
                    out[0, y, x, c] += through[k] * (t_rgba[n, c] - t_rgba[n, count - 1] * behind[k, c])
            for k in range(reached if len(t_positions) else 0):
                n = samples[k]
                left, right = _beside(row, joined, layers[k], y, x, 0)
                up, down = _beside(row, joined, layers[k], y, x, 1)
                for c in range(count):
                    aside = _change(rgba, behind, k, through[k], left, right, c) * t_positions[n, 0]
                    out[1, y, x, c] -= aside + _change(rgba, behind, k, through[k], up, down, c) * t_positions[n, 1]


@compiled(inline="always")
def _dot(rgba, n, g, half, y, x):
    """The product of a sample's colour and one half of the gradient (2, H, W, C) of a cell."""
    total = 0.0
    for c in range(rgba.shape[1]):
        total += rgba[n, c] * g[half, y, x, c]
    return total


@compiled(inline="always")
def _add(g_rgba, n, light, g, y, x):
    """Add the gradient (2, H, W, C) of a cell to that of a layer's colour."""
    for c in range(g_rgba.shape[1]):
        g_rgba[n, c] += light * g[0, y, x, c]


@compiled(inline="always")
def _pulled(rgba, before, after, g, y, x, behind):
    """The product of `_change`, without the light, and the gradient of a cell; given that of what is behind."""
    opacity = rgba[after, rgba.shape[1] - 1] - rgba[before, rgba.shape[1] - 1]
    change = 0.0
    for c in range(rgba.shape[1]):
        change += (rgba[after, c] - rgba[before, c]) * g[1, y, x, c]
    return 0.5 * (change - opacity * behind)


@loop
def pull_cells(rgba, row, joined, g, g_positions, g_rgba):
    """Add to gradients of samples those of `g` (2, H, W, C); empty ones are not wanted.

    The second half is what moves along the slopes of composites, which has a derivative alone.
    """
    most, height, width = row.shape
    alpha = rgba.shape[1] - 1
    samples, layers, through = np.empty(most, np.uint32), np.empty(most, np.uint32), np.empty(most)
    for y in range(height):
        for x in range(width):
            # What is behind a layer, times the gradient: all that is asked of it.
            behind, moved_behind = 0.0, 0.0
            for k in range(_weigh(rgba, row, y, x, samples, layers, through) - 1, -1, -1):
                n, light = samples[k], through[k]
                passed = 1 - rgba[n, alpha]
                if len(g_rgba):
                    _add(g_rgba, n, light, g, y, x)
                    g_rgba[n, alpha] -= light * behind
                    behind = _dot(rgba, n, g, 0, y, x) + passed * behind
                if len(g_positions):
                    left, right = _beside(row, joined, layers[k], y, x, 0)
                    up, down = _beside(row, joined, layers[k], y, x, 1)
                    g_positions[n, 0] -= light * _pulled(rgba, left, right, g, y, x, moved_behind)
                    g_positions[n, 1] -= light * _pulled(rgba, up, down, g, y, x, moved_behind)
                    moved_behind = _dot(rgba, n, g, 1, y, x) + passed * moved_behind


# ---------------------------------------------------------------------------------------------------- beside breaks


@compiled(inline="always")
def _color(rgba, n, c):
    """A channel of a sample; 0 for none."""
    return rgba[n, c] if n >= 0 else 0.0


@compiled
def _weigh_side(b, i, rgba, row, cell, gap, rows, stack, normal, through, behind, change, moves, movers):
    """Fill in the tables of a side, see `weigh_sides`; room for light (K,) and for composites (K, C) is given."""
    layers, count = len(row), rgba.shape[1]
    y, x = cell
    along_x, along_y = (gap[b, 2], 1 - gap[b, 2]) if i == 1 else (-gap[b, 2], gap[b, 2] - 1)
    across = normal[b, 0] * along_x + normal[b, 1] * along_y
    alpha, light = count - 1, 1.0
    for k in range(layers):
        through[k] = light
        light *= 1 - _color(rgba, row[k, y, x], alpha)
    for c in range(count):
        back, other = 0.0, 0.0
        for k in range(layers - 1, -1, -1):
            n, m = row[k, y, x], stack[b, i, k]
            behind[k, c] = back
            back = _color(rgba, n, c) + (1 - _color(rgba, n, alpha)) * back
            other = _color(rgba, m, c) + (1 - _color(rgba, m, alpha)) * other
        change[layers, c] = back - other if rows[b, i] >= 0 else 0.0
    movers[layers, 0], movers[layers, 1] = rows[b, i], -1
    moves[layers, 0], moves[layers, 1] = 0.5 * across * normal[b, 0], 0.5 * across * normal[b, 1]
    for k in range(layers):
        n, m, ends = row[k, y, x], stack[b, i, k], True
        for other_layer in range(layers):
            ends &= stack[b, 1 - i, other_layer] != m
        movers[k, 0], movers[k, 1] = n, m
        moves[k, 0], moves[k, 1] = 0.5 * along_x, 0.5 * along_y
        if ends:
            moves[k, 0], moves[k, 1] = moves[layers, 0], moves[layers, 1]
        opacity = _color(rgba, m, alpha) - _color(rgba, n, alpha)
        for c in range(count):
            rise = _color(rgba, m, c) - _color(rgba, n, c)
            change[k, c] = through[k] * (rise - opacity * behind[k, c])


@compiled(inline="always")
def _cells_of(gap, place, b, i):
    """The cell on a side of a break and the one beyond, (y, x) each, and the share of a change that the first has."""
    y, x, right = gap[b, 0], gap[b, 1], gap[b, 2]
    first, second = (y, x), (y + 1 - right, x + right)
    length = min(max(place[b] if i == 0 else 1 - place[b], 0.0), 1.0)
    share = min(length, 0.5) / (length if length > 1e-6 else 1.0)
    return (first, second, share) if i == 0 else (second, first, share)


@loop
def weigh_sides(rgba, row, rows, gap, place, ends, ties, stack, change, moves, movers, cells, share):
    """Fill in how composites change on both sides of breaks, S = 2 B, where samples move; see `stack_sides`.

    A composite changes by `change` times the motion, along `moves`, of both `movers`, for each layer. The last of K + 1
    rows is of the sample that ends there, as if the composite moved with it.

    Args:
        rgba: (N, C).
        row: (K, H, W).
        rows: (B, 2) of outlines.
        gap: (B, 3).
        place: (B,).
        ends: (B, 2).
        ties: (T, 2).
        stack: (B, 2, K).
        change: (S, K + 1, C) to fill.
        moves: (S, K + 1, 2) to fill, x and y.
        movers: (S, K + 1, 2) int32 to fill, samples or −1.
        cells: (S, 2, 2) int32 to fill: y and x of the cell on the side, and of that beyond; −1 where nothing changes.
        share: (S,) to fill, what the first cell has of the change.
    """
    normal, through, behind = np.empty((len(gap), 2)), np.empty(len(row)), np.empty((len(row), rgba.shape[1]))
    fill_normals(gap, place, ties, normal)
    for s in range(len(cells)):
        b, i, cells[s] = s // 2, s % 2, -1
        if not (ends[b, i] and stack[b, i, 0] >= 0):
            continue
        here, beyond, share[s] = _cells_of(gap, place, b, i)
        cells[s, 0, 0], cells[s, 0, 1] = here
        cells[s, 1, 0], cells[s, 1, 1] = beyond
        tables = change[s], moves[s], movers[s]
        _weigh_side(b, i, rgba, row, here, gap, rows, stack, normal, through, behind, *tables)


@loop
def push_sides(change, moves, movers, cells, share, t_positions, out):
    """Add to `out` (H, W, C) how composites change as samples move; arguments as of `weigh_sides`."""
    for s in range(len(cells)):
        (y, x), (down, right) = cells[s]
        for k in range(len(change[s]) if y >= 0 else 0):
            motion = 0.0
            for n in movers[s, k]:
                if n >= 0:
                    motion += moves[s, k, 0] * t_positions[n, 0] + moves[s, k, 1] * t_positions[n, 1]
            for c in range(out.shape[2]):
                out[y, x, c] += share[s] * change[s, k, c] * motion
                out[down, right, c] += (1 - share[s]) * change[s, k, c] * motion


@loop
def pull_sides(change, moves, movers, cells, share, g, g_positions):
    """Add to gradients of positions those of `push_sides`."""
    for s in range(len(cells)):
        (y, x), (down, right) = cells[s]
        for k in range(len(change[s]) if y >= 0 else 0):
            total = 0.0
            for c in range(g.shape[2]):
                total += change[s, k, c] * (share[s] * g[y, x, c] + (1 - share[s]) * g[down, right, c])
            for n in movers[s, k]:
                if n >= 0:
                    g_positions[n, 0] += moves[s, k, 0] * total
                    g_positions[n, 1] += moves[s, k, 1] * total
