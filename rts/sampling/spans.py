"""Breaks between the fronts of triangles, exactly: what the triangles that cross a gap hide of one another there.

The fronts at two neighbouring centres are one surface if a sheet of triangles leads from one to the other. Where they
are not, and in the gaps around, all triangles on the line between the centres are found, and the nearest at each place.
Where an outline leaves the gaps that were searched, it is followed, since thin things pass between centres.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rts.compiling.threads import parallel
from rts.sampling.gaps import INNER, Breaks, Fronts
from rts.sampling.sheets import Gaps, Sheets

ROUNDS = 8
"""How often the search goes on where outlines leave the gaps that were searched, each time twice as far."""

REACH = 3
"""How many cells around the gaps of the first round those of the second may lie."""


def breaks_of_triangles(fronts: Fronts, sheets: Sequence[Sheets], width: np.ndarray) -> Breaks:
    """The breaks between the fronts (H, W) at the centres of all cells.

    Args:
        fronts: what is seen at centres.
        sheets: the triangles of each part.
        width: the width of a cell at a depth: `width[0] + width[1] * depth`.
    """
    joined = np.zeros((2, *fronts.part.shape), np.bool_)
    for part, own in enumerate(sheets):
        own.join(part, *fronts, joined)
    search = _Search(fronts, sheets)
    searched = _gaps_apart(fronts.part, joined)
    found = [search.breaks(searched)]
    for n in range(ROUNDS):
        more = _gaps_beyond(found[-1][0], searched, 2**n)
        if more is None:
            break
        searched |= more
        found.append(search.breaks(more))
    gap, whole, numbers = found[0] if len(found) == 1 else (np.concatenate(x) for x in zip(*found, strict=True))
    # In one surface from centre to centre.
    inside = fronts.part >= 0
    joined[0, :, :-1] = inside[:, 1:] & (fronts.part[:, 1:] == fronts.part[:, :-1])
    joined[1, :-1] = inside[1:] & (fronts.part[1:] == fronts.part[:-1])
    joined[1 - gap[:, 2], gap[:, 0], gap[:, 1]] = False
    along = np.column_stack([gap[:, 2], 1 - gap[:, 2]])[:, None, :]
    points = gap[:, None, 1::-1] + 0.5 + numbers[:, :, None] * along
    slope = _slopes(whole, points[:, 0], sheets)
    near = _crossings(whole, slope, fronts, gap, width)
    slope[near < 2] = 0
    triangles = whole[:, [4, 5, 6, 7]]
    triangles[np.tile(whole[:, 2:4] < 0, 2)] = -1
    ends, parts = whole[:, 8:] == 1, whole[:, 2:4]
    return Breaks(gap, points[:, 0], near, slope, ends, points[:, 1:3], points[:, 3:], parts, joined, triangles)


class _Search:
    """A search for the breaks in gaps, which remembers the triangles around the gaps of the last one.

    Attributes:
        fronts: what is seen at centres.
        sheets: the triangles of each part.
        cells: (H, W) bool.
        near: for each part the triangles that may meet these cells.
    """

    def __init__(self, fronts: Fronts, sheets: Sequence[Sheets]):
        self.fronts, self.sheets = fronts, sheets
        self.cells, self.near = np.zeros(fronts.part.shape, np.bool_), [np.empty(0, np.int64)] * len(sheets)

    def breaks(self, marks: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The breaks in the gaps that are marked (2, H, W): the gap of each (B, 3); see `spans_loops.breaks`."""
        from rts.sampling import spans_loops

        gaps = Gaps.of(marks)
        gap, count = gaps.gap, len(gaps.gap)
        names, spans, parts = self._spans(gaps)
        ends, depth = np.empty((count, 2, 2), np.int32), np.empty((count, 2))
        for k, (y, x) in enumerate(_centres(gap)):
            ends[:, k, 0], ends[:, k, 1] = self.fronts.part[y, x], self.fronts.triangle[y, x]
            depth[:, k] = self.fronts.depth[y, x]
        begins, order = spans_loops.by_gap(names[:, 0], count)
        room = 2 * len(order) + 4 * count
        pieces, starts, counts = np.empty(room, np.int32), np.empty(room), np.empty(count, np.int32)
        known = begins, order, spans, names, parts, ends, depth, pieces, starts, counts
        parallel(spans_loops.fronts, count, *known, work=300 * count)
        at = np.cumsum(counts) - counts
        whole, numbers = np.full((counts.sum(), 10), -1, np.int32), np.empty((counts.sum(), 5))
        parallel(spans_loops.breaks, count, *known, at, INNER, whole, numbers, work=300 * count)
        found = np.flatnonzero(whole[:, 0] >= 0)
        whole = whole[found]
        return gap[whole[:, 0]], whole, numbers[found]

    def _spans(self, gaps: Gaps) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Spans of all parts on gaps, and their parts (N,) int32; see `Sheets.spans`."""
        from rts.sampling import spans_loops

        (first_y, first_x), (last_y, last_x) = _centres(gaps.gap)
        if not (self.cells[first_y, first_x] & self.cells[last_y, last_x]).all():
            self.cells = np.zeros_like(self.cells)
            spans_loops.around(np.column_stack([first_y, last_y, first_x, last_x]), REACH, self.cells)
            self.near = [own.near(self.cells) for own in self.sheets]
        several = [own.spans(near, gaps) for own, near in zip(self.sheets, self.near, strict=True)]
        parts = np.repeat(np.arange(len(several), dtype=np.int32), [len(names) for names, _ in several])
        names, spans = several[0] if len(several) == 1 else (np.concatenate(x) for x in zip(*several, strict=True))
        return names, spans, parts


def _centres(gap: np.ndarray) -> tuple[tuple[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]:
    """Indices y and x (M,) of the first and of the second centre of gaps (M, 3)."""
    y, x, row = gap.T
    return (y, x), (y + 1 - row, x + row)


def _gaps_apart(part: np.ndarray, joined: np.ndarray) -> np.ndarray:
    """Marks (2, H, W) of the gaps to search first: those between fronts that no sheet joins, and those around.

    A tip that no centre sees may reach through a gap beside; so all sides of a square are searched together.
    """
    from rts.sampling import spans_loops

    (height, width), marks = part.shape, np.empty(joined.shape, np.bool_)
    parallel(spans_loops.apart, height, part, joined, marks, work=2 * part.size)
    squares = np.empty((height - 1, width - 1), np.bool_)
    parallel(spans_loops.squares, height - 1, marks, squares, work=part.size)
    parallel(spans_loops.sides, height, squares, marks, work=2 * part.size)
    return marks


def _gaps_beyond(gap: np.ndarray, searched: np.ndarray, far: int) -> np.ndarray | None:
    """Marks (2, H, W) of gaps not yet searched around breaks, whose gaps (B, 3) are given; None if there are none.

    They are the sides of squares up to `far` squares away from those beside a break that have a side not searched.
    """
    from rts.sampling import spans_loops

    size = np.array(searched.shape[1:]) - 1
    y, x = np.concatenate([gap[:, :2], gap[:, :2] - np.column_stack([gap[:, 2], 1 - gap[:, 2]])]).T
    y, x = (i[(y >= 0) & (x >= 0) & (y < size[0]) & (x < size[1])] for i in (y, x))
    whole = searched[0, y, x] & searched[0, y + 1, x] & searched[1, y, x] & searched[1, y, x + 1]
    if whole.all():
        return None
    y, x = y[~whole], x[~whole]
    squares, more = np.zeros(size, np.bool_), np.zeros_like(searched)
    spans_loops.around(np.column_stack([y, y, x, x]), far, squares)
    parallel(spans_loops.sides, len(searched[0]), squares, more, work=2 * more[0].size)
    return more & ~searched


def _slopes(whole: np.ndarray, points: np.ndarray, sheets: Sequence[Sheets]) -> np.ndarray:
    """(B, 2, 2) slopes of depth of the surfaces that cross at breaks; 0 elsewhere."""
    slopes = np.zeros((len(whole), 2, 2))
    for part, own in enumerate(sheets):
        for side in (0, 1):
            at = np.flatnonzero((whole[:, 1] == 2) & (whole[:, 2 + side] == part))
            if len(at):
                _, slopes[at, side] = own.at(whole[at, 4 + side], points[at])
    return slopes


def _crossings(whole: np.ndarray, slope: np.ndarray, fronts: Fronts, gap: np.ndarray, width: np.ndarray) -> np.ndarray:
    """`Breaks.near`, where surfaces that hardly differ in slope are not said to cross."""
    cell = width[0] + width[1] * fronts.depth[gap[:, 0], gap[:, 1]]
    flat = ~(np.abs(slope[:, 1] - slope[:, 0]).sum(-1) > 1e-4 * cell)
    return np.where((whole[:, 1] == 2) & flat, 0, whole[:, 1]).astype(np.int32)
