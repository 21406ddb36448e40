"""Found edges of stacks of layers that light passes through: closed forms of panes of glass, and what stays hidden."""

import numpy as np
import pytest
from cards import SIZE, SQUARE, TWO, covered, in_pixels, turned
from helpers import pushed

import rts

torch = pytest.importorskip("torch")
forward = pytest.importorskip("torch.autograd.forward_ad")

pytestmark = pytest.mark.splatting

RED, GREEN, BLUE = np.eye(3)
EVERYWHERE = np.array([[-9.0, -9], [40, -9], [40, 40], [-9, 40]])


def pane(corners, depth, color, alpha, t=0.0, velocity=(0.0, 0, 0), faces=TWO):
    """A sheet at a depth, or at one for each corner, that moves with t; its colours are not premultiplied."""
    z = np.broadcast_to(-np.asarray(depth, float), (len(corners),))
    vertices = torch.tensor(np.column_stack([corners, z]), dtype=torch.float32)
    vertices = vertices + t * torch.tensor(np.asarray(velocity), dtype=torch.float32)
    colors = np.concatenate([np.broadcast_to(color, (len(corners), 3)), np.full((len(corners), 1), alpha)], 1)
    shader = rts.plugin("shaders", "unlit")(opaque=alpha == 1)
    return rts.Part(rts.Mesh(faces), {"vertices": vertices, "colors": colors.astype(np.float32)}, shader)


def drawn(parts, layers=4, **options):
    return rts.render(parts, in_pixels(), SIZE, splatter="edges", layers=layers, **options)


def rate(corners, velocity):
    """The derivative of the covered areas as corners move."""
    step = 1e-5 * np.asarray(velocity)
    return (covered(corners + step, SIZE) - covered(corners - step, SIZE)) / 2e-5


def over(*layers):
    """The composite (4,) of layers (colour, alpha) front to back."""
    total = np.zeros(4)
    for color, alpha in reversed(layers):
        total = np.array([*(alpha * np.asarray(color)), alpha]) + (1 - alpha) * total
    return total


HALF = np.array([[-9.0, -9], [12.3, -9], [12.3, 40], [-9, 40]])
OTHER = np.array([[6.7, -9], [40, -9], [40, 40], [6.7, 40]])


@pytest.mark.parametrize("moves", ["upper", "lower"])
def test_half_planes_of_glass_have_areas_times_composites(moves):
    """The upper covers x < 12.3, the lower x > 6.7; one moves to the right."""
    upper, lower = (RED, 0.4), (GREEN, 0.7)

    def scene(t):
        by = {moves: (t, (1.0, 0, 0))}
        return drawn([pane(HALF, 3, *upper, *by.get("upper", ())), pane(OTHER, 5, *lower, *by.get("lower", ()))])

    image, derivative = pushed(scene)
    left, right = covered(HALF, SIZE)[..., None], covered(OTHER, SIZE)[..., None]
    both, alone, behind = over(upper, lower), over(upper), over(lower)
    truth = left * right * both + left * (1 - right) * alone + (1 - left) * right * behind
    np.testing.assert_allclose(image, truth, atol=2e-4)
    inside = np.s_[3:-3]
    if moves == "upper":
        expected = rate(HALF, (1, 0))[..., None] * (both - behind)
    else:
        expected = rate(OTHER, (1, 0))[..., None] * (both - alone)
    np.testing.assert_allclose(derivative[inside], expected[inside], atol=2e-3)


def test_a_pane_before_glass_and_a_card_has_the_motion_of_its_polygon():
    corners = turned(SQUARE, 0.3, (12.2, 11.7))
    layers = (RED, 0.5), (GREEN, 0.6), (BLUE, 1.0)

    def scene(t):
        first = pane(corners, 3, *layers[0], t, (1.0, 0.3, 0))
        return drawn([first, pane(EVERYWHERE, 4, *layers[1]), pane(EVERYWHERE, 5, *layers[2])])

    image, derivative = pushed(scene)
    area = covered(corners, SIZE)[..., None]
    jump = over(*layers) - over(*layers[1:])
    np.testing.assert_allclose(image, over(*layers[1:]) + area * jump, atol=1e-3)
    np.testing.assert_allclose(derivative, rate(corners, (1.0, 0.3))[..., None] * jump, atol=2e-3)


def test_a_card_behind_glass_moves_in_its_colour():
    corners = turned(SQUARE, 0.3, (12.2, 11.7))
    glass, card = (RED, 0.4), (GREEN, 1.0)

    def scene(t):
        return drawn([pane(EVERYWHERE, 3, *glass), pane(corners, 5, *card, t, (0.2, 1.0, 0))])

    image, derivative = pushed(scene)
    jump = over(glass, card) - over(glass)
    np.testing.assert_allclose(image, over(glass) + covered(corners, SIZE)[..., None] * jump, atol=1e-3)
    np.testing.assert_allclose(derivative, rate(corners, (0.2, 1.0))[..., None] * jump, atol=2e-3)


def test_edges_that_cross_in_the_image_keep_their_own_motion():
    """A pane and a card behind it, whose outlines cross: the card's edge goes on under the glass."""
    near, far = turned(SQUARE, 0.2, (10.2, 12)), turned(SQUARE * 1.1, -0.3, (14, 11.6))
    glass, card = (RED, 0.4), (GREEN, 1.0)

    def scene(t):
        return drawn([pane(near, 3, *glass), pane(far, 5, *card, t, (1.0, 0, 0))])

    _, derivative = pushed(scene)
    a = covered(near, SIZE)[..., None]
    truth = rate(far, (1.0, 0))[..., None] * (a * (over(glass, card) - over(glass)) + (1 - a) * over(card))
    assert np.linalg.norm(derivative - truth) < 0.05 * np.linalg.norm(truth)
    # Where outlines cross, colours beside them change within a pixel.
    assert (np.abs(derivative - truth).max(-1) > 0.01).sum() <= 8


def test_panes_that_cross_have_the_line_where_they_meet():
    """Depths 20 + a (x − 12.2) and 20 − a (x − 12.2) + t: the line is at x = 12.2 + t / (2 a)."""
    tilt, first, second = 0.7, (RED, 0.5), (GREEN, 0.6)

    def scene(t):
        slope = tilt * (EVERYWHERE[:, 0] - 12.2)
        one = pane(EVERYWHERE, 20 + slope, *first)
        return drawn([one, pane(EVERYWHERE, 20 - slope, *second, t, (0, 0, -1.0))])

    image, derivative = pushed(scene)
    left, right = over(first, second), over(second, first)
    np.testing.assert_allclose(image[5:-5, 12], np.broadcast_to(0.2 * left + 0.8 * right, (14, 4)), atol=1e-3)
    np.testing.assert_allclose(derivative[5:-5, 12], np.broadcast_to((left - right) / (2 * tilt), (14, 4)), atol=2e-3)
    assert np.abs(derivative[:, :11]).max() < 1e-5


def test_what_an_opaque_layer_hides_has_no_derivative():
    far = turned(SQUARE * 0.8, -0.3, (12.4, 11.6))

    def scene(t):
        front, cover = pane(EVERYWHERE, 3, RED, 0.4), pane(EVERYWHERE, 4, GREEN, 1.0)
        return drawn([front, cover, pane(far, 5, BLUE, 1.0, t, (1.0, 0, 0)), pane(far, 6, RED, 0.5, t, (1.0, 0, 0))])

    _, derivative = pushed(scene)
    assert np.abs(derivative).max() == 0


def glass_ball(t, shift):
    """A ball of glass, whose front and back end in one outline."""
    import trimesh

    mesh = trimesh.creation.icosphere(2, radius=6.3)
    vertices = torch.tensor(np.asarray(mesh.vertices) + [12.1, 12.4, -20], dtype=torch.float32)
    vertices = vertices + t * torch.tensor(shift, dtype=torch.float32)
    colors = np.random.default_rng(0).random((len(vertices), 4)).astype(np.float32)
    colors[:, 3] = 0.5
    return rts.Part(
        rts.Mesh(np.asarray(mesh.faces)),
        {"vertices": vertices, "colors": colors},
        rts.plugin("shaders", "unlit")(opaque=False),
    )


@pytest.mark.parametrize("shift", [(1.0, 0, 0), (0, 1.0, 0)])
def test_a_rigid_shift_of_a_ball_of_glass_sums_to_zero(shift):
    _, derivative = pushed(lambda t: drawn([glass_ball(t, shift)]))
    assert np.abs(derivative[..., 3]).sum() > 5
    assert abs(derivative[..., 3].sum()) < 5e-4
    # Colours inside vary: what is added beside breaks is no flux.
    assert np.abs(derivative.sum((0, 1))).max() < 0.04 * np.abs(derivative).sum((0, 1)).max()


@pytest.mark.parametrize("shift", [(1.0, 0, 0), (0, 1.0, 0)])
def test_a_rigid_shift_of_glass_and_a_card_behind_it_sums_to_about_zero(shift):
    corners = turned(SQUARE, 0.3, (12.2, 11.7)) * 0.6 + 5

    def scene(t):
        return drawn(
            [pane(turned(SQUARE, 0.2, (10.2, 12)), 3, RED, 0.4, t, shift), pane(corners, 5, GREEN, 1, t, shift)]
        )

    _, derivative = pushed(scene)
    assert np.abs(derivative.sum((0, 1))).max() < 0.01 * np.abs(derivative).sum((0, 1)).max()


def test_colours_inside_move_layer_by_layer():
    """Ramps of colour along x: each moves with its own pane."""
    ramp = np.array([[0.0, 0, 0], [0.5, 0, 0], [0.5, 0, 0], [0, 0, 0]])
    corners = np.array([[0.0, -9], [24, -9], [24, 40], [0, 40]])
    for moves, share in ((0, 0.4), (1, 0.6)):

        def scene(t, moves=moves):
            by = [(t, (1.0, 0, 0)) if i == moves else () for i in (0, 1)]
            return drawn([pane(corners, 3, ramp, 0.4, *by[0]), pane(corners, 5, ramp[:, [1, 0, 2]], 1.0, *by[1])])

        _, derivative = pushed(scene)
        np.testing.assert_allclose(derivative[4:-4, 4:-4, moves], -share * 0.5 / 24, rtol=1e-3)
        np.testing.assert_allclose(derivative[4:-4, 4:-4, 1 - moves], 0, atol=1e-6)


def test_forward_mode_and_reverse_mode_agree():
    weights = torch.as_tensor(np.random.default_rng(0).normal(size=(*SIZE, 4)), dtype=torch.float32)
    corners = turned(SQUARE, 0.3, (14.2, 11.7))

    def loss(t):
        parts = [glass_ball(t, (1.0, 0.2, 0.3)), pane(corners, 20.5, GREEN, 0.7, t, (0.3, -0.5, 0.4))]
        return (drawn([*parts, pane(EVERYWHERE, 40, BLUE, 1.0)]) * weights).sum()

    with forward.dual_level():
        by_forward = float(forward.unpack_dual(loss(forward.make_dual(torch.zeros(()), torch.ones(())))).tangent)
    t = torch.zeros((), requires_grad=True)
    loss(t).backward()
    assert t.grad is not None
    assert float(t.grad) == pytest.approx(by_forward, rel=1e-3)


def test_glass_that_lets_no_light_through_is_drawn_as_opaque():
    """As alpha goes to 1, images and derivatives go to those of one layer."""
    near, far = turned(SQUARE, 0.2, (10.2, 12)), turned(SQUARE * 1.2, -0.3, (14, 11.6))

    def scene(t, alpha):
        return drawn([pane(near, 3, RED, alpha, t, (1.0, 0, 0)), pane(far, 4, GREEN, alpha)])

    (image, derivative), (glass, pushed_glass) = (pushed(lambda t, a=a: scene(t, a)) for a in (1.0, 0.9999))
    # Where outlines cross, pixels of glass are off by about a tenth.
    assert np.sort(np.abs(glass - image).max(-1).ravel())[-15] < 3e-3
    assert np.linalg.norm(pushed_glass - derivative) < 0.15 * np.linalg.norm(derivative)


@pytest.mark.parametrize("sampler", ["raster", "reference"])
def test_what_lies_behind_opaque_parts_is_left_out(sampler):
    """A wall between panes covers the left half of the image; the reference samples part by part."""
    parts = [pane(EVERYWHERE, 2, RED, 0.3), pane(HALF, 3, GREEN, 1), pane(HALF - [4, 0], 4, BLUE, 0.5)]
    parts += [pane(EVERYWHERE, 5 + i, BLUE, 0.5) for i in range(2)]
    sampled = rts.sample(parts, in_pixels(), SIZE, splatter="edges", sampler=sampler)
    kept = rts.sample(parts, in_pixels(), SIZE, splatter=None, sampler=sampler)
    assert (sampled.row.shape[0], kept.row.shape[0]) == (4, 6)
    part, row = (np.asarray(x) for x in (sampled.part, sampled.row))
    wall = (part == 1).any(axis=0)
    assert wall.any() and part[:, wall].max() == 1 and (row[:, ~wall][:3] >= 0).all()
    # Each row is in use, in order; the pane that just the wall hides has one that is not.
    cells = sum(np.count_nonzero(part == i) for i in range(5))
    assert np.array_equal(np.unique(row[row >= 0]).size, cells)
    assert [samples.ids.shape[0] for samples in sampled.samples][2] < wall.sum() / 4
    image = drawn(parts, layers="auto", sampler=sampler)
    np.testing.assert_allclose(image[12, 3], over((RED, 0.3), (GREEN, 1)), atol=1e-5)
    np.testing.assert_allclose(image[12, 20], over((RED, 0.3), (BLUE, 0.5), (BLUE, 0.5)), atol=1e-5)
    np.testing.assert_allclose(image, drawn(parts, layers=6, sampler=sampler), atol=1e-6)
    np.testing.assert_allclose(image, drawn([*parts[:2], *parts[3:]], layers="auto", sampler=sampler), atol=1e-6)


def test_layers_are_found_that_are_seen_between_centres_alone():
    """Panes stick out from behind a wall by less than a pixel, between two columns of centres."""
    wall, glass = HALF.copy(), HALF.copy()
    wall[wall[:, 0] > 0, 0], glass[glass[:, 0] > 0, 0] = 12.55, 13.35
    panes = [(RED, 0.3), (GREEN, 0.3), (BLUE, 0.3), (RED + GREEN, 0.9)]
    parts = [pane(wall, 3, (1, 1, 1), 1), *(pane(glass, 4 + i, *layer) for i, layer in enumerate(panes))]
    image = drawn(parts, layers="auto")
    np.testing.assert_allclose(image[12, 12], 0.55 * np.ones(4) + 0.45 * over(*panes), atol=1e-3)
    np.testing.assert_allclose(image[12, 13], 0.35 * over(*panes), atol=1e-3)


def test_layers_that_are_found_are_as_many_as_light_goes():
    """With layers="auto" all panes are composited; with too few of them a warning says so."""
    parts = [pane(EVERYWHERE, 3 + i, np.eye(3)[i % 3], 0.3) for i in range(5)]
    image = drawn(parts, layers="auto")
    np.testing.assert_allclose(image[12, 12], over(*[(np.eye(3)[i % 3], 0.3) for i in range(5)]), atol=1e-5)
    with pytest.warns(rts.errors.LayersWarning, match="of the light passes through the last of 2 layers"):
        drawn(parts, layers=2)


@pytest.mark.parametrize("direction", [(1.0, 0, 0), (0.3, 0.9, 0)])
def test_a_sheet_of_alpha_one_moves_as_an_opaque_one(direction):
    """Beside its slanted outline, where its colours change, too: what ends there moves along the outline's normal."""
    corners, colors = turned(SQUARE, 0.4, (12.2, 11.7)), np.random.default_rng(3).random((4, 3))

    def derivative(opaque):
        shader = rts.plugin("shaders", "unlit")(opaque=opaque)
        whole = np.concatenate([colors, np.ones((4, 1))], axis=1).astype(np.float32)

        def scene(t):
            vertices = torch.tensor(np.column_stack([corners, np.full(4, -3.0)]), dtype=torch.float32)
            vertices = vertices + t * torch.tensor(direction)
            return drawn(rts.Part(rts.Mesh(TWO), {"vertices": vertices, "colors": whole}, shader), layers=2)

        return pushed(scene)

    (image, moved), (expected, known) = derivative(False), derivative(True)
    np.testing.assert_allclose(image, expected, atol=1e-5)
    np.testing.assert_allclose(moved, known, atol=2e-5)
    assert np.abs(known[..., :3]).max() > 0.1
