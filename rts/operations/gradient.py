"""The gradient of a function of points, such as the normal of an implicit surface."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from rts.arrays.argument_checks import quoted
from rts.arrays.array_functions import from_numbers, kind_of, shape_of
from rts.arrays.engines import engine_of, namespace
from rts.arrays.trees import Array
from rts.errors import InputError

STEP = 6e-6
"""The step of central differences, as a share of the largest coordinate: the cube root of float64's precision."""


def gradient(f: Callable[[Array], Array], points: Array) -> Array:
    """The gradient (N, 3) of a function of points, of which each value must depend on its own point alone.

    The gradient is differentiable in the points and in arrays that `f` closes over. For NumPy arrays, which have no
    derivatives, it is a central difference: `f` is called with float64, and the gradient has the dtype of the points.

    Args:
        f: points (N, 3) → (N,), in array code.
        points: (N, 3) float.

    Raises:
        InputError: `f` is no function, or returns another shape; or points are no floating array of two axes.
    """
    if not callable(f) or isinstance(f, type):
        raise InputError(f"f is {quoted(f)}; expected a function of points (N, 3)")
    points = from_numbers(points, "points")
    if len(shape_of(points)) != 2 or not namespace(points).isdtype(points.dtype, "real floating"):
        raise InputError(f"points is {kind_of(points)}; expected floating numbers (N, 3)")
    engine = engine_of(points)
    if not engine.differentiates:
        return _differences(f, points)

    def checked(points: Array) -> Array:
        value = f(points)
        _check(value, points)
        return value

    return engine.gradient_of_rows(checked, points)


def _differences(f: Callable[[Array], Array], points: np.ndarray) -> np.ndarray:
    """Central differences (N, C) of `f` at points (N, C): two calls of `f` for each of C columns."""
    wide = np.asarray(points, np.float64)
    step = STEP * (float(np.abs(wide).max(initial=0.0)) or 1.0)
    columns = []
    for move in step * np.eye(points.shape[1]):
        above, below = np.asarray(f(wide + move), np.float64), np.asarray(f(wide - move), np.float64)
        _check(above, points)
        columns.append((above - below) / (2 * step))
    return np.stack(columns, axis=-1).astype(points.dtype)


def _check(value: Array, points: Array) -> None:
    if tuple(value.shape) != (points.shape[0],):
        raise InputError(
            f"f gave shape {tuple(value.shape)} for {points.shape[0]} points; expected ({points.shape[0]},)"
        )
