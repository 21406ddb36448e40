"""Entries of θ that shaders read, refused where they are wrong."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from rts.arrays.array_functions import described, is_finite, shape_of
from rts.arrays.engines import namespace, value_of
from rts.arrays.trees import Array, Tree
from rts.contracts.checks import BRIGHTEST, check_bounded
from rts.errors import InputError


def entry_of(theta: Mapping[str, Tree], name: str, *shapes: tuple[int, ...]) -> Array:
    """An entry of θ, refused where it has none of these shapes."""
    value = theta[name]
    return check_entry(f"[{name!r}]", value, " or ".join(map(str, shapes)), shape_of(value) in shapes)


def check_entry(entry: str, value: Any, expected: str, ok: bool) -> Any:
    """An entry of θ, refused if it is no finite number or floating array; `ok` says that it has the expected shape.

    A whole number becomes a floating one.
    """
    number = isinstance(value, (bool, int, float))
    if not ok or not (number or hasattr(value, "dtype")):
        raise InputError(f"theta{entry} {described(value)}; expected an array of shape {expected}")
    if number:
        check_bounded(f"theta{entry}", np.asarray(value, float))
        return value
    array: Any = value
    xp = namespace(array)
    if array.shape == () and xp.isdtype(array.dtype, "integral"):
        array = xp.astype(array, xp.float32)
    if not xp.isdtype(array.dtype, "real floating"):
        raise InputError(f"theta{entry} has dtype {array.dtype}; expected floating numbers")
    check_bounded(f"theta{entry}", array)
    return array


def check_base(name: str, base: Array) -> None:
    """Refuse base colours (N, C) of `BRIGHTEST` or more; others that are not finite are refused with the result."""
    if not is_finite(base, below=BRIGHTEST):
        values = value_of(base)
        if values is not None and np.isfinite(values).all():
            raise InputError(f"{name} holds a number of {BRIGHTEST:g} or more; expected smaller colours")
