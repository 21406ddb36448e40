"""Rasterizer for the CPU: K nearest triangles a pixel in one pass, on all cores (numba).

Triangles are rasterized in homogeneous coordinates (Olano and Greer, *Triangle scan conversion using 2D homogeneous
coordinates*, 1997): an edge function is the cross product of two corners (x, y, w), so no triangle is ever clipped,
and two triangles that share an edge evaluate exactly opposite numbers on it. Edge functions and barycentrics are
float64. The image is cut into bands of rows; each band is drawn by one thread, its triangles in order of their index,
so the result does not depend on the number of threads.
"""

from __future__ import annotations

import numba
import numpy as np

from rts.camera import Camera
from rts.protocols import Fragments, Proxy
from rts.sampling import TriangleSampler
from rts_backends.threads import parallel

BAND_ROWS = 8
CHUNK = 1 << 14
BOX_SLACK = 1e-6
NEAR, FAR = 1, 2


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
        vertices, faces = prepared.vertices, prepared.faces
        corners, flags = np.empty((len(vertices), 4)), np.empty(len(vertices), np.uint8)
        parallel(_transform, len(vertices), vertices, matrix, corners, flags)
        kept = np.empty(len(faces), np.int32)
        boxes = np.empty((len(faces), 4), np.int16 if max(size) < 2**15 else np.int32)
        counts = np.zeros(-(-len(faces) // CHUNK), np.int64)
        parallel(_set_up, len(counts), faces, corners, flags, height, width, facing, kept, boxes, counts)
        bands = -(-height // BAND_ROWS)
        scene = faces, vertices, corners, flags, kept, boxes, counts, -camera.view[2]
        parallel(_draw, bands, *scene, *fragments)
        return fragments


@numba.njit(cache=True, nogil=True)
def _transform(start, stop, vertices, matrix, corners, flags):
    """Homogeneous pixel coordinates (V, 4) = X, Y, clip z, w, and which of the two planes each vertex violates."""
    for v in range(start, stop):
        x, y, z = np.float64(vertices[v, 0]), np.float64(vertices[v, 1]), np.float64(vertices[v, 2])
        for i in range(4):
            corners[v, i] = matrix[i, 0] * x + matrix[i, 1] * y + matrix[i, 2] * z + matrix[i, 3]
        depth, w = corners[v, 2], corners[v, 3]
        # Written so that NaN violates both.
        flags[v] = (0 if depth >= -w and w > 0 else NEAR) | (0 if depth <= w else FAR)


@numba.njit(cache=True, nogil=True)
def _set_up(first, last, faces, corners, flags, height, width, facing, kept, boxes, counts):
    """List, chunk by chunk, the triangles that may cover a pixel centre, with their pixel boxes."""
    for chunk in range(first, last):
        start, stop = chunk * CHUNK, min(len(faces), (chunk + 1) * CHUNK)
        found = start
        for t in range(start, stop):
            ia, ib, ic = faces[t, 0], faces[t, 1], faces[t, 2]
            fa, fb, fc = flags[ia], flags[ib], flags[ic]
            if fa & fb & fc:
                continue
            if (fa | fb | fc) & NEAR:
                x0, x1, y0, y1 = _clipped_box(corners, ia, ib, ic, width, height)
            else:
                ra, rb, rc = 1 / corners[ia, 3], 1 / corners[ib, 3], 1 / corners[ic, 3]
                xa, xb, xc = corners[ia, 0] * ra, corners[ib, 0] * rb, corners[ic, 0] * rc
                ya, yb, yc = corners[ia, 1] * ra, corners[ib, 1] * rb, corners[ic, 1] * rc
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
            area = determinant(corners, ia, ib, ic)
            if not (area * facing > 0 or (facing == 0 and area != 0)):
                continue
            kept[found] = t
            boxes[found, 0], boxes[found, 1], boxes[found, 2], boxes[found, 3] = i0, i1, j0, j1
            found += 1
        counts[chunk] = found - start


@numba.njit(cache=True)
def _clipped_box(corners, ia, ib, ic, width, height):
    """The pixel box (x0, x1, y0, y1) of the part of a triangle before the near plane."""
    x0, x1, y0, y1 = np.inf, -np.inf, np.inf, -np.inf
    for i, j in ((ia, ib), (ib, ic), (ic, ia)):
        here, there = corners[i, 2] + corners[i, 3], corners[j, 2] + corners[j, 3]
        for end in range(2):
            if (end == 0 and here < 0) or (end == 1 and (here < 0) == (there < 0)):
                continue
            s = 0.0 if end == 0 else here / (here - there)
            x = corners[i, 0] + s * (corners[j, 0] - corners[i, 0])
            y = corners[i, 1] + s * (corners[j, 1] - corners[i, 1])
            w = corners[i, 3] + s * (corners[j, 3] - corners[i, 3])
            if not w > 0:
                return 0.0, np.float64(width), 0.0, np.float64(height)
            x0, x1, y0, y1 = min(x0, x / w), max(x1, x / w), min(y0, y / w), max(y1, y / w)
    return x0, x1, y0, y1


@numba.njit(cache=True)
def determinant(corners, ia, ib, ic):
    """Of the three corners (X, Y, w): twice the signed area on screen, times the three w."""
    ax, ay, aw = corners[ia, 0], corners[ia, 1], corners[ia, 3]
    bx, by, bw = corners[ib, 0], corners[ib, 1], corners[ib, 3]
    cx, cy, cw = corners[ic, 0], corners[ic, 1], corners[ic, 3]
    return ax * (by * cw - bw * cy) - ay * (bx * cw - bw * cx) + aw * (bx * cy - by * cx)


@numba.njit(cache=True)
def edge(corners, i, j):
    """Coefficients (x, y, 1) of the edge function of two corners; swapping them negates it exactly."""
    ax, ay, aw = corners[i, 0], corners[i, 1], corners[i, 3]
    bx, by, bw = corners[j, 0], corners[j, 1], corners[j, 3]
    return ay * bw - aw * by, aw * bx - ax * bw, ax * by - ay * bx


@numba.njit(cache=True, nogil=True)
def _draw(
    first, last, faces, vertices, corners, flags, kept, boxes, counts, view_depth, triangle_ids, barycentrics, depths
):
    """Fill the three fragment arrays, band by band."""
    layers, height, width = triangle_ids.shape
    d0, d1, d2, d3 = view_depth[0], view_depth[1], view_depth[2], view_depth[3]
    for band in range(first, last):
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
                xa, ya, wa = edge(corners, ib, ic)
                xb, yb, wb = edge(corners, ic, ia)
                xc, yc, wc = edge(corners, ia, ib)
                if determinant(corners, ia, ib, ic) < 0:
                    xa, ya, wa, xb, yb, wb, xc, yc, wc = -xa, -ya, -wa, -xb, -yb, -wb, -xc, -yc, -wc
                # Top and left edges own the pixels exactly on them (y points down).
                own_a = xa > 0 or (xa == 0 and ya > 0)
                own_b = xb > 0 or (xb == 0 and yb > 0)
                own_c = xc > 0 or (xc == 0 and yc > 0)
                clip = flags[ia] | flags[ib] | flags[ic]
                za = d0 * vertices[ia, 0] + d1 * vertices[ia, 1] + d2 * vertices[ia, 2] + d3
                zb = d0 * vertices[ib, 0] + d1 * vertices[ib, 1] + d2 * vertices[ib, 2] + d3
                zc = d0 * vertices[ic, 0] + d1 * vertices[ic, 1] + d2 * vertices[ic, 2] + d3
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
                        if not total > 0 or (clip and _clipped(corners, ia, ib, ic, ea, eb, ec)):
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
                if t < 0:
                    barycentrics[k, j, i, 0] = barycentrics[k, j, i, 1] = depths[k, j, i] = 0
                    continue
                barycentrics[k, j, i, 0], barycentrics[k, j, i, 1] = weights(corners, faces, t, i + 0.5, j + 0.5)
                depths[k, j, i] = nearest[pixel, k]


@numba.njit(cache=True)
def _clipped(corners, ia, ib, ic, ea, eb, ec):
    """Whether the point with barycentrics in the ratio ea : eb : ec lies outside the near or the far plane."""
    near = ea * (corners[ia, 2] + corners[ia, 3]) + eb * (corners[ib, 2] + corners[ib, 3])
    far = ea * (corners[ia, 3] - corners[ia, 2]) + eb * (corners[ib, 3] - corners[ib, 2])
    return near + ec * (corners[ic, 2] + corners[ic, 3]) < 0 or far + ec * (corners[ic, 3] - corners[ic, 2]) < 0


@numba.njit(cache=True)
def weights(corners, faces, t, x, y):
    """Perspective-correct barycentrics of the first two corners of a triangle at a pixel position."""
    ia, ib, ic = faces[t, 0], faces[t, 1], faces[t, 2]
    xa, ya, wa = edge(corners, ib, ic)
    xb, yb, wb = edge(corners, ic, ia)
    xc, yc, wc = edge(corners, ia, ib)
    ea, eb, ec = xa * x + (ya * y + wa), xb * x + (yb * y + wb), xc * x + (yc * y + wc)
    total = ea + eb + ec
    return ea / total, eb / total
