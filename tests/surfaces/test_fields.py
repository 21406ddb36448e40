"""Ready-made fields, against closed forms."""

import numpy as np
import pytest
from helpers import ALL, DIFFERENTIABLE, arrays, gradient, to_numpy

import rts
from rts_surfaces.implicit import fields
from rts_surfaces.implicit.field import Field

pytestmark = pytest.mark.sampling

RNG = np.random.default_rng(0)
POINTS = RNG.uniform(-1.2, 1.2, (5000, 3))
CENTERS, RADII = RNG.uniform(-1, 1, (40, 2)), RNG.uniform(0.02, 0.2, 40)
MANY = {"centers": CENTERS, "radii": RADII}
BALL = {"center": np.array([0.2, -0.1, 0.3]), "radius": np.array(0.7)}
TORUS = {"radii": np.array([0.9, 0.35])}


def to_each(points=POINTS):
    """(M, n) distances to all spheres."""
    off = points[:, None] - np.insert(CENTERS, 1, 0, axis=1)
    return np.linalg.norm(off, axis=2) - RADII


CLOSED_FORMS = {
    "sphere": (fields.sphere, BALL, np.linalg.norm(POINTS - BALL["center"], axis=1) - 0.7),
    "swept_sphere": (
        fields.swept_sphere,
        TORUS,
        np.hypot(np.hypot(POINTS[:, 0], POINTS[:, 2]) - 0.9, POINTS[:, 1]) - 0.35,
    ),
    "spheres": (fields.spheres, MANY, to_each().min(axis=1)),
}


@pytest.mark.parametrize("name", CLOSED_FORMS)
@pytest.mark.parametrize("target", ALL)
def test_fields_are_distances(name, target):
    f, theta, expected = CLOSED_FORMS[name]
    theta, points = arrays(target, (theta, POINTS))
    found = f(theta, points)
    assert rts.engine_of(found) is rts.engine_of(points) and found.dtype == points.dtype
    np.testing.assert_allclose(to_numpy(found), expected, rtol=0, atol=2e-6)


@pytest.mark.parametrize("name", CLOSED_FORMS)
@pytest.mark.parametrize("target", ALL)
def test_slopes_of_distances_have_length_one(name, target):
    f, theta, _ = CLOSED_FORMS[name]
    theta, points = arrays(target, (theta, POINTS[:500]))
    slope = to_numpy(Field(f).slope(theta, points))
    # Where two spheres are equally near the slope jumps, and a difference crosses the jump.
    assert np.mean(np.abs(np.linalg.norm(slope, axis=1) - 1) < 1e-4) > 0.995


@pytest.mark.parametrize("name", CLOSED_FORMS)
@pytest.mark.parametrize("target", DIFFERENTIABLE)
def test_derivatives_are_finite_where_distances_have_none(name, target):
    f, theta, _ = CLOSED_FORMS[name]
    centers = np.concatenate([np.zeros((1, 3)), BALL["center"][None], [(0.9, 0, 0)], np.insert(CENTERS[:1], 2, 0, 1)])
    theta, points = arrays(target, (theta, centers))
    field = Field(f)

    def total(given):
        return field.level(*given).sum() + (field.slope(*given) ** 2).sum()

    found = gradient(target, total, (theta, points))
    for x in (found[1], *found[0].values()):
        assert np.isfinite(x).all()


@pytest.mark.parametrize("target", DIFFERENTIABLE)
def test_the_derivative_of_many_spheres_is_that_of_the_nearest(target):
    theta, points = arrays(target, (MANY, POINTS))
    found = gradient(target, lambda theta: fields.spheres(theta, points).sum(), theta)
    nearest = to_each().argmin(axis=1)
    off = POINTS - np.insert(CENTERS, 1, 0, axis=1)[nearest]
    toward = -off[:, ::2] / np.linalg.norm(off, axis=1)[:, None]
    expected = np.zeros_like(CENTERS)
    np.add.at(expected, nearest, toward)
    np.testing.assert_allclose(found["centers"], expected, atol=2e-3)
    np.testing.assert_allclose(found["radii"], -np.bincount(nearest, minlength=40), atol=2e-3)


def test_many_spheres_are_found_compiled_and_batched():
    jax, torch = pytest.importorskip("jax"), pytest.importorskip("torch")
    expected = CLOSED_FORMS["spheres"][2]
    theta, points = arrays("jax", (MANY, POINTS))
    np.testing.assert_allclose(jax.jit(fields.spheres)(theta, points), expected, atol=2e-6)
    theta, points = arrays("torch-cpu", (MANY, POINTS))
    both = {name: torch.stack([x, x]) for name, x in theta.items()}
    for found in torch.func.vmap(lambda theta: fields.spheres(theta, points))(both):
        np.testing.assert_allclose(found, expected, atol=2e-6)


# ------------------------------------------------------------------------------------------------------- unions


def either(theta, points):
    return fields.sphere(theta["ball"], points)


def other(theta, points):
    return fields.swept_sphere(theta["ring"], points)


@pytest.mark.parametrize("target", ALL)
def test_unions_are_the_least_of_their_fields(target):
    theta, points = arrays(target, ({"ball": BALL, "ring": TORUS}, POINTS))
    expected = np.minimum(CLOSED_FORMS["sphere"][2], CLOSED_FORMS["swept_sphere"][2])
    np.testing.assert_allclose(to_numpy(fields.union(either, other)(theta, points)), expected, atol=2e-6)
    for sharpness in (1.0, 8.0, 1e6):  # The last would overflow if nothing were done about it.
        less = expected - to_numpy(fields.smooth_union(sharpness, either, other)(theta, points))
        assert (less > -2e-6).all() and (less < np.log(2) / sharpness + 2e-6).all()
        values = np.stack([CLOSED_FORMS["sphere"][2], CLOSED_FORMS["swept_sphere"][2]])
        exact = -np.logaddexp(*(-sharpness * values)) / sharpness
        np.testing.assert_allclose(expected - less, exact, atol=4e-6)


@pytest.mark.parametrize("target", DIFFERENTIABLE)
def test_smooth_unions_are_no_steeper_than_their_fields(target):
    theta, points = arrays(target, ({"ball": BALL, "ring": TORUS}, POINTS))
    slope = to_numpy(Field(fields.smooth_union(5.0, either, other)).slope(theta, points))
    assert np.linalg.norm(slope, axis=1).max() < 1 + 1e-5


# ------------------------------------------------------------------------------------------------------- fields


def test_levels_are_negative_inside():
    points = np.array([[0.5, 0, 0], [1, 0, 0], [2, 0, 0]])
    for inside, expected in (("below", [-0.5, 0, 1]), ("above", [0.5, 0, -1])):
        field = Field(lambda theta, p: p[:, 0] + 2, 3.0, inside)
        np.testing.assert_array_equal(field.level({}, points), expected)
        sign = 1 if inside == "below" else -1
        np.testing.assert_allclose(field.slope({}, points), np.tile([sign, 0, 0], (3, 1)), atol=1e-9)


def test_points_come_in_the_dtype_of_what_is_read():
    field = Field(lambda theta, p: p[:, 0], reads=("a",))
    single, double = np.zeros((4, 3), np.float32), np.zeros((4, 3))
    for points in (single, double):
        assert field.in_theta_dtype({"a": np.float32([1]), "b": double}, points).dtype == np.float32
        assert field.in_theta_dtype({"a": {"x": single, "y": [double]}}, points).dtype == np.float64
        assert field.in_theta_dtype({"a": np.arange(3)}, points).dtype == points.dtype


@pytest.mark.parametrize(
    ("f", "theta", "message"),
    [
        (fields.sphere, {}, "theta of the field has no 'center'; it has []"),
        (fields.sphere, {**BALL, "radius": np.ones(1)}, "'radius'] of the field has shape (1,); expected ()"),
        (fields.swept_sphere, {"radii": np.ones(3)}, "'radii'] of the field has shape (3,); expected (2,)"),
        (fields.swept_sphere, {"radii": np.ones(2, int)}, "dtype int64; expected a floating one"),
        (fields.spheres, {**MANY, "centers": np.ones((4, 3))}, "has shape (4, 3); expected (n, 2)"),
        (fields.spheres, {**MANY, "centers": np.ones((0, 2))}, "has shape (0, 2); expected (n, 2)"),
        (fields.spheres, {**MANY, "radii": np.ones(3)}, "has shape (3,); expected (40,)"),
    ],
)
def test_wrong_entries_are_refused(f, theta, message):
    with pytest.raises(rts.InputError) as caught:
        f(theta, POINTS)
    assert message in str(caught.value) and "\n" not in str(caught.value)


def test_wrong_fields_are_refused():
    with pytest.raises(rts.InputError, match="no fields are given"):
        fields.union()
    with pytest.raises(rts.InputError, match="field 1 is 3; expected a function"):
        fields.union(either, 3)
    with pytest.raises(rts.InputError, match="sharpness is 0; expected a positive number"):
        fields.smooth_union(0, either)
