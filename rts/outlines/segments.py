"""Breaks joined into segments: the outlines between the centres of cells."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rts.compiling.threads import parallel
from rts.outlines.gaps import Breaks


class Segments(NamedTuple):
    """Segments of outlines; see `rts.outlines.found.Outlines`. Host arrays.

    Attributes:
        square: (S, 2) int32.
        ties: (S, 2) int32.
        square_sides: (S, 2) int32.
        hub: (S,) int32.
        beyond: (S, 2) int32.
        corner: (S, 2) float64.
        pull: (S, 4) float64.
    """

    square: np.ndarray
    ties: np.ndarray
    square_sides: np.ndarray
    hub: np.ndarray
    beyond: np.ndarray
    corner: np.ndarray
    pull: np.ndarray


def joined(breaks: Breaks, layered: bool = False) -> Segments:
    """The segments between breaks on the sides of squares of four centres.

    Outlines of one part do not cross. With `layered`, those of different parts may, since light passes through them.
    """
    from rts.outlines import segments_loops as loops

    size = breaks.joined.shape[1:]
    square, along, ends = loops.ends_of(breaks.gap, breaks.place, breaks.near, breaks.parts, *size)
    # By squares; in each of them clockwise, part by part if outlines may cross.
    group, order = square, square.argsort(kind="stable")
    loops.turn_clockwise(order, group, along)
    if layered:
        group = loops.groups_of(order, square, ends)
        order = group.argsort(kind="stable")
        loops.turn_clockwise(order, group, along)
    known = breaks.place, breaks.tangent
    of_breaks = *known, breaks.cells_away
    origin, ties, square_sides, neighbours = loops.segments_of(order, group, square, ends, *of_breaks, size[1])
    triangle = loops.ending(breaks.near, breaks.parts, breaks.triangles)
    corner, pull = np.empty((len(ties), 2)), np.empty((len(ties), 4))
    filled = origin, ties, square_sides, neighbours, *known, triangle, corner, pull
    parallel(loops.corners, len(ties), *filled, work=150 * len(ties))
    hub = np.zeros(len(ties), np.int32)
    loops.meet(origin, ties, square_sides, *known, breaks.near, hub, corner, pull, neighbours)
    return Segments(origin, ties, square_sides, hub, np.ascontiguousarray(neighbours[:, 1:3]), corner, pull)
