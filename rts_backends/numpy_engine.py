"""The engine of NumPy arrays: forward rendering only, without derivatives."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from operator import attrgetter
from typing import Any

import numpy as np
from array_api_compat import numpy as array_api

from rts import Engine
from rts.plugin_api.arrays import Array
from rts.plugin_api.operations import Operation
from rts.plugin_api.records import ArraySpec
from rts.plugin_api.threads import read_only

_DTYPE = attrgetter("dtype")


class NumpyEngine(Engine):
    """Engine of plain NumPy arrays."""

    name = "numpy"
    namespace = array_api
    differentiates = False

    def owns(self, x: Any) -> bool:
        """True for a NumPy array."""
        return isinstance(x, np.ndarray)

    def constant(self, value: Any, like: Array | None = None) -> np.ndarray:
        """`value` as an array; floats in the dtype of `like`, if given, else in their own."""
        array = np.asarray(value)
        return array.astype(like.dtype, copy=False) if like is not None and array.dtype.kind == "f" else array

    def call_host(self, fn: Callable, specs: Sequence[ArraySpec], *args: Array) -> tuple[np.ndarray, ...]:
        """The results of `fn(*args)`: everything is on the host already."""
        return fn(*args)

    def apply(self, operation: Operation, operands: Sequence[np.ndarray], params: Mapping[str, Any]) -> np.ndarray:
        """The operation's result: by compiled code if `operation.fits` the dtypes, else by its array code.

        Beside float64, float32 is widened, as NumPy does.
        """
        if not operation.fits(list(map(_DTYPE, operands))):
            widened = [x.astype(np.float64) if x.dtype == np.float32 else x for x in operands]
            if not operation.fits(list(map(_DTYPE, widened))):
                return operation.specification(*operands, **params)
            operands = widened
        return operation.value_on_host(list(map(read_only, operands)), dict(params))[0]

    def on_host(self, *arrays: np.ndarray) -> bool:
        """True: NumPy arrays are always on the host."""
        return True

    def concurrent(self) -> bool:
        """True: NumPy keeps no state for a thread, so several may compute at once."""
        return True

    def stop_gradient(self, x: Array) -> Array:
        """`x` itself."""
        return x

    def segment_sum(self, values: Array, segments: np.ndarray, count: int) -> Array:
        """(count, n) sums of the rows of `values` (N, n) that have the same number in `segments` (N,)."""
        return np.stack([np.bincount(segments, weights=v, minlength=count) for v in values.T], axis=-1).astype(
            values.dtype
        )

    def to_numpy(self, x: Array) -> np.ndarray:
        """`x` itself."""
        return np.asarray(x)
