"""Cards in an image, a world unit a pixel; and the area of each pixel that a polygon covers, in closed form."""

from __future__ import annotations

import numpy as np

import rts

SIZE = 24, 24
SQUARE = np.array([[-7.0, -6], [7, -6], [7, 6], [-7, 6]])
TWO = np.array([[0, 1, 2], [0, 2, 3]])


def in_pixels(size=SIZE):
    """A camera that sees points (x, y, −z) at the pixel (x, y), at depth z."""
    height, width = size
    projection = np.array([[2 / width, 0, 0, -1], [0, -2 / height, 0, 1], [0, 0, -0.02, -1], [0, 0, 0, 1]])
    return rts.Camera(np.eye(4), projection)


def turned(corners, angle, at):
    c, s = np.cos(angle), np.sin(angle)
    return corners @ np.array([[c, s], [-s, c]]) + at


def flat(corners, depth=3.0):
    return np.column_stack([corners, np.full(len(corners), -depth)]).astype(np.float32)


def card(vertices, color=(1.0, 1, 1), faces=TWO):
    return rts.Part(rts.Mesh(faces), {"vertices": vertices, "color": np.asarray(color, np.float32)}, "unlit")


def two_colors():
    """A card whose halves differ in colour, before another one."""
    x, y = np.array([-7.0, 0, 0, 7]), np.array([-6.0, 6])
    corners = turned(np.array([(a, b) for a in x for b in y]), 0.3, (12.2, 11.7))
    faces = np.array([[0, 2, 3], [0, 3, 1], [4, 6, 7], [4, 7, 5]])
    colors = np.repeat(np.array([[0.9, 0.1, 0.2], [0.1, 0.8, 0.3]], np.float32), 4, axis=0)
    front = rts.Part(rts.Mesh(faces), {"vertices": flat(corners), "colors": colors}, "unlit")
    return [front, card(flat(SQUARE * 1.5 + 12, 5.0), (0.2, 0.3, 0.9))]


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
