"""Points and normals of bicubic Bézier patches at samples, differentiable in the control points."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rts import InputError, namespace
from rts.plugin_api.arrays import Array, unit
from rts.plugin_api.operations import Operation, combine
from rts.plugin_api.threads import parallel, read_only

COLLAPSED = 1e-4
"""A tangent is taken for zero, and the normal from the mixed derivative, where it is less than this share of the
other."""
SHARES = 4
"""Parts of the samples whose gradients are added up by themselves: a fixed number, so that sums do not depend on how
many threads there are."""


def values(rows: Array, table: Array, patch: Array, params: Array) -> Array:
    """(N, C): patches at samples.

    Args:
        rows: (V, C) float, control points or attributes of theirs; differentiable.
        table: (n, 16) integers, the rows of each patch, first along u, then along v.
        patch: (N,) integers.
        params: (N, 2), u and v; of the dtype of the rows, constant.
    """
    return VALUES(rows, params, patch, table)


def normals(rows: Array, table: Array, patch: Array, params: Array) -> Array:
    """(N, 3) unit normals: of the derivatives along u and v, in this order; arguments as for `values`, C = 3.

    Where one side of a patch is a single point, one derivative is zero there, and rounding beside it. It grows as the
    mixed derivative: that has its direction. Where there is no normal, it is zero.
    """
    return NORMALS(rows, params, patch, table)


def _bernstein(t: Array) -> tuple[Array, Array]:
    """The four cubic Bernstein polynomials (N, 4) at (N,), and their derivatives."""
    xp, s = namespace(t), 1 - t
    value = xp.stack([s * s * s, 3 * s * s * t, 3 * s * t * t, t * t * t], axis=-1)
    slope = xp.stack([-3 * s * s, 3 * s * (s - 2 * t), 3 * t * (2 * s - t), 3 * t * t], axis=-1)
    return value, slope


def _sum(rows: Array, ids: Array, a: Array, b: Array) -> Array:
    """Sums of the rows (N, 16), weighted by the products of weights along u (N, 4) and along v (N, 4)."""
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


def _nets(rows: np.ndarray, operands: Sequence[np.ndarray]) -> np.ndarray:
    """The control points (n, 16, C) of all patches; operands that do not fit one another are refused."""
    from rts_surfaces import bicubic_loops

    _, params, patch, table = operands
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
    nets = np.empty((len(table), 16, rows.shape[1]), rows.dtype)
    parallel(bicubic_loops.gather, len(table), rows, table, nets, work=50 * len(table))
    return nets


def _shares(nets: np.ndarray) -> np.ndarray:
    """Zeros (SHARES, n, 16, C) to add gradients to."""
    return np.zeros((SHARES, *nets.shape), nets.dtype)


def _value_shape(rows: tuple[int, ...], params: tuple[int, ...], *_: tuple[int, ...]) -> tuple[int, ...]:
    return params[0], rows[1]


def _sums(rows: np.ndarray, operands: Sequence[np.ndarray], out: np.ndarray) -> None:
    from rts_surfaces import bicubic_loops

    _, params, patch, _ = operands
    parallel(bicubic_loops.values, len(out), _nets(rows, operands), patch, params, out, work=30 * len(out))


def _values(operands: Sequence[np.ndarray], out: np.ndarray) -> None:
    _sums(operands[0], operands, out)


def _push_values(operands: Sequence[np.ndarray], tangents: Sequence[np.ndarray | None], out: np.ndarray) -> None:
    _sums(read_only(tangents[0]), operands, out)  # pyright: ignore[reportArgumentType]  # Only rows have tangents.


def _pull_values(operands: Sequence[np.ndarray], g: np.ndarray, results: Sequence[np.ndarray | None]) -> None:
    from rts_surfaces import bicubic_loops

    if results[0] is not None:
        _, params, patch, table = operands
        shares = _shares(_nets(results[0], operands))
        parallel(bicubic_loops.pull_values, len(shares), patch, params, read_only(g), shares, work=30 * len(g))
        bicubic_loops.scatter(table, shares, results[0])


def _normal_shape(rows: tuple[int, ...], params: tuple[int, ...], *_: tuple[int, ...]) -> tuple[int, ...]:
    return params[0], 3


def _normals(operands: Sequence[np.ndarray], out: np.ndarray) -> None:
    from rts_surfaces import bicubic_loops

    rows, params, patch, _ = operands
    arguments = _nets(rows, operands), patch, params, rows.dtype.type(COLLAPSED)
    parallel(bicubic_loops.normals, len(out), *arguments, out, work=60 * len(out))


def _push_normals(operands: Sequence[np.ndarray], tangents: Sequence[np.ndarray | None], out: np.ndarray) -> None:
    from rts_surfaces import bicubic_loops

    rows, params, patch, _ = operands
    moved = _nets(read_only(tangents[0]), operands)  # pyright: ignore[reportArgumentType]  # Only rows have tangents.
    arguments = _nets(rows, operands), moved, patch, params, rows.dtype.type(COLLAPSED)
    parallel(bicubic_loops.push_normals, len(out), *arguments, out, work=120 * len(out))


def _pull_normals(operands: Sequence[np.ndarray], g: np.ndarray, results: Sequence[np.ndarray | None]) -> None:
    from rts_surfaces import bicubic_loops

    if results[0] is not None:
        rows, params, patch, table = operands
        nets = _nets(rows, operands)
        shares = _shares(nets)
        arguments = nets, patch, params, rows.dtype.type(COLLAPSED), read_only(g), shares
        parallel(bicubic_loops.pull_normals, len(shares), *arguments, work=80 * len(g))
        bicubic_loops.scatter(table, shares, results[0])


VALUES = Operation(
    "rts_surfaces.bicubic_values",
    _specified_values,
    ranks=(2, 2, 1, 2),
    shape=_value_shape,
    forward=_values,
    push=_push_values,
    pull=_pull_values,
    packed=(1, 2),
    packed_result=True,
)
NORMALS = Operation(
    "rts_surfaces.bicubic_normals",
    _specified_normals,
    ranks=(2, 2, 1, 2),
    shape=_normal_shape,
    forward=_normals,
    push=_push_normals,
    pull=_pull_normals,
    packed=(1, 2),
    packed_result=True,
)
"""Both on rows, params, patch and table."""
