"""Numbers and small arrays that callers give: refused by name, in one line, where they are of the wrong kind."""

from __future__ import annotations

from types import FunctionType
from typing import Any

import numpy as np

from rts.arrays.array_functions import kind_of, shape_of
from rts.arrays.engines import CONSTANT_TYPES, is_constant, namespace, value_of
from rts.arrays.trees import leaves
from rts.errors import InputError

Shape = tuple[int, ...]


def quoted(value: Any) -> str:
    """What an error shows of a value: one line, and not a long one."""
    shape = shape_of(value)
    if len(shape) > 1 or max(shape, default=0) > 4:
        return kind_of(value)
    text = " ".join(repr(value).split())
    if isinstance(value, FunctionType):  # Without where in memory it is.
        text = f"<function {value.__name__}>"
    return text if len(text) <= 60 else f"{text[:57]}..."


def one_line(error: Exception) -> str:
    """The message of an error that is not the library's, in one line, and not a long one."""
    text = " ".join(str(error).split()) or type(error).__name__
    return text if len(text) <= 120 else f"{text[:117]}..."


def check_numbers(name: str, value: Any, *shapes: Shape) -> np.ndarray | None:
    """Refuse what is not a finite real array, or list of numbers, of one of these shapes.

    Returns:
        The value, where it is known; None for what is traced, or of a batch.
    """
    expected = " or ".join("a number" if s == () else str(s) for s in shapes)
    wrong = InputError(f"{name} is {quoted(value)}; expected {'' if () in shapes else 'numbers of shape '}{expected}")
    if not all(isinstance(x, CONSTANT_TYPES) or hasattr(x, "dtype") for x in leaves(value)):
        raise wrong
    try:
        shape, dtype = _shape_and_dtype(value)
    except ValueError:  # Rows of different lengths.
        raise wrong from None
    if dtype == np.dtype(object):
        raise wrong
    if not namespace(value).isdtype(dtype, ("real floating", "integral")):
        raise InputError(f"{name} has dtype {dtype}; expected real numbers")
    if shape not in shapes:
        given = f"is {quoted(value)}" if shape == () else f"has shape {shape}"
        raise InputError(f"{name} {given}; expected {expected}")
    known = value_of(value)
    if known is not None and not np.isfinite(known).all():
        raise InputError(f"{name} is {quoted(known)}; expected finite numbers")
    return None if known is None or known.shape != shape else known


def _shape_and_dtype(value: Any) -> tuple[Shape, Any]:
    if is_constant(value):
        array = np.asarray(value)
        return array.shape, array.dtype
    if isinstance(value, (list, tuple)):  # Such as an eye of traced scalars.
        first = next(x for x in leaves(value) if not isinstance(x, CONSTANT_TYPES))
        return (len(value), *{shape_of(x) for x in value}.pop()), first.dtype
    return shape_of(value), value.dtype


def check_flag(name: str, value: Any) -> None:
    """Refuse what is neither True nor False."""
    if not isinstance(value, (bool, np.bool_)):
        raise InputError(f"{name} is {quoted(value)}; expected True or False")


def check_positive(name: str, value: Any, *shapes: Shape) -> np.ndarray | None:
    """Refuse what `check_numbers` does, and numbers of zero or less."""
    known = check_numbers(name, value, *(shapes or ((),)))
    if known is not None and not (known > 0).all():
        raise InputError(
            f"{name} is {quoted(value)}; expected {'a positive number' if not shapes else 'positive numbers'}"
        )
    return known


def check_planes(near: Any, far: Any, *, positive: bool) -> None:
    """Refuse near and far planes in the wrong order, where their values are known."""
    a, b = check_numbers("near", near, ()), check_numbers("far", far, ())
    if a is not None and b is not None and not a < b:
        raise InputError(f"near is {quoted(near)} and far is {quoted(far)}; expected finite numbers with near < far")
    if positive and a is not None and a <= 0:
        raise InputError(f"near is {quoted(near)}; a perspective camera needs near > 0")


def check_rotation(name: str, matrix: Any) -> None:
    """Refuse what is not a (3, 3) rotation, to about three digits."""
    known = check_numbers(name, matrix, (3, 3))
    if known is None:
        return
    off = float(np.abs(known @ known.T - np.eye(3)).max())
    if off > ROTATION_TOLERANCE or np.linalg.det(known) < 0:
        what = "mirrors" if off <= ROTATION_TOLERANCE else f"is off by {off:.2g} (its product with its transpose)"
        raise InputError(f"{name} {what}; expected a rotation: move scale to the points, and mirror the image instead")


ROTATION_TOLERANCE = 2e-3
"""How far R Rᵀ may be from the identity: rotations that are written with three digits are accepted."""


def is_invertible(matrix: np.ndarray) -> bool:
    """Whether a matrix has an inverse; lengths of its rows and columns do not matter."""
    for axis in (1, 0):
        length = np.linalg.norm(matrix, axis=axis, keepdims=True)
        matrix = matrix / np.where(length > 0, length, 1)
    singular = np.linalg.svd(matrix, compute_uv=False)
    return bool(singular[-1] > 1e-12 * singular[0])


def check_pixels(size: Any) -> tuple[int, int]:
    """(height, width) as integers, refused where they make no image."""
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
