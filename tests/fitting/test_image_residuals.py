"""Image residuals: values by `render`, normal equations against those formed from the whole Jacobian."""

import numpy as np
import pytest
from helpers import DIFFERENTIABLE, arrays, box, crooked_box, icosphere, precision, quad, refused, soup, to_numpy

import rts
import rts.fitting.least_squares
from rts.arrays.engines import engine_of
from rts.errors import InputError
from rts.fitting import image_residuals
from rts.fitting.normal_equations import normal_equations
from rts.rendering import settings
from rts.splatting import normal_equations as sweep

pytestmark = pytest.mark.fitting

SIZE = (26, 31)
CAMERA = rts.Camera.look_at((0.7, 0.9, 3.2), (0, 0, 0), fov_y=45, aspect=31 / 26)
POSE = np.array([0.2, -0.3, 0.1, 0.05, -0.07, 0.1])
TOLERANCE = {np.float32: 1e-5, np.float64: 1e-10}
CASES = [
    *((channels, "torch-cpu", dtype) for channels in (1, 3, 4) for dtype in TOLERANCE),
    (3, "jax", np.float32),
    (4, "jax", np.float64),
]
"""Channels, engine and dtype."""
targets = pytest.mark.parametrize("target", DIFFERENTIABLE)
torch_targets = pytest.mark.parametrize("target", [t for t in DIFFERENTIABLE if t != "jax"])
"""For what takes the same way in every engine: jax compiles for seconds."""


def mesh(vertices, faces, shader="silhouette", **theta):
    return rts.Part(rts.plugin("rts.surfaces", "mesh")(faces), {"vertices": vertices, **theta}, shader)


def scene(parameters):
    """A box with coloured corners that moves, before a sphere and a wall, and triangles that cross them."""
    vertices, faces = box(0.5)
    colors = np.random.default_rng(0).random((8, 3)).astype(np.float32)
    moving = mesh(vertices, faces, "lambert", colors=colors).replace(transform=rts.rigid(parameters["pose"]))
    lit = {"color": parameters["color"]}
    return [
        moving,
        mesh(*icosphere(1, 0.6, (0.6, 0.1, -0.6)), "unlit", **lit),
        mesh(*quad(-0.9, 0.8, -1.1, 0.6, -0.8), "unlit"),
        mesh(*soup(6, seed=3, extent=0.7, size=0.3), "unlit"),
    ]


def start(target, dtype=np.float32):
    return arrays(target, {"color": np.array([0.9, 0.5, 0.2, 0.7]), "pose": POSE}, dtype)


def fields(channels, seed=1):
    """A target and weights, one number a pixel or a channel, some of them zero."""
    rng = np.random.default_rng(seed)
    weights = rng.random((*SIZE, channels)) * (rng.random((*SIZE, channels)) > 0.3)
    return rng.random((*SIZE, channels)), weights


def count_sweeps(monkeypatch):
    calls = []
    whole = sweep.normal_equations

    def counted(*args, **options):
        calls.append(args)
        return whole(*args, **options)

    monkeypatch.setattr(sweep, "normal_equations", counted)
    return calls


def check(residuals, parameters, tolerance, *, compiling=False):
    """Normal equations and, from the Jacobian of the residuals, the same in float64.

    The Jacobian of jax compiles for seconds, so that of torch stands for it unless it is to be `compiling`.
    """
    engine = engine_of(parameters)
    found = engine.jit(residuals.normal_equations)(parameters)
    kinds = {str(x.dtype) for x in found}
    assert len(kinds) == 1
    if engine.name == "jax" and not compiling:
        kind = to_numpy(parameters["pose"]).dtype
        parameters = arrays("torch-cpu", {k: to_numpy(v) for k, v in parameters.items()}, kind)
        engine = engine_of(parameters)
    flat, unflatten = rts.fitting.normal_equations.flatten(parameters)
    xp = engine.namespace
    r, rows = map(to_numpy, engine.jit(engine.jacobian(lambda v: xp.reshape(residuals(unflatten(v)), (-1,))))(flat))
    r, rows = r.astype(np.float64), rows.astype(np.float64)
    weights, curvatures = residuals.loss.weights(r)
    expected = residuals.loss(r), curvatures * rows @ rows.T / len(r), rows @ (weights * r) / len(r)
    scales = expected[0], np.abs(expected[1]).max(), np.abs(expected[1]).max() ** 0.5 * expected[0] ** 0.5
    assert scales[1] > 1e-6
    for own, formed, scale in zip(map(to_numpy, found), expected, scales, strict=True):
        np.testing.assert_allclose(own, formed, rtol=0, atol=tolerance * scale)
    return found


# ----------------------------------------------------------------------------------------------- normal equations


@pytest.mark.parametrize(("channels", "target", "dtype"), CASES)
def test_normal_equations_are_those_of_the_jacobian(channels, target, dtype, monkeypatch):
    sweeps = count_sweeps(monkeypatch)
    goal, weights = fields(channels)
    with precision(target, dtype):
        residuals = rts.ImageResiduals(scene, CAMERA, SIZE, goal, weights=weights)
        check(residuals, start(target, dtype), TOLERANCE[dtype], compiling=dtype == np.float32)
    assert len(sweeps) == 1


@pytest.mark.parametrize(
    ("background", "channels", "target"),
    [
        ("color", 1, "torch-cpu"),
        ("color", 3, "torch-cpu"),
        ("rgba", 4, "torch-cpu"),
        ("image", 1, "torch-cpu"),
        ("rgba", 4, "jax"),
    ],
)
def test_backgrounds_are_composited_under_the_image(background, channels, target):
    rng = np.random.default_rng(4)
    behind = {"color": rng.random(3), "rgba": rng.random(4), "image": rng.random((*SIZE, 4))}[background]
    goal, weights = fields(channels)
    residuals = rts.ImageResiduals(scene, CAMERA, SIZE, goal, weights=weights, background=behind)
    if channels == 1 and background == "color":  # All is opaque then, and nothing changes.
        np.testing.assert_allclose(to_numpy(residuals.normal_equations(start(target))[1]), 0, atol=1e-9)
        return
    check(residuals, start(target), 1e-5)


@targets
def test_jitted_and_with_few_rows(target):
    goal, _ = fields(3)
    residuals = rts.ImageResiduals(scene, CAMERA, SIZE, goal)
    eager = residuals.normal_equations(start(target))
    jitted = check(residuals, start(target), 1e-5)
    for a, b in zip(map(to_numpy, eager), map(to_numpy, jitted), strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-5 * np.abs(a).max())
    few = rts.ImageResiduals(scene, CAMERA, SIZE, goal, capacity=600)
    check(few, start(target), 1e-5)


FINE_CASES = [
    *((*case, "torch-cpu", np.float64) for case in ((1, 2), (3, 3), (4, 4))),
    (4, 2, "torch-cpu", np.float32),
    (1, 3, "jax", np.float32),
]
"""Channels, samples a pixel along each axis, engine and dtype."""


@pytest.mark.filterwarnings("ignore::rts.errors.LayersWarning")
@pytest.mark.parametrize(("channels", "fine", "target", "dtype"), FINE_CASES)
def test_supersampled_images_are_swept_to_the_normal_equations_of_their_jacobian(
    channels, fine, target, dtype, monkeypatch
):
    sweeps = count_sweeps(monkeypatch)
    goal, weights = fields(channels)
    behind = np.random.default_rng(4).random((*SIZE, 4))
    options = {"weights": weights, "supersample": fine, "background": behind}
    with precision(target, dtype):
        residuals = rts.ImageResiduals(scene, CAMERA, SIZE, goal, **options)
        check(residuals, start(target, dtype), TOLERANCE[dtype], compiling=dtype == np.float32)
    assert len(sweeps) == 1 and residuals.supersample == fine


@targets
def test_bands_of_a_supersampled_image_add_up(target, monkeypatch):
    goal, weights = fields(3)
    residuals = rts.ImageResiduals(scene, CAMERA, SIZE, goal, weights=weights, supersample=3, layers=2)
    parameters = start(target)
    whole = engine_of(parameters).jit(residuals.normal_equations)(parameters)
    sweeps = count_sweeps(monkeypatch)
    monkeypatch.setattr(settings, "BAND", 3000)
    found = check(residuals, start(target), 1e-4)
    assert len(sweeps) == 6 and {len(args[6]) for args in sweeps} == {4, 5}  # Rows of unlike number.
    for a, b in zip(map(to_numpy, found), map(to_numpy, whole), strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=3e-5 * np.abs(b).max())


@pytest.mark.parametrize("side", [1, 7, 33])
def test_supersampled_images_of_any_size(side):
    """Pixels are cut at no tile: 32 cells hold 10 of them, or 6."""
    size = side, 45 - side
    camera = rts.Camera.look_at((0.3, 0.4, 1.5), (0, 0, 0), aspect=size[1] / size[0])
    for fine in (3, 5):
        goal = np.random.default_rng(0).random((*size, 4))
        check(rts.ImageResiduals(scene, camera, size, goal, supersample=fine), start("torch-cpu", np.float64), 1e-10)


@torch_targets
def test_shapes_of_target_and_weights(target):
    alpha, weights = fields(1)
    both, _ = fields(4)
    parameters = start(target)
    flat = rts.ImageResiduals(scene, CAMERA, SIZE, alpha[..., 0], weights=weights[..., 0])
    assert tuple(flat(parameters).shape) == SIZE
    column = rts.ImageResiduals(scene, CAMERA, SIZE, alpha, weights=weights)
    assert tuple(column(parameters).shape) == (*SIZE, 1)
    for a, b in zip(check(flat, parameters, 1e-5), check(column, parameters, 1e-5), strict=True):
        np.testing.assert_array_equal(to_numpy(a), to_numpy(b))
    mask = weights[..., 0] > 0.5
    masked = rts.ImageResiduals(scene, CAMERA, SIZE, both, weights=mask)
    assert not to_numpy(masked(parameters))[~mask].any()
    check(masked, parameters, 1e-5)
    image = to_numpy(rts.render(scene(parameters), CAMERA, SIZE))
    np.testing.assert_allclose(to_numpy(masked(parameters)), (image - both) * mask[..., None], atol=1e-6)


@torch_targets
def test_target_and_weights_may_be_arrays_of_the_engine(target):
    goal, weights = fields(3)
    given, parameters = arrays(target, {"goal": goal, "weights": weights}), start(target)
    own = rts.ImageResiduals(scene, CAMERA, SIZE, given["goal"], weights=given["weights"])
    host = rts.ImageResiduals(scene, CAMERA, SIZE, goal, weights=weights)
    for a, b in zip(check(own, parameters, 1e-5), host.normal_equations(parameters), strict=True):
        np.testing.assert_allclose(to_numpy(a), to_numpy(b), rtol=1e-6, atol=1e-7)


@pytest.mark.parametrize("side", [1, 7, 16, 17, 140])
def test_images_of_any_size(side):
    """Bands and tiles are cut wherever they may."""
    size = side, 145 - side
    camera = rts.Camera.look_at((0.3, 0.4, 1.5), (0, 0, 0), aspect=size[1] / size[0])
    goal = np.random.default_rng(0).random((*size, 4))
    residuals = rts.ImageResiduals(scene, camera, size, goal)
    check(residuals, start("torch-cpu"), 1e-4)


@torch_targets
def test_cameras_vertices_and_prepared_parts(target):
    vertices, faces = box(0.6)
    fixed = mesh(vertices, faces, "lambert")
    goal, _ = fields(3)
    parameters = arrays(target, {"eye": np.array([0.7, 0.9, 3.2]), "vertices": vertices})

    def moved(p):
        camera = rts.Camera.look_at(p["eye"], (0, 0, 0), aspect=31 / 26)
        return fixed.replace(theta={"vertices": p["vertices"]}), camera

    check(rts.ImageResiduals(moved, None, SIZE, goal), parameters, 1e-5)
    prepared = rts.prepare(fixed)
    eye = {"eye": parameters["eye"]}
    held = rts.ImageResiduals(lambda p: (prepared, moved({**p, "vertices": vertices})[1]), None, SIZE, goal)
    free = rts.ImageResiduals(lambda p: moved({**p, "vertices": vertices}), None, SIZE, goal)
    for a, b in zip(check(held, eye, 1e-5), free.normal_equations(eye), strict=True):
        np.testing.assert_allclose(to_numpy(a), to_numpy(b), rtol=1e-5, atol=1e-7)


@torch_targets
def test_nothing_in_view_has_zero_derivatives(target):
    goal, _ = fields(4)
    far = arrays(target, np.array([0, 0, 0, 50.0, 0, 0]))
    residuals = rts.ImageResiduals(lambda p: mesh(*box(0.5)).replace(transform=rts.rigid(p)), CAMERA, SIZE, goal)
    value, matrix, gradient = map(to_numpy, residuals.normal_equations(far))
    np.testing.assert_allclose(value, np.mean(goal**2), rtol=1e-5)
    assert not matrix.any() and not gradient.any()


# ---------------------------------------------------------------------------------------------- the Jacobian's turn


@pytest.mark.parametrize("splatter", ["multi", "none"])
def test_what_no_sweep_knows_is_done_by_the_jacobian(splatter, monkeypatch):
    sweeps = count_sweeps(monkeypatch)
    goal, weights = fields(3)
    residuals = rts.ImageResiduals(scene, CAMERA, SIZE, goal, weights=weights, splatter=splatter)
    check(residuals, start("torch-cpu"), 1e-5)
    assert not sweeps


@pytest.mark.parametrize(("target", "fine"), [("torch-cpu", 1), ("torch-cpu", 3), ("jax", 1)])
def test_the_jacobian_of_blurred_residuals_is_of_samples_that_are_found_once(target, fine, monkeypatch):
    goal, weights = fields(3)
    behind = np.random.default_rng(4).random((*SIZE, 3))
    options = {"weights": weights, "background": behind, "supersample": fine, "layers": 2}
    monkeypatch.setattr(settings, "BAND", 3000)
    residuals = rts.ImageResiduals(scene, CAMERA, SIZE, goal, **options).at_stage(rts.Stage(sigma=1.5))
    sampled, known = image_residuals.sampled_scene, []

    def counted(scene, *args):
        known.append(not scene.traced)
        return sampled(scene, *args)

    monkeypatch.setattr(image_residuals, "sampled_scene", counted)
    residuals.normal_equations(start(target))
    assert known == [True] * len(residuals._settings.bands(SIZE)) and (len(known) > 1) == (fine > 1)
    check(residuals, start(target), 1e-4)


# ------------------------------------------------------------------------------------------------------------ fits


@targets
@pytest.mark.parametrize("jit", [True, False])
def test_a_pose_is_found_as_from_a_function(jit, target, monkeypatch):
    part = mesh(*crooked_box())
    camera = rts.Camera.look_at((0.9, 0.8, 2.2), (0, 0, 0), fov_y=40)
    moved = lambda p: part.replace(transform=rts.rigid(p))  # noqa: E731
    goal = rts.render(moved(np.array([0.12, -0.18, 0.1, 0.06, -0.05, 0.08])), camera, (40, 40))[..., 3]
    there = arrays(target, goal)
    calls = []
    known = rts.ImageResiduals(moved, camera, (40, 40), goal)
    sweeps = count_sweeps(monkeypatch)
    ours = rts.fit(known, arrays(target, np.zeros(6)), method="lm", jit=jit)
    assert len(sweeps) > 3
    sweeps.clear()

    def residuals(p):
        calls.append(p)
        return rts.render(moved(p), camera, (40, 40))[..., 3] - there

    theirs = rts.fit(residuals, arrays(target, np.zeros(6)), method="lm", jit=jit)
    assert calls and not sweeps
    np.testing.assert_allclose(ours.history[:4], theirs.history[:4], rtol=1e-3)
    assert ours.loss < ours.history[0] / 50 and abs(ours.loss - theirs.loss) < 1e-3 * ours.history[0]
    np.testing.assert_allclose(to_numpy(ours.parameters), to_numpy(theirs.parameters), atol=5e-3)


def test_adam_takes_them_for_the_function_that_they_are():
    goal, _ = fields(3)
    residuals = rts.ImageResiduals(scene, CAMERA, SIZE, goal)
    fit = rts.fit(residuals, start("torch-cpu"), steps=3, learning_rate=1e-3)
    assert fit.history[0] == pytest.approx(float((residuals(start("torch-cpu")) ** 2).mean()), rel=1e-5)
    assert fit.loss < fit.history[0]


@targets
def test_what_goes_wrong_in_sampling_stops_the_fit_with_its_reason(target):
    goal = np.zeros(SIZE)

    def scene(p):
        return mesh(*box(0.5)).replace(transform=rts.rigid(p))

    with pytest.raises(InputError, match="NaN or infinity"):
        rts.fit(rts.ImageResiduals(scene, CAMERA, SIZE, goal), arrays(target, np.full(6, np.nan)), method="lm")


# ------------------------------------------------------------------------------------------------ the protocol


class Line(rts.Residuals):
    """Residuals A x − b that know AᵀA."""

    def __init__(self, target):
        rng = np.random.default_rng(0)
        self.matrix, self.goal = (arrays(target, rng.normal(size=s)) for s in ((9, 3), 9))
        self.used = 0

    def __call__(self, p):
        return self.matrix @ p["x"] - self.goal

    def normal_equations(self, p):
        self.used += 1
        r = self(p)
        return (r * r).mean(), self.matrix.T @ self.matrix / 9, self.matrix.T @ r / 9


@targets
def test_any_residuals_may_bring_their_normal_equations(target):
    own, plain = Line(target), Line(target)
    start = arrays(target, {"x": np.zeros(3)})
    fit = rts.fit(own, start, method="lm", tolerance=1e-9)
    assert own.used
    expected = rts.fit(lambda p: plain(p), start, method="lm", tolerance=1e-9)
    np.testing.assert_allclose(to_numpy(fit.parameters["x"]), to_numpy(expected.parameters["x"]), atol=1e-4)
    for a, b in zip(own.normal_equations(start), normal_equations(plain, start, engine_of(start)), strict=True):
        np.testing.assert_allclose(to_numpy(a), to_numpy(b), rtol=1e-5)


@targets
def test_normal_equations_of_another_form_are_refused(target):
    class Wrong(Line):
        def normal_equations(self, p):
            return self.answer(*super().normal_equations(p))

    residuals, start = Wrong(target), arrays(target, {"x": np.zeros(3)})
    for answer, given in (
        (lambda value, matrix, gradient: (value, matrix), r"\(\), \(3, 3\)"),
        (lambda value, matrix, gradient: (value, gradient, matrix), r"\(\), \(3,\), \(3, 3\)"),
        (lambda value, matrix, gradient: None, "a NoneType"),
        (lambda value, matrix, gradient: (1.0, matrix, gradient), r"a float, \(3, 3\), \(3,\)"),
    ):
        residuals.answer = answer
        with refused(rf"normal_equations gave {given}; expected \w+ arrays of shapes \(\), \(3"):
            rts.fit(residuals, start, method="lm")


# ----------------------------------------------------------------------------------------------------- arguments


@pytest.mark.parametrize(
    ("target", "options", "expected"),
    [
        (np.zeros((26, 30)), {}, r"target has shape \(26, 30\); expected \(26, 31\) or \(26, 31, 1\)"),
        (np.zeros((26, 31, 2)), {}, r"target has shape \(26, 31, 2\)"),
        ("mask.png", {}, "target is 'mask.png'; expected an array"),
        (np.zeros(SIZE, np.uint8), {}, "target has dtype uint8; expected floating"),
        (
            np.zeros((*SIZE, 3)),
            {"weights": np.zeros((*SIZE, 4))},
            r"weights has shape \(26, 31, 4\); expected \(26, 31\) or \(26, 31, 1\) or \(26, 31, 3\)",
        ),
        (np.zeros(SIZE), {"weights": np.zeros(SIZE, np.int32)}, "weights has dtype int32"),
        (np.zeros(SIZE), {"background": np.zeros(2)}, r"background has shape \(2,\)"),
        (np.zeros(SIZE), {"layers": 0}, "layers is 0"),
        (None, {}, "target is None; expected an array"),
        (np.full(SIZE, np.nan), {}, "target holds NaN or infinity; expected finite numbers"),
        (np.full((*SIZE, 3), np.inf), {}, "target holds NaN or infinity"),
        (np.zeros(SIZE), {"weights": np.full(SIZE, np.nan)}, "weights holds NaN or infinity"),
        (np.zeros(SIZE), {"weights": "mask"}, "weights is 'mask'; expected an array"),
        (np.full(SIZE, 255.0), {}, r"target's alpha goes up to 255; expected 0 to 1: divide one from 0 to 255 by 255"),
        (np.full((*SIZE, 4), 255.0), {}, "target's alpha goes up to 255"),
        (np.full((*SIZE, 6), 7.0), {"channels": 5}, "target's alpha goes up to 7"),
        (np.zeros(SIZE), {"weights": np.full(SIZE, -0.5)}, "weights go down to -0.5; expected none below zero"),
        (np.zeros(SIZE), {"weights": np.zeros(SIZE)}, "weights are all zero, so that nothing is compared"),
        (np.zeros(SIZE), {"weights": np.zeros(SIZE, bool)}, "weights are all zero"),
        (np.zeros((2, *SIZE)), {"camera": [CAMERA] * 2, "weights": np.zeros((2, *SIZE))}, "weights are all zero"),
        (
            np.zeros((3, *SIZE)),
            {"camera": [CAMERA] * 3, "weights": np.ones((2, *SIZE))},
            "weights are of 2 views; expected 3",
        ),
        (np.zeros(SIZE), {"camera": [CAMERA] * 2}, "there are 2 cameras for a target of one view; expected targets"),
        (np.zeros(SIZE), {"camera": rts.Camera.stack([CAMERA] * 3)}, "there are 3 cameras for a target of one view"),
        (np.zeros((2, *SIZE)), {"camera": [CAMERA] * 3}, "3 cameras for targets of 2 views; expected as many"),
        (np.zeros(SIZE), {"background": [np.nan, 0.0, 0.0]}, "background holds NaN or infinity"),
        (np.zeros(SIZE), {"scene": None}, "scene is None; expected a function: parameters → parts"),
        (np.zeros(SIZE), {"scene": mesh(*box(0.5))}, "scene is Part.*; expected a function"),
        (np.zeros(SIZE), {"camera": "front"}, "camera is 'front'; expected an rts.Camera, or None"),
        (np.zeros(SIZE), {"size": 64}, "size is 64; expected"),
        (np.zeros(SIZE), {"splatter": 3}, "the splatter is 3; expected"),
        (np.zeros(SIZE), {"splatter": "mutli"}, "no splatter named 'mutli'"),
        (np.zeros(SIZE), {"sampler": 3}, "the sampler is 3; expected"),
        (np.zeros(SIZE), {"supersample": 1.5}, "supersample is 1.5"),
    ],
)
def test_wrong_arguments_say_what_was_expected(target, options, expected):
    given = {"scene": scene, "camera": CAMERA, "size": SIZE, **options}
    with refused(expected):
        rts.ImageResiduals(given.pop("scene"), given.pop("camera"), given.pop("size"), target, **given)


@targets
def test_colours_far_beyond_one_are_warned_of_and_features_are_not(target):
    picture = arrays(target, np.full((*SIZE, 3), 254.0))
    with pytest.warns(
        rts.errors.InputWarning, match="target's colours go up to 254, .* divide a picture from 0 to 255 by 255"
    ):
        rts.ImageResiduals(scene, CAMERA, SIZE, picture)
    rts.ImageResiduals(scene, CAMERA, SIZE, picture / 40)  # Light may be bright.
    features = arrays(target, np.concatenate([np.full((*SIZE, 5), 254.0), np.ones((*SIZE, 1))], axis=2))
    rts.ImageResiduals(scene, CAMERA, SIZE, features, channels=5)
    rts.ImageResiduals(scene, CAMERA, SIZE, features[..., :5], channels=5)
    # A view may be left out of a fit.
    masks = arrays(target, np.stack([np.zeros(SIZE), np.ones(SIZE)]))
    rts.ImageResiduals(scene, [CAMERA] * 2, SIZE, masks, weights=masks)


def test_masks_may_be_bool_and_weights_one_number():
    mask = np.random.default_rng(2).random(SIZE) > 0.5
    found = rts.ImageResiduals(scene, CAMERA, SIZE, mask, weights=0.5)(start(DIFFERENTIABLE[0]))
    expected = rts.ImageResiduals(scene, CAMERA, SIZE, mask * 1.0, weights=np.full(SIZE, 0.5))(start(DIFFERENTIABLE[0]))
    np.testing.assert_allclose(to_numpy(found), to_numpy(expected), atol=1e-6)
    several = rts.ImageResiduals(scene, [CAMERA] * 2, SIZE, np.stack([mask, mask]), weights=0.5)
    np.testing.assert_allclose(to_numpy(several(start(DIFFERENTIABLE[0])))[1], to_numpy(expected), atol=1e-5)


@pytest.mark.parametrize("name", ["target", "weights", "background"])
def test_what_requires_a_gradient_is_warned_of(name):
    torch = pytest.importorskip("torch")
    given = {"target": torch.zeros(SIZE), "weights": torch.ones(SIZE), "background": torch.ones(3)}
    given[name].requires_grad_(True)
    with pytest.warns(
        rts.errors.InputWarning, match=f"^{name} requires a gradient, .* as a constant; give {name}.detach"
    ):
        rts.ImageResiduals(scene, CAMERA, SIZE, **given)


@targets
def test_targets_of_an_engine_must_be_finite_too(target):
    goal = np.zeros(SIZE)
    goal[3, 4] = np.nan
    with pytest.raises(InputError, match="target holds NaN"):
        rts.ImageResiduals(scene, CAMERA, SIZE, arrays(target, goal))


@pytest.mark.parametrize("method", ["adam", "lm"])
@pytest.mark.parametrize(
    ("result", "said"),
    [
        (lambda: None, "scene gave None; expected an rts.Part or several, or a tuple"),
        (lambda: (1, 2, 3), "scene gave a int, a int, a int"),
        (lambda: (mesh(*box(0.5)), "front"), "scene gave a rts.scene.parts.Part, a str"),
        (lambda: np.zeros((26, 31, 4)), r"scene gave a numpy.ndarray of shape \(26, 31, 4\)"),
        (lambda: [], "scene gave nothing"),
    ],
)
def test_scenes_that_give_something_else(result, said, method):
    residuals = rts.ImageResiduals(lambda p: result(), CAMERA, SIZE, np.zeros(SIZE))
    with refused(said):
        rts.fit(residuals, start("torch-cpu"), method=method)


def test_a_camera_must_come_from_somewhere():
    residuals = rts.ImageResiduals(scene, None, SIZE, np.zeros(SIZE))
    with pytest.raises(InputError, match="camera is None, and scene gives none"):
        residuals(start("torch-cpu"))


@pytest.mark.parametrize(
    ("target", "said"),
    [
        (np.zeros(SIZE), "there are several cameras for a target of one view"),
        (np.zeros((3, *SIZE)), "there are 2 cameras for targets of 3 views"),
    ],
)
def test_a_scene_must_give_as_many_cameras_as_there_are_views(target, said):
    residuals = rts.ImageResiduals(lambda p: (scene(p), [CAMERA] * 2), None, SIZE, target)
    with refused(said):
        residuals(start("torch-cpu"))
