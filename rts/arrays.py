"""Trees of arrays, and the engine that owns them."""

from __future__ import annotations

import functools
import sys
from collections.abc import Callable, Iterator, Mapping
from typing import Any, TypeVar

import numpy as np

from rts.errors import EngineError, InputError, PluginError
from rts.protocols import Array, Engine, Tree
from rts.records import STATIC_FIELDS, join_record, split_record

_F = TypeVar("_F", bound=Callable)
CONSTANT_TYPES = (np.ndarray, np.generic, bool, int, float)


def leaves(tree: Tree) -> Iterator[Any]:
    """The leaves of nested dicts, lists, tuples and records, in a fixed order; None has none."""
    found: list[Any] = []
    _collect(tree, found)
    return iter(found)


def _collect(tree: Tree, found: list[Any]) -> None:
    kind = _KINDS.get(type(tree)) or _kind(tree)
    if kind == _LEAF:
        found.append(tree)
    elif kind == _RECORD:
        _collect(split_record(tree)[0], found)
    elif kind == _SEQUENCE:
        for item in tree:
            _collect(item, found)
    elif kind == _MAPPING:
        for key in sorted(tree):
            _collect(tree[key], found)


_LEAF, _NOTHING, _RECORD, _SEQUENCE, _MAPPING = range(1, 6)
_KINDS: dict[type, int] = {}
"""What trees of a type are. Looked up, since it is asked hundreds of times a render."""


def _kind(tree: Tree) -> int:
    if tree is None:
        kind = _NOTHING
    elif type(tree) in STATIC_FIELDS:
        kind = _RECORD
    elif isinstance(tree, (list, tuple)):
        kind = _SEQUENCE
    elif isinstance(tree, dict) or (not hasattr(tree, "dtype") and isinstance(tree, Mapping)):
        kind = _MAPPING
    else:
        kind = _LEAF
    _KINDS[type(tree)] = kind
    return kind


def map_leaves(fn: Callable[[Any], Any], tree: Tree) -> Tree:
    """The same tree with `fn` applied to each leaf, visited in the order of `leaves`."""
    kind = _KINDS.get(type(tree)) or _kind(tree)
    if kind == _LEAF:
        return fn(tree)
    if kind == _RECORD:
        arrays, static = split_record(tree)
        return join_record(type(tree), map_leaves(fn, arrays), static)
    if kind == _SEQUENCE:
        items = [map_leaves(fn, item) for item in tree]
        return type(tree)(*items) if hasattr(tree, "_fields") else type(tree)(items)
    if kind == _MAPPING:
        return {key: map_leaves(fn, tree[key]) for key in sorted(tree)}
    return None


def from_numbers(tree: Tree) -> Tree:
    """The same tree with every list or tuple that holds only numbers, nested or not, as a float32 array."""
    if isinstance(tree, Mapping):
        return {key: from_numbers(value) for key, value in tree.items()}
    if isinstance(tree, (list, tuple)) and not hasattr(tree, "_fields"):
        if tree and all(isinstance(x, (bool, int, float)) for x in leaves(tree)):
            try:
                return np.asarray(tree, np.float32)
            except ValueError:
                raise InputError(f"a list of numbers has rows of different lengths: {str(tree)[:60]}") from None
        return type(tree)(from_numbers(x) for x in tree)
    return tree


def is_constant(tree: Tree) -> bool:
    """Whether every leaf is NumPy or a Python number: never differentiated."""
    return all(isinstance(x, CONSTANT_TYPES) for x in leaves(tree))


# Plain dictionaries rather than functools caches: torch.compile looks through the latter, and warns.
_ENGINES: dict[str, Engine] = {}
_OWNERS: dict[type, Engine] = {}
_BITS: dict[Any, int] = {}
_WRAPS: dict[str, Any] = {}
"""By engines, their member `uncompiled`, or None."""


def _engine(name: str) -> Engine:
    from rts.registry import plugin

    if name not in _ENGINES:
        _ENGINES[name] = plugin("rts.engines", name)()
    return _ENGINES[name]


def _owner(x: Any) -> Engine:
    from rts.registry import plugins

    for name in plugins("rts.engines"):
        if name != "numpy" and name in sys.modules and _engine(name).owns(x):
            return _engine(name)
    raise EngineError(
        f"an array of type {type(x).__module__}.{type(x).__qualname__} belongs to no engine; "
        f"expected NumPy, {', '.join(n for n in plugins('rts.engines') if n != 'numpy')}"
    )


def engine_of(*trees: Tree) -> Engine:
    """The engine of the arrays in these trees; NumPy arrays and Python numbers are constants beside any.

    Raises:
        EngineError: arrays of two engines, or of an unknown type.
    """
    found: dict[str, Engine] = {}
    for x in leaves(trees):
        engine = _OWNERS.get(type(x))
        if engine is None:
            if isinstance(x, CONSTANT_TYPES):
                continue
            engine = _OWNERS[type(x)] = _owner(x)
        found[engine.name] = engine
    if len(found) > 1:
        raise EngineError(
            f"arrays of {' and '.join(sorted(found))} met in one call; convert one side "
            f"(NumPy arrays may stand beside either, as constants)"
        )
    return next(iter(found.values())) if found else _engine("numpy")


def _compilers() -> list[Callable[[Callable], Callable]]:
    """The members `uncompiled` of engines whose framework has been imported."""
    from rts.registry import plugins

    names = [name for name in plugins("rts.engines") if sys.modules.get(name) is not None]
    for name in names:
        if name not in _WRAPS:
            try:
                _WRAPS[name] = getattr(_engine(name), "uncompiled", None)
            except PluginError:  # It is an error where arrays of this engine are given.
                _WRAPS[name] = None
    return [_WRAPS[name] for name in names if _WRAPS[name] is not None]


def uncompiled(f: _F) -> _F:
    """`f`, which what compiles Python code, as `torch.compile` does, is to call and not to look into.

    Such a compiler would follow it through checks, caches and plugins, for most of a minute, and sees little of the
    work, which is compiled already.
    """

    @functools.wraps(f)
    def call(*args: Any, **kwargs: Any) -> Any:
        outside = f
        for wrap in _compilers():
            outside = wrap(outside)
        return outside(*args, **kwargs)

    return call  # pyright: ignore[reportReturnType]


def is_traced(x: Array) -> bool:
    """Whether an array has a shape but not yet a value."""
    return getattr(engine_of(x), "traced", lambda x: False)(x)


def exemplar(*trees: Tree) -> Array | None:
    """The widest floating array of an engine other than NumPy, which sets dtype and device for constants, or None."""
    widest, bits = None, 0
    for x in leaves(trees):
        if isinstance(x, CONSTANT_TYPES):
            continue
        own = _BITS.get(x.dtype)
        if own is None:
            xp = namespace(x)
            own = _BITS[x.dtype] = xp.finfo(x.dtype).bits if xp.isdtype(x.dtype, "real floating") else 0
        if own > bits:
            widest, bits = x, own
    return widest


def namespace(*arrays: Array) -> Any:
    """The array-API namespace of these arrays."""
    engine = _OWNERS.get(type(arrays[0])) if len(arrays) == 1 else None
    return (engine or engine_of(*arrays)).namespace


def constants(tree: Tree, engine: Engine, like: Array | None) -> Tree:
    """The same tree with every NumPy array and number as a constant of the engine."""
    return map_leaves(lambda x: engine.constant(x, like) if isinstance(x, CONSTANT_TYPES) else x, tree)


def promote(*values: Any) -> tuple[Any, list[Array]]:
    """Arguments of one call, numbers and lists included, as floating arrays of one engine, and their namespace.

    Where all are NumPy or numbers the result is float64.
    """
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


def offered(name: str, *arguments: Any) -> Array | None:
    """What an optional member of the arguments' engine gives for them; None where there is none, or it declines."""
    known = getattr(engine_of([x for x in arguments if hasattr(x, "dtype")]), name, None)
    return None if known is None else known(*arguments)


# Elementwise, since matrix units of some devices round float32 products to fewer bits.


def matmul(a: Array, b: Array) -> Array:
    """Product of two small matrices in full precision."""
    found = offered("matmul", a, b)
    return found if found is not None else namespace(a, b).sum(a[:, :, None] * b[None, :, :], axis=1)


def affine(row: Array, points: Array) -> Array:
    """One coordinate (N,) of an affine map of points (N, 3): `row` is (4,), its last entry the offset."""
    return points[..., 0] * row[0] + points[..., 1] * row[1] + points[..., 2] * row[2] + row[3]


def affine_map(rows: Array, points: Array) -> Array:
    """Points (N, 3) under an affine map of R rows (R, 4): (N, R)."""
    found = offered("affine_map", rows, points)
    if found is not None:
        return found
    return namespace(rows, points).stack([affine(rows[i, :], points) for i in range(rows.shape[0])], axis=-1)


def take(rows: Array, index: Array) -> Array:
    """(M, C): the rows of (V, C) that (M,) integers name."""
    found = offered("take", rows, index)
    return namespace(rows, index).take(rows, index, axis=0) if found is None else found


def interpolate(rows: Array, ids: Array, column: int, weights: Array) -> Array:
    """(N, C): c + w₀ (a − c) + w₁ (b − c), for the rows a, b, c of (V, C) that three columns of `ids` name.

    Args:
        rows: (V, C) float.
        ids: (N, I) integers.
        column: the first of the three.
        weights: (N, W) float, the first two of which count.

    Raises:
        InputError: these are no samples of the surface that the rows belong to.
    """
    if ids.shape[1] < column + 3 or weights.shape[1] < 2 or ids.shape[0] != weights.shape[0]:
        raise InputError(
            f"samples have ids of shape {tuple(ids.shape)} and parameters of shape {tuple(weights.shape)}; expected "
            f"(N, {column + 3}) and (N, 2), or more columns: sample this surface anew"
        )
    if isinstance(rows, np.ndarray) and isinstance(ids, np.ndarray):
        from rts import interpolation

        interpolation.check(rows, ids, column)
        return interpolation.interpolate(rows, ids, column, weights)
    found = offered("interpolate", rows, ids, column, weights)
    if found is not None:
        return found
    xp = namespace(rows, ids)
    # One gather of all corners: its gradient fills one array of the size of the mesh, instead of three.
    index = xp.reshape(ids[:, column : column + 3], (-1,))
    corners = xp.reshape(take(rows, index), (-1, 3, rows.shape[1]))
    a, b, c = corners[:, 0, :], corners[:, 1, :], corners[:, 2, :]
    return c + weights[:, 0:1] * (a - c) + weights[:, 1:2] * (b - c)


def projective_map(rows: Array, points: Array) -> Array:
    """(N, 3): of four affine maps (4, 4) of points (N, 3), the first two over the third, and the fourth.

    Where the third is zero there is no image; the result is finite.
    """
    found = offered("projective_map", rows, points)
    if found is not None:
        return found
    divisor = affine_map(rows[2:3, :], points)
    xp = namespace(divisor)
    safe = xp.where(divisor == 0, xp.ones_like(divisor), divisor)
    return xp.concat([affine_map(rows[:2, :], points) / safe, affine_map(rows[3:, :], points)], axis=1)
