"""Targets of translucent layers whose nine sources have the same layers: most targets, without plans.

Layer by layer, all sources are at the level of the target. So nothing lies in front of a level or in a gap, and the
image is I = S + (W − A) · I' at each level, see `rts.splatting.stacks`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rts.plugin_api.loops import compiled, loop
from rts_backends.fused.mixed_targets import splat


class Straight(NamedTuple):
    """S targets and what their sums are.

    Attributes:
        offsets: (H + 1,) int64, where the targets of each row begin.
        columns: (S,) int32, their columns.
        levels: (S,) int32, the number of layers of each.
        sums: (S, K, 5), at each level the colours over the weight, taken as at least one, and the weight.
        images: (S, K + 1, 4), the image from each level on.
    """

    offsets: np.ndarray
    columns: np.ndarray
    levels: np.ndarray
    sums: np.ndarray
    images: np.ndarray

    @classmethod
    def of(cls, counts: np.ndarray, layers: int, kind: np.dtype) -> Straight:
        """Room for so many targets (H,) in each row."""
        offsets = np.concatenate([[0], np.cumsum(counts)])
        count = offsets[-1]
        sums, images = np.empty((count, layers, 5), kind), np.empty((count, layers + 1, 4), kind)
        return cls(offsets, np.empty(count, np.int32), np.empty(count, np.int32), sums, images)


@loop
def find(start, stop, grid, levels, marks, straight, counts):
    """Move marks of straight targets of rows [start, stop) to another mask.

    Args:
        start: first row.
        stop: end of the rows.
        grid: the samples, the layers of each cell in order of depth.
        levels: (H, W) int32, the number of layers of each cell.
        marks: (H, W) uint8, targets; those that are straight are cleared.
        straight: (H, W) uint8, to be filled.
        counts: (H, 2), to be filled with the number of either.
    """
    height, width = levels.shape
    for y in range(start, stop):
        counts[y] = 0
        for x in range(width):
            straight[y, x] = 0
            if not marks[y, x]:
                continue
            inside = 0 < y < height - 1 and 0 < x < width - 1
            if inside and _is_straight(grid.positions, grid.row, levels, y, x):
                marks[y, x], straight[y, x] = 0, 1
            counts[y, straight[y, x]] += 1


@compiled
def _is_straight(positions, row, levels, y, x):
    count = levels[y, x]
    for n in range(9):
        if levels[y - n // 3 + 1, x - n % 3 + 1] != count:
            return False
    for t in range(count - 1):
        own, next_own = positions[row[t, y, x], 2], positions[row[t + 1, y, x], 2]
        for n in range(9):
            py, px = y - n // 3 + 1, x - n % 3 + 1
            z, next_z = positions[row[t, py, px], 2], positions[row[t + 1, py, px], 2]
            distance = abs(z - own)
            if distance > abs(next_z - own) or distance > abs(next_own - z):
                return False
    return count > 0


@loop
def fill(start, stop, grid, levels, marks, states, empty, straight):
    """List the targets of rows [start, stop), and fill their sums and images; the stencil leaves them out."""
    rgba, row = grid.rgba, grid.row
    sums, images = straight.sums, straight.images
    zero, one = sums.dtype.type(0), sums.dtype.type(1)
    for y in range(start, stop):
        d = straight.offsets[y]
        for x in range(marks.shape[1]):
            if not marks[y, x]:
                continue
            straight.columns[d], straight.levels[d], states[y, x] = x, levels[y, x], empty
            for c in range(4):
                images[d, levels[y, x], c] = zero
            for t in range(levels[y, x] - 1, -1, -1):
                red, green, blue, alpha, weight = zero, zero, zero, zero, zero
                for n in range(9):
                    v, u = n // 3 - 1, n % 3 - 1
                    i = row[t, y - v, x - u]
                    w, _, _ = splat(grid, i, y - v, x - u, u, v)
                    red, green, blue = red + w * rgba[i, 0], green + w * rgba[i, 1], blue + w * rgba[i, 2]
                    alpha, weight = alpha + w * rgba[i, 3], weight + w
                over = one / max(weight, one)
                sums[d, t, 0], sums[d, t, 1], sums[d, t, 2] = over * red, over * green, over * blue
                sums[d, t, 3], sums[d, t, 4] = over * alpha, weight
                through = min(weight, one) - over * alpha
                for c in range(4):
                    images[d, t, c] = sums[d, t, c] + through * images[d, t + 1, c]
            d += 1


@loop
def recolor(start, stop, own, listed, straight, changes):
    """Fill `outlines.Outlines.changes` (L, 2, 4) of listed targets that are straight, see `stacks.recolor`."""
    sums, images = straight.sums, straight.images
    for y in range(start, stop):
        d = straight.offsets[y]
        for j in range(own[y], own[y + 1]):
            while d < straight.offsets[y + 1] and straight.columns[d] < listed[j]:
                d += 1
            if d == straight.offsets[y + 1] or straight.columns[d] != listed[j]:
                continue
            weight = sums[d, 0, 4]
            for c in range(4 if 0 < weight < 1 else 0):
                changes[j, 1, c] = (sums[d, 0, c] + (weight - sums[d, 0, 3]) * images[d, 1, c]) / weight


@loop
def adjoint(start, stop, straight, border, g, adjoints):
    """Fill the gradients (S, K, 5) of the sums that are not normalised, from the image's (H, W, 4)."""
    sums, images = straight.sums, straight.images
    zero, one = g.dtype.type(0), g.dtype.type(1)
    own = np.empty(4, g.dtype)
    for y in range(start, stop):
        for d in range(straight.offsets[y], straight.offsets[y + 1]):
            x = straight.columns[d]
            inside = 0 <= y - border < g.shape[0] and 0 <= x - border < g.shape[1]
            for c in range(4):
                own[c] = g[y - border, x - border, c] if inside else zero
            for t in range(straight.levels[d]):
                weight, alpha, through, dot = sums[d, t, 4], sums[d, t, 3], zero, zero
                over = one / max(weight, one)
                for c in range(4):
                    through += own[c] * images[d, t + 1, c]
                    dot += own[c] * sums[d, t, c]
                    adjoints[d, t, c] = over * own[c]
                    own[c] *= min(weight, one) - alpha
                adjoints[d, t, 3] -= over * through
                adjoints[d, t, 4] = -(dot - through * alpha) * over if weight >= one else through


@loop
def pull(start, stop, grid, straight, adjoints, g_positions, g_rgba):
    """Add targets' shares to the gradients of the samples of source rows [start, stop)."""
    height = grid.row.shape[1]
    for y in range(start, stop):
        for v in range(-1 if y > 0 else 0, 2 if y < height - 1 else 1):
            for d in range(straight.offsets[y + v], straight.offsets[y + v + 1]):
                levels, column = straight.levels[d], straight.columns[d]
                _pull_target(d, levels, column, v, grid, y, adjoints, g_positions, g_rgba)


@compiled
def _pull_target(d, levels, column, v, grid, y, adjoints, g_positions, g_rgba):
    """`pull` from one target, v rows farther on, to its sources in row y."""
    rgba, row, slope = grid.rgba, grid.row, grid.positions.dtype.type(2) * grid.scale * grid.gamma
    for t in range(levels):
        red, green, blue = adjoints[d, t, 0], adjoints[d, t, 1], adjoints[d, t, 2]
        alpha, weight = adjoints[d, t, 3], adjoints[d, t, 4]
        for u in range(-1, 2):
            i = row[t, y, column - u]
            w, dx, dy = splat(grid, i, y, column - u, u, v)
            if len(g_rgba) > 0:
                g_rgba[i, 0] += w * red
                g_rgba[i, 1] += w * green
                g_rgba[i, 2] += w * blue
                g_rgba[i, 3] += w * alpha
            if len(g_positions) > 0:
                h = weight + red * rgba[i, 0] + green * rgba[i, 1] + blue * rgba[i, 2] + alpha * rgba[i, 3]
                g_positions[i, 0] += slope * w * h * dx
                g_positions[i, 1] += slope * w * h * dy


@loop
def push(start, stop, grid, straight, tangents, border, out):
    """Fill targets of rows [start, stop) of `out` (T, H, W, 4); `tangents` are those of positions and rgba."""
    t_positions, t_rgba = tangents
    change, grown = np.empty(5, out.dtype), np.empty(4, out.dtype)
    for y in range(start + border, stop + border):
        for d in range(straight.offsets[y], straight.offsets[y + 1]):
            x = straight.columns[d]
            for direction in range(len(out) if 0 <= x - border < out.shape[2] else 0):
                grown[:] = 0
                for t in range(straight.levels[d] - 1, -1, -1):
                    _change(change, d, t, direction, grid, y, x, straight.sums, t_positions, t_rgba)
                    _over(grown, change, straight.sums, straight.images, d, t)
                for c in range(4):
                    out[direction, y - border, x - border, c] = grown[c]


@compiled
def _change(change, d, t, direction, grid, y, x, sums, t_positions, t_rgba):
    """Fill the tangent (5,) of the sums at a level."""
    rgba, row, zero, one = grid.rgba, grid.row, change.dtype.type(0), change.dtype.type(1)
    slope, moved, tinted = change.dtype.type(2) * grid.scale * grid.gamma, t_positions.shape[1] > 0, t_rgba.shape[1] > 0
    change[:] = zero
    for n in range(9):
        v, u = n // 3 - 1, n % 3 - 1
        i = row[t, y - v, x - u]
        w, dx, dy = splat(grid, i, y - v, x - u, u, v)
        dw = zero
        if moved:
            dw = slope * w * (dx * t_positions[direction, i, 0] + dy * t_positions[direction, i, 1])
        change[4] += dw
        for c in range(4):
            change[c] += dw * rgba[i, c] + (w * t_rgba[direction, i, c] if tinted else zero)
    over = one / max(sums[d, t, 4], one)
    more = change[4] if sums[d, t, 4] >= one else zero
    for c in range(4):
        change[c] = (change[c] - more * sums[d, t, c]) * over


@compiled
def _over(grown, change, sums, images, d, t):
    """From the tangent of the image of the next level to that of a level."""
    zero, one = grown.dtype.type(0), grown.dtype.type(1)
    weight, behind = sums[d, t, 4], change[3]
    more = change[4] if weight < one else zero
    for c in range(4):
        through = (more - behind) * images[d, t + 1, c] + (min(weight, one) - sums[d, t, 3]) * grown[c]
        grown[c] = change[c] + through
