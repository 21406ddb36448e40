"""The one call to the host in which a part of triangles is sampled: its operands and its results."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from itertools import islice
from typing import Any, NamedTuple

import numpy as np

from rts.arrays.engines import context_of, floating_bits, is_constant, stopped
from rts.arrays.trees import Array, Tree, leaves, map_leaves
from rts.compiling.threads import OnAllCores
from rts.contracts.checked_parts import CheckedPart
from rts.contracts.records import ON_RAYS, ArraySpec, Cells, Samples
from rts.contracts.surface import TriangleSurface
from rts.sampling.cache import Entry
from rts.sampling.camera_checks import check_camera, on_host
from rts.sampling.layer_order import rays_of
from rts.scene.camera import Camera
from rts.scene.parts import Part

Find = Callable[..., tuple[Samples, Mapping[str, np.ndarray]]]
"""(camera, inputs of the proxy, further arrays), all on the host → samples, and further results by name."""


class SampleBounds(NamedTuple):
    """Bounds on the number of samples: layers, cells and rows.

    Attributes:
        layers: K.
        size: lines and columns of the cells to sample: of the grid, or of a list (L, C) of its cells.
        capacity: rows to allot, or None for as many as there are.
        view: (height, width) of the grid.
        more: without a capacity there is room for a row a cell, and for so many more.
    """

    layers: int
    size: tuple[int, int]
    capacity: int | None
    view: tuple[int, int]
    more: int = 0

    @property
    def rows(self) -> int:
        """The largest number of samples."""
        return self.layers * self.size[0] * self.size[1] + self.more if self.capacity is None else self.capacity

    def row_spec(self, dtype: Any, *widths: int) -> ArraySpec:
        """The spec of an array (rows, *widths) with a row for each sample."""
        return ArraySpec((self.rows, *widths), dtype, self.capacity is None)

    def tables(self, surface: TriangleSurface) -> dict[str, ArraySpec]:
        """Specs of the tables that a surface's `refine` fills."""
        specs = dict(surface.table_specs(self.layers * self.size[0] * self.size[1] + self.more, self.capacity))
        for name, spec in specs.items():
            if spec.by_sample:
                specs[name] = self.row_spec(spec.dtype, *spec.shape[1:])._replace(by_sample=True)
        return specs

    def specs(self, widths: tuple[int, int]) -> tuple[ArraySpec, ...]:
        """The specs of ids, params, row, depth and overflow."""
        grid = self.layers, *self.size
        return (
            self.row_spec(np.int32, widths[0]),
            self.row_spec(np.float32, widths[1]),
            ArraySpec(grid, np.int32),
            ArraySpec(grid, np.float32),
            ArraySpec((), np.int32),
        )


class HostCall:
    """One call to the host that samples a part: its inputs, and the shapes of its results.

    Args:
        part: the part.
        surface: its surface.
        camera: the camera in the part's local space, without derivatives.
        bounds: bounds on the number of samples.
        entry: the part's prepared entry, if known; the inputs of its proxy are then not read.
        concurrent: True if several threads may sample the part at once, as they then do under `vmap`.
    """

    def __init__(
        self,
        part: Part | CheckedPart,
        surface: TriangleSurface,
        camera: Camera,
        bounds: SampleBounds,
        entry: Entry | None,
        concurrent: bool = False,
    ):
        self._concurrent = concurrent
        self._surface, self._camera, self._bounds, self._entry = surface, camera, bounds, entry
        self._transform = [] if part.transform is None else [part.transform]
        self._engine, like = context_of(part.theta, camera)
        self._inputs = surface.proxy_inputs(stopped(part.theta)) if entry is None else None
        self._theta = None
        if self._engine.differentiates:
            # A surface without derivatives is evaluated where it is sampled, on the host.
            theta = {name: part.theta[name] for name in surface.reads(part.theta)}
            self._theta = theta if is_constant(theta) else None
        self._reads = part.reads if isinstance(part, CheckedPart) else None
        self._attributes = attribute_specs(surface, self._reads, self._theta, bounds, like)

    def samples(
        self,
        find: Find,
        beside: Mapping[str, ArraySpec],
        tables: Mapping[str, ArraySpec] | None = None,
        arrays: Sequence[Array] = (),
    ) -> tuple[Samples, dict[str, Array]]:
        """Samples and further arrays that `find` computes, by one call to the host.

        Args:
            find: computes samples and further results on the host; see `Find`. Its results have all names of `beside`,
                and its samples all `tables`.
            beside: specs of the further results, by name.
            tables: specs of `Samples.tables`.
            arrays: further operands of `find`, after cameras and inputs. A surface that is not centred takes the first
                as the points (1, M, 2), if there is one.

        Returns:
            Samples, and the further results by name, in arrays of the part's engine.

        Raises:
            InputError: a camera makes no image (see `check_camera`).
        """
        tables = dict(tables or {})
        if not self._surface.centered:
            tables[ON_RAYS] = self._bounds.row_spec(np.float32, 3)._replace(by_sample=True)

        # Programs keep the function, which must not keep what was traced.
        moves, further_ones, entry = len(self._transform), len(arrays), self._entry
        places, surface, theta = map_leaves(lambda _: 0.0, self._inputs), self._surface, self._theta
        attributes_of, view = self._attributes, self._bounds.view

        def complete(seen: Camera, moved: Sequence[np.ndarray], inputs: Tree, further: Sequence) -> tuple:
            """Samples with all their tables, and the further results."""
            camera = check_camera(seen, *moved)
            found, more = find(camera, inputs, *further)
            if ON_RAYS in tables:
                on_rays = _on_rays(found, camera, view, *further)
                found = replace(found, tables={**found.tables, ON_RAYS: on_rays})
            return found, {name: _allotted(found.tables[name], spec) for name, spec in tables.items()}, more

        if not self._engine.differentiates:  # All is on the host already.
            inputs = self._inputs if entry is None else entry.inputs
            found, filled, more = complete(on_host(self._camera), self._transform, inputs, arrays)
            cells = Cells(found.row, found.depth)
            return self._packed(found.ids, found.params, cells, found.overflow, filled, tables), dict(more)

        def host(*operands: np.ndarray) -> tuple[Any, ...]:
            it = iter(operands)
            seen = Camera(np.asarray(next(it), np.float64), np.asarray(next(it), np.float64))
            moved = [next(it) for _ in range(moves)]
            further = [next(it) for _ in range(further_ones)]
            inputs = map_leaves(lambda _: next(it), places) if entry is None else entry.inputs
            found, filled, more = complete(seen, moved, inputs, further)
            gbuffer = {} if theta is None else surface.evaluate(theta, found)
            return (
                *(found.ids, found.params, found.row, found.depth, found.overflow),
                *(more[name] for name in beside),
                *(filled[name] for name in tables),
                *(np.asarray(gbuffer[name], spec.dtype) for name, spec in attributes_of.items()),
            )

        sample_specs = self._bounds.specs(self._surface.sample_widths)
        specs = *sample_specs, *beside.values(), *tables.values(), *self._attributes.values()
        operands = self._camera.view, self._camera.projection, *self._transform, *arrays, *leaves(self._inputs)
        results = iter(self._engine.call_host(OnAllCores(host) if self._concurrent else host, specs, *operands))
        ids, params, row, depth, overflow = islice(results, len(sample_specs))
        more, filled, attributes = (dict(zip(x, results, strict=False)) for x in (beside, tables, self._attributes))
        return self._packed(ids, params, Cells(row, depth), overflow, filled, tables, attributes), more

    def _packed(
        self,
        ids: Array,
        params: Array,
        cells: Cells,
        overflow: Array,
        filled: Mapping[str, Array],
        tables: Mapping[str, ArraySpec],
        attributes: Mapping[str, Array] | None = None,
    ) -> Samples:
        """Samples of the part, with the tables of these specs."""
        return Samples(
            ids,
            params,
            cells,
            overflow,
            tables=filled,
            gbuffer=None if self._theta is None else attributes,
            gbuffer_names=self._reads,
            centered=self._surface.centered,
            by_sample=tuple([name for name, spec in tables.items() if spec.by_sample]),
        )


def _on_rays(samples: Samples, camera: Camera, view: tuple[int, int], cells: np.ndarray | None = None) -> np.ndarray:
    """The table `ON_RAYS` (N, 3) of samples in a view, or in listed cells (L, C) of it.

    Rows that no cell names repeat row 0.
    """
    rays, covered = rays_of(samples, camera, view, cells), samples.row >= 0
    depth, used = np.ones(len(samples.ids)), np.zeros(len(samples.ids), bool)
    depth[samples.row[covered]], used[samples.row[covered]] = samples.depth[covered], True
    used[0] |= len(used) == 1
    points = np.zeros((len(depth), 3), np.float32)
    points[used] = rays.origins[used] + depth[used, None] * rays.directions[used]
    points[~used] = points[:1]
    return points


def _allotted(table: np.ndarray, spec: ArraySpec) -> np.ndarray:
    """A table padded with zeros to the number of rows that its spec fixes."""
    if spec.packed or len(table) == spec.shape[0]:
        return table
    return np.concatenate([table, np.zeros((spec.shape[0] - len(table), *table.shape[1:]), table.dtype)])


def attribute_specs(
    surface: TriangleSurface,
    reads: Sequence[str] | None,
    host_theta: Mapping | None,
    bounds: SampleBounds,
    like: Array | None,
) -> dict[str, ArraySpec]:
    """Specs of the attributes that the host evaluates: "position", and others that the shader reads.

    Args:
        surface: the surface.
        reads: names of the attributes that the shader reads; None for all.
        host_theta: the θ that the surface reads, if it is constant; None gives no specs.
        bounds: bounds on the number of samples.
        like: an array whose precision the attributes take; None for float32.
    """
    if host_theta is None:
        return {}
    real = np.float64 if like is not None and floating_bits(like) == 64 else np.float32
    if reads is not None and not reads:
        return {"position": bounds.row_spec(real, 3)}
    i, p = surface.sample_widths
    none = np.full((1, 1, 1), -1, np.int32)
    tables = {name: np.zeros((1, *spec.shape[1:]), spec.dtype) for name, spec in bounds.tables(surface).items()}
    one = Samples(np.zeros((1, i), np.int32), np.zeros((1, p), np.float32), Cells(none, none), np.int32(0), tables)
    gbuffer = surface.evaluate(host_theta, one)
    names = list(gbuffer) if reads is None else ["position", *(n for n in reads if n in gbuffer)]
    return {n: bounds.row_spec(real, *gbuffer[n].shape[1:]) for n in dict.fromkeys(names)}
