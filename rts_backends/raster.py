"""Rasterizer for the CPU: K nearest triangles a pixel in one pass, on all cores (numba).

Triangles are rasterized in homogeneous coordinates (Olano and Greer, *Triangle scan conversion using 2D homogeneous
coordinates*, 1997): an edge function is the cross product of two corners (x, y, w), so no triangle is ever clipped,
and two triangles that share an edge evaluate exactly opposite numbers on it. Edge functions and barycentrics are
float64. The image is cut into bands of rows; each band is drawn by one thread, its triangles in order of their index,
so the result does not depend on the number of threads.
"""

from __future__ import annotations

import threading

import numba
import numpy as np

from rts.camera import Camera
from rts.protocols import Fragments, Proxy
from rts.sampling import TriangleSampler

BAND_ROWS = 8
CHUNK = 1 << 14
BOX_SLACK = 1e-6
NEAR, FAR = 1, 2

_one_at_a_time = threading.Lock()  # numba's default threading layer must not be entered by two threads.


class Raster(TriangleSampler):
    """K-buffer rasterization with a top-left fill rule; ties in depth go to the lower triangle index."""

    def rasterize(self, prepared: Proxy, camera: Camera, size: tuple[int, int], layers: int, cull: str) -> Fragments:
        """See `TriangleSampler.rasterize`."""
        height, width = size
        # Straight to homogeneous pixels: (X, Y, w) with the pixel at (X / w, Y / w), and clip z.
        to_pixels = np.array(
            [[width / 2, 0, 0, width / 2], [0, -height / 2, 0, height / 2], [0, 0, 1, 0], [0, 0, 0, 1]]
        )
        matrix = to_pixels @ camera.projection @ camera.view
        p = camera.projection
        # A y-flip of the projection, or a mirroring view, reverses the winding on screen.
        winding = np.sign(np.linalg.det(camera.view[:3, :3]) * (p[0, 0] * p[1, 1] - p[0, 1] * p[1, 0]))
        facing = -winding if cull == "back" else 0.0
        fragments = Fragments(
            np.empty((layers, height, width), np.int32),
            np.empty((layers, height, width, 2), np.float32),
            np.empty((layers, height, width), np.float32),
        )
        with _one_at_a_time:
            corners = np.empty((len(prepared.vertices), 4))
            flags = np.empty(len(prepared.vertices), np.uint8)
            _transform(prepared.vertices, matrix, corners, flags)
            chunks = -(-len(prepared.faces) // CHUNK)
            kept = np.empty(len(prepared.faces), np.int32)
            boxes = np.empty((len(prepared.faces), 4), np.int16 if max(size) < 2**15 else np.int32)
            counts = np.zeros(chunks, np.int64)
            _set_up(prepared.faces, corners, flags, height, width, facing, kept, boxes, counts)
            view_depth = -camera.view[2]
            _draw(prepared.faces, prepared.vertices, corners, flags, kept, boxes, counts, view_depth, *fragments)
        return fragments


@numba.njit(parallel=True, cache=True, nogil=True)
def _transform(vertices, matrix, corners, flags):
    """Homogeneous pixel coordinates (V, 4) = X, Y, clip z, w, and which of the two planes each vertex violates."""
    for v in numba.prange(len(vertices)):
        x, y, z = np.float64(vertices[v, 0]), np.float64(vertices[v, 1]), np.float64(vertices[v, 2])
        for i in range(4):
            corners[v, i] = matrix[i, 0] * x + matrix[i, 1] * y + matrix[i, 2] * z + matrix[i, 3]
        depth, w = corners[v, 2], corners[v, 3]
        # Written so that NaN violates both.
        flags[v] = (0 if depth >= -w and w > 0 else NEAR) | (0 if depth <= w else FAR)


@numba.njit(cache=True, inline="always")
def _determinant(a, b, c):
    return a[0] * (b[1] * c[3] - b[3] * c[1]) - a[1] * (b[0] * c[3] - b[3] * c[0]) + a[3] * (b[0] * c[1] - b[1] * c[0])


@numba.njit(parallel=True, cache=True, nogil=True)
def _set_up(faces, corners, flags, height, width, facing, kept, boxes, counts):
    """List, chunk by chunk, the triangles that may cover a pixel centre, with their pixel boxes."""
    for chunk in numba.prange(len(counts)):
        start, stop = chunk * CHUNK, min(len(faces), (chunk + 1) * CHUNK)
        found = start
        for t in range(start, stop):
            ia, ib, ic = faces[t, 0], faces[t, 1], faces[t, 2]
            fa, fb, fc = flags[ia], flags[ib], flags[ic]
            if fa & fb & fc:
                continue
            a, b, c = corners[ia], corners[ib], corners[ic]
            if (fa | fb | fc) & NEAR:
                x0, x1, y0, y1 = _clipped_box(a, b, c, width, height)
            else:
                ra, rb, rc = 1 / a[3], 1 / b[3], 1 / c[3]
                xa, xb, xc = a[0] * ra, b[0] * rb, c[0] * rc
                ya, yb, yc = a[1] * ra, b[1] * rb, c[1] * rc
                x0, x1 = min(xa, xb, xc), max(xa, xb, xc)
                y0, y1 = min(ya, yb, yc), max(ya, yb, yc)
            # Pixel centres at i + 0.5; clamp before rounding, since a far point overflows an integer.
            i0 = np.int64(np.ceil(max(x0, 0.0) - 0.5 - BOX_SLACK))
            i1 = np.int64(np.floor(min(x1, np.float64(width)) - 0.5 + BOX_SLACK))
            j0 = np.int64(np.ceil(max(y0, 0.0) - 0.5 - BOX_SLACK))
            j1 = np.int64(np.floor(min(y1, np.float64(height)) - 0.5 + BOX_SLACK))
            i0, j0, i1, j1 = max(i0, 0), max(j0, 0), min(i1, width - 1), min(j1, height - 1)
            if i0 > i1 or j0 > j1:
                continue
            area = _determinant(a, b, c)
            if not (area * facing > 0 or (facing == 0 and area != 0)):
                continue
            kept[found] = t
            boxes[found, 0], boxes[found, 1], boxes[found, 2], boxes[found, 3] = i0, i1, j0, j1
            found += 1
        counts[chunk] = found - start


@numba.njit(cache=True)
def _clipped_box(a, b, c, width, height):
    """The pixel box (x0, x1, y0, y1) of the part of a triangle before the near plane."""
    x0, x1, y0, y1 = np.inf, -np.inf, np.inf, -np.inf
    for p, q in ((a, b), (b, c), (c, a)):
        dp, dq = p[2] + p[3], q[2] + q[3]
        for end in range(2):
            if end == 0:
                if dp < 0:
                    continue
                x, y, w = p[0], p[1], p[3]
            else:
                if (dp < 0) == (dq < 0):
                    continue
                s = dp / (dp - dq)
                x, y, w = p[0] + s * (q[0] - p[0]), p[1] + s * (q[1] - p[1]), p[3] + s * (q[3] - p[3])
            if not w > 0:
                return 0.0, np.float64(width), 0.0, np.float64(height)
            x0, x1, y0, y1 = min(x0, x / w), max(x1, x / w), min(y0, y / w), max(y1, y / w)
    return x0, x1, y0, y1


@numba.njit(cache=True, inline="always")
def _edges(a, b, c):
    """Coefficients of the three edge functions, made symmetric: swapping two corners negates them exactly."""
    return (
        b[1] * c[3] - b[3] * c[1],
        b[3] * c[0] - b[0] * c[3],
        b[0] * c[1] - b[1] * c[0],
        c[1] * a[3] - c[3] * a[1],
        c[3] * a[0] - c[0] * a[3],
        c[0] * a[1] - c[1] * a[0],
        a[1] * b[3] - a[3] * b[1],
        a[3] * b[0] - a[0] * b[3],
        a[0] * b[1] - a[1] * b[0],
    )


@numba.njit(parallel=True, cache=True, nogil=True)
def _draw(faces, vertices, corners, flags, kept, boxes, counts, view_depth, triangle_ids, barycentrics, depths):
    """Fill the three fragment arrays, band by band."""
    layers, height, width = triangle_ids.shape
    for band in numba.prange((height + BAND_ROWS - 1) // BAND_ROWS):
        top, bottom = band * BAND_ROWS, min(height, (band + 1) * BAND_ROWS) - 1
        nearest = np.full(((bottom - top + 1) * width, layers), np.inf)
        ids = np.full(((bottom - top + 1) * width, layers), -1, np.int32)
        for chunk in range(len(counts)):
            for at in range(chunk * CHUNK, chunk * CHUNK + counts[chunk]):
                j0, j1 = max(top, boxes[at, 2]), min(bottom, boxes[at, 3])
                if j0 > j1:
                    continue
                t = kept[at]
                ia, ib, ic = faces[t, 0], faces[t, 1], faces[t, 2]
                a, b, c = corners[ia], corners[ib], corners[ic]
                xa, ya, wa, xb, yb, wb, xc, yc, wc = _edges(a, b, c)
                if _determinant(a, b, c) < 0:
                    xa, ya, wa, xb, yb, wb, xc, yc, wc = -xa, -ya, -wa, -xb, -yb, -wb, -xc, -yc, -wc
                # Top and left edges own the pixels exactly on them (y points down).
                own_a = xa > 0 or (xa == 0 and ya > 0)
                own_b = xb > 0 or (xb == 0 and yb > 0)
                own_c = xc > 0 or (xc == 0 and yc > 0)
                clip = flags[ia] | flags[ib] | flags[ic]
                za = _depth(view_depth, vertices[ia])
                zb = _depth(view_depth, vertices[ib])
                zc = _depth(view_depth, vertices[ic])
                for j in range(j0, j1 + 1):
                    y = j + 0.5
                    ra, rb, rc = ya * y + wa, yb * y + wb, yc * y + wc
                    for i in range(boxes[at, 0], boxes[at, 1] + 1):
                        x = i + 0.5
                        ea, eb, ec = xa * x + ra, xb * x + rb, xc * x + rc
                        if ea < 0 or eb < 0 or ec < 0:
                            continue
                        if (ea == 0 and not own_a) or (eb == 0 and not own_b) or (ec == 0 and not own_c):
                            continue
                        total = ea + eb + ec
                        if not total > 0:
                            continue
                        if clip:
                            if ea * (a[2] + a[3]) + eb * (b[2] + b[3]) + ec * (c[2] + c[3]) < 0:
                                continue
                            if ea * (a[3] - a[2]) + eb * (b[3] - b[2]) + ec * (c[3] - c[2]) < 0:
                                continue
                        z = (ea * za + eb * zb + ec * zc) / total
                        pixel = (j - top) * width + i
                        if not z < nearest[pixel, layers - 1]:
                            continue
                        k = layers - 1
                        while k > 0 and z < nearest[pixel, k - 1]:
                            nearest[pixel, k] = nearest[pixel, k - 1]
                            ids[pixel, k] = ids[pixel, k - 1]
                            k -= 1
                        nearest[pixel, k] = z
                        ids[pixel, k] = t
        for pixel in range(len(ids)):
            i, j = pixel % width, top + pixel // width
            for k in range(layers):
                t = ids[pixel, k]
                triangle_ids[k, j, i] = t
                barycentrics[k, j, i, 0] = 0
                barycentrics[k, j, i, 1] = 0
                depths[k, j, i] = 0
                if t < 0:
                    continue
                a, b, c = corners[faces[t, 0]], corners[faces[t, 1]], corners[faces[t, 2]]
                xa, ya, wa, xb, yb, wb, xc, yc, wc = _edges(a, b, c)
                x, y = i + 0.5, j + 0.5
                ea, eb, ec = xa * x + (ya * y + wa), xb * x + (yb * y + wb), xc * x + (yc * y + wc)
                total = ea + eb + ec
                barycentrics[k, j, i, 0] = ea / total
                barycentrics[k, j, i, 1] = eb / total
                depths[k, j, i] = nearest[pixel, k]


@numba.njit(cache=True, inline="always")
def _depth(row, vertex):
    return row[0] * vertex[0] + row[1] * vertex[1] + row[2] * vertex[2] + row[3]
