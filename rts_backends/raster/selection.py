"""The first pass: triangles that may cover a pixel's centre, by rounded positions of their corners on screen."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rts.plugin_api.loops import compiled, loop
from rts.plugin_api.threads import parallel
from rts_backends.raster.drawing import BAND_ROWS
from rts_backends.triangles import to_corner

BLOCK = 256
"""Triangles, or vertices, of a block in loops that keep few numbers of each; the last may have fewer."""


PER_CHUNK = 8


CHUNK = PER_CHUNK * BLOCK


LIMIT = np.float32(2**15 - 2)
"""Steps from the middle of the image to two pixels beyond its longer sides. Farther positions are clamped to this.

Positions on screen take 16 bits, so that those of a million triangles stay in caches."""


SIXTEEN, LOWER = np.int32(16), np.int32(2**16 - 1)


BEFORE, BEYOND = np.float32(2**15 - 1), np.float32(-(2**15))
"""Codes in place of a vertex's position: nearer than the near plane, behind the eye, or NaN; farther than the far
plane."""


class TriangleList(NamedTuple):
    """Triangles that may cover a pixel's centre, in the form that `draw` takes.

    Attributes:
        keep: sign of the determinants of triangles to draw; 0 for both signs.
        turns: (bands,), indices of bands of rows, those with most items first, so that threads end together.
        offsets: (2 · bands + 1,), where the items of each band begin: those seen from the front, those from behind.
        items: uint32, for each band the triangles whose boxes touch it, as indices of `rows`.
        rows: (T, LISTED) int32, the numbers listed for each triangle.
    """

    keep: float
    turns: np.ndarray
    offsets: np.ndarray
    items: np.ndarray
    rows: np.ndarray


class Projected(NamedTuple):
    """A mesh, and where its vertices lie on screen.

    Attributes:
        faces: (T, 3) uint32.
        vertices: (V, 3) float32 or float64.
        screen: (V,) int32, filled by `project`.
        matrix: (4, 4), see `pixel_matrix`.
        size: (height, width).
        step: the unit of positions on screen, in pixels.
        keep: sign of the determinants of triangles to list; 0 for both signs.
        front: that of triangles seen from the front.
    """

    faces: np.ndarray
    vertices: np.ndarray
    screen: np.ndarray
    matrix: np.ndarray
    size: tuple[int, int]
    step: np.float32
    keep: np.float32
    front: np.float32


def sorted_list(keep: float, rows: np.ndarray, spans: np.ndarray, counts: np.ndarray) -> TriangleList:
    """The list that `select` wrote to `rows`, `spans` and `counts`, sorted by bands of rows of pixels."""
    sums = np.add.reduce(counts, axis=0)
    of_bands = sums[::2] + sums[1::2]
    offsets = np.zeros(len(sums) + 1, np.int64)
    np.add.accumulate(sums, out=offsets[1:])
    places, items = offsets[:-1] + np.add.accumulate(counts, axis=0) - counts, np.empty(offsets[-1], np.uint32)
    if len(items):
        parallel(_sort, len(spans), rows, spans, places, items, work=5 * len(items))
    return TriangleList(keep, (-of_bands).argsort(), offsets, items, rows)


@loop
def project(first, last, vertices, m, screen):
    """Fill `screen` (V,) with positions of vertices, in steps from the image's middle.

    The blocks [first, last) of vertices are projected, by `m` (4, 4) to homogeneous steps. The lower 16 bits
    are the column, the upper ones the row. Positions are clamped to ±`LIMIT`; see `BEFORE` for vertices out of view.
    """
    points, pixels = np.empty((3, BLOCK), vertices.dtype), np.empty((2, BLOCK), np.int32)
    for n in range(first, last):
        block = slice(n * BLOCK, min(len(vertices), (n + 1) * BLOCK))
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


@loop
def select(first, last, mesh, made):
    """List and count the triangles that may cover the centre of a pixel, and whose determinants may have a sign.

    The search goes through chunks [first, last) of blocks of triangles of `mesh`, which is `Projected`.

    `made` is the list, to be filled: a row for each triangle (T, LISTED), where the rows of each chunk begin and end
    (chunks, 2), and the numbers of a chunk's triangles that touch each band, seen from the front and from behind
    (chunks, 2 · bands). A row begins with the triangle's index t, or −1 − t if it is seen from behind. One call writes
    its chunks one after another.
    """
    xy, box = np.empty((3, BLOCK), np.int32), np.empty((4, BLOCK), np.float32)
    clips, near, behind = np.empty(BLOCK, np.bool_), np.empty(BLOCK, np.bool_), np.empty(BLOCK, np.bool_)
    found, faces, screen, place = (box, clips, near, behind), mesh.faces, mesh.screen, first * CHUNK
    near_ones = np.empty(BLOCK, np.uint32)
    for chunk in range(first, last):
        made[1][chunk, 0] = place
        for start in range(chunk * CHUNK, min(len(faces), (chunk + 1) * CHUNK), BLOCK):
            block = faces[start : min(len(faces), start + BLOCK)]
            for b in range(len(block)):
                xy[0, b], xy[1, b], xy[2, b] = screen[block[b, 0]], screen[block[b, 1]], screen[block[b, 2]]
            _look(len(block), xy, mesh, found)
            place = _append(chunk, start, block, found, near_ones, mesh, place, made)
        made[1][chunk, 1] = place


@compiled(inline="always")
def _look(count, xy, mesh, found):
    """Fill in each triangle's box of pixels, and marks: `clips`, it may need clipping; `near`, it is to be listed.

    `xy` (3, ·) are the corners' positions of `project`. `found` are `box` (4, ·), which gets first and last column,
    first and last row, and marks. A triangle is `near` if it may cover a pixel's centre and may face as `keep`
    says, or if it `clips`. It is `behind` if it is likely to be seen from there, by `front`.
    """
    (height, width), step, keep, front = mesh.size, mesh.step, mesh.keep, mesh.front
    box, clips, near, behind = found
    more, half, four = np.float32(1.25), np.float32(0.5), np.float32(4)
    middle, center = np.float32(width / 2), np.float32(height / 2)
    for b in range(count):
        xa, ya = np.float32(np.int16(xy[0, b])), np.float32(np.int16(xy[0, b] >> SIXTEEN))
        xb, yb = np.float32(np.int16(xy[1, b])), np.float32(np.int16(xy[1, b] >> SIXTEEN))
        xc, yc = np.float32(np.int16(xy[2, b])), np.float32(np.int16(xy[2, b] >> SIXTEEN))
        x0, x1, y0, y1 = min(xa, xb, xc), max(xa, xb, xc), min(ya, yb, yc), max(ya, yb, yc)
        i0, i1, j0, j1 = _centres(
            x0 * step + middle, x1 * step + middle, y0 * step + center, y1 * step + center, height, width, step
        )
        box[0, b], box[1, b], box[2, b], box[3, b] = i0, i1, j0, j1
        # Most triangles with one centre in their box do not cover it. Half of a mesh faces away.
        x, y = (i0 + half - middle) / step, (j0 + half - center) / step
        ax, ay, bx, by, cx, cy = xa - x, ya - y, xb - x, yb - y, xc - x, yc - y
        ea, eb, ec = bx * cy - by * cx, cx * ay - cy * ax, ax * by - ay * bx
        # Rounding changes coordinates by at most half a step. Then edge functions change by at most the sum of the
        # box's sides and 2.5, and their sum by twice that. The rest is for the centre, rounded to a hundredth.
        bound = more * (x1 - x0 + y1 - y0 + four)
        away = (ea + eb + ec) * keep < -(bound + bound)
        behind[b] = (ea + eb + ec) * front < 0
        placed = (min(x0, y0) > -LIMIT) & (max(x1, y1) < LIMIT)
        clips[b] = ((x1 == BEFORE) | (x0 == BEYOND)) & (x0 < BEFORE) & (x1 > BEYOND)
        missed = ((min(ea, eb, ec) < -bound) & (max(ea, eb, ec) > bound) & (i0 == i1) & (j0 == j1)) | away
        near[b] = clips[b] | ((i0 <= i1) & (j0 <= j1) & ~(placed & missed))


@compiled(inline="always")
def _append(chunk, start, block, found, near_ones, mesh, place, made):
    """Write the triangles of a block that are marked `near` to the list `made`, from row `place` on; count their bands.

    Left out are clipped ones that cover no centre. Returns the next free row.
    """
    vertices, matrix, (height, width), step = mesh.vertices, mesh.matrix, mesh.size, mesh.step
    (box, clips, near, behind), (rows, _, counts) = found, made
    count = 0
    for b in range(len(block)):
        near_ones[count] = b
        count += near[b]
    for b in near_ones[:count]:
        i0, i1, j0, j1 = box[0, b], box[1, b], box[2, b], box[3, b]
        if clips[b]:
            corners = np.empty((3, 4))
            for c in range(3):
                to_corner(matrix, vertices, block[b, c], corners, c)
            x0, x1, y0, y1 = _clipped_box(corners, width, height)
            i0, i1, j0, j1 = _centres(x0, x1, y0, y1, height, width, step)
            if i0 > i1 or j0 > j1:
                continue
        rows[place, 0] = -1 - (start + b) if behind[b] else start + b
        rows[place, 1], rows[place, 2], rows[place, 3] = block[b, 0], block[b, 1], block[b, 2]
        rows[place, 4], rows[place, 5], rows[place, 6], rows[place, 7] = i0, i1, j0, j1
        place += 1
        for band in range(int(j0) // BAND_ROWS, int(j1) // BAND_ROWS + 1):
            counts[chunk, 2 * band + behind[b]] += 1
    return place


@compiled
def _centres(x0, x1, y0, y1, height, width, step):
    """First and last column, first and last row (float32) of pixels whose centres a box may hold; first > last if none.

    The box, in pixels, is exact to half a step. Columns and rows are cut to the image.
    """
    slack, half, zero = np.float32(0.75) * step, np.float32(0.5), np.float32(0)
    i0, i1 = max(np.ceil(x0 - half - slack), zero), min(np.floor(x1 - half + slack), np.float32(width - 1))
    j0, j1 = max(np.ceil(y0 - half - slack), zero), min(np.floor(y1 - half + slack), np.float32(height - 1))
    return i0, i1, j0, j1


@compiled
def _clipped_box(corners, width, height):
    """The box (x0, x1, y0, y1), pixels, of the part of a triangle farther than the near plane; x0 > x1 for no part.

    `corners` (3, 4) are homogeneous pixels. If a corner of that part has a w that is not positive, the box is the whole
    image.
    """
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


@loop
def _sort(first, last, rows, spans, places, items):
    """Sort a list by bands: write the rows of each band's triangles to `items`, from `places` (chunks, 2 · bands) on.

    Only chunks [first, last) are sorted; `places` move on.
    """
    for chunk in range(first, last):
        for n in range(spans[chunk, 0], spans[chunk, 1]):
            t = rows[n, 0]
            behind = t < 0
            t = -1 - t if behind else t
            rows[n, 0] = t
            for band in range(rows[n, 6] // BAND_ROWS, rows[n, 7] // BAND_ROWS + 1):
                items[places[chunk, 2 * band + behind]] = n
                places[chunk, 2 * band + behind] += 1
