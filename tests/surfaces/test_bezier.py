"""Bézier patches: a surface that refines its samples, from triangles to images."""

import numpy as np
import pytest
from example_surfaces import Bezier
from helpers import DIFFERENTIABLE, FRONT, arrays, gradient
from seen import CAMERA, SIZE, VIEWS, WEIGHTS, rays_spread, stages

import rts
from rts.testing import SurfaceConformance
from rts_testing.compatibility import BORDER
from rts_testing.derivatives import claim_slope, directions

pytestmark = pytest.mark.sampling


BEZIER = Bezier.example()


def test_a_flat_patch_is_met_where_its_plane_is():
    x, y = np.meshgrid(np.linspace(-1, 1, 4), np.linspace(-1, 1, 4), indexing="ij")
    points = np.stack([x, y, 0.25 * x - 0.5 * y], axis=-1).reshape(-1, 3).astype(np.float32)
    part = rts.Part(Bezier([np.arange(16)], 2), {"points": points}, "normals")
    samples = rts.sample(part, FRONT, SIZE, layers=1, splatter=None).samples[0]
    rays = FRONT.with_border(SIZE, BORDER).rays(samples.row.shape[1:])
    cells = samples.row[0] >= 0
    x, y = rays.origins[cells][:, :2].T
    assert len(x) > 100
    params, depth = samples.params[samples.row[0][cells]], samples.depth[0][cells]
    np.testing.assert_allclose(params, np.stack([x + 1, y + 1], axis=-1) / 2, atol=1e-6)
    np.testing.assert_allclose(depth, 5 - 0.25 * x + 0.5 * y, atol=1e-6)
    normal = part.surface.evaluate(part.theta, samples)["normal"]
    np.testing.assert_allclose(normal, np.tile(np.array([-0.25, 0.5, 1]) / 1.3125**0.5, (len(normal), 1)), atol=1e-5)


def test_the_scene_has_layers_that_change_places_meet_and_miss():
    lifted, moved, settled = stages(BEZIER, CAMERA, 4)
    disordered = 0
    for y, x in np.ndindex(SIZE):
        depth = moved.depth[:, y, x][moved.row[:, y, x] >= 0]
        disordered += (np.diff(depth) < 0).any()
    count = [int((s.row >= 0).sum()) for s in (lifted, moved, settled)]
    assert disordered > 0
    assert count[0] > count[1] > count[2] > 400
    assert (settled.row[3] >= 0).sum() > 20


@pytest.mark.parametrize("view", VIEWS)
@pytest.mark.parametrize("layers", [2, 3, 4])
def test_settled_layers_are_front_to_back_without_gaps_on_centres_of_pixels(view, layers):
    camera = VIEWS[view]
    samples = rts.sample(BEZIER, camera, SIZE, layers=layers, splatter=None).samples[0]
    covered, wide = samples.row >= 0, camera.with_border(SIZE, BORDER)
    assert covered[1].sum() > 5 and not (covered[1:] & ~covered[:-1]).any()
    spread = rays_spread(camera)
    apart, behind = np.diff(samples.depth, axis=0)[covered[1:]], samples.depth[1:][covered[1:]]
    assert (apart > 0.0099 * (spread[0] + spread[1] * behind)).all()
    np.testing.assert_array_equal(samples.row[covered], np.arange(covered.sum()))
    assert not samples.depth[~covered].any()
    near, far = camera.depth_range()
    assert near * 0.999 < samples.depth[covered].min() and samples.depth[covered].max() < far * 1.001
    k, y, x = np.nonzero(covered)
    position = BEZIER.surface.evaluate(BEZIER.theta, samples)["position"][samples.row[covered]]
    seen = wide.project(position.astype(np.float64), samples.row.shape[1:])
    np.testing.assert_allclose(seen[:, :2], np.stack([x, y], axis=-1) + 0.5, rtol=0, atol=0.02)
    np.testing.assert_allclose(seen[:, 2], samples.depth[covered], rtol=1e-5)


def test_coarse_and_fine_triangles_lead_to_the_same_roots():
    coarse, fine = (
        rts.sample(BEZIER.replace(surface=Bezier(BEZIER.surface.indices, n)), CAMERA, SIZE, layers=4, splatter=None)
        for n in (3, 24)
    )
    both = (coarse.row >= 0) & (fine.row >= 0)
    assert both.sum() > 0.95 * (fine.row >= 0).sum()
    same = np.isclose(coarse.depth, fine.depth, rtol=1e-5)[both]
    # Where one tessellation lacks a sliver, what is behind is a layer further.
    assert same.mean() > 0.95


@pytest.mark.parametrize("target", DIFFERENTIABLE)
def test_gradients_at_frozen_samples_are_finite_differences(target):
    # Of frozen samples the image has no derivative but theirs.
    splatter = "multi"
    sampled = rts.sample(BEZIER, CAMERA, SIZE, layers=3, splatter=splatter)
    points = BEZIER.theta["points"].astype(np.float64)

    def loss(points):
        image = rts.render_samples(sampled, BEZIER.replace(theta={"points": points}), CAMERA, splatter=splatter)
        return (image * rts.engine_of(image).constant(WEIGHTS, image)).sum()

    slope = gradient(target, loss, arrays(target, points))
    for seed in range(3):
        (along,) = directions([points], seed)
        ends = [loss(points + step * along) for step in (1e-6, -1e-6)]
        claim_slope(slope, along, (ends[0] - ends[1]) / 2e-6, f"the derivative of the image, in {target},")


# --------------------------------------------------------------------------------------------- conformance


class TestBezier(SurfaceConformance):
    @pytest.fixture
    def part(self):
        return BEZIER
