"""Posed images of COLMAP's models, and cameras of views saved."""

import json
import struct

import numpy as np
import pytest
from helpers import rotation
from posed import MODELS, SIZE, binary_model, save, text_model

import rts
from rts import Camera, InputError

pytestmark = pytest.mark.files

WRITERS = {"binary": binary_model, "text": text_model}
CAMERAS = {3: ("PINHOLE", SIZE, MODELS["PINHOLE"][1]), 8: ("OPENCV", SIZE, MODELS["OPENCV"][1])}


def images(count):
    """Images of a model, with numbers and names in different orders; some have keypoints."""
    listed = []
    for i in range(count):
        turn, place = rotation((0.2, 1, 0.1), 5 * i - 20), np.array([0.1 * i, -0.2, 4.0])
        keypoints = [(1.5, 2.5), (3.25, 4.0)] if i % 2 else []
        listed.append((20 - i, turn, place, 8 if i == 1 else 3, f"cam/IMG {i:02}.png", keypoints))
    return listed[::-1]


POINTS = [((0.1 * i, 0.3, 0.02 * i * i), [20 - j for j in range(i % 4)]) for i in range(30)]
POINTS.append(((0, 0, -50.0), [20]))  # A wrong one, behind the camera.


def data_set(folder, write=binary_model, count=10, model="sparse/0", size=SIZE, **options):
    """A data set whose pictures are black."""
    listed = images(count)
    write(folder / model, options.get("cameras", CAMERAS), listed, POINTS)
    for *_, name, _ in listed:
        save(folder / "images" / name, np.zeros(size))
    return listed


def refused(message, *args, **options):
    with pytest.raises(InputError) as caught:
        rts.load_views(*args, **options)
    assert message in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize("model", ["sparse/0", "sparse", "."])
@pytest.mark.parametrize("form", WRITERS)
def test_cameras_of_models_see_what_opencv_s_equation_says(tmp_path, form, model):
    listed = data_set(tmp_path, WRITERS[form], model=model)
    views = rts.load_views(tmp_path, split="all")
    by_name = {name: entry for *entry, name, _ in listed}
    assert [v.name for v in views] == sorted(by_name)
    points = np.random.default_rng(0).uniform(-1, 1, (9, 3))
    for i, view in enumerate(views):
        number, turn, place, _ = by_name[view.name]
        local = points @ turn.T + place
        x, y = local[:, 0] / local[:, 2], local[:, 1] / local[:, 2]
        expected = np.stack([90 * x + 63, 84 * y + 49.5, local[:, 2]], axis=1)
        np.testing.assert_allclose(view.camera.project(points, SIZE), expected, rtol=1e-9)
        assert view.image.shape == (*SIZE, 4) and (view.lens is not None) == (i == 1)
        depths = np.array([turn[2] @ np.array(p) + place[2] for p, seen in POINTS if number in seen])
        depths = depths[depths > 0]
        if len(depths):
            np.testing.assert_allclose([view.near, view.far], np.percentile(depths, [0.1, 99.9]), rtol=1e-12)
            np.testing.assert_allclose(view.camera.depth_range(), (view.near / 100, view.far * 100), rtol=1e-6)
        else:
            assert view.near is view.far is None and i > 2
    for path in (tmp_path / model, next((tmp_path / model).glob("cameras.*"))):
        assert [v.camera for v in rts.load_views(path, split="all")] == [v.camera for v in views]


def test_every_eighth_picture_is_for_tests(tmp_path):
    data_set(tmp_path)
    names = [v.name for v in rts.load_views(tmp_path, split="all")]
    assert [v.name for v in rts.load_views(tmp_path, split="test")] == [names[0], names[8]]
    assert [v.name for v in rts.load_views(tmp_path, split="train")] == [*names[1:8], names[9]]
    with pytest.warns(rts.errors.FileWarning, match="8 of the 10 pictures of .* every eighth .* split='train'"):
        assert len(rts.load_views(tmp_path)) == 8
    refused("split is 'val'; expected 'train', 'test' or 'all'", tmp_path, split="val")
    refused("frame is 'nerf'", tmp_path, frame="nerf")
    data_set(tmp_path / "one", count=1)
    refused("no pictures of the split 'train'", tmp_path / "one")


def test_points_may_be_missing_and_binary_tables_are_preferred(tmp_path):
    data_set(tmp_path)
    (tmp_path / "sparse/0/points3D.bin").unlink()
    view = rts.load_views(tmp_path, split="train")[0]
    assert view.near is None and tuple(view.camera.depth_range()) == pytest.approx((0.01, 1e6))
    (tmp_path / "sparse/0/cameras.txt").write_text("damaged")
    assert rts.load_views(tmp_path, split="train")[0].camera == view.camera


@pytest.mark.parametrize("size", [(48, 64), (41, 55)])
def test_smaller_pictures_have_a_folder(tmp_path, size):
    listed = data_set(tmp_path)
    for *_, name, _ in listed:
        save(tmp_path / "images_2" / name, np.zeros(size))
    view = rts.load_views(tmp_path, downscale=2, split="train")[-1]
    assert view.size == view.image.shape[:2] == size
    K, *_ = view.camera.to_opencv(size, pixel_center=0.5)
    sx, sy = size[1] / 128, size[0] / 96
    np.testing.assert_allclose(K, [[90 * sx, 0, 63 * sx], [0, 84 * sy, 49.5 * sy], [0, 0, 1]], rtol=1e-12)
    quarter = rts.load_views(tmp_path, downscale=4, split="train")[-1]
    assert quarter.size == quarter.image.shape[:2] == (24, 32)


@pytest.mark.parametrize("table", ["cameras", "images", "points3D"])
def test_binary_tables_of_any_other_length_are_refused(tmp_path, table):
    data_set(tmp_path, count=3)
    path = tmp_path / f"sparse/0/{table}.bin"
    whole = path.read_bytes()
    rts.load_views(tmp_path, split="all")
    for end in [*range(0, len(whole), 7), len(whole) - 1]:
        path.write_bytes(whole[:end])
        refused(f"{table}.bin cannot be read as COLMAP's binary (it ends early)", tmp_path)
    path.write_bytes(whole + b"more")
    refused("4 bytes follow its", tmp_path)
    path.write_bytes(b"\xff" * len(whole))
    refused(f"{table}.bin", tmp_path)


@pytest.mark.parametrize(
    "table, old, new, message",
    [
        ("cameras", "3 PINHOLE", "three PINHOLE", "line 3 is not CAMERA_ID MODEL WIDTH HEIGHT PARAMS"),
        ("cameras", "84.0 63.0", "84.0", "camera 3 has 3 parameters; expected those of PINHOLE"),
        ("cameras", "3 PINHOLE", "3 FOV", "camera 3 has the camera model 'FOV', which is not followed"),
        ("cameras", "3 PINHOLE 128", "3 PINHOLE 0", "has 0 × 96 pixels"),
        ("cameras", "90.0", "nan", "fx = nan"),
        ("cameras", "90.0", "-90.0", "fx = -90"),
        ("cameras", "128 96", "96 128", "has 128 × 96 pixels, and"),
        ("cameras", "3 PINHOLE", "4 PINHOLE", "refers to camera 3, which"),
        ("images", "18 ", "18 0 ", "is not IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME"),
        ("images", "1.5 2.5 -1", "1.5 2.5", "is not X Y POINT3D_ID of keypoints"),
        ("images", "cam/IMG 01.png", "../IMG 01.png", "outside its own folder"),
        ("images", "cam/IMG 01.png", "cam/IMG 77.png", "images.txt names 1 of 3 pictures that"),
        ("images", "0.1 -0.2 4.0", "nan -0.2 4.0", "expected a quaternion and a position"),
        ("points3D", "0.5 20 3", "0.5 20", "is not POINT3D_ID X Y Z"),
        ("points3D", "0.1 0.3", "0.1 x", "is not POINT3D_ID X Y Z"),
        ("points3D", "20 3", "99999999999999999999 3", "is not POINT3D_ID X Y Z"),
        ("points3D", "0.1 0.3", "1e300 0.3", "point 8 is at [1e+300, 0.3, 0.02]; expected numbers up to 1e+18"),
        ("points3D", "15 0.2", "8 0.2", "point 8 is there twice"),
        ("cameras", "8 OPENCV", "3 OPENCV", "camera 3 is there twice; expected each number once"),
        ("images", "19 0", "20 0", "image 20 is there twice"),
        ("images", "cam/IMG 01.png", "cam/IMG 00.png", "image 20 is of the picture 'cam/IMG 00.png', as image 19 is"),
        ("images", "0.1 -0.2 4.0", "1e300 -0.2 4.0", "expected a quaternion and a position"),
    ],
)
def test_wrong_tables_of_text_are_refused_in_one_line(tmp_path, table, old, new, message):
    data_set(tmp_path, text_model, count=3)
    path = tmp_path / f"sparse/0/{table}.txt"
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))
    refused(message, tmp_path, split="all")


def test_numbers_that_are_there_twice_in_binary_tables_are_refused(tmp_path):
    listed = data_set(tmp_path, count=3)
    number, *rest = listed[0]
    twice = [*listed, (number, *rest[:-2], "cam/other.png", [])]
    binary_model(tmp_path / "sparse/0", CAMERAS, twice, POINTS)
    refused(f"images.bin, image {number} is there twice", tmp_path)
    binary_model(tmp_path / "sparse/0", CAMERAS, listed, POINTS)
    path = tmp_path / "sparse/0/points3D.bin"
    path.write_bytes(path.read_bytes().replace(struct.pack("<Q", 15), struct.pack("<Q", 8)))
    refused("points3D.bin, point 8 is there twice", tmp_path)


def test_wrong_data_sets_are_refused_in_one_line(tmp_path):
    data_set(tmp_path, cameras={3: (7, SIZE, [90.0, 63.0, 49.5, 0.1, 0.2])})
    refused("camera model 'FOV', which is not followed", tmp_path)
    data_set(tmp_path, cameras={3: (99, SIZE, [90.0])})
    refused("camera model 'number 99', which is not followed", tmp_path)
    data_set(tmp_path)
    (tmp_path / "images/cam/IMG 05.png").write_bytes(b"no picture")
    refused("IMG 05.png cannot be read as an image", tmp_path)
    for i in (3, 4, 5, 6):
        (tmp_path / f"images/cam/IMG {i:02}.png").unlink()
    refused("names 4 of 8 pictures", tmp_path)
    refused("IMG 03.png, cam/IMG 04.png, cam/IMG 05.png, …", tmp_path)
    (tmp_path / "sparse/0/images.bin").unlink()
    refused("has no images.bin beside it", tmp_path)
    (tmp_path / "transforms.json").write_text("{}")
    refused("transforms.json has no frames", tmp_path)  # It comes before the model that it was made from.
    binary_model(tmp_path / "bare", CAMERAS, images(2))
    refused("has no folder images in", tmp_path / "bare")


def test_a_real_scene_is_the_same_in_two_formats(tmp_path, data):
    fern = np.load(data / "nerf/fern_images_378.npz")
    height, width, focal = fern["hwf"]
    np.save(tmp_path / "poses_bounds.npy", fern["poses_bounds"])
    positions = fern["points_xyz"][::3]
    listed, seen = [], [[] for _ in positions]
    for i, row in enumerate(fern["poses_bounds"]):
        save(tmp_path / f"images/{i:02}.png", np.ascontiguousarray(fern["rgb"][i, ::42, ::42]))
        down, right, back, position = row[:-2].reshape(3, 5).T[:4]
        turn = np.stack([right, down, -back])
        listed.append((i + 1, turn, -turn @ position, 1, f"{i:02}.png", []))
        local = positions @ turn.T - turn @ position
        pixels = focal * local[:, :2] / local[:, 2:] + [width / 2, height / 2]
        inside = (local[:, 2] > 0) & (pixels > 0).all(axis=1) & (pixels < [width, height]).all(axis=1)
        for n in np.flatnonzero(inside):
            seen[n].append(i + 1)
    points = list(zip(positions.tolist(), seen, strict=True))
    binary_model(tmp_path / "sparse/0", {1: ("SIMPLE_PINHOLE", (378, 504), [focal, 252.0, 189.0])}, listed, points)
    colmap = rts.load_views(tmp_path / "sparse/0", split="all")
    llff = rts.load_views(tmp_path / "poses_bounds.npy")
    for a, b in zip(colmap, llff, strict=True):
        np.testing.assert_allclose(a.camera.view, b.camera.view, atol=1e-9)
        np.testing.assert_allclose(a.camera.rays(a.size).directions, b.camera.rays(b.size).directions, atol=1e-9)
        # LLFF knew which points a picture saw; here it sees all in front of it, some of them hidden.
        np.testing.assert_allclose([a.near, a.far], [b.near, b.far], rtol=0.1)


# -------------------------------------------------------------------------------------------------------------- saved


def same(found, expected):
    """Compare views: cameras, sizes and lenses."""
    for a, b in zip(found, expected, strict=True):
        assert a.size == b.size and a.name.endswith(b.name.rpartition("/")[2])
        np.testing.assert_allclose(np.asarray(a.camera.view), np.asarray(b.camera.view), atol=1e-6)
        for p, q in zip(a.camera.to_opencv(a.size), b.camera.to_opencv(b.size), strict=True):
            np.testing.assert_allclose(np.asarray(p), np.asarray(q), rtol=1e-6, atol=1e-6)
        assert (a.lens is None) == (b.lens is None)
        if a.lens:
            x, y = np.array([3.0, 90.0]), np.array([80.0, 20.0])
            np.testing.assert_allclose(a.lens.distorted(x, y), b.lens.distorted(x, y), atol=1e-6)
        np.testing.assert_array_equal(a.image, b.image)


@pytest.mark.parametrize("model", ["PINHOLE", "RADIAL", "OPENCV_FISHEYE", "FULL_OPENCV"])
def test_saved_views_are_read_back(tmp_path, model):
    data_set(tmp_path, cameras={**CAMERAS, 8: (model, SIZE, MODELS[model][1])})
    views = rts.load_views(tmp_path, split="all")
    rts.save_views(tmp_path / "refined.json", views)
    same(rts.load_views(tmp_path / "refined.json"), views)
    assert "camera_angle_x" in json.loads((tmp_path / "refined.json").read_text())
    rts.save_views(tmp_path / "new/sparse/0", views)
    (tmp_path / "new/images").symlink_to(tmp_path / "images")
    same(rts.load_views(tmp_path / "new", split="all"), views)
    assert len((tmp_path / "new/sparse/0/cameras.txt").read_text().splitlines()) == 2 + (model != "PINHOLE")


def test_fitted_cameras_of_any_engine_are_saved(tmp_path):
    torch = pytest.importorskip("torch")
    data_set(tmp_path)
    views = rts.load_views(tmp_path, split="all", downscale=2)
    for view in views:
        view.camera = view.camera.within(rts.rigid(torch.tensor([0.1, 0.2, -0.1, 0.3, 0, 0.2], dtype=torch.float64)))
    views[0].camera = Camera.look_at((1, 2, 3), (0, 0, 0), principal_point=(0.1, 0.2))
    rts.save_views(tmp_path / "refined.json", views)
    for a, b in zip(rts.load_views(tmp_path / "refined.json", downscale=2), views, strict=True):
        for p, q in zip(a.camera.to_opencv(a.size), b.camera.to_opencv(b.size), strict=True):
            np.testing.assert_allclose(p, np.asarray(q), rtol=1e-6, atol=1e-6)


def test_wrong_views_are_not_saved(tmp_path):
    data_set(tmp_path)
    views = rts.load_views(tmp_path, split="train")

    def not_saved(message, path=tmp_path / "a.json", views=views):
        with pytest.raises(InputError) as caught:
            rts.save_views(path, views)
        assert message in str(caught.value) and "\n" not in str(caught.value)
        assert not (tmp_path / "a.json").exists()

    not_saved("expected a name ending in .json, or a folder", tmp_path / "a.npz")
    not_saved("views is []", views=[])
    not_saved("views is", views=[views[0].camera])
    not_saved("views has two of one name", tmp_path / "new", [views[0], views[0]])
    not_saved("has cameras.bin, which readers prefer", tmp_path / "sparse/0")
    good = views[0].camera
    for camera, message in (
        (Camera.orthographic((0, 0, 4), (0, 0, 0), height=2), "orthographic"),
        (good.replace(projection=np.diag([-1.0, 1, 1, 1]) @ good.projection), "mirrors or skews"),
        (good.replace(view=good.view * [[2], [2], [2], [1]]), "the rotation of views[0].camera"),
        (good.replace(view=good.view * np.nan), "NaN or infinite"),
        (Camera.stack([good, good]), "expected an rts.Camera of one view"),
        (None, "expected an rts.Camera of one view"),
    ):
        views[0].camera = camera
        not_saved(message)
