"""Materials of glTF, as the shader `pbr` reads them."""

import base64
import io
import json

import numpy as np
import pytest
from gltf_accessors import stored
from PIL import Image

import rts
from rts.shading.pbr import Pbr

pytestmark = pytest.mark.files


def picture(pixels):
    """A PNG (h, w, 3) of bytes, as a URI."""
    file = io.BytesIO()
    Image.fromarray(np.asarray(pixels, np.uint8)).save(file, "png")
    return "data:image/png;base64," + base64.b64encode(file.getvalue()).decode()


def near(x, z=2.0):
    """A camera that sees a small square around (x, 0.2, 0) from a point above it."""
    return rts.Camera.look_at((x, 0.2, z), (x, 0.2, 0), fov_y=5)


CORNERS = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], np.float32)


def model(folder, material, images=(), uv=True, more=None, **tables):
    """A glTF of one triangle with a material; textures are numbered as their images.

    `more` are further entries of the tree, and `tables` further attributes, (3, C) float32.
    """
    coordinates = {"TEXCOORD_0": CORNERS[:, :2]} if uv else {}
    tables = {"POSITION": CORNERS, **coordinates, **{name: np.float32(x) for name, x in tables.items()}}
    tree = {
        "asset": {"version": "2.0"},
        "nodes": [{"mesh": 0}],
        "scenes": [{"nodes": [0]}],
        "materials": [material],
        **(more or {}),
    }
    attributes = {name: stored(tree, rows) for name, rows in tables.items()}
    tree["accessors"][0] |= {"min": [0, 0, 0], "max": [1, 1, 0]}
    tree["meshes"] = [{"primitives": [{"attributes": attributes, "material": 0}]}]
    if images:
        tree |= {
            "images": [{"uri": picture(x)} for x in images],
            "textures": [{"source": i} for i in range(len(images))],
        }
        for texture, sampler in zip(tree["textures"], range(len(tree.get("samplers", []))), strict=False):
            texture["sampler"] = sampler
    path = folder / "m.gltf"
    path.write_text(json.dumps(tree))
    return path


def test_factors_and_maps_are_multiplied_and_decoded(tmp_path):
    surface = np.array([[[9, 51, 102], [9, 255, 0]]])
    bumps = np.array([[[255, 128, 255]]])
    shade, glow = np.array([[[51, 0, 0]]]), np.array([[[255, 0, 188]]])
    material = {
        "pbrMetallicRoughness": {
            "metallicFactor": 0.5,
            "roughnessFactor": 0.25,
            "metallicRoughnessTexture": {"index": 0},
        },
        "normalTexture": {"index": 1, "scale": 2.0},
        "occlusionTexture": {"index": 2, "strength": 0.5},
        "emissiveTexture": {"index": 3},
        "emissiveFactor": [0.5, 1, 1],
        "extensions": {"KHR_materials_emissive_strength": {"emissiveStrength": 4.0}},
    }
    [part] = rts.load(model(tmp_path, material, [surface, bumps, shade, glow]))
    theta = part.theta
    assert isinstance(part.shader, Pbr) and part.shader.opaque
    np.testing.assert_allclose(theta["metallic"][0, :, 0], [0.5 * 0.4, 0], atol=1e-6)
    np.testing.assert_allclose(theta["roughness"][0, :, 0], [0.25 * 0.2, 0.25], atol=1e-6)
    np.testing.assert_allclose(theta["normal_map"][0, 0], [2, 2 * (256 / 255 - 1), 1], atol=1e-6)
    np.testing.assert_allclose(theta["occlusion"][0, 0], [1 + 0.5 * (0.2 - 1)], atol=1e-6)
    linear = ((188 / 255 + 0.055) / 1.055) ** 2.4
    np.testing.assert_allclose(theta["emissive"][0, 0], [2, 0, 4 * linear], atol=1e-5)


def test_specular_factors_and_maps_are_multiplied(tmp_path):
    shine = {"specularFactor": 0.5, "specularColorFactor": [1, 0.5, 2]}
    material = {"pbrMetallicRoughness": {"metallicFactor": 0}, "extensions": {"KHR_materials_specular": shine}}
    [part] = rts.load(model(tmp_path, material))
    np.testing.assert_allclose(part.theta["specular"], [0.5, 0.25, 1])
    shine |= {"specularColorTexture": {"index": 0}, "specularTexture": {"index": 1}}
    tint, strength = np.array([[[255, 188, 0]]]), np.array([[[0, 0, 0, 51]]])
    [part] = rts.load(model(tmp_path, material, [tint, strength]))
    linear = ((188 / 255 + 0.055) / 1.055) ** 2.4
    np.testing.assert_allclose(part.theta["specular"], [[[0.1, 0.05 * linear, 0]]], atol=1e-6)
    for wrong in ({"specularFactor": 1.5}, {"specularColorFactor": [1, 1]}, {"specularColorFactor": [1, -1, 1]}):
        material["extensions"]["KHR_materials_specular"] = wrong
        with pytest.raises(rts.InputError, match=f"{next(iter(wrong))} of material 0"):
            rts.load(model(tmp_path, material))


def test_factors_alone_are_numbers_whose_defaults_are_those_of_the_format(tmp_path):
    [part] = rts.load(model(tmp_path, {"pbrMetallicRoughness": {"roughnessFactor": 0.3}, "emissiveFactor": [1, 0, 0]}))
    assert {name: part.theta[name].tolist() for name in ("metallic", "roughness")} == {
        "metallic": 1.0,
        "roughness": pytest.approx(0.3),
    }
    assert part.theta["emissive"].tolist() == [1, 0, 0]


@pytest.mark.parametrize(
    "material",
    [
        {"pbrMetallicRoughness": {"baseColorFactor": [1, 0, 0, 1]}},
        {"pbrMetallicRoughness": {"metallicFactor": 0.5}, "extensions": {"KHR_materials_unlit": {}}},
    ],
    ids=["base colour alone", "unlit"],
)
def test_other_materials_have_the_shaders_of_before(tmp_path, material):
    [part] = rts.load(model(tmp_path, material))
    assert not isinstance(part.shader, Pbr) and "metallic" not in part.theta


def test_merged_parts_keep_a_material_that_all_have_or_say_that_it_goes(tmp_path):
    path = model(tmp_path, {"pbrMetallicRoughness": {"roughnessFactor": 0.3}})
    tree = json.loads(path.read_text())
    tree["nodes"].append({"mesh": 0, "translation": [2, 0, 0]})
    tree["scenes"] = [{"nodes": [0, 1]}]
    path.write_text(json.dumps(tree))
    [part] = rts.load(path, merge=True)
    assert part.theta["roughness"] == pytest.approx(0.3)
    tree["materials"].append({"pbrMetallicRoughness": {"roughnessFactor": 0.7}})
    tree["meshes"].append({"primitives": [tree["meshes"][0]["primitives"][0] | {"material": 1}]})
    tree["nodes"][1]["mesh"] = 1
    path.write_text(json.dumps(tree))
    with pytest.warns(rts.errors.FileWarning, match="different materials; merged, they keep base colours alone"):
        [part] = rts.load(path, merge=True)
    assert "roughness" not in part.theta


def test_merged_primitives_of_one_material_keep_it(tmp_path):
    look = {"baseColorTexture": {"index": 0}, "roughnessFactor": 0.3}
    path = model(tmp_path, {"pbrMetallicRoughness": look}, [np.full((1, 1, 3), 51)])
    tree = json.loads(path.read_text())
    tree["meshes"][0]["primitives"] *= 2
    path.write_text(json.dumps(tree))
    with pytest.warns(rts.errors.FileWarning, match="have the corners of another one"):  # They coincide.
        [part] = rts.load(path, merge=True)
    assert part.theta["roughness"] == pytest.approx(0.3)


def test_maps_need_uv(tmp_path):
    material = {"pbrMetallicRoughness": {"metallicFactor": 0.0}, "normalTexture": {"index": 0}}
    with pytest.warns(
        rts.errors.FileWarning, match="maps without their coordinates, whose mean is taken: the normal_m"
    ):
        [part] = rts.load(model(tmp_path, material, [np.full((1, 1, 3), 128)], uv=False))
    assert "normal_map" not in part.theta and part.theta["metallic"] == 0
    look = {"baseColorTexture": {"index": 0}, "metallicRoughnessTexture": {"index": 0}, "metallicFactor": 0.5}
    path = model(tmp_path, {"pbrMetallicRoughness": look}, [np.full((1, 1, 3), 51)], uv=False)
    with pytest.warns(rts.errors.FileWarning, match="textures without coordinates, which are left out: that of mesh 0"):
        [part] = rts.load(path)
    np.testing.assert_allclose(part.theta["metallic"], [0.1], atol=1e-6)
    camera = rts.Camera.look_at((0.3, 0.3, 3), (0.3, 0.3, 0))
    assert rts.render(part, camera, (8, 8)).max() > 0


@pytest.mark.parametrize(
    ("material", "message"),
    [
        ({"pbrMetallicRoughness": {"metallicFactor": 2}}, "metallicFactor of material 0 is 2; expected a number"),
        ({"pbrMetallicRoughness": {"roughnessFactor": "x"}}, "roughnessFactor of material 0 is x"),
        ({"emissiveFactor": [1, 2, 3], "pbrMetallicRoughness": {"metallicFactor": 0}}, "emissiveFactor of material 0"),
    ],
)
def test_wrong_factors_are_refused(tmp_path, material, message):
    with pytest.raises(rts.InputError, match=message):
        rts.load(model(tmp_path, material))


# ------------------------------------------------------------------------------------------- where maps are looked up

GREY = np.full((1, 1, 3), 51)
SPECIFIED = {"offset": [0, 1], "rotation": np.pi / 2, "scale": [0.5, 0.5]}
"""The extension's own example: the lower left quarter of the image, turned clockwise by 90 degrees."""


def looked_up(index, transform=None, **reference):
    """The JSON of a reference to a texture."""
    return {"index": index, "extensions": {"KHR_texture_transform": transform or {}}, **reference}


def test_a_transform_that_all_maps_share_is_in_the_coordinates(tmp_path):
    look = {"baseColorTexture": looked_up(0, SPECIFIED), "metallicRoughnessTexture": looked_up(1, SPECIFIED)}
    [part] = rts.load(model(tmp_path, {"pbrMetallicRoughness": look}, [GREY, GREY]))
    # Corners are on the left and on top of the file's image; coordinates of rts point up.
    np.testing.assert_allclose(part.theta["uv"], [[0, 0], [0, 0.5], [0.5, 0]], atol=1e-7)


@pytest.mark.parametrize("reference", [{"texCoord": 1}, {"texCoord": 0, "transform": {"texCoord": 1}}])
def test_maps_may_all_use_another_set_of_coordinates(tmp_path, reference):
    look = {"baseColorTexture": looked_up(0, **reference)}
    further = np.array([[0.25, 0], [0.5, 0.5], [0, 1]])
    [part] = rts.load(model(tmp_path, {"pbrMetallicRoughness": look}, [GREY], TEXCOORD_1=further))
    np.testing.assert_allclose(part.theta["uv"], [[0.25, 1], [0.5, 0.5], [0, 0]], atol=1e-7)


def test_maps_may_have_coordinates_and_samplers_of_their_own(tmp_path):
    material = {
        "pbrMetallicRoughness": {"baseColorTexture": {"index": 0}, "metallicRoughnessTexture": looked_up(0, SPECIFIED)},
        "normalTexture": {"index": 0},
        "occlusionTexture": {"index": 0, "texCoord": 1},
        "emissiveTexture": {"index": 1},
        "emissiveFactor": [1, 1, 1],
    }
    further, samplers = np.array([[0.25, 0], [0.5, 0.5], [0, 1]]), {"samplers": [{}, {"wrapS": 33071}]}
    [part] = rts.load(model(tmp_path, material, [GREY, GREY], more=samplers, TEXCOORD_1=further))
    for name in ("uv_metallic", "uv_roughness"):
        np.testing.assert_allclose(part.theta[name], [[0, 0], [0, 0.5], [0.5, 0]], atol=1e-7)
    np.testing.assert_allclose(part.theta["uv_occlusion"], [[0.25, 1], [0.5, 0.5], [0, 0]], atol=1e-7)
    assert not {"uv_normal_map", "uv_emissive", "uv_texture"} & {*part.theta}
    assert part.shader.samplers == (("emissive", ("clamp", "repeat"), "linear"),)
    camera = rts.Camera.look_at((0.3, 0.3, 3), (0.3, 0.3, 0))
    assert np.isfinite(rts.render(part, camera, (8, 8))).all()


def test_a_map_without_its_coordinates_becomes_its_mean(tmp_path):
    material = {
        "pbrMetallicRoughness": {"baseColorTexture": {"index": 0}},
        "normalTexture": {"index": 0},
        "occlusionTexture": {"index": 0, "texCoord": 1},
    }
    path = model(tmp_path, material, [GREY])
    with pytest.warns(
        rts.errors.FileWarning, match="has maps without their coordinates, whose mean is taken: the occl"
    ):
        [part] = rts.load(path)
    assert "normal_map" in part.theta and "uv_occlusion" not in part.theta
    np.testing.assert_allclose(part.theta["occlusion"], [51 / 255], atol=1e-6)
    camera = rts.Camera.look_at((0.3, 0.3, 3), (0.3, 0.3, 0))
    assert np.isfinite(rts.render(part, camera, (8, 8))).all()


@pytest.mark.parametrize("textured", [True, False])
def test_merged_parts_of_different_materials_drop_how_maps_were_looked_up(tmp_path, textured):
    look = {"baseColorTexture": {"index": 0}} if textured else {}
    occlusion = {"occlusionTexture": {"index": 1, "texCoord": 1}}
    first = {"pbrMetallicRoughness": {**look, "metallicRoughnessTexture": {"index": 0}}, **occlusion}
    path = model(tmp_path, first, [GREY, GREY], more={"samplers": [{}, {"wrapS": 33071}]}, TEXCOORD_1=CORNERS[:, :2])
    tree = json.loads(path.read_text())
    tree["materials"].append({**first, "pbrMetallicRoughness": {**look, "metallicFactor": 0.5}})
    tree["meshes"].append({"primitives": [tree["meshes"][0]["primitives"][0] | {"material": 1}]})
    tree["nodes"].append({"mesh": 1, "translation": [2, 0, 0]})
    tree["scenes"] = [{"nodes": [0, 1]}]
    path.write_text(json.dumps(tree))
    with pytest.warns(rts.errors.FileWarning, match="different materials"):
        [part] = rts.load(path, merge=True)
    assert not [name for name in part.theta if name.startswith("uv_")] and "occlusion" not in part.theta


def test_what_is_not_followed_is_one_warning_that_names_it(tmp_path):
    shine = {"specularColorTexture": {"index": 0}, "specularTexture": looked_up(1, SPECIFIED)}
    material = {
        "pbrMetallicRoughness": {"baseColorTexture": {"index": 0}},
        "extensions": {"KHR_materials_clearcoat": {}, "KHR_materials_sheen": {}, "KHR_materials_specular": shine},
    }
    white, strength = np.full((1, 1, 3), 255), np.array([[[0, 0, 0, 51], [0, 0, 0, 153]]])
    path = model(tmp_path, material, [white, strength], COLOR_0=CORNERS)
    with pytest.warns(rts.errors.FileWarning) as caught:
        [part] = rts.load(path)
    assert [str(warning.message) for warning in caught] == [
        f"{path} uses the extensions KHR_materials_clearcoat, KHR_materials_sheen, which are not read; it is loaded "
        "as it is without; has a specularTexture of another size than the specularColorTexture, or looked up in "
        "another way, whose mean is taken: material 0"
    ]
    np.testing.assert_allclose(part.theta["specular"], [[[0.4, 0.4, 0.4]]], atol=1e-6)
    assert "colors" in part.theta and "texture" in part.theta


@pytest.mark.parametrize(
    ("sampler", "wrap", "filter"),
    [
        ({}, "repeat", "linear"),
        ({"wrapS": 33071, "wrapT": 33071, "magFilter": 9728}, "clamp", "nearest"),
        ({"wrapT": 33648, "magFilter": 9729, "minFilter": 9984}, ("repeat", "mirror"), "linear"),
        ({"minFilter": 9728}, "repeat", "nearest"),
        ({"minFilter": 9987}, "repeat", "linear"),
        ({"magFilter": 9728, "minFilter": 9728}, "repeat", "nearest"),
    ],
)
def test_samplers_are_options_of_the_shader(tmp_path, sampler, wrap, filter):
    look = {"baseColorTexture": {"index": 0}}
    [part] = rts.load(model(tmp_path, {"pbrMetallicRoughness": look}, [GREY], more={"samplers": [sampler]}))
    assert (part.shader.wrap, part.shader.filter, part.shader.mip) == (wrap, filter, False)


@pytest.mark.parametrize(("smaller", "larger", "filter"), [(9728, 9729, "linear"), (9729, 9728, "nearest")])
def test_one_filter_is_taken_where_a_sampler_has_two_and_the_warning_says_so(tmp_path, smaller, larger, filter):
    samplers = {"samplers": [{"magFilter": larger, "minFilter": smaller}]}
    path = model(tmp_path, {"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}, [GREY], more=samplers)
    with pytest.warns(rts.errors.FileWarning) as caught:
        [part] = rts.load(path)
    assert part.shader.filter == filter and [str(warning.message) for warning in caught] == [
        f"{path} has maps whose minFilter is another than their magFilter, which is taken for both: the texture of "
        "material 0"
    ]


@pytest.mark.parametrize(
    ("reference", "sampler", "message"),
    [
        ({"transform": {"scale": [1, "x"]}}, {}, "KHR_texture_transform of the texture of material 0 is .*'x'"),
        ({"transform": {"offset": [1]}}, {}, "KHR_texture_transform of the texture of material 0 is"),
        ({}, {"wrapS": 7}, "wrapS of the sampler of the texture of material 0 is 7; expected one of"),
    ],
)
def test_wrong_transforms_and_samplers_are_refused(tmp_path, reference, sampler, message):
    look = {"baseColorTexture": looked_up(0, **reference)}
    with pytest.raises(rts.InputError, match=message):
        rts.load(model(tmp_path, {"pbrMetallicRoughness": look}, [GREY], more={"samplers": [sampler]}))


# --------------------------------------------------------------------------------- colours, sides, tangents, no light


@pytest.mark.parametrize("material", [{}, {"alphaMode": "MASK", "alphaCutoff": 0.7}, {"alphaMode": "BLEND"}])
def test_vertex_colours_and_factors_are_exact(tmp_path, material):
    colors = np.float32([[0.7, 0.123456, 1e-4, 0.7], [0, 1, 0.3, 0.7], [0.5, 0.25, 0.1, 0.7]])
    factor = [0.1234567, 0.2, 0.3, 1]
    path = model(tmp_path, {**material, "pbrMetallicRoughness": {"baseColorFactor": factor}}, COLOR_0=colors)
    [part] = rts.load(path)
    np.testing.assert_array_equal(
        part.theta["colors"], colors if "alphaMode" in material and not part.shader.opaque else colors[:, :3]
    )
    np.testing.assert_array_equal(part.theta["color"], np.float32(factor[:3]))
    assert part.shader.opaque == (material.get("alphaMode") != "BLEND")


@pytest.mark.filterwarnings("ignore::rts.errors.EmptyImageWarning")
@pytest.mark.parametrize("merge", [False, True])
@pytest.mark.parametrize("mirrored", [False, True])
@pytest.mark.parametrize(
    ("cull", "double_sided", "seen"),
    [("file", False, False), ("file", True, True), ("none", False, True), ("back", True, False)],
)
def test_sides_are_those_of_the_file_where_it_is_asked_for(tmp_path, cull, double_sided, seen, mirrored, merge):
    scale = [-1, 1, 1] if mirrored else [1, 1, 1]
    nodes = {"nodes": [{"mesh": 0, "scale": scale}]}
    [part] = rts.load(model(tmp_path, {"doubleSided": double_sided}, more=nodes), cull=cull, merge=merge)
    x = 0.2 * scale[0]
    front, behind = (rts.render(part.replace(shader="silhouette"), near(x, z), (8, 8))[4, 4, 3] for z in (2, -2))
    assert front == 1 and behind == float(seen)


@pytest.mark.parametrize("merge", [False, True])
@pytest.mark.parametrize("mirrored", [False, True])
def test_tangents_of_the_file_turn_a_normal_map(tmp_path, mirrored, merge):
    # A normal map of directions along u, and tangents that point up, into the corner between x and y.
    tangents = [[0, 1, 0, -1]] * 3
    material = {"pbrMetallicRoughness": {"metallicFactor": 0}, "normalTexture": {"index": 0}}
    nodes = {"nodes": [{"mesh": 0, "scale": [-1 if mirrored else 1, 1, 1]}]}
    path = model(tmp_path, material, [[[[255, 255, 128]]]], more=nodes, TANGENT=tangents)
    [part] = rts.load(path, merge=merge)
    seen = []

    def shader(theta, gbuffer, camera):
        frame, normal = gbuffer["tangent"], gbuffer["normal"]
        seen.append((frame[:, :3], frame[:, 3:] * np.cross(normal, frame[:, :3])))
        return np.ones((len(frame), 4), np.float32)

    x = -0.2 if mirrored else 0.2
    rts.render(part.replace(shader=shader), near(x), (4, 4))
    along_u, along_v = seen[0]
    np.testing.assert_allclose(along_u[:16], [[0, 1, 0]] * 16, atol=1e-5)
    np.testing.assert_allclose(along_v[:16], [[-1 if mirrored else 1, 0, 0]] * 16, atol=1e-5)
    theta = {name: x for name, x in part.theta.items() if name != "tangents"}  # Then they are computed.
    rts.render(part.replace(shader=shader, theta=theta), near(x), (4, 4))
    np.testing.assert_allclose(seen[-1][0][:16], [[-1 if mirrored else 1, 0, 0]] * 16, atol=1e-5)


def test_tangents_without_a_normal_map_are_left_out(tmp_path):
    [part] = rts.load(model(tmp_path, {"pbrMetallicRoughness": {"metallicFactor": 0}}, TANGENT=[[1, 0, 0, 1]] * 3))
    assert "tangents" not in part.theta


def test_a_material_without_light_has_none_without_a_texture_either(tmp_path):
    look = {"baseColorFactor": [0.2, 0.4, 0.6, 1]}
    [part] = rts.load(model(tmp_path, {"pbrMetallicRoughness": look, "extensions": {"KHR_materials_unlit": {}}}))
    image = rts.render(part, near(0.2), (8, 8))
    np.testing.assert_allclose(image[4, 4], [0.2, 0.4, 0.6, 1], atol=1e-6)


# ---------------------------------------------------------------------------------------------------- models of others


def test_what_samplers_and_sides_make_of_a_test_card(data):
    parts = rts.load(data / "gltf/TextureSettingsTest.glb", cull="file")
    white = {"light": {"ambient": np.float32(1), "color": np.zeros(3)}}
    parts = [part.replace(theta={**part.theta, **white}) for part in parts]
    # Tiles of 0.9 lie in two columns, 2.146 apart; the right one shows what the left one should.
    pixel, y = 2.14592 / 60, -1.085
    camera = rts.Camera.orthographic((1.528, y, 5), (1.528, y, 0), height=226 * pixel)
    image = rts.render(parts, camera, (226, 160))[..., :3]
    tested, shown = image[:, 39:61], image[:, 99:121]
    assert shown.std() > 0.2 and np.abs(tested - shown).mean() < 0.025


def test_colours_of_a_box_are_at_its_corners_times_the_factor(data):
    [part] = rts.load(data / "gltf/BoxVertexColors.glb")
    camera = rts.Camera.orthographic((0, 0, 5), (0, 0, 0), height=1)
    image = rts.render(part.replace(shader="unlit"), camera, (400, 400))
    # Upper left and right, lower left and right, of the side towards the camera; sampled half a pixel inside.
    corners = [(0.511, 1, 0), (1, 0.001, 0.025), (0.804, 0.804, 0.804), (0.003, 0.131, 0.999)]
    np.testing.assert_allclose(image[::399, ::399, :3].reshape(4, 3), 0.8 * np.array(corners), atol=0.005)


@pytest.mark.thorough
def test_tangents_that_are_computed_are_those_of_a_file(data):
    [part] = rts.load(data / "gltf/WaterBottle/WaterBottle.gltf")
    seen = []

    def shader(theta, gbuffer, camera):
        normal, frame = gbuffer["normal"], gbuffer["tangent"]
        normal = normal / np.linalg.norm(normal, axis=1, keepdims=True)
        along = frame[:, :3] - np.sum(frame[:, :3] * normal, axis=1, keepdims=True) * normal
        seen.append((along / np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-9), np.sign(frame[:, 3])))
        return np.ones((len(frame), 4), np.float32)

    camera = rts.Camera.look_at((0.12, 0.05, 0.42), (0, 0, 0))
    computed = {name: x for name, x in part.theta.items() if name != "tangents"}
    for theta in (part.theta, computed):
        rts.render(part.replace(theta=theta, shader=shader), camera, (64, 64), splatter="none")
    (along, sign), (other, other_sign) = seen
    cosines = np.sum(along * other, axis=1)
    assert np.median(cosines) > 0.9999 and np.quantile(cosines, 0.05) > 0.99 and (sign == other_sign).mean() > 0.99
