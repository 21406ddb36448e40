"""How much of a point is seen from a camera: pictures of depth, compared with points of any surface.

Pictures are of samples without derivative, evaluated with derivatives: see `rts.operations.coverage`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from rts.arrays.argument_checks import quoted
from rts.arrays.array_functions import described, from_numbers, shape_of
from rts.arrays.engines import context_of, namespace, stopped
from rts.arrays.trees import Array, record
from rts.errors import InputError
from rts.operations.coverage import coverage
from rts.scene.camera import Camera

REACH = 2
"""Cells around a picture that `visibility` reads."""
RIM = 1.2
"""How many times as much depth rises in the last step before a smooth rim as in the step before, at least."""


@record(static=("size",))
class Picture:
    """The samples that a camera sees in front, and their planes; with `REACH` cells around the picture.

    Attributes:
        camera: the camera. Differentiable.
        cells: (K, H · W, 4 or 5), see `rts.operations.coverage`, of K layers. Differentiable.
        planes: (K, H, W, 4), likewise.
        middle: () a depth of the scene's, from which depths are counted.
        size: (height, width) of the picture.
    """

    camera: Camera
    cells: Array
    planes: Array
    middle: Array
    size: tuple[int, int]


@record()
class Seen:
    """A scene as it is seen from a place: the result of `rts.shadows.seen_from`, and a pytree of every engine.

    Attributes:
        pictures: what is seen, in one picture or several. A point is seen if no picture hides it.
    """

    pictures: tuple[Picture, ...]


def visibility(seen: Seen, points: Array, outside: float = 0.0) -> Array:
    """The share of each point that is seen, 0 to 1: of its surroundings, a few pixels of `seen` wide.

    It is differentiable in the points, and in all that `seen` was made of. Derivatives are of first order.

    Args:
        seen: the result of `rts.shadows.seen_from`.
        points: (N, 3) world.
        outside: the result for points outside of all pictures, or behind the camera.

    Returns:
        (N,) of the engine of `seen` and points.

    Raises:
        InputError: an argument is of another kind or shape.
    """
    if not isinstance(seen, Seen):
        raise InputError(f"seen is {quoted(seen)}; expected what rts.shadows.seen_from gave")
    points = from_numbers(points, "points")
    if len(shape_of(points)) != 2 or shape_of(points)[1] != 3:
        raise InputError(f"points {described(points)}; expected (N, 3)")
    context = context_of(seen, points)
    seen, points = context.constants((seen, points))
    xp, share, anywhere = namespace(points), None, None
    for picture in seen.pictures:
        one, inside = _of_picture(picture, points)
        share = one if share is None else share * one
        anywhere = inside if anywhere is None else anywhere | inside
    return xp.where(anywhere, share, outside)


def mean_visibility(seen: Seen | Sequence[Seen] | None, points: Array) -> Any:
    """The visibility (N, 1) of a lamp at points: the mean over several records; 1.0 for None. Outside all is seen."""
    if seen is None:
        return 1.0
    records = [seen] if isinstance(seen, Seen) else seen
    return (sum(visibility(one, points, outside=1.0) for one in records) / len(records))[:, None]


def picture_of(
    depth: Array, moving: Array | None, alpha: Array | None, row: Array, camera: Camera, size: tuple[int, int]
) -> Picture:
    """The picture of samples in their cells.

    Args:
        depth: (K, H, W) linear depth, without derivative; anything where a cell has no sample.
        moving: (K, H, W, 2) x and y of samples, of which only derivatives count; None if nothing moves.
        alpha: (K, H, W, 1) of samples, differentiable; None if they are opaque.
        row: (K, H, W) the sample of each cell and layer, or −1; with `REACH` cells around the picture.
        camera: the camera, in arrays of the engine; differentiable.
        size: (height, width) of the picture.
    """
    xp, there, still = namespace(depth), row >= 0, stopped(camera)
    count = xp.sum(xp.astype(there, depth.dtype))
    middle = xp.where(count > 0, xp.sum(xp.where(there, depth, 0.0)) / xp.where(count > 0, count, 1.0), 1.0)
    even, unit = _even_depths(xp.where(there, depth, middle), still, middle, size)
    slopes, sides = [], []
    for axis in (0, 1):
        rise = _Rise(even, there, 2 - axis)
        slopes.append(rise.slope(unit))
        if moving is None:
            sides += [xp.zeros_like(even)] * 2
            continue
        moved = moving[..., axis] - stopped(moving[..., axis])
        sides += [moved + rise.beyond(unit, end) * (moved - xp.roll(moved, end, axis=2 - axis)) for end in (-1, 1)]
    planes = xp.stack([even, *slopes, xp.where(there, unit, 0.0)], axis=-1)
    columns = sides if alpha is None else [*sides, alpha[..., 0]]
    cells = xp.reshape(xp.stack(columns, axis=-1), (row.shape[0], -1, len(columns)))
    return Picture(camera, cells, planes, middle, size)


class _Rise:
    """How depth rises from cell to cell along an axis.

    Args:
        even: (K, H, W) depth, of a kind that grows evenly on planes.
        there: (K, H, W) bool, true where a cell has a sample.
        axis: the axis of the arrays.
    """

    def __init__(self, even: Array, there: Array, axis: int):
        self._xp, self._axis = namespace(even), axis
        self._ahead, self._is_ahead = self._at(even, 1) - even, there & self._at(there, 1)
        self._back, self._is_back = self._at(self._ahead, -1), self._at(self._is_ahead, -1)

    def _at(self, x: Array, steps: int) -> Array:
        """The array at the cell so many steps ahead."""
        return self._xp.roll(x, -steps, axis=self._axis)

    def slope(self, unit: Array) -> Array:
        """The slope of the surface in each cell; where one side shows another surface, that of the other side."""
        xp, a, b = self._xp, self._ahead, self._back
        smooth, smaller = abs(a - b) <= unit + xp.minimum(abs(a), abs(b)), xp.where(abs(a) < abs(b), a, b)
        # Of something thin both sides show another surface.
        thin = (a * b < 0) & (2 * abs(smaller) > xp.maximum(abs(a), abs(b)))
        both = xp.where(smooth, (a + b) / 2, xp.where(thin, 0.0, smaller))
        return xp.where(
            self._is_ahead & self._is_back, both, xp.where(self._is_ahead, a, xp.where(self._is_back, b, 0.0))
        )

    def beyond(self, unit: Array, end: int) -> Array:
        """How many cells beyond the centre the side at an end lies, −1 or 1, to extrapolate motions from within.

        On a smooth rim motions change with the root of the distance from the outline, as depths do.
        """
        xp = self._xp
        first, known = (-self._ahead, self._is_ahead) if end < 0 else (self._back, self._is_back)
        second, is_second = self._at(first, -end), self._at(known, -end)
        joined = known & is_second & (abs(first - second) <= unit + 3 * abs(second))
        rim = (second > 0) & (first > RIM * second) & (first > unit / 2)
        growth = xp.where(rim, first / xp.where(rim, second, 1.0), 2.0)
        # e ahead of the outline depths rise as √(e + 1) − √e; this is √e over that, nearly.
        at_rim = xp.clip(1 / (growth - 1) - 0.7071, 0.0, None)
        return xp.where(joined, xp.where(rim, at_rim, 0.5), 0.0)


def _even_depths(depth: Array, camera: Camera, middle: Array, size: tuple[int, int]) -> tuple[Array, Array]:
    """`even_depth` of depths, and the even depth of a cell's width there."""
    p, xp = camera.projection, namespace(depth)
    width = 2 / xp.sqrt(size[0] * size[1] * xp.abs(p[0, 0] * p[1, 1] - p[0, 1] * p[1, 0]))
    return even_depth(depth, camera, middle), width * _clip_w(middle, camera) / _clip_w(depth, camera)


def even_depth(depth: Array, camera: Camera, middle: Array) -> Array:
    """A depth that grows evenly with x and y on planes: linear depth itself if orthographic, else as −1 / depth."""
    return (depth - middle) / _clip_w(depth, camera)


def _clip_w(depth: Array, camera: Camera) -> Array:
    """Clip w at linear depths."""
    return camera.projection[3, 3] - camera.projection[3, 2] * depth


def _of_picture(picture: Picture, points: Array) -> tuple[Array, Array]:
    """Visibility (N,) in one picture, 1 outside, and whether points are inside (N,) bool."""
    xp, (height, width), camera = namespace(points), picture.size, stopped(picture.camera)
    placed = picture.camera.project(points, picture.size)
    still, depth, (near, _) = stopped(placed), stopped(placed)[:, 2], camera.depth_range()
    inside = (still[:, 0] >= 0) & (still[:, 0] <= width) & (still[:, 1] >= 0) & (still[:, 1] <= height)
    inside = inside & (depth >= near)
    share = xp.ones_like(depth)
    even = even_depth(xp.where(inside, depth, picture.middle), camera, picture.middle)
    placed = xp.where(inside[:, None], placed[:, :2], 0.0) + REACH
    placed = xp.astype(xp.concat([placed, even[:, None]], axis=1), picture.cells.dtype, copy=False)
    for layer in range(picture.cells.shape[0]):
        hidden = coverage(picture.cells[layer, ...], placed, picture.planes[layer, ...])
        share = share * (1 - hidden[:, 0])
    return xp.where(inside, share, 1.0), inside
