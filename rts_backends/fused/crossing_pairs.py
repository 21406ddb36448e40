"""Pairs of cells between which a line of crossing runs: those of `rts.splatting.crossings`, compiled.

A quick test by vector instructions leaves few cells to look at: beside a line the gap between two layers is small, and
grows.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from rts.plugin_api.loops import compiled, loop
from rts.plugin_api.splats import Visible
from rts.plugin_api.threads import parallel, read_only

BORDER = 3
"""Rows added on each side of depths (2, ·, W), and rows and columns of gaps (·, ·).

Whether two neighbours form a pair depends on cells as far away as this. In windows, row 0 is the first added one."""
STEPS = np.array([(1, 0), (0, 1), (1, 1), (1, -1)])
"""Steps (x, y) from one cell of a pair to the other, for bits 0 to 3."""
CHUNK = 32
"""Cells that are skipped together."""
ROWS = 32
"""Rows that are searched together, few enough to stay in the processor's cache."""


class Rules(NamedTuple):
    """Limits of `rts.splatting.crossings`, in the dtype of the depths.

    Attributes:
        least: the least sum of the gaps of a pair.
        largest: its LARGEST.
        direct: its DIRECT.
        fit: its FIT.
        slack: allowance for rounding, a depth.
    """

    least: float
    largest: float
    direct: float
    fit: float
    slack: float

    @classmethod
    def of(cls, extent: Any) -> Rules:
        """The rules, in the dtype of `extent`: largest less least depth of the fronts, the camera's 0 included."""
        kind = type(extent)
        least, (*numbers, slack, _) = kind(Visible.TIE) * extent, Visible.CROSSINGS
        return cls(least, *map(kind, numbers), slack=kind(slack) * least)


def sheets(covered: np.ndarray, depth: np.ndarray, extent: np.floating, kept: np.ndarray) -> None:
    """Mark in `kept` (K, H, W) bool the samples that `rts.splatting.crossings.sheets` keeps; other marks stay.

    `covered` (K, H, W) bool and `depth` (K, H, W) have two layers at least. `extent` is the largest less the least
    depth of the fronts, the camera's 0 included.
    """
    _, height, width = covered.shape
    bits, some = _no_pairs(height, width)
    parallel(_find_candidates, height, covered, depth, Rules.of(extent), bits, some, work=3 * covered[0].size)
    if some.any():
        _keep(covered, bits, some, Visible.CROSSINGS[-1], kept)


def _no_pairs(height: int, width: int) -> tuple[np.ndarray, np.ndarray]:
    """Arrays to fill, without pairs so far: bits (H, W) as in `pairs`, and marks (H,) of rows that have some."""
    return np.zeros((height, width), np.uint8), np.zeros(height, np.bool_)


def pairs(positions: np.ndarray, row: np.ndarray, extent: np.floating) -> tuple[np.ndarray, np.ndarray]:
    """Bits (H, W) uint8 of pairs, each at its first cell, and marks (H,) of rows that have some.

    A pair is two neighbouring cells between which a line of crossing runs. Bit i at a cell: it forms one with the cell
    `STEPS[i]` farther on. Both arrays have no rows if there are no pairs.

    Args:
        positions: (N, 3).
        row: (K, H, W).
        extent: largest less least depth of the fronts, the camera's 0 included.
    """
    _, height, width = row.shape
    if len(row) > 1:
        bits, some = _no_pairs(height, width)
        parallel(find_in_cells, height, positions, row, Rules.of(extent), bits, some, work=3 * row[0].size)
        if some.any():
            return read_only(bits), some
    return nothing(width)


def nothing(width: int) -> tuple[np.ndarray, np.ndarray]:
    """The result of `pairs` if there are none."""
    return read_only(np.empty((0, width), np.uint8)), np.empty(0, np.bool_)


@loop
def gather(start, stop, positions, row, some, z, gap):
    """Fill those of the rows [start, stop) of depths and gaps that pairs depend on; others stay as they are.

    Args:
        start: first row, an index of z.
        stop: end of the rows.
        positions: (N, 3).
        row: (K, H, W).
        some: (H,), True for rows that have pairs.
        z: (2, H + 2 BORDER, W), to be filled with depths of the first two layers, where a cell has both.
        gap: (H + 2 BORDER, W + 2 BORDER), to be filled with the distance of these depths, or infinity.
    """
    height = len(some)
    for at in range(start, stop):
        y = at - BORDER
        if _any(some[max(y - BORDER, 0) : min(max(y + BORDER + 1, 0), height)]):
            gap[at] = np.inf
            if 0 <= y < height:
                _load_cells(z[:, at], gap[at], positions, row, y)


@loop
def find_in_cells(start, stop, positions, row, rules, bits, some):
    """Mark pairs whose first cell lies in rows [start, stop) in `bits` (H, W), and their rows in `some` (H,)."""
    _, height, width = row.shape
    z, gap, most = _window(width, positions.dtype)
    for top in range(start, stop, ROWS):
        bottom = min(top + ROWS, stop)
        there = False
        for at in range(bottom - top + 2 * BORDER):
            y = top - BORDER + at
            gap[at] = np.inf
            if 0 <= y < height:
                there |= _load_cells(z[:, at], gap[at], positions, row, y)
        if there:
            _find(top, bottom, z, gap, most, rules, False, bits, some)


@loop
def _find_candidates(start, stop, covered, depth, rules, bits, some):
    """Find possible pairs whose first cell lies in rows [start, stop), whichever hidden layers are left out later.

    Marks them as `find_in_cells` does.
    """
    _, height, width = covered.shape
    z, gap, most = _window(width, depth.dtype)
    for top in range(start, stop, ROWS):
        bottom = min(top + ROWS, stop)
        there = False
        for at in range(bottom - top + 2 * BORDER):
            y = top - BORDER + at
            gap[at] = np.inf
            if 0 <= y < height and _any(covered[1, y]):
                there = True
                _copy(z[0, at], depth[0, y])
                _copy(z[1, at], depth[1, y])
                _subtract(gap[at, BORDER:-BORDER], covered[0, y], covered[1, y], depth[0, y], depth[1, y])
        if there:
            _find(top, bottom, z, gap, most, rules, True, bits, some)


@compiled
def _window(width, kind):
    """Arrays, not yet filled, for a window of rows with its border: depths, gaps, and the largest gaps."""
    rows = ROWS + 2 * BORDER
    return np.empty((2, rows, width), kind), np.empty((rows, width + 2 * BORDER), kind), np.empty((rows, width), kind)


@compiled
def _load_cells(z, gap, positions, row, y):
    """Fill depths z (2, W) and gaps (W + 2 BORDER) of row y at its cells of two layers; return True if there are any.

    Other entries stay as they are; the gap of column x is at x + BORDER.
    """
    width, some = row.shape[2], False
    for left in range(0, width, CHUNK):
        right = min(left + CHUNK, width)
        last = row.dtype.type(-1)
        for x in range(left, right):
            last = max(last, row[1, y, x])
        if last < 0:
            continue
        for x in range(left, right):
            i, j = row[0, y, x], row[1, y, x]
            if j >= 0 and i >= 0:
                z[0, x], z[1, x] = positions[i, 2], positions[j, 2]
                gap[x + BORDER] = positions[j, 2] - positions[i, 2]
                some = True
    return some


@compiled
def _copy(to, given):
    # A loop, since for assigned arrays numba also compiles an error about their shapes, which takes a second.
    for x in range(len(to)):
        to[x] = given[x]


@compiled
def _subtract(gap, covered0, covered1, depth0, depth1):
    infinity = gap.dtype.type(np.inf)
    for x in range(len(gap)):
        gap[x] = depth1[x] - depth0[x] if covered0[x] & covered1[x] else infinity


@compiled
def _any(flags):
    # A loop, which becomes vector instructions; methods of arrays do not.
    largest = np.uint8(0)
    for flag in flags:
        largest = max(largest, np.uint8(flag))
    return largest > 0


@compiled
def _find(start, stop, z, gap, most, rules, candidates, bits, some):
    """Mark pairs, or `candidates`, whose first cell lies in rows [start, stop), in `bits`, and their rows in `some`.

    `z` and `gap` are a window that begins BORDER rows before `start`; `most` is working memory.
    """
    width = z.shape[2]
    rows, marks = stop - start + 2 * BORDER, np.empty(width, np.uint8)
    for y in range(BORDER - 2, rows - BORDER + 2):
        _largest(most[y], gap[y, BORDER - 1 :], gap[y, BORDER:], gap[y, BORDER + 1 :])
    for y in range(BORDER - 1, rows - BORDER + 1):
        _suspect(marks, gap[y, BORDER:], most[y - 1], most[y], most[y + 1])
        if not _any(marks):
            continue
        for left in range(0, width, CHUNK):
            right, suspected = min(left + CHUNK, width), np.uint8(0)
            for x in range(left, right):
                suspected |= marks[x]
            for x in range(left, right if suspected else left):
                if marks[x]:  # Few cells get so far: calls with arrays are dear.
                    _find_around(start, y, x, z, gap, rules, candidates, bits, some)


@compiled
def _find_around(start, y, x, z, gap, rules, candidates, bits, some):
    """Mark pairs, or `candidates`, of which one cell is (y, x) of a window that begins BORDER rows before `start`."""
    rows, width = z.shape[1:]
    for n in range(8):
        u, v = STEPS[n & 3, 0], STEPS[n & 3, 1]
        qy, qx = (y - v, x - u) if n > 3 else (y, x)
        at = qx + BORDER
        gaps = gap[qy - v, at - u], gap[qy, at], gap[qy + v, at + u], gap[qy + 2 * v, at + 2 * u]
        inside = BORDER <= qy < rows - BORDER and 0 <= qx < width
        if not _grows(*gaps, candidates) or not inside:
            continue
        if candidates:
            paired = _may_cross(z, gap, rules, qy, qx, v, u)
        else:
            paired = _crosses(z, gap, rules, qy, qx, v, u)
        if paired:
            bits[start + qy - BORDER, qx] |= np.uint8(1 << (n & 3))
            some[start + qy - BORDER] = True


@compiled
def _largest(most, before, here, after):
    """Fill `most` with the largest finite gap of each cell and its two neighbours in the row, or −1."""
    infinity, none = most.dtype.type(np.inf), most.dtype.type(-1)
    for x in range(len(most)):
        a, b, c = before[x], here[x], after[x]
        a, b, c = a if a < infinity else none, b if b < infinity else none, c if c < infinity else none
        a = b if b > a else a
        most[x] = c if c > a else a


@compiled
def _suspect(marks, gap, above, level, below):
    """Fill `marks` (W,): 1 at cells of two layers that have a much larger gap beside them, 0 at others.

    `gap` has the cells' own gaps; `above`, `level` and `below` (W,) are rows of `_largest`.

    At least one of the two cells of each pair is marked, whatever rounding does: with gaps h and t, and b and a beyond
    them, R is at least |b − 2 h − t| + |a − 2 t − h|, or twice one of these, and less than half of h + t.
    """
    infinity, times = gap.dtype.type(np.inf), gap.dtype.type(1.7)
    for x in range(len(marks)):
        a, b, c = above[x], level[x], below[x]
        a = b if b > a else a
        a = c if c > a else a
        marks[x] = np.uint8((gap[x] < infinity) & (a > times * gap[x]))


@compiled
def _crosses(z, gap, rules, y, x, v, u):
    """True if a line of crossing runs between cell (y, x) of a window and the one a step (u, v) farther on."""
    ratio = _ratio(z, gap, rules, y, x, v, u)
    if not ratio < rules.largest:
        return False
    return ratio < _ratio(z, gap, rules, y - v, x - u, v, u) and ratio <= _ratio(z, gap, rules, y + v, x + u, v, u)


@compiled
def _grows(b, h, t, a, candidates):
    """True if the gap grows beyond two cells as that of a pair must (see `_suspect`), rounding allowed for.

    h and t are the gaps of the two cells, b and a of those before and after. The gap must grow on both sides; of
    `candidates`, on one.
    """
    infinity, most = np.float32(np.inf), np.float32(0.52) * (h + t)
    before, after = abs(b - h - h - t), abs(a - t - t - h)
    # A missing gap is infinite, and the other side counts twice; if both are missing, sums are infinite or NaN.
    before, after = before if b < infinity else after, after if a < infinity else before
    if candidates:
        before = after = min(before, after)
    return (before + after < most) & (most < infinity)


@compiled
def has_two(gap, y, x):
    """True if cell (y, x) has two layers; `gap` has a border of columns."""
    return gap[y, x + BORDER] < np.inf


@compiled
def _ratio(z, gap, rules, y, x, v, u):
    """R / (h(q) + h(p)) of cell q = (y, x) and the cell p a step (u, v) farther on, see `rts.splatting.crossings`.

    Infinity where R is unknown, the gaps are too small, or R is not below its share of D.
    """
    two = gap.dtype.type(2)
    total, before, after, change0, change1, direct0, direct1 = _step(z, gap, y, x, v, u)
    change = change0 + change1 if before and after else two * min(change0, change1)
    direct = direct0 + direct1 if before and after else two * min(direct0, direct1)
    known = (before or after) and total > rules.least and change < rules.direct * direct
    return change / total if known else gap.dtype.type(np.inf)


@compiled
def _may_cross(z, gap, rules, y, x, v, u):
    """True if cell (y, x) and the one a step (u, v) farther on may form a pair.

    So it may be whichever of the cells beyond the two have two layers in the end.
    """
    two = gap.dtype.type(2)
    total, before, after, change0, change1, direct0, direct1 = _step(z, gap, y, x, v, u)
    if not total > rules.least - rules.slack:
        return False
    return (
        (before and _is_small(two * change0, two * direct0, total, rules))
        or (after and _is_small(two * change1, two * direct1, total, rules))
        or (before and after and _is_small(change0 + change1, direct0 + direct1, total, rules))
    )


@compiled
def _is_small(change, direct, total, rules):
    return change < rules.direct * direct + rules.slack and change < rules.largest * total + rules.slack


@compiled
def _step(z, gap, y, x, v, u):
    """The terms of R and D (see `rts.splatting.crossings`) of a cell q and the cell p a step (u, v) farther on.

    Returns:
        h(q) + h(p); whether the cell before q, and the one after p, count; the shares of q and p in R, and in D. A cell
        counts if it, q and p have two layers; a share is infinite if the cell does not count.
    """
    infinity, two = gap.dtype.type(np.inf), gap.dtype.type(2)
    here = has_two(gap, y, x) and has_two(gap, y + v, x + u)
    before, after = here and has_two(gap, y - v, x - u), here and has_two(gap, y + 2 * v, x + 2 * u)
    total = gap[y, x + BORDER] + gap[y + v, x + u + BORDER]
    change0, change1, direct0, direct1 = infinity, infinity, infinity, infinity
    if before:
        q0, q1, p0, p1 = z[0, y, x], z[1, y, x], z[0, y + v, x + u], z[1, y + v, x + u]
        b0, b1 = z[0, y - v, x - u], z[1, y - v, x - u]
        change0 = abs(b0 - two * q0 + p1) + abs(b1 - two * q1 + p0)
        direct0 = abs(b0 - two * q0 + p0) + abs(b1 - two * q1 + p1)
    if after:
        q0, q1, p0, p1 = z[0, y, x], z[1, y, x], z[0, y + v, x + u], z[1, y + v, x + u]
        f0, f1 = z[0, y + 2 * v, x + 2 * u], z[1, y + 2 * v, x + 2 * u]
        change1 = abs(f0 - two * p0 + q1) + abs(f1 - two * p1 + q0)
        direct1 = abs(f0 - two * p0 + q0) + abs(f1 - two * p1 + q1)
    return total, before, after, change0, change1, direct0, direct1


@compiled
def steps(bits, y, x):
    """Bits 3 (v + 1) + (u + 1) of the steps (u, v) from a cell to its partners in pairs."""
    height, directions = len(bits), 0
    for i in range(4):
        u, v = STEPS[i, 0], STEPS[i, 1]
        if bits[y, x] >> i & 1:
            directions |= 1 << (3 * (v + 1) + u + 1)
        if 0 <= y - v < height and 0 <= x - u and bits[y - v, x - u] >> i & 1:
            directions |= 1 << (3 * (1 - v) + 1 - u)
    return directions


@loop
def _keep(covered, bits, some, reach, kept):
    """Mark in `kept` the samples of the first two layers that are at most `reach` rows and columns from a pair."""
    _, height, width = covered.shape
    for y in range(height):
        for x in range(width if some[y] else 0):
            for i in range(4 if bits[y, x] else 0):
                if bits[y, x] >> i & 1:
                    _keep_around(kept, covered, y, x, reach)
                    _keep_around(kept, covered, y + STEPS[i, 1], x + STEPS[i, 0], reach)


@compiled
def _keep_around(kept, covered, y, x, reach):
    for k in range(2):
        for v in range(max(y - reach, 0), min(y + reach + 1, kept.shape[1])):
            for u in range(max(x - reach, 0), min(x + reach + 1, kept.shape[2])):
                kept[k, v, u] |= covered[k, v, u]
