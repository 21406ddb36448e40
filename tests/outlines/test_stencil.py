"""Stencils are the areas and boundary terms of the rule, pixel by pixel; and weights of colours are convex."""

import warnings

import numpy as np
import pytest
from found_outlines import noted
from helpers import quick
from mixed_scenes import mixed_of
from soups import soup_of

import rts
from benchmarks.accuracy import area_rule
from rts.arrays.trees import leaves
from rts.outlines import stacks, stencil_loops
from rts.splatting.layers import composites
from rts.splatting.stencil import splat

pytestmark = pytest.mark.splatting

OPAQUE = [number for number in range(60) if number % 4 == 3]


def sampled(parts, camera, size, **options):
    """Samples, and the outlines and cells that their stencil was made from."""
    with noted() as found, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        whole = rts.sample(parts, camera, size, **options)
    return whole, *found[-1]


def mixed(number):
    scene = mixed_of(number)
    return sampled(scene.parts, scene.cameras[0], scene.size, layers=scene.layers, supersample=scene.supersample)


@pytest.mark.parametrize("number", quick(range(12)))
def test_bands_of_lines_have_the_entries_of_the_whole(number, monkeypatch):
    monkeypatch.setattr(stencil_loops, "BANDS", 1)
    whole, *_ = mixed(number)
    monkeypatch.setattr(stencil_loops, "BANDS", 8)
    monkeypatch.setattr(stencil_loops, "SEGMENTS", 3)
    banded, *_ = mixed(number)
    for expected, found in zip(leaves(whole.stencil), leaves(banded.stencil), strict=True):
        np.testing.assert_array_equal(found, expected)


def weights_of(stencil, at_centres):
    """The weights (H · W, M) of colours."""
    count = max(int(stencil.color_sample.max(initial=0)), int(at_centres.max(initial=0))) + 1
    weights = np.zeros((at_centres.size, count))
    weights[np.flatnonzero(at_centres.reshape(-1) >= 0), at_centres[at_centres >= 0]] = 1
    np.add.at(weights, (stencil.color_cell, stencil.color_sample), stencil.color_weight)
    return weights


@pytest.mark.parametrize("number", quick(OPAQUE))
def test_areas_are_those_of_polygons(number):
    """Part by part: what a region takes of samples farther inside is of the same part."""
    whole, outlines, row = mixed(number)
    stencil, at_centres = whole.stencil, row[0]
    owners = np.repeat(np.arange(len(whole.samples)), [len(one.ids) for one in whole.samples])
    weights = weights_of(stencil, at_centres)
    parts = np.stack([weights[:, owners[: weights.shape[1]] == part].sum(1) for part in range(len(whole.samples))], 1)
    rows, inner = outlines.rows[:, :2], outlines.rows[:, 2:4]
    shown = np.where((rows >= 0) & (inner >= 0), inner, rows)
    cells = np.unique(stencil.color_cell)
    assert len(cells) > 5 or len(outlines.place) < 5
    for cell in cells:
        place = divmod(int(cell), at_centres.shape[1])
        expected = np.zeros(len(whole.samples))
        for sample, weight in area_rule.areas(outlines, shown, at_centres, place).items():
            if sample >= 0:
                expected[owners[sample]] += weight
        np.testing.assert_allclose(parts[cell], expected, atol=2e-6, err_msg=str(place))


@pytest.mark.parametrize("number", quick(OPAQUE))
def test_boundary_terms_are_those_of_rays(number):
    """Flat parts change by jumps at outlines alone."""
    whole, outlines, row = mixed(number)
    stencil, at_centres, rng = whole.stencil, row[0], np.random.default_rng(number)
    owners = np.repeat(np.arange(len(whole.samples)), [len(one.ids) for one in whole.samples])
    colors, moves = rng.random(len(whole.samples)), rng.normal(size=(len(owners), 2))
    of = np.append(colors[owners], 0.0)
    jump = of[stencil.motion_colors[:, 0]] - of[stencil.motion_colors[:, 1]]
    found = np.zeros(at_centres.size)
    rates = (stencil.motion_weight[:, :2] * moves[stencil.motion_sample]).sum(1)
    np.add.at(found, stencil.motion_cell, rates * jump)
    # A crossing moves as the sample of the surface that ends there.
    rows, kind = outlines.rows, outlines.kind
    intersect = kind == 2
    ending = rows[np.arange(len(kind)), np.minimum(kind, 1)]
    checked = 0
    for cell in np.unique(stencil.motion_cell):
        expected, known = 0.0, True
        place = divmod(int(cell), at_centres.shape[1])
        for (endpoint, mover), terms in area_rule.boundary_terms(outlines, place).items():
            known &= not intersect[mover] and ending[mover] >= 0
            before, behind = of[rows[endpoint, 0]], of[rows[endpoint, 1]]
            expected += float(terms @ moves[ending[mover]]) * (before - behind)
        if known:
            np.testing.assert_allclose(found[cell], expected, atol=1e-5, err_msg=str(cell))
            checked += 1
    assert checked > 5 or len(outlines.place) < 5


@pytest.mark.parametrize("kind", ["mixed", "soup"])
@pytest.mark.parametrize("first", quick(range(0, 700, 35)))
def test_weights_are_convex_and_images_in_the_range_of_colours(kind, first):
    """Also where many outlines meet: alpha and colours are means of what is seen."""
    for number in range(first, first + 35, 5):
        if kind == "mixed":
            whole, _, row = mixed(number)
        else:
            soup = soup_of(number)
            part = rts.Part(rts.Mesh(soup.faces), {"vertices": soup.vertices}, "silhouette", cull=soup.cull)
            whole, _, row = sampled(part, soup.camera, soup.size)
        stencil, at_centres = whole.stencil, row[0]
        count = sum(len(one.ids) for one in whole.samples)
        rng = np.random.default_rng(number)
        rgba = rng.random((count, 4)).astype(stencil.color_weight.dtype)
        rgba[:, :3] *= rgba[:, 3:]
        positions = np.zeros((count, 3), rgba.dtype)
        if stencil.stacks is not None:
            rgba, at_centres, _ = composites(positions, rgba, row, stencil)
        weights = weights_of(stencil, np.asarray(at_centres))
        assert weights.min(initial=0) >= -1e-6 and weights.sum(1).max(initial=0) <= 1 + 1e-6, number
        image = splat(positions, rgba, np.asarray(at_centres), stencil, 0)
        assert image.min(initial=0) > -1e-6 and (image <= rgba.max(0, initial=0) + 1e-6).all(), number


def test_a_pixel_that_an_edge_halves_has_half_of_each_side():
    """A half-plane whose edge runs upright through the centres of a column of pixels."""
    vertices = np.array([(-9, -9, 0), (0, -9, 0), (0, 9, 0), (-9, 9, 0)], np.float32)
    part = rts.Part(rts.Mesh([(0, 1, 2), (0, 2, 3)]), {"vertices": vertices}, "silhouette")
    camera = rts.Camera.orthographic((0, 0, 3), (0, 0, 0), height=9.0)
    stencil, at_centres = (whole := rts.sample(part, camera, (9, 9))).stencil, whole.row[0]
    inside = slice(whole.border, whole.border + 9)
    weights = weights_of(stencil, at_centres).sum(1).reshape(at_centres.shape)[inside, inside]
    np.testing.assert_allclose(weights, np.repeat([[1, 1, 1, 1, 0.5, 0, 0, 0, 0]], 9, 0), atol=1e-6)


class Pane(rts.Shader):
    """Glass of one colour, θ["color"] (4,)."""

    def __call__(self, theta, gbuffer, camera):
        return np.broadcast_to(theta["color"], (len(gbuffer["position"]), 4))


def test_many_panes_that_cross_in_a_line_need_no_room_that_is_known_before(monkeypatch):
    """Twenty panes around one upright line pass through one another there, each through all others."""
    count, vertices, faces = 20, [], []
    for n in range(count):
        angle = np.pi * (n + 0.5) / count
        away = np.array([np.sin(angle), 0, np.cos(angle)])
        vertices += [-away + [0.02, -1, 0], away + [0.02, -1, 0], away + [0.02, 1, 0], -away + [0.02, 1, 0]]
        faces += [[4 * n, 4 * n + 1, 4 * n + 2], [4 * n, 4 * n + 2, 4 * n + 3]]
    theta = {"vertices": np.array(vertices, np.float32), "color": np.array([0.1, 0.05, 0.02, 0.1], np.float32)}
    part, camera = (
        rts.Part(rts.Mesh(np.array(faces)), theta, Pane()),
        rts.Camera.look_at((0, 0, 4), (0, 0, 0), fov_y=20),
    )
    found = []
    for room in (1, 2, 50):
        monkeypatch.setattr(stacks, "ROOM", room)
        found.append(rts.sample(part, camera, (8, 8), layers=count).stencil)
    crossings = count * (count - 1) // 2
    assert len(found[0].stacks) > 2 * 8 * crossings  # In each line of pixels, and a stack before and behind each.
    for other in found[1:]:
        for name in ("color_cell", "color_weight", "motion_cell", "motion_weight", "stacks"):
            np.testing.assert_array_equal(getattr(found[0], name), getattr(other, name))
