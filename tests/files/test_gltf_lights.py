"""Lights and cameras of glTF."""

import base64
import json

import numpy as np
import pytest

import rts
from rts.files.gltf_cameras import read_cameras
from rts.files.gltf_lights import read_lights
from rts.files.gltf_tree import Gltf

pytestmark = pytest.mark.files


def opened(folder, **tree):
    """A glTF of these entries, all of whose nodes are shown."""
    nodes = tree["nodes"]
    below = {child for node in nodes for child in node.get("children", [])}
    roots = [i for i in range(len(nodes)) if i not in below]
    data = json.dumps({"asset": {"version": "2.0"}, "scenes": [{"nodes": roots}], **tree}).encode()
    return Gltf(folder / "m.gltf", data, lambda name: b"")


def lit(folder, lights, nodes):
    """A glTF with lights; each node has the light of its number."""
    nodes = [{**node, "extensions": {"KHR_lights_punctual": {"light": i}}} for i, node in enumerate(nodes)]
    return opened(folder, extensions={"KHR_lights_punctual": {"lights": lights}}, nodes=nodes)


QUARTER_ABOUT_X = [np.sqrt(0.5), 0, 0, np.sqrt(0.5)]
QUARTER_ABOUT_Y = [0, np.sqrt(0.5), 0, np.sqrt(0.5)]


def test_lights_are_in_the_form_that_shaders_read(tmp_path):
    lights = [
        {"type": "directional", "color": [1, 0.5, 0], "intensity": np.pi},
        {"type": "point", "intensity": 2 * np.pi},
        {"type": "directional"},
        {"type": "point", "range": 5},
    ]
    nodes = [{"rotation": QUARTER_ABOUT_Y, "scale": [3, 3, 3]}, {"translation": [1, 2, 3]}, {}, {"children": []}]
    gltf = lit(tmp_path, lights, nodes)
    found = read_lights(gltf)
    assert set(found) == {"direction", "color", "position", "intensity", "ambient"} and found["ambient"] == 0
    order = np.argsort(found["direction"][:, 0])  # Nodes are found in any order.
    np.testing.assert_allclose(found["direction"][order], [[0, 0, 1], [1, 0, 0]], atol=1e-6)
    np.testing.assert_allclose(found["color"][order], [[1 / np.pi] * 3, [1, 0.5, 0]], atol=1e-6)
    order = np.argsort(found["position"][:, 0])
    np.testing.assert_allclose(found["position"][order], [[0, 0, 0], [1, 2, 3]], atol=1e-6)
    np.testing.assert_allclose(found["intensity"][order], [[1 / np.pi] * 3, [2] * 3], atol=1e-6)
    assert gltf.notes == {"lights of limited range, which is not followed": ["the light of node 3"]}


def test_spot_lights_have_an_axis_and_a_cone(tmp_path):
    lights = [
        {"type": "spot", "intensity": np.pi, "spot": {"innerConeAngle": 0.2, "outerConeAngle": 0.5}},
        {"type": "spot", "spot": {}},
        {"type": "point"},
    ]
    nodes = [{"rotation": QUARTER_ABOUT_Y, "scale": [3, 3, 3]}, {"translation": [1, 2, 3]}, {"translation": [2, 0, 0]}]
    found = read_lights(lit(tmp_path, lights, nodes))
    order = np.argsort(found["position"][:, 0])
    np.testing.assert_allclose(found["axis"][order], [[-1, 0, 0], [0, 0, -1], [0, 0, 0]], atol=1e-6)
    np.testing.assert_allclose(found["cone"][order], [[0.2, 0.5], [0, np.pi / 4], [0, np.pi / 4]], atol=1e-6)
    np.testing.assert_allclose(found["intensity"][order][0], [1, 1, 1], atol=1e-6)


def test_a_white_surface_in_one_lux_has_a_radiance_of_one_over_pi(tmp_path):
    light = read_lights(lit(tmp_path, [{"type": "directional"}], [{}]))
    square = np.array([(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)], np.float32)
    part = rts.Part(rts.Mesh([(0, 1, 2), (0, 2, 3)]), {"vertices": square, "light": light}, "lambert")
    image = rts.render(part, rts.Camera.look_at((0, 0, 2), (0, 0, 0)), (4, 4))
    np.testing.assert_allclose(image[2, 2, :3], [1 / np.pi] * 3, rtol=1e-5)


def test_files_without_lights_have_none(tmp_path):
    assert read_lights(opened(tmp_path, nodes=[{}])) == {} and read_cameras(opened(tmp_path, nodes=[{}])) == []


@pytest.mark.parametrize(
    ("light", "node", "message"),
    [
        ({"type": "sun"}, {}, "the light of node 0 is of type 'sun'; expected directional, point or spot"),
        ({"type": "point", "color": [1, 2]}, {}, r"the light of node 0 has color \[1, 2\]"),
        ({"type": "point", "intensity": -1}, {}, "the light of node 0 has intensity -1"),
        ({"type": "point", "intensity": 1e300}, {}, "has intensity 1e.300; expected a number from 0 to 1e.12"),
        ({"type": "point", "intensity": True}, {}, "has intensity True; expected a number"),
        ({"type": "spot", "spot": {"innerConeAngle": 1}}, {}, r"the light of node 0 has the cone \[1, 0.78"),
        ({"type": "spot", "spot": {"outerConeAngle": 2}}, {}, r"the cone \[0.0, 2\]; expected two angles, rising"),
        ({"type": "point"}, {"scale": [1, 1, 0]}, "the transform of the light of node 0 is singular"),
        ({}, {}, "the light of node 0: 'type' is missing"),
    ],
)
def test_wrong_lights_are_refused(tmp_path, light, node, message):
    with pytest.raises(rts.InputError, match=message):
        read_lights(lit(tmp_path, [light], [node]))


def test_cameras_are_those_of_rts(tmp_path):
    cameras = [
        {"type": "perspective", "perspective": {"yfov": 0.8, "znear": 0.1, "zfar": 50, "aspectRatio": 1.5}},
        {"type": "orthographic", "orthographic": {"xmag": 3, "ymag": 2, "znear": 0.1, "zfar": 10}},
        {"type": "perspective", "perspective": {"yfov": 0.8, "znear": 0.1}, "name": "lens"},
    ]
    nodes = [
        {"camera": 0, "translation": [1, 2, 3]},
        {"children": [2], "scale": [2, 4, 2], "translation": [0, 5, 0]},
        {"camera": 1, "rotation": QUARTER_ABOUT_X, "name": "front"},
        {"camera": 2, "translation": [1, 2, 3]},
    ]
    names, found = zip(*read_cameras(opened(tmp_path, cameras=cameras, nodes=nodes)), strict=True)
    assert names == ("", "front", "lens")
    fov = np.degrees(0.8)
    expected = [
        rts.Camera.look_at((1, 2, 3), (1, 2, 0), fov_y=fov, aspect=1.5, near=0.1, far=50),
        rts.Camera.orthographic((0, 5, 0), (0, 6, 0), up=(0, 0, 1), height=4, aspect=1.5, near=0.1, far=10),
        rts.Camera.look_at((1, 2, 3), (1, 2, 0), fov_y=fov, near=0.1, far=1e9),
    ]
    for camera, other in zip(found, expected, strict=True):
        np.testing.assert_allclose(camera.view, other.view, atol=1e-12)
        np.testing.assert_allclose(camera.projection, other.projection, atol=1e-6)
        assert camera.aspect == other.aspect
    assert [float(x) for x in found[2].depth_range()] == [pytest.approx(0.1), np.inf]


@pytest.mark.parametrize(
    ("camera", "message"),
    [
        ({"type": "perspective", "perspective": {"yfov": 4, "znear": 0.1}}, "the camera of node 0 makes no image"),
        ({"type": "perspective", "perspective": {"yfov": 1, "znear": 0}}, "the camera of node 0 makes no image"),
        ({"type": "orthographic", "orthographic": {"xmag": 0, "ymag": 1, "znear": 0, "zfar": 1}}, "makes no image"),
        ({"type": "fisheye"}, "the camera of node 0: 'fisheye' is missing"),
    ],
)
def test_wrong_cameras_are_refused(tmp_path, camera, message):
    with pytest.raises(rts.InputError, match=message):
        read_cameras(opened(tmp_path, cameras=[camera], nodes=[{"camera": 0}]))


# ---------------------------------------------------------------------------------------------- what is left out

CORNERS = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], np.float32).tobytes()
SEEN = {"perspective": {"yfov": 0.8, "znear": 0.1}, "type": "perspective"}


def of_a_triangle(folder, *nodes, shown=None, **tree):
    """The path of a glTF of a triangle, node 0, and further nodes; the scene has all of them, or those `shown`."""
    tree = {
        "asset": {"version": "2.0"},
        "buffers": [{"uri": "data:;base64," + base64.b64encode(CORNERS).decode(), "byteLength": 36}],
        "bufferViews": [{"buffer": 0, "byteLength": 36}],
        "accessors": [{"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3"}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}],
        "nodes": [{"mesh": 0}, *nodes],
        "scenes": [{"nodes": list(range(1 + len(nodes))) if shown is None else shown}],
        "extensions": {"KHR_lights_punctual": {"lights": [{"type": "point"}]}},
        "cameras": [SEEN],
        **tree,
    }
    (folder / "m.gltf").write_text(json.dumps(tree))
    return folder / "m.gltf"


LIT = {"extensions": {"KHR_lights_punctual": {"light": 0}}}
CLIPS = {"animations": [{"channels": [], "samplers": []}]}


@pytest.mark.parametrize(
    ("nodes", "tree", "kinds"),
    [
        ([LIT], {}, "lights"),
        ([{"camera": 0}], {}, "cameras"),
        ([LIT, {"camera": 0}], {}, "lights and cameras"),
        ([{"camera": 0}, LIT], CLIPS, "clips, lights and cameras"),
    ],
)
def test_load_names_lights_and_cameras_that_it_leaves_out_and_load_model_reads_them(tmp_path, nodes, tree, kinds):
    path = of_a_triangle(tmp_path, *nodes, **tree)
    with pytest.warns(rts.errors.FileWarning) as caught:
        rts.load(path)
    what = f"{path} has {kinds}, which are left out; rts.load_model reads them"
    assert [str(warning.message) for warning in caught] == [what]
    model = rts.load_model(path)
    assert bool(model.lights) == ("lights" in kinds) and len(model.cameras) == ("cameras" in kinds)


def test_lights_and_cameras_of_no_node_that_is_shown_are_not_told_of(tmp_path):
    rts.load(of_a_triangle(tmp_path))
    path = of_a_triangle(tmp_path, LIT, {"camera": 0}, shown=[0])
    rts.load(path)
    assert rts.load_model(path).lights == {} and rts.load_model(path).cameras == ()
