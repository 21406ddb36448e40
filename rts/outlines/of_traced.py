"""Scenes of traced or batched values: samples and outlines by one call to the host, which samples all parts at once.

Under `vmap` items that show small meshes whole are drawn side by side in one picture.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from rts.arrays.engines import Context, engine_of, is_constant, is_traced, namespace, stopped
from rts.arrays.trees import Array, collected, leaves, map_leaves
from rts.compiling.threads import OnAllCores
from rts.contracts.records import ArraySpec, Cells, Sampled, Samples, Stencil
from rts.errors import InputWarning, warn
from rts.outlines.found import fits, specs
from rts.outlines.of_joint import AtOnce
from rts.outlines.of_scene import most_crossings
from rts.outlines.required import Required
from rts.sampling.entries import is_batched
from rts.sampling.host_call import SampleBounds, attribute_specs
from rts.sampling.host_scenes import from_values, real_of, values_of
from rts.sampling.joint import Joint, is_suited
from rts.sampling.picture import Picture, at_once, renumbered
from rts.sampling.scene import Grid, Scene
from rts.sampling.side_by_side import DrawnView, joined


def sampled_by_one_call(
    scene: Scene, grid: Grid, layers: int, required: Required, uniform: bool, capacity: int | None
) -> Sampled | None:
    """The samples of a scene whose values are not at hand, with their outlines, by one call to the host.

    The cells of each part's samples are its rows, one after the other, −1 for those that are not in use. Samples beyond
    `capacity` in a part, and crossings beyond `most_crossings`, are dropped, and counted in `overflow`.

    Args:
        scene: the scene.
        grid: the cells.
        layers: K.
        required: as of `with_outlines`.
        uniform: as of `AtOnce.found`.
        capacity: as of `Request`.

    Returns:
        None for values that are known after all, and where parts cannot be sampled along with others (`is_suited`).
    """
    engine = scene.context.engine
    if not (engine.differentiates and all(map(is_suited, scene.parts, scene.samplers))):
        return None
    values = stopped(values_of(scene, grid))
    operands = [x for x in leaves(values) if type(x) is not np.ndarray]
    traced = any(map(is_traced, operands))
    padded = scene.context.like is not None and engine.padded(scene.context.like)
    if not traced and not padded and not any(map(is_batched, operands)):
        return None
    return _Call(scene, grid, layers, required, uniform, capacity, values, traced).sampled(operands)


class _Call:
    """A call to the host: the shapes of its results, and what it computes from operands.

    Other arguments are those of `sampled_by_one_call`; `values` are those of `values_of`, and `traced` says that shapes
    are fixed. Programs keep the call, which must not keep what was traced.
    """

    def __init__(
        self,
        scene: Scene,
        grid: Grid,
        layers: int,
        required: Required,
        uniform: bool,
        capacity: int | None,
        values: Any,
        traced: bool,
    ):
        parts = [replace(part, theta={}, transform=None) for part in scene.parts]
        self._context = Context(engine_of(), np.zeros((), real_of(scene)))
        camera = scene.camera.map(lambda _: np.eye(4))  # Not read: that of the cells is among the values.
        self._scene = scene._replace(parts=parts, camera=camera, cameras=[], context=self._context)
        self._size = grid.size
        self._layers, self._required = layers, required
        self._values = map_leaves(lambda x: x if type(x) is np.ndarray else 0.0, values)
        self._capacity, self._uniform = capacity, uniform
        self._most = most_crossings(grid, capacity) if traced else None
        kept = 1 if all(scene.opaque) else layers
        cells = 1 if uniform else layers * grid.size[0] * grid.size[1]
        beside = (self._most or 0) * required.samples(layers)
        rows = beside + (cells if capacity is None else min(cells, capacity))
        # Without fixed shapes there is no bound.
        self._rows = rows if traced else (2**31 - 1) // len(scene.parts)
        self._surfaces: list[Any] = [part.surface for part in scene.parts]
        self._constant = [part.read if is_constant(part.read) else None for part in scene.parts]
        bounds = SampleBounds(layers, grid.size, self._rows, grid.size)
        self._attributes = [
            attribute_specs(surface, part.reads, theta, bounds, scene.context.like)
            for part, surface, theta in zip(scene.parts, self._surfaces, self._constant, strict=True)
        ]
        self._stencil = specs(self._most or 0, grid.size, real_of(scene), kept)
        self._cells = kept, *grid.size

    def sampled(self, operands: Sequence[Array]) -> Sampled:
        """The samples, in arrays of the operands' engine."""
        engine = engine_of(*operands)
        results = iter(engine.call_host(OnAllCores(self._one, self._several), self._specs(), *operands))
        samples, lengths = [], []
        for part, attributes in zip(self._scene.parts, self._attributes, strict=True):
            count, ids, params, *others = (next(results) for _ in range(3 + len(attributes)))
            xp, length = namespace(ids), ids.shape[-2]
            every = engine.constant(np.arange(length, dtype=np.int32), ids)
            own = Cells(xp.where(every < count, every, -1)[None, None, :])
            gbuffer = dict(zip(attributes, others, strict=True)) or None
            samples.append(Samples(ids, params, own, 0 * count, gbuffer=gbuffer, gbuffer_names=part.reads))
            lengths.append(length)
        row, depth, overflow = (next(results) for _ in range(3))
        stencil = Stencil(*results)
        starts = np.arange(len(lengths), dtype=np.int64) * self._rows
        shifts = np.cumsum([0, *lengths[:-1]]) - starts
        if shifts.any():
            starts, shifts = starts[None].astype(np.int32), shifts[None].astype(np.int32)
            row = renumbered(row, starts, shifts)
            stencil = stencil.with_samples(lambda rows: renumbered(rows, starts, shifts))
        return Sampled(tuple(samples), Cells(row, depth), overflow, stencil=stencil)

    def _specs(self) -> list[ArraySpec]:
        specs = []
        for surface, attributes in zip(self._surfaces, self._attributes, strict=True):
            i, p = surface.sample_widths
            specs.append(ArraySpec((), np.int32))
            specs += [ArraySpec((self._rows, i), np.int32, True), ArraySpec((self._rows, p), np.float32, True)]
            specs += [spec._replace(packed=True) for spec in attributes.values()]
        specs += [ArraySpec(self._cells, np.int32), ArraySpec(self._cells, np.float32), ArraySpec((), np.int32)]
        return [*specs, *self._stencil]

    def _entered(self, arrays: Sequence[np.ndarray]) -> tuple[Scene, Grid]:
        """The scene on the host, and its cells, from operands."""
        values = iter(arrays)
        known = map_leaves(lambda x: x if type(x) is np.ndarray else next(values), self._values)
        return from_values(self._scene, self._size, known)

    def _one(self, *arrays: np.ndarray) -> list[np.ndarray]:
        """The results of one item."""
        scene, grid = self._entered(arrays)
        return self._results([self._found(AtOnce(Joint.of(scene, grid), grid, scene.opaque), self._most)])[0]

    def _found(self, at_once: AtOnce, most: int | None) -> Sampled:
        """The samples, at most `capacity` of each part at centres, and the stencil of at most `most` crossings."""
        seen = at_once.centres(self._layers)
        if not self._uniform and self._capacity is not None:
            seen = _limited(seen, self._capacity)
        return at_once.found(seen, self._required, real_of(self._scene), self._uniform, most)

    def _several(self, items: Sequence[Sequence[np.ndarray]]) -> list[list[np.ndarray] | None]:
        """The results of several items; None for those that cannot be drawn along with others, or lack room."""
        views = [DrawnView.of(*self._entered(arrays)) for arrays in items]
        kinds: dict[tuple, list[int]] = {}
        for index, view in enumerate(views):
            if view is not None:
                kinds.setdefault(view.kind, []).append(index)
        most, found = at_once(self._size), {}
        for alike in kinds.values():
            for first in range(0, len(alike), most):
                chunk = alike[first : first + most]
                together = [view for index in chunk if (view := views[index]) is not None]
                for index, sampled in zip(chunk, self._side_by_side(together), strict=True):
                    assert sampled.stencil is not None
                    if fits(sampled.stencil, self._most):
                        found[index] = sampled
        results = dict(zip(found, self._results(list(found.values())), strict=True))
        return [results.get(index) for index in range(len(items))]

    def _side_by_side(self, views: Sequence[DrawnView]) -> Iterator[Sampled]:
        """The samples of each of several views of one kind, drawn in one picture."""
        picture = Picture.of(len(views), self._size)
        scene, grid, joint = joined(views, picture)
        sampled = self._found(AtOnce(joint, grid, scene.opaque), None)
        assert sampled.stencil is not None
        count = len(self._scene.parts)
        tables = [sampled.samples[first : first + count] for first in range(0, len(sampled.samples), count)]
        starts = np.cumsum([0, *(sum(len(part.ids) for part in of_view) for of_view in tables)])[:-1]
        stencils = _split(sampled.stencil, picture)
        for of_view, start, place, own in zip(tables, starts, picture.places(), stencils, strict=True):
            row, depth = (x[:, *place] for x in (sampled.row, sampled.depth))
            own = own.with_samples(partial(_moved, shift=-start))
            yield replace(sampled, samples=of_view, cells=Cells(_moved(row, -start), depth), stencil=own)

    def _results(self, items: Sequence[Sampled]) -> list[list[np.ndarray]]:
        """The results of items: for each part a count, tables and attributes, then cells, overflow and stencil."""
        attributes = [self._attributes_of(index, items) for index in range(len(self._scene.parts))]
        found = []
        for b, sampled in enumerate(items):
            results, sizes = [], [len(samples.ids) for samples in sampled.samples]
            stencil: Any = sampled.stencil
            beside = np.concatenate([x.reshape(-1) for x in stencil.samples()])
            owners = np.searchsorted(np.cumsum(sizes), beside[beside >= 0], side="right")
            named = np.bincount(owners, minlength=len(sizes)) > 0
            for samples, of_part, is_named in zip(sampled.samples, attributes, named.tolist(), strict=True):
                seen = is_named or (samples.row >= 0).any()  # Else the rows are there so that tables are not empty.
                results += [np.int32(len(samples.ids) if seen else 0), samples.ids, samples.params, *of_part[b]]
            shifts = np.arange(len(sizes)) * self._rows - np.cumsum([0, *sizes[:-1]])
            moved = np.append(np.arange(sum(sizes)) + np.repeat(shifts, sizes), -1).astype(np.int32)
            row = sampled.row
            if len(sizes) > 1:
                row, stencil = moved[row], stencil.with_samples(moved.__getitem__)
            results += [row, sampled.depth, np.asarray(sampled.overflow, np.int32), *collected(stencil)]
            found.append(results)
        return found

    def _attributes_of(self, index: int, items: Sequence[Sampled]) -> list[list[np.ndarray]]:
        """The attributes of a part whose θ is constant, for each item."""
        theta, specs = self._constant[index], self._attributes[index]
        tables = [sampled.samples[index] for sampled in items]
        if theta is None or not tables:
            return [[] for _ in tables]
        first = replace(
            tables[0],
            ids=np.concatenate([table.ids for table in tables]),
            params=np.concatenate([table.params for table in tables]),
            gbuffer_names=None,
        )
        gbuffer = self._surfaces[index].evaluate(theta, first)
        ends = np.cumsum([len(table.ids) for table in tables])[:-1]
        split = [np.split(np.asarray(gbuffer[name], spec.dtype), ends) for name, spec in specs.items()]
        return [list(of_item) for of_item in zip(*split, strict=True)]


def _limited(seen: Sampled, capacity: int) -> Sampled:
    """The surfaces seen at centres, at most `capacity` cells of each part; its last layers are left out first."""
    part = seen.row.reshape(-1)
    order = np.argsort(part, kind="stable")
    ordered = part[order]
    beyond = np.arange(len(part)) - np.searchsorted(ordered, ordered) >= capacity
    left = order[beyond & (ordered >= 0)]
    if not len(left):
        return seen
    warn(f"{len(left)} samples find no room in capacity={capacity}; give the compiled program more", InputWarning)
    cells = seen.cells.map(np.copy)
    for x, none in ((cells.row, -1), (cells.depth, 0), (cells.triangle, -1)):
        assert isinstance(x, np.ndarray)
        x.reshape(-1)[left] = none
    return replace(seen, cells=cells, overflow=np.int32(seen.overflow + len(left)))


def _moved(rows: Array, shift: int) -> np.ndarray:
    """Indices (…) int32 of rows, moved by `shift`; −1 stays."""
    return np.where(rows >= 0, rows + np.int32(shift), np.int32(-1))


def _split(stencil: Stencil, picture: Picture) -> list[Stencil]:
    """The stencils of each of B views of a picture, on the host: cells and stacks counted in the view."""
    (height, width), across, whole = picture.view, picture.across, picture.size
    count, stacks = whole[0] * whole[1], stencil.stacks

    def placed(cell: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The views of cells of the picture, and their numbers there."""
        y, x = np.divmod(cell, whole[1])
        return y // height * across + x // width, y % height * width + x % width

    def by_view(x: np.ndarray, order: np.ndarray, views: np.ndarray) -> list[np.ndarray]:
        return np.split(x[order], np.searchsorted(views[order], np.arange(1, picture.views)))

    (of_color, color_cell), (of_motion, motion_cell) = placed(stencil.color_cell), placed(stencil.motion_cell)
    color_sample, motion_colors, own_stacks = stencil.color_sample, stencil.motion_colors, [None] * picture.views
    if stacks is not None:
        # Each stack is one of the view whose entries name it; nothing names the others.
        owner = np.zeros(len(stacks), np.int64)
        for named, views in ((color_sample, of_color), *((motion_colors[:, i], of_motion) for i in (0, 1))):
            owner[named[named >= count] - count] = views[named >= count]
        order = np.argsort(owner, kind="stable")
        own_stacks = by_view(stacks, order, owner)
        number = np.empty(len(stacks), np.int64)
        number[order] = np.concatenate([np.arange(len(x)) for x in own_stacks])

        def composites(named: np.ndarray) -> np.ndarray:
            inside = np.where(named < 0, -1, placed(np.clip(named, 0, count - 1))[1])
            stack = number[np.clip(named - count, 0, None)] if len(number) else inside
            return np.where(named < count, inside, height * width + stack).astype(np.int32)

        color_sample, motion_colors = composites(color_sample), composites(motion_colors)
    orders = [np.argsort(views, kind="stable") for views in (of_color, of_motion)]
    colors = color_cell.astype(np.int32), color_sample, stencil.color_weight
    motions = motion_cell.astype(np.int32), stencil.motion_sample, stencil.motion_weight, motion_colors
    fields = [by_view(x, orders[0], of_color) for x in colors] + [by_view(x, orders[1], of_motion) for x in motions]
    joined = [stencil.joined[:, *place] for place in picture.places()]
    return [Stencil(*of_view) for of_view in zip(joined, *fields, own_stacks, strict=True)]
