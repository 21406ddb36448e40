"""Splatters on random samples: what no scene may change, and compiled code against the specification."""

import numpy as np
import pytest
from helpers import TORCH, arrays, to_numpy
from hypothesis import given
from hypothesis import strategies as st
from strategies import examples, masks, steps

from rts import splatting
from rts_backends.fused import splatters as fused

pytestmark = pytest.mark.splatting

torch = pytest.importorskip("torch")

COMPILED = [fused.Single, fused.Multi, fused.Visible]
EVERY = [splatting.Single, splatting.Multi, splatting.Visible, *COMPILED]
of_every_kind = pytest.mark.parametrize("kind", EVERY, ids=lambda kind: f"{kind.__module__}.{kind.__name__}")
of_compiled_kinds = pytest.mark.parametrize("kind", COMPILED, ids=lambda kind: kind.__name__)

FEW, MANY = examples(0.2), examples(0.4)
TOLERANCE = {np.float32: 1e-5, np.float64: 1e-12}
REALS = st.sampled_from([np.float32, np.float64])

POSITIVE = 1e-3, 0.05, 0.2
"""Values of ε: with none, rounding decides whether weights add up to one, and so the derivative on centres."""


def options(epsilons=(0.0, *POSITIVE)):
    """σ, ε and γ."""
    return st.tuples(st.sampled_from([0.5, 0.3, 0.8]), st.sampled_from(epsilons), st.sampled_from([None, 1.0]))


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
def quilts(draw):
    """Larger scenes, of rectangles that overlap, over more than one block of columns of compiled code.

    Some rectangles are as wide as the image, since compiled code takes shortcuts along whole lines. In some scenes
    deeper layers are only on one side of the border between two blocks.
    """
    layers, height, width = draw(st.tuples(st.integers(1, 4), st.integers(5, 12), st.integers(20, 45)))
    rng = np.random.default_rng(draw(st.integers(0, 9999)))
    covered, colors = np.zeros((layers, height, width), bool), np.zeros((layers, height, width), np.int64)
    depth = np.ones(covered.shape)
    for _ in range(8):
        top, left = rng.integers(height) - 3, rng.integers(width) - 3
        across = slice(max(0, left), left + rng.integers(4, 16)) if rng.random() < 0.6 else slice(width)
        place = slice(max(0, top), top + rng.integers(4, 9)), across
        y, x = np.indices((height, width))
        slopes, rough = rng.integers(-4, 5, (2, 1 if rng.random() < 0.5 else layers, 1, 1)), rng.choice([0, 0, 2, 12])
        plane = rng.integers(0, 9, (layers, 1, 1)) + slopes[0] * x + slopes[1] * y
        plane = plane + rng.integers(0, 1 + rough, plane.shape)
        depth[:, *place] = 60 + plane[:, *place] / 4
        covered[:, *place] = (np.arange(layers) < rng.integers(0, layers + 1))[:, None, None]
        colors[:, *place] = rng.integers(0, 3, (layers if rng.random() < 0.5 else 1, 1, 1))
    covered[1:, :, draw(st.sampled_from([slice(0), slice(32), slice(32, None)]))] = False
    return covered, depth, colors


@st.composite
def scenes(draw, centred=False, opaque=False, reals=REALS):
    """Positions (N, 3), rgba (N, 4) and row; layers are filled from the front, colours premultiplied."""
    covered, depth, colors = draw(patches() | quilts())
    covered, depth = np.logical_and.accumulate(covered, axis=0), np.sort(depth, axis=0)
    rng = np.random.default_rng(draw(st.integers(0, 999)))
    total = max(1, covered.sum() + draw(st.integers(0, 3)))
    row = np.full(covered.shape, -1, np.int32)
    row[covered] = rng.permutation(total)[: covered.sum()]
    k, y, x = np.nonzero(covered)
    positions, rgba = rng.normal(size=(total, 3)), rng.random((total, 4))
    positions[row[covered]] = np.stack([x + 0.5, y + 0.5, depth[covered]], axis=1)
    # All of them off the centres, one in twenty, or none; a little is no matter to compiled code.
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


@pytest.mark.parametrize("kind", [splatting.Single, fused.Single])
@FEW
@given(options=options(), scene=scenes(), seed=st.integers(0, 9))
def test_the_image_of_one_layer_is_linear_in_colour_and_alpha(kind, options, scene, seed):
    positions, rgba, row = scene
    other = np.random.default_rng(seed).random(rgba.shape).astype(rgba.dtype)
    first, second, found = (kind(*options).splat(positions, x, row) for x in (rgba, other, rgba - 2 * other))
    close(found, first - 2 * second, 4 * tolerance(scene))


@of_every_kind
@FEW
@given(options=options(), scene=scenes(), down=st.integers(-2, 2), right=st.integers(1, 30))
def test_a_scene_that_moves_by_whole_cells_moves_its_image(kind, options, scene, down, right):
    height, width = scene[2].shape[1:]
    # Away from the sides; other columns are beside the borders of the blocks that compiled code looks at.
    top, left, size = 3, 3, (height + 6, width + 36)
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


@pytest.mark.parametrize("kind", [splatting.Visible, fused.Visible])
def test_how_far_away_a_scene_is_does_not_matter_where_the_camera_is_amid_it(kind):
    positions, row = np.array([(0.5, 0.5, 1.5), (1.5, 0.5, 1.0)]), np.array([[[0, 1]], [[-1, -1]]], np.int32)
    away = kind().splat(positions, np.ones((2, 4)), row)
    close(kind().splat(positions - [0, 0, 1.25], np.ones((2, 4)), row), away, 1e-12)


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
            close(splatter.splat(*without_what_is_not_needed(splatter, nearer)), away, 1e-12)


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


@pytest.mark.parametrize("kind", [splatting.Visible, fused.Visible])
@MANY
@given(options=options(), scene=scenes())
def test_a_layer_that_is_empty_everywhere_changes_nothing(kind, options, scene):
    positions, rgba, row = scene
    # Of `Multi` it does: an empty target pairs with a source's empty layer, and takes all others in front.
    found = kind(*options).splat(positions, rgba, np.concatenate([row, np.full_like(row[:1], -1)]))
    close(found, kind(*options).splat(*scene), tolerance(scene))


@of_every_kind
@FEW
@given(options=options(), scene=scenes(), border=st.integers(1, 3))
def test_a_border_is_left_out_and_changes_nothing_inside(kind, options, scene, border):
    whole = kind(*options).splat(*scene)
    height, width = whole.shape[:2]
    expected = whole[border : max(border, height - border), border : max(border, width - border)]
    close(kind(*options).splat(*scene, border=border), expected, tolerance(scene))


# --------------------------------------------------------------------------------------- what is needed


def without_what_is_not_needed(splatter, scene):
    """The scene with the rows of samples that the splatter does not need taken from their cells."""
    positions, rgba, row = scene
    covered = row >= 0
    kept = splatter.needed(covered, np.where(covered, positions[row, 2], 0))
    assert kept.dtype == bool and not (kept & ~covered).any()
    return positions, rgba, np.where(kept, row, -1).astype(np.int32)


@of_every_kind
@MANY
@given(options=options(), scene=scenes(centred=True, opaque=True))
def test_what_is_not_needed_leaves_the_image_of_opaque_samples_as_it_is(kind, options, scene):
    splatter = kind(*options)
    close(splatter.splat(*without_what_is_not_needed(splatter, scene)), splatter.splat(*scene), tolerance(scene))


@of_compiled_kinds
@FEW
@given(
    options=options(POSITIVE),
    scene=scenes(centred=True, opaque=True, reals=st.just(np.float64)),
    seed=st.integers(0, 9),
)
def test_what_is_not_needed_leaves_the_derivative_of_opaque_samples_as_it_is(kind, options, scene, seed):
    splatter = kind(*options)
    found = pulled_back(splatter, without_what_is_not_needed(splatter, scene), seed)
    for values, expected in zip(found, pulled_back(splatter, scene, seed), strict=True):
        close(values[:, :3], expected[:, :3], 1e-9)  # Not of alpha, which is constant.


# ---------------------------------------------------------------------------- compiled, and the specification


def specification(kind):
    """The class of `rts.splatting`."""
    return getattr(splatting, kind.__name__)


def pulled_back(splatter, scene, seed):
    """Gradients from a random one of the image, by torch: of positions and colours, and of positions alone."""
    positions, rgba, row = arrays(TORCH[0], scene, scene[0].dtype)
    found = []
    for wanted in ((positions, rgba), (positions,)):
        for x in (positions, rgba):
            x.requires_grad_(any(x is w for w in wanted))
        image = splatter.splat(positions, rgba, row)
        along = torch.tensor(np.random.default_rng(seed).normal(size=image.shape), dtype=image.dtype)
        found += torch.autograd.grad(image, wanted, along)
    return to_numpy(found)


@of_compiled_kinds
@MANY
@given(options=options(), scene=scenes(), border=st.integers(0, 2))
def test_compiled_images_are_those_of_the_specification(kind, options, scene, border):
    found = kind(*options).splat(*scene, border=border)
    assert found.dtype == scene[0].dtype
    close(found, specification(kind)(*options).splat(*scene, border=border), tolerance(scene))


@of_compiled_kinds
@MANY
@given(options=options(POSITIVE), scene=scenes(), seed=st.integers(0, 9))
def test_compiled_gradients_are_those_of_the_specification(kind, options, scene, seed):
    given = pulled_back(kind(*options), scene, seed), pulled_back(specification(kind)(*options), scene, seed)
    for found, expected in zip(*given, strict=True):
        close(found, expected, 20 * tolerance(scene) * max(1, np.abs(expected).max()))


@of_compiled_kinds
@MANY
@given(options=options(), scene=scenes(centred=True, opaque=True))
def test_what_compiled_code_needs_is_what_the_specification_needs(kind, options, scene):
    own, specified = (without_what_is_not_needed(k(*options), scene)[2] for k in (kind, specification(kind)))
    np.testing.assert_array_equal(own, specified)
