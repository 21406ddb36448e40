"""The layout of several views in one picture, so that one splat serves all views.

Each view keeps the border that it was sampled with, so no splat of another view reaches its image.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from rts.arrays.engines import engine_of, namespace
from rts.arrays.trees import Array
from rts.contracts.records import Stencil

SIDE = 1024
"""Largest number of cells along each side of a picture: float32 places samples there to 1/16000 of a cell."""


class Picture(NamedTuple):
    """Places of views in a picture, line after line.

    Attributes:
        views: B, the number of views.
        view: height and width of each, in cells, with its border.
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
    """Number of views of (height, width) cells, borders included, that fit into one picture."""
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


def stencils_side_by_side(
    views: Sequence[Stencil], picture: Picture, starts: np.ndarray, shifts: np.ndarray
) -> Stencil:
    """The stencils of several views as that of their picture: entries and stacks, view after view.

    Args:
        views: the stencils of each view.
        picture: the layout of the views.
        starts: (B, P) the first row of each part in a view.
        shifts: (B, P) by how much the rows of these parts move in the picture.
    """
    xp, engine, (height, width) = namespace(views[0].joined), engine_of(views[0].joined), picture.view
    across, cells = picture.size[1], picture.size[0] * picture.size[1]
    corners = (picture.corners() @ [1, across]).astype(np.int32)

    def whole(name: str) -> Array:
        return xp.concat([getattr(view, name) for view in views])

    def of_views(name: str, values: np.ndarray) -> np.ndarray:
        """Values (B, ...) for each entry of its view."""
        return np.repeat(values, [getattr(view, name).shape[0] for view in views], axis=0)

    def placed(cell: Array, corner: np.ndarray) -> Array:
        """Cells of views, whose first cells are `corner`, as those of the picture."""
        line = cell // width
        return cell + line * (across - width) + engine.constant(corner, cell)

    def moved(name: str) -> Array:
        return renumbered(whole(name), of_views(name, starts), of_views(name, shifts))

    cell = {name: placed(whole(name), of_views(name, corners)) for name in ("color_cell", "motion_cell")}
    if views[0].stacks is None:
        colors = {name: moved(name) for name in ("color_sample", "motion_colors")}
    else:
        before = np.cumsum([0, *(view.stacks.shape[0] for view in views if view.stacks is not None)])[:-1]

        def composites(name: str) -> Array:
            """Composites of cells and stacks of views as those of the picture."""
            named = whole(name)
            shape = -1, *[1] * (named.ndim - 1)
            corner, first = (of_views(name, x).astype(np.int32).reshape(shape) for x in (corners, before))
            stack = named + engine.constant(first + np.int32(cells - height * width), named)
            inside = xp.where(named < 0, named, placed(named, corner))
            return xp.where(named < height * width, inside, stack)

        colors = {name: composites(name) for name in ("color_sample", "motion_colors")}
    fields = {**cell, **colors, "motion_sample": moved("motion_sample")}
    fields |= {name: whole(name) for name in ("color_weight", "motion_weight")}
    for kind in ("color", "motion"):
        order = xp.argsort(fields[f"{kind}_cell"])
        for name in (name for name in fields if name.startswith(kind)):
            fields[name] = xp.take(fields[name], order, axis=0)
    joined = picture.laid_out(xp.stack([view.joined for view in views]), False)
    return Stencil(joined, **fields, stacks=None if views[0].stacks is None else moved("stacks"))
