"""Breaks in gaps: the places between neighbouring centres where one front ends and another begins.

The fronts at two neighbouring centres are one surface if a sheet of triangles leads from one to the other. Where they
are not, the line between the centres is sampled where their sheets end, then halved until each break is known.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from rts.sampling.sheets import Sheets

FINE = 1e-4
"""Length of the interval, in cells, in which a break is known to lie; then the sheets tell where exactly."""

INNER = 0.1
"""Distance from a break, in cells, of the samples that tell colours; half the way to the next break if that is less."""

BESIDE = 0.05
"""Distance beyond a break, in cells, up to which a sheet is followed to tell if it goes on behind the other."""

SAME_DEPTH = 1e-5
"""Share of the depth by which a sheet's depth may differ from that of a sample on it."""

STEEP, RISE = 1.5, 0.1
"""Where no triangles tell: two fronts may be two surfaces if their depths differ by more than so many times the least
difference beside them, plus this share of a cell's width."""


class Fronts(NamedTuple):
    """The fronts at M points of the image. Host arrays.

    Attributes:
        part: (M,) int32, −1 where nothing is seen.
        triangle: (M,) int32, −1 where nothing is seen, or where no triangle is known.
        depth: (M,) float64, linear; 0 where nothing is seen.
    """

    part: np.ndarray
    triangle: np.ndarray
    depth: np.ndarray

    def at(self, index: np.ndarray) -> Fronts:
        """The fronts with some indices."""
        return Fronts(*(x[index] for x in self))

    @classmethod
    def of(cls, several: Sequence[Fronts]) -> Fronts:
        """Several fronts, one after the other."""
        return cls(*(np.concatenate(x) for x in zip(*several, strict=True)))


class Oracle(NamedTuple):
    """A scene that can be sampled at any point.

    Attributes:
        fronts: points (M, 2) → their fronts.
        sheets: the sheets of each part; None where no triangles tell.
        width: the width of a cell at a depth: `width[0] + width[1] * depth`.
    """

    fronts: Callable[[np.ndarray], Fronts]
    sheets: Sequence[Sheets | None]
    width: np.ndarray

    def walk(self, fronts: Fronts, start: np.ndarray, end: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """`Sheets.walk` of fronts, each on its part's sheets: (M,) each; NaN, NaN and −1 where no triangles tell."""
        count = len(start)
        reached, depth, triangle = np.full(count, np.nan), np.full(count, np.nan), np.full(count, -1, np.int32)
        for part, sheets in enumerate(self.sheets):
            own = np.flatnonzero((fronts.part == part) & (fronts.triangle >= 0))
            if sheets is not None and len(own):
                reached[own], depth[own], triangle[own] = sheets.walk(fronts.triangle[own], start[own], end[own])
        return reached, depth, triangle

    def planes(self, fronts: Fronts, points: np.ndarray) -> np.ndarray:
        """(M, 3) depths of the fronts' planes at points, and slopes; NaN where no triangles tell."""
        found = np.full((len(points), 3), np.nan)
        for part, sheets in enumerate(self.sheets):
            own = np.flatnonzero((fronts.part == part) & (fronts.triangle >= 0))
            if sheets is not None and len(own):
                found[own] = sheets.planes(fronts.triangle[own], points[own])
        return found

    def knows(self, fronts: Fronts) -> np.ndarray:
        """(M,) True where triangles tell how a front goes on."""
        has = np.array([sheets is not None for sheets in self.sheets])
        return (fronts.part >= 0) & has[fronts.part] & (fronts.triangle >= 0)

    def leads(self, a: Fronts, at: np.ndarray, b: Fronts, to: np.ndarray) -> np.ndarray:
        """(M,) True where a sheet of triangles leads from the front `a` at one point to the front `b` at another."""
        leads = np.zeros(len(at), bool)
        same = np.flatnonzero((a.part == b.part) & self.knows(a) & (b.triangle >= 0))
        one, other = a.at(same), b.at(same)
        reached, depth, triangle = self.walk(one, at[same], to[same])
        # Rounding may tell neighbours apart; sheets that pass through one another are as near, but share no corner.
        near = (np.abs(depth - other.depth) <= SAME_DEPTH * other.depth) & (triangle != other.triangle)
        for part, sheets in enumerate(self.sheets):
            close = np.flatnonzero(near & (one.part == part))
            if sheets is not None and len(close):
                near[close] = sheets.touch(triangle[close], other.triangle[close])
        leads[same] = (reached == 1) & ((triangle == other.triangle) | near)
        return leads


class Breaks(NamedTuple):
    """Breaks, in order of their gaps and along each. Host arrays; see `rts.contracts.records.Outlines`.

    Attributes:
        gap: (B, 3) int32.
        place: (B, 2) float64.
        near: (B,) int32.
        slope: (B, 2, 2) float64.
        ends: (B, 2) bool.
        points: (B, 2, 2) float64, x and y of the last samples before and behind each break.
        inner: (B, 2, 2) float64, x and y of the samples that tell colours.
        parts: (B, 2) int32, their parts, or −1.
        joined: (2, H, W) bool: does each cell's front go on to the next one's, along x and along y?
    """

    gap: np.ndarray
    place: np.ndarray
    near: np.ndarray
    slope: np.ndarray
    ends: np.ndarray
    points: np.ndarray
    inner: np.ndarray
    parts: np.ndarray
    joined: np.ndarray


class _Intervals(NamedTuple):
    """Intervals of gaps whose ends are not on one surface: the gap's index, two places along it, and their fronts."""

    gap: np.ndarray
    low: np.ndarray
    high: np.ndarray
    before: Fronts
    behind: Fronts

    def at(self, index: np.ndarray) -> _Intervals:
        places = self.gap[index], self.low[index], self.high[index]
        return _Intervals(*places, self.before.at(index), self.behind.at(index))

    @classmethod
    def of(cls, several: Sequence[_Intervals]) -> _Intervals:
        """Several intervals, one after the other."""
        gap, low, high = (np.concatenate([one[i] for one in several]) for i in range(3))
        return cls(
            gap, low, high, Fronts.of([one.before for one in several]), Fronts.of([one.behind for one in several])
        )


class _Lines(NamedTuple):
    """Gaps: centres (M, 2), and unit steps (M, 2) along rows or columns."""

    start: np.ndarray
    step: np.ndarray

    def points(self, gap: np.ndarray, place: np.ndarray) -> np.ndarray:
        """Points (N, 2) at places along gaps."""
        return self.start[gap] + place[:, None] * self.step[gap]


def find_breaks(fronts: Fronts, oracle: Oracle) -> Breaks:
    """The breaks between the fronts at the centres of all cells, whose arrays are (H, W)."""
    height, width = fronts.part.shape
    gaps = []
    for axis in (1, 0):
        y, x = np.mgrid[: height - (axis == 0), : width - (axis == 1)].reshape(2, -1)
        gaps.append(np.column_stack([y, x, np.full(len(y), axis)]))
    gap = np.concatenate(gaps).astype(np.int32)
    one, other, start, step = _ends(gap, fronts)
    same, seen = (one.part == other.part) & (one.part >= 0), (one.part >= 0) | (other.part >= 0)
    whole, at = np.zeros(len(gap), bool), np.flatnonzero(same)
    whole[at] = oracle.leads(one.at(at), start[at], other.at(at), (start + step)[at])
    whole |= same & ~(oracle.knows(one) & oracle.knows(other)) & _smooth(fronts, oracle.width, *gap.T)
    joined = np.zeros((2, height, width), bool)
    joined[1 - gap[:, 2], gap[:, 0], gap[:, 1]] = same
    nothing = _no_breaks(joined)
    return _with_breaks(nothing, gap[seen & ~whole], np.zeros((0, 2)), fronts, oracle)


def more_breaks(breaks: Breaks, gap: np.ndarray, places: np.ndarray, fronts: Fronts, oracle: Oracle) -> Breaks:
    """Breaks with those of further gaps (M, 3), whose fronts may differ from both centres' at given places (M,).

    Gaps that have breaks are passed over.
    """
    known = {tuple(g) for g in breaks.gap.tolist()}
    new = np.array([tuple(g) not in known for g in gap.tolist()], bool)
    return _with_breaks(breaks, gap[new], places[new, None], fronts, oracle) if new.any() else breaks


def _with_breaks(breaks: Breaks, gap: np.ndarray, places: np.ndarray, fronts: Fronts, oracle: Oracle) -> Breaks:
    """Breaks with those of further gaps (M, 3), which are cut at places (M, P), and where their sheets end."""
    one, other, start, step = _ends(gap, fronts)
    gaps = _Lines(start, step)
    places = places if len(places) else np.zeros((len(gap), 0))
    found = _halved(_cut(gaps, one, other, places, oracle), gaps, oracle)
    found = found.at(np.lexsort((found.low, found.gap)))
    place, near, slope, kept = _classified(found, gaps, oracle)
    found, number = found.at(kept), found.gap[kept]
    joined = breaks.joined.copy()
    y, x, axis = gap[number].T
    joined[1 - axis, y, x] = False
    first, last = np.diff(number, prepend=-1) != 0, np.diff(number, append=-1) != 0
    low, high = found.low, found.high
    inner = [
        low - np.minimum(INNER, (low - np.where(first, 0.0, np.roll(high, 1))) / 2),
        high + np.minimum(INNER, (np.where(last, 1.0, np.roll(low, -1)) - high) / 2),
    ]
    own = Breaks(
        gap[number],
        gaps.points(number, place[kept]),
        near[kept],
        slope[kept],
        np.stack([first, last], 1),
        np.stack([gaps.points(number, low), gaps.points(number, high)], 1),
        np.stack([gaps.points(number, at) for at in inner], 1),
        np.stack([found.before.part, found.behind.part], 1),
        joined,
    )
    names = Breaks._fields[:-1]
    both = {name: np.concatenate([getattr(breaks, name), getattr(own, name)]) for name in names}
    return own._replace(**both)


def _no_breaks(joined: np.ndarray) -> Breaks:
    """No breaks at all."""
    pairs, whole = np.zeros((0, 2, 2)), np.zeros((0, 2), np.int32)
    gap, place, near, ends = np.zeros((0, 3), np.int32), np.zeros((0, 2)), np.zeros(0, np.int32), np.zeros((0, 2), bool)
    return Breaks(gap, place, near, pairs, ends, pairs, pairs, whole, joined)


def _ends(gap: np.ndarray, fronts: Fronts) -> tuple[Fronts, Fronts, np.ndarray, np.ndarray]:
    """The fronts at both centres of gaps (M, 3), the first centres (M, 2), and steps (M, 2) to the others."""
    y, x, axis = gap.T
    step = np.column_stack([axis == 1, axis == 0])
    first, second = (_flat(fronts, y + k * step[:, 1], x + k * step[:, 0]) for k in (0, 1))
    return first, second, np.column_stack([x, y]) + 0.5, step.astype(float)


def _flat(fronts: Fronts, y: np.ndarray, x: np.ndarray) -> Fronts:
    return Fronts(*(table[y, x] for table in fronts))


def _smooth(fronts: Fronts, width: np.ndarray, y: np.ndarray, x: np.ndarray, axis: np.ndarray) -> np.ndarray:
    """Do depths from cells to the next ones along an axis change about as beside? (M,) bool; see `STEEP`."""
    depth = np.where(fronts.part >= 0, fronts.depth, np.nan)
    steps = [np.abs(np.diff(depth, axis=0, append=np.nan)), np.abs(np.diff(depth, axis=1, append=np.nan))]
    change = np.where(axis == 1, steps[1][y, x], steps[0][y, x])
    h, w = depth.shape
    after = np.where(axis == 1, steps[1][y, np.minimum(x + 1, w - 1)], steps[0][np.minimum(y + 1, h - 1), x])
    before = np.where(axis == 1, steps[1][y, np.maximum(x - 1, 0)], steps[0][np.maximum(y - 1, 0), x])
    beside = np.nan_to_num(np.fmin(before, after))
    return change <= STEEP * beside + RISE * (width[0] + width[1] * fronts.depth[y, x])


def _cut(gaps: _Lines, one: Fronts, other: Fronts, more: np.ndarray, oracle: Oracle) -> _Intervals:
    """Gaps cut where the sheets of either end come to an end, or their depths meet; intervals that are not joined.

    Args:
        gaps: the gaps.
        one: the fronts at their first centres.
        other: the fronts at their second centres.
        more: (M, P), further places to cut at.
        oracle: the scene.
    """
    end, count = gaps.start + gaps.step, len(gaps.start)
    ahead, ahead_depth, _ = oracle.walk(one, gaps.start, end)
    back, back_depth, _ = oracle.walk(other, end, gaps.start)
    with np.errstate(invalid="ignore", divide="ignore"):
        d0, d1 = back_depth - one.depth, other.depth - ahead_depth
        meet = np.where((ahead == 1) & (back == 1), d0 / (d0 - d1), np.nan)
    guesses = np.column_stack([ahead, 1 - back, meet])
    guesses[~((guesses > 0) & (guesses < 1))] = np.nan
    half = FINE * 0.4
    middle = np.where(np.isfinite(guesses).any(axis=1), np.nan, 0.5)
    places = np.column_stack([guesses - half, guesses + half, middle, more])
    places = np.sort(np.clip(places, FINE / 8, 1 - FINE / 8), axis=1)
    gap, column = np.nonzero(np.isfinite(places))
    place = places[gap, column]
    told = oracle.fronts(gaps.points(gap, place))
    # All places along all gaps, with the centres before and after.
    ids = np.concatenate([np.arange(count), gap, np.arange(count)])
    along = np.concatenate([np.zeros(count), place, np.ones(count)])
    every = Fronts.of([one, told, other])
    order = np.lexsort((along, ids))
    ids, along, every = ids[order], along[order], every.at(order)
    first = np.flatnonzero(ids[:-1] == ids[1:])
    intervals = _Intervals(ids[first], along[first], along[first + 1], every.at(first), every.at(first + 1))
    return intervals.at(np.flatnonzero(~_one_surface(intervals, gaps, oracle)))


def _one_surface(found: _Intervals, gaps: _Lines, oracle: Oracle) -> np.ndarray:
    """(M,) True for intervals whose ends lie on one sheet of triangles, or both see nothing.

    Where no triangles tell, two samples of a part are on one surface if their depths differ by little.
    """
    a, b = found.before, found.behind
    points = gaps.points(found.gap, found.low), gaps.points(found.gap, found.high)
    unknown = (a.part == b.part) & (a.part >= 0) & ~(oracle.knows(a) & oracle.knows(b))
    level = np.abs(a.depth - b.depth) <= RISE * (oracle.width[0] + oracle.width[1] * a.depth)
    return ((a.part < 0) & (b.part < 0)) | (unknown & level) | oracle.leads(a, points[0], b, points[1])


def _halved(found: _Intervals, gaps: _Lines, oracle: Oracle) -> _Intervals:
    """Intervals halved until they are `FINE`; a half whose ends are on one surface is dropped."""
    finished = []
    while True:
        fine = found.high - found.low <= FINE
        finished.append(found.at(np.flatnonzero(fine)))
        found = found.at(np.flatnonzero(~fine))
        if not len(found.gap):
            break
        middle = (found.low + found.high) / 2
        told = oracle.fronts(gaps.points(found.gap, middle))
        halves = [
            _Intervals(found.gap, found.low, middle, found.before, told),
            _Intervals(found.gap, middle, found.high, told, found.behind),
        ]
        drop = [_one_surface(half, gaps, oracle) for half in halves]
        # Where no triangles tell, the half in which the depth changes more has the break.
        unknown = (found.before.part == told.part) & (told.part == found.behind.part) & (told.part >= 0)
        unknown &= ~(oracle.knows(found.before) & oracle.knows(found.behind) & oracle.knows(told))
        changes = [np.abs(half.before.depth - half.behind.depth) for half in halves]
        drop[0] = np.where(unknown, changes[0] < changes[1], drop[0])
        drop[1] = np.where(unknown, changes[1] <= changes[0], drop[1])
        found = _Intervals.of([half.at(np.flatnonzero(~d)) for half, d in zip(halves, drop, strict=True)])
    return _Intervals.of(finished)


def _classified(
    found: _Intervals, gaps: _Lines, oracle: Oracle
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Places (M,) along gaps, `near` (M,), `slope` (M, 2, 2), and the indices of intervals that hold a break."""
    a, b, step = found.before, found.behind, gaps.step[found.gap]
    low, high = gaps.points(found.gap, found.low), gaps.points(found.gap, found.high)
    middle, length = (found.low + found.high) / 2, found.high - found.low
    at = gaps.points(found.gap, middle)
    planes = np.stack([oracle.planes(a, at), oracle.planes(b, at)], 1)
    slopes, known = planes[..., 1:], np.isfinite(planes).all(axis=(1, 2))
    missing = np.flatnonzero((a.part >= 0) & (b.part >= 0) & ~known)
    width = oracle.width[0] + oracle.width[1] * np.maximum(a.depth, b.depth)
    depth = np.where(np.isfinite(planes[..., 0]), planes[..., 0], np.stack([a.depth, b.depth], 1))
    apart = depth[:, 1] - depth[:, 0]
    rise = ((slopes[:, 1] - slopes[:, 0]) * step).sum(-1)  # Of the difference of depths along the gap.
    both = (a.part >= 0) & (b.part >= 0)
    with np.errstate(invalid="ignore", divide="ignore"):
        meets = both & (np.abs(apart) <= np.abs(np.nan_to_num(rise)) * length + SAME_DEPTH * 0.1 * depth.max(axis=1))
        meets[missing] |= np.abs(apart[missing]) <= 10 * FINE * width[missing]
        solved = middle - apart / rise
    # How far do the sheets go on behind one another?
    ahead, _, _ = oracle.walk(a, low, high + BESIDE * step)
    back, _, _ = oracle.walk(b, high, low - BESIDE * step)
    total = length + BESIDE
    goes_on = ~(ahead * total < length + BESIDE / 2), ~(back * total < length + BESIDE / 2)
    different = a.part != b.part
    told = known | different
    crosses = meets & goes_on[0] & goes_on[1] & told
    seam = meets & ~different & (~(goes_on[0] | goes_on[1]) | ~told)
    near = np.where(~both, np.where(a.part >= 0, 0, 1), np.where(apart >= 0, 0, 1))
    near = np.where(meets & goes_on[0] & ~goes_on[1], 1, np.where(meets & ~goes_on[0] & goes_on[1], 0, near))
    if len(missing) and crosses[missing].any():
        own = missing[crosses[missing]]
        slopes[own] = _sampled_slopes(found.at(own), gaps, oracle)
        rise[own] = ((slopes[own, 1] - slopes[own, 0]) * step[own]).sum(-1)
    flat = ~(np.abs(slopes[:, 1] - slopes[:, 0]).sum(-1) > 1e-4 * width)
    crosses &= np.isfinite(slopes).all(axis=(1, 2)) & ~flat
    near = np.where(crosses, 2, near).astype(np.int32)
    exact_a, exact_b = found.low + ahead * total, found.high - back * total
    place = np.where(near == 0, exact_a, np.where(near == 1, exact_b, np.where(known, solved, middle)))
    place = np.where(np.isfinite(place), np.clip(place, found.low, found.high), middle)
    slope = np.where(crosses[:, None, None], slopes, 0.0)
    return place, near, slope, np.flatnonzero(~seam)


def _sampled_slopes(found: _Intervals, gaps: _Lines, oracle: Oracle) -> np.ndarray:
    """Slopes of depth (M, 2, 2) on both sides of intervals, by samples on each side; NaN where there are none."""
    slopes = np.full((len(found.gap), 2, 2), np.nan)
    for side, (fronts, place, way) in enumerate(((found.before, found.low, -1), (found.behind, found.high, 1))):
        at, step = gaps.points(found.gap, place), gaps.step[found.gap]
        inward, across = way * BESIDE * step, BESIDE * step[:, ::-1]
        told = [oracle.fronts(at + inward), oracle.fronts(at + inward + across), oracle.fronts(at + inward - across)]
        same = [t.part == fronts.part for t in told]
        along = np.where(same[0], (told[0].depth - fronts.depth) / (way * BESIDE), np.nan)
        both = np.where(same[1] & same[2], (told[1].depth - told[2].depth) / (2 * BESIDE), np.nan)
        one = np.where(same[1], told[1].depth - told[0].depth, told[0].depth - told[2].depth) / BESIDE
        beside = np.where(np.isfinite(both), both, np.where(same[0] & (same[1] | same[2]), one, np.nan))
        slopes[:, side] = along[:, None] * step + beside[:, None] * step[:, ::-1]
    return slopes
