"""Triangles in the image, and the nearest ones at single points. Compiled.

A corner is (X, Y, w, depth), seen at the pixel (X / w, Y / w). The edge function of two corners is their cross product
in (X, Y, w), linear in the pixel's position. So no triangle needs clipping, and neighbours evaluate opposite numbers on
their edge. All of it is float64.
"""

from __future__ import annotations

import numpy as np

from rts.compiling.loops import compiled, loop


@compiled
def corners_of(t, rows, vertices, faces, corners):
    """Fill `corners` (3, 4), rows of (X, Y, w, depth), of a triangle; `rows` is `Camera.pixel_rows`.

    Returns the sign of the determinant of their X, Y and w, which tells the side that is seen.
    """
    for c in range(3):
        v = faces[t, c]
        x, y, z = np.float64(vertices[v, 0]), np.float64(vertices[v, 1]), np.float64(vertices[v, 2])
        for r in range(4):
            corners[c, r] = rows[r, 0] * x + rows[r, 1] * y + rows[r, 2] * z + rows[r, 3]
    (a, b, c), d = (corners[0], corners[1], corners[2]), 0.0
    d = a[0] * (b[1] * c[2] - b[2] * c[1]) - a[1] * (b[0] * c[2] - b[2] * c[0]) + a[2] * (b[0] * c[1] - b[1] * c[0])
    return np.sign(d)


@compiled
def edge(corners, k, sign):
    """Coefficients (x, y, 1) of the edge function opposite corner `k`, positive inside."""
    i, j = (k + 1) % 3, (k + 2) % 3
    ax, ay, aw = corners[i, 0], corners[i, 1], corners[i, 2]
    bx, by, bw = corners[j, 0], corners[j, 1], corners[j, 2]
    return sign * (ay * bw - aw * by), sign * (aw * bx - ax * bw), sign * (ax * by - ay * bx)


@loop
def hits(points, begins, order, rows, clip, keep, vertices, faces, found):
    """The K nearest triangles at points of the image, by depth, then by index.

    Args:
        points: (M, 2) float64, x and y; those of one line of pixels follow one another, by x.
        begins: (H + 1,) where the points of each line of pixels begin.
        order: (M,) the places of the points in the results.
        rows: (4, 4), see `corners_of`.
        clip: (2, 4) near and far plane, positive on what is seen.
        keep: sign of the determinants of triangles to keep; 0 keeps both.
        vertices: (V, 3) of the proxy.
        faces: (T, 3) of the proxy.
        found: `Fragments`: ids (K, M) int32, filled with −1; barycentrics (K, M, 2) float32, to fill; depths (K, M)
            float64, filled with infinity.
    """
    (ids, weights, depths), height, corners, box = found, len(begins) - 1, np.empty((3, 4)), np.empty(4)
    for t in range(len(faces)):
        sign = corners_of(t, rows, vertices, faces, corners)
        if sign == 0 or sign * keep < 0:
            continue
        _bounds(corners, height, box)
        for line in range(int(box[0]), int(box[1]) + 1):
            a, b = begins[line], begins[line + 1]
            n = a + np.searchsorted(points[a:b, 0], box[2])
            while n < b and points[n, 0] <= box[3]:
                inside, wa, wb = weights_at(corners, sign, points[n, 0], points[n, 1])
                if inside and not _hidden(t, clip, vertices, faces, wa, wb, 1 - wa - wb):
                    z = wa * corners[0, 3] + wb * corners[1, 3] + (1 - wa - wb) * corners[2, 3]
                    _insert(order[n], t, z, wa, wb, ids, weights, depths)
                n += 1


@compiled
def _bounds(corners, height, box):
    """Fill `box` with the first and last line, and the least and largest x, that a triangle may cover."""
    low, high, left, right, behind = np.inf, -np.inf, np.inf, -np.inf, False
    for c in range(3):
        w = corners[c, 2]
        behind |= not w > 0
        low, high = min(low, corners[c, 1] / w), max(high, corners[c, 1] / w)
        left, right = min(left, corners[c, 0] / w), max(right, corners[c, 0] / w)
    if behind:  # Seen in part, anywhere.
        low, high, left, right = 0.0, np.float64(height), -np.inf, np.inf
    box[0], box[1] = min(max(low, 0.0), height), max(min(high, height - 1.0), -1.0)
    box[2], box[3] = left, right


@compiled
def weights_at(corners, sign, x, y):
    """True if a triangle covers a position, and its first two barycentrics there.

    Of two triangles on one edge, the one that lies right of it, or below, has the points on it.
    """
    inside, total, first, second = True, 0.0, 0.0, 0.0
    for k in range(3):
        ex, ey, e = edge(corners, k, sign)
        value = ex * x + ey * y + e
        inside &= value > 0 or (value == 0 and (ex > 0 or (ex == 0 and ey > 0)))
        total += value
        if k == 0:
            first = value
        elif k == 1:
            second = value
    return inside and total > 0, first / total, second / total


@compiled
def _insert(m, t, z, wa, wb, ids, weights, depths):
    """Insert a hit among the nearest of point m."""
    k = len(ids) - 1
    if not z < depths[k, m]:
        return
    while k > 0 and z < depths[k - 1, m]:
        ids[k, m], depths[k, m], weights[k, m] = ids[k - 1, m], depths[k - 1, m], weights[k - 1, m]
        k -= 1
    ids[k, m], depths[k, m], weights[k, m, 0], weights[k, m, 1] = t, z, wa, wb


@compiled
def _hidden(t, clip, vertices, faces, wa, wb, wc):
    """True if a point of a triangle, by its barycentrics, is before the near or beyond the far plane."""
    a, b, c = faces[t, 0], faces[t, 1], faces[t, 2]
    for p in range(2):
        value = clip[p, 3]
        for r in range(3):
            value += clip[p, r] * (wa * vertices[a, r] + wb * vertices[b, r] + wc * vertices[c, r])
        if value < 0:
            return True
    return False
