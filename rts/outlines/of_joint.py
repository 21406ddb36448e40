"""Scenes of triangles: all samples and the stencil, found on the host in one table.

A part's rows are those at centres, then those beside crossings, so that nothing is numbered anew.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from rts.compiling.threads import parallel
from rts.contracts.records import Cells, Fragments, Sampled
from rts.outlines import samples_loops
from rts.outlines.beside import Beside, crossings_of_meshes, limited
from rts.outlines.found import Outlines, fits
from rts.outlines.gaps import Hits
from rts.outlines.required import Required
from rts.outlines.seen_mesh import SeenMesh
from rts.sampling import packing_loops
from rts.sampling.camera_checks import on_host
from rts.sampling.joint import Joint, is_suited
from rts.sampling.points import pixel_widths
from rts.sampling.scene import Grid, Scene


class AtOnce:
    """A scene of triangles, all of which are drawn and sampled at once, and the cells that see it."""

    def __init__(self, joint: Joint, grid: Grid, opaque: Sequence[bool]):
        """Take the parts, and the cells. Behind those that are `opaque`, for each part, nothing is sampled."""
        self._joint, self._grid, self._opaque = joint, grid, np.array(opaque, np.bool_)
        self._fragments: Fragments | None = None

    @classmethod
    def of(cls, scene: Scene, grid: Grid, opaque: Sequence[bool]) -> AtOnce | None:
        """A scene on the host; None if some part has to be sampled by itself."""
        suited = all(map(is_suited, scene.parts, scene.samplers))
        return cls(Joint.of(scene, grid), grid, opaque) if suited else None

    def centres(self, layers: int) -> Sampled:
        """The surfaces seen at centres (K, H, W). `Sampled.row` has parts, or −1; `found` tells the samples."""
        shape = layers, *self._grid.size
        self._fragments = self._joint.drawn(self._grid.size, layers)
        part, triangle, depth = np.empty(shape, np.int32), np.empty(shape, np.int32), np.empty(shape, np.float32)
        owners, seen = packing_loops.owners_of(self._joint.starts), self._fragments[::2]
        known = *seen, owners, self._opaque, part, triangle, depth
        parallel(samples_loops.hits, shape[1], *known, work=3 * part.size)
        return Sampled((), Cells(part, depth, triangle), np.zeros((), np.int32))

    def found(
        self, seen: Sampled, required: Required | None, real: Any, uniform: bool = False, most: int | None = None
    ) -> Sampled:
        """The samples at centres, those beside crossings, and the stencil.

        Args:
            seen: what `centres` gave last, or its first layers, or fewer cells.
            required: what samples beside crossings have to tell; None for none, and no stencil.
            real: the dtype of weights.
            uniform: whether one sample stands for all cells of a part, of one layer.
            most: the crossings for whose stencil there is room; None for any. `overflow` counts those left out.
        """
        if required is None:
            return self._sampled(seen, None, uniform)[0]
        joint, size, count = self._joint, self._grid.size, most
        mesh = SeenMesh.of(
            joint.proxy, joint.camera, size, "none", 0, joint.proxies, seams=required.colors, keep=joint.signs
        )
        width = pixel_widths(on_host(self._grid.camera).for_size(size), size)
        layers = Hits(seen.row, seen.triangle, seen.depth.astype(np.float64))
        find = partial(crossings_of_meshes, layers, self._opaque, (mesh,), width)
        while True:
            crossings, stacks, left_out = limited(find, count, required.colors)
            wanted, sides = Beside.of(crossings, stacks, required), None if stacks is None else stacks.sides
            sampled, rows = self._sampled(seen, mesh.at(wanted.triangle, wanted.points), uniform)
            outlines = Outlines.of(crossings, wanted.table(len(crossings.gap), rows), sides, left_out)
            stencil = outlines.stencil(sampled.row, required, real)
            if fits(stencil, most) or not count:
                return replace(sampled, stencil=stencil, overflow=seen.overflow + np.int32(left_out))
            count = min(count, len(crossings.gap)) // 2

    def _sampled(self, seen: Sampled, beside: Fragments | None, uniform: bool) -> tuple[Sampled, np.ndarray]:
        """The samples at centres, and those of fragments (1, 1, M) beside crossings, whose rows (M,) are told."""
        joint, part = self._joint, seen.row
        starts, table, corners = joint.starts, joint.proxy.ids, joint.proxy.corner_params
        assert self._fragments is not None and table is not None
        fragments, kept = Fragments(*(x[: len(part)] for x in self._fragments)), part >= 0
        if not uniform:
            found = packing_loops.pack(fragments, kept, table, corners, starts=starts, beside=beside)
            counts, ids, params, row, depth, rows = found
        else:  # One fragment of each part, at the first of its cells.
            first = packing_loops.firsts_of(part, len(starts) - 1)
            there, row_of, depth = first >= 0, np.full(len(first) + 1, -1, np.int32), seen.depth
            fragments = Fragments(*(x.reshape(-1, *x.shape[3:])[first[there]] for x in fragments))
            kept = np.ones(len(fragments.depth), np.bool_)
            found = packing_loops.pack(fragments, kept, table, corners, starts=starts, beside=beside)
            counts, ids, params, row_of[:-1][there], _, rows = found
            row = row_of.take(part)
        return replace(joint.of_parts(counts, ids, params, Cells(row, depth)), overflow=seen.overflow), rows
