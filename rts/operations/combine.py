"""Weighted sums of rows, as for points of every surface that is linear in its control points."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from rts.arrays.array_functions import described, from_numbers, shape_of
from rts.arrays.engines import constants, engine_of, exemplar, namespace, stopped
from rts.arrays.trees import Array
from rts.compiling.threads import read_only
from rts.errors import InputError
from rts.operations.operation import Operation, known_value
from rts.operations.take import take


def combine(rows: Array, ids: Array, weights: Array) -> Array:
    """Weighted sums Σᵢ wᵢ rowᵢ (N, C), differentiable in rows and weights.

    Args:
        rows: (V, C) float, such as control points.
        ids: (N, I) integers, indices of rows. For a sum of fewer rows, repeat any index with a weight of zero.
        weights: (N, I) float.

    Raises:
        InputError: shapes or dtypes do not fit; or, on the host, an id is no index of a row.
    """
    rows, weights = from_numbers(rows, "rows"), from_numbers(weights, "weights")
    ids = np.asarray(from_numbers(ids, "ids"), np.int32) if isinstance(ids, (list, tuple)) else from_numbers(ids, "ids")
    shapes = [shape_of(x) for x in (rows, ids, weights)]
    for name, x in (("rows", rows), ("ids", ids), ("weights", weights)):
        if not shape_of(x):
            raise InputError(f"{name} {described(x)}; expected an array (V, C), (N, I) or (N, I)")
    for name, x in (("rows", rows), ("weights", weights)):
        if not engine_of(x).namespace.isdtype(x.dtype, "real floating"):
            raise InputError(f"{name} have dtype {x.dtype}; expected floating numbers")
    if not engine_of(ids).namespace.isdtype(ids.dtype, "integral"):
        raise InputError(f"ids have dtype {ids.dtype}; expected integers that name rows")
    if len(shapes[0]) != 2 or len(shapes[1]) != 2 or shapes[1] != shapes[2] or not shapes[1][1]:
        listed_shapes = ", ".join(map(str, shapes))
        raise InputError(f"rows, ids and weights have shapes {listed_shapes}; expected (V, C), (N, I), (N, I)")
    return COMBINE(*_alike(rows, weights), ids, column=0, count=shapes[1][1], affine=False)


def interpolate(rows: Array, ids: Array, column: int, weights: Array) -> Array:
    """Interpolation c + w₀ (a − c) + w₁ (b − c), (N, C), of rows a, b, c, whose indices are three columns of `ids`.

    This is `combine` of a, b and c, where c has the weight 1 − w₀ − w₁.

    Args:
        rows: (V, C) float.
        ids: (N, I) integers, indices of rows.
        column: the first of the three columns.
        weights: (N, W) float, of which the first two are used.

    Raises:
        InputError: shapes of ids and weights do not fit; or, on the host, an id is no index of a row.
    """
    ids_shape, weights_shape = shape_of(ids), shape_of(weights)
    plain = len(ids_shape) == len(weights_shape) == 2
    if not plain or not 0 <= column <= ids_shape[1] - 3 or weights_shape[1] < 2 or ids_shape[0] != weights_shape[0]:
        raise InputError(
            f"samples have ids of shape {ids_shape} and parameters of shape {weights_shape}; "
            f"expected (N, {column + 3}) and (N, 2), or more columns: sample this surface anew"
        )
    return COMBINE(*_alike(rows, weights), ids, column=column, count=3, affine=True)


def differences(rows: Array, ids: Array, column: int) -> Array:
    """How `interpolate` changes along its two weights (N, 2 C): a − c and b − c; constant.

    Args:
        rows: (V, C) float.
        ids: (N, I) integers, indices of rows.
        column: the first of the three columns.
    """
    rows = stopped(rows)
    known = known_value(rows), known_value(ids)
    if known[0] is not None and known[1] is not None and known[0].ndim == known[1].ndim == 2:
        from rts.operations import combine_loops as loops

        host = loops.differences(read_only(known[0]), read_only(known[1]), column)
        return engine_of(rows).constant(host, rows)
    xp = namespace(rows, ids)
    a, b, c = (xp.take(rows, ids[:, column + i], axis=0) for i in range(3))
    return xp.concat([a - c, b - c], axis=1)


def _alike(rows: Array, weights: Array) -> tuple[Array, Array]:
    """Rows and weights in one engine; the weights' dtype is at least as wide as the rows'."""
    if weights.dtype == rows.dtype:
        return rows, weights
    engine = engine_of(rows, weights)
    rows, weights = constants((rows, weights), engine, exemplar(rows, weights))
    xp = engine.namespace
    narrow = xp.finfo(weights.dtype).bits < xp.finfo(rows.dtype).bits
    return rows, xp.astype(weights, rows.dtype) if narrow else weights


def _specification(rows: Array, weights: Array, ids: Array, *, column: int, count: int, affine: bool) -> Array:
    xp = namespace(rows, ids)
    # One gather of all columns: its gradient fills one array of the rows' size, instead of one for each column.
    index = xp.reshape(ids[:, column : column + count], (-1,))
    gathered = xp.reshape(take(rows, index), (-1, count, rows.shape[1]))
    if not affine:
        return sum(weights[:, i : i + 1] * gathered[:, i, :] for i in range(count))
    last = total = gathered[:, count - 1, :]
    for i in range(count - 1):
        total = total + weights[:, i : i + 1] * (gathered[:, i, :] - last)
    return total


def _shape(rows: tuple[int, ...], weights: tuple[int, ...], ids: tuple[int, ...], **_: object) -> tuple[int, ...]:
    return weights[0], rows[1]


def _check(rows: np.ndarray, weights: np.ndarray, ids: np.ndarray, *, column: int, count: int, affine: bool) -> None:
    """Refuse ids and weights with too few columns, or with different numbers of rows."""
    if len(ids) != len(weights) or not 0 <= column <= ids.shape[1] - count or weights.shape[1] < count - affine:
        raise InputError(
            f"ids and weights have shapes {ids.shape} and {weights.shape}; expected (N, {column + count}) and "
            f"(N, {count - affine}), or more columns"
        )


def _loops() -> tuple[Callable, Callable, Callable]:
    from rts.operations import combine_loops as loops

    return loops.forward, loops.push, loops.pull


COMBINE = Operation.of_loops(
    "rts.combine",
    _specification,
    (2, 2, 2),
    _shape,
    _loops,
    _check,
    differentiable=2,
    packed=(1, 2),
    packed_result=True,
)
"""The operation of `combine` and `interpolate`, on rows (V, C), weights (N, W) and ids (N, I).

Parameters: `column` is the first of the `count` columns of ids that are used. If `affine`, the last weight is one minus
the others."""
