"""Crossings where triangles do not tell them: lines between neighbouring centres are halved.

There the layers at two neighbouring centres are the same surfaces if their depths differ about as much as beside. Else
the line between the centres is halved until each crossing is known.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from rts.outlines.edge_kinds import BEFORE_ENDS, BEHIND_ENDS, INTERSECT
from rts.outlines.gaps import Crossings, Hits, Stacks
from rts.outlines.tolerances import BESIDE, PARALLEL, RISE, TOUCH

FINE = 5 * TOUCH
"""Length, in cells, to which gaps are halved. Rays end as near to a surface as that; each halving is a sample more."""


class Oracle(NamedTuple):
    """A scene that can be sampled at any point.

    Attributes:
        layers: points (M, 2) → the K layers there, nothing behind an opaque one.
        width: the width of a cell at a depth: `width[0] + width[1] * depth`.
    """

    layers: Callable[[np.ndarray], Hits]
    width: np.ndarray

    def widths(self, depth: np.ndarray) -> np.ndarray:
        """The width of cells at depths."""
        return self.width[0] + self.width[1] * depth


class _Intervals(NamedTuple):
    """Intervals of gaps whose ends see other surfaces: the gap's index, two places along it, and the layers there."""

    gap: np.ndarray
    low: np.ndarray
    high: np.ndarray
    before: Hits
    behind: Hits

    def at(self, index: np.ndarray) -> _Intervals:
        places = self.gap[index], self.low[index], self.high[index]
        return _Intervals(*places, self.before.at(index), self.behind.at(index))

    @classmethod
    def of(cls, several: Sequence[_Intervals]) -> _Intervals:
        """Several intervals, one after the other."""
        gap, low, high = (np.concatenate([one[i] for one in several]) for i in range(3))
        return cls(gap, low, high, Hits.of([one.before for one in several]), Hits.of([one.behind for one in several]))


class _Lines(NamedTuple):
    """Gaps: centres (M, 2), and unit steps (M, 2) along rows or columns."""

    start: np.ndarray
    step: np.ndarray

    def points(self, gap: np.ndarray, place: np.ndarray) -> np.ndarray:
        """Points (N, 2) at places along gaps."""
        return self.start[gap] + place[:, None] * self.step[gap]


class Hints(NamedTuple):
    """Places in gaps where something may be that neither centre sees. Host arrays.

    Attributes:
        gap: (N, 3) int32, see `Gaps`.
        place: (N,) float64, between 0 and 1.
    """

    gap: np.ndarray
    place: np.ndarray


def find_crossings(layers: Hits, oracle: Oracle, hints: Hints | None = None) -> tuple[Crossings, Stacks]:
    """The crossings between the layers that the centres of cells see, and the stacks of layers beside each crossing.

    Args:
        layers: what is seen at centres, arrays (K, H, W).
        oracle: tells what is seen anywhere else.
        hints: places where something may be that no centre sees. A gap whose two centres see the same is looked at only
            if it has hints, and at their places first.
    """
    _, height, width = layers.part.shape
    axis, y, x = np.mgrid[:2, :height, :width].reshape(3, -1)
    gap = np.column_stack([y, x, axis])[(x + axis < width) & (y + 1 - axis < height)].astype(np.int32)
    one, other, start, step = _ends(gap, layers)
    same, seen = (one.part == other.part).all(0), (one.part[0] >= 0) | (other.part[0] >= 0)
    joined = np.zeros((2, height, width), bool)
    joined[1 - gap[:, 2], gap[:, 0], gap[:, 1]] = same & seen
    at = np.flatnonzero(seen & ~(same & _smooth(layers, oracle, *gap.T)))
    hinted, place = np.empty(0, np.int64), np.empty(0)
    if hints is not None:
        hinted, place = _unsearched(hints, gap, at, (height, width))
    count, further = len(at), np.unique(hinted)
    at, hinted = np.concatenate([at, further]), count + np.searchsorted(further, hinted)
    gap, gaps = gap[at], _Lines(start[at], step[at])
    found = _halved(_intervals(count, one.at(at), other.at(at), hinted, place, gaps, oracle), gaps, oracle)
    found = found.at(np.lexsort((found.low, found.gap)))
    number, low, high = found.gap, found.low, found.high
    joined[1 - gap[number, 2], gap[number, 0], gap[number, 1]] = False
    first, last = np.diff(number, prepend=-1) != 0, np.diff(number, append=-1) != 0
    inner = [
        low - np.minimum(BESIDE, (low - np.where(first, 0.0, np.roll(high, 1))) / 2),
        high + np.minimum(BESIDE, (np.where(last, 1.0, np.roll(low, -1)) - high) / 2),
    ]
    points, beside = (np.stack([gaps.points(number, at) for at in two], 1) for two in ((low, high), inner))
    change = _Change.of(found, oracle)
    kind, slope = change.classified(found, gaps, oracle)
    crossings = Crossings(
        gap[number],
        gaps.points(number, (low + high) / 2),
        kind,
        slope,
        np.stack([first, last], 1),
        points,
        beside,
        change.parts(kind),
        joined,
        np.full((len(number), 4), -1, np.int32),
        np.where(
            (kind == INTERSECT)[:, None], lines_of_intersection(slope), _directions(found, gap[number], gaps, oracle)
        ),
        cells_away(change.depth(kind), oracle.width),
    )
    return crossings, change.stacks(kind, points, beside)


def _unsearched(
    hints: Hints, gap: np.ndarray, searched: np.ndarray, size: tuple[int, int]
) -> tuple[np.ndarray, np.ndarray]:
    """The hints in gaps that are not searched anyway: indices (N,) in `gap` (M, 3), and places (N,), both in order."""
    number = np.full((2, *size), -1)
    number[gap[:, 2], gap[:, 0], gap[:, 1]] = np.arange(len(gap))
    number[gap[searched, 2], gap[searched, 0], gap[searched, 1]] = -1
    y, x, axis = hints.gap.T
    index = number[axis, y, x]
    order = np.lexsort((hints.place, index))
    order = order[index[order] >= 0]
    return index[order], hints.place[order]


def _intervals(
    count: int, one: Hits, other: Hits, hinted: np.ndarray, place: np.ndarray, gaps: _Lines, oracle: Oracle
) -> _Intervals:
    """The intervals to halve: the first `count` gaps, whose ends see `one` and `other`; others between their hints.

    `hinted` (N,) are the gaps of hints, which are at places (N,), in order.
    """
    whole = np.arange(count)
    found = _Intervals(whole, np.zeros(count), np.ones(count), one.at(whole), other.at(whole))
    if not len(hinted):
        return found
    seen = oracle.layers(gaps.points(hinted, place))
    first, last = np.diff(hinted, prepend=-1) != 0, np.diff(hinted, append=-1) != 0
    n = np.arange(len(hinted))
    # What is seen at hints, then at first centres, then at second ones.
    every = Hits.of([seen, one.at(hinted), other.at(hinted)])
    before, ends = np.where(first, len(n) + n, n - 1), np.flatnonzero(last)
    low = np.where(first, 0.0, np.roll(place, 1))
    return _Intervals.of(
        [
            found,
            _Intervals(hinted, low, place, every.at(before), seen),
            _Intervals(hinted[ends], place[ends], np.ones(len(ends)), seen.at(ends), every.at(2 * len(n) + ends)),
        ]
    )


def _directions(found: _Intervals, gap: np.ndarray, gaps: _Lines, oracle: Oracle) -> np.ndarray:
    """Unit directions (B, 2) of outlines at crossings: each is sought again on a line `BESIDE` cells away.

    They are 0 where nothing is found there, and where a dual cell has no more than two crossings, so that it is plain
    which belong together.

    Args:
        found: the interval of each crossing, in which it was found.
        gap: (B, 3), see `Gaps`.
        gaps: the lines on which the intervals lie.
        oracle: tells what is seen anywhere.
    """
    y, x, axis = gap.T
    squares = (y + 1 - axis, x + axis), (y + 1, x + 1)
    count = np.zeros((y.max(initial=0) + 2, x.max(initial=0) + 2), int)
    for square in squares:
        np.add.at(count, square, 1)
    at = np.flatnonzero(np.maximum(count[squares[0]], count[squares[1]]) > 2)
    direction = np.zeros((len(gap), 2))
    if not len(at):
        return direction
    both, shift = found.at(np.tile(at, 2)), np.repeat([-BESIDE, BESIDE], len(at))
    step = gaps.step[both.gap]
    start = gaps.points(both.gap, (both.low + both.high) / 2) + shift[:, None] * step[:, ::-1]

    def before(place: np.ndarray) -> np.ndarray:
        seen = oracle.layers(start + place[:, None] * step)
        return _unlike(seen, both.before) < _unlike(seen, both.behind)

    low, high = np.full(len(shift), -4 * BESIDE), np.full(len(shift), 4 * BESIDE)
    known = before(low) & ~before(high)
    while (high - low).max() > FINE:
        middle = (low + high) / 2
        first = before(middle)
        low, high = np.where(first, middle, low), np.where(first, high, middle)
    # The mean of one or both sides; 0 where neither shows the outline.
    known, change = known.reshape(2, -1), np.where(known, low / shift, 0.0).reshape(2, -1)
    way = step[: len(at), ::-1] + (change.sum(0) / np.maximum(known.sum(0), 1))[:, None] * step[: len(at)]
    direction[at] = (known.sum(0) > 0)[:, None] * way / np.linalg.norm(way, axis=1, keepdims=True)
    return direction


def _unlike(a: Hits, b: Hits) -> np.ndarray:
    """(M,) how far layers are from others, by depth; far where their parts differ."""
    return np.where(a.part == b.part, np.abs(a.depth - b.depth), 1e30).sum(0)


def cells_away(depth: np.ndarray, width: np.ndarray) -> np.ndarray:
    """`Crossings.cells_away` (B,) at depths (B,); `width` as in `Oracle`."""
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.log(width[0] + width[1] * depth) / width[1] if width[1] > 0 else depth / width[0]


def lines_of_intersection(slope: np.ndarray) -> np.ndarray:
    """Unit directions (B, 2) in the image of the lines where surfaces intersect, from both slopes; 0 where these agree.

    Args:
        slope: (B, 2, 2), see `Crossings.slope`.
    """
    difference = slope[:, 1] - slope[:, 0]
    length = np.hypot(*difference.T)
    return np.column_stack([difference[:, 1], -difference[:, 0]]) / np.where(length > 0, length, 1.0)[:, None]


def _ends(gap: np.ndarray, layers: Hits) -> tuple[Hits, Hits, np.ndarray, np.ndarray]:
    """The layers at both centres of gaps (M, 3), the first centres (M, 2), and steps (M, 2) to the others."""
    y, x, axis = gap.T
    step = np.column_stack([axis == 1, axis == 0])
    first, second = (Hits(*(table[:, y + k * step[:, 1], x + k * step[:, 0]] for table in layers)) for k in (0, 1))
    return first, second, np.column_stack([x, y]) + 0.5, step.astype(float)


def _smooth(layers: Hits, oracle: Oracle, y: np.ndarray, x: np.ndarray, axis: np.ndarray) -> np.ndarray:
    """Do depths from cells to the next ones along an axis change about as beside? (M,) bool; see `RISE`."""
    depth = np.where(layers.part >= 0, layers.depth, np.nan)
    steps = [np.abs(np.diff(depth, axis=1, append=np.nan)), np.abs(np.diff(depth, axis=2, append=np.nan))]
    change = np.where(axis == 1, steps[1][:, y, x], steps[0][:, y, x])
    _, h, w = depth.shape
    after = np.where(axis == 1, steps[1][:, y, np.minimum(x + 1, w - 1)], steps[0][:, np.minimum(y + 1, h - 1), x])
    before = np.where(axis == 1, steps[1][:, y, np.maximum(x - 1, 0)], steps[0][:, np.maximum(y - 1, 0), x])
    beside = np.nan_to_num(np.fmin(before, after))
    steep = change > beside + RISE * oracle.widths(layers.depth[:, y, x])
    return np.logical_not(steep.any(0))


def _level(a: Hits, b: Hits, oracle: Oracle) -> np.ndarray:
    """True for layers of one part, or none, at nearly one depth; see `RISE`."""
    level = np.abs(a.depth - b.depth) <= RISE * oracle.widths(a.depth)
    return (a.part == b.part) & ((a.part < 0) | level)


def _halved(found: _Intervals, gaps: _Lines, oracle: Oracle) -> _Intervals:
    """Intervals halved until they are `FINE`; those in which surfaces go on, and halves with level ends, are dropped.

    A scene is sampled for two halvings at once: fewer calls cost less than the samples that prove to be of no use.
    """
    finished = []
    while True:
        fine = found.high - found.low <= FINE
        # Hints may be as close to one another, where nothing changes.
        finished.append(found.at(np.flatnonzero(fine & ~_level(found.before, found.behind, oracle).all(0))))
        found = found.at(np.flatnonzero(~fine))
        if not len(found.gap):
            break
        middle, quarter = (found.low + found.high) / 2, (found.high - found.low) / 4
        places = middle - quarter, middle, middle + quarter
        gap = np.concatenate([found.gap] * len(places))
        seen = oracle.layers(gaps.points(gap, np.concatenate(places)))
        low, middle, high = np.arange(len(gap)).reshape(len(places), -1)
        steps = [found.before, *map(seen.at, (low, middle, high)), found.behind]
        broken = np.flatnonzero(~_goes_on(steps, oracle))
        found, low, middle, high = found.at(broken), low[broken], middle[broken], high[broken]
        found, (first, second) = _halves(found, seen.at(middle), oracle)
        found, _ = _halves(found, seen.at(np.concatenate([low[first], high[second]])), oracle)
    return _Intervals.of(finished)


def _goes_on(steps: Sequence[Hits], oracle: Oracle) -> np.ndarray:
    """(M,) True where the layers at places that follow one another change about evenly; see `RISE`."""
    part, depth = (np.stack([x[i] for x in steps]) for i in (0, 2))
    change = np.abs(np.diff(depth, axis=0))
    none = np.full_like(change[:1], np.inf)
    beside = np.minimum(np.concatenate([none, change[:-1]]), np.concatenate([change[1:], none]))
    even = change <= beside + RISE * oracle.widths(depth[:1])
    return (part == part[:1]).all((0, 1)) & even.all((0, 1))


def _halves(found: _Intervals, in_middle: Hits, oracle: Oracle) -> tuple[_Intervals, list[np.ndarray]]:
    """The halves of intervals in which a surface may end, all first ones before all second ones.

    `in_middle` is what is seen in the middle of each interval. The second result are the intervals' indices, of both.
    """
    middle = (found.low + found.high) / 2
    halves = [
        _Intervals(found.gap, found.low, middle, found.before, in_middle),
        _Intervals(found.gap, middle, found.high, in_middle, found.behind),
    ]
    # Within the same parts the half in which a depth changes more has the crossing.
    alike = ((found.before.part == in_middle.part) & (in_middle.part == found.behind.part)).all(0)
    changes = [np.abs(half.before.depth - half.behind.depth).max(0) for half in halves]
    drop = [_level(half.before, half.behind, oracle).all(0) for half in halves]
    drop = [drop[0] | (alike & (changes[0] < changes[1])), drop[1] | (alike & (changes[1] <= changes[0]))]
    kept = [np.flatnonzero(~d) for d in drop]
    return _Intervals.of([half.at(index) for half, index in zip(halves, kept, strict=True)]), kept


class _Change(NamedTuple):
    """Changes of surfaces in fine intervals.

    Attributes:
        sides: the layers (K, B) before and behind.
        goes_on: for each side (K, B) int, the layer of the other side that is the same surface, or −1.
        first: (B,) the first layer in which the sides differ.
        ends: for each side (B,) its first layer that does not go on; `first` where all do, in another order.
        kind: (B,) int32, the side whose such layer is nearer.
    """

    sides: tuple[Hits, Hits]
    goes_on: tuple[np.ndarray, np.ndarray]
    first: np.ndarray
    ends: tuple[np.ndarray, np.ndarray]
    kind: np.ndarray

    @classmethod
    def of(cls, found: _Intervals, oracle: Oracle) -> _Change:
        """The changes in intervals."""
        sides, index = (found.before, found.behind), np.arange(len(found.before.part))
        a, b = (Hits(*(np.expand_dims(x, axis) for x in side)) for side, axis in zip(sides, (1, 0), strict=True))
        distance = np.where(_level(a, b, oracle) & (a.part >= 0), np.abs(a.depth - b.depth), np.inf)
        one = (distance == distance.min(0)) & (distance == distance.min(1)[:, None]) & np.isfinite(distance)
        # Within the same parts the layer whose depth changes most ends, as others may be steep.
        count, alike = len(one), (found.before.part == found.behind.part).all(0)
        most = np.abs(found.before.depth - found.behind.depth).argmax(0)
        in_order = np.eye(count, dtype=bool)[..., None] & (np.arange(count)[:, None] != most)[:, None] & (a.part >= 0)
        one = np.where(alike, in_order, one)
        behind, before = (np.where(one.any(axis), one.argmax(axis), -1) for axis in (1, 0))
        first = (~one[index, index] & ((found.before.part >= 0) | (found.behind.part >= 0))).argmax(0)
        lone = [(side.part >= 0) & (other < 0) for side, other in zip(sides, (behind, before), strict=True)]
        swapped = ~(lone[0].any(0) | lone[1].any(0))
        ends = np.where(swapped, first, lone[0].argmax(0)), np.where(swapped, first, lone[1].argmax(0))
        depths = [
            np.where(alone.any(0) | swapped, side.of_layer(at).depth, np.inf)
            for alone, side, at in zip(lone, sides, ends, strict=True)
        ]
        return cls(sides, (behind, before), first, ends, (depths[1] < depths[0]).astype(np.int32))

    def moves(self, kind: np.ndarray) -> list[np.ndarray]:
        """For each side the layer (B,) that moves the crossing if the other does not; of INTERSECT, those that do."""
        return [np.where(kind == INTERSECT, self.first, at) for at in self.ends]

    def parts(self, kind: np.ndarray) -> np.ndarray:
        """(B, 2) int32, the part that moves the crossing and what is behind it, or those that intersect, by sides."""
        at = np.where(kind == INTERSECT, self.first, np.where(kind == BEHIND_ENDS, self.ends[1], self.ends[0]))
        return np.stack([side.of_layer(at).part for side in self.sides], 1)

    def depth(self, kind: np.ndarray) -> np.ndarray:
        """(B,) the depth of the surface that ends, or of one that intersects another."""
        depths = [side.of_layer(at).depth for side, at in zip(self.sides, self.moves(kind), strict=True)]
        return np.where(kind == BEHIND_ENDS, depths[1], depths[0])

    def classified(self, found: _Intervals, gaps: _Lines, oracle: Oracle) -> tuple[np.ndarray, np.ndarray]:
        """`kind` (B,) and `slope` (B, 2, 2) of crossings."""
        kind, slope = self.kind.copy(), np.zeros((len(self.kind), 2, 2))
        a, b = (side.of_layer(self.first) for side in self.sides)
        level = np.abs(b.depth - a.depth) <= PARALLEL * oracle.widths(np.maximum(a.depth, b.depth))
        meets = np.flatnonzero((a.part >= 0) & (b.part >= 0) & (a.part != b.part) & level)
        if len(meets):
            slopes = _sampled_slopes(found.at(meets), self.first[meets], gaps, oracle)
            turn = np.abs(slopes[:, 1] - slopes[:, 0]).sum(-1)
            there = turn > PARALLEL * oracle.widths(a.depth[meets])  # False for NaN.
            kind[meets[there]], slope[meets[there]] = INTERSECT, slopes[there]
        return kind, slope

    def stacks(self, kind: np.ndarray, points: np.ndarray, inner: np.ndarray) -> Stacks:
        """The stacks; layers that go on are sampled once, at `points` (B, 2, 2), others at `inner` (B, 2, 2)."""
        (a, b), (behind, before), layers = self.sides, self.goes_on, len(self.goes_on[0])
        lone = (b.part >= 0) & (before < 0)
        there = np.concatenate([a.part >= 0, lone])
        depth = np.where(there, np.concatenate([a.depth, b.depth]), np.inf)
        order = np.argsort(depth, axis=0, kind="stable")
        place = np.argsort(order, axis=0)
        place = np.where(there & (place <= layers), place, -1)
        order = order[: layers + 1]
        placed = place[:layers], np.where(lone, place[layers:], np.take_along_axis(place, np.maximum(before, 0), 0))
        sides = np.stack([placed[0].T, np.where(b.part >= 0, placed[1], -1).T], 1)
        part = np.where(there, np.concatenate([a.part, b.part]), -1)
        at = np.where((behind >= 0)[..., None], points[:, 0], inner[:, 0])
        at = np.concatenate([at, np.broadcast_to(inner[:, 1], (layers, *inner[:, 1].shape))])
        numbers = [_numbers(side.part) for side in self.sides]
        moves = np.stack([np.take_along_axis(n, m[None], 0)[0] for n, m in zip(numbers, self.moves(kind), strict=True)])
        numbers = np.concatenate([moves, np.take_along_axis(np.concatenate(numbers), order, 0)])
        last = np.where(
            (kind[:, None] == INTERSECT) | (kind[:, None] == [BEFORE_ENDS, BEHIND_ENDS]), self.parts(kind), -1
        )
        part = np.take_along_axis(part, order, 0)
        at = np.take_along_axis(at, order[..., None], 0)
        return Stacks(last, part.T, np.full(part.T.shape, -1, np.int32), at.transpose(1, 0, 2), sides, numbers.T)


def _numbers(part: np.ndarray) -> np.ndarray:
    """For layers (K, M), how many of the same part are in front."""
    return np.stack([(part[:k] == layer).sum(0) for k, layer in enumerate(part)])


def _sampled_slopes(found: _Intervals, layer: np.ndarray, gaps: _Lines, oracle: Oracle) -> np.ndarray:
    """Slopes of depth (M, 2, 2) of a layer (M,) on both sides of intervals; NaN where they are unknown."""
    slopes = np.full((len(found.gap), 2, 2), np.nan)
    for side, (seen, place, way) in enumerate(((found.before, found.low, -1), (found.behind, found.high, 1))):
        front, number = seen.of_layer(layer), _numbers(seen.part)[layer, np.arange(len(layer))]
        at, step = gaps.points(found.gap, place), gaps.step[found.gap]
        inward, across = way * BESIDE * step, BESIDE * step[:, ::-1]
        depths = [_depth_of(front, number, oracle.layers(at + inward + k * across)) for k in (0, 1, -1)]
        same = [np.isfinite(t) for t in depths]
        along = (depths[0] - front.depth) / (way * BESIDE)
        both = (depths[1] - depths[2]) / (2 * BESIDE)
        one = np.where(same[1], depths[1] - depths[0], depths[0] - depths[2]) / BESIDE
        beside = np.where(np.isfinite(both), both, one)
        slopes[:, side] = along[:, None] * step + beside[:, None] * step[:, ::-1]
    return slopes


def _depth_of(front: Hits, number: np.ndarray, layers: Hits) -> np.ndarray:
    """The depth (M,) of the layer of a front's part with as many of the same part before it; NaN if there is none."""
    same = (layers.part == front.part) & (_numbers(layers.part) == number)
    return np.where(same.any(0), layers.of_layer(same.argmax(0)).depth, np.nan)
