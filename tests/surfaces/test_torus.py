"""A torus that is traced in steps: a surface that intersects rays itself."""

from dataclasses import replace

import numpy as np
import pytest
from example_surfaces import Torus, distance
from helpers import ALL, DIFFERENTIABLE, arrays, finite_difference, gradient, to_numpy
from seen import CAMERA, SIZE, VIEWS, loss_of

import rts
import rts.plugin_api.operations
from rts.plugin_api.records import Samples
from rts.testing import SurfaceConformance
from rts.testing.compatibility import APRON

pytestmark = pytest.mark.sampling


TORUS = Torus.example()


# --------------------------------------------------------------------------------------------------- torus

RADII = np.array([0.9, 0.35])


def some_rays(count=400):
    """Rays from about the torus and from within its tube, of any length; none of which almost touches it."""
    rng = np.random.default_rng(0)
    origins = rng.normal(size=(count, 3))
    origins *= 3 / np.linalg.norm(origins, axis=1, keepdims=True)
    origins[: count // 8] = RADII[0] * np.array([0.6, 0, 0.8]) + rng.uniform(-0.15, 0.15, (count // 8, 3))
    toward = rng.uniform(-1.1, 1.1, (count, 3)) * (1, 0.35, 1)
    directions = (toward - origins) * rng.uniform(0.2, 2, (count, 1))
    roots = [quartic(o, d) for o, d in zip(origins, directions, strict=True)]
    plain = np.array([apart(r, np.linalg.norm(d)) for r, d in zip(roots, directions, strict=True)])
    return origins[plain], directions[plain], [r for r, good in zip(roots, plain, strict=True) if good]


def quartic(o, d):
    """The roots of |p|² + R² − r² = 2 R √(x² + z²), squared, along a ray."""
    large, small = RADII
    a = np.array([d @ d, 2 * o @ d, o @ o + large**2 - small**2])
    flat = [0, 2]
    b = np.array([d[flat] @ d[flat], 2 * o[flat] @ d[flat], o[flat] @ o[flat]])
    return np.roots(np.polymul(a, a) - 4 * large**2 * np.pad(b, (2, 0)))


def apart(roots, length):
    """True if all roots, complex ones too, are at least a hundredth of a unit apart, and as far from 0."""
    gaps = np.abs(roots[:, None] - roots[None]) + np.eye(4)
    return gaps.min() * length > 1e-2 and np.abs(roots).min() * length > 1e-2


def closed_form(roots, layers=4):
    """Distances (K, R) of at least 0, nearest first; infinite where there is no root."""
    distances = np.full((layers, len(roots)), np.inf)
    for i, r in enumerate(roots):
        real = np.sort(r.real[(np.abs(r.imag) < 1e-6) & (r.real >= 0)])[:layers]
        distances[: len(real), i] = real
    return distances


def traced(radii, origins, directions, layers=4):
    hits = TORUS.surface.intersect({"radii": radii}, origins, directions, layers)
    xp = rts.namespace(radii)
    return xp.where(hits.hit, hits.distance, xp.inf), hits.params


def test_rays_meet_the_torus_where_the_quartic_is_zero():
    origins, directions, roots = some_rays()
    expected = closed_form(roots)
    counts = np.isfinite(expected).sum(axis=0)
    assert len(roots) > 250 and (np.bincount(counts, minlength=5)[[0, 1, 2, 4]] > 5).all()
    found, params = traced(RADII, origins, directions)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-6)
    assert np.isfinite(params).all()
    k, i = np.nonzero(np.isfinite(expected))
    count = len(k)
    samples = Samples(np.zeros((count, 0), np.int32), params[k, i], None, None)
    gbuffer = TORUS.surface.evaluate({"radii": RADII}, samples)
    point = origins[i] + expected[k, i][:, None] * directions[i]
    np.testing.assert_allclose(gbuffer["position"], point, atol=1e-6)
    # Rays come in, go out, and so on, save those that begin within.
    within = distance(RADII, origins)[i] < 0
    inward = np.sum(gbuffer["normal"] * directions[i], axis=1) < 0
    np.testing.assert_array_equal(inward, (k % 2 == 0) ^ within)


def test_fewer_layers_are_the_nearest():
    origins, directions, roots = some_rays()
    for layers in (1, 2, 3):
        found, _ = traced(RADII, origins, directions, layers)
        np.testing.assert_allclose(found, closed_form(roots, layers), rtol=0, atol=1e-6)


@pytest.mark.parametrize("target", DIFFERENTIABLE)
def test_every_engine_meets_the_torus_compiled_and_batched(target):
    origins, directions, roots = some_rays()
    expected = closed_form(roots)
    radii, *rays = arrays(target, (np.stack([RADII, RADII]), origins, directions))

    def distances(radii):
        return traced(radii, *rays)[0]

    if target == "jax":
        import jax

        found = jax.jit(distances)(radii[0]), *jax.jit(jax.vmap(distances))(radii)
    else:
        import torch

        found = distances(radii[0]), *torch.func.vmap(distances)(radii)
    for one in found:
        np.testing.assert_allclose(to_numpy(one), expected, rtol=0, atol=2e-5)


@pytest.mark.parametrize("view", [*VIEWS, "from the side"])
def test_layers_of_the_torus_are_front_to_back_on_centres_of_pixels(view):
    camera = {**VIEWS, "from the side": rts.Camera.look_at((3.2, 0.6, 0.5), (0, 0, 0))}[view]
    samples = rts.sample(TORUS, camera, SIZE, layers=4, splatter=None).samples[0]
    covered = samples.row >= 0
    assert covered[0].sum() > 50 and not (covered[1:] & ~covered[:-1]).any()
    assert view != "from the side" or covered[3].sum() > 20
    assert (np.diff(samples.depth, axis=0) > 0)[covered[1:]].all()
    k, y, x = np.nonzero(covered)
    position = TORUS.surface.evaluate(TORUS.theta, samples)["position"][samples.row[covered]]
    seen = camera.with_apron(SIZE, APRON).project(position.astype(np.float64), samples.row.shape[1:])
    np.testing.assert_allclose(seen[:, :2], np.stack([x, y], axis=-1) + 0.5, rtol=0, atol=0.02)
    np.testing.assert_allclose(seen[:, 2], samples.depth[covered], rtol=1e-5)


@pytest.mark.parametrize("target", DIFFERENTIABLE)
def test_gradients_in_radii_are_finite_differences(target):
    samples = rts.sample(TORUS, CAMERA, SIZE, splatter=None).samples[0]
    weights = np.random.default_rng(1).normal(size=(len(samples.ids), 3)) / len(samples.ids) ** 0.5

    def product(radii, weights=weights, samples=samples):
        return (TORUS.surface.evaluate({"radii": radii}, samples)["position"] * weights).sum()

    moved = arrays(target, weights), replace(samples, params=arrays(target, samples.params))
    found = gradient(target, lambda radii: product(radii, *moved), arrays(target, RADII))
    np.testing.assert_allclose(found, finite_difference(product, RADII), rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("target", ALL)
def test_the_gradient_of_its_distance_is_the_normal_of_the_torus(target):
    samples = rts.sample(TORUS, CAMERA, SIZE, splatter=None).samples[0]
    gbuffer = TORUS.surface.evaluate(TORUS.theta, samples)
    points, radii = arrays(target, (gbuffer["position"], RADII))
    found = rts.plugin_api.operations.gradient(lambda p: distance(radii, p), points)
    np.testing.assert_allclose(to_numpy(found), gbuffer["normal"], atol=1e-5)


def test_a_loop_in_a_program_of_jax_is_one_loop():
    jax = pytest.importorskip("jax")
    render = loss_of(TORUS, "radii", layers=2)
    for f in (render, jax.grad(render), lambda radii: jax.vmap(render)(jax.numpy.stack([radii, radii]))):
        program = str(jax.make_jaxpr(f)(arrays("jax", RADII)))
        assert program.count("while[") == 1


@pytest.mark.thorough
def test_images_of_the_torus_agree_compiled_and_batched():
    radii = np.stack([RADII, (0.8, 0.3)]).astype(np.float32)

    def image(radii):
        return rts.render(TORUS.replace(theta={"radii": radii}), CAMERA, SIZE, layers=3)

    expected = [image(r) for r in radii]
    assert np.abs(expected[0] - expected[1]).max() > 0.1
    torch, jax = pytest.importorskip("torch"), pytest.importorskip("jax")
    np.testing.assert_allclose(torch.func.vmap(image)(torch.tensor(radii)), expected, rtol=0, atol=1e-4)
    np.testing.assert_allclose(jax.jit(jax.vmap(image))(jax.numpy.asarray(radii)), expected, rtol=0, atol=1e-4)


class TestTorus(SurfaceConformance):
    @pytest.fixture
    def part(self):
        return TORUS

    @pytest.fixture
    def sampler(self):
        return "rays"
