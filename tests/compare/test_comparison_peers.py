"""DEODR and Mitsuba on scenes: closed forms, their two modes beside one another, our derivatives, what is left out."""

import sys
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh
from helpers import icosphere
from scipy.ndimage import gaussian_filter

import rts
from rts_compare.derivative_scores import loss_weights
from rts_compare.moving_scenes import moving
from rts_compare.other_renderers.installed_renderers import peers
from rts_compare.other_renderers.mitsuba_renderer import emitter, flat, mitsuba, positions_of, set_flat
from rts_diagnostics.smoothing import low_pass

pytestmark = pytest.mark.rendering

MESH = rts.plugin("rts.surfaces", "mesh")
SIZE = (48, 64)
DEPTH = 3.0
CAMERA = rts.Camera.look_at((0, 0, DEPTH), (0, 0, 0), fov_y=40)
PIXELS = 48 / (2 * DEPTH * np.tan(np.radians(20)))
"""To a world unit, at z = 0."""
COLOR = np.array([0.9, 0.5, 0.2])
CHANGE = COLOR * [1, -0.5, 0.25]
"""What the mode `color` adds."""
SAMPLES = 32


def unlit(vertices, faces, color=COLOR, **fields):
    colors = np.broadcast_to(color, (len(vertices), 3))
    return rts.Part(MESH(faces), {"vertices": np.array(vertices, float), "colors": np.array(colors)}, "unlit", **fields)


def card(left, bottom, right, top, z=0.0, **fields):
    corners = [(left, bottom, z), (right, bottom, z), (right, top, z), (left, top, z)]
    return unlit(corners, [(0, 1, 2), (0, 2, 3)], **fields)


def sphere(radius=0.6, **fields):
    vertices, faces = icosphere(2)
    shade = 0.3 + 0.6 * np.maximum(0, vertices @ [0.4, 0.5, 0.77])[:, None]
    return unlit(radius * vertices, faces, shade * [0.3, 0.9, 0.5], **fields)


@pytest.fixture(params=["DEODR", "Mitsuba"])
def peer_of(request):
    """Scene → the renderer with it."""
    if request.param == "DEODR":
        pytest.importorskip("deodr")
    else:
        try:
            mitsuba()
        except ImportError as error:
            pytest.skip(str(error))

    def peer(scene):
        found, left_out = peers(scene, (SAMPLES,))
        assert not [reason for reason in left_out if reason.startswith(request.param)], left_out
        return next(p for p in found if p.name == request.param)

    return peer


def test_an_edge_that_moves(peer_of):
    peer = peer_of(moving("half-plane", card(-4, -4, 0.013, 4), CAMERA, SIZE))
    found = peer.derivative("translation")
    assert found.shape == (*SIZE, 3)
    np.testing.assert_allclose(found.sum(axis=(0, 1)), COLOR * SIZE[0] * PIXELS, rtol=0.02)
    assert np.abs(found[:, :28]).max() < 1e-6 and np.abs(found[:, 36:]).max() < 1e-6


def test_cards_that_touch(peer_of):
    left, right = card(-4, -4, 0.013, 4), card(0.013, -4, 4, 4)
    vertices = np.concatenate([p.theta["vertices"] for p in (left, right)])
    faces = np.concatenate([left.surface.faces, right.surface.faces + 4])
    colors = np.repeat([COLOR, COLOR[::-1] / 2], 4, axis=0)
    found = peer_of(moving("cards", unlit(vertices, faces, colors), CAMERA, SIZE)).derivative("translation")
    change = (COLOR - COLOR[::-1] / 2) * SIZE[0] * PIXELS
    np.testing.assert_allclose(found[:, 10:54].sum(axis=(0, 1)), change, rtol=0.01, atol=0.03 * np.abs(change).max())


CAMERAS = {
    "centred": CAMERA,
    "sheared": rts.Camera.from_opencv([[60, 6, 25], [0, 50, 30], [0, 0, 1]], np.diag([1, -1, -1]), (0, 0, DEPTH), SIZE),
}


@pytest.mark.parametrize("camera", CAMERAS)
def test_colors_change_where_the_part_is_seen(peer_of, camera):
    camera, part = CAMERAS[camera], card(-0.5, -0.4, 0.6, 0.3, transform=rts.rigid(np.array([0.2, 0.3, 0.4, 0, 0, 0])))
    peer = peer_of(moving("card", part, camera, SIZE))
    found = peer.derivative("color")
    hard = rts.render(part, camera, SIZE, splatter="none", supersample=8)[..., 3]
    assert (hard == 1).sum() > 150
    np.testing.assert_allclose(found[hard == 1], np.broadcast_to(CHANGE, found[hard == 1].shape), atol=1e-5)
    assert np.abs(found[gaussian_filter(hard, 1, radius=1) == 0]).max() == 0
    rim = 0.0 if peer.name == "Mitsuba" else np.count_nonzero((hard > 0) & (hard < 1)) / 2  # DEODR draws edges outside.
    np.testing.assert_allclose(found.sum(axis=(0, 1)), CHANGE * (hard.sum() + rim), rtol=0.01 + 0.3 * rim / hard.sum())


def test_a_disk_grows_as_the_camera_moves_ahead(peer_of):
    angle, radius = np.linspace(0, 2 * np.pi, 128, endpoint=False), 0.5
    rim = radius * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1) + [0.1, 0.05, 0]
    faces = [(0, i, i + 1) for i in range(1, 127)]
    found = peer_of(moving("disk", unlit(rim, faces), CAMERA, SIZE)).derivative("camera")
    area = 64 * np.sin(2 * np.pi / 128) * (radius * PIXELS) ** 2
    np.testing.assert_allclose(found.sum(axis=(0, 1)), COLOR * 2 * area / DEPTH, rtol=0.03)


def two_parts():
    return moving(
        "sphere over card", [sphere(cull="back"), card(-0.9, -0.3, 0.2, 0.8, z=-0.7)], CAMERA, SIZE, moves=[0]
    )


@pytest.mark.parametrize("mode", ["rotation", "color"])
def test_gradients_are_those_of_derivative_images(peer_of, mode):
    peer, weights = peer_of(two_parts()), loss_weights(*SIZE)
    exact = peer.name == "DEODR"
    for own in (None, weights[1]):
        slope = peer.gradient(mode, own)
        used = weights[0] if own is None else own
        expected = (used * peer.derivative(mode, seed=1)).sum()
        scale = np.linalg.norm(used * peer.derivative(mode)) if mode == "rotation" else abs(expected)
        assert slope() == pytest.approx(expected, rel=1e-4 if exact else 0.02, abs=0 if exact else 0.2 * scale)
        assert slope() == pytest.approx(slope())


def test_modes_do_not_disturb_one_another(peer_of):
    peer = peer_of(two_parts())
    before = {mode: peer.derivative(mode, seed=3) for mode in ("color", "translation")}
    slope = peer.gradient("translation")
    slope()
    for mode, expected in before.items():
        np.testing.assert_allclose(peer.derivative(mode, seed=3), expected, atol=1e-3 * np.abs(expected).max())


@pytest.mark.parametrize("mode", ["shape", "camera"])
def test_they_agree_with_ours(peer_of, mode):
    torch = pytest.importorskip("torch")
    scene = two_parts()
    engine = rts.engine_of(torch.zeros(()))

    def image(t):
        parts, camera = scene.at(scene.moved(mode, t, engine))
        return rts.render(parts, camera, SIZE, splatter="edges", supersample=4)[..., :3]

    ours = low_pass(torch.func.jvp(image, (torch.zeros(()),), (torch.ones(()),))[1].numpy())
    theirs = low_pass(peer_of(scene).derivative(mode))
    assert (ours * theirs).sum() / (ours**2).sum() == pytest.approx(1, abs=0.1)


def test_patches_become_triangles_with_their_colors(peer_of):
    part = rts.plugin("rts.surfaces", "bezier").example().replace(shader="unlit")
    scene = moving("patches", part, CAMERA, SIZE)
    found = peer_of(scene).derivative("color")
    hard = rts.render(part, CAMERA, SIZE, splatter="none", supersample=4)
    inside = hard[..., 3] == 1
    assert inside.sum() > 300
    off = np.abs(found[inside] - hard[inside, :3] * [1, -0.5, 0.25])
    assert np.median(off) < 1e-3 and np.quantile(off, 0.9) < 0.01


@pytest.mark.parametrize("part", [sphere(0.6), card(-0.5, -0.4, 0.6, 0.3)], ids=["sphere", "card"])
def test_parts_that_are_seen_from_both_sides_are_turned_to_the_camera(peer_of, part):
    other = part.replace(surface=MESH(part.surface.faces[:, ::-1]))
    images = [peer_of(moving("part", p, CAMERA, SIZE)).derivative("color") for p in (part, other)]
    assert np.abs(images[0]).max() > 0.1
    assert np.abs(low_pass(images[0] - images[1])).max() < 0.02


def test_a_mode_in_which_the_triangles_are_others_has_no_derivative():
    pytest.importorskip("deodr")
    part = rts.plugin("rts.surfaces", "isosurface").example().replace(shader="silhouette")
    deodr = peers(moving("isosurface", part, rts.Camera.look_at((0, 0, 6), (0, 0, 0)), SIZE))[0][0]
    assert np.abs(deodr.derivative("translation")).max() > 0
    for of in (deodr.derivative, deodr.gradient):
        with pytest.raises(rts.InputError, match="the triangles of part 0 are others"):
            of("shape")


TEXTURE = np.full((4, 4, 3), 0.5)
SQUARE = card(-0.5, -0.4, 0.6, 0.3)
LEFT_OUT = {
    "a texture": (SQUARE.replace(theta={**SQUARE.theta, "texture": TEXTURE}), CAMERA, "part 0 has a texture"),
    "a shader": (SQUARE.replace(shader="lambert"), CAMERA, "the shader of part 0 is Lambert"),
    "a parallel camera": (
        SQUARE,
        rts.Camera.orthographic((0, 0, 3), (0, 0, 0), height=2),
        "the camera is orthographic",
    ),
    "rays alone": (
        rts.plugin("rts.surfaces", "sdf").example().replace(shader="silhouette"),
        CAMERA,
        "cannot be made one",
    ),
    "seams": (
        rts.Part(MESH([(0, 1, 2)], {"colors": [(1, 2, 0)]}), {"vertices": np.eye(3), "colors": np.eye(3)}, "unlit"),
        CAMERA,
        "not those of vertices",
    ),
    "alpha": (
        SQUARE.replace(theta={**SQUARE.theta, "color": np.ones(4)}, shader=rts.shading.shaders.Unlit(opaque=False)),
        CAMERA,
        "part 0 is translucent",
    ),
}


@pytest.mark.parametrize("case", LEFT_OUT)
def test_what_they_cannot_render_is_told(case):
    part, camera, reason = LEFT_OUT[case]
    found, (line,) = peers(moving(case, part, camera, SIZE))
    assert not found and line.startswith("DEODR and Mitsuba: ") and reason in line and "\n" not in line


def test_deodr_does_not_clip():
    pytest.importorskip("deodr")
    _, left_out = peers(moving("long", [SQUARE, card(-1, -1, 1, 1, z=3.5)], CAMERA, SIZE), ())
    assert "DEODR: it clips no triangles, and some are nearer than the near plane" in left_out


def test_a_mesh_for_mitsuba_is_a_file_with_its_colours(tmp_path):
    vertices, faces = icosphere(1)
    colors = np.abs(vertices) / 3
    path = tmp_path / "mesh.ply"
    described = emitter(vertices, faces, str(path), colors)
    assert described["emitter"]["radiance"] == {"type": "mesh_attribute", "name": "vertex_color"}
    header, body = path.read_bytes().split(b"end_header\n")
    assert b"property float r\nproperty float g\nproperty float b\nelement face" in header
    rows = np.frombuffer(body, "<f4", 6 * len(vertices)).reshape(-1, 6)
    np.testing.assert_array_equal(rows, np.concatenate([vertices, colors], axis=1).astype(np.float32))
    read = trimesh.load(path, process=False)
    np.testing.assert_array_equal(read.faces, faces)
    assert emitter(vertices, faces, str(path))["emitter"]["radiance"] == {"type": "rgb", "value": 1.0}
    np.testing.assert_array_equal(trimesh.load(path, process=False).vertices, vertices.astype(np.float32))


def test_parameters_of_mitsuba_have_either_name():
    assert positions_of({"box.vertex_positions": 0}, "box") == "box.vertex_positions"
    assert positions_of({"box.positions": 0, "box.faces": 0}, "box") == "box.positions"


def test_parameters_of_mitsuba_are_flat_or_tensors():
    try:
        mi = mitsuba()
    except ImportError as error:
        pytest.skip(str(error))
    rows = np.arange(12, dtype=np.float32).reshape(4, 3)
    parameters = {"old": mi.Float(rows.reshape(-1)), "new": mi.TensorXf(rows)}
    for name, shape in {"old": (12,), "new": (4, 3)}.items():
        set_flat(parameters, name, 2 * flat(parameters[name]))
        np.testing.assert_array_equal(np.array(parameters[name]), 2 * rows.reshape(shape))


@pytest.fixture
def fresh():
    """Mitsuba is looked for again."""
    mitsuba.cache_clear()
    yield
    mitsuba.cache_clear()


def test_packages_that_are_missing_are_told(monkeypatch, fresh):
    monkeypatch.setitem(sys.modules, "deodr", None)
    monkeypatch.setitem(sys.modules, "mitsuba", None)
    found, left_out = peers(moving("card", SQUARE, CAMERA, SIZE))
    install = "pip install 'rasterize-then-splat[bench]'"
    assert (found, left_out) == ([], [f"{p}: no module '{p.lower()}'; {install}" for p in ("DEODR", "Mitsuba")])


def test_an_old_llvm_is_told(monkeypatch, fresh):
    monkeypatch.setitem(sys.modules, "mitsuba", SimpleNamespace(set_variant=lambda name: None))
    detail = SimpleNamespace(llvm_version=lambda: (14, 0, 6))
    monkeypatch.setitem(sys.modules, "drjit", SimpleNamespace(detail=detail))
    _, left_out = peers(moving("card", SQUARE, CAMERA, SIZE))
    assert left_out[-1].startswith("Mitsuba: LLVM 14 was found; Mitsuba needs 16 or newer")
