"""Perspective projection of points."""

from __future__ import annotations

import numpy as np

from rts.engines import namespace
from rts.errors import InputError
from rts.operations.linear import is_plain_product, specified_affine_map
from rts.operations.operation import Arrays, Operation, Some
from rts.trees import Array


def projective_map(rows: Array, points: Array) -> Array:
    """Four affine maps (4, 4) of points (N, 3), as (N, 3): the first two over the third, and the fourth.

    Where the third is zero there is no image; the result is finite.
    """
    if is_plain_product(rows, points):
        PROJECTION.check_ranks((rows, points))
        return _specification(rows, points)
    return PROJECTION(rows, points)


def _specification(rows: Array, points: Array) -> Array:
    divisor = specified_affine_map(rows[2:3, :], points)
    xp = namespace(divisor)
    safe = xp.where(divisor == 0, xp.ones_like(divisor), divisor)
    depth = specified_affine_map(rows[3:, :], points)
    return xp.concat([specified_affine_map(rows[:2, :], points) / safe, depth], axis=1)


def _shape(rows: tuple[int, ...], points: tuple[int, ...]) -> tuple[int, ...]:
    return points


def _fitting(operands: Arrays) -> Arrays:
    rows, points = operands
    if rows.shape != (4, 4) or points.shape[1] != 3:
        raise InputError(f"rows and points have shapes {rows.shape} and {points.shape}; expected (4, 4) and (N, 3)")
    return operands


def _forward(operands: Arrays, out: np.ndarray) -> None:
    from rts.operations import projection_kernels

    rows, points = _fitting(operands)
    projection_kernels.project(rows, points, out)


def _push(operands: Arrays, tangents: Some, out: np.ndarray) -> None:
    from rts.operations import projection_kernels

    rows, points = _fitting(operands)
    t_rows, t_points = tangents
    projection_kernels.push(rows, points, t_rows, t_points, out)


def _pull(operands: Arrays, g: np.ndarray, results: Some) -> None:
    from rts.operations import projection_kernels

    rows, points = _fitting(operands)
    g_rows, g_points = results
    projection_kernels.pull(rows, points, g, g_rows, g_points)


PROJECTION = Operation(
    "rts.projection",
    _specification,
    ranks=(2, 2),
    shape=_shape,
    forward=_forward,
    push=_push,
    pull=_pull,
    differentiable=2,
    packed=(1,),
    packed_result=True,
)
