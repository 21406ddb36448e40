"""Motion of samples with the field, and its derivatives, compiled.

Arguments are as in `rts_surfaces.implicit.motion`: values (M,), params (N, P), rows (N, 6), numbers (N, 6). P is 16 for
motion along the gradient, see `ALONG_NORMAL`, and 4 for motion along edges, see `ALONG_EDGES`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rts.plugin_api.loops import compiled, loop
from rts.plugin_api.threads import parallel
from rts_surfaces.implicit.lattice import Spacing


class Edges(NamedTuple):
    """The edges of a lattice on which the corners of samples' triangles lie, where values reach an isovalue.

    Attributes:
        values: (M,).
        params: (N, 4).
        rows: (N, 6) int32.
        numbers: (N, 6) int32.
        isovalue: in the dtype of the values.
        lattice: how its points lie.
    """

    values: np.ndarray
    params: np.ndarray
    rows: np.ndarray
    numbers: np.ndarray
    isovalue: np.floating
    lattice: Spacing


def along(
    values: np.ndarray, params: np.ndarray, rows: np.ndarray, out: np.ndarray, *, isovalue: float, sign: float
) -> None:
    """Fill `out` (N, 3) with the positions of samples that move along the gradient."""
    real = values.dtype.type
    parallel(_move, len(rows), values, params, rows, real(isovalue), real(sign), out, work=30 * len(rows))


def push_along(
    values: np.ndarray, params: np.ndarray, rows: np.ndarray, moved: np.ndarray, out: np.ndarray, **options: float
) -> None:
    """Fill `out` (N, 3) with the derivatives of the positions of `along`; `moved` (M,) are tangents of the values.

    `options` are the keywords of `along`.
    """
    sign = values.dtype.type(options["sign"])
    parallel(_push, len(rows), moved, params, rows, sign, out, work=30 * len(rows))


def pull_along(
    values: np.ndarray, params: np.ndarray, rows: np.ndarray, g: np.ndarray, result: np.ndarray, **options: float
) -> None:
    """Add to `result` (M,), the gradient of the values, from g (N, 3), the gradient of the positions of `along`.

    `options` are the keywords of `along`.
    """
    _pull(g, params, rows, values.dtype.type(options["sign"]), result)


def crossing(values: np.ndarray, *rest: np.ndarray, isovalue: float, lattice: Spacing) -> None:
    """Fill the last of `rest`, out (N, 3), with positions of samples in triangles whose corners slide along edges.

    Before it are params, rows and numbers. The corners lie where values reach `isovalue` on edges of the `lattice`.
    """
    *operands, out = rest
    edges = Edges(values, *operands, isovalue=values.dtype.type(isovalue), lattice=lattice)
    parallel(_cross, len(out), edges, out, work=60 * len(out))


def push_crossing(values: np.ndarray, *rest: np.ndarray, isovalue: float, lattice: Spacing) -> None:
    """Fill the last of `rest`, out (N, 3), with the derivatives of the positions of `crossing`.

    Before it are params, rows, numbers, and the tangents (M,) of the values.
    """
    *operands, moved, out = rest
    edges = Edges(values, *operands, isovalue=values.dtype.type(isovalue), lattice=lattice)
    parallel(_push_crossings, len(out), edges, moved, out, work=60 * len(out))


def pull_crossing(values: np.ndarray, *rest: np.ndarray, isovalue: float, lattice: Spacing) -> None:
    """Add to the last of `rest`, result (M,), the gradient of the values.

    Before it are params, rows, numbers, and the gradient (N, 3) of the positions of `crossing`.
    """
    *operands, g, result = rest
    _pull_crossings(Edges(values, *operands, isovalue=values.dtype.type(isovalue), lattice=lattice), g, result)


@loop
def _move(start, stop, values, params, rows, isovalue, sign, out):
    """Fill `out` (N, 3) with the positions of samples from `start` to before `stop`; see `along`."""
    for n in range(start, stop):
        level = -params[n, 15]
        for i in range(6):
            level += params[n, 3 + i] * (values[rows[n, i]] - isovalue)
        for i in range(3):
            out[n, i] = params[n, 9 + i] - sign * level * params[n, 12 + i]


@loop
def _push(start, stop, tangents, params, rows, sign, out):
    """Fill `out` (N, 3), from `start` to before `stop`: derivatives of `_move` along tangents (M,) of the values."""
    for n in range(start, stop):
        level = tangents.dtype.type(0)
        for i in range(6):
            level += params[n, 3 + i] * tangents[rows[n, i]]
        for i in range(3):
            out[n, i] = -sign * level * params[n, 12 + i]


@loop
def _pull(g, params, rows, sign, results):
    """Add to `results` (M,), the gradient of the values, from g (N, 3), the gradient of the positions of `_move`."""
    for n in range(len(rows)):
        slope = g[n, 0] * params[n, 12] + g[n, 1] * params[n, 13] + g[n, 2] * params[n, 14]
        if slope != 0:
            for i in range(6):
                results[rows[n, i]] -= sign * slope * params[n, 3 + i]


@compiled(inline="always")
def _edge(n, k, edges):
    """Edge k, 0 to 2, of sample n, between its lattice points 2 k and 2 k + 1.

    Returns:
        Its axis; its length, negative if it runs against the axis; the place along it, 0 to 1, where the isovalue is
        crossed, or 0 if both values are equal; and the number that derivatives divide by, the difference of the values
        or `params[n, 3]` with its sign if that is larger. All are zero for an edge whose ends are one point.
    """
    values, params, rows, numbers, isovalue, (shape, _, step) = edges
    a, b = np.int64(numbers[n, 2 * k]), np.int64(numbers[n, 2 * k + 1])
    if a == b:
        return 0, 0.0, 0.0, 0.0
    f_a, f_b = values[rows[n, 2 * k]] - isovalue, values[rows[n, 2 * k + 1]] - isovalue
    difference = f_b - f_a
    ahead = b - a
    axis = 2 if abs(ahead) == 1 else 1 if abs(ahead) == shape[2] else 0
    length = step[axis] if ahead > 0 else -step[axis]
    place = -f_a / difference if difference != 0 else 0.0
    least = params[n, 3]
    if abs(difference) < least:
        difference = -least if difference < 0 else least
    return axis, length, place, difference


@loop
def _cross(start, stop, edges, out):
    """Fill `out` (N, 3) with the positions of samples from `start` to before `stop`; see `crossing`."""
    params, numbers, (shape, low, step) = edges.params, edges.numbers, edges.lattice
    for n in range(start, stop):
        x = y = z = 0.0
        for k in range(3):
            axis, length, place, _ = _edge(n, k, edges)
            number, share = np.int64(numbers[n, 2 * k]), params[n, k]
            x += share * (low[0] + step[0] * (number // (shape[1] * shape[2])) + (place * length if axis == 0 else 0))
            y += share * (low[1] + step[1] * (number // shape[2] % shape[1]) + (place * length if axis == 1 else 0))
            z += share * (low[2] + step[2] * (number % shape[2]) + (place * length if axis == 2 else 0))
        out[n, 0], out[n, 1], out[n, 2] = x, y, z


@loop
def _push_crossings(start, stop, edges, tangents, out):
    """Fill `out` (N, 3), from `start` to before `stop`: derivatives of `_cross` along tangents (M,) of the values."""
    params, rows = edges.params, edges.rows
    for n in range(start, stop):
        out[n] = 0
        for k in range(3):
            axis, length, place, difference = _edge(n, k, edges)
            if difference != 0:
                change = (1 - place) * tangents[rows[n, 2 * k]] + place * tangents[rows[n, 2 * k + 1]]
                out[n, axis] -= params[n, k] * length * change / difference


@loop
def _pull_crossings(edges, g, results):
    """Add to `results` (M,), the gradient of the values, from g (N, 3), the gradient of the positions of `_cross`."""
    params, rows = edges.params, edges.rows
    for n in range(len(rows)):
        if g[n, 0] == 0 and g[n, 1] == 0 and g[n, 2] == 0:
            continue
        for k in range(3):
            axis, length, place, difference = _edge(n, k, edges)
            if difference != 0:
                change = g[n, axis] * params[n, k] * length / difference
                results[rows[n, 2 * k]] -= (1 - place) * change
                results[rows[n, 2 * k + 1]] -= place * change
