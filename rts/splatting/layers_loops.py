"""Composites of layers, and their derivatives, for `rts.splatting.layers`. Compiled.

Alpha is the last of C channels.
"""

from __future__ import annotations

import numpy as np

from rts.compiling.loops import compiled, loop


@compiled(inline="always")
def _weigh(rgba, row, stacks, m, samples, layers, through):
    """Fill in the samples (K,) of a cell or a stack, their layers, and the light; returns their number.

    `row` is (K, H · W).
    """
    light, count, alpha, cells = 1.0, 0, rgba.shape[1] - 1, row.shape[1]
    for k in range(len(row)):
        n = row[k, m] if m < cells else stacks[m - cells, k]
        if n >= 0:
            samples[count], layers[count], through[count] = n, k, light
            light *= 1 - rgba[np.uint32(n), alpha]
            count += 1
    return count


@compiled(inline="always")
def _beside(row, joined, k, y, x, axis):
    """The samples of layer k in the cells before and after a cell along an axis; its own where they are not joined."""
    dy, dx, n = axis, 1 - axis, row[k, y, x]
    before = row[k, y - dy, x - dx] if y >= dy and x >= dx and joined[axis, y - dy, x - dx] else n
    after = row[k, y + dy, x + dx] if joined[axis, y, x] else n
    return np.uint32(before if before >= 0 else n), np.uint32(after if after >= 0 else n)


@loop
def value(first, last, rgba, row, stacks, out):
    """Fill rows `first` to `last` of `out` (2 H · W + R, C): composites; and, for cells, zeros at the end."""
    row = row.reshape((len(row), -1))
    cells = row.shape[1]
    out[first:last], out[cells + len(stacks) + first : cells + len(stacks) + min(last, cells)] = 0.0, 0.0
    for m in range(first, last):
        light = 1.0
        for k in range(len(row)):
            n = row[k, m] if m < cells else stacks[m - cells, k]
            if n >= 0:
                for c in range(out.shape[1]):
                    out[m, c] += light * rgba[np.uint32(n), c]
                light *= 1 - rgba[np.uint32(n), out.shape[1] - 1]


@loop
def push(first, last, rgba, row, joined, stacks, t_positions, t_rgba, out):
    """Fill rows of `out` with the derivative of `value` along tangents, and of motions; empty ones are zeros."""
    most, count, width, cells = len(row), rgba.shape[1], row.shape[2], row.shape[1] * row.shape[2]
    samples, layers = np.empty(most, np.uint32), np.empty(most, np.uint32)
    through, behind, alpha = np.empty(most), np.empty((most + 1, count)), count - 1
    flat = row.reshape((most, -1))
    for m in range(first, last):
        moved = cells + len(stacks) + m
        for c in range(count):
            out[m, c] = 0.0
            if m < cells:
                out[moved, c] = 0.0
        reached = _weigh(rgba, flat, stacks, m, samples, layers, through)
        for c in range(count):
            behind[reached, c] = 0.0
        for k in range(reached - 1, -1, -1):
            n, light = samples[k], through[k]
            opacity = t_rgba[n, alpha] if len(t_rgba) else 0.0
            if len(t_rgba):
                for c in range(count):
                    out[m, c] += light * (t_rgba[n, c] - opacity * behind[k + 1, c])
            if len(t_positions) and m < cells:
                y, x = m // width, m % width
                left, right = _beside(row, joined, layers[k], y, x, 0)
                up, down = _beside(row, joined, layers[k], y, x, 1)
                mx, my = 0.5 * light * t_positions[n, 0], 0.5 * light * t_positions[n, 1]
                aside, below = rgba[right, alpha] - rgba[left, alpha], rgba[down, alpha] - rgba[up, alpha]
                for c in range(count):
                    of_x = rgba[right, c] - rgba[left, c] - aside * behind[k + 1, c]
                    of_y = rgba[down, c] - rgba[up, c] - below * behind[k + 1, c]
                    out[moved, c] -= mx * of_x + my * of_y
            passed = 1 - rgba[n, alpha]
            for c in range(count):
                behind[k, c] = rgba[n, c] + passed * behind[k + 1, c]


@compiled(inline="always")
def _any(g, m):
    """True if a row of a gradient is not 0."""
    found = False
    for c in range(g.shape[1]):
        found |= g[m, c] != 0
    return found


@loop
def distinct(row, used):
    """True if no two cells of `row` (C,) name one sample; `used` (N,), False for all, are marked."""
    for n in row:
        if n >= 0:
            if used[np.uint32(n)]:
                return False
            used[np.uint32(n)] = True
    return True


@loop
def pull(first, last, rgba, row, joined, stacks, g, g_positions, g_rgba):
    """Add to gradients of samples those of rows `first` to `last` of `g` (2 H · W + R, C); unless they are empty."""
    most, width, cells = len(row), np.uint32(row.shape[2]), row.shape[1] * row.shape[2]
    samples, layers, through = np.empty(most, np.uint32), np.empty(most, np.uint32), np.empty(most)
    alpha, flat = rgba.shape[1] - 1, row.reshape((most, -1))
    for cell in range(first, last):
        m = np.uint32(cell)  # Compiled code need not check for negative ones.
        # What is behind a layer, times the gradient: all that is asked of it.
        behind, moved_behind, moved = 0.0, 0.0, np.uint32(cells + len(stacks) + m)
        if m >= cells and not _any(g, m):  # Of most stacks the composite only tells how colours jump.
            continue
        y, x = m // width, m % width
        for k in range(_weigh(rgba, flat, stacks, m, samples, layers, through) - 1, -1, -1):
            n, light = samples[k], through[k]
            passed, own, own_moved = 1 - rgba[n, alpha], 0.0, 0.0
            if len(g_rgba):
                for c in range(alpha + 1):
                    g_rgba[n, c] += light * g[m, c]
                    own += rgba[n, c] * g[m, c]
                g_rgba[n, alpha] -= light * behind
                behind = own + passed * behind
            if len(g_positions) and m < cells:
                left, right = _beside(row, joined, layers[k], y, x, 0)
                up, down = _beside(row, joined, layers[k], y, x, 1)
                # The product of the layer's slopes, as the composite shows them, and the gradient of the motion.
                of_x, of_y = 0.0, 0.0
                for c in range(alpha + 1):
                    of_x += (rgba[right, c] - rgba[left, c]) * g[moved, c]
                    of_y += (rgba[down, c] - rgba[up, c]) * g[moved, c]
                    own_moved += rgba[n, c] * g[moved, c]
                aside, below = rgba[right, alpha] - rgba[left, alpha], rgba[down, alpha] - rgba[up, alpha]
                g_positions[n, 0] -= light * (0.5 * (of_x - aside * moved_behind))
                g_positions[n, 1] -= light * (0.5 * (of_y - below * moved_behind))
                moved_behind = own_moved + passed * moved_behind
