"""Outlines that move as `rts.splatting.rims` says: what their motion adds to derivatives of the compiled `Visible`.

With v̂ the motion of the outline beside a cell, and v that of its front, what a source of weight w adds to the
derivative of a target is ∂w · (v̂ − v) times the change of the target's colour with the coverage of one buffer. Only
targets count that a buffer covers in part. The gradient adds up in one order: every other band of rows, and then those
between.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rts.compiling import compiled, kernel
from rts.threads import parallel
from rts_backends.fused.crossing_pairs import steps
from rts_backends.fused.mixed import splat
from rts_backends.fused.survey import BUSY, SETTLED

BAND = 16
"""Rows whose gradients are added up by one thread, more than samples of which one target knows are apart."""

NOTHING, FRONT, JOINED, SURFACE = 0, 1, 2, 3
"""What a source gives to a target: nothing, or coverage of the buffer in front as its outline moves; of that at the
surface as the target's outline moves; of that at the surface, over nothing or another part, as its own does."""

LISTED, BESIDE = 1, 2
"""Marks of targets that are listed, and of those whose outline matters to listed ones beside them."""


class Rules(NamedTuple):
    """Numbers of `rts.splatting.rims`, in the dtype of the positions."""

    least: float
    largest: float
    flat: float
    converging: float
    half: float


class Outlines(NamedTuple):
    """How outlines move, and the targets that they cover in part.

    Attributes:
        beta: (H, W), β of the targets below that are covered; 0 where the front's own motion is the outline's.
        partner: (H, W) int32, the partner's sample where β is not 0.
        offsets: (H + 1,) int64, where the targets of each row begin in the lists below.
        columns: (M,) int32, their columns.
        gives: (M, 9) uint8, what each source gives; source 3 (v + 1) + (u + 1) lies at −(u, v).
        slopes: (M, 9, 2), of the weights of sources that give something, with their position.
        changes: (M, 2, 4), of the target's colour with coverage in front, and at the surface.
    """

    beta: np.ndarray
    partner: np.ndarray
    offsets: np.ndarray
    columns: np.ndarray
    gives: np.ndarray
    slopes: np.ndarray
    changes: np.ndarray


@kernel
def find(start, stop, positions, row, reach, states, mixed, offsets, columns, ranges, ends, marks, counts):
    """Find where fronts end in rows [start, stop), and mark targets that may be covered in part.

    Args:
        start: first row.
        stop: end of the rows.
        positions: (N, 3).
        row: (K, H, W).
        reach: pixels that a sample may lie off its cell's centre, so that weights are sure to add up to one.
        states: (H, W) of `survey.py`.
        mixed: (H, W), see `rts_backends.fused.cells.Choices`, as `offsets`, `columns` and `ranges`.
        offsets: (H + 1,).
        columns: (M,).
        ranges: (M, 9, 3, 2).
        ends: (H, W) uint16, to be filled: bit 3 (v + 1) + (u + 1) where a front ends towards (u, v).
        marks: (H, W) uint8, to be filled.
        counts: (H,) zeros, to be filled with the number of marks.
    """
    _, height, width = row.shape
    # Of the cells of three rows and one more at each side: bits for what is empty, covered, and not sure to fill.
    cells = np.empty((3, width + 2), np.uint8)
    for y in range(start, stop):
        for v in range(3):
            if y == start or v == 2:
                _look(cells[(y + v) % 3], positions, row[0], states, y + v - 1, reach)
        above, level, below = cells[y % 3], cells[(y + 1) % 3], cells[(y + 2) % 3]
        for x in range(width):
            around = above[x] | above[x + 1] | above[x + 2] | level[x] | level[x + 1] | level[x + 2]
            around |= below[x] | below[x + 1] | below[x + 2]
            # Settled targets have nothing loose beside them, unless samples there were dropped for want of room.
            known = (states[y, x] == SETTLED) & (row[0, y, x] < 0)
            partial = (around & COVERED != 0) & (around & LOOSE != 0) & ~known
            marks[y, x] = np.uint8(partial) | mixed[y, x]
            ends[y, x] = np.uint16(around & EMPTY)
        for x in range(width):
            counts[y] += marks[y, x]
            if ends[y, x]:
                ends[y, x] = _ends_before_nothing(above, level, below, x) if level[x + 1] & COVERED else 0
        for d in range(offsets[y], offsets[y + 1]):
            ends[y, columns[d]] |= _ends_before_others(ranges[d], row, y, columns[d])


_BITS = (np.arange(512)[:, None] >> np.arange(9) & 1).astype(np.int8)
ALONG = (_BITS @ [(n % 3 - 1, n // 3 - 1) for n in range(9)]).astype(np.int64)
OPPOSITE = (_BITS[:, ::-1].astype(np.int64) << np.arange(9)).sum(axis=1)
LOWEST = _BITS.argmax(axis=1)
"""What nine directions as bits sum up to, the bits of those opposite, and the place of the first that is set."""


@kernel
def narrow(start, stop, marks, wanted, kept, counts):
    """Leave out marks of rows [start, stop) that are neither wanted nor beside wanted ones.

    Args:
        start: first row.
        stop: end of the rows.
        marks: (H, W) of `find`.
        wanted: (H, W) uint8.
        kept: (H, W) uint8, to be filled with marks.
        counts: (H,), to be filled with the number of those that are listed.
    """
    height, width = marks.shape
    for y in range(start, stop):
        counts[y] = 0
        for x in range(width):
            kept[y, x] = marks[y, x] & wanted[y, x]
            counts[y] += kept[y, x]
            if marks[y, x] and not kept[y, x]:
                for n in range(9):
                    v, u = y + n // 3 - 1, x + n % 3 - 1
                    if 0 <= v < height and 0 <= u < width and marks[v, u] & wanted[v, u]:
                        kept[y, x] = BESIDE


EMPTY, COVERED, LOOSE = np.uint8(1), np.uint8(2), np.uint8(4)
"""Bits of a cell: in the array without a sample, with one, and not sure to fill its share of what is around it."""


@compiled
def _look(cells, positions, row, states, y, reach):
    """Bits of a row of cells, and of one cell at each side."""
    height, width = row.shape
    half = positions.dtype.type(0.5)
    cells[:] = LOOSE
    if not 0 <= y < height:
        return
    middle = positions.dtype.type(y) + half
    for x in range(width):
        if SETTLED <= states[y, x] < BUSY:
            cells[x + 1] = COVERED
            continue
        i = row[y, x]
        if i < 0:
            cells[x + 1] = EMPTY | LOOSE
            continue
        off = max(abs(positions[i, 0] - (positions.dtype.type(x) + half)), abs(positions[i, 1] - middle))
        cells[x + 1] = COVERED if off <= reach else COVERED | LOOSE


@compiled
def _ends_before_nothing(above, level, below, x):
    """Directions in which neighbours of cell x are empty, as bits."""
    bits = 0
    for u in range(3):
        bits |= (above[x + u] & EMPTY) << u
        bits |= (level[x + u] & EMPTY) << (3 + u)
        bits |= (below[x + u] & EMPTY) << (6 + u)
    return np.uint16(bits)


@compiled
def _ends_before_others(choice, row, y, x):
    """Directions in which neighbours of a mixed target are covered, and not paired front to front, as bits."""
    _, height, width = row.shape
    bits = 0
    for n in range(9):
        py, px = y + 1 - n // 3, x + 1 - n % 3
        if n != 4 and 0 <= py < height and 0 <= px < width and row[0, py, px] >= 0:
            if not (choice[n, 1, 0] == 0 and choice[n, 1, 1] == 1):
                bits |= 1 << (8 - n)
    return np.uint16(bits)


@compiled
def _rule(positions, row, part, exits, ends, y, x, extent, rules):
    """β and the partner's sample of a cell whose front ends somewhere."""
    one, two, bits = positions.dtype.type(1), positions.dtype.type(2), np.int64(ends[y, x])
    beta, partner, best, deep, steepest = positions.dtype.type(0), -1, -1000, False, two
    along_x, along_y, left = ALONG[bits, 0], ALONG[bits, 1], bits & ~OPPOSITE[bits]
    leaves = len(exits) > 0 and exits[y, x] >= 0
    paired = leaves or (len(part) > 1 and part[0, y, x] == part[1, y, x])
    back = exits if leaves else row[-1 if len(row) < 2 else 1]
    own = _gap(positions, row, back, y, x) if paired else beta
    while left:
        n = LOWEST[left]
        left &= left - 1
        u, v = n % 3 - 1, n // 3 - 1
        py, px = y - v, x - u
        if not _covered(row, py, px):
            continue
        if paired:
            inner = _gap(positions, row, back, py, px)
            if rules.converging * own * own <= inner * inner:
                return -rules.half, back[y, x]
        along = u * along_x + v * along_y
        score = along * abs(along) * (3 - abs(u) - abs(v))
        if deep and score <= best:
            continue
        ratio = _ratio(positions, row, ends, y, x, v, u, rules.flat * extent)
        rim = ratio > rules.least
        if (rim and not deep) or (rim == deep and score > best):
            best, deep, partner, beta, steepest = score, rim, row[0, py, px], rules.half, ratio
    if deep:
        root = (one + two * steepest - steepest * steepest) / (two * steepest * (steepest - one))
        beta = min(max(root, positions.dtype.type(0)), rules.largest)
    return beta, partner


@compiled
def _covered(row, y, x):
    """Whether there is a cell, and a sample in it."""
    _, height, width = row.shape
    return 0 <= y < height and 0 <= x < width and row[0, y, x] >= 0


@compiled
def _gap(positions, row, back, y, x):
    """How far the other end of a chord lies behind the front of a cell; NaN, which compares as false, without one."""
    i, j = row[0, y, x], back[y, x]
    return positions[j, 2] - positions[i, 2] if j >= 0 else positions.dtype.type(np.nan)


@compiled
def _ratio(positions, row, ends, y, x, v, u, flat):
    """The ratio r of `rts.splatting.rims` along a usable direction; 0 where the surface does not go on, or not fall."""
    zero, py, px = positions.dtype.type(0), y - 2 * v, x - 2 * u
    if not _covered(row, py, px) or ends[y - v, x - u] >> (4 - 3 * v - u) & 1:
        return zero
    middle = positions[row[0, y - v, x - u], 2]
    slope = middle - positions[row[0, py, px], 2]
    return (positions[row[0, y, x], 2] - middle) / slope if slope > flat else zero


@kernel
def fill(
    start,
    stop,
    positions,
    rgba,
    row,
    scale,
    peak,
    gamma,
    part,
    exits,
    extent,
    rules,
    crossed,
    mixed,
    ranges,
    sums,
    firsts,
    ends,
    marks,
    found,
):
    """Decide how outlines move in rows [start, stop), as `rts.splatting.rims.rules` does, and list the marked targets.

    Args:
        start: first row.
        stop: end of the rows.
        positions: (N, 3).
        rgba: (N, 4).
        row: (K, H, W).
        scale: the exponent's factor.
        peak: of the weights, along one axis.
        gamma: the calibration.
        part: (K, H, W), the part of each sample, or no layers.
        exits: (H, W), where rays leave the part of the front, or no rows.
        extent: of the depths.
        rules: numbers of the rules.
        crossed: (H, W) uint8, the pairs of `crossing_pairs.py`, or no rows.
        mixed: (H, W), see `rts_backends.fused.cells.Choices`, as `ranges` and `sums`.
        ranges: (M, 9, 3, 2).
        sums: (M, 3, 5).
        firsts: (H + 1,), where the mixed targets of each row begin.
        ends: (H, W) of `find`.
        marks: (H, W) of `find` or `narrow`.
        found: `Outlines`, to be filled but for its offsets.
    """
    beta, partner, offsets, columns, gives, slopes, changes = found
    for y in range(start, stop):
        d, m = offsets[y], firsts[y]
        for x in range(marks.shape[1]):
            if not marks[y, x]:
                m += mixed[y, x]
                continue
            covered = row[0, y, x] >= 0
            if covered:
                beta[y, x] = positions.dtype.type(0)
                if ends[y, x]:
                    beta[y, x], partner[y, x] = _rule(positions, row, part, exits, ends, y, x, extent, rules)
            if marks[y, x] == BESIDE:
                m += mixed[y, x]
                continue
            columns[d] = x
            given = JOINED if covered else SURFACE
            own = _weigh(gives, slopes, d, positions, rgba, row, y, x, scale, peak, gamma, given)
            if mixed[y, x]:
                _list(gives[d], changes[d], ranges[m], sums[m], row, y, x)
                m += 1
            else:
                _change(gives, changes, d, own)
            if covered and len(part) and not (len(crossed) and steps(crossed, y, x)):
                _part(gives, d, part, ends, y, x)
            d += 1


# Not handed views of single targets, since to make and to count these takes as long as the work.


@compiled
def _weigh(gives, slopes, d, positions, rgba, row, y, x, scale, peak, gamma, given):
    """List the slopes of the weights of the fronts around a target, and that each gives what is given.

    Returns their sums, of colours and weights.
    """
    _, height, width = row.shape
    zero, slope = positions.dtype.type(0), positions.dtype.type(2) * scale * gamma
    red, green, blue, alpha, weight, n = zero, zero, zero, zero, zero, 0
    for v in range(-1, 2):
        for u in range(-1, 2):
            py, px = y - v, x - u
            i = row[0, py, px] if 0 <= py < height and 0 <= px < width else -1
            gives[d, n] = NOTHING
            if i >= 0:
                w, dx, dy = splat(positions, i, py, px, u, v, scale, peak, gamma)
                gives[d, n], slopes[d, n, 0], slopes[d, n, 1] = given, slope * w * dx, slope * w * dy
                red, green, blue = red + w * rgba[i, 0], green + w * rgba[i, 1], blue + w * rgba[i, 2]
                alpha, weight = alpha + w * rgba[i, 3], weight + w
            n += 1
    return red, green, blue, alpha, weight


@compiled
def _change(gives, changes, d, total):
    """How the colour of a target changes with its coverage, to which all fronts around it give."""
    zero, one = changes.dtype.type(0), changes.dtype.type(1)
    partial = zero < total[4] < one
    over = one / total[4] if partial else zero
    for c in range(4):
        changes[d, 0, c], changes[d, 1, c] = zero, over * total[c]
    for n in range(0 if partial else 9):
        gives[d, n] = NOTHING


@compiled
def _list(gives, changes, choice, total, row, y, x):
    """What the sources of a mixed target give, and how its colour changes with the coverage of its buffers."""
    zero, one = total.dtype.type(0), total.dtype.type(1)
    front, surface = zero < total[0, 4] < one, zero < total[1, 4] < one
    for c in range(4):
        under = total[1, c] + (one - total[1, 3]) * total[2, c]
        changes[0, c] = (total[0, c] - total[0, 3] * under) / total[0, 4] if front else zero
        through = (one - total[0, 3]) * (total[1, c] - total[1, 3] * total[2, c])
        changes[1, c] = through / total[1, 4] if surface else zero
    for n in range(9):
        py, px = y + 1 - n // 3, x + 1 - n % 3
        gives[n] = NOTHING
        if not _covered(row, py, px):
            continue
        if front and choice[n, 0, 1] == 1:
            gives[n] = FRONT
        elif surface and choice[n, 1, 0] == 0 and choice[n, 1, 1] == 1:
            gives[n] = JOINED if row[0, y, x] >= 0 else SURFACE


@compiled
def _part(gives, d, part, ends, y, x):
    """Sources of other parts than the target's move as their own outlines, if any: there may be a gap between."""
    for n in range(9):
        py, px = y + 1 - n // 3, x + 1 - n % 3
        if gives[d, n] == JOINED and part[0, py, px] != part[0, y, x]:
            gives[d, n] = SURFACE if ends[py, px] else NOTHING


@compiled
def _outline(t_positions, row, beta, partner, y, x, axis):
    """The motion v̂ of the outline beside a cell, along an axis."""
    b, own = beta[y, x], t_positions[row[0, y, x], axis]
    return own + b * (own - t_positions[partner[y, x], axis]) if b != 0 else own


@compiled
def gain(d, t_positions, row, outlines, y):
    """What moving outlines add to the coverage of a target's buffers in front and at the surface, along a tangent."""
    front, surface = outlines.slopes.dtype.type(0), outlines.slopes.dtype.type(0)
    x, beta, partner = outlines.columns[d], outlines.beta, outlines.partner
    for n in range(9):
        given = outlines.gives[d, n]
        if given == NOTHING:
            continue
        v, u = n // 3 - 1, n % 3 - 1
        i, qy, qx = row[0, y - v, x - u], y - v, x - u
        if given == JOINED:
            qy, qx = y, x
        along = outlines.slopes[d, n, 0] * (_outline(t_positions, row, beta, partner, qy, qx, 0) - t_positions[i, 0])
        along += outlines.slopes[d, n, 1] * (_outline(t_positions, row, beta, partner, qy, qx, 1) - t_positions[i, 1])
        if given == FRONT:
            front += along
        else:
            surface += along
    return front, surface


@kernel
def push(start, stop, row, outlines, t_positions, border, out):
    """Add to rows [start, stop) of the tangents (T, H, W, 4)."""
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
    """Add to the gradients of positions (N, 3) what outlines give, from that of the image (H, W, 4)."""
    bands = -(-len(g) // BAND)
    for first in range(2):
        given = row, outlines, border, g, first, g_positions
        parallel(_pull, (bands + 1 - first) // 2, *given, work=20 * len(outlines.columns))


@kernel
def _pull(start, stop, row, outlines, border, g, first, g_positions):
    """`pull` of every other band of rows, from band `first` on: these have no sample in common."""
    width, zero = g.shape[1], g_positions.dtype.type(0)
    for band in range(start, stop):
        top = (2 * band + first) * BAND
        _pull_rows(border + top, border + min(top + BAND, len(g)), row, outlines, border, g, width, zero, g_positions)


@compiled
def _pull_rows(top, bottom, row, outlines, border, g, width, zero, g_positions):
    """`pull` of some rows."""
    for y in range(top, bottom):
        for d in range(outlines.offsets[y], outlines.offsets[y + 1]):
            x = outlines.columns[d]
            if not 0 <= x - border < width:
                continue
            front, surface = zero, zero
            for c in range(4):
                front += g[y - border, x - border, c] * outlines.changes[d, 0, c]
                surface += g[y - border, x - border, c] * outlines.changes[d, 1, c]
            if front == zero and surface == zero:
                continue
            joined_x, joined_y = zero, zero
            for n in range(9):
                given = outlines.gives[d, n]
                if given == NOTHING:
                    continue
                py, px = y + 1 - n // 3, x + 1 - n % 3
                h = front if given == FRONT else surface
                h_x, h_y = h * outlines.slopes[d, n, 0], h * outlines.slopes[d, n, 1]
                i = row[0, py, px]
                g_positions[i, 0] -= h_x
                g_positions[i, 1] -= h_y
                if given == JOINED:
                    joined_x, joined_y = joined_x + h_x, joined_y + h_y
                else:
                    _add(g_positions, row, outlines, py, px, h_x, h_y)
            if joined_x != zero or joined_y != zero:
                _add(g_positions, row, outlines, y, x, joined_x, joined_y)


@compiled
def _add(g_positions, row, outlines, y, x, g_x, g_y):
    """Hand the gradient of the motion of the outline beside a cell to its front and its partner."""
    i, j, b = row[0, y, x], outlines.partner[y, x], outlines.beta[y, x]
    g_positions[i, 0] += g_x
    g_positions[i, 1] += g_y
    if b != 0:
        g_positions[i, 0] += b * g_x
        g_positions[i, 1] += b * g_y
        g_positions[j, 0] -= b * g_x
        g_positions[j, 1] -= b * g_y
