"""Affine maps of points (N, 3) by rows (R, 4), and their derivatives: one compiled loop each, on NumPy arrays."""

from __future__ import annotations

import numpy as np

from rts.compiling.loops import loop
from rts.compiling.threads import parallel
from rts.operations.projection_loops import CHUNK


def forward(rows: np.ndarray, points: np.ndarray, out: np.ndarray) -> None:
    """Fill `out` (N, R) with the mapped points."""
    parallel(_affine, len(out), rows, points, out, work=len(rows) * len(out))


def push(
    rows: np.ndarray, points: np.ndarray, t_rows: np.ndarray | None, t_points: np.ndarray | None, out: np.ndarray
) -> None:
    """Fill `out` (N, R) with the derivative along `t_rows` (R, 4) and `t_points` (N, 3), each None if zero."""
    if t_rows is None:
        out[...] = 0
    else:
        forward(t_rows, points, out)
    if t_points is not None:
        parallel(_add_moved, len(out), rows, t_points, out, work=len(rows) * len(out))


def pull(
    rows: np.ndarray, points: np.ndarray, g: np.ndarray, g_rows: np.ndarray | None, g_points: np.ndarray | None
) -> None:
    """Pull back the gradient `g` (N, R) of the result: fill `g_rows` and `g_points` unless they are None."""
    if g_rows is not None:
        sums = np.zeros((-(-len(points) // CHUNK), *rows.shape))
        parallel(_pull_rows, len(sums), points, g, sums, work=2 * g.size)
        g_rows[...] = sums.sum(axis=0)
    if g_points is not None:
        parallel(_pull_points, len(points), rows, g, g_points, work=g.size)


@loop
def _affine(start, stop, rows, points, out):
    """Fill rows [start, stop) of `out` (N, R) with the mapped points."""
    for n in range(start, stop):
        x, y, z = points[n, 0], points[n, 1], points[n, 2]
        for r in range(len(rows)):
            out[n, r] = x * rows[r, 0] + y * rows[r, 1] + z * rows[r, 2] + rows[r, 3]


@loop
def _add_moved(start, stop, rows, move, out):
    """Add to rows [start, stop) of `out` (N, R) the vectors `move` (N, 3) under the linear part of the map."""
    for n in range(start, stop):
        x, y, z = move[n, 0], move[n, 1], move[n, 2]
        for r in range(len(rows)):
            out[n, r] += x * rows[r, 0] + y * rows[r, 1] + z * rows[r, 2]


@loop
def _pull_rows(start, stop, points, g, sums):
    """Add to entries [start, stop) of `sums` (S, R, 4) the gradient of the map by each `CHUNK` of points."""
    for chunk in range(start, stop):
        total = sums[chunk]
        for n in range(chunk * CHUNK, min(len(points), (chunk + 1) * CHUNK)):
            for r in range(g.shape[1]):
                h = g[n, r]
                for i in range(3):
                    total[r, i] += h * points[n, i]
                total[r, 3] += h


@loop
def _pull_points(start, stop, rows, g, g_points):
    """Fill rows [start, stop) of `g_points` (N, 3) from `g` (N, R)."""
    for n in range(start, stop):
        for i in range(3):
            total = g.dtype.type(0)
            for r in range(len(rows)):
                total += g[n, r] * rows[r, i]
            g_points[n, i] = total
