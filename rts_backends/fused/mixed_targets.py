"""Splatting onto mixed targets, where layers of different surfaces meet, by the tables of `layer_pairing.py`."""

from __future__ import annotations

import numpy as np

from rts_backends.fused.rows import Grid, compiled, exp, loop


@compiled
def splat(grid, i, y, x, u, v):
    """Weight of sample i of cell (y, x) at the target (u, v) farther on, and the offset x, y from sample to target.

    The sample's own offset from its cell's centre is scaled by the calibration.
    """
    positions, peak, gamma = grid.positions, grid.peak, grid.gamma
    kind, half = positions.dtype.type, positions.dtype.type(0.5)
    dx = kind(u) - gamma * (positions[i, 0] - (kind(x) + half))
    dy = kind(v) - gamma * (positions[i, 1] - (kind(y) + half))
    return peak * peak * exp(-(dx * dx + dy * dy) * grid.scale), dx, dy


@compiled
def sums_of(total, grid, y, x, choice):
    """Fill `total` (3, 5) with a target's buffers: colours over the weight, taken as at least one; and the weight.

    `choice` (9, 3, 2) are the target's `Choices.ranges`.
    """
    rgba, row = grid.rgba, grid.row
    _, height, width = row.shape
    one = total.dtype.type(1)
    total[:] = total.dtype.type(0)
    for n in range(9):
        v, u = n // 3 - 1, n % 3 - 1
        py, px = y - v, x - u
        if not (0 <= py < height and 0 <= px < width):
            continue
        for b in range(3):
            for k in range(choice[n, b, 0], choice[n, b, 1]):
                i = row[k, py, px]
                if i < 0:
                    continue
                w, _, _ = splat(grid, i, py, px, u, v)
                for c in range(4):
                    total[b, c] += w * rgba[i, c]
                total[b, 4] += w
    for b in range(3):
        over = one / max(total[b, 4], one)
        for c in range(4):
            total[b, c] *= over


@loop
def forward(start, stop, offsets, columns, sums, border, image):
    """Fill mixed targets of rows [start, stop) of the image (H, W, 4), the cells less a border `border` wide."""
    one = image.dtype.type(1)
    for y in range(start + border, stop + border):
        for d in range(offsets[y], offsets[y + 1]):
            x, total = columns[d], sums[d]
            if not 0 <= x - border < image.shape[1]:
                continue
            for c in range(4):
                back = total[1, c] + (one - total[1, 3]) * total[2, c]
                image[y - border, x - border, c] = total[0, c] + (one - total[0, 3]) * back


@loop
def adjoint(start, stop, offsets, columns, sums, border, g, adjoints):
    """Fill `adjoints` (M, 3, 5), gradients of mixed targets' sums before normalisation, from the image's `g` (H, W, 4).

    They are zero for targets in the border.
    """
    zero, one = g.dtype.type(0), g.dtype.type(1)
    for y in range(start, stop):
        for d in range(offsets[y], offsets[y + 1]):
            x, a, total = columns[d], adjoints[d], sums[d]
            if not (0 <= y - border < g.shape[0] and 0 <= x - border < g.shape[1]):
                a[:] = zero
                continue
            shown, through = one - total[0, 3], (one - total[0, 3]) * (one - total[1, 3])
            front, surface = zero, zero
            for c in range(4):
                h = g[y - border, x - border, c]
                front += h * (total[1, c] + (one - total[1, 3]) * total[2, c])
                surface += h * total[2, c]
                a[0, c], a[1, c], a[2, c] = h, shown * h, through * h
            a[0, 3] -= front
            a[1, 3] -= shown * surface
            for b in range(3):
                over, dot = one / max(total[b, 4], one), zero
                for c in range(4):
                    dot += a[b, c] * total[b, c]
                    a[b, c] *= over
                a[b, 4] = zero if total[b, 4] < one else -dot * over


@compiled
def _any(adjoints, d):
    """True if any adjoint of the sums of target d is not zero; beside wanted targets, many have zeros alone."""
    some = False
    for b in range(3):
        for c in range(5):
            some |= adjoints[d, b, c] != 0
    return some


@loop
def pull(start, stop, grid, offsets, columns, choices, adjoints, g_positions, g_rgba):
    """Add mixed targets' shares to the gradients of the samples of source rows [start, stop), from `adjoints`.

    `choices` are the ranges. A gradient of no rows is not wanted.
    """
    height = grid.row.shape[1]
    for y in range(start, stop):
        for v in range(-1 if y > 0 else 0, 2 if y < height - 1 else 1):
            for d in range(offsets[y + v], offsets[y + v + 1]):
                if _any(adjoints, d):
                    _pull_target(d, columns[d], v, grid, y, choices, adjoints, g_positions, g_rgba)


@compiled
def _pull_target(d, column, v, grid, y, choices, adjoints, g_positions, g_rgba):
    """`pull` from target d, which lies v rows farther on, to the sources of row y."""
    rgba, row, slope = grid.rgba, grid.row, grid.positions.dtype.type(2) * grid.scale * grid.gamma
    for u in range(-1, 2):
        x, n = column - u, 3 * (v + 1) + u + 1
        if not 0 <= x < row.shape[2]:
            continue
        for b in range(3):
            for k in range(choices[d, n, b, 0], choices[d, n, b, 1]):
                i = row[k, y, x]
                if i < 0:
                    continue
                w, dx, dy = splat(grid, i, y, x, u, v)
                h = adjoints[d, b, 4]
                for c in range(4):
                    h += adjoints[d, b, c] * rgba[i, c]
                for c in range(4 if len(g_rgba) > 0 else 0):
                    g_rgba[i, c] += w * adjoints[d, b, c]
                if len(g_positions) > 0:
                    g_positions[i, 0] += slope * w * h * dx
                    g_positions[i, 1] += slope * w * h * dy


@loop
def push(start, stop, grid, offsets, columns, choices, sums, tangents, border, out):
    """Fill mixed targets of rows [start, stop) of `out` (T, H, W, 4).

    `choices` are the ranges; `tangents` are those of positions (T, N, 3) and rgba (T, N, 4), without samples for zeros.
    """
    changes = np.empty((len(out), 3, 5), out.dtype)
    for y in range(start + border, stop + border):
        for d in range(offsets[y], offsets[y + 1]):
            x, total = columns[d], sums[d]
            if not 0 <= x - border < out.shape[2]:
                continue
            changes_of(changes, total, grid, y, x, choices[d], *tangents)
            for t in range(len(out)):
                for c in range(4):
                    out[t, y - border, x - border, c] = composited(total, changes[t], c)


@compiled
def composited(total, change, c):
    """The tangent of a channel of a target, from the normalised sums (3, 5) of its buffers and their tangents."""
    one = total.dtype.type(1)
    back = total[1, c] + (one - total[1, 3]) * total[2, c]
    d_back = change[1, c] - change[1, 3] * total[2, c] + (one - total[1, 3]) * change[2, c]
    return change[0, c] - change[0, 3] * back + (one - total[0, 3]) * d_back


@compiled
def tint_of(pixel, total, grid, y, x, choice, t_rgba):
    """Add to a pixel (4,) the change of target (y, x) along a tangent (N, 4) of colours.

    `total` (3, 5) are its sums, `choice` (9, 3, 2) its ranges, see `sums_of`.
    """
    # Weights do not change with colours: tangents are summed as colours are.
    change = np.empty((3, 5), total.dtype)
    tinted = Grid(grid.positions, t_rgba, grid.row, grid.scale, grid.peak, grid.gamma)
    sums_of(change, tinted, y, x, choice)
    for c in range(4):
        pixel[c] += composited(total, change, c)


@compiled
def changes_of(changes, total, grid, y, x, choice, t_positions, t_rgba):
    """Fill `changes` (T, 3, 5), tangents of `total`, the normalised sums of a target's buffers and their weights.

    Tangents of positions (T, N, 3) and rgba (T, N, 4) may have no samples: then they are zeros.
    """
    rgba, row = grid.rgba, grid.row
    _, height, width = row.shape
    zero, one = total.dtype.type(0), total.dtype.type(1)
    slope = total.dtype.type(2) * grid.scale * grid.gamma
    moved, tinted = t_positions.shape[1] > 0, t_rgba.shape[1] > 0
    changes[:] = zero
    for n in range(9):
        v, u = n // 3 - 1, n % 3 - 1
        py, px = y - v, x - u
        if not (0 <= py < height and 0 <= px < width):
            continue
        for b in range(3):
            for k in range(choice[n, b, 0], choice[n, b, 1]):
                i = row[k, py, px]
                if i < 0:
                    continue
                w, dx, dy = splat(grid, i, py, px, u, v)
                for t in range(len(changes)):
                    dw = slope * w * (dx * t_positions[t, i, 0] + dy * t_positions[t, i, 1]) if moved else zero
                    changes[t, b, 0] += dw * rgba[i, 0] + (w * t_rgba[t, i, 0] if tinted else zero)
                    changes[t, b, 1] += dw * rgba[i, 1] + (w * t_rgba[t, i, 1] if tinted else zero)
                    changes[t, b, 2] += dw * rgba[i, 2] + (w * t_rgba[t, i, 2] if tinted else zero)
                    changes[t, b, 3] += dw * rgba[i, 3] + (w * t_rgba[t, i, 3] if tinted else zero)
                    changes[t, b, 4] += dw
    for b in range(3):
        over = one / max(total[b, 4], one)
        for t in range(len(changes)):
            grown = zero if total[b, 4] < one else changes[t, b, 4]
            for c in range(4):
                changes[t, b, c] = (changes[t, b, c] - grown * total[b, c]) * over
