"""Samples where outlines are: active pixels are those of the finer image, the others those of the plain one."""

import itertools

import numpy as np
import pytest
from adaptive_scenes import (
    BALL,
    CAMERA,
    CARD,
    FACES,
    FAR_FACES,
    MESH,
    SIZE,
    activate,
    apart,
    random_mask,
    render,
    scene,
)
from helpers import TORCH, arrays, derivative, gradient, icosphere, quad, to_numpy

import rts
from rts import Adaptive
from rts.contracts.records import Request
from rts.contracts.sampler import Sampler
from rts.fitting.least_squares import normal_equations
from rts.splatting import Multi

pytestmark = pytest.mark.splatting


# ------------------------------------------------------------------------------------------ two images, put together


@pytest.mark.parametrize("target", ["numpy", *TORCH])
@pytest.mark.parametrize("s", [2, 3, 4])
def test_active_pixels_are_those_of_the_finer_image_and_others_of_the_plain_one(target, s, monkeypatch):
    parts = scene(arrays(target, BALL, np.float64 if target in TORCH else np.float32))
    for mask in (random_mask(), np.ones(SIZE, bool), np.zeros(SIZE, bool)):
        activate(monkeypatch, mask)
        apart(parts, mask, s, 1e-9 if target in TORCH else 2e-6)


@pytest.mark.parametrize("target", TORCH)
@pytest.mark.parametrize("splatter", ["visible", "multi", "single", Multi(0.6)])
def test_gradients_are_those_of_either_image(target, splatter, monkeypatch):
    weights = np.random.default_rng(1).normal(size=(*SIZE, 4))
    vertices = arrays(target, BALL)
    for mask in (random_mask(2), np.ones(SIZE, bool)):
        activate(monkeypatch, mask)

        def slope(supersample, where):
            weigh = arrays(target, weights * where[..., None])
            return gradient(
                target, lambda v: (render(scene(v), supersample, splatter=splatter) * weigh).sum(), vertices
            )

        for supersample, where in ((3, mask), (1, ~mask)):
            found, expected = slope(Adaptive(3), where), slope(supersample, where)
            np.testing.assert_allclose(found, expected, rtol=0, atol=2e-3 * max(1, np.abs(expected).max()))


@pytest.mark.parametrize("count, compiled", [(1, False), (2, True)])
def test_engines_agree(count, compiled):
    jax, weights = pytest.importorskip("jax"), np.random.default_rng(1).normal(size=(*SIZE, 4))

    def loss(target):
        weigh = arrays(target, weights)
        return lambda v: (render(scene(v)[:count], Adaptive(3), splatter="visible", layers=2) * weigh).sum()

    found = (jax.jit if compiled else lambda f: f)(jax.grad(loss("jax")))(arrays("jax", BALL))
    expected = gradient(TORCH[0], loss(TORCH[0]), arrays(TORCH[0], BALL))
    np.testing.assert_allclose(found, expected, rtol=0, atol=2e-3 * np.abs(expected).max())


def test_aprons_are_as_wide_as_a_splatter_reaches(monkeypatch):
    class Wide(rts.Splatter):
        """Means over 7 × 7 cells."""

        reach = 3

        def image(self, splats):
            xp = rts.namespace(splats.rgba)
            color = xp.where((splats.row[0] >= 0)[..., None], splats.rgba[splats.row[0]], 0.0)
            steps = itertools.product(range(-3, 4), repeat=2)
            return sum(xp.roll(color, step, axis=(0, 1)) for step in steps) / 49

    mask = random_mask(3, 0.1)
    activate(monkeypatch, mask)
    for s in (2, 5):
        apart(scene(), mask, s, splatter=Wide())


@pytest.mark.parametrize("sampler", ["raster", "embree", "opengl", "reference"])
def test_samplers_of_triangles_take_only_what_is_asked_for(sampler, monkeypatch):
    if sampler in ("embree", "opengl"):
        pytest.importorskip("embreex" if sampler == "embree" else "moderngl")
    mask = random_mask(4)
    activate(monkeypatch, mask)
    apart(scene(), mask, 3, sampler=sampler)


def test_samplers_that_know_no_lists_serve_too(monkeypatch):
    class Whole(Sampler):
        """Samples all cells."""

        def sample(self, part, camera, size, layers, request):
            own = Request(request.capacity)
            return rts.plugin("rts.samplers", "raster")().sample(part, camera, size, layers, own)

    mask = random_mask(5)
    activate(monkeypatch, mask)
    found = rts.sample(scene(), CAMERA, SIZE, sampler=Whole(), supersample=Adaptive(3), layers=3, splatter="visible")
    listed = rts.sample(scene(), CAMERA, SIZE, sampler="raster", supersample=Adaptive(3), layers=3, splatter="visible")
    for a, b in zip(found.fine.samples, listed.fine.samples, strict=True):
        np.testing.assert_array_equal(a.row, b.row)
        np.testing.assert_allclose(a.params, b.params)
    apart(scene(), mask, 3, sampler=Whole())


@pytest.mark.parametrize("name", rts.plugins("rts.surfaces"))
def test_every_surface_is_that_of_the_finer_image(name, monkeypatch):
    target = TORCH[0]
    part = rts.plugin("rts.surfaces", name).example()
    if part is None:
        pytest.skip(f"{name} has no example")
    mask = np.random.default_rng(6).random((12, 14)) < 0.6
    activate(monkeypatch, mask)
    theta, weights = arrays(target, part.theta), np.random.default_rng(7).normal(size=(12, 14, 4)) * mask[..., None]
    camera = rts.Camera.look_at((0.3, 0.4, 5.0), (0, 0, 0))

    def image(theta, supersample):
        return rts.render(part.replace(theta=theta), camera, (12, 14), splatter="visible", supersample=supersample)

    images = [to_numpy(image(theta, n)) for n in (Adaptive(2), 2)]
    np.testing.assert_allclose(images[0][mask], images[1][mask], atol=2e-5)
    key = part.surface.reads(part.theta)[0]
    found = [
        gradient(
            target,
            lambda x, n=n: (image({**theta, key: x}, n) * arrays(target, weights)).sum(),
            arrays(target, part.theta[key]),
        )
        for n in (Adaptive(2), 2)
    ]
    np.testing.assert_allclose(found[0], found[1], rtol=0, atol=2e-3 * np.abs(found[1]).max())


# --------------------------------------------------------------------------------------------------- derivatives


def edge(target, supersample, x=0.3):
    """Each row's change of alpha as a card's right edge moves by a pixel: one, if all of the edge is felt."""
    vertices, faces = quad(-100, x, -100, 100)
    camera = rts.Camera.orthographic((0, 0, 10), (0, 0, 0), height=16)
    along = arrays(target, np.broadcast_to([1.0, 0, 0], vertices.shape))

    def alpha(v):
        return rts.render(
            rts.Part(MESH(faces), {"vertices": v}), camera, (16, 16), splatter="visible", supersample=supersample
        )[..., 3]

    return derivative(target, alpha, arrays(target, vertices), along)


@pytest.mark.parametrize("target", TORCH)
@pytest.mark.parametrize("s", [2, 4, 8])
def test_a_straight_edge_is_everywhere_that_of_the_finer_image(target, s):
    for x in (0.3, 0.02, -0.49):
        for found, expected in zip(edge(target, Adaptive(s), x), edge(target, s, x), strict=True):
            np.testing.assert_allclose(found, expected, rtol=0, atol=2e-6)


def test_half_of_an_edge_activated_is_not_felt_whole(monkeypatch):
    """The trap: coarse samples give half of an edge's derivative to each of two pixels, fine ones all to one."""
    np.testing.assert_allclose(edge(TORCH[0], Adaptive(4))[1].sum(axis=1), 1, atol=2e-3)
    columns = np.flatnonzero(np.abs(edge(TORCH[0], 1)[1]).max(axis=0) > 0.1)
    assert len(columns) == 2
    mask = np.zeros((16, 16), bool)
    mask[:, columns[0]] = True
    activate(monkeypatch, mask)
    assert np.abs(edge(TORCH[0], Adaptive(4))[1].sum(axis=1) - 1).min() > 0.3


@pytest.mark.parametrize("target", TORCH)
def test_a_ramp_that_moves_is_exact_whatever_is_active(target, monkeypatch):
    vertices, faces = quad(-30, 30, -30, 30)
    camera = rts.Camera.orthographic((0, 0, 10), (0, 0, 0), height=16)
    colors = np.repeat(0.5 + vertices[:, :1] / 100, 3, axis=1)
    along = arrays(target, np.broadcast_to([1.0, 0, 0], vertices.shape))
    activate(monkeypatch, np.random.default_rng(8).random((16, 16)) < 0.4)

    def image(v):
        part = rts.Part(MESH(faces), {"vertices": v, "colors": colors}, "unlit")
        return rts.render(part, camera, (16, 16), supersample=Adaptive(3), splatter="visible", layers=2)[..., 0]

    found, slope = derivative(target, image, arrays(target, vertices), along)
    ramp = 0.5 + (np.arange(16) - 7.5) / 100
    np.testing.assert_allclose(found, np.broadcast_to(ramp, (16, 16)), atol=1e-5)
    np.testing.assert_allclose(slope, -0.01, atol=1e-5)


def test_the_outline_of_a_sphere_that_turns_stands_still():
    vertices, faces = icosphere(5, 0.7)
    camera, size = rts.Camera.look_at((0, 0, 3.2), (0, 0, 0), fov_y=40), (96, 96)

    def norm(motion, supersample):
        def alpha(t):
            zero = 0 * t
            pose = rts.namespace(t).stack([t if m else zero for m in motion])
            part = rts.Part(MESH(faces), {"vertices": vertices}, transform=rts.rigid(pose))
            return rts.render(part, camera, size, splatter="visible", supersample=supersample)[..., 3]

        slope = derivative(TORCH[0], alpha, *arrays(TORCH[0], (np.zeros(()), np.ones(()))))[1]
        blur = np.exp(-(np.subtract.outer(np.arange(96), np.arange(96)) ** 2) / 8) / np.sqrt(8 * np.pi)
        return np.linalg.norm(blur @ slope @ blur)

    turn, move = (0, 1, 0, 0, 0, 0), (0, 0, 0, 1, 0, 0)
    assert norm(turn, 1) > 2.5 * norm(turn, Adaptive(4))
    assert norm(turn, Adaptive(4)) < 0.01 * norm(move, Adaptive(4))
    np.testing.assert_allclose(norm(move, Adaptive(4)), norm(move, 4), rtol=1e-3)


def test_derivatives_are_differences_at_fixed_samples():
    """For a splatter whose derivative is that of its image."""
    vertices, along = arrays(TORCH[0], (BALL, np.random.default_rng(9).normal(size=BALL.shape)), np.float64)
    sampled = rts.sample(scene(vertices), CAMERA, SIZE, supersample=Adaptive(3), layers=3, splatter=Multi())

    def image(v):
        return rts.render_samples(sampled, scene(v), CAMERA, splatter=Multi())

    step = 1e-6
    expected = to_numpy((image(vertices + step * along) - image(vertices - step * along)) / (2 * step))
    np.testing.assert_allclose(derivative(TORCH[0], image, vertices, along)[1], expected, atol=1e-5)


def test_depths_beyond_active_pixels_make_no_difference():
    """The trap: what stands for empty layers depends on the depths of a scene, and strips do not hold the farthest."""
    near, vertices = scene()[:2], arrays(TORCH[0], BALL, np.float64)
    parts = [
        rts.Part(p.surface, {**p.theta, "vertices": x}, "unlit") for p, x in zip(near, (vertices, CARD), strict=True)
    ]
    slope = np.array([(-20, -40, -4), (80, -40, -60), (80, 40, -60), (-20, 40, -4)], float)
    behind = rts.Part(MESH(FAR_FACES), {"vertices": slope}, "silhouette")
    for scene_ in (parts, [*parts, behind]):
        found, fine = (to_numpy(render(scene_, n, splatter="visible", layers=2)) for n in (Adaptive(4), 4))
        sampled = rts.sample(scene_, CAMERA, SIZE, supersample=Adaptive(4), layers=3, splatter="visible")
        mask = to_numpy(sampled.fine.pixel) >= 0
        np.testing.assert_allclose(found[mask], fine[mask], rtol=0, atol=1e-9)
    deepest = [max(float(s.depth.max()) for s in x) for x in (sampled.samples, sampled.fine.samples)]
    assert 0.1 < mask.mean() < 0.9 and deepest[0] > 1.2 * deepest[1]


# ------------------------------------------------------------------------------------------------- where it is used


def posed_residuals(channels, shader, s):
    """Residuals of the scene as the ball moves, and a pose."""
    rng = np.random.default_rng(12)
    goal, weights = rng.random((*SIZE, channels)), rng.random((*SIZE, 1))

    def posed(pose):
        ball, *others = scene(shader=shader)
        return [ball.replace(transform=rts.rigid(pose)), *others]

    options = dict(weights=weights, supersample=Adaptive(s), background=rng.random(3), layers=3)
    pose = np.array([0.1, 0.2, -0.1, 0.05, 0.02, 0.1])
    return rts.ImageResiduals(posed, CAMERA, SIZE, goal, **options), pose


@pytest.mark.parametrize("target", TORCH)
@pytest.mark.parametrize("channels, shader, s", [(1, "silhouette", 2), (3, "unlit", 3), (4, "unlit", 4)])
def test_normal_equations_are_those_of_the_jacobian(target, channels, shader, s):
    residuals, pose = posed_residuals(channels, shader, s)
    pose = arrays(target, pose)
    found, expected = residuals.normal_equations(pose), normal_equations(residuals, pose, rts.engine_of(pose))
    for a, b in zip(found, expected, strict=True):
        np.testing.assert_allclose(to_numpy(a), to_numpy(b), rtol=1e-3, atol=1e-5)


def test_normal_equations_in_a_compiled_program():
    jax = pytest.importorskip("jax")
    residuals, pose = posed_residuals(1, "silhouette", 2)
    found = jax.jit(residuals.normal_equations)(arrays("jax", pose))
    for a, b in zip(found, residuals.normal_equations(arrays(TORCH[0], pose)), strict=True):
        np.testing.assert_allclose(to_numpy(a), to_numpy(b), rtol=1e-3, atol=1e-5)


@pytest.mark.thorough
def test_fits_take_fewer_samples():
    vertices = 0.9 * BALL * [1, 0.7, 0.5]

    def posed(pose):
        return rts.Part(MESH(FACES), {"vertices": vertices}, transform=rts.rigid(pose))

    goal = rts.render(
        posed(np.array([0.2, 0.1, 0.3, 0.05, 0, 0])), CAMERA, (48, 48), supersample=8, splatter="visible", layers=2
    )[..., 3]
    losses = []
    for s in (1, 4, Adaptive(4)):
        residuals = rts.ImageResiduals(posed, CAMERA, (48, 48), goal, supersample=s, splatter="visible", layers=2)
        start = arrays(TORCH[0], np.array([0.1, 0, 0.2, 0, 0.05, 0]))
        losses.append(float(rts.fit(residuals, start, method="lm", progress=False).loss))
    assert losses[2] < 1.5 * losses[1] < 0.1 * losses[0]


def test_explain_counts_pixels_and_samples():
    part = scene(shader="silhouette")[0]
    (choice,) = rts.explain(part, CAMERA, SIZE, supersample=Adaptive(4))
    sampled = rts.sample(part, CAMERA, SIZE, supersample=Adaptive(4), splatter="visible")
    assert choice.active == (sampled.fine.pixel >= 0).sum() > 0
    assert choice.fine == len(sampled.fine.samples[0].ids)
    assert choice.samples == choice.fine + len(sampled.samples[0].ids)
    (plain,) = rts.explain(part, CAMERA, SIZE, splatter="visible")
    assert plain.samples == len(sampled.samples[0].ids) and plain.active is plain.fine is None
