"""Rasterizer for the CPU: K nearest triangles a pixel in one pass, on all cores (numba).

Triangles are rasterized in homogeneous coordinates (`rts_backends.triangles`), in float64. The image is cut into bands
of rows; each band is drawn by one thread, its triangles in order of their index, so the result does not depend on the
number of threads.
"""

from __future__ import annotations

import numba
import numpy as np

from rts.camera import Camera
from rts.protocols import Fragments, Proxy
from rts.sampling import TriangleSampler
from rts_backends.threads import parallel
from rts_backends.triangles import (
    clipped,
    depth_of,
    determinant,
    edge,
    edge_values,
    facing,
    owns,
    pixel_matrix,
    to_corner,
)

BAND_ROWS = 8
CHUNK = 1 << 14
BOX_SLACK = 1e-6
NEAR, FAR = 1, 2


class Raster(TriangleSampler):
    """K-buffer rasterization with a top-left fill rule; ties in depth go to the lower triangle index."""

    def rasterize(self, prepared: Proxy, camera: Camera, size: tuple[int, int], layers: int, cull: str) -> Fragments:
        """See `TriangleSampler.rasterize`."""
        height, width = size
        matrix, keep = pixel_matrix(camera, size), facing(camera, cull)
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
        parallel(_set_up, len(counts), faces, corners, flags, height, width, keep, kept, boxes, counts)
        bands = -(-height // BAND_ROWS)
        scene = faces, vertices, corners, flags, kept, boxes, counts, -camera.view[2]
        parallel(_draw, bands, *scene, *fragments)
        return fragments


@numba.njit(cache=True, nogil=True)
def _transform(start, stop, vertices, matrix, corners, flags):
    """Homogeneous pixel coordinates (V, 4) = X, Y, clip z, w, and which of the two planes each vertex violates."""
    for v in range(start, stop):
        to_corner(matrix, vertices, v, corners, v)
        depth, w = corners[v, 2], corners[v, 3]
        # Written so that NaN violates both.
        flags[v] = (0 if depth >= -w and w > 0 else NEAR) | (0 if depth <= w else FAR)


@numba.njit(cache=True, nogil=True)
def _set_up(first, last, faces, corners, flags, height, width, keep, kept, boxes, counts):
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
            if not (area * keep > 0 or (keep == 0 and area != 0)):
                continue
            kept[found] = t
            boxes[found, 0], boxes[found, 1], boxes[found, 2], boxes[found, 3] = i0, i1, j0, j1
            found += 1
        counts[chunk] = found - start


@numba.njit
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


@numba.njit(cache=True, nogil=True)
def _draw(
    first, last, faces, vertices, corners, flags, kept, boxes, counts, view_depth, triangle_ids, barycentrics, depths
):
    """Fill the three fragment arrays, band by band."""
    layers, height, width = triangle_ids.shape
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
                own_a, own_b, own_c = owns(xa, ya), owns(xb, yb), owns(xc, yc)
                clip = flags[ia] | flags[ib] | flags[ic]
                za = depth_of(view_depth, vertices, ia)
                zb = depth_of(view_depth, vertices, ib)
                zc = depth_of(view_depth, vertices, ic)
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
                        if not total > 0 or (clip and clipped(corners, ia, ib, ic, ea, eb, ec)):
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
                ia, ib, ic = faces[t, 0], faces[t, 1], faces[t, 2]
                ea, eb, ec, _ = edge_values(corners, ia, ib, ic, i + 0.5, j + 0.5)
                barycentrics[k, j, i, 0] = ea / (ea + eb + ec)
                barycentrics[k, j, i, 1] = eb / (ea + eb + ec)
                depths[k, j, i] = nearest[pixel, k]
