"""Vectors of length one."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from rts.arrays.array_functions import dot
from rts.arrays.engines import engine_of, namespace
from rts.arrays.trees import Array
from rts.operations.operation import Operation, known_value


def unit(x: Array) -> Array:
    """Vectors (…, C) scaled to length one; a zero vector stays zero, and has the identity for derivative."""
    return UNIT(x) if len(x.shape) == 2 and x.shape[1] == 3 else _specification(x)


def _specification(x: Array) -> Array:
    xp = namespace(x)
    with np.errstate(over="ignore"):  # NumPy warns of squares that are too large.
        square = dot(x, x)
    if not _is_moderate(square):
        # Float32 holds no square of a length below 1e-19 or above 1e19, so the largest component becomes 1 before.
        size = xp.max(abs(engine_of(x).stop_gradient(x)), axis=-1, keepdims=True)
        x = x / xp.where(size > 0, size, xp.ones_like(size))
        square = dot(x, x)
    safe = xp.where(square > 0, square, xp.ones_like(square))
    return x / xp.sqrt(safe)


def _is_moderate(square: Array) -> bool:
    """True if squares are known, on the host, and far from the ends of float32; zeros are not, and may be underflow."""
    values = known_value(square)
    return values is not None and bool(values.min(initial=1.0) > 1e-24 and values.max(initial=1.0) < 1e24)


def _shape(x: tuple[int, ...]) -> tuple[int, ...]:
    return x


def _loops() -> tuple[Callable, Callable, Callable]:
    from rts.operations import unit_loops as loops

    return loops.forward, loops.push, loops.pull


UNIT = Operation.of_loops("rts.unit", _specification, (2,), _shape, _loops, packed=(0,), packed_result=True)
"""The operation of `unit`, on vectors (N, 3)."""
