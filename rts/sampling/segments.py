"""Breaks joined into segments: the outlines between the centres of cells."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rts.sampling.gaps import Breaks


class Segments(NamedTuple):
    """Segments of outlines; see `rts.contracts.records.Outlines`. Host arrays.

    Attributes:
        square: (S, 2) int32.
        ties: (S, 2) int32.
        side: (S, 2) int32.
        beyond: (S, 2) int32.
        corner: (S, 2) float64.
        pull: (S, 4) float64.
    """

    square: np.ndarray
    ties: np.ndarray
    side: np.ndarray
    beyond: np.ndarray
    corner: np.ndarray
    pull: np.ndarray


def joined(breaks: Breaks) -> Segments:
    """The segments between breaks on the sides of squares of four centres."""
    from rts.sampling import segments_loops

    y, x, axis = breaks.gap.T
    along = np.where(axis == 1, breaks.place[:, 0] - x, breaks.place[:, 1] - y) - 0.5
    row = axis == 1
    # Each break lies on a side of two squares: above and below a row's gap, left and right of a column's.
    squares = np.concatenate([np.column_stack([y - row, x - ~row]), np.column_stack([y, x])])
    side = np.concatenate([np.where(row, 2, 1), np.where(row, 0, 3)]).astype(np.int32)
    number = np.tile(np.arange(len(y), dtype=np.int32), 2)
    along = np.choose(side, [t := np.tile(np.clip(along, 0, 1 - 1e-9), 2), 1 + t, 3 - t, 4 - t])
    clockwise = np.where(side < 2, 1, -1)
    sign = np.array([1, -1, 0])[breaks.near[number]] * clockwise
    parts, near = breaks.parts[number], breaks.near[number]
    low, high = parts.min(axis=1), parts.max(axis=1)
    own = np.where(near == 1, parts[:, 1], parts[:, 0])
    other = np.where(near == 1, parts[:, 0], parts[:, 1])
    front, back = np.where(near == 2, low, own), np.where(near == 2, high, other)
    # Squares beyond the grid have no corners.
    inside = np.all((squares >= 0) & (squares < np.array(breaks.joined.shape[1:]) - 1), axis=1)
    order = np.lexsort((along, squares[:, 1], squares[:, 0]))
    order = order[inside[order]]
    squares, side, number, along, sign = squares[order], side[order], number[order], along[order], sign[order]
    begins = np.flatnonzero(np.any(np.diff(squares, axis=0, prepend=-9) != 0, axis=1))
    begins = np.append(begins, len(squares)).astype(np.int64)
    partner = np.full(len(squares), -1, np.int32)
    place = np.ascontiguousarray(breaks.place[number])
    segments_loops.join(begins, along, sign, front[order], back[order], place, partner)
    # Of two ends the one that leaves the front comes first; of two that cross, the earlier.
    ends = np.arange(len(squares))
    first = (partner < 0) | (sign > 0) | ((sign == 0) & (sign[partner] == 0) & (ends < partner))
    first |= (sign == 0) & (partner >= 0) & (sign[partner] < 0)
    i, j = ends[first], partner[first]
    lone = j < 0
    ties = np.column_stack([number[i], np.where(lone, -1, number[j])])
    sides = np.column_stack([side[i], np.where(lone, -1, side[j])])
    beyond = _beyond(ties, len(y))
    corner, pull = _corners(squares[i] + 0.5, ties, beyond, breaks.place)
    corner = corner - (squares[i][:, ::-1] + 0.5)
    square, ties, sides, beyond = (np.asarray(x, np.int32) for x in (squares[i], ties, sides, beyond[:, 1:3]))
    return Segments(square, ties, sides, beyond, corner, pull)


def _beyond(ties: np.ndarray, count: int) -> np.ndarray:
    """(S, 4): the last break but one along the same outline, the last, the next, and the next but one; −1 for none.

    `ties` (S, 2) are the ends of segments, between `count` breaks.
    """
    # Each break ends at most two segments, in the squares on its two sides.
    s, end = np.nonzero(ties >= 0)
    order = np.argsort(ties[s, end], kind="stable")
    s, end, tied = s[order], end[order], ties[s, end][order]
    pair = np.flatnonzero(tied[1:] == tied[:-1])
    next_segment, next_end = np.full((len(ties), 2), -1), np.zeros((len(ties), 2), int)
    for a, b in ((pair, pair + 1), (pair + 1, pair)):
        next_segment[s[a], end[a]], next_end[s[a], end[a]] = s[b], end[b]

    def step(segment: np.ndarray, end: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The next segment at an end of each, its far end, and the break there; −1 for none."""
        known = segment >= 0
        beside = np.where(known, next_segment[segment, end], -1)
        far = 1 - next_end[segment, end]
        return beside, far, np.where(beside >= 0, ties[beside, far], -1)

    found, segments = np.full((len(ties), 4), -1), np.arange(len(ties))
    for at, columns in ((0, (1, 0)), (1, (2, 3))):
        one, far, found[:, columns[0]] = step(segments, np.full(len(ties), at))
        _, _, found[:, columns[1]] = step(one, far)
    return found


def _corners(
    origin: np.ndarray, ties: np.ndarray, beyond: np.ndarray, place: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """`Outlines.corner` and `Outlines.pull` of segments.

    Where an outline turns at a segment alone, the lines before and after it meet in its corner. Where it turns as much
    at its neighbours, it is a curve. Its tangents at the ends run as from the break before each to the one after; the
    curve is two thirds as far from the chord as their meeting.

    Args:
        origin: (S, 2), y and x of the first corner of each square.
        ties: (S, 2), the ends of segments.
        beyond: (S, 4), the result of `_beyond`.
        place: (B, 2), x and y of breaks.
    """
    start, end, sharp, alone, meets = _turns(ties, beyond, place)
    low = origin[:, ::-1]

    def inside(corner: np.ndarray) -> np.ndarray:
        return np.asarray(np.all((corner >= low) & (corner <= low + 1), axis=1))

    before, after, chord = place[beyond[:, 1]], place[beyond[:, 2]], end - start
    known = (beyond[:, 1] >= 0) & (beyond[:, 2] >= 0)
    round_, rounds = _meeting(start, end - before, end, after - start)
    rounds &= known & inside(round_)
    middle = start + chord / 2
    round_ = np.where(rounds[:, None], middle + (2 / 3) * (round_ - middle), middle)
    alone = np.where(meets & inside(sharp), alone, 0.0)[:, None]
    corner = np.where(alone > 0, (1 - alone) * round_ + alone * sharp, round_)
    share = np.clip((((corner - start) * chord).sum(1) / np.maximum((chord**2).sum(1), 1e-12)), 0, 1)
    # The corner of two straight lines moves as both of them say; a point of a curve as the ends of its chord do.
    pull = np.column_stack([0 * share, 1 - share, share, 0 * share])
    with np.errstate(invalid="ignore", divide="ignore"):
        on = np.linalg.norm(corner - start, axis=1) / np.linalg.norm(start - before, axis=1)
        back = np.linalg.norm(corner - end, axis=1) / np.linalg.norm(after - end, axis=1)
    steady = (alone[:, 0] > 0) & (on < 2) & (back < 2)
    on, back = np.where(steady, on, 0.0), np.where(steady, back, 0.0)
    lines = np.column_stack([-on, 1 + on, 1 + back, -back]) / 2
    return corner, np.where(steady[:, None], (1 - alone) * pull + alone * lines, pull)


def _turns(ties: np.ndarray, beyond: np.ndarray, place: np.ndarray) -> tuple[np.ndarray, ...]:
    """Where outlines turn: starts and ends of segments, and where the lines before and after meet, (S, 2) each.

    Also (S,) how much of the turn is this segment's alone, from 0 for a curve to 1 for a corner, and True where the
    lines meet between start and end.
    """
    start, end = place[ties[:, 0]], place[np.where(ties[:, 1] >= 0, ties[:, 1], ties[:, 0])]
    points, known = place[np.where(beyond >= 0, beyond, 0)], beyond >= 0
    ahead, back = start - points[:, 1], points[:, 2] - end
    corner, meets = _meeting(start, ahead, end, back)
    beside = np.where(known[:, 0], _angle(points[:, 1] - points[:, 0], ahead), 0.0)
    beside += np.where(known[:, 3], _angle(back, points[:, 3] - points[:, 2]), 0.0)
    alone = np.clip(1 - beside / np.maximum(_angle(ahead, back), 1e-6), 0, 1)
    return start, end, corner, alone, meets & known[:, 1] & known[:, 2]


def _meeting(start: np.ndarray, ahead: np.ndarray, end: np.ndarray, back: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where lines from `start` along `ahead` and to `end` along `back` meet (S, 2); True if that is between them."""
    turn = _cross(ahead, back)
    there = np.abs(turn) > 1e-9
    meeting = start + (_cross(end - start, back) / np.where(there, turn, 1.0))[:, None] * ahead
    between = (((meeting - start) * ahead).sum(1) >= 0) & (((end - meeting) * back).sum(1) >= 0)
    return meeting, there & between


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]


def _angle(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Angles (S,) between vectors (S, 2), 0 to π."""
    return np.abs(np.arctan2(_cross(a, b), (a * b).sum(1)))
