"""Breaks between the fronts of triangles, exactly: what the triangles that cross a gap hide of one another there.

The fronts at two neighbouring centres are one surface if a sheet of triangles leads from one to the other. Where they
are not, and in the gaps around, all triangles on the line between the centres are found, and the nearest at each place.
Where an outline leaves the gaps that were searched, it is followed, since thin things pass between centres.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rts.compiling.threads import parallel
from rts.sampling.gaps import FINE, INNER, Breaks, Fronts
from rts.sampling.sheets import Sheets

ROUNDS = 8
"""How often the search goes on where outlines leave the gaps that were searched, each time twice as far."""


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
    open_ = _open(fronts.part, joined)
    searched, found = open_.copy(), [_swept(open_, fronts, sheets)]
    for n in range(ROUNDS):
        squares = _squares_of(found[-1][0], searched)
        if not len(squares):
            break
        more = np.zeros_like(searched)
        _mark(squares, 2**n, more)
        more &= ~searched
        searched |= more
        found.append(_swept(more, fronts, sheets))
    gap, whole, numbers = (np.concatenate(x) for x in zip(*found, strict=True))
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


def _swept(open_: np.ndarray, fronts: Fronts, sheets: Sequence[Sheets]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The breaks in the gaps that are marked (2, H, W): the gap of each (B, 3); see `spans_loops.breaks`."""
    from rts.sampling import spans_loops

    gap, number = _numbered(open_)
    ends = np.empty((len(gap), 2, 2), np.int32)
    depth, step = np.empty((len(gap), 2)), np.column_stack([1 - gap[:, 2], gap[:, 2]])
    for k in (0, 1):
        y, x = (gap[:, :2] + k * step).T
        ends[:, k, 0], ends[:, k, 1], depth[:, k] = fronts.part[y, x], fronts.triangle[y, x], fronts.depth[y, x]
    several = [own.spans(number) for own in sheets]
    names, spans = (np.concatenate([one[i] for one in several]) for i in (0, 1))
    parts = np.repeat(np.arange(len(sheets), dtype=np.int32), [len(one[0]) for one in several])
    begins, order = spans_loops.by_gap(names[:, 0], len(gap))
    room = 2 * len(spans) + 4 * len(gap)
    pieces, starts, counts = np.empty(room, np.int32), np.empty(room), np.empty(len(gap), np.int32)
    known = begins, order, spans, names, parts, ends, depth, pieces, starts, counts
    parallel(spans_loops.fronts, len(gap), *known, work=300 * len(gap))
    whole, numbers = np.empty((counts.sum(), 10), np.int32), np.empty((counts.sum(), 5))
    found = spans_loops.breaks(*known, 0.4 * FINE, INNER, whole, numbers)
    return gap[whole[:found, 0]], whole[:found], numbers[:found]


def _open(part: np.ndarray, joined: np.ndarray) -> np.ndarray:
    """Marks (2, H, W) of the gaps to search first: those between fronts that no sheet joins, and those around.

    A tip that no centre sees may reach through a gap beside; so all sides of a square are searched together.
    """
    seen, open_ = part >= 0, ~joined
    open_[0, :, :-1] &= seen[:, :-1] | seen[:, 1:]
    open_[1, :-1] &= seen[:-1] | seen[1:]
    open_[0, :, -1], open_[1, -1] = False, False
    square = open_[0, :-1, :-1] | open_[0, 1:, :-1] | open_[1, :-1, :-1] | open_[1, :-1, 1:]
    for side in _sides(open_):
        side |= square
    return open_


def _sides(marks: np.ndarray) -> tuple[np.ndarray, ...]:
    """Views (H − 1, W − 1) of marks of gaps (2, H, W): the four sides of each square."""
    return marks[0, :-1, :-1], marks[0, 1:, :-1], marks[1, :-1, :-1], marks[1, :-1, 1:]


def _squares_of(gap: np.ndarray, searched: np.ndarray) -> np.ndarray:
    """The squares (M, 2), y and x, beside gaps of breaks (B, 3), that have a side which was not searched."""
    before = gap[:, :2] - np.column_stack([gap[:, 2], 1 - gap[:, 2]])
    squares = np.concatenate([gap[:, :2], before])
    size = np.array(searched.shape[1:]) - 1
    y, x = squares[((squares >= 0) & (squares < size)).all(axis=1)].T
    left = ~np.logical_and.reduce([side[y, x] for side in _sides(searched)])
    return np.column_stack([y[left], x[left]])


def _mark(squares: np.ndarray, far: int, marks: np.ndarray) -> None:
    """Mark the sides of squares (M, 2) and of all that are up to `far` squares away."""
    steps = np.mgrid[-far : far + 1, -far : far + 1].reshape(2, -1).T
    around = (squares[:, None] + steps).reshape(-1, 2)
    size = np.array(marks.shape[1:]) - 1
    y, x = around[((around >= 0) & (around < size)).all(axis=1)].T
    for side in _sides(marks):
        side[y, x] = True


def _numbered(open_: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Gaps (M, 3) that are marked, and their numbers (2, H, W), −1 for the others."""
    number = np.full(open_.shape, -1, np.int32)
    at = np.flatnonzero(open_)
    number.reshape(-1)[at] = np.arange(len(at))
    axis, y, x = np.unravel_index(at, open_.shape)
    return np.column_stack([y, x, 1 - axis]).astype(np.int32), number


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
