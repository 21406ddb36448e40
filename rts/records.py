"""Frozen dataclasses that every engine knows as pytrees, so that they may be arguments of its transforms."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import Any

STATIC_FIELDS: dict[type, tuple[str, ...]] = {}
"""The records that are pytrees, each with the names of its fields that are not arrays (engines register them)."""


def record(*, static: tuple[str, ...] = ()) -> Callable[[type], type]:
    """Make a class a frozen dataclass that every engine knows as a pytree.

    Args:
        static: the fields that are not arrays; jax compares them to decide whether to compile anew.
    """

    def decorate(cls: type) -> type:
        cls = dataclass(frozen=True, eq=False)(cls)
        STATIC_FIELDS[cls] = static
        return cls

    return decorate


def split_record(value: Any) -> tuple[tuple[Any, ...], tuple[Any, ...]]:
    """A record's array fields and its static fields, each in order of declaration."""
    static = STATIC_FIELDS[type(value)]
    names = [f.name for f in fields(value)]
    arrays = tuple(getattr(value, n) for n in names if n not in static)
    return arrays, tuple(getattr(value, n) for n in names if n in static)


def join_record(cls: type, arrays: tuple[Any, ...], static: tuple[Any, ...]) -> Any:
    """The inverse of `split_record`; runs no check, since frameworks put placeholders into the fields."""
    value, a, s = object.__new__(cls), iter(arrays), iter(static)
    for f in fields(cls):
        object.__setattr__(value, f.name, next(s if f.name in STATIC_FIELDS[cls] else a))
    return value
