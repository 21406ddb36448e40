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


def planes(camera):
    return tuple(float(z) for z in camera.depth_range())


def assert_same(found, expected):
    np.testing.assert_array_equal(found.row, expected.row)
    np.testing.assert_array_equal(found.depth, expected.depth)


@EXAMPLES
@given(scenes())
def test_layers_between_the_planes_stay_in_order_but_for_those_just_behind_one_that_stays(scene):
    samples, camera, spread = scene
    found, (near, far) = settle(*scene), planes(camera)
    assert found.row.dtype == np.int32 and found.depth.dtype == np.float32
    for y, x in np.ndindex(samples.row.shape[1:]):
        kept = []
        pairs = zip(samples.depth[:, y, x].astype(np.float64), samples.row[:, y, x].tolist(), strict=True)
        for z, row in sorted((pair for pair in pairs if pair[1] >= 0), key=lambda pair: pair[0]):
            seen = near - 1e-5 * abs(near) <= z <= far + 1e-5 * abs(far)
            if seen and not (kept and z - kept[-1][0] <= limit(camera, spread, z)):
                kept.append((z, row))
        kept += [(0, -1)] * (len(samples.row) - len(kept))
        np.testing.assert_array_equal(found.depth[:, y, x], np.float32([z for z, _ in kept]))
        np.testing.assert_array_equal(found.row[:, y, x], [row for _, row in kept])


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
