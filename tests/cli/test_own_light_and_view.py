"""The lights and cameras of a glTF, as `rts render` takes them."""

import base64
import json
import warnings

import numpy as np
import pytest
import trimesh
from helpers import crooked_block
from trimesh.exchange.gltf import export_gltf
from typer.testing import CliRunner

import rts
from rts_cli import main as cli

pytestmark = pytest.mark.files

LIGHTS = "KHR_lights_punctual"
MOVES = np.concatenate([[0, 1], [0, 0, 0], [0.1, 0, 0]]).astype(np.float32)
"""Two times, and the translations of a clip then."""


def run(*arguments, code=0):
    result = CliRunner().invoke(cli.app, [str(a) for a in arguments])
    assert result.exit_code == code, result.output
    return result.stderr if code else " ".join(result.output.split())


def error(model, *options, code=1):
    return run("render", model, "-o", model.parent / "a.png", *options, code=code)


@pytest.fixture
def tree(tmp_path):
    """The entries of a glTF: a block, a red lamp at +z, a tall camera "Side" at +x, a nameless one at +z, and a clip.

    `written` makes a file of them.
    """
    files = export_gltf(trimesh.Scene(trimesh.load(crooked_block(tmp_path))))
    entries = json.loads(files.pop("model.gltf"))
    for name, content in files.items():
        (tmp_path / name).write_bytes(content)
    first = len(entries["nodes"])
    quarter = [0, np.sqrt(0.5), 0, np.sqrt(0.5)]
    entries["nodes"] += [
        {"name": "Lamp", "extensions": {LIGHTS: {"light": 0}}},
        {"name": "Side", "camera": 0, "translation": [6, 0, 0], "rotation": quarter},
        {"camera": 1, "translation": [0, 0, 6]},
    ]
    entries["scenes"] = [{"nodes": [entries["scenes"][0]["nodes"][0], first, first + 1, first + 2]}]
    entries["extensions"] = {LIGHTS: {"lights": [{"type": "directional", "color": [1, 0, 0], "intensity": 2}]}}
    seen = {"yfov": 0.8, "znear": 0.1}
    entries["cameras"] = [{"type": "perspective", "perspective": x} for x in ({**seen, "aspectRatio": 0.5}, seen)]
    buffer, view = len(entries["buffers"]), len(entries["bufferViews"])
    uri = "data:;base64," + base64.b64encode(MOVES.tobytes()).decode()
    entries["buffers"] += [{"uri": uri, "byteLength": MOVES.nbytes}]
    entries["bufferViews"] += [{"buffer": buffer, "byteOffset": a, "byteLength": b} for a, b in ((0, 8), (8, 24))]
    table = {"componentType": 5126, "count": 2}
    times, places = len(entries["accessors"]), len(entries["accessors"]) + 1
    entries["accessors"] += [
        {**table, "bufferView": view, "type": "SCALAR", "min": [0], "max": [1]},
        {**table, "bufferView": view + 1, "type": "VEC3"},
    ]
    moved = next(i for i, node in enumerate(entries["nodes"]) if "mesh" in node)
    entries["nodes"][moved].pop("matrix", None)
    channel = {"sampler": 0, "target": {"node": moved, "path": "translation"}}
    entries["animations"] = [{"channels": [channel], "samplers": [{"input": times, "output": places}]}]
    return entries


def written(tree, folder):
    (folder / "m.gltf").write_text(json.dumps(tree))
    return folder / "m.gltf"


@pytest.fixture
def still(tree, tmp_path):
    """The path of the file without its clip."""
    del tree["animations"]
    return written(tree, tmp_path)


def picture(model, *options):
    run("render", model, "-o", model.parent / "a.hdr", "--shader", "lambert", *options)
    return rts.load_image(model.parent / "a.hdr")


def test_a_file_is_lit_by_its_own_lights_unless_an_option_tells_another(still):
    own = picture(still, "--size", 24)
    assert own[..., 0].max() > 0.3 and own[..., 1:3].max() == 0
    rts.save_image(still.parent / "sky.hdr", np.ones((16, 32, 3), np.float32))
    for option in (["--shadows"], ["--environment", still.parent / "sky.hdr"]):
        image = picture(still, "--size", 24, *option)
        np.testing.assert_allclose(image[..., 0], image[..., 1], atol=0.01)
        assert image[..., 1].max() > 0.3


def test_damaged_lights_and_cameras_do_no_harm_where_they_are_not_taken(tree, tmp_path):
    del tree["animations"]
    tree["extensions"][LIGHTS]["lights"][0]["type"] = "sun"
    tree["cameras"][0]["perspective"]["znear"] = 0
    path = written(tree, tmp_path)
    picture(path, "--size", 8, "--shadows")
    assert "is of type 'sun'" in error(path)
    assert "makes no image" in error(path, "--shadows", "--camera", "file")


@pytest.mark.parametrize(("choice", "number"), [("file", 0), ("file:Side", 0), ("file:0", 0), ("file:1", 1)])
def test_the_view_is_that_of_the_camera_of_the_file_which_is_chosen(still, choice, number):
    size = ["--size", 24] if number else []
    image = picture(still, "--camera", choice, *size)
    model = rts.load_model(still)
    parts = [part.replace(theta={**part.theta, "light": model.lights}, shader="lambert") for part in model.parts]
    expected = rts.render(parts, model.cameras[number], image.shape[:2])
    np.testing.assert_allclose(image[..., :3], expected[..., :3], atol=0.01)
    assert model.camera_names == ("Side", "") and 0.05 < expected[..., 3].mean() < 0.9


def test_a_picture_without_a_size_has_the_ratio_of_the_camera_if_it_has_one(still):
    common = "render", still, "-o", still.parent / "a.png", "--splatter", "none", "--camera"
    assert "128 x 256 pixels" in run(*common, "file")
    assert "256 x 256 pixels" in run(*common, "file:1")


def test_unasked_the_view_is_the_automatic_one(still):
    np.testing.assert_array_equal(picture(still, "--size", 24), picture(still, "--size", 24, "--camera", "30,20"))


def test_cameras_that_are_not_there_are_one_line_that_names_those_that_are(still, tmp_path):
    said = error(still, "--camera", "file:Top")
    assert said == f"rts: 'Top' is no camera of {still}; expected the name of one, or its number: 0 ('Side'), 1\n"
    without = crooked_block(tmp_path)
    assert f"{without} has no camera; expected angles" in error(without, "--camera", "file")
    for option, value in (("--fov", "30"), ("--up", "z")):
        said = error(still, "--camera", "file:Side", option, value, code=2)
        assert f"{option} beside --camera file:Side, which says it already" in said


def test_clips_have_the_lights_and_cameras_of_the_file(tree, tmp_path):
    path = written(tree, tmp_path)
    common = "--clip", "0", "--camera", "file:1", "--size", 24
    first, later = (picture(path, *common, "--time", time) for time in (0, 1))
    assert first[..., 0].max() > 0.3 and first[..., 1:3].max() == 0 and np.abs(first - later).max() > 0.1


def test_what_is_still_left_out_is_told_of(tree, tmp_path):
    path = written(tree, tmp_path)
    with warnings.catch_warnings():
        warnings.simplefilter("default")  # As in a program; the tests' own filter makes errors of warnings.
        result = CliRunner().invoke(cli.app, ["render", str(path), "-o", str(tmp_path / "a.png"), "--size", "8"])
    assert result.stderr == f"rts: warning: {path} has clips, which are left out; rts.load_model reads them\n"
