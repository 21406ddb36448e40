"""Cells of views: all views of a cell share triangles, so that images do not depend on earlier renders."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from rts import Camera

STEP, CELLS = 1.1, 16
"""Views whose distances and widths of pixels differ by less than this factor, and whose directions are in one cell of a
cube's sides (`CELLS` from the middle of a side to its edge), have the same triangles."""
EVEN = 0.5
"""Views whose smallest scale is below this share of their largest have finer triangles."""


class View(NamedTuple):
    """A cell of views, for which triangles are made: its middle, and the largest deviations from the middle.

    Attributes:
        eye: (3,) its position; where rays are parallel, the direction towards the viewer.
        parallel: True if rays are parallel.
        aside: largest deviation of the eye sideways, local units; if parallel, of the direction.
        along: largest deviation of the eye towards the surface and away from it.
        toward: (3,) unit, from the surface to the eye.
        spread: (2,): at distance d from the eye a pixel is at least `spread[0] + spread[1] d` wide.
        axis: (3,) the direction in which the camera looks.
        angle: half the angle of a cone around the axis that contains the image, radians.
    """

    eye: np.ndarray
    parallel: bool
    aside: float
    along: float
    toward: np.ndarray
    spread: np.ndarray
    axis: np.ndarray
    angle: float


def view_key(camera: Camera, size: tuple[int, int], center: np.ndarray) -> tuple:
    """The integer coordinates of the cell that contains a camera's view; equal cells have equal triangles.

    Args:
        camera: NumPy, in the surface's local space.
        size: (height, width).
        center: (3,), the middle of the surface.
    """
    inverse = np.linalg.inv(camera.view)
    spread, axis = camera.spread(size), -inverse[:3, 2]
    scales = np.linalg.svd(camera.view[:3, :3], compute_uv=False)
    # Where axes are scaled differently, as narrow a pixel, and as wide a cone, as in any direction.
    evenness = scales[2] / scales[0] if scales[2] < EVEN * scales[0] else 1.0
    if camera.projection[3, 2] == 0:
        return True, _cell(-axis), 0, _power(spread[0] * evenness), _cell(axis), 0
    off = inverse[:3, 3] - center
    # Depth is in the camera's units, distance in the surface's.
    width = spread[1] * float(np.prod(scales)) ** (1 / 3)
    # The principal point may be beside the image: as wide a cone as reaches its farthest corner.
    shift = float(np.hypot(*(camera.projection[:2, 2])))
    wide = width * math.hypot(*size) / 2 * (1 + shift) / evenness
    distance = float(np.linalg.norm(off))
    return False, _cell(off), _power(distance), _power(width * evenness), _cell(axis), _power(wide)


def view_of(key: tuple, center: np.ndarray) -> View:
    """The `View` of a key of `view_key`; `center` (3,) is the middle of the surface."""
    parallel, toward, distance, width, axis, wide = key
    direction, half = _direction(toward), 0.75 / CELLS  # Of a cell's diagonal, the tangent at most.
    narrow = STEP ** (width - 0.5)
    if parallel:
        return View(direction, True, half, 0.0, direction, np.array([narrow, 0.0]), _direction(axis), math.pi)
    length = STEP**distance
    angle = math.atan(STEP ** (wide + 0.5)) + half
    moves = length * half, length * math.log(STEP) / 2
    return View(center + length * direction, False, *moves, direction, np.array([0.0, narrow]), _direction(axis), angle)


def _power(x: float) -> int:
    return round(math.log(max(x, 1e-300)) / math.log(STEP))


def _cell(vector: np.ndarray) -> tuple[int, int, int]:
    """Integer point, on the surface of a cube of half width `CELLS`, nearest to a direction (3,)."""
    largest = float(np.abs(vector).max())
    x, y, z = (round(CELLS * c / largest) for c in vector.tolist()) if largest > 0 else (0, 0, CELLS)
    return x, y, z


def _direction(cell: tuple[int, int, int]) -> np.ndarray:
    vector = np.array(cell, np.float64)
    return vector / np.linalg.norm(vector)
