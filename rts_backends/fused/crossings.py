"""Lines of crossing, where surfaces pass through one another: `rts.splatting.crossings` for the compiled `Visible`.

Here the derivatives of targets beside a line are computed: by positions always, by colours unless the target is mixed.
These targets are few: one thread adds up their gradients, in order.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from rts.plugin_api.loops import compiled, loop
from rts.plugin_api.threads import parallel
from rts_backends.fused.crossing_pairs import BORDER, Rules, gather, has_two, steps
from rts_backends.fused.mixed_targets import splat, tint_of
from rts_backends.fused.rows import Grid
from rts_backends.fused.uniform_cells import BUSY, SETTLED

NEITHER, SHEET_A, SHEET_B = 2, 0, 1
"""A source's sheet: none, or one of two."""


class Crossings(NamedTuple):
    """Targets beside lines of crossing, and the terms of their derivatives.

    Attributes:
        offsets: (H + 1,) int64, where the cells of each row begin in the lists below.
        columns: (M,) int32, the targets' columns; −1 where the derivative turns out not to be that of a line.
        mixed: (M,) int64, indices in the list of mixed targets (`rts_backends.fused.cells.Choices`), −1 if not mixed.
        sheets: (M, 9) uint8, the sheet of each source; source 3 (v + 1) + (u + 1) lies at −(u, v) from the target.
        weights: (M, 9, 3), for each source's front: the share of its colour in a target that is not mixed; and the
            derivatives of its weight by its position x and y, over the sum of all weights.
        colors: (M, 2, 4), the sheets' mean colours.
        slopes: (M, 5), the derivative of sheet b's share of the target by ġ (`rate`); and ∇z of both sheets.
    """

    offsets: np.ndarray
    columns: np.ndarray
    mixed: np.ndarray
    sheets: np.ndarray
    weights: np.ndarray
    colors: np.ndarray
    slopes: np.ndarray

    def cells(self) -> tuple[np.ndarray, np.ndarray]:
        """Rows and columns of the targets whose derivative is that of a line."""
        own, rows = self.columns >= 0, np.arange(len(self.offsets) - 1)
        return np.repeat(rows, np.diff(self.offsets))[own], self.columns[own]

    def still(self, offsets: np.ndarray, columns: np.ndarray, changes: np.ndarray) -> None:
        """Clear the changes of these targets in a list of L `Outlines`: lines of crossing replace them.

        Args:
            offsets: (H + 1,), where the targets of each row begin in that list.
            columns: (L,) of that list.
            changes: (L, 2, 4) of that list, changed in place.
        """
        parallel(_still, len(offsets) - 1, *self[:2], offsets, columns, changes, work=4 * len(columns))

    def among_mixed(self) -> np.ndarray:
        """Indices in the list of mixed targets of the targets that are beside a line and mixed."""
        return self.mixed[(self.columns >= 0) & (self.mixed >= 0)]


def nothing(height: int, kind: np.dtype) -> Crossings:
    """An empty list of targets, in `height` rows."""
    return _empty(np.zeros(height + 1, np.int64), kind)


def _empty(offsets: np.ndarray, kind: np.dtype) -> Crossings:
    """Lists for `offsets[-1]` targets, not yet filled; floats have the dtype `kind`."""
    count = offsets[-1]
    shapes = (count, 9, 3), (count, 2, 4), (count, 5)
    arrays = (np.empty(shape, kind) for shape in shapes)
    listed = np.empty(count, np.int32), np.empty(count, np.int64), np.empty((count, 9), np.uint8)
    return Crossings(offsets, *listed, *arrays)


def listed(grid: Grid, choices: Any, extent: np.floating, bits: np.ndarray, some: np.ndarray) -> Crossings:
    """The targets beside lines of crossing, and the terms of their derivatives.

    Args:
        grid: the samples.
        choices: see `rts_backends.fused.cells.Choices`.
        extent: largest less least depth of the fronts, the camera's 0 included.
        bits: (H, W), the pairs of `crossing_pairs.py`.
        some: (H,) bool, True for rows that have pairs.
    """
    positions, row = grid.positions, grid.row
    height, width = bits.shape
    kind, rules = positions.dtype, Rules.of(extent)
    rows = height + 2 * BORDER
    z, gap = np.empty((2, rows, width), kind), np.empty((rows, width + 2 * BORDER), kind)
    parallel(gather, rows, positions, row, some, z, gap, work=row[0].size)
    around, counts = np.zeros((height, width), np.uint16), np.zeros(height, np.int64)
    seen = row, choices.mixed, choices.offsets, choices.columns, choices.ranges, z, gap
    parallel(_list, height, bits, some, choices.states, *seen, rules, around, counts, work=row[0].size)
    result = _empty(np.concatenate([[0], np.cumsum(counts)]), kind)
    parallel(_fill, height, grid, *seen[1:], rules, around, result, work=1000 * len(result.columns))
    return result


@loop
def _still(start, stop, firsts, crossed, offsets, columns, changes):
    """`Crossings.still` of rows [start, stop)."""
    for y in range(start, stop):
        d = offsets[y]
        for i in range(firsts[y], firsts[y + 1]):
            while d < offsets[y + 1] and columns[d] < crossed[i]:
                d += 1
            if d < offsets[y + 1] and columns[d] == crossed[i]:
                changes[d, :, :] = 0


@loop
def _list(start, stop, bits, some, states, row, mixed, firsts, columns, ranges, z, gap, rules, around, counts):
    """Find targets beside lines in rows [start, stop).

    Fills `around` (H, W), zeros before, with bits 3 (v + 1) + (u + 1) of the steps (u, v) from a target to its
    partners. Adds to `counts` (H,), zeros before, the number of targets in each row. Left out are targets whose sources
    cannot all be sorted into two sheets, and those amid one colour, whose derivative is already that of a line.
    """
    height, width = bits.shape
    sheets, slopes = np.empty(9, np.uint8), np.empty(4, z.dtype)
    for y in range(start, stop):
        if not (some[max(y - 1, 0)] or some[y] or some[min(y + 1, height - 1)]):
            continue
        m = firsts[y]
        for x in range(width):
            partners = 0 if SETTLED <= states[y, x] < BUSY else steps(bits, y, x)
            if not partners:
                continue
            m = _place(columns, m, mixed, y, x)
            if _decide(sheets, slopes, row, mixed, ranges, m, z, gap, rules, partners, y, x):
                around[y, x] = partners
                counts[y] += 1


@compiled
def _place(columns, m, mixed, y, x):
    """The index of target (y, x) in the list of mixed targets, searched from m on, in its row; m if it is not mixed."""
    while mixed[y, x] and columns[m] < x:
        m += 1
    return m


@loop
def _fill(
    start,
    stop,
    grid,
    mixed,
    firsts,
    columns,
    ranges,
    z,
    gap,
    rules,
    around,
    result,
):
    """Fill the lists of `result`, whose `offsets` are known, for the targets of rows [start, stop) found by `_list`."""
    row = grid.row
    slopes = np.empty(4, grid.positions.dtype)
    for y in range(start, stop):
        d, m = result.offsets[y], firsts[y]
        for x in range(row.shape[2] if result.offsets[y + 1] > d else 0):
            if around[y, x]:
                m = _place(columns, m, mixed, y, x)
                result.mixed[d] = m if mixed[y, x] else -1
                _decide(result.sheets[d], slopes, row, mixed, ranges, m, z, gap, rules, around[y, x], y, x)
                _weigh(d, result, slopes, grid, y, x)
                d += 1


@compiled
def _decide(sheets, slopes, row, mixed, ranges, m, z, gap, rules, around, y, x):
    """Sort the sources of target (y, x) into `sheets` (9,), and fill the sheets' `slopes` (4,); True if both succeed.

    `around` are the bits of its partners, see `_list`; `m` is its index in the list of mixed targets, if it is mixed.
    """
    _sort(sheets, row, mixed[y, x], ranges, m, around, y, x)
    at = y + BORDER, x
    return _incline(slopes, sheets, z, gap, *at) and _complete(sheets, slopes, z, gap, rules.fit, *at)


@compiled
def _sort(sheets, row, mixed, ranges, m, around, y, x):
    """Sort sources into sheets: partners into b, others paired front to front into a, the rest into neither."""
    _, height, width = row.shape
    for n in range(9):
        py, px = y + 1 - n // 3, x + 1 - n % 3
        sheets[n] = NEITHER
        if around >> (8 - n) & 1:
            sheets[n] = SHEET_B
        elif 0 <= py < height and 0 <= px < width and row[0, py, px] >= 0:
            if not mixed or (ranges[m, n, 1, 0] == 0 and ranges[m, n, 1, 1] == 1):
                sheets[n] = SHEET_A


@compiled
def _incline(slopes, sheets, z, gap, y, x):
    """Fill the slopes (4,) of sheets a and b, each along x and y.

    Returns False if along one axis no neighbour is both sorted and has two layers.
    """
    for axis in range(2):
        # The sources ahead and behind.
        ahead, behind = (3, 5) if axis == 0 else (1, 7)
        u, v = 1 - axis, axis
        first, second = sheets[ahead] != NEITHER, sheets[behind] != NEITHER
        first, second = first and has_two(gap, y + v, x + u), second and has_two(gap, y - v, x - u)
        if not (first or second):
            return False
        for k in range(2):
            change, change_behind = slopes.dtype.type(0), slopes.dtype.type(0)
            if first:
                change = z[k ^ sheets[ahead], y + v, x + u] - z[k, y, x]
            if second:
                change_behind = -(z[k ^ sheets[behind], y - v, x - u] - z[k, y, x])
            both = (change + change_behind) / slopes.dtype.type(2)
            slopes[2 * k + axis] = both if first and second else change if first else change_behind
    return True


@compiled
def _complete(sheets, slopes, z, gap, fit, y, x):
    """Sort sources left in neither sheet, if they have two layers, by the sheets' planes through the target.

    Returns True if all get sorted; False also if the planes are parallel.
    """
    kind = slopes.dtype.type
    gx, gy = slopes[0] - slopes[2], slopes[1] - slopes[3]
    square = gx * gx + gy * gy
    if not square > 0:
        return False
    for n in range(9):
        if sheets[n] != NEITHER:
            continue
        u, v = 1 - n % 3, 1 - n // 3
        if not has_two(gap, y + v, x + u):
            return False
        near, far = z[0, y + v, x + u], z[1, y + v, x + u]
        a = z[0, y, x] + slopes[0] * kind(u) + slopes[1] * kind(v)
        b = z[1, y, x] + slopes[2] * kind(u) + slopes[3] * kind(v)
        straight, crossed = abs(a - near) + abs(b - far), abs(a - far) + abs(b - near)
        reach = np.sqrt(square) * kind(np.sqrt(u * u + v * v))
        if not min(straight, crossed) < fit * reach:
            return False
        sheets[n] = SHEET_A if straight <= crossed else SHEET_B
    return True


@compiled
def _weigh(d, result, slopes, grid, y, x):
    """Fill entry d of `result`, the terms of a target's derivative; its column becomes −1 if a sheet has no weight."""
    rgba, row, kind = grid.rgba, grid.row, grid.positions.dtype.type
    zero, one, slope = kind(0), kind(1), kind(2) * grid.scale * grid.gamma
    weights, colors, sheets = result.weights[d], result.colors[d], result.sheets[d]
    colors[:] = zero
    wa, wb, ax, ay, bx, by = zero, zero, zero, zero, zero, zero
    for n in range(9):
        v, u = n // 3 - 1, n % 3 - 1
        i = row[0, y - v, x - u]
        w, dx, dy = splat(grid, i, y - v, x - u, u, v)
        weights[n, 0], weights[n, 1], weights[n, 2] = w, slope * w * dx, slope * w * dy
        for c in range(4):
            colors[sheets[n], c] += w * rgba[i, c]
        if sheets[n] == SHEET_A:
            wa, ax, ay = wa + w, ax + weights[n, 1], ay + weights[n, 2]
        else:
            wb, bx, by = wb + w, bx + weights[n, 1], by + weights[n, 2]
    # Weights may vanish, of samples that are not where they were cast.
    result.columns[d] = x if wa > zero and wb > zero else -1
    if result.columns[d] < 0:
        return
    over = one / (wa + wb)
    for n in range(9):
        weights[n, 0] /= max(wa + wb, one)
        weights[n, 1], weights[n, 2] = over * weights[n, 1], over * weights[n, 2]
    for c in range(4):
        colors[SHEET_A, c] /= wa
        colors[SHEET_B, c] /= wb
    share = wb * over
    gx, gy = slopes[0] - slopes[2], slopes[1] - slopes[3]
    along = ((one - share) * bx - share * ax) * over * gx + ((one - share) * by - share * ay) * over * gy
    result.slopes[d, 0] = -along / (gx * gx + gy * gy)
    result.slopes[d, 1:] = slopes


@compiled
def rate(slopes, t_positions, i, j):
    """ġ, the rate of sheet a's depth less sheet b's at a target, along a tangent (N, 3) of positions.

    `slopes` (5,) are `Crossings.slopes` of the target; i and j are the samples of its first two layers.
    """
    a = t_positions[i, 2] - slopes[1] * t_positions[i, 0] - slopes[2] * t_positions[i, 1]
    return a - (t_positions[j, 2] - slopes[3] * t_positions[j, 0] - slopes[4] * t_positions[j, 1])


@compiled
def change_of(pixel, d, lines, grid, ranges, sums, y, t_positions, t_rgba):
    """Fill `pixel` (4,) with the derivative of listed target d along tangents (N, 3) and (N, 4); no rows mean zeros."""
    rgba, row, x, m = grid.rgba, grid.row, lines.columns[d], lines.mixed[d]
    colors, moves = lines.colors[d], pixel.dtype.type(0)
    if len(t_positions) > 0:
        moves = lines.slopes[d, 0] * rate(lines.slopes[d], t_positions, row[0, y, x], row[1, y, x])
    for c in range(4):
        pixel[c] = moves * (colors[SHEET_B, c] - colors[SHEET_A, c])
    for n in range(9 if len(t_positions) > 0 else 0):
        i, weights, own = row[0, y + 1 - n // 3, x + 1 - n % 3], lines.weights[d, n], colors[lines.sheets[d, n]]
        change = weights[1] * t_positions[i, 0] + weights[2] * t_positions[i, 1]
        for c in range(4):
            pixel[c] += change * (rgba[i, c] - own[c])
    if len(t_rgba) > 0 and m >= 0:
        tint_of(pixel, sums[m], grid, y, x, ranges[m], t_rgba)
    for n in range(9 if len(t_rgba) > 0 and m < 0 else 0):
        for c in range(4):
            pixel[c] += lines.weights[d, n, 0] * t_rgba[row[0, y + 1 - n // 3, x + 1 - n % 3], c]


@loop
def push(start, stop, grid, ranges, sums, lines, t_positions, t_rgba, border, out):
    """Write the derivatives of listed targets into rows [start, stop) of `out`, the tangents (T, H, W, 4)."""
    for y in range(start + border, stop + border):
        for d in range(lines.offsets[y], lines.offsets[y + 1]):
            x = lines.columns[d] - border
            if 0 <= x < out.shape[2]:
                for t in range(len(out)):
                    change_of(out[t, y - border, x], d, lines, grid, ranges, sums, y, t_positions[t], t_rgba[t])


@loop
def pull(rgba, row, lines, border, g, g_positions, g_rgba):
    """Add to the gradients of positions (N, 3) and rgba (N, 4), from the image's `g` (H, W, 4) at listed targets.

    `lines` are the `Crossings`. A gradient of no rows is not wanted. Mixed targets add nothing to that of rgba here.
    """
    zero = g.dtype.type(0)
    for y in range(border, len(g) + border):
        for d in range(lines.offsets[y], lines.offsets[y + 1]):
            x = lines.columns[d]
            if not 0 <= x - border < g.shape[1]:
                continue
            h, colors, moves = g[y - border, x - border], lines.colors[d], zero
            for c in range(4):
                moves += h[c] * (colors[SHEET_B, c] - colors[SHEET_A, c])
            moves *= lines.slopes[d, 0]
            if len(g_positions) > 0:
                for k, sign in ((0, moves), (1, -moves)):
                    i = row[k, y, x]
                    g_positions[i, 0] -= sign * lines.slopes[d, 1 + 2 * k]
                    g_positions[i, 1] -= sign * lines.slopes[d, 2 + 2 * k]
                    g_positions[i, 2] += sign
            for n in range(9):
                i, weights, own = row[0, y + 1 - n // 3, x + 1 - n % 3], lines.weights[d, n], colors[lines.sheets[d, n]]
                change = zero
                for c in range(4):
                    change += h[c] * (rgba[i, c] - own[c])
                if len(g_positions) > 0:
                    g_positions[i, 0] += weights[1] * change
                    g_positions[i, 1] += weights[2] * change
                for c in range(4 if len(g_rgba) > 0 and lines.mixed[d] < 0 else 0):
                    g_rgba[i, c] += weights[0] * h[c]
