"""The search for the samples of one view on a surface's triangles, on the host."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from rts.arrays.trees import Tree
from rts.contracts.records import ArraySpec, Fragments, Samples
from rts.contracts.surface import TriangleSurface
from rts.sampling.cache import Entry
from rts.sampling.host_call import SampleBounds
from rts.sampling.layer_order import on_surface, refined
from rts.sampling.packing import pack_fragments, repack
from rts.sampling.pairs import with_pairs
from rts.sampling.points import at_points
from rts.sampling.sample_checks import check_fragments
from rts.scene.camera import Camera

LEAST_LAYERS = 3
"""Fewest layers of triangles to draw for a surface that moves its samples; for K layers, K + 1 if that is more. At an
outline both sides of a fold of triangles may lie beside the surface."""


@dataclass(frozen=True)
class TriangleSearch:
    """The search for the samples of one view, on the host.

    Attributes:
        sampler: the `TriangleSampler` that draws the triangles.
        surface: the surface.
        cull: the part's `cull`.
        inputs: the result of the surface's `proxy_inputs`, on the host.
        camera: host matrices.
        bounds: bounds on the number of samples.
        tables: the result of the surface's `table_specs`.
        entry: the surface's prepared entry; None to look it up, or to build it.
        points: (1, M, 2), the points to sample; None for the centres of all cells.
    """

    sampler: Any
    surface: TriangleSurface
    cull: str
    inputs: Tree
    camera: Camera
    bounds: SampleBounds
    tables: Mapping[str, ArraySpec]
    entry: Entry | None
    points: np.ndarray | None

    def in_place(self, pairs: bool) -> Samples:
        """Samples on the triangles, or refined by a surface that does not move them; `pairs` as in `Request`."""
        entry, fragments, covered = self._drawn(self.bounds.layers)
        ids, capacity = fragments.triangle_ids, self.bounds.capacity
        if not self.surface.refines:
            packed = pack_fragments(fragments, entry.proxy, capacity, covered)
            return packed.replace(triangle=ids if capacity is None else np.where(packed.row >= 0, ids, np.int32(-1)))
        unrefined = pack_fragments(fragments, entry.proxy, None, covered)
        surface, inputs, camera, view, points = self.surface, self.inputs, self.camera, self.bounds.view, self.points
        samples, _ = refined(surface, inputs, unrefined, camera, self.tables, view, points)
        packed = repack(samples, samples.row >= 0, capacity)
        if pairs and points is not None:
            packed = with_pairs(packed, surface, inputs, camera, view, points, self.tables)
        return packed.replace(triangle=np.where(packed.row >= 0, ids, np.int32(-1)))

    def moved(self) -> Samples:
        """Samples that the surface moves off its triangles, with `incomplete_cells`."""
        layers = self.bounds.layers
        # There is only one set of tables, so that no samples can be added later.
        entry, fragments, covered = self._drawn(layers if self.tables else max(layers + 1, LEAST_LAYERS))
        arguments = self.surface, self.inputs, fragments, entry.proxy, self.camera, layers, self.tables
        samples = on_surface(*arguments, size=self.bounds.view, cells=self.points)
        covers = samples.row >= 0
        incomplete = np.count_nonzero(covered[-1] & ~covers[-1])
        return repack(samples, covers, self.bounds.capacity).replace(incomplete_cells=np.asarray(incomplete, np.int32))

    def _drawn(self, layers: int) -> tuple[Entry, Fragments, np.ndarray]:
        """The entry, the triangles drawn into `layers` layers, and the covered cells of these."""
        sampler, camera, view, points = self.sampler, self.camera, self.bounds.view, self.points
        grid = layers, *self.bounds.size

        def draw(entry: Entry) -> tuple[Entry, Fragments, np.ndarray]:
            if not (count := len(entry.proxy.faces)):
                return entry, _no_fragments(grid), np.zeros(grid, np.bool_)
            seen = entry.proxy.seen_by(camera)
            arguments = entry.prepared, seen, view, layers, self.cull
            if points is None:
                fragments = sampler.rasterize(*arguments)
            else:
                fragments = sampler.rasterize_points(*arguments, points[0])
                if fragments is None:
                    fragments = at_points(entry.proxy, seen, view, layers, self.cull, points[0])
            return entry, fragments, check_fragments(fragments, grid, count, sampler)

        return sampler.working_on(self.surface, self.inputs, camera, view, self.entry, draw)


def _no_fragments(shape: tuple[int, int, int]) -> Fragments:
    return Fragments(np.full(shape, -1, np.int32), np.zeros((*shape, 2), np.float32), np.zeros(shape, np.float32))
