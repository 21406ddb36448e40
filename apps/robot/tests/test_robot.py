"""Robots of a URDF: where links are, their derivatives, meshes, and bad files."""

import sysconfig
from pathlib import Path

import numpy as np
import pytest
import yourdfpy
from arm import FORE, JOINTS, UPPER, URDF, VALUES, written
from rts_robot import load_urdf

import rts

PANDA = "cmeel.prefix/share/example-robot-data/robots/panda_description/urdf/panda.urdf"


@pytest.fixture
def path(tmp_path):
    return written(tmp_path)


def test_links_are_where_plane_geometry_puts_them(path):
    robot = load_urdf(path)
    shoulder, elbow = 0.7, -0.4
    placed = dict(zip(robot.links, robot.transforms([shoulder, elbow, 0.1, 0.03]), strict=True))
    along = UPPER + (FORE + 0.1) * np.cos(elbow)
    expected = along * np.cos(shoulder), along * np.sin(shoulder), -(FORE + 0.1) * np.sin(elbow)
    np.testing.assert_allclose(placed["hand"][:3, 3], expected, atol=1e-12)
    # Fingers move along y of the hand: x of the tip, which is turned by a right angle.
    between = np.linalg.inv(placed["hand"]) @ placed["left"], np.linalg.inv(placed["hand"]) @ placed["right"]
    np.testing.assert_allclose(between[0][:3, 3], (0, 0.03, 0.1), atol=1e-7)
    np.testing.assert_allclose(between[1][:3, 3], (0, -2 * 0.03 + 0.01, 0.1), atol=1e-7)


def test_links_are_where_yourdfpy_puts_them(path):
    robot, other = load_urdf(path), yourdfpy.URDF.load(str(path), load_meshes=False)
    assert robot.names == JOINTS and robot.links[0] == "base"
    for q in VALUES:
        other.update_cfg(q)
        for link, matrix in zip(robot.links, robot.transforms(q), strict=True):
            np.testing.assert_allclose(matrix, other.get_transform(link), atol=1e-12)


def test_transforms_are_differentiable_in_torch_and_jax(path):
    torch, jax = pytest.importorskip("torch"), pytest.importorskip("jax")
    robot, q, step = load_urdf(path), VALUES[0], 1e-5
    for number in range(len(q)):
        change = step * np.eye(len(q))[number]
        slope = (np.stack(robot.transforms(q + change)) - np.stack(robot.transforms(q - change))) / (2 * step)
        along = torch.func.jvp(
            lambda x: torch.stack(robot.transforms(x)), (torch.tensor(q),), (torch.tensor(change / step),)
        )
        np.testing.assert_allclose(along[1], slope, atol=1e-8)
    by_jax = jax.jit(jax.jacobian(lambda x: jax.numpy.stack(robot.transforms(x))))(jax.numpy.asarray(q))
    np.testing.assert_allclose(by_jax[..., -1], slope, atol=1e-5)


def test_a_dict_of_values_may_mix_numbers_and_tensors(path):
    torch = pytest.importorskip("torch")
    robot = load_urdf(path)
    elbow = torch.tensor(0.3, requires_grad=True)
    plain = robot.transforms(dict.fromkeys(JOINTS, 0.1))
    np.testing.assert_allclose(plain, robot.transforms([0.1] * 4), atol=1e-6)
    placed = robot.transforms({"finger": 0.01, "slide": 0.0, "elbow": elbow, "shoulder": 0.0})
    placed[robot.links.index("hand")][2, 3].backward()
    assert float(elbow.grad) == pytest.approx(-FORE * np.cos(0.3), abs=1e-6)


def test_parts_have_the_meshes_of_the_file_scaled_and_coloured(path):
    robot = load_urdf(path)
    parts = dict(zip([robot.links[mesh.link] for mesh in robot.meshes], robot.parts(VALUES[0], "lambert"), strict=True))
    extent = {name: np.ptp(part.theta["vertices"], axis=0) for name, part in parts.items()}
    np.testing.assert_allclose(extent["upper"], (UPPER, 0.1, 0.12), atol=1e-6)
    np.testing.assert_allclose(extent["fore"], (FORE, 0.07, 0.08), atol=1e-6)
    np.testing.assert_allclose(extent["hand"], (0.05, 0.2, 0.06), atol=1e-6)
    assert "tip" not in parts and set(parts) == {"base", "upper", "fore", "hand", "left", "right"}
    np.testing.assert_allclose(parts["base"].theta["vertices"].mean(axis=0), (0.06, 0.02, -0.05), atol=1e-6)
    red = parts["base"].theta["colors"][0]
    assert red[0] > 0.5 and red[1:].max() < 0.02  # Linear: 0.8 and 0.1 are encoded.


def test_silhouettes_are_those_of_the_shaded_parts(path):
    robot = load_urdf(path)
    camera = rts.Camera.look_at((1.6, -1.5, 1.0), (0.3, 0.1, 0.0), (0, 0, 1))
    images = [
        rts.render(robot.parts(VALUES[1], shader), camera, (40, 40))[..., 3] for shader in ("silhouette", "lambert")
    ]
    np.testing.assert_allclose(*images, atol=1e-5)
    assert 0.02 < images[0].mean() < 0.5
    whole = rts.render(robot.silhouette(VALUES[1]), camera, (40, 40))[..., 3]
    assert np.abs(whole - images[0]).mean() < 1e-3  # Outlines differ slightly where links touch.


@pytest.mark.parametrize("name", ["parts", "silhouette"])
def test_a_rendering_of_joints_has_the_slope_of_area_samples(path, name):
    torch = pytest.importorskip("torch")
    robot, q, step = load_urdf(path), VALUES[1], 0.02
    drawn = getattr(robot, name)
    camera = rts.Camera.look_at((1.6, -1.5, 1.0), (0.3, 0.1, 0.0), (0, 0, 1))
    weights = np.linspace(0, 1, 96)  # So that a link that turns without a change of its area counts, too.

    def moment(values):
        return (rts.render(drawn(values), camera, (96, 96), supersample=4)[..., 3] * weights).mean()

    values = torch.tensor(q, dtype=torch.float32, requires_grad=True)
    (rts.render(drawn(values), camera, (96, 96))[..., 3] * torch.tensor(weights)).mean().backward()
    for number, tolerance in ((0, 0.05), (2, 0.08)):  # The shoulder, and the slide.
        change = step * np.eye(len(q))[number]
        slope = (moment(q + change) - moment(q - change)) / (2 * step)
        assert float(values.grad[number]) == pytest.approx(float(slope), rel=tolerance)


def test_packages_are_found_in_the_folder_that_is_given(path, tmp_path):
    away = tmp_path / "elsewhere"
    away.mkdir()
    (away / "meshes").mkdir()
    (path.parent / "meshes/hand.dae").rename(away / "meshes/hand.dae")
    (away / "arm.urdf").write_text(URDF)
    assert len(load_urdf(away / "arm.urdf", packages=tmp_path).meshes) == 6


BAD = {
    "mimics none": ('mimic joint="finger"', 'mimic joint="thumb"', "the joint other mimics thumb"),
    "no axis": ('<axis xyz="0 0 2"/>', '<axis xyz="0 0 0"/>', "the axis of the joint shoulder is zero"),
    "a kind": ('name="slide" type="prismatic"', 'name="slide" type="floating"', "the joint slide is floating"),
    "a mesh": ("meshes/hand.dae", "meshes/paw.dae", "names the mesh meshes/paw.dae, which is not in"),
    "a package": ("meshes/fore.obj", "meshes/five.obj", "package://arm_description/meshes/five.obj, which is not in"),
    "no XML": ("</robot>", "", None),
    "no pictures": ("<visual>", "<collision>", None),
    "in a circle": ('<parent link="base"/>', '<parent link="fore"/>', None),
}


@pytest.mark.parametrize("case", BAD)
def test_a_bad_urdf_is_one_clear_error(case, path):
    before, after, message = BAD[case]
    text = URDF.replace(before, after)
    if case == "no pictures":
        text = text.replace("</visual>", "</collision>")
    if case == "no XML":
        text = "not a robot"
    path.write_text(text)
    with pytest.raises(rts.InputError) as told:
        load_urdf(path)
    assert "\n" not in str(told.value) and str(path.parent) in str(told.value)
    assert message is None or message in str(told.value)


def test_values_of_unknown_and_missing_joints_are_refused(path, tmp_path):
    robot = load_urdf(path)
    with pytest.raises(rts.InputError, match="no file"):
        load_urdf(tmp_path / "none.urdf")
    with pytest.raises(rts.InputError, match="unknown: wrist; expected one for each of shoulder, elbow, slide, finger"):
        robot.transforms(dict.fromkeys([*JOINTS, "wrist"], 0.0))
    with pytest.raises(rts.InputError, match="missing: elbow"):
        robot.transforms({"shoulder": 0.0, "slide": 0.0, "finger": 0.0})
    with pytest.raises(rts.InputError, match=r"shape \(3,\); expected \(4,\)"):
        robot.transforms([0.0, 0.0, 0.0])


def test_the_panda_is_read_whole():
    path = Path(sysconfig.get_paths()["purelib"]) / PANDA
    if not path.is_file():
        pytest.skip("the Panda is not there: pip install --no-deps example-robot-data")
    robot, other = load_urdf(path), yourdfpy.URDF.load(str(path), load_meshes=False)
    q = np.array([0.3, -0.5, 0.2, -2.0, 0.3, 1.8, 0.6, 0.02])
    other.update_cfg(q)
    for link, matrix in zip(robot.links, robot.transforms(q), strict=True):
        np.testing.assert_allclose(matrix, other.get_transform(link), atol=1e-12)
    assert len(robot.meshes) == 11 and len(robot.names) == 8
    colors = np.concatenate([mesh.colors for mesh in robot.meshes])
    assert len(np.unique(colors.round(2), axis=0)) > 3
