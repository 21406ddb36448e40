"""NumPy: forward rendering only."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from array_api_compat import numpy as array_api

from rts.errors import EngineError
from rts.protocols import Array, ArraySpec, Tree


def _forward_only(*_: Any) -> Any:
    raise EngineError("NumPy has no derivatives; pass torch or jax arrays for what is to be differentiated")


class NumpyEngine:
    """Engine of plain NumPy arrays."""

    name = "numpy"
    namespace = array_api
    value_and_grad = staticmethod(_forward_only)
    jvp = staticmethod(_forward_only)
    jacobian = staticmethod(_forward_only)
    optimizer = staticmethod(_forward_only)

    def owns(self, x: Any) -> bool:
        """Whether `x` is a NumPy array."""
        return isinstance(x, np.ndarray)

    def constant(self, value: Any, like: Array | None = None) -> np.ndarray:
        """`value` as an array, floats in the dtype of `like`."""
        array = np.asarray(value)
        return array.astype(like.dtype) if like is not None and np.issubdtype(array.dtype, np.floating) else array

    def call_host(self, fn: Callable, specs: tuple[ArraySpec, ...], *args: Array) -> tuple[np.ndarray, ...]:
        """Call `fn`: everything is on the host already."""
        return fn(*args)

    def matmul(self, a: Array, b: Array) -> Array:
        """As one product."""
        return a @ b

    def stop_gradient(self, x: Array) -> Array:
        """`x` itself."""
        return x

    def affine_map(self, rows: np.ndarray, points: np.ndarray) -> np.ndarray:
        """As one product."""
        return points @ rows[:, :3].T + rows[:, 3]

    def segment_sum(self, values: Array, segments: np.ndarray, count: int) -> np.ndarray:
        """Sums of the rows of `values` that share a segment."""
        return np.stack([np.bincount(segments, weights=v, minlength=count) for v in values.T], axis=-1).astype(
            values.dtype
        )

    def to_numpy(self, x: Array) -> np.ndarray:
        """`x` itself."""
        return np.asarray(x)

    def block(self, x: Tree) -> Tree:
        """Nothing to wait for."""
        return x

    def checkpoint(self, make: Callable[[], Tree], f: Callable[[Tree], Array]) -> np.ndarray:
        """The value of `f(make())`."""
        return f(make())

    def jit(self, f: Callable) -> Callable:
        """`f` itself."""
        return f
