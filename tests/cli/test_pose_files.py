"""A pose that was fitted: its verdict, its file, and the picture that `rts render --pose` draws of it."""

import json
import warnings

import numpy as np
import pytest
from helpers import crooked_block
from typer.testing import CliRunner

import rts
from rts.errors import InputError
from rts.scene.default_camera import bounds_of, orbit
from rts_cli import main as cli
from rts_cli.pose_file import ModelPose, posed, read_pose
from rts_cli.pose_verdict import intersection_over_union, judged, touches_border, unlike_a_mask

pytestmark = pytest.mark.files


def run(*arguments, code=0):
    result = CliRunner().invoke(cli.app, [str(a) for a in arguments])
    assert result.exit_code == code, result.output
    return " ".join(result.output.split())


@pytest.fixture
def model(tmp_path):
    return crooked_block(tmp_path)


@pytest.fixture
def pose(model):
    camera = orbit(bounds_of(rts.load(model)), (48, 64), 20, 10, 5.0, fov=35)
    return ModelPose(np.asarray(rts.rigid(np.array([0.1, -0.2, 0.3, 0.1, 0, 0.2]))), camera, (48, 64))


def rectangle(top, bottom, left, right, size=(40, 40)):
    mask = np.zeros(size, np.float32)
    mask[top:bottom, left:right] = 1
    return mask


# ------------------------------------------------------------------------------------------------- verdict


def test_intersection_over_union_of_rectangles():
    one, other = rectangle(10, 20, 10, 30), rectangle(15, 25, 10, 30)
    assert intersection_over_union(one, one) == 1
    assert intersection_over_union(one, other) == pytest.approx(100 / 300)
    assert intersection_over_union(one, rectangle(30, 35, 0, 5)) == 0
    assert intersection_over_union(0.4 * one, one) == 0 and intersection_over_union(0 * one, 0 * one) == 1


@pytest.mark.parametrize("edge", [(0, 9, 5, 9), (31, 40, 5, 9), (5, 9, 0, 9), (5, 9, 31, 40)])
def test_a_mask_touches_the_border_on_each_side(edge):
    assert touches_border(rectangle(*edge)) and not touches_border(rectangle(1, 39, 1, 39))
    assert not touches_border(0.3 * rectangle(*edge))


def test_a_photo_is_told_from_a_mask():
    def opaque(*channels):
        return np.stack([*np.broadcast_arrays(*channels, np.float32(1))], axis=-1)

    mask = rectangle(10, 30, 10, 30)
    soft = mask.copy()
    soft[10], soft[29] = 0.5 * mask[10], 0.3 * mask[29]
    noise = np.abs(np.random.default_rng(0).normal(0, 0.003, mask.shape))
    for image in (opaque(mask, mask, mask), opaque(soft, soft, soft), opaque(*[np.abs(mask - noise)] * 3)):
        assert unlike_a_mask(image) == 0
    ramp = np.linspace(0.1, 0.8, 40)[None].repeat(40, axis=0)
    assert unlike_a_mask(opaque(ramp, ramp, ramp)) == 1
    assert unlike_a_mask(opaque(mask, mask, 0)) == pytest.approx(400 / 1600)  # A yellow square.
    transparent = opaque(ramp, ramp, ramp)
    transparent[0, 0, 3] = 0
    assert unlike_a_mask(transparent) == 0


def test_the_verdict_says_what_is_wrong(model, pose):
    parts = rts.load(model)
    drawn = rts.render(posed(parts, pose.matrix, "silhouette"), pose.camera, pose.size, splatter="single", layers=1)
    good = judged(pose, parts, drawn[..., 3])
    assert good == (1.0, []) and good.word == "good fit"
    poor = judged(pose, parts, np.roll(drawn[..., 3], 12, axis=1))
    assert poor.word == "poor fit" and poor.iou < 0.9 and "--fit-fov" in poor.notes[0]
    robust = judged(pose, parts, np.roll(drawn[..., 3], 12, axis=1), robust=True)
    assert "hidden" in robust.notes[0] and "hidden" not in poor.notes[0] and robust.iou == poor.iou
    cut = judged(pose, parts, rectangle(0, 48, 0, 64, (48, 64)))
    assert "touches the border" in cut.notes[1]
    photo = np.dstack([drawn[..., 3] * 0.2 + 0.3] * 3 + [np.ones(pose.size)])
    [note] = judged(pose, parts, drawn[..., 3], photo).notes
    assert note.startswith("this is a photo, not a mask: 100% of its pixels")


# ---------------------------------------------------------------------------------------------------- file


def test_a_pose_is_drawn_exactly_as_it_was_written(model, pose, tmp_path):
    path = tmp_path / "pose.json"
    path.write_text(json.dumps(pose.numbers()))
    again = read_pose(path)
    assert again.camera == pose.camera and again.size == pose.size
    np.testing.assert_array_equal(again.matrix, pose.matrix)
    assert again.fov_y == pytest.approx(35, abs=1e-9)
    run("render", model, "--pose", path, "-o", tmp_path / "a.png")
    image = rts.render(posed(rts.load(model), pose.matrix), pose.camera, pose.size)
    rts.save_image(tmp_path / "b.png", image)
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()
    with warnings.catch_warnings():
        warnings.simplefilter("default")  # One says which side is the height.
        run("render", model, "--pose", path, "-o", tmp_path / "c.png", "--size", "128x96")
    assert rts.load_image(tmp_path / "c.png").shape == (96, 128, 4)


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (lambda p: p.pop("camera"), "no entry 'camera'"),
        (lambda p: p["camera"].pop("view"), "no entry 'view'"),
        (lambda p: p.update(camera=3), "no entry 'view'"),
        (lambda p: p.update(size=[0, 4]), r"size is \[0, 4\]"),
        (lambda p: p.update(matrix=[[1, 2]]), r"matrix has shape \(1, 2\)"),
        (lambda p: p.update(matrix="turned"), "matrix is 'turned'"),
        (lambda p: p.update(matrix=np.zeros((4, 4)).tolist()), "matrix is singular"),
        (lambda p: p["camera"].update(aspect="wide"), "aspect is 'wide'"),
    ],
)
def test_a_file_that_holds_no_pose_is_refused(pose, tmp_path, change, expected):
    entries = pose.numbers()
    change(entries)
    (tmp_path / "pose.json").write_text(json.dumps(entries))
    with pytest.raises(InputError, match=expected) as error:
        read_pose(tmp_path / "pose.json")
    assert "\n" not in str(error.value) and "pose.json: " in str(error.value)


def test_what_is_no_pose_or_says_the_view_twice_is_one_line(model, pose, tmp_path):
    assert "no file gone.json" in run("render", model, "--pose", "gone.json", code=1)
    assert "cannot be read as JSON" in run("render", model, "--pose", model, code=1)
    (tmp_path / "list.json").write_text("[]")
    assert "no entry 'camera'" in run("render", model, "--pose", tmp_path / "list.json", code=1)
    for option in ("--camera=1,2", "--fov=30", "--up=z"):
        assert "beside --pose" in run("render", model, "--pose", "p.json", option, code=2)


def test_the_field_of_view_is_fitted_and_the_fit_is_judged(model, tmp_path):
    pytest.importorskip("torch")
    mask = "--shader", "silhouette", "--splatter", "single", "--layers", 1, "--supersample", 2
    run("render", model, "-o", tmp_path / "t.png", "--size", 64, "--camera", "34,22,2.6", "--fov", 75, *mask)
    arguments = "fit-pose", model, tmp_path / "t.png", "--engine", "torch", "--fov", 60, "--camera", "30,20,2.6"
    said = run(*arguments, "--fit-fov", "-o", tmp_path / "free")
    found = json.loads((tmp_path / "free" / "pose.json").read_text())
    assert found["fov_y"] == pytest.approx(75, abs=3) and found["iou"] > 0.95 and found["notes"] == []
    assert f"good fit: IoU {found['iou']:.3f}, field of view {found['fov_y']:.1f} degrees" in said
    fixed = run(*arguments, "--steps", 1, "-o", tmp_path / "fixed", code=3)
    assert json.loads((tmp_path / "fixed" / "pose.json").read_text())["fov_y"] == pytest.approx(60)
    assert "poor fit: IoU" in fixed and " the model covers the mask with an IoU of" in fixed
    assert "field of view" not in fixed.partition("fit: IoU")[2].partition("covers the mask")[0]
