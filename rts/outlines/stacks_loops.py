"""The stacks of surfaces along gaps, from spans, and the places where they change. Compiled.

A *run* is a surface along a gap: spans that follow one another, end to start. A sheet that turns away ends there, as
the back does that it turns into. The stack at a place is the runs there, front to back; of these the first K are seen,
and none behind an opaque one. The stack changes where a run starts or ends, and where two runs pass through one
another. Where one surface hides all others, K = 1, and changes in one place are one: see `_fronts`.

Spans are named by their rows. Those of a gap are sorted by where they start. Helpers take whole arrays, and use all of
them to their end, so that no references are counted in loops over gaps: each stage goes over all gaps.
"""

from __future__ import annotations

import numpy as np

from rts.compiling.loops import compiled, loop
from rts.outlines.gaps import SEAM
from rts.outlines.spans_loops import TINY

LAST = 4e-5
"""Distance of last samples from breaks, in cells."""

TOUCH = 1e-6
"""Greatest distance along a gap by which the ends of two spans differ where a surface goes on from one to the other."""

MARGIN = 1e-7
"""Share of the depth by which a span must be nearer than another to come before it."""

ALIKE = 1e-5
"""Share of the depth by which surfaces may differ that meet."""

SAME = 1e-4
"""Share of the depth by which a sample at a centre may differ from the run that it lies on."""

CLOSE = 1e-5
"""Distance from a centre, in cells, within which the sample there decides on which side of it a run ends."""

SHORT = 2e-5
"""Length of a run that counts."""

CREASE = np.cos(np.pi / 9)
"""Cosine of the angle by which a surface turns at a seam; less if both triangles are large. Of many small triangles
that hardly turn colours hardly change, and each is as expensive as an outline."""

PART, TRIANGLE, EDGES, OPAQUE, AFTER, BEFORE = range(6)
"""Columns of the integers `of` spans: part and triangle; the last of `names`; 1 if the part lets no light through; the
spans that a span goes on with, after its end and before its start, or −1."""

NOTHING, FIRST, SECOND = -1, -2, -3
"""In place of a span: nothing is seen; the sample at the first centre, which no run holds; that at the second."""


@compiled(inline="always")
def depth_at(spans, i, place):
    """The depth of a span at a place."""
    return (spans[i, 2] + spans[i, 3] * place) / (spans[i, 4] + spans[i, 5] * place)


@compiled(inline="always")
def _turns(i, j, spans, of):
    """True if a surface that goes on from span i to j does so across a seam, and they are large, or turn there."""
    found = of[i, EDGES] & 2 != 0 and of[j, EDGES] & 1 != 0
    if found and of[i, EDGES] & of[j, EDGES] & 4 == 0:
        found = spans[i, 6] * spans[j, 6] + spans[i, 7] * spans[j, 7] + spans[i, 8] * spans[j, 8] < CREASE
    return found


@compiled(inline="always")
def _link(begin, stop, spans, of):
    """Fill in which spans of a gap follow one another. At seams a run ends, and the next one starts."""
    low = begin
    for i in range(begin, stop):
        of[i, AFTER], of[i, BEFORE] = -1, -1
    for i in range(begin, stop):
        end, searches = spans[i, 1], True
        while spans[low, 0] < spans[i, 0] - TOUCH:
            low += 1
        j = low
        while searches and j < stop:
            searches = spans[j, 0] <= end + TOUCH
            near = searches and j != i and spans[j, 0] >= end - TOUCH and spans[j, 1] > end
            if near and of[j, PART] == of[i, PART] and of[j, BEFORE] < 0:
                z = depth_at(spans, i, end)
                searches = abs(depth_at(spans, j, end) - z) > ALIKE * abs(z)
                if not searches and not _turns(i, j, spans, of):
                    of[i, AFTER], of[j, BEFORE] = j, i
            j += 1


@compiled(inline="always")
def _listed(part, z, margin, y, x, opaque, seen, depth):
    """True if the samples at a centre hold one of a part at a depth, or hide what is deeper by more than a margin."""
    found, full, deepest = False, True, 0.0
    for k in range(len(seen)):
        own, deep = seen[k, y, x], depth[k, y, x]
        full &= own >= 0
        hides = (opaque[max(own, 0)] != 0) & (z > deep + margin)
        found |= full & (((own == part) & (abs(deep - z) <= SAME * abs(z))) | hides)
        deepest = deep
    # Behind all that is listed, where the list is full.
    return found | (full & (z > deepest + margin))


@compiled(inline="always")
def _settle(head, tail, k, y, x, spans, of, opaque, seen, depth):
    """Move an end of a run that lies at a centre (0 or 1) to the side that the samples there say.

    Returns False for a run that is not real: it covers a centre with no sample there, and so touches the line with an
    edge alone.
    """
    start, end, i = spans[head, 0], spans[tail, 1], head
    while (spans[i, 1] < k) & (of[i, AFTER] >= 0):
        i = of[i, AFTER]
    reaches, z = (start <= k + CLOSE) & (end >= k - CLOSE), depth_at(spans, i, k)
    starts, ends = reaches & (start >= k - CLOSE), reaches & (end <= k + CLOSE)
    # Of what the sample meets there, that covers the centre which goes on.
    margin = ALIKE * abs(z) if starts | ends else -ALIKE * abs(z)
    found = _listed(of[head, PART], z, margin, y, x, opaque, seen, depth)
    # The centre is inside if the sample is found there, else outside.
    early, late = min(start, 0.0 if k == 0 else 1 - TINY), (max(start, TINY) if k == 0 else 2.0)
    spans[head, 0] = (early if found else late) if starts else start
    early, late = (-1.0 if k == 0 else min(end, 1 - TINY)), max(end, TINY if k == 0 else 1 + 2 * TOUCH)
    spans[tail, 1] = (late if found else early) if ends else end
    return found | starts | ends | (not reaches)


@compiled(inline="always")
def _seen(begin, stop, heads, spans, of):
    """Leave out, of the runs of a gap, those of a single span that lies behind another's; returns where they stop."""
    n = begin
    for h in range(begin, stop):
        i, hidden, q = heads[h], False, begin
        low, high, j = max(spans[i, 0], 0.0), min(spans[i, 1], 1.0), heads[begin] if of[i, AFTER] < 0 else -1
        z, deep = (1 - ALIKE) * depth_at(spans, i, low), (1 - ALIKE) * depth_at(spans, i, high)
        while j >= 0 and not hidden:
            if spans[j, 0] <= low and spans[j, 1] >= high:
                hidden = (depth_at(spans, j, low) < z) & (depth_at(spans, j, high) < deep)
            q += of[j, AFTER] < 0
            j = of[j, AFTER] if of[j, AFTER] >= 0 else (heads[q] if q < stop else -1)
        heads[n] = i
        n += not hidden
    return n


@compiled(inline="always")
def _runs(first, last, gap, begins, spans, of, opaque, seen, depth, heads, live):
    """Fill in how spans form runs: in `heads` the first spans of those of a gap that are real, in order, so many.

    There are `live` (M,) runs in each gap, and heads from the row on where its spans begin.
    """
    for g in range(first, last):
        begin, stop, y, x, n = begins[g], begins[g + 1], gap[g, 0], gap[g, 1], begins[g]
        down, across = y + 1 - gap[g, 2], x + gap[g, 2]
        _link(begin, stop, spans, of)
        for i in range(begin, stop):
            tail = i
            while of[tail, AFTER] >= 0:
                tail = of[tail, AFTER]
            real = (of[i, BEFORE] < 0) & (spans[tail, 1] - spans[i, 0] >= SHORT)
            if real:
                real &= _settle(i, tail, 0, y, x, spans, of, opaque, seen, depth)
                real &= _settle(i, tail, 1, down, across, spans, of, opaque, seen, depth)
            heads[n] = i
            n += real & (spans[i, 0] < 1) & (spans[tail, 1] > 0)
        live[g] = (_seen(begin, n, heads, spans, of) if len(seen) == 1 else n) - begin


@compiled(inline="always")
def _before(i, j, place, spans, of):
    """True if a span lies before another at a place; if they meet there, farther on; if they coincide, by parts."""
    until, by_part = min(1.0, spans[i, 1], spans[j, 1]), of[i, PART] < of[j, PART]
    a, b = depth_at(spans, i, place), depth_at(spans, j, place)
    c, d = depth_at(spans, i, until), depth_at(spans, j, until)
    later = c < d if abs(c - d) > MARGIN * abs(c) else by_part
    return a < b if abs(a - b) > ALIKE * abs(a) else later


@compiled(inline="always")
def _insert(stack, count, i, place, spans, of):
    """Insert a span into a stack by depth; returns its index."""
    at = count
    while at > 0 and _before(i, stack[at - 1], place, spans, of):
        stack[at] = stack[at - 1]
        at -= 1
    stack[at] = i
    return at


@compiled(inline="always")
def _meeting(i, j, low, high, spans):
    """Where two spans have one depth, between two places at which their order differs."""
    # Linear in homogeneous coordinates, where depths are.
    wide = (spans[i, 4] + spans[i, 5] * low) * (spans[j, 4] + spans[j, 5] * low)
    far = (spans[i, 4] + spans[i, 5] * high) * (spans[j, 4] + spans[j, 5] * high)
    before = max(depth_at(spans, j, low) - depth_at(spans, i, low), 0.0) * wide
    after = min(depth_at(spans, j, high) - depth_at(spans, i, high), 0.0) * far
    return low + (high - low) * before / (before - after) if before - after > 0 else low


@compiled(inline="always")
def _next_meeting(stack, count, place, until, spans):
    """The next place at which two neighbours in a stack pass through one another, and the first's index; or −1."""
    best, at, z = np.inf, -1, depth_at(spans, stack[0], until) if count > 1 else 0.0
    for m in range(count - 1):
        deep = depth_at(spans, stack[m + 1], until)
        if deep < z - MARGIN * abs(z):
            there = _meeting(stack[m], stack[m + 1], place, until, spans)
            if there < best:
                best, at = there, m
        z = deep
    return best, at


@compiled(inline="always")
def _next_starting(heads, first, count, place, spans, of):
    """The index, among heads that wait, of the nearest run that starts at a place; `count` if there is none.

    Of several, such as of parts that have an edge in common, that is: whichever part comes first.
    """
    found = count
    for h in range(first, count):
        i = heads[h]
        if i >= 0 and spans[i, 0] <= place:
            if found == count or _before(i, heads[found], place, spans, of):
                found = h
    return found


@compiled(inline="always")
def _show(stack, count, side, shown, of):
    """Fill in the spans of a stack that are seen on one side of a place, `shown` (2, K)."""
    lit = True
    for k in range(shown.shape[1]):
        lit &= k < count
        shown[side, k] = stack[k] if lit else NOTHING
        lit &= of[stack[k], OPAQUE] == 0


@compiled(inline="always")
def _remove(stack, count, at):
    """Remove an entry of a stack, if it is not −1; returns how many are left."""
    for m in range(at if at >= 0 else count, count - 1):
        stack[m] = stack[m + 1]
    return count - (at >= 0)


@compiled(inline="always")
def _partner(i, side, place, others, first, count, spans, of):
    """The index in a list of another run of the same part that ends (side 0) or starts (1) where one does; or −1.

    A sheet turns away there. Depths differ where triangles in between are seen from the side.
    """
    found = -1
    for m in range(count - 1, first - 1, -1):
        j = others[m]
        if j >= 0 and j != i and of[j, PART] == of[i, PART] and of[j, AFTER + side] < 0:
            found = m if abs(spans[j, 1 - side] - place) <= TOUCH else found
    return found


@compiled(inline="always")
def _at_centre(stack, count, k, spans, of, ends, depths):
    """The index in a stack of what the sample at a centre (0 or 1) shows; −1 if that is no run, or nothing."""
    found, z, known = -1, depths[1 + k], False
    for m in range(count - 1, -1, -1):
        i = stack[m]
        alike = (of[i, PART] == ends[1 + k, PART]) & (abs(depth_at(spans, i, k) - z) <= SAME * abs(z))
        same = alike & (of[i, TRIANGLE] == ends[1 + k, TRIANGLE])
        found = m if same | (alike & (not known)) else found
        known |= same
    return found


@compiled(inline="always")
def _record(e, kind, place, shown, whole, place_of, sides):
    """Fill in change e of a stack, whose spans are `shown` (2, K) as far as they are seen; returns 1 if any is."""
    changed = 0
    for k in range(shown.shape[1]):
        changed |= shown[0, k] != shown[1, k]
        sides[e, 0, k], sides[e, 1, k] = shown[0, k], shown[1, k]
    whole[e, 1], place_of[e] = kind, place
    return changed


@compiled(inline="always")
def _ends(g, gap, seen, triangle, depth, ends, depths):
    """Fill in part and triangle (3, 2), and depth (3,), of what stands for spans: nothing, and samples at centres."""
    y, x = gap[g, 0], gap[g, 1]
    down, across = y + 1 - gap[g, 2], x + gap[g, 2]
    ends[1, PART], ends[1, TRIANGLE], depths[1] = seen[0, y, x], triangle[0, y, x], depth[0, y, x]
    ends[2, PART], ends[2, TRIANGLE] = seen[0, down, across], triangle[0, down, across]
    depths[2] = depth[0, down, across]


@compiled(inline="always")
def _inside(heads, begin, stop, stack, spans, of):
    """Fill in the stack at the first centre; returns how many runs it has."""
    count = 0
    for h in range(begin, stop):
        i = heads[h]
        if spans[i, 0] <= 0:
            while (spans[i, 1] <= 0) & (of[i, AFTER] >= 0):
                i = of[i, AFTER]
            _insert(stack, count, i, 0.0, spans, of)
            heads[h], count = -1, count + 1
    return count


@compiled(inline="always")
def _along(first, last, gap, begins, live, heads, spans, of, seen, triangle, depth, room, rows, counts, whole, place_of,
           sides):  # fmt: skip
    """Fill in the changes of stacks along gaps; see `changes`. Of each `sides` are the spans that are seen."""
    longest, at, most, spare = 1, room[first], len(seen), len(place_of) - 1
    for g in range(first, last):
        longest = max(longest, live[g])
    stack, shown = np.zeros(longest + most, np.int32), np.empty((2, most), np.int32)
    ends, depths = np.full((3, 2), -1, np.int32), np.zeros(3)
    for g in range(first, last):
        waiting, stop, place, e = begins[g], begins[g] + live[g], 0.0, at
        count = _inside(heads, waiting, stop, stack, spans, of)
        _ends(g, gap, seen, triangle, depth, ends, depths)
        if most == 1 and ends[1, PART] >= 0:
            m = _at_centre(stack, count, 0, spans, of, ends, depths)
            shown[0, 0] = stack[max(m, 0)] if m >= 0 else FIRST
            if m > 0:  # Of several in one place the sample's is in front.
                stack[m], stack[0] = stack[0], stack[m]
            _show(stack, count, 1, shown, of)
            e += _record(e if e < room[last] else spare, 2, place, shown, whole, place_of, sides)
        while True:
            while waiting < stop and heads[waiting] < 0:
                waiting += 1
            until, m = min(1.0, spans[heads[waiting], 0]) if waiting < stop else 1.0, count
            for n in range(count - 1, -1, -1):
                i = stack[n]
                while (spans[i, 1] <= place) & (of[i, AFTER] >= 0):
                    i = of[i, AFTER]
                stack[n], m, until = i, n if spans[i, 1] <= place else m, min(until, spans[i, 1])
            kind = 0 if m < count else (1 if until <= place else 2)
            if kind == 2:
                there, m = _next_meeting(stack, count, place, until, spans)
                place = until if m < 0 else max(place, there)
                if m < 0 and until >= 1:
                    break
                if m < 0:
                    continue
            _show(stack, count, 0, shown, of)
            if kind == 0:
                other = _partner(stack[m], 0, place, stack, 0, count, spans, of) if m < most else -1
                count = _remove(stack, _remove(stack, count, max(m, other)), min(m, other))
            elif kind == 1:
                h = _next_starting(heads, waiting, stop, place, spans, of)
                i, heads[h] = heads[h], -1
                m = _insert(stack, count, i, place, spans, of)
                other = _partner(i, 1, spans[i, 0], heads, waiting, stop, spans, of) if m < most else -1
                count += 1
            else:
                stack[m], stack[m + 1], other = stack[m + 1], stack[m], -1
            if kind == 1 and other >= 0:
                _insert(stack, count, heads[other], place, spans, of)
                heads[other], count = -1, count + 1
            if m < most:
                _show(stack, count, 1, shown, of)
                e += _record(e if e < room[last] else spare, kind, place, shown, whole, place_of, sides)
        m = _at_centre(stack, count, 1, spans, of, ends, depths)
        if most == 1 and ends[2, PART] >= 0 and (m < 0 or (m > 0 and spans[stack[0], 1] <= 1 + CLOSE)):
            _show(stack, count, 0, shown, of)
            shown[1, 0] = SECOND if m < 0 else stack[m]
            e += _record(e if e < room[last] else spare, 2, 1.0, shown, whole, place_of, sides)
        rows[g], counts[g] = at if e <= room[last] else -1, e - at
        at = e if e <= room[last] else at


@compiled(inline="always")
def _named(i, column, of, ends):
    """Part or triangle of a span, or of what stands for one."""
    own, other = of[max(i, 0), column], ends[max(-1 - i, 0), column]
    return own if i >= 0 else other


@compiled(inline="always")
def _kind(i, j, place, spans, of, ends, depths):
    """How the nearest surface changes from span i to j at a place.

    0 or 1, that before or behind ends; 2, they cross; SEAM, one goes on across a seam, or two parts meet at an edge of
    both; −1, not at all.
    """
    part, other, a, b = _named(i, PART, of, ends), _named(j, PART, of, ends), max(i, 0), max(j, 0)
    z, deep = depth_at(spans, a, place), depth_at(spans, b, place)
    z, deep = z if i >= 0 else depths[max(-1 - i, 0)], deep if j >= 0 else depths[max(-1 - j, 0)]
    one, edges, turns = part == other, of[a, EDGES] & 2 & 2 * of[b, EDGES], False
    alike = _named(i, TRIANGLE, of, ends) == _named(j, TRIANGLE, of, ends)
    stops, starts = (i >= 0) & (spans[a, 1] <= place + CLOSE), (j >= 0) & (spans[b, 0] >= place - CLOSE)
    if stops and starts and edges != 0:
        turns = _turns(a, b, spans, of)
    if part < 0 or other < 0:
        kind = -1 if one else (1 if part < 0 else 0)
    elif one and alike:
        kind = -1
    elif abs(z - deep) > ALIKE * max(abs(z), abs(deep)):
        kind = 0 if z < deep else 1
    elif one and (stops or i < 0) and (starts or j < 0):
        kind = SEAM if turns else -1
    elif stops or starts:
        # What is seen at a centre goes on beyond it.
        stops, starts = stops and (place > CLOSE or not starts), starts and (place < 1 - CLOSE or not stops)
        kind = SEAM if stops and starts else (0 if stops else 1)
    else:
        kind = 2
    return kind


@compiled(inline="always")
def _fronts(base, found, spans, of, ends, depths, whole, place_of, sides):
    """Where one surface hides all others: make changes in one place one, and tell their kinds; returns their number."""
    n, part = base, ends[1, PART]
    # Along an edge that both samples are on nothing ends, nor lies before it.
    edge = (part == ends[2, PART]) & (sides[base, 0, 0] == FIRST) & (sides[base + found - 1, 1, 0] == SECOND)
    for e in range(base, base + found):
        i = sides[e, 0, 0]
        edge &= (i < 0) | (of[max(i, 0), PART] == part)
    for e in range(base, base + found):
        i, j, place, kind = sides[e, 0, 0], sides[e, 1, 0], place_of[e], -1
        after = min(e + 1, base + found - 1)
        if after > e and place_of[after] - place < SHORT:
            sides[after, 0, 0] = i
        else:
            kind = _kind(i, j, place, spans, of, ends, depths)
        whole[n, 1], place_of[n], sides[n, 0, 0], sides[n, 1, 0] = kind, place, i, j
        n += (kind >= 0) & (not edge)
    return n - base


@compiled(inline="always")
def _aside(i, side, place, beside, inner, spans, of):
    """Where the last sample is before (side 0) or behind a change, on span i, and that which tells colours; its span.

    `beside` is the change before, or after.
    """
    j, way, link = i, 2 * side - 1, AFTER if side == 1 else BEFORE
    bound = max(spans[i, 0], 0.0) if side == 0 else min(spans[i, 1], 1.0)
    last = place + way * min(LAST, max(way * (bound - place), 0.0))
    inward = last + way * min(inner, max(way * (beside - last), 0.0) / 2)
    while (way * (inward - spans[j, side]) > 0) & (of[j, link] >= 0):
        j = of[j, link]
    return last, last + way * min(way * (inward - last), max(way * (spans[j, side] - last), 0.0)), j


@compiled(inline="always")
def _of_front(base, f, found, inner, spans, of, ends, whole, place_of, samples, places, sides):
    """Fill in the parts and the samples of a change of the surface that hides all others."""
    e, place = base + f, place_of[base + f]
    for side in range(2):
        i, beside = sides[e, side, 0], place_of[min(max(e + 2 * side - 1, base), base + found - 1)]
        beside = beside if 0 <= f + 2 * side - 1 < found else 1.0 * side
        last, inward, j = place, place, i
        if i >= 0:
            last, inward, j = _aside(i, side, place, beside, inner, spans, of)
        part = _named(i, PART, of, ends)
        samples[e, side, 0], samples[e, 2 + side, 0], whole[e, 2 + side] = part, part, part
        samples[e, side, 1] = _named(i, TRIANGLE, of, ends)
        samples[e, 2 + side, 1] = _named(j, TRIANGLE, of, ends)
        places[e, side], places[e, 2 + side] = last, inward
        sides[e, side, 0] = side if part >= 0 else -1


@compiled
def _of_stack(base, f, found, inner, spans, of, whole, place_of, samples, places, sides):
    """Fill in the parts and the samples of a change of the stack."""
    e, kind, place, n, first, most = base + f, whole[base + f, 1], place_of[base + f], 2, -1, sides.shape[2]
    for k in range(most - 1, -1, -1):
        first = k if sides[e, 0, k] != sides[e, 1, k] else first
    for side in range(2):
        i = sides[e, side, first]
        samples[e, side, 0] = i if kind == 2 or kind == side else NOTHING
        whole[e, 2 + side] = of[i, PART] if i >= 0 else -1
    for at in range(2, samples.shape[1]):
        samples[e, at, 0] = NOTHING
    for step in range(2):
        side = 1 - step if kind == 1 else step
        for k in range(most):
            i, at = sides[e, side, k], n
            for m in range(2, n):
                at = m if samples[e, m, 0] == i else at
            sides[e, side, k] = -1
            if i >= 0 and at < samples.shape[1]:
                samples[e, at, 0], sides[e, side, k], n = i, at - 2, max(n, at + 1)
    beside = 1.0 * kind
    if 0 <= f + 2 * kind - 1 < found:
        beside = place_of[e + 2 * kind - 1]
    for n in range(samples.shape[1]):
        i = samples[e, n, 0]
        samples[e, n, 0], samples[e, n, 1], places[e, n] = -1, -1, place
        if i >= 0:
            j, places[e, n] = i, min(max(place, spans[i, 0]), spans[i, 1])
            if kind < 2 and of[i, AFTER + kind] < 0 and abs(spans[i, 1 - kind] - place) <= TOUCH:
                last, inward, x = _aside(i, kind, place, beside, inner, spans, of)
                places[e, n], j = (last, i) if n < 2 else (inward, x)
            samples[e, n, 0], samples[e, n, 1] = of[j, PART], of[j, TRIANGLE]


@loop
def changes(
    first, last, gap, begins, spans, of, heads, live, opaque, seen, triangle, depth, room, rows, counts, inner, whole,
    place_of, samples, places, sides,
):  # fmt: skip
    """Fill in the changes of stacks along gaps, in order.

    Only those that are seen count: not behind an opaque layer, nor behind the first K.

    Args:
        first: the first gap.
        last: the gap after the last.
        gap: (M, 3), see `Gaps`.
        begins: (M + 1,) where the spans of each gap begin.
        spans: (N, 6) or (N, 9), see `spans_loops.spans_of`; the ends of runs at centres are moved a little.
        of: (N, 6) int32, see `PART`; the last two to fill.
        heads: (N,) int32 to fill: from the row on where the spans of a gap begin, the first ones of its runs.
        live: (M,) int32 to fill: the number of these.
        opaque: bool, for each part.
        seen: (K, H, W) int32, the parts of the samples at centres; −1 where there are no more.
        triangle: (K, H, W) int32, their triangles.
        depth: (K, H, W) float64, their depths.
        room: (M + 1,) int64, the rows of what follows up to which there is room for the changes of gaps before each.
        rows: (M,) int64 to fill: the row where the changes of each gap begin; −1 where there is too little room.
        counts: (M,) int32 to fill: the number of changes of each gap.
        inner: distance of the samples that tell colours of what ends.
        whole: (E, 6) int32 to fill, with a row to spare, as all that follow: gap; 0 or 1 where the surface before or
            behind ends, 2 where two cross, or SEAM; its part, and the part behind it, or those that cross, as before
            and behind; 1 for the gap's first, and its last.
        place_of: (E,) float64 to fill: their places.
        samples: (E, 2 + K + 1, 2) int32 to fill: part and triangle of the last samples before and behind, or −1; then
            of what is seen before and behind. If K = 1, these are the two that tell colours.
        places: (E, 2 + K + 1) to fill: places of these samples.
        sides: (E, 2, K) int32 to fill: what is seen before and behind, as indices of these, or −1.
    """
    _runs(first, last, gap, begins, spans, of, opaque, seen, depth, heads, live)
    _along(first, last, gap, begins, live, heads, spans, of, seen, triangle, depth, room, rows, counts, whole, place_of,
           sides)  # fmt: skip
    ends, depths = np.full((3, 2), -1, np.int32), np.zeros(3)
    for g in range(first, last):
        base, found = rows[g], counts[g]
        if len(seen) == 1 and base >= 0 and found > 0:
            _ends(g, gap, seen, triangle, depth, ends, depths)
            found = _fronts(base, found, spans, of, ends, depths, whole, place_of, sides)
            counts[g] = found
        for f in range(found if base >= 0 else 0):
            e = base + f
            whole[e, 0], whole[e, 4], whole[e, 5] = g, f == 0, f == found - 1
            if len(seen) == 1:
                _of_front(base, f, found, inner, spans, of, ends, whole, place_of, samples, places, sides)
            else:
                _of_stack(base, f, found, inner, spans, of, whole, place_of, samples, places, sides)


@loop
def listed(rows, counts, gap_of, whole, place_of, samples, places, sides):
    """The changes that `changes` found with room to spare, gap after gap, as fields of `Breaks` and of `Stacks`.

    Args:
        rows: (M,), see `changes`.
        counts: (M,), see `changes`.
        gap_of: (M, 3), see `Gaps`.
        whole: see `changes`.
        place_of: see `changes`.
        samples: see `changes`.
        places: see `changes`.
        sides: see `changes`.

    Returns:
        Gaps, places in the image, kinds, ends and parts of breaks; parts, triangles and points of samples; and sides.
    """
    total, n = counts.sum(), samples.shape[1]
    gap, place, near = np.empty((total, 3), np.int32), np.empty((total, 2)), np.empty(total, np.int32)
    ends, parts = np.empty((total, 2), np.bool_), np.empty((total, 2), np.int32)
    owners, triangles = np.empty((total, n), np.int32), np.empty((total, n), np.int32)
    points, shown = np.empty((total, n, 2)), np.empty((total, 2, sides.shape[2]), np.int32)
    b = 0
    for g in range(len(rows)):
        y, x, row = gap_of[g, 0], gap_of[g, 1], gap_of[g, 2]
        for e in range(rows[g], rows[g] + counts[g]):
            gap[b, 0], gap[b, 1], gap[b, 2], near[b] = y, x, row, whole[e, 1]
            place[b, 0], place[b, 1] = x + 0.5 + place_of[e] * row, y + 0.5 + place_of[e] * (1 - row)
            for i in range(n):
                owners[b, i], triangles[b, i] = samples[e, i, 0], samples[e, i, 1]
                points[b, i, 0], points[b, i, 1] = x + 0.5 + places[e, i] * row, y + 0.5 + places[e, i] * (1 - row)
            for side in range(2):
                parts[b, side], ends[b, side] = whole[e, 2 + side], whole[e, 4 + side] == 1
                for k in range(sides.shape[2]):
                    shown[b, side, k] = sides[e, side, k]
            b += 1
    return gap, place, near, ends, parts, owners, triangles, points, shown
