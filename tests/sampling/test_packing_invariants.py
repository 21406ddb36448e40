"""Packing: which cells get which rows, and that every cell keeps its own sample."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from strategies import PROPERTIES, grids, masks, rows_of, steps, table, told_apart

from rts.compiling import threads
from rts.plugin_api.records import Fragments, Proxy
from rts.sampling.packing import pack_fragments, repack

pytestmark = pytest.mark.sampling

LAYOUTS = np.ascontiguousarray, np.asfortranarray
CAPACITIES = st.none() | st.integers(1, 40)


@st.composite
def hits(draw):
    """Fragments, the triangles that they are on, some of the covered cells, and a capacity."""
    shape, triangles = draw(grids()), draw(st.integers(1, 5))
    found = draw(table(np.int32, shape, st.integers(-1, triangles - 1)))
    first = draw(steps(shape, 0, 1))
    barycentrics = np.stack([first, (1 - first) * draw(steps(shape, 0, 1))], axis=-1)
    # Sometimes in other layouts, and with something in cells that are empty.
    given = (draw(st.sampled_from(LAYOUTS))(x) for x in (found, barycentrics, draw(steps(shape, -2, 9))))
    numbers = st.integers(-9, 9)
    ids = draw(st.none() | st.integers(0, 3).flatmap(lambda n: table(np.int32, (triangles, n), numbers)))
    params = draw(st.none() | st.integers(0, 3).flatmap(lambda n: steps((triangles, 3, n), -2, 2)))
    faces = draw(table(np.int32, (triangles, 3), st.integers(0, 7)))
    kept = draw(st.none() | masks(shape).map(lambda mask: mask & (found >= 0)))
    return Fragments(*given), Proxy(np.zeros((8, 3), np.float32), faces, ids, params), draw(CAPACITIES), kept


@st.composite
def packed(draw):
    """Samples whose rows are in any order, with a table a sample and one of all; some of the cells, and a capacity."""
    shape = draw(grids())
    row, total = draw(rows_of(draw(masks(shape))))
    own, common = np.arange(3.0 * total).reshape(total, 3), np.arange(5)
    samples = told_apart(row, total, draw(steps(shape, 1, 9)), tables={"own": own, "common": common})
    samples = replace(samples, by_sample=("own",), overflow=np.int32(draw(st.integers(0, 3))))
    return samples, draw(masks(shape)) & (row >= 0), draw(CAPACITIES)


def cells_kept(fragments, kept):
    return fragments.triangle_ids >= 0 if kept is None else kept


def in_reading_order(kept, rows):
    """`row` of so many rows given to the kept cells layer by layer, and in each line by line."""
    number = np.cumsum(kept).reshape(kept.shape) - 1
    return np.where(kept & (number < rows), number, -1)


def assert_same(found, expected):
    """That all arrays of two `Samples` are equal."""
    for name in ("ids", "params", "row", "depth", "overflow"):
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name), err_msg=name)
        assert getattr(found, name).dtype == getattr(expected, name).dtype
    assert found.tables.keys() == expected.tables.keys()
    for name, values in found.tables.items():
        np.testing.assert_array_equal(values, expected.tables[name], err_msg=name)


# ---------------------------------------------------------------------------------------------------- pack_fragments


@PROPERTIES
@given(hits())
def test_kept_cells_have_their_rows_in_reading_order_as_far_as_there_is_room(given):
    fragments, proxy, capacity, kept = given
    found = pack_fragments(fragments, proxy, capacity, kept)
    kept = cells_kept(fragments, kept)
    rows = max(1, kept.sum()) if capacity is None else capacity
    assert len(found.ids) == len(found.params) == rows
    np.testing.assert_array_equal(found.row, in_reading_order(kept, rows))
    assert found.row.dtype == found.ids.dtype == np.int32


@PROPERTIES
@given(hits())
def test_overflow_counts_the_kept_cells_without_a_row(given):
    fragments, proxy, capacity, kept = given
    found = pack_fragments(fragments, proxy, capacity, kept)
    assert found.overflow == (cells_kept(fragments, kept) & (found.row < 0)).sum()
    assert found.overflow.shape == () and found.overflow.dtype == np.int32


@PROPERTIES
@given(hits())
def test_depths_are_those_of_the_hits_and_zero_where_there_is_no_row(given):
    fragments, proxy, capacity, kept = given
    found = pack_fragments(fragments, proxy, capacity, kept)
    np.testing.assert_array_equal(found.depth, np.where(found.row >= 0, fragments.depth, 0))
    assert found.depth.dtype == np.float32


@PROPERTIES
@given(hits())
def test_ids_and_params_are_those_of_the_triangle_that_was_hit(given):
    fragments, proxy, capacity, kept = given
    found = pack_fragments(fragments, proxy, capacity, kept)
    cells = found.row >= 0
    triangle, (a, b) = fragments.triangle_ids[cells], np.moveaxis(fragments.barycentrics[cells], -1, 0)
    ids = proxy.faces if proxy.ids is None else proxy.ids
    np.testing.assert_array_equal(found.ids[found.row[cells]], ids[triangle])
    weights = np.stack([a, b, 1 - a - b], axis=1).astype(np.float64)
    expected = weights[:, :2] if proxy.corner_params is None else None
    if expected is None:
        expected = np.einsum("nc,ncp->np", weights, proxy.corner_params[triangle].astype(np.float64))
    np.testing.assert_allclose(found.params[found.row[cells]], expected, rtol=0, atol=1e-6)


@PROPERTIES
@given(hits())
def test_rows_that_no_cell_has_are_zero(given):
    fragments, proxy, capacity, kept = given
    found = pack_fragments(fragments, proxy, capacity, kept)
    unused = np.setdiff1d(np.arange(len(found.ids)), found.row)
    assert not found.ids[unused].any() and not found.params[unused].any()


@PROPERTIES
@given(hits())
def test_lifting_some_cells_is_lifting_all_and_repacking(given):
    fragments, proxy, capacity, kept = given
    whole = pack_fragments(fragments, proxy)
    assert_same(pack_fragments(fragments, proxy, capacity, kept), repack(whole, cells_kept(fragments, kept), capacity))


@PROPERTIES
@given(hits(), st.integers(2, 5))
def test_any_number_of_threads_packs_alike(given, count):
    alone = pack_fragments(*given)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(threads, "LITTLE_WORK", 1)
        patch.setenv("RTS_NUM_THREADS", str(count))
        assert_same(pack_fragments(*given), alone)


# -------------------------------------------------------------------------------------------------- repack


@PROPERTIES
@given(packed())
def test_each_cell_keeps_its_sample_and_what_its_tables_say_of_it(given):
    samples, kept, capacity = given
    found = repack(samples, kept, capacity)
    cells = found.row >= 0
    old, new = samples.row[cells], found.row[cells]
    np.testing.assert_array_equal(found.ids[new], samples.ids[old])
    np.testing.assert_array_equal(found.params[new], samples.params[old])
    np.testing.assert_array_equal(found.tables["own"][new], samples.tables["own"][old])
    np.testing.assert_array_equal(found.depth, np.where(cells, samples.depth, 0))
    assert found.tables["common"] is samples.tables["common"] and found.by_sample == ("own",)


@PROPERTIES
@given(packed())
def test_repacking_gives_kept_cells_their_rows_in_reading_order_and_counts_the_others(given):
    samples, kept, capacity = given
    found = repack(samples, kept, capacity)
    rows = max(1, kept.sum()) if capacity is None else capacity
    np.testing.assert_array_equal(found.row, in_reading_order(kept, rows))
    assert found.overflow == samples.overflow + (kept & (found.row < 0)).sum()
    unused = np.setdiff1d(np.arange(rows), found.row)
    for values in (found.ids, found.params, found.tables["own"]):
        assert len(values) == rows and not values[unused].any()
