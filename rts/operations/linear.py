"""Affine maps of points, and products of small matrices, in full precision.

Matrix units of some devices round float32 products to fewer bits: there all is elementwise.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from rts.engines import constants, engine_of, exemplar
from rts.errors import InputError
from rts.operations.operation import Arrays, Operation, Some
from rts.trees import Array


def matmul(a: Array, b: Array) -> Array:
    """Product of two small matrices."""
    engine = engine_of(a, b)
    if type(a) is not type(b):
        a, b = constants((a, b), engine, exemplar(a, b))
    if engine.exact_products(a, b):
        return a @ b
    return engine.namespace.sum(a[:, :, None] * b[None, :, :], axis=1)


def affine(row: Array, points: Array) -> Array:
    """One coordinate (N,) of an affine map of points (N, 3): `row` is (4,), its last entry the offset."""
    return points[..., 0] * row[0] + points[..., 1] * row[1] + points[..., 2] * row[2] + row[3]


def affine_map(rows: Array, points: Array) -> Array:
    """Points (N, 3) under an affine map of R rows (R, 4): (N, R)."""
    if is_plain_product(rows, points):
        AFFINE.check_ranks((rows, points))
        return specified_affine_map(rows, points)
    return AFFINE(rows, points)


def is_plain_product(*arrays: Array) -> bool:
    """Whether a product of whole matrices is all it takes: it is exact, and nobody differentiates it."""
    engine = engine_of(*arrays)
    return not engine.differentiates and engine.exact_products(*arrays)


def specified_affine_map(rows: Array, points: Array) -> Array:
    """`affine_map` in array code."""
    engine = engine_of(rows, points)
    if engine.exact_products(rows, points):
        return points @ rows[:, :3].T + rows[:, 3]
    return engine.namespace.stack([affine(rows[i, :], points) for i in range(rows.shape[0])], axis=-1)


def _shape(rows: tuple[int, ...], points: tuple[int, ...]) -> tuple[int, ...]:
    return points[0], rows[0]


def _fitting(operands: Arrays) -> Arrays:
    rows, points = operands
    if rows.shape[1] != 4 or points.shape[1] != 3:
        raise InputError(f"rows and points have shapes {rows.shape} and {points.shape}; expected (R, 4) and (N, 3)")
    return operands


def _forward(operands: Arrays, out: np.ndarray) -> None:
    from rts.operations import linear_kernels

    rows, points = _fitting(operands)
    linear_kernels.affine(rows, points, out)


def _push(operands: Arrays, tangents: Some, out: np.ndarray) -> None:
    from rts.operations import linear_kernels

    rows, points = _fitting(operands)
    t_rows, t_points = tangents
    linear_kernels.affine_push(rows, points, t_rows, t_points, out)


def _pull(operands: Arrays, g: np.ndarray, results: Some) -> None:
    from rts.operations import linear_kernels

    rows, points = _fitting(operands)
    g_rows, g_points = results
    linear_kernels.affine_pull(rows, points, g, g_rows, g_points)


_PACKED: dict[str, Any] = {"differentiable": 2, "packed": (1,), "packed_result": True}
AFFINE = Operation("rts.affine", specified_affine_map, (2, 2), _shape, _forward, _push, _pull, **_PACKED)
