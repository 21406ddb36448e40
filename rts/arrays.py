"""Small functions of arrays of any engine: numbers made arrays, shapes in words, unit vectors, borders."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from rts.engines import CONSTANT_TYPES, OWNERS, engine_of, exemplar, is_constant, namespace
from rts.errors import InputError
from rts.trees import Array, Tree, is_named, leaves


def from_numbers(tree: Tree) -> Tree:
    """A copy of a tree in which every list or tuple that holds only numbers, nested or not, is a float32 array."""
    if type(tree) is np.ndarray or type(tree) in OWNERS:
        return tree
    if isinstance(tree, Mapping):
        found = {}
        for key, value in tree.items():
            found[key] = value if type(value) is np.ndarray or type(value) in OWNERS else from_numbers(value)
        return found
    if isinstance(tree, (list, tuple)) and not is_named(tree):
        if tree and all(isinstance(x, (bool, int, float)) for x in leaves(tree)):
            try:
                return np.asarray(tree, np.float32)
            except ValueError:
                raise InputError(f"a list of numbers has rows of different lengths: {str(tree)[:60]}") from None
        return type(tree)(from_numbers(x) for x in tree)
    return tree


def _shape(x: Any) -> Any:
    return getattr(x, "shape", None)


def shape_of(x: Any) -> tuple[int, ...]:
    """The shape of an array; () of anything else."""
    return tuple(_shape(x) or ())


def described(x: Any) -> str:
    """What an error says of a value: "has shape (2, 3)" of an array, what it is of anything else."""
    return f"is a {type(x).__name__}" if _shape(x) is None else f"has shape {shape_of(x)}"


def kind_of(x: Any) -> str:
    """What an error calls a value that it did not expect: "a torch.Tensor of shape (2, 3)", "a str", "None"."""
    if x is None:
        return "None"
    kind, shape = type(x), shape_of(x)
    name = kind.__qualname__ if kind.__module__ == "builtins" else f"{kind.__module__}.{kind.__qualname__}"
    return f"a {name}{f' of shape {shape}' if shape else ''}"


def promote(*values: Any) -> tuple[Any, list[Array]]:
    """Namespace and arrays: the arguments of a call, numbers and lists included, as floating arrays of one engine.

    Where all are NumPy or numbers the result is float64.
    """
    owner = OWNERS.get(type(values[0]))
    if owner is not None:
        for v in values:
            if OWNERS.get(type(v)) is not owner:
                break
        else:
            return owner.namespace, list(values)
    values_ = [
        np.asarray(v, dtype=np.float64) if isinstance(v, (list, tuple)) and is_constant(v) else v for v in values
    ]
    engine = engine_of(values_)
    if any(isinstance(v, (list, tuple)) for v in values_):
        # A list of traced scalars, such as an eye built of parameters.
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


def unit(x: Array, axis: int = -1) -> Array:
    """Vectors scaled to length one; a zero vector stays zero, with zero derivative."""
    xp = namespace(x)
    square = xp.sum(x * x, axis=axis, keepdims=True)
    safe = xp.where(square > 0, square, xp.ones_like(square))
    return x / xp.sqrt(safe)


def without_border(image: Array, border: int) -> Array:
    """An image (H, W, C) without `border` rows and columns at each side."""
    height, width = image.shape[:2]
    return image[border : height - border, border : width - border, ...] if border else image
