"""Outlines of a sampled scene, and the samples beside them: where values are traced, by one call to the host."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import islice
from typing import Any, NamedTuple

import numpy as np

from rts.arrays.engines import Context, engine_of, is_traced, namespace, stopped, value_of
from rts.arrays.trees import Array, Tree, leaves, map_leaves
from rts.compiling.threads import OnAllCores
from rts.contracts.checked_parts import CheckedPart
from rts.contracts.records import ArraySpec, Cells, Sampled, Samples
from rts.contracts.sampler import Sampler
from rts.contracts.surface import TriangleSurface
from rts.outlines.found import Found, Told, colored_at_centers
from rts.outlines.gaps import Fronts
from rts.outlines.points import Points, at_centres, found_in_views, has_pairs
from rts.sampling.entries import host_value, inputs_of, is_batched, proxy_inputs
from rts.sampling.host_scenes import real_of
from rts.sampling.scene import Grid, Scene, has_sheets
from rts.sampling.tables import in_one_table, taken_rows
from rts.sampling.triangle_sampler import TriangleSampler


def with_outlines(
    sampled: Sampled,
    scene: Scene,
    grid: Grid,
    told: Told,
    capacity: int | None = None,
    most: int | None = None,
) -> Sampled:
    """Samples at cells' centres with `Sampled.outlines` and the samples beside breaks.

    Where light passes through, the outlines are those of all layers that it reaches; else those of the first layer.

    Args:
        sampled: the samples at centres.
        scene: the scene.
        grid: the cells.
        told: what samples beside breaks have to tell.
        capacity: `Request.capacity`. Where values are traced, there is room for `most_breaks`, or for fewer if a shared
            table has no room for their samples. `overflow` counts those beyond.
        most: the most breaks to find where values are known; None for all.

    Warns:
        InputWarning: a sampler cannot sample single points.
    """
    cells, inputs = sampled.cells, None
    if all(scene.opaque):
        sampled = replace(sampled, cells=cells.first(1))
    if scene.context.engine.differentiates:
        # Functions of surfaces want the arrays that they are given.
        known = [
            (scene.local_camera(index, grid), read, proxy_inputs(scene.parts[index]) if entry is None else None)
            for index, (read, entry) in enumerate(zip(scene.read, scene.entries, strict=True))
        ]
        inputs = stopped((known, grid.camera, sampled.cells))
    traced = any(map(is_traced, leaves(inputs)))
    if traced or any(map(is_batched, leaves(inputs))):
        room = most_breaks(grid, capacity) if traced else None
        found, more = _found_on_host(sampled, scene, grid, room, capacity, told, inputs)
    else:
        centres = at_centres(map_leaves(host_value, sampled.cells), sampled.samples)
        (here,), more = found_in_views([Points.of(scene, grid, inputs_of(scene), told)], [centres], most)
        specs = Found.specs(0, grid.size, real_of(scene), len(sampled.row))
        arrays = [np.asarray(x, spec.dtype) for x, spec in zip(here, specs, strict=True)]
        # Engines that compile eager operations anew for each shape pad them.
        found = Found(*engine_of(sampled.row).call_host(lambda _: arrays, specs, sampled.row))
    xp, samples, moved, first = namespace(found.rows), [], [], 0
    for part, (of_cells, extra) in enumerate(zip(sampled.samples, more, strict=True)):
        moved.append(first + of_cells.ids.shape[-2])
        whole = in_one_table([of_cells, extra])
        if engine_of(whole.ids).padded(whole.ids):
            whole = _without_gaps(whole, of_cells, xp.where(found.parts == part, found.rows, -1))
        samples.append(whole)
        first += whole.ids.shape[-2]
    rows = found.rows
    behind: Any = moved[0]
    if len(moved) > 1:
        owners = xp.reshape(xp.clip(found.parts, 0), (-1,))
        behind = xp.take(engine_of(rows).constant(np.asarray(moved, np.int32), rows), owners, axis=0)
        behind = xp.reshape(behind, rows.shape)
    rows = xp.where(rows >= 0, rows + behind, rows)
    overflow, cells = sampled.overflow + found.left, _renumbered(replace(sampled, cells=cells), samples)
    outlines = colored_at_centers(found.outlines(rows), cells.row, told)
    return replace(sampled, samples=tuple(samples), cells=cells, outlines=outlines, overflow=overflow)


def most_breaks(grid: Grid, capacity: int | None) -> int:
    """The number of breaks for which programs of fixed shapes have room, given `Request.capacity`."""
    return max(8 * sum(grid.size), (capacity or 0) // 4)


def _without_gaps(whole: Samples, of_cells: Samples, beside: Array) -> Samples:
    """Samples, those `of_cells` of cells and then further ones, in which unused rows repeat one in use.

    `beside` (B, R) holds the numbers of the further ones in use, or −1.
    """
    xp, count, constant = namespace(whole.ids), of_cells.ids.shape[-2], engine_of(whole.ids).constant
    rows = constant(np.arange(whole.ids.shape[-2], dtype=np.int32), whole.ids)
    used, last = (xp.max(xp.concat([xp.reshape(x, (-1,)), 0 * rows[:1] - 1])) + 1 for x in (of_cells.row, beside))
    there = (rows < used) | ((rows >= count) & (rows < count + last))
    return taken_rows(whole, xp.where(there, rows, xp.where(used > 0, 0, count)))


def _found_on_host(
    sampled: Sampled,
    scene: Scene,
    grid: Grid,
    most: int | None,
    capacity: int | None,
    told: Told,
    inputs: Tree,
) -> tuple[Found, list[Samples]]:
    """`Points.found` by a call to the host, with room for `most` breaks; `inputs` as in `with_outlines`."""
    owners, layers = [_tables(samples) for samples in sampled.samples], sampled.row.shape[0]
    room = [
        _Room.of(part, sampler, samples, layers, told, most, capacity)
        for part, sampler, samples in zip(scene.parts, scene.samplers, sampled.samples, strict=True)
    ]

    def entered(arrays: Sequence[np.ndarray]) -> tuple[Scene, Grid, Fronts, list[Tree]]:
        """Scene, cells, what is seen at their centres, and the inputs of proxies, on the host."""
        values = iter(arrays)
        known = map_leaves(lambda x: x if type(x) is np.ndarray else next(values), inputs)
        of_parts, camera, cells = known
        pairs = zip(scene.parts, of_parts, strict=True)
        parts = [replace(part, theta=theta, transform=None) for part, (_, theta, _) in pairs]
        cameras = [seen for seen, *_ in of_parts]
        here = scene._replace(parts=parts, cameras=cameras, context=Context(engine_of(), None))
        return here, Grid(camera, grid.size), at_centres(cells, sampled.samples), [x for *_, x in of_parts]

    def host(*arrays: np.ndarray) -> list[np.ndarray]:
        here, own_grid, centres, known = entered(arrays)
        points, count = Points.of(here, own_grid, known, told), most
        (found,), more = found_in_views([points], [centres], count)
        while count and not all(own.holds(samples) for own, samples in zip(room, more, strict=True)):
            count //= 2
            (found,), more = found_in_views([points], [centres], count)
        arrays_of = []
        for part, samples, tables in zip(here.parts, more, owners, strict=True):
            known_of, kinds = _tables(samples), {kind for kind, _ in tables}
            gbuffer = (
                part.surface.evaluate(part.theta, replace(samples, gbuffer_names=None)) if "gbuffer" in kinds else {}
            )
            arrays_of += [gbuffer[name] if kind == "gbuffer" else known_of[kind, name] for kind, name in tables]
        return [np.asarray(x, spec.dtype) for x, spec in zip([*found, *arrays_of], specs, strict=True)]

    operands = [x for x in leaves(inputs) if type(x) is not np.ndarray]
    specs = Found.specs(most or 0, grid.size, real_of(scene), layers)
    for tables, own in zip(owners, room, strict=True):
        for (kind, name), x in tables.items():
            dtype = np.dtype(str(x.dtype).rpartition(".")[2])  # torch's own have its name before.
            count = own.tables.get(name, own.rows) if kind == "tables" else own.rows
            specs.append(ArraySpec((count, *x.shape[1:]), dtype, packed=True))
    at_once = all(map(_samples_at_once, scene.parts, scene.samplers))
    call = OnAllCores(host) if at_once else host
    results = iter(engine_of(sampled.row, *operands).call_host(call, specs, *operands))
    found = Found(*islice(results, len(Found._fields)))
    return found, [_with_tables(of, {name: next(results) for name in _tables(of)}) for of in sampled.samples]


def _samples_at_once(part: CheckedPart, sampler: Sampler) -> bool:
    """True if several threads may sample points of a part at once."""
    return has_sheets(part, sampler) and isinstance(sampler, TriangleSampler) and sampler.draws_at_once


class _Room(NamedTuple):
    """The room for samples of a part beside breaks.

    Attributes:
        rows: the largest number of these samples.
        tables: the numbers of rows, by name, of tables that they share.
    """

    rows: int
    tables: Mapping[str, int]

    @classmethod
    def of(
        cls,
        part: CheckedPart,
        sampler: Sampler,
        samples: Samples,
        layers: int,
        told: Told,
        most: int | None,
        capacity: int | None,
    ) -> _Room:
        """Room for the samples of at most so many breaks, in addition to `samples` of the part at centres."""
        # Where there is a pair, one of the last samples is there again.
        of_pairs, surface = 3 if layers == 1 and told.motions and has_pairs(part, sampler) else 0, part.surface
        each = told.samples(layers) + of_pairs
        rows, names = each * (most or 0), set(samples.tables) - set(samples.by_sample)
        if not names or not isinstance(surface, TriangleSurface):
            return cls(rows, {})
        specs = surface.table_specs(rows, None if capacity is None else rows)
        return cls(rows, {name: specs[name].shape[0] for name in names})

    def holds(self, samples: Samples) -> bool:
        """True if tables have no more rows than there is room for."""
        return all(samples.tables[name].shape[0] <= count for name, count in self.tables.items())


def _tables(samples: Samples) -> dict[tuple[str, str], Array]:
    """The arrays of samples that have a row for each, by kind and name."""
    return {
        ("", "ids"): samples.ids,
        ("", "params"): samples.params,
        **{("tables", name): x for name, x in samples.tables.items()},
        **{("gbuffer", name): x for name, x in (samples.gbuffer or {}).items()},
    }


def _with_tables(samples: Samples, arrays: dict[tuple[str, str], Array]) -> Samples:
    """Samples with other arrays of `_tables`."""
    of = {kind: {name: x for (k, name), x in arrays.items() if k == kind} for kind in ("", "tables", "gbuffer")}
    gbuffer = None if samples.gbuffer is None else of["gbuffer"]
    return replace(samples, **of[""], tables=of["tables"], gbuffer=gbuffer)


def _renumbered(sampled: Sampled, samples: Sequence[Samples]) -> Cells:
    """The cells of a scene whose parts have got further rows behind their own."""
    if sampled.one_part:
        return replace(sampled.cells, triangle=None)
    row, counts = sampled.row, [before.ids.shape[-2] for before in sampled.samples]
    more = [of.ids.shape[-2] - count for of, count in zip(samples, counts, strict=True)]
    shift, engine = np.repeat(np.cumsum([0, *more[:-1]]), counts).astype(np.int32), engine_of(row)
    known = value_of(row)
    if known is not None and not is_batched(row):
        place = np.append(np.arange(len(shift), dtype=np.int32) + shift, np.int32(-1))
        return replace(sampled.cells, row=engine.constant(place[known], row), triangle=None)
    xp, shift = namespace(row), engine.constant(shift, row)
    moved = row + xp.reshape(xp.take(shift, xp.reshape(xp.clip(row, 0), (-1,)), axis=0), row.shape)
    return replace(sampled.cells, row=xp.where(row >= 0, moved, row), triangle=None)
