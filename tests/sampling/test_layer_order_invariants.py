"""Settling of layers: which stay, in which order, and that nothing is lost without a reason."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from strategies import examples, masks, rows_of, table, told_apart

from rts import Camera
from rts.compiling import threads
from rts.sampling.layer_order import SAME_ROOT, SAME_ROOT_PIXELS, settle

pytestmark = pytest.mark.sampling

EXAMPLES = examples(1.7)

SIZE = (24, 28)
NEAR, FAR = 1.0, 9.0
PERSPECTIVE = Camera.look_at((0, 0, 4), (0, 0, 0), near=NEAR, far=FAR)
ORTHOGRAPHIC = Camera.orthographic((1, 2, 4), (0, 0, 0), height=3, near=NEAR, far=FAR)
BEHIND = Camera.orthographic((1, 2, 4), (0, 0, 0), height=3, near=-FAR, far=FAR)
VIEWS = [PERSPECTIVE, ORTHOGRAPHIC, BEHIND]

INSIDE, ANYWHERE = [NEAR, 2.0, 3.5, 7.0, FAR], [-20.0, -4.0, 0.0, 0.9, NEAR, 3.5, FAR, 9.1, 40.0]
APART = [0.0, 0.4, -0.4, 0.9, -0.9, 1.2, 1.8]
"""Depths, and how far off them, in units of what counts as one root."""


def limit(camera, spread, depth):
    """By how much the depth of a layer exceeds that of the one before, at least; in float64."""
    unit = abs(np.linalg.det(camera.view[:3, :3])) ** (1 / 3)
    return SAME_ROOT_PIXELS * unit * (spread[0] + spread[1] * np.abs(depth)) + SAME_ROOT * np.abs(depth)


def spread_of(camera):
    return np.asarray(camera.rays(SIZE).spread, np.float64)


@st.composite
def refined(draw, camera):
    """Samples in any order, about one or two depths."""
    shape = draw(st.tuples(st.integers(1, 5), st.integers(1, 3), st.integers(1, 3)))
    few = [draw(st.sampled_from(INSIDE)), draw(st.sampled_from(ANYWHERE))]
    anchors = draw(table(np.float64, shape, st.sampled_from(few)))
    apart = draw(table(np.float64, shape, st.sampled_from(APART)))
    row, total = draw(rows_of(draw(masks(shape)) | draw(masks(shape))))
    return told_apart(row, total, (anchors + apart * limit(camera, spread_of(camera), anchors)).astype(np.float32))


@st.composite
def scenes(draw):
    """A camera, the spread of its rays, and samples seen by it."""
    camera = draw(st.sampled_from(VIEWS))
    return draw(refined(camera)), camera, spread_of(camera)


def columns(samples):
    """The rows and depths of each cell, as long as there are any that are not −1."""
    for y, x in np.ndindex(samples.row.shape[1:]):
        covered = samples.row[:, y, x] >= 0
        yield samples.row[covered, y, x], samples.depth[covered, y, x].astype(np.float64)


def planes(camera):
    return tuple(float(z) for z in camera.depth_range())


def assert_same(found, expected):
    np.testing.assert_array_equal(found.row, expected.row)
    np.testing.assert_array_equal(found.depth, expected.depth)


@EXAMPLES
@given(scenes())
def test_settling_again_changes_nothing(scene):
    once = settle(*scene)
    assert_same(settle(once, *scene[1:]), once)


@EXAMPLES
@given(scenes())
def test_layers_ascend_without_gaps_and_are_zero_where_empty(scene):
    found = settle(*scene)
    covered = found.row >= 0
    assert (covered[:-1] | ~covered[1:]).all()
    assert (np.diff(found.depth, axis=0)[covered[1:]] > 0).all()
    assert not found.depth[~covered].any()
    assert found.row.dtype == np.int32 and found.depth.dtype == np.float32


@EXAMPLES
@given(scenes())
def test_no_two_layers_of_a_cell_are_one_root(scene):
    samples, camera, spread = scene
    for _, depth in columns(settle(samples, camera, spread)):
        assert (np.diff(depth) > limit(camera, spread, depth[1:]) * (1 - 1e-9)).all()


@EXAMPLES
@given(scenes())
def test_what_stays_was_given_in_its_cell_and_lies_between_the_planes(scene):
    samples, camera, _ = scene
    near, far = planes(camera)
    for (row, depth), before in zip(columns(settle(*scene)), columns(samples), strict=True):
        known = dict(zip(*before, strict=True))
        assert len(set(row.tolist())) == len(row)
        assert [known[i] for i in row] == depth.tolist()
        assert (depth >= near - 1e-5 * abs(near)).all() and (depth <= far + 1e-5 * abs(far)).all()


@EXAMPLES
@given(scenes())
def test_what_is_dropped_lies_beyond_a_plane_or_just_behind_a_layer_that_stays(scene):
    samples, camera, spread = scene
    near, far = planes(camera)
    for (row, depth), before in zip(columns(settle(*scene)), columns(samples), strict=True):
        for i, z in zip(*before, strict=True):
            behind = z - depth[depth <= z]
            one_root = (behind <= limit(camera, spread, z) * (1 + 1e-9)).any()
            assert i in row or z < near or z > far or one_root


@EXAMPLES
@given(scenes(), st.data())
def test_the_order_in_which_layers_come_does_not_matter(scene, data):
    samples, camera, spread = scene
    order = data.draw(st.permutations(range(len(samples.row))))
    other = settle(samples.replace(row=samples.row[order], depth=samples.depth[order]), camera, spread)
    np.testing.assert_array_equal(other.depth, settle(*scene).depth)


@EXAMPLES
@given(scenes())
def test_of_layers_at_one_depth_the_first_given_stays(scene):
    samples = scene[0]
    for (row, depth), (rows, depths) in zip(columns(settle(*scene)), columns(samples), strict=True):
        assert row.tolist() == [rows[np.flatnonzero(depths == z)[0]] for z in depth]


@EXAMPLES
@given(scenes(), st.integers(-6, 6))
def test_the_unit_of_the_surface_does_not_matter(scene, exponent):
    samples, camera, _ = scene
    # Depths are the camera's, whatever the unit of what it sees.
    local = camera.within(np.diag([2.0**exponent] * 3 + [1.0]))
    assert_same(settle(samples, local, spread_of(local)), settle(*scene))


@EXAMPLES
@given(scenes(), st.integers(2, 5))
def test_any_number_of_threads_settles_alike(scene, count):
    alone = settle(*scene)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(threads, "LITTLE_WORK", 1)
        patch.setenv("RTS_NUM_THREADS", str(count))
        assert_same(settle(*scene), alone)


@EXAMPLES
@given(scenes())
def test_what_is_given_is_not_changed(scene):
    row, depth = scene[0].row.copy(), scene[0].depth.copy()
    found = settle(*scene)
    np.testing.assert_array_equal(scene[0].row, row)
    np.testing.assert_array_equal(scene[0].depth, depth)
    assert found.ids is scene[0].ids and found.params is scene[0].params
