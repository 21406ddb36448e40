"""Derivatives of surfaces of fields: by several threads at once, in both modes, and of fields steep or flat there."""

import numpy as np
import pytest
from helpers import quick, together

import rts
from rts import Camera, Part
from rts_surfaces.implicit.casting import per_level
from rts_surfaces.implicit.fields import swept_sphere

pytestmark = pytest.mark.rendering

Sdf, Isosurface = rts.plugin("surfaces", "sdf"), rts.plugin("surfaces", "isosurface")
CAMERA, SIZE = Camera.look_at((1, 2, 3), (0, 0, 0), fov_y=40), (16, 20)
BOUNDS = ((-1.5, -1.5, -1.5), (1.5, 1.5, 1.5))
SURFACES = {
    "sdf": lambda f: (Sdf(f, 1.6, lipschitz=None), "rays"),
    "isosurface met by rays": lambda f: (Isosurface(BOUNDS, f=f, shape=(20, 20, 20)), "rays"),
    "isosurface": lambda f: (Isosurface(BOUNDS, f=f, shape=(20, 20, 20)), "raster"),
}

# ------------------------------------------------------------------------------------------------------- threads

THREADS, ROUNDS = 4, 2


@pytest.mark.thorough
@pytest.mark.parametrize("name", ["sdf", "isosurface"])
def test_threads_at_once_find_the_images_and_gradients_of_one(name):
    torch = pytest.importorskip("torch")
    surfaces = [SURFACES[name](swept_sphere) for _ in range(THREADS)]

    def found(i):
        radii = torch.tensor([0.9 - 0.02 * i, 0.35 + 0.01 * i], requires_grad=True)
        surface, sampler = surfaces[i]
        image = rts.render(Part(surface, {"radii": radii}, "normals"), CAMERA, SIZE, sampler=sampler)
        weights = torch.linspace(0, 1, image.numel()).reshape(image.shape)
        (gradient,) = torch.autograd.grad((weights * image).sum(), radii)
        return image.detach().numpy(), gradient.numpy()

    expected = [found(i) for i in range(THREADS)]
    for _ in range(ROUNDS):
        for result, known in zip(together(found, THREADS), expected, strict=True):
            for x, y in zip(result, known, strict=True):
                np.testing.assert_array_equal(x, y)


# --------------------------------------------------------------------------------------------------- both modes


def ball(theta, points):
    xp = rts.namespace(points)
    return xp.sqrt(xp.sum((points - theta["center"]) ** 2, axis=-1)) - theta["radius"]


def ring(theta, points):
    return swept_sphere({"radii": rts.namespace(points).stack([theta["radius"], 0.4 * theta["radius"]])}, points)


def root(theta, points):
    xp, distance = rts.namespace(points), ball(theta, points)
    some = xp.where(distance == 0, xp.ones_like(distance), distance)
    return xp.where(distance == 0, distance, xp.sign(some) * xp.sqrt(xp.abs(some)))


def steep(theta, points):
    return rts.namespace(points).tanh(50 * ball(theta, points)) * (1 + 100 * points[:, 0] ** 2)


FIELDS = {
    "ball": ball,
    "ring": ring,
    "root": root,
    "steep": steep,
    "large": lambda theta, points: 1e4 * ball(theta, points),
    "small": lambda theta, points: 1e-4 * ball(theta, points),
    "cube": lambda theta, points: ball(theta, points) ** 3,
}
THETA = {"center": np.array([0.03, -0.02, 0.05]), "radius": np.array(0.8)}
RANDOM = np.random.default_rng(3)
ALONG = {"center": RANDOM.normal(size=3), "radius": RANDOM.normal(size=())}
WEIGHTS = RANDOM.normal(size=(*SIZE, 4))


def both(surface, sampler, shader, **more):
    """⟨J v, w⟩ in forward mode and ⟨v, Jᵀ w⟩ in reverse mode, in float64."""
    torch = pytest.importorskip("torch")
    one = torch.ones((), dtype=torch.float64)
    constant = rts.engine_of(one).constant

    def image(theta):
        return rts.render(Part(surface, theta, shader), CAMERA, SIZE, sampler=sampler, layers=2, **more)

    theta, along = ({k: constant(x, one) for k, x in given.items()} for given in (THETA, ALONG))
    weights, chosen = constant(WEIGHTS, one), rts.engine_of(one)
    forward = float((chosen.jvp(image, theta, along)[1] * weights).sum())
    gradient = chosen.value_and_grad(lambda t: (image(t) * weights).sum())(theta)[1]
    return forward, sum(float((gradient[k] * along[k]).sum()) for k in theta)


@pytest.mark.parametrize("field", quick(FIELDS, 3))
@pytest.mark.parametrize("surface", SURFACES)
def test_forward_and_reverse_mode_agree(surface, field):
    forward, reverse = both(*SURFACES[surface](FIELDS[field]), "normals")
    assert forward == pytest.approx(reverse, rel=1e-5)


@pytest.mark.parametrize("field", quick(["root", "steep", "large", "small", "cube"]))
def test_fields_with_one_surface_have_one_derivative(field):
    found, expected = (both(*SURFACES["sdf"](f), "normals")[1] for f in (FIELDS[field], ball))
    # Rays find the root of a cube less exactly.
    assert found == pytest.approx(expected, rel=0.1 if field == "cube" else 0.01)


def test_steep_places_do_not_bound_how_others_move():
    sizes = np.exp(np.random.default_rng(0).uniform(0, 3, 100))
    sizes[:3] = 1e9, 0, 1e-6
    slopes = np.eye(3)[np.arange(100) % 3] * sizes[:, None]
    hit = np.ones(100, bool)
    moved = (slopes * per_level(slopes, hit)).sum(axis=1)
    np.testing.assert_allclose(moved[[0, *range(3, 100)]], 1, rtol=1e-12)
    assert moved[1] == 0 and 0 < moved[2] < 1e-5
    beside = np.concatenate([slopes, 1e12 * slopes])
    np.testing.assert_allclose(per_level(beside, np.repeat([True, False], 100))[:100], per_level(slopes, hit))
