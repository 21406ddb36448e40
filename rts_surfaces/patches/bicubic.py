"""Points and normals of bicubic Bézier patches at samples, differentiable in the control points."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from rts import InputError, namespace
from rts.plugin_api.arrays import Array, unit
from rts.plugin_api.operations import Operation, combine

COLLAPSED = 1e-4
"""A tangent shorter than this share of the other one counts as zero, and the mixed derivative replaces it in the
normal."""


def values(rows: Array, table: Array, patch: Array, params: Array) -> Array:
    """Values (N, C) of patches at samples.

    Args:
        rows: (V, C) float, control points or their attributes; differentiable.
        table: (n, 16) integers, the rows of each patch, first along u, then along v.
        patch: (N,) integers, the patch of each sample.
        params: (N, 2), u and v; of the dtype of the rows, constant.
    """
    return VALUES(rows, params, patch, table)


def normals(rows: Array, table: Array, patch: Array, params: Array) -> Array:
    """Unit normals (N, 3): cross products of the derivatives along u and v; arguments as for `values`, C = 3.

    Where one side of a patch is a single point, one of the two derivatives is zero, and beside it mostly rounding. The
    mixed derivative has the direction in which that one grows, and replaces it. A normal that does not exist is zero.
    """
    return NORMALS(rows, params, patch, table)


def slopes(rows: Array, table: Array, patch: Array, params: Array) -> tuple[Array, Array]:
    """Derivatives (N, C) along u, and along v; arguments as for `values`."""
    ids = namespace(table, patch).take(table, patch, axis=0)
    (a, da), (b, db) = (_bernstein(params[:, i]) for i in range(2))
    return _sum(rows, ids, da, b), _sum(rows, ids, a, db)


def _bernstein(t: Array) -> tuple[Array, Array]:
    """The four cubic Bernstein polynomials (N, 4) at (N,), and their derivatives."""
    xp, s = namespace(t), 1 - t
    value = xp.stack([s * s * s, 3 * s * s * t, 3 * s * t * t, t * t * t], axis=-1)
    slope = xp.stack([-3 * s * s, 3 * s * (s - 2 * t), 3 * t * (2 * s - t), 3 * t * t], axis=-1)
    return value, slope


def _sum(rows: Array, ids: Array, a: Array, b: Array) -> Array:
    """Sums (N, C) of rows (V, C) at ids (N, 16), weighted by products of the weights a (N, 4) along u, b along v."""
    return combine(rows, ids, namespace(a).reshape(a[:, :, None] * b[:, None, :], (-1, 16)))


def _specified_values(rows: Array, params: Array, patch: Array, table: Array) -> Array:
    ids = namespace(table, patch).take(table, patch, axis=0)
    return _sum(rows, ids, _bernstein(params[:, 0])[0], _bernstein(params[:, 1])[0])


def _specified_normals(rows: Array, params: Array, patch: Array, table: Array) -> Array:
    xp = namespace(rows, params)
    ids = namespace(table, patch).take(table, patch, axis=0)
    (a, da), (b, db) = (_bernstein(params[:, i]) for i in range(2))
    along_u, along_v, mixed = (_sum(rows, ids, *w) for w in ((da, b), (a, db), (da, db)))
    uu, vv = (xp.sum(x * x, axis=-1, keepdims=True) for x in (along_u, along_v))
    sign_u, sign_v = (xp.where(params[:, i : i + 1] < 0.5, xp.ones_like(uu), -xp.ones_like(uu)) for i in range(2))
    # Along a side v = 0 that is a point, the derivative in u is zero; along u = 0, that in v.
    first = xp.where(uu < COLLAPSED**2 * vv, sign_v * mixed, along_u)
    second = xp.where(vv < COLLAPSED**2 * uu, sign_u * mixed, along_v)
    return unit(xp.linalg.cross(first, second))


def _check(rows: np.ndarray, params: np.ndarray, patch: np.ndarray, table: np.ndarray) -> None:
    if params.shape != (len(patch), 2) or table.shape[1] != 16:
        raise InputError(
            f"params and patches have shapes {params.shape} and {patch.shape}, the table has {table.shape}; expected "
            f"(N, 2), (N,) and (n, 16)"
        )
    for what, named, count in (("patches", patch, len(table)), ("control points", table, len(rows))):
        if named.size and not 0 <= named.min() <= named.max() < count:
            raise InputError(
                f"samples refer to {what} {named.min()} to {named.max()} of {count}; sample this surface anew"
            )


def _value_shape(rows: tuple[int, ...], params: tuple[int, ...], *_: tuple[int, ...]) -> tuple[int, ...]:
    return params[0], rows[1]


def _value_loops() -> tuple[Callable, Callable, Callable]:
    from rts_surfaces.patches import bicubic_loops as loops

    return loops.values, loops.push_values, loops.pull_values


def _normal_shape(rows: tuple[int, ...], params: tuple[int, ...], *_: tuple[int, ...]) -> tuple[int, ...]:
    return params[0], 3


def _normal_loops() -> tuple[Callable, Callable, Callable]:
    from rts_surfaces.patches import bicubic_normals_loops as loops

    forward, push, pull = loops.normals, loops.push_normals, loops.pull_normals
    return partial(forward, COLLAPSED), partial(push, COLLAPSED), partial(pull, COLLAPSED)


_PACKED: dict[str, Any] = {"packed": (1, 2), "packed_result": True}
VALUES = Operation.of_loops(
    "rts_surfaces.bicubic_values", _specified_values, (2, 2, 1, 2), _value_shape, _value_loops, _check, **_PACKED
)
NORMALS = Operation.of_loops(
    "rts_surfaces.bicubic_normals", _specified_normals, (2, 2, 1, 2), _normal_shape, _normal_loops, _check, **_PACKED
)
"""The operations of `values` and `normals`, both of rows, params, patch and table."""
