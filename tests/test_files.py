import json
import subprocess
import sys

import numpy as np
import pytest
import trimesh
from PIL import Image

import rts
from rts.cli.views import bounds_of, orbit
from rts.errors import EngineError, InputError, PluginError
from rts.files.srgb import decode_srgb, encode_srgb

pytestmark = pytest.mark.files

QUAD = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\n"
QUAD_UV = "vt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\n"
RED, GREEN, BLUE, WHITE = (255, 0, 0), (0, 255, 0), (0, 0, 255), (255, 255, 255)


def write(path, text):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)
    return path


def quadrants(path):
    """A texture with red at the upper left, green upper right, blue lower left and white lower right."""
    pixels = np.zeros((64, 64, 3), np.uint8)
    pixels[:32, :32], pixels[:32, 32:], pixels[32:, :32], pixels[32:, 32:] = RED, GREEN, BLUE, WHITE
    Image.fromarray(pixels).save(path)
    return path


def textured_quad(folder, name="tex.png", mtl="newmtl m\nmap_Kd {}\n"):
    quadrants(folder / name)
    write(folder / "quad.mtl", mtl.format(name))
    return write(folder / "quad.obj", f"mtllib quad.mtl\n{QUAD}{QUAD_UV}usemtl m\nf 1/1 2/2 3/3 4/4\n")


def front_view(parts, size=(64, 64)):
    camera = rts.Camera.orthographic((0.5, 0.5, 2), (0.5, 0.5, 0), height=1.0, far=10.0)
    return rts.render(parts, camera, size, splatter="none")


def corners(image):
    return [tuple(np.round(image[y, x, :3]).astype(int) * 255) for y, x in ((8, 8), (8, 56), (56, 8), (56, 56))]


def message(error):
    text = str(error.value)
    assert "\n" not in text
    return text


# ----------------------------------------------------------------------------------------------- what loads


def test_texture_coordinates_of_one_number_take_nothing_from_the_others(tmp_path):
    (tmp_path / "m.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0.25\nvt 1 0.5 7\nvt 0 1\nf 1/1 2/2 3/3\n")
    (part,) = rts.load(tmp_path / "m.obj")
    np.testing.assert_array_equal(part.theta["uv"], [(0.25, 0), (1, 0.5), (0, 1)])


def test_the_texture_of_an_obj_is_upright(tmp_path):
    [part] = rts.load(textured_quad(tmp_path))
    assert part.shader == rts.plugin("shaders", "textured")()
    assert part.transform is None
    assert corners(front_view(part)) == [RED, GREEN, BLUE, WHITE]


def test_the_texture_of_a_glb_is_upright(tmp_path):
    image = Image.open(quadrants(tmp_path / "tex.png"))
    visual = trimesh.visual.TextureVisuals(
        uv=[[0, 0], [1, 0], [1, 1], [0, 1]],
        material=trimesh.visual.material.PBRMaterial(baseColorTexture=image),
    )
    vertices = [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]
    mesh = trimesh.Trimesh(vertices, [[0, 1, 2], [0, 2, 3]], visual=visual, process=False)
    mesh.export(tmp_path / "quad.glb")
    [part] = rts.load(tmp_path / "quad.glb")
    assert corners(front_view(part)) == [RED, GREEN, BLUE, WHITE]


@pytest.mark.parametrize("name", ["a b.png", "tex.png", "sub/tex.png"])
@pytest.mark.parametrize("line", ["map_Kd {} ", "map_Kd -s 1 1 1 -clamp on {}", "map_kd\t{}\r"])
def test_texture_names_are_found_however_they_are_written(tmp_path, name, line):
    (tmp_path / "sub").mkdir()
    [part] = rts.load(textured_quad(tmp_path, name, f"newmtl m\nKd 0 0 0\n{line}\n"))
    assert part.theta["texture"].shape == (64, 64, 3)
    assert "color" not in part.theta


def test_texture_names_may_have_backslashes(tmp_path):
    (tmp_path / "sub").mkdir()
    path = textured_quad(tmp_path, "sub/tex.png")
    write(tmp_path / "quad.mtl", "newmtl m\nmap_Kd sub\\tex.png\n")
    assert "texture" in rts.load(path)[0].theta


def test_files_may_start_with_a_mark_of_their_encoding(tmp_path):
    for name, text in {
        "m.mtl": "newmtl m\nKd 1 0 0\n",
        "m.obj": f"v 0 0 9\n{QUAD}mtllib m.mtl\nusemtl m\nf 1 2 3\n",
    }.items():
        (tmp_path / name).write_text(text, encoding="utf-8-sig")
    [part] = rts.load(tmp_path / "m.obj")
    np.testing.assert_array_equal(part.theta["vertices"][0], [0, 0, 9])
    np.testing.assert_array_equal(part.theta["color"], [1, 0, 0])


def test_without_welding_the_vertices_are_those_of_the_file(tmp_path):
    rows = "v 9 9 9 0 0 1\n" + "".join(
        f"v {x} {y} 0 1 0 0\n" for x, y in [(0, 0), (1, 0), (1, 1), (1, 0), (1, 1), (2, 0)]
    )
    path = write(tmp_path / "m.obj", rows + QUAD_UV + "usemtl a\nf 2/1 3/2 4/3\nusemtl b\nf 5/4 7/1 6/3\n")
    expected = [[9, 9, 9], [0, 0, 0], [1, 0, 0], [1, 1, 0], [1, 0, 0], [1, 1, 0], [2, 0, 0]]
    a, b = rts.load(path, weld=False)
    for part, face in ((a, [1, 2, 3]), (b, [4, 6, 5])):
        np.testing.assert_array_equal(part.theta["vertices"], expected)
        np.testing.assert_array_equal(part.surface.faces, [face])
        np.testing.assert_array_equal(part.theta["colors"], [[0, 0, 1]] + [[1, 0, 0]] * 6)
    [whole] = rts.load(path, merge=True, weld=False)
    np.testing.assert_array_equal(whole.theta["vertices"], expected)
    np.testing.assert_array_equal(whole.surface.faces, [[1, 2, 3], [4, 6, 5]])
    assert len(rts.load(path, merge=True)[0].theta["vertices"]) == 4
    view = front_view(rts.load(path, merge=True)[0])
    np.testing.assert_allclose(front_view(whole), view)
    np.testing.assert_allclose(front_view([a, b]), view)


def test_without_welding_an_stl_has_three_vertices_a_face(tmp_path):
    trimesh.creation.box().export(tmp_path / "m.stl")
    assert rts.load(tmp_path / "m.stl", weld=False)[0].theta["vertices"].shape == (36, 3)


def test_seams_are_welded_and_uv_keep_their_own_table(tmp_path):
    text = QUAD + "v 1 0 0\nv 1 1 0\nv 2 0 0\n" + QUAD_UV + "vt 0.5 0.5\n"
    [part] = rts.load(write(tmp_path / "m.obj", text + "f 1/1 2/2 3/3\nf 5/5 7/1 6/3\n"))
    np.testing.assert_array_equal(
        part.theta["vertices"], np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [2, 0, 0]], np.float32)
    )
    np.testing.assert_array_equal(part.surface.faces, [[0, 1, 2], [1, 3, 2]])
    assert part.theta["uv"].shape == (4, 2)
    assert part.surface.sample_widths == (6, 2)
    assert {a.dtype for a in part.theta.values()} == {np.dtype(np.float32)}


def test_a_split_mesh_of_another_format_is_welded_too(tmp_path):
    box = trimesh.creation.icosphere(subdivisions=2)
    box.export(tmp_path / "m.stl")
    [part] = rts.load(tmp_path / "m.stl")
    assert part.theta["vertices"].shape == (len(box.vertices), 3)
    assert part.surface.faces.shape == (len(box.faces), 3)
    assert "normals" not in part.theta


def test_vertices_keep_the_order_of_the_file_and_unused_ones_are_dropped(tmp_path):
    [part] = rts.load(write(tmp_path / "m.obj", "v 9 9 9\nv 2 0 0\nv 1 0 0\nv 0 1 0\nf 4 3 2\n"))
    np.testing.assert_array_equal(part.theta["vertices"], np.array([[2, 0, 0], [1, 0, 0], [0, 1, 0]], np.float32))
    np.testing.assert_array_equal(part.surface.faces, [[2, 1, 0]])


def test_only_normals_of_the_file_are_kept(tmp_path):
    mesh = trimesh.creation.icosphere(subdivisions=1)
    mesh.export(tmp_path / "without.ply", vertex_normal=False)
    mesh.export(tmp_path / "with.ply", vertex_normal=True)
    assert "normals" not in rts.load(tmp_path / "without.ply")[0].theta
    [part] = rts.load(tmp_path / "with.ply")
    np.testing.assert_allclose(part.theta["normals"], mesh.vertex_normals, atol=1e-6)


def test_polygons_become_triangles_and_negative_indices_count_back(tmp_path):
    text = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nf -4 -3 -2 -1\n" + "v 0 0 1\nv 1 0 1\nv 1 1 1\nf -3 -2 -1\n"
    [part] = rts.load(write(tmp_path / "m.obj", text))
    np.testing.assert_array_equal(part.surface.faces, [[0, 1, 2], [0, 2, 3], [4, 5, 6]])


def test_comments_continuations_and_colors_of_an_obj(tmp_path):
    text = "v 0 0 0 1 0 0\nv 1 0 0 0 1 0 # tip\nv 0 1 0 0 0.5 1\nf 1 2 \\\n3 # one\n"
    [part] = rts.load(write(tmp_path / "m.obj", text))
    assert part.shader == rts.plugin("shaders", "lambert")()
    expected = [[1, 0, 0], [0, 1, 0], [0, decode_srgb(np.array([0.5]))[0], 1]]
    np.testing.assert_allclose(part.theta["colors"], expected, atol=1e-6)


def test_an_obj_has_one_part_a_material(tmp_path):
    write(
        tmp_path / "m.mtl",
        "newmtl a\nKd 1 0.5 0\nnewmtl b\nKd 1 1 1\nd 0.25\nnewmtl unused\nmap_Kd gone.png\n",
    )
    faces = "usemtl b\nf 1 2 3\nusemtl a\nf 1 3 4\nusemtl b\nf 1 2 4\n"
    b, a = rts.load(write(tmp_path / "m.obj", "mtllib m.mtl\n" + QUAD + faces))
    assert len(b.surface.faces) == 2 and len(a.surface.faces) == 1
    np.testing.assert_allclose(a.theta["color"], [1, 0.2140411, 0], atol=1e-6)
    np.testing.assert_allclose(b.theta["color"], [1, 1, 1, 0.25], atol=1e-6)
    assert a.shader.opaque and not b.shader.opaque
    [whole] = rts.load(tmp_path / "m.obj", merge=True)
    assert len(whole.surface.faces) == 3 and not whole.shader.opaque
    np.testing.assert_allclose(front_view(whole), front_view([b, a]), atol=1e-6)


def test_textures_are_linear_and_their_alpha_makes_the_shader_translucent(tmp_path):
    path = textured_quad(tmp_path)
    Image.fromarray(np.full((2, 2, 4), (128, 255, 0, 51), np.uint8)).save(tmp_path / "tex.png")
    [part] = rts.load(path)
    assert not part.shader.opaque
    np.testing.assert_allclose(part.theta["texture"][0, 0], [0.2158605, 1, 0, 0.2], atol=1e-6)


def test_vertex_and_face_colors_of_a_ply(tmp_path):
    mesh = trimesh.creation.box()
    mesh.visual.vertex_colors = np.tile([128, 0, 255, 255], (8, 1)).astype(np.uint8)
    mesh.export(tmp_path / "vertex.ply")
    [part] = rts.load(tmp_path / "vertex.ply")
    np.testing.assert_allclose(part.theta["colors"], np.tile([0.2158605, 0, 1], (8, 1)), atol=1e-6)
    assert part.shader.opaque
    colors = np.zeros((12, 4), np.uint8)
    colors[:, 0], colors[:, 3] = np.arange(12), 128
    mesh.visual = trimesh.visual.ColorVisuals(face_colors=colors)
    mesh.export(tmp_path / "face.ply")
    [part] = rts.load(tmp_path / "face.ply")
    assert part.theta["colors"].shape == (12, 4) and not part.shader.opaque


def test_scene_graphs_give_one_part_an_instance_with_its_transform(tmp_path):
    scene, box = trimesh.Scene(), trimesh.creation.box()
    shift = trimesh.transformations.translation_matrix([2, 0, 0]) @ np.diag([-1, 1, 1, 1])
    scene.add_geometry(box, node_name="here", geom_name="box")
    scene.add_geometry(box, node_name="there", geom_name="box", transform=shift)
    scene.export(tmp_path / "m.glb")
    parts = rts.load(tmp_path / "m.glb")
    transforms = [p.transform for p in parts if p.transform is not None]
    assert len(parts) == 2 and len(transforms) == 1
    np.testing.assert_allclose(transforms[0], shift)
    [whole] = rts.load(tmp_path / "m.glb", merge=True)
    a, b, c = np.moveaxis(whole.theta["vertices"][whole.surface.faces].astype(float), 1, 0)
    assert np.sum(a * np.cross(b, c)) / 6 == pytest.approx(2.0)
    assert whole.theta["vertices"][:, 0].max() == pytest.approx(2.5)


@pytest.mark.parametrize("kind", ["off", "ply", "glb", "stl"])
def test_other_formats(tmp_path, kind):
    trimesh.creation.box().export(tmp_path / f"m.{kind}")
    [part] = rts.load(str(tmp_path / f"m.{kind}"))
    assert part.theta["vertices"].shape == (8, 3) and len(part.surface.faces) == 12


def test_gltf_colors_are_linear_already(tmp_path):
    mesh = trimesh.creation.box()
    mesh.visual = trimesh.visual.TextureVisuals(
        material=trimesh.visual.material.PBRMaterial(baseColorFactor=[51, 102, 255, 255])
    )
    mesh.export(tmp_path / "m.glb")
    np.testing.assert_allclose(rts.load(tmp_path / "m.glb")[0].theta["color"], [0.2, 0.4, 1], atol=1e-6)


# --------------------------------------------------------------------------------------------- what does not


@pytest.mark.parametrize(
    ("name", "text", "expected"),
    [
        ("m.obj", "", "neither vertices nor faces"),
        ("m.obj", QUAD, "4 vertices but no faces"),
        ("m.obj", QUAD + "f 1 2 5\n", "line 5: a face refers to number 5 of 4 vertices"),
        ("m.obj", QUAD + "f 0 1 2\n", "line 5: a face refers to number 0 of 4 vertices"),
        ("m.obj", QUAD + "f -5 1 2\n", "line 5: the index -5 counts back further"),
        ("m.obj", QUAD + "f 1/1 2/1 3/1\n", "number 1 of 0 texture coordinates"),
        ("m.obj", QUAD + "f 1//1 2//1 3//1\n", "number 1 of 0 normals"),
        ("m.obj", QUAD + "f 1 2\n", "line 5: a face has 2 corners"),
        ("m.obj", QUAD + "f 1 2 x\n", "line 5: 'x' is no index"),
        ("m.obj", "v 0 0 0\nv 1 0\nv 0 1 0\nf 1 2 3\n", "line 2: 'v' has 2 numbers"),
        ("m.obj", "v 0 0 0\nv 1 0 .\nv 0 1 0\nf 1 2 3\n", "line 2: '1 0 .' are not numbers"),
        ("m.obj", "v 0 0 0\nv nan 0 0\nv 0 1 0\nf 1 2 3\n", "1 of 3 rows of vertices are NaN"),
        ("m.obj", "v 0 0 0\nv 1e60 0 0\nv 0 1 0\nf 1 2 3\n", "too large for float32"),
        ("m.xyzzy", "hello", "extension '.xyzzy'"),
        ("m", "hello", "expected obj, ply, stl, glb"),
        ("m.ply", "ply\nformat ascii 1.0\nelement vertex 3\n", "cannot be read as PLY"),
        ("m.off", "OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 7\n", "m.off"),
        ("m.off", "", "cannot be read as OFF"),
        ("m.glb", "glTF", "cannot be read as GLB"),
        ("m.gltf", "{", "cannot be read as GLTF"),
        ("m.stl", "", "m.stl"),
    ],
)
def test_a_bad_file_is_one_clear_line(tmp_path, name, text, expected):
    with pytest.raises(InputError) as error:
        rts.load(write(tmp_path / name, text))
    assert expected in message(error)
    assert str(tmp_path) in message(error)


def test_missing_files_and_folders(tmp_path):
    with pytest.raises(InputError, match="no file .*gone.obj"):
        rts.load(tmp_path / "gone.obj")
    with pytest.raises(InputError, match="is a folder"):
        rts.load(tmp_path)
    with pytest.raises(InputError, match="the path is a int"):
        rts.load(3)


@pytest.mark.parametrize("kind", ["ply", "stl", "glb"])
def test_truncated_binary_files(tmp_path, kind):
    whole = tmp_path / f"m.{kind}"
    trimesh.creation.icosphere(subdivisions=1).export(whole)
    whole.write_bytes(whole.read_bytes()[:-300])
    with pytest.raises(InputError, match=f"(cannot be read as|is not a valid) {kind.upper()}"):
        rts.load(whole)


@pytest.mark.parametrize("kind", ["stl", "off", "xyz"])
def test_bytes_where_text_ought_to_be(tmp_path, kind, monkeypatch):
    monkeypatch.setitem(sys.modules, "charset_normalizer", None)
    path = tmp_path / f"m.{kind}"
    path.write_bytes(bytes(range(128, 256)) * 3)
    with pytest.raises(InputError, match=f"m.{kind} is not a valid {kind.upper()} file.*export it again") as error:
        rts.load(path)
    assert "charset" not in message(error)
    assert isinstance(error.value.__cause__, UnicodeDecodeError)


def test_point_clouds_are_refused(tmp_path):
    trimesh.PointCloud(np.eye(3)).export(tmp_path / "m.ply")
    with pytest.raises(InputError, match="3 points but no faces"):
        rts.load(tmp_path / "m.ply")


def test_indices_out_of_range_in_a_ply(tmp_path):
    header = "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
    header += "element face 1\nproperty list uchar int vertex_indices\nend_header\n"
    with pytest.raises(InputError, match="m.ply"):
        rts.load(write(tmp_path / "m.ply", header + "0 0 0\n1 0 0\n0 1 0\n3 0 1 7\n"))
    with pytest.raises(InputError, match="1 of 3 rows of vertices are NaN"):
        rts.load(write(tmp_path / "n.ply", header + "0 0 0\nnan 0 0\n0 1 0\n3 0 1 2\n"))


@pytest.mark.parametrize("line", ["Kd nan 0 0", "Kd 0 0 inf", "d nan", "Tr -inf"])
def test_materials_that_are_not_finite_are_refused_with_their_line(tmp_path, line):
    write(tmp_path / "m.mtl", f"newmtl m\n\n{line}\n")
    with pytest.raises(InputError, match="m.mtl, line 3: '.*' is not finite"):
        rts.load(write(tmp_path / "m.obj", "mtllib m.mtl\n" + QUAD + "usemtl m\nf 1 2 3\n"))


def test_missing_textures_and_libraries(tmp_path):
    path = textured_quad(tmp_path)
    (tmp_path / "tex.png").write_text("not a picture")
    with pytest.raises(InputError, match="cannot be read as an image"):
        rts.load(path)
    (tmp_path / "tex.png").unlink()
    with pytest.raises(InputError, match="refers to the texture 'tex.png'"):
        rts.load(path)
    (tmp_path / "quad.mtl").unlink()
    with pytest.warns(UserWarning, match="material library 'quad.mtl'"):
        [part] = rts.load(path)
    assert "uv" in part.theta


@pytest.mark.parametrize("name", ["../secret.png", "sub/../../secret.png", "{absolute}", "C:\\secret.png", "link.png"])
@pytest.mark.parametrize("line", ["map_Kd {}", "map_Ks {}", "bump -bm 1 {}"])
def test_files_outside_the_folder_are_refused(tmp_path, name, line):
    secret = quadrants(tmp_path / "secret.png")
    folder = tmp_path / "model"
    (folder / "sub").mkdir(parents=True)
    (folder / "link.png").symlink_to(secret)
    name = name.format(absolute=secret)
    path = textured_quad(folder)
    write(folder / "quad.mtl", "newmtl m\n" + line.format(name) + "\n")
    with pytest.raises(InputError, match="outside its own folder"):
        rts.load(path)


def test_libraries_and_buffers_outside_the_folder_are_refused(tmp_path):
    write(tmp_path / "secret.mtl", "newmtl m\nKd 1 0 0\n")
    folder = tmp_path / "model"
    with pytest.raises(InputError, match="outside its own folder"):
        rts.load(write(folder / "m.obj", "mtllib ../secret.mtl\n" + QUAD + "usemtl m\nf 1 2 3\n"))
    (tmp_path / "secret.bin").write_bytes(bytes(100))
    gltf = {"asset": {"version": "2.0"}, "buffers": [{"uri": "../secret.bin", "byteLength": 100}]}
    with pytest.raises(InputError, match="outside its own folder"):
        rts.load(write(folder / "m.gltf", json.dumps(gltf)))
    gltf["buffers"][0]["uri"] = "gone.bin"
    with pytest.raises(InputError, match="no file .*gone.bin"):
        rts.load(write(folder / "m.gltf", json.dumps(gltf)))


def test_gltf_with_files_of_its_own(tmp_path):
    mesh = trimesh.creation.box()
    for name, content in trimesh.exchange.gltf.export_gltf(trimesh.Scene(mesh)).items():
        (tmp_path / name).write_bytes(content)
    assert len(rts.load(tmp_path / "model.gltf")[0].surface.faces) == 12


def test_different_textures_cannot_be_merged(tmp_path):
    quadrants(tmp_path / "a.png")
    Image.new("RGB", (2, 2)).save(tmp_path / "b.png")
    write(tmp_path / "m.mtl", "newmtl a\nmap_Kd a.png\nnewmtl b\nmap_Kd b.png\n")
    faces = "usemtl a\nf 1/1 2/2 3/3\nusemtl b\nf 1/1 3/3 4/4\n"
    with pytest.raises(InputError, match="different textures"):
        rts.load(write(tmp_path / "m.obj", "mtllib m.mtl\n" + QUAD + QUAD_UV + faces), merge=True)


# ------------------------------------------------------------------------------------------------- pictures


def test_the_srgb_curve_is_exact():
    codes = np.arange(256) / 255
    np.testing.assert_allclose(encode_srgb(decode_srgb(codes[:, None]))[:, 0], codes, atol=1e-12)
    np.testing.assert_allclose(decode_srgb(np.array([0.04045, 0.5, 1.0])), [0.04045 / 12.92, 0.21404114, 1], atol=1e-7)


def test_pictures_survive_a_round_trip(tmp_path):
    alpha = np.linspace(0.2, 1, 16).reshape(4, 4, 1)
    straight = np.random.default_rng(0).uniform(size=(4, 4, 3))
    image = np.concatenate([straight * alpha, alpha], axis=2).astype(np.float32)
    rts.save_image(tmp_path / "new" / "a.png", image)
    again = rts.load_image(tmp_path / "new" / "a.png")
    assert again.dtype == np.float32
    np.testing.assert_allclose(again, image, atol=0.006)
    with Image.open(tmp_path / "new" / "a.png") as file:
        np.testing.assert_allclose(np.asarray(file)[..., 3], alpha[..., 0] * 255, atol=0.5)


@pytest.mark.parametrize("shape", [(3, 5), (3, 5, 1), (3, 5, 3), (3, 5, 4)])
def test_shapes_of_pictures(tmp_path, shape):
    rts.save_image(tmp_path / "a.png", np.full(shape, 2.0))
    np.testing.assert_array_equal(rts.load_image(tmp_path / "a.png"), np.ones((3, 5, 4), np.float32))


def test_pictures_of_torch(tmp_path):
    torch = pytest.importorskip("torch")
    rts.save_image(tmp_path / "a.png", torch.full((2, 3, 3), 0.5, requires_grad=True))
    np.testing.assert_allclose(rts.load_image(tmp_path / "a.png")[..., :3], 0.5, atol=0.003)


def test_pictures_of_jax(tmp_path):
    jnp = pytest.importorskip("jax.numpy")
    rts.save_image(tmp_path / "a.png", jnp.full((2, 3, 3), 0.5))
    np.testing.assert_allclose(rts.load_image(tmp_path / "a.png")[..., :3], 0.5, atol=0.003)


def test_grey_pictures_of_16_bits(tmp_path):
    Image.fromarray(np.full((2, 2), 32768, np.uint16)).save(tmp_path / "a.png")
    np.testing.assert_allclose(rts.load_image(tmp_path / "a.png")[0, 0], [0.21405, 0.21405, 0.21405, 1], atol=1e-4)


@pytest.mark.parametrize(
    ("image", "expected"),
    [
        (np.full((2, 2, 3), np.nan), "12 of the image's 12 values are NaN"),
        (np.full((2, 2), np.inf), "NaN or infinite"),
        (np.zeros((2, 2, 5)), "shape"),
        (np.zeros(4), "shape"),
        (np.zeros((0, 2, 3)), "shape"),
        (np.zeros((2, 2, 3), np.uint8), "dtype uint8"),
    ],
)
def test_what_is_no_picture_is_refused(tmp_path, image, expected):
    with pytest.raises(InputError, match=expected):
        rts.save_image(tmp_path / "a.png", image)
    with pytest.raises(InputError, match=expected):
        rts.save_animation(tmp_path / "a.gif", [image])
    assert not list(tmp_path.iterdir())


def test_bad_names_of_pictures(tmp_path):
    with pytest.raises(InputError, match="ending in .png"):
        rts.save_image(tmp_path / "a.jpg", np.zeros((2, 2)))
    (tmp_path / "folder.png").mkdir()
    with pytest.raises(InputError, match="folder.png is a folder"):
        rts.save_image(tmp_path / "folder.png", np.zeros((2, 2)))
    write(tmp_path / "file", "")
    for name in ("file/a.png", "file/deeper/a.png"):
        with pytest.raises(InputError, match="file is a file; expected a folder"):
            rts.save_image(tmp_path / name, np.zeros((2, 2)))
        with pytest.raises(InputError, match="file is a file; expected a folder"):
            rts.save_animation(tmp_path / name, [np.zeros((2, 2))])
    with pytest.raises(InputError, match="no picture"):
        rts.load_image(tmp_path / "gone.png")
    with pytest.raises(InputError, match="cannot be read as an image"):
        rts.load_image(write(tmp_path / "a.png", "hello"))
    with pytest.raises(EngineError, match="belongs to no engine"):
        rts.save_image(tmp_path / "a.png", "hello")


@pytest.mark.parametrize("kind", ["gif", "png"])
def test_animations(tmp_path, kind):
    frames = [np.full((8, 6, 3), v) for v in (0.0, 0.25, 1.0)]
    rts.save_animation(tmp_path / "new" / f"a.{kind}", frames, fps=10)
    with Image.open(tmp_path / "new" / f"a.{kind}") as file:
        assert file.n_frames == 3 and file.size == (6, 8)
        assert file.info["duration"] == 100
        file.seek(2)
        assert file.convert("RGB").getpixel((0, 0)) == WHITE


def test_bad_animations(tmp_path):
    with pytest.raises(InputError, match="at least one"):
        rts.save_animation(tmp_path / "a.gif", [])
    with pytest.raises(InputError, match="all of one shape"):
        rts.save_animation(tmp_path / "a.gif", [np.zeros((2, 2)), np.zeros((3, 2))])
    with pytest.raises(InputError, match=".gif, .png or .mp4"):
        rts.save_animation(tmp_path / "a.avi", [np.zeros((2, 2))])
    with pytest.raises(InputError, match="fps is 0"):
        rts.save_animation(tmp_path / "a.gif", [np.zeros((2, 2))], fps=0)


def test_mp4_needs_a_package(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    with pytest.raises(PluginError, match="pip install imageio-ffmpeg"):
        rts.save_animation(tmp_path / "a.mp4", [np.zeros((2, 2))])


# jax, where it is loaded, warns of the fork that starts ffmpeg.
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning", "ignore:os.fork")
def test_mp4(tmp_path):
    pytest.importorskip("imageio_ffmpeg")
    rts.save_animation(tmp_path / "a.mp4", [np.zeros((17, 15, 3)), np.ones((17, 15, 3))], fps=5)
    assert (tmp_path / "a.mp4").stat().st_size > 500


def test_importing_the_library_imports_no_reader_and_no_framework():
    heavy = ["trimesh", "PIL", "imageio", "scipy", "torch", "jax", "numba"]
    code = f"import sys, rts; print([m for m in {heavy} if m in sys.modules])"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True).stdout.strip() == "[]"


# ------------------------------------------------------------------------------------------------ real data


@pytest.mark.parametrize(
    ("name", "vertices", "faces", "entries"),
    [
        ("meshes/bunny.obj", 34834, 69451, {"vertices"}),  # 1113 of its 35947 vertices are in no face.
        ("meshes/nefertiti.obj", 49971, 99938, {"vertices"}),
        ("meshes/teapot.obj", 3241, 6320, {"vertices"}),  # 403 of its 3644 vertices repeat others.
        ("meshes/teapot_2464.obj", 1232, 2464, {"vertices", "normals"}),
        ("meshes/spot/spot_triangulated.obj", 2930, 5856, {"vertices", "uv"}),
        ("meshes/spot/spot_quadrangulated.obj", 2930, 5856, {"vertices", "uv"}),
        ("ycb_airplane/textured.obj", 8188, 16384, {"vertices", "uv", "normals", "texture"}),
    ],
)
def test_real_models(data, name, vertices, faces, entries):
    [part] = rts.load(data / name)
    assert part.theta["vertices"].shape == (vertices, 3)
    assert len(part.surface.faces) == faces
    assert set(part.theta) == entries
    assert part.transform is None and part.shader.opaque
    assert isinstance(part.shader, rts.plugin("shaders", "textured" if "texture" in entries else "lambert"))


def test_spot_has_its_texture_where_it_belongs(data):
    folder = data / "meshes" / "spot"
    [part] = rts.load(folder / "spot_triangulated.obj")
    assert part.theta["uv"].shape == (3225, 2)
    theta = {**part.theta, "texture": rts.load_image(folder / "spot_texture.png")}
    # Seen from the front: pink muzzle below, brown horns above.
    image = rts.render(
        part.replace(theta=theta, shader="textured"), orbit(bounds_of([part]), (128, 128), 180, 0), (128, 128)
    )
    rows, columns = np.nonzero(image[..., 3] > 0.99)
    top = image[rows.min() : rows.min() + 6]
    horns = top[top[..., 3] > 0.99][:, :3].mean(axis=0)
    assert horns[0] > 2 * horns[2] and horns.max() < 0.4
    muzzle = image[52, 64, :3]
    assert muzzle[0] > 0.7 and 0.2 < muzzle[2] < 0.6
