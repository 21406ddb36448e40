"""Points where outlines meet: edges that end behind another surface, panes that cross. Closed forms of polygons."""

import numpy as np
import pytest
from cards import SIZE, SQUARE, card, covered, flat, in_pixels, turned
from found_outlines import sampled_with_outlines
from helpers import pushed

import rts

torch = pytest.importorskip("torch")

pytestmark = pytest.mark.splatting

NEAR, FAR = turned(SQUARE, 0.2, (10.2, 12)), turned(SQUARE * 1.2, -0.3, (14, 11.6))
RED, GREEN = (1.0, 0, 0), (0, 1.0, 0)


def common(one, other):
    """The polygon that two convex ones have in common; corners (C, 2), clockwise in the image."""
    for a, b in zip(other, np.roll(other, -1, axis=0), strict=True):
        way, kept = b - a, []
        sides = way[0] * (one - a)[:, 1] - way[1] * (one - a)[:, 0]
        for p, q, sp, sq in zip(one, np.roll(one, -1, axis=0), sides, np.roll(sides, -1), strict=True):
            if sp >= 0:
                kept.append(p)
            if sp * sq < 0:
                kept.append(p + (q - p) * sp / (sp - sq))
        one = np.array(kept).reshape(-1, 2)
    return one


def pair(near, far, move=None):
    """An image of a card before another one, moved if `move` is given."""
    vertices = flat(near, 3.0)
    return rts.render(
        [card(vertices if move is None else move(vertices), RED), card(flat(far, 4.0), GREEN)], in_pixels(), SIZE
    )


def expected(near, far):
    """What is seen of both cards (H, W, 2)."""
    hidden = common(far, near)
    return np.stack([covered(near, SIZE), covered(far, SIZE) - covered(hidden, SIZE)], axis=-1)


def panes(near, far, alphas, move=None):
    """An image of a pane of glass before another one; if `move` is given, the near one is moved."""
    unlit, parts = rts.plugin("shaders", "unlit")(opaque=False), []
    for corners, depth, color, alpha in ((near, 3.0, RED, alphas[0]), (far, 4.0, GREEN, alphas[1])):
        vertices = flat(corners, depth)
        vertices = vertices if move is None or depth > 3 else move(vertices)
        colors = np.tile(np.float32([*color, alpha]), (4, 1))
        parts.append(card(vertices).replace(theta={"vertices": vertices, "colors": colors}, shader=unlit))
    return rts.render(parts, in_pixels(), SIZE)


def composites(near, far, alphas):
    """What is seen of both panes (H, W, 2)."""
    (a, b), both = alphas, covered(common(far, near), SIZE)
    return np.stack([a * covered(near, SIZE), b * (covered(far, SIZE) - a * both)], axis=-1)


PLACES = [(0.0, 0.0), (0.3, 0.45), (0.71, 0.13), (0.5, 0.5)]


@pytest.mark.parametrize("shift", PLACES)
def test_a_card_before_another_has_the_colours_of_both_by_area(shift):
    image = pair(NEAR + shift, FAR)
    errors = np.abs(image[..., :2] - expected(NEAR + shift, FAR)).max(-1)
    # Where a corner lies in the square of another edge, up to three pixels are off.
    assert np.sort(errors.ravel())[-4] < 1e-4 and errors.max() < 0.2
    assert image[..., 3].max() < 1 + 1e-6 and image.min() >= 0


@pytest.mark.parametrize("shift", PLACES[:3])
def test_it_moves_as_polygons_do(shift):
    way, step = np.array([0.6, -0.3]), 1e-5
    velocity = torch.tensor([*way, 0.0], dtype=torch.float32)
    near = NEAR + shift
    _, derivative = pushed(lambda t: pair(near, FAR, lambda v: torch.as_tensor(v) + t * velocity))
    truth = (expected(near + step * way, FAR) - expected(near - step * way, FAR)) / (2 * step)
    error = np.linalg.norm(derivative[..., :2] - truth) / np.linalg.norm(truth)
    assert error < 0.08


ALPHAS = [(0.5, 0.7), (0.9, 0.9), (0.2, 0.5)]


@pytest.mark.parametrize("alphas", ALPHAS)
@pytest.mark.parametrize("shift", PLACES)
def test_outlines_of_glass_cross_in_a_pixel_by_area(shift, alphas):
    errors = np.abs(panes(NEAR + shift, FAR, alphas)[..., :2] - composites(NEAR + shift, FAR, alphas)).max(-1)
    # Where a corner lies in the square of another edge, up to three pixels are off.
    assert np.sort(errors.ravel())[-4] < 1e-4 and errors.max() < 0.08


@pytest.mark.parametrize("alphas", ALPHAS)
@pytest.mark.parametrize("shift", PLACES[:3])
def test_crossing_outlines_move_each_with_its_pane(shift, alphas):
    way, step, near = np.array([0.6, -0.3]), 1e-5, NEAR + shift
    velocity = torch.tensor([*way, 0.0], dtype=torch.float32)
    _, derivative = pushed(lambda t: panes(near, FAR, alphas, lambda v: torch.as_tensor(v) + t * velocity))
    truth = composites(near + step * way, FAR, alphas) - composites(near - step * way, FAR, alphas)
    np.testing.assert_allclose(derivative[..., :2], truth / (2 * step), atol=1e-4)


@pytest.mark.parametrize("seam", [8.0, 8.3, 8.5, 8.83])
def test_cards_side_by_side_leave_no_trace_of_their_seam(seam):
    left, right = ([(3.0, 3), (seam, 3), (seam, 12.4), (3, 12.4)], [(seam, 3), (13.2, 3), (13.2, 12.4), (seam, 12.4)])
    parts = [card(flat(np.array(corners)), color) for corners, color in ((left, RED), (right, GREEN))]
    image = rts.render(parts, in_pixels(), SIZE)
    shares = np.stack([covered(np.array(corners), SIZE) for corners in (left, right)], axis=-1)
    np.testing.assert_allclose(image[..., :2], shares, atol=2e-3)
    np.testing.assert_allclose(image[..., 3], shares.sum(-1), atol=2e-3)


@pytest.mark.parametrize("seed", range(4))
def test_colours_of_heaps_of_cards_stay_in_range(seed):
    random, parts = np.random.default_rng(seed), []
    for _ in range(30):
        corners = turned(SQUARE * random.uniform(0.2, 0.8, 2), random.uniform(0, 3), random.uniform(2, 22, 2))
        vertices = flat(corners, 3.0) - np.float32([0, 0, 1]) * random.uniform(0, 4, (4, 1)).astype(np.float32)
        parts.append(card(vertices, random.random(3)))
    image = rts.render(parts, in_pixels(), SIZE)
    assert image.min() >= -1e-5 and image.max() <= 1 + 1e-5


@pytest.mark.parametrize("opaque", [True, False])
def test_surfaces_that_pass_through_one_another_give_one_image_in_any_order(opaque):
    """Large triangles at random, each a part of its own, of which most cross others."""
    corners = np.random.default_rng(4).normal(size=(6, 3, 3)) * [8, 8, 2] + [12, 12, 8]
    shader, mesh = rts.plugin("shaders", "unlit")(opaque=opaque), rts.plugin("surfaces", "mesh")(np.array([(0, 1, 2)]))
    parts = []
    for n, vertices in enumerate(corners * [1, 1, -1]):
        colors = np.tile([n / 5, 1 - n / 5, 0.5, 1.0 if opaque else 0.6], (3, 1))
        parts.append(rts.Part(mesh, {"vertices": vertices, "colors": colors}, shader))
    image = rts.render(parts, in_pixels(), SIZE)
    assert (sampled_with_outlines(parts, in_pixels(), SIZE)[1].kind == 2).sum() > 10
    for order in ([5, 4, 3, 2, 1, 0], [2, 0, 4, 5, 1, 3]):
        np.testing.assert_allclose(rts.render([parts[i] for i in order], in_pixels(), SIZE), image, rtol=0, atol=1e-6)
