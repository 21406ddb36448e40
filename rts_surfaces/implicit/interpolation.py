"""Interpolation, linear along each axis, of values on a lattice and of their central differences."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from rts import engine_of, namespace
from rts.plugin_api.arrays import Array
from rts.plugin_api.operations import Operation, combine
from rts_surfaces.implicit.lattice import Lattice

Numbers = tuple[float, ...]


def interpolated(values: Array, points: Array, lattice: Lattice) -> Array:
    """Values (X, Y, Z) of a lattice at points (M, 3): (M,), differentiable in both; beyond the bounds as on them."""
    lowest, shares = _cells(values.shape, points, lattice.low.tolist(), lattice.step.tolist())
    return _combined(values, *_corners(values.shape, lowest, shares))


def differences(values: Array, points: Array, lattice: Lattice) -> Array:
    """Central differences (M, 3) of values (X, Y, Z) along the axes, interpolated at points (M, 3); see `interpolated`.

    At the bounds differences are one-sided. Unlike the slope of the interpolated values, they have no jumps.
    """
    points = namespace(values).astype(points, values.dtype, copy=False)
    return DIFFERENCES(values, points, low=tuple(lattice.low.tolist()), step=tuple(lattice.step.tolist()))


def _cells(
    shape: Sequence[int], points: Array, low: Sequence[float], step: Sequence[float]
) -> tuple[list[Array], list[Array]]:
    """The cells of points (M, 3): a list of their lowest corners (M,) int32, and one of places in them, 0 to 1 (M,).

    Each list has an array for each axis. Points beyond the lattice count as their nearest ones on its bounds. Places
    are differentiable. `low` and `step` are the lattice's, of the given `shape`.
    """
    xp, engine = namespace(points), engine_of(points)
    lowest, shares = [], []
    for axis in range(3):
        last = shape[axis] - 1
        at = xp.clip((points[:, axis] - low[axis]) / step[axis], 0.0, float(last))
        cell = xp.clip(xp.floor(engine.stop_gradient(at)), 0.0, float(last - 1))
        lowest.append(xp.astype(cell, xp.int32))
        shares.append(at - cell)
    return lowest, shares


def _corners(shape: Sequence[int], lowest: Sequence[Array], shares: Sequence[Array]) -> tuple[Array, Array]:
    """Numbers (M, 8) in the lattice of the corners of cells, and their weights (M, 8) in linear interpolation.

    `lowest` and `shares` are the lists that `_cells` returns. Corner i has the offsets (i & 1, i >> 1 & 1, i >> 2 & 1).
    """
    xp = namespace(lowest[0])
    first = (lowest[0] * shape[1] + lowest[1]) * shape[2] + lowest[2]
    ids, weights = [], []
    for i in range(8):
        bits = i & 1, i >> 1 & 1, i >> 2 & 1
        ids.append(first + (bits[0] * shape[1] + bits[1]) * shape[2] + bits[2])
        factors = [s if bit else 1 - s for s, bit in zip(shares, bits, strict=True)]
        weights.append(factors[0] * factors[1] * factors[2])
    return xp.stack(ids, axis=-1), xp.stack(weights, axis=-1)


def _combined(values: Array, ids: Array, weights: Array) -> Array:
    return combine(namespace(values).reshape(values, (-1, 1)), ids, weights)[:, 0]


def _specification(values: Array, points: Array, *, low: Numbers, step: Numbers) -> Array:
    lowest, shares = _cells(values.shape, points, low, step)
    xp = namespace(points)
    corners, shared = _corners(values.shape, lowest, shares)
    columns, strides = [], (values.shape[1] * values.shape[2], values.shape[2], 1)
    for axis in range(3):
        ids, weights = [], []
        for i in range(8):
            at = lowest[axis] + (i >> axis & 1)
            up, down = xp.astype(at < values.shape[axis] - 1, at.dtype), xp.astype(at > 0, at.dtype)
            per_step = shared[:, i] / (xp.astype(up + down, points.dtype) * step[axis])
            ids += [corners[:, i] + strides[axis] * up, corners[:, i] - strides[axis] * down]
            weights += [per_step, -per_step]
        columns.append(_combined(values, xp.stack(ids, axis=-1), xp.stack(weights, axis=-1)))
    return xp.stack(columns, axis=-1)


def _shape(values: tuple[int, ...], points: tuple[int, ...], **_: object) -> tuple[int, ...]:
    return points[0], 3


def _loops() -> tuple[Callable, Callable, Callable]:
    from rts_surfaces.implicit import interpolation_loops as loops

    return loops.forward, loops.push, loops.pull


_PACKED: dict[str, Any] = {"packed": (1,), "packed_result": True}
DIFFERENCES = Operation.of_loops(
    "rts_surfaces.differences", _specification, (3, 2), _shape, _loops, differentiable=2, **_PACKED
)
"""The operation of `differences`, on values and points; low and step are the lattice's."""
