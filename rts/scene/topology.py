"""Tables of indices: copied, fixed, and checked once, so that compiled code can rely on them."""

from __future__ import annotations

import weakref
from typing import Any

import numpy as np

from rts.arrays.argument_checks import quoted
from rts.arrays.array_functions import shape_of
from rts.arrays.engines import value_of
from rts.arrays.extremes import extent
from rts.arrays.trees import leaves
from rts.contracts.records import Cells
from rts.errors import EngineError, InputError


def index_table(name: str, table: Any, width: int) -> np.ndarray:
    """A copy (T, width) int32, read-only, of a table of indices that count from 0.

    Args:
        name: what an error calls it.
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
    """The values of a table, on the host."""
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
        known = value_of(table)
    except EngineError:
        raise InputError(f"{name} is {quoted(table)}; expected an array of integers") from None
    if known is None or known.shape != shape_of(table):
        raise InputError(
            f"{name} is traced, and topology must be known while Python runs; make the surface outside of jit and "
            f"vmap, or give it NumPy indices"
        )
    return known


def fixed(array: np.ndarray) -> np.ndarray:
    """The array itself, from now on read-only. It must own its memory."""
    array.flags.writeable = False
    return array


def pieces(faces: np.ndarray) -> np.ndarray:
    """Which triangles hang together and are wound alike: (T,) int16, numbers from 1 on, the largest piece first.

    Two triangles do where they are the only ones at an edge, and go along it in opposite directions. A piece with two
    triangles that go along their edge in the same direction, as in a Möbius strip, has no sides: its number is 0. So is
    that of pieces beyond those that have a number.

    Args:
        faces: (T, 3) integers.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    count = len(faces)
    start, end = faces.reshape(-1).astype(np.int64), np.roll(faces, -1, axis=1).reshape(-1).astype(np.int64)
    low, high = np.minimum(start, end), np.maximum(start, end)
    key = low * (int(high.max(initial=0)) + 1) + high
    order = np.argsort(key, kind="stable")
    key, along, triangle = key[order], (start < end)[order], order // 3
    first = np.flatnonzero(np.r_[True, key[1:] != key[:-1]]) if len(key) else np.zeros(0, np.int64)
    first = first[np.diff(np.r_[first, len(key)]) == 2]
    alike, pairs = along[first] != along[first + 1], (triangle[first], triangle[first + 1])
    joined = coo_array((alike[alike], tuple(p[alike] for p in pairs)), shape=(count, count))
    _, labels = connected_components(joined, directed=False)
    sizes = np.bincount(labels)
    number = np.empty(len(sizes), np.int64)
    number[np.argsort(-sizes, kind="stable")] = np.arange(1, len(sizes) + 1)
    number[number >= Cells.MORE_BEHIND] = 0
    twisted = labels[pairs[0]][~alike & (labels[pairs[0]] == labels[pairs[1]])]
    number[twisted] = 0
    return fixed(number[labels].astype(np.int16))


_extent: dict[int, tuple[weakref.ref, tuple[int, int]]] = {}


def table_extent(array: np.ndarray) -> tuple[int, int]:
    """The least and the largest number in a table that is not empty; of a fixed one it is looked for but once."""
    kept = not array.flags.writeable and array.flags.owndata
    key = id(array)
    if kept and key in _extent and _extent[key][0]() is array:
        return _extent[key][1]
    found = extent(array)
    if kept:
        _extent[key] = weakref.ref(array, lambda _: _extent.pop(key, None)), found
    return found
