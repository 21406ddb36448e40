"""Splats of several views side by side in one picture, so that one splat serves them all.

Each view keeps the apron that it was sampled with, so no splat of another reaches its image. What splatters decide by
depths they decide in terms of the largest: of each view it is brought between 1 and 2, by a power of two.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from rts.engines import engine_of, namespace, value_of
from rts.records import Splats
from rts.trees import Array

SIDE = 1024
"""Cells along each side of a picture, at most: float32 places samples there to 1/16000 of a cell."""


class Picture(NamedTuple):
    """Places of views, line after line.

    Attributes:
        views: B, the number of views.
        view: height and width of each, in cells, with its apron.
        across: views in a line.
    """

    views: int
    view: tuple[int, int]
    across: int

    @classmethod
    def of(cls, count: int, view: tuple[int, int]) -> Picture:
        """A picture of so many views, about as high as wide."""
        return cls(count, view, min(count, max(1, round(math.sqrt(count * view[0] / view[1])))))

    @property
    def down(self) -> int:
        """Lines of views."""
        return -(-self.views // self.across)

    def joined(self, views: Sequence[Splats]) -> Splats:
        """The splats of views that tell alike, as those of the picture: it has no border, but cells that are wanted."""
        xp, engine, border = namespace(views[0].positions), engine_of(views[0].positions), views[0].border
        counts = [splats.positions.shape[0] for splats in views]
        down, across = np.divmod(np.arange(self.views), self.across)
        corners = np.stack([across * self.view[1], down * self.view[0], 0 * down], axis=1).astype(np.float32)
        positions = xp.concat([splats.positions * _scale(splats) for splats in views])
        first = np.cumsum([0, *counts[:-1]], dtype=np.int32)[:, None, None, None]
        inside = np.zeros((self.views, 1, *self.view), bool)
        inside[:, :, border : self.view[0] - border, border : self.view[1] - border] = True

        def told(name: str, empty: int | bool, rows: bool = False) -> Array | None:
            """A field of splats: rows of samples are counted over all views."""
            given = [getattr(splats, name) for splats in views]
            if given[0] is None:
                return None
            grids = xp.stack(given)
            several = len(grids.shape) == 4
            grids = grids if several else grids[:, None, ...]
            grids = xp.where(grids >= 0, grids + engine.constant(first, positions), grids) if rows else grids
            found = self._laid_out(grids, empty)
            return found if several else found[0, ...]

        return Splats(
            positions + engine.constant(np.repeat(corners, counts, axis=0), positions),
            xp.concat([splats.rgba for splats in views]),
            told("row", -1, rows=True),
            told("part", -1),
            told("facing", 0),
            told("settled", False),
            wanted=self._laid_out(engine.constant(inside, positions), False)[0, ...],
            exit=told("exit", -1, rows=True),
        )

    def _laid_out(self, views: Array, empty: int | bool) -> Array:
        """The picture (K, height, width) of arrays (B, K, h, w) of the views; `empty` is where there is none."""
        xp, (height, width), nowhere = namespace(views), self.view, self.down * self.across - self.views
        if nowhere:
            views = xp.concat([views, *[xp.full_like(views[:1, ...], empty)] * nowhere])
        grid = xp.reshape(views, (self.down, self.across, -1, height, width))
        return xp.reshape(xp.permute_dims(grid, (2, 0, 3, 1, 4)), (-1, self.down * height, self.across * width))

    def apart(self, image: Array, border: int) -> Array:
        """The views (B, h, w, C) of an image (height, width, C) of the picture, without their borders."""
        xp, (height, width) = namespace(image), self.view
        grid = xp.reshape(image, (self.down, height, self.across, width, image.shape[-1]))
        inner = grid[:, border : height - border, :, border : width - border, :]
        views = xp.permute_dims(inner, (0, 2, 1, 3, 4))
        return xp.reshape(views, (-1, *views.shape[2:]))[: self.views, ...]


def _scale(splats: Splats) -> Array:
    """Factors (1, 3) of positions, which bring the largest depth between 1 and 2."""
    xp, positions, factor = namespace(splats.positions), splats.positions, 1.0
    most = value_of(xp.max(xp.abs(positions[:, 2]))) if positions.shape[0] else None
    if most is not None and np.isfinite(most) and most > 0:
        factor = 2.0 ** (1 - np.frexp(most)[1])
    return engine_of(positions).constant(np.array([[1.0, 1.0, factor]]), positions)


def at_once(view: tuple[int, int]) -> int:
    """How many views of (height, width) cells, aprons included, go into one picture."""
    return max(1, (SIDE // view[0]) * (SIDE // view[1]))
