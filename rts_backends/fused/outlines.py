"""Derivatives of the compiled `Visible` by moving outlines; these move as `rts.splatting.rims` says.

Let v̂ be the motion of the outline beside a cell, and v that of its front. A source of weight w adds to a target's
derivative ∂w · (v̂ − v), times the change of the target's colour with the coverage of one buffer (in front, or at the
surface), if the buffer covers the target in part. Gradients add up in one order: every other band of rows first, then
those between.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rts.plugin_api.loops import compiled, loop
from rts.plugin_api.threads import parallel
from rts_backends.fused.crossing_pairs import steps
from rts_backends.fused.pairs import BLOCK
from rts_backends.fused.rows import exp
from rts_backends.fused.uniform_cells import LISTED

BAND = 16
"""Rows whose gradients one thread adds up: more than the distance of any two samples that one target refers to."""

NOTHING, FRONT, JOINED, SURFACE = 0, 1, 2, 3
"""The coverage that a source gives to a target.

NOTHING: none. FRONT: that of the buffer in front, moving with the source's outline. JOINED: that of the surface,
moving with the target's outline. SURFACE: that of the surface, over nothing or another part, moving with the
source's outline."""

NEAR = 1e-3
"""Exponents below which four terms of its series give the exponential in double precision."""


class Rules(NamedTuple):
    """Limits of `rts.splatting.rims`, in the dtype of the positions: its LEAST, LARGEST, FLAT, CONVERGING and HALF."""

    least: float
    largest: float
    flat: float
    converging: float
    half: float


class Outlines(NamedTuple):
    """Motions of outlines, and the targets that they cover in part.

    Attributes:
        beta: (H, W), β at covered targets of the lists below, and at those marked `BESIDE`; not filled elsewhere. The
            outline moves by v̂ = v + β (v − the motion of the partner's sample).
        partner: (H, W) int32, the partner's sample, an index of positions, where β is not 0.
        second: (1, H, W) int32, where β is −1 a second partner: the mean of both motions counts; or no entries.
        offsets: (H + 1,) int64, where the targets of each row begin in the lists below.
        columns: (M,) int32, the targets' columns.
        gives: (M, 9) uint8, the coverage from each source, NOTHING to SURFACE; source 3 (v + 1) + (u + 1) lies at −(u,
            v).
        slopes: (M, 9, 2), derivatives of these sources' weights with their position.
        changes: (M, 2, 4), derivatives of the target's colour with coverage in front, and at the surface.
    """

    beta: np.ndarray
    partner: np.ndarray
    second: np.ndarray
    offsets: np.ndarray
    columns: np.ndarray
    gives: np.ndarray
    slopes: np.ndarray
    changes: np.ndarray


DIRECTIONS = LISTED - 1
"""Mask of bits 3 (v + 1) + (u + 1), of directions (u, v) in which a front ends, in the `ends` of `survey`."""

BESIDE = LISTED << 1
"""Mark in `ends` of targets that are not LISTED, but whose outline affects LISTED ones beside them."""


def _ordered(bits: int) -> list[int]:
    """Nine numbers: directions whose opposite is not among the bits, the most outward first, then −1."""
    steps = {n: np.array([n % 3 - 1, n // 3 - 1]) for n in range(9) if bits >> n & 1}
    outward = sum(steps.values(), np.zeros(2, int))

    def score(n: int) -> int:
        """A whole number that orders directions n as n · outward / ‖n‖ does."""
        along = int(steps[n] @ outward)
        return along * abs(along) * (3 - int(abs(steps[n]).sum()))

    directions = sorted((n for n in steps if not bits >> (8 - n) & 1), key=score, reverse=True)
    return directions + [-1] * (9 - len(directions))


OUTWARD = np.array([_ordered(bits) for bits in range(LISTED)], np.int8)
"""The order (512, 9) in which directions are tried, by the bits of those in which a front ends."""


@loop
def narrow(start, stop, ends, wanted, kept, counts):
    """Copy `ends` to `kept` in rows [start, stop), without LISTED at targets that are not wanted.

    A target that loses LISTED gets BESIDE instead if it lies beside a wanted target that is LISTED.

    Args:
        start: first row.
        stop: end of the rows.
        ends: (H, W) of `uniform_cells.survey` and `layer_pairing.choose`.
        wanted: (H, W) uint8, not 0 for targets whose colour is wanted.
        kept: (H, W) uint16, to be filled.
        counts: (H,), to be filled with the number of targets in each row that are still LISTED.
    """
    height, width = ends.shape
    for y in range(start, stop):
        counts[y] = 0
        for x in range(width):
            bits = ends[y, x]
            if bits & LISTED and not wanted[y, x]:
                bits = bits & DIRECTIONS | _beside(ends, wanted, y, x)
            kept[y, x] = bits
            counts[y] += bits & LISTED != 0


@compiled
def _beside(ends, wanted, y, x):
    """BESIDE if a target is beside a wanted, listed one; 0 otherwise."""
    height, width = ends.shape
    for n in range(9):
        v, u = y + n // 3 - 1, x + n % 3 - 1
        if 0 <= v < height and 0 <= u < width and ends[v, u] & LISTED and wanted[v, u]:
            return BESIDE
    return 0


# Each call of a helper with branches counts references to its arrays. So the work for each direction of a cell is
# written out where the arrays are.


@compiled
def _rule(positions, row, part, one_part, exits, ends, y, x, extent, rules):
    """β and the partner's sample (see `Outlines`) of a covered cell (y, x) whose front ends in some direction.

    (0, −1) if no rule holds; β is −1 if `exits` name two samples. For the arguments see `fill`.
    """
    layers, height, width = row.shape
    zero, one, two = positions.dtype.type(0), positions.dtype.type(1), positions.dtype.type(2)
    bits, front = ends[y, x] & DIRECTIONS, positions[row[0, y, x], 2]
    if len(exits) > 1 and exits[1, y, x] >= 0:
        return -positions.dtype.type(1), exits[0, y, x]
    leaves = len(exits) > 0 and exits[0, y, x] >= 0
    # The other end of the chord, if any: where the ray leaves, or a second layer of the front's part.
    second = min(1, layers - 1)
    back = exits[0, y, x] if leaves else row[second, y, x]
    same = layers > 1 if one_part else len(part) > 1 and part[0, y, x] == part[1, y, x]
    own, m = positions[back, 2] - front, 0
    while back >= 0 and (leaves or same) and OUTWARD[bits, m] >= 0:
        py, px = y + 1 - OUTWARD[bits, m] // 3, x + 1 - OUTWARD[bits, m] % 3
        j = -1
        if 0 <= py < height and 0 <= px < width and row[0, py, px] >= 0:
            j = exits[0, py, px] if leaves else row[second, py, px]
            if leaves and len(exits) > 1 and exits[1, py, px] >= 0:
                j = -1
        inner = positions[j, 2] - positions[row[0, py, px], 2] if j >= 0 else zero
        if j >= 0 and rules.converging * own * own <= inner * inner:
            return -rules.half, back
        m += 1
    beta, partner = zero, np.int32(-1)
    for m in range(9):
        n = OUTWARD[bits, m]
        if n < 0:
            break
        v, u = n // 3 - 1, n % 3 - 1
        py, px, qy, qx = y - v, x - u, y - 2 * v, x - 2 * u
        if not (0 <= py < height and 0 <= px < width and row[0, py, px] >= 0):
            continue
        if partner < 0:
            beta, partner = rules.half, row[0, py, px]
        # If the surface ends in this direction, or does not fall, try the next.
        if not (0 <= qy < height and 0 <= qx < width and row[0, qy, qx] >= 0) or ends[py, px] >> (4 - 3 * v - u) & 1:
            continue
        middle = positions[row[0, py, px], 2]
        slope = middle - positions[row[0, qy, qx], 2]
        if slope > rules.flat * extent:
            ratio = (front - middle) / slope
            if ratio > rules.least:
                root = (one + two * ratio - ratio * ratio) / (two * ratio * (ratio - one))
                return min(max(root, zero), rules.largest), row[0, py, px]
    return beta, partner


@loop
def fill(
    start,
    stop,
    grid,
    part,
    one_part,
    exits,
    extent,
    rules,
    crossed,
    mixed,
    firsts,
    ranges,
    sums,
    ends,
    result,
):
    """Find the motions of outlines in rows [start, stop), as `rts.splatting.rims.rules` does; list LISTED targets.

    Args:
        start: first row.
        stop: end of the rows.
        grid: the samples.
        part: (K, H, W), the part of each sample, or no layers.
        one_part: True if all samples are of one part.
        exits: (E, H, W), see `rts.plugin_api.records.Cells`.
        extent: largest less least depth of the fronts, the camera's 0 included.
        rules: limits of the rules.
        crossed: (H, W) uint8, the pairs of `crossing_pairs.py`, or no rows.
        mixed: (M,), columns of the mixed targets; see `rts_backends.fused.cells.Choices`, also for the next three.
        firsts: (H + 1,), where the mixed targets of each row begin.
        ranges: (M, 9, 3, 2).
        sums: (M, 3, 5).
        ends: (H, W) of `uniform_cells.survey` and `layer_pairing.choose`, or of `narrow`.
        result: `Outlines`, to be filled but for `offsets` and `second`.
    """
    beta, partner, _, offsets, columns, gives, slopes, changes = result
    positions, row, peak = grid.positions, grid.row, grid.peak
    kind, width = positions.dtype.type, ends.shape[1]
    around, which, samples = np.empty((9, 3), positions.dtype), np.empty(9, np.int64), np.empty(9, np.int64)
    for n in range(9):
        u, v = kind(n % 3 - 1), kind(n // 3 - 1)
        around[n, 0], around[n, 1], around[n, 2] = u, v, peak * peak * exp(-(u * u + v * v) * grid.scale)
    for y in range(start, stop):
        d, m = offsets[y], firsts[y]
        for b in range((width + BLOCK - 1) // BLOCK):
            first, last = b * BLOCK, min((b + 1) * BLOCK, width)
            if not _any(ends[y, first:last]):
                continue
            for x in range(first, last):
                if ends[y, x] <= DIRECTIONS:
                    continue
                covered = row[0, y, x] >= 0
                if covered:
                    beta[y, x] = positions.dtype.type(0)
                if covered and ends[y, x] & DIRECTIONS:
                    rule = _rule(positions, row, part, one_part, exits, ends, y, x, extent, rules)
                    beta[y, x], partner[y, x] = rule
                if not ends[y, x] & LISTED:
                    continue
                columns[d] = x
                while m < firsts[y + 1] and mixed[m] < x:
                    m += 1
                own = _weigh(gives, slopes, d, grid, y, x, around, which, samples)
                if m < firsts[y + 1] and mixed[m] == x:
                    front, surface = _change_mixed(changes, d, sums, m)
                    _list(gives, d, ranges, m, front, surface)
                else:
                    _change(gives, changes, d, own)
                if covered and len(part) and not (len(crossed) and steps(crossed, y, x)):
                    _part(gives, d, part, ends, y, x)
                d += 1


@compiled
def _any(ends):
    some = np.uint16(0)
    for x in range(len(ends)):
        some |= ends[x]
    return some != 0


# Takes whole arrays: views of single targets take as long to make as the work itself.


@compiled
def _weigh(gives, slopes, d, grid, y, x, around, which, samples):
    """Fill `gives` of target d, as if it were not mixed, and `slopes` of the weights of the fronts around it.

    `slopes` of sources without a front stay as they are. `around` (9, 3) are u, v and the weight of sources whose
    samples lie on their cells' centres; `which` and `samples` (9,) are working memory.

    Returns the sums of the fronts' weighted colours (four numbers), and of their weights.
    """
    positions, rgba, row, scale, _, gamma = grid
    _, height, width = row.shape
    kind, count, n = positions.dtype.type, 0, 0
    for v in range(-1, 2):
        for u in range(-1, 2):
            py, px = y - v, x - u
            i = row[0, py, px] if 0 <= py < height and 0 <= px < width else -1
            gives[d, n], which[count], samples[count] = NOTHING, n, i
            count += i >= 0
            n += 1
    zero, half, slope, peak = kind(0), kind(0.5), kind(2) * scale * gamma, around[4, 2]
    red, green, blue, alpha, weight, given = zero, zero, zero, zero, zero, JOINED if row[0, y, x] >= 0 else SURFACE
    for k in range(count):
        n, i = which[k], samples[k]
        u, v, w = around[n, 0], around[n, 1], around[n, 2]
        rx, ry = gamma * (positions[i, 0] - (kind(x) + half - u)), gamma * (positions[i, 1] - (kind(y) + half - v))
        dx, dy = u - rx, v - ry
        more = scale * ((u + dx) * rx + (v + dy) * ry)
        if abs(more) < NEAR:
            w *= kind(1) + more + more * more * (half + more * kind(1 / 6) + more * more * kind(1 / 24))
        else:
            w = peak * exp(-(dx * dx + dy * dy) * scale)
        gives[d, n], slopes[d, n, 0], slopes[d, n, 1] = given, slope * w * dx, slope * w * dy
        red, green, blue = red + w * rgba[i, 0], green + w * rgba[i, 1], blue + w * rgba[i, 2]
        alpha, weight = alpha + w * rgba[i, 3], weight + w
    return red, green, blue, alpha, weight


@compiled
def _change(gives, changes, d, total):
    """Fill `changes` (2, 4) of target d, which is not mixed: all fronts around it add to one coverage, at the surface.

    `total` are the sums of `_weigh`. A target that is not covered in part gets zeros, and its `gives` become NOTHING.
    """
    zero, one = changes.dtype.type(0), changes.dtype.type(1)
    partial = zero < total[4] < one
    over = one / total[4] if partial else zero
    for c in range(4):
        changes[d, 0, c], changes[d, 1, c] = zero, over * total[c]
    if not partial:
        _clear(gives, d)


@compiled
def _clear(gives, d):
    for n in range(9):
        gives[d, n] = NOTHING


@compiled
def _change_mixed(changes, d, sums, m):
    """Fill `changes` (2, 4) of target d, the m-th mixed one: derivatives of its colour with its buffers' coverage.

    They are zeros for a buffer that does not cover it in part. Returns two marks: True if the buffer in front, and the
    one at the surface, cover the target in part.
    """
    zero, one = sums.dtype.type(0), sums.dtype.type(1)
    front, surface = zero < sums[m, 0, 4] < one, zero < sums[m, 1, 4] < one
    over = one / sums[m, 0, 4] if front else zero
    through = (one - sums[m, 0, 3]) / sums[m, 1, 4] if surface else zero
    for c in range(4):
        under = sums[m, 1, c] + (one - sums[m, 1, 3]) * sums[m, 2, c]
        changes[d, 0, c] = over * (sums[m, 0, c] - sums[m, 0, 3] * under)
        changes[d, 1, c] = through * (sums[m, 1, c] - sums[m, 1, 3] * sums[m, 2, c])
    return front, surface


@compiled(inline="always")
def _list(gives, d, ranges, m, front, surface):
    """Correct `gives` of target d, the m-th mixed one, whose buffers cover it in part as `front` and `surface` say.

    Before, `gives` is as `_weigh` fills it: NOTHING only for sources without a front. Sources whose front is in the
    buffer in front become FRONT, if that covers in part. Those whose front changes no such coverage become NOTHING.
    """
    for n in range(9):
        if gives[d, n] != NOTHING:
            if front and ranges[m, n, 0, 1] == 1:
                gives[d, n] = FRONT
            elif not (surface and ranges[m, n, 1, 0] == 0 and ranges[m, n, 1, 1] == 1):
                gives[d, n] = NOTHING


@compiled
def _part(gives, d, part, ends, y, x):
    """Have JOINED sources of other parts than the target's move as their own outlines: a gap may lie between.

    In `gives` they become SURFACE, or NOTHING without an outline of their own.
    """
    n = 0
    for v in range(-1, 2):
        for u in range(-1, 2):
            if gives[d, n] == JOINED and part[0, y - v, x - u] != part[0, y, x]:
                gives[d, n] = SURFACE if ends[y - v, x - u] & DIRECTIONS else NOTHING
            n += 1


@compiled
def _outline(t_positions, row, beta, partner, second, y, x, axis):
    """The motion v̂ of the outline beside a cell along an axis, 0 or 1, if samples move as `t_positions` (N, 3)."""
    b, own = beta[y, x], t_positions[row[0, y, x], axis]
    if b == 0:
        return own
    other = t_positions[partner[y, x], axis]
    if b == -1:
        other = (other + t_positions[second[0, y, x], axis]) / 2
    return own + b * (own - other)


@compiled
def gain(d, t_positions, row, outlines, y):
    """The growth of target d's coverage by moving outlines along a tangent (N, 3): in front, and at the surface."""
    front, surface = outlines.slopes.dtype.type(0), outlines.slopes.dtype.type(0)
    x, rule = outlines.columns[d], (outlines.beta, outlines.partner, outlines.second)
    for n in range(9):
        kind = outlines.gives[d, n]
        if kind == NOTHING:
            continue
        v, u = n // 3 - 1, n % 3 - 1
        i, qy, qx = row[0, y - v, x - u], y - v, x - u
        if kind == JOINED:
            qy, qx = y, x
        along = outlines.slopes[d, n, 0] * (_outline(t_positions, row, *rule, qy, qx, 0) - t_positions[i, 0])
        along += outlines.slopes[d, n, 1] * (_outline(t_positions, row, *rule, qy, qx, 1) - t_positions[i, 1])
        if kind == FRONT:
            front += along
        else:
            surface += along
    return front, surface


@loop
def push(start, stop, row, outlines, t_positions, border, out):
    """Add the changes by moving outlines to rows [start, stop) of the tangents (T, H, W, 4)."""
    for y in range(start + border, stop + border):
        for d in range(outlines.offsets[y], outlines.offsets[y + 1]):
            x = outlines.columns[d] - border
            if not 0 <= x < out.shape[2]:
                continue
            for t in range(len(out)):
                front, surface = gain(d, t_positions[t], row, outlines, y)
                for c in range(4):
                    change = front * outlines.changes[d, 0, c] + surface * outlines.changes[d, 1, c]
                    out[t, y - border, x, c] += change


def pull(row: np.ndarray, outlines: Outlines, border: int, g: np.ndarray, g_positions: np.ndarray) -> None:
    """Add outlines' shares to the gradients of positions (N, 3), `g_positions`, from the image's `g` (H, W, 4)."""
    bands = -(-len(g) // BAND)
    for first in range(2):
        given = row, outlines, border, g, first, g_positions
        parallel(_pull, (bands + 1 - first) // 2, *given, work=20 * len(outlines.columns))


@loop
def _pull(start, stop, row, outlines, border, g, first, g_positions):
    """`pull` of every other band of rows, from band `first` on: such bands share no sample."""
    beta, partner, second, offsets, columns, gives, slopes, changes = outlines
    arrays = beta, partner, second, offsets, columns, gives, slopes, changes
    for band in range(start, stop):
        top = (2 * band + first) * BAND
        _pull_rows(border + top, border + min(top + BAND, len(g)), row, *arrays, border, g, g_positions)


@compiled
def _pull_rows(
    top, bottom, row, beta, partner, second, offsets, columns, gives, slopes, changes, border, g, g_positions
):
    """`pull` of the targets of rows [top, bottom) of the cells."""
    width, zero = g.shape[1], g_positions.dtype.type(0)
    for y in range(top, bottom):
        for d in range(offsets[y], offsets[y + 1]):
            x = columns[d]
            if not 0 <= x - border < width:
                continue
            front, surface = zero, zero
            for c in range(4):
                front += g[y - border, x - border, c] * changes[d, 0, c]
                surface += g[y - border, x - border, c] * changes[d, 1, c]
            if front != zero or surface != zero:
                _pull_target(g_positions, row, beta, partner, second, gives, slopes, d, y, x, front, surface)


@compiled
def _pull_target(g_positions, row, beta, partner, second, gives, slopes, d, y, x, front, surface):
    """`pull` of target d, from the gradients `front` and `surface` of its buffers' coverage."""
    zero = g_positions.dtype.type(0)
    joined_x, joined_y = zero, zero
    for n in range(9):
        kind, py, px = gives[d, n], y + 1 - n // 3, x + 1 - n % 3
        if kind == NOTHING:
            continue
        h = front if kind == FRONT else surface
        h_x, h_y = h * slopes[d, n, 0], h * slopes[d, n, 1]
        if kind == JOINED:
            i = row[0, py, px]
            g_positions[i, 0] -= h_x
            g_positions[i, 1] -= h_y
            joined_x, joined_y = joined_x + h_x, joined_y + h_y
        else:
            _lead(g_positions, row, beta, partner, second, py, px, h_x, h_y)
    if joined_x != zero or joined_y != zero:
        i = row[0, y, x]
        g_positions[i, 0] += joined_x
        g_positions[i, 1] += joined_y
        _lead(g_positions, row, beta, partner, second, y, x, joined_x, joined_y)


@compiled(inline="always")
def _lead(g_positions, row, beta, partner, second, y, x, g_x, g_y):
    """Add the gradient of v̂ − v, an outline's motion less its front's, to the front's sample and its partners."""
    b = beta[y, x]
    if b != 0:
        i, j = row[0, y, x], partner[y, x]
        g_positions[i, 0] += b * g_x
        g_positions[i, 1] += b * g_y
        if b == -1:
            k, b = second[0, y, x], b / 2
            g_positions[k, 0] -= b * g_x
            g_positions[k, 1] -= b * g_y
        g_positions[j, 0] -= b * g_x
        g_positions[j, 1] -= b * g_y
