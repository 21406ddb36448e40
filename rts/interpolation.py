"""Interpolation over triangles and its derivatives, compiled for arrays on the host. It imports numba.

Three columns of `ids` (N, I), from `column`, name rows a, b, c of (V, C); weights are (N, W), of which the first two
count, and the result c + w₀ (a − c) + w₁ (b − c) is (N, C). An id of no row gives NaN, and no gradient.
"""

from __future__ import annotations

import numba
import numpy as np

from rts.errors import InputError
from rts.threads import parallel, read_all


def check(rows: np.ndarray, ids: np.ndarray, column: int) -> None:
    """Raise an InputError where ids name no row."""
    named = ids[:, column : column + 3]
    if not named.size:
        return
    for index in (named.max(), named.min()):
        if not 0 <= index < len(rows):
            raise InputError(f"samples refer to row {index} of an array of {len(rows)}; sample this surface anew")


def interpolate(
    rows: np.ndarray, ids: np.ndarray, column: int, weights: np.ndarray, out: np.ndarray | None = None
) -> np.ndarray:
    """The result (N, C), into `out` where that is given."""
    if out is None:
        out = np.empty((len(ids), rows.shape[1]), np.result_type(rows, weights))
    parallel(_interpolate, len(ids), *read_all(rows, ids), column, *read_all(weights), out, work=8 * len(ids))
    return out


def push(
    rows: np.ndarray,
    ids: np.ndarray,
    column: int,
    weights: np.ndarray,
    t_rows: np.ndarray | None,
    t_weights: np.ndarray | None,
    out: np.ndarray,
) -> None:
    """Fill `out` (N, C) with the tangent along those of rows (V, C) and weights (N, 2), or None for zeros."""
    if t_rows is None:
        out[...] = 0
    else:
        interpolate(t_rows, ids, column, weights, out)
    if t_weights is not None:
        given = read_all(rows, ids), read_all(t_weights)
        parallel(_add_weighted, len(ids), *given[0], column, *given[1], out)


def pull(
    rows: np.ndarray,
    ids: np.ndarray,
    column: int,
    weights: np.ndarray,
    g: np.ndarray,
    g_rows: np.ndarray | None,
    g_weights: np.ndarray | None,
) -> None:
    """From the gradient of the result (N, C) add to that of rows (V, C), and fill that of weights (N, 2).

    Both may be None, where they are not wanted. Sums are taken in the order of the samples.
    """
    if g_rows is not None:
        _scatter(*read_all(ids), column, *read_all(weights, g), g_rows)
    if g_weights is not None:
        parallel(_weigh, len(ids), *read_all(rows, ids), column, *read_all(g), g_weights)


@numba.njit
def _known(a, b, c, count):
    return 0 <= a < count and 0 <= b < count and 0 <= c < count


@numba.njit(cache=True, nogil=True)
def _interpolate(start, stop, rows, ids, column, weights, out):
    for n in range(start, stop):
        a, b, c = ids[n, column], ids[n, column + 1], ids[n, column + 2]
        if not _known(a, b, c, len(rows)):
            out[n] = np.nan
            continue
        for i in range(rows.shape[1]):
            last = rows[c, i]
            out[n, i] = last + weights[n, 0] * (rows[a, i] - last) + weights[n, 1] * (rows[b, i] - last)


@numba.njit(cache=True, nogil=True)
def _add_weighted(start, stop, rows, ids, column, weights, out):
    for n in range(start, stop):
        a, b, c = ids[n, column], ids[n, column + 1], ids[n, column + 2]
        if not _known(a, b, c, len(rows)):
            out[n] = np.nan
            continue
        for i in range(rows.shape[1]):
            last = rows[c, i]
            out[n, i] += weights[n, 0] * (rows[a, i] - last) + weights[n, 1] * (rows[b, i] - last)


@numba.njit(cache=True, nogil=True)
def _scatter(ids, column, weights, g, g_rows):
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


@numba.njit(cache=True, nogil=True)
def _weigh(start, stop, rows, ids, column, g, g_weights):
    for n in range(start, stop):
        a, b, c = ids[n, column], ids[n, column + 1], ids[n, column + 2]
        u = v = g.dtype.type(0)
        if _known(a, b, c, len(rows)):
            for i in range(g.shape[1]):
                u += g[n, i] * (rows[a, i] - rows[c, i])
                v += g[n, i] * (rows[b, i] - rows[c, i])
        g_weights[n, 0], g_weights[n, 1], g_weights[n, 2:] = u, v, 0
