"""Breaks joined into segments: the outlines between the centres of cells."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rts.compiling.threads import parallel
from rts.outlines.gaps import Breaks


class Segments(NamedTuple):
    """Segments of outlines; see `rts.contracts.records.Outlines`. Host arrays.

    Attributes:
        square: (S, 2) int32.
        ties: (S, 2) int32.
        square_sides: (S, 2) int32.
        beyond: (S, 2) int32.
        corner: (S, 2) float64.
        pull: (S, 4) float64.
    """

    square: np.ndarray
    ties: np.ndarray
    square_sides: np.ndarray
    beyond: np.ndarray
    corner: np.ndarray
    pull: np.ndarray


def joined(breaks: Breaks, layered: bool = False) -> Segments:
    """The segments between breaks on the sides of squares of four centres.

    Outlines of one part do not cross. With `layered`, those of different parts may, since light passes through them.
    """
    from rts.outlines import segments_loops as loops

    height, width = breaks.joined.shape[1:]
    square, along, ends = loops.ends_of(breaks.gap, breaks.place, breaks.near, breaks.parts, height, width)
    # By squares; in each of them clockwise, part by part if outlines may cross.
    group = square * (1 + breaks.parts.max(initial=0)) + ends[:, 3] if layered else square
    order = np.argsort(group + 1j * along, kind="stable")  # By both parts, and faster than lexsort.
    square, ends = square.take(order), ends.take(order, 0)
    begins = np.append(np.flatnonzero(np.diff(group[order], prepend=-1)), len(square))
    partner = np.full(len(square), -1, np.int32)
    loops.join(begins, ends, breaks.place, breaks.tangent, partner)
    origin, ties, square_sides = loops.segments_of(square, ends, partner, width)
    around = loops.beyond(ties, len(breaks.place))
    corner, pull = np.empty((len(ties), 2)), np.empty((len(ties), 4))
    ending = np.arange(len(breaks.near)), np.where(breaks.near == 1, 1, 0)
    triangle, part = breaks.triangles[ending].astype(np.int64), breaks.parts[ending]
    triangle = np.where(
        triangle >= 0, triangle + part * (1 + triangle.max(initial=0)), -1
    )  # Of all parts, no two alike.
    of_breaks = breaks.place, breaks.tangent, triangle
    parallel(
        loops.corners, len(ties), origin, ties, square_sides, around, *of_breaks, corner, pull, work=300 * len(ties)
    )
    return Segments(origin, ties, square_sides, np.ascontiguousarray(around[:, 1:3]), corner, pull)
