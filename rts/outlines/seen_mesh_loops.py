"""Connected patches of triangles in the image: walks from triangle to triangle, and the planes of triangles. Compiled.

Corners and edge functions are those of `rts.sampling.points_loops`.
"""

from __future__ import annotations

import numpy as np

from rts.compiling.loops import compiled, loop
from rts.sampling.points_loops import corners_of, edge, weights_at

STEPS = 4096
"""The most triangles of one walk."""

WALKS = -2
"""In place of the triangle that a walk ends on, as long as it goes on."""


@compiled(inline="always")
def plane_at(corners, sign, x, y):
    """Depth of a triangle's plane at a position, and its slopes along x and y, a pixel."""
    total, total_x, total_y, deep, deep_x, deep_y = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for k in range(3):
        ex, ey, e = edge(corners, k, sign)
        value, z = ex * x + ey * y + e, corners[k, 3]
        total, total_x, total_y = total + value, total_x + ex, total_y + ey
        deep, deep_x, deep_y = deep + value * z, deep_x + ex * z, deep_y + ey * z
    z = deep / total
    return z, (deep_x - z * total_x) / total, (deep_y - z * total_y) / total


@loop
def neighbours(faces, order):
    """(T, 3) int32: the triangle beyond the edge opposite each corner; −1 where none or several share it.

    A triangle with the same three corners, such as the back of a double face, is no neighbour. `order` (3 T,) sorts the
    edges (3 t + corner) by their ends.
    """
    found = np.full((len(faces), 3), -1, np.int32)
    n = 0
    while n < len(order):
        t, c = order[n] // 3, order[n] % 3
        i, j = faces[t, (c + 1) % 3], faces[t, (c + 2) % 3]
        m = n + 1
        while m < len(order):
            s, d = order[m] // 3, order[m] % 3
            k, h = faces[s, (d + 1) % 3], faces[s, (d + 2) % 3]
            if min(k, h) != min(i, j) or max(k, h) != max(i, j):
                break
            m += 1
        if m == n + 2:
            s, d = order[n + 1] // 3, order[n + 1] % 3
            if faces[s, d] != faces[t, c]:
                found[t, c], found[s, d] = s, t
        n = m
    return found


@loop
def projected(first, last, vertices, rows, seen):
    """Fill `seen` (V, 2) float32: where vertices lie in the image, in cells; NaN for those behind the camera."""
    for v in range(first, last):
        x, y, z = np.float64(vertices[v, 0]), np.float64(vertices[v, 1]), np.float64(vertices[v, 2])
        w = rows[2, 0] * x + rows[2, 1] * y + rows[2, 2] * z + rows[2, 3]
        if w > 0:
            seen[v, 0] = (rows[0, 0] * x + rows[0, 1] * y + rows[0, 2] * z + rows[0, 3]) / w
            seen[v, 1] = (rows[1, 0] * x + rows[1, 1] * y + rows[1, 2] * z + rows[1, 3]) / w
        else:
            seen[v] = np.nan


@compiled(inline="always")
def _meets(ax, ay, bx, by):
    """Where an edge between two vertices, on both sides of a line, meets it; of each, its places along it and aside."""
    return ax - ay * (bx - ax) / (by - ay)


@compiled(inline="always")
def _walked(t, target, start, axis, at, seen, faces, adjacent):
    """The triangle that a walk from triangle to triangle, a cell along a line of centres, ends on.

    It ends before that, with −1, where the patch ends, turns away, or reaches behind the camera.

    Args:
        t: the first triangle, which the line meets at `start`.
        target: a triangle which the walk need not leave.
        start: where the walk starts, along the line.
        axis: 0 for lines along x, 1 along y.
        at: the line's place along the other axis.
        seen: (V, 2), see `projected`.
        faces: (T, 3).
        adjacent: (T, 3).
    """
    out, place, first, second, end, steps = -1, -np.inf, faces[t, 1], faces[t, 2], np.int32(WALKS), 0
    # The edge that the line goes out through, opposite the corner `out`.
    for c in range(3):
        a, b = faces[t, (c + 1) % 3], faces[t, (c + 2) % 3]
        ay, by = seen[a, 1 - axis] - at, seen[b, 1 - axis] - at
        end = end if not np.isnan(ay) else np.int32(-1)
        if (ay >= 0) != (by >= 0):
            there = _meets(seen[a, axis], ay, seen[b, axis], by)
            if there > place:
                out, place, first, second = c, there, a, b
    end = end if out >= 0 else np.int32(-1)
    # Its ends, of which each step replaces one. The steps hardly branch: no processor could tell which way they go.
    ax, ay, bx, by = seen[first, axis], seen[first, 1 - axis] - at, seen[second, axis], seen[second, 1 - axis] - at
    while end == WALKS and steps < STEPS:
        s, steps = adjacent[t, out], steps + 1
        if place >= start + 1:
            end = t
        elif s < 0 or s == target:
            end = s
        else:
            third = faces[s, 0] ^ faces[s, 1] ^ faces[s, 2] ^ first ^ second
            cx, cy = seen[third, axis], seen[third, 1 - axis] - at
            # The vertex on the other side of the line than the third one stays.
            stays = (ay >= 0) != (cy >= 0)
            left = second if stays else first
            first, ax, ay = (first, ax, ay) if stays else (third, cx, cy)
            second, bx, by = (third, cx, cy) if stays else (second, bx, by)
            before, place = place, _meets(ax, ay, bx, by)
            # Where the triangle lies on the same side of the edge, the patch turns away.
            end = np.int32(-1 if np.isnan(cy) or place < before else WALKS)
            t, out = s, 1 if faces[s, 1] == left else (2 if faces[s, 2] == left else 0)
    return end if end != WALKS else np.int32(-1)


@compiled(inline="always")
def _touch(faces, t, s):
    """True if two triangles have a corner in common."""
    found = False
    for i in range(3):
        for j in range(3):
            found |= faces[t, i] == faces[s, j]
    return found


@loop
def seams(first, last, part, triangle, mesh, met, colors, joined):
    """Mark neighbouring centres, in lines `first` to `last`, whose first hits are joined by a patch of triangles.

    Args:
        first: the first line.
        last: the line after the last.
        part: (H, W) int32, the parts seen at centres; or (K H, W), those of layers.
        triangle: likewise, their triangles.
        mesh: the triangles of some parts, a `SeenMesh`.
        met: (2, H, W) uint8, 0 in gaps that no silhouette meets; see `silhouettes_loops.mark_silhouettes`.
        colors: whether colours differ on a part. Where they do not, a part that no silhouette meets goes on, since
            nobody can tell whether its patches intersect.
        joined: (2, H, W) or (2, K H, W) bool to fill: along x, and along y.
    """
    (_, height, width), keep, seen, faces, adjacent = met.shape, mesh.keep, mesh.seen, mesh.faces, mesh.adjacent
    part_range = mesh.first, mesh.first + len(mesh.starts) - 1
    apart = np.empty(width, np.bool_)
    for y in range(first, last):
        for axis in range(2):
            dx, dy, line = 1 - axis, axis, y % height
            count = width - dx if line + dy < height else 0
            # Without branches, for a loop that takes several cells at once.
            for x in range(count):
                own, there = part[y, x], part[y + dy, x + dx]
                same = (own >= part_range[0]) & (own < part_range[1]) & (own == there) & (met[axis, line, x] != 2)
                one = triangle[y, x] == triangle[y + dy, x + dx] or (not colors and met[axis, line, x] == 0)
                joined[axis, y, x] |= same & one
                apart[x] = same & ~one
            for x in range(count):
                if not apart[x]:
                    continue
                t, s = triangle[y, x], triangle[y + dy, x + dx]
                end = s
                next_ = keep[t] != 0 and (adjacent[t, 0] == s or adjacent[t, 1] == s or adjacent[t, 2] == s)
                # Around a corner that two triangles have in common the patch neither ends nor turns away.
                if not next_ and (met[axis, line, x] != 0 or not _touch(faces, t, s)):
                    start, at = (x + 0.5, line + 0.5) if axis == 0 else (line + 0.5, x + 0.5)
                    end = _walked(t, s, start, axis, at, seen, faces, adjacent)
                joined[axis, y, x] = end == s


@loop
def on_planes(first, last, triangles, points, rows, vertices, faces, weights, depths):
    """Triangles' planes at points (M, 2): the first two barycentrics, and depths.

    Of a triangle that is seen edge-on, these are of its nearest edge.
    """
    corners = np.empty((3, 4))
    for m in range(first, last):
        sign = corners_of(triangles[m], rows, vertices, faces, corners)
        _, weights[m, 0], weights[m, 1] = weights_at(corners, sign, points[m, 0], points[m, 1])
        depths[m] = plane_at(corners, sign, points[m, 0], points[m, 1])[0]
        if sign == 0:
            depths[m], weights[m, 0], weights[m, 1] = on_edges(corners, points[m, 0], points[m, 1])


@compiled(inline="always")
def on_edges(corners, x, y):
    """Depth and first two barycentrics of the point of a triangle's edges that is seen nearest to a position."""
    least, shares = np.inf, (0.0, 0.0, 0.0)
    for k in range(3):
        i, j = (k + 1) % 3, (k + 2) % 3
        aw, bw = corners[i, 2], corners[j, 2]
        ax, ay = corners[i, 0] / aw, corners[i, 1] / aw
        dx, dy = corners[j, 0] / bw - ax, corners[j, 1] / bw - ay
        length = dx * dx + dy * dy
        t = min(max(((x - ax) * dx + (y - ay) * dy) / length, 0.0), 1.0) if length > 0 else 0.0
        off = (ax + t * dx - x) ** 2 + (ay + t * dy - y) ** 2
        if off < least:
            total = (1 - t) / aw + t / bw
            p, q = (1 - t) / aw / total, t / bw / total
            least, shares = off, (0.0, p, q) if k == 0 else ((q, 0.0, p) if k == 1 else (p, q, 0.0))
    z = shares[0] * corners[0, 3] + shares[1] * corners[1, 3] + shares[2] * corners[2, 3]
    return z, shares[0], shares[1]
