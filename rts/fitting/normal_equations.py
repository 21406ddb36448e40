"""Normal equations of residuals, in any engine: as functions of one vector of parameters."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from rts.arrays.engine_base import Engine
from rts.arrays.engines import namespace
from rts.arrays.trees import Array, Tree, leaves, map_leaves
from rts.errors import InputError
from rts.fitting.losses import SQUARE, Loss
from rts.fitting.run import Run, require
from rts.fitting.terms import Terms


class Linearization(NamedTuple):
    """Residuals r linearised at a point, on the host.

    Attributes:
        value: the mean loss of the n residuals.
        matrix: (U, U) float64, JᵀSJ / n for the Jacobian J; W and S are those of `Loss.weights`.
        gradient: (U,) float64, JᵀWr / n: half the gradient of the loss.
        rounding: the machine epsilon of the dtype that these were computed in.
    """

    value: float
    matrix: np.ndarray
    gradient: np.ndarray
    rounding: float

    def checked(self, start: bool) -> Linearization:
        """Give itself back, or raise the error of `require` if the loss or the matrix is not finite."""
        require(math.isfinite(self.value), f"the loss is {self.value}", start)
        require(bool(np.isfinite(self.matrix).all()), "the Jacobian is not finite", start)
        return self


def normal_equations(
    residuals: Callable[[Tree], Array], parameters: Tree, engine: Engine, loss: Loss = SQUARE
) -> tuple[Array, Array, Array]:
    """Normal equations of residuals by their whole Jacobian J, (n, U); see `Residuals.normal_equations`.

    Args:
        residuals: parameters → array of n residuals r, of any shape.
        parameters: the point, a tree of U numbers in arrays of the engine.
        engine: the engine, which has derivatives.
        loss: the loss of each residual.

    Returns:
        Mean loss (), JᵀSJ / n (U, U) and JᵀWr / n (U,), where W and S are diagonals of `loss.weights(r)`.
    """
    xp = engine.namespace
    vector, unflatten = flatten(parameters)
    r, rows = engine.jacobian(lambda v: xp.reshape(residuals(unflatten(v)), (-1,)))(vector)
    rows = xp.astype(rows, r.dtype, copy=False)  # torch may widen values of no axes under its transforms.
    value = loss(r)
    if loss.robust:
        weights, curvatures = loss.weights(r)
        root = xp.sqrt(curvatures)
        # A weight too small for the dtype is zero: the residual has no say, but for its loss.
        r, rows = xp.where(root > 0, weights / xp.where(root > 0, root, 1.0), 0.0) * r, root * rows
    return value, rows @ xp.matrix_transpose(rows) / r.shape[0], rows @ r / r.shape[0]


def least_squares_functions(
    terms: Terms, loss: Loss, own_equations: bool, parameters: Tree, engine: Engine, run: Run, jit: bool
) -> tuple[Callable, Callable]:
    """Two functions of a vector (U,) of parameters: to a `Linearization`, on the host; and to the loss alone, a float.

    All terms are computed, and their mean is taken; for the arguments see `levenberg_marquardt`.
    """
    vector, unflatten = flatten(parameters)

    def equations(v: Array, data: Tree) -> tuple[Array, Array, Array]:
        if own_equations:
            return _checked_equations(terms.unchecked(data).normal_equations(unflatten(v)), v.shape[0], engine)
        return normal_equations(terms.of(data), unflatten(v), engine, loss)

    def value_at(v: Array, data: Tree) -> tuple[Array]:
        return (loss(terms.of(data)(unflatten(v))),)

    if jit:
        equations, value_at = engine.jit(equations), engine.jit(value_at)

    def mean(compute: Callable, v: Array) -> list[Array]:
        return terms.mean(lambda key: run.attempt(engine, lambda: compute(v, terms.load(key))), None)

    def linearize(v: Array) -> Linearization:
        value, *rest = mean(equations, v)
        rounding = float(engine.namespace.finfo(rest[0].dtype).eps)
        matrix, gradient = (engine.to_numpy(x).astype(np.float64) for x in rest)
        return Linearization(float(value), matrix, gradient, rounding)

    return linearize, lambda v: float(mean(value_at, v)[0])


def _checked_equations(result: Any, count: int, engine: Engine) -> tuple[Array, Array, Array]:
    """The result of a user's `normal_equations`, refused unless it is arrays of the engine, of the right shapes."""
    expected = (), (count, count), (count,)
    equations: Any = tuple(result) if isinstance(result, (tuple, list)) else (result,)
    if not all(engine.owns(x) for x in equations) or tuple(tuple(x.shape) for x in equations) != expected:
        shapes = ", ".join(str(tuple(x.shape)) if engine.owns(x) else f"a {type(x).__name__}" for x in equations)
        raise InputError(
            f"normal_equations gave {shapes}; expected {engine.name} arrays of shapes {', '.join(map(str, expected))}: "
            f"mean loss, JᵀSJ / n, JᵀWr / n"
        )
    return equations


def flatten(parameters: Tree) -> tuple[Array, Callable[[Array], Tree]]:
    """All leaves, in order, as one vector (U,), and the function that makes a tree like `parameters` of such a vector.

    The tree has the shapes and dtypes of `parameters`. The vector has the dtype that the engine promotes these to.
    """
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
