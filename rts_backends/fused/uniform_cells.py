"""Targets amid splats of one colour: the image has that colour there, and no motion of splats changes it.

The same pass over all samples finds where the fronts of `Visible` end.
"""

from __future__ import annotations

import numpy as np

from rts.plugin_api.loops import compiled, loop
from rts_backends.fused.pairs import BLOCK, mark

EMPTY, SETTLED, FLAT, BUSY = 0, 1, 2, 3
"""States of a target: no splat reaches it; `settled` gives the sample whose colour it shows; it lies amid splats of one
colour; any other."""


LISTED = 1 << 9
"""Mark of `ends`, beside bits 3 (v + 1) + (u + 1) of directions (u, v) in which a front ends: the target is mixed, or
may be covered in part."""

NOTHING, COVERED, LOOSE = np.uint8(1), np.uint8(2), np.uint8(4)
"""Bits of a cell. NOTHING: inside the array without a sample. COVERED: with one. LOOSE: not sure to fill its share of
its neighbours."""


@loop
def survey(
    start,
    stop,
    positions,
    rgba,
    row,
    exits,
    fronts,
    reach,
    states,
    hidden,
    depths,
    seen,
    counts,
    mixed,
    marked,
    ends,
    listed,
):
    """Find the states of the targets of rows [start, stop), and fill the other arrays that describe the cells.

    Mixed targets of `Visible` are marked in the same pass. Those of `Multi` are not: they depend on the extent of all
    depths, which is not known yet.

    Args:
        start: first row.
        stop: end of the rows.
        positions: (N, 3).
        rgba: (N, 4).
        row: (K, H, W).
        exits: (E, H, W), see `rts.plugin_api.records.Cells`.
        fronts: True if front layers alone make a target FLAT; otherwise they must be opaque, to hide those behind.
        reach: the largest offset of a sample from its cell's centre, pixels, at which the nine weights of a target are
            sure to sum to one or more; negative if never.
        states: (H, W) uint8, EMPTY or SETTLED, to be filled where they are EMPTY.
        hidden: (H, B) uint8, zeros, to be marked: the blocks of columns in or beside which hidden layers are covered.
        depths: (H, 2, 2) zeros, for the least and the largest depth, and zero, of each row's fronts and hidden layers.
        seen: (N,) bool, zeros, to be marked: samples that a cell refers to.
        counts: (H,) zeros, to be filled with the number of cells of `row` and `exits` that refer to a sample.
        mixed: (H, W) uint8, to be filled with marks of the mixed targets of `Visible`; no rows if not wanted.
        marked: (H,) zeros, to be filled with the number of targets marked in `mixed` in each row.
        ends: (H, W) uint16, to be filled with the mark LISTED, and, at covered LISTED targets, bits of the directions
            in which the neighbour is empty; no rows if not wanted.
        listed: (H,) zeros, to be filled with the number of targets that are LISTED in each row.
    """
    layers, height, width = row.shape
    blocks, kind, asks = hidden.shape[1], positions.dtype, len(mixed) > 0
    # For three rows: blocks in or beside which hidden layers are, and the depths of these.
    near, z = np.zeros((3, blocks), np.uint8), np.empty((3, layers, width + 2 if asks else 0), kind)
    asked, loaded = np.empty(blocks, np.uint8), np.full((3, blocks), -9, np.int64)
    target, beyond = np.empty((layers, BLOCK), kind), kind.type(np.inf)
    # For three rows, marks of cells: covered; amid three alike; alike with the cell above.
    cells = np.zeros((3, 3, width + 2), np.uint8)
    covered, calm, joins = cells[0], cells[1], cells[2]
    kinds, partial = np.empty((3, width + 2), np.uint8), np.empty(width, np.uint8)
    for y in range(start - 1, stop + 1):
        now, before = (y + 3) % 3, (y + 2) % 3
        covered[now], calm[now], joins[now], near[now], kinds[now] = 0, 0, 0, 0, LOOSE
        if 0 <= y < height:
            above, marks = row[0, max(y - 1, 0)], (covered[now], calm[now], joins[now], kinds[now, 1:-1])
            _inspect(positions, rgba, row[0, y], above, y, fronts, reach, *marks)
            if len(ends) > 0:
                _fill_settled(kinds[now, 1:-1], states[y])
            for k in range(len(row)):
                if k > 0 and not fronts:
                    _cover(covered[now], row[k, y])
                if start <= y < stop:
                    counts[y] += _note(row[k, y], positions, k > 0, hidden[y], depths[y, min(k, 1)], seen)
                elif asks and k > 0:
                    _hide(row[k, y], near[now])
            if start <= y < stop:
                for e in range(len(exits)):
                    counts[y] += _note_exits(exits[e, y], seen)
                for b in range(blocks):  # Assigning arrays compiles an error about their shapes as well: a second.
                    near[now, b] = hidden[y, b]
        if y > start and asks:
            for b in range(blocks):
                asked[b] = near[0, b] | near[1, b] | near[2, b]
            mark(mixed[y - 1], asked, positions, row, y - 1, beyond, z, loaded, target)
            marked[y - 1] = _keep_covered(mixed[y - 1], row[0, y - 1])
        if y > start:
            first = (y + 1) % 3
            runs = calm[first], calm[before], calm[now]
            _decide(states[y - 1], covered[0], covered[1], covered[2], *runs, joins[before], joins[now])
            if len(ends) > 0:
                given = kinds[first], kinds[before], kinds[now]
                _mark_partial(partial, *given, row[0, y - 1])
                listed[y - 1] = _unite(partial, mixed, y - 1)
                _fill_ends(ends[y - 1], partial, *given)


@compiled
def _inspect(positions, rgba, cells, above, y, fronts, reach, covered, calm, joins, kinds):
    """Mark row y of cells: the cell of column x at index x + 1, but in `kinds` at x.

    `cells` and `above` (W,) are the samples of this row and of the row above, or −1. `covered`, `calm` and `joins`
    (W + 2,) must be zeros, since only ones are written; `kinds` (W,) is filled. A cell is plain if its sample is within
    `reach` of the cell's centre, along each axis, and opaque (any alpha will do with `fronts`).

    `covered`: with a sample. `calm`: plain, as are its left and right neighbours, all three of equal rgba. `joins`:
    plain, with the rgba of the cell above, which need not be centred. `kinds`: NOTHING | LOOSE without a sample,
    COVERED if centred within `reach`, else COVERED | LOOSE.
    """
    kind = positions.dtype.type
    half, opaque, last, run = kind(0.5), kind(1), -1, 0
    for x in range(len(cells)):
        i = cells[x]
        if i < 0:
            run, kinds[x] = 0, NOTHING | LOOSE
            continue
        covered[x + 1] = 1
        centered = (abs(positions[i, 0] - (kind(x) + half)) <= reach) & (
            abs(positions[i, 1] - (kind(y) + half)) <= reach
        )
        kinds[x] = COVERED if centered else COVERED | LOOSE
        if not (centered and (fronts or rgba[i, 3] == opaque)):
            run = 0
            continue
        run = run + 1 if run > 0 and _alike(rgba, i, last) else 1
        last = i
        if run >= 3:
            calm[x] = 1
        # The other cell is centred if it is calm in its own row.
        if above[x] >= 0 and _alike(rgba, i, above[x]):
            joins[x + 1] = 1


@compiled
def _alike(rgba, i, j):
    same = True
    for c in range(4):
        same &= rgba[i, c] == rgba[j, c]
    return same


@compiled
def _cover(covered, cells):
    for x in range(len(cells)):
        covered[x + 1] |= np.uint8(cells[x] >= 0)


@compiled
def _note(cells, positions, behind, hidden, depths, seen):
    """Note a row of a layer, samples `cells` (W,) or −1; return the number of covered cells.

    Marks the samples in `seen` (N,), and extends `depths` (2,), the least and the largest depth. If the layer is
    `behind` the front, also marks in `hidden` (B,) the blocks of columns in or beside which a cell is covered.
    """
    count, last = 0, len(cells) - 1
    least, largest = depths[0], depths[1]
    for x in range(len(cells)):
        i = cells[x]
        if i >= 0:
            count += 1
            seen[i] = True
            least, largest = min(least, positions[i, 2]), max(largest, positions[i, 2])
            if behind:
                hidden[max(x - 1, 0) // BLOCK] = hidden[min(x + 1, last) // BLOCK] = 1
    depths[0], depths[1] = least, largest
    return count


@compiled
def _note_exits(cells, seen):
    """Mark the samples of a row of exits in `seen`; return how many cells have one."""
    count = 0
    for x in range(len(cells)):
        if cells[x] >= 0:
            count += 1
            seen[cells[x]] = True
    return count


@compiled
def _hide(cells, hidden):
    """Mark the blocks in or beside which a row of a hidden layer is covered, as `_note` does."""
    last = len(cells) - 1
    for x in range(len(cells)):
        if cells[x] >= 0:
            hidden[max(x - 1, 0) // BLOCK] = hidden[min(x + 1, last) // BLOCK] = 1


@compiled
def _keep_covered(mixed, cells):
    """Clear marks of targets without a sample; return the number of those left."""
    count = 0
    for x in range(len(cells)):
        mixed[x] &= np.uint8(cells[x] >= 0)
        count += mixed[x]
    return count


@compiled
def _decide(states, covered0, covered1, covered2, calm0, calm1, calm2, joins1, joins2):
    """Fill a row of `states` with EMPTY, FLAT or BUSY, but for SETTLED ones, which stay.

    The others (W + 2,) are marks of `_inspect`, of the rows above (0), at (1) and below (2) the targets'.
    """
    for x in range(len(states)):
        some = covered0[x] | covered0[x + 1] | covered0[x + 2] | covered1[x] | covered1[x + 1] | covered1[x + 2]
        some |= covered2[x] | covered2[x + 1] | covered2[x + 2]
        flat = calm0[x + 1] & calm1[x + 1] & calm2[x + 1] & joins1[x + 1] & joins2[x + 1]
        states[x] = SETTLED if states[x] == SETTLED else (some << 1 | some) - flat


@compiled
def _fill_settled(kinds, states):
    """Mark settled targets as COVERED and not LOOSE: no loose cell lies beside them, unless samples overflowed."""
    for x in range(len(kinds)):
        kinds[x] = COVERED if states[x] == SETTLED else kinds[x]


@compiled
def _mark_partial(partial, above, level, below, fronts):
    """Fill `partial` (W,), 1 at the targets of a row that may be covered in part, 0 at others.

    `above`, `level` and `below` (W + 2,) are bits of cells, such as LOOSE, of three rows, one cell more at each side.
    `fronts` (W,) are the samples of the targets' own cells, or −1.
    """
    for x in range(len(partial)):
        around = above[x] | above[x + 1] | above[x + 2] | level[x] | level[x + 1] | level[x + 2]
        around |= below[x] | below[x + 1] | below[x + 2]
        dropped = (fronts[x] < 0) & (level[x + 1] == COVERED)
        partial[x] = np.uint8((around & COVERED != 0) & (around & LOOSE != 0) & ~dropped)


@compiled
def _unite(partial, mixed, y):
    """Add the mixed targets (H, W) of row y to the marks `partial` (W,); return the number of marks.

    `mixed` without rows adds none.
    """
    count = 0
    for x in range(len(partial) if len(mixed) > 0 else 0):
        partial[x] |= mixed[y, x]
    for x in range(len(partial)):
        count += partial[x]
    return count


@compiled
def _fill_ends(ends, partial, above, level, below):
    """Fill a row of `ends` (W,), see `survey`: LISTED where `partial`, and if covered, directions of empty neighbours.

    `above`, `level` and `below` are as in `_mark_partial`.
    """
    for x in range(len(ends)):
        bits = _empty(above, x, 0) | _empty(above, x + 1, 1) | _empty(above, x + 2, 2)
        bits |= _empty(level, x, 3) | _empty(level, x + 2, 5)
        bits |= _empty(below, x, 6) | _empty(below, x + 1, 7) | _empty(below, x + 2, 8)
        fronts = partial[x] & (level[x + 1] >> 1)
        ends[x] = np.uint16(partial[x]) << 9 | bits * fronts


@compiled
def _empty(kinds, x, n):
    """Bit n if the cell with index x in `kinds` is empty, else 0."""
    return np.uint16(kinds[x] & NOTHING) << n


@loop
def paint(start, stop, settled, border, colors, images):
    """Give settled targets of rows [start, stop) of `images` the colours (T, N, 4) of the samples that `settled` names.

    Images (T, H, W, 4) are the targets less the border. Colours are zero if N is 0.
    """
    zero, some = images.dtype.type(0), colors.shape[1] > 0
    for n in range(len(images)):
        for y in range(start, stop):
            image = images[n, y]
            cells = settled[y + border, border : border + len(image)]
            for x in range(len(image)):
                i = cells[x]
                for c in range(4 if i >= 0 else 0):
                    image[x, c] = colors[n, i, c] if some else zero


@loop
def note(start, stop, settled, shown):
    """Mark in `shown` (N,) bool the samples whose colours settled targets of rows [start, stop) show."""
    last = -1
    for y in range(start, stop):
        for x in range(settled.shape[1]):
            if settled[y, x] != last:
                last = settled[y, x]
                if last >= 0:
                    shown[last] = True


@loop
def collect(start, stop, settled, number, border, g, sums):
    """Sum the gradient `g` (H, W, 4) of an image, the targets less the border, over settled ones of rows [start, stop).

    Adds to `sums` (H, S, 4), by row and by the sample whose colour is shown; `number` (N,) gives its index among S.
    """
    width = g.shape[1]
    for y in range(start, stop):
        end = 0
        while end < width:
            first, i = end, settled[y + border, end + border]
            while end < width and settled[y + border, end + border] == i:
                end += 1
            if i >= 0:
                _add(sums[y, number[i]], g[y, first:end])


@compiled(fastmath={"contract", "reassoc"})
def _add(to, g):
    """Add the sum of the rows of g (n, 4) to `to` (4,), in an order that suits vector instructions."""
    a, b, c, d = to[0], to[1], to[2], to[3]
    for x in range(len(g)):
        a += g[x, 0]
        b += g[x, 1]
        c += g[x, 2]
        d += g[x, 3]
    to[0], to[1], to[2], to[3] = a, b, c, d
