"""Surfaces that are not their triangles: layers settle after `refine`, and rays are traced in steps."""

from dataclasses import replace

import numpy as np
import pytest
from helpers import ALL, DIFFERENTIABLE, FRONT, arrays, finite_difference, gradient, rigid, to_numpy
from throwaway import Bezier, Crowded, Sheets, Torus, distance

import rts
from rts import Samples, splatting
from rts.sampling import packing, settling
from rts.sampling.packing import lift
from rts.testing import SurfaceConformance
from rts.testing.derivatives import claim_slope, directions

pytestmark = pytest.mark.sampling

SIZE = (24, 28)
CAMERA = rts.Camera.look_at((0.9, 1.6, 3.2), (0, 0, 0), aspect=28 / 24)
VIEWS = {
    "perspective": CAMERA,
    "orthographic": rts.Camera.orthographic((1.1, 1.3, 3.1), (0, 0.1, 0), height=3.1, aspect=28 / 24, near=0.5, far=9),
    "cut by near and far plane": rts.Camera.look_at((0.9, 1.6, 3.2), (0, 0, 0), aspect=28 / 24, near=3.3, far=4.2),
}
PLANES = rts.Camera.look_at((0, 0, 4), (0, 0, 0), near=1, far=9)
BEZIER, TORUS = Bezier.example(), Torus.example()


def rays_spread(camera, size=SIZE):
    return np.asarray(camera.rays(size).spread, np.float64)


def made(row, depth, **options):
    """Samples of two integers and a real in a row of cells, each row of which can be told from the others."""
    row, depth = np.array(row, np.int32), np.array(depth, np.float32)
    count = max(1, int(row.max(initial=-1)) + 1)
    ids = np.arange(2 * count, dtype=np.int32).reshape(-1, 2)
    return Samples(ids, np.arange(count, dtype=np.float32)[:, None] / 8, row, depth, np.int32(0), **options)


def column(*depths, camera=PLANES):
    """(rows, depths) of one cell once settled, of layers at these depths; None for a row of −1."""
    row = [-1 if z is None else i for i, z in enumerate(depths)]
    given = made(np.reshape(row, (-1, 1, 1)), np.reshape([0 if z is None else z for z in depths], (-1, 1, 1)))
    found = settling.settle(given, camera, rays_spread(camera))
    return found.row[:, 0, 0].tolist(), found.depth[:, 0, 0].tolist()


def settled_by_hand(samples, camera, spread):
    """What `settle` does, a cell at a time."""
    row, depth = np.full_like(samples.row, -1), np.zeros_like(samples.depth)
    near, far = (float(x) for x in camera.depth_range())
    for y, x in np.ndindex(row.shape[1:]):
        layers = zip(samples.depth[:, y, x].tolist(), samples.row[:, y, x].tolist(), strict=True)
        kept = []
        for z, i in sorted([(z, i) for z, i in layers if i >= 0 and near <= z <= far], key=lambda layer: layer[0]):
            if not kept or z - kept[-1][0] > 0.01 * (spread[0] + spread[1] * z) + 1e-6 * z:
                kept.append((z, i))
        for k, layer in enumerate(kept):
            depth[k, y, x], row[k, y, x] = layer
    return row, depth


def repacked_by_hand(samples, kept, capacity):
    """Which of the old rows the new ones are, where they are, and how many are lost."""
    cells = np.argwhere(kept)
    fitting = cells if capacity is None else cells[:capacity]
    row, old = np.full_like(samples.row, -1), []
    for number, cell in enumerate(map(tuple, fitting)):
        row[cell] = number
        old.append(samples.row[cell])
    return row, old, len(cells) - len(fitting)


# ------------------------------------------------------------------------------------------------ settle


def test_layers_out_of_order_are_sorted():
    assert column(5, 3, 7, 2) == ([3, 1, 0, 2], [2, 3, 5, 7])


def test_rows_of_minus_one_leave_no_gap():
    assert column(None, 5, None, 3) == ([3, 1, -1, -1], [3, 5, 0, 0])
    assert column(None, None) == ([-1, -1], [0, 0])


@pytest.mark.parametrize("view", ["perspective", "orthographic"])
def test_two_layers_at_one_root_become_one_and_the_width_of_a_pixel_decides(view):
    camera = VIEWS[view]
    spread = rays_spread(camera)
    for z in (2.0, 6.0):
        apart = 0.01 * (spread[0] + spread[1] * z) + 1e-6 * z
        assert column(z, z, camera=camera)[0] == [0, -1]
        assert column(z, z + 0.8 * apart, camera=camera)[0] == [0, -1]
        assert column(z + 0.8 * apart, z, camera=camera)[0] == [1, -1]
        assert column(z, z + 1.2 * apart, camera=camera)[0] == [0, 1]


def test_how_far_layers_are_apart_counts_from_the_one_that_stays():
    spread = rays_spread(PLANES)
    apart = 0.01 * (spread[0] + spread[1] * 3)
    assert column(3, 3 + 0.6 * apart, 3 + 1.3 * apart, 3 + 1.9 * apart)[0] == [0, 2, -1, -1]


def test_layers_before_the_near_and_beyond_the_far_plane_are_dropped():
    assert column(0.99, 4, 9.01, 2) == ([3, 1, -1, -1], [2, 4, 0, 0])
    assert column(-4, 1, 9)[0] == [1, 2, -1]


def test_without_straight_planes_only_what_refine_dropped_is_dropped():
    oblique = PLANES.projection.copy()
    oblique[2, 1] = 0.2
    assert column(0.5, 100.0, 9.5, camera=PLANES._replace(projection=oblique))[0] == [0, 2, 1]


def test_settling_changes_rows_and_depths_only():
    given = made([[[0, 1]], [[2, -1]]], [[[5, 3]], [[2, 0]]], tables={"a": np.arange(3.0)}, by_sample=("a",))
    given = replace(given, overflow=np.int32(4))
    row, depth = given.row.copy(), given.depth.copy()
    found = settling.settle(given, PLANES, rays_spread(PLANES))
    np.testing.assert_array_equal(found.row, [[[2, 1]], [[0, -1]]])
    np.testing.assert_array_equal(found.depth, [[[2, 3]], [[5, 0]]])
    assert found.row.dtype == np.int32 and found.depth.dtype == np.float32
    np.testing.assert_array_equal(given.row, row)
    np.testing.assert_array_equal(given.depth, depth)
    for name in ("ids", "params", "overflow", "tables", "by_sample", "gbuffer", "centered"):
        assert getattr(found, name) is getattr(given, name)


@pytest.mark.parametrize("shape", [(1, 3, 4), (2, 5, 7), (3, 6, 5), (5, 9, 8), (4, 60, 70)])
@pytest.mark.parametrize("view", ["perspective", "orthographic"])
def test_settling_is_what_one_does_by_hand(view, shape):
    camera = VIEWS[view]
    spread, (near, far) = rays_spread(camera), camera.depth_range()
    rng = np.random.default_rng(sum(shape))
    for _ in range(4):
        # Few depths, around which layers are nearer than, and farther than what counts as one root.
        z = rng.choice([0.5 * near, 2.0, 2.5, 4.0, 8.0, 2 * far], shape, p=[0.05, 0.3, 0.3, 0.2, 0.1, 0.05])
        width = 0.01 * (spread[0] + spread[1] * z) + 1e-6 * z
        depth = z + width * rng.choice([0.0, 0.4, -0.4, 1.5, -1.5], shape)
        row = np.where(rng.random(shape) < 0.8, rng.permutation(depth.size).reshape(shape), -1)
        given = made(row, depth)
        found = settling.settle(given, camera, spread)
        row, depth = settled_by_hand(given, camera, spread)
        np.testing.assert_array_equal(found.depth, depth)
        np.testing.assert_array_equal(found.row, row)


# ------------------------------------------------------------------------------------------------ repack


def test_rows_are_numbered_layer_by_layer_in_the_order_of_cells():
    given = made([[[4, -1, 2]], [[0, 3, 1]]], np.ones((2, 1, 3)))
    found = packing.repack(given, given.row >= 0, None)
    np.testing.assert_array_equal(found.row, [[[0, -1, 1]], [[2, 3, 4]]])
    np.testing.assert_array_equal(found.ids, given.ids[[4, 2, 0, 3, 1]])
    np.testing.assert_array_equal(found.params, given.params[[4, 2, 0, 3, 1]])
    assert found.overflow == 0


def test_the_deepest_layers_have_no_room_first_and_are_counted():
    given = made(np.arange(9).reshape(3, 1, 3), np.ones((3, 1, 3)))
    found = packing.repack(replace(given, overflow=np.int32(5)), given.row >= 0, 4)
    np.testing.assert_array_equal(found.row, [[[0, 1, 2]], [[3, -1, -1]], [[-1, -1, -1]]])
    np.testing.assert_array_equal(found.depth, np.where(found.row >= 0, 1, 0))
    assert found.overflow == 5 + 5 and found.overflow.dtype == np.int32 and found.overflow.shape == ()
    assert len(found.ids) == len(found.params) == 4


def test_tables_by_sample_go_with_their_samples_and_others_stay():
    tables = {"own": np.arange(6.0).reshape(3, 2), "all": np.arange(7)}
    given = made([[[2, 0]], [[1, -1]]], np.ones((2, 1, 2)), tables=tables, by_sample=("own",))
    kept = np.array([[[True, False]], [[True, False]]])
    found = packing.repack(given, kept, None)
    np.testing.assert_array_equal(found.tables["own"], tables["own"][[2, 1]])
    assert found.tables["all"] is tables["all"]
    found = packing.repack(given, kept, 4)
    np.testing.assert_array_equal(found.tables["own"], [*tables["own"][[2, 1]], (0, 0), (0, 0)])


def test_there_is_a_row_of_zeros_where_nothing_is_kept():
    given = made([[[0]], [[1]]], np.ones((2, 1, 1)))
    found = packing.repack(given, np.zeros((2, 1, 1), bool), None)
    assert (found.row == -1).all() and not found.depth.any()
    np.testing.assert_array_equal(found.ids, np.zeros((1, 2)))


def test_packing_is_what_one_does_by_hand():
    rng = np.random.default_rng(0)
    for _ in range(100):
        shape = tuple(rng.integers(1, 6, 3))
        row = np.where(rng.random(shape) < 0.7, rng.permutation(np.prod(shape)).reshape(shape), -1)
        given = made(row, np.where(row >= 0, rng.random(shape) + 1, 0))
        given = replace(given, tables={"t": rng.random((len(given.ids), 2))}, by_sample=("t",), overflow=np.int32(3))
        kept = (row >= 0) & (rng.random(shape) < 0.8)
        for capacity in (None, 1, 5, 200):
            found = packing.repack(given, kept, capacity)
            rows, old, lost = repacked_by_hand(given, kept, capacity)
            np.testing.assert_array_equal(found.row, rows)
            np.testing.assert_array_equal(found.depth, np.where(rows >= 0, given.depth, 0))
            assert found.overflow == 3 + lost and len(found.ids) == (max(1, len(old)) if capacity is None else capacity)
            for new, before in (
                (found.ids, given.ids),
                (found.params, given.params),
                (found.tables["t"], given.tables["t"]),
            ):
                np.testing.assert_array_equal(new[: len(old)], before[old])
                assert not new[len(old) :].any()


# ------------------------------------------------------------------------------- what refine may not give

HEIGHTS = np.array([0.5, 0.0, -0.5], np.float32)


def sheets(refining, heights=HEIGHTS, **options):
    return rts.Part(Sheets(refining), {"heights": heights}, **options)


def layers_of(part, camera=FRONT, **options):
    """How many samples there are in each layer."""
    sampled = rts.sample(part, camera, SIZE, **{"layers": 3, **options})
    return (to_numpy(sampled.row) >= 0).sum(axis=(1, 2)).tolist()


def moved_to(heights):
    """A `refine` that puts the samples of each sheet at another depth; where that is NaN, they are dropped."""
    depths = 5 - np.asarray(heights, np.float32)

    def refining(samples, rays):
        cells, depth = samples.row >= 0, samples.depth.copy()
        depth[cells] = depths[samples.ids[samples.row[cells], 0]]
        return replace(samples, depth=depth, row=np.where(np.isfinite(depth), samples.row, -1))

    return refining


def spoiled(array, at):
    """A copy with a NaN."""
    array = array.copy()
    array[at] = np.nan
    return array


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda s: None, "gave a NoneType; expected rts.Samples"),
        (lambda s: (s.ids, s.params), "gave a tuple; expected rts.Samples"),
        (lambda s: replace(s, row=np.where(s.row >= 0, s.row.max() - s.row, -1)), "another number to a row"),
        (lambda s: replace(s, row=np.where(s.row < 0, 0, s.row)), "another number to a row"),
        (
            lambda s: replace(s, row=s.row[:2]),
            r"gave row of shape \(2, 28, 32\) and dtype int32; expected \(3, 28, 32\)",
        ),
        (lambda s: replace(s, depth=s.depth[0]), r"gave depth of shape \(28, 32\)"),
        (
            lambda s: replace(s, depth=spoiled(s.depth, (0, 12, 14))),
            "gave 1 depths that are not finite; set their rows to −1",
        ),
        (
            lambda s: replace(s, params=spoiled(s.params, s.row[0, 12, 14])),
            "gave 1 samples whose params are not finite",
        ),
        (lambda s: replace(s, params=s.params[:-1]), "gave params of shape"),
        (lambda s: replace(s, params=s.params[:, :1]), "gave params of shape"),
        (lambda s: replace(s, ids=np.tile(s.ids, (1, 2))), "gave ids of shape"),
        (lambda s: replace(s, ids=None), "gave ids of shape .* dtype object"),
        (lambda s: replace(s, ids=s.ids + 0.6), "gave ids of .* dtype float64; expected .* of int32"),
        (lambda s: replace(s, params=[[1.0], [1.0, 2.0]]), "gave params that is no array"),
        (lambda s: replace(s, overflow=np.zeros(1, np.int32)), r"gave overflow of shape \(1,\)"),
        (lambda s: replace(s, overflow=-3), "gave an overflow of -3"),
        (lambda s: replace(s, tables={**s.tables, "more": np.zeros(1)}), "gave the tables .*'more'.*declares"),
        (lambda s: replace(s, tables={}), r"gave the tables \[\]; table_specs declares \['own', 'places'\]"),
        (lambda s: replace(s, tables={**s.tables, "places": np.zeros((11, 2))}), r"shape \(11, 2\).* allots \(10, 2\)"),
        (lambda s: replace(s, tables={**s.tables, "places": np.zeros((9, 3))}), r"shape \(9, 3\), where .* overflow"),
        (lambda s: replace(s, tables={**s.tables, "own": np.zeros((9, 1))}), "table 'own' of 9 rows; expected [0-9]+,"),
    ],
)
def test_what_refine_may_not_give_is_refused_in_its_name(change, words):
    class Tabled(Sheets):
        def table_specs(self, rows, capacity):
            spec = rts.ArraySpec((rows, 1), np.float32, packed=True, by_sample=True)
            return {"places": rts.ArraySpec((10, 2), np.float32, packed=True), "own": spec}

    part = rts.Part(Tabled(lambda samples, rays: change(samples)), {"heights": HEIGHTS})
    with pytest.raises(rts.InputError, match=f"refine of .*Tabled.*{words}") as caught:
        rts.sample(part, FRONT, SIZE, layers=3)
    assert "\n" not in str(caught.value)


def test_what_is_dropped_may_have_any_depth_and_params():
    def refining(samples, rays):
        cells = samples.row >= 0
        second = cells & (samples.ids[samples.row, 0] == 1)
        params = samples.params.copy()
        params[samples.row[second]] = np.nan
        row, depth = np.where(second, -1, samples.row), np.where(second, np.inf, samples.depth)
        return replace(samples, params=params, row=row, depth=depth)

    whole, fewer = (layers_of(sheets(f)) for f in (lambda samples, rays: samples, refining))
    assert whole[0] == whole[1] == whole[2] > 100
    assert fewer == [whole[0], whole[0], 0]


def test_refine_is_asked_once_with_a_row_and_a_ray_for_each_covered_cell():
    calls = []

    def refining(samples, rays):
        calls.append((samples, rays))
        return samples

    rts.sample(sheets(refining), CAMERA, SIZE, layers=3)
    ((samples, rays),) = calls
    count = (samples.row >= 0).sum()
    assert rays.origins.shape == rays.directions.shape == (count, 3) and rays.spread.shape == (2,)
    assert len(samples.ids) == len(samples.params) == count
    np.testing.assert_array_equal(np.sort(samples.row[samples.row >= 0]), np.arange(count))
    cells = samples.row >= 0
    at = np.empty(count)
    at[samples.row[cells]] = samples.depth[cells]
    point = rays.origins + at[:, None] * rays.directions
    np.testing.assert_allclose(point[:, :2], samples.params, atol=1e-5)
    np.testing.assert_allclose(point[:, 2], HEIGHTS[samples.ids[:, 0]], atol=1e-5)


@pytest.mark.parametrize("target", ALL)
def test_sheets_that_change_places_are_seen_in_their_new_order(target):
    moved = np.array([-0.75, 0.25, 0.6], np.float32)
    expected = rts.sample(sheets(lambda samples, rays: samples, moved), FRONT, SIZE, layers=3)
    found = to_numpy(rts.sample(sheets(moved_to(moved), arrays(target, HEIGHTS)), FRONT, SIZE, layers=3))
    np.testing.assert_array_equal(found.row, expected.row)
    np.testing.assert_allclose(found.depth, expected.depth, rtol=1e-6)
    count = (expected.row >= 0).sum()
    sheet = found.samples[0].ids[:count, 0]
    np.testing.assert_array_equal(sheet, expected.samples[0].ids[:count, 0])
    assert sheet[found.row[0, 14, 16]] == 2 and sheet[found.row[2, 14, 16]] == 0


@pytest.mark.parametrize("by", [1e3, 1e4])
def test_layers_of_a_model_in_small_units_are_not_merged(by):
    class Large(Sheets):  # The same squares in units of which `by` make one of the world's.
        def proxy(self, inputs, camera, size):
            proxy = super().proxy(inputs, camera, size)
            return proxy._replace(vertices=proxy.vertices * np.float32(by))

    part = rts.Part(Large(), {"heights": HEIGHTS})
    found = layers_of(part.replace(transform=np.diag([1 / by, 1 / by, 1 / by, 1])))
    assert found == layers_of(sheets(lambda samples, rays: samples))


@pytest.mark.parametrize("heights", [(np.nan, np.nan, -0.5), (0.4, 0.4, -0.5)])
def test_as_many_layers_as_count_are_taken_where_refine_leaves_fewer(heights):
    part = sheets(moved_to(heights))
    found, expected = (layers_of(part, layers=k) for k in ("auto", 3))
    assert [n for n in found if n] == [n for n in expected if n]
    # And where it is one part of several.
    beside = part.replace(transform=rigid(translation=(100, 0, 0)))
    several = [rts.sample([part, beside], FRONT, SIZE, layers=k, splatter="visible") for k in ("auto", 3)]
    assert (several[0].row >= 0).sum() == (several[1].row >= 0).sum() > 0


def test_rows_that_refine_renumbers_in_place_are_refused():
    def refining(samples, rays):
        samples.row[samples.row >= 0] += 1
        return samples

    with pytest.raises(rts.InputError, match="another number to a row"):
        layers_of(sheets(refining))


# ------------------------------------------------------------------------------------------------ overflow


@pytest.mark.parametrize("target", [*ALL, "jax.jit"])
def test_samples_that_find_no_room_in_a_table_or_a_row_are_counted(target):
    whole = rts.sample(sheets(lambda samples, rays: samples), FRONT, SIZE, layers=3)
    total, front = int((whole.row >= 0).sum()), int((whole.row[0] >= 0).sum())
    heights = arrays(target.removesuffix(".jit"), HEIGHTS)
    # Room for all, for two layers and some, rows for one and some, and for less than the table has.
    for room, capacity in ((2 * front + 7, None), (total, front + 5), (2 * front + 7, front + 5), (front, total)):
        part = rts.Part(Crowded(room), {"heights": heights})

        def sampled(heights, part=part, capacity=capacity):
            return rts.sample(part.replace(theta={"heights": heights}), FRONT, SIZE, layers=3, capacity=capacity)

        if target == "jax.jit":
            import jax

            sampled = jax.jit(sampled)
        found = to_numpy(sampled(heights))
        kept = min(total, room, total if capacity is None else capacity)
        assert found.overflow == total - kept
        assert (found.row >= 0).sum() == kept and (found.row[0] >= 0).sum() == front
        own = found.samples[0]
        places = own.tables["places"][own.ids[:, 1]]
        again = whole.samples[0].params[whole.row[found.row >= 0]]
        np.testing.assert_allclose(places[found.row[found.row >= 0]], again, atol=1e-6)


# -------------------------------------------------------------------------------------------------- Bézier


def stages(part, camera, layers, size=SIZE):
    """Samples on the triangles, refined, and settled."""
    sampler, inputs = rts.plugin("samplers", "raster")(), part.theta["points"]
    proxy = part.surface.proxy(inputs, camera, size)
    lifted = lift(sampler.rasterize(sampler.prepare(proxy), camera, size, layers, "none"), proxy)
    moved, rays = settling.refined(part.surface, inputs, lifted, camera, size, {})
    return lifted, moved, settling.settle(moved, camera, rays.spread)


def test_a_flat_patch_is_met_where_its_plane_is():
    x, y = np.meshgrid(np.linspace(-1, 1, 4), np.linspace(-1, 1, 4), indexing="ij")
    points = np.stack([x, y, 0.25 * x - 0.5 * y], axis=-1).reshape(-1, 3).astype(np.float32)
    part = rts.Part(Bezier([np.arange(16)], 2), {"points": points}, "normals")
    samples = rts.sample(part, FRONT, SIZE, layers=1).samples[0]
    rays = FRONT.with_apron(SIZE, 2).rays((SIZE[0] + 4, SIZE[1] + 4))
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
    samples = rts.sample(BEZIER, camera, SIZE, layers=layers).samples[0]
    covered, wide = samples.row >= 0, camera.with_apron(SIZE, 2)
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
        rts.sample(BEZIER.replace(surface=Bezier(BEZIER.surface.indices, n)), CAMERA, SIZE, layers=4) for n in (3, 24)
    )
    both = (coarse.row >= 0) & (fine.row >= 0)
    assert both.sum() > 0.95 * (fine.row >= 0).sum()
    same = np.isclose(coarse.depth, fine.depth, rtol=1e-5)[both]
    # Where one tessellation lacks a sliver, what is behind is a layer further.
    assert same.mean() > 0.95


def unpruned(splatter):
    return type("Whole", (type(splatter),), {"prunes": False})()


@pytest.mark.parametrize("layers", [2, 3, 4])
def test_the_image_is_the_same_without_what_is_not_needed(layers):
    for splatter in (rts.plugin("splatters", "visible")(), splatting.Visible()):
        whole = unpruned(splatter)
        images = [rts.render(BEZIER, CAMERA, SIZE, layers=layers, splatter=s) for s in (splatter, whole)]
        np.testing.assert_allclose(*images, rtol=0, atol=1e-6)
        sampled = [rts.sample(BEZIER, CAMERA, SIZE, layers=layers, splatter=s) for s in (splatter, whole)]
        counts = [int((s.row >= 0).sum()) for s in sampled]
        assert 200 < counts[0] < counts[1]


def test_with_another_part_and_prepared_the_image_is_the_same_without_what_is_not_needed():
    parts = [BEZIER, rts.Part(Crowded(2000), {"heights": np.array([-0.3, 0.3, -0.7], np.float32)}, shader="depth")]
    splatter = splatting.Visible()
    images = [rts.render(parts, CAMERA, SIZE, layers=4, splatter=s) for s in (splatter, unpruned(splatter))]
    prepared = rts.prepare(parts, "raster")
    images.append(rts.render(prepared, CAMERA, SIZE, layers=4, splatter=splatter))
    for image in images[1:]:
        np.testing.assert_allclose(image, images[0], rtol=0, atol=1e-6)


@pytest.mark.parametrize("target", ALL)
def test_which_samples_are_needed_is_asked_with_their_final_depths(target):
    asked = []

    class Spy(splatting.Visible):
        def needed(self, covered, depth):
            asked.append((covered.copy(), depth.copy()))
            return super().needed(covered, depth)

    part = BEZIER.replace(theta=arrays(target, BEZIER.theta))
    whole = to_numpy(rts.sample(part, CAMERA, SIZE, layers=4))
    found = to_numpy(rts.sample(part, CAMERA, SIZE, layers=4, splatter=Spy()))
    ((covered, depth),) = asked
    np.testing.assert_array_equal(covered, whole.row >= 0)
    np.testing.assert_array_equal(depth, whole.depth)
    kept = splatting.Visible().needed(covered, depth)
    np.testing.assert_array_equal(found.row >= 0, kept)
    own, all_of_them = found.samples[0], whole.samples[0]
    np.testing.assert_array_equal(own.ids[found.row[kept]], all_of_them.ids[whole.row[kept]])
    np.testing.assert_array_equal(own.params[found.row[kept]], all_of_them.params[whole.row[kept]])


WEIGHTS = np.random.default_rng(0).normal(size=(*SIZE, 4)).astype(np.float32)


def loss_of(part, name, camera=CAMERA, **options):
    """Of an entry of θ, as an array of any engine."""

    def loss(value):
        image = rts.render(part.replace(theta={name: value}), camera, SIZE, **options)
        return (image * rts.engine_of(image).constant(WEIGHTS, image)).sum()

    return loss


@pytest.fixture(scope="module")
def slopes_by_torch():
    """Values and gradients of the Bézier scene and of another one, in control points."""
    pytest.importorskip("torch")
    values = [BEZIER.theta["points"], 0.9 * BEZIER.theta["points"]]
    loss = loss_of(BEZIER, "points", layers=3)
    given = [arrays("torch-cpu", v) for v in values]
    return values, [float(loss(x)) for x in given], [gradient("torch-cpu", loss, x) for x in given]


def close(found, expected):
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-4 * np.abs(expected).max())


@pytest.mark.parametrize("target", DIFFERENTIABLE)
def test_gradients_at_frozen_samples_are_finite_differences(target):
    sampled = rts.sample(BEZIER, CAMERA, SIZE, layers=3, splatter="visible")
    points = BEZIER.theta["points"].astype(np.float64)

    def loss(points):
        image = rts.render_samples(sampled, BEZIER.replace(theta={"points": points}), CAMERA)
        return (image * rts.engine_of(image).constant(WEIGHTS, image)).sum()

    slope = gradient(target, loss, arrays(target, points))
    for seed in range(3):
        (along,) = directions([points], seed)
        ends = [loss(points + step * along) for step in (1e-6, -1e-6)]
        claim_slope(slope, along, (ends[0] - ends[1]) / 2e-6, f"the derivative of the image, in {target},")


@pytest.mark.parametrize("target", DIFFERENTIABLE)
def test_images_of_patches_agree(target):
    expected = rts.render(BEZIER, CAMERA, SIZE, layers=3)
    found = rts.render(BEZIER.replace(theta=arrays(target, BEZIER.theta)), CAMERA, SIZE, layers=3)
    np.testing.assert_allclose(to_numpy(found), expected, rtol=0, atol=1e-5)


def test_gradients_of_patches_agree_in_torch_and_jax(slopes_by_torch):
    jax = pytest.importorskip("jax")
    values, _, expected = slopes_by_torch
    close(jax.grad(loss_of(BEZIER, "points", layers=3))(jax.numpy.asarray(values[0])), expected[0])


def test_compiled_and_batched_by_jax_images_and_gradients_of_patches_are_the_same(slopes_by_torch):
    jax = pytest.importorskip("jax")
    values, losses, expected = slopes_by_torch
    slope = jax.value_and_grad(loss_of(BEZIER, "points", layers=3))
    found = jax.jit(slope)(jax.numpy.asarray(values[0]))
    np.testing.assert_allclose(found[0], losses[0], rtol=1e-4)
    close(found[1], expected[0])
    found = jax.jit(jax.vmap(slope))(jax.numpy.stack(values))
    np.testing.assert_allclose(found[0], losses, rtol=1e-4)
    for one, other in zip(found[1], expected, strict=True):
        close(one, other)


def test_batched_by_torch_images_and_gradients_of_patches_are_the_same(slopes_by_torch):
    torch = pytest.importorskip("torch")
    values, losses, expected = slopes_by_torch
    slope = torch.func.vmap(torch.func.grad_and_value(loss_of(BEZIER, "points", layers=3)))
    found = slope(torch.tensor(np.stack(values)))
    np.testing.assert_allclose(found[1], losses, rtol=1e-4)
    for one, other in zip(found[0], expected, strict=True):
        close(one, other)


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
    """Whether all roots differ by a hundredth of a unit or more, complex ones as well."""
    gaps = np.abs(roots[:, None] - roots[None]) + np.eye(4)
    return gaps.min() * length > 1e-2 and np.abs(roots).min() * length > 1e-2


def closed_form(roots, layers=4):
    """(K, R) distances of at least 0, nearest first; infinite where there is none."""
    found = np.full((layers, len(roots)), np.inf)
    for i, r in enumerate(roots):
        real = np.sort(r.real[(np.abs(r.imag) < 1e-6) & (r.real >= 0)])[:layers]
        found[: len(real), i] = real
    return found


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
    samples = Samples(np.zeros((count, 0), np.int32), params[k, i], None, None, None)
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
    samples = rts.sample(TORUS, camera, SIZE, layers=4).samples[0]
    covered = samples.row >= 0
    assert covered[0].sum() > 50 and not (covered[1:] & ~covered[:-1]).any()
    assert view != "from the side" or covered[3].sum() > 20
    assert (np.diff(samples.depth, axis=0) > 0)[covered[1:]].all()
    k, y, x = np.nonzero(covered)
    position = TORUS.surface.evaluate(TORUS.theta, samples)["position"][samples.row[covered]]
    seen = camera.with_apron(SIZE, 2).project(position.astype(np.float64), samples.row.shape[1:])
    np.testing.assert_allclose(seen[:, :2], np.stack([x, y], axis=-1) + 0.5, rtol=0, atol=0.02)
    np.testing.assert_allclose(seen[:, 2], samples.depth[covered], rtol=1e-5)


@pytest.mark.parametrize("target", DIFFERENTIABLE)
def test_gradients_in_radii_are_finite_differences(target):
    samples = rts.sample(TORUS, CAMERA, SIZE).samples[0]
    weights = np.random.default_rng(1).normal(size=(len(samples.ids), 3)) / len(samples.ids) ** 0.5

    def product(radii, weights=weights, samples=samples):
        return (TORUS.surface.evaluate({"radii": radii}, samples)["position"] * weights).sum()

    moved = arrays(target, weights), replace(samples, params=arrays(target, samples.params))
    found = gradient(target, lambda radii: product(radii, *moved), arrays(target, RADII))
    np.testing.assert_allclose(found, finite_difference(product, RADII), rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("target", ALL)
def test_the_gradient_of_its_distance_is_the_normal_of_the_torus(target):
    samples = rts.sample(TORUS, CAMERA, SIZE).samples[0]
    gbuffer = TORUS.surface.evaluate(TORUS.theta, samples)
    points, radii = arrays(target, (gbuffer["position"], RADII))
    found = rts.gradient(lambda p: distance(radii, p), points)
    np.testing.assert_allclose(to_numpy(found), gbuffer["normal"], atol=1e-5)


def test_a_loop_in_a_program_of_jax_is_one_loop():
    jax = pytest.importorskip("jax")
    render = loss_of(TORUS, "radii", layers=2)
    for f in (render, jax.grad(render), lambda radii: jax.vmap(render)(jax.numpy.stack([radii, radii]))):
        program = str(jax.make_jaxpr(f)(arrays("jax", RADII)))
        assert program.count("while[") == 1


def test_images_of_the_torus_agree_compiled_and_batched():
    radii = np.stack([RADII, (0.8, 0.3)]).astype(np.float32)

    def image(radii):
        return rts.render(TORUS.replace(theta={"radii": radii}), CAMERA, SIZE, layers=3)

    expected = [image(r) for r in radii]
    assert np.abs(expected[0] - expected[1]).max() > 0.1
    torch, jax = pytest.importorskip("torch"), pytest.importorskip("jax")
    np.testing.assert_allclose(torch.func.vmap(image)(torch.tensor(radii)), expected, rtol=0, atol=1e-4)
    np.testing.assert_allclose(jax.jit(jax.vmap(image))(jax.numpy.asarray(radii)), expected, rtol=0, atol=1e-4)


# --------------------------------------------------------------------------------------------- conformance


class TestBezier(SurfaceConformance):
    @pytest.fixture
    def part(self):
        return BEZIER


class TestTorus(SurfaceConformance):
    @pytest.fixture
    def part(self):
        return TORUS

    @pytest.fixture
    def sampler(self):
        return "rays"
