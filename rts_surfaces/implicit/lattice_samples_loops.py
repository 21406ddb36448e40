"""Parameters of an isosurface's samples, compiled."""

from __future__ import annotations

import numpy as np

from rts.plugin_api.loops import compiled, loop

LARGEST = 1e38
"""Larger motions, beyond single precision, become zero: where fields are flat to the last digit nothing moves."""


@compiled(inline="always")
def _place(number, lattice, out):
    shape, low, step = lattice
    out[0] = low[0] + step[0] * (number // (shape[1] * shape[2]))
    out[1] = low[1] + step[1] * (number // shape[2] % shape[1])
    out[2] = low[2] + step[2] * (number % shape[2])


@compiled(inline="always")
def corner(values, band, base, cell, i, shape):
    """The value at corner i of a cell: its lowest one has the number `base`; `cell` is its row in a band."""
    if band is None:
        return np.float64(values[base + ((i & 1) * shape[1] + (i >> 1 & 1)) * shape[2] + (i >> 2 & 1)])
    return np.float64(values[band[0][cell, i]])


@compiled(inline="always")
def _slope(field, band, cell, base, at, caps, out):
    """Fill the gradient (3,) of values interpolated within a cell; zero across sides that are capped."""
    values, (shape, low, step) = field.values, field.lattice
    x, y, z = base // (shape[1] * shape[2]), base // shape[2] % shape[1], base % shape[2]
    near_x = min(max((at[0] - low[0]) / step[0] - x, 0.0), 1.0)
    near_y = min(max((at[1] - low[1]) / step[1] - y, 0.0), 1.0)
    near_z = min(max((at[2] - low[2]) / step[2] - z, 0.0), 1.0)
    out[:] = 0
    for i in range(8):
        a, b, c = i & 1, i >> 1 & 1, i >> 2 & 1
        value = corner(values, band, base, cell, i, shape)
        along_x, along_y, along_z = (
            (near_x if a else 1 - near_x),
            (near_y if b else 1 - near_y),
            (near_z if c else 1 - near_z),
        )
        out[0] += (2 * a - 1) * along_y * along_z * value
        out[1] += (2 * b - 1) * along_x * along_z * value
        out[2] += (2 * c - 1) * along_x * along_y * value
    for i in range(3):
        out[i] = 0.0 if caps >> i & 1 else out[i] / step[i]


@loop
def fill(start, stop, field, band, ids, near, points, params, least):
    """Fill the lattice points and parameters of samples [start, stop).

    Args:
        start: the first sample.
        stop: the sample after the last.
        field: `Interpolated`.
        band: rows (C, 8) of the corners of a band's cells, and numbers (M,) of its points; None without one.
        ids: (N, 8) int32: the six ends of three edges, the cell, and its caps, see `marching_cubes.Triangles`.
        near: (N, 2), the first two barycentrics.
        points: (N, 6) int32, to be filled with the numbers of lattice points.
        params: (N, 16), to be filled with the barycentrics (3), the weights of the six values (6), the position (3),
            its motion for each unit of level (3), and the weighted sum of the six values less the isovalue.
        least: lower bound for the slope, by whose square motions are divided.
    """
    values, isovalue, sign, _, lattice = field
    a, b, at, slope = np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    for n in range(start, stop):
        params[n, 0], params[n, 1], params[n, 2] = near[n, 0], near[n, 1], 1 - near[n, 0] - near[n, 1]
        at[:] = 0
        level = 0.0
        for k in range(3):
            row_a, row_b, share = ids[n, 2 * k], ids[n, 2 * k + 1], np.float64(params[n, k])
            if band is None:
                number_a, number_b = np.int64(row_a), np.int64(row_b)
            else:
                number_a, number_b = np.int64(band[1][row_a]), np.int64(band[1][row_b])
            points[n, 2 * k], points[n, 2 * k + 1] = number_a, number_b
            _place(number_a, lattice, a)
            _place(number_b, lattice, b)
            f_a, f_b = np.float64(values[row_a]), np.float64(values[row_b])
            along = (isovalue - f_a) / (f_b - f_a) if f_a != f_b else 0.0
            for i in range(3):
                at[i] += share * (a[i] + along * (b[i] - a[i]))
            params[n, 3 + 2 * k], params[n, 4 + 2 * k] = share * (1 - along), share * along
            level += share * ((1 - along) * (f_a - isovalue) + along * (f_b - isovalue))
        cell = np.int64(ids[n, 6])
        base = cell if band is None else np.int64(band[1][band[0][cell, 0]])
        _slope(field, band, cell, base, at, ids[n, 7], slope)
        divisor = max(slope[0] * slope[0] + slope[1] * slope[1] + slope[2] * slope[2], least * least)
        for i in range(3):
            params[n, 9 + i] = at[i]
            moved = sign * slope[i] / divisor if divisor > 0 else 0.0
            params[n, 12 + i] = moved if abs(moved) < LARGEST else 0.0
        # Zero on the isosurface; within a cap samples move with the field's value there.
        params[n, 15] = level


@loop
def hand_on(start, stop, faces, ends, cells, caps, ids):
    """Fill the ids (T, 8) that samples take from triangles: the ends of three edges, the cell, and its caps."""
    for t in range(start, stop):
        for k in range(3):
            for i in range(2):
                ids[t, 2 * k + i] = ends[faces[t, k], i]
        ids[t, 6], ids[t, 7] = cells[t], caps[t]
