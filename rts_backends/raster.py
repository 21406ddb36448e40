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

import numba
import numpy as np

from rts.camera import Camera
from rts.records import Fragments, Proxy
from rts.sampling.triangle_sampler import TriangleSampler
from rts.threads import parallel
from rts_backends import raster_cells
from rts_backends.triangles import facing, owns, pixel_matrix, to_corner

BAND_ROWS = raster_cells.SIDE
CHUNK = 1 << 11
BLOCK = 64
LONG_BLOCK = 256
"""The block for loops that keep little of each triangle or vertex."""

LIMIT = np.float32(2**15 - 2)
"""Steps from the middle of the image to two pixels outside of it; a position beyond is put there.

Positions on screen take 16 bits, so that those of a million triangles stay in caches.
"""

BEFORE, BEYOND = np.float32(2**15 - 1), np.float32(-(2**15))
"""In place of a position: before the near plane (or NaN), beyond the far plane."""

LISTED = raster_cells.LISTED
"""What is listed of a triangle: its index, its three corners, and its first and last column and row of pixels."""

NUMBERS = 18
"""Three edge functions (x, y, 1) turned inward; of the corners the depths, and w + z and w − z of clip space."""


class Raster(TriangleSampler):
    """K-buffer rasterization with a top-left fill rule; ties in depth go to the lower triangle index."""

    _scratch: dict[tuple, tuple]

    def __new__(cls, *args: Any, **kwargs: Any) -> Self:
        """Give every instance room to keep scratch memory, whatever `__init__` a subclass has."""
        self = super().__new__(cls, *args, **kwargs)
        self._scratch = {}  # At most one; whoever draws takes it out, so threads never share.
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
        vertices, faces = prepared.vertices, np.asarray(prepared.faces, np.int32).view(np.uint32)
        matrix, keep = pixel_matrix(camera, size), facing(camera, cull)
        # Drawn again and again, one mesh touches the same pages of memory: the system clears them only once. There is
        # room for every vertex and triangle, but only what is used is ever touched.
        key = len(vertices), len(faces)
        screen, listed = self._scratch.pop(key, None) or (
            np.empty((len(vertices), 2), np.int16),
            np.empty((len(faces), LISTED), np.int32),
        )
        step = (max(size) / 2 + 2) / float(LIMIT)
        to_steps = np.diag([1 / step, 1 / step, 1, 1])
        to_steps[:2, 3] = -width / 2 / step, -height / 2 / step
        parallel(_project, len(vertices), vertices, to_steps @ matrix, screen, work=4 * len(vertices))
        chunks, bands = -(-len(faces) // CHUNK), -(-height // BAND_ROWS)
        spans, counts = np.empty((chunks, 2), np.int64), np.zeros((bands, chunks), np.int64)
        given = vertices, faces, screen, matrix, height, width, step, keep
        parallel(_select, chunks, *given, listed, spans, counts, work=10 * len(faces))
        blocks = None if cells is None else raster_cells.Blocks.of(cells, size)
        if blocks is not None:
            parallel(raster_cells.narrow, chunks, listed, blocks.bits, spans, counts, work=5 * int(counts.sum()))
        offsets = np.append(0, np.cumsum(counts.sum(axis=1)))
        places = offsets[:-1, None] + np.cumsum(counts, axis=1) - counts
        items = np.empty(offsets[-1], np.uint32)
        parallel(_sort, chunks, listed, spans, places, items, work=8 * len(items))
        given = offsets, items, listed, vertices, matrix, -camera.view[2], keep
        if blocks is None or cells is None:
            fragments = Fragments(
                np.empty((layers, height, width), np.int32),
                np.empty((layers, height, width, 2), np.float32),
                np.empty((layers, height, width), np.float32),
            )
            parallel(_draw, bands, *given, *fragments)
        else:
            fragments = blocks.nothing(cells, layers)
            flat = [x.reshape(layers, cells.size, *x.shape[3:]) for x in fragments]
            nearest = np.full((layers, cells.size), np.inf)
            parallel(_draw_cells, bands, *given, blocks.table, blocks.numbers, nearest, *flat)
        self._scratch = {key: (screen, listed)}
        return fragments


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _project(start, stop, vertices, m, screen):
    """Positions (V, 2) on screen, in steps from the middle of the image."""
    points, pixels = np.empty((3, LONG_BLOCK), np.float32), np.empty((2, LONG_BLOCK), np.int16)
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
            written[v, 0], written[v, 1] = pixels[0, v], pixels[1, v]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _select(first, last, vertices, faces, screen, matrix, height, width, step, keep, listed, spans, counts):
    """List the triangles that may cover a pixel's centre, and count them.

    Chunks of one call follow on each other in the list; `spans` (chunks, 2) says where each begins and ends, `counts`
    (bands, chunks) how many of its triangles touch a band of rows.
    """
    xy, box = np.empty((3, LONG_BLOCK, 2), np.int16), np.empty((4, LONG_BLOCK), np.float32)
    clips, near = np.empty(LONG_BLOCK, np.bool_), np.empty(LONG_BLOCK, np.bool_)
    chosen, corners = np.empty(LONG_BLOCK, np.uint32), np.empty((3, 4))
    step, sign = np.float32(step), np.float32(keep)
    middle, center, half, five = np.float32(width / 2), np.float32(height / 2), np.float32(0.5), np.float32(5)
    found = first * CHUNK
    for chunk in range(first, last):
        spans[chunk, 0] = found
        end = min(len(faces), (chunk + 1) * CHUNK)
        for start in range(chunk * CHUNK, end, LONG_BLOCK):
            block = faces[start : min(end, start + LONG_BLOCK)]
            for b in range(len(block)):
                for c in range(3):
                    v = block[b, c]
                    xy[c, b, 0], xy[c, b, 1] = screen[v, 0], screen[v, 1]
            for b in range(len(block)):
                xa, xb, xc = np.float32(xy[0, b, 0]), np.float32(xy[1, b, 0]), np.float32(xy[2, b, 0])
                ya, yb, yc = np.float32(xy[0, b, 1]), np.float32(xy[1, b, 1]), np.float32(xy[2, b, 1])
                x0, x1, y0, y1 = min(xa, xb, xc), max(xa, xb, xc), min(ya, yb, yc), max(ya, yb, yc)
                i0, i1, j0, j1 = _centres(
                    x0 * step + middle, x1 * step + middle, y0 * step + center, y1 * step + center, height, width, step
                )
                box[0, b], box[1, b], box[2, b], box[3, b] = i0, i1, j0, j1
                # Where there is one centre, most triangles whose box holds it do not.
                x, y = (i0 + half - middle) / step, (j0 + half - center) / step
                ax, ay, bx, by, cx, cy = xa - x, ya - y, xb - x, yb - y, xc - x, yc - y
                ea, eb, ec = bx * cy - by * cx, cx * ay - cy * ax, ax * by - ay * bx
                bound = five * (x1 - x0 + y1 - y0 + five)  # Twice what rounding to whole steps may come to.
                away = (ea + eb + ec) * sign < -bound
                missed = ((min(ea, eb, ec) < -bound) & (max(ea, eb, ec) > bound)) | away
                placed = (min(x0, y0) > -LIMIT) & (max(x1, y1) < LIMIT)
                clips[b] = ((x1 == BEFORE) | (x0 == BEYOND)) & (x0 < BEFORE) & (x1 > BEYOND)
                near[b] = clips[b] | ((i0 <= i1) & (j0 <= j1) & ~((i0 == i1) & (j0 == j1) & placed & missed))
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
                listed[found, 0] = start + b
                listed[found, 1], listed[found, 2], listed[found, 3] = block[b, 0], block[b, 1], block[b, 2]
                listed[found, 4], listed[found, 5], listed[found, 6], listed[found, 7] = i0, i1, j0, j1
                found += 1
                for band in range(int(j0) // BAND_ROWS, int(j1) // BAND_ROWS + 1):
                    counts[band, chunk] += 1
        spans[chunk, 1] = found


@numba.njit
def _centres(x0, x1, y0, y1, height, width, step):
    """First and last column and row, in float32, whose pixels have their centres in a box, known to half a step."""
    slack, half, zero = np.float32(0.75) * step, np.float32(0.5), np.float32(0)
    i0, i1 = max(np.ceil(x0 - half - slack), zero), min(np.floor(x1 - half + slack), np.float32(width - 1))
    j0, j1 = max(np.ceil(y0 - half - slack), zero), min(np.floor(y1 - half + slack), np.float32(height - 1))
    return i0, i1, j0, j1


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
def _sort(first, last, listed, spans, places, items):
    """Sort the list by bands: write where each band's triangles are, in order, from `places` (bands, chunks) on."""
    for chunk in range(first, last):
        for n in range(spans[chunk, 0], spans[chunk, 1]):
            for band in range(listed[n, 6] // BAND_ROWS, listed[n, 7] // BAND_ROWS + 1):
                items[places[band, chunk]] = n
                places[band, chunk] += 1


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _draw(first, last, offsets, items, listed, vertices, matrix, view_depth, keep, triangle_ids, barycentrics, depths):
    """Fill the three fragment arrays, band by band."""
    layers, height, width = triangle_ids.shape
    nearest = np.empty((layers, BAND_ROWS, width))
    entries, points = np.empty((LISTED, BLOCK), np.int32), np.empty((3, 3, BLOCK), np.float32)
    numbers, clips, covers = np.empty((NUMBERS, BLOCK)), np.empty(BLOCK, np.bool_), np.empty(BLOCK, np.int32)
    most = 4 * BLOCK
    hits = np.empty((most + width, 2), np.int32)
    for band in range(first, last):
        top, bottom = band * BAND_ROWS, min(height, (band + 1) * BAND_ROWS) - 1
        rows = slice(top, bottom + 1)
        nearest[:], triangle_ids[:, rows], barycentrics[:, rows] = np.inf, -1, 0
        for start in range(offsets[band], offsets[band + 1], BLOCK):
            block = items[start : min(offsets[band + 1], start + BLOCK)]
            _gather(block, listed, vertices, entries, points)
            _set_up(len(block), points, matrix, view_depth, keep, top, bottom, entries, numbers, clips)
            _cover(len(block), entries, numbers, covers)
            found = 0
            for b in range(len(block)):
                i0, i1, j0, j1 = entries[4, b], entries[5, b], entries[6, b], entries[7, b]
                place = b * BAND_ROWS + j0 - top
                if (i1 - i0 < 2) & (j1 - j0 < 2):
                    for n in range(4):
                        hits[found, 0], hits[found, 1] = place + (n >> 1), i0 + (n & 1)
                        found += (covers[b] >> n) & 1
                    continue
                for j in range(j0, j1 + 1):
                    y = j + 0.5
                    ra, rb = numbers[1, b] * y + numbers[2, b], numbers[4, b] * y + numbers[5, b]
                    rc = numbers[7, b] * y + numbers[8, b]
                    for i in range(i0, i1 + 1):
                        x = i + 0.5
                        ea, eb, ec = numbers[0, b] * x + ra, numbers[3, b] * x + rb, numbers[6, b] * x + rc
                        hits[found, 0], hits[found, 1] = place, i
                        found += (ea >= 0) & (eb >= 0) & (ec >= 0)
                    place += 1
                    if found > most - 4:
                        _insert(hits[:found], top, entries, numbers, clips, nearest, triangle_ids, barycentrics)
                        found = 0
            _insert(hits[:found], top, entries, numbers, clips, nearest, triangle_ids, barycentrics)
        for k in range(layers):
            for j in range(top, bottom + 1):
                for i in range(width):
                    z = nearest[k, j - top, i]
                    depths[k, j, i] = z if z < np.inf else 0.0


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _draw_cells(
    first,
    last,
    offsets,
    items,
    listed,
    vertices,
    matrix,
    view_depth,
    keep,
    table,
    members,
    nearest,
    triangle_ids,
    barycentrics,
    depths,
):
    """As `_draw`, of some cells: arrays (K, M) are of their list; `table` and `members` are those of `Blocks`."""
    entries, points = np.empty((LISTED, BLOCK), np.int32), np.empty((3, 3, BLOCK), np.float32)
    numbers, clips, covers = np.empty((NUMBERS, BLOCK)), np.empty(BLOCK, np.bool_), np.empty(BLOCK, np.int32)
    most = 4 * BLOCK
    hits = np.empty((most + table.shape[1] * BAND_ROWS, 2), np.int32)
    for band in range(first, last):
        top = band * BAND_ROWS
        for start in range(offsets[band], offsets[band + 1], BLOCK):
            block = items[start : min(offsets[band + 1], start + BLOCK)]
            _gather(block, listed, vertices, entries, points)
            _set_up(len(block), points, matrix, view_depth, keep, top, top + BAND_ROWS - 1, entries, numbers, clips)
            _cover(len(block), entries, numbers, covers)
            found = 0
            for b in range(len(block)):
                i0, i1, j0, j1 = entries[4, b], entries[5, b], entries[6, b], entries[7, b]
                place = b * BAND_ROWS + j0 - top
                if (i1 - i0 < 2) & (j1 - j0 < 2):
                    for n in range(4):
                        hits[found, 0], hits[found, 1] = place + (n >> 1), i0 + (n & 1)
                        found += (covers[b] >> n) & 1
                    continue
                for j in range(j0, j1 + 1):
                    y = j + 0.5
                    ra, rb = numbers[1, b] * y + numbers[2, b], numbers[4, b] * y + numbers[5, b]
                    rc = numbers[7, b] * y + numbers[8, b]
                    for column in range(i0 // BAND_ROWS, i1 // BAND_ROWS + 1):
                        if table[band, column] < 0:
                            continue
                        left, right = max(i0, column * BAND_ROWS), min(i1, column * BAND_ROWS + BAND_ROWS - 1)
                        for i in range(left, right + 1):
                            x = i + 0.5
                            ea, eb, ec = numbers[0, b] * x + ra, numbers[3, b] * x + rb, numbers[6, b] * x + rc
                            hits[found, 0], hits[found, 1] = place, i
                            found += (ea >= 0) & (eb >= 0) & (ec >= 0)
                    place += 1
                    if found > most - 4:
                        given = entries, numbers, clips, table[band], members, nearest, triangle_ids, barycentrics
                        _insert_cells(hits[:found], top, *given)
                        found = 0
            given = entries, numbers, clips, table[band], members, nearest, triangle_ids, barycentrics
            _insert_cells(hits[:found], top, *given)
        for column in table[band]:
            if column < 0:
                continue
            for m in members[column].flat:
                if m >= 0:
                    for k in range(len(nearest)):
                        z = nearest[k, m]
                        depths[k, m] = z if z < np.inf else 0.0


@numba.njit(error_model="numpy")
def _insert_cells(hits, top, entries, numbers, clips, columns, members, nearest, triangle_ids, barycentrics):
    """As `_insert`, into the layers of those cells that are listed."""
    for h in range(len(hits)):
        place, i = np.uint32(hits[h, 0]), np.uint32(hits[h, 1])
        b, row = place // np.uint32(BAND_ROWS), place % np.uint32(BAND_ROWS)
        block = columns[i // np.uint32(BAND_ROWS)]
        if block < 0:
            continue
        m = members[block, row, i % np.uint32(BAND_ROWS)]
        if m < 0:
            continue
        found, z, p, q = _met(b, i + 0.5, row + np.uint32(top) + 0.5, numbers, clips)
        if found:
            _put(z, entries[0, b], p, q, nearest[:, m], triangle_ids[:, m], barycentrics[:, m])


# numba itself must inline these, so that lengths of rows are known: only then do their loops become vector code.


@numba.njit(inline="always")
def _gather(block, listed, vertices, entries, points):
    """What is listed of the triangles (LISTED, BLOCK), and their corners (3, 3, BLOCK).

    The loops are so short that the processor overlaps their waits for memory.
    """
    for b in range(len(block)):
        for r in range(LISTED):
            entries[r, b] = listed[block[b], r]
    for b in range(len(block)):
        for c in range(3):
            v = np.uint32(entries[1 + c, b])
            for r in range(3):
                points[c, r, b] = vertices[v, r]


@numba.njit(inline="always")
def _set_up(count, points, m, view_depth, keep, top, bottom, entries, numbers, clips):
    """Work out the numbers (NUMBERS, BLOCK) of triangles, and which may need clipping.

    Rows are cut to the band; none are left of a triangle of no area, or facing away.
    """
    corners, signs = np.empty((3, 4, BLOCK)), np.empty(BLOCK)
    for c in range(3):
        for b in range(count):
            px, py, pz = points[c, 0, b], points[c, 1, b], points[c, 2, b]
            numbers[9 + c, b] = view_depth[0] * px + view_depth[1] * py + view_depth[2] * pz + view_depth[3]
            x, y, z = np.float64(px), np.float64(py), np.float64(pz)
            for r in range(4):
                corners[c, r, b] = m[r, 0] * x + m[r, 1] * y + m[r, 2] * z + m[r, 3]
            numbers[12 + c, b] = corners[c, 3, b] + corners[c, 2, b]
            numbers[15 + c, b] = corners[c, 3, b] - corners[c, 2, b]
    for b in range(count):
        ax, ay, aw = corners[0, 0, b], corners[0, 1, b], corners[0, 3, b]
        bx, by, bw = corners[1, 0, b], corners[1, 1, b], corners[1, 3, b]
        cx, cy, cw = corners[2, 0, b], corners[2, 1, b], corners[2, 3, b]
        area = ax * (by * cw - bw * cy) - ay * (bx * cw - bw * cx) + aw * (bx * cy - by * cx)
        signs[b] = 1.0 if area > 0 else -1.0
        drawn = (area * keep > 0) | ((keep == 0) & (area != 0))
        entries[6, b], entries[7, b] = max(entries[6, b], top), min(entries[7, b], bottom) if drawn else -1
        near = min(numbers[12, b], numbers[13, b], numbers[14, b])
        far = min(numbers[15, b], numbers[16, b], numbers[17, b])
        clips[b] = (near < 0) | (far < 0)
    for c in range(3):
        i, j = (c + 1) % 3, (c + 2) % 3
        for b in range(count):
            ax, ay, aw = corners[i, 0, b], corners[i, 1, b], corners[i, 3, b]
            bx, by, bw = corners[j, 0, b], corners[j, 1, b], corners[j, 3, b]
            numbers[3 * c, b] = signs[b] * (ay * bw - aw * by)
            numbers[3 * c + 1, b] = signs[b] * (aw * bx - ax * bw)
            numbers[3 * c + 2, b] = signs[b] * (ax * by - ay * bx)


@numba.njit(inline="always")
def _cover(count, entries, numbers, covers):
    """Which of the first 2 × 2 pixels of its box each triangle may cover, as bits."""
    for b in range(count):
        bits = 0
        for n in range(4):
            i, j = entries[4, b] + (n & 1), entries[6, b] + (n >> 1)
            x, y = i + 0.5, j + 0.5
            ea = numbers[0, b] * x + (numbers[1, b] * y + numbers[2, b])
            eb = numbers[3, b] * x + (numbers[4, b] * y + numbers[5, b])
            ec = numbers[6, b] * x + (numbers[7, b] * y + numbers[8, b])
            bits |= ((i <= entries[5, b]) & (j <= entries[7, b]) & (ea >= 0) & (eb >= 0) & (ec >= 0)) << n
        covers[b] = bits


@numba.njit(error_model="numpy")
def _insert(hits, top, entries, numbers, clips, nearest, triangle_ids, barycentrics):
    """Insert the block's triangles into the layers of pixels; hits (n, 2) are triangle and row of the band, column."""
    for h in range(len(hits)):
        place, i = np.uint32(hits[h, 0]), np.uint32(hits[h, 1])
        b, row = place // np.uint32(BAND_ROWS), place % np.uint32(BAND_ROWS)
        j = row + np.uint32(top)
        found, z, p, q = _met(b, i + 0.5, j + 0.5, numbers, clips)
        if found:
            _put(z, entries[0, b], p, q, nearest[:, row, i], triangle_ids[:, j, i], barycentrics[:, j, i])


@numba.njit(inline="always", error_model="numpy")
def _met(b, x, y, numbers, clips):
    """Whether triangle b of a block covers a point; and its depth and first two barycentrics there."""
    xa, ya, wa = numbers[0, b], numbers[1, b], numbers[2, b]
    xb, yb, wb = numbers[3, b], numbers[4, b], numbers[5, b]
    xc, yc, wc = numbers[6, b], numbers[7, b], numbers[8, b]
    ea, eb, ec = xa * x + (ya * y + wa), xb * x + (yb * y + wb), xc * x + (yc * y + wc)
    found = True
    # Top and left edges own the pixels exactly on them (y points down).
    if min(ea, eb, ec) == 0:
        found = not ((ea == 0 and not owns(xa, ya)) or (eb == 0 and not owns(xb, yb)) or (ec == 0 and not owns(xc, yc)))
    total = ea + eb + ec
    found = found and total > 0 and not (clips[b] and _outside(numbers, b, ea, eb, ec))
    z, scale = (ea * numbers[9, b] + eb * numbers[10, b] + ec * numbers[11, b]) / total, 1 / total
    return found, z, np.float32(ea * scale), np.float32(eb * scale)


@numba.njit(inline="always")
def _put(z, t, p, q, nearest, triangle_ids, barycentrics):
    """Put a hit into the layers (K,) of a cell: behind what is as near, before what is farther."""
    moved = z  # A branch would be foreseen every other time.
    for k in range(len(nearest)):
        old, old_t, old_p, old_q = nearest[k], triangle_ids[k], barycentrics[k, 0], barycentrics[k, 1]
        before = z < old
        nearest[k], triangle_ids[k] = moved if before else old, t if before else old_t
        barycentrics[k, 0], barycentrics[k, 1] = p if before else old_p, q if before else old_q
        moved, t = old if before else moved, old_t if before else t
        p, q = old_p if before else p, old_q if before else q


@numba.njit
def _outside(numbers, b, ea, eb, ec):
    """Whether the point with barycentrics in the ratio ea : eb : ec lies outside the near or the far plane."""
    near = ea * numbers[12, b] + eb * numbers[13, b] + ec * numbers[14, b]
    far = ea * numbers[15, b] + eb * numbers[16, b] + ec * numbers[17, b]
    return near < 0 or far < 0
