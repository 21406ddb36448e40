"""Central differences on a lattice, interpolated, and their derivatives, compiled. See `interpolation`."""

from __future__ import annotations

import numpy as np

from rts.plugin_api.loops import compiled, loop
from rts.plugin_api.threads import parallel

Numbers = tuple[float, ...]


def forward(values: np.ndarray, points: np.ndarray, out: np.ndarray, *, low: Numbers, step: Numbers) -> None:
    """Fill `out` (N, 3) with the differences of values (X, Y, Z) at points (N, 3); NaN where a point is not finite."""
    parallel(_value, len(points), values, points, low, step, out, work=150 * len(points))


def push(
    values: np.ndarray,
    points: np.ndarray,
    t_values: np.ndarray | None,
    t_points: np.ndarray | None,
    out: np.ndarray,
    *,
    low: Numbers,
    step: Numbers,
) -> None:
    """Fill `out` (N, 3) with derivatives of the differences along `t_values` (X, Y, Z) and `t_points` (N, 3).

    A tangent that is None counts as zeros. NaN where a point is not finite.
    """
    out[...] = 0
    if t_values is not None:
        forward(t_values, points, out, low=low, step=step)
    if t_points is not None:
        parallel(_push_points, len(points), values, points, t_points, low, step, out, work=300 * len(points))


def pull(
    values: np.ndarray,
    points: np.ndarray,
    g: np.ndarray,
    g_values: np.ndarray | None,
    g_points: np.ndarray | None,
    *,
    low: Numbers,
    step: Numbers,
) -> None:
    """Pull back g (N, 3), the gradient of the differences: add to `g_values` (X, Y, Z), and fill `g_points` (N, 3).

    Either is None if it is not wanted. A point that is not finite adds nothing, and its gradient is zero.
    """
    if g_values is not None:
        _pull_values(points, g, low, step, g_values)
    if g_points is not None:
        parallel(_pull_points, len(points), values, points, g, low, step, g_points, work=300 * len(points))


@compiled(inline="always")
def _place(point, shape, low, step, lowest, near, slopes):
    """Fill `lowest` (3,), `near` (3, 2) and `slopes` (3,) for the cell of a point.

    They are its lowest corner, the weights of both ends along each axis, and the derivatives of the upper end's weight
    by the point's coordinates. Beyond the bounds the point counts as on them, and these derivatives are 0. Returns
    False if the point is not finite: the arrays are then unfinished.
    """
    for axis in range(3):
        at = (point[axis] - low[axis]) / step[axis]
        if not np.isfinite(at):
            return False
        last = shape[axis] - 1
        within = 0 <= at <= last
        at = min(max(at, 0.0), float(last))
        lowest[axis] = min(int(at), last - 1)
        near[axis, 1] = at - lowest[axis]
        near[axis, 0] = 1 - near[axis, 1]
        slopes[axis] = 1 / step[axis] if within else 0.0
    return True


@compiled(inline="always")
def _difference(values, at, axis, step):
    """The central difference at the lattice point `at` (3,) along an axis, one-sided at the bounds."""
    x, y, z = at
    up, down = at[axis] < values.shape[axis] - 1, at[axis] > 0
    i, j, k = axis == 0, axis == 1, axis == 2
    above = values[x + (i and up), y + (j and up), z + (k and up)]
    below = values[x - (i and down), y - (j and down), z - (k and down)]
    return (above - below) / ((up + down) * step[axis])


@loop
def _value(start, stop, values, points, low, step, out):
    """Fill `out` (N, 3) with the differences at points from `start` to before `stop`; NaN as in `forward`."""
    lowest, near, slopes, at = np.empty(3, np.int64), np.empty((3, 2)), np.empty(3), np.empty(3, np.int64)
    for n in range(start, stop):
        out[n] = 0
        if not _place(points[n], values.shape, low, step, lowest, near, slopes):
            out[n] = np.nan
            continue
        for i in range(8):
            share = 1.0
            for axis in range(3):
                bit = i >> axis & 1
                at[axis] = lowest[axis] + bit
                share *= near[axis, bit]
            for axis in range(3):
                out[n, axis] += share * _difference(values, at, axis, step)


@compiled(inline="always")
def _share_slopes(i, near, slopes, out):
    """Fill `out` (3,) with the derivatives of corner i's weight by the point's coordinates; see `_place`."""
    for along in range(3):
        slope = slopes[along] if i >> along & 1 else -slopes[along]
        for axis in range(3):
            if axis != along:
                slope *= near[axis, i >> axis & 1]
        out[along] = slope


@loop
def _push_points(start, stop, values, points, tangents, low, step, out):
    """Add to `out` (N, 3) the derivatives of the differences along tangents (N, 3) of points; NaN as in `forward`."""
    lowest, near, slopes, at = np.empty(3, np.int64), np.empty((3, 2)), np.empty(3), np.empty(3, np.int64)
    share_slope = np.empty(3)
    for n in range(start, stop):
        if not _place(points[n], values.shape, low, step, lowest, near, slopes):
            out[n] = np.nan
            continue
        for i in range(8):
            _share_slopes(i, near, slopes, share_slope)
            change = share_slope[0] * tangents[n, 0] + share_slope[1] * tangents[n, 1] + share_slope[2] * tangents[n, 2]
            for axis in range(3):
                at[axis] = lowest[axis] + (i >> axis & 1)
            for axis in range(3):
                out[n, axis] += change * _difference(values, at, axis, step)


@loop
def _pull_points(start, stop, values, points, g, low, step, results):
    """Fill `results` (N, 3) with the gradients of the points, from g (N, 3), those of the differences.

    0 where a point is not finite.
    """
    lowest, near, slopes, at = np.empty(3, np.int64), np.empty((3, 2)), np.empty(3), np.empty(3, np.int64)
    share_slope = np.empty(3)
    for n in range(start, stop):
        results[n] = 0
        if not _place(points[n], values.shape, low, step, lowest, near, slopes):
            continue
        for i in range(8):
            for axis in range(3):
                at[axis] = lowest[axis] + (i >> axis & 1)
            along = 0.0
            for axis in range(3):
                along += g[n, axis] * _difference(values, at, axis, step)
            _share_slopes(i, near, slopes, share_slope)
            for axis in range(3):
                results[n, axis] += along * share_slope[axis]


@loop
def _pull_values(points, g, low, step, results):
    """Add to `results` (X, Y, Z), the gradient of the values, from g (N, 3), that of the differences."""
    shape = results.shape
    lowest, near, slopes = np.empty(3, np.int64), np.empty((3, 2)), np.empty(3)
    at, up, down = np.empty(3, np.int64), np.empty(3, np.int64), np.empty(3, np.int64)
    for n in range(len(points)):
        if g[n, 0] == 0 and g[n, 1] == 0 and g[n, 2] == 0:
            continue
        if not _place(points[n], shape, low, step, lowest, near, slopes):
            continue
        for i in range(8):
            share = 1.0
            for axis in range(3):
                bit = i >> axis & 1
                at[axis] = lowest[axis] + bit
                share *= near[axis, bit]
            for axis in range(3):
                up[:] = at
                down[:] = at
                up[axis] = min(at[axis] + 1, shape[axis] - 1)
                down[axis] = max(at[axis] - 1, 0)
                change = share * g[n, axis] / ((up[axis] - down[axis]) * step[axis])
                results[up[0], up[1], up[2]] += change
                results[down[0], down[1], down[2]] -= change
