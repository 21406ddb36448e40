"""Scenes scaled as a whole, camera and all: images and gradients are those of scale 1."""

import numpy as np
import pytest
from helpers import ALL, DIFFERENTIABLE, arrays, derivative, gradient, icosphere, quick, relative_error, to_numpy

import rts
from rts.operations.unit import unit

pytestmark = pytest.mark.rendering

SIZE = (20, 20)
WEIGHTS = np.random.default_rng(0).normal(size=(*SIZE, 4))
SCALES = quick((1e-10, 1e10, 1e-12, 1e-15))
"""Areas of 1e-20 and 1e20 have squares that float32 has not."""
SHADERS = "lambert", "normals", "blinn_phong"


def camera(scale):
    eye, planes = scale * np.array([1, 0.8, 3.2]), {"near": 0.5 * scale, "far": 10 * scale}
    return rts.Camera.look_at(eye, (0, 0, 0), fov_y=40, **planes)


def mesh(scale):
    vertices, faces = icosphere(1)
    return rts.Mesh(faces), {"vertices": vertices.astype(np.float64) * scale}


def example(plugin):
    def made(scale):
        part = rts.plugin("rts.surfaces", plugin).example()
        (name,) = {"points", "vertices"} & set(part.theta)
        return part.surface, {name: part.theta[name].astype(np.float64) * scale}

    return made


def isosurface(scale):
    x, y, z = np.meshgrid(*[np.linspace(-1.3, 1.3, 12)] * 3, indexing="ij")
    surface = rts.Isosurface(np.full((2, 3), 1.3 * scale) * [[-1], [1]])
    return surface, {"values": (np.sqrt(x * x + 1.3 * y * y + z * z) - 0.9) * scale}


def sdf(scale):
    def distance(theta, points):
        xp = rts.namespace(points)
        return scale * xp.sqrt(xp.sum((points / scale) ** 2, axis=-1)) - theta["radius"]

    return rts.Sdf(distance, 1.2 * scale), {"radius": np.array(scale)}


def shown(surface, theta, scale, shader, transform=None):
    return rts.render(rts.Part(surface, theta, shader, transform), camera(scale), SIZE)


def check(made, scale, shader, target, image_off=1e-4, slope_off=3e-4):
    """Compare image and gradient at a scale, in float32, with those at scale 1 in float64."""
    results = []
    for s, dtype in ((scale, np.float32), (1.0, np.float64)):
        surface, theta = made(s)
        theta = arrays(target, theta, dtype)
        weights = arrays(target, WEIGHTS, dtype)
        image = to_numpy(shown(surface, theta, s, shader))

        def total(x, surface=surface, s=s, weights=weights):
            return (shown(surface, x, s, shader) * weights).sum()

        (slope,) = gradient(target, total, theta).values()
        results.append((image, slope.astype(np.float64) * s))
    (image, slope), (expected, expected_slope) = results
    assert expected[..., 3].sum() > 20 and np.ptp(expected[..., 0]) > 0.3
    np.testing.assert_allclose(image, expected, atol=image_off)
    assert relative_error(slope, expected_slope) < slope_off


@pytest.mark.parametrize("scale", SCALES)
@pytest.mark.parametrize("shader", SHADERS)
def test_a_mesh_of_any_scale_looks_the_same_and_has_right_gradients(shader, scale):
    check(mesh, scale, shader, "torch-cpu")


@pytest.mark.thorough
@pytest.mark.parametrize("scale", (1e-10, 1e10))
@pytest.mark.parametrize("shader", SHADERS)
def test_in_jax_a_mesh_of_any_scale_looks_the_same_and_has_right_gradients(shader, scale):
    pytest.importorskip("jax")
    surface, theta = mesh(scale)
    given, weights = arrays("jax", theta), arrays("jax", WEIGHTS)
    found = gradient("jax", lambda x: (shown(surface, x, scale, shader) * weights).sum(), given)["vertices"]
    surface, theta = mesh(1.0)
    given, weights = arrays("torch-cpu", theta, np.float64), arrays("torch-cpu", WEIGHTS, np.float64)
    expected = gradient("torch-cpu", lambda x: (shown(surface, x, 1.0, shader) * weights).sum(), given)["vertices"]
    assert relative_error(found.astype(np.float64) * scale, expected) < 3e-4


@pytest.mark.parametrize("scale", quick((1e-10, 1e10)))
@pytest.mark.parametrize("surface", quick(("bezier", "bspline", "subdivision", isosurface, sdf)))
@pytest.mark.thorough
def test_other_surfaces_of_any_scale_look_the_same_and_have_right_gradients(surface, scale):
    # Outlines of what has no triangles, or moves samples off them, are found by halving, which rounding may change.
    off = {"image_off": 0.02, "slope_off": 1e-2}
    check(example(surface) if isinstance(surface, str) else surface, scale, "normals", "torch-cpu", **off)


@pytest.mark.parametrize("scale", (1e-10, 1e10))
def test_a_transform_that_scales_leaves_shading_as_it_is(scale):
    surface, theta = mesh(1.0)
    expected = shown(surface, theta, 1.0, "lambert")
    transform = np.diag([scale] * 3 + [1.0])
    np.testing.assert_allclose(shown(surface, theta, scale, "lambert", transform), expected, atol=1e-4)


# ------------------------------------------------------------------------------------------------ unit vectors


@pytest.mark.parametrize("target", ALL)
def test_unit_vectors_of_any_length_are_the_closed_form(target):
    lengths = np.array([1e-37, 1e-30, 1e-22, 1e-10, 1.0, 1e10, 1e22, 1e37])
    given = lengths[:, None] * np.array([2 / 3, -1 / 3, 2 / 3])
    for rows in (given, *given[:, None]):  # All at once, and one by one.
        found = to_numpy(unit(arrays(target, rows)))
        np.testing.assert_allclose(found, np.tile([2 / 3, -1 / 3, 2 / 3], (len(rows), 1)), rtol=1e-6)
    zero = to_numpy(unit(arrays(target, np.zeros((2, 3)))))
    np.testing.assert_array_equal(zero, 0)


@pytest.mark.parametrize("target", DIFFERENTIABLE)
def test_derivatives_of_unit_vectors_of_any_length_are_the_closed_form(target):
    direction, along = np.array([2 / 3, -1 / 3, 2 / 3]), np.array([0.3, 0.5, -0.2])
    expected = along - direction * (direction @ along)
    for length in (1e-22, 1e-16, 1.0, 1e16, 1e22):
        given, tangent, to = (arrays(target, x[None]) for x in (length * direction, length * along, along))
        np.testing.assert_allclose(derivative(target, unit, given, tangent)[1][0], expected, rtol=1e-5)
        found = gradient(target, lambda x, to=to: (unit(x) * to).sum(), given)
        np.testing.assert_allclose(found[0].astype(np.float64) * length, expected, rtol=1e-5)
    found = gradient(target, lambda x: (unit(x) * arrays(target, along)).sum(), arrays(target, np.zeros((1, 3))))
    np.testing.assert_allclose(found[0], along, rtol=1e-6)
