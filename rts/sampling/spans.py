"""Breaks between the fronts of triangles, exactly: what the triangles that cross a gap hide of one another there.

The fronts at two neighbouring centres are one surface if a sheet of triangles leads from one to the other. Where they
are not, and in the gaps around, all triangles on the line between the centres are found, and the nearest at each place.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rts.compiling.threads import parallel
from rts.sampling.gaps import FINE, INNER, Breaks, Fronts
from rts.sampling.sheets import Sheets


def breaks_of_triangles(fronts: Fronts, sheets: Sequence[Sheets], width: np.ndarray) -> Breaks:
    """The breaks between the fronts (H, W) at the centres of all cells.

    Args:
        fronts: what is seen at centres.
        sheets: the triangles of each part.
        width: the width of a cell at a depth: `width[0] + width[1] * depth`.
    """
    from rts.sampling import spans_loops

    joined = np.zeros((2, *fronts.part.shape), np.bool_)
    for part, own in enumerate(sheets):
        own.join(part, *fronts, joined)
    gap, number = _searched(fronts.part, joined)
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
    whole, numbers = whole[:found], numbers[:found]
    # In one surface from centre to centre.
    own, inside = gap[whole[:, 0]], fronts.part >= 0
    joined[0, :, :-1] = inside[:, 1:] & (fronts.part[:, 1:] == fronts.part[:, :-1])
    joined[1, :-1] = inside[1:] & (fronts.part[1:] == fronts.part[:-1])
    joined[1 - own[:, 2], own[:, 0], own[:, 1]] = False
    along = np.column_stack([own[:, 2], 1 - own[:, 2]])[:, None, :]
    points = own[:, None, 1::-1] + 0.5 + numbers[:, :, None] * along
    slope = _slopes(whole, points[:, 0], sheets)
    near = _crossings(whole, slope, fronts, own, width)
    slope[near < 2] = 0
    triangles = whole[:, [4, 5, 6, 7]]
    triangles[np.tile(whole[:, 2:4] < 0, 2)] = -1
    return Breaks(
        own,
        points[:, 0],
        near,
        slope,
        whole[:, 8:] == 1,
        points[:, 1:3],
        points[:, 3:],
        whole[:, 2:4],
        joined,
        triangles,
    )


def _searched(part: np.ndarray, joined: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Gaps (M, 3) that are searched, and their numbers (2, H, W): those between fronts that no sheet joins.

    A tip that no centre sees may reach through a gap beside; so all sides of a square are searched together.
    """
    seen, open_ = part >= 0, ~joined
    open_[0, :, :-1] &= seen[:, :-1] | seen[:, 1:]
    open_[1, :-1] &= seen[:-1] | seen[1:]
    open_[0, :, -1], open_[1, -1] = False, False
    square = open_[0, :-1, :-1] | open_[0, 1:, :-1] | open_[1, :-1, :-1] | open_[1, :-1, 1:]
    for side in (open_[0, :-1, :-1], open_[0, 1:, :-1], open_[1, :-1, :-1], open_[1, :-1, 1:]):
        side |= square
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
