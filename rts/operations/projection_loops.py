"""Perspective projection of points, and its derivatives: one compiled loop each, on NumPy arrays.

Four affine maps (4, 4) of points (N, 3) give (N, 3): the first two values over the third, and the fourth. A point
whose third value is zero has no image; its result is finite. All floats are of one dtype.
"""

from __future__ import annotations

import numpy as np

from rts.compiling.loops import loop
from rts.compiling.threads import parallel, read_only

CHUNK = 4096
"""Number of points that are summed together. Fixed, so that results do not depend on the number of threads."""


def forward(rows: np.ndarray, points: np.ndarray, out: np.ndarray) -> None:
    """Fill `out` (N, 3) with the projected points."""
    parallel(_project, len(out), rows, points, out, work=4 * len(out))


def push(
    rows: np.ndarray, points: np.ndarray, t_rows: np.ndarray | None, t_points: np.ndarray | None, out: np.ndarray
) -> None:
    """Fill `out` (N, 3) with the derivative along `t_rows` (4, 4) and `t_points` (N, 3), each None if zero."""
    turn = read_only(np.zeros_like(rows)) if t_rows is None else t_rows
    move = read_only(np.empty((0, 3), points.dtype)) if t_points is None else t_points
    parallel(_push, len(out), rows, points, turn, move, out, work=8 * len(out))


def pull(
    rows: np.ndarray, points: np.ndarray, g: np.ndarray, g_rows: np.ndarray | None, g_points: np.ndarray | None
) -> None:
    """Pull back the gradient `g` (N, 3) of the result: fill `g_rows` (4, 4) and `g_points` (N, 3) unless None."""
    sums = np.empty((-(-len(points) // CHUNK), 4, 4))
    g_points = np.empty((0, 3), points.dtype) if g_points is None else g_points
    parallel(_pull, len(sums), rows, points, g, sums, g_points, work=5 * len(points))
    if g_rows is not None:
        g_rows[...] = sums.sum(axis=0)


@loop
def _project(start, stop, m, points, out):
    """Fill rows [start, stop) of `out` (N, 3) with the points (N, 3) under the maps `m` (4, 4)."""
    one = out.dtype.type(1)
    for n in range(start, stop):
        x, y, z = points[n, 0], points[n, 1], points[n, 2]
        w = m[2, 0] * x + m[2, 1] * y + m[2, 2] * z + m[2, 3]
        over = one / (one if w == 0 else w)
        out[n, 0] = (m[0, 0] * x + m[0, 1] * y + m[0, 2] * z + m[0, 3]) * over
        out[n, 1] = (m[1, 0] * x + m[1, 1] * y + m[1, 2] * z + m[1, 3]) * over
        out[n, 2] = m[3, 0] * x + m[3, 1] * y + m[3, 2] * z + m[3, 3]


@loop
def _push(start, stop, m, points, turn, move, out):
    """Fill rows [start, stop) of `out` (N, 3) with the derivative along `turn` (4, 4) of `m` and `move` of the points.

    `move` is (N, 3), or has no rows if it is zero.
    """
    zero, one = out.dtype.type(0), out.dtype.type(1)
    value, change = np.empty(4, out.dtype), np.empty(4, out.dtype)
    for n in range(start, stop):
        x, y, z = points[n, 0], points[n, 1], points[n, 2]
        for r in range(4):
            value[r] = m[r, 0] * x + m[r, 1] * y + m[r, 2] * z + m[r, 3]
            change[r] = turn[r, 0] * x + turn[r, 1] * y + turn[r, 2] * z + turn[r, 3]
            if len(move):
                change[r] += m[r, 0] * move[n, 0] + m[r, 1] * move[n, 1] + m[r, 2] * move[n, 2]
        over = one / (one if value[2] == 0 else value[2])
        deeper = zero if value[2] == 0 else change[2]
        out[n, 0] = (change[0] - value[0] * over * deeper) * over
        out[n, 1] = (change[1] - value[1] * over * deeper) * over
        out[n, 2] = change[3]


@loop
def _pull(start, stop, m, points, g, sums, g_points):
    """Fill entries [start, stop) of `sums` (S, 4, 4): the gradient of `m` by each `CHUNK` of points, from `g` (N, 3).

    Also fills the rows of these points in `g_points` (N, 3), unless it has no rows.
    """
    zero, one = points.dtype.type(0), points.dtype.type(1)
    for chunk in range(start, stop):
        # A loop, since for assigned arrays numba also compiles an error about their shapes, which takes a second.
        total = sums[chunk]
        total[:] = 0
        for n in range(chunk * CHUNK, min(len(points), (chunk + 1) * CHUNK)):
            if g[n, 0] == 0 and g[n, 1] == 0 and g[n, 2] == 0:  # Common: the interior of a silhouette.
                if len(g_points):
                    g_points[n, 0] = g_points[n, 1] = g_points[n, 2] = zero
                continue
            x, y, z = points[n, 0], points[n, 1], points[n, 2]
            w = m[2, 0] * x + m[2, 1] * y + m[2, 2] * z + m[2, 3]
            over = one / (one if w == 0 else w)
            u = (m[0, 0] * x + m[0, 1] * y + m[0, 2] * z + m[0, 3]) * over
            v = (m[1, 0] * x + m[1, 1] * y + m[1, 2] * z + m[1, 3]) * over
            a, b, d = g[n, 0] * over, g[n, 1] * over, g[n, 2]
            c = zero if w == 0 else -(g[n, 0] * u + g[n, 1] * v) * over
            for r, h in enumerate((a, b, c, d)):
                total[r, 0] += h * x
                total[r, 1] += h * y
                total[r, 2] += h * z
                total[r, 3] += h
            if len(g_points):
                for i in range(3):
                    g_points[n, i] = a * m[0, i] + b * m[1, i] + c * m[2, i] + d * m[3, i]
