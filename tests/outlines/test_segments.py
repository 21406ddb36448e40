"""Crossings joined into segments: where their ends lie on dual cells, and which way outlines run."""

import numpy as np
import pytest

from rts.outlines import segments_loops as loops

pytestmark = pytest.mark.sampling

WIDTH = 5


def test_ends_lie_clockwise_on_the_sides_of_the_dual_cells_beside_their_gaps():
    """A crossing at 0.3 of each side of the dual cell (1, 1): 0.3 along the top, 1.3 on the right, then back."""
    gap = np.array([(1, 1, 1), (1, 2, 0), (2, 1, 1), (1, 1, 0)], np.int32)
    step = np.column_stack([gap[:, 2], 1 - gap[:, 2]])
    place = gap[:, 1::-1] + 0.5 + 0.3 * step
    dual, along, ends = loops.ends_of(gap, place, np.zeros(4, np.int32), np.zeros((4, 2), np.int32), 5, WIDTH)
    own = dual == WIDTH + 1
    found = {int(side): (int(b), at, int(way)) for (b, side, way, *_), at in zip(ends[own], along[own], strict=True)}
    assert set(found) == {0, 1, 2, 3}
    # Clockwise, the way along the upper and the right side leaves what lies before their crossings.
    expected = {0: (0, 0.3, 1), 1: (1, 1.3, 1), 2: (2, 2.7, -1), 3: (3, 3.7, -1)}
    for side, (b, at, way) in expected.items():
        assert found[side][0] == b and found[side][2] == way and found[side][1] == pytest.approx(at)


def segments_between(gap, place, kind):
    """Squares, endpoints and sides of the segments between crossings of one part, before nothing."""
    gap, place, kind = np.array(gap, np.int32), np.array(place), np.array(kind, np.int32)
    parts = np.where(kind[:, None] == [0, 1], 0, -1).astype(np.int32)
    dual, along, ends = loops.ends_of(gap, place, kind, parts, 5, WIDTH)
    order = np.lexsort((along, dual))
    return loops.segments_of(order, dual, dual, ends, place, np.zeros((len(place), 2)), np.zeros(len(place)), WIDTH)


@pytest.mark.parametrize("kind", [0, 1])
def test_a_segment_starts_where_the_way_clockwise_leaves_the_front(kind):
    """An outline from top to bottom through the dual cell (1, 1); what ends lies on its left, or on its right."""
    _, endpoints, side, _ = segments_between([(1, 1, 1), (2, 1, 1)], [(1.8, 1.5), (1.8, 2.5)], [kind, kind])
    across = [tuple(t) for t, s in zip(endpoints.tolist(), side.tolist(), strict=True) if min(s) >= 0]
    assert across == [(0, 1) if kind == 0 else (1, 0)]


def test_the_crossings_before_and_after_a_segment_are_in_order():
    """An outline from top to bottom through all rows of centres."""
    places = [(1.8, y + 0.5) for y in range(5)]
    _, endpoints, _, around = segments_between([(y, 1, 1) for y in range(5)], places, [0] * 5)
    np.testing.assert_array_equal(endpoints, [(0, 1), (1, 2), (2, 3), (3, 4)])
    np.testing.assert_array_equal(around, [(-1, -1, 2, 3), (-1, 0, 3, 4), (0, 1, 4, -1), (1, 2, -1, -1)])


OUTLINE, ENTERS, CROSSING = 1, -1, 0
"""Kinds of ends: where the way around a dual cell leaves a front, where it enters it, and at an intersection."""


@pytest.mark.parametrize("names", [(0, 1, 2), (2, 1, 0), (1, 2, 0)])
@pytest.mark.parametrize(
    ("kinds", "expected"),
    [
        # Outlines of glass cross: those of each part are joined.
        ([(OUTLINE, 0), (OUTLINE, 1), (ENTERS, 0), (ENTERS, 1)], [0, 1, 0, 1]),
        # Something opaque hides the rest of an outline, which the line of intersection goes on as.
        ([(OUTLINE, 0), (CROSSING, 0, 1)], [0, 0]),
        ([(CROSSING, 0, 1), (OUTLINE, 1), (OUTLINE, 0), (ENTERS, 0)], [0, 0, 2, 2]),
        # A line of intersection ends at an outline that goes through the dual cell, and meets those of others anywhere.
        ([(OUTLINE, 0), (CROSSING, 0, 1), (ENTERS, 0)], [0, 1, 0]),
        ([(CROSSING, 0, 1), (CROSSING, 1, 2), (CROSSING, 1, 0), (CROSSING, 2, 1)], [0, 1, 0, 1]),
    ],
)
def test_ends_of_glass_are_grouped_alike_whichever_part_comes_first(names, kinds, expected):
    ends = np.zeros((len(kinds), 5), np.int32)
    for e, (kind, *parts) in enumerate(kinds):
        front, back = names[parts[0]], names[parts[1]] if len(parts) > 1 else -1
        if kind == CROSSING:
            front, back = min(front, back), max(front, back)
        ends[e] = e, e % 4, kind, front, back
    dual, order = np.full(len(kinds), 7), np.arange(len(kinds))
    assert loops.groups_of(order, dual, ends).tolist() == expected
