"""Checks of numbers and small arrays that callers give; errors name the argument in one line."""

from __future__ import annotations

from collections.abc import Mapping
from types import FunctionType
from typing import Any

import numpy as np

from rts.arrays.array_functions import kind_of, shape_of
from rts.arrays.engines import CONSTANT_TYPES, is_constant, namespace, value_of
from rts.arrays.trees import leaves
from rts.errors import InputError

Shape = tuple[int, ...]


def quoted(value: Any) -> str:
    """A value for an error message, in one line: its repr, cut to 60 characters, or the name of a function.

    An array of several axes, or of more than 4 numbers, is told by its type and shape instead.
    """
    shape = shape_of(value)
    if len(shape) > 1 or max(shape, default=0) > 4:
        return kind_of(value)
    text = " ".join(repr(value).split())
    if isinstance(value, FunctionType):  # Its repr shows an address in memory.
        text = f"<function {value.__name__}>"
    return text if len(text) <= 60 else f"{text[:57]}..."


def in_short(tree: Any) -> str:
    """A tree as its repr, but for arrays, which are told by dtype and shape: "{'vertices': float32 (8, 3)}"."""
    if isinstance(tree, Mapping):
        return "{" + ", ".join(f"{key!r}: {in_short(value)}" for key, value in tree.items()) + "}"
    if isinstance(tree, (list, tuple)):
        return "[" + ", ".join(map(in_short, tree)) + "]"
    shape, dtype = shape_of(tree), getattr(tree, "dtype", None)
    return f"{str(dtype).removeprefix('torch.')} {shape}" if shape and dtype is not None else quoted(tree)


def one_line(error: Exception) -> str:
    """The message of a foreign error, or its type if it has none, in one line of at most 120 characters."""
    text = " ".join(str(error).split()) or type(error).__name__
    return text if len(text) <= 120 else f"{text[:117]}..."


def check_numbers(name: str, value: Any, *shapes: Shape) -> np.ndarray | None:
    """Raise an `InputError` unless a value is a finite real array, or list of numbers, of one of these shapes.

    The shape () is that of a number. Of traced values only shape and dtype are checked.

    Returns:
        The value as NumPy; None if it is traced, or batched by `vmap`.
    """
    found = _shape_and_dtype(value)
    if found is None:
        what = _either(shapes) if () in shapes else f"numbers of shape {_either(shapes)}"
        raise InputError(f"{name} is {quoted(value)}; expected {what}")
    shape, dtype = found
    if not namespace(value).isdtype(dtype, ("real floating", "integral")):
        raise InputError(f"{name} has dtype {dtype}; expected real numbers")
    if shape not in shapes:
        fault = f"is {quoted(value)}" if shape == () else f"has shape {shape}"
        raise InputError(f"{name} {fault}; expected {_either(shapes)}")
    array = value_of(value)
    if array is not None and not np.isfinite(array).all():
        raise InputError(f"{name} is {quoted(array)}; expected finite numbers")
    return None if array is None or array.shape != shape else array


def _either(shapes: tuple[Shape, ...]) -> str:
    return " or ".join("a number" if s == () else str(s) for s in shapes)


def _shape_and_dtype(value: Any) -> tuple[Shape, Any] | None:
    """The shape and dtype of an array, number or list of numbers; None for anything else."""
    if not all(isinstance(x, CONSTANT_TYPES) or hasattr(x, "dtype") for x in leaves(value)):
        return None
    try:
        if is_constant(value):
            array = np.asarray(value)
            shape, dtype = array.shape, array.dtype
        elif isinstance(value, (list, tuple)):  # For example a camera's eye of traced scalars.
            first = next(x for x in leaves(value) if not isinstance(x, CONSTANT_TYPES))
            shape, dtype = (len(value), *{shape_of(x) for x in value}.pop()), first.dtype
        else:
            shape, dtype = shape_of(value), value.dtype
    except ValueError:  # Rows of different lengths.
        return None
    return None if dtype == np.dtype(object) else (shape, dtype)


def check_flag(name: str, value: Any) -> None:
    """Refuse anything but True and False, Python's or NumPy's."""
    if not isinstance(value, (bool, np.bool_)):
        raise InputError(f"{name} is {quoted(value)}; expected True or False")


def check_positive(name: str, value: Any, *shapes: Shape) -> np.ndarray | None:
    """`check_numbers` that also refuses numbers of zero or less; without shapes, a single number is expected."""
    array = check_numbers(name, value, *(shapes or ((),)))
    if array is not None and not (array > 0).all():
        raise InputError(
            f"{name} is {quoted(value)}; expected {'a positive number' if not shapes else 'positive numbers'}"
        )
    return array


def check_planes(near: Any, far: Any, *, positive: bool) -> None:
    """Refuse depths of planes unless both are finite numbers with near < far, and near > 0 if `positive`.

    Traced depths pass.
    """
    a, b = check_numbers("near", near, ()), check_numbers("far", far, ())
    if a is not None and b is not None and not a < b:
        raise InputError(f"near is {quoted(near)} and far is {quoted(far)}; expected finite numbers with near < far")
    if positive and a is not None and a <= 0:
        raise InputError(f"near is {quoted(near)}; a perspective camera needs near > 0")


def check_rotation(name: str, matrix: Any) -> None:
    """Refuse anything but a (3, 3) rotation, within `ROTATION_TOLERANCE`; traced (3, 3) matrices pass."""
    rotation = check_numbers(name, matrix, (3, 3))
    if rotation is None:
        return
    off = float(np.abs(rotation @ rotation.T - np.eye(3)).max())
    if off > ROTATION_TOLERANCE or np.linalg.det(rotation) < 0:
        what = "mirrors" if off <= ROTATION_TOLERANCE else f"is off by {off:.2g} (its product with its transpose)"
        raise InputError(f"{name} {what}; expected a rotation: move scale to the points, and mirror the image instead")


ROTATION_TOLERANCE = 2e-3
"""Largest accepted difference of an entry of R Rᵀ from the identity's: rotations written with three digits pass."""


def is_invertible(matrix: np.ndarray) -> bool:
    """True if the singular values of a matrix, its rows and then columns scaled to length one, are within 1e12 : 1."""
    for axis in (1, 0):
        length = np.linalg.norm(matrix, axis=axis, keepdims=True)
        matrix = matrix / np.where(length > 0, length, 1)
    singular = np.linalg.svd(matrix, compute_uv=False)
    return bool(singular[-1] > 1e-12 * singular[0])


def check_pixels(size: Any) -> tuple[int, int]:
    """The size (height, width) as Python integers; refused unless it holds two positive whole numbers."""
    if type(size) is tuple and len(size) == 2 and type(size[0]) is int is type(size[1]) and min(size) > 0:
        return size
    try:
        height, width = (int(s) for s in size if not isinstance(size, (set, frozenset, dict)))
        whole = (height, width) == tuple(size)
    except (TypeError, ValueError, OverflowError):
        height, width, whole = 0, 0, False
    if not whole or height <= 0 or width <= 0:
        raise InputError(f"size is {quoted(size)}; expected (height, width), two positive integers")
    return height, width
