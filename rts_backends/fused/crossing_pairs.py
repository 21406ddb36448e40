"""Between which cells lines run where surfaces cross: the pairs of `rts.splatting.crossings`, compiled.

They are found by a test that vector instructions do and that few other cells pass: on either side of a line the gap
between two layers grows.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from rts.compiling import compiled, kernel
from rts.splatting import crossings as specification
from rts.splatting.kernel import TIE
from rts.threads import parallel

BORDER = 3
"""Rows around those of arrays of depths (2, ·, W), and rows and columns around those of their gaps (·, ·): so far from
a cell are those that decide whether it is in a pair with a neighbour. Rows y below count from the first of all."""
STEPS = ((1, 0), (0, 1), (1, 1), (1, -1))
"""Steps (x, y) from one cell of each pair to the other, which bits 0 to 3 stand for."""
CHUNK, FEW = 16, 8
"""Cells that are passed over at once; and the share of a row's cells, 1 / FEW, that are looked at one by one."""
ROWS = 32
"""That are looked at together, so that they stay near the processor."""


class Rules(NamedTuple):
    """Numbers of `rts.splatting.crossings`, in the dtype of the depths."""

    least: float
    largest: float
    direct: float
    fit: float

    @classmethod
    def of(cls, extent: Any) -> Rules:
        """For depths of an extent, the camera's included, in their dtype."""
        kind = type(extent)
        numbers = specification.LARGEST, specification.DIRECT, specification.FIT
        return cls(kind(TIE) * extent, *map(kind, numbers))


def sheets(covered: np.ndarray, depth: np.ndarray, extent: np.floating, kept: np.ndarray) -> None:
    """Mark in `kept` (K, H, W) what `rts.splatting.crossings.sheets` keeps."""
    _, height, width = covered.shape
    bits, some = no_pairs(height, width)
    parallel(_find_in_depths, height, covered, depth, Rules.of(extent), bits, some, work=covered[0].size)
    if some.any():
        _keep(covered, bits, some, specification.KEPT, kept)


def no_pairs(height: int, width: int) -> tuple[np.ndarray, np.ndarray]:
    """No pairs: bits (H, W) of the steps from each cell to the other of a pair, and whether there are any in a row."""
    return np.zeros((height, width), np.uint8), np.zeros(height, np.bool_)


@kernel
def gather(start, stop, positions, row, z, gap):
    """Depths of the first two layers of rows [start, stop), where there are both, and the gaps between them."""
    columns = np.empty(row.shape[2], np.int32)
    for y in range(start, stop):
        _load_cells(z[:, y + BORDER], gap[y + BORDER], columns, positions, row, y)


@kernel
def find_in_cells(start, stop, positions, row, rules, bits, some):
    """Find pairs whose first cell lies in rows [start, stop)."""
    _, height, width = row.shape
    z, gap, counts = _window(width, positions.dtype)
    columns = np.empty((len(gap), width), np.int32)
    for top in range(start, stop, ROWS):
        bottom = min(top + ROWS, stop)
        gap[:] = np.inf
        counts[:] = 0
        for y in range(max(top - BORDER, 0), min(bottom + BORDER, height)):
            at = y - top + BORDER
            counts[at] = _load_cells(z[:, at], gap[at], columns[at], positions, row, y)
        _find(top, bottom, z, gap, counts, columns, rules, bits, some)


@kernel
def _find_in_depths(start, stop, covered, depth, rules, bits, some):
    """Find pairs whose first cell lies in rows [start, stop)."""
    _, height, width = covered.shape
    z, gap, counts = _window(width, depth.dtype)
    columns = np.empty((len(gap), 0), np.int32)
    for top in range(start, stop, ROWS):
        bottom = min(top + ROWS, stop)
        gap[:] = np.inf
        counts[:] = 0
        for y in range(max(top - BORDER, 0), min(bottom + BORDER, height)):
            at = y - top + BORDER
            if _any(covered[1, y]):
                counts[at] = width
                z[0, at], z[1, at] = depth[0, y], depth[1, y]
                _subtract(gap[at, BORDER:-BORDER], covered[0, y], covered[1, y], depth[0, y], depth[1, y])
        _find(top, bottom, z, gap, counts, columns, rules, bits, some)


@compiled
def _window(width, kind):
    """Arrays of depths and gaps for some rows and those around them, and for how many cells of each have two layers."""
    rows = ROWS + 2 * BORDER
    return np.empty((2, rows, width), kind), np.empty((rows, width + 2 * BORDER), kind), np.empty(rows, np.int64)


@compiled
def _load_cells(z, gap, columns, positions, row, y):
    """Fill depths (2, W) of a row, gaps and columns of its cells of two layers; returns how many there are."""
    width, count = row.shape[2], 0
    for left in range(0, width, CHUNK):
        right = min(left + CHUNK, width)
        if not _some(row[1, y, left:right]):
            continue
        for x in range(left, right):
            i, j = row[0, y, x], row[1, y, x]
            if j >= 0 and i >= 0:
                z[0, x], z[1, x] = positions[i, 2], positions[j, 2]
                gap[x + BORDER] = positions[j, 2] - positions[i, 2]
                columns[count] = x
                count += 1
    return count


@compiled
def _subtract(gap, covered0, covered1, depth0, depth1):
    infinity = gap.dtype.type(np.inf)
    for x in range(len(gap)):
        gap[x] = depth1[x] - depth0[x] if covered0[x] & covered1[x] else infinity


# Loops that the compiler makes vector instructions of, as it does not of methods of arrays.


@compiled
def _any(flags):
    most = np.uint8(0)
    for flag in flags:
        most = max(most, np.uint8(flag))
    return most > 0


@compiled
def _some(cells):
    most = cells.dtype.type(-1)
    for i in cells:
        most = max(most, i)
    return most >= 0


@compiled
def _find(start, stop, z, gap, counts, columns, rules, bits, some):
    """Find pairs in a window of rows, of which each has so many cells of two layers; the columns of these, if few."""
    width = z.shape[2]
    marks = np.empty(width, np.uint8)
    for y in range(BORDER, stop - start + BORDER):
        if counts[y] == 0:
            continue
        for i in range(4):
            u, v = STEPS[i]
            before, here = gap[y - v, BORDER - u :], gap[y, BORDER:]
            there, after = gap[y + v, BORDER + u :], gap[y + 2 * v, BORDER + 2 * u :]
            if FEW * counts[y] < width:
                for n in range(counts[y]):
                    x = columns[y, n]
                    if _grows(before[x], here[x], there[x], after[x]) and _crosses(z, gap, rules, y, x, v, u):
                        bits[start + y - BORDER, x] |= np.uint8(1 << i)
                        some[start + y - BORDER] = True
                continue
            _suspect(marks, before, here, there, after)
            if not _any(marks):
                continue
            for x in range(width):
                if marks[x] and _crosses(z, gap, rules, y, x, v, u):
                    bits[start + y - BORDER, x] |= np.uint8(1 << i)
                    some[start + y - BORDER] = True


@compiled
def _suspect(marks, before, here, there, after):
    """Mark cells where the gap grows on both sides of a pair."""
    for x in range(len(marks)):
        marks[x] = np.uint8(_grows(before[x], here[x], there[x], after[x]))


@compiled
def _grows(b, h, t, a):
    """Whether the gap grows from a pair's two cells on either side; where it is not known it is infinity.

    R is at least what the gaps alone change by, |b − 2 h − t| + |a − 2 t − h|, and at most half of h + t: 3 / 2, 1 / 2
    and 5 / 2 less what rounding may do.
    """
    own, other, both = np.float32(1.49), np.float32(0.49), np.float32(2.49)
    return (b > own * h + other * t) & (a > own * t + other * h) & (b + a > both * (h + t))


@compiled
def _crosses(z, gap, rules, y, x, v, u):
    """Whether a line runs between a cell and the one a step (u, v) farther on."""
    ratio = _ratio(z, gap, rules, y, x, v, u)
    if not ratio < rules.largest:
        return False
    return ratio < _ratio(z, gap, rules, y - v, x - u, v, u) and ratio <= _ratio(z, gap, rules, y + v, x + u, v, u)


@compiled
def has_two(gap, y, x):
    """Whether a cell has two layers."""
    return gap[y, x + BORDER] < np.inf


@compiled
def _ratio(z, gap, rules, y, x, v, u):
    """R / (h(q) + h(p)) of a cell q and the one p a step (u, v) farther on; infinity where they are no pair."""
    infinity, two = gap.dtype.type(np.inf), gap.dtype.type(2)
    if not (has_two(gap, y, x) and has_two(gap, y + v, x + u)):
        return infinity
    before, after = has_two(gap, y - v, x - u), has_two(gap, y + 2 * v, x + 2 * u)
    total = gap[y, x + BORDER] + gap[y + v, x + u + BORDER]
    if not (before or after) or not total > rules.least:
        return infinity
    q0, q1, p0, p1 = z[0, y, x], z[1, y, x], z[0, y + v, x + u], z[1, y + v, x + u]
    change0, change1, direct0, direct1 = infinity, infinity, infinity, infinity
    if before:
        b0, b1 = z[0, y - v, x - u], z[1, y - v, x - u]
        change0 = abs(b0 - two * q0 + p1) + abs(b1 - two * q1 + p0)
        direct0 = abs(b0 - two * q0 + p0) + abs(b1 - two * q1 + p1)
    if after:
        f0, f1 = z[0, y + 2 * v, x + 2 * u], z[1, y + 2 * v, x + 2 * u]
        change1 = abs(f0 - two * p0 + q1) + abs(f1 - two * p1 + q0)
        direct1 = abs(f0 - two * p0 + q0) + abs(f1 - two * p1 + q1)
    change = change0 + change1 if before and after else two * min(change0, change1)
    direct = direct0 + direct1 if before and after else two * min(direct0, direct1)
    return change / total if change < rules.direct * direct else infinity


@kernel
def _keep(covered, bits, some, reach, kept):
    """Keep the first two layers near pairs."""
    _, height, width = covered.shape
    for y in range(height):
        for x in range(width if some[y] else 0):
            for i in range(4 if bits[y, x] else 0):
                if bits[y, x] >> i & 1:
                    for step in range(2):
                        px, py = x + step * STEPS[i][0], y + step * STEPS[i][1]
                        for row in range(max(py - reach, 0), min(py + reach + 1, height)):
                            _keep_around(kept[0, row], covered[0, row], px, reach)
                            _keep_around(kept[1, row], covered[1, row], px, reach)


@compiled
def _keep_around(kept, covered, x, reach):
    for i in range(max(x - reach, 0), min(x + reach + 1, len(kept))):
        kept[i] |= covered[i]
