"""Active pixels, which take many samples: those beside outlines, and where colours change."""

import itertools
import math

import numpy as np
import pytest
from adaptive_scenes import (
    BALL,
    CAMERA,
    MESH,
    SIZE,
    render,
    scene,
)
from helpers import arrays, icosphere, quad
from loops import STEPS, Pairing

import rts
from rts import Adaptive
from rts.sampling.adaptive import outlines
from rts.splatting.layers import dilated

pytestmark = pytest.mark.sampling


# ------------------------------------------------------------------------------------------------------- outlines


def two_sheets(seed):
    """Rows and depths (K, H, W) of rough sheets with holes, in two layers."""
    rng = np.random.default_rng(seed)
    height, width = 9, 11
    y, x = np.indices((height, width))
    sheets = np.stack([3 + 0.2 * x + 0 * y, 3.9 + 0.1 * y, 5 - 0.15 * x])
    sheets = sheets + 0.05 * rng.random(sheets.shape)  # No two depths tie.
    sheets = np.where(rng.random(sheets.shape) < 0.4, np.inf, sheets)
    depth = np.sort(sheets, axis=0)[:2]
    covered = np.isfinite(depth)
    row = np.where(covered, np.cumsum(covered).reshape(covered.shape) - 1, -1).astype(np.int32)
    return row, np.where(covered, depth, 0)


@pytest.mark.parametrize("seed", range(4))
def test_active_are_cells_at_either_side_of_where_fronts_end(seed):
    row, depth = two_sheets(seed)
    positions = np.zeros((row.max() + 1, 3))
    positions[row[row >= 0], 2] = depth[row >= 0]
    pairing = Pairing(positions, row, visible=True)
    expected = np.zeros(row.shape[1:], bool)
    for (y, x), (u, v) in itertools.product(pairing.cells, STEPS):
        if (u, v) != (0, 0) and pairing.ends((y, x), (u, v)):
            expected[y, x] = expected[y + v, x + u] = True
    found = outlines(row, depth, [positions.shape[0]])
    np.testing.assert_array_equal(found, expected)
    assert 0.2 < found.mean() < 1


def test_where_layers_tie_cells_are_active():
    row = np.arange(60, dtype=np.int32).reshape(2, 5, 6)
    left = np.arange(6) < 3
    for gap, active in ((0.0, True), (1e-9, True), (0.01, False)):
        depth = np.stack([np.where(left, 1.0, 1.5), np.where(left, 2.0 + gap, 2.5)])
        found = outlines(row, np.repeat(depth[:, None], 5, axis=1), [60])
        assert found[:, 2:4].all() == found.any() == active


def test_where_another_part_is_seen_both_sides_are_active():
    row = np.arange(30, dtype=np.int32).reshape(1, 5, 6)
    found = outlines(row, np.ones(row.shape), [15, 15])
    np.testing.assert_array_equal(np.flatnonzero(found), np.arange(8, 22))  # It changes amid the third row.
    assert not outlines(row, np.ones(row.shape), [30]).any()


def test_dilation_reaches_the_eight_neighbours():
    cells = np.zeros((5, 6), bool)
    cells[2, 1] = True
    expected = np.zeros((5, 6), bool)
    expected[1:4, :3] = True
    np.testing.assert_array_equal(dilated(cells), expected)


def test_masks_are_dilated_for_shaders_of_more_than_one_colour_a_part():
    def active(shader, adaptive):
        sampled = rts.sample(scene(shader=shader), CAMERA, SIZE, supersample=adaptive, layers=3, splatter="visible")
        return sampled.fine.pixel >= 0

    bare = active("silhouette", Adaptive(4))
    np.testing.assert_array_equal(active("unlit", Adaptive(4)), active("silhouette", Adaptive(4, dilated=True)))
    np.testing.assert_array_equal(active("unlit", Adaptive(4, dilated=False)), bare)
    inner = dilated(bare)[1:-1, 1:-1]
    np.testing.assert_array_equal(active("unlit", Adaptive(4))[1:-1, 1:-1], inner)


def test_cells_amid_one_colour_are_no_outlines_though_their_samples_are_left_out():
    vertices, faces = icosphere(3)
    part, adaptive = rts.Part(MESH(faces), {"vertices": vertices}, cull="back"), Adaptive(4)
    whole, settled = (
        rts.sample(part, CAMERA, (48, 48), supersample=adaptive, splatter="visible", settles=s) for s in (False, True)
    )
    np.testing.assert_array_equal(settled.fine.pixel, whole.fine.pixel)
    assert len(settled.samples[0].ids) < 0.7 * len(whole.samples[0].ids)
    images = [rts.render_samples(s, part, CAMERA, splatter="visible") for s in (whole, settled)]
    np.testing.assert_allclose(*images, rtol=0, atol=1e-6)


def steps_of_colour():
    """A card whose left half is dark and whose right half is bright, over all of the image."""
    vertices, faces = quad(-9, 9, -9, 9)

    def shader(theta, gbuffer, camera):
        xp = rts.namespace(gbuffer["position"])
        grey = xp.where(gbuffer["position"][:, :1] < 0.13, 0.1, 0.9)
        return xp.concat([grey, grey, grey, xp.ones_like(grey)], axis=1)

    return rts.Part(MESH(faces), {"vertices": vertices}, shader)


def test_contrast_finds_edges_of_colour():
    part = steps_of_colour()
    images = [render(part, n, splatter="visible", layers=2) for n in (1, 4, Adaptive(4), Adaptive(4, contrast=0.2))]
    plain, fine, by_outlines, by_contrast = images
    np.testing.assert_array_equal(by_outlines, plain)
    changed = np.abs(by_contrast - plain).max(axis=-1) > 0
    assert changed.any() and np.abs(by_contrast - fine).max() < np.abs(plain - fine).max() / 3


def test_contrast_is_refused_where_colours_are_not_known():
    with pytest.raises(rts.InputError, match="rts.sample knows no colours"):
        rts.sample(scene(), CAMERA, SIZE, supersample=Adaptive(4, contrast=0.2), splatter="visible", layers=2)
    jax = pytest.importorskip("jax")
    with pytest.raises(rts.InputError, match="colours are traced"):
        jax.jit(lambda v: render(scene(v), Adaptive(4, contrast=0.2), splatter="visible", layers=2))(
            arrays("jax", BALL)
        )


# ------------------------------------------------------------------------------------------------------ the value


@pytest.mark.parametrize(
    "wrong, told",
    [
        ({"samples": 1}, "samples of Adaptive is 1; expected an integer of at least 2"),
        ({"samples": 2.5}, "samples of Adaptive is 2.5"),
        ({"samples": 65}, "samples of Adaptive is 65; expected at most 64, .* take 4 or 8"),
        ({"samples": 4, "dilated": 1}, "dilated of Adaptive is 1; expected True, False or None"),
        ({"samples": 4, "contrast": 0}, "contrast of Adaptive is 0; expected a positive finite number"),
        ({"samples": 4, "contrast": math.inf}, "contrast of Adaptive is inf; expected a positive finite number"),
    ],
)
def test_what_cannot_be_is_refused(wrong, told):
    with pytest.raises(rts.InputError, match=told):
        Adaptive(**wrong)


def test_more_fine_samples_than_memory_are_refused_before_they_are_laid_out(monkeypatch):
    monkeypatch.setattr(rts.contracts.checks, "MEMORY", 8000 * SIZE[0] * SIZE[1])
    monkeypatch.setattr(rts.sampling.fine_samples, "lay_out", lambda *_: pytest.fail("laid out"))
    with pytest.raises(rts.InputError, match=r"1 x \d+ pixels .* or fewer samples a pixel"):
        render(scene(), Adaptive(64), splatter="visible", layers=2)


def test_it_is_a_static_value():
    assert Adaptive(4) == Adaptive(np.int64(4)) != Adaptive(4, dilated=True) and len({Adaptive(4), Adaptive(4)}) == 1


@pytest.mark.parametrize(
    "given, text",
    [
        (4, "4"),
        (Adaptive(4), "adaptive:4"),
        (Adaptive(8, dilated=False, contrast=0.2), "adaptive:8:dilated=False:contrast=0.2"),
        (Adaptive(4, contrast=1e-5), "adaptive:4:contrast=1e-05"),
    ],
)
def test_texts_stand_for_it(given, text):
    assert Adaptive.of_text(text) == Adaptive.of_text(text.upper()) == given


@pytest.mark.parametrize(
    "text, told",
    [
        ("four", "'four' is no supersample; expected a number such as 4, or adaptive:4"),
        ("adaptive", "is no supersample"),
        ("dense:4", "is no supersample"),
        ("adaptive:1", "samples of Adaptive is 1"),
        ("adaptive:4:contrast=much", "'contrast=much' of 'adaptive:4:contrast=much' is none of"),
        ("adaptive:4:contrast=nan", "contrast of Adaptive is nan"),
        ("adaptive:4:dilated=1", "'dilated=1' of 'adaptive:4:dilated=1' is none of"),
    ],
)
def test_texts_that_stand_for_nothing_are_refused(text, told):
    with pytest.raises(rts.InputError, match=told):
        Adaptive.of_text(text)
