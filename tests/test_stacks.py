"""Translucent layers: what is seen through them, and how their edges move; closed forms, and compiled loops."""

import dataclasses
import functools
import itertools

import numpy as np
import pytest
from helpers import ALL, TORCH, arrays, derivative, icosphere, low_passed, mesh_part, quad, splats_of, to_numpy
from test_splatting import random_scene

import rts
from rts.splatting import Visible
from rts_backends.fused import splatters as fused

pytestmark = pytest.mark.splatting

BOTH = [Visible, fused.Visible]
CAMERA = rts.Camera.look_at((0.1, 0.2, 6), (0, 0, 0), (0.21, 1, 0), fov_y=30)
"""Edges of upright cards are aslant in its images."""


def card(z, color, alpha, **sides):
    """A rectangle of one colour that faces +z."""
    vertices, faces = quad(**sides, z=z)
    colors = np.tile(np.float32([*color, alpha]), (4, 1))
    shader = rts.plugin("shaders", "unlit")(opaque=alpha == 1)
    return mesh_part((vertices, faces), theta={"colors": colors}, shader=shader)


def ball(alpha, color=(0.2, 0.9, 0.4), radius=0.8):
    vertices, faces = icosphere(4)
    colors = np.tile(np.float32([*color, alpha]), (len(vertices), 1))
    shader = rts.plugin("shaders", "unlit")(opaque=alpha == 1)
    return mesh_part(((vertices * radius).astype(np.float32), faces), theta={"colors": colors}, shader=shader)


def backdrop(z=-0.5):
    """A large card, each corner of another colour."""
    part = card(z, (0, 0, 0), 1, left=-3, right=3, bottom=-3, top=3)
    part.theta["colors"] = np.float32([[0.1, 0.2, 0.3, 1], [0.9, 0.3, 0.2, 1], [0.8, 0.9, 0.1, 1], [0.2, 0.8, 0.9, 1]])
    return part


def translucent(layers, seed, dtype=np.float64, **options):
    """A random scene whose layers let light through."""
    positions, rgba, row = random_scene(layers, seed=seed, **options)
    return splats_of(positions.astype(dtype), rgba.astype(dtype), row, opaque=False)


def on(splats, positions, rgba):
    """Splats with other positions and colours, in arrays of their engine."""
    row = rts.engine_of(positions).constant(splats.row)
    return splats.replace(positions=positions, rgba=rgba, cells=dataclasses.replace(splats.cells, row=row))


def sorted_over(colors):
    """Premultiplied colours (K, 4), front to back, over one another."""
    image = np.zeros(4)
    for color in reversed(colors):
        image = color + (1 - color[3]) * image
    return image


# ---------------------------------------------------------------------------------------- nothing dropped in silence


@pytest.mark.parametrize("name", ["single", "multi"])
@pytest.mark.parametrize("target", ALL)
def test_splatters_for_opaque_layers_warn_of_translucent_ones(name, target):
    parts = [card(0.5, (1, 0, 0), 0.25), card(-0.5, (0, 0, 1), 1)]
    parts = [part.replace(theta=arrays(target, part.theta)) for part in parts]
    with pytest.warns(rts.errors.LayersWarning, match=r"translucent.*use splatter='visible'"):
        rts.render(parts, CAMERA, (8, 8), splatter=name)


@pytest.mark.parametrize("name", ["none", "visible"])
def test_light_behind_the_last_layer_is_told(name):
    parts = [card(0.5, (1, 0, 0), 0.25), card(0, (0, 1, 0), 0.5), card(-0.5, (0, 0, 1), 1)]
    with pytest.warns(
        rts.errors.LayersWarning, match="up to 40 % of the light passes through the last of 2 layers.*'auto'"
    ):
        rts.render(parts, CAMERA, (8, 8), splatter=name, layers=2)


@pytest.mark.parametrize("name", ["none", "visible"])
@pytest.mark.parametrize("layers", [3, "auto"])
def test_with_enough_layers_there_is_no_warning(name, layers, recwarn):
    parts = [card(0.5, (1, 0, 0), 0.25), card(0, (0, 1, 0), 0.5), card(-0.5, (0, 0, 1), 1)]
    rts.render(parts, CAMERA, (8, 8), splatter=name, layers=layers)
    rts.render(parts[:2], CAMERA, (8, 8), splatter=name, layers=layers)
    assert not recwarn


def test_a_function_that_gives_alpha_one_needs_no_promise(recwarn):
    part = card(0.5, (1, 0, 0), 1).replace(
        shader=lambda theta, gbuffer, camera: theta["colors"][:1].repeat(len(gbuffer["position"]), 0)
    )
    rts.render(part, CAMERA, (8, 8), splatter="multi")
    assert not recwarn


# ------------------------------------------------------------------------------------------------------ order


@pytest.mark.parametrize(("target", "kind"), [*itertools.product(["numpy", *TORCH], BOTH), ("jax", fused.Visible)])
def test_red_and_green_glass_before_blue(kind, target):
    parts = [card(0.5, (1, 0, 0), 0.5), card(0.0, (0, 1, 0), 0.5), card(-0.5, (0, 0, 1), 1)]
    parts = [part.replace(theta=arrays(target, part.theta)) for part in parts]
    image = to_numpy(rts.render(parts, CAMERA, (24, 24), layers=4, splatter=kind()))
    np.testing.assert_allclose(image[12, 12], (0.5, 0.25, 0.25, 1), atol=1e-6)


@pytest.mark.parametrize("kind", BOTH)
def test_cards_in_any_order_of_parts_are_sorted(kind):
    rng = np.random.default_rng(0)
    colors = rng.random((8, 3))
    cards = [card(1 - 0.25 * k, colors[k], 0.3) for k in range(8)]
    expected = sorted_over([np.append(0.3 * c, 0.3) for c in colors])
    for _ in range(3):
        parts = [cards[k] for k in rng.permutation(8)]
        image = rts.render(parts, CAMERA, (24, 24), layers=9, splatter=kind())
        np.testing.assert_allclose(image[8:16, 8:16], np.broadcast_to(expected, (8, 8, 4)), atol=1e-6)


def test_either_card_of_a_pair_that_crosses_is_in_front_on_its_side():
    aslant = mesh_part(
        (np.float32([(-1, -1, -1), (1, -1, 1), (1, 1, 1), (-1, 1, -1)]), quad()[1]),
        theta={"colors": np.tile(np.float32([1, 0, 0, 0.5]), (4, 1))},
        shader=rts.plugin("shaders", "unlit")(opaque=False),
    )
    image = rts.render([card(0, (0, 1, 0), 0.5), aslant], rts.Camera.look_at((0, 0, 6), (0, 0, 0)), (32, 32), layers=3)
    np.testing.assert_allclose(image[16, 13], (0.25, 0.5, 0, 0.75), atol=1e-6)
    np.testing.assert_allclose(image[16, 18], (0.5, 0.25, 0, 0.75), atol=1e-6)


# ----------------------------------------------------------------------------------------------------- opaque


@pytest.mark.parametrize("layers", [1, 2, 4])
@pytest.mark.parametrize("seed", range(3))
def test_opaque_stacks_are_those_of_opaque_layers(layers, seed):
    splats = translucent(layers, seed)
    splats.rgba[:, 3] = 1
    positions, rgba = arrays("torch-cpu", (splats.positions, splats.rgba), np.float64)
    tangent = arrays("torch-cpu", np.random.default_rng(seed).normal(size=positions.shape), np.float64)
    (image, change), (expected, expected_change) = (
        derivative(
            "torch-cpu",
            lambda p, opaque=opaque: Visible().image(on(splats.replace(opaque=opaque), p, rgba)),
            positions,
            tangent,
        )
        for opaque in (False, True)
    )
    np.testing.assert_array_equal(image, expected)
    np.testing.assert_allclose(change, expected_change, atol=1e-12)


# --------------------------------------------------------------------------------------------------- compiled


def agree(splats, seed=0):
    """The compiled image, its gradients and its tangent are those of the specification."""
    torch = pytest.importorskip("torch")
    rng = np.random.default_rng(seed)
    given = arrays("torch-cpu", (splats.positions, splats.rgba), np.float64)
    along = arrays("torch-cpu", tuple(rng.normal(size=x.shape) for x in given), np.float64)
    results = []
    for kind in BOTH:

        def image(positions, rgba, kind=kind):
            return kind().image(on(splats, positions, rgba))

        value, pull = torch.func.vjp(image, *given)
        weights = arrays("torch-cpu", np.random.default_rng(1).normal(size=value.shape), np.float64)
        results.append((value, *pull(weights), torch.func.jvp(image, given, along)[1]))
    for found, expected in zip(*map(to_numpy, results), strict=True):
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-6 * max(1, np.abs(expected).max()))


@pytest.mark.parametrize("layers", [1, 2, 3, 6])
def test_compiled_they_are_those_of_the_specification(layers):
    for seed in range(4):
        agree(translucent(layers, seed), seed)


@functools.cache
def scene():
    return [card(0.5, (1, 0.1, 0.1), 0.5, right=0.13), card(0, (0.1, 1, 0.1), 0.5, left=-0.41), ball(0.5), backdrop(-1)]


@functools.cache
def crossed():
    """Two cards of glass that pass through each other, before a backdrop."""
    cards, turns = [card(0, (1, 0.1, 0.1), 0.5), card(0, (0.1, 1, 0.1), 0.7)], [(0.2, 0.5, 0), (-0.3, -0.4, 0)]
    moves = [rts.rigid(np.float32([*turn, 0, 0, 0])) for turn in turns]
    return [*(c.replace(transform=move) for c, move in zip(cards, moves, strict=True)), backdrop(-1.5)]


def moved(part, pose):
    """The part, moved by a pose (6,) of torch."""
    torch = pytest.importorskip("torch")
    before = np.eye(4) if part.transform is None else part.transform
    return part.replace(transform=rts.rigid(pose) @ torch.tensor(np.float32(before)))


@pytest.mark.parametrize("supersample", [1, 2])
@pytest.mark.parametrize("parts", [scene, crossed])
def test_compiled_images_of_smooth_scenes_are_those_of_the_specification(parts, supersample):
    torch = pytest.importorskip("torch")
    first, *others = parts()
    weights = torch.tensor(np.random.default_rng(2).normal(size=(24, 24, 4)).astype(np.float32))

    def image(given, kind):
        part = moved(first.replace(theta={**first.theta, "colors": given[1]}), given[0])
        options = {"layers": 6, "splatter": kind(), "supersample": supersample}
        return rts.render([part, *others], CAMERA, (24, 24), **options)

    given = torch.zeros(6), torch.tensor(first.theta["colors"])
    results = []
    for kind in BOTH:
        value, change = torch.func.jvp(lambda g, k=kind: image(g, k), (given,), ((torch.ones(6), given[1] * 0 + 0.1),))
        pulled = torch.func.grad(lambda g, k=kind: (image(g, k) * weights).sum())(given)
        results.append(to_numpy((value, change, *pulled)))
    for found, expected in zip(*results, strict=True):
        np.testing.assert_allclose(found, expected, atol=1e-4 * np.abs(expected).max())


@pytest.mark.parametrize("kind", BOTH)
def test_gradients_of_colour_and_alpha_are_finite_differences(kind):
    splats = translucent(3, 1)
    weights, step = np.random.default_rng(0).normal(size=(5, 6, 4)), 1e-6
    positions, rgba = arrays("torch-cpu", (splats.positions, splats.rgba), np.float64)
    found = to_numpy(
        pytest.importorskip("torch").func.grad(
            lambda c: (kind().image(on(splats, positions, c)) * arrays("torch-cpu", weights, np.float64)).sum()
        )(rgba)
    )
    for i, c in [(0, 0), (3, 3), (7, 1), (9, 3), (20, 3)]:
        ends = []
        for sign in (-1, 1):
            moved = splats.rgba.copy()
            moved[i, c] += sign * step
            ends.append((kind().image(splats.replace(rgba=moved)) * weights).sum())
        assert found[i, c] == pytest.approx((ends[1] - ends[0]) / (2 * step), abs=1e-6)


# ------------------------------------------------------------------------------------------------------ edges


def test_a_glass_ball_keeps_its_coverage():
    image, solid = (rts.render(ball(alpha), CAMERA, (48, 48), layers=3) for alpha in (0.5, 1))
    # Front and back of alpha ½ let a quarter through, at the outline, too.
    assert image[..., 3].sum() == pytest.approx(0.75 * solid[..., 3].sum(), rel=0.003)
    assert image[..., 3].max() == pytest.approx(0.75, abs=1e-6)


EDGES = {
    "the upper of two cards": (scene()[:2], 0),
    "the lower of two cards": (scene()[:2], 1),
    "a ball": ([ball(0.5)], 0),
    "a card behind a ball": (
        [ball(0.5), card(-1.2, (0.9, 0.2, 0.1), 1, left=-0.3, right=0.5, bottom=-0.4, top=0.3)],
        1,
    ),
}


@pytest.mark.parametrize("supersample, most", [(1, 0.06), pytest.param(2, 0.04, marks=pytest.mark.thorough)])
@pytest.mark.parametrize("name", EDGES)
def test_edges_move_as_areas_do(name, supersample, most):
    parts, index = EDGES[name]
    error, gain = errors_of_motion([*parts, backdrop(-1.5)], index, (1, 0.5, 0), supersample)
    assert error < most
    assert gain == pytest.approx(1, abs=0.025)


def test_outlines_behind_glass_have_fine_samples():
    glass = card(1, (0.5, 0.5, 1), 0.5, left=-3, right=3, bottom=-3, top=3)
    parts = [glass, card(0, (0.9, 0.2, 0.1), 1, left=-0.7, right=0.6), card(-1, (0.1, 0.2, 0.3), 1)]
    images = [
        rts.render(parts, CAMERA, (32, 32), layers=3, supersample=s, splatter="visible")
        for s in (1, 4, rts.Adaptive(4))
    ]
    assert np.abs(images[0] - images[1]).max() > 0.1
    np.testing.assert_allclose(images[2], images[1], atol=1e-5)
    # With one layer nothing is hidden.
    with pytest.warns(rts.errors.LayersWarning):
        finer, adaptive = (
            rts.render(parts, CAMERA, (32, 32), layers=1, supersample=s, splatter="visible")
            for s in (4, rts.Adaptive(4))
        )
    np.testing.assert_allclose(adaptive, finer, atol=1e-5)


def test_lines_of_crossing_move_as_depths_say():
    # The error is that of opaque cards. Where lines move as samples do, the gain is 0.09.
    error, gain = errors_of_motion(crossed(), 0, (0, 0, 2), 1)
    assert error < 0.1
    assert gain == pytest.approx(1, abs=0.04)


def errors_of_motion(parts, index, along, supersample):
    """Error and gain of the derivative as a part moves along a direction, in pixels; both smoothed."""
    torch = pytest.importorskip("torch")
    size = (96, 96)
    direction = torch.tensor([0, 0, 0, *along]) * 3.2 / size[0]

    def image(step, **options):
        scene = [moved(part, step * direction) if i == index else part for i, part in enumerate(parts)]
        return rts.render(scene, CAMERA, size, layers=4, **options)

    ends = [to_numpy(image(torch.tensor(step), splatter="none", supersample=16)) for step in (-0.5, 0.5)]
    expected = low_passed((ends[1] - ends[0])[..., :3])
    _, change = derivative(
        "torch-cpu", functools.partial(image, supersample=supersample), torch.zeros(()), torch.ones(())
    )
    found = low_passed(change[..., :3])
    return np.linalg.norm(found - expected) / np.linalg.norm(expected), (found * expected).sum() / (expected**2).sum()
