"""Tables of indices: copied, made read-only, and checked once, so that compiled loops can rely on them."""

from __future__ import annotations

import weakref
from typing import Any

import numpy as np

from rts.arrays.argument_checks import quoted
from rts.arrays.array_functions import shape_of
from rts.arrays.engines import value_of
from rts.arrays.trees import leaves
from rts.arrays.value_ranges import value_range
from rts.errors import EngineError, InputError


def index_table(name: str, table: Any, width: int) -> np.ndarray:
    """A copy (T, width) int32, read-only, of a table of indices that count from 0.

    Args:
        name: the name in error messages.
        table: (T, width) integers, T at least 1: an array of any engine, or a list of lists.
        width: the number of columns.

    Raises:
        InputError: another shape, no integers, numbers below 0 or from 2**31 on, or values that are traced.
    """
    array = _known(name, table)
    if array.dtype == object:
        raise InputError(f"{name} is {quoted(table)}; expected (T, {width}) integers")
    if array.ndim != 2 or array.shape[1] != width or not len(array):
        raise InputError(f"{name} has shape {array.shape}; expected (T, {width}) with at least one triangle")
    if not np.issubdtype(array.dtype, np.integer):
        raise InputError(f"{name} has dtype {array.dtype}; expected integers")
    if array.min() < 0:
        raise InputError(f"{name} holds the index {array.min()}; indices count from 0")
    if array.max() >= 2**31:
        raise InputError(f"{name} holds the index {array.max()}; expected less than 2**31")
    return fixed(array.astype(np.int32, order="C"))


def _known(name: str, table: Any) -> np.ndarray:
    """The values of a table, on the host; refused if they are traced or no array."""
    if not isinstance(table, np.ndarray) and any(isinstance(x, (str, bytes)) for x in leaves(table)):
        raise InputError(f"{name} is {quoted(table)}; expected an array of integers")
    if isinstance(table, (np.ndarray, list, tuple)) or shape_of(table) == ():
        try:
            return np.asarray(table)
        except ValueError:
            raise InputError(f"{name} has rows of different lengths; expected as many integers in each") from None
        except Exception as error:  # Such as a list of traced arrays.
            raise InputError(f"{name} is no table of known integers ({type(error).__name__})") from None
    try:
        values = value_of(table)
    except EngineError:
        raise InputError(f"{name} is {quoted(table)}; expected an array of integers") from None
    if values is None or values.shape != shape_of(table):
        raise InputError(
            f"{name} is traced, and topology must be known while Python runs; make the surface outside of jit and "
            f"vmap, or give it NumPy indices"
        )
    return values


def fixed(array: np.ndarray) -> np.ndarray:
    """The array itself, made read-only. It must own its memory."""
    array.flags.writeable = False
    return array


_extent: dict[int, tuple[weakref.ref, tuple[int, int]]] = {}


def table_extent(array: np.ndarray) -> tuple[int, int]:
    """Least and largest number in a non-empty table. A read-only table that owns its memory is searched only once."""
    kept = not array.flags.writeable and array.flags.owndata
    key = id(array)
    if kept and key in _extent and _extent[key][0]() is array:
        return _extent[key][1]
    bounds = value_range(array)
    if kept:
        _extent[key] = weakref.ref(array, lambda _: _extent.pop(key, None)), bounds
    return bounds
