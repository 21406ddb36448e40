"""A scene sampled at single points: hits there, the crossings between them, and the samples beside these."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Any

import numpy as np

from rts.arrays.engines import engine_of, exemplar, host_value
from rts.arrays.trees import Tree
from rts.compiling.threads import read_only
from rts.contracts.checked_parts import CheckedPart
from rts.contracts.records import Cells, Fragments, Request, Samples
from rts.contracts.sampler import Sampler
from rts.contracts.surface import TriangleSurface
from rts.errors import InputWarning, warn
from rts.outlines.beside import Beside, crossings_of_meshes, limited
from rts.outlines.edge_kinds import BEHIND_ENDS, INTERSECT
from rts.outlines.found import Outlines
from rts.outlines.gaps import Crossings, Gaps, Hits, Stacks
from rts.outlines.halving import Hints, Oracle, find_crossings
from rts.outlines.required import Required
from rts.outlines.seen_mesh import SeenMesh
from rts.plugin_base import overrides
from rts.registry import name_of
from rts.sampling.camera_checks import on_host
from rts.sampling.entries import entry_of
from rts.sampling.points import pixel_widths
from rts.sampling.sample_checks import check_samples
from rts.sampling.scene import Grid, Scene, lies_on_triangles
from rts.sampling.tables import in_one_table, taken_rows
from rts.sampling.triangle_sampler import TriangleSampler
from rts.scene.camera import Camera


class Points:
    """A scene that can be sampled at any point of a grid, part by part."""

    def __init__(self, scene: Scene, grid: Grid, parts: list[tuple], required: Required):
        """Take a tuple of each part: its sampler, camera, entry, and its `SeenMesh` where samples stay on triangles."""
        self._scene, self._grid, self._parts, self._required = scene, grid, parts, required
        self._width = pixel_widths(on_host(grid.camera).for_size(grid.size), grid.size)

    @classmethod
    def of(cls, scene: Scene, grid: Grid, inputs: Sequence[Tree], required: Required) -> Points:
        """The points of a grid.

        Args:
            scene: the scene.
            grid: its cells.
            inputs: of each part's proxy, on the host; read where the part has no entry.
            required: what samples have to tell.
        """
        parts = []
        for index, (part, sampler, entry, part_inputs) in enumerate(
            zip(scene.parts, scene.samplers, scene.entries, inputs, strict=True)
        ):
            camera, mesh = scene.local_camera(index, grid), None
            if isinstance(sampler, TriangleSampler):
                host = on_host(camera.for_size(grid.size))
                entry = entry or entry_of(part, sampler, part_inputs, host, grid.size)
                if lies_on_triangles(part, sampler):
                    seen = entry.proxy.seen_by(host)
                    mesh = SeenMesh.of(entry.proxy, seen, grid.size, part.cull, index, seams=required.colors)
            parts.append((sampler, camera, entry, mesh))
        return cls(scene, grid, parts, required)

    def outlines(self, layers: Hits, most: int | None = None) -> tuple[Outlines, np.ndarray, list[Samples]]:
        """Outlines between what is seen at centres (K, H, W), of at most `most` crossings; and their samples, by part.

        `Outlines.rows` are counted in each part; in the middle there are these parts, int32, of the same shape, or −1.
        """
        crossings, stacks, left_out = limited(functools.partial(self._crossings, layers), most, self._required.colors)
        wanted, samples = Beside.of(crossings, stacks, self._required), []
        found = np.empty(len(wanted.part), np.int32)
        for part in range(len(self._parts)):
            (inside,) = (wanted.part == part).nonzero()
            points = wanted.points[inside]
            fragments = self._on_triangles(part, points, wanted.triangle[inside])
            one, found[inside] = self._of_layers(part, points, wanted.number[inside], fragments)
            samples.append(one)
        rows, parts = (wanted.table(len(crossings.gap), x) for x in (found, wanted.part))
        if stacks is None:
            rows[:, 4:], parts[:, 4:] = self._pairs(crossings, samples)
        return Outlines.of(crossings, rows, None if stacks is None else stacks.sides, left_out), parts, samples

    def _pairs(self, crossings: Crossings, samples: list[Samples]) -> tuple[np.ndarray, np.ndarray]:
        """Pairs beside the deepest points of rays at crossings, rows (B, 2) of their parts, or −1; these parts (B, 2).

        They are added to the samples of parts.
        """
        part = np.where(crossings.kind == BEHIND_ENDS, crossings.parts[:, 1], crossings.parts[:, 0])
        part[crossings.kind == INTERSECT] = -1
        rows = np.full((len(part), 2), -1, np.int32)
        if not self._required.motions:
            part[:] = -1
        for index, known in enumerate(self._parts):
            if not has_pairs(self._scene.parts[index], known[0]):
                continue
            points, triangles = crossings.points, crossings.triangles
            at = np.flatnonzero(part == index)
            if not len(at):
                continue
            ending, drawn = (at, crossings.kind[at]), isinstance(known[0], TriangleSampler)
            fragments = self._on_triangles(index, points[ending], triangles[ending]) if drawn else None
            more = self._sample(index, points[ending], fragments, pairs=True)
            if more.pair is not None:
                found = host_value(more.pair).T[: len(at)]
                rows[at] = np.where(found >= 0, found + samples[index].ids.shape[-2], -1)
            samples[index] = in_one_table([samples[index], more])
        return rows, np.column_stack([part, part]).astype(np.int32)

    def _crossings(self, layers: Hits, seams: bool) -> tuple[Crossings, Stacks | None]:
        """All crossings, with those at seams, if they are wanted; and stacks there, of several layers."""
        meshes, opaque = [mesh for *_, mesh in self._parts], np.array(self._scene.opaque)
        count = len(layers.part)
        layers = layers if count == 1 else _lit(layers, opaque)
        if None not in meshes:
            return crossings_of_meshes(layers, opaque, meshes, self._width, seams)
        oracle = Oracle(functools.partial(self._layers, count=count), self._width)
        crossings, stacks = find_crossings(layers, oracle, self._hints(layers))
        return crossings, stacks if count > 1 else None

    def _hints(self, layers: Hits) -> Hints | None:
        """Places in gaps where triangles are whose silhouettes lie there, though surfaces may be a little beside them.

        Of one layer, silhouettes behind what both centres see do not count.
        """
        several: list[SeenMesh] = []
        for index, (sampler, camera, entry, mesh) in enumerate(self._parts):
            if mesh is None and isinstance(sampler, TriangleSampler):
                host, cull = on_host(camera.for_size(self._grid.size)), self._scene.parts[index].cull
                mesh = SeenMesh.of(entry.proxy, entry.proxy.seen_by(host), self._grid.size, cull, index)
            if mesh is not None:
                several.append(mesh)
        if not several:
            return None
        front = Hits(*(read_only(x[0]) for x in layers))
        if len(layers.part) > 1:
            front = front._replace(part=read_only(np.full_like(front.part, -1)))
        met = np.zeros((2, *front.part.shape), np.uint8)
        for mesh in several:
            mesh.mark_silhouettes(front, self._width, met)
        gaps = Gaps.of(met == 2)
        if not len(gaps.gap):
            return None
        found = [mesh.spans(gaps, False)[:2] for mesh in several]
        names, spans = (np.concatenate(x) for x in zip(*found, strict=True))
        low, high = np.clip(spans[:, 0], 0, 1), np.clip(spans[:, 1], 0, 1)
        there = np.flatnonzero((names[:, 0] >= 0) & (high > low))
        return Hints(gaps.gap[names[there, 0]], (low[there] + high[there]) / 2)

    def _on_triangles(self, part: int, points: np.ndarray, triangles: np.ndarray) -> Fragments | None:
        """Fragments (1, 1, M) of a part at points (M, 2) on its triangles (M,); None if some are not known (−1)."""
        mesh = self._parts[part][-1]
        return mesh.at(triangles, points) if mesh is not None and (triangles >= 0).all() else None

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
        (sampler, camera, entry, mesh), checked = self._parts[part], self._scene.parts[part]
        if fragments is None and len(points):
            # Engines that compile eager operations for each shape get few: further rows repeat the first point.
            arrays = checked.theta, camera
            more = engine_of(*arrays).room(len(points), exemplar(*arrays)) - len(points)
            points = np.concatenate([points, np.repeat(points[:1], more, axis=0)])
        if not len(points) and (mesh is None or _refines(checked)):
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

    def _layers(self, points: np.ndarray, count: int) -> Hits:
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
        fronts = Hits(part, np.full(none, -1, np.int32), np.where(part >= 0, depth, 0.0))
        return _lit(fronts, np.array(scene.opaque))


def has_pairs(part: CheckedPart, sampler: Sampler) -> bool:
    """True if outlines of a part may move as a pair of samples; those of triangles that stand for no field do not."""
    return not isinstance(sampler, TriangleSampler) or overrides(part.surface, "refine_outlines", TriangleSurface)


def at_centres(cells: Cells, samples: Sequence[Samples]) -> Hits:
    """Surfaces seen at centres (K, H, W), from the cells of a scene on the host; `samples` are those of its parts."""
    if len(samples) == 1:
        part = np.minimum(cells.row, np.int32(0))
    else:
        owners = np.repeat(np.arange(len(samples), dtype=np.int32), [one.ids.shape[-2] for one in samples])
        part = np.append(owners, np.int32(-1)).take(cells.row)
    triangle = np.full(part.shape, -1, np.int32) if cells.triangle is None else cells.triangle
    assert cells.depth is not None
    return Hits(part, triangle, cells.depth.astype(np.float64))


def _lit(layers: Hits, opaque: np.ndarray) -> Hits:
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
