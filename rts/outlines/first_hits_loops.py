"""First hits along gaps, the nearest spans, and the crossings between them. Compiled.

Places and spans are those of `rts.outlines.spans_loops`.
"""

from __future__ import annotations

import numpy as np

from rts.compiling.loops import compiled, loop
from rts.outlines.edge_kinds import BEFORE_ENDS, BEHIND_ENDS, INTERSECT, SEAM
from rts.outlines.tolerances import ALIKE, CREASE, TOUCH

EMPTY = -9.0
"""The end of a span that covers nothing, before its start."""

NOTHING, FIRST, SECOND = -1, -2, -3
"""In place of a span: nothing is seen; the sample at the first centre; that at the second."""


@compiled(inline="always")
def depth_at(spans, i, place):
    """The depth of a span at a place."""
    return (spans[i, 2] + spans[i, 3] * place) / (spans[i, 4] + spans[i, 5] * place)


@compiled(inline="always")
def _rest(spans, begin, stop, place):
    """The first of a gap's spans, `begin` to `stop`, which are sorted by starts, that may not have ended at a place."""
    while begin < stop and spans[begin, 1] <= place:
        begin += 1
    return begin


@compiled(inline="always")
def _nearest(spans, begin, stop, place, beyond):
    """The nearest of a gap's spans, `begin` to `stop`, that covers `place`, and goes on after it; −1 for none."""
    best, z, i = NOTHING, np.inf, begin
    while i < stop and spans[i, 0] <= place + beyond:
        if spans[i, 1] > place + beyond:
            deep = depth_at(spans, i, place)
            best, z = (i, deep) if best < 0 or deep < z else (best, z)
        i += 1
    return best


@compiled(inline="always")
def _next_start(spans, begin, stop, place):
    """The least start of a span of a gap at or after a place; infinite if there is none."""
    i = _rest(spans, begin, stop, place + TOUCH)
    return max(spans[i, 0], place) if i < stop else np.inf


@compiled(inline="always")
def _overtaken(spans, begin, stop, x, place):
    """Where the span x ends, or another comes before it, after `place`; and which one does, or −9."""
    best, by, i = spans[x, 1], -9, begin - 1
    while i + 1 < stop and spans[i + 1, 0] <= best:
        i += 1
        low, high = max(place, spans[i, 0]), min(spans[x, 1], spans[i, 1])
        if i == x or high <= low:
            continue
        z = depth_at(spans, x, low)
        before, after = depth_at(spans, i, low) - z, depth_at(spans, i, high) - depth_at(spans, x, high)
        if before < -ALIKE * abs(z):
            at = low
        elif after < -ALIKE * abs(z):
            # Linear in homogeneous coordinates, where depths are.
            wide = (spans[i, 4] + spans[i, 5] * low) * (spans[x, 4] + spans[x, 5] * low)
            far = (spans[i, 4] + spans[i, 5] * high) * (spans[x, 4] + spans[x, 5] * high)
            before, after = max(before, 0.0) * wide, after * far
            at = low + (high - low) * before / (before - after)
        else:
            continue
        if at < best or (by >= 0 and at == best and depth_at(spans, i, at) < depth_at(spans, by, at)):
            best, by = at, i
    return best, by


@compiled(inline="always")
def _first_hits(g, on_gap, spans, names, parts, ends, end_depth, pieces, starts):
    """The first hits along a gap: which span is the nearest, and from which place on. Returns their number.

    Args:
        g: the gap.
        on_gap: its first span, and the one after its last.
        spans: see `crossings`.
        names: see `crossings`.
        parts: see `crossings`.
        ends: see `crossings`.
        end_depth: see `crossings`.
        pieces: (2 N + 4,) int64 or more for its N spans, to fill: spans, NOTHING, FIRST or SECOND.
        starts: (2 N + 4,) float64 or more, to fill: where they begin.
    """
    begin, stop = on_gap
    room, n, place, until, x = 2 * (stop - begin) + 3, 0, 0.0, 1.0, NOTHING
    for k in range(2):
        _agree(spans, begin, stop, ends[g, k, 0] >= 0, end_depth[g, k], k)
    if ends[g, 0, 0] >= 0:
        x = FIRST
        for i in range(begin, stop):
            covers = spans[i, 0] <= TOUCH and spans[i, 1] > spans[i, 0]
            if covers and parts[i] == ends[g, 0, 0] and names[i, 1] == ends[g, 0, 1]:
                x = i
    while n < room and place < until:
        pieces[n], starts[n] = x, place
        begin = _rest(spans, begin, stop, place)
        n, by, beyond = n + 1, -9, TOUCH
        if x == NOTHING:
            place = _next_start(spans, begin, stop, place)
        elif x == FIRST:
            beyond = 0.0
        else:
            place, by = _overtaken(spans, begin, stop, x, place)
        until = 1 - TOUCH if by < 0 else 1.0
        x = by if by >= 0 else _nearest(spans, begin, stop, place, beyond)
    # The sample at the second centre has the last word.
    x, last_part = pieces[n - 1], ends[g, 1, 0]
    known = x >= 0 and last_part == parts[x] and ends[g, 1, 1] == names[x, 1]
    if not known and not (x == NOTHING and last_part < 0):
        pieces[n], starts[n] = (SECOND if last_part >= 0 else NOTHING), 1.0
        n += 1
        # The line runs along an edge that both samples are on: nothing ends there, nor lies before it.
        if pieces[0] == FIRST and last_part == ends[g, 0, 0] and _all_of(pieces, n, parts, last_part):
            n = 1
    return n


@compiled(inline="always")
def _all_of(pieces, count, parts, part):
    """True if none of some pieces of front is another part's."""
    found = True
    for n in range(count):
        found &= pieces[n] < 0 or parts[pieces[n]] == part
    return found


@compiled(inline="always")
def _agree(spans, begin, stop, seen, depth, centre):
    """Empty the spans that reach over a centre before what is seen there: they touch the line with an edge alone."""
    for i in range(begin, stop):
        if spans[i, 0] < centre - TOUCH and spans[i, 1] > centre + TOUCH:
            if not seen or depth_at(spans, i, centre) < depth - ALIKE * abs(depth):
                spans[i, 1] = EMPTY


@compiled(inline="always")
def _goes_on(spans, begin, stop, parts, x, place, way):
    """True if a surface that ends (way 1) or starts (way 0) at a place with the span x goes on there with another."""
    found, z, i = False, depth_at(spans, x, place), begin
    while i < stop and spans[i, 0] <= place + TOUCH:
        touches = abs(spans[i, 1 - way] - place) <= TOUCH and spans[i, 1] > spans[i, 0]
        if touches and i != x and parts[i] == parts[x]:
            found |= abs(depth_at(spans, i, place) - z) <= ALIKE * abs(z)
        i += 1
    return found


@compiled(inline="always")
def _kind(before, behind, nearer, stops, starts):
    """How a front changes at a place: BEFORE_ENDS, BEHIND_ENDS or INTERSECT; −1, not at all.

    Where two parts meet at an edge of both, the kind is SEAM.

    Args:
        before: the part before the place, or −1.
        behind: the part behind, or −1.
        nearer: 0 if the surface before is nearer, 1 if that behind is; −1 if they meet.
        stops: True if the surface before ends there, and goes on with no other span.
        starts: True if that behind starts there, and comes from no other.
    """
    kind = -1
    if before < 0 or behind < 0:
        if before != behind:
            kind = BEHIND_ENDS if before < 0 else BEFORE_ENDS
    elif nearer >= 0:
        kind = nearer
    elif stops != starts:
        kind = BEFORE_ENDS if stops else BEHIND_ENDS
    elif not stops:
        kind = INTERSECT
    elif before != behind:
        kind = SEAM
    return kind


@compiled(inline="always")
def is_seam(x, y, first_kind, second_kind, spans):
    """True if a surface that goes on from the span x to y does so across a seam, and they are large, or turn there.

    The kinds are the last numbers of their `names`, see `spans_loops.spans_of`.
    """
    if first_kind & 2 == 0 or second_kind & 1 == 0:
        return False
    if first_kind & second_kind & 4 != 0:
        return True
    return spans[x, 6] * spans[y, 6] + spans[x, 7] * spans[y, 7] + spans[x, 8] * spans[y, 8] < CREASE


@loop
def crossings(
    first, last, gap, begins, spans, names, parts, seen, triangle, depth, ends, end_depth, inner, rows, counts, whole,
    numbers,
):  # fmt: skip
    """Fill in the crossings along gaps, in order.

    The helpers take these arrays whole, with a gap's number and range of spans: a view of an array costs as much as a
    span, since threads count its references in turns.

    Args:
        first: the first gap.
        last: the gap after the last.
        gap: (M, 3), see `Gaps`.
        begins: (M + 1,) where the spans of each gap begin.
        spans: (N, 6) or (N, 9), see `spans_loops.spans_of`; those of a gap sorted by where they start.
        names: (N, 3), see `spans_loops.spans_of`.
        parts: (N,) int32.
        seen: (H, W) int32, the parts seen at centres, or −1.
        triangle: (H, W) int32, and their triangles.
        depth: (H, W) float64.
        ends: (M, 2, 2) int32 to fill: part and triangle of the samples at both centres; −1 where nothing is seen.
        end_depth: (M, 2) to fill: their depths.
        inner: distance of the samples that tell colours.
        rows: (M,) to fill: the row of `whole` and `numbers` where the crossings of each gap begin.
        counts: (M,) to fill: the number of crossings of each gap.
        whole: (2 N + 4 M, 10) int32 to fill: gap, kind (see `_kind`, or SEAM), parts before and behind, then triangles
            of the last samples, of those that tell colours (before, behind), and 1 for the gap's first crossing, and
            for its last.
        numbers: (2 N + 4 M, 5) float64 to fill: place of the crossing, the last samples, and those that tell colours.
    """
    most = 4
    for g in range(first, last):
        most = max(most, 2 * (begins[g + 1] - begins[g]) + 4)
    pieces, starts, at = np.empty(most, np.int64), np.empty(most), 2 * begins[first] + 4 * first
    for g in range(first, last):
        begin, stop = begins[g], begins[g + 1]
        for k in range(2):
            y, x = gap[g, 0] + k * (1 - gap[g, 2]), gap[g, 1] + k * gap[g, 2]
            ends[g, k, 0], ends[g, k, 1], end_depth[g, k] = seen[y, x], triangle[y, x], depth[y, x]
        n = _first_hits(g, (begin, stop), spans, names, parts, ends, end_depth, pieces, starts)
        rows[g], count, a = at, 0, 0
        for m in range(1, n):
            # A piece that is too short to count belongs to what comes after it.
            if m + 1 < n and starts[m + 1] - starts[m] < TOUCH:
                continue
            x, y, place, row = pieces[a], pieces[m], starts[m], at + count
            a = m
            before, behind = _part(g, parts, ends, x), _part(g, parts, ends, y)
            t, s = names[x, 1] if x >= 0 else ends[g, 0, 1], names[y, 1] if y >= 0 else ends[g, 1, 1]
            z = depth_at(spans, x, place) if x >= 0 else end_depth[g, 0]
            deep = depth_at(spans, y, place) if y >= 0 else end_depth[g, 1]
            nearer = -1 if abs(z - deep) <= ALIKE * max(abs(z), abs(deep)) else (0 if z < deep else 1)
            # What is seen at a centre goes on beyond it.
            stops, begun = x >= 0 and spans[x, 1] <= place + TOUCH, y >= 0 and spans[y, 0] >= place - TOUCH
            seamless = nearer < 0 and (x < 0 or stops) and (y < 0 or begun)
            seam = seamless and before == behind and x >= 0 and y >= 0
            seam = seam and is_seam(x, y, names[x, 2], names[y, 2], spans)
            if before == behind and (t == s or seamless) and not seam:
                continue
            if nearer < 0 and not seam:
                begin = _rest(spans, begin, stop, place - 2 * TOUCH)
                stops = stops and not _goes_on(spans, begin, stop, parts, x, place, 1)
                begun = begun and not _goes_on(spans, begin, stop, parts, y, place, 0)
            kind = SEAM if seam else _kind(before, behind, nearer, stops, begun)
            if kind < 0:
                continue
            whole[row, 0], whole[row, 1], whole[row, 2], whole[row, 3] = g, kind, before, behind
            whole[row, 4], whole[row, 5], whole[row, 8], whole[row, 9] = t, s, count == 0, 0
            numbers[row, 0] = place
            # On their side of the edge, beyond rounding, since normals and motions may jump there.
            numbers[row, 1] = min(max(place - 2 * TOUCH, spans[x, 0], 0.0), place) if x >= 0 else place
            numbers[row, 2] = max(min(place + 2 * TOUCH, spans[y, 1], 1.0), place) if y >= 0 else place
            count += 1
        if count > 0:
            whole[at + count - 1, 9] = 1
        _inner(at, count, pieces, starts, n, names, parts, inner, whole, numbers)
        counts[g] = count
        at += count


@loop
def listed(rows, counts, gap_of, whole, numbers, gap, points, parts, kind, triangles, ends, joined):
    """Fill in the fields of `Crossings`, gap after gap, from what `crossings` found with room to spare.

    Args:
        rows: (M,), see `crossings`.
        counts: (M,), see `crossings`.
        gap_of: (M, 3), see `Gaps`.
        whole: see `crossings`.
        numbers: see `crossings`.
        gap: (B, 3) int32 to fill.
        points: (B, 5, 2) to fill: x and y of the crossing, of its last samples, and of those that tell colours.
        parts: (B, 2) int32 to fill.
        kind: (B,) int32 to fill.
        triangles: (B, 4) int32 to fill; −1 where nothing is seen.
        ends: (B, 2) bool to fill.
        joined: (2, H, W) bool, False from then on in gaps with a crossing: elsewhere one surface goes on.
    """
    b = 0
    for g in range(len(rows)):
        y, x, row = gap_of[g, 0], gap_of[g, 1], gap_of[g, 2]
        joined[1 - row, y, x] &= counts[g] == 0
        for n in range(rows[g], rows[g] + counts[g]):
            gap[b, 0], gap[b, 1], gap[b, 2], kind[b] = y, x, row, whole[n, 1]
            for i in range(5):
                points[b, i, 0], points[b, i, 1] = x + 0.5 + numbers[n, i] * row, y + 0.5 + numbers[n, i] * (1 - row)
            for side in range(2):
                parts[b, side], ends[b, side] = whole[n, 2 + side], whole[n, 8 + side] == 1
                for i in range(side, 4, 2):
                    triangles[b, i] = whole[n, 4 + i] if whole[n, 2 + side] >= 0 else -1
            b += 1


@compiled(inline="always")
def _inner(at, count, pieces, starts, n, names, parts, inner, whole, numbers):
    """Fill in the samples that tell colours of the crossings of a gap, from the row `at`; see `crossings`."""
    for b in range(at, at + count):
        before = numbers[b - 1, 0] if b > at else 0.0
        after = numbers[b + 1, 0] if b + 1 < at + count else 1.0
        for side in range(2):
            end = numbers[b, 1 + side]
            length = end - before if side == 0 else after - end
            inward = end - min(inner, length / 2) if side == 0 else end + min(inner, length / 2)
            numbers[b, 3 + side], whole[b, 6 + side] = end, whole[b, 4 + side]
            found = _piece(pieces, starts, n, inward)
            if found >= 0 and parts[found] == whole[b, 2 + side] and inward != end:
                numbers[b, 3 + side], whole[b, 6 + side] = inward, names[found, 1]


@compiled(inline="always")
def _part(g, parts, ends, x):
    """The part of a piece of front of a gap."""
    end = ends[g, 1 if x == SECOND else 0, 0]
    return parts[x] if x >= 0 else (end if x != NOTHING else np.int32(-1))


@compiled(inline="always")
def _piece(pieces, starts, count, place):
    """The piece of front at a place of a gap."""
    n = 0
    while n + 1 < count and starts[n + 1] <= place:
        n += 1
    return pieces[n]
