"""The tolerances and costs of outlines, one after the other: what each decides at 0.7 and at 1.4 times the number.

So a number that is half as large, or twice, fails. The numbers stand here once more, since what is drawn must not move
with them.
"""

import numpy as np
import pytest
from found_outlines import sampled_with_outlines
from helpers import pushed

import rts
from rts.outlines import segments_loops
from rts.outlines.gaps import Hits
from rts.outlines.halving import Oracle, find_crossings

torch = pytest.importorskip("torch")

pytestmark = pytest.mark.splatting

SIZE, DEPTH = 6, 5.0
CAMERA = rts.Camera.orthographic((0, 0, DEPTH), (0, 0, 0), height=SIZE, near=1, far=9)
"""A cell is as wide as a unit; centres lie at halves. Depths of what is at z = 0 are `DEPTH`."""
QUAD = np.array([(0, 1, 2), (0, 2, 3)], np.int32)
RED, GREEN = np.array([1.0, 0, 0]), np.array([0, 1.0, 0])
AROUND = pytest.mark.parametrize("share", [0.7, 1.4])
"""Shares of a number."""
TOUCH, ALIKE, BESIDE, PARALLEL, RISE, CUT = 2e-5, 1e-5, 0.1, 1e-3, 0.2, 1e-3
LARGE, CREASE = 16.0, np.radians(20)
LONE, ASIDE, ON_ONE_SIDE, OTHER_BEHIND, UNLIKE, FAR = 2.0, 0.4, 1.5, 0.5, 1.0, 4.0


def card(left, right, color, height=lambda x, y: 0.0 * x, half=10.0):
    """A card from `left` to `right`, higher than the image, nearer by `height`."""
    x, y = np.array([left, right, right, left]), half * np.array([-1.0, -1, 1, 1])
    return rts.Part(rts.Mesh(QUAD), {"vertices": np.column_stack([x, y, height(x, y)]), "color": color}, "unlit")


def drawn(parts):
    return np.asarray(rts.render(parts, CAMERA, (SIZE, SIZE)), np.float64)


@AROUND
def test_touch_is_the_width_of_what_counts(share):
    """A strip between centres, in cells, of which no centre sees anything."""
    width = share * TOUCH
    _, outlines = sampled_with_outlines(card(0.0, width, RED), CAMERA, (SIZE, SIZE))
    assert (len(outlines.gap) > 0) == (share > 1)


@AROUND
def test_alike_is_how_much_nearer_a_surface_is_before_another(share):
    """A strip of 0.6 cells between centres, before a card that covers all."""
    nearer = share * ALIKE * DEPTH
    image = drawn([card(-9, 9, RED), card(-0.3, 0.3, GREEN, lambda x, y: 0 * x + nearer)])
    assert image[..., 1].sum() / SIZE == pytest.approx(0.6 if share > 1 else 0.0, abs=1e-3)


@AROUND
def test_beside_is_how_far_from_an_edge_its_colour_is_that_of_a_sample(share):
    """A card ends at x = 0.2, in red as wide as this; the rest of it, which has no vertex in common, is green."""
    width = share * BESIDE
    corners = [[(a, -1, 0), (b, -1, 0), (b, 1, 0), (a, 1, 0)] for a, b in ((-1, 0.2 - width), (0.2 - width, 0.2))]
    mesh = rts.Mesh(np.concatenate([QUAD, QUAD + 4]).astype(np.int32))
    theta = {"vertices": np.reshape(corners, (8, 3)), "colors": np.repeat([GREEN, RED], 4, axis=0)}
    red, green = drawn(rts.Part(mesh, theta, "unlit"))[SIZE // 2, SIZE // 2, :2]
    assert (red > green) == (share > 1)


@AROUND
def test_parallel_is_the_turn_between_planes_that_cross(share):
    """Where z = slope · x and z = t, x = t / slope; as it rises, a plane that crosses another covers more of it."""
    slope = share * PARALLEL

    def image(t):
        still = card(-9, 9, RED, lambda x, y: slope * (x - 0.2))
        up = torch.eye(4, dtype=torch.float64) + t * torch.tensor(np.outer([0, 0, 1.0, 0], [0, 0, 0, 1.0]))
        return rts.render([still, card(-9, 9, GREEN).replace(transform=up)], CAMERA, (SIZE, SIZE))

    _, along = pushed(image)
    expected = SIZE / slope if share > 1 else 0.0
    assert along[..., 1].sum() == pytest.approx(expected, rel=0.02, abs=1)


@AROUND
def test_cut_is_how_far_from_a_cut_an_edge_moves_with_the_surface(share):
    """A card that ends at x = 0.2, and that the near plane cuts a little above a line of centres; it moves along x."""
    above = share * CUT

    def image(t):
        rising = card(-9, 0.2, RED, lambda x, y: DEPTH - 1 + y - 0.5 - above, half=2.5)
        along = torch.eye(4, dtype=torch.float64) + t * torch.tensor(np.outer([1.0, 0, 0, 0], [0, 0, 0, 1.0]))
        return rts.render(rising.replace(transform=along), CAMERA, (SIZE, SIZE))

    _, along = pushed(image)
    upper, lower = along[SIZE // 2 - 1, :, 3].sum(), along[SIZE // 2 + 1, :, 3].sum()
    assert lower == pytest.approx(1, abs=1e-3)
    assert (upper > 0.45) == (share > 1), upper


@AROUND
def test_rise_is_the_step_in_depth_that_surfaces_without_triangles_may_have(share):
    """A level surface, a half of which is nearer, in widths of cells."""
    width = 0.25

    def seen(points):
        depth = 2.0 - (points[:, 0] > 2.2) * share * RISE * width
        return Hits(np.zeros((1, len(depth)), np.int32), np.full((1, len(depth)), -1, np.int32), depth[None])

    centres = np.stack(np.meshgrid(np.arange(4) + 0.5, np.arange(4) + 0.5), -1).reshape(-1, 2)
    hits = Hits(*(x.reshape(1, 4, 4) for x in seen(centres)))
    crossings, _ = find_crossings(hits, Oracle(seen, np.array([width, 0.0])))
    assert len(crossings.gap) == (4 if share > 1 else 0)
    np.testing.assert_allclose(crossings.place[:, 0], 2.2, atol=TOUCH)


def joined(ends, directions=None, depths=None, behind=None):
    """The pairs of crossings that are joined in the dual cell between centres at (1.5, 1.5) and (2.5, 2.5).

    Args:
        ends: for each crossing, clockwise, its side (0 top to 3 left), its place there from the left or from above, and
            1 if the way clockwise leaves the surface there, −1 if it enters it.
        directions: angles of outlines to the right; None for unknown ones.
        depths: `Crossings.cells_away`.
        behind: the parts behind; None for none.
    """
    side, at, sign = (np.array(x) for x in zip(*ends, strict=True))
    gap = np.array([[(1, 1, 1), (1, 2, 0), (2, 1, 1), (1, 1, 0)][s] for s in side], np.int32)
    place = gap[:, 1::-1] + 0.5 + at[:, None] * np.column_stack([gap[:, 2], 1 - gap[:, 2]])
    kind = np.where((sign > 0) == (side < 2), 0, 1).astype(np.int32)
    parts = np.where(kind[:, None] == [0, 1], 0, np.full((len(ends), 1), -1) if behind is None else np.c_[behind])
    parts = parts.astype(np.int32)
    dual, along, rows = segments_loops.ends_of(gap, place, kind, parts, 5, 5)
    order = np.lexsort((along, dual))
    angle = np.array(directions if directions is not None else [0.0] * len(ends))
    tangent = np.column_stack([np.cos(angle), np.sin(angle)]) * (directions is not None)
    away = np.array(depths if depths is not None else [0.0] * len(ends))
    origin, endpoints, *_ = segments_loops.segments_of(order, dual, dual, rows, place, tangent, away, 5)
    inside = (origin == (1, 1)).all(axis=1) & (endpoints[:, 1] >= 0)
    return {tuple(sorted(pair)) for pair in endpoints[inside].tolist()}


def along(off, length):
    """What `off` and `length` cost, of which each end of a segment has its own; two lists of both."""
    return sum(ASIDE * x for x in off) + 2 * (0.5 - ASIDE) * length


@AROUND
def test_lone_is_the_cost_of_an_end(share):
    """An outline along a diagonal, and an end on each side that it meets: pairs on a side, or those two alone."""
    cost, each = share * LONE + along([0, 0], 2**0.5) / 2 - ON_ONE_SIDE, along([0.5**0.5, 1], 1)
    width = cost / each if share < 1 else 0.9
    apart = cost - width * each
    away = FAR * apart / (UNLIKE - apart)
    ends = [(0, 0.0, 1), (0, width, -1), (2, 1.0, -1), (2, 1 - width, 1)]
    found = joined(ends, [np.pi / 4, np.pi / 2, np.pi / 4, np.pi / 2], [0.0, away, 0.0, away])
    assert found == ({(0, 1), (2, 3)} if share < 1 else {(0, 2)})


@pytest.mark.parametrize("share", [0.7, 1.25])
def test_on_one_side_is_how_far_outlines_lead_aside_before_they_are_those_of_two_tips(share):
    """Something thin enters at the top, and something at the bottom: one thing that goes through, or two that end."""
    cost = share * ON_ONE_SIDE - along([0, 0], 1)
    off = min(cost / (2 * ASIDE), 1.0)
    apart = cost - along([off, off], 0)
    away = FAR * apart / (UNLIKE - apart)
    ends = [(0, 0.5, 1), (0, 0.50001, -1), (2, 0.50001, 1), (2, 0.5, -1)]
    found = joined(ends, [np.pi / 2 - np.arcsin(off)] * 4, [0.0, 0.0, away, away])
    assert found == ({(0, 3), (1, 2)} if share < 1 else {(0, 1), (2, 3)})


def aside(cost):
    """How far aside of a straight way across a dual cell a segment ends that costs so much more."""
    found = np.linspace(0, 1, 10001)
    return found[np.searchsorted(along([found, found], np.hypot(1, found)) - along([0, 0], 1), cost)]


@AROUND
def test_other_behind_is_what_an_outline_costs_that_goes_on_before_another_part(share):
    ends = [(0, 0.1, 1), (2, 0.1 + aside(share * OTHER_BEHIND), -1), (2, 0.1, -1)]
    assert joined(ends, [np.pi / 2] * 3, behind=[1, 1, 2]) == ({(0, 1)} if share < 1 else {(0, 2)})


def test_unlike_is_what_an_outline_costs_that_goes_on_far_away():
    """It goes on aside for 0.7 of it, straight on rather than come back by the side that it came in at for 1.3."""
    down, far = [np.pi / 2] * 3, 1e6
    ends = [(0, 0.1, 1), (2, 0.1 + aside(0.7 * UNLIKE), -1), (2, 0.1, -1)]
    assert joined(ends, down, [0.0, 0.0, far]) == {(0, 1)}
    assert ON_ONE_SIDE - along([0, 0], 1) == pytest.approx(1.3 * UNLIKE)
    assert joined([(0, 0.5, 1), (0, 0.50001, -1), (2, 0.5, -1)], down, [0.0, 0.0, far]) == {(0, 2)}


@AROUND
def test_far_is_the_distance_in_depth_that_counts_half(share):
    """An outline goes on straight to a surface that ends farther off, or aside to one at its own depth."""
    ends = [(0, 0.1, 1), (2, 0.1 + aside(UNLIKE / 2), -1), (2, 0.1, -1)]
    found = joined(ends, [np.pi / 2] * 3, [0.0, 0.0, share * FAR])
    assert found == ({(0, 2)} if share < 1 else {(0, 1)})


@pytest.mark.parametrize("share", [0.7, 1.1])
def test_aside_is_the_share_of_direction_beside_length(share):
    """An outline goes straight across, or a shorter way, at right angles, to the side beside: for this share either."""
    short = along([0, 0], 1) + 2 * ASIDE * (1 - share)
    ends = [(0, 1 - short, 1), (1, 0.0, -1), (2, 1 - short, -1)]
    assert joined(ends, [np.pi / 2] * 3) == ({(0, 2)} if share < 1 else {(0, 1)})


def seam(height, turn=0.0):
    """How much of a pixel's red, 0.2 of it, is seen where a red triangle meets a green one, without a vertex in common.

    Both are four cells wide, and as high as twice `height`; the surface turns there.
    """
    back = -4 * np.tan(turn / 2)
    triangles = np.array([[(0.2, -1, 0), (0.2, 1, 0), (0.2 + way * 4, 0, back / height)] for way in (-1, 1)]) * [
        1,
        height,
        height,
    ]
    colors = np.repeat([RED, GREEN], 3, axis=0)
    mesh = rts.Mesh(np.arange(6, dtype=np.int32).reshape(2, 3))
    part = rts.Part(mesh, {"vertices": triangles.reshape(-1, 3), "colors": colors}, "unlit")
    return drawn(part)[SIZE // 2, SIZE // 2, 0]


@AROUND
def test_large_is_the_area_of_triangles_whose_seams_count(share):
    assert seam(share * LARGE / 4) == pytest.approx(0.2 if share > 1 else 0.0, abs=1e-3)


@AROUND
def test_crease_is_the_cosine_of_the_turn_at_which_seams_count(share):
    assert seam(2.0, share * CREASE) == pytest.approx(0.2 if share > 1 else 0.0, abs=1e-3)
