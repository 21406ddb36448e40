"""Small functions of arrays of any engine: conversion, shapes in words, unit vectors, borders."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from rts.arrays.engines import CONSTANT_TYPES, OWNERS, engine_of, exemplar, is_constant, namespace, value_of
from rts.arrays.trees import STATIC_FIELDS, Array, Tree, leaves, map_leaves
from rts.arrays.value_ranges import largest_absolute
from rts.errors import EngineError, InputError


def from_numbers(tree: Tree, name: str = "an array") -> Tree:
    """The tree with leaves that the library can work with: arrays, Python's numbers, and None.

    A list or tuple of Python's numbers, nested or not, becomes a float32 array, unless it is empty or a named tuple.
    NumPy arrays of foreign byte order become native ones; half precision becomes float32, extended precision float64.
    Other arrays are not copied.

    Args:
        tree: nested dicts, lists, tuples and records.
        name: the name in error messages.

    Raises:
        InputError: a leaf is no array, is complex, or cannot be used, such as a sparse tensor; a list has rows of
            different lengths; or a key is no string.
        EngineError: a leaf is an array of an unknown framework.
    """
    kind = type(tree)
    if kind is np.ndarray:
        return tree if tree.dtype in _ORDINARY else _ordinary(tree, name)
    owner = OWNERS.get(kind)
    if owner is not None:
        return tree if owner.plain(tree) else owner.admitted(tree, name)
    if tree is None or kind in _NUMBERS:
        return tree
    if kind is dict or isinstance(tree, Mapping):
        entries = {}
        for key, value in tree.items():
            if not isinstance(key, str):
                raise InputError(f"{name} has the key {key!r}; expected names")
            owner = OWNERS.get(type(value))
            plain = type(value) is np.ndarray and value.dtype in _ORDINARY if owner is None else owner.plain(value)
            entries[key] = value if plain else from_numbers(value, f"{name}[{key!r}]")
        return entries
    if isinstance(tree, (list, tuple)):
        numbers = [isinstance(x, (bool, int, float)) for x in leaves(tree)]
        if numbers and all(numbers) and not hasattr(tree, "_fields"):
            try:
                return np.asarray(tree, np.float32)
            except (ValueError, OverflowError):
                what = " ".join(str(tree).split())[:60]
                raise InputError(f"{name} is {what}, whose rows have different lengths; expected an array") from None
        items = [from_numbers(x, f"{name}[{i}]") for i, x in enumerate(tree)]
        return kind(*items) if hasattr(tree, "_fields") else kind(items)
    if kind in STATIC_FIELDS:
        return map_leaves(lambda x: from_numbers(x, name), tree)
    if isinstance(tree, np.generic):
        return tree if tree.dtype in _ORDINARY else _ordinary(np.asarray(tree), name)
    if isinstance(tree, np.ndarray):
        return from_numbers(np.asarray(tree), name)
    try:
        engine = engine_of(tree)
    except EngineError as error:
        if _shape(tree) is not None:  # An array of some other framework.
            raise EngineError(f"{name} is not usable: {error}") from None
        what = " ".join(repr(tree).split())
        raise InputError(f"{name} is {what if len(what) <= 60 else kind_of(tree)}; expected an array") from None
    return engine.admitted(tree, name)


_NUMBERS = (bool, int, float)
_ORDINARY = frozenset(np.dtype(t) for t in "? b h i l q B H I L Q f d".split())


def _ordinary(array: np.ndarray, name: str) -> np.ndarray:
    """A copy of an array in a dtype of `_ORDINARY`; refused if it holds no real numbers."""
    dtype = array.dtype.newbyteorder("=")
    if dtype.kind == "f" and dtype not in _ORDINARY:
        dtype = np.dtype(np.float32 if dtype.itemsize < 4 else np.float64)
    if dtype not in _ORDINARY:
        raise InputError(f"{name} has dtype {array.dtype}; expected real numbers, such as float32")
    return array.astype(dtype)


def _shape(x: Any) -> Any:
    return getattr(x, "shape", None)


def shape_of(x: Any) -> tuple[int, ...]:
    """The shape of an array; () of anything else."""
    return tuple(getattr(x, "shape", None) or ())


def described(x: Any) -> str:
    """A predicate for error messages: "has shape (2, 3)" for an array, "is a str" for anything else."""
    return f"is a {type(x).__name__}" if _shape(x) is None else f"has shape {shape_of(x)}"


def kind_of(x: Any) -> str:
    """The type of a value, and an array's shape, for messages: "a torch.Tensor of shape (2, 3)", "a str", "None"."""
    if x is None:
        return "None"
    kind, shape = type(x), shape_of(x)
    name = kind.__qualname__ if kind.__module__ == "builtins" else f"{kind.__module__}.{kind.__qualname__}"
    return f"a {name}{f' of shape {shape}' if shape else ''}"


def promote(*values: Any) -> tuple[Any, list[Array]]:
    """The array-API namespace of the arguments, and the arguments as arrays of one engine.

    NumPy arrays, numbers and lists of numbers become float64 if all arguments are such. Beside torch or jax arrays
    they become floating constants like the widest of those, which stay as they are. A list of scalar arrays is stacked.
    """
    owner = OWNERS.get(type(values[0]))
    if owner is not None and len({*map(type, values)}) == 1:
        return owner.namespace, list(values)
    values_ = [
        np.asarray(v, dtype=np.float64) if isinstance(v, (list, tuple)) and is_constant(v) else v for v in values
    ]
    engine = engine_of(values_)
    if any(isinstance(v, (list, tuple)) for v in values_):
        # A list of traced scalars, such as a camera's eye computed from parameters.
        like = exemplar(values_)
        values_ = [
            namespace(like).stack([engine.constant(x, like) if is_constant(x) else x for x in v])
            if isinstance(v, (list, tuple))
            else v
            for v in values_
        ]
    like = exemplar(values_)
    arrays = [
        v if not isinstance(v, CONSTANT_TYPES) else engine.constant(np.asarray(v, dtype=np.float64), like)
        for v in values_
    ]
    return namespace(*arrays), arrays


def dot(a: Array, b: Array) -> Array:
    """Scalar products (…, 1) of short vectors (…, C)."""
    products = a * b
    engine = OWNERS.get(type(products)) or engine_of(a, b)
    if engine.differentiates:
        return engine.namespace.sum(products, axis=-1, keepdims=True)
    # NumPy takes ten times as long to sum along short axes.
    return sum(products[..., i : i + 1] for i in range(products.shape[-1]))


def without_border(image: Array, border: int) -> Array:
    """An image (H, W, C) without `border` rows and columns at each side."""
    height, width = image.shape[:2]
    return image[border : height - border, border : width - border, ...] if border else image


def is_finite(*arrays: Array, below: float = math.inf) -> bool:
    """True if no array holds NaN, infinity, or a number that is not `below` in size; traced arrays pass.

    Quick if it is true.
    """
    for x in arrays:
        engine = OWNERS.get(type(x)) or engine_of(x)
        values = engine.at_hand(x)
        if values is None and not engine.on_host(x):
            below_all = value_of(engine.namespace.all(abs(x) < below))
            if below_all is not None and not below_all.all():
                return False
        if values is None or not values.size:
            continue
        # Repeated values are checked once. Sums and products would start threads of their own, or overflow.
        if 0 in values.strides:
            values = values[tuple([slice(None) if step else slice(1) for step in values.strides])]
        if not largest_absolute(values) < below:
            return False
    return True


def averaged(image: Array, factor: int) -> Array:
    """An image (h, w, C) of (h · factor, w · factor, C): each pixel is the mean of `factor`² cells."""
    if factor == 1:
        return image
    # One axis after the other: over both at once, torch takes three times as long.
    xp, (height, width), channels = namespace(image), (n // factor for n in image.shape[:2]), image.shape[2]
    rows = xp.mean(xp.reshape(image, (height, factor, width * factor * channels)), axis=1)
    return xp.mean(xp.reshape(rows, (height, width, factor, channels)), axis=2)
