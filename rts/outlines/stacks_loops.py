"""The stacks of layers along gaps, from spans, and the places where they change. Compiled.

A *run* is a surface along a gap: spans that follow one another, end to start. A sheet that turns away ends there, as
the back does that it turns into. The stack at a place is the runs there, front to back. It changes where a run starts
or ends, and where two runs pass through one another.
"""

from __future__ import annotations

import numpy as np

from rts.compiling.loops import compiled, loop
from rts.outlines.spans_loops import ALIKE, LAST, MARGIN, SHORT, TINY, TOUCH, depth_at

CLOSE = 1e-5
"""Distance from a centre, in cells, within which the sample there decides on which side of it a run ends."""

SAME = 1e-4
"""Share of the depth by which a sample at a centre may differ from the run that it lies on."""


@compiled
def _alike(spans, i, j, place):
    """True if two spans have about one depth at a place."""
    z = depth_at(spans, i, place)
    return abs(depth_at(spans, j, place) - z) <= ALIKE * abs(z)


@compiled
def _link(index, spans, parts, low, high, after, before):
    """Fill `after` and `before` (n,), in the order of `index`: the span that each one goes on with, or −1."""
    n = len(index)
    after[:n], before[:n] = -1, -1
    for i in range(n):
        for j in range(n):
            if i == j or before[j] >= 0 or parts[index[i]] != parts[index[j]] or not high[j] > high[i]:
                continue
            if abs(low[j] - high[i]) <= TOUCH and _alike(spans, index[i], index[j], high[i]):
                after[i], before[j] = j, i
                break


@compiled
def _listed(part, z, seen, depth, g, k):
    """1 if the samples at a centre hold one of a part at a depth; −1 if they hide it; else 0."""
    for layer in range(seen.shape[2]):
        if seen[g, k, layer] < 0:
            return 0
        if seen[g, k, layer] == part and abs(depth[g, k, layer] - z) <= SAME * abs(z):
            return 1
    # Behind all that is listed, where the list is full.
    return -1 if z > depth[g, k, seen.shape[2] - 1] else 0


@compiled
def _hides(opaque, z, seen, depth, g, k):
    """True if a sample at a centre hides what lies at a depth."""
    for layer in range(seen.shape[2]):
        if seen[g, k, layer] >= 0 and opaque[seen[g, k, layer]] and depth[g, k, layer] < z:
            return True
    return False


@compiled
def _settle(head, tail, index, spans, parts, opaque, seen, depth, g, after, low, high):
    """Move the ends of a run that lie at a centre to the side that the samples there say; True if the run is real.

    A run that covers a centre with no sample there touches the line with an edge alone.
    """
    part = parts[index[head]]
    for k in range(2):
        centre = float(k)
        start, end = low[head], high[tail]
        if start > centre + CLOSE or end < centre - CLOSE:
            continue
        i = head
        while high[i] < centre and after[i] >= 0:
            i = after[i]
        z = depth_at(spans, index[i], centre)
        found = _listed(part, z, seen, depth, g, k)
        if start < centre - CLOSE and end > centre + CLOSE:
            if found == 0 and not _hides(opaque, z, seen, depth, g, k):
                return False
            continue
        if abs(start - centre) <= CLOSE:
            if k == 0:
                low[head] = -1.0 if found != 0 else max(start, TINY)
            else:
                low[head] = min(start, 1 - TINY) if found != 0 else 2.0
        if abs(end - centre) <= CLOSE:
            if k == 0:
                high[tail] = max(end, TINY) if found != 0 else -1.0
            else:
                high[tail] = 2.0 if found != 0 else min(end, 1 - TINY)
    return True


@compiled
def _before(spans, i, j, place, until):
    """True if a span lies before another at a place; if they meet there, farther on."""
    a, b = depth_at(spans, i, place), depth_at(spans, j, place)
    if abs(a - b) > ALIKE * abs(a):
        return a < b
    return depth_at(spans, i, until) < depth_at(spans, j, until)


@compiled
def _insert(stack, count, i, index, spans, place, until):
    """Insert a span into a stack by depth; returns its index."""
    at = count
    while at > 0 and _before(spans, index[i], index[stack[at - 1]], place, until):
        stack[at] = stack[at - 1]
        at -= 1
    stack[at] = i
    return at


@compiled
def _remove(stack, count, at):
    """Remove an entry of a stack."""
    for m in range(at, count - 1):
        stack[m] = stack[m + 1]


@compiled
def _seen(stack, at, most, index, parts, opaque):
    """True if an entry of a stack is among the first, and nothing opaque is before it."""
    if at >= most:
        return False
    for m in range(at):
        if opaque[parts[index[stack[m]]]]:
            return False
    return True


@compiled
def _partner(i, index, parts, place, ends, neighbour):
    """Another run of the same part that ends (or starts) where one does: a sheet turns away there; or −1.

    Their depths differ where triangles in between are seen from the side.

    Args:
        i: the span with which the run ends.
        index: the gap's spans.
        parts: (N,).
        place: where it ends.
        ends: (n,), where spans end (or start).
        neighbour: (n,), what they go on with there, or −1.
    """
    for j in range(len(index)):
        if j != i and neighbour[j] < 0 and parts[index[j]] == parts[index[i]] and abs(ends[j] - place) <= TOUCH:
            return j
    return -1


@compiled
def _meeting(spans, i, j, low, high):
    """Where two spans have one depth, between two places at which their order differs."""
    wide = (spans[i, 4] + spans[i, 5] * low) * (spans[j, 4] + spans[j, 5] * low)
    far = (spans[i, 4] + spans[i, 5] * high) * (spans[j, 4] + spans[j, 5] * high)
    before = max(depth_at(spans, j, low) - depth_at(spans, i, low), 0.0) * wide
    after = min(depth_at(spans, j, high) - depth_at(spans, i, high), 0.0) * far
    return low + (high - low) * before / (before - after) if before - after > 0 else low


@compiled
def _next_meeting(stack, count, index, spans, place, until):
    """The next place at which two neighbours in a stack pass through one another, and the first's index; or −1."""
    best, at = np.inf, -1
    for m in range(count - 1):
        i, j = index[stack[m]], index[stack[m + 1]]
        z = depth_at(spans, i, until)
        if depth_at(spans, j, until) < z - MARGIN * abs(z):
            there = _meeting(spans, i, j, place, until)
            if there < best:
                best, at = there, m
    return best, at


@compiled
def _record(e, kind, at, partner, place, stack, count, scene, result):
    """Fill in a change of the stack, but for the samples of what ends there; see `changes`."""
    index, spans, names, parts, opaque = scene
    whole, place_of, samples, places, sides = result
    most, entries = sides.shape[2], samples.shape[1] - 2
    whole[e, 1], place_of[e] = kind, place
    samples[e], sides[e] = -1, -1
    places[e] = place
    n = 0
    for m in range(count):
        i = stack[m]
        if n == entries:
            break
        samples[e, 2 + n, 0], samples[e, 2 + n, 1] = parts[index[i]], names[index[i], 1]
        places[e, 2 + n] = min(max(place, spans[index[i], 0]), spans[index[i], 1])
        n += 1
        if opaque[parts[index[i]]] and not (kind < 2 and (m == at or m == partner)) and m > (at if kind == 2 else -1):
            break
    for side in range(2):
        k, whole[e, 2 + side] = 0, -1
        for m in range(n):
            here = m
            if kind == 2 and side == 1 and (m == at or m == at + 1) and at + 1 < n:
                here = 2 * at + 1 - m
            if kind == 1 - side and (m == at or m == partner):
                continue
            if k == most:
                break
            sides[e, side, k] = here
            k += 1
            if opaque[samples[e, 2 + here, 0]]:
                break
    # The surface that changes, and what is behind it: parts before and behind the break.
    if kind == 2:
        whole[e, 2], whole[e, 3] = parts[index[stack[at]]], parts[index[stack[at + 1]]]
    else:
        whole[e, 2 + kind] = parts[index[stack[at]]]
        k = sides[e, 1 - kind, at] if at < most else -1
        whole[e, 3 - kind] = samples[e, 2 + k, 0] if k >= 0 else -1


@compiled
def _complete(base, f, found, g, enders, index, spans, names, parts, after, before, inner, result):
    """Fill in the samples of what ends at a change: the last ones, and those that tell colours."""
    whole, place_of, samples, places, sides = result
    e, kind = base + f, whole[base + f, 1]
    whole[e, 0], whole[e, 4], whole[e, 5] = g, f == 0, f == found - 1
    place = place_of[e]
    if kind == 2:
        for side in range(2):
            i = index[enders[f, side]]
            samples[e, side, 0], samples[e, side, 1], places[e, side] = parts[i], names[i, 1], place
        return
    for n in range(2):
        i = enders[f, n]
        if i < 0:
            continue
        x = index[i]
        if kind == 0:
            end = min(max(place - LAST, spans[x, 0], 0.0), place)
            beside = place_of[e - 1] if f > 0 else 0.0
            inward = end - min(inner, max(end - beside, 0.0) / 2)
            while spans[index[i], 0] > inward and before[i] >= 0:
                i = before[i]
            inward = max(inward, min(spans[index[i], 0], end))
        else:
            end = max(min(place + LAST, spans[x, 1], 1.0), place)
            beside = place_of[e + 1] if f + 1 < found else 1.0
            inward = end + min(inner, max(beside - end, 0.0) / 2)
            while spans[index[i], 1] < inward and after[i] >= 0:
                i = after[i]
            inward = min(inward, max(spans[index[i], 1], end))
        if n == 0:
            samples[e, kind, 0], samples[e, kind, 1], places[e, kind] = parts[x], names[x, 1], end
        for k in range(2, samples.shape[1]):
            if samples[e, k, 0] == parts[x] and samples[e, k, 1] == names[x, 1]:
                samples[e, k, 1], places[e, k] = names[index[i], 1], inward
                break


@compiled
def _note(kind, at, partner, place, stack, count, scene, found, base, enders, result):
    """Count a change of the stack, if it is seen, and fill it in if there is room in `enders`; returns the number."""
    index, _, _, parts, opaque = scene
    if not _seen(stack, at, result[4].shape[2], index, parts, opaque):
        return found
    if found < len(enders):
        _record(base + found, kind, at, partner, place, stack, count, scene, result)
        other = at + 1 if kind == 2 else partner
        enders[found, 0], enders[found, 1] = stack[at], stack[other] if other >= 0 else -1
    return found + 1


@compiled
def _cross(place, until, stack, count, scene, found, base, enders, result):
    """Record runs that pass through one another between two places; returns the number of changes."""
    index, spans = scene[0], scene[1]
    for _ in range(count * count):
        there, m = _next_meeting(stack, count, index, spans, place, until)
        if m < 0:
            break
        place = max(place, there)
        found = _note(2, m, -1, place, stack, count, scene, found, base, enders, result)
        stack[m], stack[m + 1] = stack[m + 1], stack[m]
    return found


@compiled
def _end(place, stack, count, scene, runs, found, base, enders, result):
    """Take out runs that end, or go on with another span; returns the stack's height and the number of changes."""
    low, high, after, before, live, inside = runs
    index, parts, m = scene[0], scene[3], 0
    while m < count:
        i = stack[m]
        while high[i] <= place and after[i] >= 0:
            i = after[i]
        stack[m] = i
        if high[i] > place:
            m += 1
            continue
        other, partner = _partner(i, index, parts, place, high, after), -1
        for k in range(count):
            partner = k if k != m and other >= 0 and stack[k] == other else partner
        front = m if partner < 0 else min(m, partner)
        partner = max(m, partner) if partner >= 0 else partner
        found = _note(0, front, partner, place, stack, count, scene, found, base, enders, result)
        if partner >= 0:
            _remove(stack, count, partner)
            count -= 1
        _remove(stack, count, front)
        count, m = count - 1, 0
    return count, found


@compiled
def _start(place, farther, stack, count, scene, runs, found, base, enders, result):
    """Put in the runs that start at a place; returns the stack's height and the number of changes."""
    low, high, after, before, live, inside = runs
    index, spans, parts = scene[0], scene[1], scene[3]
    for i in range(len(index)):
        if not live[i] or inside[i] or before[i] >= 0 or low[i] > place or high[i] <= place:
            continue
        front = _insert(stack, count, i, index, spans, low[i], min(farther, high[i]))
        inside[i], count = True, count + 1
        other, partner = _partner(i, index, parts, low[i], low, before), -1
        if other >= 0 and live[other] and not inside[other]:
            partner = _insert(stack, count, other, index, spans, low[i], min(farther, high[other]))
            inside[other], count = True, count + 1
            front, partner = (front, partner) if partner > front else (partner, front + 1)
        found = _note(1, front, partner, place, stack, count, scene, found, base, enders, result)
    return count, found


@compiled
def _fill_runs(g, scene, seen, depth, runs, knots):
    """Fill in the runs of a gap, and the places where spans start and end, in order; returns the number of places."""
    index, spans, _, parts, opaque = scene
    low, high, after, before, live, inside = runs
    for i in range(len(index)):
        low[i], high[i], live[i], inside[i] = spans[index[i], 0], spans[index[i], 1], False, False
    _link(index, spans, parts, low, high, after, before)
    for i in range(len(index)):
        if before[i] >= 0:
            continue
        tail, start, j = i, low[i], i
        while after[tail] >= 0:
            tail = after[tail]
        real = high[tail] - start >= SHORT
        real = real and _settle(i, tail, index, spans, parts, opaque, seen, depth, g, after, low, high)
        while j >= 0:
            live[j] = real
            j = after[j]
    count = 0
    for i in range(len(index)):
        for place in (low[i], high[i]):
            if live[i] and 0 < place < 1:
                knots[count], count = place, count + 1
    knots[count] = 1.0
    knots[: count + 1] = np.sort(knots[: count + 1])
    return count + 1


@compiled
def _next_knot(knots, k, known):
    """The first of sorted knots that is greater than number k; the one after it if there is none."""
    for m in range(k + 1, known):
        if knots[m] > knots[k]:
            return knots[m]
    return knots[k + 1]


@loop
def changes(
    first, last, begins, spans, names, parts, opaque, seen, depth, counts, at, fill, inner, whole, place_of,
    samples, places, sides,
):  # fmt: skip
    """Count the changes of stacks along gaps, or fill them in, in order.

    Only those that are seen count: not behind an opaque layer, nor behind the first K.

    Args:
        first: the first gap.
        last: the gap after the last.
        begins: (M + 1,) where the spans of each gap begin.
        spans: (N, 6), see `spans_loops.spans_of`.
        names: (N, 2) gap and triangle.
        parts: (N,) int32.
        opaque: bool, for each part.
        seen: (M, 2, K) int32, the parts of the samples at both centres; −1 where there are no more.
        depth: (M, 2, K) float64, their depths.
        counts: (M,) int32, numbers of changes; to fill if they are counted.
        at: (M,) where the changes of each gap begin; used if
        fill: True to fill in what follows, False to count.
        inner: distance of the samples that tell colours of what ends.
        whole: (E, 6) int32 to fill: gap; 0 or 1 where the surface before or behind ends, 2 where two cross; its part,
            and the part behind it, or those that cross, as before and behind; 1 for the gap's first, and its last.
        place_of: (E,) float64 to fill: their places.
        samples: (E, 2 + K + 1, 2) int32 to fill: part and triangle of the last samples before and behind, or −1; then
            of the stack there, front to back, with what starts or ends.
        places: (E, 2 + K + 1) to fill: places of these samples.
        sides: (E, 2, K) int32 to fill: the stacks before and behind, as indices in that stack, or −1.
    """
    result = whole, place_of, samples, places, sides
    for g in range(first, last):
        index = np.arange(begins[g], begins[g + 1])
        n, scene = len(index), (index, spans, names, parts, opaque)
        low, high, after, before = np.empty(n), np.empty(n), np.empty(n, np.int32), np.empty(n, np.int32)
        live, inside = np.empty(n, np.bool_), np.empty(n, np.bool_)
        runs, stack, knots = (low, high, after, before, live, inside), np.empty(n + 1, np.int32), np.empty(2 * n + 1)
        enders = np.empty((counts[g] if fill else 0, 2), np.int32)
        known, count, found, place = _fill_runs(g, scene, seen, depth, runs, knots), 0, 0, 0.0
        for i in range(n):
            if live[i] and low[i] <= 0 < high[i]:
                _insert(stack, count, i, index, spans, 0.0, min(knots[0], high[i]))
                inside[i], count = True, count + 1
        for k in range(known):
            found = _cross(place, knots[k], stack, count, scene, found, at[g], enders, result)
            place = knots[k]
            if k + 1 < known and place < 1 and (k == 0 or place > knots[k - 1]):
                count, found = _end(place, stack, count, scene, runs, found, at[g], enders, result)
                farther = _next_knot(knots, k, known)
                count, found = _start(place, farther, stack, count, scene, runs, found, at[g], enders, result)
        if not fill:
            counts[g] = found
            continue
        for f in range(found):
            _complete(at[g], f, found, g, enders, index, spans, names, parts, after, before, inner, result)
