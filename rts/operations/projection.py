"""Perspective projection of points."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np

from rts.arrays.engines import namespace
from rts.arrays.trees import Array
from rts.errors import InputError
from rts.operations.by_view import index_of_views, of_view, ranges_of_views, rows_in_views
from rts.operations.linear import is_plain_product, specified_affine_map
from rts.operations.operation import Arrays, Operation, Some


def projective_map(rows: Array, points: Array) -> Array:
    """The first two values over the third, and the fourth, (N, 3), of four affine maps (4, 4) of points (N, 3).

    A point whose third value is zero has no image; its result is finite.
    """
    if is_plain_product(rows, points):
        PROJECTION.check_ranks((rows, points))
        return _specification(rows, points)
    return PROJECTION(rows, points)


def projective_map_of_views(rows: Array, points: Array, view: Array, places: Array) -> Array:
    """`projective_map` for points (N, 3) of several views, which are placed side by side in one picture.

    Unused rows at the end hold anything; NumPy's plain products leave these rows out.

    Args:
        rows: (B, 4, 4), the affine maps of each view.
        points: (N, 3), views one after the other.
        view: (N,) int32, the view of each point; see `rts.operations.by_view`.
        places: (B, 3), for each view the offsets of x and y, and a factor on depth.
    """
    if not is_plain_product(rows[0, ...], points):
        return VIEWS(rows, points, view, places)
    xp, placed = namespace(points), []
    for b, own in ranges_of_views(view, len(rows)):
        shown = _specification(rows[b, ...], points[own, :])
        placed.append(xp.concat([shown[:, :2] + places[b, :2], shown[:, 2:] * places[b, 2]], axis=1))
    return xp.concat(placed)


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
    "rts.projection",
    _specification,
    (2, 2),
    _shape,
    _loops,
    _check,
    differentiable=2,
    packed=(1,),
    packed_result=True,
)


def _specification_of_views(rows: Array, points: Array, view: Array, places: Array) -> Array:
    xp, index = namespace(points), index_of_views(view)
    rows, places, points = xp.take(rows, index, axis=0), xp.take(places, index, axis=0), points[:, None, :]
    x, y, divisor, depth = xp.unstack(xp.sum(rows[..., :3] * points, axis=-1) + rows[..., 3], axis=1)
    safe = xp.where(divisor == 0, xp.ones_like(divisor), divisor)
    return xp.stack([x / safe + places[:, 0], y / safe + places[:, 1], depth * places[:, 2]], axis=1)


def _shape_of_views(rows: tuple, points: tuple[int, ...], view: tuple, places: tuple) -> tuple[int, ...]:
    return points


def _each_view(operands: Arrays) -> Iterator[tuple[int, slice, Arrays, np.ndarray]]:
    """For each view its index, the slice of its points, its operands of `PROJECTION`, and its row of `places`."""
    rows, points, view, places = operands
    if rows.shape[1:] != (4, 4) or points.shape != (len(view), 3) or places.shape != (len(rows), 3):
        shapes = ", ".join(str(x.shape) for x in operands)
        raise InputError(
            f"rows, points, view and places have shapes {shapes}; expected (B, 4, 4), (N, 3), (N,) and (B, 3)"
        )
    for b, own in ranges_of_views(view, len(rows)):
        yield b, own, (rows[b], points[own]), places[b]


def _forward_of_views(operands: Arrays, out: np.ndarray) -> None:
    out[rows_in_views(operands[2]) :] = 0
    for _, own, given, place in _each_view(operands):
        projected = out[own]
        PROJECTION.forward(given, projected)
        projected[:, :2] += place[:2]
        projected[:, 2] *= place[2]


def _push_of_views(operands: Arrays, tangents: Some, out: np.ndarray) -> None:
    out[rows_in_views(operands[2]) :] = 0
    for b, own, given, place in _each_view(operands):
        PROJECTION.push(given, [of_view(tangents[0], b), of_view(tangents[1], own)], out[own])
        out[own, 2] *= place[2]


def _pull_of_views(operands: Arrays, g: np.ndarray, results: Some) -> None:
    for b, own, given, place in _each_view(operands):
        gradient = g[own] if place[2] == 1 else g[own] * np.array([1, 1, place[2]], g.dtype)
        PROJECTION.pull(given, gradient, [of_view(results[0], b), of_view(results[1], own)])


VIEWS = Operation(
    "rts.projection_of_views",
    _specification_of_views,
    ranks=(3, 2, 1, 2),
    shape=_shape_of_views,
    forward=_forward_of_views,
    push=_push_of_views,
    pull=_pull_of_views,
    differentiable=2,
    packed=(1, 2),
    packed_result=True,
    used=lambda operands: rows_in_views(operands[2]),
)
"""The operation of `projective_map_of_views`."""
