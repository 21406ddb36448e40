"""A scene sampled at single points: its fronts there, the breaks between them, and the samples beside breaks."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from rts.arrays.engines import engine_of, exemplar, host_value
from rts.arrays.trees import Tree
from rts.contracts.checked_parts import CheckedPart
from rts.contracts.records import Cells, Fragments, Request, Samples
from rts.contracts.sampler import Sampler
from rts.contracts.surface import TriangleSurface
from rts.errors import InputWarning, warn
from rts.outlines.found import Outlines, Told
from rts.outlines.gaps import SEAM, Breaks, Fronts, Gaps, Hints, Oracle, find_breaks
from rts.outlines.segments import joined
from rts.outlines.sheets import Sheets
from rts.outlines.spans import breaks_of_triangles
from rts.outlines.stacks import breaks_of_stacks
from rts.plugin_base import overrides
from rts.registry import name_of
from rts.sampling.camera_checks import on_host
from rts.sampling.entries import entry_of
from rts.sampling.packing import pack_fragments
from rts.sampling.points import pixel_widths
from rts.sampling.sample_checks import check_samples
from rts.sampling.scene import Grid, Scene, has_sheets
from rts.sampling.tables import in_one_table, taken_rows
from rts.sampling.triangle_sampler import TriangleSampler
from rts.scene.camera import Camera


class _Broken(NamedTuple):
    """Breaks, and the samples that they need. Host arrays.

    Attributes:
        breaks: the breaks.
        parts: (B, R), the parts of samples, or −1.
        points: (B, R, 2), where they are.
        triangles: (B, R), on which they are; −1 where none is known.
        numbers: (B, R), how many layers of the same part are in front; 0 where triangles are known.
        sides: see `Outlines.sides`.
        left: number of breaks left out.
    """

    breaks: Breaks
    parts: np.ndarray
    points: np.ndarray
    triangles: np.ndarray
    numbers: np.ndarray
    sides: np.ndarray
    left: int


class Points:
    """A scene that can be sampled at any point of a grid, part by part."""

    def __init__(self, scene: Scene, grid: Grid, parts: list[tuple], told: Told):
        """Take of each part its sampler, camera, entry and, where triangles tell all, sheets, shared by joint parts."""
        self._scene, self._grid, self._parts, self._told = scene, grid, parts, told
        self._width = pixel_widths(on_host(grid.camera).for_size(grid.size), grid.size)

    @classmethod
    def of(cls, scene: Scene, grid: Grid, inputs: Sequence[Tree], told: Told) -> Points:
        """The points of a grid.

        Args:
            scene: the scene.
            grid: its cells.
            inputs: of each part's proxy, on the host; read where the part has no entry.
            told: what samples have to tell.
        """
        parts, joints = [], {joint.first: joint for joint in scene.joints}
        for index, (part, sampler, entry, part_inputs) in enumerate(
            zip(scene.parts, scene.samplers, scene.entries, inputs, strict=True)
        ):
            camera, sheets, joint = scene.local_camera(index, grid), None, joints.get(index)
            if joint is not None:
                sheets = Sheets.of(joint.proxy, joint.camera, grid.size, joint.cull, index, joint.proxies, told.colors)
            elif parts and parts[-1][3] is not None and index in parts[-1][3].parts:
                sheets = parts[-1][3]
            elif isinstance(sampler, TriangleSampler):
                host = on_host(camera.for_size(grid.size))
                entry = entry or entry_of(part, sampler, part_inputs, host, grid.size)
                if has_sheets(part, sampler):
                    seen = entry.proxy.seen_by(host)
                    sheets = Sheets.of(entry.proxy, seen, grid.size, part.cull, index, seams=told.colors)
            parts.append((sampler, camera, entry, sheets))
        return cls(scene, grid, parts, told)

    def outlines(self, layers: Fronts, most: int | None = None) -> tuple[Outlines, list[Samples]]:
        """Outlines between what is seen at centres (K, H, W), of at most `most` breaks; and their samples, by part."""
        broken = self._broken(layers, most)
        rows, samples = np.full(broken.parts.shape, -1, np.int32), []
        joints = {joint.first: joint for joint in self._scene.joints}
        while (part := len(samples)) < len(self._parts):
            joint = joints.get(part)
            inside = (broken.parts >= part) & (broken.parts < (part + 1 if joint is None else joint.stop))
            points = broken.points[inside]
            fragments = self._on_sheets(part, points, broken.triangles[inside])
            if joint is not None:
                assert fragments is not None
                lifted = joint.lifted(fragments)
                firsts = np.cumsum([0, *(len(one.ids) for one in lifted.samples)], dtype=np.int32)
                samples += lifted.samples
                rows[inside] = host_value(lifted.row)[0, 0] - firsts[broken.parts[inside] - part]
                continue
            one, rows[inside] = self._of_layers(part, points, broken.numbers[inside], fragments)
            samples.append(one)
        return self._found(broken, rows, samples), samples

    def _found(self, broken: _Broken, rows: np.ndarray, samples: list[Samples]) -> Outlines:
        """Outlines from breaks, whose `_Broken.parts` are sampled in `rows` of `samples`; pairs are added to these."""
        breaks, parts, _, _, _, sides, left = broken
        layered = sides.shape[-1] > 0
        if not layered:
            pairs, of_pairs = self._pairs(breaks, samples)
            rows, parts = np.concatenate([rows, pairs], axis=1), np.concatenate([parts, of_pairs], axis=1)
        down, across, along = breaks.gap.T
        place = np.where(along == 1, breaks.place[:, 0] - across, breaks.place[:, 1] - down) - 0.5
        near = np.where(breaks.near == SEAM, 0, breaks.near)  # There both surfaces move alike.
        of_breaks = place, breaks.gap, near, breaks.slope, breaks.ends
        return Outlines(rows, parts, sides, *of_breaks, *joined(breaks, layered), breaks.joined, left)

    def _pairs(self, breaks: Breaks, samples: list[Samples]) -> tuple[np.ndarray, np.ndarray]:
        """Pairs beside the deepest points of rays at breaks, rows (B, 2) of their parts, or −1; and these parts (B, 2).

        They are added to the samples of parts.
        """
        part = np.where(breaks.near == 2, -1, np.where(breaks.near == 1, breaks.parts[:, 1], breaks.parts[:, 0]))
        rows = np.full((len(part), 2), -1, np.int32)
        if not self._told.motions:
            part[:] = -1
        for index, known in enumerate(self._parts):
            if not has_pairs(self._scene.parts[index], known[0]):
                continue
            points, triangles = breaks.points, breaks.triangles
            at = np.flatnonzero(part == index)
            if not len(at):
                continue
            ending, drawn = (at, breaks.near[at]), isinstance(known[0], TriangleSampler)
            fragments = self._on_sheets(index, points[ending], triangles[ending]) if drawn else None
            more = self._sample(index, points[ending], fragments, pairs=True)
            if more.pair is not None:
                found = host_value(more.pair).T[: len(at)]
                rows[at] = np.where(found >= 0, found + samples[index].ids.shape[-2], -1)
            samples[index] = in_one_table([samples[index], more])
        return rows, np.column_stack([part, part]).astype(np.int32)

    def _broken(self, layers: Fronts, most: int | None) -> _Broken:
        """The breaks, at most so many, between what is seen at centres (K, H, W), and the samples that they need."""
        breaks, *others = self._breaks(layers, self._told.colors)
        count, left = len(breaks.gap), 0
        if most is not None and count > most:
            if self._told.colors:  # Outlines come before seams.
                breaks, *others = self._breaks(layers, False)
            left = count - min(most, len(breaks.gap))
            warn(
                f"{left} breaks of outlines find no room beside {most}, and edges there neither move nor are smooth; "
                f"give the compiled program capacity={4 * count} or more",
                InputWarning,
            )
            breaks = Breaks(*(x if name == "joined" else x[:most] for name, x in breaks._asdict().items()))
            others = [x[:most] for x in others]
        return _Broken(breaks, *others, left)

    def _breaks(
        self, layers: Fronts, seams: bool
    ) -> tuple[Breaks, np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """All breaks, and the other arrays of `_Broken`; with those at seams, if they are wanted."""
        every, opaque = [sheet for *_, sheet in self._parts], np.array(self._scene.opaque)
        known, count = None not in every, len(layers.part)
        sheets = list({id(sheet): sheet for sheet in every}.values())
        if count == 1 and known:
            breaks = breaks_of_triangles(Fronts(*(x[0] for x in layers)), sheets, self._width, seams)
            stacks = None
        elif known:
            breaks, stacks = breaks_of_stacks(_lit(layers, opaque), opaque, sheets, self._width, seams)
        else:
            oracle = Oracle(functools.partial(self._layers, count=count), self._width)
            breaks, stacks = find_breaks(_lit(layers, opaque), oracle, self._hints(layers))
        if count == 1 or stacks is None:
            # For each break the two last samples, which tell motions, and the two that tell colours.
            points, triangles = np.concatenate([breaks.points, breaks.inner], 1), breaks.triangles
            told, first, none = self._told, breaks.parts, np.full_like(breaks.parts, -1)
            if not told.motions:
                if told.centers:  # What lies behind a break that is not the last.
                    first = np.column_stack([none[:, 0], np.where(breaks.ends[:, 1], -1, first[:, 1])])
                else:  # Those that tell colours come first, and are alone.
                    points, triangles = np.roll(points, 2, axis=1), np.roll(triangles, 2, axis=1)
            parts = np.concatenate([first, breaks.parts if told.samples(1) == 4 else none], 1)
            return breaks, parts, points, triangles, 0 * parts, np.empty((len(parts), 2, 0), np.int32)
        parts = np.concatenate([stacks.last, stacks.parts], 1)
        points = np.concatenate([breaks.points, stacks.points], 1)
        triangles = np.concatenate([breaks.triangles[:, :2], stacks.triangles], 1)
        return breaks, parts, points, triangles, stacks.numbers, stacks.sides

    def _hints(self, layers: Fronts) -> Hints | None:
        """Places in gaps where triangles are whose silhouettes lie there, though surfaces may be a little beside them.

        Of one layer, silhouettes behind what both centres see do not count.
        """
        several: list[Sheets] = []
        for index, (sampler, camera, entry, sheet) in enumerate(self._parts):
            if sheet is None and isinstance(sampler, TriangleSampler):
                host, cull = on_host(camera.for_size(self._grid.size)), self._scene.parts[index].cull
                sheet = Sheets.of(entry.proxy, entry.proxy.seen_by(host), self._grid.size, cull, index)
            if sheet is not None and not any(sheet is other for other in several):
                several.append(sheet)
        if not several:
            return None
        front = Fronts(*(x[0] for x in layers))
        if len(layers.part) > 1:
            front = front._replace(part=np.full_like(front.part, -1))
        met = np.zeros((2, *front.part.shape), np.uint8)
        for sheet in several:
            sheet.meet(front, self._width, met)
        gaps = Gaps.of(met == 2)
        if not len(gaps.gap):
            return None
        found = [sheet.spans(gaps, False)[:2] for sheet in several]
        names, spans = (np.concatenate(x) for x in zip(*found, strict=True))
        low, high = np.clip(spans[:, 0], 0, 1), np.clip(spans[:, 1], 0, 1)
        there = np.flatnonzero((names[:, 0] >= 0) & (high > low))
        return Hints(gaps.gap[names[there, 0]], (low[there] + high[there]) / 2)

    def _on_sheets(self, part: int, points: np.ndarray, triangles: np.ndarray) -> Fragments | None:
        """Fragments (1, 1, M) of a part at points (M, 2) on its triangles (M,); None if some are not known (−1)."""
        sheets = self._parts[part][-1]
        return sheets.at(triangles, points) if sheets is not None and (triangles >= 0).all() else None

    def _of_layers(
        self, part: int, points: np.ndarray, numbers: np.ndarray, fragments: Fragments | None
    ) -> tuple[Samples, np.ndarray]:
        """Samples of one layer of a part at each point (M, 2), given their `numbers` (M,); and their rows (M,)."""
        most, count = numbers.max(initial=0), len(points)
        samples = self._sample(part, points, fragments, layers=1 + most)
        row = host_value(samples.row)[:, 0]
        if not most:
            return samples, row[0, :count]
        row = row[numbers, np.arange(count)]
        used, index_of = np.unique(row, return_inverse=True)
        none = int(used[0] < 0)
        used = used[none:].astype(np.int32) if len(used) > none else np.zeros(1, np.int32)
        return taken_rows(samples, engine_of(samples.row).constant(used, samples.row)), index_of.reshape(-1) - none

    def _sample(
        self,
        part: int,
        points: np.ndarray,
        fragments: Fragments | None = None,
        pairs: bool = False,
        layers: int = 1,
    ) -> Samples:
        """Samples of a part at points (M, 2), with `fragments` (1, 1, M) if they are known."""
        (sampler, camera, entry, sheets), checked = self._parts[part], self._scene.parts[part]
        plain = sheets is not None and not _refines(checked) and checked.surface.centered
        if fragments is not None and plain and not pairs and not self._scene.context.engine.differentiates:
            # What a call of the sampler comes to.
            return pack_fragments(fragments, entry.proxy).replace(gbuffer_names=checked.reads, at_points=True)
        if fragments is None and len(points):
            # Engines that compile eager operations for each shape get few: further rows repeat the first point.
            arrays = checked.theta, camera
            more = engine_of(*arrays).room(len(points), exemplar(*arrays)) - len(points)
            points = np.concatenate([points, np.repeat(points[:1], more, axis=0)])
        if not len(points) and (sheets is None or _refines(checked)):
            # Surfaces may want a ray at least; nothing names its sample.
            points, fragments = np.full((1, 2), 0.5), None
        if fragments is not None:
            sampler = _OnTriangles(fragments)
        request = Request(points=points, pairs=pairs, entry=entry)
        samples = sampler.sample(checked, camera, self._grid.size, layers, request)
        if samples.at_points:
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
        part, depth = np.full(none, -1, np.int32), np.full(none, np.inf)
        for index, opaque in enumerate(scene.opaque):
            samples = self._sample(index, points, layers=1 if opaque else count)
            row, z = (host_value(x)[:, 0, : len(points)] for x in (samples.row, samples.depth))
            part = np.concatenate([part, np.where(row >= 0, np.int32(index), np.int32(-1))])
            depth = np.concatenate([depth, np.where(row >= 0, z, np.inf)])
            order = np.argsort(depth, axis=0, kind="stable")[:count]
            part, depth = (np.take_along_axis(x, order, 0) for x in (part, depth))
        fronts = Fronts(part, np.full(none, -1, np.int32), np.where(part >= 0, depth, 0.0))
        return _lit(fronts, np.array(scene.opaque))


def has_pairs(part: CheckedPart, sampler: Sampler) -> bool:
    """True if outlines of a part may move as a pair of samples; those of triangles that stand for no field do not."""
    return not isinstance(sampler, TriangleSampler) or overrides(part.surface, "refine_outlines", TriangleSurface)


def at_centres(cells: Cells, samples: Sequence[Samples]) -> Fronts:
    """Surfaces seen at centres (K, H, W), from the cells of a scene on the host; `samples` are those of its parts."""
    from rts.sampling.merging_loops import looked_up

    if len(samples) == 1:
        part = np.minimum(cells.row, np.int32(0))
    else:
        owners = np.repeat(np.arange(len(samples), dtype=np.int32), [one.ids.shape[-2] for one in samples])
        part = looked_up(cells.row, owners)
    triangle = np.full(part.shape, -1, np.int32) if cells.triangle is None else cells.triangle
    assert cells.depth is not None
    return Fronts(part, triangle, cells.depth.astype(np.float64))


def _lit(layers: Fronts, opaque: np.ndarray) -> Fronts:
    """The surfaces seen at points (K, ...), without what lies behind an opaque layer."""
    if not opaque.any():
        return layers
    part, hidden = layers.part.copy(), np.zeros(layers.part.shape[1:], np.bool_)
    for layer in part:
        layer[hidden] = -1
        hidden |= (layer >= 0) & opaque[layer]
    return layers._replace(part=part, depth=np.where(part >= 0, layers.depth, 0.0))


def _refines(part: CheckedPart) -> bool:
    """True if samples on a part's triangles pass through its surface."""
    return isinstance(part.surface, TriangleSurface) and part.surface.refines


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
