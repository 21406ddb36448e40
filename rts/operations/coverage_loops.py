"""`rts.operations.coverage` and its derivatives, as compiled loops for arrays on the host.

Around each point 4 × 4 cells are looked at. `look` fills tables of them; the loops then add up.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from rts.compiling.loops import compiled, loop
from rts.compiling.threads import parallel
from rts.errors import InputError
from rts.operations.depth_limits import BIAS, FAR, OWN, REACH

WORK = 400
"""Nanoseconds for a point, roughly."""


class Picture(NamedTuple):
    """The picture that covers points; see `coverage`, whose arguments these are.

    Attributes:
        samples: (M, 3).
        row: (H, W) int32.
        planes: (9, H, W).
        lens: (5,).
        opaque: whether samples let no light through.
    """

    samples: np.ndarray
    row: np.ndarray
    planes: np.ndarray
    lens: np.ndarray
    opaque: bool

    def check(self, points: np.ndarray) -> None:
        """Refuse arrays of other shapes."""
        samples, row, planes, lens, _ = self
        channels, height, width = planes.shape
        fits = row.shape == (height, width) and samples.shape[1] == 3 and points.shape[1] == 3 and len(samples) > 0
        if not fits or channels != 9 or min(height, width) <= 2 * REACH or len(lens) != 5 or row.max() >= len(samples):
            shapes = ", ".join(str(x.shape) for x in (samples, points, row, planes, lens))
            raise InputError(f"a picture has arrays of shapes {shapes}; expected what rts.shadows.seen_from gave")


def forward(samples: np.ndarray, points: np.ndarray, *rest: np.ndarray, opaque: bool) -> np.ndarray:
    """Fill the last of `rest`, out (N, 1), with the covered shares; the others are the picture's arrays.

    Returns (N,) bool, true where the derivative may not be zero.
    """
    *arrays, out = rest
    picture, kept = Picture(samples, *arrays, opaque=opaque), np.empty(len(points), np.bool_)
    picture.check(points)
    parallel(_forward, len(points), picture, points, out, kept, work=WORK * len(points))
    return kept


def push(samples: np.ndarray, points: np.ndarray, *rest: Any, opaque: bool, kept: np.ndarray | None) -> None:
    """Fill the last of `rest`, out (N, 1), with the derivative.

    Before it are the picture's arrays, and the tangents of samples and of points, each None if zero.
    """
    *arrays, t_samples, t_points, out = rest
    kept = np.ones(len(points), np.bool_) if kept is None else kept
    t_samples = np.zeros_like(samples) if t_samples is None else t_samples
    t_points = np.zeros_like(points) if t_points is None else t_points
    arguments = Picture(samples, *arrays, opaque=opaque), points, t_samples, t_points, kept, out
    parallel(_push, len(points), *arguments, work=WORK * len(points) // 4)


def pull(samples: np.ndarray, points: np.ndarray, *rest: Any, opaque: bool, kept: np.ndarray | None) -> None:
    """Add to the last two of `rest` the gradients of samples and of points, each unless None.

    Before them are the picture's arrays, and the gradient (N, 1) of the result.
    """
    *arrays, g, g_samples, g_points = rest
    kept = np.ones(len(points), np.bool_) if kept is None else kept
    g_samples = np.zeros_like(samples) if g_samples is None else g_samples
    g_points = np.zeros_like(points) if g_points is None else g_points
    _pull(Picture(samples, *arrays, opaque=opaque), points, g, g_samples, g_points, kept)


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
    height, width = planes.shape[1] - 2 * REACH, planes.shape[2] - 2 * REACH
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

    In the dtype of planes, and without branches. `_look` decides.
    """
    top, left, real = _corner(y, planes.shape[1]), _corner(x, planes.shape[2]), planes.dtype.type
    across, down, limit, found = real(x), real(y), real(depth), False
    for j in range(4):
        for i in range(4):
            a, b = planes[2, top + j, left + i], planes[3, top + j, left + i]
            found |= planes[8, top + j, left + i] + a * across + b * down < limit
    return found


@compiled
def _look(samples, at, row, planes, opaque, covers, depths, fronts):
    """Fill tables (4, 4) of the cells around a point; True if some cell is in front of it."""
    x, y, depth = at
    height, width = planes.shape[1:]
    top, left = _corner(y, height), _corner(x, width)
    closest, own_a, own_b, own_steep, some = OWN, 0.0, 0.0, 0.0, False
    for j in range(4):
        for i in range(4):
            unit = planes[1, top + j, left + i]
            covers[j, i], depths[j, i], fronts[j, i] = 0, FAR, False
            if unit == 0:
                continue
            a, b = float(planes[2, top + j, left + i]), float(planes[3, top + j, left + i])
            steep = unit + abs(a) + abs(b)
            seen = planes[0, top + j, left + i] + a * (x - (left + i + 0.5)) + b * (y - (top + j + 0.5))
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
            z = planes[0, top + j, left + i]
            dx, dy = x - (left + i + 0.5), y - (top + j + 0.5)
            if closest < OWN and not z < depth - own_a * dx - own_b * dy - BIAS * own_steep:
                fronts[j, i] = False
                continue
            some = True
            covers[j, i] = 1 if opaque else samples[max(row[top + j, left + i], 0), 2]
    return some


@compiled
def _tables():
    """Room for `_look`."""
    return np.empty((4, 4)), np.empty((4, 4)), np.empty((4, 4), np.bool_)


SIDES = 24
"""Number of sides between 4 × 4 cells."""


@compiled
def _beside(number):
    """The axis of a side, by its number; places across and along it; row and column of the cells before and behind."""
    axis, i, j = number // 12, number % 12 // 4, number % 4
    return (axis, i, j, j, i, j, i + 1) if axis == 0 else (axis, i, j, i, j, i + 1, j)


@compiled
def _jump(covers, number):
    """How much more the cell before a side covers than that behind it; most of the time 0."""
    _, _, _, a, b, c, d = _beside(number)
    return covers[a, b] - covers[c, d]


@compiled
def _side(jump, depths, row, planes, x, y, number):
    """A side between two of the cells around a point, by its number; for `jump` see `_jump`.

    Returns how much the result changes as the side moves along its axis; the axis; the sample of the nearer cell; how
    far the side lies beyond its centre; and the sample of the cell within.
    """
    height, width = planes.shape[1:]
    top, left = _corner(y, height), _corner(x, width)
    axis, i, j, a, b, c, d = _beside(number)
    across, along = (x - left, y - top) if axis == 0 else (y - top, x - left)
    if depths[a, b] < depths[c, d]:
        y_cell, x_cell, side, step = top + a, left + b, 2 * axis + 5, -1
    else:
        y_cell, x_cell, side, step = top + c, left + d, 2 * axis + 4, 1
    within = row[y_cell, min(max(x_cell + step, 0), width - 1)]
    if axis == 1:
        within = row[min(max(y_cell + step, 0), height - 1), x_cell]
    change = jump * _quadratic(across - (i + 1)) * _cubic(along - (j + 0.5))
    sample, beyond = row[y_cell, x_cell], float(planes[side, y_cell, x_cell])
    return change, axis, max(sample, 0), beyond, max(within, 0)


@compiled
def _cell(x, y, row, number):
    """The sample of one of the cells around a point, by its number, and the cell's weight."""
    top, left = _corner(y, row.shape[0]) + number // 4, _corner(x, row.shape[1]) + number % 4
    return max(row[top, left], 0), _cubic(y - (top + 0.5)) * _cubic(x - (left + 0.5))


@loop
def _forward(start, stop, picture, points, out, kept):
    (samples, row, planes, lens, opaque), (covers, depths, fronts) = picture, _tables()
    for n in range(start, stop):
        x, y, depth = _placed(points, n, planes, lens)
        out[n, 0], kept[n] = 0, False
        if depth == -FAR or not _some_front(x, y, depth, planes):
            continue
        if not _look(samples, (x, y, depth), row, planes, opaque, covers, depths, fronts):
            continue
        even = True
        for c in range(1, 16):
            even &= covers[c // 4, c % 4] == covers[0, 0]
        total, kept[n] = covers[0, 0], not opaque or not even
        if not even:
            total = 0.0
            for c in range(16):
                total += covers[c // 4, c % 4] * _cell(x, y, row, c)[1]
        out[n, 0] = min(max(total, 0.0), 1.0)


@loop
def _push(start, stop, picture, points, t_samples, t_points, kept, out):
    (samples, row, planes, lens, opaque), (covers, depths, fronts) = picture, _tables()
    for n in range(start, stop):
        x, y, _ = at = _placed(points, n, planes, lens)
        out[n, 0], total = 0, 0.0
        if not kept[n] or not _look(samples, at, row, planes, opaque, covers, depths, fronts):
            continue
        for s in range(SIDES):
            jump = _jump(covers, s)
            if jump == 0:
                continue
            change, axis, sample, beyond, within = _side(jump, depths, row, planes, x, y, s)
            if change != 0:
                moved = t_samples[sample, axis] - t_points[n, axis]
                total += change * (moved + beyond * (t_samples[sample, axis] - t_samples[within, axis]))
        if not opaque:
            for c in range(16):
                if fronts[c // 4, c % 4]:
                    sample, weight = _cell(x, y, row, c)
                    total += weight * t_samples[sample, 2]
        out[n, 0] = total


@loop
def _pull(picture, points, g, g_samples, g_points, kept):
    (samples, row, planes, lens, opaque), (covers, depths, fronts) = picture, _tables()
    for n in range(len(points)):
        x, y, _ = at = _placed(points, n, planes, lens)
        if not kept[n] or g[n, 0] == 0 or not _look(samples, at, row, planes, opaque, covers, depths, fronts):
            continue
        for s in range(SIDES):
            jump = _jump(covers, s)
            if jump == 0:
                continue
            change, axis, sample, beyond, within = _side(jump, depths, row, planes, x, y, s)
            if change != 0:
                change *= g[n, 0]
                g_samples[sample, axis] += change * (1 + beyond)
                g_samples[within, axis] -= change * beyond
                g_points[n, axis] -= change
        if not opaque:
            for c in range(16):
                if fronts[c // 4, c % 4]:
                    sample, weight = _cell(x, y, row, c)
                    g_samples[sample, 2] += weight * g[n, 0]
