"""The stencil of a sampled scene, and the samples beside outlines: where values are traced, by one call to the host."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import islice
from typing import Any, NamedTuple

import numpy as np

from rts.arrays.engines import Context, engine_of, host_value, is_traced, namespace, stopped
from rts.arrays.trees import Array, Tree, collected, leaves, map_leaves
from rts.compiling.threads import OnAllCores
from rts.contracts.checked_parts import CheckedPart
from rts.contracts.records import ArraySpec, Sampled, Samples, Stencil
from rts.contracts.sampler import Sampler
from rts.contracts.surface import TriangleSurface
from rts.outlines.found import Outlines, fits, specs
from rts.outlines.points import Points, at_centres, has_pairs
from rts.outlines.required import Required
from rts.sampling.entries import inputs_of, is_batched, proxy_inputs
from rts.sampling.host_scenes import real_of
from rts.sampling.picture import renumbered
from rts.sampling.scene import Grid, Scene, lies_on_triangles
from rts.sampling.tables import in_one_table, taken_rows
from rts.sampling.triangle_sampler import TriangleSampler


def with_outlines(
    sampled: Sampled,
    scene: Scene,
    grid: Grid,
    required: Required,
    capacity: int | None = None,
) -> Sampled:
    """Samples at cells' centres with `Sampled.stencil` and the samples beside crossings.

    Where light passes through, the outlines are those of all layers that it reaches; else those of the first layer.

    Args:
        sampled: the samples at centres.
        scene: the scene.
        grid: the cells.
        required: what samples beside crossings have to tell.
        capacity: `Request.capacity`. Where values are traced, there is room for `most_crossings`, or for fewer if a
            shared table has no room for their samples. `overflow` counts those beyond.

    Warns:
        InputWarning: a sampler cannot sample single points.
    """
    inputs, real = None, real_of(scene)
    if all(scene.opaque) and sampled.row.shape[0] > 1:  # Else the cells stay those of a single part, and cross once.
        sampled = replace(sampled, cells=sampled.cells.first(1))
    if scene.context.engine.differentiates:
        # Functions of surfaces want the arrays that they are given.
        known = [
            (scene.local_camera(index, grid), read, proxy_inputs(scene.parts[index]) if entry is None else None)
            for index, (read, entry) in enumerate(zip(scene.read, scene.entries, strict=True))
        ]
        inputs = stopped((known, grid.camera, sampled.cells))
    traced = any(map(is_traced, leaves(inputs)))
    if traced or any(map(is_batched, leaves(inputs))):
        room = most_crossings(grid, capacity) if traced else None
        return _found_on_host(sampled, scene, grid, room, capacity, required, inputs)
    points, cells = Points.of(scene, grid, inputs_of(scene), required), map_leaves(host_value, sampled.cells)
    found, parts, more = points.outlines(at_centres(cells, sampled.samples))
    samples, places = _joined(sampled.samples, more, _used(found.rows, parts, len(more)))
    row = cells.row if len(samples) == 1 else places.of_centres()[cells.row]
    stencil = _over_parts(found, parts, places.beside).stencil(row, required, real)
    if len(samples) > 1:
        row = engine_of(sampled.row).constant(row, sampled.row)
        sampled = replace(sampled, cells=replace(sampled.cells, row=row))
    # Engines that compile eager operations anew for each shape pad them.
    engine, overflow, cells = engine_of(sampled.row), sampled.overflow + np.int32(found.left_out), sampled.cells
    if engine.differentiates:
        arrays, layers = collected(stencil), 1 if stencil.stacks is None else stencil.stacks.shape[1]
        stencil = Stencil(*engine.call_host(lambda _: arrays, specs(0, grid.size, real, layers), sampled.row))
    cells = replace(cells, triangle=None)
    return replace(sampled, samples=samples, cells=cells, stencil=stencil, overflow=overflow)


class _Places(NamedTuple):
    """Where the samples of each part lie among those of all.

    Attributes:
        counts: (P,) the numbers of samples at centres.
        centres: (P,) int32, the index of each part's first sample at a centre.
        beside: (P,) int32, that of its first sample beside a crossing.
    """

    counts: np.ndarray
    centres: np.ndarray
    beside: np.ndarray

    def of_centres(self) -> np.ndarray:
        """The index of each sample at a centre, counted over all of these; then −1."""
        shifts = self.centres - np.cumsum(self.counts) + self.counts
        at = np.arange(self.counts.sum()) + np.repeat(shifts, self.counts)
        return np.append(at, -1).astype(np.int32)


def _over_parts(found: Outlines, parts: np.ndarray, starts: np.ndarray) -> Outlines:
    """Outlines with rows counted over all parts, those of each of which begin at `starts` (P,)."""
    return found._replace(rows=np.where(found.rows >= 0, found.rows + starts[parts], np.int32(-1)))


def _used(rows: np.ndarray, parts: np.ndarray, count: int) -> np.ndarray:
    """The number (P,) int32 of rows up to the last one that is named, of each of `count` parts."""
    ends = np.zeros(count + 1, np.int32)  # The last one is that of no part.
    np.maximum.at(ends, parts.reshape(-1), rows.reshape(-1) + np.int32(1))
    return ends[:count]


def _joined(centres: Sequence[Samples], beside: Sequence[Samples], used: Any) -> tuple[tuple[Samples, ...], _Places]:
    """The samples of each part, those at centres and then those beside crossings, of which so many are `used`."""
    samples, counts, firsts, first = [], [], [], 0
    for of_cells, extra, last in zip(centres, beside, used, strict=True):
        whole = in_one_table([of_cells, extra])
        if engine_of(whole.ids).padded(whole.ids):
            whole = _without_gaps(whole, of_cells, last)
        samples.append(whole)
        counts.append(of_cells.ids.shape[-2])
        firsts.append(first)
        first += whole.ids.shape[-2]
    counts, firsts = np.array(counts), np.array(firsts, np.int32)
    return tuple(samples), _Places(counts, firsts, firsts + counts.astype(np.int32))


def most_crossings(grid: Grid, capacity: int | None) -> int:
    """The number of crossings for which programs of fixed shapes have room, given `Request.capacity`."""
    return max(8 * sum(grid.size), (capacity or 0) // 4)


def _without_gaps(whole: Samples, of_cells: Samples, beside: Any) -> Samples:
    """Samples, those `of_cells` of cells and then further ones, in which unused rows repeat one in use.

    `beside` is the number of the further ones in use.
    """
    xp, count, constant = namespace(whole.ids), of_cells.ids.shape[-2], engine_of(whole.ids).constant
    rows = constant(np.arange(whole.ids.shape[-2], dtype=np.int32), whole.ids)
    used = xp.max(xp.concat([xp.reshape(of_cells.row, (-1,)), 0 * rows[:1] - 1])) + 1
    there = (rows < used) | ((rows >= count) & (rows < count + beside))
    return taken_rows(whole, xp.where(there, rows, xp.where(used > 0, 0, count)))


def _found_on_host(
    sampled: Sampled,
    scene: Scene,
    grid: Grid,
    most: int | None,
    capacity: int | None,
    required: Required,
    inputs: Tree,
) -> Sampled:
    """See `with_outlines`; by a call to the host, with room for `most` crossings, and with the `inputs` from there."""
    owners, layers, real = [_tables(samples) for samples in sampled.samples], sampled.row.shape[0], real_of(scene)
    room = [
        _Room.of(part, sampler, samples, layers, required, most, capacity)
        for part, sampler, samples in zip(scene.parts, scene.samplers, sampled.samples, strict=True)
    ]
    # The host does not know how many samples beside crossings there will be: there is room for the most between parts.
    counts = np.array([samples.ids.shape[-2] for samples in sampled.samples])
    total, parts = counts.sum(), len(counts)
    each = (2**31 - 1 - total) // parts if most is None else max(own.rows for own in room)
    beside = (total + each * np.arange(parts)).astype(np.int32)

    def host(*arrays: np.ndarray) -> list[np.ndarray]:
        values = iter(arrays)
        of_parts, camera, cells = map_leaves(lambda x: x if type(x) is np.ndarray else next(values), inputs)
        pairs = zip(scene.parts, of_parts, strict=True)
        here = scene._replace(
            parts=[replace(part, theta=theta, transform=None) for part, (_, theta, _) in pairs],
            cameras=[seen for seen, *_ in of_parts],
            context=Context(engine_of(), None),
        )
        points = Points.of(here, Grid(camera, grid.size), [x for *_, x in of_parts], required)
        centres, count = at_centres(cells, sampled.samples), most
        while True:
            found, of_rows, more = points.outlines(centres, count)
            stencil = _over_parts(found, of_rows, beside).stencil(cells.row, required, real)
            if not count or (fits(stencil, most) and all(own.holds(x) for own, x in zip(room, more, strict=True))):
                break
            count = min(count, len(found.place)) // 2
        results = [*collected(stencil), _used(found.rows, of_rows, parts), found.left_out]
        for part, samples, tables in zip(here.parts, more, owners, strict=True):
            known_of, kinds = _tables(samples), {kind for kind, _ in tables}
            gbuffer = (
                part.surface.evaluate(part.theta, replace(samples, gbuffer_names=None)) if "gbuffer" in kinds else {}
            )
            results += [gbuffer[name] if kind == "gbuffer" else known_of[kind, name] for kind, name in tables]
        return [np.asarray(x, spec.dtype) for x, spec in zip(results, of_results, strict=True)]

    operands = [x for x in leaves(inputs) if type(x) is not np.ndarray]
    of_results = specs(most or 0, grid.size, real, layers)
    fields = len(of_results)
    of_results += [ArraySpec((parts,), np.int32), ArraySpec((), np.int32)]
    for tables, own in zip(owners, room, strict=True):
        for (kind, name), x in tables.items():
            dtype = np.dtype(str(x.dtype).rpartition(".")[2])  # torch's own have its name before.
            count = own.tables.get(name, own.rows) if kind == "tables" else own.rows
            of_results.append(ArraySpec((count, *x.shape[1:]), dtype, packed=True))
    at_once = all(map(_samples_at_once, scene.parts, scene.samplers))
    call = OnAllCores(host) if at_once else host
    results = iter(engine_of(sampled.row, *operands).call_host(call, of_results, *operands))
    stencil, used, left_out = Stencil(*islice(results, fields)), next(results), next(results)
    more = [_with_tables(of, {name: next(results) for name in _tables(of)}) for of in sampled.samples]
    samples, places = _joined(sampled.samples, more, [used[part] for part in range(parts)])
    cells = replace(sampled.cells, triangle=None)
    if parts > 1:
        before = np.concatenate([np.cumsum(counts) - counts, beside])
        shifts = np.concatenate([places.centres, places.beside]) - before
        starts, shifts = before[None].astype(np.int32), shifts[None].astype(np.int32)
        stencil = stencil.with_samples(lambda rows: renumbered(rows, starts, shifts))
        cells = replace(cells, row=renumbered(cells.row, starts, shifts))
    return replace(sampled, samples=samples, cells=cells, stencil=stencil, overflow=sampled.overflow + left_out)


def _samples_at_once(part: CheckedPart, sampler: Sampler) -> bool:
    """True if several threads may sample points of a part at once."""
    return lies_on_triangles(part, sampler) and isinstance(sampler, TriangleSampler) and sampler.draws_at_once


class _Room(NamedTuple):
    """The capacity for samples of a part beside crossings, in a compiled program.

    Attributes:
        rows: the largest number of these samples.
        tables: the capacities, by name, of tables whose rows several samples share; see `Samples.tables`.
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
        required: Required,
        most: int | None,
        capacity: int | None,
    ) -> _Room:
        """Room for the samples of at most so many crossings, in addition to `samples` of the part at centres."""
        # Where there is a pair, one of the last samples is there again.
        of_pairs, surface = 3 if layers == 1 and required.motions and has_pairs(part, sampler) else 0, part.surface
        each = required.samples(layers) + of_pairs
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
