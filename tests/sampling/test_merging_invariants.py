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
def test_each_cell_has_its_nearest_samples_in_order_and_ties_go_to_the_earlier_part(given):
    samples, layers = given
    layers = min(layers, sum(len(s.row) for s in samples))
    found, numbers = merge(*given), np.cumsum([0, *(len(s.ids) for s in samples)])
    for y, x in np.ndindex(found.row.shape[1:]):
        every = []
        for part, own in enumerate(samples):
            rows, depths, triangles = (z[:, y, x].tolist() for z in (own.row, own.depth, own.triangle))
            triples = zip(depths, rows, triangles, strict=True)
            every += [(z, part, row + numbers[part], triangle) for z, row, triangle in triples if row >= 0]
        nearest = sorted(every, key=lambda one: one[:2])[:layers]
        nearest += [(0, -1, -1, -1)] * (layers - len(nearest))
        depth, part, row, triangle = zip(*nearest, strict=True)
        np.testing.assert_array_equal(found.depth[:, y, x], depth)
        np.testing.assert_array_equal(found.part[:, y, x], part)
        np.testing.assert_array_equal(found.row[:, y, x], row)
        np.testing.assert_array_equal(found.cells.triangle[:, y, x], triangle)


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


def test_in_array_code_the_unit_of_depth_does_not_matter():
    rows, depths = (x.reshape(2, 1, 1, 1) for x in (np.array([-1, 0]), np.array([0, 2**24], np.float32)))
    row, depth = (x.item() for x in merging._interleaved(1, [1, 1], *rows, *depths))
    assert (row, depth) == (1, 2**24)
