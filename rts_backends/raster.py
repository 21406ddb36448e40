"""Rasterizer for the CPU: K nearest triangles a pixel in one pass, on all cores (numba).

Most triangles of a large mesh cover no pixel's centre. A first pass sees only their corners on screen, rounded, and
lists those that may cover one. The second draws the image in bands of rows, each by one thread and in the order of the
triangles, so the result does not depend on the number of threads. For blocks of listed triangles it works out, in
float64 and homogeneous coordinates, the numbers of `rts_backends.triangles`, finds the pixels that they may cover, and
inserts these into the layers.

Loops run over arrays of one short block (a row for each number, a column for each triangle) and have no branches, so
that they compile to vector instructions and no jump is mispredicted; what is rare is sorted out last.
"""

from __future__ import annotations

from typing import Any, Self

import numpy as np

from rts.camera import Camera
from rts.compiling import compiled, kernel
from rts.records import Fragments, Proxy
from rts.sampling.triangle_sampler import TriangleSampler
from rts.threads import parallel, read_only
from rts_backends.raster_cells import Blocks, touches
from rts_backends.raster_drawing import BAND_ROWS, LISTED, draw, draw_cells
from rts_backends.triangles import facing, pixel_matrix, to_corner

CHUNK = 1 << 11
LONG_BLOCK = 256
"""The block for loops that keep little of each triangle or vertex."""

LIMIT = np.float32(2**15 - 2)
"""Steps from the middle of the image to two pixels outside of it; a position beyond is put there.

Positions on screen take 16 bits, so that those of a million triangles stay in caches.
"""

SIXTEEN, LOWER = np.int32(16), np.int32(2**16 - 1)

BEFORE, BEYOND = np.float32(2**15 - 1), np.float32(-(2**15))
"""In place of a position: before the near plane (or NaN), beyond the far plane."""


class Raster(TriangleSampler):
    """K-buffer rasterization with a top-left fill rule; ties in depth go to the lower triangle index."""

    tells_exits = True
    concurrent = True
    _scratch: tuple[tuple, list[tuple]]

    def __new__(cls, *args: Any, **kwargs: Any) -> Self:
        """Give every instance room to keep scratch memory, whatever `__init__` a subclass has."""
        self = super().__new__(cls, *args, **kwargs)
        self._scratch = (), []  # Of one size alone; whoever draws takes his out, so threads never share.
        return self

    def rasterize(self, prepared: Proxy, camera: Camera, size: tuple[int, int], layers: int, cull: str) -> Fragments:
        """See `TriangleSampler.rasterize`."""
        return self._drawn(prepared, camera, size, layers, cull, None)

    def rasterize_cells(
        self, prepared: Proxy, camera: Camera, size: tuple[int, int], layers: int, cull: str, cells: np.ndarray
    ) -> Fragments:
        """See `TriangleSampler.rasterize_cells`: triangles that touch no block of these cells are passed over."""
        return self._drawn(prepared, camera, size, layers, cull, cells)

    def _drawn(
        self,
        prepared: Proxy,
        camera: Camera,
        size: tuple[int, int],
        layers: int,
        cull: str,
        cells: np.ndarray | None,
    ) -> Fragments:
        """Fragments of all cells, or of some."""
        height, width = size
        # With unsigned indices compiled code need not look for negative ones, which count from the end.
        vertices, faces = read_only(prepared.vertices), read_only(prepared.faces, np.int32).view(np.uint32)
        matrix, keep = pixel_matrix(camera, size), facing(camera, cull)
        # Drawn again and again, one mesh touches the same pages of memory: the system clears them only once. There is
        # room for every vertex and triangle, but only what is used is ever touched.
        key = len(vertices), len(faces)
        scratch = self._scratch
        if scratch[0] != key:
            scratch = self._scratch = key, []
        try:
            screen, listed = scratch[1].pop()
        except IndexError:
            screen, listed = np.empty(len(vertices), np.int32), np.empty((len(faces), LISTED), np.int32)
        step = (max(size) / 2 + 2) / float(LIMIT)
        to_steps = np.diag([1 / step, 1 / step, 1, 1])
        to_steps[:2, 3] = -width / 2 / step, -height / 2 / step
        parallel(_project, len(vertices), vertices, to_steps @ matrix, screen, work=4 * len(vertices))
        chunks, bands = -(-len(faces) // CHUNK), -(-height // BAND_ROWS)
        spans, counts = np.empty((chunks, 2), np.int64), np.zeros((chunks, bands), np.int64)
        blocks = Blocks.everything() if cells is None else Blocks.of(cells, size)
        given = vertices, faces, screen, matrix, height, width, step, keep, blocks.bits
        parallel(_select, chunks, *given, listed, spans, counts, work=10 * len(faces))
        offsets = np.append(0, np.cumsum(counts.sum(axis=0)))
        places = offsets[:-1] + np.cumsum(counts, axis=0) - counts
        items = np.empty(offsets[-1], np.uint32)
        parallel(_sort, chunks, listed, spans, places, items, work=8 * len(items))
        shape = layers, *(size if cells is None else cells.shape)
        fragments = Fragments(np.empty(shape, np.int32), np.empty((*shape, 2), np.float32), np.empty(shape, np.float32))
        given = offsets, items, listed, vertices, matrix, -camera.view[2], keep, blocks.bits
        if cells is None:
            parallel(draw, bands, *given, tuple(fragments))
        else:
            if (absent := cells < 0).any():
                for x, nothing in zip(fragments, (-1, 0, 0), strict=True):
                    x[:, absent] = nothing
            flat = tuple(x.reshape(layers, cells.size, *x.shape[3:]) for x in fragments)
            parallel(draw_cells, bands, *given, blocks.table, blocks.numbers, flat)
        scratch[1].append((screen, listed))
        return fragments


@kernel(error_model="numpy")
def _project(start, stop, vertices, m, screen):
    """Positions (V,) on screen, in steps from the image's middle: columns in the lower 16 bits, rows in the others."""
    points, pixels = np.empty((3, LONG_BLOCK), np.float32), np.empty((2, LONG_BLOCK), np.int32)
    for first in range(start, stop, LONG_BLOCK):
        block = slice(first, min(stop, first + LONG_BLOCK))
        read, written = vertices[block], screen[block]
        for v in range(len(read)):
            points[0, v], points[1, v], points[2, v] = read[v, 0], read[v, 1], read[v, 2]
        for v in range(len(read)):
            x, y, z = np.float64(points[0, v]), np.float64(points[1, v]), np.float64(points[2, v])
            depth = m[2, 0] * x + m[2, 1] * y + m[2, 2] * z + m[2, 3]
            w = m[3, 0] * x + m[3, 1] * y + m[3, 2] * z + m[3, 3]
            scale = 1 / w
            column = (m[0, 0] * x + m[0, 1] * y + m[0, 2] * z + m[0, 3]) * scale
            row = (m[1, 0] * x + m[1, 1] * y + m[1, 2] * z + m[1, 3]) * scale
            column, row = min(max(np.rint(column), -LIMIT), LIMIT), min(max(np.rint(row), -LIMIT), LIMIT)
            behind_near, before_far = (depth >= -w) & (w > 0), depth <= w
            column, row = column if before_far else BEYOND, row if before_far else BEYOND
            pixels[0, v], pixels[1, v] = column if behind_near else BEFORE, row if behind_near else BEFORE
        for v in range(len(read)):
            written[v] = (pixels[1, v] << SIXTEEN) | (pixels[0, v] & LOWER)


@kernel(error_model="numpy")
def _select(first, last, vertices, faces, screen, matrix, height, width, step, keep, bits, listed, spans, counts):
    """List the triangles that may cover a pixel's centre, of those that `bits` of `Blocks` tell; and count them.

    Chunks of one call follow on each other in the list; `spans` (chunks, 2) says where each begins and ends, `counts`
    (chunks, bands) how many of its triangles touch a band of rows, so that threads do not write side by side.
    """
    xy, box = np.empty((3, LONG_BLOCK), np.int32), np.empty((4, LONG_BLOCK), np.float32)
    clips, near = np.empty(LONG_BLOCK, np.bool_), np.empty(LONG_BLOCK, np.bool_)
    chosen, corners = np.empty(LONG_BLOCK, np.uint32), np.empty((3, 4))
    step, sign = np.float32(step), np.float32(keep)
    more = np.float32(1.25)
    middle, center, half, four = np.float32(width / 2), np.float32(height / 2), np.float32(0.5), np.float32(4)
    found = first * CHUNK
    for chunk in range(first, last):
        spans[chunk, 0] = found
        end = min(len(faces), (chunk + 1) * CHUNK)
        for start in range(chunk * CHUNK, end, LONG_BLOCK):
            block = faces[start : min(end, start + LONG_BLOCK)]
            for b in range(len(block)):
                xy[0, b], xy[1, b], xy[2, b] = screen[block[b, 0]], screen[block[b, 1]], screen[block[b, 2]]
            for b in range(len(block)):
                xa, ya = np.float32(np.int16(xy[0, b])), np.float32(np.int16(xy[0, b] >> SIXTEEN))
                xb, yb = np.float32(np.int16(xy[1, b])), np.float32(np.int16(xy[1, b] >> SIXTEEN))
                xc, yc = np.float32(np.int16(xy[2, b])), np.float32(np.int16(xy[2, b] >> SIXTEEN))
                x0, x1, y0, y1 = min(xa, xb, xc), max(xa, xb, xc), min(ya, yb, yc), max(ya, yb, yc)
                i0, i1, j0, j1 = _centres(
                    x0 * step + middle, x1 * step + middle, y0 * step + center, y1 * step + center, height, width, step
                )
                box[0, b], box[1, b], box[2, b], box[3, b] = i0, i1, j0, j1
                # Where there is one centre, most triangles whose box holds it do not. Half of a mesh faces away.
                x, y = (i0 + half - middle) / step, (j0 + half - center) / step
                ax, ay, bx, by, cx, cy = xa - x, ya - y, xb - x, yb - y, xc - x, yc - y
                ea, eb, ec = bx * cy - by * cx, cx * ay - cy * ax, ax * by - ay * bx
                # Rounding changes coordinates by half a step at most, so these by the sum of the box's sides and 2.5,
                # and their sum by twice that. The rest is for the centre, which is rounded to a hundredth.
                bound = more * (x1 - x0 + y1 - y0 + four)
                away = (ea + eb + ec) * sign < -(bound + bound)
                placed = (min(x0, y0) > -LIMIT) & (max(x1, y1) < LIMIT)
                clips[b] = ((x1 == BEFORE) | (x0 == BEYOND)) & (x0 < BEFORE) & (x1 > BEYOND)
                missed = ((min(ea, eb, ec) < -bound) & (max(ea, eb, ec) > bound) & (i0 == i1) & (j0 == j1)) | away
                near[b] = clips[b] | ((i0 <= i1) & (j0 <= j1) & ~(placed & missed))
            count = 0
            for b in range(len(block)):
                chosen[count] = b
                count += near[b]
            for b in chosen[:count]:
                i0, i1, j0, j1 = box[0, b], box[1, b], box[2, b], box[3, b]
                if clips[b]:
                    for c in range(3):
                        to_corner(matrix, vertices, block[b, c], corners, c)
                    x0, x1, y0, y1 = _clipped_box(corners, width, height)
                    i0, i1, j0, j1 = _centres(x0, x1, y0, y1, height, width, step)
                    if i0 > i1 or j0 > j1:
                        continue
                if len(bits) > 0 and not touches(bits, np.uint32(i0), np.uint32(i1), np.uint32(j0), np.uint32(j1)):
                    continue
                listed[found, 0] = start + b
                listed[found, 1], listed[found, 2], listed[found, 3] = block[b, 0], block[b, 1], block[b, 2]
                listed[found, 4], listed[found, 5], listed[found, 6], listed[found, 7] = i0, i1, j0, j1
                found += 1
                for band in range(int(j0) // BAND_ROWS, int(j1) // BAND_ROWS + 1):
                    counts[chunk, band] += 1
        spans[chunk, 1] = found


@compiled
def _centres(x0, x1, y0, y1, height, width, step):
    """First and last column and row, in float32, whose pixels have their centres in a box, known to half a step."""
    slack, half, zero = np.float32(0.75) * step, np.float32(0.5), np.float32(0)
    i0, i1 = max(np.ceil(x0 - half - slack), zero), min(np.floor(x1 - half + slack), np.float32(width - 1))
    j0, j1 = max(np.ceil(y0 - half - slack), zero), min(np.floor(y1 - half + slack), np.float32(height - 1))
    return i0, i1, j0, j1


@compiled
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


@kernel
def _sort(first, last, listed, spans, places, items):
    """Sort the list by bands: write where each band's triangles are, in order, from `places` (chunks, bands) on."""
    for chunk in range(first, last):
        for n in range(spans[chunk, 0], spans[chunk, 1]):
            for band in range(listed[n, 6] // BAND_ROWS, listed[n, 7] // BAND_ROWS + 1):
                items[places[chunk, band]] = n
                places[chunk, band] += 1
