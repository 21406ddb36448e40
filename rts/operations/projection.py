"""Perspective projection of points."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence

import numpy as np

from rts.engines import engine_of, namespace
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


def projective_map_of_views(rows: Array, points: Array, counts: Sequence[int]) -> Array:
    """As `projective_map`, of points (N, 3) of B views, one after the other, so many each, by rows (B, 4, 4)."""
    if is_plain_product(rows[0, ...], points):
        ends = np.cumsum(counts).tolist()
        own = [points[end - n : end, :] for end, n in zip(ends, counts, strict=True)]
        return namespace(points).concat([_specification(rows[b, ...], x) for b, x in enumerate(own)])
    view = np.repeat(np.arange(len(counts), dtype=np.int32), counts)
    return VIEWS(rows, points, engine_of(points).constant(view))


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


def _specification_of_views(rows: Array, points: Array, view: Array) -> Array:
    xp = namespace(points)
    rows, points = xp.take(rows, view, axis=0), points[:, None, :]
    x, y, divisor, depth = xp.unstack(xp.sum(rows[..., :3] * points, axis=-1) + rows[..., 3], axis=1)
    safe = xp.where(divisor == 0, xp.ones_like(divisor), divisor)
    return xp.stack([x / safe, y / safe, depth], axis=1)


def _shape_of_views(rows: tuple[int, ...], points: tuple[int, ...], view: tuple[int, ...]) -> tuple[int, ...]:
    return points


def _each_view(operands: Arrays) -> Iterator[tuple[int, slice, Arrays]]:
    """Of each view its number, where its points are, and the operands of its projection."""
    rows, points, view = operands
    if rows.shape[1:] != (4, 4) or points.shape != (len(view), 3):
        raise InputError(
            f"rows, points and view have shapes {rows.shape}, {points.shape} and {view.shape}; expected (B, 4, 4), "
            f"(N, 3) and (N,)"
        )
    ends = np.searchsorted(view, np.arange(len(rows) + 1))
    for b, own in enumerate(itertools.starmap(slice, itertools.pairwise(ends.tolist()))):
        yield b, own, (rows[b], points[own])


def _at(x: np.ndarray | None, place: int | slice) -> np.ndarray | None:
    return None if x is None else x[place]


def _forward_of_views(operands: Arrays, out: np.ndarray) -> None:
    for _, own, given in _each_view(operands):
        _forward(given, out[own])


def _push_of_views(operands: Arrays, tangents: Some, out: np.ndarray) -> None:
    for b, own, given in _each_view(operands):
        _push(given, [_at(tangents[0], b), _at(tangents[1], own)], out[own])


def _pull_of_views(operands: Arrays, g: np.ndarray, results: Some) -> None:
    for b, own, given in _each_view(operands):
        _pull(given, g[own], [_at(results[0], b), _at(results[1], own)])


VIEWS = Operation(
    "rts.projection_of_views",
    _specification_of_views,
    ranks=(3, 2, 1),
    shape=_shape_of_views,
    forward=_forward_of_views,
    push=_push_of_views,
    pull=_pull_of_views,
    differentiable=2,
)
"""Points (N, 3) of views, one after the other, by the rows (B, 4, 4) of each; the last operand (N,) says whose."""
