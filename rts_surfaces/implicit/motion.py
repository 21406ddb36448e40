"""How samples of an isosurface move along the field's gradient: an operation."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rts.engines import namespace
from rts.errors import InputError
from rts.operations.combine import combine
from rts.operations.operation import Arrays, Operation, Some
from rts.threads import parallel, read_only
from rts.trees import Array

_WEIGHTS, _PLACE, _ALONG = slice(3, 9), slice(9, 12), slice(12, 15)
"""Which parameters of a sample are the weights of the six values, its place, and by how much it moves for a unit."""


def along_normal(values: Array, rows: Array, params: Array, isovalue: float, sign: float) -> Array:
    """(N, 3): where samples are, less their vector times the level, which is zero where they were found.

    Args:
        values: (M,) float.
        rows: (N, 6) int32, the six values of each sample.
        params: (N, 15), in the dtype of the values.
        isovalue: the level is `sign * (value - isovalue)`.
        sign: 1 or −1.
    """
    return ALONG_NORMAL(values, params, rows, isovalue=isovalue, sign=sign)


def _specification(values: Array, params: Array, ids: Array, *, isovalue: float, sign: float) -> Array:
    xp, weights = namespace(values, params), params[:, _WEIGHTS]
    level = combine(values[:, None], ids, weights)[:, 0] - isovalue * xp.sum(weights, axis=1)
    return params[:, _PLACE] - sign * level[:, None] * params[:, _ALONG]


def _shape(values: tuple[int, ...], params: tuple[int, ...], ids: tuple[int, ...], **_: object) -> tuple[int, ...]:
    return params[0], 3


def _checked(operands: Arrays) -> Arrays:
    values, params, ids = operands
    if ids.shape != (len(params), 6) or params.shape[1] != 15:
        raise InputError(f"ids and params have shapes {ids.shape} and {params.shape}; expected (N, 6) and (N, 15)")
    if ids.size and not 0 <= ids.min() <= ids.max() < len(values):
        raise InputError(
            f"samples refer to values from {ids.min()} to {ids.max()} of {len(values)}; sample this surface anew"
        )
    return operands


def _forward(operands: Arrays, out: np.ndarray, *, isovalue: float, sign: float) -> None:
    from rts_surfaces.implicit import motion_kernels

    values, params, ids = _checked(operands)
    real = values.dtype.type
    parallel(motion_kernels.move, len(ids), values, params, ids, real(isovalue), real(sign), out, work=30 * len(ids))


def _push(operands: Arrays, tangents: Sequence[np.ndarray], out: np.ndarray, *, isovalue: float, sign: float) -> None:
    from rts_surfaces.implicit import motion_kernels

    values, params, ids = _checked(operands)
    given = read_only(tangents[0]), params, ids, values.dtype.type(sign), out
    parallel(motion_kernels.push, len(ids), *given, work=30 * len(ids))


def _pull(operands: Arrays, g: np.ndarray, results: Some, *, isovalue: float, sign: float) -> None:
    from rts_surfaces.implicit import motion_kernels

    values, params, ids = _checked(operands)
    if results[0] is not None:
        motion_kernels.pull(read_only(g), params, ids, values.dtype.type(sign), results[0])


ALONG_NORMAL = Operation(
    "rts_surfaces.along_normal",
    _specification,
    ranks=(1, 2, 2),
    shape=_shape,
    forward=_forward,
    push=_push,
    pull=_pull,
    packed=(1, 2),
    packed_result=True,
)
"""The operation of `along_normal`, on values, params and ids."""
