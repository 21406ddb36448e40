"""Models in the viewer: parts as triangles, the files that browsers are sent, and the command `rts view`."""

import http.client
import io
import json
import os
import signal
import struct
import subprocess
import sys
from contextlib import closing

import numpy as np
import pytest
import trimesh
from PIL import Image
from rts_viewer.glb import Triangles, glb, smooth_normals
from rts_viewer.model import triangles_of
from rts_viewer.pictures import png
from typer.testing import CliRunner
from viewed import RED, ball, free_port, view, watching

import rts
from rts_cli.main import app

pytestmark = pytest.mark.files

SQUARE = np.float32([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
HALVES = np.array([[0, 1, 2], [0, 2, 3]])


def read(data):
    """The only mesh of a file, as another reader has it, and the file's tables."""
    scene = trimesh.load(io.BytesIO(data), file_type="glb", process=False)
    (mesh,) = scene.geometry.values()
    length = struct.unpack("<I", data[12:16])[0]
    return mesh, json.loads(data[20 : 20 + length])


def test_another_reader_finds_the_mesh_in_the_file():
    vertices, faces, colors = ball(cuts=3)
    mesh, tables = read(glb(Triangles(vertices, faces, colors=colors)))
    np.testing.assert_array_equal(mesh.vertices, vertices)
    np.testing.assert_array_equal(mesh.faces, faces)
    np.testing.assert_allclose(mesh.vertex_normals, vertices, atol=0.02)  # A sphere's normals.
    np.testing.assert_allclose(mesh.visual.vertex_attributes["color"], colors)
    assert tables["materials"][0]["alphaMode"] == "OPAQUE" and tables["materials"][0]["doubleSided"]


def test_a_texture_keeps_its_place_and_colours():
    texture = np.zeros((2, 2, 3), np.float32)
    texture[0, 0] = (0.5, 0, 0)  # At the top left, where u is 0 and v is 1.
    mesh, tables = read(glb(Triangles(SQUARE, HALVES, uv=SQUARE[:, :2], texture=texture, wrap="clamp")))
    np.testing.assert_allclose(mesh.visual.uv, SQUARE[:, :2])  # trimesh has v upwards, too.
    assert np.asarray(mesh.visual.material.baseColorTexture)[0, 0, :3].tolist() == [188, 0, 0]
    assert tables["samplers"][0]["wrapS"] == 33071


@pytest.mark.parametrize("where", ["colors", "factor", "texture"])
def test_what_lets_light_through_is_blended(where):
    values = {"colors": np.full((4, 4), 0.5), "factor": (1, 1, 1, 0.5), "texture": np.full((2, 2, 4), 0.5)}
    _, tables = read(glb(Triangles(SQUARE, HALVES, uv=SQUARE[:, :2], **{where: values[where]})))
    assert tables["materials"][0]["alphaMode"] == "BLEND"


def test_normals_are_weighted_by_area():
    vertices = np.float32([[0, 0, 0], [2, 0, 0], [0, 3, 0], [0, 0, 1]])
    normals = smooth_normals(vertices, np.array([[0, 1, 2], [0, 3, 1]]))
    np.testing.assert_allclose(normals[0], (0, 2, 6))  # Twice the areas: 6 upright, 2 sideways.
    np.testing.assert_allclose(normals[2], (0, 0, 6))


# ----------------------------------------------------------------------------------------------------- parts


def test_colours_with_a_table_of_their_own_go_to_corners():
    colors = np.float32([[1, 0, 0], [0, 1, 0]])
    table = np.array([[0, 0, 0], [1, 1, 1]])
    part = rts.Part(rts.Mesh(HALVES, {"colors": table}), {"vertices": SQUARE, "colors": colors}, "unlit")
    mesh = triangles_of(part)
    np.testing.assert_allclose(mesh.vertices[mesh.faces], SQUARE[HALVES])
    np.testing.assert_allclose(mesh.colors[mesh.faces], colors[table])


def test_a_transform_moves_and_a_mirror_turns_triangles_round():
    vertices, faces, _ = ball()
    matrix = np.diag([-2.0, 1, 1, 1])
    matrix[:3, 3] = (5, 0, 0)
    theta = {"vertices": vertices, "normals": vertices}
    mesh = triangles_of(rts.Part(rts.Mesh(faces), theta, "unlit", transform=matrix))
    solid = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    assert solid.volume == pytest.approx(2 * trimesh.Trimesh(vertices, faces).volume, rel=1e-5)
    assert mesh.vertices.mean(axis=0) == pytest.approx((5, 0, 0), abs=1e-5)
    outward = mesh.normals / np.linalg.norm(mesh.normals, axis=1, keepdims=True)
    expected = (vertices * (-1, 2, 2)) / np.linalg.norm(vertices * (-1, 2, 2), axis=1, keepdims=True)
    np.testing.assert_allclose(outward, expected, atol=1e-5)  # An ellipsoid's.


def test_alpha_counts_only_for_shaders_that_are_not_opaque():
    theta = {"vertices": SQUARE, "colors": np.full((4, 4), 0.5, np.float32)}
    shader = rts.plugin("shaders", "unlit")
    for opaque, channels in ((True, 3), (False, 4)):
        assert triangles_of(rts.Part(rts.Mesh(HALVES), theta, shader(opaque=opaque))).colors.shape == (4, channels)


@pytest.mark.thorough
def test_surfaces_other_than_meshes_are_shown_by_their_shape():
    part = rts.plugin("surfaces", "bspline").example()
    mesh = triangles_of(part)
    assert len(mesh.faces) > 100 and mesh.faces.max() < len(mesh.vertices) and mesh.colors is None


# ----------------------------------------------------------------------------------------------- the command


@pytest.fixture
def model(tmp_path):
    """A file of two parts, one of them moved, and a folder with a view."""
    vertices, faces, _ = ball()
    scene = trimesh.Scene()
    for name, shift in (("left", -2), ("right", 2)):
        matrix = np.eye(4)
        matrix[0, 3] = shift
        scene.add_geometry(trimesh.Trimesh(vertices, faces, process=False), node_name=name, transform=matrix)
    scene.export(tmp_path / "two.glb")
    seen = view((3, 1, 0), RED, (24, 32))
    rts.save_image(tmp_path / "seen.png", seen.image)
    named = rts.View(seen.camera, seen.image, name="seen.png", path=tmp_path / "seen.png")
    rts.save_views(tmp_path / "transforms.json", [named])
    return tmp_path / "two.glb"


@pytest.mark.thorough
def test_the_command_shows_a_model_until_it_is_interrupted(model):
    port = free_port()
    words = [sys.executable, "-m", "rts", "view", str(model), "--port", str(port), "--views", str(model.parent)]
    process = subprocess.Popen(
        words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env={**os.environ, "COLUMNS": "40"}
    )
    first = process.stdout.readline()
    assert first == f"http://127.0.0.1:{port} shows two.glb, 640 triangles, 1 cameras; Ctrl-C ends it\n", first
    for name, status in (("127.0.0.1", 200), ("evil.example", 403)):
        with closing(http.client.HTTPConnection("127.0.0.1", port, timeout=10)) as connection:
            connection.request("GET", "/", headers={"Host": name})
            assert connection.getresponse().status == status
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=60)
    assert (process.returncode, out, err) == (0, "", "")


def test_wrong_use_is_told_in_one_line(model):
    with watching() as watch:
        port = watch.url.rpartition(":")[2]
        for words, code, told in (
            ([str(model), "--port", port], 1, f"port {port} of 127.0.0.1 is in use"),
            ([str(model), "--host", "nowhere.invalid"], 1, "nowhere.invalid"),
            ([str(model), "--up", "x"], 2, "'x' is no axis"),
            (["none.glb", "--port", str(free_port())], 1, "no file none.glb"),
            ([str(model), "--port", str(free_port()), "--views", "nowhere"], 1, "nowhere"),
        ):
            done = CliRunner().invoke(app, ["view", *words])
            assert done.exit_code == code and told in done.output, done.output
            assert done.output.count("\n") == 1 and done.output.startswith("rts: ")


def test_pictures_are_written_as_they_are():
    picture = np.arange(48, dtype=np.uint8).reshape(4, 4, 3)
    np.testing.assert_array_equal(np.asarray(Image.open(io.BytesIO(png(picture)))), picture)
