"""Outlines of a sampled scene: its fronts at any point, the breaks between them, and the samples beside breaks."""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from dataclasses import fields, replace
from typing import Any, NamedTuple

import numpy as np

from rts.arrays.engines import engine_of, exemplar, floating_bits, is_traced, namespace, stopped, value_of
from rts.arrays.trees import Array, Tree, leaves, map_leaves
from rts.compiling.threads import each
from rts.contracts.checks import CheckedPart
from rts.contracts.records import ArraySpec, Cells, Fragments, Outlines, Request, Sampled, Samples
from rts.contracts.surface import TriangleSurface
from rts.errors import InputWarning, warn
from rts.plugin_base import overrides
from rts.registry import name_of
from rts.rendering.sampled_views import in_one_table
from rts.rendering.scene import Grid, Scene, has_sheets
from rts.sampling.gaps import Breaks, Fronts, Oracle, find_breaks
from rts.sampling.points import pixel_widths
from rts.sampling.sample_checks import check_samples
from rts.sampling.segments import joined
from rts.sampling.sheets import Sheets
from rts.sampling.spans import breaks_of_triangles
from rts.sampling.stacks_of_spans import breaks_of_stacks
from rts.sampling.triangle_sampler import TriangleSampler
from rts.scene.camera import Camera


def with_outlines(sampled: Sampled, scene: Scene, grid: Grid, capacity: int | None = None) -> Sampled:
    """Samples at cells' centres with `Sampled.outlines` and the samples beside breaks.

    Where light passes through, the outlines are those of all layers that it reaches; else those of the first layer.

    Args:
        sampled: the samples at centres.
        scene: the scene.
        grid: the cells.
        capacity: `Request.capacity`. Where values are traced, there is room for a quarter as many breaks, or for 8 a
            row and a column of the grid, if that is more, or for fewer if a shared table has no room for their samples.
            `overflow` counts those beyond.

    Warns:
        InputWarning: a sampler cannot sample single points.
    """
    cells, known = sampled.cells, []
    if all(scene.opaque):
        sampled = replace(sampled, cells=cells.first(1))
    for part, read, entry in zip(scene.parts, scene.read, scene.entries, strict=True):
        # Functions of surfaces want the arrays that they are given.
        known.append((part.transform, read, _proxy_inputs(part) if entry is None else None))
    inputs = stopped((known, scene.camera, grid.camera, sampled.cells))
    traced = any(map(is_traced, leaves(inputs)))
    if traced or all(map(has_sheets, scene.parts, scene.samplers)) or any(map(_batched, leaves(inputs))):
        most = max(8 * sum(grid.size), (capacity or 0) // 4) if traced else None
        found, more = _found_on_host(sampled, scene, grid, most, capacity, inputs)
    else:
        entered = [map_leaves(host_value, x) for *_, x in inputs[0]]
        centres = at_centres(map_leaves(host_value, inputs[3]), sampled.samples)
        (here,), more = found_in_views([Points.of(scene, grid, entered)], [centres])
        specs = Found.specs(0, grid.size, real_of(scene), len(sampled.row))
        arrays = [np.asarray(x, spec.dtype) for x, spec in zip(here, specs, strict=True)]
        # Engines that compile eager operations anew for each shape pad them.
        found = Found(*engine_of(sampled.row).call_host(lambda _: arrays, specs, sampled.row))
    xp, samples, first, rows = namespace(found.rows), [], 0, found.rows
    for part, (own, extra) in enumerate(zip(sampled.samples, more, strict=True)):
        count = own.ids.shape[-2]
        rows = xp.where((found.parts == part) & (found.rows >= 0), found.rows + (first + count), rows)
        whole = in_one_table([own, extra])
        if engine_of(whole.ids).padded(whole.ids):
            whole = _without_gaps(whole, own, xp.where(found.parts == part, found.rows, -1))
        samples.append(whole)
        first += whole.ids.shape[-2]
    outlines = found.outlines(rows)
    overflow, cells = sampled.overflow + found.left, _renumbered(replace(sampled, cells=cells), samples)
    return replace(sampled, samples=tuple(samples), cells=cells, outlines=outlines, overflow=overflow)


def _without_gaps(whole: Samples, own: Samples, beside: Array) -> Samples:
    """Samples, those `own` of cells and then further ones, in which unused rows repeat one in use.

    `beside` (B, R) holds the numbers of the further ones in use, or −1.
    """
    xp, count, constant = namespace(whole.ids), own.ids.shape[-2], engine_of(whole.ids).constant
    rows = constant(np.arange(whole.ids.shape[-2], dtype=np.int32), whole.ids)
    used, last = (xp.max(xp.concat([xp.reshape(x, (-1,)), 0 * rows[:1] - 1])) + 1 for x in (own.row, beside))
    there = (rows < used) | ((rows >= count) & (rows < count + last))
    return taken_rows(whole, xp.where(there, rows, xp.where(used > 0, 0, count)))


def taken_rows(samples: Samples, index: Array) -> Samples:
    """The rows of samples with some indices (N,)."""
    xp = namespace(samples.ids)

    def taken(named: Mapping[str, Array]) -> dict[str, Array]:
        return {name: xp.take(x, index, axis=0) for name, x in named.items()}

    own = taken({"ids": samples.ids, "params": samples.params})
    gbuffer = None if samples.gbuffer is None else taken(samples.gbuffer)
    tables = {**samples.tables, **taken({name: samples.tables[name] for name in samples.by_sample})}
    return replace(samples, **own, tables=tables, gbuffer=gbuffer)


def with_entries(scene: Scene, grid: Grid) -> Scene:
    """The scene with prepared entries of parts whose triangles are not cheap, so that outlines make none anew.

    The scene itself where values are traced, or several at once.
    """
    if not any(map(_is_dear, scene.parts)):
        return scene
    inputs = stopped((scene.read, [part.transform for part in scene.parts], grid.camera))
    if any(is_traced(x) or _batched(x) for x in leaves(inputs)):
        return scene
    entries = []
    for part, sampler, entry in zip(scene.parts, scene.samplers, scene.entries, strict=True):
        if entry is None and isinstance(sampler, TriangleSampler) and _is_dear(part):
            camera = _on_host(grid.camera.within(part.transform).for_size(grid.size))
            entry = _entry(part, sampler, map_leaves(host_value, _proxy_inputs(part)), camera, grid.size)
        entries.append(entry)
    return scene._replace(entries=entries)


class Found(NamedTuple):
    """Outlines as they are found; see `Outlines`. Rows of zeros have no effect.

    Attributes:
        rows: (B, 6) int32, for each break the two last samples, the two that tell colours, and the pair, counted in
            their part. Of K layers (B, 2 + K + 1): the two last samples, and those of the stack there.
        parts: of the shape of `rows`, int32, their parts, or −1.
        sides: (B, 2, K) int32, the stacks before and behind, as indices in that stack, or −1; (B, 2, 0) for one layer.
        places: (B, K + 1) the places of the samples of the stack along the gap; (B, 0) for one layer.
        left: () int32, number of breaks left out for want of room.
    """

    rows: Array
    parts: Array
    sides: Array
    places: Array
    place: Array
    gap: Array
    points: Array
    near: Array
    slope: Array
    ends: Array
    square: Array
    ties: Array
    side: Array
    beyond: Array
    corner: Array
    pull: Array
    joined: Array
    left: Array

    @staticmethod
    def specs(most: int, size: tuple[int, int], real: Any, layers: int) -> list[ArraySpec]:
        """Specs of outlines with at most so many breaks, each of which ends at most two segments."""
        integers, ends, (columns, entries, of_sides) = np.int32, 2 * most, _columns(layers)
        breaks = [ArraySpec((most, columns), integers, packed=True)] * 2
        breaks += [ArraySpec((most, 2, of_sides), integers, packed=True), ArraySpec((most, entries), real, packed=True)]
        breaks += [ArraySpec((most,), real, packed=True), ArraySpec((most, 3), integers, packed=True)]
        breaks += [ArraySpec((most, 2), real, packed=True), ArraySpec((most,), integers, packed=True)]
        breaks += [ArraySpec((most, 2, 2), real, packed=True), ArraySpec((most, 2), np.bool_, packed=True)]
        segments = [ArraySpec((ends, 2), integers, packed=True)] * 4
        segments += [ArraySpec((ends, 2), real, packed=True), ArraySpec((ends, 4), real, packed=True)]
        return [*breaks, *segments, ArraySpec((2, *size), np.bool_), ArraySpec((), integers)]

    def outlines(self, rows: Array) -> Outlines:
        """The outlines, with `rows` counted over all parts."""
        last = rows[:, :2]
        named = {"rows": last, "inner": rows[:, 2:4], "pair": rows[:, 4:]}
        if self.sides.shape[-1]:
            named = {"rows": last, "inner": last, "pair": 0 * last - 1, **self._stacks(rows[:, 2:])}
        return Outlines(**{f.name: named.get(f.name, getattr(self, f.name, None)) for f in fields(Outlines)})

    def _stacks(self, rows: Array) -> dict[str, Array]:
        """`Outlines.stack` and `Outlines.stack_points`; `rows` (B, K + 1) are the samples of each stack."""
        xp, shape, there = namespace(rows), self.sides.shape, self.sides >= 0
        first = engine_of(rows).constant(np.arange(shape[0], dtype=np.int32) * rows.shape[1], rows)[:, None, None]
        at = xp.reshape(xp.where(there, first + self.sides, 0), (-1,))
        stack, places = (xp.reshape(xp.take(xp.reshape(x, (-1,)), at), shape) for x in (rows, self.places))
        return {"stack": xp.where(there, stack, -1), "stack_points": xp.where(there, places, 0.0)}


def _found_on_host(
    sampled: Sampled, scene: Scene, grid: Grid, most: int | None, capacity: int | None, inputs: Tree
) -> tuple[Found, list[Samples]]:
    """`Points.found` by a call to the host, with room for `most` breaks; `inputs` as in `with_outlines`."""
    owners, layers = [_tables(own) for own in sampled.samples], sampled.row.shape[0]
    # Where a break has a pair, its last sample is there once more.
    rows = (_columns(layers)[0] + 1) * (most or 0)
    room = [_rooms(*own, rows, capacity) for own in zip(scene.parts, sampled.samples, strict=True)]

    def host(*arrays: np.ndarray) -> list[np.ndarray]:
        given = iter(arrays)
        known = map_leaves(lambda x: x if type(x) is np.ndarray else next(given), inputs)
        of_parts, whole, camera, cells = known
        own_parts = zip(scene.parts, of_parts, strict=True)
        parts = [replace(part, transform=moved, theta=theta) for part, (moved, theta, _) in own_parts]
        entered = [x for *_, x in of_parts]
        points = Points.of(scene._replace(parts=parts, camera=whole), Grid(camera, grid.size), entered)
        centres, count = at_centres(cells, sampled.samples), most
        (found,), more = found_in_views([points], [centres], count)
        while count and not all(map(_has_room, more, room)):
            count //= 2
            (found,), more = found_in_views([points], [centres], count)
        arrays_of = []
        for part, samples, tables in zip(parts, more, owners, strict=True):
            known_of, kinds = _tables(samples), {kind for kind, _ in tables}
            gbuffer = part.surface.evaluate(part.theta, replace(samples, asked=None)) if "gbuffer" in kinds else {}
            arrays_of += [gbuffer[name] if kind == "gbuffer" else known_of[kind, name] for kind, name in tables]
        return [np.asarray(x, spec.dtype) for x, spec in zip([*found, *arrays_of], specs, strict=True)]

    operands = [x for x in leaves(inputs) if type(x) is not np.ndarray]
    specs = Found.specs(most or 0, grid.size, real_of(scene), layers)
    for own, rooms in zip(owners, room, strict=True):
        for (kind, name), x in own.items():
            dtype = np.dtype(str(x.dtype).rpartition(".")[2])  # torch's own have its name before.
            count = rooms.get(name, rows) if kind == "tables" else rows
            specs.append(ArraySpec((count, *x.shape[1:]), dtype, packed=True))
    results = iter(engine_of(sampled.row, *operands).call_host(host, specs, *operands))
    found = Found(*(next(results) for _ in Found._fields))
    return found, [_with_tables(own, {name: next(results) for name in _tables(own)}) for own in sampled.samples]


def _columns(layers: int) -> tuple[int, int, int]:
    """The numbers of samples of a break, of those of its stack, and of layers on each side; see `Found`."""
    return (6, 0, 0) if layers == 1 else (layers + 3, layers + 1, layers)


def real_of(scene: Scene) -> Any:
    """The dtype of a scene's floating arrays."""
    like = scene.context.like
    return np.float32 if like is not None and floating_bits(like) == 32 else np.float64


def _rooms(part: CheckedPart, samples: Samples, rows: int, capacity: int | None) -> dict[str, int]:
    """The numbers of rows, by name, of tables that so many further samples of a part share."""
    surface, names = part.surface, set(samples.tables) - set(samples.by_sample)
    if not names or not isinstance(surface, TriangleSurface):
        return {}
    specs = surface.table_specs(rows, None if capacity is None else rows)
    return {name: specs[name].shape[0] for name in names}


def _has_room(samples: Samples, room: Mapping[str, int]) -> bool:
    """True if tables have no more rows than there is room for."""
    return all(samples.tables[name].shape[0] <= count for name, count in room.items())


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
    of = {kind: {name: x for (own, name), x in arrays.items() if own == kind} for kind in ("", "tables", "gbuffer")}
    gbuffer = None if samples.gbuffer is None else of["gbuffer"]
    return replace(samples, **of[""], tables=of["tables"], gbuffer=gbuffer)


def _renumbered(sampled: Sampled, samples: Sequence[Samples]) -> Cells:
    """The cells of a scene whose parts have got further rows behind their own."""
    if sampled.one_part:
        return replace(sampled.cells, triangle=None)
    row, counts = sampled.row, [own.ids.shape[-2] for own in sampled.samples]
    more = [of.ids.shape[-2] - count for of, count in zip(samples, counts, strict=True)]
    shift = engine_of(row).constant(np.repeat(np.cumsum([0, *more[:-1]]), counts).astype(np.int32), row)
    xp = namespace(row)
    moved = row + xp.reshape(xp.take(shift, xp.reshape(xp.clip(row, 0), (-1,)), axis=0), row.shape)
    return replace(sampled.cells, row=xp.where(row >= 0, moved, row), triangle=None)


def at_centres(cells: Cells, samples: Sequence[Samples]) -> Fronts:
    """Surfaces seen at centres (K, H, W), from the cells of a scene on the host; `samples` are those of its parts."""
    part = np.minimum(cells.row, np.int32(0))
    for first in np.cumsum([own.ids.shape[-2] for own in samples])[:-1]:
        part += cells.row >= first
    triangle = np.full(part.shape, -1, np.int32) if cells.triangle is None else cells.triangle
    assert cells.depth is not None
    return Fronts(part, triangle, cells.depth.astype(np.float64))


def _refines(part: CheckedPart) -> bool:
    """True if samples on a part's triangles pass through its surface."""
    return isinstance(part.surface, TriangleSurface) and part.surface.refines


def _is_dear(part: CheckedPart) -> bool:
    """True if making a part's triangles costs more than to compare their inputs."""
    return isinstance(part.surface, TriangleSurface) and not part.surface.proxy_is_cheap


def _batched(x: Array) -> bool:
    """True for an array of which a transform maps over several values."""
    value = value_of(x)
    return value is not None and value.ndim != x.ndim


def host_value(x: Array) -> np.ndarray:
    """The value of an array, which is not traced."""
    value = value_of(x)
    assert value is not None
    return value


def _on_host(camera: Camera) -> Camera:
    """A camera that is not traced, with matrices on the host."""
    return camera.map(lambda m: np.asarray(host_value(m), np.float64))


class _Broken(NamedTuple):
    """Breaks, and the samples that they need. Host arrays.

    Attributes:
        breaks: the breaks.
        parts: (B, R), the parts of samples, or −1.
        points: (B, R, 2), where they are.
        triangles: (B, R), on which they are; −1 where none is known.
        numbers: (B, R), how many layers of the same part are in front; 0 where triangles are known.
        sides: see `Found.sides`.
        left: number of breaks left out.
    """

    breaks: Breaks
    parts: np.ndarray
    points: np.ndarray
    triangles: np.ndarray
    numbers: np.ndarray
    sides: np.ndarray
    left: int


def found_in_views(
    views: Sequence[Points], layers: Sequence[Fronts], most: int | None = None
) -> tuple[list[Found], list[Samples]]:
    """Outlines of each view between what is seen at centres (K, H, W), of at most `most` breaks; samples of each part.

    Samples of several views lie on triangles. They are one table for each part, view after view.
    """
    broken = each(lambda b: views[b].broken(layers[b], most), range(len(views)))
    rows, samples = [np.full(own.parts.shape, -1, np.int32) for own in broken], []
    for part in range(len(views[0].entries)):
        asked = [own.parts == part for own in broken]
        points = [own.points[here] for own, here in zip(broken, asked, strict=True)]
        known = [own.triangles[here] for own, here in zip(broken, asked, strict=True)]
        fragments = [view.on_sheets(part, *own) for view, *own in zip(views, points, known, strict=True)]
        together = None
        if None not in fragments:
            together = Fragments(*(np.concatenate(x, axis=2) for x in zip(*fragments, strict=True)))
        numbers = np.concatenate([own.numbers[here] for own, here in zip(broken, asked, strict=True)])
        own, numbers = views[0].of_layers(part, np.concatenate(points), numbers, together)
        ends = np.cumsum([len(x) for x in points])
        samples.append(own)
        for own, here, number in zip(rows, asked, np.split(numbers[: ends[-1]], ends[:-1]), strict=True):
            own[here] = number
    return [view.found(own, at, samples) for view, own, at in zip(views, broken, rows, strict=True)], samples


class Points:
    """A scene that can be sampled at any point of a grid, part by part."""

    def __init__(self, scene: Scene, grid: Grid, parts: list[tuple]):
        """Take for each part its sampler, camera, entry and, where triangles tell all, sheets."""
        self._scene, self._grid, self._parts = scene, grid, parts
        self._width = pixel_widths(_on_host(grid.camera).for_size(grid.size), grid.size)

    @classmethod
    def of(cls, scene: Scene, grid: Grid, inputs: Sequence[Tree]) -> Points:
        """The points of a grid; `inputs` of each part's proxy, on the host, are read where it has no entry."""
        parts = []
        for part, sampler, entry, own in zip(scene.parts, scene.samplers, scene.entries, inputs, strict=True):
            camera, sheets = grid.camera.within(part.transform), None
            if isinstance(sampler, TriangleSampler):
                host = _on_host(camera.for_size(grid.size))
                entry = entry or _entry(part, sampler, own, host, grid.size)
                if has_sheets(part, sampler):
                    sheets = Sheets.of(entry.proxy, host, grid.size, part.cull)
            parts.append((sampler, camera, entry, sheets))
        return cls(scene, grid, parts)

    @property
    def entries(self) -> list[Any]:
        """The prepared entry of each part."""
        return [entry for _, _, entry, _ in self._parts]

    def found(self, broken: _Broken, rows: np.ndarray, samples: list[Samples]) -> Found:
        """Outlines from breaks, whose `_Broken.parts` are sampled in `rows` of `samples`; pairs are added to these."""
        breaks, parts, points, _, _, sides, left = broken
        layered = sides.shape[-1] > 0
        if not layered:
            pairs, of_pairs = self._pairs(breaks, samples)
            rows, parts = np.concatenate([rows, pairs], axis=1), np.concatenate([parts, of_pairs], axis=1)
        along = np.stack([breaks.gap[:, 2], 1 - breaks.gap[:, 2]], axis=1)
        first = breaks.gap[:, 1::-1] + 0.5
        place = ((breaks.place - first) * along).sum(-1)
        places = ((points - first[:, None]) * along[:, None]).sum(-1)
        entries = places[:, 2:] if layered else places[:, :0]
        own = breaks.gap, places[:, :2], breaks.near, breaks.slope, breaks.ends
        segments = joined(breaks, layered)
        return Found(rows, parts, sides, entries, place, *own, *segments, breaks.joined, np.int32(left))

    def _pairs(self, breaks: Breaks, samples: list[Samples]) -> tuple[np.ndarray, np.ndarray]:
        """Pairs beside the deepest points of rays at breaks, rows (B, 2) of their parts, or −1; and these parts (B, 2).

        They are added to the samples of parts. Triangles that stand for no field have no pairs.
        """
        part = np.where(breaks.near == 2, -1, np.where(breaks.near == 1, breaks.parts[:, 1], breaks.parts[:, 0]))
        rows = np.full((len(part), 2), -1, np.int32)
        for own, known in enumerate(self._parts):
            at = np.flatnonzero(part == own)
            surface, points, triangles = self._scene.parts[own].surface, breaks.points, breaks.triangles
            drawn = isinstance(known[0], TriangleSampler)
            if not len(at) or (drawn and not overrides(surface, "refine_outlines", TriangleSurface)):
                continue
            chosen = at, breaks.near[at]
            fragments = self.on_sheets(own, points[chosen], triangles[chosen]) if drawn else None
            more = self.sample(own, points[chosen], fragments, pairs=True)
            if more.pair is not None:
                found = host_value(more.pair).T
                rows[at] = np.where(found >= 0, found + samples[own].ids.shape[-2], -1)
            samples[own] = in_one_table([samples[own], more])
        return rows, np.column_stack([part, part]).astype(np.int32)

    def broken(self, layers: Fronts, most: int | None) -> _Broken:
        """The breaks, at most so many, between what is seen at centres (K, H, W), and the samples that they need."""
        breaks, *others = self._breaks(layers)
        left = 0 if most is None else max(0, len(breaks.gap) - most)
        if left:
            breaks = Breaks(*(x if name == "joined" else x[:most] for name, x in breaks._asdict().items()))
            others = [x[:most] for x in others]
        return _Broken(breaks, *others, left)

    def _breaks(self, layers: Fronts) -> tuple[Breaks, np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """All breaks, and the other arrays of `_Broken`."""
        sheets, opaque = [own for *_, own in self._parts if own is not None], np.array(self._scene.opaque)
        known, count = len(sheets) == len(self._parts), len(layers.part)
        if count == 1 and known:
            breaks, stacks = breaks_of_triangles(Fronts(*(x[0] for x in layers)), sheets, self._width), None
        elif known:
            breaks, stacks = breaks_of_stacks(_lit(layers, opaque), opaque, sheets, self._width)
        else:
            oracle = Oracle(functools.partial(self._layers, count=count), self._width)
            breaks, stacks = find_breaks(_lit(layers, opaque), oracle)
        if count == 1 or stacks is None:
            # For each break the two last samples, and the two that tell colours.
            parts = np.concatenate([breaks.parts, breaks.parts], 1)
            points = np.concatenate([breaks.points, breaks.inner], 1)
            return breaks, parts, points, breaks.triangles, 0 * parts, np.empty((len(parts), 2, 0), np.int32)
        parts = np.concatenate([stacks.last, stacks.parts], 1)
        points = np.concatenate([breaks.points, stacks.points], 1)
        triangles = np.concatenate([breaks.triangles[:, :2], stacks.triangles], 1)
        return breaks, parts, points, triangles, stacks.numbers, stacks.sides

    def on_sheets(self, part: int, points: np.ndarray, triangles: np.ndarray) -> Fragments | None:
        """Fragments (1, 1, M) of a part at points (M, 2) on its triangles (M,); None if some are not known (−1)."""
        sheets = self._parts[part][-1]
        return sheets.at(triangles, points)[0] if sheets is not None and (triangles >= 0).all() else None

    def of_layers(
        self, part: int, points: np.ndarray, numbers: np.ndarray, fragments: Fragments | None
    ) -> tuple[Samples, np.ndarray]:
        """Samples of one layer of a part at each point (M, 2), given their `numbers` (M,); and their rows (M,)."""
        most, count = numbers.max(initial=0), len(points)
        samples = self.sample(part, points, fragments, layers=1 + most)
        row = host_value(samples.row)[:, 0]
        if not most:
            return samples, row[0, :count]
        row = row[numbers, np.arange(count)]
        used, own = np.unique(row, return_inverse=True)
        none = int(used[0] < 0)
        used = used[none:].astype(np.int32) if len(used) > none else np.zeros(1, np.int32)
        return taken_rows(samples, engine_of(samples.row).constant(used, samples.row)), own.reshape(-1) - none

    def sample(
        self,
        part: int,
        points: np.ndarray,
        fragments: Fragments | None = None,
        pairs: bool = False,
        layers: int = 1,
    ) -> Samples:
        """Samples of a part at points (M, 2), with `fragments` (1, 1, M) if they are known."""
        sampler, camera, entry, sheets = self._parts[part]
        if not len(points) and (sheets is None or _refines(self._scene.parts[part])):
            # Surfaces may want a ray at least; nothing names its sample.
            points, fragments = np.full((1, 2), 0.5), None
        if fragments is not None:
            sampler = _OnTriangles(fragments)
        request = Request(points=points, pairs=pairs, entry=entry)
        samples = sampler.sample(self._scene.parts[part], camera, self._grid.size, layers, request)
        if "points" in samples.followed:
            return samples
        warn(
            f"the sampler {name_of('rts.samplers', sampler)} does not sample single points, so that outlines lie midway"
            f" between centres of pixels; use sampler='raster' or 'rays', or more samples a pixel",
            InputWarning,
        )
        height, width = self._grid.size
        x, y = (np.clip(np.floor(points[:, axis]), 0, count - 1) for axis, count in ((0, width), (1, height)))
        at = (y * width + x).astype(np.int64)
        check_samples(samples, (height, width), sampler)
        found, depth = (host_value(z).reshape(len(z), -1)[:, at] for z in (samples.row, samples.depth))
        constant = engine_of(samples.row).constant
        number = np.where(found >= 0, np.arange(found.size).reshape(found.shape), -1)
        taken = taken_rows(samples, constant(np.maximum(found, 0).reshape(-1).astype(np.int32), samples.row))
        row = constant(number.astype(np.int32)[:, None], samples.row)
        return taken.replace(row=row, depth=constant(depth[:, None], samples.depth))

    def _layers(self, points: np.ndarray, count: int) -> Fronts:
        """The nearest `count` layers at points (M, 2), nothing behind an opaque one; of equal ones the first part's."""
        scene, none = self._scene, (count, len(points))
        given = [part.theta for part in scene.parts], self._grid.camera
        more = engine_of(*given).room(len(points), exemplar(*given)) - len(points)
        asked = np.concatenate([points, np.repeat(points[:1], more, axis=0)])
        part, depth = np.full(none, -1, np.int32), np.full(none, np.inf)
        for index, opaque in enumerate(scene.opaque):
            samples = self.sample(index, asked, layers=1 if opaque else count)
            row, z = (host_value(x)[:, 0, : len(points)] for x in (samples.row, samples.depth))
            part = np.concatenate([part, np.where(row >= 0, np.int32(index), np.int32(-1))])
            depth = np.concatenate([depth, np.where(row >= 0, z, np.inf)])
            order = np.argsort(depth, axis=0, kind="stable")[:count]
            part, depth = (np.take_along_axis(x, order, 0) for x in (part, depth))
        return _lit(Fronts(part, np.full(none, -1, np.int32), depth), np.array(scene.opaque))


def _lit(layers: Fronts, opaque: np.ndarray) -> Fronts:
    """The surfaces seen at points (K, ...), without what lies behind an opaque layer."""
    part, hidden = layers.part.copy(), np.zeros(layers.part.shape[1:], np.bool_)
    for own in part:
        own[hidden] = -1
        hidden |= (own >= 0) & opaque[own]
    return layers._replace(part=part, depth=np.where(part >= 0, layers.depth, 0.0))


class _OnTriangles(TriangleSampler):
    """A sampler of points whose triangles are known."""

    def __init__(self, fragments: Fragments):
        """Take the fragments (1, 1, M) at all points to come."""
        self._fragments = fragments

    def rasterize(self, prepared: Any, camera: Camera, size: tuple[int, int], layers: int, cull: str) -> Fragments:
        """Nothing but points is asked for."""
        raise NotImplementedError

    def rasterize_points(
        self, prepared: Any, camera: Camera, size: tuple[int, int], layers: int, cull: str, points: np.ndarray
    ) -> Fragments:
        """The fragments."""
        return self._fragments


def inputs_of(scene: Scene) -> list[Tree]:
    """The inputs of the proxies of all parts, on the host; none of them is traced."""
    return [map_leaves(host_value, _proxy_inputs(part)) for part in scene.parts]


def _proxy_inputs(part: CheckedPart) -> Tree:
    """The inputs of a part's proxy, without derivatives; None if it has no triangles."""
    surface = part.surface
    return stopped(surface.proxy_inputs(stopped(part.theta))) if isinstance(surface, TriangleSurface) else None


def _entry(part: CheckedPart, sampler: TriangleSampler, inputs: Tree, camera: Camera, size: tuple[int, int]) -> Any:
    """The part's prepared entry, with the inputs of its proxy, on the host."""
    surface: Any = part.surface
    return sampler.working_on(surface, inputs, camera, size, None, lambda known: known._replace(inputs=inputs))
