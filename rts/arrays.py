"""Trees of arrays, and the engine that owns them."""

from __future__ import annotations

import functools
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, TypeVar

import numpy as np

from rts.adapting import adapted
from rts.errors import EngineError, InputError, PluginError
from rts.interfaces import Engine
from rts.records import STATIC_FIELDS, Array, Tree, join_record, record_arrays, split_record

_F = TypeVar("_F", bound=Callable)
CONSTANT_TYPES = (np.ndarray, np.generic, bool, int, float)


def leaves(tree: Tree) -> Iterator[Any]:
    """The leaves of nested dicts, lists, tuples and records, in a fixed order; None has none."""
    return iter(_collected(tree))


def _collected(tree: Tree) -> list[Any]:
    """The same as a list. One loop, since it is asked for dozens of times a render."""
    found, rest = [], [tree]
    while rest:
        x = rest.pop()
        kind = _KINDS.get(type(x)) or _kind(x)
        if kind == _LEAF:
            found.append(x)
        elif kind == _RECORD:
            rest.extend(record_arrays(x)[::-1])
        elif kind == _SEQUENCE:
            rest.extend(x[::-1])
        elif kind == _MAPPING:
            rest.extend([x[key] for key in sorted(x, reverse=True)])
    return found


_LEAF, _NOTHING, _RECORD, _SEQUENCE, _MAPPING = range(1, 6)
_KINDS: dict[type, int] = {}
"""What trees of a type are."""


def _kind(tree: Tree) -> int:
    if tree is None:
        kind = _NOTHING
    elif type(tree) in STATIC_FIELDS:
        kind = _RECORD
    elif isinstance(tree, (list, tuple)):
        kind = _SEQUENCE
    elif isinstance(tree, Mapping):
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
        items = []
        for item in tree:
            items.append(fn(item) if _KINDS.get(type(item)) == _LEAF else map_leaves(fn, item))
        return type(tree)(*items) if _is_named(tree) else type(tree)(items)
    if kind == _MAPPING:
        return {key: map_leaves(fn, tree[key]) for key in sorted(tree)}
    return None


def _is_named(tree: Tree) -> bool:
    """Whether a sequence is a named tuple."""
    return hasattr(tree, "_fields")


def from_numbers(tree: Tree) -> Tree:
    """The same tree with every list or tuple that holds only numbers, nested or not, as a float32 array."""
    if type(tree) is np.ndarray or type(tree) in OWNERS:
        return tree
    if isinstance(tree, Mapping):
        found = {}
        for key, value in tree.items():
            found[key] = value if type(value) is np.ndarray or type(value) in OWNERS else from_numbers(value)
        return found
    if isinstance(tree, (list, tuple)) and not _is_named(tree):
        if tree and all(isinstance(x, (bool, int, float)) for x in leaves(tree)):
            try:
                return np.asarray(tree, np.float32)
            except ValueError:
                raise InputError(f"a list of numbers has rows of different lengths: {str(tree)[:60]}") from None
        return type(tree)(from_numbers(x) for x in tree)
    return tree


def is_constant(tree: Tree) -> bool:
    """Whether every leaf is NumPy or a Python number: never differentiated."""
    if type(tree) in OWNERS:
        return False
    for x in _collected(tree):
        if type(x) in OWNERS or not isinstance(x, CONSTANT_TYPES):
            return False
    return True


# Plain dictionaries rather than functools caches: torch.compile looks through the latter, and warns.
_ENGINES: dict[str, Engine] = {}
OWNERS: dict[type, Engine] = {}
"""Engines by the types of arrays that have been met; NumPy's own, which are constants beside any, are not in it."""
_BITS: dict[Any, int] = {}
_BROKEN: set[str] = set()
"""Engines that do not load."""


def engine_named(name: str) -> Engine:
    """The one object of an engine, which is loaded.

    Raises:
        PluginError: it cannot be loaded.
    """
    from rts.registry import plugin

    if name not in _ENGINES:
        engine = adapted(plugin("rts.engines", name)(), Engine)
        if engine is None:
            raise PluginError(f"the engine {name!r} is not an rts.Engine, nor has its methods; subclass it")
        _ENGINES[name] = engine
    return _ENGINES[name]


def _owner(x: Any) -> Engine:
    from rts.registry import plugins

    for name in plugins("rts.engines"):
        if name != "numpy" and name in sys.modules and engine_named(name).owns(x):
            return engine_named(name)
    raise EngineError(
        f"an array of type {type(x).__module__}.{type(x).__qualname__} belongs to no engine; "
        f"expected NumPy, {', '.join(n for n in plugins('rts.engines') if n != 'numpy')}"
    )


def engine_of(*trees: Tree) -> Engine:
    """The engine of the arrays in these trees; NumPy arrays and Python numbers are constants beside any.

    Raises:
        EngineError: arrays of two engines, or of an unknown type.
    """
    found: Engine | None = None
    for x in trees:
        engine = OWNERS.get(type(x))
        if engine is None:
            if type(x) is np.ndarray:
                continue
            return _engine_of_leaves(_collected(trees))
        if found is not None and engine is not found:
            return _engine_of_leaves(trees)
        found = engine
    return found if found is not None else _ENGINES.get("numpy") or engine_named("numpy")


def _engine_of_leaves(found: Sequence[Any]) -> Engine:
    only: Engine | None = None
    for x in found:
        engine = OWNERS.get(type(x))
        if engine is None:
            if isinstance(x, CONSTANT_TYPES):
                continue
            engine = OWNERS[type(x)] = _owner(x)
        if only is not None and engine is not only:
            raise EngineError(
                f"arrays of {' and '.join(sorted((engine.name, only.name)))} met in one call; convert one side "
                f"(NumPy arrays may stand beside either, as constants)"
            )
        only = engine
    return only if only is not None else _ENGINES.get("numpy") or engine_named("numpy")


def suiting(*trees: Tree) -> tuple[Engine, Array | None]:
    """The engine of these trees, and their exemplar."""
    found = _collected(trees)
    return _engine_of_leaves(found), _widest(found)


_names: list[str] = []


def _imported() -> list[Engine]:
    """The engines whose framework has been imported."""
    if not _names:
        from rts.registry import plugins

        _names.extend(plugins("rts.engines"))
    found = []
    for name in _names:
        if sys.modules.get(name) is not None and name not in _BROKEN:
            if name not in _ENGINES:
                try:
                    engine_named(name)
                except PluginError:  # It is an error where arrays of this engine are given.
                    _BROKEN.add(name)
                    continue
            found.append(_ENGINES[name])
    return found


def uncompiled(f: _F) -> _F:
    """`f`, which what compiles Python code, as `torch.compile` does, is to call and not to look into.

    Such a compiler would follow it through checks, caches and plugins, for most of a minute, and sees little of the
    work, which is compiled already.
    """

    @functools.wraps(f)
    def call(*args: Any, **kwargs: Any) -> Any:
        outside = f
        for engine in _imported():
            outside = engine.uncompiled(outside)
        return outside(*args, **kwargs)

    return call  # pyright: ignore[reportReturnType]


def is_traced(x: Array) -> bool:
    """Whether an array has a shape but not yet a value."""
    return engine_of(x).traced(x)


def exemplar(*trees: Tree) -> Array | None:
    """The widest floating array of an engine other than NumPy, which sets dtype and device for constants, or None."""
    return _widest(_collected(trees))


def _widest(found: Sequence[Any]) -> Array | None:
    widest, bits = None, 0
    for x in found:
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
    engine = OWNERS.get(type(arrays[0])) if len(arrays) == 1 else None
    return (engine_of(*arrays) if engine is None else engine).namespace


def _shape(x: Any) -> Any:
    return getattr(x, "shape", None)


def shape_of(x: Any) -> tuple[int, ...]:
    """The shape of an array; () of anything else."""
    return tuple(_shape(x) or ())


def described(x: Any) -> str:
    """What an error says of a value: "has shape (2, 3)" of an array, what it is of anything else."""
    return f"is a {type(x).__name__}" if _shape(x) is None else f"has shape {shape_of(x)}"


def constants(tree: Tree, engine: Engine, like: Array | None) -> Tree:
    """The same tree with every NumPy array and number as a constant of the engine."""
    if tree is None or type(tree) in OWNERS:
        return tree
    if type(tree) is np.ndarray:
        return engine.constant(tree, like)

    def constant(x: Any) -> Array:
        return x if type(x) in OWNERS or not isinstance(x, CONSTANT_TYPES) else engine.constant(x, like)

    return map_leaves(constant, tree)


def promote(*values: Any) -> tuple[Any, list[Array]]:
    """Arguments of one call, numbers and lists included, as floating arrays of one engine, and their namespace.

    Where all are NumPy or numbers the result is float64.
    """
    owner = OWNERS.get(type(values[0]))
    for v in values:
        if owner is None or OWNERS.get(type(v)) is not owner:
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
