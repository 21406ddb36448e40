"""The stacks of layers along gaps, from spans, and the places where they change. Compiled.

A *run* is a surface along a gap: spans that follow one another, end to start. A patch that turns away ends there, as
the back does that it turns into. The stack at a place is the runs there, front to back. It changes where a run starts
or ends, and where two runs pass through one another.

Each gap works on tables of its own, copied from those of all spans: `own` (n, 11), the columns of
`spans_loops.spans_of`, then where a run starts and ends; and `of` (n, 8), integers. To pass an array on, threads count
its references in turns, so that helpers take few, and none that is shared in their inmost loops.
"""

from __future__ import annotations

import numpy as np

from rts.compiling.loops import compiled, loop
from rts.outlines.edge_kinds import BEFORE_ENDS, BEHIND_ENDS, INTERSECT
from rts.outlines.first_hits_loops import depth_at, is_seam
from rts.outlines.tolerances import ALIKE, TOUCH

LOW, HIGH = 9, 10
"""Columns of `own`: where a run starts, in the row of its first span, and where it ends, in that of its last."""

PART, TRIANGLE, OPAQUE, AFTER, BEFORE, LIVE, INSIDE, EDGES = range(8)
"""Columns of `of`: part and triangle of a span; 1 if the part lets no light through; the spans that it goes on with, or
−1; 1 if its run is real; 1 if the run is, or has been, in the stack; the last of the span's `names`."""


@compiled(inline="always")
def _alike(own, i, j, place):
    """True if two spans have about one depth at a place."""
    z = depth_at(own, i, place)
    return abs(depth_at(own, j, place) - z) <= ALIKE * abs(z)


@compiled(inline="always")
def _link(own, of, n):
    """Fill in the columns AFTER and BEFORE of n spans. At seams a run ends, and the next one starts."""
    for i in range(n):
        for j in range(n):
            if i == j or of[j, BEFORE] >= 0 or of[i, PART] != of[j, PART] or not own[j, HIGH] > own[i, HIGH]:
                continue
            if abs(own[j, LOW] - own[i, HIGH]) <= TOUCH and _alike(own, i, j, own[i, HIGH]):
                if not is_seam(i, j, of[i, EDGES], of[j, EDGES], own):
                    of[i, AFTER], of[j, BEFORE] = j, i
                break


@compiled(inline="always")
def _listed(part, z, seen, depth, y, x):
    """1 if the samples at a centre hold one of a part at a depth; −1 if they hide it; else 0."""
    # Behind all that is listed, where the list is full.
    found = -1 if z > depth[len(seen) - 1, y, x] else 0
    for layer in range(len(seen)):
        if seen[layer, y, x] < 0:
            found = 0
            break
        if seen[layer, y, x] == part and abs(depth[layer, y, x] - z) <= ALIKE * abs(z):
            found = 1
            break
    return found


@compiled(inline="always")
def _hides(opaque, z, seen, depth, y, x):
    """True if a sample at a centre hides what lies at a depth."""
    found = False
    for layer in range(len(seen)):
        found |= seen[layer, y, x] >= 0 and opaque[seen[layer, y, x]] and depth[layer, y, x] < z
    return found


@compiled(inline="always")
def _fit_to_centres(head, tail, own, of, opaque, seen, depth, gap, g):
    """Move the ends of a run that lie at a centre to the side that the samples there say; True if the run is real.

    A run that covers a centre with no sample there touches the line with an edge alone.
    """
    real = True
    for k in range(2):
        centre, y, x = float(k), gap[g, 0] + k * (1 - gap[g, 2]), gap[g, 1] + k * gap[g, 2]
        start, end = own[head, LOW], own[tail, HIGH]
        if not real or start > centre + TOUCH or end < centre - TOUCH:
            continue
        i = head
        while own[i, HIGH] < centre and of[i, AFTER] >= 0:
            i = of[i, AFTER]
        z = depth_at(own, i, centre)
        found = _listed(of[head, PART], z, seen, depth, y, x)
        if start < centre - TOUCH and end > centre + TOUCH:
            real = found != 0 or _hides(opaque, z, seen, depth, y, x)
            continue
        if abs(start - centre) <= TOUCH:
            if k == 0:
                own[head, LOW] = -1.0 if found != 0 else max(start, TOUCH)
            else:
                own[head, LOW] = min(start, 1 - TOUCH) if found != 0 else 2.0
        if abs(end - centre) <= TOUCH:
            if k == 0:
                own[tail, HIGH] = max(end, TOUCH) if found != 0 else -1.0
            else:
                own[tail, HIGH] = 2.0 if found != 0 else min(end, 1 - TOUCH)
    return real


@compiled(inline="always")
def _before(own, i, j, place, until):
    """True if a span lies before another at a place; if they meet there, farther on."""
    a, b = depth_at(own, i, place), depth_at(own, j, place)
    return a < b if abs(a - b) > ALIKE * abs(a) else depth_at(own, i, until) < depth_at(own, j, until)


@compiled(inline="always")
def _insert(stack, count, i, own, place, until):
    """Insert a span into a stack by depth; returns its index."""
    at = count
    while at > 0 and _before(own, i, stack[at - 1], place, until):
        stack[at] = stack[at - 1]
        at -= 1
    stack[at] = i
    return at


@compiled(inline="always")
def _remove(stack, count, at):
    """Remove an entry of a stack."""
    for m in range(at, count - 1):
        stack[m] = stack[m + 1]


@compiled(inline="always")
def _seen(stack, at, most, of):
    """True if an entry of a stack is among the first, and nothing opaque is before it."""
    found = at < most
    for m in range(at):
        found &= of[stack[m], OPAQUE] == 0
    return found


@compiled(inline="always")
def _partner(i, n, own, of, place, end, link):
    """Another run of the same part that ends (or starts) where one does: a patch turns away there; or −1.

    Their depths differ where triangles in between are seen from the side.

    Args:
        i: the span with which the run ends.
        n: the number of the gap's spans.
        own: their table.
        of: and the integers.
        place: where the run ends.
        end: HIGH (or LOW).
        link: AFTER (or BEFORE).
    """
    found = -1
    for j in range(n):
        if j != i and of[j, link] < 0 and of[j, PART] == of[i, PART] and abs(own[j, end] - place) <= TOUCH:
            found = j
            break
    return found


@compiled(inline="always")
def _meeting(own, i, j, low, high):
    """Where two spans have one depth, between two places at which their order differs."""
    wide = (own[i, 4] + own[i, 5] * low) * (own[j, 4] + own[j, 5] * low)
    far = (own[i, 4] + own[i, 5] * high) * (own[j, 4] + own[j, 5] * high)
    before = max(depth_at(own, j, low) - depth_at(own, i, low), 0.0) * wide
    after = min(depth_at(own, j, high) - depth_at(own, i, high), 0.0) * far
    return low + (high - low) * before / (before - after) if before - after > 0 else low


@compiled(inline="always")
def _next_meeting(stack, count, own, place, until):
    """The next place at which two neighbours in a stack pass through one another, and the first's index; or −1."""
    best, at, z = np.inf, -1, depth_at(own, stack[0], until) if count > 0 else 0.0
    for m in range(count - 1):
        i, j = stack[m], stack[m + 1]
        beyond = depth_at(own, j, until)
        if beyond < z - ALIKE * abs(z):
            there = _meeting(own, i, j, place, until)
            if there < best:
                best, at = there, m
        z = beyond
    return best, at


@compiled(inline="always")
def _next_ending(stack, count, own, of, place):
    """The first run in a stack that ends at a place, or `count`; other runs go on with their next spans there."""
    found = count
    for m in range(count):
        i = stack[m]
        while own[i, HIGH] <= place and of[i, AFTER] >= 0:
            i = of[i, AFTER]
        stack[m] = i
        found = m if own[i, HIGH] <= place and found == count else found
    return found


@compiled(inline="always")
def _next_starting(n, own, of, place, until):
    """The nearest run that starts at a place, and is not in the stack yet; n if there is none.

    Of several, such as of parts that have an edge in common, that is: whichever part comes first.
    """
    found = n
    for i in range(n):
        waits = of[i, LIVE] == 1 and of[i, INSIDE] == 0 and of[i, BEFORE] < 0
        if waits and own[i, LOW] <= place < own[i, HIGH]:
            if found == n or _before(own, i, found, place, min(until, own[i, HIGH], own[found, HIGH])):
                found = i
    return found


@compiled(inline="always")
def _index(stack, count, i):
    """The place of a span in a stack; −1 if it is not there."""
    found = -1
    for m in range(count):
        found = m if stack[m] == i else found
    return found


@compiled
def _record(change, stack, count, own, of, enders, whole, place_of, samples, places, sides):
    """Fill in change f of the stack along a gap, but for the samples of what ends there; see `changes`.

    `enders[f]` are filled with the runs that change, the second one −1 for none. `change` holds no constants: for
    each of them the helper would be compiled again.
    """
    base, f, kind, at, partner, place = change
    e, most, entries, second = base + f, sides.shape[2], samples.shape[1] - 2, at + 1 if kind == INTERSECT else partner
    enders[f, 0], enders[f, 1] = stack[at], stack[second] if second >= 0 else -1
    whole[e, 1], place_of[e] = kind, place
    samples[e], sides[e] = -1, -1
    places[e] = place
    n = 0
    for m in range(count):
        i = stack[m]
        if n == entries:
            break
        samples[e, 2 + n, 0], samples[e, 2 + n, 1] = of[i, PART], of[i, TRIANGLE]
        places[e, 2 + n] = min(max(place, own[i, 0]), own[i, 1])
        n += 1
        ends = kind < INTERSECT and (m == at or m == partner)
        if of[i, OPAQUE] == 1 and not ends and m > (at if kind == INTERSECT else -1):
            break
    for side in range(2):
        k, whole[e, 2 + side] = 0, -1
        for m in range(n):
            here = m
            if kind == INTERSECT and side == 1 and (m == at or m == at + 1) and at + 1 < n:
                here = 2 * at + 1 - m
            if kind == 1 - side and (m == at or m == partner):
                continue
            if k == most:
                break
            sides[e, side, k] = here
            k += 1
            if of[stack[here], OPAQUE] == 1:
                break
    # The surface that changes, and what is behind it: parts before and behind the crossing.
    if kind == INTERSECT:
        whole[e, 2], whole[e, 3] = of[stack[at], PART], of[stack[at + 1], PART]
    else:
        whole[e, 2 + kind] = of[stack[at], PART]
        k = sides[e, 1 - kind, at] if at < most else -1
        whole[e, 3 - kind] = samples[e, 2 + k, 0] if k >= 0 else -1


@compiled(inline="always")
def _complete(base, f, found, g, enders, own, of, inner, whole, place_of, samples, places):
    """Fill in the samples of what ends at a change: the last ones, and those that tell colours."""
    e, kind = base + f, whole[base + f, 1]
    whole[e, 0], whole[e, 4], whole[e, 5] = g, f == 0, f == found - 1
    place = place_of[e]
    for n in range(2):
        i = enders[f, n]
        if kind == INTERSECT:
            samples[e, n, 0], samples[e, n, 1], places[e, n] = of[i, PART], of[i, TRIANGLE], place
            continue
        if i < 0:
            continue
        x = i
        if kind == BEFORE_ENDS:
            beside = place_of[e - 1] if f > 0 else 0.0
            inward = place - min(inner, max(place - beside, 0.0) / 2)
            while own[i, 0] > inward and of[i, BEFORE] >= 0:
                i = of[i, BEFORE]
            inward = max(inward, min(own[i, 0], place))
        else:
            beside = place_of[e + 1] if f + 1 < found else 1.0
            inward = place + min(inner, max(beside - place, 0.0) / 2)
            while own[i, 1] < inward and of[i, AFTER] >= 0:
                i = of[i, AFTER]
            inward = min(inward, max(own[i, 1], place))
        if n == 0:
            samples[e, kind, 0], samples[e, kind, 1], places[e, kind] = of[x, PART], of[x, TRIANGLE], place
        for k in range(2, samples.shape[1]):
            if samples[e, k, 0] == of[x, PART] and samples[e, k, 1] == of[x, TRIANGLE]:
                samples[e, k, 1], places[e, k] = of[i, TRIANGLE], inward
                break


@compiled(inline="always")
def _fill_runs(g, n, own, of, opaque, seen, depth, gap, knots):
    """Fill in the runs of a gap of n spans, and where spans start and end, in order; returns the number of places."""
    _link(own, of, n)
    for i in range(n):
        if of[i, BEFORE] >= 0:
            continue
        tail, j = i, i
        while of[tail, AFTER] >= 0:
            tail = of[tail, AFTER]
        real = own[tail, HIGH] - own[i, LOW] >= TOUCH and _fit_to_centres(i, tail, own, of, opaque, seen, depth, gap, g)
        while j >= 0:
            of[j, LIVE] = real
            j = of[j, AFTER]
    count = 0
    for i in range(n):
        for end in (LOW, HIGH):
            if of[i, LIVE] == 1 and 0 < own[i, end] < 1:
                at = count
                while at > 0 and knots[at - 1] > own[i, end]:
                    knots[at] = knots[at - 1]
                    at -= 1
                knots[at], count = own[i, end], count + 1
    knots[count] = 1.0
    return count + 1


@compiled(inline="always")
def _next_knot(knots, k, known):
    """The first of sorted knots that is greater than number k; the one after it if there is none."""
    found = knots[k + 1]
    for m in range(k + 1, known):
        if knots[m] > knots[k]:
            found = knots[m]
            break
    return found


@compiled(inline="always")
def _found_along(numbers, own, of, stack, knots, enders, whole, place_of, samples, places, sides):
    """Fill in the changes of the stack along a gap, as far as there is room; returns their number.

    `numbers` are those of spans, of knots, of runs that are in the stack at first, of the first change, and the room.
    """
    n, known, count, base, room = numbers
    found, place, most = 0, 0.0, sides.shape[2]
    for k in range(known):
        for _ in range(count * count):  # Runs that pass through one another before the next knot.
            there, m = _next_meeting(stack, count, own, place, knots[k])
            if m < 0:
                break
            place = max(place, there)
            if _seen(stack, m, most, of):
                if found < room:
                    change = base, found, np.int64(INTERSECT), m, np.int64(-1), place
                    _record(change, stack, count, own, of, enders, whole, place_of, samples, places, sides)
                found += 1
            stack[m], stack[m + 1] = stack[m + 1], stack[m]
        place = knots[k]
        if k + 1 == known or place >= 1 or (k > 0 and place <= knots[k - 1]):
            continue
        m = _next_ending(stack, count, own, of, place)
        while m < count:
            other = _partner(stack[m], n, own, of, place, HIGH, AFTER)
            partner = _index(stack, count, other) if other >= 0 else -1
            m, partner = (partner, m) if 0 <= partner < m else (m, partner)
            if _seen(stack, m, most, of):
                if found < room:
                    change = base, found, np.int64(BEFORE_ENDS), m, partner, place
                    _record(change, stack, count, own, of, enders, whole, place_of, samples, places, sides)
                found += 1
            for x in (partner, m):
                if x >= 0:
                    _remove(stack, count, x)
                    count -= 1
            m = _next_ending(stack, count, own, of, place)
        farther = _next_knot(knots, k, known)
        i = _next_starting(n, own, of, place, farther)
        while i < n:
            low, partner = own[i, LOW], -1
            m = _insert(stack, count, i, own, low, min(farther, own[i, HIGH]))
            of[i, INSIDE], count = 1, count + 1
            other = _partner(i, n, own, of, low, LOW, BEFORE)
            if other >= 0 and of[other, LIVE] == 1 and of[other, INSIDE] == 0:
                partner = _insert(stack, count, other, own, low, min(farther, own[other, HIGH]))
                of[other, INSIDE], count = 1, count + 1
                m, partner = (m, partner) if partner > m else (partner, m + 1)
            if _seen(stack, m, most, of):
                if found < room:
                    change = base, found, np.int64(BEHIND_ENDS), m, partner, place
                    _record(change, stack, count, own, of, enders, whole, place_of, samples, places, sides)
                found += 1
            i = _next_starting(n, own, of, place, farther)
    return found


@loop
def changes(
    first, last, gap, begins, spans, names, parts, opaque, seen, depth, room, rows, counts, inner, whole,
    place_of, samples, places, sides,
):  # fmt: skip
    """Fill in the changes of stacks along gaps, in order.

    Only those that are seen count: not behind an opaque layer, nor behind the first K.

    Args:
        first: the first gap.
        last: the gap after the last.
        gap: (M, 3), see `Gaps`.
        begins: (M + 1,) where the spans of each gap begin.
        spans: (N, 6) or (N, 9), see `spans_loops.spans_of`.
        names: (N, 3), see `spans_loops.spans_of`.
        parts: (N,) int32.
        opaque: bool, for each part.
        seen: (K, H, W) int32, the parts of the samples at centres; −1 where there are no more.
        depth: (K, H, W) float64, their depths.
        room: (M + 1,) int64, the rows of what follows up to which there is room for the changes of gaps before each.
        rows: (M,) int64 to fill: the row where the changes of each gap begin; −1 where there is too little room.
        counts: (M,) int32 to fill: the number of changes of each gap.
        inner: distance of the samples that tell colours of what ends.
        whole: (E, 6) int32 to fill: gap; BEFORE_ENDS, BEHIND_ENDS or INTERSECT; the part of the surface that changes,
            and the part behind it, or those that intersect, as before and behind; 1 for the gap's first, and its last.
        place_of: (E,) float64 to fill: their places.
        samples: (E, 2 + K + 1, 2) int32 to fill: part and triangle of the last samples before and behind, or −1; then
            of the stack there, front to back, with what starts or ends.
        places: (E, 2 + K + 1) to fill: places of these samples.
        sides: (E, 2, K) int32 to fill: the stacks before and behind, as indices in that stack, or −1.
    """
    longest, at, end = 0, room[first], room[last]
    for g in range(first, last):
        longest = max(longest, begins[g + 1] - begins[g])
    own, of = np.empty((longest, 11)), np.empty((longest, 8), np.int64)
    stack, knots = np.empty(longest + 1, np.int64), np.empty(2 * longest + 1)
    enders = np.empty((end - at, 2), np.int64)
    for g in range(first, last):
        n, base = begins[g + 1] - begins[g], at
        for i in range(n):
            x = begins[g] + i
            for c in range(spans.shape[1]):
                own[i, c] = spans[x, c]
            own[i, LOW], own[i, HIGH] = spans[x, 0], spans[x, 1]
            of[i, PART], of[i, TRIANGLE], of[i, OPAQUE] = parts[x], names[x, 1], opaque[parts[x]]
            of[i, AFTER], of[i, BEFORE], of[i, LIVE], of[i, INSIDE], of[i, EDGES] = -1, -1, 0, 0, names[x, 2]
        known, count = _fill_runs(g, n, own, of, opaque, seen, depth, gap, knots), 0
        for i in range(n):
            if of[i, LIVE] == 1 and own[i, LOW] <= 0 < own[i, HIGH]:
                _insert(stack, count, i, own, 0.0, min(knots[0], own[i, HIGH]))
                of[i, INSIDE], count = 1, count + 1
        numbers = n, known, count, base, end - base
        found = _found_along(numbers, own, of, stack, knots, enders, whole, place_of, samples, places, sides)
        rows[g], counts[g] = base, found
        if found > end - base:
            rows[g], found = -1, 0
        for f in range(found):
            _complete(base, f, found, g, enders, own, of, inner, whole, place_of, samples, places)
        at += found
