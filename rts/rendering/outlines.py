"""Outlines of a sampled scene: its fronts at any point, the breaks between them, and the samples beside breaks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from rts.arrays.engines import engine_of, stopped, value_of
from rts.arrays.trees import Array, Tree, map_leaves
from rts.contracts.records import Outlines, Request, Sampled, Samples
from rts.contracts.surface import TriangleSurface
from rts.errors import InputError
from rts.registry import name_of
from rts.rendering.sampled_views import in_one_table
from rts.rendering.scene import Grid, Scene
from rts.sampling.gaps import Fronts, Oracle, find_breaks, more_breaks
from rts.sampling.segments import joined, tips
from rts.sampling.sheets import Sheets
from rts.sampling.triangle_sampler import TriangleSampler
from rts.scene.camera import Camera


def with_outlines(sampled: Sampled, scene: Scene, grid: Grid) -> Sampled:
    """Samples at cells' centres, of one layer, with `Sampled.outlines` and the samples beside breaks.

    Raises:
        InputError: arrays are traced; or a sampler cannot sample single points.
    """
    points = _Points.of(scene, grid)
    fronts, oracle = points.at_centres(sampled), points.oracle()
    breaks = find_breaks(fronts, oracle)
    segments = joined(breaks)
    further = more_breaks(breaks, *tips(breaks, segments), fronts, oracle)
    if further is not breaks:
        breaks, segments = further, joined(further)
    # For each break the two last samples, and the two that tell colours.
    parts, every = np.concatenate([breaks.parts, breaks.parts], 1), np.concatenate([breaks.points, breaks.inner], 1)
    samples, rows, first = [], np.full(parts.shape, -1, np.int32), 0
    for part, own in enumerate(sampled.samples):
        asked = parts == part
        more = points.sample(part, every[asked], evaluated=True)
        count = own.ids.shape[-2]
        found = _known(more.row)[0, 0]
        rows[asked] = np.where(found >= 0, first + count + found, -1)
        samples.append(in_one_table([own, more]))
        first += samples[-1].ids.shape[-2]
    shifted = _renumbered(sampled, samples)
    fields = {name: getattr(breaks, name) for name in ("place", "gap", "points", "near", "slope", "ends", "joined")}
    outlines = Outlines(rows=rows[:, :2], inner=rows[:, 2:], **fields, **segments._asdict())
    return replace(sampled, samples=tuple(samples), cells=shifted, outlines=outlines)


def _renumbered(sampled: Sampled, samples: Sequence[Samples]) -> Any:
    """The cells of a scene whose parts have got further rows behind their own."""
    row = _known(sampled.row)
    bounds = np.cumsum([own.ids.shape[-2] for own in sampled.samples])
    more = np.cumsum([0, *(s.ids.shape[-2] - o.ids.shape[-2] for s, o in zip(samples, sampled.samples, strict=True))])
    moved = np.where(row >= 0, row + more[np.searchsorted(bounds, row, side="right").clip(0, len(bounds))], -1)
    return replace(sampled.cells, row=engine_of(sampled.row).constant(moved.astype(np.int32), sampled.row))


def _known(x: Array) -> np.ndarray:
    """The values of an array; refused if it is traced."""
    value = value_of(x)
    if value is None:
        raise InputError(
            "splatter 'edges' looks for outlines while Python runs, and these samples are traced; render outside of "
            "jit and vmap, or give splatter='visible'"
        )
    return value


class _Points:
    """A scene that can be sampled at any point of a grid, part by part."""

    def __init__(self, scene: Scene, grid: Grid, parts: list[tuple]):
        """Take for each part its sampler, camera, entry and sheets."""
        self._scene, self._grid, self._parts = scene, grid, parts

    @classmethod
    def of(cls, scene: Scene, grid: Grid) -> _Points:
        """The points of a grid."""
        parts = []
        for part, sampler, entry in zip(scene.parts, scene.chosen(), scene.entries, strict=True):
            camera, sheets, surface = grid.camera.within(part.transform), None, part.surface
            if isinstance(sampler, TriangleSampler) and isinstance(surface, TriangleSurface):
                host = camera.for_size(grid.size).map(lambda m: np.asarray(_known(m), np.float64))
                entry = _entry(part, sampler, entry, host, grid.size)
                sheets = Sheets.of(entry.proxy, host, grid.size)
            parts.append((sampler, camera, entry, sheets))
        return cls(scene, grid, parts)

    def sample(self, part: int, points: np.ndarray, evaluated: bool = False) -> Samples:
        """One layer of samples of a part at points (M, 2); with `evaluated`, for rendering."""
        sampler, camera, entry, _ = self._parts[part]
        own = entry if not evaluated else self._scene.entries[part]
        request = Request(points=points, triangles=True, entry=own)
        samples = sampler.sample(self._scene.parts[part], camera, self._grid.size, 1, request)
        if "points" not in samples.followed:
            raise InputError(
                f"the sampler {name_of('rts.samplers', sampler)} does not sample single points, which splatter 'edges' "
                f"needs; use sampler='raster', or splatter='visible'"
            )
        return samples

    def oracle(self) -> Oracle:
        """The scene for `find_breaks`."""
        width = np.asarray(_known(self._grid.camera.spread(self._grid.size)), np.float64)
        return Oracle(self.fronts, [sheets for *_, sheets in self._parts], width)

    def fronts(self, points: np.ndarray) -> Fronts:
        """The nearest samples of all parts at points (M, 2)."""
        if not len(points):
            return Fronts(np.zeros(0, np.int32), np.zeros(0, np.int32), np.zeros(0))
        samples = [self.sample(part, points) for part in range(len(self._parts))]
        return _merged([(_known(s.row)[0, 0], _known(s.depth)[0, 0], s.triangle) for s in samples])

    def at_centres(self, sampled: Sampled) -> Fronts:
        """The fronts (H, W) of a sampled scene."""
        row, first, own = _known(sampled.row)[0], 0, []
        depth = _known(sampled.depth)[0]
        for samples in sampled.samples:
            count = samples.ids.shape[-2]
            inside = (row >= first) & (row < first + count)
            own.append((np.where(inside, row - first, -1), depth, samples.triangle))
            first += count
        return _merged(own)


def _merged(own: Sequence[tuple[np.ndarray, np.ndarray, Array | None]]) -> Fronts:
    """The nearest of each part's rows, depths and triangles; of equal ones the first part's."""
    shape = own[0][0].shape
    part, triangle, depth = np.full(shape, -1, np.int32), np.full(shape, -1, np.int32), np.full(shape, np.inf)
    for index, (row, z, triangles) in enumerate(own):
        nearer = (row >= 0) & (z < depth)
        part[nearer], depth[nearer] = index, z[nearer]
        triangle[nearer] = -1 if triangles is None else _known(triangles)[row[nearer]]
    return Fronts(part, triangle, np.where(part >= 0, depth, 0.0))


def _entry(part: Any, sampler: TriangleSampler, entry: Any, camera: Camera, size: tuple[int, int]) -> Any:
    """The part's prepared entry, with the inputs of its proxy."""
    if entry is not None:
        return entry
    surface: Any = part.surface
    inputs: Tree = map_leaves(_known, surface.proxy_inputs(stopped(part.theta)))
    return sampler.working_on(surface, inputs, camera, size, None, lambda known: known._replace(inputs=inputs))
