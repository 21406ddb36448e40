"""The triangles of a part as a camera sees them: patches that join samples, and what lies where on them."""

from __future__ import annotations

import itertools
import operator
import weakref
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from rts.compiling.threads import parallel, read_only
from rts.contracts.records import Fragments, Proxy
from rts.outlines import seen_mesh_loops, silhouettes_loops, spans_loops
from rts.outlines.gaps import Gaps, Hits
from rts.sampling.packing_loops import in_one
from rts.sampling.points import near_and_far, pixel_rows
from rts.scene.camera import Camera


class SeenMesh(NamedTuple):
    """The triangles of a part, or of neighbouring parts, as a camera sees them.

    Attributes:
        first: the index of the first part.
        starts: (P + 1,) int32, where the triangles of each part begin.
        vertices: (V, 3) float32, or float64 of joint parts.
        faces: (T, 3) int32.
        adjacent: (T, 3) int32, the triangle beyond the edge opposite each corner; −1 where none or several share it,
            and at seams, if they are wanted.
        rows: (4, 4), see `Camera.pixel_rows`.
        clip: (2, 4) near and far plane, positive on what is seen.
        keep: (T,) int8, the sign of the determinants on screen of triangles that are kept; 0 for both.
        seen: (V, 2) float32, where vertices lie in the image, in cells; NaN for those behind the camera.
        sides: (T + 1,) int8, which side of triangles is seen, and 0; see `silhouettes_loops.turns`.
        on_lines: (T,) int32, for each block of triangles, from its first place on, those that may meet a line of
            centres, in order, but for those that are seen edge-on or not kept; any numbers at its other places.
        lines: (T,) int8, at these places the lines that they may meet: 1 for those along x, 2 along y, 3 for both.
        cells: (T,) int32, at these places the (flat) cells of the upper left corners of their boxes.
        counts: (blocks,) int32, how many each block has; see `silhouettes_loops.BLOCK`.
    """

    first: int
    starts: np.ndarray
    vertices: np.ndarray
    faces: np.ndarray
    adjacent: np.ndarray
    rows: np.ndarray
    clip: np.ndarray
    keep: np.ndarray
    seen: np.ndarray
    sides: np.ndarray
    on_lines: np.ndarray
    lines: np.ndarray
    cells: np.ndarray
    counts: np.ndarray

    @classmethod
    def of(
        cls,
        proxy: Proxy,
        camera: Camera,
        size: tuple[int, int],
        cull: str,
        first: int = 0,
        proxies: Sequence[Proxy] = (),
        seams: bool = False,
        keep: np.ndarray | None = None,
    ) -> SeenMesh:
        """The triangles of a proxy as a camera sees them.

        Args:
            proxy: the triangles.
            camera: host matrices, in the proxy's space, for images of `size`.
            size: (height, width) of the grid of cells.
            cull: as in `TriangleSampler.rasterize`.
            first: the index of the first part.
            proxies: those of neighbouring parts, whose triangles the proxy has one part after the other; none for one.
            seams: whether patches end at seams (`Proxy.corners`), too.
            keep: see above; None for what `cull` says.
        """
        # Vertices of joint parts may be float64: moved into the camera's space, they are as exact as before.
        vertices, faces = read_only(proxy.vertices), read_only(proxy.faces, np.int32)
        rows, seen = pixel_rows(camera, size), np.empty((len(vertices), 2), np.float32)
        parallel(seen_mesh_loops.projected, len(seen), vertices, rows, seen, work=4 * len(seen))
        every, sides = proxies or [proxy], np.zeros(len(faces) + 1, np.int8)
        if seams:
            tables = [x.faces if x.corners is None else x.corners for x in every]
        else:  # Of one colour triangles that meet are one patch, whether they share their vertices or not.
            tables = [_welded(x.vertices, x.faces) for x in every]
            if not all(map(operator.is_, tables, [x.faces for x in every])):
                shifts = [0, *itertools.accumulate(len(x.vertices) for x in every)][:-1]
                faces = read_only(tables[0] if len(tables) == 1 else in_one(tables, shifts), np.int32)
        starts = np.array([0, *itertools.accumulate(map(len, tables))], np.int32)
        adjacent = [_adjacent(table) for table in tables]
        adjacent = adjacent[0] if len(adjacent) == 1 else in_one(adjacent, starts[:-1].tolist())
        keep = np.full(len(faces), camera.kept_sign(cull), np.int8) if keep is None else keep
        count, blocks = len(faces), -(-len(faces) // silhouettes_loops.BLOCK)
        on_lines, lines, cells = np.empty(count, np.int32), np.empty(count, np.int8), np.empty(count, np.int32)
        image = rows, near_and_far(camera), keep, seen, sides, on_lines, lines, cells, np.empty(blocks, np.int32)
        mesh = cls(first, starts, vertices, faces, adjacent, *image)
        parallel(silhouettes_loops.turns, blocks, mesh, *size, work=5 * count)
        return mesh

    def mark_silhouettes(self, hits: Hits, width: np.ndarray, met: np.ndarray) -> None:
        """Mark, in `met` (2, H, W) uint8, the gaps where a patch may end or turn away; see the loop of this name.

        `hits` (H, W), read-only, are seen at centres; for `width` see `Oracle`.
        """
        arguments = self, hits.part, hits.depth, width, met
        parallel(silhouettes_loops.mark_silhouettes, len(self.counts), *arguments, work=5 * len(self.faces))

    def join(self, hits: Hits, met: np.ndarray, joined: np.ndarray, *, colors: bool) -> None:
        """Mark, in `joined` (2, H, W), the centres whose hits, of one of the parts, a patch joins to the next ones'.

        `hits` (H, W), read-only, are seen at centres; for `met` see `mark_silhouettes`, for `colors` the loop `seams`.
        """
        arguments = hits.part, hits.triangle, self, met, colors, joined
        parallel(seen_mesh_loops.seams, len(joined[0]), *arguments, work=8 * joined[0].size)

    def spans(self, gaps: Gaps, seams: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Spans of triangles on gaps, (N, 3) and (N, 6) or (N, 9), see `spans_loops.spans_of`; and their parts (N,)."""
        size = len(self.counts), silhouettes_loops.BLOCK
        triangles, most, counts = np.empty(size, np.int32), np.empty(size, np.int32), np.empty_like(self.counts)
        parallel(spans_loops.most_spans, len(counts), self, gaps, triangles, most, counts, work=5 * len(self.faces))
        listed = np.arange(size[1]) < counts[:, None]
        triangles, most = triangles[listed], most[listed]
        ends = most.cumsum()
        begins, total = ends - most, int(ends[-1]) if len(ends) else 0
        names, spans = np.empty((total, 3), np.int32), np.empty((total, 9 if seams else 6))
        names[:, 0] = -1
        arguments = triangles, begins, self, gaps, names, spans
        parallel(spans_loops.spans_of, len(triangles), *arguments, work=60 * len(names))
        part = self.starts[1:-1].searchsorted(names[:, 1], "right") + self.first
        return names, spans, part.astype(np.int32)

    def at(self, triangle: np.ndarray, points: np.ndarray) -> Fragments:
        """Fragments (1, 1, M) of triangles (M,) at points (M, 2)."""
        count = len(triangle)
        weights, depth = np.empty((count, 2), np.float32), np.empty(count, np.float32)
        arguments = triangle, points, self.rows, self.vertices, self.faces, weights, depth
        parallel(seen_mesh_loops.on_planes, count, *arguments, work=50 * count)
        return Fragments(triangle[None, None], weights[None, None], depth[None, None])


_welds: dict[int, tuple[weakref.ref, np.ndarray, np.ndarray]] = {}


def _welded(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """The faces (T, 3) int32 with one number for all vertices in one place; `faces` itself where most are shared.

    Otherwise each edge of a triangle is looked at as an outline. That of a read-only table that owns its memory is
    kept, as long as vertices that were in one place still are.
    """
    if len(vertices) < len(faces):  # Closed meshes have half as many vertices as triangles.
        return faces
    key, kept = id(faces), faces.flags.owndata and not faces.flags.writeable
    if kept and key in _welds and _welds[key][0]() is faces:
        _, first, found = _welds[key]
        if len(first) == len(vertices) and np.array_equal(vertices, vertices.take(first, 0)):
            return found
    first = _first_in_place(vertices)
    if (first == np.arange(len(first))).all():
        return faces
    found = first[faces]
    found.flags.writeable = False
    if kept:
        _welds[key] = weakref.ref(faces, lambda _: _welds.pop(key, None)), first, found
    return found


def _first_in_place(vertices: np.ndarray) -> np.ndarray:
    """For each of the vertices (V, 3) a vertex in the same place (V,) int32, the same one for most of those there."""
    bits = (vertices.astype(np.float32) + np.float32(0)).view(np.uint32).astype(np.uint64)  # −0 becomes 0.
    factors = np.array([0x9E3779B97F4A7C15, 0xC2B2AE3D27D4EB4F, 0x165667B19E3779F9], np.uint64)
    key = (bits * factors).sum(axis=1, dtype=np.uint64)  # Wraps around.
    order = np.argsort(key, kind="stable")
    ordered = vertices[order]
    new = np.ones(len(order), bool)  # Places of one key are mixed up too rarely to matter; they are then not welded.
    new[1:] = (ordered[1:] != ordered[:-1]).any(axis=1)
    first = np.empty(len(order), np.int32)
    first[order] = order[np.flatnonzero(new)[np.cumsum(new) - 1]]
    return first


_known: dict[int, tuple[weakref.ref, np.ndarray]] = {}


def _adjacent(faces: np.ndarray) -> np.ndarray:
    """`SeenMesh.adjacent`; that of a read-only table that owns its memory is kept as long as the table."""
    kept, key = not faces.flags.writeable and faces.flags.owndata, id(faces)
    if kept and key in _known and _known[key][0]() is faces:
        return _known[key][1]
    table = np.ascontiguousarray(faces, np.int32)
    edges = np.sort(table[:, [[1, 2], [2, 0], [0, 1]]].reshape(-1, 2), axis=1)
    order = np.lexsort((edges[:, 1], edges[:, 0]))
    found = seen_mesh_loops.neighbours(table, order)
    if kept:
        _known[key] = weakref.ref(faces, lambda _: _known.pop(key, None)), found
    return found
