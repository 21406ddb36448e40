"""Strips: the fine cells that active pixels need, laid out side by side as one picture that any splatter can take.

The image is cut into strips of a few lines of pixels. The columns of a strip that hold active pixels form runs, with an
apron of fine cells around each, so that no splat crosses from one run to another. Runs are laid side by side in lines
of the layout, each as high as a strip and its apron. Cells that no active pixel needs are empty. A cell that two runs
show is sampled, evaluated and shaded once.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from rts.arrays.engines import Engine, constants, engine_of, namespace
from rts.arrays.trees import Array
from rts.compiling.threads import parallel, read_only
from rts.contracts.records import ArraySpec, Cells, Decision, Fine, Question, Sampled, Samples
from rts.sampling.hidden import HiddenRule, numbers_of

STRIP = 16
"""Approximate height of a strip in fine cells, without its apron. Lower strips have more aprons, higher ones more empty
cells."""

LINE = 256
"""Fine cells in each line (row of an array) of the list of cells to sample."""

FILLED = 1 / 3
"""Assumed share of needed cells in a strip, where shapes have to be known beforehand."""


class FineGrid(NamedTuple):
    """The sizes of an adaptively sampled image.

    Attributes:
        size: (height, width) in pixels.
        side: s, fine cells along each side of a pixel.
        apron: fine cells around active pixels, and around the image; also coarse cells around the coarse grid.
    """

    size: tuple[int, int]
    side: int
    apron: int

    @property
    def fine(self) -> tuple[int, int]:
        """Height and width of the grid of fine cells, with its apron."""
        height, width = self.size
        return height * self.side + 2 * self.apron, width * self.side + 2 * self.apron

    @property
    def high(self) -> int:
        """Pixels from top to bottom of a strip."""
        return max(1, STRIP // self.side)

    @property
    def strips(self) -> int:
        """Number of strips in the image."""
        return -(-self.size[0] // self.high)

    @property
    def gap(self) -> int:
        """Pixels of width that the aprons of a run take, left and right together, rounded up."""
        return -(-2 * self.apron // self.side)

    @property
    def pitch(self) -> int:
        """Pixels of height that a line of a layout takes, aprons included."""
        return self.high + self.gap

    def room(self, capacity: int | None, layers: int) -> Room:
        """Room for `capacity` rows in `layers` layers, if strips are `FILLED`; None for the worst case."""
        cells, columns = self.fine[0] * self.fine[1], self.strips * (self.size[1] + self.gap)
        if capacity is None:
            return Room(columns, cells)
        each = FILLED * self.high * self.side**2
        return Room(min(columns, math.ceil(capacity / layers / each)), min(cells, max(1, capacity // layers)))


class Room(NamedTuple):
    """The size of a layout: columns of strips, and fine cells.

    Attributes:
        columns: columns of strips, a pixel wide, those of aprons included.
        cells: fine cells to sample.
    """

    columns: int
    cells: int

    def share(self, of_all: float) -> Room:
        """A share of the room."""
        return Room(math.ceil(of_all * self.columns), math.ceil(of_all * self.cells))


def rounded(count: int) -> int:
    """The least 2ⁿ or 3·2ⁿ that is at least `count` and 16: few shapes, so that compiled programs are reused."""
    size = 16
    while size < count:
        size = size * 3 // 2 if size & (size - 1) == 0 else size * 4 // 3
    return size


class Layout(NamedTuple):
    """Fine cells in strips.

    Attributes:
        cells: (L, LINE) int32, the cells to sample, as flat indices in the grid with its apron; −1 for none.
        place: (h, w) int32, the index in `cells` that each place of the layout shows, or −1.
        kinds: (h, w) uint8, bits of `strips_loops`: `WANTED` in an active pixel, `NEAR` within two cells of one.
        wanted: (h, w) bool, the cells of active pixels.
        pixel: (H, W) int32, flat index of an active pixel in the layout, in pixels without the apron; −1 for others.
        coarse: (H', W') bool, the coarse cells, apron included, whose pixels are not active.
        dropped: () int32, the number of active pixels without room.
    """

    cells: Array
    place: Array
    kinds: Array
    wanted: Array
    pixel: Array
    coarse: Array
    dropped: Array

    @staticmethod
    def specs(grid: FineGrid, room: Room) -> tuple[ArraySpec, ...]:
        """Shapes and dtypes of the fields."""
        place = _shape(grid, *_lines(grid, room.columns))
        lines = -(-room.cells // LINE), LINE
        coarse = tuple(n + 2 * grid.apron for n in grid.size)
        kinds = np.int32, np.int32, np.uint8, np.bool_, np.int32, np.bool_, np.int32
        shapes = lines, place, place, place, grid.size, coarse, ()
        return tuple(itertools.starmap(ArraySpec, zip(shapes, kinds, strict=True)))


def _lines(grid: FineGrid, columns: int) -> tuple[int, int]:
    """Lines of runs, and pixels across, of a roughly square layout. A line may cut a run.

    `columns` is the width of all runs together, in pixels, aprons included.
    """
    # At the end of a line up to `gap` columns stay empty, and a run that is cut needs its aprons twice.
    across = max(math.isqrt(columns * grid.pitch), 3 * grid.gap + 1)
    return -(-columns // (across - 2 * grid.gap)), across


def _shape(grid: FineGrid, lines: int, across: int) -> tuple[int, int]:
    """Height and width, in fine cells, of a layout of `lines` lines of runs, `across` pixels wide."""
    pixels = (lines - 1) * grid.pitch + grid.high, across - grid.gap
    return pixels[0] * grid.side + 2 * grid.apron, pixels[1] * grid.side + 2 * grid.apron


def lay_out(
    active: np.ndarray, grid: FineGrid, room: Room | None = None, sizes_of: Callable[[int], int] | None = None
) -> Layout:
    """Lay out in strips the fine cells that active pixels need, as far as there is room.

    Args:
        active: (H, W) bool, the active pixels.
        grid: the sizes.
        room: the room; None for as much as needed.
        sizes_of: function from the needed number of lines of `cells` to the number to allot; without `room`, of
            columns too. None for the numbers of `room`, or without room for as many as needed.

    Returns:
        The layout, NumPy arrays. Active pixels that find no room stay −1 in `pixel`; `dropped` counts them.
    """
    from rts.sampling import strips_loops

    marks = read_only(active).view(np.uint8)
    runs = strips_loops.find(marks, grid.high, grid.gap)
    columns = max(1, int(runs[:, 2].sum()) + grid.gap * len(runs))
    lines, across = _lines(grid, (sizes_of or int)(columns) if room is None else room.columns)
    pieces = strips_loops.split(runs, grid.gap, lines, across)
    if room is None and sizes_of is int:
        lines = int(pieces[:, 3].max(initial=0)) + 1
    sizes = grid.side, grid.apron, grid.high, grid.gap
    pieces, counts = _fitting(marks, pieces, grid, None if room is None else room.cells)
    total = int(counts.sum())
    allotted = -(-max(1, total) // LINE)
    allotted = -(-room.cells // LINE) if sizes_of is None and room is not None else (sizes_of or int)(allotted)
    shape = _shape(grid, lines, across)
    cells, pixel = np.empty(allotted * LINE, np.int32), np.full(grid.size, -1, np.int32)
    cells[total:] = -1
    place, kinds = np.full(shape, -1, np.int32), np.zeros(shape, np.uint8)
    arguments = marks, pieces, _firsts(pieces, grid), *sizes, np.cumsum(counts) - counts, cells, place, kinds
    parallel(strips_loops.fill, len(counts), *arguments, work=4 * place.size)
    strips_loops.number(marks, pieces, grid.high, grid.pitch, across - grid.gap, pixel)
    left = np.count_nonzero(active) - np.count_nonzero(pixel >= 0)
    coarse = np.ones([n + 2 * grid.apron for n in grid.size], bool)
    inner = tuple(slice(grid.apron, grid.apron + n) for n in grid.size)
    np.less(pixel, 0, out=coarse[inner])
    wanted = (kinds & strips_loops.WANTED).view(np.bool_)
    return Layout(cells.reshape(-1, LINE), place, kinds, wanted, pixel, coarse, np.asarray(left, np.int32))


def _fitting(marks: np.ndarray, pieces: np.ndarray, grid: FineGrid, most: int | None) -> tuple[np.ndarray, np.ndarray]:
    """The first pieces that need at most `most` cells together, and how many of these each line of the grid has (H',).

    Args:
        marks: (H, W) uint8, the active pixels.
        pieces: (P, 5), see `strips_loops`.
        grid: the sizes.
        most: the bound; None for all pieces.
    """
    from rts.sampling import strips_loops

    def counted(n: int) -> np.ndarray:
        counts = np.zeros(grid.fine[0], np.int64)
        arguments = marks, pieces[:n], _firsts(pieces[:n], grid), grid.side, grid.apron, grid.high
        parallel(strips_loops.count, len(counts), *arguments, grid.fine[1], counts, work=500 * len(counts))
        return counts

    counts = counted(len(pieces))
    if most is None or counts.sum() <= most:
        return pieces, counts
    low, high = 0, len(pieces)
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (middle, high) if counted(middle).sum() <= most else (low, middle)
    return pieces[:low], counted(low)


def _firsts(pieces: np.ndarray, grid: FineGrid) -> np.ndarray:
    """(S + 1,) the index of the first piece of each strip, then the number of pieces."""
    return np.searchsorted(pieces[:, 0], np.arange(grid.strips + 1))


@dataclass(frozen=True)
class HiddenInStrips:
    """The rule of a splatter for the samples of listed cells: its rule for images, applied to their layout.

    Attributes:
        rule: the rule for images.
        layout: the layout, on the host.
    """

    rule: HiddenRule
    layout: Layout

    @property
    def settles(self) -> bool:
        """See `Hidden`."""
        return self.rule.settles

    @property
    def size(self) -> float:
        """See `Hidden`."""
        return self.rule.size

    def decide(self, question: Question) -> Decision:
        """See `Hidden`; cells of the question and the decision are those of the list, (K, L, LINE)."""
        from rts.sampling import strips_loops

        covered, depth, size = question
        layers, (place, wanted) = len(covered), (self.layout.place, self.layout.wanted)
        lists = [read_only(x).reshape(layers, -1) for x in (covered, depth)]
        laid, deep = np.empty((layers, *place.shape), bool), np.empty((layers, *place.shape), depth.dtype)
        parallel(strips_loops.gather, layers * len(place), *lists, place, laid, deep, work=2 * laid.size)
        kept, settled, asked = self.rule.decide(Question(laid, deep, size), wanted)
        needed = covered
        if asked is not laid:
            needed = np.concatenate([covered[:1], self._listed(asked[1:], covered[1:], self.layout.kinds)])
        if settled is None:
            return Decision(needed, None, needed)
        # Only beside a wanted place does the layout show the cells that lie beside it in the grid.
        amid = self._listed(((settled >= 0) & wanted)[None], covered[:1])[0]
        return Decision(self._listed(kept, needed), numbers_of(amid), needed)

    def _listed(self, marks: np.ndarray, among: np.ndarray, kinds: np.ndarray | None = None) -> np.ndarray:
        """Cells (K, L, LINE) bool of the list: true where `among` is, and `marks` (K, h, w) of the layout mark it.

        With `kinds`, marks that are not near wanted cells are first cleared, in `marks` itself.
        """
        from rts.sampling import strips_loops

        marked, place = np.zeros((len(among), math.prod(among.shape[1:])), bool), self.layout.place
        arguments = marks, np.empty((0, 0), np.uint8) if kinds is None else kinds, place, marked
        parallel(strips_loops.scatter, len(marks) * len(place), *arguments, work=marks.size)
        marked = marked.reshape(among.shape)
        marked &= among
        return marked


def arranged(sampled: Sampled, layout: Layout, grid: FineGrid) -> Fine:
    """Samples of listed cells, put into the layout wherever it shows these cells; the result is not `flat`.

    Exits that find no room behind the samples are left out.

    Args:
        sampled: the samples; `row` is (K, L, LINE), as `layout.cells`.
        layout: the layout, in arrays of any engine.
        grid: the sizes.
    """
    sizes = [s.ids.shape[-2] for s in sampled.samples]
    engine, layers = engine_of(sampled), sampled.row.shape[0]
    laid = layers, *layout.place.shape
    splats = layers * laid[1] * laid[2]
    specs = [
        ArraySpec((splats,), np.int32, packed=True),
        ArraySpec((splats, 3), np.float32, packed=True),
        ArraySpec(laid, np.int32),
        ArraySpec(laid, np.int32),
    ]
    facing = [] if sampled.facing is None else [sampled.facing]
    specs += [ArraySpec(laid, np.int16) for _ in facing]
    amid = [] if sampled.settled is None else [sampled.settled]
    specs += [ArraySpec(laid[1:], np.int8) for _ in amid]
    leaves = [] if sampled.exit is None else [sampled.exit]
    specs += [ArraySpec((x.shape[0], *laid[1:]), np.int32) for x in leaves]

    def host(row: np.ndarray, place: np.ndarray, cells: np.ndarray, *optional: np.ndarray) -> tuple[np.ndarray, ...]:
        sides = [
            np.where(place >= 0, x.reshape(layers, -1)[:, place], 0).astype(np.int16) for x in optional[: len(facing)]
        ]
        settled = optional[len(facing) : len(facing) + len(amid)]
        index, shift, *placed, settled = _arranged(row, place, cells, sizes, grid.fine[1], *settled)
        exits = ()
        if leaves:
            index, shift, *exits = _with_exits(index, shift, placed[0][0], place, optional[-1], splats)
        return index, shift, *placed, *sides, *([settled] if amid else []), *exits

    arguments = sampled.row, layout.place, layout.cells, *facing, *amid, *leaves
    index, shift, row, part, *optional = engine.call_host(host, tuple(specs), *arguments)
    return Fine(
        sampled.samples,
        index,
        shift,
        Cells(
            row,
            facing=optional[0] if facing else None,
            settled=optional[len(facing)] if amid else None,
            exit=optional[-1] if leaves else None,
        ),
        part,
        layout.wanted,
        layout.pixel,
        layout.coarse,
        sampled.overflow + layout.dropped,
        supersample=grid.side,
        apron=grid.apron,
    )


def _arranged(
    row: np.ndarray,
    place: np.ndarray,
    cells: np.ndarray,
    sizes: Sequence[int],
    width: int,
    settled: np.ndarray | None = None,
) -> tuple[np.ndarray, ...]:
    """Index (M,), shift (M, 3), laid and part (K, h, w), and shown (h, w), as `strips_loops.arrange` fills them.

    M is at least 1: without samples, the only splat is sample 0, which no place shows.

    Args:
        row: (K, L, LINE), the sample of each listed cell, counted over all parts; −1 for none.
        place: see `Layout`.
        cells: see `Layout`.
        sizes: the number of rows of each part.
        width: cells in a line of the grid, apron included.
        settled: (L, LINE), 0 or −1, see `Cells.settled`; None for none, and `shown` has no rows.
    """
    from rts.sampling import strips_loops

    row, place, cells = (read_only(x, np.int32) for x in (row, place, cells))
    amid = read_only(np.empty(0, np.int8) if settled is None else settled.reshape(-1))
    row, cells, lines = row.reshape(len(row), -1), cells.reshape(-1), len(row) * len(place)
    counts = np.empty(lines, np.int64)
    parallel(strips_loops.count_samples, lines, row, place, counts, work=len(row) * place.size)
    offsets, total = np.cumsum(counts) - counts, int(counts.sum())
    make = np.empty if total else np.zeros
    index, shift = make(max(1, total), np.int32), make((max(1, total), 3), np.float32)
    laid, part = (np.empty((len(row), *place.shape), np.int32) for _ in range(2))
    shown = np.empty(place.shape if len(amid) else (0, 0), np.int8)
    arguments = row, place, cells, amid, np.cumsum(sizes)[:-1], width, offsets, index, shift, laid, part, shown
    parallel(strips_loops.arrange, lines, *arguments, work=2 * laid.size)
    return index, shift, laid, part, shown


def _with_exits(
    index: np.ndarray, shift: np.ndarray, fronts: np.ndarray, place: np.ndarray, exits: np.ndarray, most: int
) -> tuple[np.ndarray, ...]:
    """Index and shift of splats, those of exits appended, at most `most` in all; and `Cells.exit` (E, h, w) of splats.

    Args:
        index: (M,), see `Fine`.
        shift: (M, 3), see `Fine`.
        fronts: (h, w), the splat of the front in each place of the layout, or −1.
        place: see `Layout`.
        exits: (E, L, LINE), samples of the listed cells; all E of a cell, or none.
        most: the room.
    """
    count, laid = len(exits), np.full((len(exits), *place.shape), -1, np.int32)
    listed = exits.reshape(count, -1)
    there = np.nonzero((fronts >= 0) & (place >= 0) & (listed[-1, place] >= 0))
    there = tuple(x[: max(0, most - len(index)) // count] for x in there)
    first, own = len(index), listed[:, place[there]].T.reshape(-1)
    index = np.concatenate([index, own.astype(index.dtype)])
    shift = np.concatenate([shift, np.repeat(shift[fronts[there]], count, axis=0)])
    laid[:, *there] = np.arange(first, len(index), dtype=np.int32).reshape(-1, count).T
    return index, shift, laid


def at_cells(whole: Samples, cells: Array, capacity: int | None) -> Samples:
    """The samples of listed cells, selected from those of all cells, for samplers that do not follow lists.

    Their cells are (K, L, LINE), without exits and settled cells.

    Args:
        whole: samples of the whole grid.
        cells: (L, LINE) int32, flat indices in the grid, or −1.
        capacity: rows to allot; samples beyond are dropped, and counted in `overflow`. None for as many as there are.
    """
    layers, count = whole.row.shape[0], whole.ids.shape[0]
    rows = count if capacity is None else capacity
    grid = layers, *cells.shape
    whole_facing = [] if whole.facing is None else [whole.facing]

    def host(
        row: np.ndarray, depth: np.ndarray, cells: np.ndarray, *whole_facing: np.ndarray
    ) -> tuple[np.ndarray, ...]:
        listed = cells >= 0
        at = np.where(listed, cells, 0)
        row, depth = (x.reshape(layers, -1)[:, at] for x in (row, depth))
        covered = (row >= 0) & listed
        index = row[covered]
        number = np.full(grid, -1, np.int32)
        number[covered] = np.where(np.arange(len(index)) < rows, np.arange(len(index)), -1)
        kept = np.zeros(max(1, len(index)) if capacity is None else rows, np.int32)
        kept[: len(index)] = index[: len(kept)]
        sides = (np.where(number >= 0, x.reshape(layers, -1)[:, at], 0).astype(np.int16) for x in whole_facing)
        dropped = np.asarray(max(0, len(index) - rows), np.int32)
        return kept, number, np.where(number >= 0, depth, 0), dropped, *sides

    kind = np.float64 if namespace(whole.depth).finfo(whole.depth.dtype).bits == 64 else np.float32
    specs = (
        ArraySpec((rows,), np.int32, packed=capacity is None),
        ArraySpec(grid, np.int32),
        ArraySpec(grid, kind),
        ArraySpec((), np.int32),
        *(ArraySpec(grid, np.int16) for _ in whole_facing),
    )
    arguments = whole.row, whole.depth, cells, *whole_facing
    index, row, depth, overflow, *facing = engine_of(whole).call_host(host, specs, *arguments)
    xp, gbuffer = namespace(index), whole.gbuffer
    tables = whole.tables.items()
    return replace(
        whole,
        ids=xp.take(whole.ids, index, axis=0),
        params=xp.take(whole.params, index, axis=0),
        cells=Cells(row, depth, facing[0] if facing else None),
        overflow=whole.overflow + overflow,
        tables={k: xp.take(v, index, axis=0) if k in whole.by_sample else v for k, v in tables},
        gbuffer=None if gbuffer is None else {k: xp.take(v, index, axis=0) for k, v in gbuffer.items()},
    )


def of_engine(layout: Layout, engine: Engine, like: Array) -> Layout:
    """The layout in arrays of an engine, on the device of `like`."""
    return Layout(*(constants(x, engine, like) for x in layout))
