"""Cameras of photographs: those of a scene that is rendered, and folders that are wrong."""

import numpy as np
import pytest
from PIL import Image
from rts_reconstruct.cameras import find_cameras

import rts

pycolmap = pytest.importorskip("pycolmap")

COUNT, SIZE = 6, (240, 320)


@pytest.fixture(scope="module")
def photographs(tmp_path_factory):
    """A corner of a room with noise on its walls, from six places; the third is held upright."""
    folder = tmp_path_factory.mktemp("photographs")
    rng = np.random.default_rng(0)
    noise = sum(np.kron(rng.random((n, n, 3)), np.ones((512 // n, 512 // n, 1))) for n in (8, 32, 128)) / 3
    square = np.float32([[0, 0], [1, 0], [1, 1], [0, 1]])
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    walls = []
    for axis in range(3):
        corners = 4 * np.roll(np.c_[square, np.zeros(4)], axis, axis=1).astype(np.float32)
        theta = {"vertices": corners, "uv": square, "texture": np.roll(noise, 97 * axis, 1).astype(np.float32)}
        walls.append(rts.Part(rts.Mesh(faces), theta, "unlit"))
    cameras = []
    for i in range(COUNT):
        turn = np.radians(25 + 40 * i / (COUNT - 1))
        eye = np.array([np.cos(turn), 0.55 + 0.1 * np.sin(3 * i), np.sin(turn)]) * 5
        camera = rts.Camera.look_at(eye, (0.8, 0.8, 0.8), fov_y=50)
        pixels = np.asarray(rts.render(walls, camera, SIZE, supersample=2))[..., :3]
        picture, exif = Image.fromarray((255 * np.clip(pixels, 0, 1) ** (1 / 2.2)).astype(np.uint8)), Image.Exif()
        if i == 2:  # Stored lying on its side.
            picture, exif[274] = picture.transpose(Image.Transpose.ROTATE_90), 6
        picture.save(folder / f"{i}.jpg", exif=exif, quality=95)
        cameras.append(camera)
    return folder, cameras


def test_cameras_are_those_of_the_scene(photographs, tmp_path):
    folder, cameras = photographs
    found = find_cameras(folder, tmp_path / "set")
    assert found.registered == COUNT and found.missing == () and found.turned == ("2.jpg",)
    assert found.error < 1 and f"{COUNT} of {COUNT} cameras" in str(found)
    assert sorted(p.name for p in (tmp_path / "set").iterdir()) == ["images", "sparse"]
    views = rts.load_views(tmp_path / "set", split="all")
    assert [view.size for view in views] == [SIZE] * COUNT
    pairs = [(camera, view.camera) for camera, view in zip(cameras, views, strict=True)]
    # Where cameras stand, up to a similarity.
    eyes = [np.stack([np.linalg.inv(np.asarray(c.view))[:3, 3] for c in side]) for side in zip(*pairs, strict=True)]
    true, got = (e - e.mean(0) for e in eyes)
    u, s, vt = np.linalg.svd(got.T @ true)
    assert np.linalg.det(u @ vt) > 0
    fitted = got @ u @ vt * (s.sum() / (got**2).sum())
    assert np.abs(fitted - true).max() < 0.02 * np.linalg.norm(true, axis=1).max()


def test_a_folder_of_few_or_broken_photographs_is_refused(photographs, tmp_path):
    with pytest.raises(rts.InputError, match="is no folder; expected one with photographs"):
        find_cameras(tmp_path / "none", tmp_path / "set")
    few = tmp_path / "few"
    few.mkdir()
    with pytest.raises(rts.InputError, match="has 0 photographs; expected at least 3"):
        find_cameras(few, tmp_path / "set")
    for i in range(3):
        Image.fromarray(np.full((80, 80, 3), 60 * i, np.uint8)).save(few / f"{i}.png")
    with pytest.raises(rts.InputError, match="no cameras were found for the 3 photographs"):
        find_cameras(few, tmp_path / "set")
    assert not (tmp_path / "set").exists(), "something is left behind"
    (few / "3.jpg").write_bytes(b"no picture")
    with pytest.raises(rts.InputError, match=r"3.jpg cannot be read as a picture"):
        find_cameras(few, tmp_path / "set")
    with pytest.raises(rts.InputError, match="size is 3; expected a number of pixels, at least 64"):
        find_cameras(few, tmp_path / "set", size=3)


def test_what_is_there_is_not_replaced(photographs, tmp_path):
    (tmp_path / "images").mkdir()
    with pytest.raises(rts.InputError, match="has a data set already"):
        find_cameras(photographs[0], tmp_path)
