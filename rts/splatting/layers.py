"""The layers around each target of an image: depths, pairing, accumulation, compositing."""

from __future__ import annotations

import functools
import operator
from collections.abc import Callable
from typing import Any

import numpy as np

from rts.arrays.engines import namespace, stopped
from rts.arrays.extremes import extent
from rts.arrays.trees import Array
from rts.contracts.records import Cells, Splats
from rts.errors import InputError
from rts.operations.operation import known_value

OFFSETS = (-1, 0, 1)
NEIGHBOURS = [(u, v) for v in OFFSETS for u in OFFSETS]
AROUND = [n for n in NEIGHBOURS if n != (0, 0)]

Steps = tuple[int, int]
"""A step: numbers of cells along x and y."""


def check_rows(row: Array, count: int, name: str = "row") -> None:
    """Raise an InputError if `row` holds a number that is neither −1 nor an index below `count`; traced rows pass."""
    value = known_value(row)
    if value is None or not value.size:
        return
    low, high = extent(value)
    if high >= count:
        raise InputError(f"{name} refers to sample {high} of {count}; expected indices below, or -1 for an empty cell")
    if low < -1:
        raise InputError(f"{name} refers to sample {low}; expected indices of samples, or -1 for an empty cell")


def check_settled(settled: Array, shape: tuple[int, ...], count: int) -> None:
    """Raise an InputError unless `Splats.settled` is of the grid's `shape`, and of −1 or indices below `count`."""
    if tuple(settled.shape) != tuple(shape):
        raise InputError(f"settled has shape {tuple(settled.shape)}; expected {tuple(shape)}, as row says")
    if not namespace(settled).isdtype(settled.dtype, "signed integer"):
        raise InputError(
            f"settled is {settled.dtype}; expected signed integers: the sample whose colour a cell shows, or -1"
        )
    check_rows(settled, count, "settled")


class Depths:
    """Depths of the cells around each target of an image; (u, v) leads from source to target."""

    def __init__(self, depth: list[Array], covered: Array, facing: list[Array] | None = None):
        """Take depths of each layer (h, w), finite, a mask of covered cells (K, h, w), and `Splats.facing`.

        All have a border of one empty cell around the image (H, W). Without `facing`, any two layers may pair.
        `extent` is the range of the fronts' depths and the camera's, 0: hidden samples may have been left out.
        """
        self.xp = namespace(covered, depth[0])
        self.size = covered.shape[1] - 2, covered.shape[2] - 2
        self.covered, self._facing = covered, facing
        self._depth, self.extent = _beyond(depth, covered), _extent(depth[0], covered[0])
        front = self._depth[0][None], self.xp.where(covered[0], 0, -1)[None]
        self._front = bordered(front[0])[0], bordered(front[1])[0] >= 0
        self.target = self.source(0, 0)

    def behind(self, depth: Array) -> Array:
        """Distances behind the fronts, of depths (h, w), with the border."""
        return depth - self._depth[0]

    def front(self, u: int, v: int) -> tuple[Array, Array]:
        """Depth of the sources' fronts and a mask of covered ones, (H, W) both; |u| and |v| up to 2."""
        depth, covered = (self.at(x, u, v, border=2) for x in self._front)
        return depth, covered

    def source(self, u: int, v: int) -> list[Array]:
        """Depths of the sources' layers, K times (H, W)."""
        return [self.at(z, u, v) for z in self._depth]

    def sides(self, u: int, v: int) -> list[Array] | None:
        """`Splats.facing` of the sources' layers, K times (H, W); or None."""
        return None if self._facing is None else [self.at(f, u, v) for f in self._facing]

    def covers(self, u: int, v: int) -> Array:
        """True where the sources have any layer, (H, W)."""
        return self.at(self.covered[0], u, v)

    def pairing(self, u: int, v: int) -> tuple[Array, Array]:
        """The number s of `Multi`, and the difference of the paired depths, (H, W) both.

        With `facing`, a hidden layer does not pair with a front that is the other side of its piece. Only a last layer
        marked `Cells.MORE_BEHIND` may, with fronts behind it: it stands for the unknown layers there.
        """
        source, xp = self.source(u, v), self.xp
        ahead, below = [xp.abs(z - self.target[0]) for z in source], [xp.abs(z - source[0]) for z in self.target]
        if self._facing is not None:
            cells = [(self.at(f, u, v), self.at(f, 0, 0)) for f in self._facing]
            (front, target), *hidden = cells
            for k, (p, q) in enumerate(hidden, start=1):
                ahead[k] = xp.where(opposite_sides(p, target, self.target[0] > source[k]), xp.inf, ahead[k])
                below[k] = xp.where(opposite_sides(q, front, source[0] > self.target[k]), xp.inf, below[k])
        a, best_a = first_minimum(ahead, xp)
        b, best_b = first_minimum(below, xp)
        return xp.where(best_b < best_a, -b, a), xp.minimum(best_a, best_b)

    def fronts_pair(self, u: int, v: int, margin: float) -> tuple[Array, Array]:
        """True where two fronts are closer, by a margin, than a front and a hidden layer; and the least distance.

        Distances are of depths between a source's and a target's layer, at least one of them a front; (H, W) both.
        """
        source, xp = self.source(u, v), self.xp
        front, hidden = xp.abs(source[0] - self.target[0]), xp.full_like(source[0], xp.inf)
        for p, q in zip(source[1:], self.target[1:], strict=True):
            hidden = xp.minimum(hidden, xp.minimum(xp.abs(p - self.target[0]), xp.abs(q - source[0])))
        return front + margin < hidden, xp.minimum(front, hidden)

    def continues(self, u: int, v: int, limit: Array) -> Array:
        """True (H, W) where a front, the source's or target's, is on the line through the other and the cell beyond it.

        The distance from the line must be less than `limit`.
        """
        xp = self.xp
        source, target = self.at(self._depth[0], u, v), self.target[0]
        continued = xp.zeros_like(target, dtype=xp.bool)
        for end, start, steps in ((source, target, -1), (target, source, 2)):
            before, covered = self.front(steps * u, steps * v)
            continued = continued | (covered & (xp.abs(end - (2 * start - before)) < limit))
        return continued

    def at(self, cells: Array, u: int, v: int, border: int = 1) -> Array:
        """For each target (H, W), the cell of (h, w, …) from which (u, v) leads to it; `border` cells are around."""
        top, left = border - v, border - u
        return cells[top : top + self.size[0], left : left + self.size[1], ...]


class Layers(Depths):
    """`Depths` with weights and colours.

    Attributes:
        position: for each layer (h, w, 3); any value where the layer is not covered.
        exits: for each entry of `Splats.exit` a mask of the cells that have it (h, w), and its position (h, w, 3).
    """

    def __init__(self, weights: Callable[[Array], Any], splats: Splats, facing: Array | None = None):
        """Layers of packed samples; `weights` is `Kernel.weights`, `facing` is `Splats.facing` or None."""
        check_rows(splats.row, splats.positions.shape[0])
        cells = bordered(splats.row)
        every = [cells[k] for k in range(splats.row.shape[0])]
        self.position = [unpack(splats.positions, c) for c in every]
        self.exits: list[tuple[Array, Array]] = []
        if splats.exit is not None:
            check_rows(splats.exit, splats.positions.shape[0])
            exits = bordered(splats.exit)
            self.exits = [(exits[e] >= 0, unpack(splats.positions, exits[e])) for e in range(exits.shape[0])]
        sides = None if facing is None else list(bordered(facing, 0))
        super().__init__([p[..., 2] for p in self.position], cells >= 0, sides)
        self._color = [_weighted(unpack(splats.rgba, c), (c >= 0)[..., None]) for c in every]
        self._weights = [weights(p) for p in self.position]

    def splats(self, u: int, v: int, still: Array | None = None) -> list[Array]:
        """Splats of the sources' layers, K times (H, W, 5): weighted colours and the weight.

        Args:
            u: along x.
            v: along y.
            still: (H, W) bool, targets at which weights have no derivative; None for none.
        """
        splats = []
        for k in range(len(self._color)):
            weight = self.weight(k, u, v)
            weight = weight if still is None else self.xp.where(still, stopped(weight), weight)
            splats.append(self.color(k, u, v) * weight[..., None])
        return splats

    def color(self, k: int, u: int, v: int) -> Array:
        """Colours of the sources' layer k with a 1 appended, (H, W, 5); zeros where it is not covered."""
        return self.at(self._color[k], u, v)

    def weight(self, k: int, u: int, v: int) -> Array:
        """Weights of the sources' layer k (H, W); any value where it is not covered."""
        wx, wy = self._weights[k]
        return self.at(wx[u] * wy[v], u, v)


def nothing(rgba: Array, row: Array) -> Array:
    """The image (H, W, 4) of no samples: zeros. An InputError if `row` (K, H, W) names a sample."""
    check_rows(row, 0)
    xp = namespace(rgba, row)
    return xp.stack([xp.zeros_like(row[0], dtype=rgba.dtype)] * 4, axis=-1)


def unpack(values: Array, cells: Array) -> Array:
    """(h, w, C) of packed values (N, C). An empty cell gets values of row 0, to be masked."""
    xp = namespace(values, cells)
    index = xp.reshape(xp.where(cells >= 0, cells, 0), (-1,))
    return xp.reshape(xp.take(values, index, axis=0), (*cells.shape, values.shape[1]))


def bordered(cells: Array, value: int = -1) -> Array:
    """Cells (K, H, W) with a border, one cell wide, filled with `value`."""
    xp = namespace(cells)
    side = xp.full_like(cells[:, :, :1], value)
    cells = xp.concat([side, cells, side], axis=2)
    end = xp.full_like(cells[:, :1, :], value)
    return xp.concat([end, cells, end], axis=1)


def _weighted(rgba: Array, covered: Array) -> Array:
    """(h, w, 5): colour, and 1 to sum the weights; zero where not covered."""
    xp = namespace(rgba)
    return xp.where(covered, xp.concat([rgba, xp.ones_like(rgba[..., :1])], axis=-1), 0.0)


def normalised(total: Array, xp: Any) -> Array:
    """Colours (H, W, 4) of sums (H, W, 5): over the sum of weights, the last, or over 1 if less (paper eq. 3)."""
    return total[..., :4] / xp.clip(total[..., 4:], 1.0, None)


def _beyond(depth: list[Array], covered: Array) -> list[Array]:
    """Depths of each layer, with one depth for all empty places.

    It lies beyond all layers, at a distance of the scene's own scale: at least as far from any layer as two layers are
    from each other, so that no layer pairs with an empty place.
    """
    xp = namespace(covered, depth[0])
    extent = _extent(xp.stack(depth), covered)
    beyond = xp.where(extent > 0, 2 * extent, 1.0)
    return [xp.where(covered[k], z, beyond) for k, z in enumerate(depth)]


def _extent(depth: Array, covered: Array) -> Array:
    """The range () of the covered depths and the camera's, 0."""
    xp = namespace(covered, depth)
    depth = xp.where(covered, depth, 0.0)
    return xp.clip(xp.max(depth), 0.0, None) - xp.clip(xp.min(depth), None, 0.0)


def opposite(n: Steps) -> Steps:
    """The reversed steps."""
    return -n[0], -n[1]


def dilated(cells: np.ndarray) -> np.ndarray:
    """The marks (H, W), bool or uint8, spread to the eight cells around each."""
    wide = np.pad(cells, ((1, 1), (0, 0)))
    wide = np.pad(wide[:-2] | wide[1:-1] | wide[2:], ((0, 0), (1, 1)))
    return wide[:, :-2] | wide[:, 1:-1] | wide[:, 2:]


def all_of(conditions: list[Array]) -> Array:
    """True where all conditions hold; at least one is given."""
    return functools.reduce(operator.and_, conditions)


def fronts(covered: np.ndarray) -> np.ndarray:
    """(K, H, W) bool: the covered cells of the first layer."""
    return covered & (np.arange(len(covered)) == 0)[:, None, None]


def opposite_sides(hidden: Array, front: Array, behind: Array) -> Array:
    """True where a hidden layer is the other side of a front's piece, so that the two do not pair.

    Args:
        hidden: (H, W), `Splats.facing` of the hidden layer.
        front: (H, W), `Splats.facing` of the front, in a neighbouring cell.
        behind: (H, W) bool, true where that front is deeper than the hidden layer.
    """
    xp, bit = namespace(front), Cells.MORE_BEHIND
    other = (front != 0) & (hidden == -front)
    return other | ((front != 0) & ~behind & (hidden == -front - xp.where(front > 0, bit, -bit)))


def first_minimum(values: list[Array], xp: Any) -> tuple[Array, Array]:
    """Index and value of the smallest of several images, per cell; the first of equal ones."""
    best, index = values[0], xp.zeros_like(values[0], dtype=xp.int32)
    for k, value in enumerate(values[1:], start=1):
        smaller = value < best
        best, index = xp.where(smaller, value, best), xp.where(smaller, k, index)
    return index, best


def nearest(source: list[Array], depth: Array, s: Array, xp: Any) -> Array:
    """Index of each source's hidden layer beyond s that is nearest to `depth` (H, W); K where no layer is beyond s."""
    best, index = xp.full_like(depth, xp.inf), xp.full_like(s, len(source))
    for k, z in enumerate(source[1:], start=1):
        distance = xp.abs(z - depth)
        nearer = (k > s) & (distance < best)
        best, index = xp.where(nearer, distance, best), xp.where(nearer, k, index)
    return index


def over(front: Array, back: Array) -> Array:
    """`front` composited over `back`, both premultiplied RGBA (…, 4) (Porter and Duff 1984)."""
    return front + (1 - front[..., 3:]) * back
