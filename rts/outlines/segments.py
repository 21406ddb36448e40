"""Crossings joined into segments: the outlines between the centres of cells."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rts.compiling.threads import parallel
from rts.outlines import corners_loops
from rts.outlines import segments_loops as loops
from rts.outlines.gaps import Crossings


class Segments(NamedTuple):
    """Pieces of outlines, each in a dual cell, from one crossing to another. Host arrays.

    Attributes:
        dual: (S, 2) int32, the first corner (y, x) of each segment's dual cell.
        endpoints: (S, 2) int32, the two crossings of each segment; the near surface lies to the right of the way from
            one to the other. −1 in second place if a crossing is alone. Segments of one dual cell follow one another.
        dual_sides: (S, 2) int32, the sides of the dual cell that these lie on: 0 top, 1 right, 2 bottom, 3 left; or −1.
        junction: (S,) int32, how many rows farther on there is the segment, of the same dual cell, that the outline of
            a lone crossing ends at, or that this one crosses; 0 for none. It does so at its `corner`. Then `adjacent`
            has the crossings of that segment, and `pull` weights of their motions, first and last, whose sum is about
            the motion of that segment's corner. Lone crossings with no segment beside them have the first of them as
            their junction.
        adjacent: (S, 2) int32, the crossings along the same outline before and after these two; −1 for none.
        corner: (S, 2) float64, a point between the two where the outline turns: x and y from the dual cell's first
            centre.
        pull: (S, 4) float64, weights of the motions of the crossing before, of these two, and of the one after, whose
            sum is the motion of the corner.
    """

    dual: np.ndarray
    endpoints: np.ndarray
    dual_sides: np.ndarray
    junction: np.ndarray
    adjacent: np.ndarray
    corner: np.ndarray
    pull: np.ndarray


def joined(crossings: Crossings, layered: bool = False) -> Segments:
    """The segments between crossings on the sides of dual cells.

    Outlines of one part do not cross. With `layered`, those of different parts may, since light passes through them.
    """
    size = crossings.joined.shape[1:]
    dual, along, ends = loops.ends_of(crossings.gap, crossings.place, crossings.kind, crossings.parts, *size)
    # By dual cells; in each of them clockwise, part by part if outlines may cross.
    group, order = dual, dual.argsort(kind="stable")
    loops.turn_clockwise(order, group, along)
    if layered:
        group = loops.groups_of(order, dual, ends)
        order = group.argsort(kind="stable")
        loops.turn_clockwise(order, group, along)
    known = crossings.place, crossings.tangent
    found = loops.segments_of(order, group, dual, ends, *known, crossings.cells_away, size[1])
    origin, endpoints, dual_sides, neighbours = found
    triangle = loops.ending(crossings.kind, crossings.parts, crossings.triangles)
    count, adjacent = len(endpoints), np.empty((len(endpoints), 2), np.int32)
    numbers = np.zeros(count, np.int32), adjacent, np.empty((count, 2)), np.empty((count, 4))
    segments = Segments(origin, endpoints, dual_sides, *numbers)
    parallel(corners_loops.corners, count, segments, neighbours, *known, triangle, work=150 * count)
    corners_loops.join_lone_ends(segments, neighbours, *known)
    adjacent[:] = neighbours[:, 1:3]
    return segments
