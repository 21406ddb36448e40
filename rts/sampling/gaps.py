"""Breaks in gaps: the places between neighbouring centres where one front ends and another begins.

Where triangles do not tell, the fronts at two neighbouring centres are one surface if their depths differ about as much
as beside. Else the line between the centres is halved until each break is known.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

FINE = 1e-4
"""Length of the interval, in cells, in which a break is known to lie."""

INNER = 0.1
"""Distance from a break, in cells, of the samples that tell colours; half the way to the next break if that is less."""

BESIDE = 0.05
"""Distance from a crossing, in cells, of the samples that tell how depths change."""

STEEP, RISE = 1.5, 0.1
"""Two fronts of a part may be two surfaces if their depths differ by more than so many times the least difference
beside them, plus this share of a cell's width."""


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
        width: the width of a cell at a depth: `width[0] + width[1] * depth`.
    """

    fronts: Callable[[np.ndarray], Fronts]
    width: np.ndarray

    def widths(self, depth: np.ndarray) -> np.ndarray:
        """The width of cells at depths."""
        return self.width[0] + self.width[1] * depth


class Breaks(NamedTuple):
    """Breaks, those of a gap in order along it. Host arrays; see `rts.contracts.records.Outlines`.

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
        triangles: (B, 4) int32, the triangles of these samples, in order; −1 where none is known.
        tangent: (B, 2) float64, the outline's unit direction in the image, either way; 0 where it is unknown.
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
    triangles: np.ndarray
    tangent: np.ndarray


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
    axis, y, x = np.mgrid[:2, :height, :width].reshape(3, -1)
    gap = np.column_stack([y, x, axis])[(x + axis < width) & (y + 1 - axis < height)].astype(np.int32)
    one, other, start, step = _ends(gap, fronts)
    same, seen = (one.part == other.part) & (one.part >= 0), (one.part >= 0) | (other.part >= 0)
    joined = np.zeros((2, height, width), bool)
    joined[1 - gap[:, 2], gap[:, 0], gap[:, 1]] = same
    at = np.flatnonzero(seen & ~(same & _smooth(fronts, oracle, *gap.T)))
    gap, gaps = gap[at], _Lines(start[at], step[at])
    ends = np.arange(len(at)), np.zeros(len(at)), np.ones(len(at))
    found = _halved(_Intervals(*ends, one.at(at), other.at(at)), gaps, oracle)
    found = found.at(np.lexsort((found.low, found.gap)))
    near, slope, kept = _classified(found, gaps, oracle)
    found, number = found.at(kept), found.gap[kept]
    joined[1 - gap[number, 2], gap[number, 0], gap[number, 1]] = False
    first, last = np.diff(number, prepend=-1) != 0, np.diff(number, append=-1) != 0
    low, high = found.low, found.high
    inner = [
        low - np.minimum(INNER, (low - np.where(first, 0.0, np.roll(high, 1))) / 2),
        high + np.minimum(INNER, (np.where(last, 1.0, np.roll(low, -1)) - high) / 2),
    ]
    return Breaks(
        gap[number],
        gaps.points(number, (low + high) / 2),
        near[kept],
        slope[kept],
        np.stack([first, last], 1),
        np.stack([gaps.points(number, low), gaps.points(number, high)], 1),
        np.stack([gaps.points(number, at) for at in inner], 1),
        np.stack([found.before.part, found.behind.part], 1),
        joined,
        np.full((len(number), 4), -1, np.int32),
        np.zeros((len(number), 2)),
    )


def _ends(gap: np.ndarray, fronts: Fronts) -> tuple[Fronts, Fronts, np.ndarray, np.ndarray]:
    """The fronts at both centres of gaps (M, 3), the first centres (M, 2), and steps (M, 2) to the others."""
    y, x, axis = gap.T
    step = np.column_stack([axis == 1, axis == 0])
    first, second = (Fronts(*(table[y + k * step[:, 1], x + k * step[:, 0]] for table in fronts)) for k in (0, 1))
    return first, second, np.column_stack([x, y]) + 0.5, step.astype(float)


def _smooth(fronts: Fronts, oracle: Oracle, y: np.ndarray, x: np.ndarray, axis: np.ndarray) -> np.ndarray:
    """Do depths from cells to the next ones along an axis change about as beside? (M,) bool; see `STEEP`."""
    depth = np.where(fronts.part >= 0, fronts.depth, np.nan)
    steps = [np.abs(np.diff(depth, axis=0, append=np.nan)), np.abs(np.diff(depth, axis=1, append=np.nan))]
    change = np.where(axis == 1, steps[1][y, x], steps[0][y, x])
    h, w = depth.shape
    after = np.where(axis == 1, steps[1][y, np.minimum(x + 1, w - 1)], steps[0][np.minimum(y + 1, h - 1), x])
    before = np.where(axis == 1, steps[1][y, np.maximum(x - 1, 0)], steps[0][np.maximum(y - 1, 0), x])
    beside = np.nan_to_num(np.fmin(before, after))
    return change <= STEEP * beside + RISE * oracle.widths(fronts.depth[y, x])


def _one_surface(found: _Intervals, oracle: Oracle) -> np.ndarray:
    """(M,) True for intervals whose ends see one part at nearly one depth, or both see nothing."""
    a, b = found.before, found.behind
    level = np.abs(a.depth - b.depth) <= RISE * oracle.widths(a.depth)
    return (a.part == b.part) & ((a.part < 0) | level)


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
        # Within one part the half in which the depth changes more has the break.
        alike = (found.before.part == told.part) & (told.part == found.behind.part)
        changes = [np.abs(half.before.depth - half.behind.depth) for half in halves]
        drop = [_one_surface(half, oracle) for half in halves]
        drop = [drop[0] | (alike & (changes[0] < changes[1])), drop[1] | (alike & (changes[1] <= changes[0]))]
        found = _Intervals.of([half.at(np.flatnonzero(~d)) for half, d in zip(halves, drop, strict=True)])
    return _Intervals.of(finished)


def _classified(found: _Intervals, gaps: _Lines, oracle: Oracle) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """`near` (M,) and `slope` (M, 2, 2) of breaks, and the indices of intervals that hold one."""
    a, b = found.before, found.behind
    both, apart = (a.part >= 0) & (b.part >= 0), b.depth - a.depth
    meets = both & (np.abs(apart) <= 10 * FINE * oracle.widths(np.maximum(a.depth, b.depth)))
    near = np.where(both, apart < 0, a.part < 0).astype(np.int32)
    slope, crosses = np.zeros((len(near), 2, 2)), np.flatnonzero(meets & (a.part != b.part))
    if len(crosses):
        found_slopes = _sampled_slopes(found.at(crosses), gaps, oracle)
        turn = np.abs(found_slopes[:, 1] - found_slopes[:, 0]).sum(-1)
        there = turn > 1e-4 * oracle.widths(a.depth[crosses])  # False for NaN.
        near[crosses[there]], slope[crosses[there]] = 2, found_slopes[there]
    return near, slope, np.flatnonzero(~(meets & (a.part == b.part)))


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
