"""Where several views lie side by side in one picture, so that one splat serves them all.

Each view keeps the apron that it was sampled with, so no splat of another reaches its image. What splatters decide by
depths they decide in terms of the largest: where those of views differ much, they are brought between 1 and 2, by
powers of two, which round nothing. So the depths that count as equal are up to twice as far apart as in a view alone.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from rts.arrays.engines import namespace
from rts.arrays.trees import Array

SIDE = 1024
"""Cells along each side of a picture, at most: float32 places samples there to 1/16000 of a cell."""


class Picture(NamedTuple):
    """Places of views, line after line.

    Attributes:
        views: B, the number of views.
        view: height and width of each, in cells, with its apron.
        down: lines of views.
        across: views in a line.
    """

    views: int
    view: tuple[int, int]
    down: int
    across: int

    @classmethod
    def of(cls, count: int, view: tuple[int, int]) -> Picture:
        """A picture of so many views, about as high as wide, with few places left over."""
        down, most = (max(1, SIDE // n) for n in view)
        even = math.sqrt(count * view[0] / view[1])
        # From half as wide to twice as wide as high.
        least, most = (
            max(-(-count // down), min(round(n), most, count)) for n in (even / math.sqrt(2), even * math.sqrt(2))
        )

        def cost(across: int) -> tuple[int, int]:
            lines = -(-count // across)
            return lines * across, max(lines * view[0], across * view[1])

        across = min(range(least, most + 1), key=cost)
        return cls(count, view, -(-count // across), across)

    @property
    def size(self) -> tuple[int, int]:
        """(height, width) in cells."""
        return self.down * self.view[0], self.across * self.view[1]

    def places(self) -> list[tuple[slice, slice]]:
        """Lines and columns of cells of each view."""
        (height, width), found = self.view, []
        for y, x in np.ndindex(self.down, self.across):
            found.append((slice(y * height, (y + 1) * height), slice(x * width, (x + 1) * width)))
        return found[: self.views]

    def corners(self) -> np.ndarray:
        """(B, 2) the column and the line of the first cell of each view."""
        down, across = np.divmod(np.arange(self.views), self.across)
        return np.stack([across * self.view[1], down * self.view[0]], axis=1)

    def inside(self, border: int) -> np.ndarray:
        """(height, width) bool, the cells of views without a border of so many."""
        (height, width), inside = self.view, np.zeros((self.down, self.view[0], self.across, self.view[1]), bool)
        inside[:, border : height - border, :, border : width - border] = True
        for y, x in list(np.ndindex(self.down, self.across))[self.views :]:
            inside[y, :, x] = False
        return inside.reshape(self.size)

    def laid_out(self, views: Array, empty: int | bool) -> Array:
        """The picture (K, height, width) of arrays (B, K, h, w) of the views; `empty` is where there is none."""
        xp, (height, width), nowhere = namespace(views), self.view, self.down * self.across - self.views
        if nowhere:
            views = xp.concat([views, *[xp.full_like(views[:1, ...], empty)] * nowhere])
        grid = xp.reshape(views, (self.down, self.across, -1, height, width))
        return xp.reshape(xp.permute_dims(grid, (2, 0, 3, 1, 4)), (-1, *self.size))

    def apart(self, image: Array, border: int) -> Array:
        """The views (B, h, w, C) of an image (height, width, C) of the picture, without their borders."""
        xp, (height, width) = namespace(image), self.view
        grid = xp.reshape(image, (self.down, height, self.across, width, image.shape[-1]))
        inner = grid[:, border : height - border, :, border : width - border, :]
        views = xp.permute_dims(inner, (0, 2, 1, 3, 4))
        return xp.reshape(views, (-1, *views.shape[2:]))[: self.views, ...]


def depth_scales(largest: np.ndarray) -> np.ndarray:
    """(B,) float32 factors that bring the largest depth (B,) of each view between 1 and 2; ones where one would do."""
    known = np.isfinite(largest) & (largest > 0)
    powers = np.frexp(np.where(known, largest, 1.0))[1]
    if not known.any() or (powers[known] == powers[known][0]).all():
        return np.ones(len(largest), np.float32)
    return np.where(known, np.ldexp(1.0, 1 - powers), 1.0).astype(np.float32)


def at_once(view: tuple[int, int]) -> int:
    """How many views of (height, width) cells, aprons included, go into one picture."""
    return max(1, (SIDE // view[0]) * (SIDE // view[1]))
