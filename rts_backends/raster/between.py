"""Triangles that fall between the centres of cells: the third pass of the rasterizer, over a finished image.

A piece of a mesh that is thinner than cells are apart may cover no centre, and no comparison of samples can tell where
it is. Each cell shows, by its own depth and those of the eight cells around it, how near the surface may come in its
square. A triangle that touches the square nearer than that is missed. In empty surroundings every triangle is.

Small triangles of a fine mesh touch every cell, and lie where the depths around them say.
"""

from __future__ import annotations

import numpy as np

from rts import Camera
from rts.plugin_api.loops import compiled, loop
from rts.plugin_api.records import Proxy
from rts.plugin_api.threads import parallel, read_only
from rts_backends.raster.clusters import SIZE, Clusters
from rts_backends.reference import ROUNDING, SLACK
from rts_backends.triangles import depth_of, pixel_matrix, to_corner

BOX = 16
"""The most cells of a box that are looked at one by one before a triangle is clipped to rows of cells."""

PER_CHUNK = 8
"""Blocks of triangles that are looked at together."""


def between(
    mesh: Proxy | Clusters, camera: Camera, size: tuple[int, int], keep: float, depth: np.ndarray
) -> np.ndarray:
    """The depths (H, W) float32 of the nearest triangles missed in each cell, or 0 where none is.

    Triangles that the near or the far plane cuts are left out.

    Args:
        mesh: the triangles.
        camera: NumPy float64 matrices.
        size: (height, width).
        keep: sign of the determinants of triangles to look at; 0 for both signs.
        depth: (H, W) float32, what each cell shows; 0 where it is empty.
    """
    vertices, faces = read_only(mesh.vertices, np.float32), read_only(mesh.faces, np.int32)
    matrix, view_depth = pixel_matrix(camera, size), -camera.view[2]
    if isinstance(mesh, Clusters):
        blocks, _, used = mesh.seen(matrix, size, keep, False)
    else:
        blocks, used = (np.arange(-(-len(x) // SIZE), dtype=np.int32) for x in (faces, vertices))
    limits, missed, pooled = np.empty(size, np.float32), np.zeros(size, np.float32), np.empty(size, np.float32)
    parallel(_limit, size[0], read_only(depth, np.float32), limits, work=20 * limits.size)
    parallel(_pool, size[0], limits, pooled, work=2 * limits.size)
    screen = np.empty((len(vertices), 3), np.float32)
    parallel(_project, len(used), used, vertices, matrix, view_depth, screen, work=4 * SIZE * len(used))
    chunks = -(-len(blocks) // PER_CHUNK)
    listed, counts = np.empty((chunks, PER_CHUNK * SIZE), np.int32), np.zeros(chunks, np.int64)
    parallel(_list, chunks, blocks, faces, screen, keep, limits, pooled, listed, counts, work=10 * SIZE * len(blocks))
    # One thread marks, so that the result does not depend on the order of threads; few triangles are left.
    _mark(listed, counts, faces, vertices, matrix, view_depth, limits, missed)
    return missed


@loop
def _limit(start, stop, depth, limits):
    """Fill rows [start, stop) of `limits` (H, W): the depth from which on a triangle in a cell is no surprise.

    `depth` (H, W) is what the cells show, 0 where they are empty. The limit is infinite amid empty cells.
    """
    height, width = depth.shape
    low, high = np.empty(width + 2, np.float32), np.empty(width + 2, np.float32)
    slack, rounding, infinity = np.float32(SLACK), np.float32(ROUNDING), np.float32(np.inf)
    low[0] = low[width + 1] = infinity
    high[0] = high[width + 1] = np.float32(0)
    for y in range(start, stop):
        above, level, below = depth[max(y - 1, 0)], depth[y], depth[min(y + 1, height - 1)]
        for x in range(width):
            a, b, c = above[x], level[x], below[x]
            high[x + 1] = max(a, b, c)
            a, b, c = a if a > 0 else infinity, b if b > 0 else infinity, c if c > 0 else infinity
            low[x + 1] = min(a, b, c)
        for x in range(width):
            least, most = min(low[x], low[x + 1], low[x + 2]), max(high[x], high[x + 1], high[x + 2])
            nearer = least - max(slack * (most - least), rounding * least)
            limits[y, x] = nearer if most > 0 else infinity


@loop
def _project(first, last, used, vertices, m, view_depth, screen):
    """Fill `screen` (V, 3) with column and row, in pixels, and depth; the depth is −1 outside of near and far plane.

    Only the blocks `used[first:last]` of vertices are projected, by `m` (4, 4) to homogeneous pixels.
    """
    points, seen = np.empty((3, SIZE), np.float32), np.empty((3, SIZE), np.float32)
    for n in used[first:last]:
        block = slice(n * SIZE, min(len(vertices), (n + 1) * SIZE))
        read, written = vertices[block], screen[block]
        for v in range(len(read)):
            points[0, v], points[1, v], points[2, v] = read[v, 0], read[v, 1], read[v, 2]
        for v in range(len(read)):
            x, y, z = np.float64(points[0, v]), np.float64(points[1, v]), np.float64(points[2, v])
            depth = m[2, 0] * x + m[2, 1] * y + m[2, 2] * z + m[2, 3]
            w = m[3, 0] * x + m[3, 1] * y + m[3, 2] * z + m[3, 3]
            scale = 1 / w
            seen[0, v] = (m[0, 0] * x + m[0, 1] * y + m[0, 2] * z + m[0, 3]) * scale
            seen[1, v] = (m[1, 0] * x + m[1, 1] * y + m[1, 2] * z + m[1, 3]) * scale
            linear = view_depth[0] * x + view_depth[1] * y + view_depth[2] * z + view_depth[3]
            seen[2, v] = linear if (w > 0) & (depth >= -w) & (depth <= w) else -1.0
        for v in range(len(read)):
            written[v, 0], written[v, 1], written[v, 2] = seen[0, v], seen[1, v], seen[2, v]


@loop
def _pool(start, stop, limits, pooled):
    """Fill rows [start, stop) of `pooled` (H, W): the largest limit of a cell, and of those to the right and below."""
    height, width = limits.shape
    for y in range(start, stop):
        level, below = limits[y], limits[min(y + 1, height - 1)]
        for x in range(width - 1):
            pooled[y, x] = max(max(level[x], level[x + 1]), max(below[x], below[x + 1]))
        pooled[y, width - 1] = max(level[width - 1], below[width - 1])


@loop
def _list(first, last, blocks, faces, screen, keep, limits, pooled, listed, counts):
    """List the triangles that may be missed somewhere: in row c of `listed` those of chunk c, `counts` (chunks,) each.

    Chunks [first, last) of `blocks` are gone through. A triangle is left out if it faces the other way, and if in all
    cells of its box it is surely no nearer than the limit.
    """
    height, width = limits.shape
    corners, box, near = np.empty((9, SIZE), np.float32), np.empty((4, SIZE), np.int32), np.empty(SIZE, np.float32)
    seen, large, place = np.empty(SIZE, np.bool_), np.empty(SIZE, np.bool_), np.empty(SIZE, np.int32)
    chosen, highest = np.empty(SIZE, np.int32), pooled.ravel()
    sign, zero, one = np.float32(keep), np.float32(0), np.float32(1)
    right, bottom = np.float32(width - 1), np.float32(height - 1)
    for chunk in range(first, last):
        count = 0
        for n in range(chunk * PER_CHUNK, min(len(blocks), (chunk + 1) * PER_CHUNK)):
            start = blocks[n] * SIZE
            block = faces[start : min(len(faces), start + SIZE)]
            for b in range(len(block)):
                for c in range(3):
                    v = np.uint32(block[b, c])
                    corners[c, b], corners[3 + c, b], corners[6 + c, b] = screen[v, 0], screen[v, 1], screen[v, 2]
            for b in range(len(block)):
                xa, xb, xc = corners[0, b], corners[1, b], corners[2, b]
                ya, yb, yc = corners[3, b], corners[4, b], corners[5, b]
                area = ((xb - xa) * (yc - ya) - (xc - xa) * (yb - ya)) * (sign if sign != 0 else one)
                x0, x1 = max(np.floor(min(xa, xb, xc)), zero), min(np.ceil(max(xa, xb, xc)) - one, right)
                y0, y1 = max(np.floor(min(ya, yb, yc)), zero), min(np.ceil(max(ya, yb, yc)) - one, bottom)
                near[b] = min(corners[6, b], corners[7, b], corners[8, b])
                shown = ((area > 0) | ((sign == 0) & (area < 0))) & (near[b] > 0) & (x0 <= x1) & (y0 <= y1)
                x0, x1, y0, y1 = (x0, x1, y0, y1) if shown else (zero, zero, zero, zero)
                box[0, b], box[1, b], box[2, b], box[3, b] = x0, x1, y0, y1
                seen[b], large[b] = shown, (x1 - x0 > 1) | (y1 - y0 > 1)
            for b in range(len(block)):
                place[b] = box[2, b] * width + box[0, b]
            some = 0
            for b in range(len(block)):  # A branch would be mispredicted.
                chosen[some] = b
                some += seen[b] & (large[b] | (near[b] < highest[np.uint32(place[b])]))
            for b in chosen[:some]:
                listed[chunk, count] = start + b
                count += _may_miss(limits, corners[:, b], box[:, b])
        counts[chunk] = count


@compiled
def _may_miss(limits, corners, box):
    """True if a triangle may be nearer than the limit in some cell of its box (4,), ends included, or if that is large.

    `corners` (9,) are three columns, three rows and three depths.
    """
    i0, i1, j0, j1 = box[0], box[1], box[2], box[3]
    if (i1 - i0 + 1) * (j1 - j0 + 1) > BOX:
        return True
    half = np.float32(0.5)
    xa, ya, za = corners[0], corners[3], corners[6]
    x, y, z = corners[1] - xa, corners[4] - ya, corners[7] - za
    u, v, w = corners[2] - xa, corners[5] - ya, corners[8] - za
    area, near, far = x * v - u * y, min(za, za + z, za + w), max(za, za + z, za + w)
    along_x, along_y = (z * v - w * y) / area, (w * x - z * u) / area
    # Half a cell aside, and the most by which depths seen in perspective bend off a plane.
    reach = half * (abs(along_x) + abs(along_y)) + (far - near) * (far - near) / near
    for j in range(j0, j1 + 1):
        for i in range(i0, i1 + 1):
            least = za + along_x * (i + half - xa) + along_y * (j + half - ya) - reach
            if near < limits[j, i] and not least >= limits[j, i]:
                return True
    return False


@loop
def _mark(listed, counts, faces, vertices, matrix, view_depth, limits, missed):
    """Write the depths of listed triangles to the cells of `missed` (H, W) that they touch before the limit.

    Of several triangles the nearest stays. `listed` and `counts` are as `_list` fills them.
    """
    corners, points = np.empty((3, 4)), np.empty((3, 4))
    for chunk in range(len(counts)):
        for t in listed[chunk, : counts[chunk]]:
            for c in range(3):
                to_corner(matrix, vertices, faces[t, c], corners, c)
                scale = 1 / corners[c, 3]
                points[c, 0], points[c, 1], points[c, 2] = corners[c, 0] * scale, corners[c, 1] * scale, scale
                points[c, 3] = depth_of(view_depth, vertices, faces[t, c]) * scale
            _mark_rows(points, limits, missed)


@compiled
def _mark_rows(points, limits, missed):
    """Mark the cells that a triangle touches before the limit; see `_mark`.

    `points` (3, 4) are the corners' column, row, 1 / w and depth / w, of which the last two are linear on screen.
    """
    height, width = limits.shape
    top = max(int(np.floor(points[:, 1].min())), 0)
    bottom = min(int(np.ceil(points[:, 1].max())), height)
    ends, level = np.empty((2, 3)), np.empty((2, 3))
    for j in range(top, bottom):
        _clip(points, j, j + 1.0, ends)
        first, last = max(int(np.floor(ends[0, 0])), 0), min(int(np.ceil(ends[1, 0])), width)
        # Cells whose centre is covered are left out: those from `covered` to before `resumed`.
        _clip(points, j + 0.5, j + 0.5, level)
        covered, resumed = last, last
        if level[0, 0] < level[1, 0]:
            covered = max(int(np.ceil(level[0, 0] - 0.5)), first)
            resumed = max(int(np.floor(level[1, 0] - 0.5)) + 1, covered)
        i = resumed if covered == first else first
        while i < last:
            across = ends[1, 0] - ends[0, 0]
            s = min(max((i + 0.5 - ends[0, 0]) / across, 0.0), 1.0) if across > 0 else 0.0
            over_w, depth = (1 - s) * ends[0, 1] + s * ends[1, 1], (1 - s) * ends[0, 2] + s * ends[1, 2]
            depth = np.float32(depth / over_w)
            if depth < limits[j, i] and (missed[j, i] == 0 or depth < missed[j, i]):
                missed[j, i] = depth
            i = resumed if i + 1 == covered else i + 1


@compiled
def _clip(points, low, high, ends):
    """Fill `ends` (2, 3): column, 1 / w and depth / w of the leftmost and the rightmost point of a triangle in rows.

    The rows are [low, high]. The first column is infinite and the last −infinite where the triangle does not reach.
    """
    ends[0, 0], ends[1, 0] = np.inf, -np.inf
    for a in range(3):
        b = (a + 1) % 3
        ya, yb = points[a, 1], points[b, 1]
        if max(ya, yb) < low or min(ya, yb) > high:
            continue
        for side in range(2):
            s = 1.0 * side
            if ya != yb:
                s = min(max(((high if side else low) - ya) / (yb - ya), 0.0), 1.0)
            x = points[a, 0] + s * (points[b, 0] - points[a, 0])
            over_w = points[a, 2] + s * (points[b, 2] - points[a, 2])
            depth = points[a, 3] + s * (points[b, 3] - points[a, 3])
            if x < ends[0, 0]:
                ends[0, 0], ends[0, 1], ends[0, 2] = x, over_w, depth
            if x > ends[1, 0]:
                ends[1, 0], ends[1, 1], ends[1, 2] = x, over_w, depth
