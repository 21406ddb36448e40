"""Breaks between the fronts of triangles, exactly: what the triangles that cross a gap hide of one another there.

The fronts at two neighbouring centres are one surface if a sheet of triangles leads from one to the other. Where they
are not, and where a silhouette passes between the centres, all triangles on the line between them are found, and the
nearest at each place. A silhouette is an edge where a sheet of triangles ends or turns away; so things that no centre
sees are found as well.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rts.compiling.threads import parallel
from rts.outlines.gaps import INNER, Breaks, Fronts, Gaps, lines_of_crossing
from rts.outlines.sheets import Sheets


def breaks_of_triangles(fronts: Fronts, sheets: Sequence[Sheets], width: np.ndarray) -> Breaks:
    """The breaks between the fronts (H, W) at the centres of all cells.

    Args:
        fronts: what is seen at centres.
        sheets: the triangles of all parts.
        width: the width of a cell at a depth: `width[0] + width[1] * depth`.
    """
    from rts.outlines import spans_loops

    met = np.zeros((2, *fronts.part.shape), np.uint8)
    for sheet in sheets:
        sheet.meet(fronts, width, met)
    joined = np.zeros(met.shape, np.bool_)
    for sheet in sheets:
        sheet.join(fronts, met, joined)
    gaps = np.empty_like(joined)
    parallel(spans_loops.wanted, len(fronts.part), fronts.part, joined, met, gaps, work=2 * fronts.part.size)
    gap, whole, numbers = _breaks_in(gaps, fronts, sheets)
    joined[1 - gap[:, 2], gap[:, 0], gap[:, 1]] = False  # Elsewhere one surface goes on from centre to centre.
    along = np.column_stack([gap[:, 2], 1 - gap[:, 2]])[:, None, :]
    points = gap[:, None, 1::-1] + 0.5 + numbers[:, :, None] * along
    near, slope = crossings(whole[:, 1], whole[:, 2:4], whole[:, 4:6], points[:, 0], sheets, width)
    triangles = whole[:, [4, 5, 6, 7]]
    triangles[np.tile(whole[:, 2:4] < 0, 2)] = -1
    ends, parts = whole[:, 8:] == 1, whole[:, 2:4]
    tangent = tangents(near, slope, parts, whole[:, 4:6], points[:, 0], sheets)
    return Breaks(
        gap, points[:, 0], near, slope, ends, points[:, 1:3], points[:, 3:], parts, joined, triangles, tangent
    )


def _breaks_in(
    marks: np.ndarray, fronts: Fronts, sheets: Sequence[Sheets]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The breaks in the gaps that are marked (2, H, W): the gap of each (B, 3); and see `spans_loops.breaks`."""
    from rts.outlines import spans_loops

    gaps = Gaps.of(marks)
    gap, count = gaps.gap, len(gaps.gap)
    begins, names, spans, parts = spans_on(gaps, sheets)
    ends, depth = np.empty((count, 2, 2), np.int32), np.empty((count, 2))
    for k in (0, 1):
        y, x = gap[:, 0] + k * (1 - gap[:, 2]), gap[:, 1] + k * gap[:, 2]
        ends[:, k, 0], ends[:, k, 1], depth[:, k] = (table[y, x] for table in fronts)
    room, rows, counts = 2 * len(spans) + 4 * count, np.empty(count, np.int64), np.empty(count, np.int32)
    whole, numbers = np.empty((room, 10), np.int32), np.empty((room, 5))
    known = begins, spans, names, parts, ends, depth, INNER, rows, counts, whole, numbers
    parallel(spans_loops.breaks, count, *known, work=600 * count)
    # There is more room than they fill.
    found = np.repeat(rows - (np.cumsum(counts) - counts), counts) + np.arange(counts.sum())
    whole = whole.take(found, 0)
    return gap.take(whole[:, 0], 0), whole, numbers.take(found, 0)


def spans_on(gaps: Gaps, sheets: Sequence[Sheets]) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Spans of all parts on gaps, gap after gap: where those of each begin (M + 1,); names, spans; parts (N,) int32.

    See `Sheets.spans`.
    """
    from rts.outlines import spans_loops

    several = [sheet.spans(gaps) for sheet in sheets]
    names, spans, parts = several[0] if len(several) == 1 else (np.concatenate(x) for x in zip(*several, strict=True))
    begins, order = spans_loops.by_gap(names[:, 0], len(gaps.gap))
    return begins, names.take(order, 0), spans.take(order, 0), parts.take(order)


def crossings(
    near: np.ndarray,
    parts: np.ndarray,
    triangles: np.ndarray,
    points: np.ndarray,
    sheets: Sequence[Sheets],
    width: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """`Breaks.near`, and slopes of depth (B, 2, 2) of the surfaces that cross at breaks; 0 elsewhere.

    Surfaces that hardly differ in slope are not said to cross.

    Args:
        near: (B,) int32, 2 where surfaces are found to cross.
        parts: (B, 2), before and behind.
        triangles: (B, 2), alike.
        points: (B, 2), where breaks are.
        sheets: the triangles of all parts.
        width: the width of a cell at a depth: `width[0] + width[1] * depth`.
    """
    slopes, depth = np.zeros((len(near), 2, 2)), np.zeros(len(near))
    for sheet in sheets:
        for side in (0, 1):
            at = np.flatnonzero((near == 2) & sheet.holds(parts[:, side]))
            if len(at):
                found, slopes[at, side] = sheet.at(triangles[at, side], points[at])
                depth[at] = found.depth[0, 0]
    difference = np.abs(slopes[:, 1] - slopes[:, 0]).sum(-1)
    flat = ~(difference > 1e-4 * (width[0] + width[1] * depth))
    near = np.where((near == 2) & flat, 0, near).astype(np.int32)
    slopes[near < 2] = 0
    return near, slopes


def tangents(
    near: np.ndarray,
    slope: np.ndarray,
    parts: np.ndarray,
    triangles: np.ndarray,
    points: np.ndarray,
    sheets: Sequence[Sheets],
) -> np.ndarray:
    """`Breaks.tangent`: along the edge of the triangle that ends there, or the line where two planes cross.

    Arguments as of `crossings`, with slopes.
    """
    found = lines_of_crossing(slope)
    side = np.where(near == 1, 1, 0)
    index = np.arange(len(near))
    part, triangle = parts[index, side], triangles[index, side]
    for sheet in sheets:
        at = np.flatnonzero((near < 2) & sheet.holds(part))
        found[at] = sheet.along(triangle[at], points[at])
    length = np.hypot(*found.T)
    return found / np.where(length > 0, length, 1.0)[:, None]
