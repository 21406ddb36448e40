"""Posed images: cameras and pictures of Blender's and LLFF's data sets."""

import json
import math

import numpy as np
import pytest
from helpers import rotation
from PIL import Image

import rts
from rts import InputError
from rts.files.srgb import decode_srgb

pytestmark = pytest.mark.files

ANGLE = 0.7
HEIGHT, WIDTH = 6, 8


def pose(i=0):
    """A camera-to-world matrix (4, 4)."""
    matrix = np.eye(4)
    matrix[:3, :3] = rotation((0.2, 1, 0.1), 30 * i)
    matrix[:3, 3] = 3 * matrix[:3, 2] + [0.1 * i, 0, 0.2]
    return matrix


def pictures(folder, count, channels=4, size=(HEIGHT, WIDTH)):
    """Random pictures (count, H, W, channels) uint8, written as PNG."""
    folder.mkdir(parents=True, exist_ok=True)
    found = np.random.default_rng(0).integers(0, 256, (count, *size, channels), dtype=np.uint8)
    for i, picture in enumerate(found):
        Image.fromarray(picture).save(folder / f"r_{i}.png")
    return found


def blender(folder, count=3, **changes):
    """A data set of Blender's form: its pictures (count, H, W, 4)."""
    found = pictures(folder / "train", count)
    frames = [{"file_path": f"./train/r_{i}", "transform_matrix": pose(i).tolist()} for i in range(count)]
    write(folder, {"camera_angle_x": ANGLE, "frames": frames, **changes})
    return found


def write(folder, content):
    path = folder / "transforms_train.json"
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    return path


def llff(folder, count=3, factor=1):
    """A data set of LLFF's form, its pictures `factor` times smaller than its poses say."""
    pictures(folder / ("images" if factor == 1 else f"images_{factor}"), count, 3)
    rows = []
    for i in range(count):
        c2w = pose(0.2 * i)
        right, up, back, position = c2w[:3].T
        matrix = np.stack([-up, right, back, position, [HEIGHT * factor, WIDTH * factor, 10.0 * factor]], axis=1)
        rows.append([*matrix.reshape(-1), 2.0 + i, 20.0])
    np.save(folder / "poses_bounds.npy", np.array(rows))
    return np.array(rows)


def test_cameras_of_blender_see_what_nerf_s_rays_do(tmp_path):
    blender(tmp_path)
    focal = 0.5 * WIDTH / math.tan(0.5 * ANGLE)
    for center in (0.0, 0.375, 0.5):
        views = rts.load_views(tmp_path, pixel_center=center)
        assert [v.name for v in views] == ["r_0.png", "r_1.png", "r_2.png"] and views[0].near is None
        for i, view in enumerate(views):
            assert view.size == (HEIGHT, WIDTH)
            rays, c2w = view.camera.rays(view.size), pose(i)
            x, y = np.meshgrid(np.arange(WIDTH) + center, np.arange(HEIGHT) + center)
            local = np.stack([(x - WIDTH / 2) / focal, -(y - HEIGHT / 2) / focal, -np.ones_like(x)], axis=-1)
            np.testing.assert_allclose(rays.directions, local @ c2w[:3, :3].T, atol=1e-12)
            np.testing.assert_allclose(rays.origins[2, 3], c2w[:3, 3], atol=1e-12)


def test_images_are_linear_or_as_they_are_premultiplied_or_on_a_background(tmp_path):
    encoded = blender(tmp_path)[1].astype(np.float32) / 255
    color, alpha = encoded[..., :3], encoded[..., 3:]
    linear = decode_srgb(color)
    white = np.ones(3, np.float32)
    red = np.array([1, 0.5, 0], np.float32)
    for options, expected in (
        ({}, np.concatenate([linear * alpha, alpha], axis=-1)),
        ({"linear": False}, np.concatenate([color * alpha, alpha], axis=-1)),
        ({"background": "white"}, linear * alpha + (1 - alpha) * white),
        ({"background": "white", "linear": False}, color * alpha + (1 - alpha) * white),
        ({"background": [1, 0.5, 0], "linear": False}, color * alpha + (1 - alpha) * red),
        ({"background": "black", "cache": True}, linear * alpha),
    ):
        image = rts.load_views(tmp_path / "transforms_train.json", **options)[1].image
        assert image.dtype == np.float32
        np.testing.assert_allclose(image, expected, atol=1e-6)
        half = rts.load_views(tmp_path, downscale=2, **options)[1]
        assert half.size == (HEIGHT // 2, WIDTH // 2)
        blocks = expected.reshape(HEIGHT // 2, 2, WIDTH // 2, 2, -1)
        np.testing.assert_allclose(half.image, blocks.mean(axis=(1, 3)), atol=1e-6)


def test_smaller_images_are_of_the_same_view(tmp_path):
    blender(tmp_path)
    whole, half = (rts.load_views(tmp_path, downscale=n)[2] for n in (1, 2))
    a, b = (v.camera.rays(v.size).directions for v in (whole, half))
    np.testing.assert_allclose(b, a.reshape(HEIGHT // 2, 2, WIDTH // 2, 2, 3).mean(axis=(1, 3)), atol=1e-12)


def test_images_are_read_when_they_are_needed(tmp_path):
    blender(tmp_path)
    lazy, kept = rts.load_views(tmp_path)[0], rts.load_views(tmp_path, cache=True)[0]
    first = kept.image
    Image.new("RGB", (WIDTH, HEIGHT), (255, 0, 0)).save(tmp_path / "train/r_0.png")
    np.testing.assert_array_equal(lazy.image, np.broadcast_to([1.0, 0, 0, 1], (HEIGHT, WIDTH, 4)))
    assert kept.image is first
    Image.new("RGB", (WIDTH, 2 * HEIGHT)).save(tmp_path / "train/r_0.png")
    with pytest.raises(InputError, match="8 × 12 pixels, and had 8 × 6"):
        _ = lazy.image
    (tmp_path / "train/r_0.png").unlink()
    with pytest.raises(InputError, match="no picture"):
        _ = lazy.image


def test_pictures_that_are_cut_short_are_refused_when_they_are_read(tmp_path):
    blender(tmp_path)
    path = tmp_path / "train/r_0.png"
    path.write_bytes(path.read_bytes()[:60])  # The header is whole.
    for linear in (True, False):
        view = rts.load_views(tmp_path, linear=linear)[0]
        with pytest.raises(InputError, match="cannot be read as an image"):
            _ = view.image
    path.unlink()
    with pytest.raises(InputError, match="no picture"):
        _ = view.image


def test_cameras_of_llff_are_those_of_the_file(tmp_path):
    rows = llff(tmp_path)
    for i, view in enumerate(rts.load_views(tmp_path)):
        c2w, focal = view.camera.to_blender(view.size)
        np.testing.assert_allclose(c2w, pose(0.2 * i), atol=1e-12)
        np.testing.assert_allclose(focal, 10, rtol=1e-12)
        assert (view.near, view.far) == tuple(rows[i, -2:])
        np.testing.assert_allclose([*view.camera.depth_range()], [view.near / 100, view.far * 100], rtol=1e-6)


def test_smaller_pictures_of_llff_have_a_folder(tmp_path):
    llff(tmp_path, factor=4)
    view = rts.load_views(tmp_path / "poses_bounds.npy", downscale=4)[0]
    assert view.size == view.image.shape[:2] == (HEIGHT, WIDTH)
    np.testing.assert_allclose(view.camera.to_blender(view.size)[1], 10, rtol=1e-12)
    with pytest.raises(InputError, match="no folder images"):
        rts.load_views(tmp_path)


def test_the_frame_of_nerf_is_about_the_mean_camera(tmp_path, data):
    rows = llff(tmp_path)
    views = rts.load_views(tmp_path, frame="nerf")
    matrices = np.stack([v.camera.to_blender(v.size)[0] for v in views])
    np.testing.assert_allclose(matrices[:, :3, 3].mean(axis=0), 0, atol=1e-12)
    np.testing.assert_allclose(np.cross(matrices[:, :3, 2].mean(axis=0), [0, 0, 1]), 0, atol=1e-12)
    np.testing.assert_allclose(min(v.near for v in views), 1 / 0.75, rtol=1e-12)
    np.testing.assert_allclose([v.far for v in views], 20 / 1.5, rtol=1e-12)
    assert len(rows) == len(views)
    # The real scene, as the weights of its field expect it.
    fern = np.load(data / "nerf/fern_images_378.npz")
    for file in (tmp_path / "images").iterdir():
        file.unlink()
    np.save(tmp_path / "poses_bounds.npy", fern["poses_bounds"])
    for i, image in enumerate(fern["rgb"]):
        Image.fromarray(image[::54, ::54]).save(tmp_path / f"images/{i:02}.png")
    views = rts.load_views(tmp_path, frame="nerf", linear=False)
    for view, expected in zip(views, fern["c2w"], strict=True):
        np.testing.assert_allclose(view.camera.to_blender(view.size)[0][:3], expected, atol=1e-9)


@pytest.mark.parametrize(
    "change, message",
    [
        ({"camera_angle_x": None}, "lacks camera_angle_x"),
        ({"camera_angle_x": "wide"}, "has a camera_angle_x of 'wide'"),
        ({"camera_angle_x": 3.2}, "has a camera_angle_x of 3.2"),
        ({"frames": []}, "has no frames"),
        ({"frames": {"a": 1}}, "frames that are no list"),
        ({"frames": [{"file_path": "train/r_0"}]}, "frame 0 lacks file_path or transform_matrix"),
        ({"frames": [{"file_path": 3, "transform_matrix": pose().tolist()}]}, "a name of a picture that is 3"),
        ({"frames": [{"file_path": "train/r_9", "transform_matrix": pose().tolist()}]}, "no such file"),
        ({"frames": [{"file_path": "../r_0", "transform_matrix": pose().tolist()}]}, "outside its own folder"),
        ({"frames": [{"file_path": "train/r_0", "transform_matrix": (2 * pose()).tolist()}]}, "no rotation"),
        ({"frames": [{"file_path": "train/r_0", "transform_matrix": np.diag([1, 1, -1, 1]).tolist()}]}, "mirrors"),
        ({"frames": [{"file_path": "train/r_0", "transform_matrix": [[1, 0], [0, 1]]}]}, "has shape"),
        ({"frames": [{"file_path": "train/r_0", "transform_matrix": [[math.nan] * 4] * 4}]}, "finite"),
        ({"frames": [{"file_path": "train/r_0", "transform_matrix": "eye"}]}, "the matrix is 'eye'"),
        ({"fl_x": 100.0}, "fl_x = 100.0"),
        ({"fl_x": 10**400}, "fl_x = inf; expected a positive number"),
        ({"fl_x": 5e-324, "camera_angle_x": None}, "fx = 4.94066e-324; expected a positive one, in pixels"),
        ({"camera_angle_x": 5e-324}, "between 0 and π"),
        ({"w": 5e-324}, "expected"),
        ({"k1": 1e300}, "k1 = 1e+300; expected a finite one, up to 1e+09"),
        ({"is_fisheye": "x"}, "frame 0 has is_fisheye = 'x'; expected true or false"),
        ({"is_fisheye": 0}, "is_fisheye = 0"),
        ({"frames": [{"file_path": "\ud800", "transform_matrix": pose().tolist()}]}, "no file can be called"),
        ({"frames": [{"file_path": "a\nb", "transform_matrix": pose().tolist()}]}, r"nor a\nb.png"),
        ({"frames": [{"file_path": "train/r_0", "transform_matrix": (1e300 * pose()).tolist()}]}, "up to 1e+18"),
    ],
)
def test_wrong_files_of_blender_are_refused_in_one_line(tmp_path, change, message):
    blender(tmp_path, **change)
    refused(message, tmp_path)


def test_a_fisheye_is_told_by_its_flag_or_not_at_all(tmp_path):
    blender(tmp_path)
    tree = json.loads((tmp_path / "transforms_train.json").read_text())
    for flag, is_fisheye in ((True, True), (False, False), (None, False)):
        write(tmp_path, {**tree, "is_fisheye": flag})
        assert (rts.load_views(tmp_path)[0].lens is not None) == is_fisheye


def test_a_coefficient_that_is_next_to_nothing_bends_nothing(tmp_path):
    images = []
    for least in (0.0, 5e-324):
        blender(tmp_path, camera_model="OPENCV", k1=-0.1, k3=least)
        images.append([view.image for view in rts.load_views(tmp_path)])
    np.testing.assert_array_equal(*images)


def refused(message, *args, **options):
    with pytest.raises(InputError) as caught:
        rts.load_views(*args, **options)
    assert message in str(caught.value) and "\n" not in str(caught.value)


def test_damaged_files_are_refused_in_one_line(tmp_path):
    refused("has none of", tmp_path)
    refused("there is no file", tmp_path / "nothing.json")
    blender(tmp_path)
    whole = (tmp_path / "transforms_train.json").read_text()
    for content, message in ((whole[:100], "is no JSON"), ("[1, 2]", "holds a list"), ("[" * 100_000, "is no JSON")):
        write(tmp_path, content)
        refused(message, tmp_path)
    (tmp_path / "transforms_train.json").write_bytes(b"\xff\xfe\x00\xd8")
    refused("is no JSON", tmp_path)
    write(tmp_path, whole)
    (tmp_path / "train/r_1.png").write_bytes(b"no picture")
    refused("cannot be read as an image", tmp_path)
    (tmp_path / "views.txt").write_text(whole)
    refused("no file of cameras", tmp_path / "views.txt")
    llff(tmp_path)
    refused("give the path of one", tmp_path)


def test_wrong_files_of_llff_are_refused_in_one_line(tmp_path):
    rows = llff(tmp_path)
    path = tmp_path / "poses_bounds.npy"
    wrong = {}
    wrong["shape (3, 16)"] = rows[:, :16]
    wrong["shape (0, 17)"] = rows[:0]
    wrong["NaN"] = np.where(np.arange(17) == 3, np.nan, rows)
    wrong["2 poses, but"] = rows[:2]
    wrong["bounds 20 and 2"] = np.concatenate([rows[:, :15], rows[:, [16]], rows[:, [15]]], axis=1)
    wrong["no rotation"] = np.where(np.arange(17) == 0, 3.0, rows)
    wrong["focal length -10"] = np.where(np.arange(17) == 14, -10.0, rows)
    wrong["another shape"] = np.where(np.arange(17) == 4, 20.0, rows)
    wrong["dtype <U"] = rows.astype(str)
    for message, array in wrong.items():
        np.save(path, array)
        refused(message, tmp_path)
    np.save(path, np.array([{"pickled": 1}]), allow_pickle=True)
    refused("without pickles", tmp_path)
    np.save(path, rows)
    path.write_bytes(path.read_bytes()[:200])
    refused("is no array of numbers", tmp_path)


@pytest.mark.parametrize(
    "options, message",
    [
        ({"downscale": 0}, "downscale is 0"),
        ({"downscale": 4}, "no multiples of downscale = 4"),
        ({"background": "mauve"}, "'mauve'"),
        ({"background": [1, 2]}, "background has shape"),
        ({"background": [1, 2, 0]}, "from 0 to 1"),
        ({"pixel_center": "left"}, "pixel_center is 'left'"),
        ({"frame": "world"}, "frame is 'world'"),
        ({"split": 3}, "split is 3"),
        ({"split": "test"}, "has none of"),
        ({"linear": "yes"}, "linear is 'yes'"),
        ({"near": -1}, "near is -1"),
        ({"near": 5, "far": 2}, "near"),
    ],
)
def test_wrong_arguments_are_refused_in_one_line(tmp_path, options, message):
    blender(tmp_path)
    refused(message, tmp_path, **options)
