"""Exact arithmetic on triangles in homogeneous pixel coordinates, shared by the compiled samplers.

A corner is (X, Y, clip z, w), at the pixel (X / w, Y / w). The edge function of two corners is their cross product in
(X, Y, w) (Olano and Greer, *Triangle scan conversion using 2D homogeneous coordinates*, 1997): no triangle needs
clipping, and two triangles that share an edge evaluate exactly opposite numbers on it. All of it is float64.

These helpers are not cached on disk, only the loops that call them are: a helper loaded from the cache is not
inlined, which costs a factor of three. After a change in this file, touch the files of the loops that call it: a
loop's cache goes by the date of the loop's own file.
"""

from __future__ import annotations

import numpy as np

from rts import Camera
from rts.plugin_api.loops import compiled, loop


def pixel_matrix(camera: Camera, size: tuple[int, int]) -> np.ndarray:
    """(4, 4) matrix from the proxy's space to homogeneous pixels (X, Y, clip z, w); `size` is (height, width)."""
    height, width = size
    to_pixels = np.array([[width / 2, 0, 0, width / 2], [0, -height / 2, 0, height / 2], [0, 0, 1, 0], [0, 0, 0, 1]])
    return to_pixels @ camera.projection @ camera.view


@loop
def bounding_sphere(vertices, faces):
    """(4,) centre and radius, at least 1e-30, of the sphere around the bounding box of vertices that triangles use.

    Without triangles the centre is NaN.
    """
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    for t in range(len(faces)):
        for c in range(3):
            v = faces[t, c]
            for r in range(3):
                x = np.float64(vertices[v, r])
                low[r], high[r] = min(low[r], x), max(high[r], x)
    sphere = np.empty(4)
    sphere[:3] = (low + high) / 2
    sphere[3] = max(np.sqrt(((high - low) ** 2).sum()) / 2, 1e-30)
    return sphere


@compiled
def to_corner(matrix, vertices, v, corners, i):
    """Transform vertex `v` by `matrix` (4, 4) into row `i` of `corners` (·, 4)."""
    x, y, z = np.float64(vertices[v, 0]), np.float64(vertices[v, 1]), np.float64(vertices[v, 2])
    for r in range(4):
        corners[i, r] = matrix[r, 0] * x + matrix[r, 1] * y + matrix[r, 2] * z + matrix[r, 3]


@compiled
def depth_of(row, vertices, v):
    """Linear depth of vertex `v`; `row` (4,) is minus the third row of the camera's view matrix."""
    return row[0] * vertices[v, 0] + row[1] * vertices[v, 1] + row[2] * vertices[v, 2] + row[3]


@compiled
def determinant(corners, ia, ib, ic):
    """The determinant of three corners (X, Y, w): twice the signed area on screen, times the three w."""
    ax, ay, aw = corners[ia, 0], corners[ia, 1], corners[ia, 3]
    bx, by, bw = corners[ib, 0], corners[ib, 1], corners[ib, 3]
    cx, cy, cw = corners[ic, 0], corners[ic, 1], corners[ic, 3]
    return ax * (by * cw - bw * cy) - ay * (bx * cw - bw * cx) + aw * (bx * cy - by * cx)


@compiled
def edge(corners, i, j):
    """Coefficients (x, y, 1) of the edge function of two corners; swapping them negates it exactly."""
    ax, ay, aw = corners[i, 0], corners[i, 1], corners[i, 3]
    bx, by, bw = corners[j, 0], corners[j, 1], corners[j, 3]
    return ay * bw - aw * by, aw * bx - ax * bw, ax * by - ay * bx


@compiled
def owns(x, y):
    """True if an edge owns the pixels exactly on it: a top or left edge.

    `x` and `y` are coefficients of its edge function, positive inside.
    """
    return x > 0 or (x == 0 and y > 0)


@compiled
def edge_values(corners, ia, ib, ic, x, y):
    """Edge functions opposite `ia`, `ib`, `ic` at a pixel position, positive inside; True if the triangle covers it.

    Near and far planes do not count here, see `clipped`; a triangle of no area must be left out before.
    """
    xa, ya, wa = edge(corners, ib, ic)
    xb, yb, wb = edge(corners, ic, ia)
    xc, yc, wc = edge(corners, ia, ib)
    if determinant(corners, ia, ib, ic) < 0:
        xa, ya, wa, xb, yb, wb, xc, yc, wc = -xa, -ya, -wa, -xb, -yb, -wb, -xc, -yc, -wc
    ea, eb, ec = xa * x + (ya * y + wa), xb * x + (yb * y + wb), xc * x + (yc * y + wc)
    inside = (
        (ea > 0 or (ea == 0 and owns(xa, ya)))
        and (eb > 0 or (eb == 0 and owns(xb, yb)))
        and (ec > 0 or (ec == 0 and owns(xc, yc)))
    )
    return ea, eb, ec, inside


@compiled
def clipped(corners, ia, ib, ic, ea, eb, ec):
    """True if the point with barycentrics in the ratio ea : eb : ec is nearer than the near or beyond the far plane."""
    near = ea * (corners[ia, 2] + corners[ia, 3]) + eb * (corners[ib, 2] + corners[ib, 3])
    far = ea * (corners[ia, 3] - corners[ia, 2]) + eb * (corners[ib, 3] - corners[ib, 2])
    return near + ec * (corners[ic, 2] + corners[ic, 3]) < 0 or far + ec * (corners[ic, 3] - corners[ic, 2]) < 0
