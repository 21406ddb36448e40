"""Breaks between the fronts of triangles, exactly: what the triangles that cross a gap hide of one another there.

The fronts at two neighbouring centres are one surface if a sheet of triangles leads from one to the other. Where they
are not, and where a silhouette passes between the centres, all triangles on the line between them are found, and the
nearest at each place. A silhouette is an edge where a sheet of triangles ends or turns away; so things that no centre
sees are found as well.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rts.compiling.threads import parallel, read_only
from rts.outlines.gaps import INNER, Breaks, Fronts, Gaps
from rts.outlines.sheets import Sheets


def breaks_of_triangles(fronts: Fronts, sheets: Sequence[Sheets], width: np.ndarray, seams: bool) -> Breaks:
    """The breaks between the fronts (H, W) at the centres of all cells.

    Args:
        fronts: what is seen at centres.
        sheets: the triangles of all parts.
        width: the width of a cell at a depth: `width[0] + width[1] * depth`.
        seams: whether there are breaks where a surface goes on across edges that its triangles do not share, and they
            are large, or turn there: colours may change.
    """
    from rts.outlines import fronts_loops, spans_loops

    met = np.zeros((2, *fronts.part.shape), np.uint8)
    for sheet in sheets:
        sheet.meet(fronts, width, met)
    joined = np.zeros(met.shape, np.bool_)
    for sheet in sheets:
        sheet.join(fronts, met, joined)
    marks, same, front = np.empty_like(joined), np.empty_like(joined), read_only(fronts.part)[None]
    parallel(spans_loops.wanted, len(met[0]), front, joined, met, marks, same, work=fronts.part.size)
    gaps = Gaps.of(marks)
    begins, names, spans, parts = spans_on(gaps, sheets, seams)
    count = len(gaps.gap)
    room, rows, counts = 2 * len(spans) + 4 * count, np.empty(count, np.int64), np.empty(count, np.int32)
    whole, numbers = np.empty((room, 10), np.int32), np.empty((room, 5))
    seen = *map(read_only, fronts), np.empty((count, 2, 2), np.int32), np.empty((count, 2))
    known = gaps.gap, begins, spans, names, parts, *seen, INNER, rows, counts, whole, numbers
    parallel(fronts_loops.breaks, count, *known, work=600 * count)
    count = counts.sum()
    gap, points, near = np.empty((count, 3), np.int32), np.empty((count, 5, 2)), np.empty(count, np.int32)
    beside, triangles, ends = np.empty((count, 2), np.int32), np.empty((count, 4), np.int32), np.empty((count, 2), bool)
    fronts_loops.listed(rows, counts, gaps.gap, whole, numbers, gap, points, beside, near, triangles, ends, same)
    slope, tangent, away = moving_edges(near, beside, triangles, points[:, 0], sheets, width)
    place, last, inner = points[:, 0], points[:, 1:3], points[:, 3:]
    return Breaks(gap, place, near, slope, ends, last, inner, beside, same, triangles, tangent, away)


def spans_on(
    gaps: Gaps, sheets: Sequence[Sheets], seams: bool
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Spans of all parts on gaps, gap after gap: where those of each begin (M + 1,); names, spans; parts (N,) int32.

    See `Sheets.spans`.
    """
    from rts.outlines import spans_loops

    several = [sheet.spans(gaps, seams) for sheet in sheets]
    names, spans, parts = several[0] if len(several) == 1 else (np.concatenate(x) for x in zip(*several, strict=True))
    begins, order = spans_loops.by_gap(names[:, 0], len(gaps.gap))
    parallel(spans_loops.by_start, len(gaps.gap), begins, spans[:, 0], order, work=50 * len(order))
    return begins, names.take(order, 0), spans.take(order, 0), parts.take(order)


def moving_edges(
    near: np.ndarray,
    parts: np.ndarray,
    triangles: np.ndarray,
    points: np.ndarray,
    sheets: Sequence[Sheets],
    width: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """`Breaks.slope`, `tangent` and `cells_away`: of the edge of the triangle that ends, or where two planes cross.

    Args:
        near: `Breaks.near`. It becomes 0 where surfaces that cross hardly differ in slope.
        parts: (B, 2) int32, before and behind.
        triangles: (B, 2 or more) int32, alike.
        points: (B, 2), where breaks are.
        sheets: the triangles of all parts.
        width: the width of a cell at a depth: `width[0] + width[1] * depth`.
    """
    from rts.outlines import silhouettes_loops

    slope, depth, tangent = np.zeros((len(near), 2, 2)), np.full(len(near), np.nan), np.zeros((len(near), 2))
    known = read_only(parts), read_only(triangles), read_only(points)
    for sheet in sheets:
        sheet.edges(near, *known, slope, depth, tangent)
    away = np.empty(len(near))
    silhouettes_loops.settle(width, depth, near, slope, tangent, away)
    return slope, tangent, away
