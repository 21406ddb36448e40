"""Several samples a pixel: the average of the finer image, rendered in bands of bounded memory."""

import tracemalloc

import numpy as np
import pytest
from helpers import ALL, DIFFERENTIABLE, TORCH, arrays, derivative, gradient, icosphere, quad, to_numpy

import rts
from rts.rendering import settings
from rts.splatting import Edges

pytestmark = pytest.mark.splatting

MESH = rts.plugin("rts.surfaces", "mesh")
CAMERA = rts.Camera.look_at((0.2, 0.1, 3.0), (0, 0, 0))
SIZE = (10, 12)
CORNERS, FACES = np.array([(-1, -1, 0), (1, -0.8, 0.3), (0.1, 1, -0.2)]), np.array([(0, 1, 2)])
RGB = np.array([(1, 0.2, 0), (0, 1, 0.3), (0.1, 0, 1)])


def image(vertices, supersample, size=SIZE, **options):
    part = rts.Part(MESH(FACES), {"vertices": vertices, "colors": RGB}, "unlit")
    return rts.render(part, CAMERA, size, supersample=supersample, **options)


def averaged(fine, s):
    height, width = fine.shape[0] // s, fine.shape[1] // s
    return fine.reshape(height, s, width, s, 4).mean(axis=(1, 3))


@pytest.fixture
def narrow_bands(monkeypatch):
    """Bands of a few rows."""
    monkeypatch.setattr(settings, "BAND", 1000)


@pytest.mark.parametrize("target", ALL)
@pytest.mark.parametrize("s", [2, 3])
def test_a_pixel_is_the_average_of_its_samples(target, s):
    vertices = arrays(target, CORNERS)
    fine = to_numpy(image(vertices, 1, (s * SIZE[0], s * SIZE[1])))
    np.testing.assert_allclose(to_numpy(image(vertices, s)), averaged(fine, s), rtol=0, atol=1e-6)


@pytest.mark.parametrize("target", ALL)
def test_bands_make_no_difference_to_the_image(target, narrow_bands, monkeypatch):
    assert len(settings.RenderSettings(None, 2, 3, None).bands(SIZE)) == 3
    vertices, background = arrays(target, (CORNERS, np.random.default_rng(0).random((*SIZE, 3))))
    found = to_numpy(image(vertices, 3, background=background))
    monkeypatch.undo()
    assert len(settings.RenderSettings(None, 2, 3, None).bands(SIZE)) == 1
    np.testing.assert_allclose(found, to_numpy(image(vertices, 3, background=background)), rtol=0, atol=2e-5)


@pytest.mark.parametrize("target", DIFFERENTIABLE)
def test_bands_make_no_difference_to_derivatives(target, monkeypatch):
    vertices, weights = arrays(target, (CORNERS, np.random.default_rng(1).normal(size=(*SIZE, 4))))

    def loss(v):
        return (image(v, 2) * weights).sum()

    found = {}
    for band in (2**20, 500):
        monkeypatch.setattr(settings, "BAND", band)
        slope = derivative(target, loss, vertices, arrays(target, np.ones((3, 3))))[1]
        found[band] = gradient(target, loss, vertices), slope
        np.testing.assert_allclose(found[band][0].sum(), slope, rtol=1e-3)
    for whole, banded in zip(*found.values(), strict=True):
        np.testing.assert_allclose(banded, whole, rtol=1e-3, atol=1e-3)


def test_gradients_shade_each_band_again_instead_of_keeping_it(narrow_bands):
    calls = []

    class Counting(Edges):
        def image(self, splats):
            calls.append(splats.row.shape)
            return super().image(splats)

    bands = len(settings.RenderSettings(None, 1, 3, None).bands(SIZE))
    assert bands > 1
    gradient(TORCH[0], lambda v: image(v, 3, splatter=Counting()).sum(), arrays(TORCH[0], CORNERS))
    assert len(calls) == 2 * bands


def memory(render, size=(32, 32), s=16):
    """Bytes of arrays, at most and at the end, of a render with s² samples a pixel; what torch itself allots aside."""
    kept = render(s, size)
    tracemalloc.start()
    kept = render(s, size)
    current, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    del kept
    return current, peak


def test_memory_is_bounded_by_the_bands(monkeypatch):
    _, whole = memory(lambda s, size: image(CORNERS, s, size))
    monkeypatch.setattr(settings, "BAND", 2**15)
    _, banded = memory(lambda s, size: image(CORNERS, s, size))
    assert banded < 0.3 * whole


def test_between_forward_and_backward_bands_keep_next_to_nothing(monkeypatch):
    vertices = arrays(TORCH[0], CORNERS).requires_grad_(True)
    whole, _ = memory(lambda s, size: image(vertices, s, size))
    monkeypatch.setattr(settings, "BAND", 2**15)
    banded, _ = memory(lambda s, size: image(vertices, s, size))
    assert banded < 0.35 * whole  # What is left is the image itself, and the graph of each band.


@pytest.mark.parametrize("splatter", ["multi", "edges"])
def test_bands_of_a_closed_surface_have_no_seams(splatter, monkeypatch):
    vertices, faces = icosphere(1)
    part = rts.Part(MESH(faces), {"vertices": vertices, "colors": (vertices + 1) / 2}, "unlit")
    found = []
    for band in (2**30, 2**11):
        monkeypatch.setattr(settings, "BAND", band)
        found.append(rts.render(part, CAMERA, (24, 24), supersample=4, splatter=splatter, layers=3))
    assert len(settings.RenderSettings(None, 3, 4, None).bands((24, 24))) > 8
    np.testing.assert_allclose(found[1], found[0], rtol=0, atol=1e-6)


@pytest.mark.parametrize("opaque", [True, False])
def test_every_window_shows_its_rectangle_of_the_image_where_outlines_turn_within_two_pixels(opaque):
    """A polygon with corners about every 2 pixels, of which a window's border cuts some."""
    turn = 2 * np.pi * np.arange(24) / 24
    radius = np.random.default_rng(0).uniform(0.6, 0.9, 24)[:, None]
    corners = np.concatenate([np.zeros((1, 3)), radius * np.stack([np.cos(turn), np.sin(turn), 0 * turn], 1)])
    i = np.arange(24)
    faces, rgba = (
        np.stack([0 * i, i + 1, (i + 1) % 24 + 1], 1),
        np.tile([1.0, 0.5, 0.2, 1.0 if opaque else 0.5], (25, 1)),
    )
    shader = rts.plugin("shaders", "unlit")(opaque=opaque)
    part, size = rts.Part(MESH(faces), {"vertices": corners, "colors": rgba}, shader), (20, 20)
    whole = rts.render(part, CAMERA, size)
    assert whole[..., 3].max() > 0.4
    for first in range(4, 15):
        for rows, columns in ((slice(first, first + 2), slice(0, 20)), (slice(0, 20), slice(first, first + 2))):
            corner, extent = (rows.start, columns.start), (rows.stop - rows.start, columns.stop - columns.start)
            window = rts.render(part, CAMERA.window(size, corner, extent), extent)
            np.testing.assert_allclose(window, whole[rows, columns], rtol=0, atol=1e-5)


def test_shaders_see_the_camera_of_the_whole_image(monkeypatch):
    def where(theta, gbuffer, camera):
        xp = rts.namespace(gbuffer["position"])
        pixels = camera.project(gbuffer["position"], (1, 1))[:, :2]
        return xp.concat([pixels, pixels[:, :1] * 0, pixels[:, :1] * 0 + 1], axis=1)

    part = rts.Part(MESH(FACES), {"vertices": CORNERS}, where)
    found = []
    for band in (2**30, 500):
        monkeypatch.setattr(settings, "BAND", band)
        found.append(rts.render(part, CAMERA, SIZE, supersample=2))
    np.testing.assert_allclose(found[1], found[0], rtol=0, atol=1e-9)


@pytest.mark.parametrize("target", DIFFERENTIABLE)
def test_a_background_has_its_gradient_over_bands_of_constants(target, narrow_bands):
    background = arrays(target, np.random.default_rng(0).random((*SIZE, 3)))
    found = gradient(target, lambda b: image(CORNERS, 3, background=b).sum(), background)
    alpha = image(CORNERS, 3)[..., 3:]
    np.testing.assert_allclose(found, np.broadcast_to(1 - alpha, found.shape), atol=1e-5)


def test_sampled_knows_its_samples_a_pixel():
    part = rts.Part(MESH(FACES), {"vertices": CORNERS, "colors": RGB}, "unlit")
    sampled = rts.sample(part, CAMERA, SIZE, supersample=2)
    assert sampled.row.shape == (1, *(2 * n + 2 * sampled.border for n in SIZE)) and sampled.supersample == 2
    np.testing.assert_array_equal(rts.render_samples(sampled, part, CAMERA), image(CORNERS, 2))


@pytest.mark.parametrize("target", DIFFERENTIABLE)
@pytest.mark.parametrize("s", [1, 2, 4])
def test_an_edge_is_felt_whole_at_any_number_of_samples(target, s):
    # A world unit is a pixel: as the card moves by one, each row's alpha grows by one at the right edge.
    vertices, faces = quad(-100, 0.3, -100, 100)
    camera = rts.Camera.orthographic((0, 0, 10), (0, 0, 0), height=16)
    along_x = arrays(target, np.broadcast_to([1.0, 0, 0], vertices.shape))

    def alpha(v):
        return rts.render(rts.Part(MESH(faces), {"vertices": v}), camera, (16, 16), supersample=s)[..., 3]

    _, slope = derivative(target, alpha, arrays(target, vertices), along_x)
    np.testing.assert_allclose(slope.sum(axis=1), 1, atol=2e-3)


def test_coverage_of_an_edge_is_the_area_at_any_number_of_samples():
    vertices, faces = quad(-100, 0.3, -100, 100)
    camera = rts.Camera.orthographic((0, 0, 10), (0, 0, 0), height=16)
    part, area = rts.Part(MESH(faces), {"vertices": vertices}), np.clip(8.3 - np.arange(16), 0, 1)
    for s in (1, 4):
        np.testing.assert_allclose(rts.render(part, camera, (16, 16), supersample=s)[8, :, 3], area, atol=1e-6)


@pytest.mark.parametrize("wrong", [0, -1, 1.5, True, "2", None])
def test_other_numbers_of_samples_are_refused(wrong):
    with pytest.raises(rts.InputError, match="supersample is .*; expected an integer of at least 1"):
        image(CORNERS, wrong)


def test_a_splatter_may_average_the_cells_of_pixels_itself():
    """As `edges` does; all others give cells."""

    class Averaging(rts.plugin("splatters", "none")):
        def cropped(self, splats):
            assert splats.supersample == 2
            return averaged(super().cropped(splats), 2)

    expected = image(CORNERS, 2, splatter="none")
    np.testing.assert_allclose(image(CORNERS, 2, splatter=Averaging()), expected, atol=1e-6)
    cells = rts.plugin("splatters", "edges").image
    by_cells = type("ByCells", (Edges,), {"image": lambda self, splats: cells(self, splats)})()
    np.testing.assert_allclose(image(CORNERS, 2, splatter=by_cells), image(CORNERS, 2), atol=1e-6)
