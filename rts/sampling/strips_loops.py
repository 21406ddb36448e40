"""Fine cells of active pixels laid out in strips, and samples put into them. Compiled.

A piece is a run of a strip's columns, or a part of one that has its own place in the layout: (strip, first column,
number of columns, line, place in the line), in pixels. The place is where its left apron begins. The right apron is as
wide; both together, rounded up to whole pixels, are the `gap`.
"""

from __future__ import annotations

import numpy as np

from rts.compiling.loops import compiled, loop

WANTED, NEAR = 1, 2
"""Bits of cells: inside of an active pixel, and within two cells of one."""


@loop
def find(active, high, gap):
    """Runs (R, 3) int32 of columns of strips: strip, first column, number. Runs that aprons would join are one.

    Args:
        active: (H, W) uint8.
        high: pixels from top to bottom of a strip.
        gap: pixels that aprons on two opposite sides take.
    """
    height, width = active.shape
    strips, found = (height + high - 1) // high, 0
    runs, some = np.empty((strips * (width // (gap + 2) + 1), 3), np.int32), np.empty(width, np.uint8)
    for strip in range(strips):
        some[:] = 0
        for y in range(strip * high, min(height, (strip + 1) * high)):
            _unite(some, active[y])
        last = -1
        for x in range(width):
            if some[x]:
                if last < 0 or x - last > gap + 1:
                    runs[found, 0], runs[found, 1] = strip, x
                    found += 1
                last = x
                runs[found - 1, 2] = x + 1 - runs[found - 1, 1]
    return runs[:found]


@compiled
def _unite(some, active):
    for x in range(len(some)):
        some[x] |= active[x]


@loop
def split(runs, gap, lines, across):
    """Pieces (P, 5) int32 of runs, cut to fit the layout; what finds no room after the last line is left out.

    Args:
        runs: (R, 3), the result of `find`.
        gap: pixels that aprons on two opposite sides take.
        lines: number of lines of pieces.
        across: pixels of width in a line, aprons included.
    """
    pieces = np.empty((len(runs) + lines, 5), np.int32)
    found, line, at = 0, 0, 0
    for r in range(len(runs)):
        strip, first, left = runs[r]
        while left > 0:
            fits = min(left, across - at - gap)
            if fits < 1:
                line, at = line + 1, 0
                if line == lines:
                    return pieces[:found]
                continue
            piece = pieces[found]
            piece[0], piece[1], piece[2], piece[3], piece[4] = strip, first, fits, line, at
            found, at, first, left = found + 1, at + fits + gap, first + fits, left - fits
    return pieces[:found]


@loop
def number(active, pieces, high, pitch, across, pixel):
    """Write to `pixel`, for the active pixels of pieces, their flat index in the layout; leave other entries alone.

    Args:
        active: (H, W) uint8.
        pieces: (P, 5).
        high: pixels from top to bottom of a strip.
        pitch: pixels from a line of pieces to the next.
        across: pixels of width in the layout, without its apron.
        pixel: (H, W) int32, −1 at the start.
    """
    height, _ = active.shape
    for strip, first, columns, line, at in pieces:
        for y in range(strip * high, min(height, (strip + 1) * high)):
            start = (line * pitch + y - strip * high) * across + at
            for j in range(columns):
                if active[y, first + j]:
                    pixel[y, first + j] = start + j


@compiled
def _needs(needs, active, line, strip, first, columns, side, apron, high):
    """Fill `needs[:columns]`: 1 for the columns of a piece whose active pixels need a line of cells, else 0.

    Args:
        needs: (W,) uint8.
        active: (H, W) uint8.
        line: line of cells of the grid, apron included.
        strip: strip of the piece.
        first: first column of the piece.
        columns: number of its columns.
        side: s, cells along each side of a pixel.
        apron: cells around active pixels that are needed.
        high: pixels from top to bottom of a strip.

    Returns:
        True if any column needs the line.
    """
    needs[:columns] = 0
    top, bottom = strip * high, min(len(active), (strip + 1) * high)
    begin, end = _pixels(line, side, apron)
    some = np.uint8(0)
    for y in range(max(top, begin), min(bottom, end)):
        _unite(needs[:columns], active[y, first : first + columns])
    for j in range(columns):
        some |= needs[j]
    return some != 0


@compiled
def _pixels(line, side, apron):
    """First and end of the lines of pixels that hold a line of cells in themselves or their aprons.

    Line 0 of cells is the first of the image's apron. The lines of pixels may lie outside of the image.
    """
    return (line - 2 * apron) // side, line // side + 1


@compiled
def _begin(marks, first):
    """Start of the first run of marks at `first` or later; the number of marks if there is no run."""
    while first < len(marks) and not marks[first]:
        first += 1
    return first


@compiled
def _end(marks, first):
    """The end of the run of marks that begins at `first`."""
    end = first + 1
    while end < len(marks) and marks[end]:
        end += 1
    return end


@loop
def count(start, stop, active, pieces, firsts, side, apron, high, width, counts):
    """Write to `counts` how many cells the active pixels of the given pieces need in the grid's lines [start, stop).

    The apron around each active pixel is included. A cell that several pixels or pieces need counts once.

    Args:
        start: first line.
        stop: end of the lines.
        active: (H, W) uint8.
        pieces: (P, 5).
        firsts: (S + 1,), where the pieces of each strip begin.
        side: s, cells along each side of a pixel.
        apron: cells around active pixels that are needed.
        high: pixels from top to bottom of a strip.
        width: cells in a line of the grid, apron included.
        counts: (H',) int64, for every line of the grid; entries [start, stop) are written.
    """
    needs, seen = np.empty(active.shape[1], np.uint8), np.zeros(width, np.uint8)
    for line in range(start, stop):
        if line > start and _pixels(line, side, apron) == _pixels(line - 1, side, apron):
            counts[line] = counts[line - 1]
            continue
        (begin, end), found = _strips(line, side, apron, high, len(firsts) - 1), 0
        for p in range(firsts[begin], firsts[end]):
            strip, first, columns = pieces[p, 0], pieces[p, 1], pieces[p, 2]
            some = _needs(needs, active, line, strip, first, columns, side, apron, high)
            for j in range(columns if some else 0):
                if needs[j]:
                    seen[(first + j) * side : (first + j + 1) * side + 2 * apron] = 1
        for u in range(width if begin < end else 0):
            found += np.int64(seen[u])
            seen[u] = 0
        counts[line] = found


@compiled
def _strips(line, side, apron, high, strips):
    """First and end of the strips that may need a line of cells of the grid."""
    return max(0, (line - 2 * apron) // (high * side)), min(strips, line // (high * side) + 1)


@loop
def fill(start, stop, active, pieces, firsts, side, apron, high, gap, offsets, cells, place, kinds):
    """Lay out the cells of lines [start, stop) of the grid, apron included, that active pixels need.

    Args:
        start: first line.
        stop: end of the lines.
        active: (H, W) uint8.
        pieces: (P, 5).
        firsts: (S + 1,), where the pieces of each strip begin.
        side: s, cells along each side of a pixel.
        apron: cells around active pixels that are needed.
        high: pixels from top to bottom of a strip.
        gap: pixels that aprons on two opposite sides take.
        offsets: (H',), the number of cells in the lines before each.
        cells: (M,) int32. The flat indices in the grid of a line's cells are written from its offset on.
        place: (h, w) int32, −1 at the start. Where the layout shows a cell, its index in `cells` is written.
        kinds: (h, w) uint8, 0 at the start, to which the bits `WANTED` and `NEAR` are added.
    """
    width = active.shape[1] * side + 2 * apron
    needs, numbers = np.empty(active.shape[1], np.uint8), np.full(width, -1, np.int32)
    for line in range(start, stop):
        n, (begin, end) = offsets[line], _strips(line, side, apron, high, len(firsts) - 1)
        # Lines of one pixel differ in their numbers alone.
        again = line > start and _pixels(line, side, apron) == _pixels(line - 1, side, apron)
        more = n - offsets[line - 1] if again else 0
        near = _near(line, side, apron)
        alike = line > start and near == _near(line - 1, side, apron)
        for p in range(firsts[begin], firsts[end]):
            strip, first, columns = pieces[p, 0], pieces[p, 1], pieces[p, 2]
            down, over = pieces[p, 3] * (high + gap) * side + line - strip * high * side, pieces[p, 4] * side
            left, right = first * side, (first + columns) * side + 2 * apron
            if again:
                _repeat(place[down, over : over + right - left], place[down - 1, over : over + right - left], more)
            elif _needs(needs, active, line, strip, first, columns, side, apron, high):
                j, until = _begin(needs[:columns], 0), 0
                while j < columns:
                    u, j = max(j * side, until), _end(needs[:columns], j)
                    until = j * side + 2 * apron
                    n = _number(numbers[left + u : left + until], cells, line * width + left + u, n)
                    _copy(place[down, over + u : over + until], numbers[left + u : left + until])
                    j = _begin(needs[:columns], j)
            if alike and line > strip * high * side:
                _copy(kinds[down, over : over + right - left], kinds[down - 1, over : over + right - left])
            else:
                _tell(kinds[down, over : over + right - left], active, near, strip, first, columns, side, apron, high)
        if again:
            _repeat(cells[n : n + more], cells[n - more : n], width)
        for p in range(firsts[begin], firsts[end] if not again else 0):
            numbers[pieces[p, 1] * side : (pieces[p, 1] + pieces[p, 2]) * side + 2 * apron] = -1


@compiled
def _repeat(to, given, more):
    """Fill `to` with the numbers `given`, `more` added to each but −1."""
    more = to.dtype.type(more)
    for u in range(len(to)):
        to[u] = given[u] + more if given[u] >= 0 else given[u]


@compiled
def _number(numbers, cells, first, n):
    """Number the cells of a run that have no number yet, from n on, and list them in `cells`. Returns the next number.

    Args:
        numbers: (R,) int32, the number of each cell of the run, or −1 for none; changed in place.
        cells: (M,) int32; entries from n on are written.
        first: flat index of the run's first cell in the grid.
        n: the first free number.
    """
    known = False
    for u in range(len(numbers)):
        known |= numbers[u] >= 0
    if not known:
        own = cells[n : n + len(numbers)]
        for u in range(len(numbers)):
            numbers[u], own[u] = n + u, first + u
        return n + len(numbers)
    for u in range(len(numbers)):
        if numbers[u] < 0:
            numbers[u], cells[n] = n, first + u
            n += 1
    return n


@compiled
def _copy(to, given):
    for u in range(len(to)):
        to[u] = given[u]


@compiled
def _near(line, side, apron):
    """First and end of the lines of pixels near a line of cells, and the line of pixels that it lies in.

    Near is within two cells, and within the apron. All three may lie outside of the image.
    """
    begin, end = _pixels(line, side, apron)
    own = line - apron
    return max(begin, (own - side - 2) // side + 1), min(end, (own + 2) // side + 1), own // side


@compiled
def _tell(kinds, active, near, strip, first, columns, side, apron, high):
    """Add the bits `WANTED` and `NEAR` to `kinds`, one line of cells of a piece, apron included.

    Args:
        kinds: (columns · side + 2 · apron,) uint8.
        active: (H, W) uint8.
        near: the result of `_near` for the line of cells.
        strip: strip of the piece.
        first: first column of the piece.
        columns: number of its columns.
        side: s, cells along each side of a pixel.
        apron: cells around active pixels.
        high: pixels from top to bottom of a strip.
    """
    around = min(apron, 2)
    begin, end, own = near
    for y in range(max(strip * high, begin), min(len(active), (strip + 1) * high, end)):
        marks, j = active[y, first : first + columns], 0
        while j < columns:
            if not marks[j]:
                j += 1
                continue
            left, j = j * side + apron, _end(marks, j)
            right = j * side + apron
            for u in range(left - around, right + around):
                kinds[u] |= np.uint8(NEAR)
            for u in range(left, right if y == own else left):
                kinds[u] |= np.uint8(WANTED)


@loop
def count_samples(start, stop, row, place, counts):
    """Write to `counts` (K · h,) the number of samples that each of the lines [start, stop) of a layout shows.

    Line k · h + y is line y in layer k. `row` (K, M) has the sample of each listed cell, `place` (h, w) the cell that
    each place shows; −1 for none.
    """
    height = len(place)
    for line in range(start, stop):
        k, found = line // height, 0
        for m in place[line % height]:
            found += m >= 0 and row[k, m] >= 0
        counts[line] = found


@loop
def arrange(start, stop, row, place, cells, settled, firsts, width, offsets, index, shift, laid, part, shown):
    """Put samples into lines [start, stop) of a layout; line k · h + y is line y in layer k.

    Args:
        start: first line.
        stop: end of the lines.
        row: (K, M) int32, the sample of each listed cell, counted over all parts; −1 for none.
        place: (h, w) int32, the cell that each place of the layout shows; −1 for none.
        cells: (M,) int32, the flat index of each cell in the grid.
        settled: (M,) int8, 0 or −1, see `Cells.settled`; empty if there is none.
        firsts: (P − 1,) the first row of each part but the first.
        width: cells in a line of the grid, apron included.
        offsets: (K · h,), the number of the first splat of each line.
        index: (N,) int32, to be filled: the sample of each splat.
        shift: (N, 3) float32, to be filled: cells right and down from the grid to the layout, then 0.
        laid: (K, h, w) int32, to be filled: the splat of each place, or −1.
        part: (K, h, w) int32, to be filled: the part of that splat, or −1.
        shown: (h, w) int8, to be filled: `settled` of each place; no rows if there is none.
    """
    height, across = len(place), np.uint32(width)
    for line in range(start, stop):
        k, y, n = line // height, line % height, offsets[line]
        if k == 0 and len(shown) > 0:
            for x in range(place.shape[1]):
                m = place[y, x]
                shown[y, x] = settled[m] if m >= 0 else -1
        for x in range(place.shape[1]):
            m = place[y, x]
            i = row[k, m] if m >= 0 else -1
            laid[k, y, x], part[k, y, x] = -1, -1
            if i < 0:
                continue
            index[n], laid[k, y, x], part[k, y, x] = i, n, 0
            for first in firsts:
                part[k, y, x] += i >= first
            cell = np.uint32(cells[m])
            shift[n, 0], shift[n, 1], shift[n, 2] = x - cell % across, y - cell // across, 0
            n += 1


@loop
def gather(start, stop, covered, depth, place, laid, deep):
    """Fill lines [start, stop) of `laid` and `deep` (K, h, w) with cover and depth of the listed cells (K, M).

    Line k · h + y is line y in layer k. `place` (h, w) names the cell that each place shows; −1 gives False and 0.
    """
    height = len(place)
    for line in range(start, stop):
        k, y = line // height, line % height
        for x in range(place.shape[1]):
            m = place[y, x]
            laid[k, y, x] = m >= 0 and covered[k, m]
            deep[k, y, x] = depth[k, m] if m >= 0 else 0


@loop
def scatter(start, stop, kept, kinds, place, found):
    """Mark in `found` the listed cells that are kept in lines [start, stop) of a layout.

    Args:
        start: first line; line k · h + y is line y in layer k.
        stop: end of the lines.
        kept: (K, h, w) bool, False where the layout shows no cell. With `kinds`, cleared in place where not `NEAR`.
        kinds: (h, w) uint8, bits; no rows to keep all.
        place: (h, w) int32, the cell that each place shows, or −1.
        found: (K, M) bool, False at the start.
    """
    height = len(place)
    for line in range(start, stop):
        k, y = line // height, line % height
        for x in range(place.shape[1]):
            if kept[k, y, x]:
                kept[k, y, x] = len(kinds) == 0 or kinds[y, x] & NEAR != 0
                if kept[k, y, x]:
                    found[k, place[y, x]] = True
