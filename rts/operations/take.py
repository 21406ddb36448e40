"""Rows of an array by index."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rts.arrays.engines import namespace
from rts.arrays.trees import Array
from rts.compiling.threads import parallel, read_only
from rts.errors import InputError
from rts.operations.operation import Arrays, Operation, Some, known_value


def take(rows: Array, index: Array) -> Array:
    """Rows (M, C) of an array (V, C), by their indices (M,). Gradients are added up in the order of the indices.

    Raises:
        InputError: on the host, an index names no row.
    """
    return TAKE(rows, index)


def _specification(rows: Array, index: Array) -> Array:
    value = known_value(index)
    if value is not None:
        _check(value, rows.shape[0])
    return namespace(rows, index).take(rows, index, axis=0)


def _check(index: np.ndarray, count: int) -> None:
    if index.size and not 0 <= index.min() <= index.max() < count:
        raise InputError(f"rows from {index.min()} to {index.max()} were asked for; expected 0 to {count - 1}")


def _shape(rows: tuple[int, ...], index: tuple[int, ...]) -> tuple[int, ...]:
    return index[0], rows[1]


def _forward(operands: Arrays, out: np.ndarray) -> None:
    from rts.operations import take_loops

    rows, index = operands
    index, bad = read_only(index, np.int32 if index.dtype.itemsize < 8 else np.int64), np.zeros(1, np.bool_)
    parallel(take_loops.put, len(index), read_only(rows), index, out, bad, work=2 * out.size)
    if bad[0]:
        _check(index, len(rows))


def _push(operands: Arrays, tangents: Sequence[np.ndarray], out: np.ndarray) -> None:
    # Only this operand has a derivative, so its tangent is always there.
    _forward((tangents[0], operands[1]), out)


def _pull(operands: Arrays, g: np.ndarray, results: Some) -> None:
    from rts.operations import take_loops

    if results[0] is not None:
        take_loops.add(np.ascontiguousarray(g), operands[1], results[0])


TAKE = Operation("rts.take", _specification, (2, 1), _shape, _forward, _push, _pull, packed=(1,), packed_result=True)
