"""The narrow band of an implicit surface: the cells of a lattice through which it passes, at few evaluations."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from numbers import Integral
from typing import Any, NamedTuple

import numpy as np

from rts import InputError
from rts.plugin_api.checks import check_positive, is_count, quoted
from rts.plugin_api.threads import parallel
from rts_surfaces.implicit import blocks_loops
from rts_surfaces.implicit import narrow_band_loops as loops
from rts_surfaces.implicit.lattice import Lattice

Level = Callable[[np.ndarray], np.ndarray]
"""A function of points in space (M, 3) float64 to levels (M,) float32 or float64, negative inside the surface."""

WORK = 5
"""Nanoseconds to compute one point in space; decides how many threads share a loop."""
ROUNDING = 4
"""Rounding error of a level, in units of the last digit of its scale: the Lipschitz bound times coordinates."""


class Band(NamedTuple):
    """Cells of a lattice that a surface passes through, and their corners.

    Attributes:
        numbers: (M,) int64, the points of the lattice that are corners of cells, each once.
        values: (M,) the levels there, in the dtype of the level.
        corners: (C, 8) int32, the rows of `numbers` of the corners of each cell. Corner i has the offsets (i & 1,
            i >> 1 & 1, i >> 2 & 1) along x, y and z.
        cells: (C, 3) int32, the coordinates of the lowest corner of each cell; each cell once, in no special order.
        inner: (D, 8) int32, like `corners`, of cells one further inside: other cells that have an inside corner of
            these `cells`. Points of theirs alone come last in `numbers`. Empty unless asked for.
        evaluations: the number of points at which the level was evaluated.
    """

    numbers: np.ndarray
    values: np.ndarray
    corners: np.ndarray
    cells: np.ndarray
    inner: np.ndarray
    evaluations: int


@dataclass(frozen=True)
class NarrowBand:
    """A search for the cells of a lattice that a surface passes through.

    With a Lipschitz bound these are all cells whose corners differ in sign. A block of cells is dropped if the level at
    its centre is further from zero than it can change within the block; other blocks are halved.

    Without one, the search halves coarse cells whose corners differ in sign, with a margin around them. Of the halves,
    only those whose corners differ in sign are halved again. At every fineness the surface is then followed across the
    sides of cells that it crosses. So each coarse cell whose corners differ in sign has cells in the band, and the band
    has no holes: if the four corners shared with a neighbour differ in sign, the neighbour is in it, too. A separate
    part of the surface between coarse corners of one sign is found only in the margin, and only if it shows at corners
    of halved cells.

    Isosurfaces also need levels one cell further inside, where rays that graze the surface are deepest.

    Args:
        lipschitz: the fastest change of the level, per unit of length; None if unknown.
        coarse: cells along each side of the first blocks, a power of two; None for 16 with a Lipschitz bound and 8
            without one.
        margin: width, in coarse cells, of this margin. It has no effect with a Lipschitz bound.
        chunk: the largest number of points at which the level is evaluated together.

    Raises:
        InputError: an argument is of the wrong kind.
    """

    lipschitz: float | None = None
    coarse: int | None = None
    margin: int = 1
    chunk: int = 2**18

    def __post_init__(self):
        if self.lipschitz is not None:
            known = check_positive("lipschitz", self.lipschitz)
            if known is None:
                raise InputError("lipschitz is traced; expected a known number")
            object.__setattr__(self, "lipschitz", float(known))
        if self.coarse is not None and not (is_count(self.coarse) and int(self.coarse).bit_count() == 1):
            raise InputError(f"coarse is {quoted(self.coarse)}; expected a power of two, such as 16, or None")
        if not isinstance(self.margin, Integral) or isinstance(self.margin, bool) or self.margin < 0:
            raise InputError(f"margin is {quoted(self.margin)}; expected an integer of at least 0")
        if not is_count(self.chunk):
            raise InputError(f"chunk is {quoted(self.chunk)}; expected an integer of at least 1")

    def find(self, level: Level, lattice: Lattice, closed: bool, inner: bool = False) -> Band:
        """Find the cells whose corners differ in sign.

        Args:
            level: see `Level`; called for at most `chunk` places at a time.
            lattice: the lattice.
            closed: True if the surface is capped at the lattice's boundary. Cells are in the band, too, if one of their
                corners is inside and on the boundary.
            inner: True to evaluate the level one cell further inside, too; see `Band.inner`.

        Returns:
            The band; it is empty if there are no such cells. If the level is NaN at a point of the lattice, the search
            ends, and the band is one cell that has this point as a corner.
        """
        evaluate = _Evaluate(level, lattice, int(self.chunk))
        try:
            if self.lipschitz is None:
                grid, cells, rows = _followed(evaluate, int(self.coarse or 8), int(self.margin), bool(closed))
            else:
                grid, cells, rows = _bounded(evaluate, int(self.coarse or 16), self.lipschitz, bool(closed))
            beside = grid.corners(_inner(grid, cells, rows) if inner else cells[:0])
        except _Unknown as unknown:
            evaluate.refuses = False
            point = np.array(np.unravel_index(unknown.number, lattice.shape))
            grid, cells = _Grid(evaluate, 1), np.minimum(point, np.array(lattice.shape) - 2)[None].astype(np.int32)
            rows, beside = grid.corners(cells), np.empty((0, 8), np.int32)
        rows = np.concatenate([rows, beside])
        numbers, values = loops.compact(rows, grid.numbers, grid.values)
        return Band(numbers, values, rows[: len(cells)], cells, rows[len(cells) :], evaluate.count)


class _Unknown(Exception):
    """The level is NaN at the point of the lattice that has this number."""

    def __init__(self, number: int):
        super().__init__()
        self.number = number


class _Evaluate:
    """The level at points of a lattice, in chunks, counted. While it `refuses` NaN, a NaN raises `_Unknown`."""

    def __init__(self, level: Level, lattice: Lattice, chunk: int):
        self.level, self.chunk, self.count, self.refuses = level, chunk, 0, True
        self.dtype = np.dtype(np.float64)  # Until the first evaluation.
        self.shape = lattice.shape
        self.low, self.step = tuple(lattice.low.tolist()), tuple(lattice.step.tolist())

    def counts(self, side: int) -> tuple[int, ...]:
        """The number of blocks with this side along each axis."""
        return tuple(-(-(n - 1) // side) for n in self.shape)

    def all_blocks(self, side: int) -> np.ndarray:
        """All blocks (B, 3) int32 with this side."""
        return np.ascontiguousarray(np.indices(self.counts(side), np.int32).reshape(3, -1).T)

    def at_points(self, numbers: np.ndarray) -> np.ndarray:
        """The levels (M,) at points by number (M,)."""
        return self._levels(loops.places_of, numbers, numbers, self.shape, self.low, self.step)

    def at_centres(self, blocks: np.ndarray, side: int) -> tuple[np.ndarray, np.ndarray]:
        """The numbers (B,) of the centres of blocks (B, 3), −1 where a block is cropped, and the levels there (B,)."""
        numbers = blocks_loops.centre_numbers(blocks, side, self.shape)
        return numbers, self._levels(blocks_loops.centres, numbers, blocks, side, self.shape, self.low, self.step)

    def slack(self, values: np.ndarray, lipschitz: float) -> float:
        """The largest rounding error of levels (M,), from their dtype and the lattice's coordinates."""
        far = max(max(abs(x), abs(x + s * (n - 1))) for x, s, n in zip(self.low, self.step, self.shape, strict=True))
        return ROUNDING * float(np.finfo(values.dtype).eps) * lipschitz * far

    def _levels(self, loop: Callable, numbers: np.ndarray, items: np.ndarray, *args: Any) -> np.ndarray:
        all_levels = np.empty(0, self.dtype)
        for first in range(0, len(items), self.chunk):
            some = items[first : first + self.chunk]
            places = np.empty((len(some), 3))
            parallel(loop, len(some), some, *args, places, work=len(some) * WORK)
            levels = np.asarray(self.level(places))
            self.count += len(some)
            if first == 0:
                all_levels, self.dtype = np.empty(len(items), levels.dtype), levels.dtype
            all_levels[first : first + len(some)] = levels
            wrong = np.isnan(levels) & (numbers[first : first + len(some)] >= 0)
            if self.refuses and wrong.any():
                raise _Unknown(int(numbers[first + wrong.argmax()]))
        return all_levels


class _Grid:
    """Corners of blocks whose sides all have one length, and the levels at corners evaluated so far.

    Attributes:
        numbers: (M,) int64, the numbers in the lattice of corners evaluated so far.
        values: (M,), the levels at these corners.
    """

    def __init__(self, evaluate: _Evaluate, side: int):
        self.side, self.counts = side, evaluate.counts(side)
        self._evaluate, self._count, self._used = evaluate, 0, 0
        self._numbers, self._values = np.empty(64, np.int64), np.empty(0, evaluate.dtype)
        self.directory, self.bricks = _bricks(self.counts, np.int32)

    @property
    def numbers(self) -> np.ndarray:
        return self._numbers[: self._count]

    @property
    def values(self) -> np.ndarray:
        return self._values[: self._count]

    def give(self, numbers: np.ndarray, values: np.ndarray) -> None:
        """Add levels at new corners, by their numbers in the lattice; negative numbers are skipped."""
        numbers, values = numbers[numbers >= 0], values[numbers >= 0]
        first, state = self._count, (self.directory, self.bricks, self._used, self._numbers, self._count)
        self.bricks, self._used, self._numbers, self._count = loops.given_rows(
            numbers, self.side, self._evaluate.shape, self.counts, *state
        )
        self._keep(first, values)

    def corners(self, blocks: np.ndarray) -> np.ndarray:
        """The rows (B, 8) of the corners of blocks in `numbers` and `values`; missing levels are evaluated."""
        first, state = self._count, (self.directory, self.bricks, self._used, self._numbers, self._count)
        rows, self.bricks, self._used, self._numbers, self._count = loops.numbered(
            blocks, self.side, self._evaluate.shape, self.counts, *state
        )
        if self._count > first:
            self._keep(first, self._evaluate.at_points(self._numbers[first : self._count]))
        return rows

    def _keep(self, first: int, values: np.ndarray) -> None:
        if len(self._values) < self._count:
            longer = np.empty(len(self._numbers), values.dtype)
            longer[:first] = self._values[:first]
            self._values = longer
        self._values[first : self._count] = values


def _bricks(counts: tuple[int, ...], dtype: Any) -> tuple[np.ndarray, np.ndarray]:
    """A directory without bricks, and room for some; see `rts_surfaces.implicit.narrow_band_loops`."""
    places = int(np.prod([n // loops.BRICK + 1 for n in counts]))
    return np.full(places, -1, np.int32), np.empty((64, loops.BRICK**3), dtype)


def _bounded(evaluate: _Evaluate, side: int, lipschitz: float, closed: bool) -> tuple[_Grid, np.ndarray, np.ndarray]:
    """Find the cells whose corners differ in sign: the grid of cells, these cells (C, 3) and rows of corners (C, 8)."""
    blocks, centres, slack = evaluate.all_blocks(side), [], 0.0
    while side > 1:
        numbers, levels = evaluate.at_centres(blocks, side)
        slack = evaluate.slack(levels, lipschitz)
        near = blocks_loops.near(blocks, levels, side, evaluate.shape, evaluate.step, lipschitz, slack, closed)
        blocks = blocks[near]
        centres.append((numbers[near], levels[near]))
        if side > 2:
            blocks = blocks_loops.halved(blocks, evaluate.counts(side // 2))
        side //= 2
    grid = _Grid(evaluate, 1)
    if centres:
        numbers, levels = centres.pop()
        pairs = _Grid(evaluate, 2)
        for known in centres:
            pairs.give(*known)
        # How much the level may change to the corner across such axes; not at all to itself.
        across = np.array(evaluate.step) * (np.arange(8)[:, None] >> np.arange(3) & 1)
        reach = lipschitz * np.sqrt((across**2).sum(axis=1)) * (1 + blocks_loops.RELATIVE) + slack
        reach[0] = -1
        rows, bounds = pairs.corners(blocks), (grid.counts, reach, closed)
        blocks = loops.uncertain(blocks, numbers, levels, rows, pairs.values, *bounds)
        grid.give(pairs.numbers, pairs.values)
        grid.give(numbers, levels)
    rows = grid.corners(blocks)
    return grid, *loops.crossed(blocks, rows, grid.values, grid.counts, closed)


def _followed(evaluate: _Evaluate, side: int, margin: int, closed: bool) -> tuple[_Grid, np.ndarray, np.ndarray]:
    """Find cells whose corners differ in sign, and follow the surface from them; results as of `_bounded`."""
    grid = _Grid(evaluate, side)
    blocks = evaluate.all_blocks(side)
    rows = grid.corners(blocks)
    blocks, rows = loops.crossed(blocks, rows, grid.values, grid.counts, closed)
    if side > 1 and margin > 0:
        blocks = blocks_loops.widened(blocks, margin, grid.counts)
        rows = grid.corners(blocks)
    while side > 1:
        side //= 2
        known = loops.compact(rows, grid.numbers, grid.values)
        grid = _Grid(evaluate, side)
        grid.give(*known)
        blocks = blocks_loops.halved(blocks, grid.counts)
        blocks, rows = _complete(grid, blocks, closed)
    return grid, blocks, rows


def _complete(grid: _Grid, blocks: np.ndarray, closed: bool) -> tuple[np.ndarray, np.ndarray]:
    """The blocks whose corners differ in sign, and blocks into which the surface continues: (C, 3), and rows (C, 8)."""
    directory, bricks = _bricks(grid.counts, np.uint8)
    bricks, used = loops.marked(blocks, grid.counts, directory, bricks, 0)
    rows = grid.corners(blocks)
    fronts = [loops.crossed(blocks, rows, grid.values, grid.counts, closed)]
    while len(fronts[-1][0]):
        blocks, bricks, used = loops.beyond(*fronts[-1], grid.values, grid.counts, closed, directory, bricks, used)
        rows = grid.corners(blocks)
        fronts.append((blocks, rows))
    return np.concatenate([f[0] for f in fronts]), np.concatenate([f[1] for f in fronts])


def _inner(grid: _Grid, cells: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Other cells (D, 3) that have a corner of these cells (C, 3) which is inside; `rows` are (C, 8)."""
    directory, bricks = _bricks(grid.counts, np.uint8)
    bricks, used = loops.marked(cells, grid.counts, directory, bricks, 0)
    return loops.inner(cells, rows, grid.values, grid.counts, directory, bricks, used)


def rows_by_place(numbers: np.ndarray, shape: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray]:
    """A directory and bricks that tell the row of each lattice point by number (M,); see `narrow_band_loops.row_at`."""
    directory, bricks = _bricks(shape, np.int32)
    state = directory, bricks, 0, np.empty_like(numbers), 0
    return directory, loops.given_rows(numbers, 1, shape, shape, *state)[0]
