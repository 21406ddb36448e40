"""Exits: where rays leave culled parts, found beside outlines, so that these move as the middles of chords."""

import numpy as np
import pytest
from helpers import arrays, derivative, gradient, icosphere, mesh_part, to_numpy

import rts
from rts import splatting
from rts.plugin_api.records import Proxy
from rts.sampling.exits import beside_outlines
from rts.splatting.layers import dilated
from rts_backends.fused import splatters as fused
from rts_backends.fused.cells import Cells
from rts_backends.raster.sampler import Raster

pytestmark = pytest.mark.sampling

SIZE = 40
CAMERA = rts.Camera.look_at((0, 0, 4), (0, 0, 0), fov_y=40)
BALL = icosphere(3, 1.1)
SAMPLERS = "raster", "embree", "reference"


def ball(target="torch-cpu", **options):
    """A culled ball whose vertices are differentiated."""
    vertices, faces = BALL
    return mesh_part((arrays(target, vertices), faces), cull="back", **options)


def sampled(parts, splatter=None, **options):
    """The samples of parts for a splatter."""
    return rts.sample(parts, CAMERA, (SIZE, SIZE), splatter=splatter or splatting.Visible(), **options)


def points(part, samples, rows):
    """Where samples are, (M, 3)."""
    return to_numpy(part.surface.evaluate(part.theta, samples)["position"])[rows]


# ------------------------------------------------------------------------------------------------- what is found


@pytest.mark.parametrize("sampler", SAMPLERS)
def test_rays_leave_a_ball_behind_its_front(sampler):
    part = ball()
    found = sampled(part, sampler=sampler, layers=1)
    row, leaves = to_numpy(found.row)[0], to_numpy(found.exit)[0]
    there = leaves >= 0
    covered = row >= 0
    ring = covered & dilated(covered & dilated(~covered))
    np.testing.assert_array_equal(there, ring)
    ends, starts = (points(part, found.samples[0], x[there]) for x in (leaves, row))
    # Both lie on the ball, on one ray, and the camera sees the far one from behind.
    np.testing.assert_allclose(np.linalg.norm(ends, axis=1), 1.1, rtol=0.02)
    eye = np.array([0, 0, 4])
    a, b = starts - eye, ends - eye
    np.testing.assert_allclose(np.cross(a, b), 0, atol=1e-4)
    assert ((b * b).sum(axis=1) >= (a * a).sum(axis=1)).all()
    assert (np.sort(leaves[there]) == np.arange(there.sum()) + row.max() + 1).all()


@pytest.mark.parametrize("eye", [(0, 0, 4), (0.9, 0.5, 0.2)], ids=["outside", "inside"])
def test_one_look_at_all_triangles_finds_what_two_find(eye):
    vertices, faces = BALL
    raster = rts.plugin("rts.samplers", "raster")()
    heap = np.concatenate([0.3 * vertices + shift for shift in ((0, 0, 0), (0.4, 0.3, 0.1), (-0.3, 0.1, 0.5))])
    all_faces = np.concatenate([faces + k * len(vertices) for k in range(3)])
    mesh = Proxy(heap.astype(np.float32), all_faces.astype(np.int32))
    camera = rts.Camera.look_at(eye, (0, 0, 0), fov_y=40, near=0.3).for_size((SIZE, SIZE))
    camera = camera.map(lambda m: np.asarray(m, np.float64))
    given = mesh, camera, (SIZE, SIZE), 2, lambda fragments: beside_outlines(fragments.triangle_ids >= 0)
    found, expected = raster.rasterize_exits(*given), rts.TriangleSampler.rasterize_exits(raster, *given)
    assert (found[2].triangle_ids >= 0).sum() > 50
    for a, b in zip((*found[0], found[1], *found[2]), (*expected[0], expected[1], *expected[2]), strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("layers", [1, 2, 3])
def test_cells_beside_outlines_are_those_of_the_definition(layers):
    rng = np.random.default_rng(layers)
    for shape in ((7, 9), (30, 40), (1, 5), (5, 1), (2, 2), (3, 0)):
        kept = np.stack([rng.random(shape) < share for share in (0.95, 0.03, 0.02)[:layers]])
        kept &= kept[:1]
        ends = ~kept[0] | kept[1:].any(axis=0)
        expected = kept[0] & dilated(kept[0] & dilated(ends))
        np.testing.assert_array_equal(beside_outlines(kept), np.flatnonzero(expected)[None])


@pytest.mark.parametrize(
    "part, splatter",
    [
        (ball().replace(cull="none"), None),
        (ball("numpy"), None),
        (ball(), splatting.Visible(exits=False)),
        (ball(), splatting.Visible(rims=False)),
        (ball(), splatting.Multi()),
    ],
)
def test_exits_are_only_told_where_they_are_read(part, splatter):
    assert sampled(part, splatter).exit is None


@pytest.mark.parametrize("sampler", SAMPLERS)
def test_parts_that_are_not_seen_have_no_exits(sampler):
    away = ball(transform=rts.rigid(arrays("torch-cpu", np.array([0.0, 0, 0, 0, 0, 9.0]))))
    assert (to_numpy(sampled(away, sampler=sampler).exit) == -1).all()


def test_a_capacity_leaves_out_exits_before_layers():
    part = ball()
    whole = sampled(part, layers=1)
    fronts = int((to_numpy(whole.row) >= 0).sum())
    for more in (0, 7):
        found = sampled(part, layers=1, capacity=fronts + more)
        np.testing.assert_array_equal(to_numpy(found.row), to_numpy(whole.row))
        assert (to_numpy(found.exit) >= 0).sum() == more and found.overflow == 0


# -------------------------------------------------------------------------------------------------- derivatives


def image(splatter, target, parts=None, **options):
    """Pose (6,) → image of a ball, or of what `parts` makes of a transform, that has this pose."""
    parts = parts or (lambda transform: ball(target, transform=transform))
    return lambda pose: rts.render(parts(rts.rigid(pose)), CAMERA, (SIZE, SIZE), splatter=splatter, **options)


TURN, MOVE = np.array([0.3, 1.0, 0.0, 0.0, 0.0, 0.0]), np.array([0.0, 0.0, 0.0, 1.0, 0.0, 0.0])


def change(function, target, tangent=TURN):
    """An image, and its derivative along a tangent of the pose."""
    return derivative(target, function, *arrays(target, (np.zeros(6), tangent)))


@pytest.mark.parametrize("sampler", SAMPLERS)
@pytest.mark.parametrize("supersample", [1, 2])
def test_a_ball_that_turns_changes_less_than_by_the_root_rule(sampler, supersample):
    options = {"sampler": sampler, "supersample": supersample, "layers": 1}
    (one, found), (same, by_root) = (
        change(image(fused.Visible(exits=e), "torch-cpu", **options), "torch-cpu") for e in (True, False)
    )
    np.testing.assert_array_equal(one, same)
    moved = change(image(fused.Visible(), "torch-cpu", **options), "torch-cpu", MOVE)[1]
    assert np.linalg.norm(found) < 0.6 * np.linalg.norm(by_root)
    assert abs(found[..., 3].sum()) < 0.01 * np.abs(moved[..., 3]).sum()


def two(transform):
    """A ball that is culled before one that is not, both moving."""
    other = mesh_part(icosphere(2, 0.7, (0.5, 0.2, -1.0)), shader="lambert", transform=transform)
    return [other, ball(shader="lambert", transform=transform)]


@pytest.mark.parametrize("parts, layers", [(None, 1), (None, 2), (two, 2)])
def test_the_compiled_splatter_changes_as_the_specification(parts, layers):
    found, expected = (
        change(image(kind(), "torch-cpu", parts, layers=layers), "torch-cpu")
        for kind in (fused.Visible, splatting.Visible)
    )
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_allclose(one, other, rtol=0, atol=2e-4)
    off = change(image(fused.Visible(exits=False), "torch-cpu", parts, layers=layers), "torch-cpu")
    np.testing.assert_array_equal(off[0], found[0])
    assert np.abs(off[1] - found[1]).max() > 0.1


def test_exits_that_cells_share_add_up_in_one_order(monkeypatch):
    """As on one thread, to the bit; no sampler of the library gives any."""
    rng, shape = np.random.default_rng(0), (90, 60)
    covered = np.indices(shape).sum(axis=0) % 9 < 5
    row = np.where(covered, np.cumsum(covered.ravel()).reshape(shape) - 1, -1).astype(np.int32)[None]
    y, x = np.nonzero(covered)
    positions = np.stack([x + 0.5, y + 0.5, 1 + 0.5 * (np.indices(shape).sum(axis=0)[covered] % 9 % 4 == 0)], axis=1)
    positions = np.concatenate([positions, [[30, 45, 2.0]]])
    exits, g = np.where(covered, len(y), -1).astype(np.int32)[None], rng.normal(size=(*shape, 4))
    settings, part = fused.Visible()._settings(0), np.where(row >= 0, 0, -1)
    found = []
    for threads in (1, 2, 2, 2):
        monkeypatch.setenv("RTS_NUM_THREADS", str(threads))
        cells = Cells(settings, positions, np.ones((len(positions), 4)), row, part=part, exits=exits)
        assert cells.choices.repeated
        found.append(np.zeros_like(positions))
        cells.vjp(g, found[-1], None)
        np.testing.assert_array_equal(found[-1], found[0])
    assert np.abs(found[0][-1, :2]).min() > 0


@pytest.mark.parametrize("method", ["rasterize", "rasterize_cells"])
def test_exits_are_found_by_a_method_that_a_subclass_overrides(method):
    called = []

    def noted(self, *args):
        called.append(args[4])
        return getattr(Raster, method)(self, *args)

    own = type("Own", (Raster,), {method: noted})()
    np.testing.assert_array_equal(sampled(ball(), sampler=own, layers=1).exit, sampled(ball(), layers=1).exit)
    assert called == ["back" if method == "rasterize" else "front"]


def test_pruned_scenes_of_several_parts_keep_their_exits():
    parts = two(arrays("torch-cpu", np.eye(4)))
    found = sampled(parts, fused.Visible(), layers=2)
    whole = sampled(parts, None, layers=2)
    leaves, part = to_numpy(found.exit)[0], to_numpy(found.part)[0]
    assert (part[leaves >= 0] == 1).all() and (leaves >= 0).sum() > 50
    first, count = found.samples[0].ids.shape[0], found.samples[1].ids.shape[0]
    named = leaves[leaves >= 0] - first
    assert named.min() >= 0 and named.max() < count
    # Those that are left are where they were.
    ends = points(parts[1], found.samples[1], named)
    before = to_numpy(whole.exit)[0][leaves >= 0] - whole.samples[0].ids.shape[0]
    np.testing.assert_array_equal(ends, points(parts[1], whole.samples[1], before))


def test_jax_has_the_same_derivatives_eager_and_compiled():
    jax = pytest.importorskip("jax")
    expected = change(image(fused.Visible(), "torch-cpu", layers=1), "torch-cpu")[1]
    function = image(fused.Visible(), "jax", layers=1)
    found = change(function, "jax")[1]
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-3)
    along = np.random.default_rng(0).normal(size=expected.shape)
    zero, weights = arrays("jax", (np.zeros(6), along))
    for capacity in (None, 4000):
        f = image(fused.Visible(), "jax", layers=1, capacity=capacity)
        g = jax.jit(jax.grad(lambda pose, f=f: (f(pose) * weights).sum()))(zero)
        np.testing.assert_allclose((np.asarray(g) * TURN).sum(), (along * expected).sum(), rtol=2e-3)


def test_samples_that_were_found_before_render_as_at_once():
    part, pose = ball(), arrays("torch-cpu", np.zeros(6))
    weights = arrays("torch-cpu", np.random.default_rng(1).normal(size=(SIZE, SIZE, 4)))

    def at_once(pose):
        return (image(fused.Visible(), "torch-cpu")(pose) * weights).sum()

    def later(pose):
        moved = part.replace(transform=rts.rigid(pose))
        found = rts.sample(moved, CAMERA, (SIZE, SIZE), splatter=fused.Visible())
        return (rts.render_samples(found, moved, CAMERA, splatter=fused.Visible()) * weights).sum()

    slopes = [gradient("torch-cpu", f, pose) for f in (at_once, later)]
    np.testing.assert_allclose(slopes[1], slopes[0], rtol=1e-4, atol=1e-4)
