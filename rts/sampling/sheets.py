"""Sheets of a part's triangles in the image: do two samples lie on one sheet, and where does it end?"""

from __future__ import annotations

import weakref
from typing import NamedTuple

import numpy as np

from rts.compiling.threads import parallel
from rts.contracts.records import Proxy
from rts.sampling.points import pixel_rows
from rts.scene.camera import Camera


class Walk(NamedTuple):
    """Walks on sheets along M lines of the image.

    Attributes:
        reached: (M,) the share of each line that lies on the sheet; 1 if the walk came to the end.
        depth: (M,) depth of the sheet where the walk stops.
        triangle: (M,) int32, the last triangle; −1 for a walk that has no first one.
    """

    reached: np.ndarray
    depth: np.ndarray
    triangle: np.ndarray


class Sheets(NamedTuple):
    """A part's triangles as a camera sees them.

    Attributes:
        vertices: (V, 3) float32.
        faces: (T, 3) int32.
        beyond: (T, 3) int32, the triangle beyond the edge opposite each corner; −1 where none or several share it.
        rows: (4, 4), see `Camera.pixel_rows`.
    """

    vertices: np.ndarray
    faces: np.ndarray
    beyond: np.ndarray
    rows: np.ndarray

    @classmethod
    def of(cls, proxy: Proxy, camera: Camera, size: tuple[int, int]) -> Sheets:
        """The sheets of a proxy; `camera` holds host matrices, in its space, for images of `size`."""
        vertices = np.ascontiguousarray(proxy.vertices, np.float32)
        return cls(
            vertices, np.ascontiguousarray(proxy.faces, np.int32), _beyond(proxy.faces), pixel_rows(camera, size)
        )

    def walk(self, triangle: np.ndarray, start: np.ndarray, end: np.ndarray) -> Walk:
        """Walks along lines from `start` (M, 2) to `end` (M, 2), each from the triangle (M,) that its start lies on."""
        from rts.sampling import sheets_loops

        count = len(triangle)
        found = Walk(np.empty(count), np.empty(count), np.empty(count, np.int32))
        lines = np.ascontiguousarray(triangle, np.int32), np.ascontiguousarray(start), np.ascontiguousarray(end)
        mesh = self.rows, self.vertices, self.faces, self.beyond
        parallel(sheets_loops.walk, count, *lines, *mesh, *found, work=500 * count)
        return found

    def touch(self, one: np.ndarray, other: np.ndarray) -> np.ndarray:
        """(M,) True for pairs of triangles that have a corner in common."""
        return (self.faces[one][:, :, None] == self.faces[other][:, None, :]).any(axis=(1, 2))

    def planes(self, triangle: np.ndarray, points: np.ndarray) -> np.ndarray:
        """(M, 3) depths of triangles' planes at points (M, 2), and their slopes along x and y, a cell."""
        from rts.sampling import sheets_loops

        found = np.empty((len(points), 3))
        arguments = np.ascontiguousarray(triangle, np.int32), np.ascontiguousarray(points), self.rows, self.vertices
        parallel(sheets_loops.planes, len(points), *arguments, self.faces, found, work=100 * len(points))
        return found


_known: dict[int, tuple[weakref.ref, np.ndarray]] = {}


def _beyond(faces: np.ndarray) -> np.ndarray:
    """`Sheets.beyond`; that of a read-only table that owns its memory is kept as long as the table."""
    from rts.sampling import sheets_loops

    kept, key = not faces.flags.writeable and faces.flags.owndata, id(faces)
    if kept and key in _known and _known[key][0]() is faces:
        return _known[key][1]
    table = np.ascontiguousarray(faces, np.int32)
    edges = np.sort(table[:, [[1, 2], [2, 0], [0, 1]]].reshape(-1, 2), axis=1)
    order = np.lexsort((edges[:, 1], edges[:, 0]))
    found = sheets_loops.neighbours(table, order)
    if kept:
        _known[key] = weakref.ref(faces, lambda _: _known.pop(key, None)), found
    return found
