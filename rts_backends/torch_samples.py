"""Projection and interpolation of packed samples in torch on the CPU, compiled.

Written in torch they take a dozen passes over the samples, and twice as many back.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from rts import interpolation
from rts_backends import projection_kernels
from rts_backends.torch_operations import Arrays, Operation, Some
from rts_backends.torch_rows import take


def project(rows: Tensor, points: Tensor) -> Tensor:
    """`rts.arrays.projective_map`."""
    return _PROJECTION(rows, points)


def interpolate(rows: Tensor, ids: Tensor, column: int, weights: Tensor) -> Tensor:
    """`rts.arrays.interpolate`."""
    if column not in _INTERPOLATIONS:
        _INTERPOLATIONS[column] = _interpolation(column)
    return _INTERPOLATIONS[column](rows, weights, ids)


def _project(operands: Arrays) -> np.ndarray:
    out = np.empty(operands[1].shape, operands[1].dtype)
    projection_kernels.project(*operands, out)
    return out


def _project_push(operands: Arrays, tangents: Some, out: np.ndarray) -> None:
    projection_kernels.push(*operands, *tangents, out)


def _project_pull(operands: Arrays, g: np.ndarray, results: Some) -> None:
    g_rows = projection_kernels.pull(*operands, g, results[1])
    if results[0] is not None:
        results[0][...] = g_rows


def specified_projection(rows: Tensor, points: Tensor) -> Tensor:
    """`project` in torch."""
    x, y, w, z = torch.addmm(rows[:, 3], points, rows[:, :3].T).unbind(1)
    safe = torch.where(w == 0, torch.ones_like(w), w)
    return torch.stack([x / safe, y / safe, z], dim=1)


_PROJECTION = Operation(
    specified_projection, _project, lambda operands: operands[1].shape, _project_push, _project_pull
)


_INTERPOLATIONS: dict[int, Operation] = {}
"""By their columns."""


def _interpolation(column: int) -> Operation:
    """Of rows, weights and ids, three columns of which, from one on, name rows."""

    def value(operands: Arrays) -> np.ndarray:
        rows, weights, ids = operands
        interpolation.check(rows, ids, column)
        return interpolation.interpolate(rows, ids, column, weights)

    def shape(operands: Arrays) -> tuple[int, ...]:
        rows, weights, _ = operands
        return len(weights), rows.shape[1]

    def push(operands: Arrays, tangents: Some, out: np.ndarray) -> None:
        rows, weights, ids = operands
        interpolation.push(rows, ids, column, weights, *tangents, out)

    def pull(operands: Arrays, g: np.ndarray, results: Some) -> None:
        rows, weights, ids = operands
        interpolation.pull(rows, ids, column, weights, g, *results)

    def specification(rows: Tensor, weights: Tensor, ids: Tensor) -> Tensor:
        index = ids[:, column : column + 3].reshape(-1)
        a, b, c = take(rows, index).reshape(-1, 3, rows.shape[1]).unbind(1)
        return c + weights[:, 0:1] * (a - c) + weights[:, 1:2] * (b - c)

    return Operation(specification, value, shape, push, pull)
