"""Interpolation over triangles, compiled for arrays on the host. Imported when first needed, since it imports numba."""

from __future__ import annotations

import numba
import numpy as np

from rts.threads import parallel


def interpolate(rows: np.ndarray, ids: np.ndarray, column: int, weights: np.ndarray) -> np.ndarray:
    """(N, C): c + w₀ (a − c) + w₁ (b − c), for the rows a, b, c that three columns of `ids` (N, I) name.

    Args:
        rows: (V, C) float.
        ids: (N, I) integers.
        column: the first of the three.
        weights: (N, 2) float.
    """
    out = np.empty((len(ids), rows.shape[1]), np.result_type(rows, weights))
    parallel(_interpolate, len(ids), np.ascontiguousarray(rows), ids, column, weights, out)
    return out


@numba.njit(cache=True, nogil=True)
def _interpolate(start, stop, rows, ids, column, weights, out):
    for n in range(start, stop):
        a, b, c = ids[n, column], ids[n, column + 1], ids[n, column + 2]
        for i in range(rows.shape[1]):
            last = rows[c, i]
            out[n, i] = last + weights[n, 0] * (rows[a, i] - last) + weights[n, 1] * (rows[b, i] - last)
