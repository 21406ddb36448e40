"""Spans: the parts of gaps that triangles cover; and the fronts along gaps, the nearest spans. Compiled.

A place along a gap is a number from 0 to 1, from its first centre to its second. A span may reach beyond both. It is
linear in homogeneous coordinates there: its depth is (a + b · place) / (c + d · place).
"""

from __future__ import annotations

import numpy as np

from rts.compiling.loops import compiled, loop
from rts.sampling.sheets_loops import corners_of, edge

TINY = 1e-9
"""Shortest length of a span."""

TOUCH = 1e-6
"""Greatest distance along a gap, and greatest share of the depth, by which the ends of two spans differ where a surface
goes on from one to the other."""

MARGIN = 1e-7
"""Share of the depth by which a span must be nearer than another to come before it."""

NOTHING, FIRST, SECOND = -1, -2, -3
"""In place of a span: nothing is seen; the sample at the first centre; that at the second."""

ALIKE = 1e-5
"""Share of the depth by which a sample at a centre may differ from a span of its surface."""

SHORT = 2e-5
"""Length of a piece of front that counts."""


@loop
def projected(first, last, vertices, rows, seen):
    """Fill `seen` (V, 2) float32: where vertices lie in the image, in cells; NaN for those behind the camera."""
    for v in range(first, last):
        x, y, z = np.float64(vertices[v, 0]), np.float64(vertices[v, 1]), np.float64(vertices[v, 2])
        w = rows[2, 0] * x + rows[2, 1] * y + rows[2, 2] * z + rows[2, 3]
        if w > 0:
            seen[v, 0] = (rows[0, 0] * x + rows[0, 1] * y + rows[0, 2] * z + rows[0, 3]) / w
            seen[v, 1] = (rows[1, 0] * x + rows[1, 1] * y + rows[1, 2] * z + rows[1, 3]) / w
        else:
            seen[v] = np.nan


@compiled
def _within(low, high, count):
    """The first and last of `count` cells from `low` to `high`, which may be farther away than integers reach."""
    return int(min(max(low, 0.0), count)), int(max(min(high, count - 1.0), -1.0))


@compiled
def _crosses(low_x, high_x, low_y, high_y, number):
    """True if a gap with a number meets a box."""
    height, width = number.shape[1:]
    for axis in range(2):  # Along rows, then along columns.
        # Centres are at half cells; a gap reaches over one cell from its first centre on.
        far_x, far_y = (1.5, 0.5) if axis == 0 else (0.5, 1.5)
        first_x, last_x = _within(np.ceil(low_x - far_x), np.floor(high_x - 0.5), width)
        first_y, last_y = _within(np.ceil(low_y - far_y), np.floor(high_y - 0.5), height)
        for y in range(first_y, last_y + 1):
            for x in range(first_x, last_x + 1):
                if number[axis, y, x] >= 0:
                    return True
    return False


@loop
def near_gaps(first, last, faces, seen, keep, number, near):
    """Fill `near` (T,) bool: may a triangle that is kept meet a gap? For `keep` and `number` see `spans_of`."""
    slack = np.float32(0.01)
    for t in range(first, last):
        a, b, c = faces[t, 0], faces[t, 1], faces[t, 2]
        low_x, high_x = min(seen[a, 0], seen[b, 0], seen[c, 0]), max(seen[a, 0], seen[b, 0], seen[c, 0])
        low_y, high_y = min(seen[a, 1], seen[b, 1], seen[c, 1]), max(seen[a, 1], seen[b, 1], seen[c, 1])
        area = (seen[b, 0] - seen[a, 0]) * (seen[c, 1] - seen[a, 1])
        area -= (seen[c, 0] - seen[a, 0]) * (seen[b, 1] - seen[a, 1])
        if np.isnan(area):
            near[t] = True
        elif area * keep < -slack:
            near[t] = False
        else:
            near[t] = _crosses(low_x - slack, high_x + slack, low_y - slack, high_y + slack, number)


@compiled
def _room(table, more):
    """The table, with its rows copied to one twice as long if `more` rows do not fit."""
    if more <= len(table):
        return table
    longer = np.empty((max(2 * len(table), more), table.shape[1]), table.dtype)
    longer[: len(table)] = table
    return longer


@compiled
def _add_spans(t, axis, n, begin, stop, low, high, number, line, corners, count, names, spans):
    """Add a triangle's spans on the gaps from `begin` to `stop` of a line, of which it covers what is from low to high.

    Returns the number of all spans.
    """
    for m in range(begin, stop):
        gap, start, end = (number[axis, n, m] if axis == 0 else number[axis, m, n]), low - 0.5 - m, high - 0.5 - m
        if gap < 0 or min(end, 1.0) - max(start, 0.0) <= TINY:
            continue
        names[count, 0], names[count, 1] = gap, t
        _fill(spans[count], start, end, line, corners, m + 0.5)
        count += 1
    return count


@loop
def spans_of(triangles, rows, vertices, faces, clip, keep, number):
    """Spans of triangles on gaps.

    Args:
        triangles: (M,) the triangles.
        rows: (4, 4), see `corners_of`.
        vertices: (V, 3) of the proxy.
        faces: (T, 3) of the proxy.
        clip: (2, 4) near and far plane, positive on what is seen.
        keep: sign of the determinants of triangles to keep; 0 keeps both.
        number: (2, H, W) int32, numbers of the gaps along rows and along columns; −1 for those not looked at.

    Returns:
        (N, 2) int32, gap and triangle of each span; and (N, 6) float64, its ends, and its depth's a, b, c, d.
    """
    height, width = number.shape[1:]
    names, spans, count = np.empty((64, 2), np.int32), np.empty((64, 6)), 0
    corners, bounds, line = np.empty((3, 4)), np.empty(4), np.empty((6, 2))
    for t in triangles:
        sign = corners_of(t, rows, vertices, faces, corners)
        if not abs(sign) > 0 or sign * keep < 0:  # NaN, too.
            continue
        _bounds(corners, height, width, bounds)
        for axis in range(2):
            along, across = axis, 1 - axis
            least, most = int(max(np.floor(bounds[2 * along] - 0.5), 0)), _last(bounds, along, number)
            for n in range(int(max(np.ceil(bounds[2 * across] - 0.5), 0)), _last(bounds, across, number) + 1):
                if not _any(number, axis, n, least, most):
                    continue
                _on_line(t, corners, sign, clip, vertices, faces, along, n + 0.5, line)
                low, high = _inside(line, bounds[2 * along] - 1.0, bounds[2 * along + 1] + 1.0)
                begin, stop = int(max(np.floor(low - 0.5), 0)), int(min(high - 0.5, number.shape[2 - axis] - 1)) + 1
                names, spans = _room(names, count + stop - begin), _room(spans, count + stop - begin)
                count = _add_spans(t, axis, n, begin, stop, low, high, number, line, corners, count, names, spans)
    return names[:count], spans[:count]


@compiled
def _any(number, axis, n, least, most):
    """True if one of the gaps from `least` to `most` along a line is looked at."""
    for m in range(least, most + 1):
        if (number[axis, n, m] if axis == 0 else number[axis, m, n]) >= 0:
            return True
    return False


@compiled
def _last(bounds, axis, number):
    """The last line, of rows (1) or columns (0), that a box meets."""
    return int(min(np.floor(bounds[2 * axis + 1] - 0.5), number.shape[2 - axis] - 1))


@compiled
def _bounds(corners, height, width, bounds):
    """Fill `bounds` with the least and largest x, then y, of a triangle; those of the grid if it is seen in part."""
    for a in range(2):
        bounds[2 * a], bounds[2 * a + 1] = np.inf, -np.inf
    for c in range(3):
        if not corners[c, 2] > 0:
            bounds[0], bounds[1], bounds[2], bounds[3] = 0.0, width, 0.0, height
            return
        for a in range(2):
            value = corners[c, a] / corners[c, 2]
            bounds[2 * a], bounds[2 * a + 1] = min(bounds[2 * a], value), max(bounds[2 * a + 1], value)
    for a in range(2):  # Against rounding; also keeps what is far outside within integers.
        most = width if a == 0 else height
        bounds[2 * a] = min(max(bounds[2 * a] - 1e-6, -1.0), most + 1.0)
        bounds[2 * a + 1] = max(min(bounds[2 * a + 1] + 1e-6, most + 1.0), -1.0)


@compiled
def _on_line(t, corners, sign, clip, vertices, faces, along, at, line):
    """Fill `line` with functions c + d · x that are positive on what is seen of a triangle along a line of centres.

    Rows 0 to 2 are the edge functions, 3 and 4 the near and the far plane.
    """
    line[3:] = 0.0
    for k in range(3):
        ex, ey, e = edge(corners, k, sign)
        line[k, 0], line[k, 1] = (ey * at + e, ex) if along == 0 else (ex * at + e, ey)
        v = faces[t, k]
        for p in range(2):
            value = clip[p, 3]
            for r in range(3):
                value += clip[p, r] * vertices[v, r]
            line[3 + p, 0] += value * line[k, 0]
            line[3 + p, 1] += value * line[k, 1]


@compiled
def _inside(line, low, high):
    """The interval, within one that is given, where all functions of a line are positive."""
    for k in range(5):
        c, d = line[k, 0], line[k, 1]
        if d > 0:
            low = max(low, -c / d)
        elif d < 0:
            high = min(high, -c / d)
        elif c < 0:
            return 0.0, -1.0
    # An edge along the line, but for rounding, meets it farther away than integers reach.
    return (low, high) if low < high else (0.0, -1.0)


@compiled
def _fill(span, start, end, line, corners, origin):
    """Fill in a span: its ends along a gap that begins at `origin` of a line, and its depth's coefficients."""
    span[0], span[1], span[2:] = start, end, 0.0
    for k in range(3):
        at = line[k, 0] + line[k, 1] * origin
        span[2] += at * corners[k, 3]
        span[3] += line[k, 1] * corners[k, 3]
        span[4] += at
        span[5] += line[k, 1]


@loop
def by_gap(gaps, count):
    """Where the spans of each of `count` gaps begin in a list in their order (count + 1,); and this list (N,)."""
    begins = np.zeros(count + 1, np.int64)
    for gap in gaps:
        begins[gap + 1] += 1
    for g in range(count):
        begins[g + 1] += begins[g]
    order, next_ = np.empty(len(gaps), np.int64), begins[:-1].copy()
    for n in range(len(gaps)):
        order[next_[gaps[n]]] = n
        next_[gaps[n]] += 1
    return begins, order


@compiled
def _z(spans, i, place):
    return (spans[i, 2] + spans[i, 3] * place) / (spans[i, 4] + spans[i, 5] * place)


@compiled
def _nearest(spans, own, place, beyond):
    """The nearest of a gap's spans that covers `place`, and goes on after it; −1 for none."""
    best = NOTHING
    for i in own:
        if spans[i, 0] <= place + beyond and spans[i, 1] > place + beyond:
            if best < 0 or _z(spans, i, place) < _z(spans, best, place):
                best = i
    return best


@compiled
def _next_start(spans, own, place):
    """The least start of a span of a gap at or after a place; infinite if there is none."""
    best = np.inf
    for i in own:
        if spans[i, 1] > place + TOUCH and spans[i, 0] < best:
            best = spans[i, 0]
    return max(best, place)


@compiled
def _overtaken(spans, own, x, place):
    """Where the span x ends, or another comes before it, after `place`; and which one does, or −9."""
    best, by = spans[x, 1], -9
    for i in own:
        low, high = max(place, spans[i, 0]), min(spans[x, 1], spans[i, 1])
        if i == x or high - low <= TINY:
            continue
        z = _z(spans, x, low)
        before, after = _z(spans, i, low) - z, _z(spans, i, high) - _z(spans, x, high)
        if before < -MARGIN * abs(z):
            at = low
        elif after < -MARGIN * abs(z):
            # Linear in homogeneous coordinates, where depths are.
            wide = (spans[i, 4] + spans[i, 5] * low) * (spans[x, 4] + spans[x, 5] * low)
            far = (spans[i, 4] + spans[i, 5] * high) * (spans[x, 4] + spans[x, 5] * high)
            before, after = max(before, 0.0) * wide, after * far
            at = low + (high - low) * before / (before - after)
        else:
            continue
        if at < best - TINY or (by >= 0 and at <= best + TINY and _z(spans, i, at) < _z(spans, by, at)):
            best, by = at, i
    return best, by


@loop
def fronts(first, last, begins, order, spans, names, parts, ends, end_depth, pieces, starts, counts):
    """The fronts along gaps: which span is the nearest, and from which place on.

    Args:
        first: the first gap.
        last: the gap after the last.
        begins: (M + 1,) and
        order: (N,), the result of `by_gap`.
        spans: (N, 6), see `spans_of`.
        names: (N, 2) gap and triangle.
        parts: (N,) int32.
        ends: (M, 2, 2) int32, part and triangle of the samples at both centres; −1 where nothing is seen.
        end_depth: (M, 2) their depths.
        pieces: (2 N + 4 M,) int32 to fill: spans, NOTHING, FIRST or SECOND.
        starts: (2 N + 4 M,) float64 to fill: where they begin.
        counts: (M,) to fill: their number.
    """
    for g in range(first, last):
        own = order[begins[g] : begins[g + 1]]
        base, room, n = 2 * begins[g] + 4 * g, 2 * len(own) + 3, 0
        place, x = 0.0, NOTHING
        for k in range(2):
            _agree(spans, own, ends[g, k, 0] >= 0, end_depth[g, k], k)
        if ends[g, 0, 0] >= 0:
            x = FIRST
            for i in own:
                if parts[i] == ends[g, 0, 0] and names[i, 1] == ends[g, 0, 1] and spans[i, 0] <= TOUCH:
                    x = i
        while n < room:
            pieces[base + n], starts[base + n] = x, place
            n += 1
            if x == NOTHING:
                place = _next_start(spans, own, place)
                if not place < 1 - TOUCH:
                    break
                x = _nearest(spans, own, place, TOUCH)
            elif x == FIRST:
                x = _nearest(spans, own, 0.0, TINY)
            else:
                place, by = _overtaken(spans, own, x, place)
                if place >= (1 - TOUCH if by < 0 else 1.0):
                    break
                x = by if by >= 0 else _nearest(spans, own, place, TOUCH)
        # The sample at the second centre has the last word.
        x, last_part = pieces[base + n - 1], ends[g, 1, 0]
        known = x >= 0 and last_part == parts[x] and ends[g, 1, 1] == names[x, 1]
        if not known and not (x == NOTHING and last_part < 0):
            pieces[base + n], starts[base + n] = (SECOND if last_part >= 0 else NOTHING), 1.0
            n += 1
            # The line runs along an edge that both samples are on: nothing ends there.
            if pieces[base] == FIRST and last_part == ends[g, 0, 0]:
                n = 1
        counts[g] = n


@compiled
def _agree(spans, own, seen, depth, centre):
    """Empty the spans that reach over a centre before what is seen there: they touch the line with an edge alone."""
    for i in own:
        if spans[i, 0] < centre - TOUCH and spans[i, 1] > centre + TOUCH:
            if not seen or _z(spans, i, centre) < depth - ALIKE * abs(depth):
                spans[i, 0], spans[i, 1] = 9.0, 9.0


@compiled
def _goes_on(spans, parts, own, x, place, way):
    """True if a surface that ends (way 1) or starts (way 0) at a place with the span x goes on there with another."""
    for i in own:
        if i != x and parts[i] == parts[x] and abs(spans[i, 1 - way] - place) <= TOUCH:
            if abs(_z(spans, i, place) - _z(spans, x, place)) <= ALIKE * abs(_z(spans, x, place)):
                return True
    return False


@compiled
def _kind(spans, parts, own, a, b, depth, place):
    """How a front ends at a place: 0 or 1, the surface before or behind it ends; 2, they cross; 3, they are one.

    Args:
        spans: (N, 6).
        parts: (N,).
        own: the gap's spans.
        a: the span before; NOTHING or FIRST.
        b: the span behind; NOTHING or SECOND.
        depth: (2,) depths of the samples at both centres.
        place: the place.
    """
    if a == NOTHING or b == NOTHING:
        return 1 if a == NOTHING else 0
    za = _z(spans, a, place) if a >= 0 else depth[0]
    zb = _z(spans, b, place) if b >= 0 else depth[1]
    if abs(za - zb) > ALIKE * max(abs(za), abs(zb)):
        return 0 if za < zb else 1
    # What is seen at a centre goes on beyond it.
    ends = a >= 0 and spans[a, 1] <= place + TOUCH
    ends = ends and not _goes_on(spans, parts, own, a, place, 1)
    starts = b >= 0 and spans[b, 0] >= place - TOUCH
    starts = starts and not _goes_on(spans, parts, own, b, place, 0)
    if ends != starts:
        return 0 if ends else 1
    return 3 if ends else 2


@compiled
def _continues(spans, parts, names, ends, depth, a, b, place):
    """True if two pieces of front, one after the other, are one surface."""
    pa = parts[a] if a >= 0 else (ends[0, 0] if a == FIRST else -1)
    pb = parts[b] if b >= 0 else (ends[1, 0] if b == SECOND else -1)
    if pa != pb or pa < 0:
        return pa == pb
    ta, tb = names[a, 1] if a >= 0 else ends[0, 1], names[b, 1] if b >= 0 else ends[1, 1]
    if ta == tb:
        return True
    za, zb = _z(spans, a, place) if a >= 0 else depth[0], _z(spans, b, place) if b >= 0 else depth[1]
    if abs(za - zb) > ALIKE * max(abs(za), abs(zb)):
        return False
    return (a < 0 or spans[a, 1] <= place + TOUCH) and (b < 0 or spans[b, 0] >= place - TOUCH)


@loop
def breaks(begins, order, spans, names, parts, ends, end_depth, pieces, starts, counts, fine, inner, whole, numbers):
    """Fill in the breaks along gaps, in order, and return their number.

    Args:
        begins: see `fronts`.
        order: see `fronts`.
        spans: see `fronts`.
        names: see `fronts`.
        parts: see `fronts`.
        ends: see `fronts`.
        end_depth: see `fronts`.
        pieces: see `fronts`.
        starts: see `fronts`.
        counts: see `fronts`.
        fine: distance of last samples from breaks.
        inner: distance of the samples that tell colours.
        whole: (P, 10) int32 to fill: gap, kind (0, 1 or 2), parts before and behind, then triangles of the last
            samples, of those that tell colours (before, behind), and 1 for the gap's first break, and for its last.
        numbers: (P, 5) float64 to fill: place of the break, of the last samples, and of those that tell colours.
    """
    count = 0
    for g in range(len(counts)):
        own, base = order[begins[g] : begins[g + 1]], 2 * begins[g] + 4 * g
        begun, a = count, 0
        for n in range(1, counts[g]):
            # A piece that is too short to count belongs to what comes after it.
            if n + 1 < counts[g] and starts[base + n + 1] - starts[base + n] < SHORT:
                continue
            x, y, place = pieces[base + a], pieces[base + n], starts[base + n]
            joined = _continues(spans, parts, names, ends[g], end_depth[g], x, y, place)
            kind = 3 if joined else _kind(spans, parts, own, x, y, end_depth[g], place)
            px, py = _part(parts, ends[g], x), _part(parts, ends[g], y)
            if kind < 3 or px != py:
                kind = 0 if kind == 3 else kind
                whole[count, 0], whole[count, 1], whole[count, 2], whole[count, 3] = g, kind, px, py
                whole[count, 4] = names[x, 1] if x >= 0 else ends[g, 0, 1]
                whole[count, 5] = names[y, 1] if y >= 0 else ends[g, 1, 1]
                whole[count, 8], whole[count, 9] = count == begun, 0
                numbers[count, 0] = place
                numbers[count, 1] = min(max(place - fine, spans[x, 0], 0.0), place) if x >= 0 else place
                numbers[count, 2] = max(min(place + fine, spans[y, 1], 1.0), place) if y >= 0 else place
                count += 1
            a = n
        if count > begun:
            whole[count - 1, 9] = 1
        for b in range(begun, count):
            before = numbers[b - 1, 0] if b > begun else 0.0
            after = numbers[b + 1, 0] if b + 1 < count else 1.0
            for side in range(2):
                last = numbers[b, 1 + side]
                length = last - before if side == 0 else after - last
                at = last - min(inner, length / 2) if side == 0 else last + min(inner, length / 2)
                numbers[b, 3 + side], whole[b, 6 + side] = last, whole[b, 4 + side]
                found = _piece(pieces, starts, base, counts[g], at)
                if found >= 0 and parts[found] == whole[b, 2 + side] and abs(at - last) > TINY:
                    numbers[b, 3 + side], whole[b, 6 + side] = at, names[found, 1]
    return count


@compiled
def _part(parts, ends, x):
    """The part of a piece of front."""
    if x >= 0:
        return parts[x]
    return ends[0, 0] if x == FIRST else (ends[1, 0] if x == SECOND else np.int32(-1))


@compiled
def _piece(pieces, starts, base, count, place):
    """The piece of front at a place of a gap."""
    n = 0
    while n + 1 < count and starts[base + n + 1] <= place:
        n += 1
    return pieces[base + n]
