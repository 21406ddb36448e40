"""Affine maps of points, and products of small matrices, in full precision.

Matrix units of some devices round float32 products to fewer bits. There, products are computed elementwise.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from rts.arrays.engines import constants, engine_of, exemplar, namespace
from rts.arrays.trees import Array
from rts.errors import InputError
from rts.operations.by_view import index_of_views, of_view, ranges_of_views, rows_in_views
from rts.operations.operation import Arrays, Operation, Some


def matmul(a: Array, b: Array) -> Array:
    """Product of two small matrices, in one engine; NumPy's beside another's is a constant."""
    engine = engine_of(a, b)
    if type(a) is not type(b):
        a, b = constants((a, b), engine, exemplar(a, b))
    if engine.exact_products(a, b):
        return a @ b
    return engine.namespace.sum(a[:, :, None] * b[None, :, :], axis=1)


def affine(row: Array, points: Array) -> Array:
    """One coordinate (…) of an affine map of points (…, 3): `row` is (4,), its last entry the offset."""
    return points[..., 0] * row[0] + points[..., 1] * row[1] + points[..., 2] * row[2] + row[3]


def affine_map(rows: Array, points: Array) -> Array:
    """Points (N, 3) under an affine map of R rows (R, 4): (N, R)."""
    if is_plain_product(rows, points):
        AFFINE.check_ranks((rows, points))
        return specified_affine_map(rows, points)
    return AFFINE(rows, points)


def is_plain_product(*arrays: Array) -> bool:
    """True if a plain matrix product will do: it keeps the precision, and the engine has no derivatives."""
    engine = engine_of(*arrays)
    return not engine.differentiates and engine.exact_products(*arrays)


def specified_affine_map(rows: Array, points: Array) -> Array:
    """`affine_map` in array code, its specification."""
    engine = engine_of(rows, points)
    if engine.exact_products(rows, points):
        return points @ rows[:, :3].T + rows[:, 3]
    return engine.namespace.stack([affine(rows[i, :], points) for i in range(rows.shape[0])], axis=-1)


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
    if not is_plain_product(rows, points):
        return VIEWS(rows, points, view)
    VIEWS.check_ranks((rows, points, view))
    mapped = np.zeros((len(points), rows.shape[1]), np.result_type(rows, points))
    for b, own in ranges_of_views(view, len(rows)):
        np.matmul(points[own], rows[b, :, :3].T, out=mapped[own])
        mapped[own] += rows[b, :, 3]
    return mapped


def _specification_of_views(rows: Array, points: Array, view: Array) -> Array:
    xp = namespace(points)
    own = xp.take(rows, index_of_views(view), axis=0)
    terms = own[..., 0] * points[:, :1], own[..., 1] * points[:, 1:2], own[..., 2] * points[:, 2:]
    return terms[0] + terms[1] + terms[2] + own[..., 3]


def _shape_of_views(rows: tuple[int, ...], points: tuple[int, ...], view: tuple[int, ...]) -> tuple[int, ...]:
    return points[0], rows[1]


def _each_view(operands: Arrays) -> Iterator[tuple[int, slice, Arrays]]:
    """For each view its index, the slice of its points, and its operands of `AFFINE`."""
    rows, points, view = operands
    if rows.shape[2] != 4 or points.shape != (len(view), 3):
        shapes = ", ".join(str(x.shape) for x in operands)
        raise InputError(f"rows, points and view have shapes {shapes}; expected (B, R, 4), (N, 3) and (N,)")
    for b, own in ranges_of_views(view, len(rows)):
        yield b, own, (rows[b], points[own])


def _forward_of_views(operands: Arrays, out: np.ndarray) -> None:
    out[rows_in_views(operands[2]) :] = 0
    for _, own, given in _each_view(operands):
        AFFINE.forward(given, out[own])


def _push_of_views(operands: Arrays, tangents: Some, out: np.ndarray) -> None:
    out[rows_in_views(operands[2]) :] = 0
    for b, own, given in _each_view(operands):
        AFFINE.push(given, [of_view(tangents[0], b), of_view(tangents[1], own)], out[own])


def _pull_of_views(operands: Arrays, g: np.ndarray, results: Some) -> None:
    for b, own, given in _each_view(operands):
        AFFINE.pull(given, g[own], [of_view(results[0], b), of_view(results[1], own)])


VIEWS = Operation(
    "rts.affine_of_views",
    _specification_of_views,
    ranks=(3, 2, 1),
    shape=_shape_of_views,
    forward=_forward_of_views,
    push=_push_of_views,
    pull=_pull_of_views,
    differentiable=2,
    packed=(1, 2),
    packed_result=True,
    used=lambda operands: rows_in_views(operands[2]),
)
"""The operation of `affine_map_of_views`."""
