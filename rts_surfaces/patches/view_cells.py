"""Cells of views: all views in a cell get the same triangles, so that images do not depend on earlier ones."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from rts import Camera

STEP, CELLS = 1.1, 16
"""Views have the same triangles if their directions are in one cell of a cube's sides (`CELLS` cells from the middle of
a side to its edge), and distances, widths of pixels and widths of view round to one power of `STEP`."""
EVEN = 0.5
"""Views whose smallest scale of an axis is below this share of their largest have finer triangles."""


class ViewCell(NamedTuple):
    """A cell of views, for which triangles are made: its middle, and the largest deviations of a view from it.

    Attributes:
        eye: (3,), local space; where rays are parallel, the unit direction towards the viewer.
        parallel: True if rays are parallel.
        aside: largest deviation of the eye sideways, local units; where rays are parallel, of the direction.
        along: largest deviation of the eye towards the surface or away from it, local units.
        toward: (3,) unit, from the surface's centre to the eye.
        spread: (2,): at distance d from the eye a pixel is at least `spread[0] + spread[1] d` wide, local units.
        axis: (3,) unit, the direction in which the camera looks.
        angle: half the angle of a cone around the axis that holds all views of the cell, radians; π where rays are
            parallel.
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
    """The cell of views that holds a camera, as a tuple for `view_of`: True if rays are parallel, and whole numbers.

    Args:
        camera: a camera of NumPy arrays, in the surface's local space.
        size: (height, width) in pixels.
        center: (3,), the surface's centre.
    """
    inverse = np.linalg.inv(camera.view)
    spread, axis = camera.spread(size), -inverse[:3, 2]
    scales = np.linalg.svd(camera.view[:3, :3], compute_uv=False)
    # Where axes are scaled differently, pixels count as narrow, and the cone as wide, as in the worst direction.
    evenness = scales[2] / scales[0] if scales[2] < EVEN * scales[0] else 1.0
    if camera.projection[3, 2] == 0:
        return True, _cell(-axis), 0, _power(spread[0] * evenness), _cell(axis), 0
    off = inverse[:3, 3] - center
    # Depth is in the camera's units, distance in the surface's.
    width = spread[1] * float(np.prod(scales)) ** (1 / 3)
    # The principal point may be beside the image: the cone reaches the image's farthest corner.
    shift = float(np.hypot(*(camera.projection[:2, 2])))
    wide = width * math.hypot(*size) / 2 * (1 + shift) / evenness
    distance = float(np.linalg.norm(off))
    return False, _cell(off), _power(distance), _power(width * evenness), _cell(axis), _power(wide)


def view_of(key: tuple, center: np.ndarray) -> ViewCell:
    """The cell of views with a key, the result of `view_key`, for a surface with this centre (3,)."""
    parallel, toward, distance, width, axis, wide = key
    direction, half = _direction(toward), 0.75 / CELLS  # Of a cell's diagonal, the tangent at most.
    narrow = STEP ** (width - 0.5)
    if parallel:
        return ViewCell(direction, True, half, 0.0, direction, np.array([narrow, 0.0]), _direction(axis), math.pi)
    length = STEP**distance
    angle = math.atan(STEP ** (wide + 0.5)) + half
    moves = length * half, length * math.log(STEP) / 2
    return ViewCell(
        center + length * direction, False, *moves, direction, np.array([0.0, narrow]), _direction(axis), angle
    )


def _power(x: float) -> int:
    return round(math.log(min(max(x, 1e-300), 1e300)) / math.log(STEP))


def _cell(vector: np.ndarray) -> tuple[int, int, int]:
    """The cell of a direction (3,), of any length, on the sides of a cube: whole numbers from −`CELLS` to `CELLS`.

    A direction of length 0 counts as z, and so does one of numbers too large, which are refused later.
    """
    largest = float(np.abs(vector).max())
    x, y, z = (round(CELLS * c / largest) for c in vector.tolist()) if 0 < largest < math.inf else (0, 0, CELLS)
    return x, y, z


def _direction(cell: tuple[int, int, int]) -> np.ndarray:
    vector = np.array(cell, np.float64)
    return vector / np.linalg.norm(vector)
