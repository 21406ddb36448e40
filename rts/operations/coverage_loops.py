"""`rts.operations.coverage` and its derivatives, as compiled loops for arrays on the host.

Around each point 4 × 4 cells are looked at. `look` fills tables of them; the loops then add up.
"""

from __future__ import annotations

import math

import numpy as np

from rts.compiling.loops import compiled, loop
from rts.compiling.threads import parallel
from rts.operations.coverage import BIAS, FAR, OWN

WORK = 400
"""Nanoseconds for a point, roughly."""


def forward(table: np.ndarray, points: np.ndarray, planes: np.ndarray, row: np.ndarray, out: np.ndarray) -> np.ndarray:
    """Fill `out` (N, 1) with the covered shares. Returns (N,) bool, true where the derivative may not be zero."""
    kept = np.empty(len(points), np.bool_)
    parallel(_forward, len(points), table, points, planes, row, out, kept, work=WORK * len(points))
    return kept


def push(
    table: np.ndarray,
    points: np.ndarray,
    planes: np.ndarray,
    row: np.ndarray,
    t_table: np.ndarray | None,
    t_points: np.ndarray | None,
    out: np.ndarray,
    *,
    kept: np.ndarray | None,
) -> None:
    """Fill `out` (N, 1) with the derivative along `t_table` and `t_points`, each None if zero."""
    kept = np.ones(len(points), np.bool_) if kept is None else kept
    t_table = np.zeros_like(table) if t_table is None else t_table
    t_points = np.zeros_like(points) if t_points is None else t_points
    work = WORK * len(points) // 4
    parallel(_push, len(points), table, points, planes, row, t_table, t_points, kept, out, work=work)


def pull(
    table: np.ndarray,
    points: np.ndarray,
    planes: np.ndarray,
    row: np.ndarray,
    g: np.ndarray,
    g_table: np.ndarray | None,
    g_points: np.ndarray | None,
    *,
    kept: np.ndarray | None,
) -> None:
    """Add to `g_table` and `g_points` the gradients, from `g` (N, 1) of the result, each unless None."""
    kept = np.ones(len(points), np.bool_) if kept is None else kept
    g_table = np.zeros_like(table) if g_table is None else g_table
    g_points = np.zeros_like(points) if g_points is None else g_points
    _pull(table, points, planes, row, g, g_table, g_points, kept)


@compiled
def _cubic(d):
    d = abs(d)
    if d < 1:
        return 2 / 3 - d * d * (1 - d / 2)
    tail = max(2 - d, 0.0)
    return tail * tail * tail / 6


@compiled
def _quadratic(d):
    d = abs(d)
    if d < 0.5:
        return 0.75 - d * d
    tail = max(1.5 - d, 0.0)
    return tail * tail / 2


@compiled
def _corner(x, n):
    """The first of four cells around a place, of a row of n cells."""
    return int(math.floor(min(max(x - 1.5, 0.0), n - 4.0)))


@compiled
def _look(table, x, y, depth, planes, row, covers, depths, samples, fronts):
    """Fill tables (4, 4) of the cells around a point; True if some cell is in front of it."""
    height, width = row.shape
    top, left = _corner(y, height), _corner(x, width)
    closest, own_a, own_b, own_steep, some = OWN, 0.0, 0.0, 0.0, False
    for j in range(4):
        for i in range(4):
            r = row[top + j, left + i]
            samples[j, i], covers[j, i], depths[j, i], fronts[j, i] = r, 0, FAR, False
            if r < 0:
                continue
            plane = planes[top + j, left + i]
            a, b = float(plane[1]), float(plane[2])
            steep = plane[3] + abs(a) + abs(b)
            seen = plane[0] + a * (x - (left + i + 0.5)) + b * (y - (top + j + 0.5))
            depths[j, i] = seen
            if seen < depth - BIAS * steep:
                fronts[j, i], some = True, True
            off = abs(seen - depth) / steep
            if off < closest:
                closest, own_a, own_b, own_steep = off, a, b, steep
    if not some:
        return False
    some = False
    for j in range(4):
        for i in range(4):
            if not fronts[j, i]:
                continue
            z = planes[top + j, left + i, 0]
            dx, dy = x - (left + i + 0.5), y - (top + j + 0.5)
            if closest < OWN and not z < depth - own_a * dx - own_b * dy - BIAS * own_steep:
                fronts[j, i] = False
                continue
            some = True
            covers[j, i] = table[samples[j, i], 2] if table.shape[1] > 2 else 1
    return some


@compiled
def _tables():
    """Room for `_look`."""
    return np.empty((4, 4)), np.empty((4, 4)), np.empty((4, 4), np.int64), np.empty((4, 4), np.bool_)


@compiled
def _side(covers, depths, samples, axis, i, j):
    """The side behind cell i along an axis, in line j: how much less is covered behind it, and the nearer sample."""
    if axis == 0:
        a, b, c, d = j, i, j, i + 1
    else:
        a, b, c, d = i, j, i + 1, j
    nearer = samples[a, b] if depths[a, b] < depths[c, d] else samples[c, d]
    return covers[a, b] - covers[c, d], nearer


@loop
def _forward(start, stop, table, points, planes, row, out, kept):
    covers, depths, samples, fronts = _tables()
    height, width = row.shape
    for n in range(start, stop):
        x, y, depth = float(points[n, 0]), float(points[n, 1]), float(points[n, 2])
        out[n, 0], kept[n] = 0, False
        if not _look(table, x, y, depth, planes, row, covers, depths, samples, fronts):
            continue
        top, left, total = _corner(y, height), _corner(x, width), 0.0
        kept[n] = table.shape[1] > 2
        for j in range(4):
            weight = _cubic(y - (top + j + 0.5))
            for i in range(4):
                total += covers[j, i] * weight * _cubic(x - (left + i + 0.5))
                kept[n] |= covers[j, i] != covers[0, 0]
        out[n, 0] = min(max(total, 0.0), 1.0)


@loop
def _push(start, stop, table, points, planes, row, t_table, t_points, kept, out):
    covers, depths, samples, fronts = _tables()
    height, width = row.shape
    for n in range(start, stop):
        out[n, 0] = 0
        if not kept[n]:
            continue
        x, y, depth = float(points[n, 0]), float(points[n, 1]), float(points[n, 2])
        if not _look(table, x, y, depth, planes, row, covers, depths, samples, fronts):
            continue
        top, left, total = _corner(y, height), _corner(x, width), 0.0
        for axis in range(2):
            across, along = (x - left, y - top) if axis == 0 else (y - top, x - left)
            for i in range(3):
                weight = _quadratic(across - (i + 1))
                for j in range(4):
                    jump, nearer = _side(covers, depths, samples, axis, i, j)
                    if jump != 0:
                        moved = t_table[nearer, axis] - t_points[n, axis]
                        total += jump * weight * _cubic(along - (j + 0.5)) * moved
        if table.shape[1] > 2:
            for j in range(4):
                for i in range(4):
                    if fronts[j, i]:
                        weight = _cubic(y - (top + j + 0.5)) * _cubic(x - (left + i + 0.5))
                        total += weight * t_table[samples[j, i], 2]
        out[n, 0] = total


@loop
def _pull(table, points, planes, row, g, g_table, g_points, kept):
    covers, depths, samples, fronts = _tables()
    height, width = row.shape
    for n in range(len(points)):
        if not kept[n] or g[n, 0] == 0:
            continue
        x, y, depth = float(points[n, 0]), float(points[n, 1]), float(points[n, 2])
        if not _look(table, x, y, depth, planes, row, covers, depths, samples, fronts):
            continue
        top, left = _corner(y, height), _corner(x, width)
        for axis in range(2):
            across, along = (x - left, y - top) if axis == 0 else (y - top, x - left)
            for i in range(3):
                weight = _quadratic(across - (i + 1)) * g[n, 0]
                for j in range(4):
                    jump, nearer = _side(covers, depths, samples, axis, i, j)
                    if jump != 0:
                        change = jump * weight * _cubic(along - (j + 0.5))
                        g_table[nearer, axis] += change
                        g_points[n, axis] -= change
        if table.shape[1] > 2:
            for j in range(4):
                for i in range(4):
                    if fronts[j, i]:
                        weight = _cubic(y - (top + j + 0.5)) * _cubic(x - (left + i + 0.5))
                        g_table[samples[j, i], 2] += weight * g[n, 0]
