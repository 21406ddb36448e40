"""Surfaces that are sampled on their triangles, and do not lie on the rays through the centres of cells."""

import dataclasses

import numpy as np
import pytest
from helpers import icosphere

import rts
from rts import Camera, Part
from rts.plugin_api.operations import combine
from rts.plugin_api.records import Proxy

pytestmark = pytest.mark.rendering

DISTANCE, FOV, SIZE, RADIUS = 3.0, 50.0, (32, 32), 1.0
CAMERA = Camera.look_at((0, 0, DISTANCE), (0, 0, 0), fov_y=FOV)


class Ball(rts.TriangleSurface):
    """A ball over the faces of an icosphere, θ["radius"] (): a sample is the direction that its triangle has there."""

    sample_widths = (3, 2)
    centered = False

    def __init__(self, level):
        self.directions, self.faces = icosphere(level)

    def evaluate(self, theta, samples):
        engine, xp = rts.engine_of(theta["radius"]), rts.namespace(theta["radius"])
        directions = engine.constant(self.directions, theta["radius"])
        b = xp.astype(samples.params, directions.dtype)
        weights = xp.concat([b, 1 - xp.sum(b, axis=1, keepdims=True)], axis=1)
        normal = combine(directions, samples.ids, weights)
        some = xp.sum(normal * normal, axis=1, keepdims=True)
        normal = normal / xp.sqrt(xp.where(some > 0, some, xp.ones_like(some)))
        return rts.GBuffer(position=theta["radius"] * normal, normal=normal)

    def proxy_inputs(self, theta):
        return theta["radius"]

    def proxy(self, inputs, camera, size):
        return Proxy((inputs * self.directions).astype(np.float32), self.faces)


class Refined(Ball):
    """A ball whose samples are moved to where rays meet it."""

    centered = True

    def refine(self, inputs, samples, rays):
        cells, radius = samples.row >= 0, float(inputs)
        depth, row = samples.depth.astype(np.float64), samples.row.copy()
        origin, ahead = rays.origins[row[cells]], rays.directions[row[cells]]
        a, b = (ahead * ahead).sum(1), (origin * ahead).sum(1)
        left = b * b - a * ((origin * origin).sum(1) - radius**2)
        roots = (-b + np.sqrt(np.maximum(left, 0)) * np.array([[-1], [1]])) / a
        nearest = np.abs(roots - depth[cells]).argmin(axis=0)
        depth[cells] = np.take_along_axis(roots, nearest[None], axis=0)[0]
        corners = self.directions[samples.ids[row[cells]]].astype(np.float64)
        weights = np.linalg.solve(corners.transpose(0, 2, 1), (origin + depth[cells][:, None] * ahead)[..., None])
        params = samples.params.copy()
        params[row[cells]] = (weights[:, :2] / weights.sum(axis=1, keepdims=True))[..., 0]
        row[cells] = np.where(left > 0, row[cells], -1)
        return samples.replace(params=params, row=row, depth=depth.astype(np.float32))


def closed_form(radius=RADIUS):
    """Mean alpha of a ball in the middle of the image, and its derivative in the radius."""
    square = np.tan(np.radians(FOV / 2)) ** 2
    area = np.pi / 4 * radius**2 / (DISTANCE**2 - radius**2) / square
    return area, 2 * area * DISTANCE**2 / radius / (DISTANCE**2 - radius**2)


def mean_alpha(engine, surface, **options):
    """Mean alpha and its derivative in the radius, in reverse and forward mode."""
    chosen = rts.engine_of(engine.zeros(1))
    radius = chosen.constant(np.float32(RADIUS))

    def alpha(radius):
        part = Part(surface, {"radius": radius}, "normals")
        return rts.namespace(radius).mean(rts.render(part, CAMERA, SIZE, layers=2, **options)[..., 3])

    value, slope = chosen.value_and_grad(alpha)(radius)
    return float(value), float(slope), float(chosen.jvp(alpha, radius, chosen.constant(np.float32(1)))[1])


@pytest.fixture(params=["torch", "jax"])
def engine(request):
    if request.param == "torch":
        return pytest.importorskip("torch")
    return pytest.importorskip("jax").numpy


CASES = [("torch", splatter, s) for splatter in ("edges", "multi", "single") for s in (1, 2, 4)]
CASES += [("jax", "edges", 2), ("jax", "multi", 1)]


@pytest.mark.parametrize(("engine", "splatter", "supersample"), CASES, indirect=["engine"])
def test_images_and_derivatives_are_those_of_refined_samples(engine, splatter, supersample):
    torch, options = pytest.importorskip("torch"), {"splatter": splatter, "supersample": supersample}
    value, reverse, forward = mean_alpha(engine, Ball(2), **options)
    expected, slope, _ = mean_alpha(torch, Refined(2), **options)
    assert value == pytest.approx(expected, rel=0.002)
    assert reverse == pytest.approx(slope, rel=0.05)
    assert forward == pytest.approx(reverse, rel=1e-4)


@pytest.mark.parametrize("options", [{}, {"supersample": 2}], ids=["plain", "finer"])
def test_finer_triangles_come_nearer_to_closed_forms(options):
    torch = pytest.importorskip("torch")
    found = np.array([mean_alpha(torch, Ball(level), **options)[:2] for level in (1, 2, 3)])
    value, slope = abs(found / closed_form() - 1).T
    assert value[2] < value[1] / 2 < value[0] / 4
    assert slope[2] < slope[1] < slope[0] and slope[2] < 0.07


def test_alpha_inside_is_one_at_every_resolution():
    for supersample in (1, 2, 4):
        image = rts.render(Part(Ball(1), {"radius": np.float32(1)}, "normals"), CAMERA, SIZE, supersample=supersample)
        assert image[12:20, 12:20, 3].min() > 0.999


@pytest.mark.parametrize("cull", ["none", "back"])
@pytest.mark.parametrize("by", [(0, 0, 3), (0, 0, 10), (1e4, 0, 0)], ids=["at the camera", "behind it", "far away"])
def test_samples_far_from_their_rays_have_finite_derivatives(by, cull):
    torch = pytest.importorskip("torch")

    class Elsewhere(Ball):
        def evaluate(self, theta, samples):
            found = super().evaluate(theta, samples)
            moved = found["position"] + torch.tensor(by, dtype=torch.float32)
            return rts.GBuffer(position=moved, normal=found["normal"])

    radius = torch.tensor(RADIUS, requires_grad=True)
    part = Part(Elsewhere(1), {"radius": radius}, "normals", cull=cull)
    image = rts.render(part, CAMERA, SIZE, supersample=2)
    (gradient,) = torch.autograd.grad(image[..., 3].mean(), radius)
    assert torch.isfinite(image).all() and gradient.item() == pytest.approx(closed_form()[1], rel=0.3)


def test_derivatives_are_not_called_unknown():
    torch = pytest.importorskip("torch")

    def scene(parameters):
        return Part(Ball(2), {"radius": parameters["radius"]}, "normals"), CAMERA

    report = rts.check_gradient(scene, {"radius": torch.tensor(RADIUS)}, SIZE, loss=lambda image: image[..., 3].mean())
    print(report)
    assert "unknown" not in str(report)


def test_samples_without_points_on_rays_are_refused():
    part = Part(Ball(1), {"radius": np.float32(RADIUS)}, "normals")
    found = rts.sample(part, CAMERA, SIZE)
    bare = dataclasses.replace(found, samples=(dataclasses.replace(found.samples[0], tables={}),))
    with pytest.raises(rts.InputError, match="not centered, and have no table 'points on rays'"):
        rts.render_samples(bare, part, CAMERA)
