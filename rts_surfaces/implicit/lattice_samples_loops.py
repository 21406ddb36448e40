"""Parameters of an isosurface's samples, compiled."""

from __future__ import annotations

import numpy as np

from rts.plugin_api.loops import compiled, loop
from rts_surfaces.implicit.casting import APART, FIRST, GROWTH, HALVINGS, MARCH, REACH
from rts_surfaces.implicit.narrow_band_loops import row_at

LARGEST = 1e38
"""Larger motions, beyond single precision, become zero: where fields are flat to the last digit nothing moves."""


@compiled(inline="always")
def _place(number, shape, low, step, out):
    out[0] = low[0] + step[0] * (number // (shape[1] * shape[2]))
    out[1] = low[1] + step[1] * (number // shape[2] % shape[1])
    out[2] = low[2] + step[2] * (number % shape[2])


@compiled(inline="always")
def _corner(values, band, base, cell, i, shape):
    """The value at corner i of a cell: its lowest one has the number `base`; `cell` is its row in a band."""
    if band is None:
        return np.float64(values[base + ((i & 1) * shape[1] + (i >> 1 & 1)) * shape[2] + (i >> 2 & 1)])
    return np.float64(values[band[0][cell, i]])


@compiled(inline="always")
def _slope(values, band, cell, base, at, shape, low, step, caps, out):
    """Fill the gradient (3,) of values interpolated within a cell; zero across sides that are capped."""
    x, y, z = base // (shape[1] * shape[2]), base // shape[2] % shape[1], base % shape[2]
    near_x = min(max((at[0] - low[0]) / step[0] - x, 0.0), 1.0)
    near_y = min(max((at[1] - low[1]) / step[1] - y, 0.0), 1.0)
    near_z = min(max((at[2] - low[2]) / step[2] - z, 0.0), 1.0)
    out[:] = 0
    for i in range(8):
        a, b, c = i & 1, i >> 1 & 1, i >> 2 & 1
        value = _corner(values, band, base, cell, i, shape)
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
def fill(start, stop, values, isovalue, sign, band, shape, low, step, ids, near, points, params, least):
    """Fill the lattice points and parameters of samples [start, stop).

    Args:
        start: the first sample.
        stop: the sample after the last.
        values: (M,), of all lattice points, indexed by number, or of a band's points, indexed by row.
        isovalue: see `marching_cubes.of_lattice`.
        sign: see `marching_cubes.of_lattice`.
        band: rows (C, 8) of the corners of a band's cells, and numbers (M,) of its points; None without one.
        shape: (X, Y, Z).
        low: (3,), the first point.
        step: (3,), the distance of neighbours along each axis.
        ids: (N, 8) int32: the six ends of three edges, the cell, and its caps, see `marching_cubes.Triangles`.
        near: (N, 2), the first two barycentrics.
        points: (N, 6) int32, to be filled with the numbers of lattice points.
        params: (N, 4), of which the barycentrics (3) are filled; or (N, 16), filled with the barycentrics, the weights
            of the six values (6), the position (3), its motion for each unit of level (3), and the weighted sum of the
            six values less the isovalue.
        least: lower bound for the slope, by whose square motions are divided.
    """
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
            if params.shape[1] == 4:
                continue
            _place(number_a, shape, low, step, a)
            _place(number_b, shape, low, step, b)
            f_a, f_b = np.float64(values[row_a]), np.float64(values[row_b])
            along = (isovalue - f_a) / (f_b - f_a) if f_a != f_b else 0.0
            for i in range(3):
                at[i] += share * (a[i] + along * (b[i] - a[i]))
            params[n, 3 + 2 * k], params[n, 4 + 2 * k] = share * (1 - along), share * along
            level += share * ((1 - along) * (f_a - isovalue) + along * (f_b - isovalue))
        if params.shape[1] == 4:
            continue
        cell = np.int64(ids[n, 6])
        base = cell if band is None else np.int64(band[1][band[0][cell, 0]])
        _slope(values, band, cell, base, at, shape, low, step, ids[n, 7], slope)
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


@compiled
def _level(values, band, isovalue, sign, capped, shape, low, step, at, near, slope):
    """The level at a point, interpolated along each axis.

    Fills `near`, the point's places in its cell, 0 to 1 along each axis, and the gradient `slope`. Beyond the bounds,
    and where a band has no cell, the level is infinite and the gradient NaN; if `capped`, the level beyond the bounds
    is at least the distance beyond them.

    Returns:
        The level, the number of the cell's lowest corner, the cell's row in a band, and True if a cap decides.
    """
    side, beyond, base, cell = 0, -np.inf, 0, 0
    for i in range(3):
        place = (at[i] - low[i]) / step[i]
        over = max(-place, place - (shape[i] - 1)) * step[i]
        if over > beyond:
            side, beyond = i, over
        lowest = min(max(int(np.floor(place)), 0), shape[i] - 2)
        base, near[i] = base * shape[i] + lowest, min(max(place - lowest, 0.0), 1.0)
    if band is not None:
        across = base // shape[2]
        cell = row_at(across // shape[1], across % shape[1], base % shape[2], shape, band[1], band[2])
    if (beyond > 0 and not capped) or cell < 0:
        slope[:] = np.nan
        return np.inf, 0, 0, True
    # Along x, then along y, then along z.
    x, y, z = near
    f00, f01 = _corner(values, band, base, cell, 0, shape), _corner(values, band, base, cell, 4, shape)
    f10, f11 = _corner(values, band, base, cell, 2, shape), _corner(values, band, base, cell, 6, shape)
    d00, d01 = _corner(values, band, base, cell, 1, shape) - f00, _corner(values, band, base, cell, 5, shape) - f01
    d10, d11 = _corner(values, band, base, cell, 3, shape) - f10, _corner(values, band, base, cell, 7, shape) - f11
    f0, f1 = f00 + x * d00, f01 + x * d01
    e0, e1 = f10 + x * d10 - f0, f11 + x * d11 - f1
    f0, f1 = f0 + y * e0, f1 + y * e1
    level = sign * (f0 + z * (f1 - f0) - isovalue)
    d0, d1 = d00 + y * (d10 - d00), d01 + y * (d11 - d01)
    slope[0] = sign * (d0 + z * (d1 - d0)) / step[0]
    slope[1] = sign * (e0 + z * (e1 - e0)) / step[1]
    slope[2] = sign * (f1 - f0) / step[2]
    if capped and beyond > level:
        upper = at[side] > low[side]
        slope[0], slope[1], slope[2] = 0.0, 0.0, 0.0
        slope[side] = 1.0 if upper else -1.0
        return beyond, base, cell, True
    return level, base, cell, False


@compiled
def _along(start, direction, t, out):
    for i in range(3):
        out[i] = start[i] + t * direction[i]


@loop
def deepest(
    start,
    stop,
    values,
    band,
    isovalue,
    sign,
    capped,
    shape,
    low,
    step,
    origins,
    directions,
    depth,
    spread,
    points,
    params,
    there,
):
    """Fill pairs of samples beside the deepest points of rays [start, stop); see `casting.deepest`.

    Args:
        start: the first ray.
        stop: the ray after the last.
        values: see `fill`.
        band: rows (C, 8) of the corners of a band's cells; and the rows of these cells, by the places of their lowest
            corners, see `narrow_band.rows_by_place`. None without a band.
        isovalue: see `fill`.
        sign: see `fill`.
        capped: True if the surface is closed at the bounds.
        shape: see `fill`.
        low: see `fill`.
        step: see `fill`.
        origins: (R, 3), of `rts.plugin_api.records.Rays`.
        directions: (R, 3), also of `Rays`.
        depth: (R,), depths of the surface's points on the rays.
        spread: (2,), of `Rays`.
        points: (R, 2, 6) int32, to be filled with the numbers of lattice points.
        params: (R, 2, 16), zeros, to be filled as in `fill`, with barycentrics of zero.
        there: (R,) bool, to be filled: rays that have a pair.
    """
    first, unit, at = np.empty(3), np.empty(3), np.empty(3)
    slope, near, ends = np.empty(3), np.empty(3), np.empty((2, 3))
    for n in range(start, stop):
        there[n] = False
        length = np.sqrt(directions[n, 0] ** 2 + directions[n, 1] ** 2 + directions[n, 2] ** 2)
        for i in range(3):
            first[i], unit[i] = origins[n, i] + depth[n] * directions[n, i], directions[n, i] / length
        reach = REACH * (spread[0] + spread[1] * depth[n])
        # A kink of the field spreads over a cell; where cells are wider than pixels it is a face.
        apart = max(APART * reach, min(0.5 * min(step), reach / 6))
        # Steps that grow pass the deepest point.
        before, t, move = 0.0, 0.0, FIRST * reach
        value, _, _, _ = _level(values, band, isovalue, sign, capped, shape, low, step, first, near, slope)
        a, b, after = 0.0, 0.0, value
        for _ in range(MARCH):
            _along(first, unit, t + move, at)
            after, _, _, _ = _level(values, band, isovalue, sign, capped, shape, low, step, at, near, slope)
            if after > value:
                a, b = before, t + move
                break
            before, t, move, value = t, t + move, GROWTH * move, after
        if b == 0:  # It falls all along.
            continue
        for _ in range(HALVINGS // 2):
            middle = (a + b) / 2
            _along(first, unit, middle, at)
            _level(values, band, isovalue, sign, capped, shape, low, step, at, near, slope)
            if slope[0] * unit[0] + slope[1] * unit[1] + slope[2] * unit[2] < 0:
                a = middle
            else:
                b = middle
        a, b, level = max(a - apart, 0.0), b + apart, 0.0
        falls, rises = 0.0, 0.0
        for k in range(2):
            _along(first, unit, b if k else a, at)
            value, base, cell, cap = _level(values, band, isovalue, sign, capped, shape, low, step, at, near, ends[k])
            rate = ends[k, 0] * unit[0] + ends[k, 1] * unit[1] + ends[k, 2] * unit[2]
            if k:
                rises = max(rate, 0.0)
            else:
                falls = max(-rate, 0.0)
            level += value / 2
            if not np.isfinite(value):  # It falls until it leaves an open surface through its bounds, or the band.
                break
            _tetrahedron(values, band, isovalue, base, cell, shape, at, near, points[n, k], params[n, k])
            params[n, k, 15] = np.nan if cap else params[n, k, 15]
        share = rises / (falls + rises) if falls + rises > 0 else 0.5
        across, square = 0.0, 0.0
        for i in range(3):
            slope[i] = share * ends[0, i] + (1 - share) * ends[1, i]
            across += slope[i] * unit[i]
        for i in range(3):
            slope[i] -= across * unit[i]
            square += slope[i] * slope[i]
        if not (level <= 0 and level * level < reach * reach * square):
            params[n] = 0
            continue
        there[n] = True
        for k in range(2):
            part = 2 - 2 * share if k else 2 * share
            if np.isnan(params[n, k, 15]):
                part, params[n, k, 15] = 0.0, 0.0
            for i in range(3):
                moved = part * slope[i] / square
                params[n, k, 12 + i] = moved if abs(moved) < LARGEST else 0.0


@compiled
def _tetrahedron(values, band, isovalue, base, cell, shape, at, near, points, params):
    """Fill the four lattice points that interpolate at a point, their weights, the point, and its level.

    Changes `near`, the point's places in its cell.
    """
    number, corner, left, level = base, 0, 1.0, 0.0
    for k in range(6):
        points[k], params[3 + k] = number, 0
        if k > 3:
            continue
        # The next corner lies along the axis with the largest place of those that remain.
        axis = 0 if near[0] >= near[1] and near[0] >= near[2] else 1 if near[1] >= near[2] else 2
        own = near[axis] if k < 3 else 0.0
        params[3 + k] = left - own
        level += (left - own) * (_corner(values, band, base, cell, corner, shape) - isovalue)
        if k < 3:
            number += shape[1] * shape[2] if axis == 0 else shape[2] if axis == 1 else 1
            corner, left, near[axis] = corner | 1 << axis, own, -1.0
    for i in range(3):
        params[9 + i] = at[i]
    params[15] = level
