"""Vectors of length one and their derivatives, as compiled loops.

Computed in float64, whose range holds all squares of float32; vectors of float64 are scaled where it does not hold
theirs. A zero vector is multiplied by 1, and so has the identity for derivative.
"""

from __future__ import annotations

import numpy as np

from rts.compiling.loops import compiled, loop
from rts.compiling.threads import parallel


def forward(x: np.ndarray, out: np.ndarray) -> None:
    """Fill `out` (N, 3) with the vectors x (N, 3), scaled to length one."""
    parallel(_unit, len(x), x, out, work=4 * len(x))


def push(x: np.ndarray, t: np.ndarray, out: np.ndarray) -> None:
    """Fill `out` (N, 3) with the derivatives of unit vectors along `t` (N, 3)."""
    parallel(_turn, len(x), x, t, out, work=7 * len(x))


def pull(x: np.ndarray, g: np.ndarray, g_x: np.ndarray) -> None:
    """Fill `g_x` (N, 3) with the gradient of the vectors, from that of unit vectors, `g` (N, 3)."""
    parallel(_turn, len(x), x, g, g_x, work=7 * len(x))


@compiled
def _of(x, n):
    """The components of the unit vector of row n of `x` (N, 3), and the factor by which it was scaled."""
    a, b, c, scale = np.float64(x[n, 0]), np.float64(x[n, 1]), np.float64(x[n, 2]), 1.0
    square = a * a + b * b + c * c
    if not 1e-280 < square < 1e280:
        scale = 1e200 if square < 1 else 1e-160
        a, b, c = scale * a, scale * b, scale * c
        square = a * a + b * b + c * c
    factor = 1.0 / np.sqrt(square) if square != 0 else 1.0
    return a * factor, b * factor, c * factor, factor * scale if square != 0 else 1.0


@loop
def _unit(start, stop, x, out):
    """Fill rows [start, stop) of `out` (N, 3) with unit vectors."""
    for n in range(start, stop):
        out[n, 0], out[n, 1], out[n, 2], _ = _of(x, n)


@loop
def _turn(start, stop, x, t, out):
    """Fill rows [start, stop) of `out` (N, 3) with what `t` (N, 3) has across the unit vectors, over their lengths.

    The derivative is symmetric, so that it takes motions to motions, and gradients to gradients.
    """
    for n in range(start, stop):
        a, b, c, factor = _of(x, n)
        along = a * t[n, 0] + b * t[n, 1] + c * t[n, 2]
        out[n, 0] = (t[n, 0] - along * a) * factor
        out[n, 1] = (t[n, 1] - along * b) * factor
        out[n, 2] = (t[n, 2] - along * c) * factor
