"""Light that shaders share: lamps, spherical harmonics, environments; tone mapping."""

import numpy as np
import pytest
from helpers import ALL, DIFFERENTIABLE, FRONT, arrays, finite_difference, gradient, to_numpy

from rts import GBuffer, InputError
from rts.shading import harmonics, irradiance, prefiltered, tonemap, turned_environment
from rts.shading.environment import _directions, reflected
from rts.shading.pbr import Pbr
from rts.shading.shaders import BlinnPhong, Lambert

pytestmark = pytest.mark.rendering

SHADERS = Lambert(), BlinnPhong(), Pbr()
WAYS = np.random.default_rng(0).standard_normal((40, 3))
WAYS[:, 2] = abs(WAYS[:, 2])
WAYS /= np.linalg.norm(WAYS, axis=1, keepdims=True)


def shade(shader, light, position=(0, 0, 0.0), **theta):
    gbuffer = GBuffer(position=np.tile(np.array(position), (len(WAYS), 1)), normal=WAYS)
    theta = {name: np.asarray(value, np.float64) for name, value in theta.items()}
    light = {n: v if isinstance(v, dict) else np.asarray(v, np.float64) for n, v in light.items()}
    return shader({**theta, "light": light}, gbuffer, FRONT)[:, :3]


@pytest.mark.parametrize("shader", SHADERS)
def test_a_point_light_fades_with_the_square_of_its_distance(shader):
    near = shade(shader, {"position": (0.1, 1.2, 2.0), "intensity": (3, 2, 1)}, (0.1, 0.2, 0))
    way, square = np.array([0, 1, 2.0]), 5.0
    far = {"direction": way, "color": np.array([3, 2, 1]) / square, "ambient": 0}
    np.testing.assert_allclose(near, shade(shader, far, (0.1, 0.2, 0)), atol=1e-12)


CONE = np.array([0.3, 0.6])
SPOT = {"position": np.array([0, 0, 2.0]), "intensity": np.full(3, 4.0)}


def floor_lit_by(light, points):
    """The colour of a white floor, z = 0, at points (N, 2), without any cosine of the floor."""
    position = np.column_stack([points, np.zeros(len(points))])
    toward = light["position"] - position
    gbuffer = GBuffer(position=position, normal=toward)
    return Lambert()({"light": {**light, "ambient": np.zeros(())}}, gbuffer, FRONT)[:, 0] * (toward**2).sum(axis=1)


def test_a_spot_light_fades_between_the_two_angles_of_its_cone():
    angle = np.linspace(0, 1.2, 50)
    points = 2 * np.tan(angle)[:, None] * [np.cos(0.4), np.sin(0.4)]
    found = floor_lit_by({**SPOT, "axis": np.array([0, 0, -3.0]), "cone": CONE}, points)
    share = np.clip((np.cos(angle) - np.cos(0.6)) / (np.cos(0.3) - np.cos(0.6)), 0, 1)
    np.testing.assert_allclose(found, 4 * share**2, atol=1e-12)
    assert (found[angle < 0.3] > 3.999).all() and (found[angle > 0.6] == 0).all()
    hard = floor_lit_by({**SPOT, "axis": np.array([0, 0, -1.0]), "cone": np.array([0.5, 0.5])}, points)
    np.testing.assert_allclose(hard[abs(angle - 0.5) > 0.01], 4.0 * (angle < 0.5)[abs(angle - 0.5) > 0.01], atol=1e-9)
    default = floor_lit_by({**SPOT, "axis": np.array([0, 0, -1.0])}, points)
    np.testing.assert_allclose(
        default, 4 * np.clip((np.cos(angle) - np.sqrt(0.5)) / (1 - np.sqrt(0.5)), 0, 1) ** 2, atol=1e-9
    )


def test_a_light_without_an_axis_beside_spot_lights_shines_all_around():
    points = np.random.default_rng(0).uniform(-3, 3, (30, 2))
    even = floor_lit_by({**SPOT, "axis": np.zeros(3), "cone": CONE}, points)
    np.testing.assert_array_equal(even, floor_lit_by(SPOT, points))


@pytest.mark.parametrize("target", DIFFERENTIABLE)
def test_a_spot_light_has_derivatives_in_all_its_entries(target):
    light = {"position": np.array([[0.2, 0.1, 2.0]]), "axis": np.array([[0.1, 0, -1.0]]), "cone": CONE[None]}
    points = np.random.default_rng(0).uniform(-1, 1, (40, 2))
    fixed = np.column_stack([points, np.zeros(40)]), np.tile([0, 0, 1.0], (40, 1))

    def f(light, position, normal):
        return Lambert()({"light": light}, GBuffer(position=position, normal=normal), FRONT)[:, :3].sum()

    expected = finite_difference(lambda light: f(light, *fixed), light, 1e-6)
    found = gradient(target, lambda light: f(light, *arrays(target, fixed)), arrays(target, light))
    for name in light:
        assert abs(expected[name]).max() > 0.1
        np.testing.assert_allclose(found[name], expected[name], atol=1e-3 * abs(expected[name]).max())


@pytest.mark.parametrize("shader", SHADERS)
def test_even_light_is_the_same_as_a_number_harmonics_and_an_image(shader):
    ambient = shade(shader, {"position": (0, 0, 9.0), "intensity": (0, 0, 0), "ambient": 0.7})
    np.testing.assert_allclose(shade(shader, {"sh": np.full((1, 3), 0.7 * np.sqrt(4 * np.pi))}), ambient, rtol=1e-6)
    np.testing.assert_allclose(shade(shader, {"environment": np.full((6, 12, 3), 0.7)}), ambient, rtol=1e-6)


@pytest.mark.parametrize("roughness", [0.25, 0.6, 1.0])
def test_harmonics_and_an_image_of_them_light_alike(roughness):
    sh = np.zeros((16, 3))
    sh[0], sh[1:] = 5, 0.4 * np.random.default_rng(1).standard_normal((15, 3))
    image = (harmonics(_directions(64, 128).reshape(-1, 3), 16) @ sh).reshape(64, 128, 3)
    assert image.min() > 0
    found = [shade(Pbr(), light, metallic=0.5, roughness=roughness) for light in ({"sh": sh}, {"environment": image})]
    np.testing.assert_allclose(found[0], found[1], rtol=0.01)
    np.testing.assert_allclose(prefiltered(image)["sh"], sh[:9], atol=2e-3)


def test_a_prefiltered_environment_is_the_image_blurred_once():
    image = np.random.default_rng(0).random((6, 12, 3))
    found = [shade(Pbr(), {"environment": x}, roughness=0.3, metallic=0.4) for x in (image, prefiltered(image))]
    np.testing.assert_array_equal(*found)


def test_the_image_is_the_view_along_minus_z_with_x_on_the_right_and_y_on_top():
    image = np.zeros((64, 128, 3))
    for way, rows, columns in (
        ((0, 0, -1), (24, 40), (56, 72)),
        ((1, 0, 0), (24, 40), (88, 104)),
        ((0, 1, 0), (0, 8), (0, 128)),
    ):
        here = image.copy()
        here[slice(*rows), slice(*columns)] = 1
        seen = reflected(prefiltered(here), np.array([way, np.negative(way)], float), np.zeros((2, 1)))
        np.testing.assert_allclose(seen[:, 0], [1, 0], atol=1e-6)
    here = image.copy()
    here[:8] = 1  # Above, +y; in a world with z up, +z.
    up_z = turned_environment(here, np.array([[1, 0, 0], [0, 0, 1.0], [0, -1, 0]]))
    seen = reflected(prefiltered(up_z), np.array([(0, 0, 1.0), (0, 1.0, 0)]), np.zeros((2, 1)))
    np.testing.assert_allclose(seen[:, 0], [1, 0], atol=1e-6)


def test_irradiance_of_a_distant_light_is_a_cosine_by_harmonics_up_to_order_2():
    # Light from +z alone: its harmonics, convolved with a cosine, are known (Ramamoorthi and Hanrahan 2001).
    sh = np.repeat(np.pi * harmonics(np.array([[0, 0, 1.0]]), 16).T, 3, axis=1)
    c = WAYS[:, 2:]
    np.testing.assert_allclose(
        irradiance(sh, WAYS), np.repeat(1 / 4 + c / 2 + 5 / 32 * (3 * c * c - 1), 3, 1), atol=1e-9
    )


def test_defaults_hold_only_without_lights_that_surround():
    dark = shade(Lambert(), {"position": (0, 0, 9.0), "intensity": (0, 0, 0)})
    np.testing.assert_array_equal(dark, 0)
    lamp = {"direction": (0, 0, 1.0), "color": (1, 1, 1)}
    np.testing.assert_allclose(shade(Lambert(), lamp), 0.2 + WAYS[:, 2:].repeat(3, axis=1))
    np.testing.assert_allclose(shade(Lambert(), {**lamp, "ambient": 0}), WAYS[:, 2:].repeat(3, axis=1))
    np.testing.assert_allclose(shade(Lambert(), {**lamp, "sh": np.zeros((4, 3))}), WAYS[:, 2:].repeat(3, axis=1))


@pytest.mark.parametrize("target", ALL)
def test_engines_blur_an_environment_alike(target):
    image = np.random.default_rng(0).random((8, 16, 3)).astype(np.float32)
    found, expected = to_numpy(prefiltered(arrays(target, image))), prefiltered(image.astype(np.float64))
    for name in expected:
        np.testing.assert_allclose(found[name], expected[name], atol=2e-5)


@pytest.mark.parametrize(
    "light, message",
    [
        ({"sh": np.zeros((5, 3))}, r"expected an array of shape \(n, 3\), n = 1, 4, 9 or 16"),
        ({"environment": np.zeros((4, 8))}, r"expected an array of shape \(h, w, 3\)"),
        ({"environment": {"sh": np.zeros((9, 3))}}, "expected an image, or what prefiltered made of it"),
        ({"intensity": np.ones(3)}, "has 'intensity', but no 'position' of point lights"),
        ({"axis": np.ones(3)}, "has 'axis', but no 'position' of point lights"),
        ({"position": np.ones(3), "cone": np.ones(2)}, "has a cone, but no axis"),
        ({"position": np.ones(3), "axis": np.ones(3), "cone": np.ones(3)}, r"expected an array of shape \(2,\) or"),
        ({"position": np.ones(3), "axis": np.ones(3), "cone": np.array([2, 1.0])}, "expected two angles from 0 to π"),
        ({"position": np.ones(3), "axis": np.ones(3), "cone": np.array([0, 30.0])}, "in radians"),
        ({"position": np.ones(3), "axis": np.ones((2, 3))}, "has 1 positions but 2 axes"),
        ({"position": np.ones((2, 3)), "intensity": np.ones((3, 3))}, "has 2 positions but 3 intensities"),
        ({"colour": np.ones(3)}, "has an entry 'colour'; expected direction"),
    ],
)
def test_wrong_light_is_refused(light, message):
    with pytest.raises(InputError, match=message):
        shade(Lambert(), light)


def test_tone_mapping_keeps_dark_colours_and_compresses_bright_ones():
    grey = np.linspace(0, 60, 500)[:, None] * np.ones(3)
    found = tonemap(grey)[:, 0]
    assert found[0] == 0 and (np.diff(found) > 0).all() and 0.99 < found[-1] < 1
    np.testing.assert_allclose(tonemap(np.array([0.5, 0.3, 0.2])), np.array([0.5, 0.3, 0.2]) - 0.04)
    np.testing.assert_allclose(tonemap(np.array([0.25, 0.15, 0.1]), 1.0), np.array([0.5, 0.3, 0.2]) - 0.04)
    half = tonemap(np.array([[1.0, 0.5, 0.2, 0.5], [0, 0, 0, 0]]))
    np.testing.assert_allclose(half, [[*(0.5 * tonemap(np.array([2.0, 1.0, 0.4]))), 0.5], [0, 0, 0, 0]])
    with pytest.raises(InputError, match="expected a number of stops"):
        tonemap(grey, "bright")


@pytest.mark.parametrize("target", ALL)
@pytest.mark.parametrize("width", [41, 47, 82])
def test_environments_of_odd_widths_are_looked_up_inside_of_their_rows(target, width):
    image = arrays(target, np.ones((width // 2, width, 3)))
    for name, found in prefiltered(image).items():
        assert np.isfinite(to_numpy(found)).all(), name
    np.testing.assert_allclose(to_numpy(turned_environment(image, arrays(target, np.eye(3)))), 1, atol=1e-6)
