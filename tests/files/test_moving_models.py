"""Models that move: `rts.load_model`, clips and poses, and what is refused of them."""

import json

import numpy as np
import pytest
from gltf_accessors import stored, viewed
from helpers import DIFFERENTIABLE, arrays, rotation, to_numpy
from PIL import Image, ImageSequence
from typer.testing import CliRunner

import rts
from rts import InputError
from rts.errors import FileWarning
from rts.results import Channel, Clip
from rts_cli.clip_frames import frames_of
from rts_cli.main import app

pytestmark = pytest.mark.files

VERTICES = np.array([(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (1, 2, 0), (0, 2, 0)], np.float32)
FACES = np.array([(0, 1, 2), (0, 2, 3), (3, 2, 4), (3, 4, 5)], np.uint16)
BOUNDS = {"min": [0, 0, 0], "max": [1, 2, 0]}
HALF = np.sqrt(0.5)


class Bar:
    """A glTF of a bar: nodes 0 (the mesh), 1 and 2 (its joints, the second 1 above the first), and a clip."""

    def __init__(self):
        self.tree = {}
        weights = np.array([(1, 0, 0, 0), (1, 0, 0, 0), (0.5, 0.5, 0, 0), (0.5, 0.5, 0, 0), (0, 1, 0, 0), (0, 1, 0, 0)])
        joints = np.tile(np.array([0, 1, 0, 0], np.uint8), (6, 1))
        above = np.tile(np.eye(4), (2, 1, 1))
        above[1, 1, 3] = -1
        attributes = {"POSITION": self.add(VERTICES, **BOUNDS)}
        attributes |= {"JOINTS_0": self.add(joints), "WEIGHTS_0": self.add(weights)}
        self.primitive = {"attributes": attributes, "indices": self.add(FACES.reshape(-1))}
        self.skin = {"joints": [1, 2], "inverseBindMatrices": self.add(above.swapaxes(1, 2).reshape(2, 16))}
        times, turns = self.add(np.array([0.0, 1, 2])), np.array([(0, 0, 0, 1), (0, 0, HALF, HALF), (0, 0, 0, 1)])
        self.sampler = {"input": times, "output": self.add(turns)}
        self.clip = {
            "name": "wave",
            "channels": [{"sampler": 0, "target": {"node": 2, "path": "rotation"}}],
            "samplers": [self.sampler],
        }
        self.nodes = [{"mesh": 0, "skin": 0, "translation": [9, 9, 9]}, {"children": [2]}, {"translation": [0, 1, 0]}]
        self.more = {}

    def add(self, rows, **more):
        return stored(self.tree, rows.astype(np.float32) if rows.dtype.kind == "f" else rows, **more)

    def written(self, folder):
        tree = {
            "asset": {"version": "2.0"},
            "scene": 0,
            "scenes": [{"nodes": [0, 1]}],
            "nodes": self.nodes,
            "meshes": [{"primitives": [self.primitive]}],
            "skins": [self.skin],
            "animations": [self.clip],
            **self.tree,
            **self.more,
        }
        path = folder / "bar.gltf"
        path.write_text(json.dumps(tree))
        return path


@pytest.fixture
def bar():
    return Bar()


def test_a_model_and_its_parts_are_shown_in_short(bar, tmp_path):
    model = rts.load_model(bar.written(tmp_path))
    assert repr(model) == "Model(1 part, 3 nodes, 1 skin, 1 clip)"
    assert "'vertices': float32 (6, 3)" in repr(model.parts[0]) and len(repr(model.parts[0])) < 400


def posed(model, *when):
    part = model.posed(model.pose(*when))[0]
    return part.surface.posed(part.theta)


def test_a_bar_is_bent_by_its_clip_about_the_joint(bar, tmp_path):
    model = rts.load_model(bar.written(tmp_path))
    assert [node.parent for node in model.nodes] == [-1, -1, 1]
    assert model.clips[0].duration == 2 and model.bindings == ((0, 0),)
    # The place of the mesh's own node does not matter, since joints have places in the scene.
    np.testing.assert_allclose(posed(model), VERTICES, atol=1e-6)
    bent = posed(model, "wave", 1.0)
    np.testing.assert_allclose(bent[4:], [(-1, 2, 0), (-1, 1, 0)], atol=1e-6)
    np.testing.assert_allclose(bent[2:4], [(0.5, 1.5, 0), (0, 1, 0)], atol=1e-6)
    # Rotations go evenly along the arc.
    turned = rotation((0, 0, 1), 30)[:3, :3] @ (VERTICES[4] - [0, 1, 0]) + [0, 1, 0]
    np.testing.assert_allclose(posed(model, 0, 1 / 3)[4], turned, atol=1e-6)
    np.testing.assert_array_equal(posed(model, 0, 7), posed(model, 0, 2))


def test_load_leaves_motion_out_and_says_so_once(bar, tmp_path):
    with pytest.warns(FileWarning, match="has skins and clips, which are left out; rts.load_model") as caught:
        parts = rts.load(bar.written(tmp_path))
    assert len(caught) == 1
    np.testing.assert_array_equal(parts[0].transform[:3, 3], [9, 9, 9])


def test_nodes_without_a_skin_carry_their_parts_and_morph_targets(bar, tmp_path):
    bar.primitive["attributes"] = {"POSITION": bar.primitive["attributes"]["POSITION"]}
    bar.primitive["targets"] = [{"POSITION": bar.add(np.float32(VERTICES * 2))}, {"POSITION": bar.add(-VERTICES)}]
    bar.nodes = [{"children": [1]}, {"mesh": 0, "translation": [0, 1, 0]}]
    bar.more = {"skins": []}
    channels = [{"sampler": 0, "target": {"node": 0, "path": "rotation"}}]
    channels += [{"sampler": 1, "target": {"node": 1, "path": "weights"}}]
    weights = {"input": bar.sampler["input"], "output": bar.add(np.array([0, 0, 1, 0.5, 0, 1.0]))}
    bar.clip |= {"channels": channels, "samplers": [bar.sampler, weights]}
    bar.more["scenes"] = [{"nodes": [0]}]
    model = rts.load_model(bar.written(tmp_path))
    part = model.posed(model.pose("wave", 1.0))[0]
    np.testing.assert_allclose(part.surface.posed(part.theta), 2.5 * VERTICES)
    np.testing.assert_allclose(part.transform[:3, 3], [-1, 0, 0], atol=1e-7)
    np.testing.assert_allclose(posed(model, "wave", 0.5), 1.75 * VERTICES)


def test_displacements_of_morph_targets_may_be_sparse(bar, tmp_path):
    places, moved = np.array([2, 5], np.uint16), np.float32([(0, 0, 3), (1, 0, 0)])
    first, second = ({"bufferView": viewed(bar.tree, x.tobytes())} for x in (places, moved))
    sparse = {"count": 2, "indices": {**first, "componentType": 5123}, "values": second}
    bar.tree["accessors"].append({"componentType": 5126, "count": 6, "type": "VEC3", "sparse": sparse})
    bar.primitive["targets"] = [{"POSITION": len(bar.tree["accessors"]) - 1}]
    model = rts.load_model(bar.written(tmp_path), weld=False)
    wanted = np.zeros((1, 6, 3))
    wanted[0, places] = moved
    np.testing.assert_array_equal(model.parts[0].theta["morph_vertices"], wanted)


def test_interpolation_by_steps_and_by_cubics():
    times, values = np.array([1.0, 3.0]), np.array([[0.0], [8.0]])
    assert [Channel(0, "weights", times, values, "STEP").at(t)[0] for t in (0, 1, 2.9, 3, 9)] == [0, 0, 0, 8, 8]
    # A cubic with the derivatives of t² at both ends is t².
    cubic = Channel(0, "weights", times, np.array([[[0], [1], [2]], [[6], [9], [0]]], float), "CUBICSPLINE")
    np.testing.assert_allclose([cubic.at(t)[0] for t in (1, 1.5, 2, 2.7, 3)], np.square([1, 1.5, 2, 2.7, 3]))
    # Of two quaternions that stand for the same turn, the nearer is taken.
    turn = np.array([0, 0, HALF, HALF])
    there = [Channel(0, "rotation", times, np.stack([[0, 0, 0, 1], x])).at(2.0) for x in (turn, -turn)]
    np.testing.assert_allclose(there, np.tile([0, 0, np.sin(np.pi / 8), np.cos(np.pi / 8)], (2, 1)))
    assert Clip("", ()).duration == 0


@pytest.mark.parametrize("target", DIFFERENTIABLE)
def test_parts_are_differentiable_in_the_transforms_of_a_pose(bar, tmp_path, target):
    model = rts.load_model(bar.written(tmp_path))
    pose = model.pose("wave", 1.0)
    moved = pose.transforms.copy()
    moved[1, :3, 3] += [1, 2, 3]
    part = model.posed(pose._replace(transforms=arrays(target, moved)))[0]
    np.testing.assert_allclose(to_numpy(part.surface.posed(part.theta)), posed(model, 0, 1) + [1, 2, 3], atol=1e-5)


DAMAGES = {
    "joints out of range": (
        lambda bar: bar.primitive["attributes"].update(JOINTS_0=bar.add(np.full((6, 4), 2, np.uint8))),
        "vertex 0 of the mesh of node 0 has joint 2, and its skin has 2",
    ),
    "a joint that is no node": (lambda bar: bar.skin.update(joints=[1, 7]), "skin 0 has the joints"),
    "few matrices": (
        lambda bar: bar.skin.update(inverseBindMatrices=bar.add(np.eye(4).reshape(1, 16))),
        "expected 2, one a joint",
    ),
    "a singular matrix": (
        lambda bar: bar.skin.update(inverseBindMatrices=bar.add(np.tile(np.diag([1.0, 1, 0, 1]).reshape(16), (2, 1)))),
        "inverse bind matrix of joint 0 of skin 0 is singular",
    ),
    "no such skin": (lambda bar: bar.nodes[0].update(skin=3), "node 0 has skin 3"),
    "negative weights": (
        lambda bar: bar.primitive["attributes"].update(WEIGHTS_0=bar.add(np.tile([2.0, -1, 0, 0], (6, 1)))),
        "the weight -1 of a joint",
    ),
    "joints without weights": (lambda bar: bar.primitive["attributes"].pop("WEIGHTS_0"), "without WEIGHTS_0"),
    "times out of order": (lambda bar: bar.sampler.update(input=bar.add(np.array([0.0, 2, 1]))), "not in order"),
    "few key frames": (
        lambda bar: bar.sampler.update(input=bar.add(np.array([0.0, 2]))),
        "12 numbers for 2 key frames",
    ),
    "an unknown interpolation": (lambda bar: bar.sampler.update(interpolation="CUBIC"), "interpolation 'CUBIC'"),
    "a clip of no node": (lambda bar: bar.clip["channels"][0]["target"].update(node=5), "moves node 5"),
    "a clip twice": (lambda bar: bar.clip["channels"].append(bar.clip["channels"][0]), "two channels for rotation"),
    "weights of no targets": (lambda bar: bar.clip["channels"][0]["target"].update(path="weights"), "is of VEC4"),
    "a rotation of zero": (lambda bar: bar.sampler.update(output=bar.add(np.zeros((3, 4)))), "a rotation of length 0"),
    "sparse matrices": (
        lambda bar: bar.tree["accessors"][bar.skin["inverseBindMatrices"]].update(sparse={}),
        "'count' is missing",
    ),
    "displacements of other rows": (
        lambda bar: bar.primitive.update(targets=[{"POSITION": bar.add(np.zeros((5, 3)))}]),
        "has 5 rows, and POSITION 6",
    ),
    "no accessor": (lambda bar: bar.sampler.update(output=99), "is accessor 99"),
}


@pytest.mark.parametrize("name", DAMAGES)
def test_damaged_motion_is_refused_by_name(bar, tmp_path, name):
    change, message = DAMAGES[name]
    change(bar)
    with pytest.raises(InputError, match=message):
        rts.load_model(bar.written(tmp_path))


def test_weights_are_scaled_to_sum_to_1_with_a_warning(bar, tmp_path):
    weights = np.tile([0.25, 0.25, 0, 0], (6, 1))
    weights[5] = 0
    bar.primitive["attributes"]["WEIGHTS_0"] = bar.add(weights)
    with pytest.warns(
        FileWarning, match="6 vertices of the mesh of node 0 have weights that do not sum to 1"
    ) as caught:
        model = rts.load_model(bar.written(tmp_path))
    assert len(caught) == 1
    expected = np.tile([0.5, 0.5, 0, 0], (6, 1))
    expected[5] = [1, 0, 0, 0]
    np.testing.assert_array_equal(model.parts[0].theta["joint_weights"], expected)


def test_missing_matrices_are_the_identity(bar, tmp_path):
    bar.skin.pop("inverseBindMatrices")
    model = rts.load_model(bar.written(tmp_path))
    np.testing.assert_array_equal(model.skins[0].inverse_bind_matrices, np.tile(np.eye(4), (2, 1, 1)))


@pytest.mark.filterwarnings("ignore:.*faces have the corners of another one")
def test_vertices_that_coincide_are_welded_only_if_they_move_alike(bar, tmp_path):
    twice = np.concatenate([VERTICES, VERTICES])
    bar.primitive["attributes"] = {"POSITION": bar.add(twice, **BOUNDS)}
    bar.primitive["indices"] = bar.add(np.concatenate([FACES, FACES + 6]).reshape(-1))
    moves = np.zeros((12, 3), np.float32)
    moves[6] = 1
    bar.primitive["targets"] = [{"POSITION": bar.add(moves)}]
    model = rts.load_model(bar.written(tmp_path))
    assert len(model.parts[0].theta["vertices"]) == 7
    assert len(rts.load_model(bar.written(tmp_path), weld=False).parts[0].theta["vertices"]) == 12


def test_wrong_clips_times_and_poses_are_refused(bar, tmp_path):
    model = rts.load_model(bar.written(tmp_path))
    for clip, time, message in (("walk", 0.0, r"its index: 0 \('wave'\)"), (1, 0.0, "index"), (0, np.inf, "time is")):
        with pytest.raises(InputError, match=message):
            model.pose(clip, time)
    with pytest.raises(InputError, match=r"expected \(3, 4, 4\)"):
        model.posed(model.pose()._replace(transforms=np.eye(4)))
    (tmp_path / "a.obj").write_text("v 0 0 0\n")
    with pytest.raises(InputError, match="no model that moves"):
        rts.load_model(tmp_path / "a.obj")


@pytest.mark.parametrize(("name", "count"), [("RiggedSimple", 1), ("AnimatedMorphCube", 1), ("BrainStem", 59)])
def test_real_models_move(data, name, count):
    model = rts.load_model(data / "gltf" / f"{name}.glb")
    assert len(model.parts) == count
    ends = [posed(model, 0, share * model.clips[0].duration) for share in (0.0, 0.3, 0.6)]
    assert all(np.isfinite(x).all() for x in ends) and np.abs(ends[0] - ends[1]).max() > 1e-3


def test_a_walking_man_keeps_his_height_and_feet_on_the_ground(data):
    with pytest.warns(FileWarning, match="do not sum to 1"):
        model = rts.load_model(data / "gltf" / "CesiumMan.glb")
    for share in np.linspace(0, 1, 5):
        y = posed(model, 0, share * model.clips[0].duration)[:, 1]
        assert 1.3 < np.ptp(y) < 1.6 and abs(y.min()) < 0.15


def test_a_model_has_the_lights_and_cameras_of_its_file(tmp_path):
    bar = Bar()
    bar.nodes[0] |= {"extensions": {"KHR_lights_punctual": {"light": 0}}, "camera": 0}
    bar.more = {
        "extensions": {"KHR_lights_punctual": {"lights": [{"type": "point", "intensity": float(np.pi)}]}},
        "cameras": [{"type": "perspective", "perspective": {"yfov": 0.8, "znear": 0.1}}],
    }
    model = rts.load_model(bar.written(tmp_path))
    np.testing.assert_array_equal(model.lights["position"], [[9, 9, 9]])
    np.testing.assert_allclose(model.lights["intensity"], [[1, 1, 1]])
    np.testing.assert_allclose(np.linalg.inv(model.cameras[0].view)[:3, 3], [9, 9, 9])
    plain = rts.load_model(Bar().written(tmp_path))
    assert plain.lights == {} and plain.cameras == ()


def test_frames_in_which_a_clip_hides_everything_are_background(tmp_path):
    bar = Bar()
    bar.nodes[0] = {"mesh": 0}
    del bar.primitive["attributes"]["JOINTS_0"], bar.primitive["attributes"]["WEIGHTS_0"]
    sizes = np.array([(1, 1, 1), (0, 0, 0), (1, 1, 1)])
    bar.sampler |= {"output": bar.add(sizes.astype(float)), "interpolation": "STEP"}
    bar.clip["channels"][0]["target"] = {"node": 0, "path": "scale"}
    model, options = str(bar.written(tmp_path)), ["--clip", "wave", "--size", "16"]
    done = CliRunner().invoke(app, ["render", model, *options, "-o", str(tmp_path / "a.gif")])
    assert done.exit_code == 0, done.output
    with Image.open(tmp_path / "a.gif") as frames:
        shown = [bool(np.ptp(np.asarray(f.convert("RGB")), axis=(0, 1)).any()) for f in ImageSequence.Iterator(frames)]
    assert shown[0] and not all(shown)
    with pytest.raises(InputError, match="hides all parts then; choose another time"):
        frames_of(bar.written(tmp_path), "wave", 1.5, False)
