"""Footprints of cells on the texture, on the host. Compiled."""

from __future__ import annotations

import numpy as np

from rts.compiling.loops import loop

LEAST = 1e-30
"""Smallest divisor; numbers of smaller absolute value are replaced by it."""


@loop
def footprints(start, stop, rows, view, position, steps, out):
    """Fill rows [start, stop) of `out` (N, 4); see `rts.shading.uv_footprints.uv_footprint`.

    Args:
        start: the first row.
        stop: the row after the last.
        rows: (B, 3, 4) float64.
        view: (N,) int32, from 1 on, 0 for unused rows; (0,) for one view.
        position: (N, 3).
        steps: (N, 10), see `rts.GBuffer`.
        out: to fill.
    """
    pixel, moves = np.empty(3), np.empty((2, 2))
    for n in range(start, stop):
        b = max(view[n] - 1, 0) if len(view) > 0 else 0
        for i in range(3):
            pixel[i] = rows[b, i, 3]
            for k in range(3):
                pixel[i] += rows[b, i, k] * position[n, k]
        for a in range(2):
            across = down = away = 0.0
            for k in range(3):
                step = steps[n, 3 * a + k]
                across, down, away = (
                    across + rows[b, 0, k] * step,
                    down + rows[b, 1, k] * step,
                    away + rows[b, 2, k] * step,
                )
            # The derivative of (p₀, p₁) / p₂, but for the common 1 / p₂².
            moves[a, 0], moves[a, 1] = across * pixel[2] - pixel[0] * away, down * pixel[2] - pixel[1] * away
        determinant = moves[0, 0] * moves[1, 1] - moves[0, 1] * moves[1, 0]
        # Where the surface is seen edge-on, the determinant is zero, and uv changes without bound.
        factor = pixel[2] * pixel[2] / (determinant if abs(determinant) >= LEAST else LEAST)
        for i in range(2):
            first, second = steps[n, 6 + i], steps[n, 8 + i]
            out[n, i] = (first * moves[1, 1] - second * moves[0, 1]) * factor
            out[n, 2 + i] = (second * moves[0, 0] - first * moves[1, 0]) * factor
