"""Merging parts by depth: the nearest layers of each cell, in order; compiled as in array code."""

from dataclasses import replace

import numpy as np
import pytest
from helpers import TORCH, arrays, to_numpy
from hypothesis import given
from hypothesis import strategies as st
from strategies import PROPERTIES, masks, rows_of, steps, told_apart

from rts.compiling import threads
from rts.sampling import merging
from rts.sampling.merging import merge

pytestmark = pytest.mark.sampling

REALS = st.sampled_from([np.float32, np.float64])


@st.composite
def parts(draw, least=1, most=4, reals=REALS):
    """Samples of some parts on one grid, each front to back, perhaps with empty layers between; and K."""
    size = draw(st.integers(1, 3)), draw(st.integers(1, 4))
    found = []
    for _ in range(draw(st.integers(least, most))):
        shape = draw(st.integers(1, 3)), *size
        row, total = draw(rows_of(draw(masks(shape))))
        depth = np.sort(draw(steps(shape, -2, 4, dtype=draw(reals))), axis=0)
        triangle = np.random.default_rng(draw(st.integers(0, 9))).integers(0, 9, shape)
        told = told_apart(row, total, depth).replace(triangle=np.where(row >= 0, triangle, -1).astype(np.int32))
        found.append(replace(told, overflow=np.int32(draw(st.integers(0, 3)))))
    return found, draw(st.integers(1, 6))


def offsets_of(samples):
    """At which number the rows of each part begin."""
    return np.cumsum([0, *(len(s.ids) for s in samples)])


def given_to(interleave, samples, layers, target="numpy"):
    """Row, depth and triangle from one of the two ways to interleave."""
    given = *(s.row for s in samples), *(s.depth for s in samples), *(s.triangle for s in samples)
    given = given if target == "numpy" else map(lambda x: arrays(target, x, x.dtype), given)
    return to_numpy(interleave(layers, [len(s.ids) for s in samples], *given))


# ------------------------------------------------------------------------------------------------ compiled


@pytest.mark.parametrize("target", ["numpy", TORCH[0]])
@PROPERTIES
@given(given=parts())
def test_compiled_it_is_the_array_code(target, given):
    row, depth, triangle = given_to(merging._interleaved_on_the_host, *given)
    own, *others = given_to(merging._interleaved, *given, target)
    np.testing.assert_array_equal(row, own)
    for found, expected, empty in zip((depth, triangle), others, (0, -1), strict=True):
        np.testing.assert_array_equal(found, np.where(own >= 0, expected, empty))
    assert depth.dtype == np.result_type(*(s.depth for s in given[0]))


@PROPERTIES
@given(parts(), st.integers(2, 5))
def test_any_number_of_threads_merges_alike(given, count):
    alone = given_to(merging._interleaved_on_the_host, *given)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(threads, "LITTLE_WORK", 1)
        patch.setenv("RTS_NUM_THREADS", str(count))
        for found, expected in zip(given_to(merging._interleaved_on_the_host, *given), alone, strict=True):
            np.testing.assert_array_equal(found, expected)


# ---------------------------------------------------------------------------------------------- the record


@PROPERTIES
@given(parts(least=2))
def test_depths_ascend_without_gaps_and_are_zero_where_empty(given):
    found = merge(*given)
    covered = found.row >= 0
    assert (covered[:-1] | ~covered[1:]).all()
    assert (np.diff(found.depth, axis=0)[covered[1:]] >= 0).all()
    assert not found.depth[~covered].any()


@PROPERTIES
@given(parts(least=2))
def test_every_sample_named_is_one_of_its_part_in_its_cell(given):
    samples, layers = given
    found = merge(samples, layers)
    numbers, ids = offsets_of(samples), np.concatenate([s.ids for s in samples])
    for k, y, x in np.argwhere(found.row >= 0):
        own = samples[found.part[k, y, x]]
        [layer] = np.flatnonzero(own.row[:, y, x] == found.row[k, y, x] - numbers[found.part[k, y, x]])
        np.testing.assert_array_equal(ids[found.row[k, y, x]], own.ids[own.row[layer, y, x]])
        assert found.depth[k, y, x] == own.depth[layer, y, x]
        assert found.cells.triangle[k, y, x] == own.triangle[layer, y, x]


@PROPERTIES
@given(parts(least=2))
def test_nothing_nearer_is_missing_and_no_sample_is_taken_twice(given):
    samples, layers = given
    found = merge(samples, layers)
    numbers = offsets_of(samples)
    for y, x in np.ndindex(found.row.shape[1:]):
        taken = found.row[:, y, x][found.row[:, y, x] >= 0].tolist()
        assert len(set(taken)) == len(taken)
        left = [
            z
            for s, first in zip(samples, numbers, strict=False)
            for i, z in zip(s.row[:, y, x], s.depth[:, y, x], strict=True)
            if i >= 0 and i + first not in taken
        ]
        assert not left or (len(taken) == layers and min(left) >= found.depth[-1, y, x])


@PROPERTIES
@given(parts(least=2))
def test_equal_depths_go_to_the_earlier_part(given):
    found = merge(*given)
    tied = (np.diff(found.depth, axis=0) == 0) & (found.row[1:] >= 0)
    assert (np.diff(found.part, axis=0)[tied] >= 0).all()


@PROPERTIES
@given(parts(least=2), st.data())
def test_where_no_depths_are_equal_the_order_of_parts_does_not_matter(given, data):
    samples, layers = given
    # What the parts add tells their depths apart.
    samples = [s.replace(depth=np.where(s.row >= 0, s.depth + i / 64, 0)) for i, s in enumerate(samples)]
    order = data.draw(st.permutations(range(len(samples))))
    found, other = merge(samples, layers), merge([samples[i] for i in order], layers)
    np.testing.assert_array_equal(np.where(other.part >= 0, np.array(order)[other.part], -1), found.part)
    np.testing.assert_array_equal(other.depth, found.depth)


@PROPERTIES
@given(parts(least=2))
def test_one_layer_more_changes_none_before_it(given):
    samples, layers = given
    fewer, more = merge(samples, layers), merge(samples, layers + 1)
    np.testing.assert_array_equal(more.row[:layers], fewer.row)
    np.testing.assert_array_equal(more.depth[:layers], fewer.depth)


@PROPERTIES
@given(parts())
def test_what_did_not_fit_is_counted_over_all_parts(given):
    samples, layers = given
    found = merge(samples, layers)
    assert found.overflow == sum(int(s.overflow) for s in samples)
    assert found.samples == tuple(samples)


@PROPERTIES
@given(parts(most=1))
def test_the_layers_of_a_single_part_are_its_own(given):
    [samples], layers = given
    found = merge([samples], layers)
    assert found.row is samples.row and found.depth is samples.depth


@PROPERTIES
@given(parts(least=2, reals=st.just(np.float32)), st.sampled_from([-40, 40]))
def test_the_unit_of_depth_does_not_matter(given, exponent):
    samples, layers = given
    scaled = [s.replace(depth=s.depth * np.float32(2.0**exponent)) for s in samples]
    found, expected = merge(scaled, layers), merge(samples, layers)
    np.testing.assert_array_equal(found.row, expected.row)
    np.testing.assert_array_equal(found.part, expected.part)


def test_in_array_code_the_unit_of_depth_does_not_matter():
    rows, depths = (x.reshape(2, 1, 1, 1) for x in (np.array([-1, 0]), np.array([0, 2**24], np.float32)))
    row, depth = (x.item() for x in merging._interleaved(1, [1, 1], *rows, *depths))
    assert (row, depth) == (1, 2**24)
