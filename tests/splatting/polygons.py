"""Convex polygons in an image: the area of each pixel that they cover, in closed form."""

from __future__ import annotations

import numpy as np


def covered(corners: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Share (H, W) of each pixel inside a convex polygon.

    Args:
        corners: (C, 2) float64, x and y in pixels, in either order around it.
        size: (height, width).
    """
    shares = np.zeros(size)
    low, high = np.floor(corners.min(axis=0)).astype(int), np.ceil(corners.max(axis=0)).astype(int)
    for y in range(max(0, low[1]), min(size[0], high[1])):
        strip = _cut(_cut(corners, 1, y, 1), 1, y + 1, -1)
        for x in range(max(0, low[0]), min(size[1], high[0])):
            shares[y, x] = _area(_cut(_cut(strip, 0, x, 1), 0, x + 1, -1))
    return shares


def _cut(corners: np.ndarray, axis: int, at: float, sign: int) -> np.ndarray:
    """The part of a polygon where sign · (coordinate − at) ≥ 0."""
    kept = []
    for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        da, db = sign * (a[axis] - at), sign * (b[axis] - at)
        if da >= 0:
            kept.append(a)
        if da * db < 0:
            kept.append(a + (b - a) * da / (da - db))
    return np.array(kept).reshape(-1, 2)


def _area(corners: np.ndarray) -> float:
    x, y = corners.T
    return 0.5 * abs(float(np.dot(x, np.roll(y, -1)) - np.dot(y, np.roll(x, -1))))
