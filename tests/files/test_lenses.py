"""Lenses: distortion against its formulas, pictures undistorted, and where they are defined."""

import json

import numpy as np
import pytest
from helpers import rotation
from posed import MODELS, SIZE, bent, save, straight, text_model

import rts
from rts import InputError
from rts.files.views.lenses import Lens, undistorted

pytestmark = pytest.mark.files

HEIGHT, WIDTH = SIZE
CURVED = [model for model in MODELS if "PINHOLE" not in model]
ROTATION, TRANSLATION = rotation((0.2, 1, 0.1), 20), np.array([0.3, -0.2, 0.5])


def wave(x, y):
    """A smooth picture, given camera coordinates over depth."""
    return 0.5 + 0.4 * np.sin(9 * x + 1) * np.cos(8 * y)


def pixels():
    """x and y, pixels, of the centres of all pixels."""
    return np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)


def colmap(folder, model, parameters=None, picture=None):
    """The views of a data set of one picture."""
    parameters = MODELS[model][1] if parameters is None else parameters
    save(folder / "images/a.png", np.zeros(SIZE) if picture is None else picture)
    cameras = {1: (model, SIZE, parameters)}
    text_model(folder / "sparse/0", cameras, [(1, ROTATION, TRANSLATION, 1, "a.png", [])])
    return rts.load_views(folder, split="all", linear=False)


@pytest.mark.parametrize("model", MODELS)
def test_points_are_seen_where_the_formulas_say(tmp_path, model):
    (view,) = colmap(tmp_path, model)
    x, y = np.random.default_rng(0).uniform(-0.6, 0.6, (2, 50))
    local = np.stack([x, y, np.ones_like(x)], axis=1) * np.linspace(1, 5, 50)[:, None]
    seen = view.camera.project((local - TRANSLATION) @ ROTATION, view.size)
    np.testing.assert_allclose(seen[:, 2], local[:, 2], rtol=1e-12)
    lens = view.lens or Lens(*([MODELS[model][1][0]] * ("SIMPLE" in model)), *MODELS[model][1])
    expected = bent(model, MODELS[model][1], x, y)
    np.testing.assert_allclose(lens.distorted(seen[:, 0], seen[:, 1]), expected, atol=1e-3)
    assert (view.lens is None) == (model not in CURVED) == (view.mask is None)
    moved = np.abs(np.stack(expected, axis=1) - seen[:, :2]).max()
    assert moved > 1 if model in CURVED else moved < 1e-9


@pytest.mark.parametrize("model", CURVED)
def test_a_picture_that_is_distorted_and_undistorted_is_that_of_a_pinhole(tmp_path, model):
    parameters = MODELS[model][1]
    (view,) = colmap(tmp_path, model, picture=wave(*straight(model, parameters, *pixels())))
    rays = view.camera.rays(view.size).directions @ ROTATION.T
    x, y = rays[..., 0] / rays[..., 2], rays[..., 1] / rays[..., 2]
    u, v = bent(model, parameters, x, y)
    defined = (u >= 0) & (u <= WIDTH) & (v >= 0) & (v <= HEIGHT)
    np.testing.assert_array_equal(view.mask, defined)
    assert defined.all() == (model in ("RADIAL", "OPENCV_FISHEYE", "FULL_OPENCV"))  # Barrels; the others are cushions.
    assert view.mask.dtype == np.float32
    # Bilinear interpolation errs by an eighth of the second derivatives, of both axes, and lenses make these larger.
    # At the rim pixels are repeated.
    bound = 0.4 * (9**2 + 8**2) / 84**2 / 8 * 2
    inner = (u >= 0.5) & (u <= WIDTH - 0.5) & (v >= 0.5) & (v <= HEIGHT - 0.5)
    image = view.image
    assert np.abs(image[..., 0] - wave(x, y))[inner].max() < bound
    # A shift by a tenth of a pixel would be seen.
    assert np.abs(wave(x + 0.1 / 90, y) - wave(x, y))[inner].max() > bound
    assert (image[~defined] == 0).all() and (image[defined][:, 3] == 1).all()


def test_a_lens_that_turns_back_shows_no_place_twice(tmp_path):
    # x (1 - 0.3 r²) grows up to r² = 1 / 0.9, and falls back into the picture beyond.
    parameters = [40.0, 64.0, 48.0, -0.3]
    (view,) = colmap(tmp_path, "SIMPLE_RADIAL", parameters)
    x, y = pixels()
    x, y = (x - 64) / 40, (y - 48) / 40
    u, v = bent("SIMPLE_RADIAL", parameters, x, y)
    inside, beyond = (u >= 0) & (u <= WIDTH) & (v >= 0) & (v <= HEIGHT), x * x + y * y > 1 / 0.9
    assert (inside & beyond).any()
    np.testing.assert_array_equal(view.mask, inside & ~beyond)


@pytest.mark.parametrize(
    "reach, distortion",
    [
        (2, {"k4": -0.25}),  # 1 − r² / 4 under the fraction is 0.
        (2, {"k1": -1 / 12}),  # r − r³ / 12 has its maximum.
        (np.tan(1), {"k4": -1 / 9, "fisheye": True}),  # θ − θ⁹ / 9 has it at θ = 1.
        (np.inf, {"k1": -1 / 12, "fisheye": True}),  # θ − θ³ / 12 has it at θ = 2, behind the camera.
    ],
)
def test_a_lens_reaches_as_far_as_its_polynomials_grow(reach, distortion):
    r = np.array([0.0, 1, 1.55, 1.56, 1.999, 2.001, 50])
    found = Lens(1, 1, 0, 0, **distortion).distorted(r, 0 * r)[0]
    np.testing.assert_array_equal(np.isnan(found), r > reach)


def test_without_distortion_a_picture_stays():
    picture = np.random.default_rng(0).random((5, 7, 4), np.float32)
    found, defined = undistorted(picture, Lens(5, 6, 3.5, 2.5))
    np.testing.assert_allclose(found, picture, atol=1e-6)
    assert found.dtype == defined.dtype == np.float32 and (defined == 1).all()


def test_undistorted_pictures_are_made_smaller_with_their_masks(tmp_path):
    colmap(tmp_path, "OPENCV", picture=wave(*straight("OPENCV", MODELS["OPENCV"][1], *pixels())))
    white = {"linear": False, "split": "all", "background": "white"}
    (whole,), (half,) = rts.load_views(tmp_path, **white), rts.load_views(tmp_path, downscale=2, **white)
    assert (whole.image[whole.mask == 0] == 1).all() and (whole.mask == 0).any()
    for a, b in ((whole.image, half.image), (whole.mask, half.mask)):
        np.testing.assert_allclose(
            b, a.reshape(HEIGHT // 2, 2, WIDTH // 2, 2, -1).mean(axis=(1, 3)).reshape(b.shape), atol=1e-6
        )
    np.testing.assert_allclose(
        half.lens.distorted(20.0, 30.0), np.divide(whole.lens.distorted(40.0, 60.0), 2), rtol=1e-12
    )


# ----------------------------------------------------------------------------------------------------- Blender's JSON


def transforms(folder, tree=None, frame=None, size=SIZE):
    """A file transforms.json of one picture, camera at the origin, and its views."""
    save(folder / "a.png", np.zeros(size))
    entry = {"file_path": "a.png", "transform_matrix": np.eye(4).tolist(), **(frame or {})}
    (folder / "transforms.json").write_text(json.dumps({**(tree or {}), "frames": [entry]}))
    return rts.load_views(folder)


LENS = {"fl_x": 90.0, "fl_y": 84.0, "cx": 61.0, "cy": 50.0, "w": 128, "h": 96}


@pytest.mark.parametrize("factor", [1, 2])
def test_focal_lengths_and_principal_points_of_json_are_followed(tmp_path, factor):
    (view,) = transforms(tmp_path, LENS, size=(96 * factor, 128 * factor))
    points = np.random.default_rng(0).uniform(-1, 1, (9, 3)) - [0, 0, 3]
    depth = -points[:, 2]
    expected = np.stack([61 + 90 * points[:, 0] / depth, 50 - 84 * points[:, 1] / depth, depth / factor], axis=1)
    np.testing.assert_allclose(view.camera.project(points, view.size), factor * expected, rtol=1e-12)
    (width,) = transforms(tmp_path, {k: v for k, v in LENS.items() if k != "h"}, size=(96 * factor, 128 * factor))
    assert width.camera == view.camera
    (frames,) = transforms(tmp_path, {**LENS, "fl_x": 1.0}, LENS, size=(96 * factor, 128 * factor))
    assert frames.camera == view.camera


def test_distortion_of_json_is_followed(tmp_path):
    bent_by = {"k1": -0.12, "k2": 0.03, "p1": 0.004, "p2": -0.006}
    x, y = np.meshgrid(np.linspace(-0.4, 0.4, 5), np.linspace(-0.4, 0.4, 5))
    for tree, model, k in (
        ({**LENS, **bent_by}, "OPENCV", [-0.12, 0.03, 0.004, -0.006]),
        ({**LENS, **bent_by, "k3": 0.02}, "FULL_OPENCV", [-0.12, 0.03, 0.004, -0.006, 0.02, 0, 0, 0]),
        ({**LENS, "camera_model": "OPENCV_FISHEYE", "k1": 0.1, "k4": 0.02}, "OPENCV_FISHEYE", [0.1, 0, 0, 0.02]),
        ({**LENS, "is_fisheye": True, "k1": 0.1}, "OPENCV_FISHEYE", [0.1, 0, 0, 0]),
    ):
        (view,) = transforms(tmp_path, tree)
        found = view.lens.distorted(90 * x + 61, 84 * y + 50)
        np.testing.assert_allclose(found, bent(model, [90, 84, 61, 50, *k], x, y), atol=1e-9)
        assert view.mask.shape == SIZE


@pytest.mark.parametrize(
    "tree, message",
    [
        ({**LENS, "fl_x": -1}, "fl_x = -1; expected a positive number"),
        ({**LENS, "cx": "middle"}, "cx = 'middle'; expected a number"),
        ({**LENS, "k1": [0.1]}, "k1 = [0.1]"),
        ({**LENS, "w": 96}, "has 128 × 96 pixels, and"),
        ({**LENS, "k4": 0.1}, "has k4, which tools take for different things"),
        ({**LENS, "camera_model": "EQUIRECTANGULAR"}, "camera model 'EQUIRECTANGULAR', which is not followed"),
        ({**LENS, "camera_angle_x": 0.3}, "fl_x = 90.0, where camera_angle_x makes it 423"),
        ({**LENS, "mask_path": "m.png"}, "refers to the picture 'm.png'"),
        ({}, "lacks camera_angle_x and fl_x"),
    ],
)
def test_wrong_lenses_of_json_are_refused_in_one_line(tmp_path, tree, message):
    with pytest.raises(InputError) as caught:
        transforms(tmp_path, tree)
    assert message in str(caught.value) and "\n" not in str(caught.value)


# ------------------------------------------------------------------------------------------------------ OpenCV's JSON


def opencv(folder, **changes):
    """A file cameras.json of one picture, and its views."""
    save(folder / "a.png", np.zeros(SIZE))
    view = {
        "image": "a.png",
        "K": [[90, 0, 61], [0, 84, 50], [0, 0, 1]],
        "R": ROTATION.tolist(),
        "t": TRANSLATION.tolist(),
    }
    view = {name: value for name, value in {**view, **changes}.items() if value is not None}
    (folder / "cameras.json").write_text(json.dumps({"views": [view]}))
    return rts.load_views(folder)


def test_json_of_opencv_counts_pixels_from_the_centre_of_the_first(tmp_path):
    points = np.random.default_rng(0).uniform(-1, 1, (9, 3)) + [0, 0, 3]
    local = points @ ROTATION.T + TRANSLATION
    x, y = local[:, 0] / local[:, 2], local[:, 1] / local[:, 2]
    (view,) = opencv(tmp_path, t=TRANSLATION[:, None].tolist())
    expected = np.stack([90 * x + 61 + 0.5, 84 * y + 50 + 0.5, local[:, 2]], axis=1)
    np.testing.assert_allclose(view.camera.project(points, SIZE), expected, rtol=1e-12)
    assert view.mask is None
    for k, model, options in (
        ([-0.12, 0.03, 0.004, -0.006], "OPENCV", {}),
        ([-0.12, 0.03, 0.004, -0.006, 0.02], "FULL_OPENCV", {}),
        ([0.2, 0.05, 0.004, -0.006, 0.01, 0.3, 0.04, 0.002], "FULL_OPENCV", {}),
        ([0.03, -0.01, 0.004, -0.001], "OPENCV_FISHEYE", {"fisheye": True}),
    ):
        (view,) = opencv(tmp_path, distortion=k, width=128, height=96, **options)
        np.testing.assert_allclose(view.camera.project(points, SIZE), expected, rtol=1e-12)
        found = np.stack(view.lens.distorted(expected[:, 0], expected[:, 1]))
        np.testing.assert_allclose(found - 0.5, bent(model, [90, 84, 61, 50, *k], x, y), atol=1e-9)


def test_views_of_opencv_share_what_stands_beside_them(tmp_path):
    (alone,) = opencv(tmp_path, distortion=[0.1, 0, 0, 0])
    tree = json.loads((tmp_path / "cameras.json").read_text())
    tree |= {"K": tree["views"][0].pop("K"), "distortion": tree["views"][0].pop("distortion")}
    (tmp_path / "cameras.json").write_text(json.dumps(tree))
    (shared,) = rts.load_views(tmp_path / "cameras.json")
    assert shared.camera == alone.camera and shared.lens == alone.lens


@pytest.mark.parametrize(
    "changes, message",
    [
        ({"K": None}, "view 0 lacks image or K or R or t"),
        ({"K": [[90, 1, 61], [0, 84, 50], [0, 0, 1]]}, "expected [[fx, 0, cx]"),
        ({"K": [[-90, 0, 61], [0, 84, 50], [0, 0, 1]]}, "fx = -90; expected a positive one"),
        ({"R": np.diag([1, 1, -1]).tolist()}, "mirrors"),
        ({"t": [1, 2]}, "t has shape (2,)"),
        ({"t": [1, 2, "c"]}, "t is [1, 2, 'c']"),
        ({"distortion": [0.1] * 12}, "distortion has shape (12,)"),
        ({"distortion": [0.1] * 5, "fisheye": True}, "distortion has shape (5,)"),
        ({"distortion": 3}, "distortion is 3"),
        ({"fisheye": 1}, "fisheye = 1; expected true or false"),
        ({"image": 3}, "a name of a picture that is 3"),
        ({"image": "b.png"}, "refers to the picture 'b.png'"),
        ({"width": 96}, "another shape"),
        ({"width": -1}, "width = -1; expected pixels"),
        ({"mask": "b.png"}, "refers to the picture 'b.png'"),
    ],
)
def test_wrong_views_of_opencv_are_refused_in_one_line(tmp_path, changes, message):
    with pytest.raises(InputError) as caught:
        opencv(tmp_path, **changes)
    assert message in str(caught.value) and "\n" not in str(caught.value)


# -------------------------------------------------------------------------------------------------------------- masks


def half_white(height=HEIGHT, width=WIDTH):
    """A mask: white on the left, grey (128) on the right."""
    return np.where(np.arange(width) < width // 2, 255, 128)[None].repeat(height, axis=0).astype(np.uint8)


def test_masks_are_pictures_that_files_name(tmp_path):
    expected = half_white().astype(np.float32) / 255
    save(tmp_path / "m.png", half_white())
    (view,) = transforms(tmp_path, LENS, {"mask_path": "m.png"})
    np.testing.assert_allclose(view.mask, expected, atol=1e-6)
    assert view.mask.dtype == np.float32 and view.image.shape == (*SIZE, 4)
    (tmp_path / "transforms.json").unlink()
    (view,) = opencv(tmp_path, mask="m.png")
    np.testing.assert_allclose(view.mask, expected, atol=1e-6)


def test_a_mask_and_an_undistorted_picture_count_where_both_do(tmp_path):
    (bare,) = colmap(tmp_path, "SIMPLE_RADIAL")
    save(tmp_path / "masks/a.png.png", half_white())
    (view,) = rts.load_views(tmp_path, split="all")
    away = np.abs(np.arange(WIDTH) - WIDTH // 2) > 3  # The edge moves by distortion.
    expected = bare.mask * half_white() / 255
    np.testing.assert_allclose(view.mask[:, away], expected[:, away], atol=1e-6)
    assert {0, 1} < set(view.mask[:, away].ravel().tolist())


def test_masks_are_made_smaller_like_pictures(tmp_path):
    text_model(tmp_path, {1: ("PINHOLE", SIZE, MODELS["PINHOLE"][1])}, [(1, ROTATION, TRANSLATION, 1, "a.png", [])])
    save(tmp_path / "images/a.png", np.zeros(SIZE))
    mask = np.random.default_rng(0).integers(0, 256, SIZE, dtype=np.uint8)
    save(tmp_path / "masks/a.png", mask)  # As the picture is called, which COLMAP allows of PNG.
    quarter = (mask / 255).reshape(24, 4, 32, 4).mean(axis=(1, 3))
    options = {"split": "all", "downscale": 4}
    (view,) = rts.load_views(tmp_path, **options)
    np.testing.assert_allclose(view.mask, quarter, atol=1e-6)
    save(tmp_path / "images_4/a.png", np.zeros((24, 32)))
    (view,) = rts.load_views(tmp_path, **options)
    assert view.size == view.mask.shape == (24, 32)
    np.testing.assert_allclose(view.mask, quarter, atol=1e-6)
    save(tmp_path / "masks_4/a.png.png", mask[:24, :32])
    (view,) = rts.load_views(tmp_path, **options)
    np.testing.assert_allclose(view.mask, mask[:24, :32] / 255, atol=1e-6)


def test_masks_may_be_called_as_a_picture_but_for_its_ending_and_others_are_told(tmp_path):
    text_model(tmp_path, {1: ("PINHOLE", SIZE, MODELS["PINHOLE"][1])}, [(1, ROTATION, TRANSLATION, 1, "a.jpg", [])])
    save(tmp_path / "images/a.png", np.zeros(SIZE))
    (tmp_path / "images/a.png").rename(tmp_path / "images/a.jpg")
    save(tmp_path / "masks/mask_a.png", half_white())
    with pytest.warns(
        rts.errors.FileWarning, match=r"none of 1 files of .*masks \(mask_a.png …\) .* such as a.jpg.png"
    ):
        (view,) = rts.load_views(tmp_path, split="all")
    assert view.mask is None
    save(tmp_path / "masks/a.png", half_white())
    (view,) = rts.load_views(tmp_path, split="all")
    np.testing.assert_allclose(view.mask, half_white() / 255, atol=1e-6)


def test_wrong_masks_are_refused_in_one_line(tmp_path):
    save(tmp_path / "m.png", half_white(width=WIDTH + 1))
    with pytest.raises(InputError, match="mask .*m.png has 129 × 96 pixels, and .*a.png 128 × 96"):
        transforms(tmp_path, LENS, {"mask_path": "m.png"})
    save(tmp_path / "m.png", half_white())
    (view,) = transforms(tmp_path, LENS, {"mask_path": "m.png"})
    save(tmp_path / "m.png", half_white(2 * HEIGHT))
    with pytest.raises(InputError, match="128 × 192 pixels, and had 128 × 96 before"):
        _ = view.mask
    (tmp_path / "m.png").write_bytes(b"no picture")
    with pytest.raises(InputError, match="m.png cannot be read as an image"):
        transforms(tmp_path, LENS, {"mask_path": "m.png"})
