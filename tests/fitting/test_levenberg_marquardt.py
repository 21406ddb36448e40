"""Levenberg–Marquardt: solutions known in closed form, what a step computes, and where it stops."""

import math

import numpy as np
import pytest
from helpers import DIFFERENTIABLE, arrays, to_numpy
from linear_problem import MATRIX, SOLUTION, joined, line

import rts
from rts.fitting.least_squares import _Model
from rts.fitting.normal_equations import Linearization

pytestmark = pytest.mark.fitting

targets = pytest.mark.parametrize("target", DIFFERENTIABLE)


def rosenbrock(p):
    """Its two residuals, by the arithmetic that every engine has."""
    return p[:1] * 0 + 1 - p[:1], 10 * (p[1:] - p[:1] ** 2)


def _torch():
    return pytest.importorskip("torch")


@targets
def test_lm_solves_linear_least_squares_in_a_few_steps(target):
    residuals, start = line(target)
    fit = rts.fit(residuals, start, method="lm", progress=False)
    np.testing.assert_allclose(to_numpy(fit.parameters), SOLUTION, atol=1e-6)
    assert fit.history[4] < 1e-9 * fit.history[0]


@targets
def test_lm_solves_an_overdetermined_system_to_its_normal_equations(target):
    goal = np.random.default_rng(1).normal(size=9)
    matrix, there = arrays(target, MATRIX), arrays(target, goal)
    fit = rts.fit(lambda p: matrix @ p - there, arrays(target, np.ones(3)), method="lm", tolerance=1e-9)
    np.testing.assert_allclose(to_numpy(fit.parameters), np.linalg.lstsq(MATRIX, goal)[0], atol=1e-4)


@targets
def test_lm_goes_through_the_valley_of_rosenbrock(target):
    start = arrays(target, np.array([-1.2, 1.0]))
    fit = rts.fit(lambda p: joined(target, rosenbrock(p)), start, method="lm", steps=100, tolerance=0)
    np.testing.assert_allclose(to_numpy(fit.parameters), [1, 1], atol=1e-4)
    assert fit.steps < 60
    assert any(after > before for before, after in zip(fit.history, fit.history[1:], strict=False)), "no trial rejected"


@targets
def test_lm_ignores_parameters_that_change_nothing_and_differences_of_scale(target):
    scales = arrays(target, np.array([1e-2, 1e3, 0.0]))
    start = arrays(target, {"far": np.array([0.0]), "near": np.array([0.0, 0.0, 7.0])})
    goal = arrays(target, np.array([1.0, 1.0, 0.0]))
    fit = rts.fit(
        lambda p: joined(target, [p["near"] * scales - goal, 1e-4 * p["far"] - 1]), start, method="lm", tolerance=0
    )
    np.testing.assert_allclose(to_numpy(fit.parameters["near"]), [1e2, 1e-3, 7], rtol=1e-4)
    np.testing.assert_allclose(to_numpy(fit.parameters["far"]), [1e4], rtol=1e-4)
    assert fit.reason.endswith("not determined: near[2]")


def test_lm_keeps_float64_and_mixed_dtypes():
    torch = _torch()
    start = {"a": torch.zeros(2, dtype=torch.float64), "b": torch.zeros(1)}
    fit = rts.fit(lambda p: torch.cat([p["a"] - 1, p["b"] - 2]), start, method="lm")
    assert fit.parameters["a"].dtype == torch.float64 and fit.parameters["b"].dtype == torch.float32


def test_no_jacobian_is_made_that_nobody_uses():
    torch = _torch()
    traced = []

    def residuals(p):
        traced.append(torch._C._functorch.is_functorch_wrapped_tensor(p))
        return torch.stack([p[0] - 1, 10 * (p[1] - p[0] ** 2)])

    start = torch.tensor([0.9, 0.9])
    rts.fit(residuals, start, method="lm", steps=1)
    assert traced == [True]
    traced.clear()
    rts.fit(residuals, start, method="lm", steps=2)
    assert traced == [True, False]


def test_residuals_are_computed_once_where_a_trial_is_accepted():
    torch = _torch()
    calls = []

    def residuals(p):
        derived = torch._C._functorch.is_functorch_wrapped_tensor(p)
        calls.append("linearised" if derived else "valued")
        return torch.stack([1 - p[0], 10 * (p[1] - p[0] ** 2)])

    fit = rts.fit(residuals, torch.tensor([-1.2, 1.0]), method="lm", steps=12, tolerance=0)
    best, expected = fit.history[0], ["linearised"]
    assert fit.steps == 12
    accepted, refused = True, 0
    for value in fit.history[1:-1]:
        after, accepted = accepted, value < best
        refused += not accepted
        expected.append("linearised" if after else "valued")
        if accepted and not after:
            expected.append("linearised")  # Its derivative was not known.
        best = min(best, value)
    assert refused > 0
    assert calls == [*expected, "valued"]  # After the last there is no step to make.


@targets
def test_lm_stops_where_steps_gain_little_or_nothing_can(target):
    residuals, start = line(target)
    assert "gained less than 0.5" in rts.fit(lambda p: residuals(p) ** 2 + 1, start, method="lm", tolerance=0.5).reason
    assert rts.fit(lambda p: p * 0 + 1, start, method="lm").reason.startswith("the gradient is exactly zero")
    # Away from the start the loss only rises, whatever the derivative says.
    walled = rts.fit(lambda p: p + 1000 * (p != 0) + 1, start, method="lm")
    assert walled.reason.startswith("no step lowers the loss, though the gradient promises it: the loss has jumps")
    assert walled.loss == 1
    np.testing.assert_array_equal(to_numpy(walled.parameters), np.zeros(3))


def test_no_step_goes_where_the_matrix_is_not_definite():
    model = _Model(Linearization(1.0, np.array([[1.0, 1.5], [1.5, 1.0]]), np.array([1.0, 0.0]), 1e-7), [2])
    step, predicted = model.step(1e-3)
    assert step[0] == pytest.approx(step[1]) and step[0] < 0 and predicted > 0


@targets
def test_lm_shuns_trials_that_are_not_finite(target):
    # The first trials overshoot to below zero, where a power is NaN.
    start = arrays(target, np.array([4.0]))
    fit = rts.fit(lambda p: p**0.1 - 0.5, start, method="lm", steps=100, tolerance=0)
    assert any(map(math.isnan, fit.history))
    np.testing.assert_allclose(to_numpy(fit.parameters), [0.5**10], rtol=1e-3)


def test_values_that_leave_torch_are_refused_in_one_line():
    torch = _torch()
    with pytest.raises(rts.InputError, match=r"use no values of arrays in Python or NumPy, or method=\"adam\""):
        rts.fit(lambda p: p + torch.from_numpy(p.detach().numpy()), torch.ones(3), method="lm", progress=False)
