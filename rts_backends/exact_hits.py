"""Hits of a rasterizer that rounds vertices, made exact: each goes to the triangle that truly covers the pixel.

A hit for which no such triangle is found nearby is dropped.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rts.plugin_api.loops import compiled, loop
from rts_backends.triangles import clipped, depth_of, determinant, edge_values, to_corner


class SeenTriangles(NamedTuple):
    """Triangles as a camera sees them, and those around each corner.

    Attributes:
        matrix: (4, 4), see `pixel_matrix`.
        row: (4,), see `depth_of`.
        keep: see `Camera.kept_sign`.
        vertices: (V, 3) float32.
        faces: (T, 3) int32.
        around: (T, 3) int32, the result of `places`.
        offsets: (V + 1,) int32, of `corner_lists` of `around`.
        members: (3 T,) int32, also.
    """

    matrix: np.ndarray
    row: np.ndarray
    keep: float
    vertices: np.ndarray
    faces: np.ndarray
    around: np.ndarray
    offsets: np.ndarray
    members: np.ndarray


WALK = 16
"""The most steps from triangle to triangle, in search of one that covers the pixel's centre."""


@loop
def corner_lists(faces, count):
    """Offsets (V + 1,) and members (3 T,): `members[offsets[v] : offsets[v + 1]]` are the triangles around vertex v.

    `count` is V.
    """
    offsets = np.zeros(count + 1, np.int32)
    for t in range(len(faces)):
        for c in range(3):
            offsets[faces[t, c] + 1] += 1
    for v in range(count):
        offsets[v + 1] += offsets[v]
    members, filled = np.empty(3 * len(faces), np.int32), offsets[:-1].copy()
    for t in range(len(faces)):
        for c in range(3):
            v = faces[t, c]
            members[filled[v]] = t
            filled[v] += 1
    return offsets, members


@loop
def places(vertices, faces):
    """A copy of `faces` (T, 3) with vertices at one position replaced by the first, so that triangles there connect."""
    size = 4
    while size < 2 * len(vertices):
        size *= 2
    table, first = np.full(size, -1, np.int32), np.empty(len(vertices), np.int32)
    bits = (vertices + np.float32(0)).view(np.uint32)  # So that −0 is 0.
    for v in range(len(vertices)):
        mixed = np.uint64(bits[v, 0]) * np.uint64(0x9E3779B185EBCA87)
        mixed = (mixed ^ (mixed >> np.uint64(29)) ^ np.uint64(bits[v, 1])) * np.uint64(0xC2B2AE3D27D4EB4F)
        mixed = (mixed ^ (mixed >> np.uint64(31)) ^ np.uint64(bits[v, 2])) * np.uint64(0x165667B19E3779F9)
        slot = np.int64((mixed ^ (mixed >> np.uint64(32))) & np.uint64(size - 1))
        while True:
            w = table[slot]
            if w < 0:
                table[slot] = first[v] = v
                break
            if bits[w, 0] == bits[v, 0] and bits[w, 1] == bits[v, 1] and bits[w, 2] == bits[v, 2]:
                first[v] = w
                break
            slot = (slot + 1) & (size - 1)
    found = np.empty_like(faces)
    for t in range(len(faces)):
        for c in range(3):
            found[t, c] = first[faces[t, c]]
    return found


@compiled
def look(t, x, y, matrix, row, keep, vertices, faces, corners):
    """Test triangle `t` at a pixel position: True if it covers it; least barycentric, depth, first two barycentrics.

    If the triangle is culled or has no area, or lies behind the eye or is clipped there, the least barycentric is −∞
    and the rest is 0. `matrix` is that of `pixel_matrix`, `row` that of `depth_of`, `keep` that of `Camera.kept_sign`;
    `corners` (3, 4) is working memory.
    """
    ia, ib, ic = faces[t, 0], faces[t, 1], faces[t, 2]
    to_corner(matrix, vertices, ia, corners, 0)
    to_corner(matrix, vertices, ib, corners, 1)
    to_corner(matrix, vertices, ic, corners, 2)
    area = determinant(corners, 0, 1, 2)
    if not (area * keep > 0 or (keep == 0 and area != 0)):
        return False, -np.inf, 0.0, 0.0, 0.0
    ea, eb, ec, inside = edge_values(corners, 0, 1, 2, x, y)
    total = ea + eb + ec
    if not total > 0 or clipped(corners, 0, 1, 2, ea, eb, ec):
        return False, -np.inf, 0.0, 0.0, 0.0
    za, zb, zc = depth_of(row, vertices, ia), depth_of(row, vertices, ib), depth_of(row, vertices, ic)
    z = (ea * za + eb * zb + ec * zc) / total
    return inside, min(ea, eb, ec) / total, z, ea / total, eb / total


@compiled
def holds(triangles, count, t):
    """True if triangle `t` is among the first `count` of `triangles`."""
    same = False
    for n in range(count):
        same |= triangles[n] == t
    return same


@compiled
def _walk(t, x, y, hits, count, seen, corners):
    """Go from triangle `t` to its neighbours, towards one that covers a pixel and is not among the first `count` hits.

    Neighbours share a corner. If `t` itself covers the pixel, it is the last triangle, even if it is among the hits.
    Returns True if the last triangle covers the pixel, this triangle, its depth and its first two barycentrics.
    """
    matrix, row, keep, vertices, faces, around, offsets, members = seen
    inside, least, z, a, b = look(t, x, y, matrix, row, keep, vertices, faces, corners)
    for _ in range(WALK):
        if inside:
            break
        # The best of the triangles around this one; none better means that the surface ends here.
        best, best_least, best_z, best_a, best_b, best_inside = t, least, z, a, b, False
        for c in range(3):
            v = around[t, c]
            for at in range(offsets[v], offsets[v + 1]):
                s = members[at]
                inside_s, least_s, z_s, a_s, b_s = look(s, x, y, matrix, row, keep, vertices, faces, corners)
                # Triangles among the hits have hits of their own; so coplanar layers all stay.
                if holds(hits, count, s):
                    inside_s, least_s = False, -np.inf
                if (inside_s and not best_inside) or (inside_s == best_inside and least_s > best_least):
                    best, best_least, best_z = s, least_s, z_s
                    best_a, best_b, best_inside = a_s, b_s, inside_s
        if best == t:
            break
        t, least, z, a, b, inside = best, best_least, best_z, best_a, best_b, best_inside
    return inside, t, z, a, b


@loop
def correct(first, last, seen, fragments):
    """Correct the hits of pixel rows [first, last): fill barycentrics and depths, correct ids, drop those that miss.

    The ids of `fragments` (K, H, W) are changed in place; each pixel's hits are sorted by depth, then by index, and
    empty layers follow. Hits behind an empty layer are dropped.
    """
    triangle_ids, barycentrics, depths = fragments
    layers, _, width = triangle_ids.shape
    corners = np.empty((3, 4))
    hits, hit_depths, hit_params = np.empty(layers, np.int32), np.empty(layers), np.empty((layers, 2))
    for j in range(first, last):
        for i in range(width):
            count = 0
            for k in range(layers):
                t = triangle_ids[k, j, i]
                if t < 0:
                    break
                inside, t, z, a, b = _walk(t, i + 0.5, j + 0.5, hits, count, seen, corners)
                if not inside or holds(hits, count, t):
                    continue
                at = count
                while at > 0 and (z < hit_depths[at - 1] or (z == hit_depths[at - 1] and t < hits[at - 1])):
                    hits[at], hit_depths[at], hit_params[at] = hits[at - 1], hit_depths[at - 1], hit_params[at - 1]
                    at -= 1
                hits[at], hit_depths[at], hit_params[at, 0], hit_params[at, 1] = t, z, a, b
                count += 1
            for k in range(layers):
                triangle_ids[k, j, i] = hits[k] if k < count else -1
                depths[k, j, i] = hit_depths[k] if k < count else 0
                barycentrics[k, j, i, 0] = hit_params[k, 0] if k < count else 0
                barycentrics[k, j, i, 1] = hit_params[k, 1] if k < count else 0
