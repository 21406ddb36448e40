"""Rotations of the edges around each vertex, as compiled loops; LAPACK is far slower for such small matrices."""

from __future__ import annotations

import math

import numpy as np

from rts.compiling.loops import loop
from rts.compiling.threads import parallel, read_only

# isort: split
import numba  # After `loops`, which imports it where no signal interrupts.

SWEEPS = 12
"""Largest number of sweeps. Convergence is quadratic and takes fewer."""


def turned(spokes: np.ndarray, rest: np.ndarray, starts: np.ndarray) -> np.ndarray:
    """The edges at rest, those of each vertex turned by one rotation to come nearest to the present edges.

    Args:
        spokes: (M, 3) float32 or float64, the present edges, ordered by the vertex that they begin at.
        rest: (M, 3) float64, the edges at rest, in the same order.
        starts: (V + 1,) the index of the first edge of each vertex, then M.

    Returns:
        (M, 3), of the dtype of spokes.
    """
    out, count = np.empty(spokes.shape, spokes.dtype), len(starts) - 1
    parallel(_turn, count, read_only(spokes), rest, starts, out, work=700 * count)
    return out


@loop
def _turn(start, stop, spokes, rest, starts, out):
    columns, axes, rotation = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    for i in range(start, stop):
        columns[:] = 0
        for n in range(starts[i], starts[i + 1]):
            for c in range(3):
                for r in range(3):
                    columns[c, r] += spokes[n, r] * rest[n, c]
        _nearest_rotation(columns, axes, rotation)
        for n in range(starts[i], starts[i + 1]):
            for r in range(3):
                total = 0.0
                for c in range(3):
                    total += rotation[r, c] * rest[n, c]
                out[n, r] = total


@numba.njit(error_model="numpy")
def _nearest_rotation(columns, axes, rotation):
    """Fill `rotation` (3, 3) with the R of largest tr(Rᵀ M); the identity if M is zero or holds infinity.

    `columns` (3, 3) holds the columns of M as rows. It and the scratch array `axes` (3, 3) are overwritten. If M holds
    NaN, R is NaN or any rotation.

    Columns are rotated in pairs until all are orthogonal (Hestenes 1958): M V = U Σ. The axis of the least singular
    value follows from the other two, so that U Vᵀ is a rotation. R is unique even if the least singular value is zero.
    """
    largest = 0.0
    for c in range(3):
        for r in range(3):
            largest = max(largest, abs(columns[c, r]))
            axes[c, r] = rotation[c, r] = 1.0 if c == r else 0.0
    if not 0.0 < largest < math.inf:
        return
    for c in range(3):
        for r in range(3):
            columns[c, r] /= largest
    for _ in range(SWEEPS):
        # Not a short circuit: all three pairs are turned.
        going = _orthogonalise(columns, axes, 0, 1)
        going |= _orthogonalise(columns, axes, 0, 2)
        going |= _orthogonalise(columns, axes, 1, 2)
        if not going:
            break
    lengths = (_length(columns[0]), _length(columns[1]), _length(columns[2]))
    last = 0 if lengths[0] < min(lengths[1], lengths[2]) else 1 if lengths[1] < lengths[2] else 2
    a, b = (last + 1) % 3, (last + 2) % 3
    if lengths[a] < lengths[b]:
        a, b = b, a
    for r in range(3):
        columns[a, r] /= lengths[a]
    if lengths[b] > 1e-12 * lengths[a]:
        for r in range(3):
            columns[b, r] /= lengths[b]
    else:
        _set_perpendicular(columns[a], columns[b])
    _set_cross(columns[a], columns[b], columns[last])
    _set_cross(axes[a], axes[b], axes[last])
    for r in range(3):
        for c in range(3):
            rotation[r, c] = columns[0, r] * axes[0, c] + columns[1, r] * axes[1, c] + columns[2, r] * axes[2, c]


@numba.njit(error_model="numpy")
def _length(x):
    return math.sqrt(x[0] * x[0] + x[1] * x[1] + x[2] * x[2])


@numba.njit(error_model="numpy")
def _orthogonalise(columns, axes, p, q):
    """Rotate rows p and q of `columns` (3, 3), and of `axes` alike, so that those of `columns` become orthogonal.

    Returns False, and changes nothing, if they were already, or hold NaN.
    """
    first, second, both = 0.0, 0.0, 0.0
    for r in range(3):
        first += columns[p, r] * columns[p, r]
        second += columns[q, r] * columns[q, r]
        both += columns[p, r] * columns[q, r]
    if not both * both > 1e-30 * first * second:
        return False
    more, twice = second - first, 2 * both
    slope = twice / (more + math.copysign(math.sqrt(more * more + twice * twice), more))
    cosine = 1 / math.sqrt(1 + slope * slope)
    sine = cosine * slope
    for r in range(3):
        x, y = columns[p, r], columns[q, r]
        columns[p, r], columns[q, r] = cosine * x - sine * y, sine * x + cosine * y
        x, y = axes[p, r], axes[q, r]
        axes[p, r], axes[q, r] = cosine * x - sine * y, sine * x + cosine * y
    return True


@numba.njit(error_model="numpy")
def _set_cross(a, b, out):
    for r in range(3):
        s, t = (r + 1) % 3, (r + 2) % 3
        out[r] = a[s] * b[t] - a[t] * b[s]


@numba.njit(error_model="numpy")
def _set_perpendicular(a, out):
    """Fill `out` with a unit vector at right angles to the unit vector `a`."""
    least = 0
    for r in range(1, 3):
        if abs(a[r]) < abs(a[least]):
            least = r
    s, t = (least + 1) % 3, (least + 2) % 3
    length = math.sqrt(a[s] * a[s] + a[t] * a[t])
    out[least], out[s], out[t] = 0.0, -a[t] / length, a[s] / length
