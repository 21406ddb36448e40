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


@compiled(inline="always")
def _place(x, y, side):
    """A place on a square's sides, clockwise from the upper left corner, 0 to 4."""
    if side == 0:
        return x
    if side == 1:
        return 1 + y
    return 3 - x if side == 2 else 4 - y


@compiled(inline="always")
def _next_side(side, k, is_first, is_last):
    """The side of a break, 0 or 1, that a square's corner is next to; −1 if another break lies between, or no gap."""
    begins, stops = is_first and k == (0, 1, 3, 0)[side], is_last and k == (1, 2, 2, 3)[side]
    return 0 if begins else (1 if stops else -1)


@compiled(inline="always")
def _point(place, x, y, along):
    """A break's position in the square of a segment, given its place in a gap that starts at (x, y) there."""
    x, y = (x + place, y + 0.0) if along == 1 else (x + 0.0, y + place)
    return min(max(x, 0.0), 1.0), min(max(y, 0.0), 1.0)


@compiled(inline="always")
def _at_hub(s, hub, rows):
    """Fill `rows` with a segment's own and those of segments that end at it, or cross it. Returns their number."""
    rows[0], count = s, 1
    for h in range(max(s - REACH, 0), min(s + REACH + 1, len(hub))):
        if hub[h] != 0 and h + hub[h] == s:
            rows[count] = h
            count += 1
    return count


@compiled(inline="always")
def _add_flux(flux, s, k, i, share, rates, p, t, dx, dy):
    """Add a straight piece (dx, dy), at t on piece p of a ray, to the flux in a segment's cell k, for jump i."""
    for r in range(4):
        rate = share * ((1 - t) * rates[p, 0, r] + t * rates[p, 1, r])
        flux[s, k, i, r, 0] += rate * dy
        flux[s, k, i, r, 1] -= rate * dx


@compiled(inline="always")
def _weigh_ray(flux, weight, s, i, n, side, border, ray, rates, other):
    """Fill in what a break's outline, from its side of a square to a point where others meet, adds to the cells.

    Returns the place of the break on the sides.

    Args:
        flux: see `weigh_segments`; filled in for segment s and jump i.
        weight: (N, 4), to fill row n: by how much the colours of the cells' quarters rise with the jump, clockwise.
        s: the segment.
        i: the jump.
        n: the row of `weight`.
        side: the side.
        border: see `weigh_segments`.
        ray: (3, 2), the break, a point between, and where the outlines meet.
        rates: (2, 2, 4), weights of the motions, of the four breaks that pull, at both ends of both pieces.
        other: the sign of the segment's other jump, if the jump changes to the mean of both along the way; else 0.
    """
    sign, start = 1.0 if side < 2 else -1.0, _place(ray[0, 0], ray[0, 1], side)
    for k in range(4):
        low = 2.5 if k == 0 or k == 3 else 2.0
        weight[n, k] = 0.5 * max(low + 0.5 - max(start, low), 0.0) - (0.25 if side < k else 0.0)
    for p in range(2):
        x, y = ray[p, 0], ray[p, 1]
        wx, wy = ray[p + 1, 0] - x, ray[p + 1, 1] - y
        a = min(max((0.5 - x) / wx, 0.0), 1.0) if abs(wx) > 1e-9 else 0.0
        b = min(max((0.5 - y) / wy, 0.0), 1.0) if abs(wy) > 1e-9 else 0.0
        for m in range(3):
            begin, end = (0.0 if m == 0 else (min(a, b) if m == 1 else max(a, b))), 1.0
            if m < 2:
                end = min(a, b) if m == 0 else max(a, b)
            dx, dy, t = (end - begin) * wx, (end - begin) * wy, (begin + end) / 2
            if dx == 0 and dy == 0:
                continue
            px, py = x + t * wx, y + t * wy
            right = min(max((px - 0.5) / border + 0.5, 0.0), 1.0)
            below = min(max((py - 0.5) / border + 0.5, 0.0), 1.0)
            for k in range(4):
                east, south = k == 1 or k == 2, k >= 2
                height = min(max(py - (0.5 if south else 0.0), 0.0), 0.5) if (px >= 0.5) == east else 0.0
                weight[n, k] += height * dx
                of_cell = sign * (right if east else 1 - right) * (below if south else 1 - below)
                if of_cell != 0:
                    own, of_other = (1 - 0.5 * t * abs(other)) * of_cell, -0.5 * t * other * sign * of_cell
                    _add_flux(flux, s, k, i, own, rates, p, t, dx, dy)
                    _add_flux(flux, s, k, 1 - i, of_other, rates, p, t, dx, dy)
    return start


@compiled(inline="always")
def _along(ax, ay, bx, by, x, y):
    """Where on a straight piece from a to b a point lies, 0 to 1, and its squared distance from there."""
    dx, dy = bx - ax, by - ay
    square = dx * dx + dy * dy
    t = ((x - ax) * dx + (y - ay) * dy) / square if square > 0 else 0.0
    t = min(max(t, 0.0), 1.0)
    return t, (ax + t * dx - x) ** 2 + (ay + t * dy - y) ** 2


@compiled(inline="always")
def _fill_path(path, s, place, gap, square, ties, corner):
    """Fill a path (3, 2): start, corner and end of a segment, from the square's first centre."""
    for e in range(2):
        b = ties[s, e] if ties[s, e] >= 0 else ties[s, 0]
        x, y = gap[b, 1] - square[s, 1], gap[b, 0] - square[s, 0]
        path[2 * e, 0], path[2 * e, 1] = _point(place[b], x, y, gap[b, 2])
    path[1, 0], path[1, 1] = corner[s, 0], corner[s, 1]


@compiled(inline="always")
def _fill_ray(s, h, e, of_hub, path, pull, ray, rates):
    """Fill the ray (3, 2) and the rates (2, 2, 4) of an end e of row h, to the corner of segment s; see `_weigh_ray`.

    `of_hub` and `path` are both paths. The ray runs along the segment s from where it meets that, and moves as that.
    """
    t, own, share = 0.0, 1 + e, 0.0
    if s != h:
        x, y = path[1, 0], path[1, 1]
        first, near = _along(of_hub[0, 0], of_hub[0, 1], of_hub[1, 0], of_hub[1, 1], x, y)
        second, far = _along(of_hub[2, 0], of_hub[2, 1], of_hub[1, 0], of_hub[1, 1], x, y)
        t, own = (first, 0) if near <= far else (second, 3)
        share, _ = _along(path[0, 0], path[0, 1], path[2, 0], path[2, 1], x, y)
    for a in range(2):
        ray[0, a], ray[1, a], ray[2, a] = path[2 * e, a], path[1, a], of_hub[1, a]
    for r in range(4):
        rates[0, 0, r] = 1.0 if r == 1 + e else 0.0
        rates[0, 1, r] = pull[s, r] if s == h else (1 - share if r == 1 else (share if r == 2 else 0.0))
        rates[1, 0, r] = t * pull[h, r] + (1 - t if r == own else 0.0)
        rates[1, 1, r] = pull[h, r]


@compiled(inline="always")
def _next_breaks(k, count, sides, at):
    """The rays whose breaks come before and after a corner of a square, clockwise."""
    before, after = 0, 0
    for e in range(1, count):
        if (sides[e] < k, at[e], sides[e]) > (sides[before] < k, at[before], sides[before]):
            before = e
        if (sides[e] < k, at[e], sides[e]) < (sides[after] < k, at[after], sides[after]):
            after = e
    return before, after


@loop
def weigh_segments(
    first, last, border, place, gap, near_ends, seen, square, ties, square_sides, hub, corner, pull, share, cell_side,
    lost, flux,
):  # fmt: skip
    """Fill in the weights of segments; see `rts.contracts.records.Outlines`.

    From each break on a square's sides an outline goes to a point inside, the corner of its segment, or of the one that
    this ends at or crosses. Between the breaks that meet there lie as many surfaces.

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
        share: (S, 4, 2) to fill: for each of the square's cells, weights of the jumps at start and end.
        cell_side: (S, 4, 2) int8 to fill: for each cell, the side of both breaks (0 or 1) with the surface that its
            centre shows; −1 if another may lie between.
        lost: (S, 4, 2) to fill: for each cell and break, what is taken away of that surface.
        flux: (S, 4, 2, 4, 2) to fill: for each cell and jump, weights of the motions, along x and y, of the four breaks
            that pull.
    """
    most = 2 * (2 * REACH + 1)
    rows, owners, jumps = np.empty(most, np.int64), np.empty(most, np.int64), np.empty(most, np.int64)
    sides, weight, at = np.empty(most, np.int64), np.empty((most, 4)), np.empty(most)
    ray, rates, of_hub, path = np.empty((3, 2)), np.empty((2, 2, 4)), np.empty((3, 2)), np.empty((3, 2))
    for s in range(first, last):
        if ties[s, 0] == ties[s, 1]:
            share[s], cell_side[s], lost[s], flux[s] = 0.0, -1, 0.0, 0.0
            continue
        if hub[s] != 0:
            continue  # Its weights are filled in with those of that segment, which has no hub.
        _fill_path(of_hub, s, place, gap, square, ties, corner)
        total, count = _at_hub(s, hub, rows), 0
        both = total == 1 and ties[s, 1] >= 0
        for n in range(total):
            h = rows[n]
            share[h], cell_side[h], lost[h], flux[h] = 0.0, -1, 0.0, 0.0
            _fill_path(path, h, place, gap, square, ties, corner)
            for e in range(2 if ties[h, 1] >= 0 else 1):
                side, other = square_sides[h, e], 0.0
                if both:
                    other = 1.0 if square_sides[h, 1 - e] < 2 else -1.0
                _fill_ray(s, h, e, of_hub, path, pull, ray, rates)
                at[count] = _weigh_ray(flux, weight, h, e, count, side, border, ray, rates, other)
                owners[count], jumps[count], sides[count] = h, e, side
                count += 1
        for k in range(4):
            # Jumps around a point add up to 0; those of colours that change along outlines hardly miss it.
            mean = 0.0
            for e in range(count):
                mean += weight[e, k] / count
            for e in range(count):
                share[owners[e], k, jumps[e]] = mean - weight[e, k] if sides[e] < 2 else weight[e, k] - mean
            # Between the breaks before and after the cell's corner, clockwise, lies the surface that is seen there.
            before, after = _next_breaks(k, count, sides, at)
            one, other, i, j = int(sides[before] < 2), int(sides[after] >= 2), jumps[before], jumps[after]
            b, c = ties[owners[before], i], ties[owners[after], j]
            next_b = _next_side(sides[before], k, near_ends[b, 0], near_ends[b, 1])
            next_c = _next_side(sides[after], k, near_ends[c, 0], near_ends[c, 1])
            known = (next_b == one or next_c == other) and next_b != 1 - one and next_c != 1 - other
            if known and seen[b, one] and seen[c, other]:
                own = max(weight[after, k] - weight[before, k], 0.0) / 2
                cell_side[owners[before], k, i], cell_side[owners[after], k, j] = one, other
                lost[owners[before], k, i] = lost[owners[after], k, j] = own


@compiled(inline="always")
def fill_normals(gap, place, ties, normal):
    """Fill unit normals (B, 2) of outlines at breaks: the mean of their segments'; along the gap for a lone break."""
    for b in range(len(gap)):
        normal[b, 0], normal[b, 1] = 1e-6 * gap[b, 2], 1e-6 * (1 - gap[b, 2])
    for s in range(len(ties)):
        if ties[s, 1] < 0 or ties[s, 0] == ties[s, 1]:
            continue
        start, end = ties[s, 0], ties[s, 1]
        nx = gap[end, 0] - gap[start, 0] + place[end] * (1 - gap[end, 2]) - place[start] * (1 - gap[start, 2])
        ny = gap[start, 1] - gap[end, 1] + place[start] * gap[start, 2] - place[end] * gap[end, 2]
        for b in (start, end):
            # Two segments at a line of crossing may run in opposite directions.
            sign = 1.0 if nx * gap[b, 2] + ny * (1 - gap[b, 2]) >= 0 else -1.0
            normal[b, 0] += sign * nx
            normal[b, 1] += sign * ny
    for b in range(len(gap)):
        length = np.hypot(normal[b, 0], normal[b, 1])
        normal[b, 0] /= length
        normal[b, 1] /= length


@loop
def weigh_sides(place, gap, near_ends, seen, ties, joined, normal, cells, sides):
    """Fill in the weights of the surfaces on both sides of breaks.

    Args:
        place: (B,) of outlines.
        gap: (B, 3).
        near_ends: (B, 2), `Outlines.ends`.
        seen: (B, 2) bool, is there a sample before and behind?
        ties: (S, 2).
        joined: (2, H, W).
        normal: (B, 2) to fill.
        cells: (B, 2, 3) int32 to fill, for each side: the gap's cell on it (flat), the other one, and the one before,
            if it shows the same surface, else the first again; −1 in first place for a side that does not count.
        sides: (B, 2, 5) to fill: the share of the change that belongs to the first cell; in that cell the weight of the
            colour before, less the cell's own; in the other one that of the last colour, less the one before; and
            those of motions along x and y.
    """
    (height, width), count = joined.shape[1:], len(place)
    fill_normals(gap, place, ties, normal)
    for b in range(count):
        nx, ny = normal[b, 0], normal[b, 1]
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
