"""Covers: larger triangles that Embree intersects in place of the mesh's, so that no hit is lost to float32.

Embree intersects in float32. Where a ray passes an edge by less than float32 resolves, Embree may report a hit or a
miss. So each triangle is covered by one whose edges lie `LEAST` or more farther out. Where a ray hits a cover, a test
in float64 decides whether it hits the triangle. All lengths are in units of the object's bounding sphere, in which
float32 resolves about 1e-7.

A triangle that is very thin, or very small, has no larger one of its shape. It is covered by two long ones that cross
along its longest edge, and, if it is small, by a third across, so that one of them faces any ray.
"""

from __future__ import annotations

from typing import NamedTuple, Self

import numpy as np

from rts.plugin_api.loops import compiled, loop
from rts.plugin_api.threads import parallel

LEAST, MOST = 2e-6, 2e-5
"""Limits of the distance by which edges move out; in between, a two-hundredth of the inscribed circle's radius."""

SMALL = 100 * LEAST
"""A thin triangle has a third cover if its longest edge is shorter than this."""

NEVER = 255
"""The margin of triangles whose hits are always decided in float64."""


class Covers(NamedTuple):
    """M covers of a proxy's T triangles: first one for each, then further ones for thin and small triangles.

    Further covers that are not needed, once vertices have moved, are points.

    Attributes:
        corners: (3 M + 1, 3) float32, three for each cover; the last row is padding, since Embree reads 16 bytes each.
        faces: (M, 3) int32: 0, 1, 2; 3, 4, 5; and so on.
        owners: (M,) int32, the index of the triangle that each covers.
        margins: (T,) uint8, in thousandths. A ray that meets a triangle's first cover with all barycentrics above its
            margin surely meets the triangle; `NEVER` if no ray surely does.
    """

    corners: np.ndarray
    faces: np.ndarray
    owners: np.ndarray
    margins: np.ndarray

    @classmethod
    def of(cls, vertices: np.ndarray, faces: np.ndarray, sphere: np.ndarray) -> Self:
        """Covers of a proxy's triangles.

        Args:
            vertices: (V, 3) float32.
            faces: (T, 3) int32.
            sphere: (4,) centre and radius of the object's bounding sphere.
        """
        wanted = np.empty(len(faces), np.uint8)
        parallel(_count, len(faces), vertices, faces, sphere, wanted, work=60 * len(faces))
        count = len(faces) + int(wanted.sum(dtype=np.int64))
        numbers = np.arange(3 * count, dtype=np.int32).reshape(-1, 3)
        covers = cls(np.zeros((3 * count + 1, 3), np.float32), numbers, numbers[:, 0] // 3, np.empty_like(wanted))
        covers._fill(vertices, faces, sphere, wanted)
        return covers

    def follow(self, vertices: np.ndarray, faces: np.ndarray, sphere: np.ndarray) -> bool:
        """Cover the triangles of moved vertices, in place; False, with no change, if they need more covers."""
        wanted = np.empty(len(faces), np.uint8)
        parallel(_count, len(faces), vertices, faces, sphere, wanted, work=60 * len(faces))
        if len(faces) + int(wanted.sum(dtype=np.int64)) > len(self.faces):
            return False
        self._fill(vertices, faces, sphere, wanted)
        return True

    def _fill(self, vertices: np.ndarray, faces: np.ndarray, sphere: np.ndarray, wanted: np.ndarray) -> None:
        # Covers that are not needed are points.
        self.corners[3 * len(faces) :] = 0
        self.owners[len(faces) :] = 0
        places = len(faces) + np.cumsum(wanted, dtype=np.int64) - wanted
        parallel(_cover, len(faces), vertices, faces, sphere, wanted, places, self, work=100 * len(faces))


@compiled
def _shape(vertices, faces, t, sphere, points):
    """Fill `points` (3, 3) with the corners of triangle t, in units of the sphere and about its centre.

    Returns the lengths of the edges, each opposite its corner, and twice the triangle's area: four numbers.
    """
    for c in range(3):
        for r in range(3):
            points[c, r] = (np.float64(vertices[faces[t, c], r]) - sphere[r]) / sphere[3]
    ux, uy, uz = points[1, 0] - points[0, 0], points[1, 1] - points[0, 1], points[1, 2] - points[0, 2]
    vx, vy, vz = points[2, 0] - points[0, 0], points[2, 1] - points[0, 1], points[2, 2] - points[0, 2]
    nx, ny, nz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
    wx, wy, wz = vx - ux, vy - uy, vz - uz
    a, b = np.sqrt(wx * wx + wy * wy + wz * wz), np.sqrt(vx * vx + vy * vy + vz * vz)
    return a, b, np.sqrt(ux * ux + uy * uy + uz * uz), np.sqrt(nx * nx + ny * ny + nz * nz)


@loop
def _count(start, stop, vertices, faces, sphere, wanted):
    """Fill `wanted` with the number of further covers that each triangle needs: 0, 1 or 2."""
    points = np.empty((3, 3))
    for t in range(start, stop):
        a, b, c, area = _shape(vertices, faces, t, sphere, points)
        wanted[t] = 0
        if not area > 10 * LEAST * (a + b + c):
            wanted[t] = 2 if max(a, b, c) < SMALL else 1


@loop
def _cover(start, stop, vertices, faces, sphere, wanted, places, covers):
    """Fill the corners, owners and margins of the covers of triangles [start, stop).

    `places` (T,) are the indices of the first further covers.
    """
    corners, owners, margins = covers.corners, covers.owners, covers.margins
    points, along, side, across = np.empty((3, 3)), np.empty(3), np.empty(3), np.empty(3)
    for t in range(start, stop):
        a, b, c, area = _shape(vertices, faces, t, sphere, points)
        round_about = a + b + c
        if wanted[t] == 0:
            radius = area / round_about
            out = min(max(radius / 200, LEAST), MOST)
            # Larger by `out` on all sides, about the centre of the inscribed circle.
            factor = 1 + out / radius
            for r in range(3):
                center = (a * points[0, r] + b * points[1, r] + c * points[2, r]) / round_about
                for i in range(3):
                    corners[3 * t + i, r] = center + factor * (points[i, r] - center)
            # Three times that far inside the triangle; a barycentric is a distance over a height.
            margin = 4 * out * max(a, b, c) / (area * factor)
            margins[t] = np.uint8(min(np.ceil(1000 * margin), NEVER))
            continue
        margins[t] = NEVER
        first = 1 if a >= max(b, c) else (2 if b >= c else 0)
        p, q, s = first, (first + 1) % 3, (first + 2) % 3
        longest = max(a, b, c)
        height = area / longest if longest > 0 else 0.0
        for r in range(3):
            along[r] = (points[q, r] - points[p, r]) / longest if longest > 0 else np.float64(r == 0)
        _perpendicular(points, p, s, along, height, side)
        across[0] = along[1] * side[2] - along[2] * side[1]
        across[1] = along[2] * side[0] - along[0] * side[2]
        across[2] = along[0] * side[1] - along[1] * side[0]
        _ribbon(corners[3 * t : 3 * t + 3], points[p], along, side, longest, height)
        at = places[t]
        _ribbon(corners[3 * at : 3 * at + 3], points[p], along, across, longest, height)
        owners[at] = t
        if wanted[t] == 2:
            at += 1
            owners[at] = t
            wide = 4 * (height + LEAST)
            for r in range(3):
                corners[3 * at, r] = points[p, r] + wide * side[r]
                corners[3 * at + 1, r] = points[p, r] + wide * (0.9 * across[r] - 0.5 * side[r])
                corners[3 * at + 2, r] = points[p, r] - wide * (0.9 * across[r] + 0.5 * side[r])


@compiled
def _perpendicular(points, p, s, along, height, side):
    """Fill `side` (3,) with a unit vector perpendicular to `along` (3,), in the triangle's plane if it has one.

    `along` is the unit direction of an edge that begins at corner p of `points` (3, 3). Corner s lies opposite, at the
    distance `height` from the edge.
    """
    if height > 1e-12:
        dot = 0.0
        for r in range(3):
            dot += (points[s, r] - points[p, r]) * along[r]
        for r in range(3):
            side[r] = points[s, r] - points[p, r] - dot * along[r]
    else:
        least = 0
        for r in range(1, 3):
            least = r if abs(along[r]) < abs(along[least]) else least
        for r in range(3):
            side[r] = np.float64(r == least) - along[least] * along[r]
    length = np.sqrt(side[0] * side[0] + side[1] * side[1] + side[2] * side[2])
    for r in range(3):
        side[r] /= length


@compiled
def _ribbon(corners, start, along, side, length, height):
    """Fill `corners` (3, 3) with a long triangle around a segment, in the plane of `along` and `side`, unit vectors.

    The segment leads from `start` along `along`, `length` far. The triangle reaches more than `height` to either side
    of it; at the segment's end it is about half as wide as at its start.
    """
    wide = 2 * (height + 2 * LEAST)
    for r in range(3):
        corners[0, r] = start[r] - 2 * LEAST * along[r] - wide * side[r]
        corners[1, r] = start[r] - 2 * LEAST * along[r] + wide * side[r]
        corners[2, r] = start[r] + (2 * length + 6 * LEAST) * along[r]
