"""Outputs of a render by name, against closed forms."""

import numpy as np
import pytest
import torch

import rts
from tests.helpers import ALL, arrays, icosphere, mesh_part, to_numpy

pytestmark = pytest.mark.rendering

SIZE = 24
NEAR, FAR = 2.0, 5.0
"""Depths of a card and of a wall behind it."""
EDGE = 0.13
"""Where the card ends, NDC."""
CAMERA = rts.Camera.look_at((0, 0, 0), (0, 0, -1), fov_y=90)
SQUARE = np.array([[0, 1, 2], [0, 2, 3]])
REAL = ("color", "depth", "normal", "position", "alpha", "depth_front")


def card(depth, left, right, half=9.0, **more):
    """A part square to the camera at a depth, from x = left to right, of NDC."""
    x = depth * np.array([left, right, right, left], np.float64)
    y = depth * half * np.array([-1, -1, 1, 1], np.float64)
    return rts.Part(rts.Mesh(SQUARE), {"vertices": np.stack([x, y, np.full(4, -depth)], axis=1), **more}, "silhouette")


def pixels(ndc):
    """Columns from the left side of the image to an x in NDC."""
    return SIZE * (1 + ndc) / 2


def moved(part, shift):
    """The part, its vertices moved to the right by a number of pixels."""
    depth = -float(part.theta["vertices"][0, 2])
    vertices = torch.as_tensor(part.theta["vertices"]) + shift * torch.tensor([2 * depth / SIZE, 0, 0])
    return part.replace(theta={**part.theta, "vertices": vertices})


def test_a_card_before_a_wall_mixes_depth_by_area_and_moves_it():
    shift = torch.tensor(0.0, dtype=torch.float64, requires_grad=True)
    scene = [moved(card(NEAR, -9, EDGE), shift), card(FAR, -9, 9)]
    found = rts.render(scene, CAMERA, (SIZE, SIZE), outputs=("depth", "depth_front", "part", "alpha"))
    share = np.clip(pixels(EDGE) - np.arange(SIZE), 0, 1)
    np.testing.assert_allclose(to_numpy(found["depth"])[5, :, 0], NEAR * share + FAR * (1 - share), atol=1e-5)
    front = np.arange(SIZE) + 0.5 < pixels(EDGE)
    np.testing.assert_allclose(to_numpy(found["depth_front"])[5, :, 0], np.where(front, NEAR, FAR), atol=1e-5)
    np.testing.assert_array_equal(to_numpy(found["part"])[5, :, 0], np.where(front, 0, 1))
    np.testing.assert_allclose(to_numpy(found["alpha"]), 1, atol=1e-6)
    found["depth"][5].sum().backward()
    np.testing.assert_allclose(float(shift.grad), NEAR - FAR, atol=1e-3)


def test_means_are_of_what_is_covered_of_a_pixel():
    uv = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float64)
    shift = torch.tensor(0.0, dtype=torch.float64, requires_grad=True)
    scene = moved(card(NEAR, -0.5, EDGE, uv=uv), shift)
    names = ("depth", "normal", "position", "uv", "alpha", "color")
    tensors = rts.render(scene, CAMERA, (SIZE, SIZE), outputs=names, background=(1.0, 0.0, 0.0))
    found = {name: x[SIZE // 2] for name, x in to_numpy(tensors).items()}
    column = int(pixels(EDGE))
    share = pixels(EDGE) - column
    middle = (column + share / 2) * 2 / SIZE - 1
    np.testing.assert_allclose(found["alpha"][column], [share], atol=1e-6)
    np.testing.assert_allclose(found["depth"][column], [NEAR], atol=1e-5)
    np.testing.assert_allclose(found["normal"][column], [0, 0, 1], atol=1e-5)
    np.testing.assert_allclose(found["position"][column, 0], NEAR * middle, atol=1e-3)
    np.testing.assert_allclose(found["uv"][column, 0], (middle + 0.5) / (0.5 + EDGE), atol=1e-3)
    np.testing.assert_allclose(found["color"][column], [1, share, share, 1], atol=1e-6)
    for name in ("depth", "normal", "position", "uv", "alpha"):
        np.testing.assert_array_equal(found[name][0], 0)
    # Depth is the same wherever the card is; it covers one pixel more on the right, and one less on the left.
    (slope,) = torch.autograd.grad(tensors["depth"].sum(), shift, retain_graph=True)
    np.testing.assert_allclose(float(slope), 0, atol=1e-4)
    (slope,) = torch.autograd.grad(tensors["alpha"][SIZE // 2, SIZE // 2 :].sum(), shift)
    np.testing.assert_allclose(float(slope), 1, atol=1e-4)


def test_depth_in_front_has_the_derivative_at_the_pixel_not_at_the_point():
    depth = torch.tensor([2.0, 4.0, 4.0, 2.0], dtype=torch.float64)
    shift = torch.tensor(0.0, dtype=torch.float64, requires_grad=True)
    x, y = torch.tensor([-2.0, 2.0, 2.0, -2.0]), torch.tensor([-9.0, -9.0, 9.0, 9.0])
    slanted = rts.Part(rts.Mesh(SQUARE), {"vertices": torch.stack([x + shift, y, -depth], dim=1)}, "silhouette")
    front = rts.render(slanted, CAMERA, (SIZE, SIZE), outputs=("depth_front",))["depth_front"][SIZE // 2]
    ndc = (np.arange(SIZE) + 0.5) * 2 / SIZE - 1
    # On z = 3 + (x − s) / 2 and x = ndc z.
    expected = 3 / (1 - ndc / 2)
    there = (np.abs(ndc * expected) < 1.5).nonzero()[0]
    np.testing.assert_allclose(to_numpy(front)[there, 0], expected[there], atol=1e-5)
    front[there].sum().backward()
    np.testing.assert_allclose(float(shift.grad), (-0.5 / (1 - ndc / 2))[there].sum(), rtol=0.01)


@pytest.mark.parametrize("engine", ALL)
def test_outputs_are_those_of_renders_one_by_one(engine):
    ball, wall = mesh_part(icosphere(1)), card(4.0, -0.5, 0.9)
    camera = rts.Camera.look_at((0, 0, 3), (0, 0, 0))
    scene = arrays(engine, [ball, wall])
    together = rts.render(scene, camera, (20, 20), outputs=(*REAL, "part", "triangle"))
    assert list(together) == [*REAL, "part", "triangle"]
    # Alone the silhouette needs one sample, whose areas beside outlines are one number: sums are rounded otherwise.
    alone = to_numpy(rts.render(scene, camera, (20, 20)))
    np.testing.assert_allclose(to_numpy(together["color"]), alone, rtol=0, atol=5e-7)
    for name in REAL:
        alone = rts.render(scene, camera, (20, 20), outputs=[name])[name]
        np.testing.assert_allclose(to_numpy(together[name]), to_numpy(alone), atol=1e-5)
    several = rts.render_views(scene, [camera, camera], (20, 20), outputs=REAL)
    for name in REAL:
        np.testing.assert_allclose(to_numpy(several[name])[1], to_numpy(together[name]), atol=1e-5)
    triangle, part = to_numpy(together["triangle"])[..., 0], to_numpy(together["part"])[..., 0]
    assert triangle[part == 0].max() < len(ball.surface.faces) and set(triangle[part == 1]) <= {0, 1}
    assert (triangle[part < 0] == -1).all()


@pytest.mark.parametrize("options", [{"splatter": "multi"}, {"supersample": 2}, {"layers": 3}], ids=str)
def test_other_settings_give_the_same_up_to_their_own_edges(options):
    scene = mesh_part(icosphere(2), shader="lambert")
    camera = rts.Camera.look_at((0, 0, 3), (0, 0, 0))
    usual = rts.render(scene, camera, (24, 24), outputs=("depth", "normal", "part"))
    found = rts.render(scene, camera, (24, 24), outputs=("depth", "normal", "part"), **options)
    inside = usual["depth"][..., 0] > 0
    assert np.abs(found["depth"] - usual["depth"])[inside & (found["depth"][..., 0] > 0)].mean() < 0.03
    assert (found["part"] >= 0).sum() > 100


def test_light_that_passes_weighs_what_lies_behind():
    glass = card(NEAR, -9, 9, color=np.array([1, 1, 1, 0.25])).replace(
        shader=rts.plugin("rts.shaders", "unlit")(opaque=False)
    )
    found = rts.render([glass, card(FAR, -9, 9)], CAMERA, (8, 8), outputs=("depth", "alpha"))
    np.testing.assert_allclose(found["depth"], 0.25 * NEAR + 0.75 * FAR, atol=1e-5)


@pytest.mark.parametrize("target", ALL)
@pytest.mark.parametrize(("alpha", "kept"), [(5e-4, 0), (2e-3, 1)])
def test_pixels_of_which_hardly_anything_is_covered_tell_no_means(target, alpha, kept):
    glass = card(NEAR, -9, 9, color=np.array([1, 1, 1, alpha])).replace(
        shader=rts.plugin("rts.shaders", "unlit")(opaque=False)
    )
    names, glass = ("depth", "normal", "alpha"), glass.replace(theta=arrays(target, glass.theta))
    found = rts.render(glass, CAMERA, (8, 8), outputs=names)
    np.testing.assert_allclose(to_numpy(found["alpha"]), alpha, rtol=1e-4)
    np.testing.assert_allclose(to_numpy(found["depth"]), kept * NEAR, rtol=1e-4)
    np.testing.assert_allclose(to_numpy(found["normal"]), np.broadcast_to([0, 0, kept], (8, 8, 3)), atol=1e-5)


def test_attributes_of_the_surface_are_outputs():
    colors = np.array([[0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1]], np.float64)
    part = card(NEAR, -9, 9, colors=colors).replace(shader="silhouette")
    with pytest.raises(rts.InputError, match="outputs has 'colours'.*did you mean 'color'"):
        rts.render(part, CAMERA, (8, 8), outputs=("colours",))
    with pytest.raises(rts.InputError, match="'uv' is an attribute that no part has"):
        rts.render(part, CAMERA, (8, 8), outputs=("uv",))
    for wrong in ("depth", (), [3]):
        with pytest.raises(rts.InputError, match="expected a tuple of names"):
            rts.render(part, CAMERA, (8, 8), outputs=wrong)


def test_uv_is_zero_on_parts_without():
    uv = np.array([[0.5, 0.5]] * 4)
    found = rts.render([card(NEAR, -9, EDGE, uv=uv), card(FAR, -9, 9)], CAMERA, (SIZE, SIZE), outputs=("uv",))["uv"]
    np.testing.assert_allclose(found[5, 0], 0.5, atol=1e-6)
    np.testing.assert_allclose(found[5, -1], 0, atol=1e-6)


# ------------------------------------------------------------------------------------------------ residuals


def test_a_pose_is_found_from_depth_where_colours_do_not_tell():
    ball, camera = mesh_part(icosphere(2), shader="silhouette"), rts.Camera.look_at((0, 0, 0), (0, 0, -1), fov_y=60)
    wall = card(6.0, -9, 9)

    def scene(parameters):
        return [ball.replace(transform=rts.rigid(parameters["pose"])), wall]

    truth = {"pose": torch.tensor([0.0, 0.0, 0.0, 0.1, -0.05, -3.5])}
    found = rts.render(scene(truth), camera, (20, 20), outputs=("depth", "normal"))
    target = {name: x.detach() for name, x in found.items()}
    residuals = rts.ImageResiduals(scene, camera, (20, 20), target, weights={"normal": 0.5})
    assert residuals(truth).shape == (20 * 20 * 4,) and abs(residuals(truth)).max() < 1e-6
    result = rts.fit(residuals, {"pose": torch.tensor([0.0, 0.0, 0.0, 0.0, 0.0, -3.0])}, method="lm", steps=15)
    np.testing.assert_allclose(to_numpy(result.parameters["pose"])[3:], to_numpy(truth["pose"])[3:], atol=5e-3)
    coarse = residuals.at_stage(rts.Stage(0.5))
    assert coarse(truth).shape == (10 * 10 * 4,)
    views = rts.ImageResiduals(
        lambda p: scene(p), [camera, camera], (20, 20), {"depth": torch.stack([target["depth"]] * 2)}
    )
    assert views(truth).shape == (2, 400) and abs(views(truth)).max() < 1e-4


def test_depth_counts_where_it_was_measured_and_something_is_seen():
    part = card(NEAR, -0.5, EDGE)
    target = np.full((SIZE, SIZE), 3.0)
    target[:, SIZE // 2 :] = 0
    residuals = rts.ImageResiduals(lambda p: part, CAMERA, (SIZE, SIZE), {"depth": target}, weights={"depth": 2.0})
    found = residuals({}).reshape(SIZE, SIZE)[3]
    share = np.clip(np.arange(SIZE) + 1 - pixels(-0.5), 0, 1) * (np.arange(SIZE) < SIZE // 2)
    np.testing.assert_allclose(found, 2 * (NEAR - 3.0) * share, atol=1e-5)


def test_wrong_targets_of_outputs_are_refused():
    ball, camera = mesh_part(icosphere(1), shader="silhouette"), rts.Camera.look_at((0, 0, 3), (0, 0, 0))

    def residuals(target, weights=None, cameras=camera):
        return rts.ImageResiduals(lambda p: ball, cameras, (8, 8), target, weights=weights)

    for target, message in (
        ({"depth": np.zeros((4, 4))}, r"target\['depth'\].*expected real numbers \(8, 8\)"),
        ({"part": np.zeros((8, 8))}, "target has 'part', and indices have no derivative"),
        ({"alpha": np.full((8, 8), 255.0)}, r"target\['alpha'\]'s alpha goes up to 255"),
        ({"depth": None}, r"target\['depth'\] is a NoneType; expected real numbers"),
        ({"depth": 2.0}, r"target\['depth'\] is a float; expected real numbers"),
        (5.0, "target is a float; expected"),
        ([{"depth": np.ones((8, 8))}], r"target\['depth'\] is a list; expected real numbers"),
        ({"depth": np.full((8, 8), np.nan)}, "NaN.*put 0 where nothing was measured"),
        ({"alpha": np.full((8, 8), np.nan)}, "NaN.*weight of 0"),
        ({}, "target is an empty dict; expected targets by names of outputs"),
        ({"depth": np.zeros((8, 8))}, "all zero, so that nothing is compared"),
    ):
        with pytest.raises(rts.InputError, match=message):
            residuals(target)
    with pytest.raises(rts.InputError, match="weights is .*by names of targets: depth"):
        residuals({"depth": np.ones((8, 8))}, {"dept": 1.0})
    with pytest.raises(rts.InputError, match=r"has shape \(8, 8\); expected those of 2 views, \(2, H, W, ·\)"):
        residuals({"depth": np.ones((8, 8))}, cameras=[camera, camera])
    with pytest.raises(rts.InputError, match="unlike names: alpha; depth; expected the same"):
        residuals([{"depth": np.ones((8, 8))}, {"alpha": np.ones((8, 8))}], cameras=[camera, camera])
    with pytest.warns(rts.errors.InputWarning, match=r"target\['color'\]'s colours go up to 200"):
        residuals({"color": np.full((8, 8, 3), 200.0)})
    two = {"depth": np.ones((2, 8, 8))}
    for weights in ([{"depth": 0.5}], [{"depth": 0.5}] * 5, {"depth": np.ones((5, 8, 8))}):
        with pytest.raises(rts.InputError, match="weights are of [15] views; expected 2"):
            residuals(two, weights, [camera, camera])
    with pytest.raises(rts.InputError, match="weights is a dict"):
        residuals(np.ones((8, 8)), {"color": 1.0})
    residuals({"color": np.full((8, 8, 4), 5.0)})  # Of features, perhaps.
    with pytest.raises(rts.InputError, match="expected 1 numbers a pixel"):
        residuals({"depth": np.ones((8, 8, 3))})({})


def test_targets_of_views_are_arrays_lists_or_a_dict_for_each():
    ball = mesh_part(icosphere(1), shader="silhouette")
    cameras = [rts.Camera.look_at(eye, (0, 0, 0)) for eye in ((0, 0, 3), (3, 0, 0))]
    views = [rts.render(ball, camera, (8, 8), outputs=("depth", "alpha")) for camera in cameras]
    lists = {name: [2 * view[name] for view in views] for name in ("depth", "alpha")}
    arrays_of, weights = {name: np.stack(x) for name, x in lists.items()}, [{"depth": 0.5}, {"depth": 2.0}]
    dicts = [{name: 2 * x for name, x in view.items()} for view in views]
    found = [
        rts.ImageResiduals(lambda p: (ball, cameras), own, (8, 8), target, weights=weights)({})
        for target in (arrays_of, lists, dicts)
        for own in (cameras, None)
    ]
    assert found[0].any()
    some, plain = (
        rts.ImageResiduals(lambda p: (ball, cameras), cameras, (8, 8), lists, weights=weights)({})
        for weights in ([None, {"depth": 2.0}], None)
    )
    np.testing.assert_array_equal(some[0], plain[0])
    for other in found[1:]:
        np.testing.assert_array_equal(other, found[0])


@pytest.mark.parametrize("method", ["lm", "adam"])
def test_a_scene_that_forgets_its_parameters_is_told_so(method):
    ball, camera = mesh_part(icosphere(1), shader="silhouette"), rts.Camera.look_at((0, 0, 3), (0, 0, 0))
    residuals = rts.ImageResiduals(lambda p: ball, camera, (8, 8), {"depth": np.full((8, 8), 2.0)})
    with pytest.raises(rts.InputError, match="residuals do not depend on the parameters"):
        rts.fit(residuals, torch.zeros(6), method=method, progress=False)


@pytest.mark.filterwarnings("ignore::rts.errors.EmptyImageWarning")
def test_a_fit_to_depth_says_where_nothing_is_compared_any_more():
    ball, camera = mesh_part(icosphere(1), shader="silhouette"), rts.Camera.look_at((0, 0, 3), (0, 0, 0))
    target = {"depth": 1000 * rts.render(ball, camera, (8, 8), outputs=("depth",))["depth"]}
    residuals = rts.ImageResiduals(lambda p: ball.replace(transform=rts.rigid(p)), camera, (8, 8), target)
    fit = rts.fit(residuals, torch.tensor([0.0, 0, 0, 0.1, 0, 0]), method="lm", progress=False)
    assert fit.loss == 0 and "all is met, or nothing compared" in fit.reason
