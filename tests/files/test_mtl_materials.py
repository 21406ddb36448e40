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


def picture_of(folder, name, pixels):
    """A PNG of grey or coloured pixels."""
    Image.fromarray(np.array(pixels, np.uint8)).save(folder / name)


def test_heights_that_rise_along_u_tilt_normals_to_its_other_side(tmp_path):
    picture_of(tmp_path, "h.png", [[0, 51, 102, 153]])
    part = loaded(tmp_path, "map_Bump -bm 0.5 h.png")
    assert isinstance(part.shader, Pbr)
    normals = part.theta["normal_map"]
    # The first and last column are beside each other, since textures repeat.
    slopes = 0.5 * np.array([0.2 - 0.6, 0.4, 0.4, 0 - 0.4]) / 2
    expected = np.stack([-slopes, 0 * slopes, np.ones(4)], axis=1) / np.hypot(slopes, 1)[:, None]
    np.testing.assert_allclose(normals, expected[None], atol=1e-6)
    assert normals.dtype == np.float32 and (normals[0, 1:3, 0] < 0).all()


def test_heights_that_rise_along_v_tilt_normals_down_though_rows_go_down(tmp_path):
    picture_of(tmp_path, "h.png", [[153], [102], [51], [0]])
    normals = loaded(tmp_path, "bump h.png").theta["normal_map"]
    slopes = np.array([0 - 0.4, 0.4, 0.4, 0.2 - 0.6]) / 2
    expected = np.stack([0 * slopes, -slopes, np.ones(4)], axis=1) / np.hypot(slopes, 1)[:, None]
    np.testing.assert_allclose(normals, expected[:, None], atol=1e-6)


def test_a_hill_is_a_hollow_with_the_opposite_multiplier_and_none_without_a_slope(tmp_path):
    picture_of(tmp_path, "h.png", [[0, 0, 0], [0, 255, 100], [0, 60, 0]])
    picture_of(tmp_path, "flat.png", np.full((2, 3), 200))
    hill, hollow = (loaded(tmp_path, f"bump -bm {m} h.png").theta["normal_map"] for m in ("2", "-2"))
    np.testing.assert_allclose(hollow, hill * [-1, -1, 1], atol=1e-6)
    for line in ("bump -bm 0 h.png", "bump flat.png"):
        np.testing.assert_allclose(loaded(tmp_path, line).theta["normal_map"] - [0, 0, 1.0], 0, atol=1e-6)


def test_of_a_bump_map_the_multiplier_is_followed_and_other_options_are_not(tmp_path):
    picture_of(tmp_path, "h.png", [[0, 255, 0]])
    with pytest.warns(rts.errors.FileWarning, match=r": -s of map_bump of 'm'$"):
        loaded(tmp_path, "bump -bm 0.5 -s 2 2 2 h.png")


def test_the_height_of_a_colour_is_its_luminance(tmp_path):
    picture_of(tmp_path, "h.png", [[(0, 0, 0), (255, 0, 0), (0, 0, 0), (0, 255, 0)]])
    normals = loaded(tmp_path, "bump h.png").theta["normal_map"]
    np.testing.assert_allclose(normals[0, 0, 0] / normals[0, 0, 2], (0.7152 - 0.2126) / 2, rtol=1e-5)


def test_light_from_the_side_brightens_the_slope_that_faces_it(tmp_path):
    heights = 127 * (1 + np.cos(np.linspace(0, 2 * np.pi, 64, endpoint=False)))  # Lowest in the middle.
    for name, pixels, direction in (("u.png", heights[None], (1, 0, 1)), ("v.png", heights[:, None], (0, 1, 1))):
        picture_of(tmp_path, name, pixels)
        part = loaded(tmp_path, f"bump -bm 20 {name}")
        light = {"direction": np.array([direction], float), "color": np.ones((1, 3)), "ambient": np.zeros(3)}
        part = part.replace(theta={**part.theta, "light": light})
        camera = rts.Camera.look_at((0.5, 0.5, 3), (0.5, 0.5, 0), fov_y=15)
        image = np.asarray(rts.render(part, camera, (16, 16)))[..., 0]
        # Before the middle heights fall, and face what is beyond it.
        faces, turns = (image[:, 4:6], image[:, 10:12]) if name == "u.png" else (image[10:12], image[4:6])
        assert faces.mean() > 1.2 * turns.mean()


def test_a_bump_map_with_the_colours_of_a_normal_map_is_taken_for_one(tmp_path):
    pixels = np.array([[(128, 128, 255), (150, 110, 240), (0, 0, 0)]], np.uint8)
    picture_of(tmp_path, "n.png", pixels)
    with pytest.warns(rts.errors.FileWarning) as caught:
        part = loaded(tmp_path, "map_Bump -bm 0.5 n.png")
    [warning] = caught
    assert str(warning.message) == (
        f"{tmp_path / 'm.obj'} has bump maps that are taken for normal maps, by their colours: that of 'm'"
    )
    np.testing.assert_allclose(part.theta["normal_map"], (pixels / 127.5 - 1) * [0.5, 0.5, 1], atol=1e-6)


@pytest.mark.parametrize("grey", [0, 128, 200, 255])
def test_grey_is_never_taken_for_a_normal_map(tmp_path, grey):
    picture_of(tmp_path, "h.png", [[grey, grey], [grey, 0]])
    normals = loaded(tmp_path, "map_Bump h.png").theta["normal_map"]
    np.testing.assert_allclose(np.linalg.norm(normals, axis=-1), 1, atol=1e-6)


def test_a_normal_map_goes_before_a_bump_map(tmp_path):
    picture(tmp_path, "n.png", (255, 128, 255))
    picture_of(tmp_path, "h.png", [[0, 255, 0]])
    with pytest.warns(rts.errors.FileWarning, match=r"has maps that are not read: map_bump of 'm'$"):
        part = loaded(tmp_path, "bump -s 2 2 2 h.png\nnorm n.png")
    np.testing.assert_allclose(part.theta["normal_map"], [[[1, 2 * 128 / 255 - 1, 1]]], atol=1e-6)
    assert part.theta["normal_map"].shape == loaded(tmp_path, "norm n.png\nbump n.png").theta["normal_map"].shape


@pytest.mark.parametrize("values", ["", "nan", "inf", "much", "0,5", "1.2.3", "1e999", "-1e7", "1 2"])
def test_multipliers_that_are_not_one_number_are_taken_for_one_with_a_warning_of_their_line(tmp_path, values):
    picture_of(tmp_path, "h.png", [[0, 255, 0]])
    with pytest.warns(rts.errors.FileWarning, match=r"m.mtl, line 2: -bm is '.*' in '-bm .*h.png', not one number"):
        part = loaded(tmp_path, f"map_Bump -bm {values} h.png")
    np.testing.assert_array_equal(part.theta["normal_map"], loaded(tmp_path, "map_Bump h.png").theta["normal_map"])


def test_specular_maps_are_read_beside_entries_of_pbr_alone(tmp_path):
    picture(tmp_path, "s.png", (255, 51, 0))
    part = loaded(tmp_path, "Pr 0.5\nmap_Ks s.png")
    np.testing.assert_allclose(part.theta["specular"], [[[2, 0.4, 0]]], atol=1e-6)
    with pytest.warns(rts.errors.FileWarning, match="maps that are not read: map_ks of 'm'"):
        assert isinstance(loaded(tmp_path, "Kd 1 1 1\nmap_Ks s.png").shader, Lambert)


def test_other_maps_are_named_in_one_warning_but_for_copies_of_the_texture(tmp_path):
    picture(tmp_path, "t.png", (255, 0, 0))
    with pytest.warns(rts.errors.FileWarning) as caught:
        loaded(tmp_path, "map_Kd t.png\nmap_Ka t.png\nmap_Ks s.png\nmap_d a.png\ndisp d.png\nrefl r.png")
    [warning] = caught
    assert str(warning.message) == (
        f"{tmp_path / 'm.obj'} has maps that are not read: map_ks of 'm', map_d of 'm', disp of 'm' and 1 more"
    )


def test_options_that_are_not_followed_are_named_in_the_same_warning(tmp_path):
    picture(tmp_path, "t.png", (255, 0, 0))
    with pytest.warns(rts.errors.FileWarning) as caught:
        loaded(tmp_path, "map_Kd -s 2 2 1 -o -0.5 0 0 -bm 1 -clamp on t.png\nmap_Pr -imfchan r t.png\nmap_d s.png")
    [warning] = caught
    assert str(warning.message) == (
        f"{tmp_path / 'm.obj'} has maps that are not read: map_d of 'm'; and options of maps that are not followed: "
        "-s of map_kd of 'm', -o of map_kd of 'm', -clamp of map_kd of 'm' and 1 more"
    )


def test_colour_spaces_of_maps_are_options_with_a_word(tmp_path):
    picture(tmp_path, "t 1.png", (255, 0, 0))
    part = loaded(tmp_path, "map_Kd -colorspace sRGB t 1.png\nmap_Pr -s 1 1 1 -colorspace Linear -clamp off t 1.png")
    np.testing.assert_array_equal(part.theta["texture"], [[[1, 0, 0]]])
    np.testing.assert_array_equal(part.theta["roughness"], [[[1]]])
    with pytest.warns(rts.errors.FileWarning, match="not followed: -colorspace of map_kd of 'm', -texres of map_pr"):
        loaded(tmp_path, "map_Kd -colorspace linear t 1.png\nmap_Pr -texres 512x512 t 1.png")
