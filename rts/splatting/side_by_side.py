"""The layout of several views in one picture, so that one splat serves all views.

Each view keeps the apron that it was sampled with, so no splat of another view reaches its image. Splatters compare
depths relative to the largest one. If the largest depths of views differ much, they are scaled to between 1 and 2 by
powers of two, which is exact. The threshold for equal depths is then up to twice that of a single view.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from rts.arrays.engines import namespace
from rts.arrays.trees import Array

SIDE = 1024
"""Largest number of cells along each side of a picture: float32 places samples there to 1/16000 of a cell."""


class Picture(NamedTuple):
    """Places of views in a picture, line after line.

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
        """A picture of `count` views, about as high as wide, with few empty places."""
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
        """Lines and columns of the cells of each view."""
        (height, width), places = self.view, []
        for y, x in np.ndindex(self.down, self.across):
            places.append((slice(y * height, (y + 1) * height), slice(x * width, (x + 1) * width)))
        return places[: self.views]

    def corners(self) -> np.ndarray:
        """(B, 2) the column and the line of the first cell of each view."""
        down, across = np.divmod(np.arange(self.views), self.across)
        return np.stack([across * self.view[1], down * self.view[0]], axis=1)

    def inside(self, border: int) -> np.ndarray:
        """(height, width) bool, true for the cells of views but for a border in each."""
        (height, width), inside = self.view, np.zeros((self.down, self.view[0], self.across, self.view[1]), bool)
        inside[:, border : height - border, :, border : width - border] = True
        for y, x in list(np.ndindex(self.down, self.across))[self.views :]:
            inside[y, :, x] = False
        return inside.reshape(self.size)

    def laid_out(self, views: Array, empty: int | bool) -> Array:
        """The picture (K, height, width) of the views' arrays (B, K, h, w); `empty` fills places without a view."""
        xp, (height, width), nowhere = namespace(views), self.view, self.down * self.across - self.views
        if nowhere:
            views = xp.concat([views, *[xp.full_like(views[:1, ...], empty)] * nowhere])
        grid = xp.reshape(views, (self.down, self.across, -1, height, width))
        return xp.reshape(xp.permute_dims(grid, (2, 0, 3, 1, 4)), (-1, *self.size))

    def apart(self, image: Array, border: int) -> Array:
        """The views (B, h, w, C), borders cut off, of an image (height, width, C) of the picture."""
        xp, (height, width) = namespace(image), self.view
        grid = xp.reshape(image, (self.down, height, self.across, width, image.shape[-1]))
        inner = grid[:, border : height - border, :, border : width - border, :]
        views = xp.permute_dims(inner, (0, 2, 1, 3, 4))
        return xp.reshape(views, (-1, *views.shape[2:]))[: self.views, ...]


def depth_scales(largest: np.ndarray) -> np.ndarray:
    """(B,) float32 factors that scale the largest depth (B,) of each view to between 1 and 2.

    All factors are one if the views would need the same factor. So are those of views without a positive, finite depth.
    """
    usable = np.isfinite(largest) & (largest > 0)
    powers = np.frexp(np.where(usable, largest, 1.0))[1]
    if not usable.any() or (powers[usable] == powers[usable][0]).all():
        return np.ones(len(largest), np.float32)
    return np.where(usable, np.ldexp(1.0, 1 - powers), 1.0).astype(np.float32)


def at_once(view: tuple[int, int]) -> int:
    """Number of views of (height, width) cells, aprons included, that fit into one picture."""
    return max(1, (SIDE // view[0]) * (SIDE // view[1]))
