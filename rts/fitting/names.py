"""What errors and reports call things: leaves of parameters by name, and long texts in one line."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import fields
from typing import Any

from rts.trees import STATIC_FIELDS, Array, Tree


def named_leaves(tree: Tree, name: str = "") -> Iterator[tuple[str, Array]]:
    """Leaves with names such as "light.direction", in the order of `leaves`; a single array is "parameters"."""

    def at(key: Any) -> str:
        return f"{name}.{key}" if name else str(key)

    if isinstance(tree, Mapping):
        for key in sorted(tree):
            yield from named_leaves(tree[key], at(key))
    elif isinstance(tree, (list, tuple)):
        for i, item in enumerate(tree):
            yield from named_leaves(item, at(i))
    elif type(tree) in STATIC_FIELDS:
        for field in fields(tree):
            if field.name not in STATIC_FIELDS[type(tree)]:
                yield from named_leaves(getattr(tree, field.name), at(field.name))
    elif tree is not None:
        yield name or "parameters", tree


def one_line(text: str, longest: int = 200) -> str:
    """The text in one line, cut where it is too long."""
    text = " ".join(text.split())
    return text if len(text) <= longest else f"{text[: longest - 1]}…"


def listed(names: Sequence[str], most: int = 3) -> str:
    """Names in a row, not more than a few."""
    more = [f"{len(names) - most} more"] if len(names) > most else []
    return ", ".join([*names[:most], *more])
