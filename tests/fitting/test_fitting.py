import math

import numpy as np
import pytest
from helpers import DIFFERENTIABLE, arrays, crooked_box, mesh_part, refused, to_numpy
from linear_problem import MATRIX, SOLUTION, joined, line

import rts
from rts.errors import InputError, PluginError

pytestmark = pytest.mark.fitting

targets = pytest.mark.parametrize("target", DIFFERENTIABLE)


def _torch():
    return pytest.importorskip("torch")


# ------------------------------------------------------------------------------------------------ solutions


@targets
@pytest.mark.parametrize(("method", "options"), [("adam", {"learning_rate": 0.1}), ("sgd", {"learning_rate": 0.4})])
def test_descent_finds_the_minimum_of_a_quadratic(target, method, options):
    residuals, start = line(target)
    fit = rts.fit(residuals, start, method=method, steps=600, **options)
    np.testing.assert_allclose(to_numpy(fit.parameters), SOLUTION, atol=2e-3)


@targets
def test_sgd_makes_the_step_of_the_book(target):
    seen = []
    start = arrays(target, np.array([1.0, -3.0]))
    rts.fit(lambda p: p, start, method="sgd", steps=3, learning_rate=0.1, callback=lambda k, p, v: seen.append(p))
    # The gradient of the mean square of two numbers is the numbers.
    np.testing.assert_allclose([to_numpy(p) for p in seen], [[1, -3], [0.9, -2.7], [0.81, -2.43]], rtol=1e-6)


@targets
@pytest.mark.parametrize("method", ["adam", "sgd", "lm"])
def test_parameters_may_be_nested(target, method):
    start = arrays(target, {"b": [np.zeros((2, 2)), np.array(1.0)], "a": (np.full(3, 2.0),)})

    def residuals(p):
        (first,), (second, third) = p["a"], p["b"]
        return joined(target, [(first - 1) * third, second.reshape(4) + 2])

    fit = rts.fit(residuals, start, method=method, steps=400, learning_rate=0.3 if method != "lm" else None)
    assert fit.loss < 1e-5
    assert set(fit.parameters) == {"a", "b"}
    assert isinstance(fit.parameters["a"], tuple) and isinstance(fit.parameters["b"], list)
    assert tuple(fit.parameters["b"][1].shape) == ()
    np.testing.assert_allclose(to_numpy(fit.parameters["b"][0]), np.full((2, 2), -2), atol=1e-2)


@targets
def test_a_loss_of_ones_own(target):
    start = arrays(target, np.array([3.0]))
    goal = arrays(target, np.array([[0.0], [0.1], [10.0]]))
    fit = rts.fit(lambda p: p - goal, start, loss=lambda r: abs(r).sum(), steps=300, learning_rate=0.05)
    np.testing.assert_allclose(to_numpy(fit.parameters), [0.1], atol=0.05)  # The median.


@pytest.mark.parametrize("method", ["adam", "lm"])
def test_the_start_is_neither_changed_nor_followed(method):
    torch = _torch()
    start = torch.ones(2, requires_grad=True)
    fit = rts.fit(lambda p: p * p + 1, start * 2, method=method, steps=1)
    assert not fit.parameters.requires_grad
    with torch.no_grad():
        start += 5
    np.testing.assert_array_equal(fit.parameters, [2, 2])
    rts.fit(lambda p: p, start, method=method, steps=3)
    np.testing.assert_array_equal(start.detach(), [6, 6])


# -------------------------------------------------------------------------------------------------- stopping


@targets
@pytest.mark.parametrize("method", ["adam", "sgd", "lm"])
def test_steps_history_and_best(target, method):
    calls = []
    residuals, start = line(target)
    options = {} if method == "lm" else {"learning_rate": 0.2}
    fit = rts.fit(residuals, start, method=method, steps=3, callback=lambda *a: calls.append(a), **options)
    assert fit.steps == len(fit.history) == 3
    assert fit.reason == "all 3 steps made"
    assert [step for step, _, _ in calls] == [0, 1, 2]
    assert [loss for _, _, loss in calls] == fit.history
    assert fit.history[0] == pytest.approx(np.mean((MATRIX @ SOLUTION) ** 2), rel=1e-5)
    np.testing.assert_array_equal(to_numpy(calls[0][1]), np.zeros(3))
    best = int(np.argmin(fit.history))
    assert fit.loss == fit.history[best]
    np.testing.assert_array_equal(to_numpy(fit.parameters), to_numpy(calls[best][1]))
    assert fit.seconds > 0


@targets
def test_the_best_is_kept_when_descent_overshoots(target):
    start = arrays(target, np.array([1.0]))
    fit = rts.fit(lambda p: p, start, method="sgd", steps=5, learning_rate=1.5)  # p, −2p, 4p, …
    np.testing.assert_allclose(fit.history, [1, 4, 16, 64, 256])
    assert fit.loss == 1
    np.testing.assert_array_equal(to_numpy(fit.parameters), [1])


@targets
@pytest.mark.parametrize("method", ["adam", "sgd", "lm"])
@pytest.mark.parametrize("last", [0, 2])
def test_a_callback_stops_and_its_reason_stays(target, method, last):
    residuals, start = line(target)
    # The tolerance would stop Levenberg–Marquardt in the same step.
    options = {"tolerance": 10.0} if method == "lm" and last == 0 else {}
    fit = rts.fit(residuals, start, method=method, callback=lambda step, p, loss: step == last, **options)
    assert fit.reason == "the callback asked to"
    assert fit.steps == last + 1


def test_an_error_of_the_callback_is_its_own():
    def report(step, parameters, loss):
        if step == 2:
            raise InputError("cannot write")

    for method in ("adam", "lm"):
        with pytest.raises(InputError, match="cannot write"):
            rts.fit(lambda p: p**3 - 1, _torch().ones(1) * 3, method=method, callback=report)


@targets
def test_patience(target):
    start = arrays(target, np.array([1.0]))
    flat = rts.fit(lambda p: p * 0 + 1, start, steps=100, patience=7)
    assert flat.steps == 8 and flat.reason.startswith("no gain in 7 steps: the gradient is exactly zero")
    # Two steps gain less than a fifth.
    slow = rts.fit(lambda p: p, start, method="sgd", learning_rate=0.02, steps=100, patience=2, tolerance=0.3)
    assert slow.steps == 3
    assert rts.fit(lambda p: p, start, method="sgd", learning_rate=0.02, steps=100, patience=2).steps == 100


@targets
def test_patience_with_a_negative_loss(target):
    start = arrays(target, np.array([1.0]))
    fit = rts.fit(lambda p: p * 0, start, loss=lambda r: r.sum() - 1, steps=100, patience=5)
    assert fit.steps == 6


# ----------------------------------------------------------------------------------------------- going astray


@targets
def test_descent_that_diverges_keeps_the_best(target):
    start = arrays(target, np.array([2.0]))
    fit = rts.fit(lambda p: p**4 - 1, start, method="sgd", learning_rate=0.1)
    assert "the loss is" in fit.reason and "too far" in fit.reason
    assert all(map(math.isfinite, fit.history)) and fit.loss == min(fit.history) == fit.history[0]
    np.testing.assert_array_equal(to_numpy(fit.parameters), [2])


@targets
@pytest.mark.parametrize("method", ["adam", "lm"])
def test_what_is_not_finite_at_the_start_is_an_error(target, method):
    start = arrays(target, np.array([0.0]))
    with pytest.raises(InputError, match="the loss is nan at the start"):
        rts.fit(lambda p: p + math.nan, start, method=method)
    what = "Jacobian" if method == "lm" else "gradient"
    with pytest.raises(InputError, match=f"the {what} is not finite at the start"):
        rts.fit(lambda p: p**0.5 + 1, start, method=method)


@targets
@pytest.mark.parametrize("method", ["sgd", "lm"])
def test_a_derivative_that_is_not_finite_later_stops(target, method):
    # Below a half the root of zero has no derivative.
    start = arrays(target, np.array([1.0]))
    fit = rts.fit(lambda p: p + (abs(p - 0.5) + (p - 0.5)) ** 0.5, start, method=method)
    assert fit.reason.startswith(f"the {'Jacobian' if method == 'lm' else 'gradient'} is not finite; ")
    assert fit.loss == fit.history[-1] < 0.25
    assert abs(to_numpy(fit.parameters)[0]) < 0.5


def host(target, fn, x):
    """A host function of the library in a trace or out of it, as samplers are."""
    from rts.arrays.engines import engine_of
    from rts.contracts.records import ArraySpec

    return engine_of(x).call_host(fn, (ArraySpec((1,), np.float32),), x)[0]


@targets
@pytest.mark.parametrize("jit", [True, False])
@pytest.mark.parametrize("method", ["sgd", "lm"])
def test_an_input_error_later_stops_and_at_the_start_is_raised(target, jit, method):
    def refuse(x):
        if abs(float(x[0])) < 0.7:
            raise InputError("the vertices went away")
        return (np.zeros(1, np.float32),)

    def residuals(p):
        return p * p + host(target, refuse, p)

    fit = rts.fit(
        residuals,
        arrays(target, np.array([2.0])),
        method=method,
        learning_rate=0.01 if method == "sgd" else None,
        jit=jit,
    )
    assert fit.reason == "the vertices went away"
    assert fit.steps >= 2 and fit.loss == min(fit.history) < fit.history[0]
    assert 0.7 <= to_numpy(fit.parameters)[0] < 2
    with pytest.raises(InputError, match="^the vertices went away"):
        rts.fit(residuals, arrays(target, np.array([0.5])), method=method, jit=jit)


@targets
def test_other_errors_are_never_kept_quiet(target):
    def residuals(error):
        def fail(x):
            if float(x[0]) < 1:
                raise error
            return (np.zeros(1, np.float32),)

        return lambda p: p + host(target, fail, p)

    start = arrays(target, np.array([2.0]))
    with pytest.raises(PluginError, match="no driver"):
        rts.fit(residuals(PluginError("no driver")), start, method="sgd", learning_rate=0.3)
    with pytest.raises(Exception, match="a bug") as caught:
        rts.fit(residuals(ZeroDivisionError("a bug")), start, method="sgd", learning_rate=0.3)
    assert not isinstance(caught.value, rts.RtsError)


def test_an_older_error_is_not_taken_for_a_new_one():
    jax = pytest.importorskip("jax")

    def refuse(x):
        raise InputError("old")

    with pytest.raises(jax.errors.JaxRuntimeError, match="old"):
        jax.block_until_ready(jax.jit(lambda x: host("jax", refuse, x))(jax.numpy.ones(1)))
    with pytest.raises(ZeroDivisionError):
        rts.fit(lambda p: 1 / 0, jax.numpy.ones(1))


# -------------------------------------------------------------------------------------------------- arguments


@targets
@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ({"method": "newton"}, "method is 'newton'; expected one of adam, sgd, lm"),
        ({"steps": 0}, "steps is 0; expected a whole number"),
        ({"steps": True}, "steps is True"),
        ({"steps": 2.5}, "steps is 2.5"),
        ({"learning_rate": 0}, "learning_rate is 0; expected a positive number"),
        ({"learning_rate": -1.0}, "learning_rate is -1.0"),
        ({"learning_rate": math.inf}, "learning_rate is inf"),
        ({"learning_rate": math.nan}, "learning_rate is nan"),
        ({"learning_rate": "fast"}, "learning_rate is 'fast'"),
        ({"tolerance": -1e-3}, "tolerance is -0.001"),
        ({"tolerance": math.nan}, "tolerance is nan"),
        ({"tolerance": None}, "tolerance is None"),
        ({"patience": 0}, "patience is 0"),
        ({"method": "lm", "loss": lambda r: r.sum()}, "takes no loss but an rts.Loss"),
        ({"callback": "print"}, "callback is 'print'; expected a function of step, parameters and loss, or None"),
    ],
)
def test_wrong_options(target, options, expected):
    with refused(expected):
        rts.fit(lambda p: p, arrays(target, np.ones(3)), **options)


@targets
@pytest.mark.parametrize("method", ["adam", "lm"])
@pytest.mark.parametrize(
    ("result", "expected"),
    [
        (lambda p: None, "residuals gave None; expected one"),
        (lambda p: [p, p], "residuals gave a list"),
        (lambda p: 1.0, "residuals gave a float"),
        (lambda p: np.ones(3), "residuals gave a numpy.ndarray"),
        (lambda p: p > 0, "dtype .*bool; expected floats"),
        (lambda p: p[:0], r"shape \(0,\)"),
    ],
)
def test_residuals_that_are_none(target, method, result, expected):
    with refused(expected):
        rts.fit(result, arrays(target, np.ones(3)), method=method)


def test_residuals_of_another_engine_or_of_none():
    with pytest.raises(InputError, match="residuals is 'mask.png'; expected a function of the parameters"):
        rts.fit("mask.png", _torch().ones(2))
    torch, jax = _torch(), pytest.importorskip("jax")
    with pytest.raises(InputError, match="expected one torch array"):
        rts.fit(lambda p: jax.numpy.ones(2), torch.ones(2))
    with pytest.raises(InputError, match="residuals gave a torch.Tensor of shape .2,.; expected one jax array"):
        rts.fit(lambda p: torch.ones(2), jax.numpy.ones(2))


@targets
def test_parameters_that_cannot_be_optimised(target):
    for wrong in (np.ones(3), 1.0, [], {}, None, {"a": arrays(target, np.ones(3)), "b": np.ones(2)}):
        with pytest.raises(InputError, match="expected torch or jax arrays"):
            rts.fit(lambda p: p, wrong)
    with pytest.raises(InputError, match="dtype .*int"):
        rts.fit(lambda p: p, {"a": arrays(target, np.ones(3, np.int32))})
    for wrong, kind in (
        ("pose", "a str"),
        ({1, 2}, "a set"),
        (object(), "a object"),
        ([b"x"], "a bytes"),
        (1j, "a comp"),
    ):
        with pytest.raises(InputError, match=f"parameters holds {kind}.*; expected torch or jax arrays to optimise"):
            rts.fit(lambda p: p, wrong)


def test_the_progress_bar(capsys):
    rts.fit(lambda p: p, _torch().ones(2), steps=3, progress=True)
    assert "loss" in (shown := capsys.readouterr().err) and "ms/iteration" in shown and "3/3" in shown
    rts.fit(lambda p: p, _torch().ones(2), steps=3)
    assert capsys.readouterr().err == ""


# ---------------------------------------------------------------------------------------------- silhouettes

SIZE = (40, 40)
POSE = np.array([0.12, -0.18, 0.1, 0.06, -0.05, 0.08], np.float32)


def silhouette_residuals(target, splatter):
    camera = rts.Camera.look_at((0.9, 0.8, 2.2), (0, 0, 0), fov_y=40)
    part = mesh_part(crooked_box())

    def silhouette(pose):
        moved = part.replace(transform=rts.rigid(pose))
        return rts.render(moved, camera, SIZE, layers=1, splatter=splatter)[..., 3]

    goal = arrays(target, silhouette(POSE.astype(np.float64)))
    return lambda pose: silhouette(pose) - goal


@pytest.mark.parametrize(
    ("target", "method", "options"),
    [("torch-cpu", "lm", {}), ("torch-cpu", "adam", {"steps": 250, "learning_rate": 0.01}), ("jax", "lm", {})],
)
def test_a_pose_is_recovered_from_a_silhouette(target, method, options):
    residuals, start = silhouette_residuals(target, "single"), arrays(target, np.zeros(6))
    fit = rts.fit(residuals, start, method=method, **options)
    assert fit.loss < fit.history[0] / 50
    np.testing.assert_allclose(to_numpy(fit.parameters), POSE, atol=0.03)


@pytest.mark.parametrize("method", ["lm", "adam"])
def test_plain_rasterization_moves_nothing(method):
    residuals, start = silhouette_residuals("torch-cpu", "none"), arrays("torch-cpu", np.zeros(6))
    fit = rts.fit(residuals, start, method=method, steps=60)
    np.testing.assert_array_equal(fit.parameters, start)
    assert fit.loss == fit.history[0]
    assert fit.reason.startswith("" if method == "lm" else "no gain in 50 steps: ")
    assert fit.reason.endswith('is the object in view, and the splatter other than "none"?')


@targets
def test_vertices_that_become_nan_stop_the_fit(target):
    residuals = silhouette_residuals(target, "single")
    start = arrays(target, np.zeros(6))
    fit = rts.fit(lambda pose: residuals(pose / (pose == 0)), start, method="sgd", steps=4)
    assert "NaN" in fit.reason and fit.steps == 1
    np.testing.assert_array_equal(to_numpy(fit.parameters), np.zeros(6))
