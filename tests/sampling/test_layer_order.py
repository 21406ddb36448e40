"""Surfaces that are not their triangles: layers are put in order after `refine`."""

from dataclasses import replace

import numpy as np
import pytest
from example_surfaces import Crowded, Sheets
from helpers import ALL, FRONT, arrays, refused, rigid, to_numpy
from seen import CAMERA, SIZE, VIEWS, rays_spread

import rts
from rts.contracts.records import Cells
from rts.plugin_api.records import ArraySpec, Samples
from rts.sampling import layer_order, packing

pytestmark = pytest.mark.sampling


PLANES = rts.Camera.look_at((0, 0, 4), (0, 0, 0), near=1, far=9)


def made(row, depth, **options):
    """Samples of two integers and a real in a row of cells, each row of which can be told from the others."""
    row, depth = np.array(row, np.int32), np.array(depth, np.float32)
    count = max(1, int(row.max(initial=-1)) + 1)
    ids = np.arange(2 * count, dtype=np.int32).reshape(-1, 2)
    return Samples(ids, np.arange(count, dtype=np.float32)[:, None] / 8, Cells(row, depth), np.int32(0), **options)


def column(*depths, camera=PLANES):
    """(rows, depths) of one cell once settled, of layers at these depths; None for a row of −1."""
    row = [-1 if z is None else i for i, z in enumerate(depths)]
    given = made(np.reshape(row, (-1, 1, 1)), np.reshape([0 if z is None else z for z in depths], (-1, 1, 1)))
    found = layer_order.settle(given, camera, rays_spread(camera))
    return found.row[:, 0, 0].tolist(), found.depth[:, 0, 0].tolist()


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


def test_layers_before_the_near_and_beyond_the_far_plane_are_dropped():
    assert column(0.99, 4, 9.01, 2) == ([3, 1, -1, -1], [2, 4, 0, 0])
    assert column(-4, 1, 9)[0] == [1, 2, -1]


def test_without_straight_planes_only_what_refine_dropped_is_dropped():
    oblique = PLANES.projection.copy()
    oblique[2, 1] = 0.2
    assert column(0.5, 100.0, 9.5, camera=PLANES.replace(projection=oblique))[0] == [0, 2, 1]


def test_settling_changes_rows_and_depths_only():
    given = made([[[0, 1]], [[2, -1]]], [[[5, 3]], [[2, 0]]], tables={"a": np.arange(3.0)}, by_sample=("a",))
    given = replace(given, overflow=np.int32(4))
    row, depth = given.row.copy(), given.depth.copy()
    found = layer_order.settle(given, PLANES, rays_spread(PLANES))
    np.testing.assert_array_equal(found.row, [[[2, 1]], [[0, -1]]])
    np.testing.assert_array_equal(found.depth, [[[2, 3]], [[5, 0]]])
    assert found.row.dtype == np.int32 and found.depth.dtype == np.float32
    np.testing.assert_array_equal(given.row, row)
    np.testing.assert_array_equal(given.depth, depth)
    for name in ("ids", "params", "overflow", "tables", "by_sample", "gbuffer", "centered"):
        assert getattr(found, name) is getattr(given, name)


# ------------------------------------------------------------------------------------------------ repack


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


# ------------------------------------------------------------------------------- what refine may not give

HEIGHTS = np.array([0.5, 0.0, -0.5], np.float32)


def sheets(refining, heights=HEIGHTS, **options):
    return rts.Part(Sheets(refining), {"heights": heights}, **options)


def layers_of(part, camera=FRONT, **options):
    """The number of samples in each layer."""
    sampled = rts.sample(part, camera, SIZE, **{"layers": 3, **options}, splatter=None)
    return (to_numpy(sampled.row) >= 0).sum(axis=(1, 2)).tolist()


def moved_to(heights):
    """A `refine` that puts the samples of each sheet at another depth; where that is NaN, they are dropped."""
    depths = 5 - np.asarray(heights, np.float32)

    def refining(samples, rays):
        cells, depth = samples.row >= 0, samples.depth.copy()
        depth[cells] = depths[samples.ids[samples.row[cells], 0]]
        return samples.replace(depth=depth, row=np.where(np.isfinite(depth), samples.row, -1))

    return refining


def spoiled(array, at):
    """A copy with a NaN."""
    array = array.copy()
    array[at] = np.nan
    return array


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda s: None, "gave a NoneType; expected Samples"),
        (lambda s: (s.ids, s.params), "gave a tuple; expected Samples"),
        (lambda s: s.replace(row=np.where(s.row >= 0, s.row.max() - s.row, -1)), "another number to a row"),
        (lambda s: s.replace(row=np.where(s.row < 0, 0, s.row)), "another number to a row"),
        (
            lambda s: s.replace(row=s.row[:2]),
            r"gave row of shape \(2, 28, 32\) and dtype int32; expected \(3, 28, 32\)",
        ),
        (lambda s: s.replace(depth=s.depth[0]), r"gave depth of shape \(28, 32\)"),
        (
            lambda s: s.replace(depth=spoiled(s.depth, (0, 12, 14))),
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
        (lambda s: replace(s, ids=s.ids + 10), r"gave ids from 0 to 12, and tables \['places'\] of 10 rows .*are rows"),
    ],
)
def test_what_refine_may_not_give_is_refused_in_its_name(change, words):
    class Tabled(Sheets):
        def table_specs(self, rows, capacity):
            spec = ArraySpec((rows, 1), np.float32, packed=True, by_sample=True)
            return {"places": ArraySpec((10, 2), np.float32, packed=True), "own": spec}

    part = rts.Part(Tabled(lambda samples, rays: change(samples)), {"heights": HEIGHTS})
    with refused(f"refine of .*Tabled.*{words}"):
        rts.sample(part, FRONT, SIZE, layers=3, splatter=None)


def test_what_is_dropped_may_have_any_depth_and_params():
    def refining(samples, rays):
        cells = samples.row >= 0
        second = cells & (samples.ids[samples.row, 0] == 1)
        params = samples.params.copy()
        params[samples.row[second]] = np.nan
        row, depth = np.where(second, -1, samples.row), np.where(second, np.inf, samples.depth)
        return samples.replace(params=params, row=row, depth=depth)

    whole, fewer = (layers_of(sheets(f)) for f in (lambda samples, rays: samples, refining))
    assert whole[0] == whole[1] == whole[2] > 100
    assert fewer == [whole[0], whole[0], 0]


def test_refine_is_asked_once_with_a_row_and_a_ray_for_each_covered_cell():
    calls = []

    def refining(samples, rays):
        calls.append((samples, rays))
        return samples

    rts.sample(sheets(refining), CAMERA, SIZE, layers=3, splatter=None)
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
    expected = rts.sample(sheets(lambda samples, rays: samples, moved), FRONT, SIZE, layers=3, splatter=None)
    found = to_numpy(rts.sample(sheets(moved_to(moved), arrays(target, HEIGHTS)), FRONT, SIZE, layers=3, splatter=None))
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
    several = [rts.sample([part, beside], FRONT, SIZE, layers=k) for k in ("auto", 3)]
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
    whole = rts.sample(sheets(lambda samples, rays: samples), FRONT, SIZE, layers=3, splatter=None)
    total, front = int((whole.row >= 0).sum()), int((whole.row[0] >= 0).sum())
    heights = arrays(target.removesuffix(".jit"), HEIGHTS)
    # Room for all, for two layers and some, rows for one and some, and for less than the table has.
    for room, capacity in ((2 * front + 7, None), (total, front + 5), (2 * front + 7, front + 5), (front, total)):
        part = rts.Part(Crowded(room), {"heights": heights})

        def sampled(heights, part=part, capacity=capacity):
            return rts.sample(
                part.replace(theta={"heights": heights}), FRONT, SIZE, layers=3, capacity=capacity, splatter=None
            )

        if target == "jax.jit":
            import jax

            sampled = jax.jit(sampled)
        found = to_numpy(sampled(heights))
        kept = min(total, room, total if capacity is None else capacity)
        assert found.overflow == total - kept
        assert (found.row >= 0).sum() == kept and (found.row[0] >= 0).sum() == front
        own = found.samples[0]
        places = own.tables["places"][own.ids[:, 0], :2]
        again = whole.samples[0].params[whole.row[found.row >= 0]]
        np.testing.assert_allclose(places[found.row[found.row >= 0]], again, atol=1e-6)
