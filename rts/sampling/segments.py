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
        beyond: (S, 4) int32.
    """

    square: np.ndarray
    ties: np.ndarray
    side: np.ndarray
    beyond: np.ndarray


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
    inside = ((squares >= 0) & (squares < np.array(breaks.joined.shape[1:]) - 1)).all(axis=1)
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
    return Segments(*(x.astype(np.int32) for x in (squares[i], ties, sides, beyond)))


def _beyond(ties: np.ndarray, count: int) -> np.ndarray:
    """`Outlines.beyond` (S, 4) of segments between `count` breaks."""
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
