"""Rays through pixels."""

from typing import NamedTuple

from rts.arrays.trees import Array


class Rays(NamedTuple):
    """Rays through pixel centres: the point at camera depth z is `origins + z * directions`.

    Attributes:
        origins: (..., 3), on the plane of the camera's centre.
        directions: (..., 3), scaled to advance one unit of depth.
        spread: (2,), a pixel at camera depth z is `spread[0] + spread[1] * z` wide, in the units of the origins: the
            side of a square of its area.
    """

    origins: Array
    directions: Array
    spread: Array
