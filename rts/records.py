"""Frozen dataclasses that every engine knows as pytrees, so that they may be arguments of its transforms."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import Any

STATIC_FIELDS: dict[type, tuple[str, ...]] = {}
"""The records that are pytrees, each with the names of its fields that are not arrays (engines register them)."""


_ARRAY_FIELDS: dict[type, tuple[str, ...]] = {}


def record(*, static: tuple[str, ...] = ()) -> Callable[[type], type]:
    """Make a class a frozen dataclass that every engine knows as a pytree.

    Args:
        static: the fields that are not arrays; jax compares them to decide whether to compile anew.
    """

    def decorate(cls: type) -> type:
        cls = dataclass(frozen=True, eq=False)(cls)
        STATIC_FIELDS[cls] = static
        _ARRAY_FIELDS[cls] = tuple(f.name for f in fields(cls) if f.name not in static)
        return cls

    return decorate


def split_record(value: Any) -> tuple[tuple[Any, ...], tuple[Any, ...]]:
    """A record's array fields in order of declaration, and its static fields in that of `STATIC_FIELDS`."""
    # Looked up beforehand, since records are taken apart dozens of times a render.
    cls = type(value)
    return tuple([getattr(value, n) for n in _ARRAY_FIELDS[cls]]), tuple(
        [getattr(value, n) for n in STATIC_FIELDS[cls]]
    )


def join_record(cls: type, arrays: tuple[Any, ...], static: tuple[Any, ...]) -> Any:
    """The inverse of `split_record`; runs no check, since frameworks put placeholders into the fields."""
    value = object.__new__(cls)
    value.__dict__.update(
        zip(_ARRAY_FIELDS[cls], arrays, strict=True), **dict(zip(STATIC_FIELDS[cls], static, strict=True))
    )
    return value
