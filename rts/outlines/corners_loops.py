"""Where outlines turn and end in dual cells: the corners of segments, and the junctions of lone ones. Compiled."""

from __future__ import annotations

import numpy as np

from rts.compiling.loops import compiled, loop
from rts.outlines.segments_loops import on_sides, row_of
from rts.outlines.tolerances import PARALLEL, TOUCH


@compiled(inline="always")
def _minus(a, b):
    """The difference of two vectors."""
    return a[0] - b[0], a[1] - b[1]


@compiled(inline="always")
def _meeting(start, ahead, end, back):
    """Where lines from `start` along `ahead` and to `end` along `back` meet, and True if that is between."""
    turn = ahead[0] * back[1] - ahead[1] * back[0]
    if not abs(turn) > PARALLEL * np.hypot(ahead[0], ahead[1]) * np.hypot(back[0], back[1]):
        return start, False
    t = ((end[0] - start[0]) * back[1] - (end[1] - start[1]) * back[0]) / turn
    meeting = start[0] + t * ahead[0], start[1] + t * ahead[1]
    there = (end[0] - meeting[0]) * back[0] + (end[1] - meeting[1]) * back[1]
    return meeting, t * np.hypot(ahead[0], ahead[1]) > TOUCH and there > TOUCH * np.hypot(back[0], back[1])


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
    """True if a point lies in a segment's dual cell, or `TOUCH` off it: vertices may lie on its sides, or corners."""
    x, y = point[0] - origin[s, 1] - 0.5, point[1] - origin[s, 0] - 0.5
    return -TOUCH <= x <= 1 + TOUCH and -TOUCH <= y <= 1 + TOUCH


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
            row_of(place, endpoints[s, 0]),
            row_of(place, endpoints[s, 1] if endpoints[s, 1] >= 0 else endpoints[s, 0]),
        )
        x, y = (start[0] + end[0]) / 2, (start[1] + end[1]) / 2
        if endpoints[s, 1] < 0:  # Straight into the dual cell, as far as its middle.
            side = dual_sides[s, 0]
            x, y = x + (0.0, -0.5, 0.0, 0.5)[side], y + (0.5, 0.0, -0.5, 0.0)[side]
        alone, on, back = 0.0, 0.0, 0.0
        tip = endpoints[s, 1] >= 0 and dual_sides[s, 0] == dual_sides[s, 1]
        if tip:
            a, b = endpoints[s, 0], endpoints[s, 1]
            way, other = _inward(row_of(tangent, a), dual_sides[s, 0]), _inward(row_of(tangent, b), dual_sides[s, 1])
            curve, between = _meeting(start, way, end, (-other[0], -other[1]))
            tip = between and _within(curve, origin, s)
            share = 1.0 if triangle[a] >= 0 and triangle[a] == triangle[b] else 2 / 3
            if tip:
                x, y = x + share * (curve[0] - x), y + share * (curve[1] - y)
        if neighbours[s, 1] >= 0 and neighbours[s, 2] >= 0:
            before, after = row_of(place, neighbours[s, 1]), row_of(place, neighbours[s, 2])
            curve, between = _meeting(start, _minus(end, before), end, _minus(after, start))
            if not tip and between and _within(curve, origin, s):
                x, y = x + 2 / 3 * (curve[0] - x), y + 2 / 3 * (curve[1] - y)
            ahead, behind = _minus(start, before), _minus(after, end)
            sharp, between = _meeting(start, ahead, end, behind)
            if between and _within(sharp, origin, s):
                beside = 0.0
                if neighbours[s, 0] >= 0:
                    beside += _angle(_minus(before, row_of(place, neighbours[s, 0])), ahead)
                if neighbours[s, 3] >= 0:
                    beside += _angle(behind, _minus(row_of(place, neighbours[s, 3]), after))
                turn = _angle(ahead, behind)
                alone = 1 - beside / turn if beside < turn else 0.0
            if alone > 0:
                x, y = x + alone * (sharp[0] - x), y + alone * (sharp[1] - y)
                on = np.hypot(x - start[0], y - start[1]) / np.hypot(ahead[0], ahead[1])
                back = np.hypot(x - end[0], y - end[1]) / np.hypot(behind[0], behind[1])
        chord, square = _minus(end, start), (end[0] - start[0]) ** 2 + (end[1] - start[1]) ** 2
        share = (x - start[0]) * chord[0] + (y - start[1]) * chord[1]
        share = min(max(share / square, 0.0), 1.0) if square > 0 else 0.0
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
def _on_segment(origin, s, e, endpoints, place, corner):
    """The end e of a segment, and its corner, from the dual cell's first centre."""
    left, top = origin[s, 1] + 0.5, origin[s, 0] + 0.5
    end = row_of(place, endpoints[s, e])
    return (end[0] - left, end[1] - top), row_of(corner, s)


@compiled(inline="always")
def _end_at(s, other, way, origin, endpoints, place, corner):
    """Where the outline of the lone crossing of a segment would end at another one; see `join_lone_ends`.

    Returns:
        A place on the other segment, 0 to 2, its corner at 1; how far it is off the way, and how far ahead.
    """
    best, least, nearest = 1.0, np.inf, np.inf
    start = _on_segment(origin, s, 0, endpoints, place, corner)[0]
    for e in range(2):
        end, middle = _on_segment(origin, other, e, endpoints, place, corner)
        t, off, ahead = _towards(start, way, end, middle)
        if off < least - TOUCH or (off < least + TOUCH and ahead < nearest - TOUCH):  # Rounding does not decide.
            best, least, nearest = t if e == 0 else 2 - t, off, ahead
    return best, least, nearest


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
def _junction(cell, s, way, origin, endpoints, place, clock, junction, corner):
    """The step to the segment of a dual cell that segment s ends at or crosses, 0 for none; and its place there.

    `cell` are the first segment there, and the one after the last.
    """
    first, stop = cell
    step, on, least, nearest = 0, 0.0, np.inf, np.inf
    for other in range(first, stop):
        if endpoints[other, 1] < 0 or other == s:
            continue
        if endpoints[s, 1] < 0:
            t, off, ahead = _end_at(s, other, way, origin, endpoints, place, corner)
            nearer = off < least - TOUCH or (off < least + TOUCH and ahead < nearest - TOUCH)
            if nearer and not _apart(first, stop, s, other, endpoints, clock):
                step, on, least, nearest = other - s, t, off, ahead
            continue
        low, high = min(clock[other, 0], clock[other, 1]), max(clock[other, 0], clock[other, 1])
        crosses = (low < clock[s, 0] < high) != (low < clock[s, 1] < high)
        for e in range(2):  # Those that begin in one place do not.
            crosses &= abs(clock[s, e] - low) > TOUCH and abs(clock[s, e] - high) > TOUCH
        if crosses and other < s and step == 0 and junction[other] == 0:
            on = _cut_at(s, other, origin, endpoints, place, corner)
            step = other - s if on >= 0 else 0
    return step, on


@compiled(inline="always")
def _where_both_end(s, other, origin, endpoints, dual_sides, place, tangent):
    """Where the outlines of two lone crossings of a dual cell meet, from its first centre: ahead, or midway."""
    start, end = row_of(place, endpoints[s, 0]), row_of(place, endpoints[other, 0])
    way = _inward(row_of(tangent, endpoints[s, 0]), dual_sides[s, 0])
    back = _inward(row_of(tangent, endpoints[other, 0]), dual_sides[other, 0])
    point, between = _meeting(start, way, end, (-back[0], -back[1]))
    if not (between and _within(point, origin, s)):
        point = (start[0] + end[0]) / 2, (start[1] + end[1]) / 2
    return point[0] - origin[s, 1] - 0.5, point[1] - origin[s, 0] - 0.5


@loop
def join_lone_ends(segments, neighbours, place, tangent):
    """Fill in `junction` of segments, and change what else they have where there is one, `neighbours` (S, 4) included.

    `place` (B, 2) and `tangent` (B, 2) are as of `corners`.

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
                x, y = row_of(place, endpoints[s, e])
                clock[s, e] = on_sides(x - origin[s, 1] - 0.5, y - origin[s, 0] - 0.5, dual_sides[s, e])
    while first < count:
        stop = first + 1
        while stop < count and origin[stop, 0] == origin[first, 0] and origin[stop, 1] == origin[first, 1]:
            stop += 1
        for s in range(first, stop if stop > first + 1 else first):  # One alone in its dual cell meets none.
            way = _inward(row_of(tangent, endpoints[s, 0]), dual_sides[s, 0])
            junction[s], on[s] = _junction((first, stop), s, way, origin, endpoints, place, clock, junction, corner)
        lead, alone = -1, True
        for s in range(first, stop):
            if endpoints[s, 1] >= 0 or junction[s] != 0:
                continue
            if lead < 0:
                lead = s
            elif not _apart(first, stop, s, lead, endpoints, clock):
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
        if endpoints[other, 1] < 0:
            corner[s, 0], corner[s, 1] = corner[other, 0], corner[other, 1]
            continue
        e = 0 if on[s] < 1 else 1
        share = on[s] if e == 0 else 2 - on[s]
        end, middle = _on_segment(origin, other, e, endpoints, place, corner)
        for a in range(2):
            corner[s, a] = min(max((1 - share) * end[a] + share * middle[a], 0.0), 1.0)
            neighbours[s, 1 + a] = endpoints[other, a]
        pull[s, 0], pull[s, 3] = pull[other, 0] + pull[other, 1], pull[other, 2] + pull[other, 3]
        pull[s, 1], pull[s, 2] = 0.0, 0.0
