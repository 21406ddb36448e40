"""The planes of the samples in a picture of depth, and where outlines lie beside them."""

from __future__ import annotations

from collections.abc import Callable

from rts.arrays.engines import engine_of, namespace, stopped
from rts.arrays.trees import Array
from rts.operations.depth_limits import FAR, FLAT, NEARER, RIM
from rts.operations.operation import Operation


def depth_planes(depth: Array, row: Array, lens: Array) -> Array:
    """The surface in each cell, (9, H, W): even depth, its unit, slopes along x and y, sides' distances, a limit.

    The unit is the even depth of a cell's width; 0 where a cell has no sample. Sides are the left, right, upper and
    lower one, in cells from the centre; by them motions are extrapolated from within. On a smooth rim motions change
    with the root of the distance from the outline, as depths do. Where a point's even depth is at most the limit, plus
    the slopes times the point's x and y, the surface's plane is not in front of it. The result has no derivative.

    Args:
        depth: (H, W) linear depth of the sample in each cell.
        row: (H, W) the sample in each cell, or −1 for none.
        lens: (5,): a and b, of clip w a + b · depth; the depth that even depths count from; that of the near plane; the
            even depth of a cell's width, times clip w.
    """
    return PLANES(depth, row, lens)


def even_depth(depth: Array, lens: Array) -> Array:
    """A depth that grows evenly with x and y on planes: linear depth itself if orthographic, else as −1 / depth."""
    return (depth - lens[2]) / (lens[0] + lens[1] * depth)


def _specification(depth: Array, row: Array, lens: Array) -> Array:
    xp, there = namespace(depth), row >= 0
    z = xp.where(there, stopped(depth), lens[2])
    return _planes(even_depth(z, lens), xp.where(there, lens[4] / (lens[0] + lens[1] * z), 0.0))


def _planes(even: Array, unit: Array) -> Array:
    """The planes of cells of which even depths and their units are known."""
    sides, slopes = [], []
    for axis in (1, 0):
        rise = _Rise(even, unit, axis)
        slopes.append(rise.slope())
        sides += [rise.beyond(-1), rise.beyond(1)]
    xp, (a, b), (x, y) = namespace(even), slopes, _centres(even)
    limit = even + NEARER * (unit + abs(a) + abs(b)) - a * x - b * y
    return xp.stack([even, unit, a, b, *sides, xp.where(unit > 0, limit, FAR)])


def _centres(even: Array) -> tuple[Array, Array]:
    """The x (1, W) and y (H, 1) of the centres of cells."""
    engine, (height, width) = engine_of(even), even.shape
    return engine.arange(width, even)[None, :] + 0.5, engine.arange(height, even)[:, None] + 0.5


class _Rise:
    """How depth rises from cell to cell along an axis. The picture is continued as if it were repeated."""

    def __init__(self, even: Array, unit: Array, axis: int):
        self._xp, self._axis, self._unit, there = namespace(even), axis, unit, unit > 0
        self._ahead, self._is_ahead = self._at(even, 1) - even, there & self._at(there, 1)
        self._back, self._is_back = self._at(self._ahead, -1), self._at(self._is_ahead, -1)

    def _at(self, x: Array, steps: int) -> Array:
        """The array at the cell so many steps ahead."""
        return self._xp.roll(x, -steps, axis=self._axis)

    def slope(self) -> Array:
        """The change of depth a cell: the mean of both sides, or that of the only side that shows the surface."""
        xp, a, b = self._xp, self._ahead, self._back
        smooth, smaller = abs(a - b) <= self._unit + xp.minimum(abs(a), abs(b)), xp.where(abs(a) < abs(b), a, b)
        # Of something thin both sides show another surface.
        thin = (a * b < 0) & (2 * abs(smaller) > xp.maximum(abs(a), abs(b)))
        both = xp.where(smooth, (a + b) / 2, xp.where(thin, 0.0, smaller))
        one = xp.where(self._is_ahead, a, xp.where(self._is_back, b, 0.0))
        return xp.where(self._is_ahead & self._is_back, both, one)

    def beyond(self, end: int) -> Array:
        """How many cells beyond the centre the side at an end lies, −1 or 1; 0 where no cell within tells motions."""
        xp, unit = self._xp, self._unit
        first, known = (-self._ahead, self._is_ahead) if end < 0 else (self._back, self._is_back)
        second, is_second = self._at(first, -end), self._at(known, -end)
        joined = known & is_second & (abs(first - second) <= unit + 3 * abs(second))
        rim = (second > 0) & (first > RIM * second) & (first > unit / 2)
        growth = xp.where(rim, first / xp.where(rim, second, 1.0), 2.0)
        # e ahead of the outline depths rise as √(e + 1) − √e; this is √e over that, nearly.
        at_rim = xp.clip(1 / (growth - 1) - 0.7071, 0.0, None)
        return xp.where(joined, xp.where(rim, at_rim, FLAT), 0.0)


def _shape(depth: tuple[int, ...], row: tuple[int, ...], lens: tuple[int, ...]) -> tuple[int, ...]:
    return 9, *depth


def _loops() -> tuple[Callable, Callable, Callable]:
    from rts.operations import depth_planes_loops as loops

    return loops.forward, loops.push, loops.pull


PLANES = Operation.of_loops("rts.depth_planes", _specification, (2, 2, 1), _shape, _loops)
"""The operation of `depth_planes`."""
