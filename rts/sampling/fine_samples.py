"""Fine samples of active pixels. Coarse samples tell which pixels are active."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Literal, NamedTuple

import numpy as np

from rts.arrays.engines import Engine, engine_of
from rts.arrays.trees import Array
from rts.contracts.checks import check_memory
from rts.contracts.records import Fine, Sampled
from rts.sampling.adaptive import Adaptive, contrasts, missed, visible_outlines
from rts.sampling.hidden import HiddenRule, planned, with_layers_that_count
from rts.sampling.strips import FineGrid, HiddenInStrips, Layout, Room, arranged, lay_out, of_engine, rounded

FEW = 1 / 6
"""A share of all pixels at outlines that few images exceed: compiled programs have a branch with room for these."""


class Where(NamedTuple):
    """The rule by which pixels are active.

    Attributes:
        adaptive: the user's settings.
        dilates: True if the neighbours of active pixels are active, too.
        opaque: for each part, whether its shader promises to be opaque.
        colors: (N, 4) of the coarse samples, to measure contrast; None to ignore it.
    """

    adaptive: Adaptive
    dilates: bool
    opaque: Sequence[bool]
    colors: np.ndarray | None = None


def active(
    row: np.ndarray,
    depth: np.ndarray,
    settled: np.ndarray | None = None,
    between: np.ndarray | None = None,
    *,
    sizes: Sequence[int],
    apron: int,
    where: Where,
) -> np.ndarray:
    """Active pixels (H, W) bool of the image, from coarse samples (K, ·, ·) with an apron.

    Args:
        row: see `visible_outlines`.
        depth: see `visible_outlines`.
        settled: see `visible_outlines`.
        between: see `missed`; None to ignore what lies between centres.
        sizes: the number of rows of each part.
        apron: cells around the image.
        where: the rule.
    """
    pixels = visible_outlines(row, depth, sizes, settled, where.opaque)
    if between is not None:
        pixels |= missed(row[0], depth[0], between, settled)
    if where.colors is not None and where.adaptive.contrast is not None:
        pixels |= contrasts(row[0], where.colors, where.adaptive.contrast)
    pixels = dilated(pixels) if where.dilates else pixels
    return np.ascontiguousarray(pixels[apron:-apron, apron:-apron])


class Known(NamedTuple):
    """Fields of coarse samples that tell which pixels are active, by name, and what else tells.

    Attributes:
        arrays: `row`, `depth`, and those of `settled` and `between` that are there, in arrays of any engine.
        sizes: the number of rows of each part.
        apron: cells around the image.
        where: the rule.
    """

    arrays: Mapping[str, Array]
    sizes: Sequence[int]
    apron: int
    where: Where

    @classmethod
    def of(cls, coarse: Sampled, where: Where) -> Known:
        """The fields of one sample a pixel."""
        names = ("row", "depth", "settled", "between")
        arrays = {name: x for name in names if (x := getattr(coarse, name)) is not None}
        return cls(arrays, [s.ids.shape[-2] for s in coarse.samples], coarse.apron, where)

    def find(self, *values: np.ndarray) -> np.ndarray:
        """Active pixels (H, W) bool, from the values of `arrays`, on the host."""
        given = dict(zip(self.arrays, values, strict=True))
        return active(**given, sizes=self.sizes, apron=self.apron, where=self.where)

    def values(self, engine: Engine) -> list[np.ndarray] | None:
        """The values of `arrays`; None if some are traced."""
        found = [engine.known(x) for x in self.arrays.values()]
        values = [x for x in found if x is not None]
        # Under `vmap` of torch values are those of all items.
        return values if len(values) == len(found) and values[0].ndim == 3 else None

    def laid_out(self, engine: Engine, grid: FineGrid, room: Room) -> Layout:
        """The layout of traced samples, as far as there is room."""

        def host(*values: np.ndarray) -> tuple[np.ndarray, ...]:
            return tuple(lay_out(self.find(*values), grid, room))

        return Layout(*engine.call_host(host, Layout.specs(grid, room), *self.arrays.values()))


def few_laid_out(coarse: Sampled, grid: FineGrid, where: Where) -> Layout | None:
    """The layout of traced samples in a share `FEW` of the room; None if a program cannot choose, or need not."""
    known, engine = Known.of(coarse, where), engine_of(coarse)
    if not engine.branches or known.values(engine) is not None:
        return None
    return known.laid_out(engine, grid, grid.room(None, 1).share(FEW))


def fine_samples(
    coarse: Sampled,
    grid: FineGrid,
    where: Where,
    take: Callable[..., Sampled],
    hidden: HiddenRule | None,
    layers: int | Literal["auto"],
    capacity: int | None,
    flat: bool,
    layout: Layout | None = None,
) -> Fine:
    """Fine samples of active pixels and their apron, in strips.

    Args:
        coarse: one sample a pixel.
        grid: the sizes of the image and of its fine cells.
        where: the rule by which pixels are active.
        take: samples the fine grid: `take(layers, hidden, listed=cells, capacity=rows)` → `Sampled`.
        hidden: the rule for hidden samples of an image; None to keep all.
        layers: K, or "auto".
        capacity: rows to allot; None for as many as there are, or could be if coarse samples are traced.
        flat: True if inactive pixels show one colour alone. The result is then marked `Fine.flat`, unless pixels lack
            room, no coarse cell is settled, or coarse samples are traced.
        layout: the layout of traced samples, see `few_laid_out`; None to lay them out.
    """
    told, engine, most = Known.of(coarse, where), engine_of(coarse), planned(layers)
    values = told.values(engine)
    if values is None:
        if layout is None:
            room = grid.room(capacity, most)
            check_memory(1, room.cells, most, capacity, gradient=engine.differentiates)
            layout = told.laid_out(engine, grid, room)
        # Where no capacity is given, results tell how many of their rows are in use.
        known, allotted, flat = None, None if capacity is None else most * grid.room(capacity, most).cells, False
    else:
        pixels, few = told.find(*values), engine.padded(coarse.row)
        room = None if capacity is None else grid.room(capacity, most)
        if room is None:  # Aprons come on top; but to lay out what is far too large would take for ever.
            check_memory(1, int(pixels.sum()) * grid.side**2, most, None, gradient=engine.differentiates)
        host = lay_out(pixels, grid, room, rounded if few else int)
        check_memory(1, host.cells.size, most, capacity, gradient=engine.differentiates)
        layout, allotted = of_engine(host, engine, coarse.depth), None
        known = None if hidden is None else HiddenInStrips(hidden, host)
        flat = flat and coarse.settled is not None and not host.dropped
        flat = flat and bool((values[list(told.arrays).index("settled")] >= 0).any())
    taken = partial(take, listed=layout.cells, capacity=allotted)
    sampled = taken(layers, known) if layers != "auto" else with_layers_that_count(taken, known, where.opaque)
    return replace(arranged(sampled, layout, grid), flat=flat)


def dilated(cells: np.ndarray) -> np.ndarray:
    """The marks (H, W), bool or uint8, spread to the eight cells around each."""
    wide = np.pad(cells, ((1, 1), (0, 0)))
    wide = np.pad(wide[:-2] | wide[1:-1] | wide[2:], ((0, 0), (1, 1)))
    return wide[:, :-2] | wide[:, 1:-1] | wide[:, 2:]
