"""Crossings between first hits of triangles, exactly: what the triangles that cross a gap hide of one another there.

The first hits at two neighbouring centres are one surface if a patch of triangles leads from one to the other. Where
they are not, and where a silhouette passes between the centres, all triangles on the line between them are found, and
the nearest at each place. A silhouette is an edge where a patch of triangles ends or turns away; so things that no
centre sees are found as well.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rts.compiling.threads import parallel
from rts.outlines import first_hits_loops, silhouettes_loops, spans_loops
from rts.outlines.gaps import Crossings, Gaps, Hits
from rts.outlines.seen_mesh import SeenMesh
from rts.outlines.tolerances import BESIDE


def crossings_of_triangles(hits: Hits, meshes: Sequence[SeenMesh], width: np.ndarray, seams: bool) -> Crossings:
    """The crossings between the first hits (H, W) at the centres of all cells.

    Args:
        hits: what is seen at centres, read-only.
        meshes: the triangles of all parts.
        width: the width of a cell at a depth: `width[0] + width[1] * depth`.
        seams: whether there are crossings where a surface goes on across edges that its triangles do not share, and
            they are large, or turn there: colours may change.
    """
    met = np.zeros((2, *hits.part.shape), np.uint8)
    for mesh in meshes:
        mesh.mark_silhouettes(hits, width, met)
    joined = np.zeros(met.shape, np.bool_)
    for mesh in meshes:
        mesh.join(hits, met, joined, colors=seams)
    marks, same = np.empty_like(joined), np.empty_like(joined)
    parallel(spans_loops.wanted, len(met[0]), hits.part[None], joined, met, marks, same, work=hits.part.size)
    gaps = Gaps.of(marks)
    begins, names, spans, parts = spans_on(gaps, meshes, seams)
    count = len(gaps.gap)
    room, rows, counts = 2 * len(spans) + 4 * count, np.empty(count, np.int64), np.empty(count, np.int32)
    whole, numbers = np.empty((room, 10), np.int32), np.empty((room, 5))
    seen = *hits, np.empty((count, 2, 2), np.int32), np.empty((count, 2))
    known = gaps.gap, begins, spans, names, parts, *seen, BESIDE, rows, counts, whole, numbers
    parallel(first_hits_loops.crossings, count, *known, work=600 * count)
    count = counts.sum()
    gap, points, kind = np.empty((count, 3), np.int32), np.empty((count, 5, 2)), np.empty(count, np.int32)
    beside, triangles, ends = np.empty((count, 2), np.int32), np.empty((count, 4), np.int32), np.empty((count, 2), bool)
    first_hits_loops.listed(rows, counts, gaps.gap, whole, numbers, gap, points, beside, kind, triangles, ends, same)
    place, last, inner = points[:, 0].copy(), points[:, 1:3], points[:, 3:]
    slope, tangent, away = moving_edges(kind, beside, triangles, place, meshes, width)
    return Crossings(gap, place, kind, slope, ends, last, inner, beside, same, triangles, tangent, away)


def spans_on(
    gaps: Gaps, meshes: Sequence[SeenMesh], seams: bool
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Spans of all parts on gaps, gap after gap: where those of each begin (M + 1,); names, spans; parts (N,) int32.

    See `SeenMesh.spans`.
    """
    several = [mesh.spans(gaps, seams) for mesh in meshes]
    names, spans, parts = several[0] if len(several) == 1 else (np.concatenate(x) for x in zip(*several, strict=True))
    begins, order = spans_loops.by_gap(names[:, 0], len(gaps.gap))
    parallel(spans_loops.by_start, len(gaps.gap), begins, spans[:, 0], order, work=50 * len(order))
    return begins, names.take(order, 0), spans.take(order, 0), parts.take(order)


def moving_edges(
    kind: np.ndarray,
    parts: np.ndarray,
    triangles: np.ndarray,
    points: np.ndarray,
    meshes: Sequence[SeenMesh],
    width: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """`Crossings.slope`, `tangent` and `cells_away`: of the edge of the triangle that ends, or where planes intersect.

    Args:
        kind: `Crossings.kind`. It becomes 0 where surfaces that intersect hardly differ in slope.
        parts: (B, 2) int32, before and behind.
        triangles: (B, 2 or more) int32, alike.
        points: (B, 2), where crossings are.
        meshes: the triangles of all parts.
        width: the width of a cell at a depth: `width[0] + width[1] * depth`.
    """
    slope, depth, tangent = np.zeros((len(kind), 2, 2)), np.full(len(kind), np.nan), np.zeros((len(kind), 2))
    for mesh in meshes:
        arguments = kind, parts, triangles, points, mesh, slope, depth, tangent
        parallel(silhouettes_loops.edges, len(kind), *arguments, work=100 * len(kind))
    away = np.empty(len(kind))
    silhouettes_loops.finish_directions(width, depth, kind, slope, tangent, away)
    return slope, tangent, away
