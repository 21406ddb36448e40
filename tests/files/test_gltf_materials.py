"""Materials of glTF, as the shader `pbr` reads them."""

import base64
import io
import json

import numpy as np
import pytest
from PIL import Image

import rts
from rts.shading.pbr import Pbr

pytestmark = pytest.mark.files


def picture(pixels):
    """A PNG (h, w, 3) of bytes, as a URI."""
    file = io.BytesIO()
    Image.fromarray(np.asarray(pixels, np.uint8)).save(file, "png")
    return "data:image/png;base64," + base64.b64encode(file.getvalue()).decode()


def model(folder, material, images=(), uv=True):
    """A glTF of one triangle with a material; textures are numbered as their images."""
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], np.float32)
    data = corners.tobytes() + corners[:, :2].tobytes()
    views = [{"buffer": 0, "byteLength": 36}, {"buffer": 0, "byteOffset": 36, "byteLength": 24}]
    bounds = {"min": [0, 0, 0], "max": [1, 1, 0]}
    accessors = [
        {"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3", **bounds},
        {"bufferView": 1, "componentType": 5126, "count": 3, "type": "VEC2"},
    ]
    attributes = {"POSITION": 0, "TEXCOORD_0": 1} if uv else {"POSITION": 0}
    tree = {
        "asset": {"version": "2.0"},
        "buffers": [{"uri": "data:;base64," + base64.b64encode(data).decode(), "byteLength": len(data)}],
        "bufferViews": views,
        "accessors": accessors,
        "meshes": [{"primitives": [{"attributes": attributes, "material": 0}]}],
        "nodes": [{"mesh": 0}],
        "scenes": [{"nodes": [0]}],
        "materials": [material],
    }
    if images:
        tree |= {
            "images": [{"uri": picture(x)} for x in images],
            "textures": [{"source": i} for i in range(len(images))],
        }
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


def test_maps_need_uv(tmp_path):
    material = {"pbrMetallicRoughness": {"metallicFactor": 0.0}, "normalTexture": {"index": 0}}
    [part] = rts.load(model(tmp_path, material, [np.full((1, 1, 3), 128)], uv=False))
    assert "normal_map" not in part.theta and part.theta["metallic"] == 0
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
