"""Areas of the regions into which outlines cut dual cells, and boundary terms of outlines that move. Compiled.

The rule is in `benchmarks/accuracy/area_rule.py`, one pixel at a time, in plain NumPy.
"""

from __future__ import annotations

import numpy as np

from rts.compiling.loops import compiled
from rts.outlines.segments_loops import on_sides


@compiled(inline="always")
def _point(place, x, y, along):
    """A crossing's position in the dual cell of a segment, given its place in a gap that starts at (x, y) there."""
    x, y = (x + place, y + 0.0) if along == 1 else (x + 0.0, y + place)
    return min(max(x, 0.0), 1.0), min(max(y, 0.0), 1.0)


@compiled(inline="always")
def _add_term(terms, s, k, i, share, rates, p, t, way):
    """Add a straight piece, `way` (x, y) at t on piece p of a ray, to the term of a segment's cell k, for jump i."""
    for r in range(4):
        rate = share * ((1 - t) * rates[p, 0, r] + t * rates[p, 1, r])
        terms[s, k, i, r, 0] += rate * way[1]
        terms[s, k, i, r, 1] -= rate * way[0]


@compiled(inline="always")
def _weigh_ray(terms, weight, length, s, i, n, side, ray, rates, other):
    """Fill in what a crossing's outline, from its side of a dual cell to a point where others meet, adds to the cells.

    Returns the place of the crossing on the sides.

    Args:
        terms: (N, 4, 2, 4, 2), to fill for segment s and jump i: for each cell and jump, weights of the motions, along
            x and y, of the four crossings that pull.
        weight: (N, 4), to fill row n: the areas of the cells' quarters that lie behind the ray, clockwise, but for a
            constant.
        length: (N, 4), to fill row n: the lengths of the ray in the quarters.
        s: the segment.
        i: the jump.
        n: the row of `weight`.
        side: the side.
        ray: the crossing, a point between, and where the outlines meet: x and y of each.
        rates: (2, 2, 4), weights of the motions, of the four crossings that pull, at both ends of both pieces.
        other: the sign of the segment's other jump, if the jump changes to the mean of both along the way; else 0.
    """
    sign, start = 1.0 if side < 2 else -1.0, on_sides(ray[0][0], ray[0][1], side)
    for k in range(4):
        low = 2.5 if k == 0 or k == 3 else 2.0
        weight[n, k] = 0.5 * max(low + 0.5 - max(start, low), 0.0) - (0.25 if side < k else 0.0)
        length[n, k] = 0.0
    for p in range(1 if ray[1] == ray[2] else 2):
        (x, y), (wx, wy) = (ray[0], ray[1]) if p == 0 else (ray[1], ray[2])
        wx, wy = wx - x, wy - y
        a = min(max((0.5 - x) / wx, 0.0), 1.0) if wx != 0 else 0.0
        b = min(max((0.5 - y) / wy, 0.0), 1.0) if wy != 0 else 0.0
        end = 0.0
        for m in range(3):
            begin, end = end, (min(a, b) if m == 0 else (max(a, b) if m == 1 else 1.0))
            dx, dy, t = (end - begin) * wx, (end - begin) * wy, (begin + end) / 2
            if dx == 0 and dy == 0:
                continue
            px, py = x + t * wx, y + t * wy
            # An edge along a border of two pixels belongs to both.
            right, below = ((px >= 0.5) + (px > 0.5)) / 2, ((py >= 0.5) + (py > 0.5)) / 2
            for k in range(4):
                east, south = k == 1 or k == 2, k >= 2
                height = min(max(py - (0.5 if south else 0.0), 0.0), 0.5) if (px >= 0.5) == east else 0.0
                weight[n, k] += height * dx
                length[n, k] += np.hypot(dx, dy) if (px >= 0.5) == east and (py >= 0.5) == south else 0.0
                of_cell = sign * (right if east else 1 - right) * (below if south else 1 - below)
                if of_cell != 0:
                    own, of_other = (1 - 0.5 * t * abs(other)) * of_cell, -0.5 * t * other * sign * of_cell
                    _add_term(terms, s, k, i, own, rates, p, t, (dx, dy))
                    _add_term(terms, s, k, 1 - i, of_other, rates, p, t, (dx, dy))
    return start


@compiled(inline="always")
def _along(a, b, point):
    """Where on a straight piece from a to b a point lies, 0 to 1, and its squared distance from there."""
    (ax, ay), (x, y) = a, point
    dx, dy = b[0] - ax, b[1] - ay
    square = dx * dx + dy * dy
    t = ((x - ax) * dx + (y - ay) * dy) / square if square > 0 else 0.0
    t = min(max(t, 0.0), 1.0)
    return t, (ax + t * dx - x) ** 2 + (ay + t * dy - y) ** 2


@compiled(inline="always")
def _path(s, place, gap, dual, endpoints, corner):
    """The start, corner and end of a segment, from the dual cell's first centre."""
    a, b = endpoints[s, 0], endpoints[s, 1] if endpoints[s, 1] >= 0 else endpoints[s, 0]
    start = _point(place[a], gap[a, 1] - dual[s, 1], gap[a, 0] - dual[s, 0], gap[a, 2])
    end = _point(place[b], gap[b, 1] - dual[s, 1], gap[b, 0] - dual[s, 0], gap[b, 2])
    return start, (corner[s, 0], corner[s, 1]), end


@compiled(inline="always")
def _meets(path, of_junction):
    """Where a path ends on a half of its junction's, which rate is that of the half's end, and where on the chord."""
    first, near = _along(of_junction[0], of_junction[1], path[1])
    second, far = _along(of_junction[2], of_junction[1], path[1])
    share, _ = _along(path[0], path[2], path[1])
    return (first, 0, share) if near <= far else (second, 3, share)


@compiled(inline="always")
def _fill_rates(rates, s, h, e, t, own, share, pull):
    """Fill the rates (2, 2, 4) of the ray from an end e of row h, to the corner of segment s; see `_weigh_ray`.

    The ray runs along the segment s from where it meets that, and moves as that; t, own and share are of `_meets`, and
    have no effect if s is h, where t is 0.
    """
    for r in range(4):
        rates[0, 0, r] = 1.0 if r == 1 + e else 0.0
        rates[0, 1, r] = pull[s, r] if s == h else (1 - share if r == 1 else (share if r == 2 else 0.0))
        rates[1, 0, r] = t * pull[h, r] + (1 - t if r == own else 0.0)
        rates[1, 1, r] = pull[h, r]


@compiled
def _fill_order(count, sides, at, crossings, order):
    """Fill `order` with the rays of a dual cell, clockwise from its upper left corner by where they start.

    The first comes again at the end, so that each has one after it.
    """
    for e in range(count):
        here = e
        while here > 0:
            other = order[here - 1]
            after = at[other] > at[e] if at[other] != at[e] else (crossings[other] > crossings[e]) == (sides[e] < 2)
            if not (sides[other] > sides[e] or (sides[other] == sides[e] and after)):
                break
            order[here] = other
            here -= 1
        order[here] = e
    order[count] = order[0]


@compiled
def _behind(start, end, corner):
    """The area of a cell's quarter that a straight piece adds to that behind a ray; see `_weigh_ray`."""
    east, south, total = corner == 1 or corner == 2, corner >= 2, 0.0
    (x, y), (wx, wy) = start, (end[0] - start[0], end[1] - start[1])
    a = min(max((0.5 - x) / wx, 0.0), 1.0) if wx != 0 else 0.0
    b = min(max((0.5 - y) / wy, 0.0), 1.0) if wy != 0 else 0.0
    low, high = min(a, b), max(a, b)
    for begin, stop in ((0.0, low), (low, high), (high, 1.0)):
        t = (begin + stop) / 2
        if (x + t * wx >= 0.5) == east:
            total += min(max(y + t * wy - (0.5 if south else 0.0), 0.0), 0.5) * (stop - begin) * wx
    return total


@compiled
def _merge_junctions(first, count, order, junctions, corner, weight, last, open_junctions):
    """Make one junction of those whose rays alternate around a dual cell, since lines to them cross.

    Rays of one go on, straight, to the other.

    Args:
        first: the first segment of the dual cell.
        count: number of rays.
        order: the rays in order, clockwise.
        junctions: the junction of each ray, counted in the dual cell; changed.
        corner: (S, 2), where junctions are.
        weight: (N, 4), see `_add_areas`; changed.
        last: room for a number a junction.
        open_junctions: room for a number a junction.
    """
    for p in range(count):
        last[junctions[order[p]]] = p
    depth = 0
    for p in range(count):
        junction, found = junctions[order[p]], -1
        while depth > 0 and last[open_junctions[depth - 1]] < p:
            depth -= 1
        for d in range(depth):
            if open_junctions[d] == junction:
                found = d
        if found < 0:
            open_junctions[depth], depth = junction, depth + 1
            continue
        for d in range(found + 1, depth):
            other = open_junctions[d]
            start = corner[first + other, 0], corner[first + other, 1]
            end = corner[first + junction, 0], corner[first + junction, 1]
            for e in range(count):
                for k in range(4 if junctions[e] == other else 0):
                    junctions[e] = junction
                    weight[e, k] += _behind(start, end, k)
            last[junction] = max(last[junction], last[other])
        depth = found + 1


@compiled
def _fill_regions(count, order, junctions, region):
    """Fill `region`: for the piece of a dual cell's sides behind each ray, in order, the number of the region there.

    A region reaches from the piece between two rays to others, if these rays end at one junction and no ray of it lies
    between.

    Args:
        count: number of rays.
        order: the rays in order, clockwise.
        junctions: the junction of each ray.
        region: to fill.
    """
    for p in range(count):
        region[p] = p
    for p in range(count):
        last = p - 1 if p > 0 else count - 1
        before = last
        while junctions[order[before]] != junctions[order[p]]:
            before = before - 1 if before > 0 else count - 1
        own, other = region[before], region[last]
        for q in range(count):
            region[q] = own if region[q] == other else region[q]


@compiled(inline="always")
def _add_areas(
    count, order, sides, crossings, junctions, region, weight, length, area, of_junction, corner, cell, centre, shown,
    colors, parts, n,
):  # fmt: skip
    """Add entries of colours for the regions of a dual cell in one of its cells. Returns the new number of entries.

    The cell's own region is the one around its centre, and has the centre's colour, which counts by the whole cell
    already. The others have a mean of the colours beside them, at the crossings where they begin and end; of several
    outlines around a region each counts by its length in the quarter.

    Args:
        count: number of rays.
        order: the rays in order, clockwise.
        sides: the side of the dual cell that each ray starts from.
        crossings: the crossing that it starts from.
        junctions: the junction of each ray.
        region: see `_fill_regions`.
        weight: (N, 4), the area of the cell's quarter behind each ray, clockwise, up to a constant.
        length: (N, 4), the lengths of rays in the cells' quarters.
        area: room for a number a region.
        of_junction: room for two numbers a junction.
        corner: the corner of the dual cell, clockwise from the upper left: 0 to 3.
        cell: the cell's (flat) number.
        centre: the colour of its centre, or −1.
        shown: (B, 2), see `stencil_loops._of_crossings`.
        colors: (E, 3) int32, cells, colours, and the colours that these are taken of, or −1: to fill from `n` on.
        parts: (E,) their weights.
        n: number of entries so far.
    """
    here = -1
    for p in range(count):
        area[p] = 0.0
        here += sides[order[p]] < corner
    own = region[here] if here >= 0 else region[count - 1]
    for p in range(count):
        area[region[p]] += weight[order[p], corner] - weight[order[p + 1], corner]
    area[own] += 0.25
    total = 0.0
    for p in range(count):
        area[p] = max(area[p], 0.0)
        total += area[p]
    # Where lines for outlines cross, what they take twice is shared out.
    scale = 0.25 / total
    if centre >= 0 and area[own] * scale != 0.25:
        colors[n, 0], colors[n, 1], colors[n, 2], parts[n] = cell, centre, -1, area[own] * scale - 0.25
        n += 1
    for r in range(count):
        if r == own or area[r] == 0:
            continue
        for p in range(count):
            of_junction[junctions[p], 0], of_junction[junctions[p], 1] = 0.0, 0.0
        total = 0.0
        for p in range(2 * count):
            ray = order[(p + 1) // 2]  # Of each piece of the sides the rays at both ends.
            if region[p // 2] == r:
                of_junction[junctions[ray], 0] += length[ray, corner] + 1e-9  # Of no length, all count alike.
                of_junction[junctions[ray], 1] += 1
                total += length[ray, corner] + 1e-9
        for p in range(2 * count):
            ray = order[(p + 1) // 2]
            if region[p // 2] != r:
                continue
            share = area[r] * scale * of_junction[junctions[ray], 0] / (total * of_junction[junctions[ray], 1])
            color = shown[crossings[ray], int((sides[ray] < 2) == (p % 2 == 0))]
            if color >= 0:
                colors[n, 0], colors[n, 1], colors[n, 2], parts[n] = cell, color, -1, share
                n += 1
    return n


@compiled(inline="always")
def _add_boundary_terms(s, first, terms, dual, width, endpoints, adjacent, shown, movers, moves, motions, rates, m):
    """Add entries of motions for a segment, with `terms` of those from `first` on. Returns their new number."""
    for j in range(8):
        k, e = j // 2, j % 2
        cell = (dual[s, 0] + (k >= 2)) * width + dual[s, 1] + (k == 1 or k == 2)
        endpoint = endpoints[s, e] if endpoints[s, e] >= 0 else endpoints[s, 0]
        before, behind = shown[endpoint, 0], shown[endpoint, 1]
        for r in range(4 if before != behind else 0):
            x, y = terms[s - first, k, e, r, 0], terms[s - first, k, e, r, 1]
            b = endpoints[s, r - 1] if r == 1 or r == 2 else adjacent[s, r // 3]
            for i in range(2 if b >= 0 and (x != 0 or y != 0) else 0):
                of_x = moves[b, i, 0, 0] * x + moves[b, i, 0, 1] * y
                of_y = moves[b, i, 1, 0] * x + moves[b, i, 1, 1] * y
                of_z = moves[b, i, 2, 0] * x + moves[b, i, 2, 1] * y
                if movers[b, i] >= 0 and (of_x != 0 or of_y != 0 or of_z != 0):
                    motions[m, 0], motions[m, 1], motions[m, 2], motions[m, 3] = cell, movers[b, i], before, behind
                    rates[m, 0], rates[m, 1], rates[m, 2] = of_x, of_y, of_z
                    m += 1
    return m


@compiled
def add_dual_cells(begin, end, outlines, shown, at_centres, entries):
    """Add the entries of segments, dual cell after dual cell, of those that have cells in lines `begin` to `end`.

    From each crossing on a dual cell's sides a ray goes to a junction inside: the corner of its segment, or of the one
    that this ends at or crosses. Between the rays lie regions. Other arguments as of `stencil_loops._add_sides`.

    Returns:
        The numbers of entries of colours, and of motions.
    """
    width, most, stop, first, n, m = at_centres.shape[1], 1, 0, 0, 0, 0
    (dual, endpoints, dual_sides, junction, adjacent, corner, pull), gap = outlines.segments, outlines.gap
    place, beside, movers, moves = outlines.place, shown.colors, shown.movers, shown.moves
    colors, parts, motions, speeds = entries
    for s in range(1, len(dual)):  # The most segments of one dual cell.
        stop = stop if dual[s, 0] == dual[stop, 0] and dual[s, 1] == dual[stop, 1] else s
        most = max(most, s + 1 - stop)
    sides, crossings = np.empty(2 * most, np.int64), np.empty(2 * most, np.int64)
    order, junctions = np.empty(2 * most + 1, np.int64), np.empty(2 * most, np.int64)
    region = np.empty(2 * most, np.int64)
    last, open_junctions = np.empty(most, np.int64), np.empty(most, np.int64)
    weight, length, of_junction = np.empty((2 * most, 4)), np.empty((2 * most, 4)), np.empty((most, 2))
    at, area = np.empty(2 * most), np.empty(2 * most)
    terms, members = np.empty((most, 4, 2, 4, 2)), np.empty(most, np.int64)
    rates = np.empty((2, 2, 4))
    while first < len(dual):
        stop, count = first + 1, 0
        while stop < len(dual) and dual[stop, 0] == dual[first, 0] and dual[stop, 1] == dual[first, 1]:
            stop += 1
        if not begin - 1 <= dual[first, 0] < end:
            first = stop
            continue
        terms[: stop - first] = 0.0
        for s in range(first, stop):
            members[s - first] = 0
        for s in range(first, stop):
            members[s + junction[s] - first] += endpoints[s, 0] != endpoints[s, 1]
        for s in range(first, stop):
            if endpoints[s, 0] == endpoints[s, 1]:
                continue
            leader = s + junction[s]
            both = members[leader - first] == 1 and endpoints[s, 1] >= 0
            path, t, own, share = _path(s, place, gap, dual, endpoints, corner), 0.0, 0, 0.0
            if leader != s:
                t, own, share = _meets(path, _path(leader, place, gap, dual, endpoints, corner))
            for e in range(2 if endpoints[s, 1] >= 0 else 1):
                side, other = dual_sides[s, e], 0.0
                if both:
                    other = 1.0 if dual_sides[s, 1 - e] < 2 else -1.0
                _fill_rates(rates, leader, s, e, t, own, share, pull)
                ray = path[2 * e], path[1], (corner[leader, 0], corner[leader, 1])
                at[count] = _weigh_ray(terms, weight, length, s - first, e, count, side, ray, rates, other)
                sides[count], crossings[count], junctions[count] = side, endpoints[s, e], leader - first
                count += 1
        if count > 0:
            _fill_order(count, sides, at, crossings, order)
            if count > 3:  # Fewer rays do not alternate.
                _merge_junctions(first, count, order, junctions, corner, weight, last, open_junctions)
            _fill_regions(count, order, junctions, region)
            for k in range(4):
                y, x = dual[first, 0] + (k >= 2), dual[first, 1] + (k == 1 or k == 2)
                n = _add_areas(
                    count, order, sides, crossings, junctions, region, weight, length, area, of_junction, k,
                    y * width + x, at_centres[y, x], beside, colors, parts, n,
                )  # fmt: skip
        for s in range(first, stop):
            if endpoints[s, 0] != endpoints[s, 1]:
                m = _add_boundary_terms(
                    s, first, terms, dual, width, endpoints, adjacent, beside, movers, moves, motions, speeds, m
                )
        first = stop
    return n, m
