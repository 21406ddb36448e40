"""The matrix of a rigid pose and its Jacobian, compiled: as sixty small array operations they are far slower."""

from __future__ import annotations

import math

import numpy as np

from rts.compiling.loops import loop

SMALL = 1e-2
"""Limit of the squared angle below which series replace sine and cosine; their error is below 3e-14."""


def rigid(pose: np.ndarray, center: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The matrix (4, 4) of a pose (6,) about a centre (3,), and the entries' Jacobian (16, 9) by both; float64.

    The pose is a rotation vector and a translation. Entries are counted row by row; pose comes before centre.
    """
    matrix, jacobian = np.empty((4, 4)), np.empty((16, 9))
    _rigid(pose.astype(np.float64), center.astype(np.float64), matrix, jacobian)
    return matrix, jacobian


@loop
def _rigid(pose, center, matrix, jacobian):
    """Fill `matrix` (4, 4) and `jacobian` (16, 9), float64; see `rigid`."""
    r = pose[:3]
    s = r[0] * r[0] + r[1] * r[1] + r[2] * r[2]
    if s < SMALL:
        a = 1 - s / 6 * (1 - s / 20 * (1 - s / 42))
        b = 0.5 - s / 24 * (1 - s / 30 * (1 - s / 56))
        da = -(1 - s / 10 * (1 - s / 28 * (1 - s / 54))) / 6
        db = -(1 - s / 15 * (1 - s / 37.333333333333336 * (1 - s / 67.5))) / 24
    else:
        angle = math.sqrt(s)
        a, b = math.sin(angle) / angle, (1 - math.cos(angle)) / s
        da, db = (math.cos(angle) - a) / (2 * s), (a / 2 - b) / s
    jacobian[:] = 0
    # With the cross product's matrix K, the rotation is 1 + a K + b K² (Rodrigues).
    k = np.zeros((3, 3))
    k[0, 1], k[0, 2], k[1, 2] = -r[2], r[1], -r[0]
    k[1, 0], k[2, 0], k[2, 1] = r[2], -r[1], r[0]
    square, turn = np.empty((3, 3)), np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            square[i, j] = r[i] * r[j] - (s if i == j else 0.0)
            matrix[i, j] = (1.0 if i == j else 0.0) + a * k[i, j] + b * square[i, j]
    for n in range(3):
        turn[:] = 0
        up, down = (n + 1) % 3, (n + 2) % 3
        turn[up, down], turn[down, up] = -1, 1
        for i in range(3):
            for j in range(3):
                d_square = (r[j] if i == n else 0.0) + (r[i] if j == n else 0.0) - (2 * r[n] if i == j else 0.0)
                slope = a * turn[i, j] + b * d_square + 2 * r[n] * (da * k[i, j] + db * square[i, j])
                jacobian[4 * i + j, n] = slope
                jacobian[4 * i + 3, n] -= slope * center[j]
    matrix[3, 0] = matrix[3, 1] = matrix[3, 2] = 0
    matrix[3, 3] = 1
    for i in range(3):
        matrix[i, 3] = center[i] + pose[3 + i]
        jacobian[4 * i + 3, 3 + i] = jacobian[4 * i + 3, 6 + i] = 1
        for j in range(3):
            matrix[i, 3] -= matrix[i, j] * center[j]
            jacobian[4 * i + 3, 6 + j] -= matrix[i, j]
