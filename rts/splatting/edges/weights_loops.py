"""The weights of colours and motions in the image of `rts.splatting.edges`, from outlines alone. Compiled.

An image is linear in colours; and, with their values as constants, linear in motions. `sums_loops` adds up what is
weighed here.
"""

from __future__ import annotations

import numpy as np

from rts.compiling.loops import compiled, loop
from rts.contracts.records import REACH


@loop
def weigh_breaks(gap, near, slope, rows, inner, pair, places, shown, points, movers, origins, moves):
    """Fill in the weights of breaks; see `rts.contracts.records.Outlines`.

    Args:
        gap: (B, 3).
        near: (B,).
        slope: (B, 2, 2).
        rows: (B, 2).
        inner: (B, 2).
        pair: (B, 2).
        places: (B, 2), the field `points`.
        shown: (B, 2) int32 to fill: the samples that tell colours, or −1.
        points: (B, 2, 2) to fill: x and y of the last samples.
        movers: (B, 2) int32 to fill: the samples that breaks move with, or −1: the last ones, or a pair.
        origins: (B, 2, 2) to fill: x and y of these.
        moves: (B, 2, 3, 2) to fill: motion of breaks along x and y, for motions (x, y, depth) of their two samples.
    """
    for b in range(len(near)):
        paired = pair[b, 0] >= 0
        for i in range(2):
            shown[b, i] = inner[b, i] if rows[b, i] >= 0 and inner[b, i] >= 0 else rows[b, i]
            movers[b, i] = pair[b, i] if paired else rows[b, i]
            points[b, i, 0] = gap[b, 1] + 0.5 + places[b, i] * gap[b, 2]
            points[b, i, 1] = gap[b, 0] + 0.5 + places[b, i] * (1 - gap[b, 2])
        for i in range(2):
            of = min(near[b], 1) if paired else i
            origins[b, i, 0], origins[b, i, 1] = points[b, of, 0], points[b, of, 1]
        moves[b] = 0.0
        if paired:
            for i in range(2):
                moves[b, i, 0, 0], moves[b, i, 1, 1] = 0.5, 0.5
            continue
        if near[b] < 2:
            moves[b, near[b], 0, 0], moves[b, near[b], 1, 1] = 1.0, 1.0
            continue
        square = (slope[b, 0, 0] - slope[b, 1, 0]) ** 2 + (slope[b, 0, 1] - slope[b, 1, 1]) ** 2
        for a in range(2):
            share = -(slope[b, 0, a] - slope[b, 1, a]) / (square if square > 0 else 1.0)
            for i in range(2):
                sign = share if i == 0 else -share
                moves[b, i, 0, a] = -sign * slope[b, i, 0]
                moves[b, i, 1, a] = -sign * slope[b, i, 1]
                moves[b, i, 2, a] = sign


@loop
def in_use(near_ends, ties, beyond):
    """The numbers of breaks and of segments up to the last one that has an effect; arguments as of outlines."""
    segments, breaks = len(ties), len(near_ends)
    while segments > 0 and ties[segments - 1, 0] == ties[segments - 1, 1]:
        segments -= 1
    while breaks > 0 and not (near_ends[breaks - 1, 0] or near_ends[breaks - 1, 1]):
        breaks -= 1
    for s in range(segments):
        for e in range(2):
            breaks = max(breaks, ties[s, e] + 1, beyond[s, e] + 1)
    return breaks, segments


@compiled
def _place(x, y, side):
    """A place on a square's sides, clockwise from the upper left corner, 0 to 4."""
    if side == 0:
        return x
    if side == 1:
        return 1 + y
    return 3 - x if side == 2 else 4 - y


@compiled
def _right_of_bottom(start, end, clockwise, low, high):
    """The length, between two places on the sides, of what lies on the right of the way from `start` to `end`."""
    a, b = (start, end) if clockwise else (end, start)
    between = max(min(max(b, low), high) - min(max(a, low), high), 0.0)
    return high - low - between if clockwise else between


@compiled
def _next_side(side, k, is_first, is_last):
    """The side of a break, 0 or 1, that a square's corner is next to; −1 if another break lies between, or no gap."""
    begins, stops = is_first and k == (0, 1, 3, 0)[side], is_last and k == (1, 2, 2, 3)[side]
    return 0 if begins else (1 if stops else -1)


@compiled
def _point(place, x, y, along):
    """A break's position in the square of a segment, given its place in a gap that starts at (x, y) there."""
    x, y = (x + place, y + 0.0) if along == 1 else (x + 0.0, y + place)
    return min(max(x, 0.0), 1.0), min(max(y, 0.0), 1.0)


@compiled
def _add_flux(flux, s, k, pull, i, lone, t, first, second, dx, dy):
    """Add a straight piece (dx, dy) of a segment, with weights of both jumps, to the flux in its cell k; see below.

    The piece lies at t between start and corner (i = 0), or between corner and end.
    """
    for m in range(4):
        rate = (1 - t) * (m == 1) + t * pull[s, m] if i == 0 else (1 - t) * pull[s, m] + t * (m == 2)
        if lone:
            rate = 1.0 if m == 1 else 0.0
        flux[s, k, 0, m, 0] += rate * first * dy
        flux[s, k, 0, m, 1] -= rate * first * dx
        flux[s, k, 1, m, 0] += rate * second * dy
        flux[s, k, 1, m, 1] -= rate * second * dx


@compiled
def _add_piece(flux, area, s, pull, i, lone, piece, share_of, first, second):
    """Add a straight piece of a segment to the flux in its four cells, and to areas (4,) on the right of the way.

    `piece` are its place t as of `_add_flux`, x and y of its middle, and its way; `share_of` its shares on the right
    and below. `first` and `second` are weights of both jumps.
    """
    t, px, py, dx, dy = piece
    for k in range(4):
        east, south = k == 1 or k == 2, k >= 2
        height = min(max(py - (0.5 if south else 0.0), 0.0), 0.5) if (px >= 0.5) == east else 0.0
        area[k] -= height * dx
        of_cell = (share_of[0] if east else 1 - share_of[0]) * (share_of[1] if south else 1 - share_of[1])
        if of_cell > 0 and (first != 0 or second != 0):
            _add_flux(flux, s, k, pull, i, lone, t, of_cell * first, of_cell * second, dx, dy)


@compiled
def _at_hub(s, hub, found):
    """Fill `found` with the rows of segments that end at another one, or cross it. Returns their number."""
    count = 0
    for h in range(max(s - REACH, 0), min(s + REACH + 1, len(hub))):
        if hub[h] != 0 and h + hub[h] == s:
            found[count] = h
            count += 1
    return count


@compiled
def _weigh_ray(flux, weight, s, i, side, border, ray, rates):
    """Fill in what a break's outline, from its side of a square to a point where others meet, adds to the cells.

    Args:
        flux: see `weigh_segments`; filled in for segment s and jump i.
        weight: (4,) to fill: by how much the colours of the cells' quarters rise with the jump, clockwise.
        s: the segment.
        i: the jump.
        side: the side.
        border: see `weigh_segments`.
        ray: (3, 2), the break, a point between, and where the outlines meet.
        rates: (2, 2, 4), weights of the motions, of the four breaks that pull, at both ends of both pieces.
    """
    cuts, sign = np.empty(4), 1.0 if side < 2 else -1.0
    start = _place(ray[0, 0], ray[0, 1], side)
    for k in range(4):
        low = 2.5 if k == 0 or k == 3 else 2.0
        weight[k] = 0.5 * max(low + 0.5 - max(start, low), 0.0) - (0.25 if side < k else 0.0)
    for n in range(2):
        x, y = ray[n, 0], ray[n, 1]
        wx, wy = ray[n + 1, 0] - x, ray[n + 1, 1] - y
        a = min(max((0.5 - x) / wx, 0.0), 1.0) if abs(wx) > 1e-9 else 0.0
        b = min(max((0.5 - y) / wy, 0.0), 1.0) if abs(wy) > 1e-9 else 0.0
        cuts[0], cuts[1], cuts[2], cuts[3] = 0.0, min(a, b), max(a, b), 1.0
        for m in range(3):
            t, part = (cuts[m] + cuts[m + 1]) / 2, cuts[m + 1] - cuts[m]
            px, py, dx, dy = x + t * wx, y + t * wy, part * wx, part * wy
            right = min(max((px - 0.5) / border + 0.5, 0.0), 1.0)
            below = min(max((py - 0.5) / border + 0.5, 0.0), 1.0)
            for k in range(4):
                east, south = k == 1 or k == 2, k >= 2
                height = min(max(py - (0.5 if south else 0.0), 0.0), 0.5) if (px >= 0.5) == east else 0.0
                weight[k] += height * dx
                of_cell = sign * (right if east else 1 - right) * (below if south else 1 - below)
                for r in range(4):
                    rate = (1 - t) * rates[n, 0, r] + t * rates[n, 1, r]
                    flux[s, k, i, r, 0] += of_cell * rate * dy
                    flux[s, k, i, r, 1] -= of_cell * rate * dx


@compiled
def _along(a, b, point):
    """Where on a straight piece a point lies, 0 to 1, and its squared distance from there."""
    dx, dy = b[0] - a[0], b[1] - a[1]
    square = dx * dx + dy * dy
    t = ((point[0] - a[0]) * dx + (point[1] - a[1]) * dy) / square if square > 0 else 0.0
    t = min(max(t, 0.0), 1.0)
    return t, (a[0] + t * dx - point[0]) ** 2 + (a[1] + t * dy - point[1]) ** 2


@compiled
def _fill_path(s, place, gap, square, ties, corner, path):
    """Fill a path (3, 2): start, corner and end of a segment, from the square's first centre; see `weigh_segments`."""
    for e in range(2):
        b = ties[s, e] if ties[s, e] >= 0 else ties[s, 0]
        path[2 * e] = _point(place[b], gap[b, 1] - square[s, 1], gap[b, 0] - square[s, 0], gap[b, 2])
    path[1] = corner[s]


@compiled
def _fill_ray(s, h, e, of_hub, path, pull, ray, rates):
    """Fill the ray (3, 2) and the rates (2, 2, 4) of an end e of row h, to the corner of segment s; see `_weigh_ray`.

    `of_hub` and `path` are both paths. The ray runs along the segment s from where it meets that, and moves as that.
    """
    ray[0], ray[2], rates[:] = path[2 * e], of_hub[1], 0.0
    rates[0, 0, 1 + e], rates[1, 1] = 1.0, pull[h]
    if s == h:
        ray[1], rates[0, 1] = (path[2 * e] + path[1]) / 2, (rates[0, 0] + pull[s]) / 2
        rates[1, 0] = rates[0, 1]
        return
    first, near = _along(of_hub[0], of_hub[1], path[1])
    second, far = _along(of_hub[2], of_hub[1], path[1])
    t, own = (first, 0) if near <= far else (second, 3)
    ray[1], rates[1, 0] = path[1], t * pull[h]
    rates[1, 0, own] += 1 - t
    share = _along(path[0], path[2], path[1])[0]
    rates[0, 1, 1], rates[0, 1, 2] = 1 - share, share


@compiled
def _weigh_meeting(
    s, others, border, place, gap, near_ends, seen, square, ties, square_sides, corner, pull, share, cell_side, lost,
    flux,
):  # fmt: skip
    """Fill in the weights of a segment s and of those, rows `others`, that end at it or cross it; see `weigh_segments`.

    Each of their outlines goes from its break to the segment's corner, and between them lie as many surfaces.
    """
    most, count = 2 * (1 + len(others)), 0
    ray, rates, of_hub, path = np.empty((3, 2)), np.empty((2, 2, 4)), np.empty((3, 2)), np.empty((3, 2))
    weights, at, sides = np.empty((most, 4)), np.empty(most), np.empty(most, np.int64)
    owners, jumps = np.empty(most, np.int64), np.empty(most, np.int64)
    _fill_path(s, place, gap, square, ties, corner, of_hub)
    for n in range(most):
        owner, e = s if n < 2 else others[n // 2 - 1], n % 2
        if e == 0:
            flux[owner], share[owner], lost[owner], cell_side[owner] = 0.0, 0.0, 0.0, -1
        if ties[owner, e] < 0:
            continue
        side = square_sides[owner, e]
        _fill_path(owner, place, gap, square, ties, corner, path)
        _fill_ray(s, owner, e, of_hub, path, pull, ray, rates)
        _weigh_ray(flux, weights[count], owner, e, side, border, ray, rates)
        owners[count], jumps[count], sides[count], at[count] = owner, e, side, _place(ray[0, 0], ray[0, 1], side)
        for k in range(4):
            share[owner, k, e] = -weights[count, k] if side < 2 else weights[count, k]
        count += 1
    for k in range(4):
        # Clockwise, the breaks before and after the corner, between which its surface lies.
        before, after = -1, -1
        for e in range(count):
            if before < 0 or (sides[e] < k, at[e], sides[e]) > (sides[before] < k, at[before], sides[before]):
                before = e
            if after < 0 or (sides[e] < k, at[e], sides[e]) < (sides[after] < k, at[after], sides[after]):
                after = e
        one, other, i, j = int(sides[before] < 2), int(sides[after] >= 2), jumps[before], jumps[after]
        b, c = ties[owners[before], i], ties[owners[after], j]
        next_b = _next_side(sides[before], k, near_ends[b, 0], near_ends[b, 1])
        next_c = _next_side(sides[after], k, near_ends[c, 0], near_ends[c, 1])
        known = (next_b == one or next_c == other) and next_b != 1 - one and next_c != 1 - other
        if known and seen[b, one] and seen[c, other]:
            cell_side[owners[before], k, i], cell_side[owners[after], k, j] = one, other
            own = max(weights[after, k] - weights[before, k], 0.0) / 2
            lost[owners[before], k, i] = lost[owners[after], k, j] = own


@loop
def weigh_segments(
    first, last, border, place, gap, near_ends, seen, square, ties, square_sides, hub, corner, pull, path, share,
    cell_side, lost, flux,
):  # fmt: skip
    """Fill in the weights of segments; see `rts.contracts.records.Outlines`.

    Args:
        first: the first segment.
        last: the segment after the last.
        border: width, in cells, beside borders of pixels in which both have a share.
        place: (B,) of outlines.
        gap: (B, 3).
        near_ends: (B, 2), `Outlines.ends`.
        seen: (B, 2) bool, is there a sample before and behind?
        square: (S, 2).
        ties: (S, 2).
        square_sides: (S, 2).
        hub: (S,).
        corner: (S, 2).
        pull: (S, 4).
        path: (S, 3, 2) to fill: start, corner and end, from the first corner's centre.
        share: (S, 4, 2) to fill: for each of the square's cells, weights of the jumps at start and end.
        cell_side: (S, 4, 2) int8 to fill: for each cell, the side of both breaks (0 or 1) with the surface that its
            centre shows; −1 if another may lie between.
        lost: (S, 4, 2) to fill: for each cell and break, what is taken away of that surface.
        flux: (S, 4, 2, 4, 2) to fill: for each cell and jump, weights of the motions, along x and y, of the four breaks
            that pull.
    """
    cuts, area, rows = np.empty(4), np.empty(4), np.empty(2 * REACH, np.int64)
    for s in range(first, last):
        if ties[s, 0] == ties[s, 1]:
            path[s], share[s], cell_side[s], lost[s], flux[s] = 0.0, 0.0, -1, 0.0, 0.0
            continue
        lone = ties[s, 1] < 0
        _fill_path(s, place, gap, square, ties, corner, path[s])
        if hub[s] != 0:
            continue  # Its weights are filled in with those of that segment.
        count = _at_hub(s, hub, rows)
        if count > 0:
            of_breaks = place, gap, near_ends, seen
            of_segments = square, ties, square_sides, corner, pull, share, cell_side, lost, flux
            _weigh_meeting(s, rows[:count], border, *of_breaks, *of_segments)
            continue
        flux[s] = 0.0
        side0 = square_sides[s, 0]
        side1 = (side0 + 2) % 4 if lone else square_sides[s, 1]
        if lone:
            along = gap[ties[s, 0], 2]
            path[s, 2, 0] = path[s, 0, 0] if along == 1 else 1 - path[s, 0, 0]
            path[s, 2, 1] = 1 - path[s, 0, 1] if along == 1 else path[s, 0, 1]
            path[s, 1] = (path[s, 0] + path[s, 2]) / 2
        # Clockwise, sides 0 and 1 lead along their gaps; what lies before a start is on the right of the way.
        sign0 = 1.0 if side0 < 2 else -1.0
        sign1 = sign0 if lone else (1.0 if side1 >= 2 else -1.0)
        chord_x, chord_y = path[s, 2, 0] - path[s, 0, 0], path[s, 2, 1] - path[s, 0, 1]
        length = chord_x * chord_x + chord_y * chord_y
        turn = (path[s, 1, 0] - path[s, 0, 0]) * chord_x + (path[s, 1, 1] - path[s, 0, 1]) * chord_y
        turn = turn / length if length > 0 else 0.0
        start, end = _place(path[s, 0, 0], path[s, 0, 1], side0), _place(path[s, 2, 0], path[s, 2, 1], side1)
        # Two sides meet in a corner, which an outline may pass through.
        clockwise = start < end or (start == end and side0 < side1)
        area[0] = area[3] = 0.5 * _right_of_bottom(start, end, clockwise, 2.5, 3.0)
        area[1] = area[2] = 0.5 * _right_of_bottom(start, end, clockwise, 2.0, 2.5)
        for i in range(2):
            x, y = path[s, i, 0], path[s, i, 1]
            wx, wy = path[s, i + 1, 0] - x, path[s, i + 1, 1] - y
            cuts[0], cuts[3] = 0.0, 1.0
            a = min(max((0.5 - x) / wx, 0.0), 1.0) if abs(wx) > 1e-9 else 0.0
            b = min(max((0.5 - y) / wy, 0.0), 1.0) if abs(wy) > 1e-9 else 0.0
            cuts[1], cuts[2] = min(a, b), max(a, b)
            for n in range(3):
                t, part = (cuts[n] + cuts[n + 1]) / 2, cuts[n + 1] - cuts[n]
                if part == 0:
                    continue
                px, py, dx, dy = x + t * wx, y + t * wy, part * wx, part * wy
                u = t * turn if i == 0 else (1 - t) * turn + t
                counts = not lone or abs(px - path[s, 0, 0]) + abs(py - path[s, 0, 1]) <= 0.5
                share_of = min(max((px - 0.5) / border + 0.5, 0.0), 1.0), min(max((py - 0.5) / border + 0.5, 0.0), 1.0)
                piece = t, px, py, dx, dy
                _add_piece(flux, area, s, pull, i, lone, piece, share_of, counts * (1 - u) * sign0, counts * u * sign1)
        for k in range(4):
            # Clockwise, corner k begins side k: it lies on the right of the way between the end and the start.
            after, until = side0 >= k, side1 >= k
            on_right = (after or not until) if clockwise else (after and not until)
            counts = not lone or side0 == k or side0 == (k + 3) % 4
            beside = (area[k] - (0.25 if on_right else 0.0)) / 2 if counts else 0.0
            share[s, k, 0], share[s, k, 1] = sign0 * beside, sign1 * beside
            lost[s, k, 0] = lost[s, k, 1] = abs(beside)
            first, second = int((sign0 > 0) != on_right), int((sign1 > 0) != on_right)
            at_start = _next_side(side0, k, near_ends[ties[s, 0], 0], near_ends[ties[s, 0], 1])
            at_end = -1 if lone else _next_side(side1, k, near_ends[ties[s, 1], 0], near_ends[ties[s, 1], 1])
            known = (at_start == first or at_end == second) and at_start != 1 - first and at_end != 1 - second
            known = known and seen[ties[s, 0], first] and seen[ties[s, 0] if lone else ties[s, 1], second]
            cell_side[s, k, 0], cell_side[s, k, 1] = (first, second) if known else (-1, -1)


@loop
def weigh_sides(place, gap, near_ends, seen, ties, path, joined, normal, cells, sides):
    """Fill in the weights of the surfaces on both sides of breaks.

    Args:
        place: (B,) of outlines.
        gap: (B, 3).
        near_ends: (B, 2), `Outlines.ends`.
        seen: (B, 2) bool, is there a sample before and behind?
        ties: (S, 2).
        path: (S, 3, 2), see `weigh_segments`.
        joined: (2, H, W).
        normal: (B, 2) to fill.
        cells: (B, 2, 3) int32 to fill, for each side: the gap's cell on it (flat), the other one, and the one before,
            if it shows the same surface, else the first again; −1 in first place for a side that does not count.
        sides: (B, 2, 5) to fill: the share of the change that belongs to the first cell; in that cell the weight of the
            colour before, less the cell's own; in the other one that of the last colour, less the one before; and
            those of motions along x and y.
    """
    (height, width), count = joined.shape[1:], len(place)
    for b in range(count):
        normal[b, 0], normal[b, 1] = 1e-6 * gap[b, 2], 1e-6 * (1 - gap[b, 2])
    for s in range(len(ties)):
        if ties[s, 1] < 0 or ties[s, 0] == ties[s, 1]:
            continue
        nx, ny = path[s, 2, 1] - path[s, 0, 1], path[s, 0, 0] - path[s, 2, 0]
        for e in range(2):
            b = ties[s, e]
            # Two segments at a line of crossing may run in opposite directions.
            sign = 1.0 if nx * gap[b, 2] + ny * (1 - gap[b, 2]) >= 0 else -1.0
            normal[b, 0] += sign * nx
            normal[b, 1] += sign * ny
    for b in range(count):
        length = np.hypot(normal[b, 0], normal[b, 1])
        nx, ny = normal[b, 0] / length, normal[b, 1] / length
        y, x, row = gap[b, 0], gap[b, 1], gap[b, 2]
        ahead, step = nx * row + ny * (1 - row), row + (1 - row) * width
        for i in range(2):
            cells[b, i, 0] = -1
            if not (near_ends[b, i] and seen[b, i]):
                continue
            way = 1 - 2 * i
            here = y * width + x + i * step
            length = min(max(place[b] if i == 0 else 1 - place[b], 0.0), 1.0)
            inside, outside = min(length, 0.5), max(length - 0.5, 0.0)
            cells[b, i, 0], cells[b, i, 1], cells[b, i, 2] = here, here + way * step, here
            # The cell before tells the slope, where it shows the same surface, since the way may be short.
            by = y + (2 if i == 1 else -1) * (1 - row)
            bx = x + (2 if i == 1 else -1) * row
            rate = 1 / max(length, 0.5)
            if 0 <= by < height and 0 <= bx < width:
                fy, fx = (by, bx) if i == 0 else (y + (1 - row), x + row)
                if joined[1 - row, fy, fx]:
                    cells[b, i, 2], rate = by * width + bx, 1 / (1 + length)
            sides[b, i, 0] = inside / (length if length > 1e-6 else 1.0)
            sides[b, i, 1] = ahead * ahead * (0.125 - inside**2 / 2)
            sides[b, i, 2] = -ahead * ahead * rate * outside**2 / 2
            sides[b, i, 3], sides[b, i, 4] = -0.5 * way * ahead * nx, -0.5 * way * ahead * ny
