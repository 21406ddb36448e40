"""Tangents of surfaces, and normal maps, by closed form and against finite differences."""

import numpy as np
import pytest
from helpers import DIFFERENTIABLE, FRONT, SIZE, arrays, finite_difference, gradient, mesh_part, quad, rigid, show

import rts
from rts import Camera

pytestmark = pytest.mark.rendering

UV = np.array([(0, 0), (1, 0), (1, 1), (0, 1)], np.float32)
EYE = Camera.look_at((0.4, 0.7, 4), (0, 0, 0), fov_y=50, aspect=1.2)


def tangent_of(theta, gbuffer, camera):
    """The first three numbers, mapped from [−1, 1] to [0, 1], and the sign as alpha 1 or 1/2."""
    tangent = gbuffer["tangent"]
    xp = rts.namespace(tangent)
    alpha = 0.75 + 0.25 * tangent[:, 3:]
    return xp.concat([alpha * (tangent[:, :3] * 0.5 + 0.5), alpha], axis=1)


tangent_of.takes_views, tangent_of.reads = True, ("tangent",)


def seen(uv, **options):
    """Tangent and sign in the middle of a square that faces the camera."""
    part = mesh_part(quad(-1, 1, -1, 1), theta={"uv": np.asarray(uv, np.float32)}, shader=tangent_of, **options)
    pixel = np.asarray(show(part, FRONT, splatter="none"))[SIZE[0] // 2, SIZE[1] // 2]
    return np.round([*(2 * pixel[:3] / pixel[3] - 1), 4 * pixel[3] - 3], 5)


def test_tangents_are_where_u_grows_and_the_sign_says_where_v_does():
    np.testing.assert_allclose(seen(UV), [1, 0, 0, 1], atol=1e-5)
    np.testing.assert_allclose(seen(0.1 * UV[:, ::-1]), [0, 1, 0, -1], atol=1e-5)
    np.testing.assert_allclose(seen(UV * [-3, 1]), [-1, 0, 0, -1], atol=1e-5)
    np.testing.assert_allclose(seen(UV * [1, -1]), [1, 0, 0, -1], atol=1e-5)
    sheared = UV + 0.5 * UV[:, ::-1] * [1, 0]  # u grows along x alone where v stays.
    np.testing.assert_allclose(seen(sheared), [1, 0, 0, 1], atol=1e-5)


def test_normal_maps_with_coordinates_of_their_own_have_tangents_along_these():
    vertices, faces = quad(-1, 1, -1, 1)
    theta = {"vertices": vertices, "uv": UV, "uv_normal_map": np.ascontiguousarray(UV[:, ::-1])}
    for left_out in ((), ("uv",)):
        kept = {name: rows for name, rows in theta.items() if name not in left_out}
        part = rts.Part(rts.Mesh(faces, {"uv_normal_map": None}), kept, tangent_of)
        pixel = np.asarray(show(part, FRONT, splatter="none"))[SIZE[0] // 2, SIZE[1] // 2]
        np.testing.assert_allclose([*(2 * pixel[:3] / pixel[3] - 1), 4 * pixel[3] - 3], [0, 1, 0, -1], atol=1e-5)


def test_tangents_move_with_the_part_and_a_mirror_changes_their_sign():
    turn = rigid((0, 0, 1), 30)
    np.testing.assert_allclose(seen(UV, transform=turn), [np.cos(np.pi / 6), 0.5, 0, 1], atol=1e-5)
    np.testing.assert_allclose(seen(UV, transform=np.diag([-1.0, 1, 1, 1])), [-1, 0, 0, -1], atol=1e-5)


def test_tangents_of_curved_surfaces_are_their_derivatives():
    # A quarter of a cylinder about y: u runs around it, so tangents are at right angles to normal and axis.
    k = 0.5522847498
    curve = np.array([(1, 0), (1, k), (k, 1), (0, 1)])
    points = np.array([[(x, y, z) for x, z in curve] for y in (-0.6, -0.2, 0.2, 0.6)], np.float32)

    def shader(theta, gbuffer, camera):
        tangent, normal = gbuffer["tangent"], gbuffer["normal"]
        normal = normal / np.linalg.norm(normal, axis=1, keepdims=True)
        off = abs((tangent[:, :3] * normal).sum(axis=1)) + abs(tangent[:, 1])
        return np.stack([off, off, off, np.ones_like(off)], axis=1)

    uv = np.array([(i / 3, j / 3) for j in range(4) for i in range(4)], np.float32)
    part = rts.Part(rts.Bezier(np.arange(16)[None]), {"points": points.reshape(-1, 3), "uv": uv}, shader)
    image = rts.render(part, Camera.look_at((3, 0.2, 3), (0.6, 0, 0.6), fov_y=40), (24, 24), splatter="none")
    assert image[..., 3].sum() > 50 and image[..., :3].max() < 1e-5


def sheet(surface):
    """A part of a curved surface with uv that bend, and the name of its control points."""
    rng = np.random.default_rng(3)
    y, x = np.mgrid[0:4, 0:4] / 1.5 - 1
    points = np.stack([x, y, 0.3 * x * y + 0.1 * rng.standard_normal(x.shape)], axis=-1)
    uv = np.stack([x + 0.2 * y * y, y + 0.1 * x], axis=-1)
    if surface == "bspline":
        return rts.Part(rts.BSpline((4, 4)), {"points": points, "uv": uv}, tangent_of), "points"
    points, uv = points.reshape(-1, 3), uv.reshape(-1, 2)
    if surface == "bezier":
        return rts.Part(rts.Bezier(np.arange(16)[None]), {"points": points, "uv": uv}, tangent_of), "points"
    faces = [(i, i + 1, i + 5, i + 4) for j in range(3) for i in range(4 * j, 4 * j + 3)]
    cage = rts.Subdivision(faces, indices={"uv": faces} if surface == "subdivision, uv of its own" else None)
    return rts.Part(cage, {"vertices": points, "uv": uv}, tangent_of), "vertices"


@pytest.mark.parametrize("surface", ["bezier", "bspline", "subdivision", "subdivision, uv of its own"])
def test_tangents_of_smooth_surfaces_are_exact(surface, monkeypatch):
    from rts.arrays.engines import context_of
    from rts.shading.tangents import tangents

    part, _ = sheet(surface)
    samples = rts.sample(part, FRONT, SIZE, splatter="none").samples[0]
    gbuffer = part.surface.evaluate(part.theta, samples)
    context, errors = context_of(part.theta), []
    for step in (2**-6, 2**-8):
        monkeypatch.setattr(type(part.surface), "param_step", step)
        stepped = tangents(part.surface, part.theta, samples, gbuffer, context)
        errors.append(abs(gbuffer["tangent"] - stepped).max())
    assert len(samples.ids) > 20 and errors[1] < 0.3 * errors[0] < 0.03


@pytest.mark.parametrize("target", DIFFERENTIABLE)
@pytest.mark.parametrize("surface", ["bezier", "bspline", "subdivision"])
def test_tangents_of_smooth_surfaces_have_derivatives(target, surface):
    part, shape = sheet(surface)
    moving = {name: part.theta[name] for name in (shape, "uv")}
    weights = np.random.default_rng(0).standard_normal((10, 12, 4))
    frozen = rts.sample(part, EYE, (10, 12), splatter="none")

    def f(theta, weights):
        return (rts.render_samples(frozen, part.replace(theta=theta), EYE, splatter="none") * weights).sum()

    expected = finite_difference(lambda theta: f(theta, weights), moving, 1e-5)
    found = gradient(target, lambda theta: f(theta, arrays(target, weights)), arrays(target, moving))
    for name in moving:
        np.testing.assert_allclose(found[name], expected[name], atol=2e-3 * abs(expected[name]).max())


@pytest.mark.parametrize("target", DIFFERENTIABLE)
def test_shading_with_a_normal_map_has_the_derivatives_of_finite_differences(target):
    rng = np.random.default_rng(0)
    vertices, faces = quad(-1, 1, -1, 1)
    vertices = vertices + 0.2 * rng.standard_normal(vertices.shape).astype(np.float32)
    constant = {"normal_map": rng.uniform(-0.4, 0.4, (3, 4, 3)) + [0, 0, 0.8], "roughness": np.array(0.5)}
    moving = {"vertices": vertices.astype(np.float64), "uv": UV + 0.1 * rng.standard_normal((4, 2))}
    size = 30, 36  # Pixels of less than half a texel, where maps are looked up at points.
    weights = rng.standard_normal((*size, 3))
    part = rts.Part(rts.Mesh(faces), arrays("numpy", {**constant, **moving}, np.float64), "pbr")
    frozen = rts.sample(part, EYE, size, splatter="none")

    def f(theta, fixed, weights):
        image = rts.render_samples(frozen, part.replace(theta={**fixed, **theta}), EYE, splatter="none")
        return (image[..., :3] * weights).sum()

    expected = finite_difference(lambda theta: f(theta, constant, weights), moving, 1e-5)
    fixed, factors = arrays(target, (constant, weights))
    found = gradient(target, lambda theta: f(theta, fixed, factors), arrays(target, moving))
    for name in moving:
        np.testing.assert_allclose(found[name], expected[name], atol=2e-3 * abs(expected[name]).max())


def test_surfaces_of_other_parameters_have_no_tangents():
    from rts.shading.tangents import tangents

    samples = rts.sample(mesh_part(quad()), FRONT, SIZE).samples[0]
    wrong = samples.replace(params=np.zeros((len(samples.ids), 3)))
    with pytest.raises(rts.InputError, match="expected two: without them 'tangent'"):
        tangents(rts.Mesh(quad()[1]), {}, wrong, {}, None)


@pytest.mark.parametrize("direction", [(-1, 1, 1), (1, 1, 1), (1, -1, 1)])
def test_a_file_s_normal_maps_look_like_the_domes_that_they_were_baked_from(data, direction):
    # Ten squares of dielectrics hold a dome, and those beside them its normal map, each turned another way.
    [part] = rts.load(data / "gltf/NormalTangentTest.glb")
    theta = {**part.theta, "light": {"direction": np.array(direction, float), "ambient": 0.1}}
    camera = Camera.orthographic((0, -0.125, 1), (0, -0.125, 0), height=2.15, aspect=444 / 430)
    y, x = np.mgrid[-17:18, -17:18]

    def off(normal_map):
        """The difference of a dome and its map, relative to the dome, for each of ten."""
        image = show(part.replace(theta={**theta, "normal_map": normal_map}), camera, size=(430, 444))
        shown, disk = np.clip(image[..., :3], 0, 1), x**2 + y**2 < 17**2  # Highlights are clipped as a display does.
        found = []
        for cy, cx in ((30 + 80 * row, 30 + 160 * column) for row in range(5) for column in range(2)):
            dome, mapped = (shown[cy + y, cx + step + x][disk] for step in (0, 64))
            found.append(np.sqrt(((dome - mapped) ** 2).mean() / (dome**2).mean()))
        return found

    assert max(off(theta["normal_map"])) < 0.02
    assert min(off(theta["normal_map"] * np.float32([1, -1, 1]))) > 0.1
