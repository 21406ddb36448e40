"""Triangles at single points of the image, for samplers that rasterize whole images alone."""

from __future__ import annotations

import math

import numpy as np

from rts.contracts.records import Fragments, Proxy
from rts.scene.camera import Camera
from rts.scene.transforms import determinant


def at_points(
    proxy: Proxy, camera: Camera, size: tuple[int, int], layers: int, cull: str, points: np.ndarray
) -> Fragments:
    """The nearest triangles at points of the image: each triangle against the points in its bounding box.

    Args:
        proxy: the triangles.
        camera: NumPy float64 matrices; world is the proxy's local space.
        size: (height, width) of the grid of cells.
        layers: K.
        cull: as in `TriangleSampler.rasterize`.
        points: (M, 2) float64, x and y in cells from the upper left corner; those outside of the grid meet nothing.

    Returns:
        Fragments (K, 1, M).
    """
    from rts.sampling import points_loops

    line = np.floor(points[:, 1])
    line = np.where((line >= 0) & (line < size[0]), line, size[0]).astype(np.int64)
    order = np.lexsort((points[:, 0], line))
    begins = np.searchsorted(line[order], np.arange(size[0] + 1))
    shape = layers, len(points)
    found = Fragments(np.full(shape, -1, np.int32), np.zeros((*shape, 2), np.float32), np.full(shape, np.inf))
    arguments = np.ascontiguousarray(points[order]), begins, order, pixel_rows(camera, size)
    faces = np.ascontiguousarray(proxy.faces, np.int32)
    vertices = np.ascontiguousarray(proxy.vertices, np.float32)
    points_loops.hits(*arguments, near_and_far(camera), camera.kept_sign(cull), vertices, faces, found)
    ids, weights, depth = (x[:, None] for x in found)
    return Fragments(ids, weights, np.where(ids >= 0, depth, 0).astype(np.float32))


def pixel_rows(camera: Camera, size: tuple[int, int]) -> np.ndarray:
    """`Camera.pixel_rows` of host matrices, float64."""
    across, down = size[1] / 2, size[0] / 2
    x, y, _, w = np.asarray(camera.projection, np.float64)
    return np.array([across * x + across * w, down * w - down * y, w, _BACKWARDS]) @ camera.view


_BACKWARDS = np.array([0.0, 0.0, -1.0, 0.0])
"""Linear depth of points in camera space."""


def near_and_far(camera: Camera) -> np.ndarray:
    """(2, 4) near and far plane of host matrices, positive on what is seen."""
    p = camera.projection
    return np.array([p[3] + p[2], p[3] - p[2]]) @ camera.view


def pixel_widths(camera: Camera, size: tuple[int, int]) -> np.ndarray:
    """`Camera.spread` of host matrices, float64, for images of `size`."""
    (a, b, *_), (c, d, *_), _, (*_, e, f) = camera.projection.tolist()
    area = 4 / (size[0] * size[1] * abs(a * d - b * c))
    return math.sqrt(area) * abs(determinant(camera.view)) ** (-1 / 3) * np.array([f, -e])
