"""Outlines of a sampled scene: its fronts at any point, the breaks between them, and the samples beside breaks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from rts.arrays.engines import engine_of, stopped, value_of
from rts.arrays.trees import Array, Tree, map_leaves
from rts.contracts.records import Fragments, Outlines, Request, Sampled, Samples
from rts.contracts.surface import TriangleSurface
from rts.errors import InputError
from rts.registry import name_of
from rts.rendering.sampled_views import in_one_table
from rts.rendering.scene import Grid, Scene
from rts.sampling.gaps import Breaks, Fronts, Oracle, find_breaks
from rts.sampling.segments import joined
from rts.sampling.sheets import Sheets
from rts.sampling.spans import breaks_of_triangles
from rts.sampling.triangle_sampler import TriangleSampler
from rts.scene.camera import Camera


def with_outlines(sampled: Sampled, scene: Scene, grid: Grid) -> Sampled:
    """Samples at cells' centres, of one layer, with `Sampled.outlines` and the samples beside breaks.

    Raises:
        InputError: arrays are traced; or a sampler cannot sample single points.
    """
    points = _Points.of(scene, grid)
    breaks = points.breaks(points.at_centres(sampled))
    segments = joined(breaks)
    # For each break the two last samples, and the two that tell colours.
    parts, every = np.concatenate([breaks.parts, breaks.parts], 1), np.concatenate([breaks.points, breaks.inner], 1)
    triangles = breaks.triangles
    samples, rows, first = [], np.full(parts.shape, -1, np.int32), 0
    for part, own in enumerate(sampled.samples):
        asked = parts == part
        more = points.sample(part, every[asked], triangles[asked])
        count = own.ids.shape[-2]
        found = _known(more.row)[0, 0]
        rows[asked] = np.where(found >= 0, first + count + found, -1)
        samples.append(in_one_table([own, more]))
        first += samples[-1].ids.shape[-2]
    shifted = _renumbered(sampled, samples)
    fields = {name: getattr(breaks, name) for name in ("gap", "near", "slope", "ends", "joined")}
    along = np.stack([breaks.gap[:, 2], 1 - breaks.gap[:, 2]], axis=1)
    first = breaks.gap[:, 1::-1] + 0.5
    fields["place"] = ((breaks.place - first) * along).sum(-1)
    fields["points"] = ((breaks.points - first[:, None]) * along[:, None]).sum(-1)
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
        """Take for each part its sampler, camera, entry and, where triangles tell all, sheets."""
        self._scene, self._grid, self._parts = scene, grid, parts
        self._width = np.asarray(_known(grid.camera.spread(grid.size)), np.float64)

    @classmethod
    def of(cls, scene: Scene, grid: Grid) -> _Points:
        """The points of a grid."""
        parts = []
        for part, sampler, entry in zip(scene.parts, scene.chosen(), scene.entries, strict=True):
            camera, sheets, surface = grid.camera.within(part.transform), None, part.surface
            if isinstance(sampler, TriangleSampler) and isinstance(surface, TriangleSurface):
                host = camera.for_size(grid.size).map(lambda m: np.asarray(_known(m), np.float64))
                entry = _entry(part, sampler, entry, host, grid.size)
                if not (surface.refines and surface.refine_moves):
                    sheets = Sheets.of(entry.proxy, host, grid.size, part.cull)
            parts.append((sampler, camera, entry, sheets))
        return cls(scene, grid, parts)

    def breaks(self, fronts: Fronts) -> Breaks:
        """The breaks between the fronts (H, W) at centres."""
        sheets = [own for *_, own in self._parts if own is not None]
        if len(sheets) == len(self._parts):
            return breaks_of_triangles(fronts, sheets, self._width)
        return find_breaks(fronts, Oracle(self._fronts, self._width))

    def sample(self, part: int, points: np.ndarray, triangles: np.ndarray | None = None) -> Samples:
        """One layer of samples of a part at points (M, 2); on `triangles` (M,) if they are known (not −1)."""
        sampler, camera, entry, sheets = self._parts[part]
        if sheets is not None and triangles is not None and (triangles >= 0).all():
            sampler = _Found(sheets.at(triangles, points)[0])
        request = Request(points=points, triangles=True, entry=entry)
        samples = sampler.sample(self._scene.parts[part], camera, self._grid.size, 1, request)
        if "points" not in samples.followed:
            raise InputError(
                f"the sampler {name_of('rts.samplers', sampler)} does not sample single points, which splatter 'edges' "
                f"needs; use sampler='raster', or splatter='visible'"
            )
        return samples

    def _fronts(self, points: np.ndarray) -> Fronts:
        """The nearest samples of all parts at points (M, 2); of equal ones the first part's."""
        part, depth = np.full(len(points), -1, np.int32), np.full(len(points), np.inf)
        for index in range(len(self._parts)):
            samples = self.sample(index, points)
            seen, z = _known(samples.row)[0, 0] >= 0, _known(samples.depth)[0, 0]
            nearer = seen & (z < depth)
            part[nearer], depth[nearer] = index, z[nearer]
        return Fronts(part, np.full(len(part), -1, np.int32), np.where(part >= 0, depth, 0.0))

    def at_centres(self, sampled: Sampled) -> Fronts:
        """The fronts (H, W) of a sampled scene."""
        row, counts = _known(sampled.row)[0], [own.ids.shape[-2] for own in sampled.samples]
        of_part = np.repeat(np.arange(len(counts), dtype=np.int32), counts)
        none = [np.full(count, -1, np.int32) for count in counts]
        own = [s.triangle if s.triangle is not None else n for s, n in zip(sampled.samples, none, strict=True)]
        triangles = np.concatenate([_known(x) for x in own])
        part, triangle = (np.where(row >= 0, table[row], np.int32(-1)) for table in (of_part, triangles))
        return Fronts(part, triangle, _known(sampled.depth)[0].astype(np.float64))


class _Found(TriangleSampler):
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


def _entry(part: Any, sampler: TriangleSampler, entry: Any, camera: Camera, size: tuple[int, int]) -> Any:
    """The part's prepared entry, with the inputs of its proxy."""
    if entry is not None:
        return entry
    surface: Any = part.surface
    inputs: Tree = map_leaves(_known, surface.proxy_inputs(stopped(part.theta)))
    return sampler.working_on(surface, inputs, camera, size, None, lambda known: known._replace(inputs=inputs))
