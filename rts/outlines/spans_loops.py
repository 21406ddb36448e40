"""Spans: the parts of gaps that triangles cover. Compiled.

A place along a gap is a number from 0 to 1, from its first centre to its second. A span may reach beyond both. It is
linear in homogeneous coordinates there: its depth is (a + b · place) / (c + d · place).
"""

from __future__ import annotations

import numpy as np

from rts.compiling.loops import compiled, loop
from rts.outlines.silhouettes_loops import ANY_SIZE, BLOCK
from rts.outlines.tolerances import LARGE, TOUCH
from rts.sampling.points_loops import corners_of, edge

REACHES = 0, 1, 2, 4
"""How many cells before gaps there are marks for triangles; see `around`."""


@loop
def wanted(first, last, part, joined, met, gaps, same):
    """Fill in the gaps, in lines `first` to `last`, in which a layer may change.

    Args:
        first: the first line.
        last: the line after the last.
        part: (K, H, W) int32, the parts seen at centres.
        joined: (2, K H, W) bool, true if a patch joins a layer to that of the next centre; see `seen_mesh_loops.seams`.
        met: (2, H, W) uint8, 2 where a silhouette passes.
        gaps: (2, H, W) bool to fill: something is seen at one of both centres that no patch joins; or `met` is 2.
        same: (2, H, W) bool to fill: the same parts are seen at both, and some.
    """
    layers, height, width = part.shape
    for axis in range(2):
        for y in range(first, last):
            count, below = (width - 1, y) if axis == 0 else (width if y + 1 < height else 0, y + 1)
            for x in range(width):
                gaps[axis, y, x], same[axis, y, x] = met[axis, y, x] == 2, x < count and part[0, y, x] >= 0
            for k in range(layers):  # Without branches, for loops that take several cells at once.
                for x in range(count):
                    one, other = part[k, y, x], part[k, below, x + 1 - axis]
                    gaps[axis, y, x] |= ((one & other) >= 0) & ~joined[axis, k * height + y, x]
                    same[axis, y, x] &= one == other


@loop
def around(gap, cells):
    """Mark, in `cells` (H, W) int8, the cells of gaps (M, 3), and those to the left and above.

    The cells of a gap have 1 if it is one along a row, 2 along a column; so have, times four, these and those that are
    one cell before, and so on, for each of the `REACHES`. A triangle that meets a gap has its cell among those that are
    marked so, by its size; see `silhouettes_loops.ANY_SIZE`.
    """
    width, count, marked = cells.shape[1], cells.size, cells.reshape(-1)
    room = width * REACHES[-1]
    marks, wider = np.zeros(count + room, np.int8), np.zeros(count + room, np.int8)
    for n in range(len(gap)):
        kind, at = 2 - gap[n, 2], gap[n, 0] * width + gap[n, 1]
        marks[at] |= kind
        marks[at + (1 if kind == 1 else width)] |= kind
    for n in range(len(REACHES)):
        for axis in range(2 if n > 0 else 0):
            # Before a row they reach into the one above, which does no harm.
            step = (REACHES[n] - REACHES[n - 1]) * (1 if axis == 0 else width)
            behind = marks[step:]
            for i in range(count):
                wider[i] = marks[i] | behind[i]
            marks, wider = wider, marks
        for i in range(count):
            marked[i] |= marks[i] << 2 * n


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


@compiled(inline="always")
def _box(a, b, c, seen, height, width, box):
    """Fill `box` with the least x, largest x, least and largest y of a triangle in the image, and a little around.

    Returns twice its area; NaN, and a box of the whole image, if it is seen in part.
    """
    area = (seen[b, 0] - seen[a, 0]) * (seen[c, 1] - seen[a, 1])
    area -= (seen[c, 0] - seen[a, 0]) * (seen[b, 1] - seen[a, 1])
    for axis in range(2):
        low, high = min(seen[a, axis], seen[b, axis], seen[c, axis]), max(seen[a, axis], seen[b, axis], seen[c, axis])
        box[2 * axis] = 0.0 if np.isnan(area) else low - np.float32(TOUCH)
        box[2 * axis + 1] = (width if axis == 0 else height) if np.isnan(area) else high + np.float32(TOUCH)
    return area


@compiled(inline="always")
def _range(low, high, count):
    """The first of `count` numbers from `low` to `high`, which may be beyond integers, and the one after the last."""
    return int(min(max(np.ceil(low), 0.0), count)), int(max(min(np.floor(high), count - 1.0), -1.0)) + 1


@compiled(inline="always")
def _gaps_of(box, axis, height, width):
    """The lines of centres that a box meets, then the gaps of each: the first and the one after the last."""
    lines, count = (height, width) if axis == 0 else (width, height)
    begin, stop = _range(box[2 - 2 * axis] - 0.5, box[3 - 2 * axis] - 0.5, lines)
    # A gap reaches from its first centre to the next one.
    low, high = _range(box[2 * axis] - 1.5, box[2 * axis + 1] - 0.5, count - 1)
    return begin, stop, low, max(high, low)


@loop
def most_spans(first, last, mesh, gaps, triangles, most, counts):
    """List the triangles that may have spans, with bounds on their numbers.

    Args:
        first: the first block of triangles.
        last: the block after the last.
        mesh: the triangles, a `SeenMesh`.
        gaps: the gaps.
        triangles: (blocks, BLOCK) int32 to fill: in the first places of each block such triangles.
        most: (blocks, BLOCK) int32 to fill, at the same places: the most spans of each.
        counts: (blocks,) int32 to fill: how many such triangles.
    """
    seen, sides, cells, lines, on_lines = mesh.seen, mesh.sides, mesh.cells, mesh.lines, mesh.on_lines
    marks, box, near = gaps.around.reshape(-1), np.empty(4, np.float32), np.empty((2, BLOCK), np.int32)
    height, width = gaps.rows.shape
    for block in range(first, last):
        count, begin, place = 0, block * BLOCK, 0
        for n in range(begin, begin + mesh.counts[block]):  # Without branches, as in `turns`.
            size = abs(sides[on_lines[n]])
            # Sizes 4 and 5 share the last of the marks.
            axes = lines[n] & (marks[cells[n]] >> 2 * (min(size, 4) - 1) | (3 if size == ANY_SIZE else 0))
            near[0, count], near[1, count] = on_lines[n], axes
            count += axes != 0
        for n in range(count):
            t = near[0, n]
            _box(mesh.faces[t, 0], mesh.faces[t, 1], mesh.faces[t, 2], seen, height, width, box)
            triangles[block, place], most[block, place] = t, _most(near[1, n], box, gaps)
            place += most[block, place] > 0
        counts[block] = place


@compiled(inline="always")
def _most(axes, box, gaps):
    """The number of gaps, along axes, on the lines that a box meets."""
    (height, width), number = gaps.rows.shape, 0
    for axis in range(2):
        begin, stop, low, high = _gaps_of(box, axis, height, width)
        for n in range(begin, stop if axes & (1 + axis) else begin):
            # To choose between the arrays themselves would count their references.
            ends = (
                (gaps.rows[n, low], gaps.rows[n, high]) if axis == 0 else (gaps.columns[n, low], gaps.columns[n, high])
            )
            number += ends[1] - ends[0]
    return number


@loop
def spans_of(first, last, triangles, begins, mesh, gaps, names, spans):
    """Spans of triangles on gaps.

    Args:
        first: the first triangle.
        last: the triangle after the last.
        triangles: (M,) the triangles.
        begins: (M,) where the spans of each begin.
        mesh: the triangles of which these are, a `SeenMesh`.
        gaps: the gaps.
        names: (N, 3) int32 to fill, of each span the gap, the triangle, and a sum: 1 if it starts at an edge that no
            other triangle shares, 2 if it ends at one, 4 if the triangle is `LARGE`; or 0 if `spans` have no normals.
            The gaps of those that are left out stay as they are, −1.
        spans: (N, 6) float64 to fill: its ends, and its depth's a, b, c, d. Or (N, 9), with the triangle's unit normal
            on the side that is seen, in the proxy's space, where it starts or ends at such an edge.
    """
    rows, vertices, faces, adjacent = mesh.rows, mesh.vertices, mesh.faces, mesh.adjacent
    clip, keep, seen = mesh.clip, mesh.keep, mesh.seen
    gap, by_row, by_column = gaps.gap, gaps.rows, gaps.columns
    corners, box, line, edges = np.empty((3, 4)), np.empty(4, np.float32), np.empty((6, 2)), np.empty((3, 3))
    (height, width), seams = by_row.shape, spans.shape[1] > 6
    for i in range(first, last):
        t, count = triangles[i], begins[i]
        sign = corners_of(t, rows, vertices, faces, corners)
        if not abs(sign) > 0 or sign * keep[t] < 0:  # NaN, too.
            continue
        size = _box(faces[t, 0], faces[t, 1], faces[t, 2], seen, height, width, box)
        large = 0 if abs(size) < 2 * LARGE else 4  # Those that are seen in part, too.
        normal = _normal(t, sign, vertices, faces) if seams else (0.0, 0.0, 0.0)
        cut = _cut(t, clip, vertices, faces)
        for k in range(3):
            edges[k, 0], edges[k, 1], edges[k, 2] = edge(corners, k, sign)
        for axis in range(2):
            begin, stop, low, high = _gaps_of(box, axis, height, width)
            for n in range(begin, stop):
                # To choose between the arrays themselves would count their references.
                ends = (by_row[n, low], by_row[n, high]) if axis == 0 else (by_column[n, low], by_column[n, high])
                if ends[0] == ends[1]:
                    continue
                _on_line(t, edges, clip, cut, vertices, faces, axis, n + 0.5, line)
                least, most, start, end = _inside(line, cut, box[2 * axis] - 1.0, box[2 * axis + 1] + 1.0)
                on_line = *ends, 1 - axis
                bounds = least, most, seams * (_is_open(adjacent, t, start) + 2 * _is_open(adjacent, t, end) + large)
                count = _add(t, on_line, bounds, normal, gap, line, corners, names, spans, count)


@compiled(inline="always")
def _normal(t, sign, vertices, faces):
    """The unit normal of a triangle, on the side that the viewer sees if `sign` is that of its area in the image."""
    a, b, c = vertices[faces[t, 0]], vertices[faces[t, 1]], vertices[faces[t, 2]]
    ux, uy, uz = np.float64(b[0]) - a[0], np.float64(b[1]) - a[1], np.float64(b[2]) - a[2]
    vx, vy, vz = np.float64(c[0]) - a[0], np.float64(c[1]) - a[1], np.float64(c[2]) - a[2]
    x, y, z = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
    size = np.sqrt(x * x + y * y + z * z)
    size = (size if sign > 0 else -size) if size > 0 else 1.0
    return x / size, y / size, z / size


@compiled(inline="always")
def _is_open(adjacent, t, edge):
    """True if an edge of a triangle has no other triangle beyond it; False for what is no edge, but a plane."""
    # Without branches: no processor could tell which edges bound a span.
    return (edge >= 0) & (edge < 3) & (adjacent[t, min(max(edge, 0), 2)] < 0)


@compiled(inline="always")
def _add(t, on_line, bounds, normal, gap, line, corners, names, spans, count):
    """Add the spans of a triangle on gaps of a line; returns `count`.

    `on_line` are the first gap, the one after the last, and the column of `gap` that tells where they begin; `bounds`
    are where on the line the triangle is seen, from and to, and the last number of its `names`; `normal` is its own.
    """
    (first, last, column), (least, most, kind) = on_line, bounds
    for g in range(first, last if most - least > 1e-9 else first):  # Along an edge it is rounding.
        start, end = least - 0.5 - gap[g, column], most - 0.5 - gap[g, column]
        # Those that touch it count, since a layer may end at a centre.
        if start <= 1 and end >= 0:
            names[count, 0], names[count, 1], names[count, 2] = g, t, kind
            _fill(spans, count, start, end, line, corners, gap[g, column] + 0.5)
            if spans.shape[1] > 6:
                spans[count, 6], spans[count, 7], spans[count, 8] = normal
            count += 1
    return count


@compiled(inline="always")
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


@compiled(inline="always")
def _on_line(t, edges, clip, cut, vertices, faces, along, at, line):
    """Fill `line` with functions c + d · x that are positive on what is seen of a triangle along a line of centres.

    Rows 0 to 2 are the edge functions, 3 and 4 the near and the far plane, if these may cut the triangle.
    """
    line[3:] = 0.0
    for k in range(3):
        ex, ey, e = edges[k, 0], edges[k, 1], edges[k, 2]
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


@compiled(inline="always")
def _inside(line, cut, low, high):
    """The interval, within one that is given, where all functions of a line are positive; and those that bound it."""
    start, end = -1, -1
    for k in range(5 if cut else 3):
        c, d = line[k, 0], line[k, 1]
        if d > 0:
            at = -c / d
            low, start = (at, k) if at > low else (low, start)
        elif d < 0:
            at = -c / d
            high, end = (at, k) if at < high else (high, end)
        elif c < 0:
            high = -np.inf
    # An edge along the line, but for rounding, meets it farther away than integers reach.
    return (low, high, start, end) if low < high else (0.0, -1.0, -1, -1)


@compiled(inline="always")
def _fill(spans, n, start, end, line, corners, origin):
    """Fill in span n: its ends along a gap that begins at `origin` of a line, and its depth's coefficients."""
    a, b, c, d = 0.0, 0.0, 0.0, 0.0
    for k in range(3):
        at = line[k, 0] + line[k, 1] * origin
        a, b, c, d = a + at * corners[k, 3], b + line[k, 1] * corners[k, 3], c + at, d + line[k, 1]
    spans[n, 0], spans[n, 1], spans[n, 2], spans[n, 3], spans[n, 4], spans[n, 5] = start, end, a, b, c, d


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


FEW = 8
"""The most spans of a gap that are sorted at once."""


@loop
def by_start(first, last, begins, starts, order):
    """Sort the spans of each gap, from `begins` (M + 1,) on in the list `order` (N,), by where they start.

    Of those that start in one place the earlier span comes first, as it does before. Most gaps have a few spans; others
    are divided into as many pieces as they have spans, and the spans that start in each piece are sorted.
    """
    most = (begins[first + 1 : last + 1] - begins[first:last]).max() if last > first else 0
    ends, moved = np.empty(most + 2, np.int64), np.empty(most, np.int64)
    for g in range(first, last):
        begin, count = begins[g], begins[g + 1] - begins[g]
        if count <= FEW:
            _sort(begin, begin + count, starts, order)
            continue
        ends[: count + 2] = 0
        for n in range(count):
            ends[_piece(starts[order[begin + n]], count) + 2] += 1
        for n in range(count):
            ends[n + 2] += ends[n + 1]
        for n in range(count):
            span = order[begin + n]
            piece = _piece(starts[span], count) + 1
            moved[ends[piece]] = span
            ends[piece] += 1
        order[begin : begin + count] = moved[:count]
        for n in range(count):
            _sort(begin + ends[n], begin + ends[n + 1], starts, order)


@compiled(inline="always")
def _piece(start, count):
    """The number of the piece of a gap, of `count`, in which a span starts; those that start before it in the first."""
    return int(min(max(start, 0.0), 1.0) * (count - 1))


@compiled(inline="always")
def _sort(begin, stop, starts, order):
    """Sort a part of `order` by `starts`, those that are equal by their numbers: Shell's sort."""
    step = 1
    while 3 * step < stop - begin:
        step = 3 * step + 1
    while step > 0 and stop - begin > 1:
        for n in range(begin + step, stop):
            span, m = order[n], n
            while m - step >= begin and (starts[order[m - step]], order[m - step]) > (starts[span], span):
                order[m] = order[m - step]
                m -= step
            order[m] = span
        step //= 3
