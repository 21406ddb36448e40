"""Rasterizer for the CPU: K nearest triangles a pixel in one pass, on all cores (numba).

Most triangles of a large mesh cover no pixel's centre. A first pass sees only their corners on screen, in float32, and
keeps those that may cover one; for these alone a second works out, in float64 and homogeneous coordinates
(`rts_backends.triangles`), all that drawing needs. The third draws the image in bands of rows, each by one thread and
in the order of the triangles, so the result does not depend on the number of threads.
"""

from __future__ import annotations

from typing import Any, Self

import numba
import numpy as np

from rts.camera import Camera
from rts.protocols import Fragments, Proxy
from rts.sampling import TriangleSampler
from rts.threads import parallel
from rts_backends.triangles import depth_of, determinant, edge, facing, owns, pixel_matrix, to_corner

BAND_ROWS = 16
CHUNK = 1 << 14
BLOCK = 64
SLACK = 1e-2
"""Pixels, for the rounding of corners to float32."""

WIDTH = 12
"""What is kept of a triangle: three edge functions (x, y, 1) turned inward, and the depths of its corners."""


class Raster(TriangleSampler):
    """K-buffer rasterization with a top-left fill rule; ties in depth go to the lower triangle index."""

    _scratch: dict[tuple, _Scratch]

    def __new__(cls, *args: Any, **kwargs: Any) -> Self:
        """Give every instance room to keep scratch memory, whatever `__init__` a subclass has."""
        self = super().__new__(cls, *args, **kwargs)
        self._scratch = {}  # At most one; whoever draws takes it out, so threads never share.
        return self

    def rasterize(self, prepared: Proxy, camera: Camera, size: tuple[int, int], layers: int, cull: str) -> Fragments:
        """See `TriangleSampler.rasterize`."""
        height, width = size
        vertices, faces = prepared.vertices, prepared.faces
        matrix = pixel_matrix(camera, size)
        # Drawn again and again, one mesh touches the same pages of memory: the system clears them only once.
        key = len(vertices), len(faces), np.int16 if max(size) < 2**15 else np.int32
        scratch = self._scratch.pop(key, None) or _Scratch(*key)
        screen, boxes, kept, numbers, clips, planes, counts = scratch.arrays
        parallel(_project, len(vertices), vertices, matrix, screen)
        keep = facing(camera, cull)
        parallel(_select, len(counts), vertices, faces, screen, matrix, height, width, keep, boxes, kept, clips, counts)
        given = vertices, faces, matrix, -camera.view[2], keep
        parallel(_set_up, len(counts), *given, boxes, kept, clips, numbers, planes, counts)
        fragments = Fragments(
            np.empty((layers, height, width), np.int32),
            np.empty((layers, height, width, 2), np.float32),
            np.empty((layers, height, width), np.float32),
        )
        bands = -(-height // BAND_ROWS)
        offsets, items = _bands(bands, boxes, counts)
        parallel(_draw, bands, offsets, items, boxes, kept, clips, numbers, planes, *fragments)
        self._scratch = {key: scratch}
        return fragments


class _Scratch:
    """Arrays with room for every vertex and triangle, of which only what is used is ever touched."""

    def __init__(self, vertices: int, faces: int, box_dtype: type):
        self.arrays = (
            np.empty((vertices, 2), np.float32),
            np.empty((faces, 4), box_dtype),
            np.empty(faces, np.int32),
            np.empty((faces, WIDTH)),
            np.empty(faces, np.bool_),
            np.empty((faces, 6)),
            np.zeros(-(-faces // CHUNK), np.int64),
        )


@numba.njit(cache=True, nogil=True)
def _project(start, stop, vertices, matrix, screen):
    """Pixel positions (V, 2); +inf before the near plane (or NaN), −inf beyond the far plane."""
    m = matrix
    for v in range(start, stop):
        x, y, z = np.float64(vertices[v, 0]), np.float64(vertices[v, 1]), np.float64(vertices[v, 2])
        depth = m[2, 0] * x + m[2, 1] * y + m[2, 2] * z + m[2, 3]
        w = m[3, 0] * x + m[3, 1] * y + m[3, 2] * z + m[3, 3]
        if not (depth >= -w and w > 0):
            screen[v, 0] = screen[v, 1] = np.inf
        elif not depth <= w:
            screen[v, 0] = screen[v, 1] = -np.inf
        else:
            screen[v, 0] = (m[0, 0] * x + m[0, 1] * y + m[0, 2] * z + m[0, 3]) / w
            screen[v, 1] = (m[1, 0] * x + m[1, 1] * y + m[1, 2] * z + m[1, 3]) / w


@numba.njit(cache=True, nogil=True)
def _select(first, last, vertices, faces, screen, matrix, height, width, keep, boxes, kept, clips, counts):
    """List, chunk by chunk, the triangles that may cover a pixel's centre, with their boxes of pixels."""
    corners = np.empty((3, 4))
    low, slack = np.float32(-SLACK), np.float32(SLACK)
    right, bottom = np.float32(width + SLACK), np.float32(height + SLACK)
    half, half_out, half_in = np.float32(0.5), np.float32(0.5 + SLACK), np.float32(0.5 - SLACK)
    infinity, zero = np.float32(np.inf), np.float32(0)
    for chunk in range(first, last):
        start, stop = chunk * CHUNK, min(len(faces), (chunk + 1) * CHUNK)
        found = start
        for t in range(start, stop):
            ia, ib, ic = faces[t, 0], faces[t, 1], faces[t, 2]
            xa, xb, xc = screen[ia, 0], screen[ib, 0], screen[ic, 0]
            x0, x1 = min(xa, xb, xc), max(xa, xb, xc)
            if x0 == infinity or x1 == -infinity:
                continue
            ya, yb, yc = screen[ia, 1], screen[ib, 1], screen[ic, 1]
            y0, y1 = min(ya, yb, yc), max(ya, yb, yc)
            clip = x1 == infinity or x0 == -infinity
            if clip:
                to_corner(matrix, vertices, ia, corners, 0)
                to_corner(matrix, vertices, ib, corners, 1)
                to_corner(matrix, vertices, ic, corners, 2)
                x0, x1, y0, y1 = _clipped_box(corners, width, height)
            # Pixel centres lie at i + 0.5; clamped before rounding, since a far point overflows an integer.
            i0, i1 = np.int32(np.ceil(max(x0, low) - half_out)), np.int32(np.floor(min(x1, right) - half_in))
            if i0 > i1:
                continue
            j0, j1 = np.int32(np.ceil(max(y0, low) - half_out)), np.int32(np.floor(min(y1, bottom) - half_in))
            if j0 > j1:
                continue
            i0, j0, i1, j1 = max(i0, 0), max(j0, 0), min(i1, width - 1), min(j1, height - 1)
            if i0 > i1 or j0 > j1:
                continue
            if i0 == i1 and j0 == j1 and not clip:
                # One centre: most triangles whose box holds it do not.
                x, y = np.float32(i0) + half, np.float32(j0) + half
                ax, ay, bx, by, cx, cy = xa - x, ya - y, xb - x, yb - y, xc - x, yc - y
                ea, eb, ec = bx * cy - by * cx, cx * ay - cy * ax, ax * by - ay * bx
                bound = slack * (x1 - x0 + y1 - y0)
                if min(ea, eb, ec) < -bound and max(ea, eb, ec) > bound:
                    continue
                area = ea + eb + ec
                if keep != 0 and area * np.float32(keep) < -bound and abs(area) > zero:
                    continue
            kept[found], clips[found] = t, clip
            boxes[found, 0], boxes[found, 1], boxes[found, 2], boxes[found, 3] = i0, i1, j0, j1
            found += 1
        counts[chunk] = found - start


@numba.njit(cache=True, nogil=True)
def _set_up(first, last, vertices, faces, matrix, view_depth, keep, boxes, kept, clips, numbers, planes, counts):
    """Work out what drawing needs of the listed triangles; those of no area, or facing away, leave the list."""
    corners = np.empty((3, 4))
    near_faces, near_vertices = np.empty((BLOCK, 3), np.int32), np.empty((3 * BLOCK, 3), np.float32)
    for chunk in range(first, last):
        start, found = chunk * CHUNK, chunk * CHUNK
        for n in range(start, start + counts[chunk]):
            at = (n - start) % BLOCK
            if at == 0:
                # Corners are gathered by loops so short that the processor overlaps their waits for memory.
                block = min(BLOCK, start + counts[chunk] - n)
                for b in range(block):
                    t = kept[n + b]
                    near_faces[b, 0], near_faces[b, 1], near_faces[b, 2] = faces[t, 0], faces[t, 1], faces[t, 2]
                for b in range(block):
                    for c in range(3):
                        v = near_faces[b, c]
                        near_vertices[3 * b + c, 0] = vertices[v, 0]
                        near_vertices[3 * b + c, 1] = vertices[v, 1]
                        near_vertices[3 * b + c, 2] = vertices[v, 2]
            t = kept[n]
            to_corner(matrix, near_vertices, 3 * at, corners, 0)
            to_corner(matrix, near_vertices, 3 * at + 1, corners, 1)
            to_corner(matrix, near_vertices, 3 * at + 2, corners, 2)
            area = determinant(corners, 0, 1, 2)
            if not (area * keep > 0 or (keep == 0 and area != 0)):
                continue
            sign = 1.0 if area > 0 else -1.0
            xa, ya, wa = edge(corners, 1, 2)
            xb, yb, wb = edge(corners, 2, 0)
            xc, yc, wc = edge(corners, 0, 1)
            numbers[found, 0], numbers[found, 1], numbers[found, 2] = sign * xa, sign * ya, sign * wa
            numbers[found, 3], numbers[found, 4], numbers[found, 5] = sign * xb, sign * yb, sign * wb
            numbers[found, 6], numbers[found, 7], numbers[found, 8] = sign * xc, sign * yc, sign * wc
            numbers[found, 9] = depth_of(view_depth, near_vertices, 3 * at)
            numbers[found, 10] = depth_of(view_depth, near_vertices, 3 * at + 1)
            numbers[found, 11] = depth_of(view_depth, near_vertices, 3 * at + 2)
            if clips[n]:
                for c in range(3):
                    planes[found, c] = corners[c, 3] + corners[c, 2]
                    planes[found, 3 + c] = corners[c, 3] - corners[c, 2]
            kept[found], clips[found] = t, clips[n]
            for c in range(4):
                boxes[found, c] = boxes[n, c]
            found += 1
        counts[chunk] = found - start


@numba.njit
def _clipped_box(corners, width, height):
    """The pixel box (x0, x1, y0, y1) of the part of a triangle before the near plane."""
    x0, x1, y0, y1 = np.inf, -np.inf, np.inf, -np.inf
    for i in range(3):
        j = (i + 1) % 3
        here, there = corners[i, 2] + corners[i, 3], corners[j, 2] + corners[j, 3]
        for end in range(2):
            if (end == 0 and here < 0) or (end == 1 and (here < 0) == (there < 0)):
                continue
            s = 0.0 if end == 0 else here / (here - there)
            x = corners[i, 0] + s * (corners[j, 0] - corners[i, 0])
            y = corners[i, 1] + s * (corners[j, 1] - corners[i, 1])
            w = corners[i, 3] + s * (corners[j, 3] - corners[i, 3])
            if not w > 0:
                return np.float32(0), np.float32(width), np.float32(0), np.float32(height)
            x0, x1, y0, y1 = min(x0, x / w), max(x1, x / w), min(y0, y / w), max(y1, y / w)
    return np.float32(x0), np.float32(x1), np.float32(y0), np.float32(y1)


@numba.njit(cache=True, nogil=True)
def _bands(count, boxes, counts):
    """For each band of rows the listed triangles that touch it, in order: offsets (bands + 1,) into items."""
    offsets = np.zeros(count + 1, np.int64)
    for chunk in range(len(counts)):
        for n in range(chunk * CHUNK, chunk * CHUNK + counts[chunk]):
            for band in range(boxes[n, 2] // BAND_ROWS, boxes[n, 3] // BAND_ROWS + 1):
                offsets[band + 1] += 1
    for band in range(count):
        offsets[band + 1] += offsets[band]
    items, filled = np.empty(offsets[count], np.int32), offsets[:-1].copy()
    for chunk in range(len(counts)):
        for n in range(chunk * CHUNK, chunk * CHUNK + counts[chunk]):
            for band in range(boxes[n, 2] // BAND_ROWS, boxes[n, 3] // BAND_ROWS + 1):
                items[filled[band]] = n
                filled[band] += 1
    return offsets, items


@numba.njit(cache=True, nogil=True)
def _draw(first, last, offsets, items, boxes, kept, clips, numbers, planes, triangle_ids, barycentrics, depths):
    """Fill the three fragment arrays, band by band."""
    layers, height, width = triangle_ids.shape
    nearest = np.empty((BAND_ROWS * width, layers))
    winners = np.empty((BAND_ROWS * width, layers), np.int32)
    for band in range(first, last):
        top, bottom = band * BAND_ROWS, min(height, (band + 1) * BAND_ROWS) - 1
        nearest[:], winners[:] = np.inf, -1
        for at in range(offsets[band], offsets[band + 1]):
            n = items[at]
            j0, j1 = max(top, boxes[n, 2]), min(bottom, boxes[n, 3])
            xa, ya, wa = numbers[n, 0], numbers[n, 1], numbers[n, 2]
            xb, yb, wb = numbers[n, 3], numbers[n, 4], numbers[n, 5]
            xc, yc, wc = numbers[n, 6], numbers[n, 7], numbers[n, 8]
            za, zb, zc = numbers[n, 9], numbers[n, 10], numbers[n, 11]
            # Top and left edges own the pixels exactly on them (y points down).
            own_a, own_b, own_c = owns(xa, ya), owns(xb, yb), owns(xc, yc)
            i0, i1, clipped = boxes[n, 0], boxes[n, 1], clips[n]
            for j in range(j0, j1 + 1):
                y = j + 0.5
                ra, rb, rc = ya * y + wa, yb * y + wb, yc * y + wc
                for i in range(i0, i1 + 1):
                    x = i + 0.5
                    ea, eb, ec = xa * x + ra, xb * x + rb, xc * x + rc
                    # One branch that is hard to foresee instead of three.
                    if (ea < 0) | (eb < 0) | (ec < 0):
                        continue
                    if ((ea == 0) & (not own_a)) | ((eb == 0) & (not own_b)) | ((ec == 0) & (not own_c)):
                        continue
                    total = ea + eb + ec
                    if not total > 0 or (clipped and _outside(planes, n, ea, eb, ec)):
                        continue
                    z = (ea * za + eb * zb + ec * zc) / total
                    pixel = (j - top) * width + i
                    if not z < nearest[pixel, layers - 1]:
                        continue
                    k = layers - 1
                    while k > 0 and z < nearest[pixel, k - 1]:
                        nearest[pixel, k], winners[pixel, k] = nearest[pixel, k - 1], winners[pixel, k - 1]
                        k -= 1
                    nearest[pixel, k], winners[pixel, k] = z, n
        for k in range(layers):
            for j in range(top, bottom + 1):
                y = j + 0.5
                for i in range(width):
                    n = winners[(j - top) * width + i, k]
                    if n < 0:
                        triangle_ids[k, j, i] = -1
                        barycentrics[k, j, i, 0] = barycentrics[k, j, i, 1] = depths[k, j, i] = 0
                        continue
                    x = i + 0.5
                    ea = numbers[n, 0] * x + (numbers[n, 1] * y + numbers[n, 2])
                    eb = numbers[n, 3] * x + (numbers[n, 4] * y + numbers[n, 5])
                    ec = numbers[n, 6] * x + (numbers[n, 7] * y + numbers[n, 8])
                    scale = 1 / (ea + eb + ec)
                    triangle_ids[k, j, i] = kept[n]
                    barycentrics[k, j, i, 0], barycentrics[k, j, i, 1] = ea * scale, eb * scale
                    depths[k, j, i] = nearest[(j - top) * width + i, k]


@numba.njit
def _outside(planes, n, ea, eb, ec):
    """Whether the point with barycentrics in the ratio ea : eb : ec lies outside the near or the far plane."""
    near = ea * planes[n, 0] + eb * planes[n, 1] + ec * planes[n, 2]
    far = ea * planes[n, 3] + eb * planes[n, 4] + ec * planes[n, 5]
    return near < 0 or far < 0
