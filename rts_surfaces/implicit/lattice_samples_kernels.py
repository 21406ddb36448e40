"""What samples of an isosurface carry, compiled."""

from __future__ import annotations

import numba
import numpy as np

LARGEST = 1e38
"""What is larger is no number of single precision: fields that are flat to the last digit move nothing."""


@numba.njit(nogil=True, inline="always")
def _place(number, shape, low, step, out):
    out[0] = low[0] + step[0] * (number // (shape[1] * shape[2]))
    out[1] = low[1] + step[1] * (number // shape[2] % shape[1])
    out[2] = low[2] + step[2] * (number % shape[2])


@numba.njit(cache=True, nogil=True)
def fill(
    start, stop, values, isovalue, sign, numbers, corners, shape, low, step, ids, near, points, params, squares, apart
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
        near: (N, 2), barycentrics.
        points: (N, 6) int32, to be filled with the numbers of lattice points.
        params: (N, 15), to be filled: barycentrics (3), weights of the six values (6), the sample's place (3), and the
            level's gradient within the cell (3), along the side where it is capped.
        squares: (N,), to be filled with the square of the gradient's length.
        apart: (N, 3), to be filled: by how much the values at the ends of edges differ; 0 where they are one point.
    """
    banded = len(numbers) > 0
    a, b, lowest = np.empty(3), np.empty(3), np.empty(3)
    at, beside, slope = np.empty(3), np.empty((3, 2)), np.empty(3)
    corner = np.empty(8)
    for n in range(start, stop):
        params[n, 0], params[n, 1], params[n, 2] = near[n, 0], near[n, 1], 1 - near[n, 0] - near[n, 1]
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
            beside[i, 1] = min(max((at[i] - lowest[i]) / step[i], 0.0), 1.0)
            beside[i, 0] = 1 - beside[i, 1]
        slope[:] = 0
        for i in range(8):
            x, y, z = i & 1, i >> 1 & 1, i >> 2 & 1
            slope[0] += (2 * x - 1) * beside[1, y] * beside[2, z] * corner[i]
            slope[1] += (2 * y - 1) * beside[0, x] * beside[2, z] * corner[i]
            slope[2] += (2 * z - 1) * beside[0, x] * beside[1, y] * corner[i]
        squares[n] = 0
        for i in range(3):
            along = 0.0 if ids[n, 7] >> i & 1 else sign * slope[i] / step[i]
            params[n, 12 + i] = along
            squares[n] += along * along


@numba.njit(cache=True, nogil=True)
def divide(start, stop, squares, least, params):
    """Turn gradients into how samples move for each unit of level: divide by their square, or by `least` if larger."""
    for n in range(start, stop):
        divisor = max(squares[n], least)
        for i in range(12, 15):
            moved = params[n, i] / divisor if divisor > 0 else 0.0
            params[n, i] = moved if abs(moved) < LARGEST else 0.0


@numba.njit(cache=True, nogil=True)
def name(start, stop, faces, ends, cells, caps, ids):
    """Fill what triangles hand on to samples, (T, 8): the ends of three edges, the cell, and where it is capped."""
    for t in range(start, stop):
        for k in range(3):
            for i in range(2):
                ids[t, 2 * k + i] = ends[faces[t, k], i]
        ids[t, 6], ids[t, 7] = cells[t], caps[t]
