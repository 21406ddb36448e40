"""Silhouettes: edges of triangles where a patch ends or turns away; and the gaps that they meet. Compiled."""

from __future__ import annotations

import numpy as np

from rts.compiling.loops import compiled, loop
from rts.outlines.edge_kinds import BEFORE_ENDS, BEHIND_ENDS, INTERSECT
from rts.outlines.seen_mesh_loops import on_edges, plane_at
from rts.outlines.tolerances import PARALLEL, TOUCH
from rts.sampling.points_loops import corners_of, edge

ANY_SIZE = 6
"""The size of triangles that are larger than others, or seen in part. Others have the size n if they are at most
n − 0.52 cells wide and high: where they meet a gap, one of its two cells is among the n × n cells at the upper left
corner of their box."""


@loop
def turns(first, last, mesh, height, width):
    """Fill the `sides` of a `SeenMesh`: which side of a triangle is seen, by the sign of its determinant.

    They are multiplied by the triangle's size; see `ANY_SIZE`. And fill the `cells` of triangles, beyond the border of
    the image the nearest one; any number for those that are seen in part.

    Args:
        first: the first triangle.
        last: the triangle after the last.
        mesh: the triangles.
        height: of the image, in cells.
        width: likewise.
    """
    rows, vertices, faces, seen, sides = mesh.rows, mesh.vertices, mesh.faces, mesh.seen, mesh.sides
    cells, right, bottom = mesh.cells, np.float32(width - 1), np.float32(height - 1)
    corners = np.empty((3, 4))
    for t in range(first, last):
        a, b, c = faces[t, 0], faces[t, 1], faces[t, 2]
        area = (seen[b, 0] - seen[a, 0]) * (seen[c, 1] - seen[a, 1])
        area -= (seen[c, 0] - seen[a, 0]) * (seen[b, 1] - seen[a, 1])
        # Not by the least and the largest of the corners: these leave out those behind the camera, which are NaN.
        whole = not np.isnan(area)
        if area == 0 or not whole:
            area = np.float32(corners_of(t, rows, vertices, faces, corners))
        x, y = min(seen[a, 0], seen[b, 0], seen[c, 0]), min(seen[a, 1], seen[b, 1], seen[c, 1])
        wide = max(max(seen[a, 0], seen[b, 0], seen[c, 0]) - x, max(seen[a, 1], seen[b, 1], seen[c, 1]) - y)
        size = int(min(wide + np.float32(1.52), np.float32(ANY_SIZE))) if whole else ANY_SIZE
        sides[t] = size * (int(area > 0) - int(area < 0))
        x, y = min(max(x, np.float32(0)), right), min(max(y, np.float32(0)), bottom)
        cells[t] = int(y) * width + int(x) if whole else 0


@loop
def mark_silhouettes(first, last, mesh, part, depth, width, gaps):
    """Mark, in `gaps` (2, H, W), those that silhouettes meet: 2, or 1 where both centres show something nearer.

    Args:
        first: the first triangle.
        last: the triangle after the last.
        mesh: the triangles, a `SeenMesh`.
        part: (H, W) int32, −1 where a centre shows nothing.
        depth: (H, W) float64.
        width: the width of a cell at a depth: `width[0] + width[1] * depth`.
        gaps: (2, H, W) uint8.
    """
    rows, vertices, faces, near_plane, seen = mesh.rows, mesh.vertices, mesh.faces, mesh.clip[0], mesh.seen
    keep, adjacent, sides = mesh.keep, mesh.adjacent, mesh.sides
    ends, deep = np.empty((2, 2)), np.empty(2)
    for t in range(first, last):
        side = sides[t]
        if side == 0 or side * keep[t] < 0:
            continue
        # In most triangles all three neighbours go on: one branch.
        a, b, c = sides[adjacent[t, 0]], sides[adjacent[t, 1]], sides[adjacent[t, 2]]
        if (a * side > 0) & (b * side > 0) & (c * side > 0):
            continue
        for c in range(3):
            s = adjacent[t, c]
            # Two kept triangles that fold have an edge in common, which is told once.
            if s >= 0 and (sides[s] * side > 0 or (keep[t] == 0 and s < t and sides[s] != 0)):
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
        slope: (B, 2, 2) to fill where surfaces intersect: slopes of depth along x and y, a cell.
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
            if kind[b] == INTERSECT:
                # Not a number where a triangle is seen edge-on.
                depth[b], slope[b, side, 0], slope[b, side, 1] = plane_at(corners, sign, x, y)
            else:
                depth[b] = on_edges(corners, x, y)[0]
            if ends:
                tangent[b, 0], tangent[b, 1] = _nearest_edge(corners, sign, x, y)


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
        slope: (B, 2, 2), see `edges`; becomes 0 but at intersections.
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
        if kind[b] != INTERSECT:
            slope[b] = 0.0
        length = np.hypot(tangent[b, 0], tangent[b, 1])
        if length > 0:
            tangent[b, 0], tangent[b, 1] = tangent[b, 0] / length, tangent[b, 1] / length
