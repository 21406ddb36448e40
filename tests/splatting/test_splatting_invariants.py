"""Splatters on random samples: what no scene may change."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from strategies import examples, masks, steps
from test_splatting import splat_by_loops

from rts import splatting

pytestmark = pytest.mark.splatting

KINDS = [splatting.Single, splatting.Multi]
of_every_kind = pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.__name__)

FEW, MANY = examples(0.2), examples(2)
TOLERANCE = {np.float32: 1e-5, np.float64: 1e-12}
REALS = st.sampled_from([np.float32, np.float64])


def options():
    """σ, ε and γ."""
    values = [0.5, 0.3, 0.8], [0.0, 1e-3, 0.05, 0.2], [None, 1.0]
    return st.tuples(*map(st.sampled_from, values))


# ------------------------------------------------------------------------------------------------- samples


@st.composite
def depths_of(draw, shape):
    """Depths (K, H, W) from 1 on in quarters, so that they are often equal, and their differences, too.

    Some are any, others of planes, which may be steep and parallel.
    """
    if draw(st.booleans()):
        return draw(steps(shape, 1, 4, dtype=np.float64))
    layers, height, width = shape
    place = draw(steps((layers, 1, 1), 0, 2, dtype=np.float64))
    across, down = draw(steps((2, draw(st.sampled_from([1, layers])), 1, 1), -2, 2, dtype=np.float64))
    return 30 + place + across * np.arange(width) + down * np.arange(height)[:, None]


@st.composite
def patches(draw):
    """Covered (K, H, W), depths and a number for the colour, of small scenes: all cells of a layer, a line, or any."""
    shape = draw(st.tuples(st.integers(1, 3), st.integers(1, 5), st.integers(1, 7)))
    extent = draw(st.sampled_from([(shape[0], 1, 1), (*shape[:2], 1), (shape[0], 1, shape[2]), shape]))
    covered = np.broadcast_to(draw(masks(extent)), shape)
    colors = draw(steps(shape, 0, draw(st.integers(0, 2)), step=1, dtype=np.int64))
    return covered, draw(depths_of(shape)), colors


@st.composite
def scenes(draw, centred=False, opaque=False, reals=REALS):
    """Positions (N, 3), rgba (N, 4) and row; layers are filled from the front, colours premultiplied."""
    covered, depth, colors = draw(patches())
    covered, depth = np.logical_and.accumulate(covered, axis=0), np.sort(depth, axis=0)
    rng = np.random.default_rng(draw(st.integers(0, 999)))
    total = max(1, covered.sum() + draw(st.integers(0, 3)))
    row = np.full(covered.shape, -1, np.int32)
    row[covered] = rng.permutation(total)[: covered.sum()]
    k, y, x = np.nonzero(covered)
    positions, rgba = rng.normal(size=(total, 3)), rng.random((total, 4))
    positions[row[covered]] = np.stack([x + 0.5, y + 0.5, depth[covered]], axis=1)
    # All of them off the centres, one in twenty, or none.
    share = draw(st.just(0.0) if centred else st.sampled_from([0.0, 0.05, 1.0]))
    off = rng.integers(-6, 7, (len(k), 2)) / draw(st.sampled_from([16, 2**17]))
    positions[row[covered], :2] += off * (rng.random((len(k), 1)) < share)
    palette = np.concatenate([rng.integers(0, 17, (3, 3)) / 16, np.ones((3, 1))], axis=1)
    palette = palette * (1 if opaque else rng.choice([0.5, 1], (3, 1)))
    rgba[row[covered]] = palette[colors[covered]]
    kind = draw(reals)
    return positions.astype(kind), rgba.astype(kind), row


def tolerance(scene):
    return TOLERANCE[scene[0].dtype.type]


def close(found, expected, atol):
    np.testing.assert_allclose(found, expected, rtol=0, atol=atol)


@of_every_kind
@MANY
@given(options=options(), scene=scenes())
def test_images_are_those_of_the_loop_written_from_the_definition(kind, options, scene):
    """So constants stay, colours are linear, mirrored and shifted scenes have mirrored and shifted images."""
    sigma, epsilon, calibration = options
    layers = scene[2] if kind is splatting.Multi else scene[2][:1]
    gamma = splatting.exact_calibration(sigma) if calibration is None else calibration
    expected = splat_by_loops(*(x.astype(np.float64) for x in scene[:2]), layers, sigma, epsilon, gamma)
    close(kind(*options).splat(*scene), expected, tolerance(scene))


@of_every_kind
@FEW
@given(options=options(), scene=scenes())
def test_images_are_premultiplied_with_alpha_between_zero_and_one(kind, options, scene):
    image = kind(*options).splat(*scene)
    assert np.isfinite(image).all() and image.min(initial=0) >= 0
    assert image[..., 3].max(initial=0) <= 1 + tolerance(scene)
    assert (image[..., :3] <= image[..., 3:] + tolerance(scene)).all()


@of_every_kind
@FEW
@given(options=options(), scene=scenes(), seed=st.integers(0, 9))
def test_the_order_of_packed_rows_does_not_matter(kind, options, scene, seed):
    positions, rgba, row = scene
    order = np.random.default_rng(seed).permutation(len(rgba))
    numbers = np.append(np.argsort(order), -1).astype(np.int32)
    found = kind(*options).splat(positions[order], rgba[order], numbers[row])
    np.testing.assert_array_equal(found, kind(*options).splat(*scene))


@of_every_kind
@FEW
@given(options=options(), scene=scenes(), border=st.integers(1, 3))
def test_a_border_is_left_out_and_changes_nothing_inside(kind, options, scene, border):
    whole = kind(*options).splat(*scene)
    height, width = whole.shape[:2]
    expected = whole[border : max(border, height - border), border : max(border, width - border)]
    close(kind(*options).splat(*scene, border=border), expected, tolerance(scene))
