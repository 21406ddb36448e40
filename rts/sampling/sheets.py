"""The triangles of a part as a camera sees them: sheets that join samples, and what lies where on them."""

from __future__ import annotations

import weakref
from typing import NamedTuple

import numpy as np

from rts.compiling.threads import parallel
from rts.contracts.records import Fragments, Proxy
from rts.sampling.points import kept_sign, near_and_far, pixel_rows
from rts.scene.camera import Camera


class Sheets(NamedTuple):
    """A part's triangles as a camera sees them.

    Attributes:
        vertices: (V, 3) float32.
        faces: (T, 3) int32.
        beyond: (T, 3) int32, the triangle beyond the edge opposite each corner; −1 where none or several share it.
        rows: (4, 4), see `Camera.pixel_rows`.
        clip: (2, 4) near and far plane, positive on what is seen.
        keep: sign of the determinants on screen of triangles to keep; 0 for both.
    """

    vertices: np.ndarray
    faces: np.ndarray
    beyond: np.ndarray
    rows: np.ndarray
    clip: np.ndarray
    keep: float

    @classmethod
    def of(cls, proxy: Proxy, camera: Camera, size: tuple[int, int], cull: str) -> Sheets:
        """The sheets of a proxy; `camera` holds host matrices, in its space, for images of `size`."""
        tables = np.ascontiguousarray(proxy.vertices, np.float32), np.ascontiguousarray(proxy.faces, np.int32)
        seen = pixel_rows(camera, size), near_and_far(camera), kept_sign(camera, cull)
        return cls(*tables, _beyond(proxy.faces), *seen)

    def join(self, own: int, part: np.ndarray, triangle: np.ndarray, depth: np.ndarray, joined: np.ndarray) -> None:
        """Mark, in `joined` (2, H, W), the centres whose fronts, of the part `own`, a sheet joins to the next ones'.

        `part`, `triangle` and `depth` (H, W) tell what is seen at each centre.
        """
        from rts.sampling import sheets_loops

        mesh, height = (self.rows, self.vertices, self.faces, self.beyond), len(part)
        arguments = part, triangle, depth, own, *mesh, self.keep != 0, joined
        parallel(sheets_loops.seams, height, *arguments, work=20 * part.size)

    def spans(self, number: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The triangles' spans on gaps, whose numbers stand in `number` (2, H, W): see `spans_loops.spans_of`."""
        from rts.sampling import spans_loops

        seen, near = np.empty((len(self.vertices), 2), np.float32), np.empty(len(self.faces), np.bool_)
        parallel(spans_loops.projected, len(seen), self.vertices, self.rows, seen, work=10 * len(seen))
        parallel(spans_loops.near_gaps, len(near), self.faces, seen, self.keep, number, near, work=20 * len(near))
        mesh = self.rows, self.vertices, self.faces, self.clip, self.keep
        return spans_loops.spans_of(np.flatnonzero(near), *mesh, number)

    def at(self, triangle: np.ndarray, points: np.ndarray) -> tuple[Fragments, np.ndarray]:
        """Fragments (1, 1, M) of triangles (M,) at points (M, 2); slopes (M, 2) of depth along x and y, a cell."""
        from rts.sampling import sheets_loops

        count = len(triangle)
        weights, depth, slopes = np.empty((count, 2)), np.empty(count), np.empty((count, 2))
        arguments = triangle, points, self.rows, self.vertices, self.faces, weights, depth, slopes
        parallel(sheets_loops.on_planes, count, *arguments, work=100 * count)
        weights, depth = weights.astype(np.float32), depth.astype(np.float32)
        return Fragments(triangle[None, None], weights[None, None], depth[None, None]), slopes


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
