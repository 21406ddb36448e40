"""Materials of OBJ files, as the shader `pbr` reads them."""

import numpy as np
import pytest
from PIL import Image

import rts
from rts.shading.pbr import Pbr
from rts.shading.shaders import Lambert

pytestmark = pytest.mark.files

SQUARE = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\n"


def loaded(folder, material):
    """The part of a square with a material of these lines."""
    (folder / "m.mtl").write_text(f"newmtl m\n{material}\n")
    (folder / "m.obj").write_text(f"mtllib m.mtl\n{SQUARE}usemtl m\nf 1/1 2/2 3/3 4/4\n")
    [part] = rts.load(folder / "m.obj")
    return part


def picture(folder, name, pixel):
    """A PNG of one pixel."""
    Image.fromarray(np.array([[pixel]], np.uint8)).save(folder / name)


def test_numbers_are_entries_of_pbr_and_what_is_bright_is_linear(tmp_path):
    part = loaded(tmp_path, "Kd 1 1 1\nPr 0.25\nPm 1.5\nKe 0.5 0 0")
    assert isinstance(part.shader, Pbr)
    assert part.theta["roughness"] == 0.25 and part.theta["metallic"] == 1
    np.testing.assert_allclose(part.theta["emissive"], [((0.5 + 0.055) / 1.055) ** 2.4, 0, 0], rtol=1e-5)


def test_maps_replace_numbers(tmp_path):
    picture(tmp_path, "r.png", (51, 0, 0))
    picture(tmp_path, "n.png", (255, 128, 255))
    picture(tmp_path, "e.png", (255, 188, 0))
    part = loaded(tmp_path, "Pr 1\nmap_Pr r.png\nmap_Pm r.png\nnorm -bm 1.0 n.png\nKe 1 1 1\nmap_Ke e.png")
    for name in ("roughness", "metallic"):
        np.testing.assert_allclose(part.theta[name], [[[0.2]]], atol=1e-6)
    np.testing.assert_allclose(part.theta["normal_map"], [[[1, 2 * 128 / 255 - 1, 1]]], atol=1e-6)
    np.testing.assert_allclose(part.theta["emissive"], [[[1, ((188 / 255 + 0.055) / 1.055) ** 2.4, 0]]], rtol=1e-5)


def test_a_material_without_them_is_lambert(tmp_path):
    part = loaded(tmp_path, "Kd 1 0 0\nKs 1 1 1\nNs 20\nKe 0 0 0")
    assert isinstance(part.shader, Lambert) and set(part.theta) == {"vertices", "uv", "color"}


def test_other_maps_are_named_in_one_warning_but_for_copies_of_the_texture(tmp_path):
    picture(tmp_path, "t.png", (255, 0, 0))
    with pytest.warns(rts.errors.FileWarning) as caught:
        loaded(tmp_path, "map_Kd t.png\nmap_Ka t.png\nmap_Bump b.png\nmap_Ks s.png\nmap_d a.png\ndisp d.png")
    [warning] = caught
    assert str(warning.message) == (
        f"{tmp_path / 'm.obj'} has maps that are not read: map_bump of 'm', map_ks of 'm', map_d of 'm' and 1 more"
    )


def test_options_that_are_not_followed_are_named_in_the_same_warning(tmp_path):
    picture(tmp_path, "t.png", (255, 0, 0))
    with pytest.warns(rts.errors.FileWarning) as caught:
        loaded(tmp_path, "map_Kd -s 2 2 1 -o -0.5 0 0 -bm 1 -clamp on t.png\nmap_Pr -imfchan r t.png\nmap_Ks s.png")
    [warning] = caught
    assert str(warning.message) == (
        f"{tmp_path / 'm.obj'} has maps that are not read: map_ks of 'm'; and options of maps that are not followed: "
        "-s of map_kd of 'm', -o of map_kd of 'm', -clamp of map_kd of 'm' and 1 more"
    )
