"""The entries of a stencil, from outlines, in the order of cells. Compiled."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from rts.compiling.loops import compiled, loop
from rts.compiling.threads import parallel, read_only
from rts.outlines.areas_loops import add_dual_cells
from rts.outlines.edge_kinds import INTERSECT

BANDS, SEGMENTS = 8, 400
"""The most bands of lines whose entries are made at once, and the fewest segments of each. These are numbers of their
own, so that results are the same for any number of threads."""


class BesideRows(NamedTuple):
    """The samples beside crossings. Host arrays, int32, −1 for none.

    Attributes:
        last: (B, 2), those that tell motions.
        inner: (B, 2), those that tell colours, or −1 where the former do.
        pair: (B, 2), see `Outlines.rows`.
        stack: (B, 2, K), the stacks before and behind; K = 0 for one layer.
    """

    last: np.ndarray
    inner: np.ndarray
    pair: np.ndarray
    stack: np.ndarray


class Shown(NamedTuple):
    """The colours beside crossings, and how these move. Host arrays.

    Attributes:
        colors: (B, 2) int32, before and behind, or −1; of several layers, composites, which follow those of all cells.
        movers: (B, 2) int32, the samples that crossings move with, or −1: the last ones, or a pair.
        moves: (B, 2, 3, 2), the motion of crossings along x and y, for motions (x, y, depth) of these two samples.
        normals: (B, 2), unit normals of outlines.
        first_stack: (B,) int32, the number of the first further stack of each; see `_further_stacks`.
    """

    colors: np.ndarray
    movers: np.ndarray
    moves: np.ndarray
    normals: np.ndarray
    first_stack: np.ndarray


class Entries(NamedTuple):
    """Room for entries of a stencil, in any order.

    Attributes:
        colors: (E, 3) int32, cells, colours, and the colours that these are taken of, or −1.
        parts: (E,) their weights.
        motions: (F, 4) int32, cells, samples, and the colours before and behind.
        rates: (F, 3) their weights.
    """

    colors: np.ndarray
    parts: np.ndarray
    motions: np.ndarray
    rates: np.ndarray


@loop
def _normals(outlines):
    """Unit normals (B, 2) of outlines at crossings: the mean of their segments'; along the gap for a lone crossing."""
    gap, place, endpoints = outlines.gap, outlines.place, outlines.segments.endpoints
    normal = np.zeros((len(gap), 2))
    for s in range(len(endpoints)):
        if endpoints[s, 1] < 0 or endpoints[s, 0] == endpoints[s, 1]:
            continue
        start, end = endpoints[s, 0], endpoints[s, 1]
        nx = gap[end, 0] - gap[start, 0] + place[end] * (1 - gap[end, 2]) - place[start] * (1 - gap[start, 2])
        ny = gap[start, 1] - gap[end, 1] + place[start] * gap[start, 2] - place[end] * gap[end, 2]
        for b in (start, end):
            # Two segments at a line of intersection may run in opposite directions.
            sign = 1.0 if nx * gap[b, 2] + ny * (1 - gap[b, 2]) >= 0 else -1.0
            normal[b, 0] += sign * nx
            normal[b, 1] += sign * ny
    for b in range(len(gap)):
        length = np.hypot(normal[b, 0], normal[b, 1])
        normal[b, 0] = normal[b, 0] / length if length > 0 else gap[b, 2]
        normal[b, 1] = normal[b, 1] / length if length > 0 else 1 - gap[b, 2]
    return normal


@compiled
def _former(gap, b, i, joined):
    """The cell (y, x) before the one on a side of a crossing, or this if that shows another surface; True if not."""
    right, down = gap[b, 2], 1 - gap[b, 2]
    y, x = gap[b, 0] + i * down, gap[b, 1] + i * right
    by, bx = y + (2 * i - 1) * down, x + (2 * i - 1) * right
    inside = 0 <= by < joined.shape[1] and 0 <= bx < joined.shape[2]
    on = inside and joined[down, min(y, by), min(x, bx)]
    return (by, bx, True) if on else (y, x, False)


@compiled
def _add_sides(begin, end, outlines, beside, shown, row, at_centres, entries, counts):
    """Add the entries of the surfaces on both sides of crossings with cells in lines `begin` to `end`.

    From the centre to the crossing, at a distance d, the colour changes from C to that of the last sample, X. Of this
    change the share up to the border, at ½, belongs to the centre's cell, and the rest to the next one. It moves along
    the outline's normal, with the mean motion of both samples. What is left of a cell that the outline cuts has a mean
    colour other than C: the slope from the centre before tells it. The strip in the next cell differs from X by half
    the slope times its width.

    Of layers each moves by itself: what ends at the crossing along the normal, others along the gap.

    Args:
        begin: the first line.
        end: the line after the last.
        outlines: the outlines.
        beside: the samples beside crossings.
        shown: their colours and motions.
        row: (K, H, W) int32, the samples in cells.
        at_centres: (H, W) int32, the colours at centres; of several layers, composites.
        entries: to fill.
        counts: the numbers of entries of colours and of motions so far.

    Returns:
        The new numbers.
    """
    width, (n, m), (colors, parts, motions, rates) = at_centres.shape[1], counts, entries
    gap, place, ends, joined = outlines.gap, outlines.place, outlines.ends, outlines.joined
    rows, stack, first_stack = beside.last, beside.stack, shown.first_stack
    shown_colors, normal = shown.colors, shown.normals
    for b in range(len(gap)):
        nx, ny, right = normal[b, 0], normal[b, 1], gap[b, 2]
        if gap[b, 0] >= end or gap[b, 0] + 1 - right < begin:
            continue
        ahead, step = nx * right + ny * (1 - right), right + (1 - right) * width
        further = at_centres.size + first_stack[b]
        for i in range(2):
            last, way = shown_colors[b, i], 1 - 2 * i
            y, x = gap[b, 0] + i * (1 - right), gap[b, 1] + i * right
            cell, here = y * width + x, at_centres[y, x]
            if not (ends[b, i] and last >= 0 and here >= 0):
                continue
            next_ = cell + way * step
            length = min(max(place[b] if i == 0 else 1 - place[b], 0.0), 1.0)
            inside, outside = min(length, 0.5), max(length - 0.5, 0.0)
            by, bx, on = _former(gap, b, i, joined)
            former, rate = at_centres[by, bx], 1 / (1 + length) if on else 1 / max(length, 0.5)
            nearer = ahead * ahead * (0.125 - inside**2 / 2) if on else 0.0
            farther = ahead * ahead * rate * outside**2 / 2
            for at, color, share in ((cell, here, nearer), (next_, last, farther)):
                if share > 0 and former >= 0 and color != former:
                    colors[n, 0], colors[n, 1], colors[n, 2], parts[n] = at, former, color, share
                    n += 1
            mine = 0.5 / max(length, 0.5)
            across = -0.5 * way * ahead * nx, -0.5 * way * ahead * ny
            shares = (cell, mine), (next_, 1 - mine)
            if stack.shape[2] == 0:
                for at, share in shares:
                    m = _add_motion(motions, rates, m, at, rows[b, i], share, across, last, here)
                    m = _add_motion(motions, rates, m, at, row[0, y, x], share, across, last, here)
                continue
            # The composite of a cell changes as that of a stack where one layer is that of the crossing.
            along = -0.5 * way * right, -0.5 * way * (1 - right)
            for k in range(len(row)):
                own, there, stays = row[k, y, x], stack[b, i, k], False
                if own == there:
                    continue
                for other in range(len(row)):
                    stays |= stack[b, 1 - i, other] == there
                moves = along if stays else across
                for at, share in shares:
                    m = _add_motion(motions, rates, m, at, own, share, moves, further, here)
                    m = _add_motion(motions, rates, m, at, there, share, moves, further, here)
                further += 1
    return n, m


@compiled(inline="always")
def _add_motion(motions, rates, m, cell, sample, share, moves, color, other):
    """Add an entry of motions along x and y; the next one replaces it if it is 0. Returns the new number of entries."""
    x, y = share * moves[0], share * moves[1]
    motions[m, 0], motions[m, 1], motions[m, 2], motions[m, 3] = cell, sample, color, other
    rates[m, 0], rates[m, 1], rates[m, 2] = x, y, 0.0
    return m + (sample >= 0 and color != other and (x != 0 or y != 0))


@compiled
def _by_cells(entries, count, start, cells):
    """Where the entries of each of so many `cells` from `start` on begin in `order`, and this, the order of these.

    The first column of entries has their cells.
    """
    first, order = np.zeros(cells + 2, np.int64), np.empty(count, np.int64)
    for n in range(count):
        if 0 <= entries[n, 0] - start < cells:
            first[entries[n, 0] - start + 2] += 1
    for i in range(cells):
        first[i + 2] += first[i + 1]
    for n in range(count):
        at = entries[n, 0] - start + 1
        if 0 < at <= cells:
            order[first[at]] = n
            first[at] += 1
    return first, order[: first[cells]]


@compiled(inline="always")
def _at(colors, several, color):
    """The place of a colour among the first `several`, or `several`."""
    at = 0
    while at < several and colors[at] != color:
        at += 1
    return at


@compiled
def _sorted_colors(colors, parts, count, start, cells, at_centres):
    """Entries of colours by cell, one for each colour of a cell, without those of 0.

    In each cell weights are at least 0, and their sum at most 1, with the 1 by which the centre's colour counts:
    regions fill the cell, and of a colour no more is taken than there is.
    """
    first, order = _by_cells(colors, count, start, cells)
    cell_of, color_of, weight_of = np.empty(count, np.int32), np.empty(count, np.int32), np.empty(count)
    color, weight, front, n = np.empty(count + 1, np.int32), np.empty(count + 1), at_centres.reshape(-1), 0
    for i in range(cells):
        if first[i] == first[i + 1]:
            continue
        own, several = front[start + i], 1
        color[0], weight[0] = own, 1.0 if own >= 0 else 0.0
        for e in range(first[i], first[i + 1]):  # In the order of entries: areas before what is taken of them.
            entry, taken = order[e], parts[order[e]]
            if colors[entry, 2] >= 0:
                at = _at(color, several, colors[entry, 2])
                taken = min(taken, max(weight[at], 0.0)) if at < several else 0.0
                weight[min(at, several - 1)] -= taken
            at = _at(color, several, colors[entry, 1])
            if at == several:
                color[at], weight[at], several = colors[entry, 1], 0.0, several + 1
            weight[at] += taken
        for e in range(several):
            share = max(weight[e], 0.0) - (1 if e == 0 and own >= 0 else 0)
            if share != 0 and color[e] >= 0:
                cell_of[n], color_of[n], weight_of[n] = start + i, color[e], share
                n += 1
    return cell_of[:n], color_of[:n], weight_of[:n]


@loop
def _sort_motions(n, motions, rates, order, cell, sample, weight, colors):
    """Fill in entries of motions in an order, from row n on."""
    for e in order:
        cell[n], sample[n], colors[n, 0], colors[n, 1] = motions[e, 0], motions[e, 1], motions[e, 2], motions[e, 3]
        weight[n, 0], weight[n, 1], weight[n, 2] = rates[e, 0], rates[e, 1], rates[e, 2]
        n += 1


@loop
def _of_crossings(outlines, beside, cells):
    """`Shown.colors`, `movers` and `moves`; composites beside crossings follow those of so many `cells`."""
    kind, slope, rows, (_, inner, pair, stack) = outlines.kind, outlines.slope, beside.last, beside
    count = len(kind)
    shown, movers, moves = np.empty((count, 2), np.int32), np.empty((count, 2), np.int32), np.zeros((count, 2, 3, 2))
    for b in range(count):
        paired = pair[b, 0] >= 0
        for i in range(2):
            shown[b, i] = inner[b, i] if rows[b, i] >= 0 and inner[b, i] >= 0 else rows[b, i]
            if stack.shape[2] > 0:
                shown[b, i] = cells + 2 * b + i if stack[b, i, 0] >= 0 else -1
            movers[b, i] = pair[b, i] if paired else rows[b, i]
        if paired:
            for i in range(2):
                moves[b, i, 0, 0], moves[b, i, 1, 1] = 0.5, 0.5
            continue
        ending = min(kind[b], 1)
        cut = kind[b] < INTERSECT and (slope[b, ending, 0] != 0 or slope[b, ending, 1] != 0)
        if kind[b] < INTERSECT and not cut:
            moves[b, ending, 0, 0], moves[b, ending, 1, 1] = 1.0, 1.0
            continue
        # A line of intersection; or one of fixed depth, where a plane that does not move cuts a surface.
        square = (slope[b, 0, 0] - slope[b, 1, 0]) ** 2 + (slope[b, 0, 1] - slope[b, 1, 1]) ** 2
        for a in range(2):
            share = -(slope[b, 0, a] - slope[b, 1, a]) / (square if square > 0 else 1.0)
            for i in range(ending if cut else 0, ending + 1 if cut else 2):
                sign = share if i == 0 else -share
                moves[b, i, 0, a] = -sign * slope[b, i, 0]
                moves[b, i, 1, a] = -sign * slope[b, i, 1]
                moves[b, i, 2, a] = sign
    return shown, movers, moves


@loop
def _further_stacks(outlines, stack, row, shown):
    """Stacks (R, K): two of each crossing, then those of cells in which one layer is a crossing's.

    Also returns the number (B,) of each crossing's first of the latter. `stack` is that of `BesideRows`; `shown` (B, 2)
    are the colours of `Shown`.
    """
    gap, ends = outlines.gap, outlines.ends
    layers, count, r = len(row), len(gap), 2 * len(gap)
    stacks, first = np.empty((r * (1 + layers), layers), np.int32), np.empty(count, np.int32)
    for b in range(count):
        first[b] = r
        for i in range(2):
            y, x = gap[b, 0] + i * (1 - gap[b, 2]), gap[b, 1] + i * gap[b, 2]
            for k in range(layers):
                stacks[2 * b + i, k] = stack[b, i, k]
                if not (ends[b, i] and shown[b, i] >= 0 and row[0, y, x] >= 0) or row[k, y, x] == stack[b, i, k]:
                    continue
                for other in range(layers):
                    stacks[r, other] = row[other, y, x] if other != k else stack[b, i, k]
                r += 1
    return stacks[:r], first


@loop
def _in_lines(begin, end, outlines, beside, shown, row, at_centres):
    """The entries in the cells of lines `begin` to `end`: colours as of `entries`, and motions, with their order."""
    segments, crossings, width, gap, dual = 0, 0, row.shape[2], outlines.gap, outlines.segments.dual
    for s in range(len(dual)):
        segments += begin - 1 <= dual[s, 0] < end
    for b in range(len(gap)):
        crossings += begin - 1 <= gap[b, 0] < end
    most = 20 * segments + 4 * crossings
    colors, parts = np.empty((most, 3), np.int32), np.empty(most)
    most = 64 * segments + 8 * crossings * len(row) + 1  # The last may be one of 0.
    motions, rates = np.empty((most, 4), np.int32), np.empty((most, 3))
    room = Entries(colors, parts, motions, rates)
    counts = add_dual_cells(begin, end, outlines, shown, at_centres, room)
    n, m = _add_sides(begin, end, outlines, beside, shown, row, at_centres, room, counts)
    start, cells = begin * width, (end - begin) * width
    order = _by_cells(motions, m, start, cells)[1]
    return *_sorted_colors(colors, parts, n, start, cells, at_centres), motions, rates, order


def entries(outlines: Any, beside: BesideRows, row: np.ndarray, real: Any) -> Any:
    """The entries of a stencil; see `rts.contracts.records.Stencil`.

    Args:
        outlines: the `Outlines`.
        beside: the samples beside their crossings.
        row: (K, H, W) int32, the samples in cells.
        real: the dtype of weights.

    Returns:
        Cells, colours and weights of colours; cells, samples, weights and colours of motions; and stacks (R, K).
    """
    at_centres, dual, cells = row[0], outlines.segments.dual, row[0].size
    stacks, first_stack = np.empty((0, 0), np.int32), np.zeros_like(outlines.kind)
    colors, movers, moves = _of_crossings(outlines, beside, cells)
    if beside.stack.shape[2]:
        at_centres = np.where(at_centres >= 0, np.arange(cells, dtype=np.int32).reshape(at_centres.shape), np.int32(-1))
        stacks, first_stack = _further_stacks(outlines, beside.stack, row, colors)
    shown = Shown(colors, movers, moves, _normals(outlines), first_stack)
    known = outlines, beside, shown, row, read_only(at_centres)
    bands = min(BANDS, 1 + len(dual) // SEGMENTS)
    lines = [0, *dual[len(dual) * np.arange(1, bands) // bands, 0].tolist(), row.shape[1]]
    found: list[Any] = [()] * bands

    def some(first, last):
        for i in range(first, last):
            found[i] = _in_lines(lines[i], lines[i + 1], *known)

    parallel(some, bands, work=1500 * len(dual))
    *colors, _, _, orders = zip(*found, strict=True)
    at = np.cumsum([0, *map(len, orders)]).tolist()
    motions = *np.empty((2, at[-1]), np.int32), np.empty((at[-1], 3), real), np.empty((at[-1], 2), np.int32)

    def sort(first, last):
        for i in range(first, last):
            _sort_motions(at[i], *found[i][3:], *motions)

    parallel(sort, bands, work=20 * at[-1])
    cell, color, weight = map(np.concatenate, colors)
    return (cell, color, weight.astype(real)), motions, stacks
