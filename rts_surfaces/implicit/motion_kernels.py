"""Samples moved along the field's gradient, and the derivatives, compiled. See `rts_surfaces.implicit.motion`."""

from __future__ import annotations

import numba


@numba.njit(cache=True, nogil=True)
def move(start, stop, values, params, ids, isovalue, sign, out):
    """Fill the places (N, 3) of samples `start` to `stop`."""
    for n in range(start, stop):
        level = values.dtype.type(0)
        for i in range(6):
            level += params[n, 3 + i] * (values[ids[n, i]] - isovalue)
        for i in range(3):
            out[n, i] = params[n, 9 + i] - sign * level * params[n, 12 + i]


@numba.njit(cache=True, nogil=True)
def push(start, stop, tangents, params, ids, sign, out):
    """Fill the derivatives (N, 3) along tangents (M,) of the values."""
    for n in range(start, stop):
        level = tangents.dtype.type(0)
        for i in range(6):
            level += params[n, 3 + i] * tangents[ids[n, i]]
        for i in range(3):
            out[n, i] = -sign * level * params[n, 12 + i]


@numba.njit(cache=True, nogil=True)
def pull(g, params, ids, sign, results):
    """Add the gradients (M,) of the values, of those (N, 3) of the places."""
    for n in range(len(ids)):
        along = g[n, 0] * params[n, 12] + g[n, 1] * params[n, 13] + g[n, 2] * params[n, 14]
        if along != 0:
            for i in range(6):
                results[ids[n, i]] -= sign * along * params[n, 3 + i]
