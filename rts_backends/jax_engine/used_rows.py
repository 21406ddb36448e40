"""The number of rows in use of packed arrays while a program is traced; the other rows are zero."""

from __future__ import annotations

import weakref
from collections.abc import Sequence

import jax
import numpy as np
from jax.core import Tracer


class UsedRows:
    """The record of the rows in use of tracers, each for as long as its tracer lives.

    A tracer has no hash, and no equality but that of its entries. So the record goes by identity, and asks on each
    look whether the tracer is still the one that was noted.
    """

    def __init__(self):
        self._record: dict[int, tuple[weakref.ref, jax.Array | np.int32]] = {}

    def note(self, x: jax.Array, used: jax.Array | np.int32) -> None:
        """Record the number () int32 of rows in use of `x`, if `x` is traced; other arrays need no record."""
        if isinstance(x, Tracer):
            key = id(x)
            self._record[key] = weakref.ref(x, lambda _: self._record.pop(key, None)), used

    def used(self, packed: Sequence[jax.Array]) -> jax.Array | np.int32:
        """The number of rows in use of `packed`, arrays (N, ·) with the same rows in use.

        It is N if none of the arrays has a record, and 0 if there are no arrays.
        """
        for x in packed:
            known = self._record.get(id(x))
            if known is not None and known[0]() is x:
                return known[1]
        return np.int32(packed[0].shape[0] if packed else 0)
