"""Silhouettes: edges of triangles where a patch ends or turns away; and the gaps that they meet. Compiled."""

from __future__ import annotations

import numpy as np

from rts.compiling.loops import compiled, loop
from rts.outlines.edge_kinds import BEFORE_ENDS, BEHIND_ENDS, INTERSECT
from rts.outlines.seen_mesh_loops import on_edges, plane_at
from rts.outlines.tolerances import CUT, PARALLEL, TOUCH
from rts.sampling.points_loops import corners_of, edge

ANY_SIZE = 6
"""The size of triangles that are larger than others, or seen in part. Others have the size n if they are at most
n − 0.52 cells wide and high: where they meet a gap, one of its two cells is among the n × n cells at the upper left
corner of their box."""


BLOCK = 256
"""Triangles of a block, of which loops keep few numbers; the last block may have fewer."""


@loop
def turns(first, last, mesh, height, width):
    """Fill the `sides` of a `SeenMesh`: which side of a triangle is seen, by the sign of its determinant.

    They are multiplied by the triangle's size; see `ANY_SIZE`. And fill `on_lines`, with its `counts`, `lines` and
    `cells`: the cells of triangles, beyond the border of the image the nearest one, and any for those that are seen in
    part.

    Args:
        first: the first block of triangles.
        last: the block after the last.
        mesh: the triangles.
        height: of the image, in cells.
        width: likewise.
    """
    faces, seen, corners = mesh.faces, mesh.seen, np.empty((3, 4))
    x, y, table = np.empty((3, BLOCK), np.float32), np.empty((3, BLOCK), np.float32), np.empty((4, BLOCK), np.int32)
    sizes, lines, cells, order = table[0], table[1], table[2], table[3]
    for block in range(first, last):
        begin, end = block * BLOCK, min((block + 1) * BLOCK, len(faces))
        block_faces, sides, keep = faces[begin:end], mesh.sides[begin:end], mesh.keep[begin:end]
        on_lines, listed_lines, listed_cells = mesh.on_lines[begin:end], mesh.lines[begin:end], mesh.cells[begin:end]
        for n in range(end - begin):
            a, b, c = block_faces[n, 0], block_faces[n, 1], block_faces[n, 2]
            x[0, n], x[1, n], x[2, n] = seen[a, 0], seen[b, 0], seen[c, 0]
            y[0, n], y[1, n], y[2, n] = seen[a, 1], seen[b, 1], seen[c, 1]
        if _look(x, y, height, width, sizes, sides, cells, lines):
            for n in range(end - begin):
                if sides[n] == 0:
                    sides[n] = sizes[n] * int(corners_of(begin + n, mesh.rows, mesh.vertices, faces, corners))
        count = 0
        for n in range(end - begin):  # Without branches: no processor could tell which triangles are listed.
            order[count] = n
            count += (lines[n] != 0) & (sides[n] != 0) & (sides[n] * keep[n] >= 0)
        for n in range(count):
            on_lines[n], listed_lines[n], listed_cells[n] = begin + order[n], lines[order[n]], cells[order[n]]
        mesh.counts[block] = count


@compiled
def _look(x, y, height, width, sizes, sides, cells, lines):
    """Fill in sizes, sides, cells and lines of triangles with corners `x`, `y`; returns whether any side is 0.

    Such triangles are seen edge-on, or in part, and are to be looked at again. Without branches, for a loop that takes
    several triangles at once.
    """
    zero, right, bottom, again = np.float32(0), np.float32(width - 1), np.float32(height - 1), False
    more, largest, one = np.float32(1.52), np.float32(ANY_SIZE), np.float32(1)
    before, after = np.float32(0.51), np.float32(0.49)  # Half a cell, and more than `TOUCH` and rounding.
    for n in range(len(sides)):
        ax, bx, cx, ay, by, cy = x[0, n], x[1, n], x[2, n], y[0, n], y[1, n], y[2, n]
        area = (bx - ax) * (cy - ay) - (cx - ax) * (by - ay)
        # Not by the least and the largest of the corners: these leave out those behind the camera, which are NaN.
        whole = area == area
        x0, x1, y0, y1 = min(ax, bx, cx), max(ax, bx, cx), min(ay, by, cy), max(ay, by, cy)
        wide = max(x1 - x0, y1 - y0) + more
        size = np.int32(min(wide, largest) if whole else largest)
        sizes[n], sides[n] = size, size * (np.int32(area > 0) - np.int32(area < 0))
        column, row = np.int32(min(max(x0, zero), right)), np.int32(min(max(y0, zero), bottom))
        cells[n] = row * np.int32(width) + column if whole else 0
        # Farther out there are no lines of centres, and positions are rounded more.
        x0, x1, y0, y1 = max(x0, -one), min(x1, right + one), max(y0, -one), min(y1, bottom + one)
        on_row = np.ceil(y0 - before) <= np.floor(y1 - after)
        on_column = np.ceil(x0 - before) <= np.floor(x1 - after)
        lines[n] = np.int32(on_row) + 2 * np.int32(on_column) if whole else 3
        again |= sides[n] == 0
    return again


@loop
def mark_silhouettes(first, last, mesh, part, depth, width, gaps):
    """Mark, in `gaps` (2, H, W), those that silhouettes meet: 2, or 1 where both centres show something nearer.

    Args:
        first: the first block of triangles.
        last: the block after the last.
        mesh: the triangles, a `SeenMesh`.
        part: (H, W) int32, −1 where a centre shows nothing.
        depth: (H, W) float64.
        width: the width of a cell at a depth: `width[0] + width[1] * depth`.
        gaps: (2, H, W) uint8.
    """
    adjacent, sides, on_lines = mesh.adjacent, mesh.sides, mesh.on_lines
    ends, deep, folds = np.empty((2, 2)), np.empty(2), np.empty(BLOCK, np.int32)
    for block in range(first, last):
        count, place = 0, block * BLOCK
        for n in range(place, place + mesh.counts[block]):
            t = on_lines[n]
            side = sides[t]
            a, b, c = sides[adjacent[t, 0]] * side, sides[adjacent[t, 1]] * side, sides[adjacent[t, 2]] * side
            folds[count] = t
            # In most triangles all three neighbours go on.
            count += min(a, b, c) <= 0
        for n in range(count):
            _mark_edges(folds[n], mesh, part, depth, width, gaps, ends, deep)


@compiled(inline="always")
def _mark_edges(t, mesh, part, depth, width, gaps, ends, deep):
    """Mark the gaps that the edges of triangle `t` meet at which a patch ends or turns away."""
    rows, vertices, faces, near_plane, seen = mesh.rows, mesh.vertices, mesh.faces, mesh.clip[0], mesh.seen
    keep, adjacent, sides = mesh.keep, mesh.adjacent, mesh.sides
    for c in range(3):
        s = adjacent[t, c]
        # Two kept triangles that fold have an edge in common, which is told once.
        if s >= 0 and (sides[s] * sides[t] > 0 or (keep[t] == 0 and s < t and sides[s] != 0)):
            continue
        a, b = faces[t, (c + 1) % 3], faces[t, (c + 2) % 3]
        if not _passes_centres(a, b, seen) or not _in_image(a, b, seen, part.shape):
            continue
        if not _ends(a, b, rows, vertices, near_plane, seen, ends, deep):
            continue
        for axis in range(2):
            _mark(axis, ends, min(deep[0], deep[1]), part, depth, width, gaps)


@compiled(inline="always")
def _passes_centres(a, b, seen):
    """False for an edge that meets no line of centres, such as most of those that are much shorter than a cell."""
    found = np.isnan(seen[a, 0]) or np.isnan(seen[b, 0])
    for axis in range(2):
        low, high = min(seen[a, axis], seen[b, axis]), max(seen[a, axis], seen[b, axis])
        found |= np.ceil(low - 0.5 - TOUCH) <= np.floor(high - 0.5 + TOUCH)
    return found


@compiled(inline="always")
def _in_image(a, b, seen, size):
    """False for an edge that lies beyond one border of the image."""
    beyond = False
    for axis in range(2):
        beyond |= (seen[a, axis] < 0) & (seen[b, axis] < 0)
        beyond |= (seen[a, axis] > size[1 - axis]) & (seen[b, axis] > size[1 - axis])
    return not beyond


@compiled(inline="always")
def _ends(a, b, rows, vertices, near_plane, seen, ends, deep):
    """Fill in both ends of an edge in the image, and their depths; False if it lies before the near plane.

    An edge that reaches behind the camera is cut there.
    """
    for k in range(2):
        v = a if k == 0 else b
        ends[k, 0], ends[k, 1], deep[k] = seen[v, 0], seen[v, 1], rows[3, 3]
        for r in range(3):
            deep[k] += rows[3, r] * vertices[v, r]
    shown, (first, second) = True, (near_plane[3], near_plane[3])
    for r in range(3):
        first += near_plane[r] * vertices[a, r]
        second += near_plane[r] * vertices[b, r]
    cut = first / (first - second) if (first > 0) != (second > 0) else 0.0
    for k in range(2 if np.isnan(ends[0, 0] + ends[1, 0]) else 0):
        value, share = (first, 0.0) if k == 0 else (second, 1.0)
        share = share if value > 0 else cut
        x, y, w, deep[k] = rows[0, 3], rows[1, 3], rows[2, 3], rows[3, 3]
        for r in range(3):
            place = (1 - share) * vertices[a, r] + share * vertices[b, r]
            x, y, w = x + rows[0, r] * place, y + rows[1, r] * place, w + rows[2, r] * place
            deep[k] += rows[3, r] * place
        ends[k, 0], ends[k, 1] = x / w, y / w
        shown &= w > 0 and not (first <= 0 and second <= 0)
    return shown


@compiled(inline="always")
def _mark(axis, ends, nearest, part, depth, width, gaps):
    """Mark the gaps along an axis that an edge meets; see `mark_silhouettes`; depths are compared with the nearest."""
    height, across = part.shape
    lines, count = (height, across) if axis == 0 else (across, height)
    k = 0 if ends[0, 1 - axis] <= ends[1, 1 - axis] else 1
    x, y = ends[k, axis], ends[k, 1 - axis]
    dx, dy = ends[1 - k, axis] - x, ends[1 - k, 1 - axis] - y
    low, high = np.ceil(max(y - 0.5 - TOUCH, 0.0)), np.floor(min(y + dy - 0.5 + TOUCH, lines - 1.0))
    for n in range(int(min(low, lines * 1.0)), int(max(high, -1.0)) + 1):
        start, stop = x, x + dx
        if dy > 0:
            start = x + dx * min(max((n + 0.5 - TOUCH - y) / dy, 0.0), 1.0)
            stop = x + dx * min(max((n + 0.5 + TOUCH - y) / dy, 0.0), 1.0)
        begin, end = min(start, stop) - 0.5 - TOUCH, max(start, stop) - 0.5 + TOUCH
        for m in range(int(max(np.floor(begin), 0.0)), int(min(end, count - 2.0)) + 1):
            y0, x0 = (n, m) if axis == 0 else (m, n)
            y1, x1 = (n, m + 1) if axis == 0 else (m + 1, n)
            if part[y0, x0] >= 0 and part[y1, x1] >= 0:
                far = max(depth[y0, x0], depth[y1, x1])
                if nearest > far + abs(depth[y1, x1] - depth[y0, x0]) + width[0] + width[1] * far:
                    gaps[axis, y0, x0] = max(gaps[axis, y0, x0], 1)
                    continue
            gaps[axis, y0, x0] = 2


@loop
def edges(first, last, kind, parts, triangles, points, mesh, slope, depth, tangent):
    """Fill in depths, slopes and tangents of crossings, as the triangles of some parts have them.

    Args:
        first: the first crossing.
        last: the crossing after the last.
        kind: (B,), see `edge_kinds.BEFORE_ENDS`.
        parts: (B, 2), the parts before and behind.
        triangles: (B, 2 or more), alike.
        points: (B, 2), where crossings are.
        mesh: the triangles of these parts, a `SeenMesh`.
        slope: (B, 2, 2) to fill where surfaces intersect, or the near or far plane cuts the one that ends: slopes of
            depth along x and y, a cell.
        depth: (B,) to fill: of the surface that ends, or where surfaces intersect.
        tangent: (B, 2) to fill: along the nearest edge of the triangle that ends, or of the one before.
    """
    rows, vertices, faces, corners = mesh.rows, mesh.vertices, mesh.faces, np.empty((3, 4))
    own = mesh.first, mesh.first + len(mesh.starts) - 1
    for b in range(first, last):
        x, y = points[b, 0], points[b, 1]
        for side in range(2):
            ends = side == (1 if kind[b] == BEHIND_ENDS else 0)
            if not (own[0] <= parts[b, side] < own[1] and (ends or kind[b] == INTERSECT)):
                continue
            sign = corners_of(triangles[b, side], rows, vertices, faces, corners)
            # Not a number where a triangle is seen edge-on.
            deep, along, down = plane_at(corners, sign, x, y)
            cut = kind[b] != INTERSECT and sign != 0
            cut = cut and _is_cut(triangles[b, side], vertices, faces, mesh.clip, corners, deep, np.hypot(along, down))
            if kind[b] == INTERSECT or cut:
                depth[b], slope[b, side, 0], slope[b, side, 1] = deep, along, down
            else:
                depth[b] = on_edges(corners, x, y)[0]
            if cut:
                tangent[b, 0], tangent[b, 1] = down, -along
            elif ends:
                tangent[b, 0], tangent[b, 1] = _nearest_edge(corners, sign, x, y)


@compiled
def _is_cut(t, vertices, faces, clip, corners, depth, slope):
    """True if a triangle crosses the near or the far plane within `CUT` cells of where it has a depth and a slope."""
    cut = False
    for p in range(2):
        low, high, first, last = np.inf, -np.inf, 0.0, 0.0
        for k in range(3):
            v = faces[t, k]
            off = clip[p, 3] + clip[p, 0] * vertices[v, 0] + clip[p, 1] * vertices[v, 1] + clip[p, 2] * vertices[v, 2]
            first, low = (corners[k, 3], off) if off < low else (first, low)
            last, high = (corners[k, 3], off) if off > high else (last, high)
        at = first - low * (last - first) / (high - low)
        cut |= low < 0 < high and abs(depth - at) <= CUT * slope
    return cut


@compiled(inline="always")
def _nearest_edge(corners, sign, x, y):
    """The direction in the image of the edge of a triangle that is nearest to a position."""
    least, along, down = np.inf, 0.0, 0.0
    for k in range(3):
        ex, ey, e = edge(corners, k, sign)
        size = np.hypot(ex, ey)
        if size > 0 and abs(ex * x + ey * y + e) < least * size:
            least, along, down = abs(ex * x + ey * y + e) / size, ey, -ex
    return along, down


@loop
def finish_directions(width, depth, kind, slope, tangent, away):
    """Make tangents (B, 2) unit directions, of intersections where planes meet; those that are flat end before.

    Args:
        width: the width of a cell at a depth: `width[0] + width[1] * depth`.
        depth: (B,), see `edges`.
        kind: (B,), see `edges`; becomes BEFORE_ENDS where slopes of surfaces that intersect hardly differ.
        slope: (B, 2, 2), see `edges`; becomes 0 where slopes hardly differ.
        tangent: (B, 2), see `edges`.
        away: (B,) to fill with `Crossings.cells_away`.
    """
    for b in range(len(kind)):
        away[b] = np.log(width[0] + width[1] * depth[b]) / width[1] if width[1] > 0 else depth[b] / width[0]
        if kind[b] == INTERSECT:
            x, y = slope[b, 1, 0] - slope[b, 0, 0], slope[b, 1, 1] - slope[b, 0, 1]
            if abs(x) + abs(y) > PARALLEL * (width[0] + width[1] * depth[b]):
                tangent[b, 0], tangent[b, 1] = y, -x
            else:
                kind[b] = BEFORE_ENDS
                slope[b] = 0.0
        length = np.hypot(tangent[b, 0], tangent[b, 1])
        if length > 0:
            tangent[b, 0], tangent[b, 1] = tangent[b, 0] / length, tangent[b, 1] / length
