"""Facts about the arrays of a program that is being traced, beyond their shapes."""

from __future__ import annotations

import weakref
from collections.abc import Sequence
from typing import NamedTuple

import jax
import numpy as np
from jax.core import Tracer

from rts.plugin_api.operations import Operation


class Origin(NamedTuple):
    """Facts about one array, as far as they are known.

    Args:
        used: how many of its rows are in use, () int32; the others are zero.
        operation: the cheap operation, without parameters, that gave it.
        operands: those of `operation`.
    """

    used: jax.Array | np.int32 | None = None
    operation: Operation | None = None
    operands: Sequence[jax.Array] = ()


class Origins:
    """The record of the origins of tracers, each for as long as its tracer lives.

    A tracer has no hash, and no equality but that of its entries. So the record goes by identity, and asks on each
    look whether the tracer is still the one that was noted.
    """

    def __init__(self):
        self._record: dict[int, tuple[weakref.ref, Origin]] = {}

    def of(self, x: jax.Array) -> Origin:
        """The facts about an array; none about one that was not noted."""
        known = self._record.get(id(x))
        return known[1] if known is not None and known[0]() is x else Origin()

    def note(self, x: jax.Array, origin: Origin) -> None:
        """Record the facts about an array of a program; those about known values are not needed."""
        if isinstance(x, Tracer):
            key = id(x)
            self._record[key] = weakref.ref(x, lambda _: self._record.pop(key, None)), origin

    def used(self, packed: Sequence[jax.Array]) -> jax.Array | np.int32:
        """How many rows are used of arrays (N, ·) that belong together, as far as that is known of any of them."""
        counts = (self.of(x).used for x in packed)
        return next((n for n in counts if n is not None), np.int32(packed[0].shape[0] if packed else 0))
