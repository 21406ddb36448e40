import contextlib
import json
import logging
import os
import re
import sys
import warnings

import numpy as np
import pytest
import trimesh
from gltf_accessors import COMPONENTS, stored, viewed
from helpers import DIFFERENTIABLE, arrays, refused
from PIL import Image

import rts
from rts.errors import InputError, PluginError
from rts.files.srgb import decode_srgb, encode_srgb
from rts.scene.default_camera import bounds_of, orbit

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
        uv=[[0, 0], [1, 0], [1, 1], [0, 1]], material=trimesh.visual.material.PBRMaterial(baseColorTexture=image)
    )
    vertices = [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]
    mesh = trimesh.Trimesh(vertices, [[0, 1, 2], [0, 2, 3]], visual=visual, process=False)
    mesh.export(tmp_path / "quad.glb")
    [part] = rts.load(tmp_path / "quad.glb")
    assert corners(front_view(part)) == [RED, GREEN, BLUE, WHITE]


@pytest.mark.parametrize("name", ["a b.png", "tex.png", "sub/tex.png"])
@pytest.mark.parametrize("line", ["map_Kd {} ", "map_Kd -s 1 1 1 -clamp off -colorspace sRGB {}", "map_kd\t{}\r"])
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
    write(tmp_path / "m.mtl", "newmtl a\nKd 1 0.5 0\nnewmtl b\nKd 1 1 1\nd 0.25\nnewmtl unused\nmap_Kd gone.png\n")
    behind = "v 0 0 -1\nv 1 0 -1\nv 0 1 -1\n"
    faces = behind + "usemtl b\nf 1 2 3\nusemtl a\nf 1 3 4\nusemtl b\nf 5 6 7\n"
    b, a = rts.load(write(tmp_path / "m.obj", "mtllib m.mtl\n" + QUAD + faces))
    assert len(b.surface.faces) == 2 and len(a.surface.faces) == 1
    np.testing.assert_allclose(a.theta["color"], [1, 0.2140411, 0], atol=1e-6)
    np.testing.assert_allclose(b.theta["color"], [1, 1, 1, 0.25], atol=1e-6)
    assert a.shader.opaque and not b.shader.opaque
    [whole] = rts.load(tmp_path / "m.obj", merge=True)
    assert len(whole.surface.faces) == 3 and not whole.shader.opaque
    np.testing.assert_allclose(front_view(whole), front_view([b, a]), atol=1e-6)


def test_faces_of_an_obj_without_uv_leave_others_theirs(tmp_path):
    faces = "vn 0 0 1\nusemtl m\nf 1/1/1 2/2/1 3/3/1\nf 1 3 4\n"
    textured_quad(tmp_path)
    path = write(tmp_path / "m.obj", f"mtllib quad.mtl\n{QUAD}{QUAD_UV}{faces}")
    with pytest.warns(rts.errors.FileWarning) as caught:
        [part] = rts.load(path, weld=False)
    text = str(caught[0].message)
    assert "1 of 2 faces have no texture coordinates, and take (0, 0)" in text
    assert "1 of 2 faces have no normals, and leave their material without normals" in text
    uv = part.theta["uv"][part.surface.indices.get("uv", part.surface.faces)]
    np.testing.assert_allclose(uv, [[(0, 0), (1, 0), (1, 1)], [(0, 0)] * 3])
    assert "normals" not in part.theta and "texture" in part.theta


def test_an_obj_may_name_several_libraries_in_a_line(tmp_path):
    write(tmp_path / "a.mtl", "newmtl a\nKd 1 0 0\n")
    write(tmp_path / "b.mtl", "newmtl b\nKd 0 1 0\n")
    path = write(tmp_path / "m.obj", f"mtllib a.mtl b.mtl\n{QUAD}usemtl a\nf 1 2 3\nusemtl b\nf 1 3 4\n")
    assert [part.theta["color"].tolist() for part in rts.load(path)] == [[1, 0, 0], [0, 1, 0]]


ONE_FACE = (
    "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n{}"
    "element face 1\nproperty list uchar int vertex_indices\nend_header\n{}3 0 1 2\n"
)


@pytest.mark.parametrize("names", [("red", "green", "blue"), ("diffuse_red", "diffuse_green", "diffuse_blue"), "rgb"])
def test_colors_of_a_ply_have_one_of_three_names(tmp_path, names):
    columns = "".join(f"property uchar {name}\n" for name in names)
    path = write(tmp_path / "m.ply", ONE_FACE.format(columns, "0 0 0 255 0 0\n1 0 0 0 255 0\n0 1 0 0 0 255\n"))
    np.testing.assert_allclose(rts.load(path)[0].theta["colors"], np.eye(3))


def test_properties_of_a_ply_that_are_not_read_are_named(tmp_path):
    columns = "property float quality\nproperty uchar intensity\n"
    path = write(tmp_path / "m.ply", ONE_FACE.format(columns, "0 0 0 1 1\n1 0 0 1 1\n0 1 0 1 1\n"))
    with pytest.warns(rts.errors.FileWarning, match="properties that are not read: quality, intensity"):
        rts.load(path)
    strips = ONE_FACE.format("", "0 0 0\n1 0 0\n0 1 0\n").replace("element face", "element tristrips")
    with pytest.raises(rts.InputError, match="strips of triangles, which are not read"):
        rts.load(write(tmp_path / "s.ply", strips))


def test_a_fan_of_a_gltf_turns_as_its_first_triangle_does(tmp_path):
    values = np.ones((4, 4), np.float32)
    path = gltf_with(tmp_path, "COLOR_0", values)
    tree = json.loads(path.read_text())
    primitive = tree["meshes"][0]["primitives"][0]
    primitive["mode"] = 6
    del primitive["indices"]
    [part] = rts.load(write(tmp_path / "fan.gltf", json.dumps(tree)), weld=False)
    np.testing.assert_array_equal(part.surface.faces, GRID[1])


def test_a_photograph_on_its_side_is_told(tmp_path):
    image, exif = Image.new("RGB", (6, 4)), Image.Exif()
    exif[0x0112] = 6
    image.save(tmp_path / "turned.jpg", exif=exif)
    image.save(tmp_path / "upright.jpg")
    with pytest.warns(rts.errors.FileWarning, match="EXIF orientation 6"):
        assert rts.load_image(tmp_path / "turned.jpg").shape == (4, 6, 4)
    rts.load_image(tmp_path / "upright.jpg")  # Warnings are errors.


def test_textures_are_linear_and_their_alpha_makes_the_shader_translucent(tmp_path):
    path = textured_quad(tmp_path)
    Image.fromarray(np.full((2, 2, 4), (128, 255, 0, 51), np.uint8)).save(tmp_path / "tex.png")
    [part] = rts.load(path)
    assert not part.shader.opaque
    np.testing.assert_allclose(part.theta["texture"][0, 0], [0.2158605, 1, 0, 0.2], atol=1e-6)


@pytest.mark.parametrize(
    "mode, cutoff, expected",
    [
        ("OPAQUE", None, None),
        (None, None, None),
        ("BLEND", None, [0.2, 0.6]),
        ("MASK", None, [0, 1]),
        ("MASK", 0.7, [0, 0]),
    ],
)
def test_alpha_of_a_gltf_blends_cuts_out_or_is_ignored(tmp_path, mode, cutoff, expected):
    image = Image.fromarray(np.uint8([[[255, 0, 0, 51], [0, 255, 0, 153]]]))
    material = trimesh.visual.material.PBRMaterial(baseColorTexture=image, alphaMode=mode, alphaCutoff=cutoff)
    mesh = trimesh.Trimesh([(0, 0, 0), (1, 0, 0), (0, 1, 0)], [(0, 1, 2)], process=False)
    mesh.visual = trimesh.visual.TextureVisuals(uv=[(0, 0), (1, 0), (0, 1)], material=material)
    mesh.export(tmp_path / "m.glb")
    [part] = rts.load(tmp_path / "m.glb")
    assert part.shader.opaque == (expected is None)
    texture = part.theta["texture"]
    np.testing.assert_allclose(texture[0, :, 3:].ravel(), [] if expected is None else expected, atol=1e-6)


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


def test_vertex_colors_of_floating_numbers_and_of_an_off(tmp_path):
    rows = "".join(f"{xyz} {{}}\n" for xyz in ("0 0 0", "1 0 0", "0 1 0"))
    floating = PLY.replace(
        "element face", "property float red\nproperty float green\nproperty float blue\nelement face"
    )
    files = {
        "unit.ply": floating.format(3, 1) + rows.format("1 0 0.5", "1 0 0.5", "1 0 0.5") + "3 0 1 2\n",
        "bytes.ply": floating.format(3, 1) + rows.format("255 0 128", "255 0 128", "255 0 128") + "3 0 1 2\n",
        "short.ply": floating.replace("float red", "ushort red").replace("float green", "ushort green").format(3, 1)
        + rows.format(*["65535 0 0.5"] * 3).replace("0.5", "32896")
        + "3 0 1 2\n",
        "bytes.off": "COFF\n3 1 0\n" + rows.format(*["255 0 128 255"] * 3) + "3 0 1 2\n",
        "normals.off": "CNOFF\n3 1 0\n" + rows.format(*["0 0 1 1 0 0.5 1"] * 3) + "3 0 1 2\n",
    }
    files["short.ply"] = files["short.ply"].replace("float blue", "ushort blue")
    files["alpha.ply"] = files["unit.ply"].replace("float blue", "float blue\nproperty uchar alpha")
    files["alpha.ply"] = files["alpha.ply"].replace("1 0 0.5", "1 0 0.5 255")
    for name, text in files.items():
        [part] = rts.load(write(tmp_path / name, text))
        np.testing.assert_allclose(part.theta["colors"], np.tile([1, 0, 0.2158605], (3, 1)), atol=1e-6, err_msg=name)


def test_comments_of_a_ply_say_nothing_but_the_name_of_a_texture(tmp_path):
    comments = "comment element vertex 7\ncomment\tend_header\nobj_info property int x\ncomment TextureFile a b.png\n"
    Image.fromarray(np.full((8, 8, 3), (255, 0, 0), np.uint8)).save(tmp_path / "a b.png")
    uv = "property float s\nproperty float t\nelement face"
    header = PLY.replace("element vertex", comments + "element vertex", 1).replace("element face", uv)
    rows = "".join(f"{x} {y} 0 {x} {y}\n" for x, y in [(0, 0), (1, 0), (0, 1)])
    [part] = rts.load(write(tmp_path / "m.ply", header.format(3, 1) + rows + "3 0 1 2\n"))
    assert part.theta["texture"].shape == (8, 8, 3)
    np.testing.assert_allclose(part.theta["uv"], [(0, 0), (1, 0), (0, 1)])


def test_numbers_after_the_corners_of_an_off_are_warned_of(tmp_path):
    path = write(tmp_path / "m.off", "OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2 255 0 0\n")
    with pytest.warns(UserWarning, match="m.off: 1 faces have numbers after their corners") as caught:
        rts.load(path)
    assert caught[0].filename == __file__


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


GRID = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)], [[0, 1, 2], [0, 2, 3]]


def square_of_gltf():
    """The tree of a square as glTF, its data inside."""
    scene = trimesh.Scene(trimesh.Trimesh(*GRID, process=False))
    return json.loads(trimesh.exchange.gltf.export_gltf(scene, embed_buffers=True)["model.gltf"])


def gltf_with(folder, name, values, **more):
    """A square as glTF with one attribute more, (4, C) of any type."""
    tree = square_of_gltf()
    primitive = tree["meshes"][0]["primitives"][0]
    primitive["attributes"][name] = stored(tree, values, **more)
    primitive["material"], tree["materials"] = 0, [{}]
    if name == "COLOR_0":
        del primitive["material"]
    return write(folder / "m.gltf", json.dumps(tree))


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32])
def test_fractions_of_a_gltf_may_be_integers(tmp_path, dtype):
    whole = 1 if dtype is np.float32 else np.iinfo(dtype).max
    values = np.round(np.array([[1, 0.2, 0, 1]] * 4) * whole, 2).astype(dtype)
    more = {} if dtype is np.float32 else {"normalized": True}
    [part] = rts.load(gltf_with(tmp_path, "COLOR_0", values, **more))
    np.testing.assert_allclose(part.theta["colors"], [[1, 0.2, 0]] * 4, atol=1e-6)
    uv = np.round(np.array([[0, 1], [1, 1], [1, 0.2], [0, 0]]) * whole, 2).astype(dtype)
    [part] = rts.load(gltf_with(tmp_path, "TEXCOORD_0", uv, **more))
    np.testing.assert_allclose(part.theta["uv"], [[0, 0], [1, 0], [1, 0.8], [0, 1]], atol=1e-6)
    np.testing.assert_array_equal(part.theta["vertices"], GRID[0])


def with_material(path, material):
    """A glTF whose only primitive has this material."""
    tree = json.loads(path.read_text())
    tree["meshes"][0]["primitives"][0]["material"], tree["materials"] = 0, [material]
    return write(path, json.dumps(tree))


@pytest.mark.parametrize(
    "material, expected",
    [
        (None, 1),
        ({}, 1),
        ({"alphaMode": "OPAQUE"}, 1),
        ({"alphaMode": "MASK"}, 0),
        ({"alphaMode": "MASK", "alphaCutoff": 0.2}, 1),
        ({"alphaMode": "MASK", "alphaCutoff": 0.2, "pbrMetallicRoughness": {"baseColorFactor": [1, 1, 1, 0.6]}}, 0),
        ({"alphaMode": "BLEND"}, 0.25),
    ],
)
def test_alpha_of_colours_of_a_gltf_counts_as_its_material_says(tmp_path, material, expected):
    values = np.float32([[1, 0.2, 0, 0.25]] * 4)
    path = gltf_with(tmp_path, "COLOR_0", values)
    [part] = rts.load(path if material is None else with_material(path, material))
    colors = part.theta["colors"]
    alpha = colors[:, 3] if colors.shape[1] == 4 else np.ones(4)
    np.testing.assert_allclose(alpha, expected, atol=2e-3)
    np.testing.assert_allclose(colors[:, :3], values[:, :3], atol=1e-6)
    assert part.shader.opaque == (expected == 1) and len(part.theta.get("color", np.ones(3))) == 3


COPY = "decode it by `gltf-transform copy model.glb decoded.glb`, of the package @gltf-transform/cli of npm, or"


@pytest.mark.parametrize(
    ("name", "advice"),
    [
        ("KHR_draco_mesh_compression", f"{COPY} export it again from Blender, without compression"),
        ("EXT_meshopt_compression", f"{COPY} by gltfpack without its option -c"),
        ("KHR_meshopt_compression", "export it again without compression, such as by gltfpack without its option -c"),
        ("X_shapes", "export it again without this extension"),
    ],
)
def test_an_extension_that_is_not_read_is_warned_of_or_refused_with_what_to_do_about_it(tmp_path, name, advice):
    path = tmp_path / "m.gltf"
    beside, required, elsewhere, fallback = (square_of_gltf() for _ in range(4))
    beside["bufferViews"][0]["extensions"] = {name: {"buffer": 0, "byteLength": 9, "mode": "ATTRIBUTES"}}
    with pytest.warns(rts.errors.FileWarning, match=f"uses the extension {name}, which is not read"):
        rts.load(write(path, json.dumps(beside)))
    required["extensionsUsed"] = required["extensionsRequired"] = [name]
    primitive = elsewhere["meshes"][0]["primitives"][0]
    primitive["extensions"] = {name: {}}
    del elsewhere["accessors"][primitive["attributes"]["POSITION"]]["bufferView"]
    fallback["buffers"].append({"byteLength": 9, "extensions": {name: {"fallback": True}}})
    for tree, words in (
        (required, f"requires the extension '{name}', which is not read"),
        (elsewhere, name),
        (fallback, f"and the extension that has them is not read: {name}"),
    ):
        with warnings.catch_warnings(), pytest.raises(InputError) as error:
            warnings.simplefilter("ignore")
            rts.load(write(path, json.dumps(tree)))
        text = message(error)
        assert words in text and text.endswith(f"; {advice}") and "cut short" not in text


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (
            {"extensionsUsed": "KHR_materials_unlit"},
            'extensionsUsed is "KHR_materials_unlit"; expected a list of names',
        ),
        ({"extensionsRequired": [1]}, "extensionsRequired is [1]; expected a list of names"),
        ({"asset": "2.0"}, 'asset is "2.0"; expected an object'),
        ({"meshes": {"0": {}}}, 'meshes is {"0": {}}; expected a list of objects'),
        ({"nodes": ["a"]}, 'nodes is ["a"]; expected a list of objects'),
        ({"meshes": [{"primitives": 3}]}, "primitives of meshes 0 is 3; expected a list of objects"),
        ({"meshes": [{"primitives": [{"attributes": []}]}]}, "attributes of meshes 0 is []; expected an object"),
        ({"materials": [{"pbrMetallicRoughness": 1}]}, "pbrMetallicRoughness of materials 0 is 1; expected an object"),
        ({"materials": [{"extensions": "KHR_x"}]}, 'extensions of materials 0 is "KHR_x"; expected an object'),
        ({"materials": [{"extensions": {"KHR_x": True}}]}, "KHR_x of materials 0 is true; expected an object"),
        ({"accessors": [{"sparse": [1]}]}, "sparse of accessors 0 is [1]; expected an object"),
    ],
)
def test_a_part_of_a_gltf_of_another_kind_is_named(tmp_path, change, expected):
    with pytest.raises(InputError) as error:
        rts.load(write(tmp_path / "m.gltf", json.dumps(square_of_gltf() | change)))
    assert f"cannot be read as GLTF (its tree: {expected})" in message(error)


def with_sparse(path, accessor, indices, values, /, *, base=True, **changes):
    """A glTF, one of whose accessors has other rows at some places, or rows of zeros elsewhere."""
    tree = json.loads(path.read_text())
    parts = {}
    for name, array in (("indices", indices), ("values", values)):
        parts[name] = {"bufferView": viewed(tree, bytes(4) + array.tobytes()), "byteOffset": 4}
    parts["indices"]["componentType"] = COMPONENTS[indices.dtype.str[1:]]
    entry = tree["accessors"][accessor]
    entry["sparse"] = {"count": len(indices), **parts}
    for key in ("min", "max", *([] if base else ["bufferView", "byteOffset"])):
        entry.pop(key, None)
    for name, change in changes.items():
        (entry["sparse"] if name == "whole" else entry["sparse"][name]).update(change)
    return write(path, json.dumps(tree))


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.uint32])
@pytest.mark.parametrize("base", [True, False], ids=["others", "zeros"])
def test_sparse_accessors_have_other_rows_at_some_places(tmp_path, dtype, base):
    path = gltf_with(tmp_path, "COLOR_0", np.full((4, 3), 0.25, np.float32))
    tree = json.loads(path.read_text())
    attributes = tree["meshes"][0]["primitives"][0]["attributes"]
    colors = np.float32([(1, 0.5, 0), (0, 0.5, 1)])
    with_sparse(path, attributes["COLOR_0"], np.array([1, 3], dtype), colors, base=base)
    moved = np.float32([(1, 0, 2), (1, 1, 3), (0, 1, 4)])
    with_sparse(path, attributes["POSITION"], np.array([1, 2, 3], dtype), moved, base=base)
    [part] = rts.load(path, weld=False)
    np.testing.assert_array_equal(part.theta["vertices"], [(0, 0, 0), *moved])
    rest = 0.25 if base else 0
    np.testing.assert_allclose(part.theta["colors"], [[rest] * 3, colors[0], [rest] * 3, colors[1]])


def test_the_corners_of_faces_may_be_sparse(tmp_path):
    path = gltf_with(tmp_path, "COLOR_0", np.ones((4, 3), np.float32))
    tree = json.loads(path.read_text())
    indices = tree["meshes"][0]["primitives"][0]["indices"]
    dtype = {5121: np.uint8, 5123: np.uint16, 5125: np.uint32}[tree["accessors"][indices]["componentType"]]
    [part] = rts.load(with_sparse(path, indices, np.array([1, 4], np.uint8), np.array([3, 1], dtype)), weld=False)
    np.testing.assert_array_equal(part.surface.faces, [(0, 3, 2), (0, 1, 3)])


@pytest.mark.parametrize(
    ("indices", "changes", "expected"),
    [
        ([1, 1], {}, "indices of the sparse rows of accessor .* are \\[1, 1\\]; expected ascending ones below 4"),
        ([2, 1], {}, "expected ascending ones"),
        ([1, 4], {}, "expected ascending ones below 4"),
        ([0, 1], {"whole": {"count": 3}}, "indices of the sparse rows of accessor .* from byte 4 to 7 of 6"),
        ([0, 1], {"values": {"byteOffset": 8}}, "values of the sparse rows of accessor .* from byte 8 to 32 of 28"),
        ([0, 1], {"values": {"byteOffset": 3}}, "expected them inside, from a multiple of 4 on"),
        ([0, 1], {"indices": {"componentType": 5126}}, "have componentType 5126; expected 5121, 5123 or 5125"),
        ([0, 1], {"indices": {"bufferView": 99}}, "accessor"),
        ([0, 1], {"whole": {"values": None}}, "accessor"),
    ],
)
def test_wrong_sparse_accessors_are_refused(tmp_path, indices, changes, expected):
    path = gltf_with(tmp_path, "COLOR_0", np.ones((4, 3), np.float32))
    last = len(json.loads(path.read_text())["accessors"]) - 1
    with_sparse(path, last, np.array(indices, np.uint8), np.ones((2, 3), np.float32), **changes)
    with pytest.raises(InputError, match=expected):
        rts.load(path)


# --------------------------------------------------------------------------------------------- what does not


@pytest.mark.parametrize(
    ("name", "text", "expected"),
    [
        ("m.obj", "", "neither vertices nor faces"),
        ("m.obj", QUAD, "4 vertices but no faces"),
        ("m.obj", QUAD + "f 1 2 5\n", "line 5: a face refers to number 5 of 4 vertices"),
        ("m.obj", QUAD + "f 0 1 2\n", "line 5: a face refers to number 0 of 4 vertices"),
        ("m.obj", QUAD + "f -5 1 2\n", "line 5: the index -5 counts back further"),
        ("m.obj", QUAD + "f 1 2\n", "line 5: a face has 2 corners"),
        ("m.obj", QUAD + "f 1 2 x\n", "line 5: 'x' is no index"),
        ("m.obj", "v 0 0 0\nv 1 0\nv 0 1 0\nf 1 2 3\n", "line 2: 'v' has 2 numbers"),
        ("m.obj", "v 0 0 0\nv 1 0 .\nv 0 1 0\nf 1 2 3\n", "line 2: '1 0 .' are not numbers"),
        ("m.obj", "v 0 0 0\nv nan 0 0\nv 0 1 0\nf 1 2 3\n", "1 of 3 rows of vertices are NaN"),
        ("m.obj", "v 0 0 0\nv 1e60 0 0\nv 0 1 0\nf 1 2 3\n", "too large for float32"),
        ("m.xyzzy", "hello", "extension '.xyzzy'"),
        ("m.xyz", "0 0 0\n", "extension '.xyz', which is not known; expected obj, ply, stl, glb, gltf or off"),
        ("m", "hello", "expected obj, ply, stl, glb"),
        ("m.ply", "ply\nformat ascii 1.0\nelement vertex 3\n", "cannot be read as PLY"),
        ("m.off", "OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 7\n", "m.off"),
        ("m.off", "", "cannot be read as OFF"),
        ("m.off", "OFF\n0 0 0\n", "it promises no vertices"),
        ("m.off", "OFF\n3 0 0\n0 0 0\n1 0 0\n0 1 0\n", "3 points but no faces"),
        ("m.off", "OFF BINARY\n3 1 0\n", "it begins with 'OFF BINARY'"),
        ("m.off", "4OFF\n3 1 0\n0 0 0 1\n1 0 0 1\n0 1 0 1\n3 0 1 2\n", "it begins with '4OFF'"),
        ("m.off", "OFF\nthree 1 0\n", "'three 1 0' are no counts"),
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


PLY = (
    "ply\nformat ascii 1.0\nelement vertex {}\nproperty float x\nproperty float y\nproperty float z\n"
    "element face {}\nproperty list uchar int vertex_indices\nend_header\n"
)
SQUARE = "0 0 0\n1 0 0\n1 1 0\n0 1 0\n"


@pytest.mark.parametrize(
    ("header", "rows", "expected"),
    [
        ((4, 2), "3 0 1 2\n", "4 .*2 .*5"),
        ((4, 1), "3 0 1 2\n3 0 2 3\n", "4 .*1 .*6"),
        ((5, 1), "3 0 1 2\n", "5 .*1 .*5"),
        ((4, 1), "4 0 1 2\n", "line [0-9]+.*4"),
        ((4, 2), "4 0 1 2\n3 0 2 3\n", "line [0-9]+.*4"),
        ((4, 2), "3 0 1 2\n2 0 1\n", "corners"),
        ((4, 1), "3 0 x 2\n", "'3 0 x 2'"),
        ((4, 1), "3 0 1.5 2\n", "line [0-9]+"),
        ((4, 1), "3 0 1 -2\n", "-2"),
        ((4, 1), "3 0 1 4\n", "4"),
        ((4_000_000_000, 1), "3 0 1 2\n", "4000000000"),
    ],
)
def test_rows_that_are_not_those_that_were_promised(tmp_path, header, rows, expected):
    files = {"m.ply": PLY.format(*header) + SQUARE + rows, "m.off": f"OFF\n{header[0]} {header[1]} 0\n{SQUARE}{rows}"}
    for name, text in files.items():
        with refused(f"{name} cannot be read as {name[2:].upper()} \\(.*{expected}"):
            rts.load(write(tmp_path / name, text))


def test_a_list_that_is_too_short_for_its_row_in_a_ply_or_too_long_in_an_off(tmp_path):
    with pytest.raises(InputError, match="line 14 has 5 numbers, which do not make a row of face"):
        rts.load(write(tmp_path / "m.ply", PLY.format(4, 1) + SQUARE + "3 0 1 2 3\n"))
    with pytest.raises(InputError, match="line 7 promises a face of 3 corners, and has 2 numbers too many"):
        rts.load(write(tmp_path / "m.off", f"OFF\n4 1 0\n{SQUARE}3 0 1 2 3 1\n"))


FACET = "facet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nvertex 0 1 0\nendloop\nendfacet\n"


def test_an_stl_in_text_is_what_it_says(tmp_path):
    [part] = rts.load(write(tmp_path / "m.stl", f"solid vertex normal solid\n{FACET}endsolid vertex\n"))
    np.testing.assert_array_equal(part.theta["vertices"], [(0, 0, 0), (1, 0, 0), (0, 1, 0)])
    assert len(rts.load(write(tmp_path / "m.stl", f"solid a\n{FACET}endsolid a\nsolid b\n{FACET}endsolid b\n"))) == 2
    for wrong in (
        FACET.replace("vertex 1 0 0", "vertex 1 0").replace("vertex 0 1 0", "vertex 0 1 0 7"),
        FACET.replace("vertex 1 0 0\n", ""),
        FACET.replace("1 0 0", "1 x 0"),
        FACET.replace("endfacet\n", ""),
        FACET + "hello\n",
    ):
        with refused(r"m.stl cannot be read as STL \(line [0-9]+"):
            rts.load(write(tmp_path / "m.stl", f"solid a\n{FACET}{wrong}endsolid a\n"))


@pytest.mark.parametrize("value", ["nan", "inf", "1e30", "-1"])
def test_colours_that_are_none_are_refused(tmp_path, value):
    header = PLY.replace("element face", "property float red\nproperty float green\nproperty float blue\nelement face")
    rows = f"0 0 0 0.5 {value} 0\n1 0 0 0 0 0\n0 1 0 0 0 0\n3 0 1 2\n"
    with refused(r"row 0 of vertex has green = .*; expected colours from 0 to 1"):
        rts.load(write(tmp_path / "m.ply", header.format(3, 1) + rows))
    if value == "-1":
        return
    with pytest.raises(InputError, match="m.obj: .*row.* of colors.*(NaN|infinite)"):
        rts.load(write(tmp_path / "m.obj", f"v 0 0 0 {value} 0 0\nv 1 0 0 0 0 0\nv 0 1 0 0 0 0\nf 1 2 3\n"))
    colors = np.zeros((4, 3), np.float32)
    colors[2, 1] = float(value)
    with refused("row 2 of COLOR_0 of mesh 0 is .*; expected colours from 0 to 1"):
        rts.load(gltf_with(tmp_path, "COLOR_0", colors))


@pytest.mark.parametrize(
    ("text", "alpha"),
    [
        ("Tr 1.000000", 1),
        ("Tr 1.0001", 1),
        ("Tr 0", 1),
        ("Tr 0.25", 0.75),
        ("# Wavefront material file\n# Converted by Meshlab Group\nTr 1.000000", 1),
        ("# Converted by Meshlab Group\nTr 0.25", 0.25),
        ("#\n# File generated with VCGLib\nTr 0.25", 0.25),
        ("# not of MeshLab's kin\nd 0.5\nTr 0.25", 0.5),
        ("d 0", 0),
        ("Tr 1\nd 0", 0),
        ("d 0\nTr 1", 0),
        ("d 1\nTr 1", 1),
        ("Tr 1\nd 0.5", 0.5),
    ],
)
def test_how_opaque_a_material_is(tmp_path, text, alpha):
    write(tmp_path / "m.mtl", f"newmtl m\nKd 1 0 0\n{text}\n")
    [part] = rts.load(write(tmp_path / "m.obj", "mtllib m.mtl\n" + QUAD + "usemtl m\nf 1 2 3 4\n"))
    assert part.shader.opaque == (alpha == 1)
    np.testing.assert_allclose(part.theta["color"], [1, 0, 0] if alpha == 1 else [1, 0, 0, alpha])
    if alpha > 0:
        np.testing.assert_allclose(front_view(part)[..., 3], alpha, atol=1e-6)


def test_materials_that_no_library_has_are_warned_of(tmp_path):
    write(tmp_path / "m.mtl", "newmtl m\nKd 1 0 0\n")
    path = write(tmp_path / "m.obj", "mtllib m.mtl\n" + QUAD + "usemtl m\nf 1 2 3\nusemtl n\nf 1 3 4\n")
    with pytest.warns(rts.errors.FileWarning, match="m.obj uses materials that its libraries lack: 'n'") as caught:
        rts.load(path)
    assert issubclass(rts.errors.FileWarning, rts.errors.RtsWarning) and caught[0].filename == __file__


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("v 0 0 0 1 0", "'v' has 5 numbers; expected 3 or 4 or 6 or 7"),
        ("vn 0 0 1 1", "'vn' has 4 numbers; expected 3"),
        ("vt 0 0 1 1", "'vt' has 4 numbers; expected 1 or 2 or 3"),
        ("v 0 1_0 0", "'0 1_0 0' are not numbers"),
        ("f 1 2 3_0", "'1 2 3_0' are not numbers"),
    ],
)
def test_rows_of_an_obj_with_too_many_numbers_or_odd_ones(tmp_path, line, expected):
    with pytest.raises(InputError, match=f"m.obj, line 5: {expected}"):
        rts.load(write(tmp_path / "m.obj", QUAD + line + "\nf 1 2 3\n"))


def test_colours_that_not_all_vertices_have_are_left_out_with_a_warning(tmp_path):
    with pytest.warns(UserWarning, match="m.obj: some 'v' have 6 numbers and some 3; colours are left out"):
        [part] = rts.load(write(tmp_path / "m.obj", QUAD + "v 0 0 1 1 0 0\nf 1 2 5\n"))
    assert "colors" not in part.theta


@pytest.mark.parametrize("name", ["merge", "weld"])
@pytest.mark.parametrize("value", ["no", 0, 1, None, [], np.zeros(3), 0.5])
def test_merge_and_weld_are_true_or_false(tmp_path, name, value):
    path = write(tmp_path / "m.obj", QUAD + "f 1 2 3\n")
    with refused(f"{name} is .*; expected True or False"):
        rts.load(path, **{name: value})
    assert rts.load(path, **{name: np.True_})


def test_a_texture_that_is_no_image_is_refused_in_every_format(tmp_path):
    header = PLY.replace("element vertex", "comment TextureFile t.png\nelement vertex")
    (tmp_path / "t.png").write_text("hello")
    with pytest.raises(InputError, match="m.ply .*its texture t.png cannot be read as an image"):
        rts.load(write(tmp_path / "m.ply", header.format(4, 1) + SQUARE + "3 0 1 2\n"))
    material = trimesh.visual.material.PBRMaterial(baseColorTexture=Image.open(quadrants(tmp_path / "u.png")))
    visual = trimesh.visual.TextureVisuals(uv=[[0, 0], [1, 0], [1, 1], [0, 1]], material=material)
    data = trimesh.Trimesh(*GRID, visual=visual, process=False).export(file_type="glb")
    (tmp_path / "m.glb").write_bytes(data.replace(b"\x89PNG", b"none"))
    with pytest.raises(InputError, match="m.glb .*the texture of material 0 cannot be read as an image"):
        rts.load(tmp_path / "m.glb")


def test_what_trimesh_and_numpy_warn_of_is_one_warning_that_names_the_file(tmp_path, monkeypatch):
    def careless(*args, **kwargs):
        logging.getLogger("trimesh").warning("something\nis odd")
        for _ in range(2):
            np.array([1e300]).astype(np.float32) / np.zeros(1, np.float32)
            warnings.warn("two\nlines", RuntimeWarning, stacklevel=1)
            warnings.warn("of the past", DeprecationWarning, stacklevel=1)
        return trimesh.Scene(trimesh.Trimesh(*GRID, process=False))

    monkeypatch.setattr(trimesh, "load", careless)
    monkeypatch.setattr(trimesh.exchange.load, "mesh_formats", lambda: {"dae", "ply", "xyz"})
    with pytest.warns(UserWarning) as caught:
        [part] = rts.load(write(tmp_path / "m.dae", ""))
    np.testing.assert_array_equal(part.theta["vertices"], GRID[0])
    ours = f"{tmp_path / 'm.dae'}: something is odd; check what was loaded; two lines; check what was loaded"
    assert [str(w.message) for w in caught] == [ours] and {w.filename for w in caught} == {__file__}


def test_missing_files_and_folders(tmp_path):
    with pytest.raises(InputError, match="no file .*gone.obj"):
        rts.load(tmp_path / "gone.obj")
    with pytest.raises(InputError, match="is a folder"):
        rts.load(tmp_path)
    with pytest.raises(InputError, match="the path is a int"):
        rts.load(3)


@pytest.mark.parametrize("kind", ["stl", "off"])
def test_bytes_where_text_ought_to_be(tmp_path, kind):
    path = tmp_path / f"m.{kind}"
    path.write_bytes(bytes(range(128, 256)) * 3)
    with pytest.raises(InputError, match=f"m.{kind} is not a valid {kind.upper()} file.*export it again") as error:
        rts.load(path)
    assert isinstance(error.value.__cause__, UnicodeDecodeError)


def test_what_trimesh_cannot_read_is_one_error_of_the_file_that_is_missing(tmp_path, monkeypatch):
    def broken(*args, resolver, **kwargs):
        with contextlib.suppress(InputError):  # trimesh only logs it.
            resolver.get("gone.png")
        raise ValueError("nothing\nworks")

    monkeypatch.setattr(trimesh, "load", broken)
    monkeypatch.setattr(trimesh.exchange.load, "mesh_formats", lambda: {"dae"})
    with refused("m.dae refers to 'gone.png', but there is no file"):
        rts.load(write(tmp_path / "m.dae", ""))


def test_a_textured_ply_keeps_its_vertices_with_their_normals_and_colours(tmp_path):
    extra = "".join(f"property float {name}\n" for name in ("s", "t", "nx", "ny", "nz", "red", "green", "blue"))
    header = PLY.replace("element face", extra + "element face", 1)
    rows = "".join(f"{x} {y} 0 {x} {y} 0 0 1 0 1 0\n" for x, y in [(9, 9), (1, 0), (0, 1), (0, 0), (1, 0)])
    path = write(tmp_path / "m.ply", header.format(5, 2) + rows + "3 3 1 2\n3 2 3 4\n")
    [part] = rts.load(path, weld=False)
    np.testing.assert_array_equal(part.theta["vertices"][:, :2], [(9, 9), (1, 0), (0, 1), (0, 0), (1, 0)])
    np.testing.assert_array_equal(part.theta["uv"], part.theta["vertices"][:, :2])
    np.testing.assert_array_equal(part.theta["normals"], [(0, 0, 1)] * 5)
    np.testing.assert_array_equal(part.theta["colors"], [(0, 1, 0)] * 5)


def ply_of_textures(folder, names, numbers, kind="int"):
    """A PLY of three polygons, a square and two triangles, with coordinates of their corners and textures' numbers."""
    text = "".join(f"comment TextureFile {name}\n" for name in names)
    for name, color in (("a.png", (255, 0, 0)), ("b.png", (0, 0, 255))):
        Image.fromarray(np.full((2, 2, 3), color, np.uint8)).save(folder / name)
    more = "property list uchar float texcoord\n" + (f"property {kind} texnumber\n" if numbers else "")
    header = PLY.replace("element vertex", text + "element vertex", 1).replace("end_header", more + "end_header")
    rows = "".join(f"{x} {y} 0\n" for x, y in [(0, 0), (1, 0), (1, 1), (0, 1), (2, 0), (2, 1)])
    faces = ["4 0 1 2 3 8 0 0 1 0 1 1 0 1", "3 1 4 5 6 0 0 1 0 1 1", "3 1 5 2 6 .5 .5 1 1 0 1"]
    faces = [f"{face} {number}".rstrip() for face, number in zip(faces, numbers or [""] * 3, strict=True)]
    return write(folder / "m.ply", header.format(6, 3) + rows + "\n".join(faces) + "\n")


@pytest.mark.parametrize("kind", ["int", "uchar", "float"])
def test_faces_of_a_ply_have_the_textures_of_their_numbers(tmp_path, kind):
    path = ply_of_textures(tmp_path, ["a.png", "b.png"], [1, 0, 1], kind)
    red, blue = rts.load(path)
    for part, color, uv in (
        (red, (1, 0, 0), [(0, 0), (1, 0), (1, 1)]),
        (blue, (0, 0, 1), [(0, 0), (1, 0), (1, 1), (0, 0), (1, 1), (0, 1), (0.5, 0.5), (1, 1), (0, 1)]),
    ):
        np.testing.assert_array_equal(part.theta["texture"][0, 0], color)
        table = part.surface.proxy(part.theta["vertices"], None, (1, 1)).ids[:, -3:]
        np.testing.assert_array_equal(part.theta["uv"][table].reshape(-1, 2), uv)
    camera = rts.Camera.orthographic((1, 0.5, 2), (1, 0.5, 0), height=1.0, far=10.0)
    image = rts.render([red, blue], camera, (32, 64), splatter="none")
    np.testing.assert_allclose(image[16, [10, 60], :3], [(0, 0, 1), (1, 0, 0)], atol=1e-6)
    np.testing.assert_allclose(image[4, 36, :3], (0, 0, 1), atol=1e-6)
    with pytest.raises(InputError, match="different textures, which cannot be merged"):
        rts.load(path, merge=True)


def test_faces_of_a_ply_whose_texture_is_not_told_are_warned_of(tmp_path):
    path = ply_of_textures(tmp_path, ["a.png", "b.png"], [])
    with pytest.warns(rts.errors.FileWarning, match="has 2 textures, and no texnumber of faces: the first, 'a.png'"):
        [part] = rts.load(path)
    np.testing.assert_array_equal(part.theta["texture"][0, 0], (1, 0, 0))
    path = ply_of_textures(tmp_path, ["a.png"], [0, -1, 0])
    with pytest.warns(
        rts.errors.FileWarning, match="1 of 3 faces have a texnumber .* its 1 textures, such as face 1 wi"
    ):
        red, plain = rts.load(path)
    assert "texture" in red.theta and len(red.surface.faces) == 3
    assert "texture" not in plain.theta and len(plain.surface.faces) == 1


def test_point_clouds_are_refused(tmp_path):
    trimesh.PointCloud(np.eye(3)).export(tmp_path / "m.ply")
    with pytest.raises(InputError, match="3 points but no faces"):
        rts.load(tmp_path / "m.ply")


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
    with pytest.warns(rts.errors.FileWarning, match=r"pictures that are not there, .*: 'tex.png' \(map_kd\) of 'm'$"):
        [part] = rts.load(path)
    assert "uv" in part.theta and "texture" not in part.theta
    (tmp_path / "quad.mtl").unlink()
    with pytest.warns(UserWarning, match="material library 'quad.mtl'"):
        [part] = rts.load(path)
    assert "uv" in part.theta


@pytest.mark.parametrize(
    ("corners", "uv", "normals", "said"),
    [
        ("1/1/1 2/2/1 3/3/1", False, False, [r"1 of 2 faces refer to texture coordinates .* 0 of the file", "normals"]),
        ("1//1 2//1 3//1", False, False, ["normals that are not among the 0"]),
        ("1/1 2/2 3/3", False, False, ["texture coordinates that are not among the 0"]),
        ("1/-1 2/-2 3/0", False, False, ["texture coordinates that are not among the 0"]),
        ("1/1 2/2 3/9", True, False, ["texture coordinates that are not among the 4"]),
        ("1/-9 2/2 3/3", True, False, ["texture coordinates that are not among the 4"]),
    ],
)
def test_texture_coordinates_and_normals_that_are_not_there_are_left_out_with_a_warning(
    tmp_path, corners, uv, normals, said
):
    rows = QUAD + (QUAD_UV if uv else "")
    with pytest.warns(rts.errors.FileWarning) as caught:
        [part] = rts.load(write(tmp_path / "m.obj", f"{rows}f {corners}\nf 1 3 4\n"))
    [text] = [str(w.message) for w in caught]
    assert f"m.obj, line {9 if uv else 5}: 1 of 2 faces refer to" in text
    for words in said:
        assert re.search(words, text)
    assert ("uv" in part.theta) == uv and "normals" not in part.theta
    np.testing.assert_array_equal(part.surface.faces, [(0, 1, 2), (0, 2, 3)])


def test_a_material_without_its_picture_has_its_colour(tmp_path):
    path = textured_quad(tmp_path)
    write(tmp_path / "quad.mtl", "newmtl m\nKd 0.5 0 1\nmap_Kd -s 2 2 1 none.png\nmap_Pr none.png\nPm 1\nd 0.5\n")
    with pytest.warns(rts.errors.FileWarning) as caught:
        [part] = rts.load(path)
    [text] = [str(w.message) for w in caught]
    assert text.endswith("'none.png' (map_kd) of 'm', 'none.png' (map_pr) of 'm'")
    np.testing.assert_allclose(part.theta["color"], [0.21404114, 0, 1, 0.5], atol=1e-6)
    assert part.theta["metallic"] == 1 and "roughness" not in part.theta


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


def test_names_in_a_file_that_no_file_can_have(tmp_path):
    write(tmp_path / "m.mtl", f"newmtl m\nmap_Kd {'a' * 999}.png\n")
    gltf = {"asset": {"version": "2.0"}, "buffers": [{"uri": f"{'a' * 999}.bin", "byteLength": 1}]}
    for name, text in {
        "a.obj": f"mtllib {'a' * 999}.mtl\n{QUAD}f 1 2 3\n",
        "b.obj": f"mtllib m.mtl\n{QUAD}usemtl m\nf 1 2 3\n",
        "c.gltf": json.dumps(gltf),
    }.items():
        with pytest.raises(InputError, match="refers to 'a{60}', which no file can be called; repair the file"):
            rts.load(write(tmp_path / name, text))


@pytest.mark.parametrize("kind", ["obj", "ply"])
def test_what_is_no_regular_file_is_not_waited_for(tmp_path, kind):
    os.mkfifo(tmp_path / f"m.{kind}")
    with pytest.raises(InputError, match="is no regular file"):
        rts.load(tmp_path / f"m.{kind}")


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


# ------------------------------------------------------------------------------------------------- pictures


def test_the_srgb_curve_is_exact():
    codes = np.arange(256) / 255
    np.testing.assert_allclose(encode_srgb(decode_srgb(codes[:, None]))[:, 0], codes, atol=1e-12)
    np.testing.assert_allclose(decode_srgb(np.array([0.04045, 0.5, 1.0])), [0.04045 / 12.92, 0.21404114, 1], atol=1e-7)


@pytest.mark.parametrize("shape", [(3, 5), (3, 5, 1), (3, 5, 3), (3, 5, 4)])
def test_shapes_of_pictures(tmp_path, shape):
    rts.save_image(tmp_path / "a.png", np.full(shape, 2.0))
    np.testing.assert_array_equal(rts.load_image(tmp_path / "a.png"), np.ones((3, 5, 4), np.float32))


def test_pictures_may_be_nested_lists(tmp_path):
    rts.save_image(tmp_path / "a.png", [[0.0, 1.0, 0.0], (1.0, 1.0, 1.0)])
    np.testing.assert_array_equal(rts.load_image(tmp_path / "a.png")[..., 0], [[0, 1, 0], [1, 1, 1]])


@pytest.mark.parametrize("target", DIFFERENTIABLE)
def test_pictures_may_be_arrays_of_an_engine(tmp_path, target):
    image = arrays(target, np.full((2, 3, 3), 0.5))
    rts.save_image(tmp_path / "a.png", image.requires_grad_() if target != "jax" else image)
    np.testing.assert_allclose(rts.load_image(tmp_path / "a.png")[..., :3], 0.5, atol=0.003)


def test_grey_pictures_of_16_bits(tmp_path):
    Image.fromarray(np.full((2, 2), 32768, np.uint16)).save(tmp_path / "a.png")
    np.testing.assert_allclose(rts.load_image(tmp_path / "a.png")[0, 0], [0.21405, 0.21405, 0.21405, 1], atol=1e-4)


@pytest.mark.parametrize(
    ("image", "expected"),
    [
        (np.full((2, 2, 3), np.nan), "12 of .*'s 12 values are NaN"),
        (np.full((2, 2), np.inf), "NaN or infinite"),
        (np.zeros((2, 2, 5)), "shape"),
        (np.zeros(4), "shape"),
        (np.zeros((0, 2, 3)), "shape"),
        (np.zeros((2, 2, 3), np.uint8), "dtype uint8"),
        (np.zeros((2, 2), complex), "dtype complex128"),
        (np.zeros((2, 2), object), "dtype object"),
        (np.zeros((2, 2, 2, 2)), "shape"),
        (np.float64(0.5), "shape"),
        (np.broadcast_to(0.5, (10**6, 10**6)), "does not fit into memory"),
        (None, "is None, a NoneType; expected an array"),
        ("hello", "is 'hello', a str; expected an array"),
        (3, "is 3, a int; expected an array"),
        ([[0.5] * 99, [0.5]], r"is \[\[0.5, 0.5.{0,60}\.\.\., a list; expected an array"),
        ([["a"]], "dtype <U1"),
        ([[1, 2]], "dtype int"),
        ([0.5], "shape"),
        ({"a": 1}, "a dict; expected an array"),
    ],
)
def test_what_is_no_picture_is_refused(tmp_path, image, expected):
    with pytest.raises(InputError, match=expected) as error:
        rts.save_image(tmp_path / "a.png", image)
    assert "the image" in message(error)
    with pytest.raises(InputError, match=expected) as error:
        rts.save_animation(tmp_path / "a.gif", [np.zeros((2, 2)), image])
    assert "frame 1" in message(error)
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
    with pytest.raises(InputError, match="is a folder; expected a picture"):
        rts.load_image(tmp_path)
    for load in (rts.load_image, rts.load, lambda path: rts.save_image(path, np.zeros((2, 2)))):
        for path in (None, 3, ["a.png"], b"a.png", np.zeros(3)):
            with pytest.raises(InputError, match=f"the path is a {type(path).__name__}; expected a string"):
                load(path)
        for path, expected in {"a\0.png": "no file can be called", f"{'a' * 999}.png": "name too long"}.items():
            with pytest.raises(InputError, match=f"(?i){expected}") as error:
                load(path)
            assert len(message(error)) < 200


def test_where_nothing_can_be_written_is_found_before_anything_is_made(tmp_path, monkeypatch):
    def fails(*_, **__):
        raise OSError(30, "Read-only file system")

    (tmp_path / "old.png").write_text("")
    with monkeypatch.context() as patched:
        patched.setattr("tempfile.TemporaryFile", fails)
        for name in ("a.png", "new/deeper/a.png"):
            with refused(r"nothing can be written into .*Read-only file system\); choose"):
                rts.save_image(tmp_path / name, np.zeros((2, 2)))
        patched.setattr("os.access", lambda *_: False)
        with pytest.raises(InputError, match=r"old.png cannot be written \(Permission denied\)"):
            rts.save_image(tmp_path / "old.png", np.zeros((2, 2)))
    assert [p.name for p in tmp_path.iterdir()] == ["old.png"]
    monkeypatch.setattr(Image.Image, "save", fails)
    for save in (
        lambda: rts.save_image(tmp_path / "a.png", np.zeros((2, 2))),
        lambda: rts.save_animation(tmp_path / "a.png", [np.zeros((2, 2))]),
    ):
        with refused(r"a.png cannot be written \(Read-only file system\)"):
            save()


def test_colours_that_are_far_too_bright_or_hardly_opaque_are_saved_without_a_warning(tmp_path):
    image = np.zeros((1, 3, 4))
    image[0] = [[1e308, 0, 0, 1e-310], [0, 1e300, 0, 1], [-1e308, 0, 0, 1e300]]
    rts.save_image(tmp_path / "a.png", image)
    np.testing.assert_array_equal(rts.load_image(tmp_path / "a.png")[0], [[0] * 4, [0, 1, 0, 1], [0, 0, 0, 1]])
    rts.save_animation(tmp_path / "a.gif", [image.astype(np.float64)])


def test_pictures_of_floating_numbers_are_refused(tmp_path):
    Image.fromarray(np.full((2, 2), 0.5, np.float32)).save(tmp_path / "a.tiff")
    with refused("a.tiff .*holds floating-point numbers"):
        rts.load_image(tmp_path / "a.tiff")


def test_what_pillow_warns_of_is_a_warning_that_names_the_picture(tmp_path, monkeypatch):
    Image.new("RGB", (8, 8)).save(tmp_path / "a.png")
    monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", 40)
    with pytest.warns(UserWarning, match=r"a\.png: Image size \(64 pixels\) exceeds") as caught:
        rts.load_image(tmp_path / "a.png")
    assert caught[0].filename == __file__


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
    for fps in (0, -1, np.nan, np.inf, None, "20", [20], True, np.ones(3), 1j):
        with refused("fps is .*; expected a positive number"):
            rts.save_animation(tmp_path / "a.gif", [np.zeros((2, 2))], fps=fps)
    for kind, fps in [("gif", 1e-9), ("gif", 0.001), ("gif", 500), ("png", 1e-300), ("png", 1e4)]:
        with pytest.raises(InputError, match=f"fps is .*, and a .{kind} holds from .* to 10+ frames a second"):
            rts.save_animation(tmp_path / f"a.{kind}", [np.zeros((2, 2))], fps=fps)
    for frames in (None, 3, "abc", b"abc", {"a": 1}):
        with pytest.raises(InputError, match=f"frames is a {type(frames).__name__}; expected several images"):
            rts.save_animation(tmp_path / "a.gif", frames)
    for shape in [(4, 6, 3), (4, 6, 4), (4, 6)]:
        with pytest.raises(InputError, match=r"frames is one image, \(4, 6.*; expected several"):
            rts.save_animation(tmp_path / "a.gif", np.zeros(shape))
    with pytest.raises(InputError, match="at most 65535 pixels a side"):
        rts.save_animation(tmp_path / "a.gif", [np.zeros((1, 70000))])
    assert not list(tmp_path.iterdir())


def test_an_array_of_frames_is_an_animation_and_its_speed_is_the_nearest_that_there_is(tmp_path):
    for fps, duration in {60: 20, 30: 30, 25: 40}.items():
        rts.save_animation(tmp_path / "a.gif", np.linspace(0, 1, 3)[:, None, None, None] * np.ones((4, 6, 3)), fps=fps)
        with Image.open(tmp_path / "a.gif") as file:
            assert file.n_frames == 3 and file.info["duration"] == duration


def test_mp4_needs_a_package(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    with pytest.raises(PluginError, match=r"pip install 'rasterize-then-splat\[video\]'"):
        rts.save_animation(tmp_path / "a.mp4", [np.zeros((2, 2))])


# jax, where it is loaded, warns of the fork that starts ffmpeg.
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning", "ignore:os.fork")
def test_mp4(tmp_path):
    pytest.importorskip("imageio_ffmpeg")
    rts.save_animation(tmp_path / "a.mp4", [np.zeros((17, 15, 3)), np.ones((17, 15, 3))], fps=5)
    assert (tmp_path / "a.mp4").stat().st_size > 500


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
