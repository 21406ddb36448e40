"""Trees of arrays: nested dicts, lists, tuples and records; their leaves, and the decorator of records."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, fields
from typing import Any, TypeVar, dataclass_transform

Array = Any
"""An array of NumPy, torch or jax, or of an engine that a plugin brings."""

Tree = Any
"""Arrays in nested dicts, lists, tuples and records."""

_Class = TypeVar("_Class", bound=type)


STATIC_FIELDS: dict[type, tuple[str, ...]] = {}
"""The record classes, which engines register as pytrees, each with the names of its fields that are not arrays."""

_ARRAY_FIELDS: dict[type, tuple[str, ...]] = {}


@dataclass_transform(frozen_default=True, eq_default=False, field_specifiers=(field,))
def record(*, static: tuple[str, ...] = ()) -> Callable[[_Class], _Class]:
    """Make a class a frozen dataclass, and a pytree of every engine, so that transforms take it as an argument.

    Args:
        static: the fields that are not arrays; jax compares them to decide whether to compile anew.
    """

    def decorate(cls: _Class) -> _Class:
        decorated = dataclass(frozen=True, eq=False)(cls)
        STATIC_FIELDS[decorated] = static
        _ARRAY_FIELDS[decorated] = tuple(f.name for f in fields(decorated) if f.name not in static)
        return decorated

    return decorate


def split_record(value: Any) -> tuple[list[Any], tuple[Any, ...]]:
    """A record's array fields in order of declaration, and its static fields in the order of `STATIC_FIELDS`."""
    arrays, static = (map(value.__dict__.__getitem__, of[type(value)]) for of in (_ARRAY_FIELDS, STATIC_FIELDS))
    return list(arrays), tuple(static)


def join_record(cls: type, arrays: Iterable[Any], static: tuple[Any, ...]) -> Any:
    """The inverse of `split_record`; runs no check, since frameworks put placeholders into the fields."""
    value = object.__new__(cls)
    value.__dict__.update(
        zip(_ARRAY_FIELDS[cls], arrays, strict=True), **dict(zip(STATIC_FIELDS[cls], static, strict=True))
    )
    return value


# ------------------------------------------------------------------------------------------------------------- leaves


def leaves(tree: Tree) -> Iterator[Any]:
    """The leaves of nested dicts, lists, tuples and records, in a fixed order: dicts by sorted key. None has none."""
    return iter(collected(tree))


def collected(tree: Tree) -> list[Any]:
    """`leaves` as a list. One loop for speed: every render calls it dozens of times."""
    arrays, rest = [], [tree]
    while rest:
        x = rest.pop()
        kind = _KINDS.get(type(x)) or _kind(x)
        if kind == _LEAF:
            arrays.append(x)
        elif kind == _RECORD:
            rest.extend(map(x.__dict__.__getitem__, _ARRAY_FIELDS[type(x)][::-1]))
        elif kind == _SEQUENCE:
            rest.extend(x[::-1])
        elif kind == _MAPPING:
            rest.extend(map(x.__getitem__, sorted(x, reverse=True)))
    return arrays


_LEAF, _NOTHING, _RECORD, _SEQUENCE, _MAPPING = range(1, 6)
_KINDS: dict[type, int] = {}
"""The kind, such as `_LEAF`, of each type of tree met so far."""


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


def placed_leaves(tree: Tree, place: tuple = ()) -> Iterator[tuple[tuple, Any]]:
    """The leaves in the order of `leaves`, each with its path: keys, indices and names of fields."""
    kind = _KINDS.get(type(tree)) or _kind(tree)
    if kind == _LEAF:
        yield place, tree
    elif kind == _RECORD:
        for name in _ARRAY_FIELDS[type(tree)]:
            yield from placed_leaves(getattr(tree, name), (*place, name))
    elif kind == _SEQUENCE:
        for i, item in enumerate(tree):
            yield from placed_leaves(item, (*place, i))
    elif kind == _MAPPING:
        for key in sorted(tree):
            yield from placed_leaves(tree[key], (*place, key))


def map_leaves(fn: Callable[[Any], Any], tree: Tree) -> Tree:
    """A copy of a tree with `fn` applied to each leaf, in the order of `leaves`; None stays None."""
    kind = _KINDS.get(type(tree)) or _kind(tree)
    if kind == _LEAF:
        return fn(tree)
    if kind == _RECORD:
        copy, values = object.__new__(type(tree)), tree.__dict__
        for name in _ARRAY_FIELDS[type(tree)]:
            item = values[name]
            if item is not None:
                item = fn(item) if _KINDS.get(type(item)) == _LEAF else map_leaves(fn, item)
            copy.__dict__[name] = item
        for name in STATIC_FIELDS[type(tree)]:
            copy.__dict__[name] = values[name]
        return copy
    if kind == _SEQUENCE:
        items = []
        for item in tree:
            items.append(fn(item) if _KINDS.get(type(item)) == _LEAF else map_leaves(fn, item))
        cls = type(tree)
        return items if cls is list else (cls(*items) if hasattr(tree, "_fields") else cls(items))
    if kind == _MAPPING:
        mapped = {}
        for key in sorted(tree):
            item = tree[key]
            mapped[key] = fn(item) if _KINDS.get(type(item)) == _LEAF else map_leaves(fn, item)
        return mapped
    return None
