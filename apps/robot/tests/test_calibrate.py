"""Cameras from masks and joint values, how sure they are, the command, and bad input."""

import json

import numpy as np
import pytest
from arm import CAMERA, JOINTS, SIZE, VALUES, area_masks, written
from PIL import Image
from rts_robot import calibrate, calibration, load_urdf
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

import rts
from rts_cli.main import app

torch = pytest.importorskip("torch")
TRUE = np.linalg.inv(CAMERA.view) @ np.diag([1.0, -1, -1, 1])
INTRINSICS = CAMERA.to_opencv(SIZE)[0]


@pytest.fixture(scope="module")
def robot(tmp_path_factory):
    return load_urdf(written(tmp_path_factory.mktemp("arm")))


@pytest.fixture(scope="module")
def masks(robot):
    """Masks of which a fiftieth of the pixels is wrong."""
    rng, masks = np.random.default_rng(0), area_masks(robot)
    wrong = rng.random(masks.shape) < 0.02
    return np.where(wrong, 1 - masks, masks)


def error(found):
    turn = Rotation.from_matrix(TRUE[:3, :3] @ found.camera_to_base[:3, :3].T).as_rotvec()
    return np.concatenate([turn, TRUE[:3, 3] - found.camera_to_base[:3, 3]])


@pytest.mark.thorough
def test_a_camera_is_found_without_a_start_to_within_its_deviations(robot, masks):
    found = calibrate(robot, masks, VALUES, INTRINSICS, progress=False)
    off = error(found)
    assert np.linalg.norm(off[:3]) < 3e-3 and np.linalg.norm(off[3:]) < 5e-3  # A pixel is 28 mm wide there.
    assert off @ np.linalg.solve(found.covariance, off) < 22.5  # χ² of six numbers: 99.9 %.
    assert found.deviations[3:].max() < 5e-3 and not found.offsets
    np.testing.assert_allclose(found.camera.view, CAMERA.view, atol=0.01)


@pytest.mark.thorough
def test_another_search_follows_where_the_robot_does_not_fit_the_masks(robot, masks, monkeypatch):
    searches = []

    def starts(*_, seed):
        searches.append(seed)
        around = [0.02, -0.01, 0.01] if seed == 6 else [0, 0, 2.5]
        return [np.linalg.inv(np.asarray(rts.rigid([*around, 0.02, -0.01, 0.01])) @ TRUE)]

    monkeypatch.setattr(calibration, "find_starts", starts)
    found = calibrate(robot, masks, VALUES, INTRINSICS, seed=5, progress=False)
    assert searches == [5, 6] and found.ious.min() > 0.85
    assert np.linalg.norm(error(found)[3:]) < 5e-3


@pytest.mark.thorough
def test_offsets_of_joints_are_found_beside_the_camera(robot):
    values = VALUES - [0, 0.04, 0.02, 0]
    near = TRUE @ np.asarray(rts.rigid([0.02, -0.01, 0.01, 0.02, -0.01, 0.01]))
    found = calibrate(
        robot,
        area_masks(robot),
        values,
        INTRINSICS,
        start=near,
        offsets=["elbow", "slide"],
        loss="linear",
        progress=False,
    )
    assert found.offsets["elbow"] == pytest.approx(0.04, abs=4e-3)
    assert found.offsets["slide"] == pytest.approx(0.02, abs=3e-3)
    assert np.linalg.norm(error(found)[3:]) < 0.01
    np.testing.assert_allclose(found.values, VALUES, atol=4e-3)


def test_residuals_without_correlation_have_the_variance_of_a_mean():
    from rts_robot.uncertainty import covariance_of

    rng = np.random.default_rng(0)
    draws = torch.tensor(rng.normal(size=(8, 3, 64, 64)))
    mean, loss, pixels = torch.tensor([0.0], dtype=torch.float64), rts.Loss(), 3 * 64 * 64

    def variance(draws):
        of_draws = [
            covariance_of(lambda p, n, data=data: p[0] - data[n], mean, 3, loss, ["mean"])[0, 0] for data in draws
        ]
        return np.mean(of_draws)

    assert variance(draws) == pytest.approx(1 / pixels, rel=0.15)
    # Squares of 2 × 2 equal pixels: four times as much.
    coarse = draws[..., ::2, ::2].repeat_interleave(2, -1).repeat_interleave(2, -2)
    assert variance(coarse) == pytest.approx(4 / pixels, rel=0.25)
    # The same pixels in all three views: three times as much.
    assert variance(draws[:, :1].expand(-1, 3, -1, -1)) == pytest.approx(3 / pixels, rel=0.15)


def test_the_variance_of_a_robust_mean_is_that_of_repeated_draws():
    from rts_robot.uncertainty import covariance_of

    rng, loss = np.random.default_rng(1), rts.Loss("huber", 0.5)
    drawn = rng.standard_t(2, size=(60, 32, 32))
    means, variances = [], []
    for data in map(torch.tensor, drawn):
        mean = torch.zeros(1, dtype=torch.float64)
        for _ in range(60):
            mean = mean - (loss.weights(mean - data)[0] * (mean - data)).mean()
        means.append(float(mean))
        variances.append(covariance_of(lambda p, _, data=data: p[0] - data, mean, 1, loss, ["mean"])[0, 0])
    assert np.mean(variances) == pytest.approx(np.var(means), rel=0.4)


def test_parameters_that_cannot_be_told_apart_are_refused():
    from rts_robot.uncertainty import covariance_of

    def residuals(p, view):
        return (p[0] + p[1]) * torch.ones(32, 32) + 0.1 * torch.sin(torch.arange(32.0))

    with pytest.raises(rts.InputError, match="do not tell a and b apart"):
        covariance_of(residuals, torch.zeros(2), 1, rts.Loss(), ["a", "b"])


@pytest.fixture
def folder(tmp_path, robot, masks):
    """A folder with the robot, masks and joints, as the command takes them."""
    written(tmp_path)
    (tmp_path / "masks").mkdir()
    for number, mask in enumerate(masks):
        Image.fromarray(np.uint8(np.round(255 * mask))).save(tmp_path / f"masks/{number}.png")
    rows = [dict(zip(JOINTS, row, strict=True)) for row in VALUES.tolist()]
    (tmp_path / "joints.json").write_text(json.dumps(rows))
    (tmp_path / "start.json").write_text(json.dumps({"camera_to_base": TRUE.tolist()}))
    return tmp_path


def run(folder, *more, urdf="arm_description/arm.urdf", joints="joints.json", lens=("--fov", "45")):
    words = ["calibrate", urdf, "--masks", "masks", "--joints", joints, *lens, "-o", "out", *more]
    places = [str(folder / w) if w in (urdf, joints, "masks", "out", "start.json") else w for w in words]
    return CliRunner().invoke(app, places)


@pytest.mark.thorough
def test_the_command_writes_numbers_and_a_page(folder):
    done = run(folder, "--start", "start.json")
    assert done.exit_code == 0, done.output
    entries = json.loads((folder / "out/calibration.json").read_text())
    np.testing.assert_allclose(entries["camera_to_base"], TRUE, atol=5e-3)
    assert np.shape(entries["covariance"]) == (6, 6) and [v["mask"] for v in entries["views"]][0] == "0.png"
    page = (folder / "out/report.html").read_text()
    assert page.count("data:image/png") == len(VALUES) and "http" not in page
    assert "IoU" in done.output and "poor fit" not in done.output


def test_joints_by_names_of_masks_and_as_csv_are_the_same(folder):
    from rts_robot.inputs import read_joints

    names = [f"{n}.png" for n in range(len(VALUES))]
    rows = read_joints(folder / "joints.json", names)
    (folder / "by_name.json").write_text(json.dumps(dict(reversed(list(zip(names, rows, strict=True))))))
    lines = [",".join(JOINTS), *(",".join(map(str, row)) for row in VALUES)]
    (folder / "joints.csv").write_text("\n".join(lines))
    assert read_joints(folder / "by_name.json", names) == rows == read_joints(folder / "joints.csv", names)


def spoil(folder, case):
    """Spoil something in the folder; returns further arguments of `run`."""
    masks, joints = folder / "masks", folder / "joints.json"
    rows = json.loads(joints.read_text())
    if case == "black":
        Image.fromarray(np.zeros(SIZE, np.uint8)).save(masks / "2.png")
    elif case == "another size":
        Image.fromarray(np.full((30, 40), 255, np.uint8)).save(masks / "3.png")
    elif case == "count":
        (masks / "3.png").unlink()
    elif case == "unknown":
        joints.write_text(json.dumps([row | {"wrist": 0} for row in rows]))
    elif case == "missing":
        joints.write_text(json.dumps([{"elbow": 0.0}] * 4))
    elif case == "no number":
        joints.write_text(json.dumps([row | {"elbow": "much"} for row in rows]))
    elif case == "no masks":
        for path in masks.iterdir():
            path.unlink()
    elif case == "no mesh":
        (folder / "arm_description/meshes/hand.dae").unlink()
    elif case == "nothing moves":
        path = folder / "arm_description/arm.urdf"
        still = "revolute", "continuous", "prismatic"
        text = path.read_text()
        for kind in still:
            text = text.replace(f'type="{kind}"', 'type="fixed"')
        path.write_text(text.replace('<mimic joint="finger" multiplier="-2" offset="0.01"/>', ""))
        joints.write_text(json.dumps([{}] * 4))
    return {
        "no urdf": {"urdf": "arm.urdf"},
        "no joints": {"joints": "none.json"},
        "no lens": {"lens": ()},
        "two lenses": {"lens": ("--fov", "45", "--intrinsics", "1,1,1,1")},
        "bad lens": {"lens": ("--intrinsics", "600,600")},
    }.get(case, {})


ERRORS = {
    "black": "2.png is black all over",
    "another size": "3.png has 40 x 30 pixels, and 0.png 80 x 60",
    "count": "has 4 rows for 3 masks",
    "unknown": "unknown: wrist",
    "missing": "missing: shoulder, slide, finger",
    "no number": "a value that is no number",
    "no masks": "has no pictures",
    "no mesh": "meshes/hand.dae, which is not in",
    "nothing moves": "no joint of the robot moves",
    "no urdf": "there is no file",
    "no joints": "expected the values of joints",
    "no lens": "--intrinsics fx,fy,cx,cy in pixels, or its --fov",
    "two lenses": "--intrinsics fx,fy,cx,cy in pixels, or its --fov",
    "bad lens": "expected four numbers",
}


@pytest.mark.parametrize("case", ERRORS)
def test_bad_input_is_one_clear_line(case, folder):
    done = run(folder, **spoil(folder, case))
    assert done.exit_code == 1 and not (folder / "out").exists()
    [line] = done.stderr.splitlines()
    assert ERRORS[case] in line


def test_an_offset_of_an_unknown_joint_and_a_wrong_start_are_refused(folder):
    assert "names of joints: shoulder, elbow" in run(folder, "--offsets", "wrist").stderr
    (folder / "start.json").write_text('{"camera": 1}')
    assert "no matrix camera_to_base" in run(folder, "--start", "start.json").stderr
