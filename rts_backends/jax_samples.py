"""Projection and interpolation of packed samples as jax primitives.

Both are told how many samples are used, of which alone they take notice: `jit` allots many more. The others are zero.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rts import interpolation
from rts_backends import projection_kernels
from rts_backends.jax_host import clear
from rts_backends.jax_operations import Arrays, Differentiable, Kernels, Some


def project(rows: jax.Array, points: jax.Array, used: jax.Array | np.int32) -> jax.Array:
    """`rts.arrays.projective_map` of the first `used` points."""
    return _projection(rows, points, used)


def interpolate(
    rows: jax.Array, weights: jax.Array, ids: jax.Array, used: jax.Array | np.int32, column: int
) -> jax.Array:
    """`rts.arrays.interpolate` for the first `used` samples."""
    return _interpolation(rows, weights, ids, used, column=column)


def _host_project(operands: Arrays, out: np.ndarray) -> None:
    rows, points, used = operands
    projection_kernels.project(rows, points[:used], out[:used])
    clear(out[used:])


def _host_project_push(operands: Arrays, tangents: Some, out: np.ndarray) -> None:
    rows, points, used = operands
    for i, result in enumerate(out):
        t_rows, t_points = (None if t is None else t[i] for t in tangents)
        t_points = None if t_points is None else t_points[:used]
        projection_kernels.push(rows, points[:used], t_rows, t_points, result[:used])
        clear(result[used:])


def _host_project_pull(operands: Arrays, gradients: np.ndarray, results: Some) -> None:
    rows, points, used = operands
    for i, g in enumerate(gradients):
        g_rows, g_points = (None if r is None else r[i] for r in results)
        found = projection_kernels.pull(rows, points[:used], g[:used], None if g_points is None else g_points[:used])
        if g_rows is not None:
            g_rows[...] = found
        if g_points is not None:
            clear(g_points[used:])


def _specified_projection(rows: jax.Array, points: jax.Array, used: jax.Array) -> jax.Array:
    x, y, w, z = (jnp.sum(points * rows[i, :3], axis=1) + rows[i, 3] for i in range(4))
    safe = jnp.where(w == 0, 1, w)
    return jnp.stack([x / safe, y / safe, z], axis=1)


def _host_interpolate(operands: Arrays, out: np.ndarray, column: int) -> None:
    rows, weights, ids, used = operands
    interpolation.interpolate(rows, ids[:used], column, weights[:used], out[:used])
    clear(out[used:])


def _host_interpolate_push(operands: Arrays, tangents: Some, out: np.ndarray, column: int) -> None:
    rows, weights, ids, used = operands
    for i, result in enumerate(out):
        t_rows, t_weights = (None if t is None else t[i] for t in tangents)
        t_weights = None if t_weights is None else t_weights[:used]
        interpolation.push(rows, ids[:used], column, weights[:used], t_rows, t_weights, result[:used])
        clear(result[used:])


def _host_interpolate_pull(operands: Arrays, gradients: np.ndarray, results: Some, column: int) -> None:
    rows, weights, ids, used = operands
    for i, g in enumerate(gradients):
        g_rows, g_weights = (None if r is None else r[i] for r in results)
        if g_rows is not None:
            clear(g_rows)
        filled = None if g_weights is None else g_weights[:used]
        interpolation.pull(rows, ids[:used], column, weights[:used], g[:used], g_rows, filled)
        if g_weights is not None:
            clear(g_weights[used:])


def _specified_interpolation(
    rows: jax.Array, weights: jax.Array, ids: jax.Array, used: jax.Array, *, column: int
) -> jax.Array:
    a, b, c = (jnp.take(rows, ids[:, column + i], axis=0) for i in range(3))
    return c + weights[:, :1] * (a - c) + weights[:, 1:2] * (b - c)


def _points_shape(rows: tuple, points: tuple, used: tuple, **_: Any) -> tuple[int, int]:
    return points


def _interpolated_shape(rows: tuple, weights: tuple, ids: tuple, used: tuple, **_: Any) -> tuple[int, int]:
    return weights[0], rows[1]


_projection = Differentiable(
    "project",
    (2, 2, 0),
    _points_shape,
    Kernels(_host_project, _host_project_push, _host_project_pull),
    _specified_projection,
)
_interpolation = Differentiable(
    "interpolate",
    (2, 2, 2, 0),
    _interpolated_shape,
    Kernels(_host_interpolate, _host_interpolate_push, _host_interpolate_pull),
    _specified_interpolation,
)
