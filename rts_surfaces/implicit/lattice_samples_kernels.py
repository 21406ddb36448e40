"""What samples of an isosurface carry, compiled."""

from __future__ import annotations

import numba
import numpy as np


@numba.njit(nogil=True, inline="always")
def _place(number, shape, low, step, out):
    out[0] = low[0] + step[0] * (number // (shape[1] * shape[2]))
    out[1] = low[1] + step[1] * (number // shape[2] % shape[1])
    out[2] = low[2] + step[2] * (number % shape[2])


@numba.njit(cache=True, nogil=True)
def fill(
    start, stop, values, isovalue, sign, numbers, corners, shape, low, step, ids, weights, points, params, slopes, apart
):
    """Fill what samples `start` to `stop` carry.

    Args:
        start: the first sample.
        stop: the sample after the last.
        values: (M,), of all lattice points by number, or of those of a band by row.
        isovalue: see `marching_cubes.of_lattice`.
        sign: see `marching_cubes.of_lattice`.
        numbers: (M,) of the points of a band; empty where all points are known.
        corners: (C, 8), rows of the corners of the cells of a band; empty likewise.
        shape: (X, Y, Z).
        low: (3,), the first point.
        step: (3,).
        ids: (N, 8) int32: the ends of three edges, the cell, and the axes along which it is capped.
        weights: (N, 2), barycentrics.
        points: (N, 6) int32, to be filled with the numbers of lattice points.
        params: (N, 12), to be filled: barycentrics (3), weights of the six values (6), the sample's place (3).
        slopes: (N, 3), to be filled with the level's gradient within the cell, along the side where it is capped.
        apart: (N, 3), to be filled: by how much the values at the ends of edges differ; 0 where they are one point.
    """
    banded = len(numbers) > 0
    a, b, lowest = np.empty(3), np.empty(3), np.empty(3)
    at, near, slope = np.empty(3), np.empty((3, 2)), np.empty(3)
    corner = np.empty(8)
    for n in range(start, stop):
        params[n, 0], params[n, 1], params[n, 2] = weights[n, 0], weights[n, 1], 1 - weights[n, 0] - weights[n, 1]
        at[:] = 0
        for k in range(3):
            row_a, row_b, share = ids[n, 2 * k], ids[n, 2 * k + 1], np.float64(params[n, k])
            number_a, number_b = (np.int64(numbers[row_a]), np.int64(numbers[row_b])) if banded else (row_a, row_b)
            points[n, 2 * k], points[n, 2 * k + 1] = number_a, number_b
            _place(number_a, shape, low, step, a)
            _place(number_b, shape, low, step, b)
            f_a, f_b = np.float64(values[row_a]), np.float64(values[row_b])
            along = (isovalue - f_a) / (f_b - f_a) if f_a != f_b else 0.0
            for i in range(3):
                at[i] += share * (a[i] + along * (b[i] - a[i]))
            real = row_a != row_b
            params[n, 3 + 2 * k], params[n, 4 + 2 * k] = real * share * (1 - along), real * share * along
            apart[n, k] = abs(f_b - f_a)
        cell = ids[n, 6]
        base = np.int64(numbers[corners[cell, 0]]) if banded else np.int64(cell)
        _place(base, shape, low, step, lowest)
        for i in range(8):
            if banded:
                corner[i] = values[corners[cell, i]]
            else:
                corner[i] = values[base + ((i & 1) * shape[1] + (i >> 1 & 1)) * shape[2] + (i >> 2 & 1)]
        for i in range(3):
            params[n, 9 + i] = at[i]
            near[i, 1] = min(max((at[i] - lowest[i]) / step[i], 0.0), 1.0)
            near[i, 0] = 1 - near[i, 1]
        slope[:] = 0
        for i in range(8):
            x, y, z = i & 1, i >> 1 & 1, i >> 2 & 1
            slope[0] += (2 * x - 1) * near[1, y] * near[2, z] * corner[i]
            slope[1] += (2 * y - 1) * near[0, x] * near[2, z] * corner[i]
            slope[2] += (2 * z - 1) * near[0, x] * near[1, y] * corner[i]
        for i in range(3):
            slopes[n, i] = 0 if ids[n, 7] >> i & 1 else sign * slope[i] / step[i]
