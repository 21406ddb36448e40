"""Pairs of samples that tell how outlines of a lattice's surface move, compiled."""

from __future__ import annotations

import numpy as np

from rts.plugin_api.loops import compiled, loop
from rts_surfaces.implicit.deepest import APART, FIRST, GROWTH, HALVINGS, MARCH, REACH
from rts_surfaces.implicit.lattice_levels_loops import level_at, step_along, tetrahedron
from rts_surfaces.implicit.lattice_samples_loops import LARGEST

BENT = 0.75
"""Least slope of the level over the two steps beyond the one across an outline, as a share of the slope there."""

NARROW = 0.5
"""Least distance of two rays, as a share of a cell: nearer ones tell no more than one."""

OUTSIDE = 0.1
"""How far above zero the inner ray's level may lie, as a share of the rise across the outline: the outline of triangles
is not quite that of interpolated levels."""

DOWNHILL, FIRST_DOWN, GROWTH_DOWN, HALVINGS_DOWN = 6, 0.3, 1.5, 4
"""Steps along a ray towards a least level; the first, as a share of a cell; their growth; halvings of its bracket."""


@compiled
def _rate(slope, unit):
    return slope[0] * unit[0] + slope[1] * unit[1] + slope[2] * unit[2]


@compiled
def _bracket(field, first, unit, move, at, near, slope):
    """Places along a ray from `first`, between which the level is least, by steps that grow; zeros if it only falls."""
    before, t, value = 0.0, 0.0, level_at(*field, first, near, slope)[0]
    for _ in range(MARCH):
        step_along(first, unit, t + move, at)
        after = level_at(*field, at, near, slope)[0]
        if after > value:
            return before, t + move
        before, t, move, value = t, t + move, GROWTH * move, after
    return 0.0, 0.0


@compiled
def _halved(field, first, unit, a, b, count, at, near, slope):
    """The middle of a bracket of a least level, after halvings."""
    for _ in range(count):
        middle = (a + b) / 2
        step_along(first, unit, middle, at)
        level_at(*field, at, near, slope)
        if _rate(slope, unit) < 0:
            a = middle
        else:
            b = middle
    return (a + b) / 2


@compiled
def _downhill(field, first, unit, t, move, at, near, slope):
    """The place of the least level along a ray that is nearest downhill from place t; NaN without one."""
    step_along(first, unit, t, at)
    value = level_at(*field, at, near, slope)[0]
    move = -move if _rate(slope, unit) > 0 else move
    before = t
    for _ in range(DOWNHILL):
        step_along(first, unit, t + move, at)
        after = level_at(*field, at, near, slope)[0]
        if after > value:
            ends = before, t + move
            return _halved(field, first, unit, min(ends), max(ends), HALVINGS_DOWN, at, near, slope)
        before, t, move, value = t, t + move, GROWTH_DOWN * move, after
    return np.nan


@compiled
def _mixed(field, first, unit, ends, at, near, slopes, levels, mixed):
    """Fill the levels (2,) and slopes (2, 3) at both ends of a kink, and their mean (3,) perpendicular to the ray.

    Returns:
        The share of the first end, as `deepest.deepest` has it, and the square of the mean slope.
    """
    for k in range(2):
        step_along(first, unit, ends[k], at)
        levels[k] = level_at(*field, at, near, slopes[k])[0]
    falls, rises = max(-_rate(slopes[0], unit), 0.0), max(_rate(slopes[1], unit), 0.0)
    share = rises / (falls + rises) if falls + rises > 0 else 0.5
    for i in range(3):
        mixed[i] = share * slopes[0, i] + (1 - share) * slopes[1, i]
    along, square = _rate(mixed, unit), 0.0
    for i in range(3):
        mixed[i] -= along * unit[i]
        square += mixed[i] * mixed[i]
    return share, square


@compiled
def _towards(z, origin, direction, origins, directions, slope):
    """The neighbour, of rays (8, 3), that lies most along a slope (3,) at camera depth z; −1 if none does."""
    best, found = 0.0, -1
    for k in range(len(origins)):
        along, square = 0.0, 0.0
        for i in range(3):
            step = origins[k, i] - origin[i] + z * (directions[k, i] - direction[i])
            along += step * slope[i]
            square += step * step
        if along > best * np.sqrt(square):  # False for NaN.
            best, found = along / np.sqrt(square), k
    return found


@compiled
def _write(field, at, near, slope, place, along, part, points, params):
    """Fill a sample that follows the level at `at`, from `place` (3,), by a part of the motion `along` (3,)."""
    _, base, cell, cap = level_at(*field, at, near, slope)
    tetrahedron(*field, base, cell, at, near, points, params)
    for i in range(3):
        params[9 + i] = place[i]
        moved = 0.0 if cap else part * along[i]
        params[12 + i] = moved if abs(moved) < LARGEST else 0.0
    if cap:
        params[15] = 0.0


@compiled
def _crossing(field, z, place, rays, slope, work, points, params):
    """Fill a pair of samples at the least levels of two rays, between which an outline passes.

    The outline is where the least level, linear between both rays, is zero.

    Args:
        field: `Interpolated`, and its band.
        z: camera depth of the first ray's least level.
        place: (3,), the place there, which both samples have.
        rays: origins and directions (3,) of the ray, and of its neighbour.
        slope: (3,), across the ray, of any length.
        work: (4, 3), for work.
        points: (2, 6) int32, to be filled as in `lattice_samples_loops.fill`.
        params: (2, 16), to be filled.

    Returns:
        1 for a pair; 0 where the outline does not pass between the rays, they are nearer than `NARROW`, or the levels
        beyond are unknown; −1 where levels bend so much that they say little about how the outline moves.
    """
    (at, near, unit, least), narrowest = work, min(field[0].lattice.step)
    size, square, length = 0.0, 0.0, 0.0
    for i in range(3):
        across = rays[2][i] - rays[0][i] + z * (rays[3][i] - rays[1][i])
        size, square = size + across * across, square + slope[i] * slope[i]
        length += rays[3][i] * rays[3][i]
    if size < (NARROW * narrowest) ** 2:
        return 0
    length = np.sqrt(length)
    for i in range(3):
        unit[i] = rays[3][i] / length
    t = _downhill(field, rays[2], unit, z * length, FIRST_DOWN * narrowest, at, near, least)
    if np.isnan(t):
        return 0
    step_along(rays[2], unit, t, least)
    inner, outer = level_at(*field, place, near, unit)[0], level_at(*field, least, near, unit)[0]
    rise = outer - inner
    if not (inner <= OUTSIDE * rise and 0 < outer < np.inf):
        return 0
    along = 0.0
    for i in range(3):
        across = rays[2][i] - rays[0][i] + z * (rays[3][i] - rays[1][i])
        at[i] = least[i] + 2 * across
        along += across * slope[i] / square
    beyond = level_at(*field, at, near, unit)[0]
    if beyond == np.inf:
        return 0
    if beyond - outer < 2 * BENT * rise:
        return -1
    share = -inner / rise
    for i in range(3):
        slope[i] *= along / rise
    for k in range(2):
        part = 2 * share if k else 2 - 2 * share
        _write(field, least if k else place, near, unit, place, slope, part, points[k], params[k])
    return 1


@loop
def outlines(start, stop, field, rays, beside, depth, pairs):
    """Fill pairs of samples that tell how the outlines beside rays [start, stop) move.

    They stand at the least levels of the ray and of a neighbour that misses the surface, see `_crossing`; where there
    is no such neighbour, beside the ray's deepest point, see `deepest.deepest`.

    Args:
        start: the first ray.
        stop: the ray after the last.
        field: `Interpolated`; and rows (C, 8) of the corners of a band's cells, with the rows of these cells by the
            places of their lowest corners, see `narrow_band.rows_by_place`, or None without a band.
        rays: (R,) `Rays`.
        beside: (R, 8) `Rays`, see `rts.TriangleSurface.refine_outlines`.
        depth: (R,), depths of the surface's points on the rays.
        pairs: to be filled: numbers of lattice points (R, 2, 6) int32; params (R, 2, 16), zeros before, as in `fill`,
            with barycentrics of zero; and (R,) bool, the rays that have a pair.
    """
    points, params, there = pairs
    (origins, directions, spread), (other_origins, other_directions, _) = rays, beside
    step = field[0].lattice.step
    first, unit, at, near, place = np.empty(3), np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    slope, slopes, levels, ends, work = np.empty(3), np.empty((2, 3)), np.empty(2), np.empty(2), np.empty((2, 3))
    for n in range(start, stop):
        there[n] = False
        length = np.sqrt(directions[n, 0] ** 2 + directions[n, 1] ** 2 + directions[n, 2] ** 2)
        for i in range(3):
            first[i], unit[i] = origins[n, i] + depth[n] * directions[n, i], directions[n, i] / length
        reach = REACH * (spread[0] + spread[1] * depth[n])
        a, b = _bracket(field, first, unit, FIRST * reach, at, near, slope)
        if b > 0:
            t = _halved(field, first, unit, a, b, HALVINGS // 2, at, near, slope)
        else:  # It falls all along; there may be a valley within a step.
            t = _downhill(field, first, unit, 0.0, FIRST_DOWN * min(step), at, near, slope)
        if np.isnan(t):
            continue
        # A kink of the field spreads over a cell; where cells are wider than pixels it is a face.
        margin = max(APART * reach, min(0.5 * min(step), reach / 6))
        ends[0], ends[1] = max(t - margin, 0.0), t + margin
        share, square = _mixed(field, first, unit, ends, at, near, slopes, levels, slope)
        step_along(first, unit, t, place)
        z = depth[n] + t / length
        k = _towards(z, origins[n], directions[n], other_origins[n], other_directions[n], slope)
        found = 0
        if k >= 0:
            two = origins[n], directions[n], other_origins[n, k], other_directions[n, k]
            found = _crossing(field, z, place, two, slope, (at, near, work[0], work[1]), points[n], params[n])
        level = (levels[0] + levels[1]) / 2
        if found == 0 and b > 0 and level <= 0 and level * level < reach * reach * square:
            found = 1
            for i in range(3):
                slope[i] /= square
            for k in range(2):
                part = 2 - 2 * share if k else 2 * share
                step_along(first, unit, ends[k], at)
                place[:] = at
                _write(field, at, near, slopes[k], place, slope, part, points[n, k], params[n, k])
        there[n] = found > 0
