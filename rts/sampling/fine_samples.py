"""Fine samples of active pixels. Coarse samples tell which pixels are active."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Literal, NamedTuple

import numpy as np

from rts.arrays.engines import engine_of
from rts.contracts.checks import check_memory
from rts.contracts.records import Fine, Sampled
from rts.sampling.adaptive import Adaptive, contrasts, missed, visible_outlines
from rts.sampling.hidden import HiddenRule, planned, with_layers_that_count
from rts.sampling.strips import FineGrid, HiddenInStrips, Layout, arranged, lay_out, of_engine, rounded
from rts.splatting.layers import dilated


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


def fine_samples(
    coarse: Sampled,
    grid: FineGrid,
    where: Where,
    take: Callable[..., Sampled],
    hidden: HiddenRule | None,
    layers: int | Literal["auto"],
    capacity: int | None,
    flat: bool,
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
    """
    sizes, engine = [s.ids.shape[-2] for s in coarse.samples], engine_of(coarse)
    most, names = planned(layers), ("row", "depth", "settled", "between")
    given = {name: x for name in names if (x := getattr(coarse, name)) is not None}

    def find(known: Mapping[str, np.ndarray]) -> np.ndarray:
        optional = known.get("settled"), known.get("between")
        return active(known["row"], known["depth"], *optional, sizes=sizes, apron=coarse.apron, where=where)

    values = {name: array for name, x in given.items() if (array := engine.known(x)) is not None}
    if len(values) < len(given) or values["row"].ndim != 3:
        room = grid.room(capacity, most)
        check_memory(1, room.cells, most, capacity, gradient=engine.differentiates)

        def laid_out(*values: np.ndarray) -> tuple[np.ndarray, ...]:
            return tuple(lay_out(find(dict(zip(given, values, strict=True))), grid, room))

        layout = Layout(*engine.call_host(laid_out, Layout.specs(grid, room), *given.values()))
        known, allotted, flat = None, most * room.cells, False
    else:
        pixels, few = find(values), engine.padded(coarse.row)
        room = None if capacity is None else grid.room(capacity, most)
        if room is None:  # Aprons come on top; but to lay out what is far too large would take for ever.
            check_memory(1, int(pixels.sum()) * grid.side**2, most, None, gradient=engine.differentiates)
        host = lay_out(pixels, grid, room, rounded if few else int)
        check_memory(1, host.cells.size, most, capacity, gradient=engine.differentiates)
        layout, allotted = of_engine(host, engine, coarse.depth), None
        known = None if hidden is None else HiddenInStrips(hidden, host)
        flat = flat and bool((values["settled"] >= 0).any()) and not host.dropped
    taken = partial(take, listed=layout.cells, capacity=allotted)
    sampled = taken(layers, known) if layers != "auto" else with_layers_that_count(taken, known, where.opaque)
    return replace(arranged(sampled, layout, grid), flat=flat)
