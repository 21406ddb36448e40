"""Levenberg–Marquardt on the mean square of residuals."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from rts.engines import Engine, namespace
from rts.errors import InputError
from rts.fitting.run import Run, require
from rts.trees import Array, Tree, leaves, map_leaves

FIRST_DAMPING = 1e-3
LARGEST_DAMPING = 1e12


def mean_square(residuals: Array) -> Array:
    """The mean square: the default loss."""
    return namespace(residuals).mean(residuals * residuals)


class _Linear(NamedTuple):
    """What is known of the residuals around a point: their mean square, and the normal equations JᵀJ and Jᵀr over n."""

    value: float
    matrix: np.ndarray
    gradient: np.ndarray

    def checked(self, start: bool) -> _Linear:
        """Give itself back, or raise an error where it is not finite."""
        require(math.isfinite(self.value), f"the loss is {self.value}", start)
        require(bool(np.isfinite(self.matrix).all()), "the Jacobian is not finite", start)
        return self


def levenberg_marquardt(
    residuals: Callable, parameters: Tree, engine: Engine, run: Run, jit: bool, own: Callable | None = None
) -> None:
    """Minimise the mean square of residuals by normal equations.

    With Marquardt's scaling and Nielsen's control of the damping (Madsen et al. 2004).

    Args:
        residuals: a checked function of the parameters.
        parameters: where to start; a private copy.
        engine: the engine of the parameters.
        run: takes note of each step, and says when to stop.
        jit: whether to compile.
        own: the residuals' method `normal_equations`, where they have one; see `rts.Residuals`.
    """
    vector, unflatten = flatten(parameters)
    linearize, loss_at = _least_squares(residuals, own, parameters, engine, run, jit)
    here = linearize(vector).checked(start=True)
    going = run.record(unflatten(vector), here.value)
    damping, growth = FIRST_DAMPING, 2.0
    promising = True
    while going:
        if not (here.gradient.any() and here.matrix.any()):
            run.stop("the gradient is zero")
            return
        delta, predicted, damping = _damped_step(here.matrix, here.gradient, damping)
        trial = vector + engine.constant(delta, vector)
        # A trial after one that was accepted probably is, too: its normal equations come with its loss.
        there = linearize(trial) if promising and run.left > 1 else None
        trial_value = loss_at(trial) if there is None else there.value
        if not run.record(unflatten(trial), trial_value):
            return
        gain = here.value - trial_value
        promising = gain > 0  # False for a trial that is not finite, too.
        if not promising:
            damping, growth = damping * growth, growth * 2
            going = damping <= LARGEST_DAMPING or run.stop("no step lowers the loss")
        elif gain <= run.tolerance * here.value:
            going = run.stop(f"the last step gained less than {run.tolerance:g} of the loss")
        else:
            ratio = gain / max(predicted, gain)
            damping, growth = damping * max(1 / 3, 1 - (2 * ratio - 1) ** 3), 2.0
            vector = trial
            here = (there or linearize(vector)).checked(start=False)


def normal_equations(
    residuals: Callable[[Tree], Array], parameters: Tree, engine: Engine
) -> tuple[Array, Array, Array]:
    """Mean square of the n residuals, JᵀJ / n and Jᵀr / n, by the Jacobian; see `rts.Residuals`."""
    xp = engine.namespace
    vector, unflatten = flatten(parameters)
    r, rows = engine.jacobian(lambda v: xp.reshape(residuals(unflatten(v)), (-1,)))(vector)
    return xp.mean(r * r), rows @ xp.matrix_transpose(rows) / r.shape[0], rows @ r / r.shape[0]


def _least_squares(
    residuals: Callable, own: Callable | None, parameters: Tree, engine: Engine, run: Run, jit: bool
) -> tuple[Callable, Callable]:
    """Functions of a vector: mean square with normal equations JᵀJ and Jᵀr on the host, and mean square alone."""
    vector, unflatten = flatten(parameters)

    def equations(v: Array) -> tuple[Array, Array, Array]:
        if own is None:
            return normal_equations(residuals, unflatten(v), engine)
        return _checked_equations(own(unflatten(v)), v.shape[0], engine)

    def loss(v: Array) -> Array:
        return mean_square(residuals(unflatten(v)))

    if jit:
        equations, loss = engine.jit(equations), engine.jit(loss)

    def linearize(v: Array) -> _Linear:
        value, *rest = run.attempt(engine, equations, v)
        return _Linear(float(value), *(engine.to_numpy(x).astype(np.float64) for x in rest))

    return linearize, lambda v: float(run.attempt(engine, loss, v))


def _checked_equations(found: Any, count: int, engine: Engine) -> tuple[Array, Array, Array]:
    """The result of a user's `normal_equations`, refused where its form is another."""
    expected = (), (count, count), (count,)
    given: Any = tuple(found) if isinstance(found, (tuple, list)) else (found,)
    if not all(engine.owns(x) for x in given) or tuple(tuple(x.shape) for x in given) != expected:
        shapes = ", ".join(str(tuple(x.shape)) if engine.owns(x) else f"a {type(x).__name__}" for x in given)
        raise InputError(
            f"normal_equations gave {shapes}; expected {engine.name} arrays of shapes {', '.join(map(str, expected))}: "
            f"mean square, JᵀJ / n, Jᵀr / n"
        )
    return given


def _damped_step(matrix: np.ndarray, gradient: np.ndarray, damping: float) -> tuple[np.ndarray, float, float]:
    """The step, the gain that the linear model predicts of it, and the damping that it took."""
    from scipy.linalg import LinAlgError, cho_factor, cho_solve

    scale = np.sqrt(np.diag(matrix).clip(1e-12 * np.trace(matrix)))
    scaled, downhill = matrix / scale[:, None] / scale, -gradient / scale
    while True:
        try:
            step = cho_solve(cho_factor(scaled + damping * np.eye(len(scale))), downhill)
            return step / scale, float(step @ (damping * step + downhill)), damping
        except LinAlgError:  # Rounding left the matrix with a negative eigenvalue.
            damping *= 10


def flatten(parameters: Tree) -> tuple[Array, Callable[[Array], Tree]]:
    """All leaves as one vector, and the way back."""
    arrays = list(leaves(parameters))
    xp = namespace(*arrays)

    def unflatten(vector: Array) -> Tree:
        at = 0

        def take(x: Array) -> Array:
            nonlocal at
            count = math.prod(x.shape)
            piece = xp.reshape(vector[at : at + count], tuple(x.shape))
            at += count
            return xp.astype(piece, x.dtype, copy=False)

        return map_leaves(take, parameters)

    return xp.concat([xp.reshape(x, (-1,)) for x in arrays]), unflatten
