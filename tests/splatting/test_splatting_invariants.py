"""Splatters on random samples: what no scene may change."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from strategies import examples, masks, steps

from rts import splatting

pytestmark = pytest.mark.splatting

KINDS = [splatting.Single, splatting.Multi]
of_every_kind = pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.__name__)

FEW = examples(0.2)
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


def around(covered):
    """(9, H, W) bool, whether each neighbour of each cell, and the cell, is one of these (H, W)."""
    wide, (height, width) = np.pad(covered, 1), covered.shape
    return np.stack([wide[v : v + height, u : u + width] for v in range(3) for u in range(3)])


def tolerance(scene):
    return TOLERANCE[scene[0].dtype.type]


def close(found, expected, atol):
    np.testing.assert_allclose(found, expected, rtol=0, atol=atol)


def placed(scene, corner, size):
    """Samples moved elsewhere, in an image of another size."""
    (positions, rgba, row), (top, left) = scene, corner
    wide = np.full((len(row), *size), -1, np.int32)
    wide[:, top : top + row.shape[1], left : left + row.shape[2]] = row
    return positions + np.array([left, top, 0], positions.dtype), rgba, wide


def of_one_color(scene, color):
    """The scene with all samples of a colour, and the cells amid them."""
    positions, rgba, row = scene
    return (positions, np.broadcast_to(color, rgba.shape).astype(rgba.dtype), row), around(row[0] >= 0).all(axis=0)


# ---------------------------------------------------------------------------------------------- constants


@of_every_kind
@FEW
@given(options=options(), scene=scenes(centred=True), color=st.tuples(*[st.integers(0, 16)] * 4))
def test_amid_one_colour_one_layer_is_that_colour_at_any_depths(kind, options, scene, color):
    color = np.array([min(c, color[3]) for c in color]) / 16
    (positions, rgba, row), inside = of_one_color(scene, color)
    image = kind(*options).splat(positions, rgba, row[:1])
    close(image[inside], np.broadcast_to(color, (inside.sum(), 4)), tolerance(scene))


@of_every_kind
@FEW
@given(options=options(), scene=scenes(centred=True), color=st.tuples(*[st.integers(0, 16)] * 3))
def test_amid_one_opaque_colour_layers_far_apart_are_that_colour(kind, options, scene, color):
    color = np.array([*color, 16]) / 16
    (positions, rgba, row), inside = of_one_color(scene, color)
    positions = positions.copy()
    for k, layer in enumerate(row):
        positions[layer[layer >= 0], 2] += 1000 * k
    image = kind(*options).splat(positions, rgba, row)
    close(image[inside], np.broadcast_to(color, (inside.sum(), 4)), tolerance(scene))


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
@given(options=options(), scene=scenes(centred=True, opaque=True))
def test_opaque_samples_reach_their_own_and_all_neighbouring_cells_and_no_others(kind, options, scene):
    image = kind(*options).splat(*scene)
    np.testing.assert_array_equal(image[..., 3] > 0, around(scene[2][0] >= 0).any(axis=0))


# ------------------------------------------------------------------------------------ what changes alike


@of_every_kind
@FEW
@given(options=options(), scene=scenes(), a=st.integers(-8, 8), b=st.integers(-8, 8))
def test_images_are_linear_in_colours_of_given_alphas(kind, options, scene, a, b):
    positions, rgba, row = scene
    other = np.concatenate([rgba[::-1, :3], rgba[:, 3:]], axis=1)
    both = np.concatenate([a / 8 * rgba[:, :3] + b / 8 * other[:, :3], rgba[:, 3:]], axis=1).astype(rgba.dtype)
    first, second, found = (kind(*options).splat(positions, x, row) for x in (rgba, other, both))
    close(found[..., :3], a / 8 * first[..., :3] + b / 8 * second[..., :3], tolerance(scene))
    close(found[..., 3], first[..., 3], tolerance(scene))


@FEW
@given(options=options(), scene=scenes(), seed=st.integers(0, 9))
def test_the_image_of_one_layer_is_linear_in_colour_and_alpha(options, scene, seed):
    positions, rgba, row = scene
    other = np.random.default_rng(seed).random(rgba.shape).astype(rgba.dtype)
    splatter = splatting.Single(*options)
    first, second, found = (splatter.splat(positions, x, row) for x in (rgba, other, rgba - 2 * other))
    close(found, first - 2 * second, 4 * tolerance(scene))


@of_every_kind
@FEW
@given(options=options(), scene=scenes(), down=st.integers(-2, 2), right=st.integers(1, 30))
def test_a_scene_that_moves_by_whole_cells_moves_its_image(kind, options, scene, down, right):
    height, width = scene[2].shape[1:]
    top, left, size = 3, 3, (height + 6, width + 36)  # Away from the sides.
    still = kind(*options).splat(*placed(scene, (top, left), size))
    moved = kind(*options).splat(*placed(scene, (top + down, left + right), size))
    close(moved, np.roll(still, (down, right), axis=(0, 1)), tolerance(scene))


@of_every_kind
@FEW
@given(options=options(), scene=scenes(), quarters=st.integers(1, 40))
def test_how_far_away_a_scene_is_does_not_matter(kind, options, scene, quarters):
    positions, rgba, row = scene
    farther = positions + np.array([0, 0, quarters / 4], positions.dtype)
    close(kind(*options).splat(farther, rgba, row), kind(*options).splat(*scene), tolerance(scene))


@of_every_kind
def test_scenes_before_and_behind_the_camera_look_as_they_do_when_all_is_before_it(kind):
    for seed in range(20):
        rng = np.random.default_rng(seed)
        shape = rng.integers(2, 4), *rng.integers(2, 6, 2)
        covered = np.logical_and.accumulate(rng.random(shape) < 0.8, axis=0)
        depth = np.sort(rng.integers(4, 36, shape) / 4, axis=0)
        k, y, x = np.nonzero(covered)
        row = np.full(shape, -1, np.int32)
        row[covered] = np.arange(len(k))
        positions = np.stack([x + 0.5, y + 0.5, depth[covered]], axis=1)
        rgba = np.concatenate([rng.random((len(k), 3)), np.ones((len(k), 1))], axis=1)
        away, splatter = kind().splat(positions, rgba, row), kind()
        for back in (1, 3, 5, 7, 9, 12):
            nearer = positions - [0, 0, back], rgba, row
            close(splatter.splat(*nearer), away, 1e-12)


@pytest.mark.parametrize("mirror", ["left to right", "top to bottom", "rows for columns"])
@of_every_kind
@FEW
@given(options=options(), scene=scenes())
def test_a_mirrored_scene_has_the_mirrored_image(kind, mirror, options, scene):
    positions, rgba, row = scene
    x, y, z = positions.T
    height, width = row.shape[1:]
    if mirror == "left to right":
        other, turned = (width - x, y, z), lambda image: image[:, ::-1]
    elif mirror == "top to bottom":
        other, turned = (x, height - y, z), lambda image: image[::-1]
    else:
        other, turned = (y, x, z), lambda image: np.swapaxes(image, 0, 1)
    cells = np.stack([turned(layer) for layer in row])
    found = kind(*options).splat(np.stack(other, axis=1), rgba, cells)
    close(found, turned(kind(*options).splat(*scene)), tolerance(scene))


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
