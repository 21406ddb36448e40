"""Rendering from end to end, degenerate views, backgrounds, and what bad input is told."""

import math

import numpy as np
import pytest
from helpers import (
    ALL,
    CAMERA,
    DIFFERENTIABLE,
    FRONT,
    SIZE,
    TORCH,
    arrays,
    box,
    gradient,
    icosphere,
    mesh_part,
    moved,
    quad,
    rigid,
    show,
    soup,
    to_numpy,
)

import rts
from rts import Camera, Part
from rts.shading.shaders import Lambert, Textured
from rts_testing.compatibility import BORDER

pytestmark = pytest.mark.rendering

Mesh = rts.plugin("surfaces", "mesh")


# ------------------------------------------------------------------------------------------ the whole of it


@pytest.mark.parametrize("target", ALL)
def test_colours_from_0_to_255_are_remarked(target):
    part = arrays(target, mesh_part(quad(), shader="unlit", theta={"color": np.full(3, 200.0)}))
    (remark,) = rts.explain(part, CAMERA)[0].remarks
    assert remark.startswith("theta['color'] goes up to 200, where white is 1")
    assert rts.explain(mesh_part(quad(), shader="unlit", theta={"color": np.full(3, 2.0)}), CAMERA)[0].remarks == ()


@pytest.mark.parametrize("target", ALL)
def test_render_is_sample_then_render_samples(target):
    part, camera = arrays(target, (mesh_part(icosphere(1), shader="lambert"), CAMERA))
    image = show(part, camera, layers=3, background=(0.1, 0.2, 0.3))
    sampled = rts.sample(part, camera, SIZE, layers=3)
    found = rts.render_samples(sampled, part, camera, background=(0.1, 0.2, 0.3))
    np.testing.assert_array_equal(to_numpy(found), image)
    assert image.shape == (*SIZE, 4) and image.dtype == np.float32
    assert sampled.row.shape[0] == 1 and sampled.stencil is not None
    sampled = rts.sample(part, camera, SIZE, splatter=None, layers=3)
    assert sampled.row.shape == (3, *(n + 2 * BORDER for n in SIZE)) and int(sampled.overflow) == 0


@pytest.mark.parametrize("splatter", ["none", "single", "multi"])
def test_a_part_at_plus_x_plus_y_appears_upper_right(splatter):
    part = mesh_part(quad(0.4, 1.6, 0.4, 1.6))
    alpha = show(part, FRONT, (20, 24), splatter=splatter)[..., 3]
    rows, columns = np.nonzero(alpha > 0.5)
    # 5 pixels a unit: x from 12 + 2 to 12 + 8, y from 10 − 8 to 10 − 2.
    assert (rows.min(), rows.max(), columns.min(), columns.max()) == (2, 7, 14, 19)


def test_a_surface_beyond_the_image_keeps_the_rim_bright():
    image = show(mesh_part(quad(-9, 9, -9, 9)), FRONT)
    np.testing.assert_allclose(image, 1, atol=1e-6)


def test_the_nearer_part_hides_the_farther_one_whatever_their_order():
    near = mesh_part(quad(-9, 9, -9, 9, 1.0), shader="unlit", theta={"color": np.array([1.0, 0, 0])})
    far = mesh_part(quad(-9, 9, -9, 9, 0.0), shader="unlit", theta={"color": np.array([0.0, 1, 0])})
    for parts in ([near, far], [far, near]):
        np.testing.assert_allclose(show(parts, FRONT), np.broadcast_to([1, 0, 0, 1], (*SIZE, 4)), atol=1e-6)


@pytest.mark.parametrize("target", ALL)
def test_parts_merged_by_depth_are_the_image_of_one_merged_mesh(target):
    rng = np.random.default_rng(0)
    meshes = [box(0.8), soup(12, 1), icosphere(1, 0.9, (0.3, 0.2, 0.4))]
    colors = [rng.random((len(v), 3)) for v, _ in meshes]
    parts = [mesh_part(m, shader="unlit", theta={"colors": c}) for m, c in zip(meshes, colors, strict=True)]
    offsets = np.cumsum([0, *(len(v) for v, _ in meshes)])
    merged = (
        np.concatenate([v for v, _ in meshes]),
        np.concatenate([f + o for (_, f), o in zip(meshes, offsets, strict=False)]),
    )
    one = mesh_part(merged, shader="unlit", theta={"colors": np.concatenate(colors)})
    for layers in (1, 3):
        parts_, one_, camera = arrays(target, (parts, one, CAMERA))
        sampled, expected = (
            rts.sample(parts_, camera, SIZE, layers=layers, splatter=None),
            rts.sample(one_, camera, SIZE, layers=layers, splatter=None),
        )
        np.testing.assert_array_equal(to_numpy(sampled.depth), to_numpy(expected.depth))
        seen = np.unique(to_numpy(sampled.part))
        assert {0, 1, 2} <= set(seen)
        images = (show(x, camera, layers=layers, splatter="multi") for x in (parts_, one_))
        np.testing.assert_allclose(*images, rtol=0, atol=1e-5)


@pytest.mark.parametrize("target", ALL)
@pytest.mark.parametrize("shader", ["unlit", "normals", "lambert"])
def test_a_rigid_transform_is_like_moving_the_vertices(target, shader):
    transform = rigid((1, 2, 3), 40, (0.3, -0.2, 0.5))
    vertices, faces = box(0.8)
    colors = {"colors": np.random.default_rng(0).random((8, 3))}
    still = mesh_part((vertices, faces), shader=shader, theta=colors, transform=transform)
    there = mesh_part((moved(transform, vertices), faces), shader=shader, theta=colors)
    still, there, camera = arrays(target, (still, there, CAMERA))
    np.testing.assert_allclose(show(still, camera), show(there, camera), rtol=0, atol=2e-5)


def test_normals_under_a_stretch_are_those_of_the_ellipsoid():
    vertices, faces = icosphere(3)
    transform = np.diag([1.5, 0.75, 1.0, 1.0])
    part = mesh_part((vertices, faces), theta={"normals": vertices}, transform=transform, shader="normals")
    image = show(part, splatter="none")
    sampled = rts.sample(part, CAMERA, SIZE, splatter=None)
    row = sampled.row[0, BORDER:-BORDER, BORDER:-BORDER]
    points = moved(transform, part.surface.evaluate(part.theta, sampled.samples[0])["position"])[row]
    expected = points / np.array([1.5, 0.75, 1.0]) ** 2
    expected /= np.linalg.norm(expected, axis=-1, keepdims=True)
    inside = row >= 0
    assert inside.sum() > 100
    np.testing.assert_allclose(image[inside][:, :3] * 2 - 1, expected[inside], atol=0.02)


@pytest.mark.parametrize("target", ALL)
def test_a_mirroring_transform_keeps_the_outside_outside(target):
    vertices, faces = icosphere(2, 1.0, (0.5, 0, 0))
    mirror = np.diag([-1.0, 1, 1, 1])
    outward = {"normals": vertices - np.float32((0.5, 0, 0))}
    mirrored = mesh_part((vertices, faces), theta=outward, transform=mirror, shader="normals", cull="back")
    there = mesh_part(
        (moved(mirror, vertices), faces[:, ::-1]),
        theta={"normals": moved(mirror, outward["normals"])},
        shader="normals",
        cull="back",
    )
    mirrored, there, camera = arrays(target, (mirrored, there, CAMERA))
    image = show(mirrored, camera)
    np.testing.assert_allclose(image, show(there, camera), rtol=0, atol=2e-5)
    assert image[..., 3].sum() > 50


@pytest.mark.filterwarnings("ignore:part 0 is closed and wound inside out:rts.errors.InputWarning")
def test_culling_hides_the_inside_and_nothing_else():
    vertices, faces = icosphere(2)
    outside = mesh_part((vertices, faces), cull="back")
    inside_out = mesh_part((vertices, faces[:, ::-1]), cull="back")
    both = mesh_part((vertices, faces))
    front, back, both = (rts.sample(p, CAMERA, SIZE, splatter=None, layers=2) for p in (outside, inside_out, both))
    np.testing.assert_array_equal(front.depth[0], both.depth[0])
    np.testing.assert_array_equal(back.depth[0], both.depth[1])
    assert (front.row[1] == -1).all() and (back.row[1] == -1).all() and (back.row[0] >= 0).any()


# ------------------------------------------------------------------------------------------- degenerate views

FLAT = np.array([(-1, -1, 0), (1, 1, 0), (0, 0, 0)], np.float32), np.array([(0, 1, 2), (0, 0, 1)], np.int32)
VIEWS = {
    "beside the view": (icosphere(1, 1.0, (50, 0, 0)), CAMERA, True),
    "behind the camera": (icosphere(1, 1.0, (2, 3, 8)), CAMERA, True),
    "zero area": (FLAT, CAMERA, True),
    "across the near plane": (icosphere(2, 1.0, (1, 1.5, 4)), CAMERA, False),
    "zero area among others": (
        (np.concatenate([FLAT[0], icosphere(1)[0]]), np.concatenate([FLAT[1], icosphere(1)[1] + 3])),
        CAMERA,
        False,
    ),
    "a vertex at the eye": (
        (np.array([(1, 1.5, 4), (1, 0, 0), (-1, 0, 0)], np.float32), np.array([(0, 1, 2)])),
        CAMERA,
        True,
    ),
}


@pytest.mark.filterwarnings("ignore::rts.errors.EmptyImageWarning")
@pytest.mark.parametrize("name", VIEWS)
@pytest.mark.parametrize("target", DIFFERENTIABLE)
def test_degenerate_views_give_finite_images_and_gradients(name, target):
    mesh, camera, nothing = VIEWS[name]
    part = mesh_part(mesh, shader="lambert")
    given = arrays(target, {"vertices": mesh[0], "camera": camera, "transform": np.eye(4)})

    def f(tree):
        moving = part.replace(theta={"vertices": tree["vertices"]}, transform=tree["transform"])
        return rts.render(moving, tree["camera"], (12, 14))

    image = to_numpy(f(given))
    assert np.isfinite(image).all()
    # A triangle that is seen edge-on has the width of rounding.
    assert (np.abs(image) < 1e-4).all() if nothing else image[..., 3].sum() > 1
    found = gradient(target, lambda tree: (f(tree) ** 2).sum(), given)
    for leaf in (found["vertices"], found["transform"], *found["camera"]):
        assert np.isfinite(leaf).all()
        assert not nothing or (np.abs(leaf) < 1).all()
    assert nothing or np.abs(found["vertices"]).max() > 0


# ------------------------------------------------------------------------------------------------- background


@pytest.mark.parametrize("target", ALL)
def test_backgrounds_show_through_what_is_not_covered(target):
    part, camera = arrays(
        target, (mesh_part(icosphere(1), shader="unlit", theta={"color": np.array([0.9, 0.5, 0.1])}), CAMERA)
    )
    bare = show(part, camera)
    rng = np.random.default_rng(0)
    for shape in ((3,), (4,), (*SIZE, 3), (*SIZE, 4)):
        background = rng.random(shape)
        if shape[-1] == 4:
            background[..., :3] *= background[..., 3:]
        full = background if shape[-1] == 4 else np.concatenate([background, np.ones((*shape[:-1], 1))], axis=-1)
        expected = bare + (1 - bare[..., 3:]) * full
        for given in (background, arrays(target, background)):
            np.testing.assert_allclose(show(part, camera, background=given), expected, rtol=0, atol=1e-6)
    np.testing.assert_allclose(
        show(part, camera, background=(0, 0, 1)), bare + (1 - bare[..., 3:]) * (0, 0, 1, 1), rtol=0, atol=1e-6
    )


@pytest.mark.parametrize("target", DIFFERENTIABLE)
def test_the_background_is_differentiable(target):
    part, camera = arrays(target, (mesh_part(quad(0, 9, -9, 9)), FRONT))
    found = gradient(
        target,
        lambda b: rts.render(part, camera, SIZE, splatter="none", background=b)[..., 0].sum(),
        arrays(target, np.array([0.2, 0.3, 0.4])),
    )
    np.testing.assert_allclose(found, (SIZE[0] * SIZE[1] / 2, 0, 0), atol=1e-3)


# ----------------------------------------------------------------------------------------------------- errors

BOX = box()
PART = mesh_part(BOX, shader="unlit")
UV = np.zeros((8, 2))


def with_theta(shader="unlit", **theta):
    return mesh_part(BOX, shader=shader, theta=theta)


def two_lights():
    return {"direction": np.eye(3)[:2], "color": np.eye(3)}


BAD = {
    "zero height": (lambda: rts.render(PART, CAMERA, (0, 5)), ("size", "(0, 5)", "positive integers")),
    "negative width": (lambda: rts.render(PART, CAMERA, (5, -1)), ("size", "-1", "positive integers")),
    "fractional size": (lambda: rts.render(PART, CAMERA, (2.5, 3)), ("size", "2.5", "integers")),
    "three numbers as size": (lambda: rts.render(PART, CAMERA, (6, 6, 3)), ("size", "(height, width)")),
    "nan size": (lambda: rts.render(PART, CAMERA, (math.nan, 3)), ("size", "nan")),
    "infinite size": (lambda: rts.render(PART, CAMERA, (math.inf, 3)), ("size", "inf")),
    "absurd size": (lambda: rts.render(PART, CAMERA, (10**6, 1_200_000)), ("GiB", "smaller size")),
    "no layers": (lambda: rts.render(PART, CAMERA, SIZE, layers=0), ("layers", "0", "at least 1")),
    "no capacity": (lambda: rts.render(PART, CAMERA, SIZE, capacity=0), ("capacity", "0", "at least 1")),
    "no parts": (lambda: rts.render([], CAMERA, SIZE), ("parts", "nothing", "rts.Part")),
    "a mesh for a part": (lambda: rts.render(PART.surface, CAMERA, SIZE), ("parts", "Mesh", "rts.Part")),
    "a mesh among parts": (lambda: rts.render([PART, PART.surface], CAMERA, SIZE), ("Mesh", "rts.Part")),
    "a matrix for a camera": (lambda: rts.render(PART, np.eye(4), SIZE), ("camera", "ndarray", "rts.Camera")),
    "camera and size swapped": (lambda: rts.render(PART, SIZE, CAMERA), ("camera is (20, 24)", "rts.Camera")),
    "view (3, 4)": (
        lambda: rts.render(PART, CAMERA.replace(view=np.eye(4)[:3]), SIZE),
        ("camera's view", "(3, 4)", "(4, 4)"),
    ),
    "singular view": (lambda: rts.render(PART, CAMERA.replace(view=np.zeros((4, 4))), SIZE), ("view", "singular")),
    "singular projection": (
        lambda: rts.render(PART, CAMERA.replace(projection=np.diag([1.0, 0, 1, 1])), SIZE),
        ("projection", "singular"),
    ),
    "transform (3, 3)": (
        lambda: rts.render([PART, PART.replace(transform=np.eye(3))], CAMERA, SIZE),
        ("transform of part 1", "(3, 3)", "(4, 4)"),
    ),
    "singular transform": (
        lambda: rts.render(PART.replace(transform=np.diag([1.0, 1, 0, 1])), CAMERA, SIZE),
        ("transform", "singular"),
    ),
    "cull typo": (lambda: PART.replace(cull="backs"), ("cull", "'backs'", '"back"')),
    "theta not a dict": (lambda: Part(PART.surface, BOX[0]), ("theta", "ndarray", "dict")),
    "no vertices": (lambda: rts.render(Part(PART.surface, {"points": BOX[0]}), CAMERA, SIZE), ("'vertices'",)),
    "flat vertices": (lambda: rts.render(with_theta(vertices=BOX[0][:, :2]), CAMERA, SIZE), ("(8, 2)", "(rows, 3)")),
    "vertices in one row": (lambda: rts.render(with_theta(vertices=BOX[0].ravel()), CAMERA, SIZE), ("(24,)",)),
    "whole vertices": (
        lambda: rts.render(with_theta(vertices=BOX[0].astype(int)), CAMERA, SIZE),
        ("vertices", "int64", "floating"),
    ),
    "faces out of range": (
        lambda: rts.render(with_theta(vertices=BOX[0][:7]), CAMERA, SIZE),
        ("7 rows", "refer to row 7", "count from 0"),
    ),
    "negative faces": (lambda: Mesh([(0, 1, -1)]), ("faces", "-1", "count from 0")),
    "fractional faces": (lambda: Mesh([(0.0, 1.0, 2.0)]), ("faces", "float64", "integers")),
    "quads": (lambda: Mesh([(0, 1, 2, 3)]), ("faces", "(1, 4)", "(T, 3)")),
    "no faces": (lambda: Mesh(np.zeros((0, 3), int)), ("faces", "(0, 3)", "at least one")),
    "faces beyond int32": (lambda: Mesh([(0, 1, 2**40)]), ("faces", str(2**40), "2**31")),
    "uv indices of another length": (lambda: Mesh(BOX[1], {"uv": [(0, 1, 2)]}), ("indices['uv']", "(1, 3)", "(12, 3)")),
    "uv rows missing": (
        lambda: rts.render(with_theta(uv=UV[:5], texture=np.ones((2, 2, 3))), CAMERA, SIZE),
        ("theta['uv']", "5 rows", "row 7"),
    ),
    "uv of one column": (
        lambda: rts.render(with_theta("textured", uv=UV[:, :1], texture=np.ones((2, 2, 3))), CAMERA, SIZE),
        ("theta['uv']", "(8, 1)", "(rows, 2)"),
    ),
    "an attribute declared and not given": (
        lambda: rts.render(mesh_part(BOX, indices={"heat": None}), CAMERA, SIZE),
        ("'heat'",),
    ),
    "normals of two columns": (
        lambda: rts.render(with_theta(normals=np.ones((8, 2))), CAMERA, SIZE),
        ("theta['normals']", "(8, 2)", "(rows, 3)"),
    ),
    "colours of two columns": (
        lambda: rts.render(with_theta(colors=np.ones((8, 2))), CAMERA, SIZE),
        ("theta['colors']", "(8, 2)", "(rows, 1 or 3 or 4)"),
    ),
    "colour factor of two": (
        lambda: rts.render(with_theta(color=np.ones(2)), CAMERA, SIZE),
        ("theta['color']", "(2,)", "(3,) or (4,)"),
    ),
    "colour factor a number": (
        lambda: rts.render(with_theta(color=np.array(0.5)), CAMERA, SIZE),
        ("theta['color']", "()", "(3,) or (4,)"),
    ),
    "textured without a texture": (lambda: rts.render(with_theta("textured", uv=UV), CAMERA, SIZE), ("texture",)),
    "textured without uv": (
        lambda: rts.render(with_theta("textured", texture=np.ones((2, 2, 3))), CAMERA, SIZE),
        ("uv",),
    ),
    "texture of two channels": (
        lambda: rts.render(with_theta("textured", uv=UV, texture=np.ones((2, 2, 2))), CAMERA, SIZE),
        ("texture", "(2, 2, 2)", "(h, w, C)"),
    ),
    "texture without pixels": (
        lambda: rts.render(with_theta("textured", uv=UV, texture=np.ones((0, 2, 3))), CAMERA, SIZE),
        ("texture", "(0, 2, 3)"),
    ),
    "wrap typo": (lambda: Textured(wrap="reapeat"), ("wrap", "'reapeat'", "mirror")),
    "wrap typo in a pair": (lambda: Textured(wrap=("clamp", "reapeat")), ("wrap", "'reapeat'", "mirror")),
    "filter typo": (lambda: Textured(filter="trilinear"), ("filter", "'trilinear'", "nearest")),
    "two directions, three colours": (
        lambda: rts.render(with_theta("lambert", light=two_lights()), CAMERA, SIZE),
        ("2 directions", "3 colors"),
    ),
    "a light's direction of two": (
        lambda: rts.render(with_theta("lambert", light={"direction": np.ones(2)}), CAMERA, SIZE),
        ("light", "direction", "(2,)", "(3,)"),
    ),
    "a light that is no dict": (
        lambda: rts.render(with_theta("lambert", light=np.ones(3)), CAMERA, SIZE),
        ("light", "ndarray", "dict"),
    ),
    "a light's entry misspelt": (
        lambda: rts.render(with_theta("lambert", light={"dirction": np.ones(3)}), CAMERA, SIZE),
        ("light", "'dirction'", "direction"),
    ),
    "background of two": (lambda: rts.render(PART, CAMERA, SIZE, background=(0, 1)), ("background", "(2,)", "(4,)")),
    "background of another size": (
        lambda: rts.render(PART, CAMERA, SIZE, background=np.ones((5, 6, 3))),
        ("background", "(5, 6, 3)", "(20, 24, 3)"),
    ),
    "shader of three channels": (
        lambda: rts.render(PART.replace(shader=lambda t, g, c: g["position"]), CAMERA, SIZE),
        ("shader", "3)", "4)"),
    ),
    "samples of other parts": (
        lambda: rts.render_samples(rts.sample(PART, CAMERA, SIZE, splatter=None), [PART, PART], CAMERA),
        ("2 parts", "samples of 1"),
    ),
    "samples of more parts": (
        lambda: rts.render_samples(rts.sample([PART, PART], CAMERA, SIZE, splatter=None), PART, CAMERA),
        ("1 parts", "samples of 2"),
    ),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_input_is_an_input_error_of_one_line_that_says_what_was_given(name):
    call, words = BAD[name]
    with pytest.raises(rts.InputError) as error:
        call()
    message = str(error.value)
    assert "\n" not in message
    for word in words:
        assert word in message, message


@pytest.mark.parametrize("target", DIFFERENTIABLE)
def test_bad_values_in_tensors_are_input_errors_too(target):
    part, camera = arrays(target, (PART, CAMERA))
    with pytest.raises(rts.InputError, match="view matrix is singular"):
        rts.render(part, camera.replace(view=camera.view * 0), SIZE)
    with pytest.raises(rts.InputError, match=r"shape \(8, 2\)"):
        rts.render(part.replace(theta={"vertices": part.theta["vertices"][:, :2]}), camera, SIZE)
    with pytest.raises(rts.InputError, match="NaN or infinite"):
        rts.render(part.replace(theta={"vertices": part.theta["vertices"] * math.nan}), camera, SIZE)
    with pytest.raises(rts.InputError, match="int32; expected a floating one"):
        rts.render(part.replace(theta={"vertices": arrays(target, BOX[0].astype(np.int32))}), camera, SIZE)


def test_every_error_is_an_error_of_the_library_and_of_its_python_kind():
    assert issubclass(rts.InputError, ValueError) and issubclass(rts.InputError, rts.RtsError)
    assert issubclass(rts.errors.EngineError, TypeError) and issubclass(rts.errors.EngineError, rts.RtsError)
    assert issubclass(rts.errors.PluginError, ImportError) and issubclass(rts.errors.PluginError, rts.RtsError)


def test_plain_lists_of_numbers_are_arrays():
    theta = {"vertices": BOX[0], "color": np.array([1.0, 0.5, 0.0]), "light": {"color": np.ones(3)}}
    expected = rts.render(PART.replace(theta=theta, shader="lambert"), CAMERA, SIZE)
    lists = {"vertices": BOX[0].tolist(), "color": (1.0, 0.5, 0), "light": {"color": [1, 1, 1]}}
    camera = CAMERA.replace(projection=CAMERA.projection.tolist())
    np.testing.assert_allclose(
        rts.render(PART.replace(theta=lists, shader="lambert"), camera, SIZE), expected, atol=1e-5
    )


@pytest.mark.parametrize("target", ["numpy", *TORCH])
def test_samples_in_front_that_find_no_room_are_warned_of(target):
    part = PART.replace(theta=arrays(target, dict(PART.theta)))
    for options in {}, {"supersample": 2}:
        with pytest.warns(
            rts.errors.InputWarning, match="capacity is 1, and [0-9]+ samples find no room, .* image has holes"
        ):
            rts.render(part, CAMERA, SIZE, capacity=1, **options)
    # Hidden ones are left out first, as it is documented.
    row = rts.sample(part, CAMERA, SIZE, splatter=None).row
    rts.render(part, CAMERA, SIZE, capacity=int((row[0] >= 0).sum()) + 5)


# ------------------------------------------------------------------------- what one call leaves to the next


@pytest.mark.parametrize("target", DIFFERENTIABLE)
def test_samples_taken_for_one_shader_serve_another(target):
    identity = arrays(target, np.eye(4))
    part = Part(Mesh(BOX[1]), {"vertices": BOX[0], "colors": BOX[0] * 0.5 + 0.5}, "silhouette", identity)
    sampled = rts.sample(part, CAMERA, SIZE)
    for shader in ("unlit", "lambert"):
        other = part.replace(shader=shader)
        image = rts.render_samples(sampled, other, CAMERA)
        np.testing.assert_allclose(to_numpy(image), to_numpy(rts.render(other, CAMERA, SIZE)), atol=1e-6)


def test_a_half_precision_entry_does_not_round_the_rest():
    torch = pytest.importorskip("torch")
    part = Part(Mesh(BOX[1]), {"vertices": BOX[0].astype(np.float32), "color": np.ones(3, np.float32)}, "unlit")
    expected = rts.render(part, CAMERA, SIZE)
    half = part.replace(theta={**part.theta, "color": torch.ones(3, dtype=torch.float16)})
    np.testing.assert_allclose(to_numpy(rts.render(half, CAMERA, SIZE)), expected, atol=2e-5)
    brain = part.replace(theta={"vertices": torch.tensor(BOX[0]).bfloat16(), "color": np.ones(3)})
    assert np.isfinite(to_numpy(rts.render(brain, CAMERA, SIZE).float())).all()


def test_a_float64_pose_over_constant_vertices_is_rendered_in_float64():
    torch = pytest.importorskip("torch")
    part = Part(Mesh(BOX[1]), {"vertices": BOX[0]}, "silhouette", torch.eye(4, dtype=torch.float64))
    assert rts.render(part, CAMERA, SIZE).dtype == torch.float64


@pytest.mark.parametrize("target", DIFFERENTIABLE)
def test_plain_rasterization_has_a_gradient_of_zero(target):
    weights = arrays(target, np.random.default_rng(0).random((*SIZE, 4)))

    def loss(vertices):
        return (rts.render(Part(Mesh(BOX[1]), {"vertices": vertices}), CAMERA, SIZE, splatter="none") * weights).sum()

    found = gradient(target, loss, arrays(target, BOX[0]))
    assert found.shape == BOX[0].shape and (found == 0).all()


def test_a_scene_far_away_or_huge_is_no_singular_camera():
    for scale in (1e-20, 1e8):
        camera = Camera.look_at(np.array([0.1, 0.3, 3]) * scale, (0, 0, 0), fov_y=40)
        image = rts.render(Part(Mesh(BOX[1]), {"vertices": BOX[0] * scale}), camera, SIZE)
        assert image[..., 3].sum() > 10


def test_a_projective_transform_is_refused():
    projective = np.eye(4)
    projective[3] = [0, 0, 0.5, 1]
    with pytest.raises(rts.InputError, match="last row"):
        rts.render(PART.replace(transform=projective), CAMERA, SIZE)


# ------------------------------------------------------------------------------------- what is wrong in silence

TEXTURED = {"uv": UV, "texture": np.ones((2, 2, 3), np.float32), "normals": BOX[0], "colors": np.abs(BOX[0])}
LIGHT = {"direction": np.array((0.0, 1, 1)), "ambient": np.full(3, 0.5)}
# Shader, name and what is meant by it.
MISSPELT = [
    ("lambert", "lights", "light"),
    ("lambert", "Light", "light"),
    ("unlit", "colour", "color"),
    ("silhouette", "colour", "colors"),
    ("blinn_phong", "shinyness", "shininess"),
    ("unlit", "uvs", "uv"),
    ("unlit", "textures", "texture"),
    ("normals", "normal", "normals"),
    ("depth", "depthrange", "depth_range"),
]


@pytest.mark.parametrize("shader, name, meant", MISSPELT)
def test_entries_that_nobody_reads_are_warned_of_with_the_nearest_name(shader, name, meant):
    theta = {"vertices": BOX[0], name: np.ones(3, np.float32)}
    part = Part(Mesh(BOX[1]), theta, shader)
    with pytest.warns(rts.errors.InputWarning) as found:
        rts.render([PART, part], CAMERA, SIZE)
    assert [str(w.message) for w in found] == [
        f"theta[{name!r}] of part 1 is not read; did you mean {meant!r}? rts.explain lists all such entries"
    ]
    assert f"theta[{name!r}] is not read; did you mean {meant!r}?" in rts.explain(part, CAMERA)[0].remarks


@pytest.mark.parametrize("shader", ["silhouette", "normals", "depth", "unlit", "textured", "lambert", "blinn_phong"])
def test_what_files_bring_and_other_shaders_read_is_not_warned_of(shader):
    more = {"light": LIGHT, "specular": np.ones(3), "shininess": np.array(9.0), "depth_range": np.array((1.0, 9.0))}
    offsets = {"my_offsets": np.zeros(3), "texture_2": np.zeros(3)}
    part = Part(Mesh(BOX[1]), {"vertices": BOX[0], "color": np.ones(3), **TEXTURED, **more, **offsets}, shader)
    rts.render(part, CAMERA, SIZE)
    remarks = rts.explain(part, CAMERA)[0].remarks
    assert "theta['my_offsets'] is not read" in remarks and "theta['texture_2'] is not read" in remarks
    assert ("theta['light'] is not read" in remarks) == (shader not in ("lambert", "blinn_phong"))


def test_shaders_that_do_not_say_what_they_read_are_not_spoken_of():
    def shader(theta, gbuffer, camera):
        return np.ones((len(gbuffer["position"]), 4)) * theta["colour"][0]

    shader.opaque = True

    class Tinted(Lambert):
        def base_color(self, theta, gbuffer):
            return np.ones_like(gbuffer["position"]) * theta["colour"], np.ones_like(gbuffer["position"][:, :1])

    for own in shader, Tinted():
        part = Part(Mesh(BOX[1]), {"vertices": BOX[0], "colour": np.ones(3, np.float32)}, own)
        rts.render(part, CAMERA, SIZE)
        assert rts.explain(part, CAMERA)[0].remarks == ()


def test_coordinates_of_a_map_that_no_surface_declares_are_warned_of():
    theta = {"vertices": BOX[0], "uv_occlusion": np.ones((len(BOX[0]), 2), np.float32)}
    with pytest.warns(
        rts.errors.InputWarning, match=r"declare it, such as by rts.Mesh\(faces, {'uv_occlusion': None}\)"
    ):
        rts.render(Part(Mesh(BOX[1]), theta, "pbr"), CAMERA, SIZE)
    rts.render(Part(Mesh(BOX[1], {"uv_occlusion": None}), theta, "pbr"), CAMERA, SIZE)


@pytest.mark.parametrize("target", ALL)
def test_explain_at_a_size_observes_what_functions_read(target):
    def shader(theta, gbuffer, camera):
        tint = theta.get("tint", {"color": 1.0})["color"] * (2 if "double" in theta else 1)
        return gbuffer["position"][:, [0, 0, 0, 0]] * 0 + tint

    shader.opaque = False
    theta = {"vertices": BOX[0], "tint": {"color": np.float32(0.5)}, "tints": np.ones(3), "Double": np.ones(1)}
    part = Part(Mesh(BOX[1]), arrays(target, theta), shader)
    (lambert, own) = rts.explain([PART.replace(shader="lambert"), part], CAMERA, SIZE)
    assert lambert.remarks == ()
    assert {*own.remarks} == {"theta['tints'] is not read", "theta['Double'] is not read; did you mean 'double'?"}

    def all_of_it(theta, gbuffer, camera):
        return shader({**theta}, gbuffer, camera)

    all_of_it.opaque = False
    assert rts.explain(part.replace(shader=all_of_it), CAMERA, SIZE)[0].remarks == ()


def seams(vertices, faces):
    """A mesh whose triangles share no vertices."""
    return vertices[faces].reshape(-1, 3), np.arange(3 * len(faces)).reshape(-1, 3)


@pytest.mark.parametrize("target", ALL)
def test_a_texture_from_0_to_255_is_warned_of_once_a_surface(target):
    part = mesh_part(quad(), shader="textured", theta={"uv": np.zeros((4, 2), np.float32)})
    bright, right = (np.full((2, 2, 3), top, np.float32) for top in (255, 50))
    wrong = part.replace(theta={**part.theta, "texture": arrays(target, bright)})
    with pytest.warns(rts.errors.InputWarning, match=r"texture'\] of part 0 goes up to 255; expected linear .* 0 to 1"):
        rts.render(wrong, CAMERA, SIZE)
    rts.render(wrong, CAMERA, SIZE)
    for texture, shader in ((right, "textured"), (bright, "silhouette")):
        theta = {**part.theta, "texture": arrays(target, texture)}
        rts.render(mesh_part(quad(), shader=shader, theta=theta), CAMERA, SIZE)


@pytest.mark.parametrize("target", ALL)
@pytest.mark.parametrize("name", ["sphere", "far away", "with seams", "mirrored box", "with a hollow"])
def test_closed_meshes_that_are_wound_inside_out_are_warned_of_once(name, target):
    vertices, faces = icosphere(2)
    if name == "mirrored box":  # A transform that mirrors keeps the outside; vertices that are mirrored do not.
        vertices, faces = BOX[0] * np.float32([-1, 1, 1]), BOX[1][:, ::-1]
    elif name == "far away":
        vertices = vertices + np.float32([0, 0, -30])
    elif name == "with seams":
        vertices, faces = seams(vertices, faces)
    elif name == "with a hollow":
        vertices = np.concatenate([vertices, 0.5 * vertices])
        faces = np.concatenate([faces, faces[:, ::-1] + len(vertices) // 2])
    given, inward = arrays(target, vertices), faces[:, ::-1]
    for right in mesh_part((given, faces), cull="back"), mesh_part((given, inward)):
        rts.render(right, CAMERA, SIZE)
        assert rts.explain(right, CAMERA)[0].remarks == ()
    wrong = mesh_part((given, inward), cull="back")
    with pytest.warns(rts.errors.InputWarning, match="part 0 is closed and wound inside out: .*; give it faces"):
        rts.render(wrong, CAMERA, SIZE)
    rts.render(wrong, CAMERA, SIZE)
    assert "is closed and wound inside out" in rts.explain(wrong, CAMERA)[0].remarks[0]


def test_rooms_and_open_meshes_may_be_wound_inwards():
    vertices, faces = icosphere(2)
    room = mesh_part((9 * vertices, faces[:, ::-1]), cull="back")
    rts.render(room, CAMERA, SIZE)
    # Half a sphere, a tube that is open at both ends, and a sphere with one triangle turned.
    half, tube = faces[(vertices[faces][..., 2] > 0).all(axis=1)], box()[1][:8]
    turned = np.concatenate([faces[:1], faces[1:, ::-1]])
    pairs = [(v, f) for v, f in ((vertices, half), (box()[0], tube)) for f in (f, f[:, ::-1])]
    for v, f in [*pairs, (vertices, turned)]:
        part = mesh_part((v, f), cull="back")
        rts.sample(part, CAMERA, SIZE, splatter=None)
        assert rts.explain(part, CAMERA)[0].remarks == ()


def test_surfaces_that_cannot_be_remembered_are_not_looked_at():
    class Unhashable(Mesh):
        __hash__ = None

    vertices, faces = icosphere(1)
    rts.render(Part(Unhashable(faces[:, ::-1]), {"vertices": vertices}, cull="back"), CAMERA, SIZE)


def test_vertices_that_are_traced_are_not_looked_at():
    jax = pytest.importorskip("jax")
    vertices, faces = icosphere(1)
    wrong = mesh_part((vertices, faces[:, ::-1]), cull="back")
    draw = jax.jit(lambda v: rts.render(wrong.replace(theta={"vertices": v}), CAMERA, SIZE))
    assert draw(jax.numpy.asarray(vertices))[..., 3].sum() > 10


def test_explain_tells_of_functions_that_do_not_say_whether_they_are_opaque():
    def shader(theta, gbuffer, camera):
        return rts.namespace(gbuffer["position"]).ones_like(gbuffer["position"][:, [0, 0, 0, 0]])

    part = rts.Mesh.example().replace(shader=shader)
    assert "does not say whether light passes" in str(rts.explain(part, CAMERA)[0])
    shader.opaque = True
    assert "light" not in str(rts.explain(part.replace(shader=shader), CAMERA)[0])
