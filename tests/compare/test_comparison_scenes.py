"""Scenes that settings are compared on: what each mode does, by closed forms, and the built-in ones."""

import numpy as np
import pytest
from helpers import derivative, quick, refused

import rts
from rts.arrays.engines import engine_named
from rts.errors import InputError, PluginError
from rts_compare import scene_shapes
from rts_compare.builtin_scenes import BUILTIN, builtin, names
from rts_compare.moving_scenes import MODES, check_directions, moving
from rts_diagnostics.example_shapes import QUAD, unlit

pytestmark = pytest.mark.rendering

FORMULAS = [name for name in names() if not BUILTIN[name].data]
SMALL = (48, 48)
CARD = unlit(np.array([[-0.4, -0.3, 0.2], [0.5, -0.3, 0.2], [0.5, 0.6, 0.2], [-0.4, 0.6, 0.2]]), QUAD, 0.7)
ASLANT = rts.Camera.look_at((1.0, 1.4, 2.6), (0.1, 0.0, 0.2), fov_y=35)


def made(name, request, monkeypatch):
    """A built-in scene, or a skipped test."""
    if BUILTIN[name].data:
        monkeypatch.setenv("RTS_DATA", str(request.getfixturevalue("data")))
    try:
        return builtin(name)
    except PluginError as error:
        pytest.skip(str(error))


def jvp(scene, mode, size=SMALL, exact=False, **options):
    """The image and its derivative along a mode, in torch."""
    torch = pytest.importorskip("torch")
    engine, at = engine_named("torch"), scene.exact if exact else scene.at
    zero, one = torch.zeros(()), torch.ones(())
    return derivative("torch-cpu", lambda t: rts.render(*at(scene.moved(mode, t, engine)), size, **options), zero, one)


def seen(scene, mode, by, points=None, index=0, size=SMALL):
    """Pixels and depths (N, 3) of points of a part, its vertices unless others are given, after a mode has moved it."""
    parts, camera = scene.at(scene.moved(mode, by))
    part = parts[index]
    points = part.theta["vertices"] if points is None else points
    if part.transform is not None:
        points = points @ part.transform[:3, :3].T + part.transform[:3, 3]
    return camera.for_size(size).project(points, size)


# ---------------------------------------------------------------------------------------------------- built-in


@pytest.mark.parametrize("name", quick([*FORMULAS, *(name for name in names() if BUILTIN[name].data)], 3))
def test_every_mode_of_every_scene_changes_the_image(name, request, monkeypatch):
    scene = made(name, request, monkeypatch)
    assert (scene.name, scene.size, scene.note) == (name, (256, 256), BUILTIN[name].note)
    assert list(scene.directions) == list(MODES)
    check_directions(scene)
    for mode in MODES:
        image, slope = jvp(scene, mode)
        assert np.isfinite(slope).all() and np.abs(slope).max() > 1e-3, mode
        assert 0.005 < image[..., 3].mean() < 0.6


@pytest.mark.parametrize("name", FORMULAS)
def test_formulas_need_no_data(name, monkeypatch):
    monkeypatch.setenv("RTS_DATA", "/nowhere")
    scene = builtin(name)
    assert scene.separate and rts.render(*scene.at(scene.parameters), SMALL).max() > 0.2


@pytest.mark.parametrize("name", ["bezier teapot", "subdivided rook", "vase that turns"])
def test_exact_patches_have_the_same_image_but_for_their_outlines(name, request, monkeypatch):
    scene = made(name, request, monkeypatch)
    assert scene.at(scene.parameters)[0][0].surface.tolerance > scene.exact(scene.parameters)[0][0].surface.tolerance
    assert outlines_off(scene)[0] < 0.1


def outlines_off(scene):
    """By how many pixels, on average along them, hard outlines of a scene differ from exact ones; the mean of colours.

    A line of any direction has 4/π too many sides of pixels.
    """
    hard = [rts.render(*at(scene.parameters), scene.size, splatter="none", layers=1) for at in (scene.at, scene.exact)]
    a, b = (image[..., 3] > 0.5 for image in hard)
    steps = (b[1:] != b[:-1]).sum() + (b[:, 1:] != b[:, :-1]).sum()
    return (a != b).sum() / (np.pi / 4 * steps), np.abs(hard[0] - hard[1]).mean()


def test_the_torus_on_a_lattice_is_nearly_the_exact_one():
    scene = builtin("torus by lattice")
    outline, color = outlines_off(scene)
    assert 0.005 < outline < 0.15 and color < 2e-3
    for mode in ("shape", "camera"):
        growth = [jvp(scene, mode, (96, 96), exact)[1][..., 3].sum() for exact in (False, True)]
        assert abs(growth[0] / growth[1] - 1) < 0.02


def test_names_may_be_written_in_many_ways():
    assert builtin("Torus-by_ray").name == builtin("  TORUS BY RAY").name == "torus by ray"
    assert len(names()) == 15


def test_an_unknown_name_is_refused_with_the_nearest_one():
    with refused("no scene named 'thin wire'; there are .*stack of cards.*mean 'thin wires'"):
        builtin("thin wire")
    with pytest.raises(InputError, match="bezier teapot"):
        builtin("Bézier teapott")


@pytest.mark.parametrize("name", [name for name in names() if BUILTIN[name].data])
def test_missing_data_is_named_with_what_needs_none(name, tmp_path, monkeypatch):
    monkeypatch.setenv("RTS_DATA", str(tmp_path))
    with pytest.raises(InputError) as e:
        builtin(name)
    message = str(e.value)
    assert "\n" not in message and "RTS_DATA" in message and str(tmp_path / BUILTIN[name].data[0]) in message
    assert message.endswith(", ".join(FORMULAS))


def test_the_data_is_beside_the_working_directory_by_default(tmp_path, monkeypatch):
    monkeypatch.delenv("RTS_DATA", raising=False)
    folder = tmp_path / "here"
    folder.mkdir()
    monkeypatch.chdir(folder)
    with pytest.raises(InputError, match=r"needs \.\./shared/data/meshes/nefertiti\.obj, which is missing"):
        builtin("nefertiti")


# ------------------------------------------------------------------------------------------------------- modes


@pytest.mark.parametrize("camera", [scene_shapes.camera(), ASLANT])
def test_translations_move_to_the_right_of_the_image(camera):
    scene = moving("card", CARD, camera)
    before, after = seen(scene, "translation", 0.0), seen(scene, "translation", 0.1)
    speed = 48 / 2 * camera.projection[0, 0] / before[:, 2]
    np.testing.assert_allclose(after - before, np.stack([0.1 * speed, 0 * speed, 0 * speed], axis=1), atol=1e-9)


def test_the_image_of_a_card_moves_as_the_card_does():
    scene = moving("card", CARD, scene_shapes.camera())
    side = 128
    image, slope = jvp(scene, "translation", (side, side), splatter="edges", supersample=2)
    x = np.arange(side) + 0.5
    area, moment = image[..., 3].sum(), (slope[..., 3] * x).sum()
    assert abs(moment / area * scene_shapes.pixel(3.0, side) - 1) < 0.02
    assert abs(slope[..., 3].sum()) < 0.01 * np.abs(slope[..., 3]).sum()


@pytest.mark.parametrize("camera", [scene_shapes.camera(), ASLANT])
def test_rotations_leave_the_upright_axis_through_the_middle(camera):
    middle, up = np.array([0.05, 0.15, 0.2]), np.linalg.inv(camera.view)[:3, 1]
    scene = moving("card", CARD, camera)
    axis = middle + np.linspace(-1, 1, 5)[:, None] * up
    np.testing.assert_allclose(seen(scene, "rotation", 0.2, axis), seen(scene, "rotation", 0.0, axis), atol=1e-6)
    ahead = middle + np.linalg.inv(camera.view)[:3, 2]  # What is nearer goes to the right.
    moved = seen(scene, "rotation", 0.2, ahead[None]) - seen(scene, "rotation", 0.0, ahead[None])
    assert moved[0, 0] > 1 and abs(moved[0, 1:]).max() < 1e-6


def test_a_camera_that_moves_ahead_magnifies():
    camera = scene_shapes.camera()
    scene = moving("card", CARD, camera)
    before, after = seen(scene, "camera", 0.0), seen(scene, "camera", 0.5)
    np.testing.assert_allclose(after[:, :2] - 24, (before[:, :2] - 24) * 3.0 / 2.5, rtol=1e-12)
    np.testing.assert_allclose(after[:, 2], 2.5)
    orthographic = rts.Camera.orthographic((0, 0, 3), (0, 0, 0), height=2, near=0.5, far=10)
    assert list(moving("card", CARD, orthographic).directions) == ["translation", "rotation", "shape", "color"]


def test_only_what_moves_is_moved():
    other = CARD.replace(theta={**CARD.theta, "vertices": CARD.theta["vertices"] - [0, 0, 1]})
    scene = moving("cards", [CARD, other], scene_shapes.camera(), moves=[1])
    for mode in ("translation", "rotation", "shape"):
        moved = [np.abs(seen(scene, mode, 0.1, index=i) - seen(scene, mode, 0.0, index=i)).max() for i in (0, 1)]
        assert moved[0] == 0 and moved[1] > 0.1
    colors = [p.theta["colors"] for p in scene.at(scene.moved("color", 1.0))[0]]
    np.testing.assert_allclose(colors, np.broadcast_to(0.7 * np.array([2, 0.5, 1.25]), (2, 4, 3)))


def test_a_shape_swells_about_its_middle_unevenly():
    vertices = np.array([[-1.0, 0, 0], [1, 0, 0], [0, 0.5, 0], [0, -0.5, 0], [0, 0, 0]]) + [3, 2, 1]
    part = unlit(vertices, [(0, 3, 2), (3, 1, 2), (0, 1, 4)], 0.5)
    scene = moving("kite", part, scene_shapes.camera())
    away = (scene.at(scene.moved("shape", 1.0))[0][0].theta["vertices"] - vertices) / (vertices - [3, 2, 1] + 1e-300)
    np.testing.assert_allclose(away[0, 0], 1 - 0.5 * np.sin(2))
    np.testing.assert_allclose(away[1, 0], 1 + 0.5 * np.sin(2))
    np.testing.assert_allclose(away[2, 1], 1 + 0.5 * np.sin(1.5))
    assert np.abs(away[4]).max() == 0


def test_the_middle_of_a_field_is_that_of_its_ball():
    center = np.array([0.3, -0.2, 0.1])
    surface = rts.plugin("surfaces", "sdf")(lambda theta, p: rts.namespace(p).sum(p * p, axis=1), center=center)
    part = rts.Part(surface, {"radius": np.float64(0.5)}, "normals", scene_shapes.turned(0.3, 0.4))
    scene = moving("ball", part, ASLANT)
    np.testing.assert_allclose(
        seen(scene, "rotation", 0.3, center[None]), seen(scene, "rotation", 0.0, center[None]), atol=1e-9
    )


def test_patches_turn_about_the_middle_of_their_surface():
    surface = rts.plugin("surfaces", "revolution")(np.array([1.0, 1.5, 2.0, 2.5, 3.0]), 8)
    theta = {"radii": np.full(5, 0.4), "colors": np.full((5, 8, 3), 7.0)}
    scene = moving("tube", rts.Part(surface, theta, "unlit"), ASLANT)
    middle = np.array([[0.0, 2.0, 0.0]])
    np.testing.assert_allclose(seen(scene, "rotation", 0.3, middle), seen(scene, "rotation", 0.0, middle), atol=1e-5)
    changed = scene.at(scene.moved("shape", 0.1))[0][0].theta
    np.testing.assert_allclose(changed["radii"], 0.5)
    np.testing.assert_array_equal(changed["colors"], theta["colors"])


# ------------------------------------------------------------------------------------------------------ colours


@pytest.mark.parametrize("name", ["stack of cards", "thin wires", "crossing spheres", "turned box"])
def test_unlit_colors_change_by_a_share_of_the_image(name):
    image, slope = jvp(builtin(name), "color", (64, 64))
    np.testing.assert_allclose(slope[..., :3], image[..., :3] * [1, -0.5, 0.25], atol=1e-5)
    assert np.abs(slope[..., 3]).max() == 0 and image[..., :3].max() > 0.3


UV = np.array([[0.0, 0], [1, 0], [1, 1], [0, 1]])
CHECKS = np.random.default_rng(3).uniform(0.2, 0.9, (4, 4, 3))
QUAD_OF = {"vertices": CARD.theta["vertices"]}


@pytest.mark.parametrize(
    "theta, shader, entry",
    [
        ({"uv": UV, "texture": CHECKS, "color": np.array([0.5, 1, 1])}, "textured", "texture"),
        ({"uv": UV, "texture": CHECKS[..., :1]}, "unlit", "texture"),
        ({"texture": CHECKS, "color": np.array([0.5, 0.9, 1, 1])}, "unlit", "color"),
        ({"colors": np.full((4, 4), 0.6), "color": np.ones(3)}, "lambert", "colors"),
        ({}, "lambert", "color"),
        ({"uv": UV}, "blinn_phong", "color"),
    ],
)
def test_one_base_color_changes(theta, shader, entry):
    mesh = rts.plugin("surfaces", "mesh")(scene_shapes.QUAD)
    scene = moving("card", rts.Part(mesh, QUAD_OF | theta, shader), scene_shapes.camera())
    before, after = (scene.at(scene.moved("color", t))[0][0].theta for t in (0.0, 1e-3))
    changed = {name for name in after if name not in before or not np.array_equal(before[name], after[name])}
    assert changed == {entry}
    if after[entry].shape[-1] == 4:
        np.testing.assert_array_equal(after[entry][..., 3], before[entry][..., 3])
    if shader != "blinn_phong":  # Whose highlights have another colour.
        image, slope = jvp(scene, "color")
        expected = image[..., :3] * ([1, 1, 1] if after[entry].shape[-1] == 1 else [1, -0.5, 0.25])
        np.testing.assert_allclose(slope[..., :3], expected, atol=1e-5)


@pytest.mark.parametrize("shader", ["silhouette", "normals", "depth"])
def test_shaders_without_colors_have_no_such_mode(shader):
    scene = moving("card", CARD.replace(shader=shader), scene_shapes.camera())
    assert list(scene.directions) == ["translation", "rotation", "shape", "camera"]


def test_what_only_looks_like_points_or_colors_stays():
    mesh = rts.plugin("surfaces", "mesh")(QUAD, indices={"rest": None})
    light = {"direction": np.array([0.0, 0, 1]), "color": np.ones(3)}
    more = {"normals": np.ones((4, 3)), "rest": CARD.theta["vertices"], "uv": UV, "light": light, "axis": np.ones(3)}
    field = rts.plugin("surfaces", "sdf")(lambda theta, p: p[:, 0] - theta["level"])
    ball = {"level": np.float64(0.1), "color": np.array([0.5, 0.6, 0.7]), "specular": np.ones(3), "light": light}
    for part, changed in (
        (rts.Part(mesh, {**CARD.theta, **more}, "lambert"), {"shape": {"vertices"}, "color": {"colors"}}),
        (rts.Part(field, ball, "blinn_phong"), {"shape": {"level"}, "color": {"color"}}),
    ):
        scene = moving("part", part, scene_shapes.camera())
        for mode in MODES:
            theta = scene.at(scene.moved(mode, 0.1))[0][0].theta
            found = {name for name in theta if theta[name] is not part.theta[name]}
            assert found == changed.get(mode, set()), mode


# -------------------------------------------------------------------------------------------------- exact parts


def test_modes_that_exact_parts_lack_are_left_out():
    surface = rts.plugin("surfaces", "sdf")(lambda theta, p: p[:, 0], reads=())
    exact = rts.Part(surface, {"color": np.full(3, 0.7)}, "unlit")
    scene = moving("card", CARD, scene_shapes.camera(), exact=exact)
    assert list(scene.directions) == ["translation", "rotation", "camera"]
    parts, _ = scene.exact(scene.moved("translation", 0.5))
    np.testing.assert_allclose(parts[0].transform[:3, 3], [0.5, 0, 0])


@pytest.mark.parametrize(
    "options, message",
    [
        ({"exact": [CARD, CARD]}, "exact has 2 parts; expected as many as `parts`, 1"),
        ({"moves": [1]}, "moves is .1,.; expected indices of the 1 parts"),
        ({"moves": []}, "moves is"),
        ({"modes": ["colour"]}, "modes is .'colour'.; expected some of translation"),
    ],
)
def test_scenes_that_cannot_be_are_refused(options, message):
    with pytest.raises(InputError, match=message):
        moving("card", CARD, scene_shapes.camera(), **options)
