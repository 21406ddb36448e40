"""Weighted sums of rows and their derivatives, as compiled loops for arrays on the host.

`count` columns of `ids` (N, I), from `column` on, are indices of rows of (V, C). The first columns of weights (N, W)
belong to these rows. If `affine`, the weight of the last row is one minus the others: last + Σ wᵢ (rowᵢ − last).
Affine sums of three rows have loops of their own. Gradients are added up in the order of the samples. The loops of
values and tangents write NaN for samples with an id that names no row. The loops of gradients add nothing for them.
"""

from __future__ import annotations

import numpy as np

from rts.compiling.loops import compiled, loop
from rts.compiling.threads import parallel
from rts.errors import InputError


def check(rows: np.ndarray, ids: np.ndarray, column: int, count: int) -> None:
    """Raise an InputError if an id in the `count` columns from `column` on is no index of a row."""
    named = ids[:, column : column + count]
    if not named.size:
        return
    for index in (named.max(), named.min()):
        if not 0 <= index < len(rows):
            raise InputError(f"the ids of samples refer to row {index} of {len(rows)} rows; sample this surface anew")


def forward(
    rows: np.ndarray, weights: np.ndarray, ids: np.ndarray, out: np.ndarray, column: int, count: int, affine: bool
) -> None:
    """Fill `out` (N, C) with the weighted sums. An InputError if an id names no row."""
    check(rows, ids, column, count)
    _combine(rows, weights, ids, out, column, count, affine)


def _combine(rows, weights, ids, out, column, count, affine):
    if affine and count == 3:
        parallel(_interpolate, len(ids), rows, ids, column, weights, out, work=6 * len(ids))
    else:
        parallel(_sum, len(ids), rows, ids, column, count, affine, weights, out, work=3 * count * len(ids))


def push(
    rows: np.ndarray,
    weights: np.ndarray,
    ids: np.ndarray,
    t_rows: np.ndarray | None,
    t_weights: np.ndarray | None,
    out: np.ndarray,
    *,
    column: int,
    count: int,
    affine: bool,
) -> None:
    """Fill `out` (N, C) with the derivative along `t_rows` (V, C) and `t_weights` (N, W), each None if zero.

    Ids are not checked here, unlike in `forward`.
    """
    if t_rows is None:
        out[...] = 0
    else:
        _combine(t_rows, weights, ids, out, column, count, affine)
    if t_weights is None:
        return
    if affine and count == 3:
        parallel(_add_weighted, len(ids), rows, ids, column, t_weights, out, work=6 * len(ids))
    else:
        parallel(_add_sum, len(ids), rows, ids, column, count, affine, t_weights, out, work=3 * count * len(ids))


def pull(
    rows: np.ndarray,
    weights: np.ndarray,
    ids: np.ndarray,
    g: np.ndarray,
    g_rows: np.ndarray | None,
    g_weights: np.ndarray | None,
    *,
    column: int,
    count: int,
    affine: bool,
) -> None:
    """Pull back the gradient `g` (N, C) of the result: add to `g_rows` (V, C), fill `g_weights` (N, W), unless None.

    Entries of `g_weights` in columns that the sum does not use become 0.
    """
    if g_rows is not None:
        if affine and count == 3:
            _scatter(ids, column, weights, g, g_rows)
        else:
            _scatter_sum(ids, column, count, affine, weights, g, g_rows)
    if g_weights is not None:
        if affine and count == 3:
            parallel(_weigh, len(ids), rows, ids, column, g, g_weights, work=8 * len(ids))
        else:
            parallel(_weigh_sum, len(ids), rows, ids, column, count, affine, g, g_weights, work=3 * count * len(ids))


def differences(rows: np.ndarray, ids: np.ndarray, column: int) -> np.ndarray:
    """The differences (N, 2 C) of the first and the second of three rows to the third; NaN where an id names none."""
    out = np.empty((len(ids), 2 * rows.shape[1]), rows.dtype)
    parallel(_differences, len(ids), rows, ids, column, out, work=6 * len(ids))
    return out


# ------------------------------------------------------------------------------------------------- of any number


@compiled
def _all_known(ids, n, column, count, rows):
    """True if the ids of sample n, in the `count` columns from `column` on, are indices below `rows`."""
    known = True
    for i in range(column, column + count):
        known &= 0 <= ids[n, i] < rows
    return known


@loop
def _sum(start, stop, rows, ids, column, count, affine, weights, out):
    """Fill rows [start, stop) of `out` (N, C) with sums; NaN where an id names no row."""
    for n in range(start, stop):
        if not _all_known(ids, n, column, count, len(rows)):
            out[n] = np.nan
            continue
        last = ids[n, column + count - 1]
        for c in range(rows.shape[1]):
            out[n, c] = rows[last, c] if affine else weights[n, 0] * rows[ids[n, column], c]
        for i in range(0 if affine else 1, count - 1 if affine else count):
            w, r = weights[n, i], ids[n, column + i]
            for c in range(rows.shape[1]):
                out[n, c] += w * (rows[r, c] - rows[last, c] if affine else rows[r, c])


@loop
def _add_sum(start, stop, rows, ids, column, count, affine, weights, out):
    """Add sums without their constant, `last` of affine ones, to rows [start, stop) of `out` (N, C)."""
    for n in range(start, stop):
        if not _all_known(ids, n, column, count, len(rows)):
            out[n] = np.nan
            continue
        last = ids[n, column + count - 1]
        for i in range(count - 1 if affine else count):
            w, r = weights[n, i], ids[n, column + i]
            for c in range(rows.shape[1]):
                out[n, c] += w * (rows[r, c] - rows[last, c] if affine else rows[r, c])


@loop
def _scatter_sum(ids, column, count, affine, weights, g, g_rows):
    """Add to `g_rows` (V, C) the gradient of the rows `ids` of each sample, from that of the result, `g` (N, C)."""
    one = g.dtype.type(1)
    for n in range(len(ids)):
        if not _all_known(ids, n, column, count, len(g_rows)):
            continue
        rest = one
        for i in range(count):
            w = weights[n, i] if not affine or i < count - 1 else rest
            rest -= w
            for c in range(g.shape[1]):
                g_rows[ids[n, column + i], c] += w * g[n, c]


@loop
def _weigh_sum(start, stop, rows, ids, column, count, affine, g, g_weights):
    """Fill rows [start, stop) of `g_weights` (N, W) with the gradient of the weights, from `g` (N, C)."""
    for n in range(start, stop):
        g_weights[n] = 0
        if not _all_known(ids, n, column, count, len(rows)):
            continue
        last = ids[n, column + count - 1]
        for i in range(count - 1 if affine else count):
            total = g.dtype.type(0)
            r = ids[n, column + i]
            for c in range(g.shape[1]):
                total += g[n, c] * (rows[r, c] - rows[last, c] if affine else rows[r, c])
            g_weights[n, i] = total


# ---------------------------------------------------------------------------------------------------- of triangles


@compiled
def _known(a, b, c, count):
    return 0 <= a < count and 0 <= b < count and 0 <= c < count


@loop
def _interpolate(start, stop, rows, ids, column, weights, out):
    """`_sum` for affine sums of three rows."""
    for n in range(start, stop):
        a, b, c = ids[n, column], ids[n, column + 1], ids[n, column + 2]
        if not _known(a, b, c, len(rows)):
            out[n] = np.nan
            continue
        for i in range(rows.shape[1]):
            last = rows[c, i]
            out[n, i] = last + weights[n, 0] * (rows[a, i] - last) + weights[n, 1] * (rows[b, i] - last)


@loop
def _add_weighted(start, stop, rows, ids, column, weights, out):
    """`_add_sum` for affine sums of three rows."""
    for n in range(start, stop):
        a, b, c = ids[n, column], ids[n, column + 1], ids[n, column + 2]
        if not _known(a, b, c, len(rows)):
            out[n] = np.nan
            continue
        for i in range(rows.shape[1]):
            last = rows[c, i]
            out[n, i] += weights[n, 0] * (rows[a, i] - last) + weights[n, 1] * (rows[b, i] - last)


@loop
def _scatter(ids, column, weights, g, g_rows):
    """`_scatter_sum` for affine sums of three rows."""
    one = g.dtype.type(1)
    for n in range(len(ids)):
        a, b, c = ids[n, column], ids[n, column + 1], ids[n, column + 2]
        if not _known(a, b, c, len(g_rows)):
            continue
        u, v = weights[n, 0], weights[n, 1]
        w = one - u - v
        for i in range(g.shape[1]):
            x = g[n, i]
            if x != 0:
                g_rows[a, i] += u * x
                g_rows[b, i] += v * x
                g_rows[c, i] += w * x


@loop
def _weigh(start, stop, rows, ids, column, g, g_weights):
    """`_weigh_sum` for affine sums of three rows."""
    for n in range(start, stop):
        a, b, c = ids[n, column], ids[n, column + 1], ids[n, column + 2]
        u = v = g.dtype.type(0)
        if _known(a, b, c, len(rows)):
            for i in range(g.shape[1]):
                u += g[n, i] * (rows[a, i] - rows[c, i])
                v += g[n, i] * (rows[b, i] - rows[c, i])
        g_weights[n, 0], g_weights[n, 1], g_weights[n, 2:] = u, v, 0


@loop
def _differences(start, stop, rows, ids, column, out):
    """Fill rows [start, stop) of `out` (N, 2 C); see `differences`."""
    channels = rows.shape[1]
    for n in range(start, stop):
        known = _all_known(ids, n, column, 3, len(rows))
        a, b, c = (ids[n, column], ids[n, column + 1], ids[n, column + 2]) if known else (0, 0, 0)
        for k in range(channels if len(rows) else 0):
            out[n, k] = rows[a, k] - rows[c, k] if known else np.nan
            out[n, channels + k] = rows[b, k] - rows[c, k] if known else np.nan
