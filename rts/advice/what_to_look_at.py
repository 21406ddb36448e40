"""The parts of a scene that advice looks at: each surface once, and values that are known."""

from __future__ import annotations

import weakref
from typing import Any

from rts.arrays.engines import value_of
from rts.arrays.trees import Tree, map_leaves


def known_tree(tree: Tree) -> Tree | None:
    """The tree as NumPy arrays; None if an array is traced or batched."""
    is_known = []

    def value(x: object) -> object:
        array = value_of(x)
        is_known.append(array is not None and array.shape == tuple(getattr(x, "shape", ())))
        return array

    host = map_leaves(value, tree)
    return host if all(is_known) else None


def is_new(surface: Any, seen: weakref.WeakSet[Any]) -> bool:
    """True for a surface that is not among those `seen`, where it is from now on."""
    try:
        if surface in seen:
            return False
        seen.add(surface)
    except TypeError:  # A surface that cannot be hashed, or referred to weakly, is not looked at.
        return False
    return True
