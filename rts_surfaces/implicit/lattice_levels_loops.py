"""Levels of a lattice at points and along rays, and the lattice points that make them, compiled."""

from __future__ import annotations

import numpy as np

from rts.plugin_api.loops import compiled
from rts_surfaces.implicit.lattice_samples_loops import corner
from rts_surfaces.implicit.narrow_band_loops import row_at


@compiled
def level_at(field, band, at, near, slope):
    """The level at a point, interpolated along each axis.

    Fills `near`, the point's places in its cell, 0 to 1 along each axis, and the gradient `slope`. Beyond the bounds,
    and where a band has no cell, the level is infinite and the gradient NaN; if `capped`, the level beyond the bounds
    is at least the distance beyond them.

    Returns:
        The level, the number of the cell's lowest corner, the cell's row in a band, and True if a cap decides.
    """
    values, isovalue, sign, capped, (shape, low, step) = field
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
    f00, f01 = corner(values, band, base, cell, 0, shape), corner(values, band, base, cell, 4, shape)
    f10, f11 = corner(values, band, base, cell, 2, shape), corner(values, band, base, cell, 6, shape)
    d00, d01 = corner(values, band, base, cell, 1, shape) - f00, corner(values, band, base, cell, 5, shape) - f01
    d10, d11 = corner(values, band, base, cell, 3, shape) - f10, corner(values, band, base, cell, 7, shape) - f11
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
def step_along(start, direction, t, out):
    """Fill `out` (3,) with the point at place t along a direction."""
    for i in range(3):
        out[i] = start[i] + t * direction[i]


@compiled
def tetrahedron(field, band, base, cell, at, near, points, params):
    """Fill the four lattice points that interpolate at a point, their weights, the point, and its level.

    Changes `near`, the point's places in its cell.
    """
    values, isovalue, shape = field.values, field.isovalue, field.lattice.shape
    number, last, left, level = base, 0, 1.0, 0.0
    for k in range(6):
        points[k], params[3 + k] = number, 0
        if k > 3:
            continue
        # The next corner lies along the axis with the largest place of those that remain.
        axis = 0 if near[0] >= near[1] and near[0] >= near[2] else 1 if near[1] >= near[2] else 2
        part = near[axis] if k < 3 else 0.0
        params[3 + k] = left - part
        level += (left - part) * (corner(values, band, base, cell, last, shape) - isovalue)
        if k < 3:
            number += shape[1] * shape[2] if axis == 0 else shape[2] if axis == 1 else 1
            last, left, near[axis] = last | 1 << axis, part, -1.0
    for i in range(3):
        params[9 + i] = at[i]
    params[15] = level
