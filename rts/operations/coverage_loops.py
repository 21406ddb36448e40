"""`rts.operations.coverage` and its derivatives, as compiled loops for arrays on the host.

Around each point 4 × 4 cells are looked at. `look` fills tables of them; the loops then add up.
"""

from __future__ import annotations

import math

import numpy as np

from rts.compiling.loops import compiled, loop
from rts.compiling.threads import parallel
from rts.errors import InputError
from rts.operations.depth_limits import BIAS, FAR, OWN, REACH

WORK = 400
"""Nanoseconds for a point, roughly."""


def forward(cells: np.ndarray, points: np.ndarray, planes: np.ndarray, lens: np.ndarray, out: np.ndarray) -> np.ndarray:
    """Fill `out` (N, 1) with the covered shares. Returns (N,) bool, true where the derivative may not be zero."""
    _check(cells, points, planes, lens)
    kept = np.empty(len(points), np.bool_)
    parallel(_forward, len(points), cells, points, planes, lens, out, kept, work=WORK * len(points))
    return kept


def push(
    cells: np.ndarray,
    points: np.ndarray,
    planes: np.ndarray,
    lens: np.ndarray,
    t_cells: np.ndarray | None,
    t_points: np.ndarray | None,
    out: np.ndarray,
    *,
    kept: np.ndarray | None,
) -> None:
    """Fill `out` (N, 1) with the derivative along `t_cells` and `t_points`, each None if zero."""
    kept = np.ones(len(points), np.bool_) if kept is None else kept
    t_cells = np.zeros_like(cells) if t_cells is None else t_cells
    t_points = np.zeros_like(points) if t_points is None else t_points
    work = WORK * len(points) // 4
    parallel(_push, len(points), cells, points, planes, lens, t_cells, t_points, kept, out, work=work)


def pull(
    cells: np.ndarray,
    points: np.ndarray,
    planes: np.ndarray,
    lens: np.ndarray,
    g: np.ndarray,
    g_cells: np.ndarray | None,
    g_points: np.ndarray | None,
    *,
    kept: np.ndarray | None,
) -> None:
    """Add to `g_cells` and `g_points` the gradients, from `g` (N, 1) of the result, each unless None."""
    kept = np.ones(len(points), np.bool_) if kept is None else kept
    g_cells = np.zeros_like(cells) if g_cells is None else g_cells
    g_points = np.zeros_like(points) if g_points is None else g_points
    _pull(cells, points, planes, lens, g, g_cells, g_points, kept)


def _check(cells: np.ndarray, points: np.ndarray, planes: np.ndarray, lens: np.ndarray) -> None:
    """Refuse arrays of other shapes."""
    height, width, channels = planes.shape
    fits = cells.shape[0] == height * width and cells.shape[1] in (2, 3) and points.shape[1] == 3
    if not fits or channels != 8 or min(height, width) <= 2 * REACH or len(lens) != 4:
        shapes = ", ".join(str(x.shape) for x in (cells, points, planes, lens))
        raise InputError(f"a picture has arrays of shapes {shapes}; expected what rts.shadows.seen_from gave")


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
def _placed(point, n, planes, lens):
    """A point's x, y and even depth among the cells; −`FAR`, before all of them, beside the picture."""
    x, y, depth = float(point[n, 0]), float(point[n, 1]), float(point[n, 2])
    height, width = planes.shape[0] - 2 * REACH, planes.shape[1] - 2 * REACH
    if not (x >= 0 and x <= width and y >= 0 and y <= height and depth >= lens[3]):
        return 0.0, 0.0, -FAR
    return x + REACH, y + REACH, (depth - lens[2]) / (lens[0] + lens[1] * depth)


@compiled
def _corner(x, n):
    """The first of four cells around a place, of a row of n cells."""
    return int(math.floor(min(max(x - 1.5, 0.0), n - 4.0)))


@compiled(inline="always")
def _some_front(x, y, depth, planes):
    """True if the plane of some cell around a point may be in front of it: of most points none is.

    In the dtype of planes, and without branches. So the bias is a little less than that of `_look`, which decides.
    """
    top, left, real = _corner(y, planes.shape[0]), _corner(x, planes.shape[1]), planes.dtype.type
    below, limit, bias, one = real(y - top - 0.5), real(depth), real(0.99 * BIAS), real(1)
    found = False
    for j in range(4):
        beside = real(x - left - 0.5)
        for i in range(4):
            z, unit = planes[top + j, left + i, 0], planes[top + j, left + i, 1]
            a, b = planes[top + j, left + i, 2], planes[top + j, left + i, 3]
            found |= (unit > 0) & (z + a * beside + b * below + bias * (unit + abs(a) + abs(b)) < limit)
            beside -= one
        below -= one
    return found


@compiled
def _look(cells, x, y, depth, planes, covers, depths, fronts):
    """Fill tables (4, 4) of the cells around a point; True if some cell is in front of it."""
    height, width = planes.shape[:2]
    top, left = _corner(y, height), _corner(x, width)
    closest, own_a, own_b, own_steep, some = OWN, 0.0, 0.0, 0.0, False
    for j in range(4):
        for i in range(4):
            plane = planes[top + j, left + i]
            covers[j, i], depths[j, i], fronts[j, i] = 0, FAR, False
            if plane[1] == 0:
                continue
            a, b = float(plane[2]), float(plane[3])
            steep = plane[1] + abs(a) + abs(b)
            seen = plane[0] + a * (x - (left + i + 0.5)) + b * (y - (top + j + 0.5))
            depths[j, i] = seen
            if seen < depth - BIAS * steep:
                fronts[j, i], some = True, True
            if abs(seen - depth) < closest * steep:
                closest, own_a, own_b, own_steep = abs(seen - depth) / steep, a, b, steep
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
            covers[j, i] = cells[(top + j) * width + left + i, 2] if cells.shape[1] > 2 else 1
    return some


@compiled
def _tables():
    """Room for `_look`."""
    return np.empty((4, 4)), np.empty((4, 4)), np.empty((4, 4), np.bool_)


SIDES = 24
"""Number of sides between 4 × 4 cells."""


@compiled
def _side(covers, depths, planes, x, y, number):
    """A side between two of the cells around a point, by its number.

    Returns how much the result changes as the side moves along its axis; the axis; the index of the nearer cell; how
    far the side lies beyond its centre; and the index of the cell within.
    """
    height, width = planes.shape[:2]
    top, left = _corner(y, height), _corner(x, width)
    axis, i, j = number // 12, number % 12 // 4, number % 4
    a, b, c, d = (j, i, j, i + 1) if axis == 0 else (i, j, i + 1, j)
    jump, step = covers[a, b] - covers[c, d], 1 if axis == 0 else width
    if jump == 0:
        return 0.0, axis, 0, 0.0, 0
    across, along = (x - left, y - top) if axis == 0 else (y - top, x - left)
    if depths[a, b] < depths[c, d]:
        y_cell, x_cell, side, step = top + a, left + b, 2 * axis + 5, -step
    else:
        y_cell, x_cell, side = top + c, left + d, 2 * axis + 4
    cell = y_cell * width + x_cell
    within = min(max(cell + step, 0), height * width - 1)
    change = jump * _quadratic(across - (i + 1)) * _cubic(along - (j + 0.5))
    return change, axis, cell, float(planes[y_cell, x_cell, side]), within


@compiled
def _cell(x, y, planes, number):
    """The index of one of the cells around a point, by its number, and its weight."""
    height, width = planes.shape[:2]
    top, left = _corner(y, height) + number // 4, _corner(x, width) + number % 4
    return top * width + left, _cubic(y - (top + 0.5)) * _cubic(x - (left + 0.5))


@loop
def _forward(start, stop, cells, points, planes, lens, out, kept):
    covers, depths, fronts = _tables()
    for n in range(start, stop):
        x, y, depth = _placed(points, n, planes, lens)
        out[n, 0], kept[n] = 0, False
        if depth == -FAR or not _some_front(x, y, depth, planes):
            continue
        if not _look(cells, x, y, depth, planes, covers, depths, fronts):
            continue
        even = True
        for c in range(1, 16):
            even &= covers[c // 4, c % 4] == covers[0, 0]
        total, kept[n] = covers[0, 0], cells.shape[1] > 2 or not even
        if not even:
            total = 0.0
            for c in range(16):
                total += covers[c // 4, c % 4] * _cell(x, y, planes, c)[1]
        out[n, 0] = min(max(total, 0.0), 1.0)


@loop
def _push(start, stop, cells, points, planes, lens, t_cells, t_points, kept, out):
    covers, depths, fronts = _tables()
    for n in range(start, stop):
        x, y, depth = _placed(points, n, planes, lens)
        out[n, 0], total = 0, 0.0
        if not kept[n] or not _look(cells, x, y, depth, planes, covers, depths, fronts):
            continue
        for s in range(SIDES):
            change, axis, cell, beyond, within = _side(covers, depths, planes, x, y, s)
            if change != 0:
                moved = t_cells[cell, axis] - t_points[n, axis]
                total += change * (moved + beyond * (t_cells[cell, axis] - t_cells[within, axis]))
        if cells.shape[1] > 2:
            for c in range(16):
                if fronts[c // 4, c % 4]:
                    cell, weight = _cell(x, y, planes, c)
                    total += weight * t_cells[cell, 2]
        out[n, 0] = total


@loop
def _pull(cells, points, planes, lens, g, g_cells, g_points, kept):
    covers, depths, fronts = _tables()
    for n in range(len(points)):
        x, y, depth = _placed(points, n, planes, lens)
        if not kept[n] or g[n, 0] == 0 or not _look(cells, x, y, depth, planes, covers, depths, fronts):
            continue
        for s in range(SIDES):
            change, axis, cell, beyond, within = _side(covers, depths, planes, x, y, s)
            if change != 0:
                change *= g[n, 0]
                g_cells[cell, axis] += change * (1 + beyond)
                g_cells[within, axis] -= change * beyond
                g_points[n, axis] -= change
        if cells.shape[1] > 2:
            for c in range(16):
                if fronts[c // 4, c % 4]:
                    cell, weight = _cell(x, y, planes, c)
                    g_cells[cell, 2] += weight * g[n, 0]
