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

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, NamedTuple, Self

import numpy as np

from rts.camera import Camera
from rts.compiling import compiled, kernel
from rts.records import Fragments, Proxy
from rts.sampling.triangle_sampler import TriangleSampler
from rts.threads import parallel, read_only
from rts_backends import raster_cells
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
    _scratch: dict[tuple, tuple]

    def __new__(cls, *args: Any, **kwargs: Any) -> Self:
        """Give every instance room to keep scratch memory, whatever `__init__` a subclass has."""
        self = super().__new__(cls, *args, **kwargs)
        self._scratch = {}  # At most one; whoever draws takes it out, so threads never share.
        return self

    def rasterize(self, prepared: Proxy, camera: Camera, size: tuple[int, int], layers: int, cull: str) -> Fragments:
        """See `TriangleSampler.rasterize`."""
        with self._listed(prepared, camera, size, cull) as (listed,):
            return listed.drawn(layers)

    def rasterize_cells(
        self, prepared: Proxy, camera: Camera, size: tuple[int, int], layers: int, cull: str, cells: np.ndarray
    ) -> Fragments:
        """See `TriangleSampler.rasterize_cells`: triangles that touch no block of these cells are passed over."""
        with self._listed(prepared, camera, size, cull) as (listed,):
            return listed.drawn_cells(layers, cells)

    def rasterize_with_backs(
        self,
        prepared: Proxy,
        camera: Camera,
        size: tuple[int, int],
        layers: int,
        choose: Callable[[Fragments], np.ndarray],
    ) -> tuple[Fragments, np.ndarray, Fragments]:
        """See `TriangleSampler.rasterize_with_backs`: both are listed at once."""
        with self._listed(prepared, camera, size, "back", "front") as (fronts, backs):
            fragments = fronts.drawn(layers)
            cells = choose(fragments)
            return fragments, cells, backs.drawn_cells(1, cells)

    @contextmanager
    def _listed(self, prepared: Proxy, camera: Camera, size: tuple[int, int], *culls: str) -> Iterator[list[_Listed]]:
        """The triangles that may cover a pixel's centre, for each way of culling, of which the second is opposite."""
        # With unsigned indices compiled code need not look for negative ones, which count from the end.
        vertices, faces = read_only(prepared.vertices), read_only(prepared.faces, np.int32).view(np.uint32)
        matrix, keeps = pixel_matrix(camera, size), [facing(camera, cull) for cull in culls]
        # Drawn again and again, one mesh touches the same pages of memory: the system clears them only once. There is
        # room for every vertex and triangle, but only what is used is ever touched.
        key = len(vertices), len(faces)
        screen, listed = self._scratch.pop(key, None) or (
            np.empty(len(vertices), np.int32),
            np.empty((2, len(faces), LISTED), np.int32),
        )
        height, width = size
        step = (max(size) / 2 + 2) / float(LIMIT)
        to_steps = np.diag([1 / step, 1 / step, 1, 1])
        to_steps[:2, 3] = -width / 2 / step, -height / 2 / step
        parallel(_project, len(vertices), vertices, to_steps @ matrix, screen, work=4 * len(vertices))
        chunks, bands, sides = -(-len(faces) // CHUNK), -(-height // BAND_ROWS), len(keeps)
        spans, counts = np.empty((sides, chunks, 2), np.int64), np.zeros((sides, bands, chunks), np.int64)
        given = vertices, faces, screen, matrix, height, width, step, keeps[0]
        parallel(_select, chunks, *given, listed, spans, counts, work=10 * len(faces))
        view = vertices, matrix, -camera.view[2]
        yield [_Listed(size, *view, *side) for side in zip(keeps, listed, spans, counts, strict=False)]
        self._scratch = {key: (screen, listed)}


class _Listed(NamedTuple):
    """Triangles that may cover a pixel's centre.

    Attributes:
        size: (height, width).
        vertices: (V, 3) float32.
        matrix: (4, 4), from vertices to pixels.
        view_depth: (4,), the row of the view that gives depth.
        keep: sign of the determinants to keep, or 0.
        listed: (·, LISTED) int32, what is listed of each.
        spans: (chunks, 2), where those of each chunk of triangles begin and end in the list.
        counts: (bands, chunks), how many of them touch each band of rows.
    """

    size: tuple[int, int]
    vertices: np.ndarray
    matrix: np.ndarray
    view_depth: np.ndarray
    keep: float
    listed: np.ndarray
    spans: np.ndarray
    counts: np.ndarray

    def drawn(self, layers: int) -> Fragments:
        """Fragments of all cells."""
        shape = layers, *self.size
        fragments = Fragments(np.empty(shape, np.int32), np.empty((*shape, 2), np.float32), np.empty(shape, np.float32))
        parallel(draw, len(self.counts), *self._sorted(), *fragments)
        return fragments

    def drawn_cells(self, layers: int, cells: np.ndarray) -> Fragments:
        """Fragments of some cells (L, C), as flat indices; the list is narrowed to what touches them."""
        blocks, chunks = raster_cells.Blocks.of(cells, self.size), self.counts.shape[1]
        given = self.listed, blocks.bits, self.spans, self.counts
        parallel(raster_cells.narrow, chunks, *given, work=15 * int(self.counts.sum()))
        fragments = blocks.nothing(cells, layers)
        flat = [x.reshape(layers, cells.size, *x.shape[3:]) for x in fragments]
        nearest = np.full((layers, cells.size), np.inf)
        given = *self._sorted(), blocks.table, blocks.numbers, nearest
        parallel(draw_cells, len(self.counts), *given, *flat)
        return fragments

    def _sorted(self) -> tuple[Any, ...]:
        """Arguments of what draws the list, sorted by bands."""
        counts = self.counts
        offsets = np.append(0, np.cumsum(counts.sum(axis=1)))
        places = offsets[:-1, None] + np.cumsum(counts, axis=1) - counts
        items = np.empty(offsets[-1], np.uint32)
        parallel(_sort, counts.shape[1], self.listed, self.spans, places, items, work=8 * len(items))
        return offsets, items, self.listed, self.vertices, self.matrix, self.view_depth, self.keep


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
def _select(first, last, vertices, faces, screen, matrix, height, width, step, keep, listed, spans, counts):
    """List the triangles that may cover a pixel's centre, and count them; once, or again for the side that is culled.

    Chunks of one call follow on each other in a list; `spans` (·, chunks, 2) says where each begins and ends, `counts`
    (·, bands, chunks) how many of its triangles touch a band of rows.
    """
    xy, box = np.empty((3, LONG_BLOCK), np.int32), np.empty((4, LONG_BLOCK), np.float32)
    clips, near = np.empty(LONG_BLOCK, np.bool_), np.empty((2, LONG_BLOCK), np.bool_)
    chosen, corners = np.empty(LONG_BLOCK, np.uint32), np.empty((3, 4))
    step, sign = np.float32(step), np.float32(keep)
    more = np.float32(1.25)
    middle, center, half, four = np.float32(width / 2), np.float32(height / 2), np.float32(0.5), np.float32(4)
    sides, found = len(spans), np.full(len(spans), first * CHUNK)
    for chunk in range(first, last):
        spans[:, chunk, 0] = found
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
                # Where there is one centre, most triangles whose box holds it do not.
                x, y = (i0 + half - middle) / step, (j0 + half - center) / step
                ax, ay, bx, by, cx, cy = xa - x, ya - y, xb - x, yb - y, xc - x, yc - y
                ea, eb, ec = bx * cy - by * cx, cx * ay - cy * ax, ax * by - ay * bx
                # Rounding changes coordinates by half a step at most, so these by the sum of the box's sides and 2.5,
                # and their sum by twice that. The rest is for the centre, which is rounded to a hundredth.
                bound = more * (x1 - x0 + y1 - y0 + four)
                area = (ea + eb + ec) * sign
                missed = (min(ea, eb, ec) < -bound) & (max(ea, eb, ec) > bound)
                placed = (min(x0, y0) > -LIMIT) & (max(x1, y1) < LIMIT)
                clips[b] = ((x1 == BEFORE) | (x0 == BEYOND)) & (x0 < BEFORE) & (x1 > BEYOND)
                near_one = (i0 <= i1) & (j0 <= j1) & ~((i0 == i1) & (j0 == j1) & placed & missed)
                near[0, b] = clips[b] | (near_one & ~(placed & (area < -(bound + bound))))
                near[1, b] = clips[b] | (near_one & ~(placed & (area > bound + bound)))
            for side in range(sides):
                count = 0
                for b in range(len(block)):
                    chosen[count] = b
                    count += near[side, b]
                for b in chosen[:count]:
                    i0, i1, j0, j1 = box[0, b], box[1, b], box[2, b], box[3, b]
                    if clips[b]:
                        for c in range(3):
                            to_corner(matrix, vertices, block[b, c], corners, c)
                        x0, x1, y0, y1 = _clipped_box(corners, width, height)
                        i0, i1, j0, j1 = _centres(x0, x1, y0, y1, height, width, step)
                        if i0 > i1 or j0 > j1:
                            continue
                    entry = listed[side, found[side]]
                    entry[0], entry[1], entry[2], entry[3] = start + b, block[b, 0], block[b, 1], block[b, 2]
                    entry[4], entry[5], entry[6], entry[7] = i0, i1, j0, j1
                    found[side] += 1
                    for band in range(int(j0) // BAND_ROWS, int(j1) // BAND_ROWS + 1):
                        counts[side, band, chunk] += 1
        spans[:, chunk, 1] = found


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
    """Sort the list by bands: write where each band's triangles are, in order, from `places` (bands, chunks) on."""
    for chunk in range(first, last):
        for n in range(spans[chunk, 0], spans[chunk, 1]):
            for band in range(listed[n, 6] // BAND_ROWS, listed[n, 7] // BAND_ROWS + 1):
                items[places[band, chunk]] = n
                places[band, chunk] += 1
