"""Spans: the parts of gaps that triangles cover; and the fronts along gaps, the nearest spans. Compiled.

A place along a gap is a number from 0 to 1, from its first centre to its second. A span may reach beyond both. It is
linear in homogeneous coordinates there: its depth is (a + b · place) / (c + d · place).
"""

from __future__ import annotations

import numpy as np

from rts.compiling.loops import compiled, loop
from rts.sampling.points_loops import corners_of, edge

TINY = 1e-9
"""Shortest length of a span."""

LAST = 4e-5
"""Distance of last samples from breaks, in cells."""

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

SLACK = np.float32(0.01)
"""By how much boxes of triangles are larger than these, against rounding, in cells."""


@loop
def wanted(first, last, part, joined, met, gaps):
    """Fill `gaps` (2, H, W) bool: something is seen at one of both centres, and no sheet joins them; or `met` is 2.

    Then set `joined`, where it was True if a sheet joins both centres: one part is seen at both.
    """
    height, width = part.shape
    for y in range(first, last):
        for x in range(width):
            seen = part[y, x] >= 0
            across = x + 1 < width and (seen or part[y, x + 1] >= 0) and not joined[0, y, x]
            below = y + 1 < height and (seen or part[y + 1, x] >= 0) and not joined[1, y, x]
            gaps[0, y, x], gaps[1, y, x] = across or met[0, y, x] == 2, below or met[1, y, x] == 2
            joined[0, y, x] = seen and x + 1 < width and part[y, x + 1] == part[y, x]
            joined[1, y, x] = seen and y + 1 < height and part[y + 1, x] == part[y, x]


@loop
def around(gap, cells):
    """Mark, in `cells` (H, W) int8, the cells of gaps (M, 3), and those around: 1 along rows, 2 along columns, 3 both.

    A triangle that is at most a cell wide and high, and meets a gap, has all its vertices in cells that are marked.
    """
    height, width = cells.shape
    for n in range(len(gap)):
        y, x, row = gap[n, 0], gap[n, 1], gap[n, 2]
        for j in range(max(y - 1, 0), min(y + 2 - row, height - 1) + 1):
            for i in range(max(x - 1, 0), min(x + 1 + row, width - 1) + 1):
                cells[j, i] |= 2 - row


@loop
def number(marks, gap, by_row, by_column):
    """Fill in the fields of `Gaps` from marks (2, H, W)."""
    (height, width), count = marks.shape[1:], 0
    for y in range(height):
        for x in range(width):
            by_row[y, x] = count
            if marks[0, y, x]:
                gap[count, 0], gap[count, 1], gap[count, 2] = y, x, 1
                count += 1
    for x in range(width):
        for y in range(height):
            by_column[x, y] = count
            if marks[1, y, x]:
                gap[count, 0], gap[count, 1], gap[count, 2] = y, x, 0
                count += 1


@compiled
def _box(a, b, c, seen, height, width, box):
    """Fill `box` with the least x, largest x, least and largest y of a triangle in the image, and a little around.

    Returns twice its area; NaN, and a box of the whole image, if it is seen in part.
    """
    area = (seen[b, 0] - seen[a, 0]) * (seen[c, 1] - seen[a, 1])
    area -= (seen[c, 0] - seen[a, 0]) * (seen[b, 1] - seen[a, 1])
    if np.isnan(area):
        box[0], box[1], box[2], box[3] = 0.0, width, 0.0, height
        return area
    for axis in range(2):
        box[2 * axis] = min(seen[a, axis], seen[b, axis], seen[c, axis]) - SLACK
        box[2 * axis + 1] = max(seen[a, axis], seen[b, axis], seen[c, axis]) + SLACK
    return area


@compiled
def _range(low, high, count):
    """The first of `count` numbers from `low` to `high`, which may be beyond integers, and the one after the last."""
    return int(min(max(np.ceil(low), 0.0), count)), int(max(min(np.floor(high), count - 1.0), -1.0)) + 1


@loop
def close(first, last, seen, cells, marks):
    """Fill `marks` (V,) int8 with those of the cells (H, W) of vertices; beyond the border, of the nearest cell."""
    height, width = cells.shape
    for v in range(first, last):
        x, y = seen[v, 0], seen[v, 1]
        marks[v] = 0
        if not np.isnan(x):
            marks[v] = cells[int(min(max(y, 0.0), height - 1.0)), int(min(max(x, 0.0), width - 1.0))]


@compiled
def _gaps_of(box, axis, by_row, by_column):
    """The lines of centres that a box meets, then the gaps of each: the first and the one after the last."""
    lines, count = by_row.shape if axis == 0 else by_column.shape
    begin, stop = _range(box[2 - 2 * axis] - 0.5, box[3 - 2 * axis] - 0.5, lines)
    # A gap reaches from its first centre to the next one.
    low, high = _range(box[2 * axis] - 1.5, box[2 * axis + 1] - 0.5, count - 1)
    return begin, stop, low, max(high, low)


@loop
def most_spans(first, last, faces, seen, sides, keep, close, by_row, by_column, most):
    """Fill `most` (T,) int32 with bounds on the numbers of spans of triangles.

    Args:
        first: the first triangle.
        last: the triangle after the last.
        faces: see `spans_of`.
        seen: see `spans_of`.
        sides: (T + 1,) int8, see `silhouettes_loops.turns`.
        keep: see `spans_of`.
        close: (V,), see the loop of this name, of cells `around` gaps.
        by_row: see `Gaps`.
        by_column: see `Gaps`.
        most: to fill.
    """
    box = np.empty(4, np.float32)
    for t in range(first, last):
        most[t] = 0
        if sides[t] * keep < 0:
            continue
        a, b, c = faces[t, 0], faces[t, 1], faces[t, 2]
        axes = 3 if abs(sides[t]) == 2 else close[a] & close[b] & close[c]
        if axes == 0:
            continue
        _box(a, b, c, seen, len(by_row), len(by_column), box)
        for axis in range(2):
            if axes & (1 + axis) == 0:
                continue
            begin, stop, low, high = _gaps_of(box, axis, by_row, by_column)
            table = by_row if axis == 0 else by_column
            for n in range(begin, stop):
                most[t] += table[n, high] - table[n, low]


@loop
def spans_of(
    first, last, triangles, begins, rows, vertices, faces, clip, keep, seen, gap, by_row, by_column, names, spans
):
    """Spans of triangles on gaps.

    Args:
        first: the first triangle.
        last: the triangle after the last.
        triangles: (M,) the triangles.
        begins: (M,) where the spans of each begin.
        rows: (4, 4), see `corners_of`.
        vertices: (V, 3) of the proxy.
        faces: (T, 3) of the proxy.
        clip: (2, 4) near and far plane, positive on what is seen.
        keep: sign of the determinants of triangles to keep; 0 keeps both.
        seen: (V, 2), see `sheets_loops.projected`.
        gap: see `Gaps`.
        by_row: see `Gaps`.
        by_column: see `Gaps`.
        names: (N, 2) int32 to fill, gap and triangle of each span; filled with −1.
        spans: (N, 6) float64 to fill: its ends, and its depth's a, b, c, d.
    """
    corners, box, line = np.empty((3, 4)), np.empty(4, np.float32), np.empty((6, 2))
    for i in range(first, last):
        t, count = triangles[i], begins[i]
        sign = corners_of(t, rows, vertices, faces, corners)
        if not abs(sign) > 0 or sign * keep < 0:  # NaN, too.
            continue
        _box(faces[t, 0], faces[t, 1], faces[t, 2], seen, len(by_row), len(by_column), box)
        cut = _cut(t, clip, vertices, faces)
        for axis in range(2):
            begin, stop, low, high = _gaps_of(box, axis, by_row, by_column)
            table = by_row if axis == 0 else by_column
            for n in range(begin, stop):
                if table[n, low] == table[n, high]:
                    continue
                _on_line(t, corners, sign, clip, cut, vertices, faces, axis, n + 0.5, line)
                least, most = _inside(line, box[2 * axis] - 1.0, box[2 * axis + 1] + 1.0)
                gaps = table[n, low], table[n, high]
                count = _add(t, gaps, least, most, gap[:, 1 - axis], line, corners, names, spans, count)


@compiled
def _add(t, gaps, least, most, centres, line, corners, names, spans, count):
    """Add the spans of a triangle on some gaps of a line, where it is seen from `least` to `most`; returns `count`."""
    for g in range(gaps[0], gaps[1]):
        start, end = least - 0.5 - centres[g], most - 0.5 - centres[g]
        if min(end, 1.0) - max(start, 0.0) <= TINY:
            continue
        names[count, 0], names[count, 1] = g, t
        _fill(spans[count], start, end, line, corners, centres[g] + 0.5)
        count += 1
    return count


@compiled
def _cut(t, clip, vertices, faces):
    """True if the near or the far plane may cut a triangle."""
    for k in range(3):
        v = faces[t, k]
        for p in range(2):
            value = clip[p, 3]
            for r in range(3):
                value += clip[p, r] * vertices[v, r]
            if not value > 0:
                return True
    return False


@compiled
def _on_line(t, corners, sign, clip, cut, vertices, faces, along, at, line):
    """Fill `line` with functions c + d · x that are positive on what is seen of a triangle along a line of centres.

    Rows 0 to 2 are the edge functions, 3 and 4 the near and the far plane, if these may cut the triangle.
    """
    line[3:] = 0.0
    for k in range(3):
        ex, ey, e = edge(corners, k, sign)
        line[k, 0], line[k, 1] = (ey * at + e, ex) if along == 0 else (ex * at + e, ey)
        if not cut:
            continue
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
    """Where the spans of each of `count` gaps begin in a list in their order (count + 1,); and this list.

    `gaps` (N,) are those of spans, or −1.
    """
    begins = np.zeros(count + 1, np.int64)
    for gap in gaps:
        if gap >= 0:
            begins[gap + 1] += 1
    for g in range(count):
        begins[g + 1] += begins[g]
    order, next_ = np.empty(begins[count], np.int64), begins[:-1].copy()
    for n in range(len(gaps)):
        if gaps[n] >= 0:
            order[next_[gaps[n]]] = n
            next_[gaps[n]] += 1
    return begins, order


@compiled
def depth_at(spans, i, place):
    """The depth of a span at a place."""
    return (spans[i, 2] + spans[i, 3] * place) / (spans[i, 4] + spans[i, 5] * place)


@compiled
def _nearest(spans, place, beyond):
    """The nearest of a gap's spans that covers `place`, and goes on after it; −1 for none."""
    best = NOTHING
    for i in range(len(spans)):
        if spans[i, 0] <= place + beyond and spans[i, 1] > place + beyond:
            if best < 0 or depth_at(spans, i, place) < depth_at(spans, best, place):
                best = i
    return best


@compiled
def _next_start(spans, place):
    """The least start of a span of a gap at or after a place; infinite if there is none."""
    best = np.inf
    for i in range(len(spans)):
        if spans[i, 1] > place + TOUCH and spans[i, 0] < best:
            best = spans[i, 0]
    return max(best, place)


@compiled
def _overtaken(spans, x, place):
    """Where the span x ends, or another comes before it, after `place`; and which one does, or −9."""
    best, by = spans[x, 1], -9
    for i in range(len(spans)):
        low, high = max(place, spans[i, 0]), min(spans[x, 1], spans[i, 1])
        if i == x or high - low <= TINY:
            continue
        z = depth_at(spans, x, low)
        before, after = depth_at(spans, i, low) - z, depth_at(spans, i, high) - depth_at(spans, x, high)
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
        if at < best - TINY or (by >= 0 and at <= best + TINY and depth_at(spans, i, at) < depth_at(spans, by, at)):
            best, by = at, i
    return best, by


@compiled
def _fronts(spans, triangles, parts, ends, end_depth, pieces, starts):
    """The fronts along a gap: which span is the nearest, and from which place on. Returns their number.

    Args:
        spans: (N, 6), those of the gap; see `spans_of`.
        triangles: (N,) int32.
        parts: (N,) int32.
        ends: (2, 2) int32, part and triangle of the samples at both centres; −1 where nothing is seen.
        end_depth: (2,) their depths.
        pieces: (2 N + 4,) int32 or more, to fill: spans, NOTHING, FIRST or SECOND.
        starts: (2 N + 4,) float64 or more, to fill: where they begin.
    """
    room, n, place, x = 2 * len(spans) + 3, 0, 0.0, NOTHING
    for k in range(2):
        _agree(spans, ends[k, 0] >= 0, end_depth[k], k)
    if ends[0, 0] >= 0:
        x = FIRST
        for i in range(len(spans)):
            if parts[i] == ends[0, 0] and triangles[i] == ends[0, 1] and spans[i, 0] <= TOUCH:
                x = i
    while n < room:
        pieces[n], starts[n] = x, place
        n += 1
        if x == NOTHING:
            place = _next_start(spans, place)
            if not place < 1 - TOUCH:
                break
            x = _nearest(spans, place, TOUCH)
        elif x == FIRST:
            x = _nearest(spans, 0.0, TINY)
        else:
            place, by = _overtaken(spans, x, place)
            if place >= (1 - TOUCH if by < 0 else 1.0):
                break
            x = by if by >= 0 else _nearest(spans, place, TOUCH)
    # The sample at the second centre has the last word.
    x, last_part = pieces[n - 1], ends[1, 0]
    known = x >= 0 and last_part == parts[x] and ends[1, 1] == triangles[x]
    if not known and not (x == NOTHING and last_part < 0):
        pieces[n], starts[n] = (SECOND if last_part >= 0 else NOTHING), 1.0
        n += 1
        # The line runs along an edge that both samples are on: nothing ends there, nor lies before it.
        if pieces[0] == FIRST and last_part == ends[0, 0] and _all_of(pieces[:n], parts, last_part):
            n = 1
    return n


@compiled
def _all_of(pieces, parts, part):
    """True if no piece of front is another part's."""
    for x in pieces:
        if x >= 0 and parts[x] != part:
            return False
    return True


@compiled
def _agree(spans, seen, depth, centre):
    """Empty the spans that reach over a centre before what is seen there: they touch the line with an edge alone."""
    for i in range(len(spans)):
        if spans[i, 0] < centre - TOUCH and spans[i, 1] > centre + TOUCH:
            if not seen or depth_at(spans, i, centre) < depth - ALIKE * abs(depth):
                spans[i, 0], spans[i, 1] = 9.0, 9.0


@compiled
def _goes_on(spans, parts, x, place, way):
    """True if a surface that ends (way 1) or starts (way 0) at a place with the span x goes on there with another."""
    for i in range(len(spans)):
        if i != x and parts[i] == parts[x] and abs(spans[i, 1 - way] - place) <= TOUCH:
            if abs(depth_at(spans, i, place) - depth_at(spans, x, place)) <= ALIKE * abs(depth_at(spans, x, place)):
                return True
    return False


@compiled
def _kind(spans, triangles, parts, ends, depth, a, b, place):
    """How a front changes at a place: 0 or 1, the surface before or behind it ends; 2, they cross; 3, not at all.

    Args:
        spans: (N, 6), see `_fronts`.
        triangles: (N,).
        parts: (N,).
        ends: (2, 2).
        depth: (2,), of the samples at both centres.
        a: the piece of front before the place.
        b: the piece behind.
        place: the place.
    """
    before, behind = _part(parts, ends, a), _part(parts, ends, b)
    if before < 0 or behind < 0:
        return 3 if before == behind else (1 if before < 0 else 0)
    t, s = triangles[a] if a >= 0 else ends[0, 1], triangles[b] if b >= 0 else ends[1, 1]
    if before == behind and t == s:
        return 3
    za, zb = depth_at(spans, a, place) if a >= 0 else depth[0], depth_at(spans, b, place) if b >= 0 else depth[1]
    if abs(za - zb) > ALIKE * max(abs(za), abs(zb)):
        return 0 if za < zb else 1
    # What is seen at a centre goes on beyond it.
    stops, starts = a >= 0 and spans[a, 1] <= place + TOUCH, b >= 0 and spans[b, 0] >= place - TOUCH
    if before == behind and (a < 0 or stops) and (b < 0 or starts):
        return 3
    stops = stops and not _goes_on(spans, parts, a, place, 1)
    starts = starts and not _goes_on(spans, parts, b, place, 0)
    if stops != starts:
        return 0 if stops else 1
    if not stops:
        return 2
    return 3 if before == behind else 0


@loop
def breaks(first, last, begins, spans, names, parts, ends, end_depth, inner, rows, counts, whole, numbers):
    """Fill in the breaks along gaps, in order.

    Args:
        first: the first gap.
        last: the gap after the last.
        begins: (M + 1,) where the spans of each gap begin.
        spans: (N, 6), see `spans_of`.
        names: (N, 2) gap and triangle.
        parts: (N,) int32.
        ends: (M, 2, 2) int32, part and triangle of the samples at both centres; −1 where nothing is seen.
        end_depth: (M, 2) their depths.
        inner: distance of the samples that tell colours.
        rows: (M,) to fill: the row of `whole` and `numbers` where the breaks of each gap begin.
        counts: (M,) to fill: the number of breaks of each gap.
        whole: (2 N + 4 M, 10) int32 to fill: gap, kind (0, 1 or 2), parts before and behind, then triangles of the last
            samples, of those that tell colours (before, behind), and 1 for the gap's first break, and for its last.
        numbers: (2 N + 4 M, 5) float64 to fill: place of the break, the last samples, and those that tell colours.
    """
    most = 4
    for g in range(first, last):
        most = max(most, 2 * (begins[g + 1] - begins[g]) + 4)
    pieces, starts, at = np.empty(most, np.int32), np.empty(most), 2 * begins[first] + 4 * first
    for g in range(first, last):
        a, b = begins[g], begins[g + 1]
        covers, triangles, of, end, depth = spans[a:b], names[a:b, 1], parts[a:b], ends[g], end_depth[g]
        n = _fronts(covers, triangles, of, end, depth, pieces, starts)
        known = covers, triangles, of, end, depth, pieces[:n], starts[:n]
        rows[g], counts[g] = at, _breaks(known, whole[at:], numbers[at:])
        _inner(known, counts[g], inner, whole[at:], numbers[at:])
        whole[at : at + counts[g], 0] = g
        at += counts[g]


@compiled
def _breaks(gap, whole, numbers):
    """Fill in the breaks between the fronts of a gap, but for the samples that tell colours; returns their number."""
    spans, triangles, parts, ends, depth, pieces, starts = gap
    count, a = 0, 0
    for n in range(1, len(pieces)):
        # A piece that is too short to count belongs to what comes after it.
        if n + 1 < len(pieces) and starts[n + 1] - starts[n] < SHORT:
            continue
        x, y, place = pieces[a], pieces[n], starts[n]
        kind = _kind(spans, triangles, parts, ends, depth, x, y, place)
        a = n
        if kind == 3:
            continue
        whole[count, 1], whole[count, 2], whole[count, 3] = kind, _part(parts, ends, x), _part(parts, ends, y)
        whole[count, 4] = triangles[x] if x >= 0 else ends[0, 1]
        whole[count, 5] = triangles[y] if y >= 0 else ends[1, 1]
        whole[count, 8], whole[count, 9] = count == 0, 0
        numbers[count, 0] = place
        numbers[count, 1] = min(max(place - LAST, spans[x, 0], 0.0), place) if x >= 0 else place
        numbers[count, 2] = max(min(place + LAST, spans[y, 1], 1.0), place) if y >= 0 else place
        count += 1
    if count > 0:
        whole[count - 1, 9] = 1
    return count


@compiled
def _inner(gap, count, inner, whole, numbers):
    """Fill in the samples that tell colours of the breaks of a gap; see `breaks`."""
    _, triangles, parts, _, _, pieces, starts = gap
    for b in range(count):
        before = numbers[b - 1, 0] if b > 0 else 0.0
        after = numbers[b + 1, 0] if b + 1 < count else 1.0
        for side in range(2):
            end = numbers[b, 1 + side]
            length = end - before if side == 0 else after - end
            inward = end - min(inner, length / 2) if side == 0 else end + min(inner, length / 2)
            numbers[b, 3 + side], whole[b, 6 + side] = end, whole[b, 4 + side]
            found = _piece(pieces, starts, inward)
            if found >= 0 and parts[found] == whole[b, 2 + side] and abs(inward - end) > TINY:
                numbers[b, 3 + side], whole[b, 6 + side] = inward, triangles[found]


@compiled
def _part(parts, ends, x):
    """The part of a piece of front."""
    if x >= 0:
        return parts[x]
    return ends[0, 0] if x == FIRST else (ends[1, 0] if x == SECOND else np.int32(-1))


@compiled
def _piece(pieces, starts, place):
    """The piece of front at a place of a gap."""
    n = 0
    while n + 1 < len(pieces) and starts[n + 1] <= place:
        n += 1
    return pieces[n]
