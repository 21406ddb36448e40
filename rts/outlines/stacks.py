"""Breaks between stacks of layers, exactly: what the triangles that cross a gap hide of one another there.

The layers at two neighbouring centres are one surface if a sheet of triangles leads from one to the other. Where they
are not, and where a silhouette passes between the centres, all triangles on the line between them are found, and their
stack at each place. A silhouette is an edge where a sheet of triangles ends or turns away; so things that no centre
sees are found as well. Each change of what is seen is a break, which moves with the one layer that ends there, or with
the two that cross. Of opaque surfaces there is one layer.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from rts.compiling.threads import parallel, read_only
from rts.outlines.gaps import INNER, Breaks, Fronts, Gaps, Stacks, cells_away
from rts.outlines.sheets import Sheets

ROOM = 2
"""Changes for each span that there is room for at first: it starts and ends. Where many cross, there is too little."""


def breaks_of_stacks(
    layers: Fronts, opaque: np.ndarray, sheets: Sequence[Sheets], width: np.ndarray, seams: bool
) -> tuple[Breaks, Stacks | None]:
    """The breaks between the stacks at the centres of all cells, and the layers there; None of a single layer.

    Args:
        layers: what is seen at centres, arrays (K, H, W), front to back; nothing behind an opaque layer.
        opaque: (P,) bool, the parts that let no light through.
        sheets: the triangles of all parts.
        width: the width of a cell at a depth: `width[0] + width[1] * depth`.
        seams: whether there are breaks where a surface goes on across edges that its triangles do not share, and they
            are large, or turn there: colours may change. Of several layers there are two breaks in one place.
    """
    marks, joined = _gaps_to_search(layers, opaque, sheets, width)
    gap, place, near, ends, parts, owners, triangles, points, sides = _changes(
        Gaps.of(marks), layers, opaque, sheets, seams
    )
    joined[1 - gap[:, 2], gap[:, 0], gap[:, 1]] = False  # Elsewhere one surface goes on from centre to centre.
    slope, tangent, away = _moving_edges(near, parts, triangles, place, sheets, width)
    of_breaks, of_edges = (points[:, :2], points[:, 2:4], parts, joined), (tangent, away)
    breaks = Breaks(gap, place, near, slope, ends, *of_breaks, np.ascontiguousarray(triangles[:, :4]), *of_edges)
    if len(layers.part) == 1:
        return breaks, None
    last, stack = owners[:, :2], (owners[:, 2:], triangles[:, 2:], points[:, 2:])
    return breaks, Stacks(last, *stack, sides, np.zeros(owners.shape, np.int32))


def _gaps_to_search(
    layers: Fronts, opaque: np.ndarray, sheets: Sequence[Sheets], width: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Marks (2, H, W) of the gaps in which a layer may change: a silhouette meets them, or no sheet joins a layer.

    And of those whose centres see the same parts.
    """
    from rts.outlines import spans_loops

    part, size = layers.part, layers.part.shape[1:]
    fronts = [Fronts(*(np.ascontiguousarray(x[k]) for x in layers)) for k in range(len(part))]
    ends = fronts[0]
    if len(fronts) > 1:
        ends = Fronts(np.full(size, -1, np.int32), np.full(size, -1, np.int32), np.zeros(size))
    for front in fronts if len(fronts) > 1 and opaque.any() else ():
        solid = (front.part >= 0) & opaque[front.part]
        ends.part[solid], ends.depth[solid] = front.part[solid], front.depth[solid]
    met, marks, alike = np.zeros((2, *size), np.uint8), [], []
    for sheet in sheets:
        sheet.meet(ends, width, met)
    for front in fronts:
        if marks and not (front.part >= 0).any():
            break
        joined, wanted = np.zeros(met.shape, np.bool_), np.empty(met.shape, np.bool_)
        for sheet in sheets:
            sheet.join(front, met, joined)
        parallel(spans_loops.wanted, len(front.part), front.part, joined, met, wanted, work=front.part.size // 2)
        marks.append(wanted)
        alike.append(joined)
    joined = alike[0]
    if len(fronts) > 1:
        joined[0, :, :-1] &= (part[:, :, 1:] == part[:, :, :-1]).all(0)
        joined[1, :-1] &= (part[:, 1:] == part[:, :-1]).all(0)
    return marks[0] if len(marks) == 1 else np.logical_or.reduce(marks), joined


def _changes(gaps: Gaps, layers: Fronts, opaque: np.ndarray, sheets: Sequence[Sheets], seams: bool) -> tuple[Any, ...]:
    """The changes of stacks along gaps; see `stacks_loops.listed`."""
    from rts.outlines import stacks_loops as loops

    count, most = len(gaps.gap), len(layers.part)
    begins, spans, of = _spans_on(gaps, sheets, opaque, seams)
    rows, counts, live = np.empty(count, np.int64), np.empty(count, np.int32), np.empty(count, np.int32)
    known = gaps.gap, begins, spans, of, np.empty(len(spans), np.int32), live, opaque, *map(read_only, layers)
    room = ROOM * (begins + 2 * np.arange(count + 1))
    while True:
        total = int(room[-1]) + 1
        numbers = np.empty(total), np.empty((total, most + 3, 2), np.int32), np.empty((total, most + 3))
        found = np.empty((total, 6), np.int32), *numbers, np.empty((total, 2, most), np.int32)
        parallel(loops.changes, count, *known, room, rows, counts, INNER, *found, work=600 * count)
        if not (rows < 0).any():
            return loops.listed(rows, counts, gaps.gap, *found)
        room = np.append(0, np.cumsum(np.maximum(counts, np.diff(room))))  # Many surfaces pass through one another.


def _spans_on(
    gaps: Gaps, sheets: Sequence[Sheets], opaque: np.ndarray, seams: bool
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Spans of all parts on gaps, gap after gap: where those of each begin (M + 1,), their numbers, and integers.

    See `Sheets.spans` and `stacks_loops.changes`.
    """
    from rts.outlines import spans_loops

    several = [sheet.spans(gaps, seams) for sheet in sheets]
    names, spans, parts = several[0] if len(several) == 1 else (np.concatenate(x) for x in zip(*several, strict=True))
    begins, order = spans_loops.by_gap(names[:, 0], len(gaps.gap))
    parallel(spans_loops.by_start, len(gaps.gap), begins, spans[:, 0].copy(), order, work=50 * len(order))
    of, parts = np.full((max(len(order), 1), 6), -1, np.int32), parts.take(order)
    of[: len(order), 0], of[: len(order), 1:3], of[: len(order), 3] = parts, names.take(order, 0)[:, 1:], opaque[parts]
    # Loops read the first span in place of none.
    return begins, spans.take(order, 0) if len(order) else np.ones((1, spans.shape[1])), of


def _moving_edges(
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
    for sheet in sheets:
        sheet.edges(near, parts, triangles, points, slope, depth, tangent)
    silhouettes_loops.settle(width, depth, near, slope, tangent)
    return slope, tangent, cells_away(depth, width)
