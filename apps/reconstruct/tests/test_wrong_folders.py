"""Folders, masks and pictures that are wrong: each ends in one line before any work, or is told in one line."""

import json
import shutil
import sys

import numpy as np
import pytest
from PIL import Image
from rts_reconstruct import picture_files, pictures
from seen_ellipsoid import SIZE, images, on_white, views, written
from typer.testing import CliRunner

import rts
from rts_cli.main import app

COUNT = 8


def blender(folder):
    return written(folder / "set")


def colmap(folder):
    """A data set of COLMAP with masks."""
    folder = folder / "set"
    for name in ("images", "masks"):
        (folder / name).mkdir(parents=True)
    for i, image in enumerate(images()):
        rts.save_image(folder / f"images/{i}.png", on_white(image))
        Image.fromarray(np.uint8(255 * (image[..., 3] > 0.5))).save(folder / f"masks/{i}.png.png")
    rts.save_views(folder, views())
    return folder


def photographs(folder, names=("a.png", "b.png", "c.png")):
    folder = folder / "set"
    folder.mkdir()
    for name in names:
        (folder / name).write_bytes(b"no picture")
    return folder


def masked(change, numbers=range(COUNT)):
    """A data set with masks (H, W) that a function changes."""
    return repainted(colmap, "masks/{}.png.png", change, numbers)


def painted(change):
    """A data set whose pictures (H, W, 4) a function changes."""
    return repainted(blender, "{}.png", change, range(COUNT))


def repainted(data, name, change, numbers):
    """A data set whose files, `name` of numbers, a function changes as arrays."""

    def make(folder):
        folder = data(folder)
        for i in numbers:
            file = folder / name.format(i)
            Image.fromarray(np.ascontiguousarray(change(np.array(Image.open(file))))).save(file)
        return folder

    return make


def framed(change):
    """A data set whose frames a function changes."""

    def make(folder):
        folder = blender(folder)
        tree = json.loads((folder / "transforms.json").read_text())
        change(tree["frames"])
        (folder / "transforms.json").write_text(json.dumps(tree))
        return folder

    return make


def with_file(make, name, content):
    """A data set one of whose files has another content, or is gone."""

    def made(folder):
        folder = make(folder)
        file = folder / name
        file.unlink(missing_ok=True)
        if content is not None:
            file.write_bytes(content)
        return folder

    return made


def camera_of_nothing(folder):
    folder = colmap(folder)
    file = folder / "cameras.txt"
    lines = [line.split() for line in file.read_text().splitlines() if not line.startswith("#")]
    file.write_text("\n".join(" ".join([*words[:4], "nan", *words[5:]]) for words in lines))
    return folder


def within(folder):
    (folder / "set").mkdir()
    photographs(folder / "set").rename(folder / "set/DCIM")
    return folder / "set"


def same_cameras(frames):
    for frame in frames:
        frame["transform_matrix"] = frames[0]["transform_matrix"]


WRONG = {
    "no folder": (lambda folder: folder / "set", "there is no file"),
    "an empty folder": (lambda folder: photographs(folder, ()), "has neither photographs"),
    "photographs deeper": (within, "its folder DCIM has 3: give"),
    "a picture": (lambda folder: blender(folder) / "0.png", "is one picture; expected a folder of them"),
    "a film": (lambda folder: photographs(folder, ["a.mp4"]) / "a.mp4", "is a film; expected a folder"),
    "HEIC": (lambda folder: photographs(folder, ["a.HEIC", "b.HEIC"]), "has 2 .heic, which are not read"),
    "two photographs": (lambda folder: photographs(folder, ["a.jpg", "b.jpg"]), "has 2 photographs; expected at least"),
    "photographs of text": (photographs, "a.png cannot be read as a picture"),
    "a text called PNG": (with_file(blender, "3.png", b"hello"), "3.png cannot be read as an image"),
    "black masks": (masked(lambda mask: 0 * mask), "black all over in 8 of 8 views (0.png"),
    "masks of 0 and 1": (masked(lambda mask: mask // 255), "the lightest pixel is 0.004 of white"),
    "inverted masks": (masked(lambda mask: 255 - mask), "expected white where the object is, so invert them"),
    "masks of other sizes": (masked(lambda mask: mask[::2], [2]), "expected masks of the size of the pictures"),
    "a mask of text": (with_file(colmap, "masks/2.png.png", b"no"), "2.png.png cannot be read as an image"),
    "transparent pictures": (painted(lambda picture: picture * np.uint8([1, 1, 1, 0])), "black all over in 8 of 8"),
    "black pictures": (painted(lambda picture: 0 * picture[..., :3]), "have no other colour than 0.00"),
    "pictures of a pixel": (painted(lambda picture: picture[:1, :1]), "0.png has 1 × 1 pixels"),
    "one picture": (framed(lambda frames: frames.__delitem__(slice(1, None))), "1 view in"),
    "cameras in one place": (framed(same_cameras), "of all 8 views stand in one place"),
    "a model without images": (with_file(colmap, "images.txt", None), "has no images.txt beside it"),
    "a model of missing files": (with_file(colmap, "images/3.png", None), "names 1 of 8 pictures"),
    "a camera of no length": (camera_of_nothing, "has fx = nan; expected a positive one"),
    "a binary cut short": (
        with_file(with_file(colmap, "images.bin", b""), "cameras.bin", bytes(20)),
        "cannot be read as COLMAP's binary",
    ),
    "a broken JSON": (with_file(blender, "transforms.json", b'{"frames": ['), "the file may be cut short"),
}


@pytest.mark.parametrize("kind", WRONG)
def test_a_wrong_folder_is_one_line_and_leaves_nothing(tmp_path, kind):
    make, said = WRONG[kind]
    words = ["reconstruct", str(make(tmp_path)), "-o", str(tmp_path / "out"), "--quick", "--size", str(SIZE)]
    run = CliRunner().invoke(app, words)
    lines = [line for line in run.stderr.splitlines() if "warning" not in line]
    assert run.exit_code == 1 and len(lines) == 1 and said in lines[0], run.output
    assert not (tmp_path / "out").exists()


def test_results_are_not_mixed_with_pictures(tmp_path):
    folder = colmap(tmp_path)
    before = sorted(folder.rglob("*"))
    for out in (folder, folder / "images"):
        run = CliRunner().invoke(app, ["reconstruct", str(folder), "-o", str(out)])
        assert run.exit_code == 1 and "is that of the pictures; expected another one" in run.stderr
    assert sorted(folder.rglob("*")) == before


def test_without_pycolmap_the_extra_is_named(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    model = colmap(tmp_path)
    shutil.rmtree(model / "masks")
    (model / "points3D.txt").write_text("1 0 0 0 0 0 0 0 1 0\n")
    alone = tmp_path / "alone"
    alone.mkdir()
    for i in range(3):
        shutil.copy(model / f"images/{i}.png", alone)
    for folder in (model, alone):
        run = CliRunner().invoke(app, ["reconstruct", str(folder), "-o", str(tmp_path / "out")])
        assert run.exit_code == 1 and "./apps/reconstruct[photos]" in run.stderr and run.stderr.count("\n") == 1


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda mask: 0 * mask, r"black all over in 1 of 8 views \(2.png\)"),
        (lambda mask: 0 * mask + 255, r"missing, or white all over, in 1 of 8 views \(2.png\)"),
        (lambda mask: 255 - mask, r"white along the border and black within in 1 of 8 views \(2.png\)"),
    ],
)
def test_one_wrong_mask_is_named(tmp_path, change, said):
    with pytest.warns(rts.errors.RtsWarning, match=said):
        pictures.read(masked(change, [2])(tmp_path), SIZE, 0)


def test_pictures_that_are_there_twice_or_turned_by_exif_are_named(tmp_path):
    folder = blender(tmp_path)
    found = pictures.read(folder, SIZE, 0).given
    assert picture_files.repeated(found) == picture_files.turned(found) == []
    shutil.copy(folder / "1.png", folder / "5.png")
    exif = Image.Exif()
    exif[274] = 6
    Image.open(folder / "3.png").save(folder / "3.png", exif=exif)
    found = pictures.read(folder, SIZE, 0).given
    (line,) = picture_files.repeated(found)
    assert "1 of 8 pictures" in line and "(5.png is 1.png)" in line
    (line,) = picture_files.turned(found)
    assert "EXIF turns 1 of 8 pictures (3.png)" in line
