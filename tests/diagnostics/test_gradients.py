"""Derivatives as pictures, and gradients beside finite differences of hard renders."""

import numpy as np
import pytest
from helpers import DIFFERENTIABLE, TORCH, arrays, quad, to_numpy

import rts
from rts_diagnostics import finite_difference_steps, gradients

pytestmark = pytest.mark.rendering

MESH = rts.plugin("rts.surfaces", "mesh")
CAMERA = rts.Camera.orthographic((0, 0, 10), (0, 0, 0), height=16)
SIZE = (16, 16)
VERTICES, FACES = quad(-4.3, 3.4, -3.1, 4.2)


def card(parameters):
    """A card whose colour and place are the parameters; a world unit is a pixel."""
    xp = rts.namespace(*parameters.values())
    vertices = arrays_like(parameters["shift"], VERTICES) + parameters["shift"]
    colors = xp.stack([parameters["color"]] * 4)
    return rts.Part(MESH(FACES), {"vertices": vertices, "colors": colors}, "unlit"), CAMERA


def arrays_like(x, value):
    return rts.engine_of(x).constant(value, x)


def parameters_of(target):
    return arrays(target, {"shift": np.array([0.1, 0.2, 0.0]), "color": np.array([0.8, 0.5, 0.2])})


@pytest.mark.parametrize("target", DIFFERENTIABLE)
def test_a_right_gradient_agrees_with_the_difference(target):
    check = rts.check_gradient(card, parameters_of(target), SIZE, supersample=4, budget_s=600)
    assert check.ok
    names = [s.name for s in check.slopes]
    assert names == ["color[0]", "color[1]", "color[2]", "shift[0]", "shift[1]", "shift[2]"]
    for s in check.slopes:
        # A sum of squares ripples as outlines pass pixels; a difference over a pixel averages it, the slope does not.
        assert abs(s.autodiff - s.difference) <= 0.1 * abs(s.difference) + 3 * s.error
    assert check.slopes[5].difference == pytest.approx(0, abs=1e-6)  # Orthographic: depth is not seen.
    assert [(r.kind, r.parameters) for r in check.reasons] == [("undetermined", ["shift[2]"])]


def test_gradients_that_miss_the_silhouette_are_shown_to_differ():
    check = rts.check_gradient(card, parameters_of("torch-cpu"), SIZE, splatter="none")
    by_name = {s.name: s for s in check.slopes}
    assert not check.ok
    assert by_name["shift[0]"].autodiff == 0 and not check.agrees(by_name["shift[0]"])
    assert check.agrees(by_name["color[0]"])
    row = next(line for line in str(check).splitlines() if line.startswith("shift[0]"))
    assert row.endswith("differs")


def test_the_difference_is_that_of_the_area():
    # Loss = the sum of the image, so that the slope of the shift is 0 and of the colour the card's area.
    check = rts.check_gradient(card, parameters_of("torch-cpu"), SIZE, loss=lambda image: image[..., :3].sum())
    by_name = {s.name: s for s in check.slopes}
    assert by_name["color[1]"].difference == pytest.approx(7.7 * 7.3, rel=0.02)
    assert by_name["shift[1]"].difference == pytest.approx(0, abs=max(3 * by_name["shift[1]"].error, 1e-3))


def test_only_some_numbers_of_large_arrays_are_looked_at():
    def scene(vertices):
        return rts.Part(MESH(FACES), {"vertices": vertices}), CAMERA

    check = rts.check_gradient(scene, arrays("torch-cpu", VERTICES), SIZE, entries=3, samples=3)
    assert len(check.slopes) == 3 and all(s.name.startswith("parameters[") for s in check.slopes)
    assert len({s.name for s in check.slopes}) == 3


def test_a_step_moves_what_moves_fastest_by_a_pixel():
    check = rts.check_gradient(card, parameters_of("torch-cpu"), SIZE, samples=2)
    by_name = {s.name: s for s in check.slopes}
    assert by_name["shift[0]"].step == pytest.approx(finite_difference_steps.STEP_PIXELS, rel=1e-4)
    assert by_name["color[0]"].step == pytest.approx(finite_difference_steps.STEP_COLOR, rel=1e-4)


@pytest.mark.parametrize("target", DIFFERENTIABLE)
def test_a_gradient_image_is_the_derivative_along_a_direction(target):
    parameters = parameters_of(target)
    found = rts.gradient_image(
        lambda p: rts.render(*card(p), SIZE), parameters, {"color": [0, 0, 0], "shift": [1.0, 0, 0]}
    )
    assert found.derivative.shape == (16, 16, 4)
    np.testing.assert_allclose(found.derivative[6:9, 8:, 3].sum(axis=1), 1, atol=2e-3)
    np.testing.assert_allclose(found.derivative[6:9, :8, 3].sum(axis=1), -1, atol=2e-3)
    assert found.scale == pytest.approx(np.abs(found.derivative).max())


def test_a_signed_picture_is_grey_where_nothing_changes(tmp_path):
    from PIL import Image

    along = {"color": [0, 0, 0], "shift": [1.0, 0, 0]}
    found = rts.gradient_image(lambda p: rts.render(*card(p), SIZE), parameters_of("torch-cpu"), along, scale=0.5)
    rts.save_image(tmp_path / "signed.png", found.picture)
    pixels = np.asarray(Image.open(tmp_path / "signed.png"))
    assert set(map(tuple, pixels[:2].reshape(-1, 3))) <= {(127, 127, 127), (128, 128, 128)}
    assert pixels[8, 8:, 0].max() > 150 and pixels[8, :8, 0].min() < 100


def test_one_number_needs_no_direction():
    torch = pytest.importorskip("torch")
    base = parameters_of("torch-cpu")
    shift = torch.tensor([1.0, 0, 0])
    found = rts.gradient_image(
        lambda t: rts.render(*card({**base, "shift": base["shift"] + t * shift}), SIZE), torch.tensor(0.0)
    )
    assert found.derivative[8, 8:, 3].sum() == pytest.approx(1, abs=2e-3)


@pytest.mark.parametrize("call", [lambda p: rts.check_gradient(card, p, SIZE), lambda p: rts.gradient_image(card, p)])
def test_parameters_without_derivative_are_refused(call):
    with pytest.raises(rts.InputError, match="expected torch or jax arrays"):
        call({"shift": np.zeros(3)})


def test_a_direction_that_does_not_fit_is_refused():
    parameters = parameters_of("torch-cpu")
    with pytest.raises(rts.InputError, match="give the direction"):
        rts.gradient_image(card, parameters)
    with pytest.raises(rts.InputError, match="direction has arrays of shapes"):
        rts.gradient_image(card, parameters, {"color": [0.0, 0, 0], "shift": [0.0, 0]})
    with pytest.raises(rts.InputError, match=r"expected a torch array \(H, W, C\)"):
        rts.gradient_image(lambda p: p["shift"], parameters, {"color": [0.0, 0, 0], "shift": [0.0, 0, 1]})


@pytest.mark.parametrize("target", DIFFERENTIABLE)
@pytest.mark.parametrize(
    "change, said",
    [
        ({"scene": lambda p: card(p)[0]}, r"scene gave a rts.scene.parts.Part; expected \(parts, camera\)"),
        ({"scene": lambda p: None}, "scene gave None"),
        ({"loss": lambda image: image}, "loss gave .*; expected a .* scalar"),
        ({"loss": lambda image: 1.0}, "loss gave a float"),
        ({"size": 64}, "size is 64; expected"),
        ({"size": (-3, 4)}, "expected .height, width."),
        ({"entries": 0}, "entries is 0; expected an integer of at least 1"),
        ({"samples": 0}, "expected an integer of at least 1"),
    ],
)
def test_bad_input_to_a_check_is_refused_in_one_line(change, said, target):
    given = {"scene": card, "parameters": parameters_of(target), "size": SIZE, **change}
    with pytest.raises(rts.InputError, match=said):
        rts.check_gradient(given.pop("scene"), given.pop("parameters"), given.pop("size"), **given)


def test_a_scene_that_ignores_the_parameters_is_refused():
    constant = card({"shift": np.zeros(3), "color": np.ones(3)})
    with pytest.raises(rts.InputError, match="nothing in the scene depends on the parameters"):
        rts.check_gradient(lambda p: constant, parameters_of("torch-cpu"), SIZE)


def test_integer_parameters_are_refused():
    torch = pytest.importorskip("torch")
    for call in (lambda p: rts.check_gradient(card, p, SIZE), lambda p: rts.gradient_image(card, p, p)):
        with pytest.raises(rts.InputError, match="dtype torch.int64; expected a floating one"):
            call(torch.tensor([1, 2, 3]))


ALONG = {"color": [0, 0, 0], "shift": [1.0, 0, 0]}


@pytest.mark.parametrize(
    "call, said",
    [
        (lambda p: rts.check_gradient(None, p, SIZE), "scene is None; expected a function"),
        (lambda p: rts.check_gradient(card, p, SIZE, loss="mse"), "loss is 'mse'; expected a function"),
        (lambda p: rts.check_gradient(card, p, SIZE, tolerance="small"), "tolerance is 'small'; expected a number"),
        (lambda p: rts.check_gradient(card, p, SIZE, tolerance=-1), "tolerance is -1; expected a number"),
        (lambda p: rts.check_gradient(card, p, SIZE, samples="8"), "samples is '8'; expected an integer"),
        (lambda p: rts.check_gradient(card, p, SIZE, entries=[1]), r"entries is \[1\]; expected an integer"),
        (lambda p: rts.check_gradient(card, p, SIZE, sampels=3), "no option 'sampels'; expected sampler, splatter"),
        (lambda p: rts.check_gradient(card, p, SIZE, outputs=("depth",)), "no option 'outputs'; expected sampler"),
        (lambda p: rts.check_gradient(card, {"a": p["shift"], 1: p["color"]}, SIZE), "keys that cannot be sorted"),
        (lambda p: rts.gradient_image(None, p, ALONG), "image is None; expected a function"),
        (lambda p: rts.gradient_image(lambda q: np.zeros((3, 3, 3)), p, ALONG), "image gave a numpy.ndarray"),
        (lambda p: rts.gradient_image(card, None), "parameters holds nothing; expected torch or jax"),
        (lambda p: rts.gradient_image(card, {"a": [p["shift"], 3.0]}), r"parameters\['a'\]\[1\] is .*; expected torch"),
        (lambda p: rts.gradient_image(card, p, ALONG, scale=np.ones((5, 9))), r"scale is a numpy.ndarray of shape"),
    ],
)
def test_what_is_of_the_wrong_kind_is_refused_in_one_line(call, said):
    with pytest.raises(rts.InputError, match=said) as error:
        call(parameters_of("torch-cpu"))
    assert "\n" not in str(error.value)


def test_under_jit_there_is_nothing_to_look_at():
    jax = pytest.importorskip("jax")
    image = lambda q: rts.render(*card(q), SIZE)  # noqa: E731
    for call, name in (
        (lambda q: rts.check_gradient(card, q, SIZE).slopes[0].autodiff, "check_gradient"),
        (lambda q: rts.gradient_image(image, q, ALONG).derivative, "gradient_image"),
    ):
        with pytest.raises(rts.InputError, match=f"parameters holds traced arrays; call rts.{name} outside") as error:
            jax.jit(call)(parameters_of("jax"))
        assert "\n" not in str(error.value)


def test_images_that_jax_cannot_trace_and_arrays_of_two_engines():
    torch = pytest.importorskip("torch")
    parameters = parameters_of("jax")
    for image, kind, said in (
        (lambda q: rts.render(*card(q), SIZE) * float(q["shift"][0]), rts.InputError, "jax cannot trace the function"),
        (lambda q: rts.render(*card(q), SIZE) * torch.ones(1), rts.errors.EngineError, "torch and jax arrays met"),
    ):
        with pytest.raises(kind, match=said) as error:
            rts.gradient_image(image, parameters, ALONG)
        assert "\n" not in str(error.value)


@pytest.mark.parametrize("scale", [0, -1.0, float("nan"), "1"])
def test_a_scale_that_is_none_is_refused(scale):
    along = {"color": [0, 0, 0], "shift": [1.0, 0, 0]}
    with pytest.raises(rts.InputError, match="scale is .*; expected a positive number"):
        rts.gradient_image(lambda p: rts.render(*card(p), SIZE), parameters_of("torch-cpu"), along, scale=scale)


def test_a_derivative_of_the_wrong_sign_differs_however_small_beside_others():
    slopes = [
        gradients.Slope("pose[0]", 6000.0, 6100.0, 5.0, 0.01),
        gradients.Slope("pose[1]", -600.0, 51.0, 23.0, 0.01),
    ]
    check = gradients.GradientCheck(slopes, 0.1)
    assert check.agrees(slopes[0]) and not check.agrees(slopes[1]) and not check.ok


def test_where_contributions_cancel_the_tolerance_is_relative_to_these():
    slopes = [gradients.Slope("pose[1]", -51.0, -29.0, 2.0, 0.01, size) for size in (500.0, 100.0)]
    assert [gradients.GradientCheck([slope], 0.1).ok for slope in slopes] == [True, False]


def test_contributions_are_those_of_blocks_of_pixels():
    """A square of 16 × 16 pixels that moves: 4, 8 and 4 of its rows lie in three rows of blocks, on either side."""
    camera = rts.Camera.orthographic((0, 0, 10), (0, 0, 0), height=24)
    corners = np.array([(-8.0, -8, 0), (8, -8, 0), (8, 8, 0), (-8, 8, 0)])

    def scene(shift):
        vertices = arrays_like(shift, corners) + shift * arrays_like(shift, [1.0, 0, 0])
        return rts.Part(MESH(FACES), {"vertices": vertices}, "silhouette"), camera

    start = parameters_of("torch-cpu")["shift"][:1] * 0
    [slope] = rts.check_gradient(scene, start, (24, 24), loss=lambda image: image[..., 3].sum()).slopes
    assert slope.difference == pytest.approx(0, abs=0.1)
    assert slope.contributions == pytest.approx(np.sqrt(2 * (16 + 64 + 16)), rel=0.02)


# ------------------------------------------------------------------------------------------- second derivatives

TURNED = 7.0 * np.array([(np.cos(a), np.sin(a), 0) for a in 0.3 + np.pi / 2 * np.arange(4)])
"""A square of side 7 √2, of area 98; a world unit is a pixel."""
CALIBRATED = rts.splatting.Multi(epsilon=1e-3, calibration=None)
LARGER = rts.Camera.orthographic((0, 0, 10), (0, 0, 0), height=20)


def square(shift):
    """A square that the parameters (3,) shift."""
    return rts.Part(MESH(FACES), {"vertices": arrays_like(shift, TURNED) + shift}, "silhouette"), LARGER


def checked(target, loss, **options):
    given = {
        "entries": 3,
        "samples": 2,
        "hessian": True,
        "budget_s": 600,
        "splatter": CALIBRATED,
        "layers": 2,
        **options,
    }
    return rts.check_gradient(square, arrays(target, np.array([0.1, 0.2, 0.0])), (20, 20), loss=loss, **given)


@pytest.mark.thorough
@pytest.mark.parametrize("target", TORCH)
def test_the_area_of_a_square_that_shifts_has_hessian_zero_where_weights_of_splats_are_curved(target):
    hessian = checked(target, lambda image: image[..., 3].sum()).hessian
    np.testing.assert_allclose(hessian.difference, 0, atol=1e-4)
    curvature = np.diag(hessian.autodiff)[:2] / (28 * np.sqrt(2))  # By perimeter.
    assert (curvature < -0.8).all() and (curvature > -1.1).all()
    np.testing.assert_array_equal(hessian.agreement, ~np.diag([True, True, False]))
    assert not hessian.ok
    rows = [line for line in str(hessian).splitlines() if line.endswith("differs")]
    assert [row.split()[0] for row in rows] == ["parameters[0]", "parameters[1]"] and "Gauss–Newton" in str(hessian)


@pytest.mark.thorough
def test_differences_of_gradients_are_right_to_a_hundredth():
    # The second derivative of the integral of (x + 1.3)² / 2 over a shape that shifts along x is its area.
    weights = arrays("torch-cpu", (np.arange(20) + 0.5 - 10 + 1.3) ** 2 / 2)
    hessian = checked("torch-cpu", lambda image: (image[..., 3] * weights).sum(), supersample=2).hessian
    expected = np.zeros((3, 3))
    expected[0, 0] = 98
    np.testing.assert_allclose(hessian.difference, expected, atol=0.98)
    assert np.abs(hessian.autodiff - expected).max() > 98


@pytest.mark.thorough
@pytest.mark.parametrize("target", TORCH)
def test_second_derivatives_in_colours_agree(target):
    """An image is linear in colours, so the sum of its squares has Hessian 2 Σ α² in each."""

    def scene(color):
        part = rts.Part(MESH(FACES), {"vertices": arrays_like(color, VERTICES), "color": color}, "unlit")
        return part, CAMERA

    color = arrays(target, np.array([0.8, 0.5, 0.2]))
    options = {"loss": lambda image: (image[..., :3] ** 2).sum(), "samples": 2, "budget_s": 600, "hessian": True}
    hessian = rts.check_gradient(scene, color, SIZE, **options).hessian
    alpha = to_numpy(rts.render(*scene(color), SIZE))[..., 3]
    assert hessian.ok and hessian.names == ["parameters[0]", "parameters[1]", "parameters[2]"]
    for found in hessian.autodiff, hessian.difference:
        np.testing.assert_allclose(found, 2 * (alpha**2).sum() * np.eye(3), rtol=2e-3, atol=0.05)
    values = hessian.eigenvalues(hessian.autodiff)
    np.testing.assert_allclose(values, 2 * (alpha**2).sum() * finite_difference_steps.STEP_COLOR**2, rtol=1e-3)


def test_without_asking_there_are_no_second_derivatives():
    assert rts.check_gradient(card, parameters_of("torch-cpu"), SIZE, entries=1, samples=1).hessian is None


def test_what_an_engine_cannot_differentiate_twice_is_refused_before_anything_is_measured():
    torch = pytest.importorskip("torch")

    class Once(torch.autograd.Function):
        @staticmethod
        def forward(ctx, x):
            return 2 * x

        @staticmethod
        def backward(ctx, g):
            return 2 * g

    with pytest.raises(rts.InputError, match="hessian=True: torch cannot differentiate this scene .* twice") as error:
        rts.check_gradient(lambda p: square(Once.apply(p)), torch.zeros(3), (20, 20), hessian=True, budget_s=1e-9)
    assert "\n" not in str(error.value)
    with pytest.raises(rts.InputError, match="hessian is 'yes'; expected True or False"):
        rts.check_gradient(square, torch.zeros(3), (20, 20), hessian="yes")
