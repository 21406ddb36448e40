"""Textures and shaders, by closed form."""

import math

import numpy as np
import pytest
from helpers import ALL, DIFFERENTIABLE, FRONT, TORCH, arrays, gradient, mesh_part, moved, quad, rigid, show, to_numpy

from rts import Camera, GBuffer, InputError, Mesh, Part, render
from rts.shading.shaders import BlinnPhong, Depth, Lambert, Normals, Silhouette, Unlit, sample_texture

pytestmark = pytest.mark.rendering

# ---------------------------------------------------------------------------------------------------- texture

TEXTURE = np.random.default_rng(0).random((3, 4, 3))


def texel(i, j):
    """(u, v) of the centre of texel row i, column j."""
    return (j + 0.5) / 4, 1 - (i + 0.5) / 3


@pytest.mark.parametrize("target", ALL)
@pytest.mark.parametrize("wrap", ["repeat", "mirror", "clamp"])
def test_texel_centres_are_exact_and_v_points_up(target, wrap):
    uv = np.array([texel(i, j) for i in range(3) for j in range(4)])
    found = to_numpy(sample_texture(*arrays(target, (TEXTURE, uv)), wrap))
    np.testing.assert_allclose(found.reshape(3, 4, 3), TEXTURE, atol=1e-6)


def test_between_texels_lookup_is_bilinear():
    uv = np.array([np.add(texel(1, 2), texel(1, 3)), np.add(texel(0, 1), texel(1, 1))]) / 2
    quarter = np.array(texel(0, 0)) * 0.75 * 0.5 + np.array(texel(0, 1)) * 0.25 * 0.5
    quarter += np.array(texel(1, 0)) * 0.75 * 0.5 + np.array(texel(1, 1)) * 0.25 * 0.5
    found = sample_texture(TEXTURE, np.concatenate([uv, [quarter]]))
    t = TEXTURE
    np.testing.assert_allclose(found[0], (t[1, 2] + t[1, 3]) / 2)
    np.testing.assert_allclose(found[1], (t[0, 1] + t[1, 1]) / 2)
    np.testing.assert_allclose(found[2], 0.375 * (t[0, 0] + t[1, 0]) + 0.125 * (t[0, 1] + t[1, 1]))


@pytest.mark.parametrize("target", ALL)
@pytest.mark.parametrize(
    "wrap, column",
    [
        ("repeat", [2, 3, 0, 1, 2, 3, 0, 1, 2, 3]),
        ("mirror", [1, 0, 0, 1, 2, 3, 3, 2, 1, 0]),
        ("clamp", [0, 0, 0, 1, 2, 3, 3, 3, 3, 3]),
    ],
)
def test_wrap_modes_outside_the_unit_square(target, wrap, column):
    # Columns −2 … 7 of a texture of four, and one whole turn farther out where that is the same.
    uv = np.array([texel(1, j) for j in range(-2, 8)])
    texture, there = arrays(target, (TEXTURE, uv))
    np.testing.assert_allclose(to_numpy(sample_texture(texture, there, wrap)), TEXTURE[1, column], atol=1e-6)
    # The same in v, on the transposed texture; rows count downwards, v upwards.
    flipped = np.array([((1 + 0.5) / 3, 1 - (i + 0.5) / 4) for i in range(-2, 8)])
    texture, there = arrays(target, (TEXTURE.transpose(1, 0, 2), flipped))
    np.testing.assert_allclose(to_numpy(sample_texture(texture, there, wrap)), TEXTURE[1, column], atol=1e-6)
    period = {"repeat": 3, "mirror": 2}.get(wrap)
    if period:
        texture, there = arrays(target, (TEXTURE, uv - 2 * period))
        np.testing.assert_allclose(to_numpy(sample_texture(texture, there, wrap)), TEXTURE[1, column], atol=1e-5)


@pytest.mark.parametrize("target", ALL)
def test_each_axis_has_its_wrap_and_nearest_takes_the_texel_around_a_point(target):
    near = np.array([(j + 0.5 + x, i + 0.5 + x) for i in range(-3, 6) for j in range(-4, 8) for x in (-0.49, 0.49)])
    uv = np.stack([near[:, 0] / 4, 1 - near[:, 1] / 3], axis=1)
    column = {"repeat": [0, 1, 2, 3, 0, 1, 2, 3, 0, 1, 2, 3], "clamp": [0, 0, 0, 0, 0, 1, 2, 3, 3, 3, 3, 3]}
    row = {"mirror": [2, 1, 0, 0, 1, 2, 2, 1, 0], "repeat": [0, 1, 2, 0, 1, 2, 0, 1, 2]}
    for wrap in (("repeat", "mirror"), ("clamp", "repeat")):
        expected = TEXTURE[row[wrap[1]]][:, column[wrap[0]]].repeat(2, axis=1).reshape(-1, 3)
        found = to_numpy(sample_texture(*arrays(target, (TEXTURE, uv)), wrap, filter="nearest"))
        np.testing.assert_allclose(found, expected, atol=1e-6)
        centres = (uv[::2] + uv[1::2]) / 2
        found = to_numpy(sample_texture(*arrays(target, (TEXTURE, centres)), wrap))
        np.testing.assert_allclose(found, expected[::2], atol=1e-5)


def test_torch_compiles_lookups_of_textures_of_several_sizes():
    torch = pytest.importorskip("torch")
    compiled = torch.compile(sample_texture, backend="eager", fullgraph=True)
    for height in (3, 5):
        texture, uv = (torch.rand(*shape) for shape in ((height, 4, 3), (6, 2)))
        torch.testing.assert_close(compiled(texture, uv), sample_texture(texture, uv))


def test_texture_coordinates_of_another_shape_are_refused():
    for shape in ((5,), (5, 3)):
        with pytest.raises(InputError, match=r"^uv has shape .*; expected \(N, 2\)"):
            sample_texture(TEXTURE, np.zeros(shape))


def test_repeat_blends_the_two_ends_and_clamp_does_not():
    uv = np.array([(0.0, texel(1, 0)[1])])
    ends = (TEXTURE[1, 0] + TEXTURE[1, 3]) / 2
    np.testing.assert_allclose(sample_texture(TEXTURE, uv, "repeat")[0], ends)
    np.testing.assert_allclose(sample_texture(TEXTURE, uv, "clamp")[0], TEXTURE[1, 0])
    np.testing.assert_allclose(sample_texture(TEXTURE, uv, "mirror")[0], TEXTURE[1, 0])


@pytest.mark.parametrize("target", DIFFERENTIABLE)
def test_texture_gradients_are_the_bilinear_weights_and_slopes(target):
    uv = np.array([np.add(texel(1, 2), texel(1, 3))]) / 2
    given = arrays(target, {"texture": TEXTURE, "uv": uv})
    found = gradient(target, lambda t: sample_texture(t["texture"], t["uv"])[..., 0].sum(), given)
    expected = np.zeros_like(TEXTURE)
    expected[1, 2:, 0] = 0.5
    np.testing.assert_allclose(found["texture"], expected, atol=1e-5)
    np.testing.assert_allclose(found["uv"][0, 0], 4 * (TEXTURE[1, 3, 0] - TEXTURE[1, 2, 0]), rtol=1e-4)


@pytest.mark.parametrize("channels, expected", [(1, (0.2, 0.2, 0.2, 1)), (3, (0.2, 0.4, 0.6, 1))])
def test_textures_of_one_and_three_channels(channels, expected):
    texture = np.ones((2, 2, channels)) * np.array([0.2, 0.4, 0.6])[:channels]
    theta = {"texture": texture, "uv": np.zeros((4, 2))}
    image = show(mesh_part(quad(-9, 9, -9, 9), theta=theta, shader="textured"), FRONT)
    np.testing.assert_allclose(image[9, 9], expected, atol=1e-6)


def test_a_textured_quad_is_its_texture_upright():
    texture = np.random.default_rng(0).random((20, 24, 3))
    uv = np.array([(0, 0), (1, 0), (1, 1), (0, 1)], np.float32)
    part = mesh_part(quad(-2.4, 2.4, -2, 2), theta={"texture": texture, "uv": uv}, shader="textured")
    each = show(part, FRONT, (60, 72), splatter="none")[1::3, 1::3, :3]
    np.testing.assert_allclose(each, texture, atol=1e-4)
    # A pixel as large as a texel is the mean over it, which has an eighth of each neighbour's, by two lookups a side.
    expected = texture
    for axis in (0, 1):
        expected = 0.75 * expected + 0.125 * (np.roll(expected, 1, axis) + np.roll(expected, -1, axis))
    np.testing.assert_allclose(show(part, FRONT, (20, 24), splatter="none")[..., :3], expected, atol=1e-4)


# ---------------------------------------------------------------------------------------------------- shaders


def shade(shader, normal=(0, 0, 1), position=(0, 0, 0), camera=FRONT, **theta):
    gbuffer = GBuffer(position=np.array([position], np.float64), normal=np.array([normal], np.float64))
    arrays_ = {k: v if isinstance(v, dict) else np.asarray(v, np.float64) for k, v in theta.items()}
    return shader(arrays_, gbuffer, camera)[0]


def light(degrees=0.0, ambient=0.1, color=(0.5, 0.6, 0.7)):
    """From the direction of +z turned towards +y."""
    a = math.radians(degrees)
    direction = 3.0 * np.array([0, math.sin(a), math.cos(a)])
    return {"direction": direction, "color": np.array(color), "ambient": np.full(3, ambient)}


@pytest.mark.parametrize("degrees", [0, 30, 60])
def test_lambert_is_ambient_plus_diffuse_times_the_cosine(degrees):
    found = shade(Lambert(), light=light(degrees), color=(0.8, 0.4, 0.2))
    expected = np.array([0.8, 0.4, 0.2]) * (0.1 + math.cos(math.radians(degrees)) * np.array([0.5, 0.6, 0.7]))
    np.testing.assert_allclose(found, [*expected, 1], atol=1e-12)


def test_lambert_is_two_sided_and_dark_where_light_comes_from_behind():
    np.testing.assert_allclose(shade(Lambert(), (0, 0, -2), light=light()), shade(Lambert(), light=light()))
    np.testing.assert_allclose(shade(Lambert(), light=light(180))[:3], 0.1)


@pytest.mark.parametrize("target", ALL)
@pytest.mark.parametrize("shader", ["lambert", "blinn_phong", "pbr"])
def test_interpolated_normals_that_turn_away_before_their_triangle_stay_on_its_side(target, shader):
    # The triangle is seen at 80°, its normals lean 20° further: beyond the horizon.
    a, b = math.radians(80), math.radians(100)
    along, normal = np.array([math.cos(a), 0, -math.sin(a)]), np.array([math.sin(b), 0, math.cos(b)])
    corners = 4 * np.array([-2 * along - (0, 2, 0), 2 * along - (0, 2, 0), (0, 2, 0)])
    theta = {"vertices": corners, "normals": np.tile(normal, (3, 1)), "color": np.array([0.8, 0.4, 0.2])}
    theta |= {"light": {"direction": np.array([1.0, 0, 0]), "color": np.ones(3), "ambient": np.array(0.125)}}
    if shader == "blinn_phong":
        theta["specular"] = np.zeros(3)
    camera, mirror = Camera.orthographic((0, 0, 20), (0, 0, 0), height=1, near=1, far=40), np.diag([1.0, -1, 1, 1])

    def seen(faces, transform=None, by=camera):
        part = Part(Mesh(np.array([faces])), arrays(target, theta), shader, transform=transform)
        return to_numpy(render(part, by, (3, 3)))[1, 1]

    expected = seen((0, 1, 2))
    assert expected[3] == 1
    if shader != "pbr":
        np.testing.assert_allclose(expected[:3], theta["color"] * (0.125 + math.sin(b)), rtol=1e-5)
    for faces in (0, 1, 2), (2, 1, 0):
        for transform in None, arrays(target, np.eye(4)), arrays(target, mirror):
            np.testing.assert_allclose(seen(faces, transform), expected, rtol=1e-5)
    # From behind, its other side is seen, in the dark.
    behind = Camera.orthographic((0, 0, -20), (0, 0, 0), height=1, near=1, far=40)
    dark = seen((0, 1, 2), by=behind)[:3]
    assert (dark < 0.2 * expected[:3]).all()
    if shader != "pbr":
        np.testing.assert_allclose(dark, 0.125 * theta["color"], rtol=1e-5)


def test_lambert_adds_several_lights_and_is_as_bright_as_they_are():
    both = {
        "direction": np.array([(0, 0, 1), (0, 3.0, 0), (0, 0.6, 0.8)]),
        "color": np.array([(0.1, 0, 0), (9, 9, 9), (0, 2, 0.5)]),
        "ambient": np.zeros(3),
    }
    np.testing.assert_allclose(shade(Lambert(), light=both), (0.1, 1.6, 0.4, 1), atol=1e-12)


@pytest.mark.parametrize("target", ALL)
def test_a_light_of_direction_zero_is_refused(target):
    for direction in np.zeros(3), np.array([(0, 0, 1.0), (0, 0, 0)]):
        for shader in Lambert(), BlinnPhong():
            with pytest.raises(InputError, match=r"theta\['light'\]\['direction'\] is zero; expected vectors"):
                shade(shader, light=arrays(target, {"direction": direction}))


def test_the_default_light_is_fixed_to_the_camera():
    cosine = 0.81 / math.sqrt(0.3**2 + 0.5**2 + 0.81**2)
    np.testing.assert_allclose(shade(Lambert())[:3], 0.2 + 0.8 * cosine)
    turn = rigid((1, 2, 3), 70, (0.1, 0.2, 0.3))
    turned = FRONT.within(np.linalg.inv(turn))
    position, normal = moved(turn, np.array([(0.0, 0, 0)]))[0], turn[:3, :3] @ (0, 0.6, 0.8)
    np.testing.assert_allclose(shade(Lambert(), normal, position, turned), shade(Lambert(), (0, 0.6, 0.8)))


def test_blinn_phong_is_brightest_where_the_normal_halves_light_and_view():
    lit = {
        "light": light(60, 0.0, (1.0, 1.0, 1.0)),
        "color": (0.0, 0.0, 0.0),
        "specular": (0.9, 0.5, 0.1),
        "shininess": 20.0,
    }

    def highlight(degrees):
        a = math.radians(degrees)
        return shade(BlinnPhong(), (0, math.sin(a), math.cos(a)), **lit)[:3]

    np.testing.assert_allclose(highlight(30), (0.9, 0.5, 0.1), atol=1e-9)
    for off in (10, 25):
        expected = np.array([0.9, 0.5, 0.1]) * math.cos(math.radians(off)) ** 20
        np.testing.assert_allclose(highlight(30 + off), expected, atol=1e-9)
        np.testing.assert_allclose(highlight(30 - off), expected, atol=1e-9)


def test_blinn_phong_has_no_highlight_where_the_light_comes_from_behind():
    # 100° off the normal, halfway between light and view is still 50° off it.
    lit = {"light": light(100, 0.0, (1.0, 1.0, 1.0)), "color": (0.0, 0.0, 0.0), "specular": (1.0, 1.0, 1.0)}
    np.testing.assert_array_equal(shade(BlinnPhong(), shininess=0.5, **lit)[:3], 0)


def test_blinn_phong_without_specular_is_lambert():
    for degrees in (0, 40, 130):
        found = shade(BlinnPhong(), light=light(degrees), specular=(0, 0, 0))
        np.testing.assert_allclose(found, shade(Lambert(), light=light(degrees)))


@pytest.mark.parametrize("shininess", [0.0, 0.5, 1.0, 32.0])
@pytest.mark.parametrize("degrees", [0, 89.999, 90, 120, 180])
@pytest.mark.parametrize("target", TORCH)
def test_blinn_phong_gradients_are_finite_at_grazing_light(target, degrees, shininess):
    camera = arrays(target, FRONT)
    given = arrays(
        target, {"light": light(degrees), "specular": np.full(3, 0.5), "shininess": np.array(shininess), "n": np.eye(3)}
    )

    def f(tree):
        gbuffer = GBuffer(position=0 * tree["n"], normal=tree["n"])
        return BlinnPhong()({k: v for k, v in tree.items() if k != "n"}, gbuffer, camera).sum()

    found = gradient(target, f, given)
    for leaf in (*found["light"].values(), found["specular"], found["shininess"], found["n"]):
        assert np.isfinite(leaf).all()


@pytest.mark.parametrize("camera", [FRONT, Camera.look_at((0, 0, 5), (0, 0, 0), near=1, far=9)])
def test_depth_is_linear_from_the_near_plane_to_the_far_plane(camera):
    for z, expected in ((4, 0), (2, 0.25), (0, 0.5), (-4, 1), (-9, 1)):
        found = shade(Depth(), position=(0.3, -0.2, z), camera=camera)
        np.testing.assert_allclose(found, (expected, expected, expected, 1), atol=1e-9)


def test_depth_range_sets_black_and_white():
    np.testing.assert_allclose(shade(Depth(), position=(0, 0, 0), depth_range=(4, 8))[:3], 0.25)
    np.testing.assert_allclose(shade(Depth(), position=(0, 0, 2), depth_range=(4, 8))[:3], 0)


def test_normals_map_to_colours_about_one_half():
    np.testing.assert_allclose(shade(Normals(), (0, 3, 0)), (0.5, 1, 0.5, 1))
    np.testing.assert_allclose(shade(Normals(), (-0.6, 0, 0.8)), (0.2, 0.5, 0.9, 1))


def test_silhouette_is_white():
    np.testing.assert_array_equal(shade(Silhouette()), (1, 1, 1, 1))


def test_unlit_multiplies_base_colour_and_factor_and_premultiplies_where_not_opaque():
    position = np.zeros((1, 3))
    gbuffer = GBuffer(position=position, color=np.array([[0.5, 0.6, 0.8, 0.5]]))
    theta = {"color": np.array([0.5, 1.0, 0.25, 0.4])}
    np.testing.assert_allclose(Unlit()(theta, gbuffer, FRONT)[0], (0.25, 0.6, 0.2, 1))
    np.testing.assert_allclose(Unlit(opaque=False)(theta, gbuffer, FRONT)[0], (0.05, 0.12, 0.04, 0.2))
    np.testing.assert_allclose(Unlit()({}, GBuffer(position=position), FRONT)[0], 1)


def test_base_colour_is_the_product_of_texture_and_vertex_colours():
    gbuffer = GBuffer(position=np.zeros((1, 3)), color=np.full((1, 3), 0.3), uv=np.full((1, 2), 0.5))
    theta = {"texture": np.full((1, 1, 3), 0.7)}
    np.testing.assert_allclose(Unlit()(theta, gbuffer, FRONT)[0, :3], 0.21)
    np.testing.assert_allclose(Unlit()({}, gbuffer, FRONT)[0, :3], 0.3)
