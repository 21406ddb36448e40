"""The shader `pbr`: against its formulas written anew, integrals over all directions, and samples of environments."""

import numpy as np
import pytest
from helpers import FRONT, arrays, to_numpy

import rts
from rts import Camera, GBuffer, InputError
from rts.shading.environment import _looked_up
from rts.shading.pbr import Pbr
from rts.shading.shaders import Lambert

pytestmark = pytest.mark.rendering

EYE = np.array([0, 0.8, 4.0])
CAMERA = Camera.look_at(EYE, (0, 0, 0), fov_y=30)
BASE = np.array([0.8, 0.5, 0.3])
LAMP = {"direction": np.array([0.5, 0.8, 0.6]), "color": np.array([1.0, 0.9, 2.0]), "ambient": np.zeros(3)}
GRID = [(metallic, roughness) for metallic in (0.0, 0.5, 1.0) for roughness in (0.1, 0.2, 0.5, 1.0)]


def ball(count=12):
    """Points of the unit sphere that the eye sees, on a grid of its image, and unit vectors to the eye."""
    forward = EYE / np.linalg.norm(EYE)
    right = np.cross((0, 1, 0), forward)
    right /= np.linalg.norm(right)
    across = (np.arange(count) + 0.5) / count * 2 - 1
    x, y = (c.ravel()[:, None] for c in np.meshgrid(across, across))
    inside = (x**2 + y**2 < 0.98)[:, 0]
    x, y = x[inside], y[inside]
    points = x * right + y * np.cross(forward, right) + np.sqrt(1 - x**2 - y**2) * forward
    toward = EYE - points
    toward /= np.linalg.norm(toward, axis=1, keepdims=True)
    seen = (points * toward).sum(axis=1) > 0.05
    return points[seen], toward[seen]


def shaded(points, metallic, roughness, light, dtype=np.float64, **theta):
    theta = {"color": BASE, "metallic": np.array(metallic), "roughness": np.array(roughness), **theta}
    theta = {name: np.asarray(value, dtype) for name, value in theta.items()}
    light = {name: np.asarray(value, dtype) for name, value in light.items()}
    gbuffer = GBuffer(position=points.astype(dtype), normal=points.astype(dtype))
    return Pbr()({**theta, "light": light}, gbuffer, CAMERA)[:, :3]


def brdf(normal, toward, light, metallic, roughness, dielectric=0.04):
    """The formulas of glTF 2.0, Appendix B.3, written plainly, times the cosine (…, 3), for vectors (…, 3)."""
    half = light + toward
    half = half / np.linalg.norm(half, axis=-1, keepdims=True)
    pairs = (normal, light), (normal, toward), (normal, half), (toward, half)
    n_l, n_v, n_h, v_h = ((a * b).sum(axis=-1, keepdims=True) for a, b in pairs)
    square = roughness**4
    shape = square / (np.pi * (n_h**2 * (square - 1) + 1) ** 2)
    shadowed = n_l * np.sqrt(square + (1 - square) * n_v**2) + n_v * np.sqrt(square + (1 - square) * n_l**2)
    fresnel = dielectric * (1 - metallic) + BASE * metallic
    fresnel = fresnel + (1 - fresnel) * (1 - v_h) ** 5
    diffuse = (1 - fresnel) * (1 - metallic) * BASE / np.pi
    return np.where(n_l > 0, n_l * (diffuse + fresnel * shape / (2 * np.where(n_l > 0, shadowed, 1))), 0)


def sampled(normals, toward, metallic, roughness, radiance, count=2048):
    """Light that surfaces reflect to the eye (N, 3), by `count` samples of GGX and as many of a cosine, each."""
    u, turn = (np.arange(count) + 0.5) / count, 2 * np.pi * ((np.arange(count) * 0.6180339887498949) % 1)
    square, found = roughness**4, []
    for normal, eye in zip(normals, toward, strict=True):
        side = np.cross(normal, np.eye(3)[abs(normal).argmin()])
        side /= np.linalg.norm(side)
        frame = np.stack([side, np.cross(normal, side), normal])
        high = np.sqrt((1 - u) / (1 + (square - 1) * u))
        half, flat = (
            np.stack([np.sqrt(1 - z**2) * np.cos(turn), np.sqrt(1 - z**2) * np.sin(turn), z], axis=1) @ frame
            for z in (high, np.sqrt(1 - u))
        )
        light = np.concatenate([2 * (half @ eye)[:, None] * half - eye, flat])
        half = light + eye
        half /= np.linalg.norm(half, axis=1, keepdims=True)
        n_h, v_h, n_l = half @ normal, half @ eye, np.maximum(light @ normal, 0)
        density = square / (np.pi * (n_h**2 * (square - 1) + 1) ** 2) * n_h / (4 * v_h) + n_l / np.pi
        found.append(
            (brdf(normal, eye, light, metallic, roughness) * radiance(light) / density[:, None]).sum(0) / count
        )
    return np.array(found)


@pytest.mark.parametrize("metallic, roughness", GRID)
def test_light_from_one_direction_is_that_of_the_formulas(metallic, roughness):
    points, toward = ball()
    direction = LAMP["direction"] / np.linalg.norm(LAMP["direction"])
    expected = np.pi * LAMP["color"] * brdf(points, toward, direction, metallic, roughness)
    np.testing.assert_allclose(shaded(points, metallic, roughness, LAMP), expected, rtol=1e-9, atol=1e-12)
    single = shaded(points, metallic, roughness, LAMP, np.float32)
    np.testing.assert_allclose(single, expected, rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize("specular", [0.5, (0.0, 2.0, 30.0)])
def test_specular_is_what_dielectrics_reflect_at_most_all(specular):
    points, toward = ball()
    direction = LAMP["direction"] / np.linalg.norm(LAMP["direction"])
    for metallic in (0.0, 0.5, 1.0):
        dielectric = np.minimum(0.04 * np.asarray(specular), 1)
        expected = np.pi * LAMP["color"] * brdf(points, toward, direction, metallic, 0.4, dielectric)
        found = shaded(points, metallic, 0.4, LAMP, specular=specular)
        np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("kind", ["numpy", "torch-cpu", "jax"])
def test_whole_numbers_of_python_are_numbers_of_materials_and_lights(kind):
    part = rts.plugin("surfaces", "mesh").example()
    camera = Camera.look_at((0, 1, 4), (0, 0, 0))
    entries = arrays(kind, dict(part.theta))

    def image(one, two):
        theta = entries | {"metallic": one, "roughness": one, "light": {"direction": (0, two, 0), "ambient": two}}
        return to_numpy(rts.render(part.replace(theta=theta, shader="pbr"), camera, (9, 12)))

    np.testing.assert_allclose(image(1, 2), image(1.0, 2.0), rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("metallic, roughness", [g for g in GRID if g[1] >= 0.2])
def test_even_light_from_all_around_is_the_integral_of_the_formulas(metallic, roughness):
    points, toward = ball(6)
    even = {"direction": np.array([0, 0, 1.0]), "color": np.zeros(3), "ambient": np.ones(3)}
    expected = sampled(points, toward, metallic, roughness, lambda light: 1.0, 8192)
    np.testing.assert_allclose(shaded(points, metallic, roughness, even), expected, atol=1.2e-3)


def sky():
    """An environment (64, 128, 3) of contrast 10: a bright patch of sky, a dark ground, all without edges."""
    v, u = ((np.arange(n) + 0.5) / n for n in (64, 128))
    up, around = np.cos(np.pi * v)[:, None], 2 * np.pi * (u - 0.5)
    across, back = np.sin(np.pi * v)[:, None] * np.sin(around), -np.sin(np.pi * v)[:, None] * np.cos(around)
    sun = np.exp(4 * (0.5 * across + 0.7 * up - 0.5 * back - 1))
    ground = 0.2 + 0.5 / (1 + np.exp(-6 * up)) + 0 * sun
    return ground[..., None] * [0.8, 0.9, 1.0] + sun[..., None] * [1.4, 1.2, 1.0]


def test_an_environment_is_reflected_as_4096_samples_of_it_are():
    points, toward = ball(10)
    image = sky()
    assert 9 < image.mean(axis=2).max() / image.mean(axis=2).min() < 10
    light, errors = {"environment": image}, []
    for metallic, roughness in [(m, r) for m in (0.0, 1.0) for r in (0.2, 0.4, 0.7, 1.0)]:
        expected = sampled(points, toward, metallic, roughness, lambda way: _looked_up(image, way))
        difference = shaded(points, metallic, roughness, light) - expected
        errors.append(np.sqrt((difference**2).mean() / (expected**2).mean()))
    assert max(errors) < 0.03, errors


def test_without_entries_of_its_own_it_is_nearly_lambert():
    gbuffer = GBuffer(position=ball()[0], normal=ball()[0])
    found, lambert = (shader({}, gbuffer, CAMERA) for shader in (Pbr(), Lambert()))
    assert abs(found - lambert).max() < 0.06 and abs(found - lambert).mean() < 0.02


def test_it_is_two_sided_and_turns_bent_normals_over():
    theta = {"normal_map": np.array([[[0.3, -0.2, 0.9]]]), "roughness": np.array(0.4), "light": LAMP}
    position, uv = np.array([(0.1, 0.2, 0.0)]), np.array([(0.5, 0.5)])
    seen = GBuffer(position=position, uv=uv, normal=np.array([(0, 0, 2.0)]), tangent=np.array([(1.0, 0, 0, 1)]))
    bent = np.array([(0.3, -0.2, 0.9)]) / np.linalg.norm((0.3, -0.2, 0.9))
    plain = {name: value for name, value in theta.items() if name != "normal_map"}
    expected = Pbr()(plain, GBuffer(position=position, normal=bent), FRONT)
    np.testing.assert_allclose(Pbr()(theta, seen, FRONT), expected, rtol=1e-9)
    # From behind the same map bends the other way, and the whole frame is turned over.
    behind = GBuffer(position=position, uv=uv, normal=np.array([(0, 0, -2.0)]), tangent=np.array([(-1.0, 0, 0, 1)]))
    np.testing.assert_allclose(Pbr()(theta, behind, FRONT)[0, 3], 1)
    turned = np.array([(0.3, 0.2, 0.9)]) / np.linalg.norm(bent * np.linalg.norm((0.3, -0.2, 0.9)))
    expected = Pbr()(plain, GBuffer(position=position, normal=turned), FRONT)
    np.testing.assert_allclose(Pbr()(theta, behind, FRONT), expected, rtol=1e-9)


def test_occlusion_dims_what_comes_from_all_around_and_emissive_adds():
    points, _ = ball(4)
    around, lamp = {"ambient": np.array(0.7), "environment": sky()}, LAMP
    both = {**around, "direction": lamp["direction"], "color": lamp["color"]}
    parts = [shaded(points, 0.3, 0.5, light) for light in (around, lamp)]
    found = shaded(points, 0.3, 0.5, both, occlusion=0.25, emissive=(0.1, 2.0, 0))
    np.testing.assert_allclose(found, 0.25 * parts[0] + parts[1] + [0.1, 2, 0], rtol=1e-6)


def test_maps_are_looked_up_and_equal_numbers_where_they_are_even():
    points, _ = ball(4)
    uv = np.random.default_rng(0).random((len(points), 2))
    numbers = {"metallic": np.array(0.3), "roughness": np.array(0.6), "occlusion": np.array(0.5)}
    maps = {name: np.full((3, 2, 1), value) for name, value in numbers.items()}
    gbuffer = GBuffer(position=points, normal=points, uv=uv)
    np.testing.assert_allclose(Pbr()(maps, gbuffer, CAMERA), Pbr()(numbers, gbuffer, CAMERA), rtol=1e-9)
    ramp = {"metallic": np.array([[[0.0], [1.0]]])}
    gbuffer = GBuffer(
        position=points[:1].repeat(2, 0), normal=points[:1].repeat(2, 0), uv=np.array([(0.25, 0.5), (0.75, 0.5)])
    )
    ends = [Pbr()({"metallic": np.array(m)}, gbuffer, CAMERA)[0] for m in (0.0, 1.0)]
    np.testing.assert_allclose(Pbr(wrap="clamp")(ramp, gbuffer, CAMERA), ends, rtol=1e-9)


@pytest.mark.parametrize(
    "name, value, message",
    [
        ("metallic", np.zeros((4, 4, 3)), r"theta\['metallic'\] has shape \(4, 4, 3\); expected a map \(h, w, 1\)"),
        ("roughness", np.zeros(3), r"theta\['roughness'\] has shape \(3,\); expected an array of shape \(\) or"),
        ("normal_map", np.zeros(3), r"theta\['normal_map'\] has shape \(3,\); expected a map \(h, w, 3\)"),
        ("emissive", np.full(3, np.inf), r"theta\['emissive'\] holds NaN or infinity"),
        ("occlusion", np.zeros((2, 2, 1), np.int32), "has dtype int32"),
    ],
)
def test_wrong_entries_are_refused(name, value, message):
    gbuffer = GBuffer(position=np.zeros((1, 3)), normal=np.ones((1, 3)), uv=np.zeros((1, 2)))
    with pytest.raises(InputError, match=message):
        Pbr()({name: value}, gbuffer, FRONT)


def test_a_map_with_coordinates_of_its_own_is_looked_up_there_by_its_own_sampler():
    rng = np.random.default_rng(0)
    points, _ = ball()
    uv, own = rng.uniform(-1, 2, (2, len(points), 2))
    theta = {"occlusion": rng.uniform(0, 1, (5, 4, 1)), "roughness": np.array(0.5)}
    gbuffer = {"position": points, "normal": points, "uv": own}
    for wrap, filter in (("repeat", "linear"), (("clamp", "mirror"), "nearest")):
        expected = Pbr(wrap=wrap, filter=filter)(theta, GBuffer(gbuffer), CAMERA)
        apart = {**gbuffer, "uv": uv, "uv_occlusion": own}
        other = "nearest" if filter == "linear" else "linear"
        shader = Pbr(wrap="mirror", filter=other, samplers=(("occlusion", wrap, filter),))
        np.testing.assert_array_equal(shader(theta, GBuffer(apart), CAMERA), expected)
        assert abs(shader(theta, GBuffer(gbuffer | {"uv": uv}), CAMERA) - expected).max() > 0.1


def test_coordinates_of_a_map_are_two_numbers():
    points, _ = ball()
    gbuffer = GBuffer(position=points, normal=points, uv_occlusion=points)
    with pytest.raises(InputError, match=r"the surface's 'uv_occlusion' has shape .*; expected \(N, 2\)"):
        Pbr()({"occlusion": np.ones((2, 2, 1))}, gbuffer, CAMERA)


@pytest.mark.parametrize(
    "wrong", ["clamp", (("occlusion", "clamp"),), (("colour", "clamp", "linear"),), ((3, "clamp", "linear"),)]
)
def test_wrong_samplers_are_refused(wrong):
    with pytest.raises(InputError, match="expected a tuple of \\(name, wrap, filter\\)"):
        Pbr(samplers=wrong)
    with pytest.raises(InputError, match="wrap is 'round'"):
        Pbr(samplers=(("occlusion", "round", "linear"),))


def test_a_map_without_uv_is_refused():
    gbuffer = GBuffer(position=np.zeros((1, 3)), normal=np.ones((1, 3)))
    with pytest.raises(InputError, match="the shader reads 'uv'"):
        Pbr()({"roughness": np.ones((2, 2, 1))}, gbuffer, FRONT)
