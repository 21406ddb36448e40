"""Affine maps of points, and products of small matrices, in full precision."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from rts.arrays.engines import constants, engine_of, namespace
from rts.arrays.trees import Array
from rts.errors import InputError
from rts.operations.by_view import index_of_views, operation_of_views
from rts.operations.operation import Operation


def matmul(a: Array, b: Array) -> Array:
    """Product of two small matrices, in one engine; NumPy's beside another's is a constant."""
    if type(a) is type(b) is np.ndarray:
        return a @ b
    engine = engine_of(a, b)
    if type(a) is not type(b):
        a, b = (engine.constant(a, b), b) if type(a) is np.ndarray else (a, constants(b, engine, a))
    return engine.product(a, b)


def affine(row: Array, points: Array) -> Array:
    """One coordinate (…) of an affine map of points (…, 3): `row` is (4,), its last entry the offset."""
    return points[..., 0] * row[0] + points[..., 1] * row[1] + points[..., 2] * row[2] + row[3]


def affine_map(rows: Array, points: Array) -> Array:
    """Points (N, 3) under an affine map of R rows (R, 4): (N, R)."""
    return AFFINE(rows, points)


def specified_affine_map(rows: Array, points: Array) -> Array:
    """`affine_map` in array code, its specification."""
    return engine_of(rows, points).product(points, rows[:, :3].T) + rows[:, 3]


def _shape(rows: tuple[int, ...], points: tuple[int, ...]) -> tuple[int, ...]:
    return points[0], rows[0]


def _check(rows: np.ndarray, points: np.ndarray) -> None:
    if rows.shape[1] != 4 or points.shape[1] != 3:
        raise InputError(f"rows and points have shapes {rows.shape} and {points.shape}; expected (R, 4) and (N, 3)")


def _loops() -> tuple[Callable, Callable, Callable]:
    from rts.operations import linear_loops as loops

    return loops.forward, loops.push, loops.pull


_PACKED: dict[str, Any] = {"differentiable": 2, "packed": (1,), "packed_result": True}
AFFINE = Operation.of_loops("rts.affine", specified_affine_map, (2, 2), _shape, _loops, _check, **_PACKED)


# ------------------------------------------------------------------------------------------------- of several views


def affine_map_of_views(rows: Array, points: Array, view: Array) -> Array:
    """Points (N, 3) of several views, each under the affine map of its view: (N, R), anything in unused rows.

    Args:
        rows: (B, R, 4), the affine map of each view.
        points: (N, 3), views one after the other.
        view: (N,) int32, the view of each point; see `rts.operations.by_view`.
    """
    return VIEWS(rows, points, view)


def _specification_of_views(rows: Array, points: Array, view: Array) -> Array:
    xp = namespace(points)
    maps = xp.take(rows, index_of_views(view), axis=0)
    terms = maps[..., 0] * points[:, :1], maps[..., 1] * points[:, 1:2], maps[..., 2] * points[:, 2:]
    return terms[0] + terms[1] + terms[2] + maps[..., 3]


VIEWS = operation_of_views("rts.affine_of_views", AFFINE, _specification_of_views, placed=False)
"""The operation of `affine_map_of_views`."""
