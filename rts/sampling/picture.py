"""The layout of several views in one picture, so that one splat serves all views.

Each view keeps the apron that it was sampled with, so no splat of another view reaches its image.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import fields, replace
from typing import NamedTuple

import numpy as np

from rts.arrays.engines import engine_of, namespace
from rts.arrays.trees import Array
from rts.contracts.records import Outlines

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
        square_across = math.sqrt(count * view[0] / view[1])
        # From half as wide to twice as wide as high.
        least, most = (
            max(-(-count // down), min(round(n), most, count))
            for n in (square_across / math.sqrt(2), square_across * math.sqrt(2))
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
        (height, width), slices = self.view, []
        for y, x in np.ndindex(self.down, self.across):
            slices.append((slice(y * height, (y + 1) * height), slice(x * width, (x + 1) * width)))
        return slices[: self.views]

    def corners(self) -> np.ndarray:
        """(B, 2) the column and the line of the first cell of each view."""
        down, across = np.divmod(np.arange(self.views), self.across)
        return np.stack([across * self.view[1], down * self.view[0]], axis=1)

    def laid_out(self, views: Array, empty: int | bool) -> Array:
        """The picture (K, height, width) of the views' arrays (B, K, h, w); `empty` fills places without a view."""
        xp, (height, width), nowhere = namespace(views), self.view, self.down * self.across - self.views
        if nowhere:
            views = xp.concat([views, *[xp.full_like(views[:1, ...], empty)] * nowhere])
        grid = xp.reshape(views, (self.down, self.across, -1, height, width))
        return xp.reshape(xp.permute_dims(grid, (2, 0, 3, 1, 4)), (-1, *self.size))

    def split(self, image: Array, border: int) -> Array:
        """The views (B, h, w, C), borders cut off, of an image (height, width, C) of the picture."""
        xp, (height, width) = namespace(image), self.view
        grid = xp.reshape(image, (self.down, height, self.across, width, image.shape[-1]))
        inner = grid[:, border : height - border, :, border : width - border, :]
        views = xp.permute_dims(inner, (0, 2, 1, 3, 4))
        return xp.reshape(views, (-1, *views.shape[2:]))[: self.views, ...]


def at_once(view: tuple[int, int]) -> int:
    """Number of views of (height, width) cells, aprons included, that fit into one picture."""
    return max(1, (SIDE // view[0]) * (SIDE // view[1]))


def renumbered(rows: Array, starts: np.ndarray, shifts: np.ndarray) -> Array:
    """Indices (n, ...) of rows, moved by the `shifts` (n, P) of the tables that they are in; −1 stays.

    The P tables follow one another, and begin at the rows `starts` (n, P), the first at 0.
    """
    xp, constant, moved = namespace(rows), engine_of(rows).constant, rows
    for table in range(shifts.shape[1]):
        start, shift = (constant(x[:, table].reshape(-1, *[1] * (rows.ndim - 1)), rows) for x in (starts, shifts))
        moved = xp.where(rows >= start, rows + shift, moved)
    return moved


def outlines_side_by_side(
    views: Sequence[Outlines], picture: Picture, starts: np.ndarray, shifts: np.ndarray
) -> Outlines:
    """The outlines of several views as those of their picture: breaks and segments, view after view.

    Args:
        views: the outlines of each view.
        picture: the layout of the views.
        starts: (B, P) the first row of each part in a view.
        shifts: (B, P) by how much the rows of these parts move in the picture.
    """
    xp, first, joined = namespace(views[0].place), views[0], {}
    for name in (field.name for field in fields(Outlines) if getattr(first, field.name) is not None):
        of_views = [getattr(view, name) for view in views]
        joined[name] = picture.laid_out(xp.stack(of_views), False) if name == "joined" else xp.concat(of_views)
    whole, constant = Outlines(**joined), engine_of(first.place).constant
    counts = np.array([(view.place.shape[0], view.square.shape[0]) for view in views], np.int32)
    of_break, of_segment = (np.repeat(np.arange(len(views)), count) for count in counts.T)
    corners = np.insert(picture.corners()[:, ::-1], 2, 0, axis=1).astype(np.int32)
    before = np.cumsum(counts[:, :1], axis=0, dtype=np.int32) - counts[:, :1]

    def of_samples(rows: Array) -> Array:
        return renumbered(rows, starts[of_break], shifts[of_break])

    def of_breaks(ties: Array) -> Array:
        return renumbered(ties, 0 * before[of_segment], before[of_segment])

    return replace(
        whole.with_rows(of_samples),
        gap=whole.gap + constant(corners[of_break], whole.gap),
        square=whole.square + constant(corners[of_segment, :2], whole.square),
        ties=of_breaks(whole.ties),
        beyond=of_breaks(whole.beyond),
    )
