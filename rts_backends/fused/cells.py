"""The splatters of `rts.splatting` and their first derivatives as compiled loops on all cores, NumPy in and out.

Every target collects from its nine sources, and in the reverse direction every source from its nine targets, each in
one fixed order: results do not depend on the number of threads. Most targets are plain (`stencil.py`). The layers that
the others, the mixed ones (`mixed_targets.py`), take from each source are chosen once and kept in `Cells`.
"""

from __future__ import annotations

import math
from functools import cached_property, lru_cache
from typing import NamedTuple

import numpy as np

from rts import InputError
from rts.plugin_api.splats import Visible
from rts.plugin_api.threads import parallel, read_only
from rts_backends.fused import crossing_pairs, crossings, mixed_targets, outlines, stencil, straight_stacks
from rts_backends.fused import layer_pairing as listing
from rts_backends.fused import stacks as layered
from rts_backends.fused.crossings import Crossings
from rts_backends.fused.outlines import Outlines
from rts_backends.fused.pairs import BLOCK
from rts_backends.fused.rows import Grid
from rts_backends.fused.stacks import Stacks
from rts_backends.fused.uniform_cells import EMPTY, collect, note, paint, survey

MANY = 256
"""The most samples shown by settled targets for which gradients are summed line by line; more are added one by one."""


class Settings(NamedTuple):
    """One of the splatters, as numbers.

    Attributes:
        kind: "single", "multi" or "visible".
        sigma: standard deviation, pixels.
        epsilon: excess of the weights' sum over one.
        gamma: the calibration, a factor of samples' offsets from their cells' centres.
        border: rows and columns at each side of the cells that are no part of the image.
        one_part: whether all samples belong to one part.
        rims: `visible` only: whether coverage moves as outlines do.
        crossings: `visible` only: whether lines of crossing move as depths say.
        opaque: whether alpha is sure to be 1; otherwise `visible` lets light through its layers.
    """

    kind: str
    sigma: float
    epsilon: float
    gamma: float
    border: int = 0
    one_part: bool = False
    rims: bool = False
    crossings: bool = False
    opaque: bool = True


class Choices(NamedTuple):
    """Mixed targets, whose sources are not all paired front to front, and the layers that they take.

    With translucent layers, all wanted targets that splats reach count as mixed, but for `Stacks.straight`.

    Attributes:
        mixed: (H, W) uint8, 1 at such targets.
        offsets: (H + 1,) int64, where the targets of each row begin in the lists below.
        columns: (M,) int32, their columns.
        ranges: (M, 9, 3, 2), first and last + 1 of the layers that each source gives to each buffer; source 3 (v + 1) +
            (u + 1) lies at −(u, v), and the buffers are in front, at the surface, behind.
        sums: (M, 3, 5), of each buffer the colours over the weight, taken as at least one, and the weight.
        states: (H, W) uint8, states of targets (`uniform_cells.py`); mixed ones are EMPTY here.
        ends: (H, W) uint16, the directions in which fronts end, and the mark LISTED of targets that are mixed, or that
            outlines may cover in part (`uniform_cells.py`); no rows without `rims`.
        listed: (H,) int64, the number of LISTED targets in each row.
        repeated: whether several cells name a sample, and would add to its gradient at the same time.
        extent: largest less least depth of the fronts, the camera's 0 included.
        stacks: where layers are translucent, the plans of these targets, and the targets that need no plan, which are
            not listed above.
    """

    mixed: np.ndarray
    offsets: np.ndarray
    columns: np.ndarray
    ranges: np.ndarray
    sums: np.ndarray
    states: np.ndarray
    ends: np.ndarray
    listed: np.ndarray
    repeated: bool
    extent: float
    stacks: Stacks | None = None


class Cells:
    """Samples in their cells, to be splatted, pulled back and pushed forward.

    Args:
        settings: the splatter, as numbers.
        positions: (N, 3) float32 or float64, pixel position and linear depth.
        rgba: (N, 4), of the same dtype, premultiplied colours.
        row: (K, H, W) signed integers, the sample of each cell, or −1; kind "single" reads layer 0 alone.
        choices: choices made earlier for the same samples; None to make them on first use.
        part: (K, H, W) integers, the part of each sample; None, or no layers, if unknown, or if all belong to one.
        facing: (K, H, W) integers, `Cells.facing` of the records: which piece of surface a sample is on, and by its
            sign, which side it shows; None, or no layers, if unknown.
        wanted: (H, W) bool, the targets to fill, others may be anything; None, or no rows, for all.
        settled: (H, W) integers, the sample whose colour a target shows, whatever moves, or −1; None, or no rows, for
            no such targets.
        exits: (E, H, W) integers, `Cells.exit` of the records; None, or no entries, if unknown.

    Raises:
        InputError: positions and rgba do not fit; or, unless `choices` are given, other shapes do not fit, `settled`
            holds no signed integers, or `row`, `settled` or `exits` refer to a sample that is not there.
    """

    def __init__(
        self,
        settings: Settings,
        positions: np.ndarray,
        rgba: np.ndarray,
        row: np.ndarray,
        choices: Choices | None = None,
        part: np.ndarray | None = None,
        facing: np.ndarray | None = None,
        wanted: np.ndarray | None = None,
        settled: np.ndarray | None = None,
        exits: np.ndarray | None = None,
    ):
        if positions.shape[1:] != (3,) or rgba.shape != (len(positions), 4):
            given = f"{positions.shape} and {rgba.shape}"
            raise InputError(f"positions and rgba have shapes {given}; expected (N, 3) and (N, 4)")
        shape, row = row.shape, row[:1] if settings.kind == "single" else row
        if choices is None:
            _check_grids(shape, part=part, facing=facing)
            _check_grids(shape[1:], wanted=wanted, exit=exits[0] if exits is not None and len(exits) else None)
            Visible.check(row, len(positions), settled if settled is not None and len(settled) else None, exits)
        self.positions, self.rgba, self.row = read_only(positions), read_only(rgba), read_only(row, np.int32)
        self.part = read_only(self.row[:0] if part is None else part, np.int32)
        self.exits = read_only(self.row[:0] if exits is None else exits, np.int32)
        self.facing = read_only(self.row[:0] if facing is None else facing, np.int16)
        self._settled = np.empty((0, row.shape[2]), np.int8) if settled is None else np.asarray(settled)
        self._wanted = None if wanted is None or not len(wanted) else np.asarray(wanted, np.uint8)
        if self._wanted is not None and len(self._settled):
            # Beside settled targets unwanted ones may lack their samples, so that fronts seem to end there.
            self._wanted = self._wanted & (self._settled < 0)
        self.visible, self.border, self.one_part = settings.kind == "visible", settings.border, settings.one_part
        self.rims = self.visible and settings.rims
        self.translucent = self.visible and not settings.opaque
        self.crosses = self.visible and settings.crossings
        self._numbers = tuple(map(positions.dtype.type, _scale_and_peak(settings) + (settings.gamma,)))
        self._reach = positions.dtype.type(_reach(settings))
        if choices is not None:
            self.choices = choices

    @property
    def settled(self) -> np.ndarray:
        """(H, W) int32, the sample whose colour a target shows, whatever moves, or −1; no rows for none."""
        return read_only(self._settled, np.int32)

    @cached_property
    def _shows_several(self) -> bool:
        """True if some settled target shows the colour of another sample than sample 0."""
        return self._settled.max(initial=-1) > 0

    def _paint(self, colors: np.ndarray, images: np.ndarray) -> None:
        """Give settled targets of `images` (T, H, W, 4) the colours (T, N, 4) of samples; zeros where N is 0."""
        parallel(paint, images.shape[1], self.settled, self.border, read_only(colors), images, work=images.size // 8)

    @property
    def grid(self) -> Grid:
        """The samples as loops take them."""
        return Grid(self.positions, self.rgba, self.row, *self._numbers)

    @property
    def plain_grid(self) -> Grid:
        """The samples for the stencil's loops; in `visible` front layers alone, since plain targets take no others."""
        return self.grid._replace(row=self.row[:1]) if self.visible else self.grid

    @property
    def _plain_work(self) -> int:
        """About how many nanoseconds the stencil takes at least."""
        return 4 * self.row.shape[1] * self.row.shape[2]

    @property
    def _layers_work(self) -> int:
        """About how many nanoseconds stencils of all layers take at least."""
        return len(self.row) * self._plain_work

    @property
    def _mixed_work(self) -> int:
        """About how many nanoseconds the mixed targets take: nine sources of several numbers each."""
        return 160 * len(self.choices.columns)

    @property
    def mixed_arguments(self) -> tuple:
        """The grid, and `offsets`, `columns` and `ranges` of `Choices`: arguments of the loops of mixed targets."""
        choices = self.choices
        return self.grid, choices.offsets, choices.columns, choices.ranges

    @property
    def _mixed_sums(self) -> tuple:
        return self.choices.offsets, self.choices.columns, self.choices.sums

    @cached_property
    def choices(self) -> Choices:
        """The states of all targets, and the layers that mixed ones take: computed on first use, unless given."""
        layers, height, width = self.row.shape
        count, kind = len(self.positions), self.positions.dtype
        # EMPTY for targets that are not settled, SETTLED for those that are.
        amid = self._settled >= 0
        states = amid.view(np.uint8).copy() if len(amid) else np.zeros((height, width), np.uint8)
        hidden, seen = np.zeros((height, -(-width // BLOCK)), np.uint8), np.zeros(count, np.bool_)
        counts = np.zeros(height, np.int64)
        depths = np.zeros((height, 2, 2), kind)
        fronts = self.visible or layers == 1
        marks, marked = np.zeros((height, width), np.uint8), np.zeros(height, np.int64)
        ends, listed = np.empty((height if self.rims else 0, width), np.uint16), np.zeros(height, np.int64)
        noted = states, hidden, depths, seen, counts, marks if self.visible and layers > 1 else marks[:0], marked
        given = self.positions, self.rgba, self.row, self.exits, fronts, self._reach
        parallel(survey, height, *given, *noted, ends, listed, work=3 * self.row.size)
        repeated = int(np.count_nonzero(seen)) != int(counts.sum())
        if self._wanted is not None:
            states *= self._wanted | amid if len(amid) else self._wanted
        least, largest = depths[..., 0].min(axis=0, initial=0), depths[..., 1].max(axis=0, initial=0)
        extent = (largest - least)[0]
        # See `rts.splatting.layers`: nothing is nearer to what is beyond everything than to a front.
        beyond = 2 * (largest.max() - least.min()) or kind.type(1)
        if layers > 1 and not self.visible:
            given = self.positions, self.row, beyond, hidden, states
            parallel(listing.find, height, *given, marks, marked, work=self.row.size)
        # How an outline moves is decided by pairs up to two cells away.
        if layers > 1 and self._wanted is not None:
            before, marks = marks, np.empty_like(marks)
            parallel(listing.narrow, height, before, self._wanted, marks, marked, work=self.row[0].size)
        straight = np.zeros((0, width), np.uint8)
        if self.translucent:
            # Any target that some layer reaches; `narrow` comes before, since outlines look farther.
            marks = layered.reached(self.row[0] >= 0)
            marks = marks & self._wanted if self._wanted is not None else marks
            marks = marks & ~amid if len(amid) else marks
            # Beside lines of crossing plans tell the derivative in colours from that in positions.
            bits, _ = self._pairs_within(extent)
            crossed = layered.reached(bits > 0) if len(bits) else bits
            straight, given = np.empty_like(marks), (self.positions, self.row, ends, crossed, marks)
            parallel(straight_stacks.find, height, *given, straight, marked, work=20 * self.row.size)
            states[straight > 0] = EMPTY
        if len(amid) and not self.visible:
            marks &= ~amid
            marked = marks.sum(axis=1, dtype=np.int64)
        offsets = np.concatenate([[0], np.cumsum(marked)])
        columns = np.empty(offsets[-1], np.int32)
        ranges = np.empty((offsets[-1], 9, 3, 2), np.uint8 if layers < 256 else np.int32)
        sums = np.empty((offsets[-1], 3, 5), kind)
        if len(columns):
            # An argument, since compiled code that is cached would keep its value.
            continued = kind.type(Visible.CONTINUED)
            given = self.facing, self.visible, continued, beyond, marks, offsets, columns, ranges, sums, states, ends
            parallel(listing.choose, height, self.grid, *given, work=500 * len(columns))
        stacks = None
        if self.translucent:
            stacks = Stacks.of(len(columns), layers, kind, straight)
            given = self.facing, beyond, offsets, columns, ranges, stacks
            parallel(layered.fill, height, self.grid, *given, work=400 * layers * len(columns))
        return Choices(marks, offsets, columns, ranges, sums, states, ends, listed, repeated, extent, stacks)

    @cached_property
    def outlines(self) -> Outlines:
        """Motions of outlines, and the colours that they change; without rims no targets are listed."""
        _, height, width = self.row.shape
        choices, kind = self.choices, self.positions.dtype
        ends, counts = choices.ends, choices.listed
        if self.rims and self._wanted is not None:
            ends, counts = np.empty_like(ends), np.empty_like(counts)
            given = choices.ends, self._wanted, ends, counts
            parallel(outlines.narrow, height, *given, work=self.row[0].size)
        offsets = np.concatenate([[0], np.cumsum(counts)])
        result = Outlines(
            np.empty((height, width), kind),
            np.empty((height, width), np.int32),
            self.exits[1:],
            offsets,
            np.empty(offsets[-1], np.int32),
            np.empty((offsets[-1], 9), np.uint8),
            np.empty((offsets[-1], 9, 2), kind),
            np.empty((offsets[-1], 2, 4), kind),
        )
        if len(result.columns):
            rules = outlines.Rules(*map(kind.type, Visible.RIMS))
            decide = self.part, self.one_part, self.exits, kind.type(choices.extent), rules, self._pairs[0]
            listed = choices.columns, choices.offsets, choices.ranges, choices.sums
            given = self.grid, *decide, *listed, ends
            parallel(outlines.fill, height, *given, result, work=90 * len(result.columns))
            if choices.stacks is not None:
                own = result.offsets, result.columns, choices.offsets, choices.columns, choices.stacks
                parallel(layered.recolor, height, *own, result.changes, work=20 * len(result.columns))
            if self._crossed:
                self.crossings.still(result.offsets, result.columns, result.changes)
        return result

    @cached_property
    def _pairs(self) -> tuple[np.ndarray, np.ndarray]:
        """Bits (H, W) of pairs beside lines of crossing, and marks (H,) of rows with some (see `crossing_pairs.py`).

        Both have no rows if there are no pairs.
        """
        return self._pairs_within(self.choices.extent)

    def _pairs_within(self, extent: float) -> tuple[np.ndarray, np.ndarray]:
        """`_pairs`, for an `extent` as in `Choices`."""
        if not self.crosses:
            return crossing_pairs.nothing(self.row.shape[2])
        return crossing_pairs.pairs(self.positions, self.row, self.positions.dtype.type(extent))

    @cached_property
    def crossings(self) -> Crossings:
        """Targets beside lines where surfaces cross, and the terms of their derivatives.

        A column of −1 marks a target whose derivative turned out not to be that of a line. Empty unless the splatter is
        "visible" with the setting `crossings`.
        """
        bits, some = self._pairs
        if not len(bits):
            return crossings.nothing(self.row.shape[1], self.positions.dtype)
        extent = self.positions.dtype.type(self.choices.extent)
        return crossings.listed(self._seen_grid, self.choices, extent, bits, some)

    @cached_property
    def _seen_grid(self) -> Grid:
        """`grid`; with translucent layers, its fronts have the colour that is seen along their rays."""
        if not self.translucent:
            return self.grid
        seen = np.zeros((*self.row.shape[1:], 4), self.rgba.dtype)
        for cells in self.row[::-1]:
            here = cells >= 0
            own = self.rgba[cells[here]]
            seen[here] = own + (1 - own[:, 3:]) * seen[here]
        colors, fronts = self.rgba.copy(), self.row[0] >= 0
        colors[self.row[0][fronts]] = seen[fronts]
        return self.grid._replace(rgba=read_only(colors))

    @property
    def _crossed(self) -> bool:
        """True if `crossings` may have targets."""
        return len(self.crossings.columns) > 0

    def image(self, out: np.ndarray) -> None:
        """Fill `out` (H, W, 4) with the image, premultiplied; H and W are those of the cells less both borders."""
        if out.size:
            given = self.plain_grid, self.choices.states, self.border
            parallel(stencil.forward, len(out), *given, out, work=self._plain_work)
            if self.choices.stacks is not None:
                stacks = self.choices.stacks
                given = self.choices.offsets, self.choices.columns, stacks.images, self.border
                parallel(layered.forward, len(out), *given, out, work=self._mixed_work // 10)
                given = self.grid, stacks.straight, self.border
                parallel(straight_stacks.forward, len(out), *given, out, work=self._layers_work)
            elif len(self.choices.columns):
                parallel(
                    mixed_targets.forward, len(out), *self._mixed_sums, self.border, out, work=self._mixed_work // 10
                )
            if self._shows_several:  # Targets without a sample of their own show sample 0 so far.
                self._paint(self.rgba[None], out[None])

    def vjp(self, g: np.ndarray, g_positions: np.ndarray | None, g_rgba: np.ndarray | None) -> None:
        """Fill the gradients of positions (N, 3) and rgba (N, 4) from the image's gradient `g` (H, W, 4).

        Both hold zeros before; None if not wanted.
        """
        if not self.row.size:
            return
        self._pull(g, g_positions, g_rgba)
        if len(self._settled) and g_rgba is not None:
            settled, noted, number = self.settled, np.zeros(len(g_rgba), bool), np.zeros(len(g_rgba), np.int32)
            noted[0] = True
            if self._shows_several:
                parallel(note, len(settled), settled, noted, work=settled.size // 8)
            shown = np.flatnonzero(noted)
            if len(shown) > MANY:  # Sums by line take memory for each of them; usually a part shows one.
                inner = settled[self.border : self.border + len(g), self.border : self.border + g.shape[1]]
                there = inner >= 0
                np.add.at(g_rgba, inner[there], g[there])
                return
            number[shown] = np.arange(len(shown))
            sums = np.zeros((len(g), len(shown), 4), g.dtype)
            parallel(collect, len(g), settled, number, self.border, read_only(g), sums, work=g.size // 4)
            g_rgba[shown] += sums.sum(axis=0)

    def _pull(self, g: np.ndarray, g_positions: np.ndarray | None, g_rgba: np.ndarray | None) -> None:
        """`vjp` of the targets that are not settled; gradients hold zeros before, and plain targets overwrite them."""
        height = self.row.shape[1]
        if self.choices.repeated:
            self._vjp_of_repeated(g, g_positions, g_rgba)
            return
        kind = self.positions.dtype
        gradients = (
            np.empty((0, 3), kind) if g_positions is None else g_positions,
            np.empty((0, 4), kind) if g_rgba is None else g_rgba,
        )
        g, states = read_only(g), self.choices.states
        if self._crossed:
            states = states.copy()
            states[self.crossings.cells()] = EMPTY
        plain = self.plain_grid, states, self.border
        parallel(stencil.pull, height, *plain, g, *gradients, work=self._plain_work)
        self._pull_mixed(g, *gradients)
        if self._crossed:
            crossings.pull(self._seen_grid.rgba, self.row, self.crossings, self.border, g, *gradients)
        if self.rims and g_positions is not None:
            outlines.pull(self.row, self.outlines, self.border, g, g_positions)

    def _pull_mixed(self, g: np.ndarray, g_positions: np.ndarray, g_rgba: np.ndarray) -> None:
        """Add mixed targets' shares to the gradients from the image's gradient `g`; a gradient of no rows gets none."""
        count, height = len(self.choices.columns), self.row.shape[1]
        if self.choices.stacks is not None:
            self._pull_stacks(self.choices.stacks, g, g_positions, g_rgba)
            return
        if not (count and (len(g_positions) or len(g_rgba))):
            return
        adjoints, work = np.empty((count, 3, 5), g.dtype), self._mixed_work
        parallel(mixed_targets.adjoint, height, *self._mixed_sums, self.border, g, adjoints, work=work // 5)
        given = height, *self.mixed_arguments, adjoints
        if self._crossed:
            # Lines of crossing replace the samples' share in the gradients of positions, but not of colours.
            if len(g_rgba):
                parallel(mixed_targets.pull, *given, g_positions[:0], g_rgba, work=work)
            adjoints[self.crossings.among_mixed()], g_rgba = 0, g_rgba[:0]
        if len(g_positions) or len(g_rgba):
            parallel(mixed_targets.pull, *given, g_positions, g_rgba, work=work)

    def _pull_stacks(self, stacks: Stacks, g: np.ndarray, g_positions: np.ndarray, g_rgba: np.ndarray) -> None:
        """`_pull_mixed` of translucent layers."""
        given = self.grid, stacks.straight, self.border, g, g_positions, g_rgba
        parallel(straight_stacks.pull, self.row.shape[1], *given, work=3 * self._layers_work)
        height, adjoints = self.row.shape[1], np.empty(stacks.sums.shape, g.dtype)
        given, work = (self.choices.offsets, self.choices.columns, stacks), len(self.row) * self._mixed_work
        parallel(layered.adjoint, height, *given, self.border, g, adjoints, work=work // 5)
        if self._crossed:
            # As in `_pull_mixed`.
            parallel(layered.pull, height, self.grid, *given, adjoints, g_positions[:0], g_rgba, work=work)
            adjoints[self.crossings.among_mixed()], g_rgba = 0, g_rgba[:0]
        parallel(layered.pull, height, self.grid, *given, adjoints, g_positions, g_rgba, work=work)

    def jvp(self, t_positions: np.ndarray | None, t_rgba: np.ndarray | None, out: np.ndarray) -> None:
        """Fill `out`, tangents (T, H, W, 4) of the image along those of positions (T, N, 3) and rgba (T, N, 4).

        None stands for tangents of zeros.
        """
        if not out.size:
            return
        tangents = tuple(
            read_only(np.empty((len(out), 0, size), out.dtype) if t is None else t)
            for t, size in ((t_positions, 3), (t_rgba, 4))
        )
        parallel(stencil.push, out.shape[1], self.plain_grid, *tangents, self.choices.states, self.border, out)
        if self.choices.stacks is not None:
            stacks = self.choices.stacks
            given = self.grid, self.choices.offsets, self.choices.columns, stacks, tangents, self.border
            parallel(layered.push, out.shape[1], *given, out, work=len(self.row) * self._mixed_work * len(out))
            given = self.grid, *tangents, stacks.straight, self.border
            parallel(straight_stacks.push, out.shape[1], *given, out, work=3 * self._layers_work * len(out))
        elif len(self.choices.columns):
            given = *self.mixed_arguments, self.choices.sums, tangents, self.border
            parallel(mixed_targets.push, out.shape[1], *given, out, work=self._mixed_work * len(out))
        if self.rims and t_positions is not None:
            given = self.row, self.outlines, tangents[0], self.border
            parallel(outlines.push, out.shape[1], *given, out, work=80 * len(self.outlines.columns) * len(out))
        if self._crossed:
            self._push_lines(tangents, out)
        if len(self._settled):
            self._paint(tangents[1], out)

    def _push_lines(self, tangents: tuple[np.ndarray, ...], out: np.ndarray) -> None:
        """Replace, in `out` (T, H, W, 4), the tangents of targets beside lines of crossing.

        `tangents` are those of positions (T, N, 3) and rgba (T, N, 4), without samples (N = 0) for zeros.
        """
        t_positions, t_rgba = tangents
        tints, choices, height = None, self.choices, out.shape[1]
        if choices.stacks is not None:
            # Those of colours are the stacks'; what is left moves with the lines.
            tints, still = np.zeros_like(out), (t_positions[:, :0], t_rgba)
            given = self.grid, choices.offsets, choices.columns, choices.stacks, still, self.border
            parallel(layered.push, height, *given, tints, work=len(self.row) * self._mixed_work * len(out))
            t_rgba = t_rgba[:, :0]
        given = self._seen_grid, choices.ranges, choices.sums, self.crossings, t_positions, t_rgba, self.border
        parallel(crossings.push, height, *given, out, work=80 * len(self.crossings.columns) * len(out))
        if tints is not None:
            rows, columns = (cells - self.border for cells in self.crossings.cells())
            inside = (rows >= 0) & (rows < height) & (columns >= 0) & (columns < out.shape[2])
            out[:, rows[inside], columns[inside]] += tints[:, rows[inside], columns[inside]]

    def _vjp_of_repeated(self, g: np.ndarray, *results: np.ndarray | None) -> None:
        """`_pull` where cells share samples: with a copy of the sample for each cell, whose gradients are then summed.

        `results` are the gradients of positions (N, 3) and rgba (N, 4), added to in order of cells; None if not wanted.
        """
        covered, leaves = self.row >= 0, self.exits >= 0
        index = np.concatenate([self.row[covered], self.exits[leaves]])
        own, exits = np.full(self.row.shape, -1, np.int32), np.full(self.exits.shape, -1, np.int32)
        number = np.arange(len(index), dtype=np.int32)
        own[covered], exits[leaves] = np.split(number, [np.count_nonzero(covered)])
        copy = object.__new__(Cells)
        copy.__dict__.update(self.__dict__, choices=self.choices._replace(repeated=False))
        copy.row, copy.exits = read_only(own), read_only(exits)
        copy.__dict__.pop("outlines", None)  # They refer to samples by number.
        copy.__dict__.pop("crossings", None)
        copy.__dict__.pop("_seen_grid", None)
        copy.positions, copy.rgba = read_only(self.positions[index]), read_only(self.rgba[index])
        gradients = [None if x is None else np.zeros((len(index), x.shape[1]), x.dtype) for x in results]
        copy._pull(g, *gradients)
        for result, values in zip(results, gradients, strict=True):
            if result is not None and values is not None:
                np.add.at(result, index, values)


def _check_grids(shape: tuple[int, ...], **given: np.ndarray | None) -> None:
    """Raise an InputError for arrays of another shape than the grid's; None, or an empty array, is absent."""
    for name, x in given.items():
        if x is not None and len(x) and x.shape != shape:
            raise InputError(f"{name} has shape {x.shape}; expected {shape}, as row says")


@lru_cache
def _scale_and_peak(settings: Settings) -> tuple[float, float]:
    """The exponent's factor 1 / 2σ², and the weight of a splat on its cell's centre along one axis."""
    scale = 1 / (2 * settings.sigma**2)
    return scale, math.sqrt(1 + settings.epsilon) / sum(math.exp(-(u**2) * scale) for u in (-1, 0, 1))


@lru_cache
def _reach(settings: Settings) -> float:
    """The largest offset of samples, pixels along x and y, at which a target's nine weights are sure to sum up to one.

    −1 if ε is too small for that.
    """
    if settings.epsilon < Visible.LEAST_EPSILON:
        return -1.0
    scale, low, high = 1 / (2 * settings.sigma**2), 0.0, 1.0
    full = 1 + 2 * math.exp(-scale)

    def least(off: float) -> float:
        off = settings.gamma * off  # All nine splats are off in the worst direction.
        side = (math.exp(-(off**2) * scale) + 2 * math.exp(-((1 + off) ** 2) * scale)) / full
        return (1 + settings.epsilon) * side**2

    for _ in range(40):
        middle = (low + high) / 2
        low, high = (middle, high) if least(middle) >= 1 else (low, middle)
    return 0.9 * low  # A margin, since weights are rounded.
