"""Clusters of neighbouring triangles: a cluster out of view, or facing away, is skipped as a whole.

Clusters are built once, for a mesh that stays (`rts.prepare`). Triangles are sorted along a Morton curve through their
middles and by direction, and vertices by first use. Each cluster has a box, which bounds its positions, and a cone,
which bounds its normals.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rts.plugin_api.loops import compiled, loop
from rts.plugin_api.records import Proxy
from rts.plugin_api.threads import parallel, read_only

SIZE = 256
"""Triangles of a cluster, and vertices of a block; the last may have fewer."""

AROUND = 1e-9
"""Rounding error of a sum in float64, as a share of its terms: clusters this near to the view are kept."""

NOISE = 1e-13
"""Rounding error of the determinant of three corners, as a share of the product of the largest numbers in it."""

STEPS = np.float64(2**10 - 1)
"""The largest integer position on an axis of the Morton curve."""

COARSE = 2
"""Leading bits of the position on each axis that come first in a key; then the normal's octant, then the other bits."""


class Clusters(NamedTuple):
    """The triangles of a mesh, sorted into clusters.

    Attributes:
        vertices: (V, 3) float32, the vertices that triangles use, in the order of their first use.
        faces: (T, 3) int32, triangles in the order of clusters, SIZE in each.
        order: (T,) int32, the index of each triangle in the proxy.
        boxes: (6, C) float32, the least and the largest x, y and z of each cluster; infinite if some number is not
            finite.
        cones: (5, C) float64 of each cluster: a unit vector (x, y, z); the least cosine between it and a triangle's
            normal, below 0 if unknown; and the least length of (b − a) × (c − a) over triangles (a, b, c).
        offsets: (C + 1,) int64, where each cluster's blocks of vertices begin in `blocks`.
        blocks: int32, indices of the blocks of SIZE vertices that hold the corners of each cluster.
    """

    vertices: np.ndarray
    faces: np.ndarray
    order: np.ndarray
    boxes: np.ndarray
    cones: np.ndarray
    offsets: np.ndarray
    blocks: np.ndarray

    @classmethod
    def of(cls, proxy: Proxy) -> Clusters:
        """Sort a proxy's triangles into clusters."""
        vertices, faces = read_only(proxy.vertices, np.float32), read_only(proxy.faces, np.int32)
        count, clusters = len(faces), -(-len(faces) // SIZE)
        keys = np.empty(count, np.uint64)
        low, extent = _extent(vertices)
        parallel(_keys, count, vertices, faces, low, STEPS / extent, keys, work=10 * count)
        keys.sort()
        order = (keys & np.uint64(2**31 - 1)).astype(np.int32)
        made = np.empty((len(vertices), 3), np.float32), np.empty((count, 3), np.int32)
        used = _renumber(vertices, faces, order, *made)
        vertices, faces = made[0][:used].copy(), made[1]
        boxes, cones = np.empty((6, clusters), np.float32), np.empty((5, clusters))
        parallel(_bound, clusters, vertices, faces, boxes, cones, work=50 * count)
        offsets, blocks = np.zeros(clusters + 1, np.int64), np.empty(3 * count, np.int32)
        blocks = blocks[: _find_blocks(faces, np.full(-(-used // SIZE), -1), offsets, blocks)].copy()
        return cls(*map(read_only, (vertices, faces, order, boxes, cones, offsets, blocks)))

    def seen(self, matrix: np.ndarray, size: tuple[int, int], keep: float) -> tuple[np.ndarray, np.ndarray]:
        """Clusters and blocks of vertices that may be in view.

        Args:
            matrix: (4, 4) to homogeneous pixels, see `pixel_matrix`.
            size: (height, width).
            keep: sign of the determinants of requested triangles; 0 for all.

        Returns:
            Indices of clusters (N,) int32, and of the blocks of vertices that these use, int32.
        """
        height, width = size
        # Positions more than a pixel outside of the image cannot be rounded into it.
        sums = [[1, 0, 0, 1], [-1, 0, 0, width + 1], [0, 1, 0, 1], [0, -1, 0, height + 1], [0, 0, 1, 1], [0, 0, -1, 1]]
        planes, rows = np.array(sums) @ matrix, matrix[[0, 1, 3]]
        kept, used = np.empty(self.boxes.shape[1], np.int32), np.empty(-(-len(self.vertices) // SIZE), np.int32)
        kept = kept[: _find(self.boxes, self.cones, planes, rows, keep, kept)]
        return kept, used[: _use(kept, self.offsets, self.blocks, used)]


@loop
def _extent(vertices):
    """The least x, y and z (3,) of vertices, and their largest extent along an axis, at least 1e-30.

    Numbers that are not finite are left out.
    """
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    for v in range(len(vertices)):
        for r in range(3):
            x = np.float64(vertices[v, r])
            if np.isfinite(x):
                low[r], high[r] = min(low[r], x), max(high[r], x)
    return low, max((high - low).max(), 1e-30)


@loop
def _keys(start, stop, vertices, faces, low, scale, keys):
    """Fill `keys` of triangles [start, stop), all different: 33 bits of position and octant, then 31 of the index."""
    for t in range(start, stop):
        key = np.uint64(0)
        for r in range(3):
            x, y, z = vertices[faces[t, 0], r], vertices[faces[t, 1], r], vertices[faces[t, 2], r]
            place = ((np.float64(x) + y + z) / 3 - low[r]) * scale
            bits = np.uint64(min(place, STEPS) if place > 0 else 0.0)  # NaN comes first.
            bits = (bits | bits << np.uint64(16)) & np.uint64(0x030000FF)
            bits = (bits | bits << np.uint64(8)) & np.uint64(0x0300F00F)
            bits = (bits | bits << np.uint64(4)) & np.uint64(0x030C30C3)
            bits = (bits | bits << np.uint64(2)) & np.uint64(0x09249249)
            key |= bits << np.uint64(r)
        eighth, fine = np.uint64(0), np.uint64(30 - 3 * COARSE)
        for r in range(3):
            eighth |= np.uint64(_normal(vertices, faces[t, 0], faces[t, 1], faces[t, 2], r) > 0) << np.uint64(r)
        key = ((key >> fine) << np.uint64(3) | eighth) << fine | key & ((np.uint64(1) << fine) - np.uint64(1))
        keys[t] = key << np.uint64(31) | np.uint64(t)


@loop
def _renumber(vertices, faces, order, new_vertices, new_faces):
    """Fill `new_faces` with triangles as `order` lists them, `new_vertices` with vertices by first use.

    Returns the number of vertices used.
    """
    numbers, count = np.full(len(vertices), -1, np.int32), 0
    for t in range(len(order)):
        for c in range(3):
            v = faces[order[t], c]
            if numbers[v] < 0:
                numbers[v] = count
                for r in range(3):
                    new_vertices[count, r] = vertices[v, r]
                count += 1
            new_faces[t, c] = numbers[v]
    return count


@loop
def _find_blocks(faces, last, offsets, blocks):
    """Fill `blocks` with the blocks of vertices of each cluster, `offsets[1:]` with where each cluster's end.

    `last` holds, for each block of vertices, the latest cluster that uses it: −1 at first. Returns the length of
    `blocks` that is filled.
    """
    count = 0
    for t in range(len(faces)):
        cluster = t // SIZE
        for c in range(3):
            block = faces[t, c] // SIZE
            if last[block] != cluster:
                last[block] = cluster
                blocks[count] = block
                count += 1
        offsets[cluster + 1] = count
    return count


@loop
def _bound(start, stop, vertices, faces, boxes, cones):
    """Fill `boxes` (6, C) and `cones` (5, C) of clusters [start, stop), see `Clusters`."""
    normals = np.empty((SIZE, 3))
    for cluster in range(start, stop):
        block = faces[cluster * SIZE : (cluster + 1) * SIZE]
        known, count, least = True, 0, np.inf
        for r in range(3):
            low, high = np.float32(np.inf), np.float32(-np.inf)
            for b in range(len(block)):
                for c in range(3):
                    x = vertices[block[b, c], r]
                    known &= np.isfinite(x)
                    low, high = min(low, x), max(high, x)
            boxes[r, cluster], boxes[3 + r, cluster] = low, high
        axis = np.zeros(3)
        for b in range(len(block)):
            i, j, k = block[b, 0], block[b, 1], block[b, 2]
            if _same(vertices, i, j) or _same(vertices, j, k) or _same(vertices, k, i):
                continue  # Two corners coincide: an edge function is 0 everywhere, and the triangle covers nothing.
            normal = normals[count]
            for r in range(3):
                normal[r] = _normal(vertices, i, j, k, r)
            length = np.sqrt(normal[0] ** 2 + normal[1] ** 2 + normal[2] ** 2)
            least = min(least, length)
            for r in range(3):
                normal[r] /= length
                axis[r] += normal[r]
            count += 1
        axis /= np.sqrt(axis[0] ** 2 + axis[1] ** 2 + axis[2] ** 2)
        cosine = 1.0
        for n in range(count):
            cosine = min(cosine, normals[n, 0] * axis[0] + normals[n, 1] * axis[1] + normals[n, 2] * axis[2])
        if not (known and cosine > 0 and least > 0 and least < np.inf):
            axis[:], cosine = 0.0, -1.0
        if not known:
            boxes[:3, cluster], boxes[3:, cluster] = -np.inf, np.inf
        cones[:3, cluster], cones[3, cluster], cones[4, cluster] = axis, cosine, least


@compiled
def _normal(vertices, i, j, k, r):
    """Component r of (b − a) × (c − a) of corners a, b, c."""
    p, q = (r + 1) % 3, (r + 2) % 3
    x, y = np.float64(vertices[i, p]), np.float64(vertices[i, q])
    return (vertices[j, p] - x) * (vertices[k, q] - y) - (vertices[j, q] - y) * (vertices[k, p] - x)


@compiled
def _same(vertices, i, j):
    return vertices[i, 0] == vertices[j, 0] and vertices[i, 1] == vertices[j, 1] and vertices[i, 2] == vertices[j, 2]


@loop
def _find(boxes, cones, planes, rows, keep, kept):
    """Find clusters in view that may hold requested triangles. Returns their number.

    Args:
        boxes: see `Clusters`.
        cones: see `Clusters`.
        planes: (6, 4) half-spaces p · (x, y, z, 1) ≥ 0 that the view lies in.
        rows: (3, 4) to homogeneous pixels (x, y, w).
        keep: sign of the determinants of requested triangles; 0 for all.
        kept: (C,) int32, to be filled with the indices of the clusters, from the start.
    """
    # A triangle's determinant is n · (q + s a), for its corner a and n = (b − a) × (c − a); q and s are minors.
    q0, q1, q2, s = _minor(rows, 1, 2, 3), _minor(rows, 2, 0, 3), _minor(rows, 0, 1, 3), _minor(rows, 0, 1, 2)
    seen, count = np.empty(len(kept), np.bool_), 0
    _test(boxes, cones, planes, (keep * q0, keep * q1, keep * q2, keep * s), np.abs(rows), seen)
    for cluster in range(len(seen)):
        kept[count] = cluster
        count += seen[cluster]
    return count


@compiled
def _minor(rows, i, j, k):
    a, b, c = rows[0], rows[1], rows[2]
    return a[i] * (b[j] * c[k] - b[k] * c[j]) + a[j] * (b[k] * c[i] - b[i] * c[k]) + a[k] * (b[i] * c[j] - b[j] * c[i])


@compiled(inline="always")
def _test(boxes, cones, planes, towards, rows, seen):
    """Fill `seen` (C,): False for clusters out of view, and for those none of whose triangles is requested.

    `towards` are q (three numbers) and s, times `keep`: a triangle's determinant is n · (q + s a), for its corner a and
    normal n. `rows` (3, 4) are absolute values.
    """
    qx, qy, qz, s = towards
    for cluster in range(len(seen)):
        x0, y0, z0 = np.float64(boxes[0, cluster]), np.float64(boxes[1, cluster]), np.float64(boxes[2, cluster])
        x1, y1, z1 = np.float64(boxes[3, cluster]), np.float64(boxes[4, cluster]), np.float64(boxes[5, cluster])
        x, y, z, dx, dy, dz = (x0 + x1) / 2, (y0 + y1) / 2, (z0 + z1) / 2, (x1 - x0) / 2, (y1 - y0) / 2, (z1 - z0) / 2
        mx, my, mz = max(-x0, x1), max(-y0, y1), max(-z0, z1)
        out = False
        for p in range(6):
            a, b, c, d = planes[p, 0], planes[p, 1], planes[p, 2], planes[p, 3]
            most = a * x + b * y + c * z + d + (abs(a) * dx + abs(b) * dy + abs(c) * dz)
            out |= most < -AROUND * (abs(a) * mx + abs(b) * my + abs(c) * mz + abs(d))
        noise = NOISE
        for r in range(3):
            noise *= rows[r, 0] * mx + rows[r, 1] * my + rows[r, 2] * mz + rows[r, 3]
        gx, gy, gz = qx + s * x, qy + s * y, qz + s * z
        along = cones[0, cluster] * gx + cones[1, cluster] * gy + cones[2, cluster] * gz
        across = np.sqrt(max(gx * gx + gy * gy + gz * gz - along * along, 0.0))
        cosine, least = cones[3, cluster], cones[4, cluster]
        spread = across * np.sqrt(1 - cosine * cosine + AROUND) + abs(s) * np.sqrt(dx * dx + dy * dy + dz * dz)
        # For the normal farthest from the cone's axis.
        sure = (abs(along) * cosine - spread) * least > noise
        seen[cluster] = ~out & ~(sure & (along <= 0))


@loop
def _use(kept, offsets, blocks, used):
    """Fill the head of `used` with the blocks of vertices that the clusters `kept` use. Returns the number of these.

    `offsets` and `blocks` are those of `Clusters`; `used` has room for all blocks.
    """
    every = len(kept) == len(offsets) - 1
    marks = np.full(len(used), every)
    if not every:
        for cluster in kept:
            for n in range(offsets[cluster], offsets[cluster + 1]):
                marks[blocks[n]] = True
    count = 0
    for block in range(len(used)):
        used[count] = block
        count += marks[block]
    return count
