"""Crossings on the sides of a dual cell, joined into segments that do not cross within a part. Compiled."""

from __future__ import annotations

import numpy as np

from rts.compiling.loops import compiled, loop
from rts.outlines.edge_kinds import BEFORE_ENDS, BEHIND_ENDS, INTERSECT, SEAM

LONE, ON_ONE_SIDE, OTHER_BEHIND, OTHER_KIND, OTHER_DEPTH = 2.0, 1.5, 0.5, 1.0, 1.0
"""Costs, in cells, beside the length of segments: a crossing that stays alone; a segment between two on one side,
which may be the two edges of something thin; one between crossings with different parts behind them; one between an
outline and a line where surfaces intersect; one between surfaces that end far from one another along the ray, of which
half counts for those `FAR` cells apart."""

ON_FRONT = 1.0
"""How much farther off its way, in cells, an outline counts to end at a segment on the side of what this bounds."""

FAR = 4.0
"""Cells along a ray, each as deep as it is wide; see `OTHER_DEPTH`."""

ASIDE = 0.4
"""Share of a cost that is by how far a segment leads off the direction of an outline at its end; the rest is by its
length."""

STRAIGHT = 1e-3
"""Sine of an angle, in which an outline counts as straight: rounding of vertices must not tell where lines meet."""

CLOSE = 1e-4
"""Least distance, in cells, of a corner from the ends of its segment: an outline that turns at an end has none."""

ALIKE = 1e-6
"""Distance, in cells, of two crossings that are in one place."""

TIE = 1e-4
"""Difference of distances, in cells, that does not tell which of two outlines another one ends at: it is rounding."""

REACH = 6
"""The most rows from a segment to its junction."""

MOST_ALIKE = 4
"""The most crossings in one place: a centre is the end of so many gaps."""


@compiled(inline="always")
def on_sides(x, y, side):
    """The place on a dual cell's sides, clockwise from the upper left corner, 0 to 4, of a point on one of its sides.

    Sides are 0 at the top, 1 right, 2 at the bottom, 3 left; `x` and `y` count from the upper left corner.
    """
    return x if side == 0 else (1 + y if side == 1 else (3 - x if side == 2 else 4 - y))


@loop
def places(gap, at, kind, place, kinds):
    """Fill in `Outlines.place` (B,) and `Outlines.kind` (B,), from the fields of `Crossings`."""
    for b in range(len(gap)):
        place[b] = at[b, 0] - gap[b, 1] - 0.5 if gap[b, 2] == 1 else at[b, 1] - gap[b, 0] - 0.5
        kinds[b] = BEFORE_ENDS if kind[b] == SEAM else kind[b]  # There both surfaces move alike.


@loop
def ends_of(gap, place, kind, parts, height, width):
    """The ends of segments: each crossing in the two dual cells beside its gap, as far as these have four centres.

    Returns:
        Flat index of the dual cell's first corner (E,) int64; place on its sides (E,), clockwise from the upper left
        corner, 0 to 4; and (E, 5) int32: the crossing, the side (0 top, 1 right, 2 bottom, 3 left), 1 where the way
        along the sides leaves the front, −1 where it enters it, 0 where surfaces intersect and at seams; the parts in
        front and behind. Seams have a negative number for both, by their parts, so that they are joined among
        themselves.
    """
    dual, along, ends = (
        np.empty(2 * len(gap), np.int64),
        np.empty(2 * len(gap)),
        np.empty((2 * len(gap), 5), np.int32),
    )
    count, most = 0, np.int32(1)
    for b in range(len(gap)):
        most = max(most, parts[b, 0] + 1, parts[b, 1] + 1)
    # Those on the sides 2 and 3, against the way of their gaps, come last and backwards: so that crossings in one place
    # are in order clockwise.
    for n in range(2 * len(gap)):
        backwards = n >= len(gap)
        b = 2 * len(gap) - 1 - n if backwards else n
        y, x, row = gap[b, 0], gap[b, 1], gap[b, 2]
        at = place[b, 0] - x - 0.5 if row == 1 else place[b, 1] - y - 0.5
        at = min(max(at, 0.0), 1 - 1e-9)
        front, back = parts[b, 0], parts[b, 1]
        if kind[b] == BEHIND_ENDS or (kind[b] == INTERSECT and front > back):
            front, back = back, front
        if kind[b] == SEAM:
            front = -2 - min(front, back) * most - max(front, back)
            back = front
        for first in range(2):
            # Above and below a row's gap, left and right of a column's.
            top, left = y - (row if first == 0 else 0), x - (1 - row if first == 0 else 0)
            if top < 0 or left < 0 or top >= height - 1 or left >= width - 1:
                continue
            side = (2 if row == 1 else 1) if first == 0 else (0 if row == 1 else 3)
            if (side >= 2) != backwards:
                continue
            dual[count] = top * width + left
            along[count] = on_sides(at, at, side)
            sign = 0 if kind[b] >= INTERSECT else (1 if kind[b] == BEFORE_ENDS else -1)
            ends[count, 0], ends[count, 1], ends[count, 2] = b, side, sign if side < 2 else -sign
            ends[count, 3], ends[count, 4] = front, back
            count += 1
    return dual[:count], along[:count], ends[:count]


@compiled
def _odd(first, stop, order, ends, e):
    """True if there is an odd number of ends of the part in front of an intersection e; and of that behind it."""
    odd_front, odd_back = False, False
    for m in range(first, stop):
        if ends[order[m], 2] != 0:
            odd_front ^= ends[order[m], 3] == ends[e, 3]
            odd_back ^= ends[order[m], 3] == ends[e, 4]
    return odd_front, odd_back


@loop
def turn_clockwise(order, group, along):
    """Sort the ends of each group by `along` (E,): `order` (E,) int64 lists ends sorted by `group` (E,)."""
    begin = 0
    for n in range(len(order)):
        end, m = order[n], n
        if n == 0 or group[order[n - 1]] != group[end]:
            begin = n
        while m > begin and along[order[m - 1]] > along[end]:
            order[m] = order[m - 1]
            m -= 1
        order[m] = end


@loop
def groups_of(order, dual, ends):
    """(E,) int64: ends of a dual cell that may be joined where light passes: those of a part, and intersections.

    An intersection of two parts goes on as the outline of the one of which there is an odd number of ends, such as
    where something opaque hides the rest; else intersections of two parts are joined among themselves. Groups are
    numbered as their first ends come around a dual cell, so that it has no effect which part comes first.

    Args:
        order: (E,) sorts ends by dual cells, in each clockwise.
        dual: (E,), see `ends_of`.
        ends: (E, 5), see `ends_of`.
    """
    count, first = len(order), 0
    group, kinds = np.empty(count, np.int64), np.empty((count, 2), np.int32)
    while first < count:
        stop = first
        while stop < count and dual[order[stop]] == dual[order[first]]:
            stop += 1
        for n in range(first, stop):
            e = order[n]
            kinds[n, 0], kinds[n, 1] = ends[e, 3], -1
            if ends[e, 2] == 0:
                odd_front, odd_back = _odd(first, stop, order, ends, e)
                if odd_front == odd_back:
                    kinds[n, 1] = ends[e, 4]
                elif odd_back:
                    kinds[n, 0] = ends[e, 4]
            m = first
            while kinds[m, 0] != kinds[n, 0] or kinds[m, 1] != kinds[n, 1]:
                m += 1
            group[e] = m
        first = stop
    return group


@compiled(inline="always")
def _join(begins, ends, place, tangent, cells_away, partner):
    """Fill `partner` (E,): for each end the other end of its segment, or −1, at the least total cost of each dual cell.

    Only ends with the same part in front are joined, one that leaves it with one that enters it; where two parts
    intersect, either is in front. The least cost of ends i … j of a dual cell is found from that of shorter runs, so
    that no two segments cross.

    Args:
        begins: (Q + 1,) where the ends of each dual cell begin.
        ends: (E, 5), see `ends_of`; clockwise in each dual cell.
        place: (B, 2) x and y of crossings.
        tangent: (B, 2) unit directions of outlines there, either way; 0 where they are unknown.
        cells_away: (B,), see `Crossings.cells_away`.
        partner: (E,) int32, filled with −1.
    """
    for q in range(len(begins) - 1):
        first, n = begins[q], begins[q + 1] - begins[q]
        if n == 2:
            if _cost(first, first + 1, ends, place, tangent, cells_away) < 2 * LONE:
                partner[first], partner[first + 1] = first + 1, first
            continue
        if n < 2:
            continue
        # least[i, m]: the cost of the m ends from i on; step[i, m]: the step from i to its partner, or −1.
        least, step = np.zeros((n + 2, n + 1)), np.full((n + 2, n + 1), -1, np.int32)
        for m in range(1, n + 1):
            for i in range(n - m + 1):
                best, choice = LONE + least[i + 1, m - 1], -1
                for k in range(1, m):
                    cost = _cost(first + i, first + i + k, ends, place, tangent, cells_away)
                    cost += least[i + 1, k - 1] + least[i + k + 1, m - k - 1]
                    best, choice = (cost, k) if cost < best else (best, choice)
                least[i, m], step[i, m] = best, choice
        _read(first, n, step, partner)


@compiled(inline="always")
def _cost(a, b, ends, place, tangent, cells_away):
    """The cost of a segment between two ends; infinite if they cannot be joined."""
    front, back, crosses = ends[a, 3], ends[a, 4], (ends[a, 2] == 0) != (ends[b, 2] == 0)
    other_front, other_back = ends[b, 3], ends[b, 4]
    # A line of intersection goes on as the outline of either surface, or where either intersects a third one.
    if front != other_front and ends[a, 2] == 0 and (back == other_front or (back == other_back and not crosses)):
        front, back = back, front
    if front != other_front and ends[b, 2] == 0 and front == other_back:
        other_front, other_back = other_back, other_front
    p, q = ends[a, 0], ends[b, 0]
    dx, dy, cost = place[q, 0] - place[p, 0], place[q, 1] - place[p, 1], 0.0
    for e in range(2):
        tx, ty = _row(tangent, p if e == 0 else q)
        aside = abs(dx * ty - dy * tx) if tx != 0 or ty != 0 else np.hypot(dx, dy)
        cost += ASIDE * aside + (0.5 - ASIDE) * np.hypot(dx, dy)
    cost += ON_ONE_SIDE * (ends[a, 1] == ends[b, 1]) + OTHER_BEHIND * (back != other_back)
    apart = abs(cells_away[p] - cells_away[q])
    cost += OTHER_DEPTH * apart / (apart + FAR) if apart > 0 else 0.0  # Unknown ones are NaN.
    return np.inf if front != other_front or ends[a, 2] * ends[b, 2] > 0 else cost + OTHER_KIND * crosses


@compiled(inline="always")
def _read(first, n, step, partner):
    """Fill in the partners of the n ends from `first` on, as `step` says of all runs of ends."""
    stack, top = np.empty((2 * n + 2, 2), np.int32), 1
    stack[0] = 0, n
    while top > 0:
        top -= 1
        i, m = stack[top]
        if m < 1:
            continue
        k = step[i, m]
        stack[top] = i + 1, m - 1 if k < 0 else k - 1
        top += 1
        if k >= 0:
            partner[first + i], partner[first + i + k] = first + i + k, first + i
            stack[top] = i + k + 1, m - k - 1
            top += 1


@loop
def segments_of(order, group, dual, ends, place, tangent, cells_away, width):
    """The segments between ends, those of a dual cell after those of the one before; see `outlines.segments.Segments`.

    Args:
        order: (E,) sorts ends by dual cells; in each clockwise, group by group.
        group: (E,) int64, only ends of one group are joined, which is in one dual cell.
        dual: (E,), see `ends_of`.
        ends: (E, 5), see `ends_of`.
        place: (B, 2) x and y of crossings.
        tangent: (B, 2), see `_join`.
        cells_away: (B,), see `Crossings.cells_away`.
        width: number of centres in a line.

    Returns:
        First corners (S, 2) of dual cells, endpoints (S, 2) and sides (S, 2), int32; and `_neighbours` of these.
    """
    count = len(order)
    begins, several, sorted_ends = np.empty(count + 1, np.int64), 0, np.empty((count, 5), np.int32)
    for e in range(count):
        if e == 0 or group[order[e]] != group[order[e - 1]]:
            begins[several] = e
            several += 1
        for i in range(5):
            sorted_ends[e, i] = ends[order[e], i]
    begins[several] = count
    partner = np.full(count, -1, np.int32)
    _join(begins[: several + 1], sorted_ends, place, tangent, cells_away, partner)
    origin = np.empty((count, 2), np.int32)
    endpoints, dual_sides = np.full((count, 2), -1, np.int32), np.full((count, 2), -1, np.int32)
    found = 0
    for e in range(count):
        other, sign = partner[e], sorted_ends[e, 2]
        # Of two ends the one that leaves the front comes first; of two that intersect, the earlier.
        if other >= 0:
            back = sorted_ends[other, 2]
            if not (sign > 0 or (sign == 0 and (back < 0 or (back == 0 and e < other)))):
                continue
        origin[found, 0], origin[found, 1] = dual[order[e]] // width, dual[order[e]] % width
        endpoints[found, 0], dual_sides[found, 0] = sorted_ends[e, 0], sorted_ends[e, 1]
        if other >= 0:
            endpoints[found, 1], dual_sides[found, 1] = sorted_ends[other, 0], sorted_ends[other, 1]
        found += 1
    endpoints = endpoints[:found]
    return origin[:found], endpoints, dual_sides[:found], _neighbours(endpoints, place)


@loop
def ending(kind, parts, triangles):
    """(B,) int64: the triangle that ends at each crossing, of all parts no two alike, or −1."""
    most, found = np.int64(-1), np.empty(len(kind), np.int64)
    for b in range(len(kind)):
        most = max(most, np.int64(triangles[b, 1 if kind[b] == BEHIND_ENDS else 0]))
    for b in range(len(kind)):
        side = 1 if kind[b] == BEHIND_ENDS else 0
        t = triangles[b, side]
        found[b] = t + parts[b, side] * (1 + most) if t >= 0 else -1
    return found


@compiled(inline="always")
def _neighbours(endpoints, place):
    """(S, 4) int32: the last crossing but one along the same outline, the last, the next, and the next but one; or −1.

    Of crossings in one place, which an outline has that passes through a centre, one counts. `endpoints` (S, 2) are the
    ends of segments, between crossings at `place` (B, 2); each crossing ends at most two.
    """
    # The segments at each crossing, as 2 · segment + end.
    at = np.full((len(place), 2), -1, np.int32)
    for s in range(len(endpoints)):
        for e in range(2):
            b = endpoints[s, e]
            if b >= 0:
                at[b, 0 if at[b, 0] < 0 else 1] = 2 * s + e
    found = np.full((len(endpoints), 4), -1, np.int32)
    for s in range(len(endpoints)):
        for e in range(2):
            endpoint = 2 * s + e
            far = 0
            for _ in range(2 * MOST_ALIKE):
                b = endpoints[endpoint // 2, endpoint % 2]
                if b < 0 or far == 2:
                    break
                next_ = at[b, 1] if at[b, 0] == endpoint else at[b, 0]
                if next_ < 0:
                    break
                endpoint = next_ + 1 - 2 * (next_ % 2)  # Its other end.
                c = endpoints[endpoint // 2, endpoint % 2]
                if c < 0 or abs(place[c, 0] - place[b, 0]) + abs(place[c, 1] - place[b, 1]) > ALIKE:
                    found[s, (1 - far) if e == 0 else 2 + far] = c
                    far += 1
    return found


@compiled(inline="always")
def _row(table, n):
    """A row of a table (N, 2) as two numbers."""
    return table[n, 0], table[n, 1]


@compiled(inline="always")
def _minus(a, b):
    """The difference of two vectors."""
    return a[0] - b[0], a[1] - b[1]


@compiled(inline="always")
def _meeting(start, ahead, end, back):
    """Where lines from `start` along `ahead` and to `end` along `back` meet, and True if that is between."""
    turn = ahead[0] * back[1] - ahead[1] * back[0]
    if not abs(turn) > STRAIGHT * np.hypot(ahead[0], ahead[1]) * np.hypot(back[0], back[1]):
        return start, False
    t = ((end[0] - start[0]) * back[1] - (end[1] - start[1]) * back[0]) / turn
    meeting = start[0] + t * ahead[0], start[1] + t * ahead[1]
    there = (end[0] - meeting[0]) * back[0] + (end[1] - meeting[1]) * back[1]
    return meeting, t * np.hypot(ahead[0], ahead[1]) > CLOSE and there > CLOSE * np.hypot(back[0], back[1])


@compiled(inline="always")
def _angle(a, b):
    """The angle between two vectors, 0 to π."""
    return abs(np.arctan2(a[0] * b[1] - a[1] * b[0], a[0] * b[0] + a[1] * b[1]))


@compiled(inline="always")
def _inward(tangent, side):
    """A direction, turned into a dual cell from one of its sides; straight into it where the direction is unknown."""
    into = (tangent[1], -tangent[0], -tangent[1], tangent[0])[side]
    sign = 1.0 if into >= 0 else -1.0
    if tangent[0] == 0 and tangent[1] == 0:
        return (0.0, -1.0, 0.0, 1.0)[side], (1.0, 0.0, -1.0, 0.0)[side]
    return sign * tangent[0], sign * tangent[1]


@compiled(inline="always")
def _within(point, origin, s):
    """True if a point lies in a segment's dual cell, or `CLOSE` to it: vertices may lie on its sides, or corners."""
    x, y = point[0] - origin[s, 1] - 0.5, point[1] - origin[s, 0] - 0.5
    return -CLOSE <= x <= 1 + CLOSE and -CLOSE <= y <= 1 + CLOSE


@loop
def corners(first, last, segments, neighbours, place, tangent, triangle):
    """Fill `corner` (S, 2), from the dual cell's first centre, and `pull` (S, 4) of segments; see `Segments`.

    Where an outline turns at a segment alone, the lines before and after it meet in its corner. Where it turns as much
    at its neighbours, it is a curve. Its tangents at the ends run as from the crossing before each to the one after;
    the curve is two thirds as far from the chord as their meeting. At a tip, which comes back to the side
    of the dual cell that it entered by, the tangents are the edges of the triangles there. An outline that ends alone
    in a dual cell does so half across.

    Args:
        first: the first segment.
        last: the segment after the last.
        segments: the segments, whose `corner` and `pull` are filled.
        neighbours: (S, 4), the result of `_neighbours`.
        place: (B, 2), x and y of crossings.
        tangent: (B, 2), see `_join`.
        triangle: (B,) int64, the triangle that ends at each crossing, or −1.
    """
    origin, endpoints, dual_sides, _, _, corner, pull = segments
    for s in range(first, last):
        start, end = (
            _row(place, endpoints[s, 0]),
            _row(place, endpoints[s, 1] if endpoints[s, 1] >= 0 else endpoints[s, 0]),
        )
        x, y = (start[0] + end[0]) / 2, (start[1] + end[1]) / 2
        if endpoints[s, 1] < 0:  # Straight into the dual cell, as far as its middle.
            side = dual_sides[s, 0]
            x, y = x + (0.0, -0.5, 0.0, 0.5)[side], y + (0.5, 0.0, -0.5, 0.0)[side]
        alone, on, back = 0.0, 0.0, 0.0
        tip = endpoints[s, 1] >= 0 and dual_sides[s, 0] == dual_sides[s, 1]
        if tip:
            a, b = endpoints[s, 0], endpoints[s, 1]
            way, other = _inward(_row(tangent, a), dual_sides[s, 0]), _inward(_row(tangent, b), dual_sides[s, 1])
            curve, between = _meeting(start, way, end, (-other[0], -other[1]))
            tip = between and _within(curve, origin, s)
            share = 1.0 if triangle[a] >= 0 and triangle[a] == triangle[b] else 2 / 3
            if tip:
                x, y = x + share * (curve[0] - x), y + share * (curve[1] - y)
        if neighbours[s, 1] >= 0 and neighbours[s, 2] >= 0:
            before, after = _row(place, neighbours[s, 1]), _row(place, neighbours[s, 2])
            curve, between = _meeting(start, _minus(end, before), end, _minus(after, start))
            if not tip and between and _within(curve, origin, s):
                x, y = x + 2 / 3 * (curve[0] - x), y + 2 / 3 * (curve[1] - y)
            ahead, behind = _minus(start, before), _minus(after, end)
            sharp, between = _meeting(start, ahead, end, behind)
            if between and _within(sharp, origin, s):
                beside = 0.0
                if neighbours[s, 0] >= 0:
                    beside += _angle(_minus(before, _row(place, neighbours[s, 0])), ahead)
                if neighbours[s, 3] >= 0:
                    beside += _angle(behind, _minus(_row(place, neighbours[s, 3]), after))
                alone = min(max(1 - beside / max(_angle(ahead, behind), 1e-6), 0.0), 1.0)
            if alone > 0:
                x, y = x + alone * (sharp[0] - x), y + alone * (sharp[1] - y)
                on = np.hypot(x - start[0], y - start[1]) / np.hypot(ahead[0], ahead[1])
                back = np.hypot(x - end[0], y - end[1]) / np.hypot(behind[0], behind[1])
        chord = _minus(end, start)
        share = (x - start[0]) * chord[0] + (y - start[1]) * chord[1]
        share = min(max(share / max(chord[0] * chord[0] + chord[1] * chord[1], 1e-12), 0.0), 1.0)
        # The corner of two straight lines moves as both of them say; a point of a curve as the ends of its chord do.
        lines = alone if on < 2 and back < 2 else 0.0
        pull[s, 0], pull[s, 3] = -lines * on / 2, -lines * back / 2
        pull[s, 1] = (1 - lines) * (1 - share) + lines * (1 + on) / 2
        pull[s, 2] = (1 - lines) * share + lines * (1 + back) / 2
        corner[s, 0] = min(max(x - (origin[s, 1] + 0.5), 0.0), 1.0)
        corner[s, 1] = min(max(y - (origin[s, 0] + 0.5), 0.0), 1.0)


@compiled(inline="always")
def _towards(start, way, a, b):
    """The point of a straight piece from a to b that is seen nearest along a direction from a point.

    Returns:
        Where on the piece it is, 0 to 1; how far it is off the line in this direction; and how far ahead along it.
    """
    piece, off = _minus(b, a), _minus(a, start)
    turn = way[0] * piece[1] - way[1] * piece[0]
    t = (off[0] * way[1] - off[1] * way[0]) / turn if turn != 0 else 0.5
    t = min(max(t, 0.0), 1.0)
    dx, dy = off[0] + t * piece[0], off[1] + t * piece[1]
    ahead = way[0] * dx + way[1] * dy
    return t, abs(way[0] * dy - way[1] * dx) + max(-ahead, 0.0), ahead


@compiled(inline="always")
def _between(at, start, end):
    """True if a place on the sides of a dual cell comes after `start` and before `end`, clockwise."""
    return start < at < end if start < end else at > start or at < end


@compiled(inline="always")
def _on_segment(origin, s, e, endpoints, place, corner):
    """The end e of a segment, and its corner, from the dual cell's first centre."""
    left, top = origin[s, 1] + 0.5, origin[s, 0] + 0.5
    end = _row(place, endpoints[s, e])
    return (end[0] - left, end[1] - top), _row(corner, s)


@compiled(inline="always")
def _end_at(s, other, way, origin, endpoints, place, clock, corner, kind):
    """Where the outline of the lone crossing of a segment would end at another one; see `join_lone_ends`.

    Returns:
        A place on the other segment, 0 to 2, its corner at 1; how far it is off the way, and how far ahead.
    """
    best, least, nearest = 1.0, np.inf, np.inf
    start = _on_segment(origin, s, 0, endpoints, place, corner)[0]
    for e in range(2):
        end, middle = _on_segment(origin, other, e, endpoints, place, corner)
        t, off, ahead = _towards(start, way, end, middle)
        if off < least - TIE or (off < least + TIE and ahead < nearest - TIE):
            best, least, nearest = t if e == 0 else 2 - t, off, ahead
    # What the other segment bounds lies on the right of its way, and hides what is behind on its left. Seams hide none.
    hidden = kind[endpoints[other, 0]] == SEAM or _between(clock[s, 0], clock[other, 0], clock[other, 1])
    return best, least + (0.0 if hidden else ON_FRONT), nearest


@compiled(inline="always")
def _apart(first, stop, s, other, endpoints, clock):
    """True if a segment of the same dual cell lies between the start of s and another one."""
    at, found = clock[s, 0], False
    for c in range(first, stop):
        low, high = min(clock[c, 0], clock[c, 1]), max(clock[c, 0], clock[c, 1])
        inside = low <= min(clock[other, 0], clock[other, 1]) and max(clock[other, 0], clock[other, 1]) <= high
        between = (at < low or at > high) if inside else low < at < high
        found |= between and c != other and endpoints[c, 1] >= 0
    return found


@compiled(inline="always")
def _cut_at(s, other, origin, endpoints, place, corner):
    """Where a segment crosses another one: the place on that one, 0 to 2, its corner at 1; −1 if it does not."""
    for e in range(2):
        a, b = _on_segment(origin, other, e, endpoints, place, corner)
        piece = _minus(b, a)
        for d in range(2):
            start, end = _on_segment(origin, s, d, endpoints, place, corner)
            way, off = _minus(end, start), _minus(a, start)
            turn = way[0] * piece[1] - way[1] * piece[0]
            if turn == 0:
                continue
            t, u = (off[0] * way[1] - off[1] * way[0]) / turn, (off[0] * piece[1] - off[1] * piece[0]) / turn
            if 0 <= t <= 1 and 0 <= u <= 1:
                return t if e == 0 else 2 - t
    return -1.0


@compiled(inline="always")
def _junction(first, stop, s, way, origin, endpoints, place, clock, junction, corner, kind):
    """The step to the segment, from `first` to `stop`, that one ends at or crosses, 0 for none; and its place there."""
    step, on, least, nearest = 0, 0.0, np.inf, np.inf
    for other in range(max(first, s - REACH), min(stop, s + REACH + 1)):
        if endpoints[other, 1] < 0 or other == s:
            continue
        if endpoints[s, 1] < 0:
            t, off, ahead = _end_at(s, other, way, origin, endpoints, place, clock, corner, kind)
            nearer = off < least - TIE or (off < least + TIE and ahead < nearest - TIE)
            if nearer and not _apart(first, stop, s, other, endpoints, clock):
                step, on, least, nearest = other - s, t, off, ahead
            continue
        low, high = min(clock[other, 0], clock[other, 1]), max(clock[other, 0], clock[other, 1])
        crosses = (low < clock[s, 0] < high) != (low < clock[s, 1] < high)
        for e in range(2):  # Those that begin in one place do not.
            crosses &= abs(clock[s, e] - low) > TIE and abs(clock[s, e] - high) > TIE
        if crosses and other < s and step == 0 and junction[other] == 0:
            on = _cut_at(s, other, origin, endpoints, place, corner)
            step = other - s if on >= 0 else 0
    return step, on


@compiled(inline="always")
def _where_both_end(s, other, origin, endpoints, dual_sides, place, tangent):
    """Where the outlines of two lone crossings of a dual cell meet, from its first centre: ahead, or midway."""
    start, end = _row(place, endpoints[s, 0]), _row(place, endpoints[other, 0])
    way = _inward(_row(tangent, endpoints[s, 0]), dual_sides[s, 0])
    back = _inward(_row(tangent, endpoints[other, 0]), dual_sides[other, 0])
    point, between = _meeting(start, way, end, (-back[0], -back[1]))
    if not (between and _within(point, origin, s)):
        point = (start[0] + end[0]) / 2, (start[1] + end[1]) / 2
    return point[0] - origin[s, 1] - 0.5, point[1] - origin[s, 0] - 0.5


@loop
def join_lone_ends(segments, neighbours, place, tangent, kind):
    """Fill in `junction` of segments, and change what else they have where there is one, `neighbours` (S, 4) included.

    `kind` (B,) is that of `Crossings`; `place` (B, 2) and `tangent` (B, 2) are as of `corners`.

    A lone crossing ends at a segment of its dual cell, since what this bounds hides the rest. The outline goes on along
    its tangent to the first segment on its way. If it meets none, it goes to where it comes nearest to one. Lone
    crossings that have no segment beside them meet in a point. Where light passes through, outlines cross.
    """
    origin, endpoints, dual_sides, junction, _, corner, pull = segments
    count, first = len(endpoints), 0
    # Where segments end on the sides of their dual cells, see `on_sides`.
    clock, on = np.zeros((count, 2)), np.zeros(count)
    for s in range(count):
        for e in range(2):
            if endpoints[s, e] >= 0:
                x, y = _row(place, endpoints[s, e])
                clock[s, e] = on_sides(x - origin[s, 1] - 0.5, y - origin[s, 0] - 0.5, dual_sides[s, e])
    while first < count:
        stop = first + 1
        while stop < count and origin[stop, 0] == origin[first, 0] and origin[stop, 1] == origin[first, 1]:
            stop += 1
        for s in range(first, stop if stop > first + 1 else first):  # One alone in its dual cell meets none.
            way = _inward(_row(tangent, endpoints[s, 0]), dual_sides[s, 0])
            junction[s], on[s] = _junction(first, stop, s, way, origin, endpoints, place, clock, junction, corner, kind)
        lead, alone = -1, True
        for s in range(first, stop):
            if endpoints[s, 1] >= 0 or junction[s] != 0:
                continue
            if lead < 0:
                lead = s
            elif s - lead <= REACH and not _apart(first, stop, s, lead, endpoints, clock):
                if alone:
                    corner[lead, 0], corner[lead, 1] = _where_both_end(
                        lead, s, origin, endpoints, dual_sides, place, tangent
                    )
                alone, junction[s] = False, lead - s
        first = stop
    for s in range(count):
        if junction[s] == 0:
            continue
        other = s + junction[s]
        if junction[other] != 0:  # What crosses another one is no junction: that one is.
            junction[s], on[s] = junction[s] + junction[other], on[other]
            other = s + junction[s]
            if abs(junction[s]) > REACH:
                junction[s] = 0
                continue
        if endpoints[other, 1] < 0:
            corner[s] = corner[other]
            continue
        e = 0 if on[s] < 1 else 1
        share = on[s] if e == 0 else 2 - on[s]
        end, middle = _on_segment(origin, other, e, endpoints, place, corner)
        for a in range(2):
            corner[s, a] = min(max((1 - share) * end[a] + share * middle[a], 0.0), 1.0)
            neighbours[s, 1 + a] = endpoints[other, a]
        pull[s, 0], pull[s, 3] = pull[other, 0] + pull[other, 1], pull[other, 2] + pull[other, 3]
        pull[s, 1], pull[s, 2] = 0.0, 0.0
