"""A cache of what samplers build for a surface: structures over triangles, buffers on a device.

Optimisers change arrays in place, so an array's identity proves nothing: entries are found by a fingerprint of the
bytes that the proxy was made of.
"""

from __future__ import annotations

import threading
import weakref
from collections import OrderedDict
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import xxhash

from rts.arrays.trees import Tree, leaves
from rts.contracts.records import Proxy

KEPT = 2
"""Entries for each surface and sampler. For one more, the least recently used is adapted, or else dropped."""


class Entry(NamedTuple):
    """An entry of the cache: a proxy, and the structure that a sampler built over it.

    Attributes:
        proxy: the triangles.
        prepared: the sampler's structure.
        inputs: inputs of the proxy, if the surface refines samples; else None.
    """

    proxy: Proxy
    prepared: Any
    inputs: Tree = None


class Keeper:
    """The entries of one sampler: bounded in number, released with their surfaces.

    Callers hold `lock` while they look up an entry, and while they draw one that may be adapted in place.
    """

    def __init__(self) -> None:
        self.lock = threading.RLock()
        self._entries: weakref.WeakKeyDictionary[Any, OrderedDict] = weakref.WeakKeyDictionary()

    def get(
        self,
        surface: Any,
        key: tuple,
        build: Callable[[], Entry],
        follow: Callable[[Entry], Entry | None],
    ) -> Entry:
        """The entry of a surface under a key.

        Args:
            surface: the surface; its entries are released with it.
            key: `fingerprint` of the proxy's inputs, and more if it depends on the view.
            build: makes the entry.
            follow: adapts an older entry in place, or returns None where it cannot.
        """
        try:
            entries = self._entries.setdefault(surface, OrderedDict())
        except TypeError:  # A surface that cannot be hashed, or referred to weakly: nothing can be kept for it.
            return build()
        if key in entries:
            entries.move_to_end(key)
            return entries[key]
        old = entries.popitem(last=False)[1] if len(entries) >= KEPT else None
        entries[key] = (follow(old) if old is not None else None) or build()
        return entries[key]


def same_faces(a: Proxy, b: Proxy) -> bool:
    """True if two proxies have the same faces and as many vertices."""
    same_count = len(a.vertices) == len(b.vertices)
    return same_count and (a.faces is b.faces or np.array_equal(a.faces, b.faces))


def fingerprint(tree: Tree) -> tuple:
    """A key that changes when the bytes of host arrays do; a million vertices take a fifth of a millisecond."""
    return tuple(_fingerprint(np.ascontiguousarray(x)) for x in leaves(tree))


def _fingerprint(x: np.ndarray) -> tuple:
    data = x.reshape(-1).view(np.uint8)
    # To NumPy's stubs an array is a buffer from Python 3.12 on.
    return x.shape, x.dtype.str, xxhash.xxh3_128_intdigest(data)  # pyright: ignore[reportArgumentType]
