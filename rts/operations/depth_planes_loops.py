"""`rts.operations.depth_planes`, as compiled loops for arrays on the host. It is used without derivatives."""

from __future__ import annotations

import numpy as np

from rts.compiling.loops import compiled, loop
from rts.compiling.threads import parallel
from rts.errors import InputError
from rts.operations.depth_limits import FAR, FLAT, NEARER, RIM

WORK = 30
"""Nanoseconds for a cell, roughly."""


def forward(depth: np.ndarray, row: np.ndarray, lens: np.ndarray, out: np.ndarray) -> None:
    """Fill `out` (9, H, W)."""
    if depth.shape != row.shape or len(lens) != 5:
        shapes = f"{depth.shape}, rows {row.shape} and a lens {lens.shape}"
        raise InputError(f"a picture has depths {shapes}; expected a depth and a row for each cell, and a lens (5,)")
    parallel(_even, len(row), depth, row, lens, out, work=2 * row.size)
    parallel(_forward, len(row), out, work=WORK * row.size)


def push(depth: np.ndarray, row: np.ndarray, lens: np.ndarray, t: object, out: np.ndarray) -> None:
    """Fill `out` with zeros."""
    out[...] = 0


def pull(depth: np.ndarray, row: np.ndarray, lens: np.ndarray, g: np.ndarray, g_depth: object) -> None:
    """Add no gradient."""


@compiled
def _slope(a, is_ahead, b, is_back, unit):
    """The slope between a rise ahead and one behind; see `_Rise.slope` of the specification."""
    if not (is_ahead and is_back):
        return a if is_ahead else (b if is_back else 0 * a)
    least, most = min(abs(a), abs(b)), max(abs(a), abs(b))
    if abs(a - b) <= unit + least:
        return (a + b) / 2
    if a * b < 0 and 2 * least > most:
        return 0 * a
    return a if abs(a) < abs(b) else b


@compiled
def _beyond(first, second, known, unit):
    """How far a side lies beyond a centre; see `_Rise.beyond` of the specification."""
    if not known or abs(first - second) > unit + 3 * abs(second):
        return 0 * first
    if second > 0 and first > RIM * second and first > unit / 2:
        return max(1 / (first / second - 1) - 0.7071, 0.0)
    return FLAT + 0 * first


@loop
def _even(start, stop, depth, row, lens, out):
    """Fill the first two channels of `out`: depths that are linear in the image on a plane, and their unit."""
    for y in range(start, stop):
        for x in range(row.shape[1]):
            out[0, y, x], out[1, y, x] = 0, 0
            if row[y, x] >= 0:
                z = depth[y, x]
                over = lens[0] + lens[1] * z
                out[0, y, x], out[1, y, x] = (z - lens[2]) / over, lens[4] / over


@loop
def _forward(start, stop, out):
    """Fill the other channels."""
    even, unit = out[0], out[1]
    height, width = even.shape
    # The picture is continued as if it were repeated.
    columns, rows = np.arange(-2, width + 2) % width, np.arange(-2, height + 2) % height
    for y in range(start, stop):
        for x in range(width):
            z, u = even[y, x], unit[y, x]
            for axis in range(2):
                # The cells from two behind to two ahead.
                if axis == 0:
                    i, j, k, m = columns[x], columns[x + 1], columns[x + 3], columns[x + 4]
                    far_back, back, ahead, far_ahead = even[y, i], even[y, j], even[y, k], even[y, m]
                    is_far_back, is_back = unit[y, i] > 0, unit[y, j] > 0
                    is_ahead, is_far_ahead = unit[y, k] > 0, unit[y, m] > 0
                else:
                    i, j, k, m = rows[y], rows[y + 1], rows[y + 3], rows[y + 4]
                    far_back, back, ahead, far_ahead = even[i, x], even[j, x], even[k, x], even[m, x]
                    is_far_back, is_back = unit[i, x] > 0, unit[j, x] > 0
                    is_ahead, is_far_ahead = unit[k, x] > 0, unit[m, x] > 0
                is_back, is_ahead = is_back and u > 0, is_ahead and u > 0
                out[2 + axis, y, x] = _slope(ahead - z, is_ahead, z - back, is_back, u)
                out[4 + 2 * axis, y, x] = _beyond(z - ahead, ahead - far_ahead, is_ahead and is_far_ahead, u)
                out[5 + 2 * axis, y, x] = _beyond(z - back, back - far_back, is_back and is_far_back, u)
            a, b = float(out[2, y, x]), float(out[3, y, x])
            limit = z + NEARER * (u + abs(a) + abs(b)) - a * (x + 0.5) - b * (y + 0.5)
            out[8, y, x] = limit if u > 0 else FAR
