"""Perspective projection of points."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from rts.arrays.engines import namespace
from rts.arrays.trees import Array
from rts.errors import InputError
from rts.operations.by_view import index_of_views, operation_of_views
from rts.operations.linear import specified_affine_map
from rts.operations.operation import Operation


def projective_map(rows: Array, points: Array) -> Array:
    """The first two values over the third, and the fourth, (N, 3), of four affine maps (4, 4) of points (N, 3).

    A point whose third value is zero has no image; its result is finite.
    """
    return PROJECTION(rows, points)


def projective_map_of_views(rows: Array, points: Array, view: Array, places: Array) -> Array:
    """`projective_map` for points (N, 3) of several views, which are placed side by side in one picture.

    Unused rows at the end hold anything.

    Args:
        rows: (B, 4, 4), the affine maps of each view.
        points: (N, 3), views one after the other.
        view: (N,) int32, the view of each point; see `rts.operations.by_view`.
        places: (B, 2), for each view the offsets of x and y.
    """
    return VIEWS(rows, points, view, places)


def _specification(rows: Array, points: Array) -> Array:
    mapped = specified_affine_map(rows, points)
    xp, divisor = namespace(mapped), mapped[:, 2:3]
    safe = xp.where(divisor == 0, xp.ones_like(divisor), divisor)
    return xp.concat([mapped[:, :2] / safe, mapped[:, 3:]], axis=1)


def _shape(rows: tuple[int, ...], points: tuple[int, ...]) -> tuple[int, ...]:
    return points


def _check(rows: np.ndarray, points: np.ndarray) -> None:
    if rows.shape != (4, 4) or points.shape[1] != 3:
        raise InputError(f"rows and points have shapes {rows.shape} and {points.shape}; expected (4, 4) and (N, 3)")


def _loops() -> tuple[Callable, Callable, Callable]:
    from rts.operations import projection_loops as loops

    return loops.forward, loops.push, loops.pull


PROJECTION = Operation.of_loops(
    "rts.projection", _specification, (2, 2), _shape, _loops, _check, differentiable=2, packed=(1,), packed_result=True
)


def _specification_of_views(rows: Array, points: Array, view: Array, places: Array) -> Array:
    xp, index = namespace(points), index_of_views(view)
    rows, places, points = xp.take(rows, index, axis=0), xp.take(places, index, axis=0), points[:, None, :]
    x, y, divisor, depth = xp.unstack(xp.sum(rows[..., :3] * points, axis=-1) + rows[..., 3], axis=1)
    safe = xp.where(divisor == 0, xp.ones_like(divisor), divisor)
    return xp.stack([x / safe + places[:, 0], y / safe + places[:, 1], depth], axis=1)


VIEWS = operation_of_views("rts.projection_of_views", PROJECTION, _specification_of_views, placed=True)
"""The operation of `projective_map_of_views`."""
