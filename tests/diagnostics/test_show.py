"""rts.show: pictures of images, parts and fits, as notebooks ask for them."""

import io
import sys

import numpy as np
import pytest
from PIL import Image

import rts
from rts.diagnostics.notebooks import SIZE
from rts.scene.default_camera import default_camera

pytestmark = pytest.mark.rendering

PART = rts.Revolution.example()


def pixels(shown):
    return np.asarray(Image.open(io.BytesIO(shown._repr_png_())))


@pytest.mark.parametrize("channels", [1, 3, 4])
def test_an_image_is_shown_as_it_is_saved(channels, tmp_path):
    image = np.random.default_rng(0).uniform(0, 1, (6, 5, channels))
    rts.save_image(tmp_path / "a.png", image)
    assert (tmp_path / "a.png").read_bytes() == rts.show(image)._repr_png_()


def test_depths_normals_and_numbers_of_parts_are_scaled():
    depth = np.array([[0.0, 2, 4], [4, 2, 0]])[..., None]
    np.testing.assert_array_equal(pixels(rts.show(depth)), pixels(rts.show(depth / 4)))
    normal = np.array([[-1.0, 0, 1], [0, 1, -1]])[..., None] * np.ones(3)
    np.testing.assert_array_equal(pixels(rts.show(normal)), pixels(rts.show((normal + 1) / 2)))
    assert list(pixels(rts.show(np.array([[-1, 0], [1, 1]], np.int32)[..., None])).ravel()[[0, 3]]) == [0, 255]


def test_parts_are_seen_whole_and_may_have_gradients():
    torch = pytest.importorskip("torch")
    image = rts.render(PART, default_camera([PART], SIZE), SIZE)
    expected = rts.show(image).png
    theta = {"radii": torch.tensor(PART.theta["radii"], requires_grad=True)}
    prepared = rts.prepare(PART, camera=default_camera([PART], SIZE), size=SIZE)
    for thing in (PART, [PART], prepared, PART.replace(theta=theta)):
        assert rts.show(thing).png == expected
    alpha = pixels(rts.show(PART))[..., 3]
    assert alpha.max() == 255 and alpha[[0, -1]].max() == alpha[:, [0, -1]].max() == 0


def test_a_fit_is_shown_by_its_losses(monkeypatch):
    pytest.importorskip("matplotlib")
    fit = rts.results.Fit({}, 0.1, [2.0, 1.0, 0.5, 0.1], 4, "done", 1.0, (2, 2), [])
    assert len(np.unique(pixels(rts.show(fit)).reshape(-1, 4), axis=0)) > 10
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    with pytest.raises(rts.errors.PluginError, match=r"needs matplotlib: pip install .*\[plots\]"):
        rts.show(fit)


@pytest.mark.parametrize(
    ("thing", "expected"),
    [
        (3, "int cannot be shown; expected an image, parts"),
        ([], "list cannot be shown"),
        (np.zeros((2, 2, 2)), r"shape \(2, 2, 2\)"),
        (np.zeros((2, 2, 4), np.uint8), "dtype uint8"),
        (np.full((2, 2), np.nan), "NaN or infinite"),
    ],
)
def test_what_is_no_picture_is_refused(thing, expected):
    with pytest.raises(rts.InputError, match=expected):
        rts.show(thing)


def test_an_image_is_laid_half_transparent_over_the_picture_that_it_is_fitted_to():
    image = np.zeros((2, 2, 4), np.float32)
    image[0] = [0.4, 0.0, 0.2, 1.0]
    picture = np.full((2, 2, 3), 0.6, np.float32)
    mixed = picture.copy()
    mixed[0] = [0.5, 0.3, 0.4]
    assert rts.show(image, over=picture).png == rts.show(mixed).png
    for wrong in (picture[:1], picture[..., :1], [PART], 3.0):
        with pytest.raises(rts.InputError, match="over a picture|laid over|the image"):
            rts.show(image, over=wrong)
    with pytest.raises(rts.InputError, match="over a picture|laid over|the image"):
        rts.show(PART, over=picture)
