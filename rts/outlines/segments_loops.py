"""Crossings on the sides of a dual cell, joined into segments that do not cross within a part. Compiled."""

from __future__ import annotations

import numpy as np

from rts.compiling.loops import compiled, loop
from rts.outlines.edge_kinds import BEFORE_ENDS, BEHIND_ENDS, INTERSECT, SEAM
from rts.outlines.tolerances import ASIDE, FAR, LONE, ON_ONE_SIDE, OTHER_BEHIND, TOUCH, UNLIKE


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
        at = min(max(at, 0.0), 1 - TOUCH)  # Before what starts at the next side.
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
    """The cost of a segment between two ends, in cells; infinite if they cannot be joined.

    It is how far the segment leads off the outline's direction at both ends, and its length; more if it joins what is
    unlike.
    """
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
        tx, ty = row_of(tangent, p if e == 0 else q)
        aside = abs(dx * ty - dy * tx) if tx != 0 or ty != 0 else np.hypot(dx, dy)
        cost += ASIDE * aside + (0.5 - ASIDE) * np.hypot(dx, dy)
    cost += ON_ONE_SIDE * (ends[a, 1] == ends[b, 1]) + OTHER_BEHIND * (back != other_back)
    apart = abs(cells_away[p] - cells_away[q])
    cost += UNLIKE * apart / (apart + FAR) if apart > 0 else 0.0  # Unknown ones are NaN.
    return np.inf if front != other_front or ends[a, 2] * ends[b, 2] > 0 else cost + UNLIKE * crosses


@compiled(inline="always")
def _read(first, n, step, partner):
    """Fill in the partners of the n ends from `first` on, as `step` says of all runs of ends."""
    stack, top = np.empty((2 * n + 2, 2), np.int32), 1
    stack[0, 0], stack[0, 1] = 0, n
    while top > 0:
        top -= 1
        i, m = stack[top, 0], stack[top, 1]
        if m < 1:
            continue
        k = step[i, m]
        stack[top, 0], stack[top, 1] = i + 1, m - 1 if k < 0 else k - 1
        top += 1
        if k >= 0:
            partner[first + i], partner[first + i + k] = first + i + k, first + i
            stack[top, 0], stack[top, 1] = i + k + 1, m - k - 1
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
            for _ in range(8):  # A centre is the end of four gaps.
                b = endpoints[endpoint // 2, endpoint % 2]
                if b < 0 or far == 2:
                    break
                next_ = at[b, 1] if at[b, 0] == endpoint else at[b, 0]
                if next_ < 0:
                    break
                endpoint = next_ + 1 - 2 * (next_ % 2)  # Its other end.
                c = endpoints[endpoint // 2, endpoint % 2]
                if c < 0 or abs(place[c, 0] - place[b, 0]) + abs(place[c, 1] - place[b, 1]) > TOUCH:
                    found[s, (1 - far) if e == 0 else 2 + far] = c
                    far += 1
    return found


@compiled(inline="always")
def row_of(table, n):
    """A row of a table (N, 2) as two numbers."""
    return table[n, 0], table[n, 1]
