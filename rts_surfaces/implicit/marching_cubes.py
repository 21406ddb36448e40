"""Marching cubes: the edges of a cell on which its triangles' corners lie, by the signs at the cell's corners.

The table of the 256 cases is read off PyMCubes once, from 256 single cells. The sizes of the values at lattice points
decide only the place of a corner on its edge.
"""

from __future__ import annotations

import functools
import warnings
from typing import NamedTuple

import numpy as np

from rts import PluginError
from rts.plugin_api.threads import parallel
from rts_surfaces.implicit.lattice import Lattice
from rts_surfaces.implicit.narrow_band import Band

CORNERS = np.array([[i & 1, i >> 1 & 1, i >> 2 & 1] for i in range(8)])
"""Corner i of a cell, in steps from its lowest one along x, y and z."""

EDGES = np.array([(i, i | 1 << axis) for axis in range(3) for i in range(8) if not i >> axis & 1], np.int8)
"""(12, 2) the corners that each edge of a cell joins, the lower one first; four edges along x, along y, along z."""


class Triangles(NamedTuple):
    """An isosurface as triangles, each inside of one cell. Vertices are shared.

    Attributes:
        vertices: (V, 3) float32.
        faces: (T, 3) int32, counter-clockwise seen from outside.
        ends: (V, 2) int32, the lattice points at the ends of each vertex's edge: their numbers, or their rows in a
            band. Twice the same point if the vertex is on a cap.
        cells: (T,) int32, the cell of each triangle: the number of its lowest corner, or its row in a band.
        caps: (T,) int8; bit i is set if the triangle belongs to a cap, in a side of the bounds across axis i; else 0.
        differences: (V,) float32, the field's absolute difference between the ends of each vertex's edge; 0 on caps.
    """

    vertices: np.ndarray
    faces: np.ndarray
    ends: np.ndarray
    cells: np.ndarray
    caps: np.ndarray
    differences: np.ndarray


@functools.cache
def cases() -> tuple[np.ndarray, np.ndarray]:
    """For each case, the number of triangles (256,) uint8, and the edges (256, 5, 3) int8 that their corners lie on.

    Bit i of the number of a case says whether corner i is inside. Places without a triangle hold −1.

    Raises:
        PluginError: PyMCubes is not installed.
    """
    try:
        import mcubes
    except ImportError as error:
        raise PluginError(
            f"isosurfaces need PyMCubes ({error}); install it by: pip install 'rasterize-then-splat[isosurface]'"
        ) from error
    counts, edges = np.zeros(256, np.uint8), np.full((256, 5, 3), -1, np.int8)
    middles = {tuple(CORNERS[a] + CORNERS[b]): i for i, (a, b) in enumerate(EDGES)}
    for case in range(256):
        cell = np.zeros((2, 2, 2))
        for i, corner in enumerate(CORNERS):
            cell[tuple(corner)] = 0.5 if case >> i & 1 else -0.5
        with warnings.catch_warnings():
            # PyMCubes 0.1.6 sets shapes of arrays, which NumPy 2.5 warns of.
            warnings.filterwarnings("ignore", "Setting the shape", DeprecationWarning)
            vertices, triangles = mcubes.marching_cubes(cell, 0.0)
        counts[case] = len(triangles)
        for t, triangle in enumerate(np.asarray(triangles, np.int64)):
            edges[case, t] = [middles[tuple(np.rint(2 * vertices[v]).astype(int))] for v in triangle]
    return counts, edges


def of_lattice(values: np.ndarray, lattice: Lattice, isovalue: float, sign: float, closed: bool) -> Triangles:
    """The isosurface of a field whose values are known at all points of a lattice.

    Args:
        values: (X, Y, Z) float32 or float64.
        lattice: the lattice.
        isovalue: points are inside where `sign * (value - isovalue)` is below zero.
        sign: 1 or −1.
        closed: True to cap the inside at the bounds; else the surface ends there.

    Raises:
        PluginError: see `cases`.
    """
    from rts_surfaces.implicit import marching_cubes_loops as loops

    counts, edges = cases()
    values = np.ascontiguousarray(values)
    layers = lattice.shape[0] + closed
    tally = np.zeros((layers, 3), np.int64)
    level = values.dtype.type(isovalue), values.dtype.type(sign)
    field_arguments = values, *level, closed
    parallel(loops.count, layers, *field_arguments, counts, tally, work=layers * values[0].size)
    offsets = np.cumsum(tally, axis=0) - tally
    mixed, vertices, triangles = (int(n) for n in tally.sum(axis=0))
    cells, codes = np.empty(mixed, np.int64), np.empty(mixed, np.uint8)
    # Pages of it that lie away from the surface are never touched.
    first = np.empty((layers, lattice.shape[1] + closed, lattice.shape[2] + closed), np.int32)
    ends, places = np.empty((vertices, 2), np.int32), np.empty((vertices, 3), np.float32)
    differences = np.empty(vertices, np.float32)
    vertex_arrays = cells, codes, first, ends, places, differences
    parallel(
        loops.vertices,
        layers,
        *field_arguments,
        lattice.low,
        lattice.step,
        offsets,
        *vertex_arrays,
        work=layers * values[0].size,
    )
    faces = np.empty((triangles, 3), np.int32)
    owners, caps = np.empty(triangles, np.int32), np.empty(triangles, np.int8)
    face_arrays = faces, owners, caps
    table = counts, edges, EDGES
    parallel(
        loops.faces, layers, values.shape, closed, offsets, cells, codes, first, *table, *face_arrays, work=50 * mixed
    )
    return Triangles(places, faces, ends, owners, caps, differences)


def of_band(band: Band, lattice: Lattice, closed: bool) -> Triangles:
    """The surface of value 0 in the cells of a band, whose values are negative inside; `closed` as for `of_lattice`.

    `Triangles.ends` are rows of `band.numbers`, and `Triangles.cells` are rows of `band.cells`.

    Raises:
        PluginError: see `cases`.
    """
    from rts_surfaces.implicit import marching_cubes_loops as loops
    from rts_surfaces.implicit.distinct_loops import distinct

    counts, edges = cases()
    owners, corners, virtual, caps = _with_border(band, lattice, closed)
    inside = (band.values[corners] < 0) & ((virtual[:, None] >> np.arange(8) & 1) == 0)
    codes = (inside << np.arange(8)).sum(axis=1).astype(np.uint8)
    mixed = np.flatnonzero((codes > 0) & (codes < 255))
    owners, corners, virtual, caps, codes = (x[mixed] for x in (owners, corners, virtual, caps, codes))
    per_cell = counts[codes].astype(np.int64)
    total = int(per_cell.sum())
    keys, pairs = np.empty(3 * total, np.int64), np.empty((3 * total, 2), np.int32)
    loops.edges_of_cells(corners, virtual, codes, counts, edges, EDGES, keys, pairs)
    kept, faces = distinct(keys)
    ends = np.empty((len(kept), 2), np.int32)
    ends[faces] = pairs
    f_a, f_b = (band.values[ends[:, i]].astype(np.float64) for i in range(2))
    a, b = (lattice.points(band.numbers[ends[:, i]]) for i in range(2))
    along = np.where(f_a == f_b, 0.0, -f_a / np.where(f_a == f_b, 1.0, f_b - f_a))
    places = (a + along[:, None] * (b - a)).astype(np.float32)
    owners, caps = (np.repeat(x, per_cell) for x in (owners, caps))
    faces = faces.reshape(-1, 3).astype(np.int32, copy=False)
    return Triangles(places, faces, ends, owners, caps, np.abs(f_b - f_a).astype(np.float32))


def _with_border(band: Band, lattice: Lattice, closed: bool) -> tuple[np.ndarray, ...]:
    """The band's cells, and for a closed surface the cells beyond the lattice next to them.

    Returns:
        For each cell its row of the band, or that of the cell next to it, (C,) int32; the rows of its corners (C, 8)
        int32, in place of corners beyond the lattice those next to them; which corners lie beyond, and so outside,
        (C,) uint8, a bit each; and `Triangles.caps` of the cell's triangles (C,) int8.
    """
    count = len(band.corners)
    band_rows = np.arange(count, dtype=np.int32)
    groups = [(band_rows, band.corners, np.zeros(count, np.uint8), np.zeros(count, np.int8))]
    last = np.array(lattice.shape) - 2
    for side in np.stack(np.meshgrid(*[(-1, 0, 1)] * 3, indexing="ij"), axis=-1).reshape(-1, 3) if closed else ():
        at_side = np.flatnonzero(((side == 0) | (band.cells == np.where(side < 0, 0, last))).all(axis=1))
        if not side.any() or not len(at_side):
            continue
        # Along an axis of the border, both corners are the lattice's last ones.
        beside = np.where(side == 0, CORNERS, side > 0).astype(np.int64) @ np.array([1, 2, 4])
        outer = ((side != 0) & (CORNERS == (side > 0))).any(axis=1) @ (1 << np.arange(8))
        cap = (side != 0) @ (1, 2, 4)
        of_all = np.full(len(at_side), outer, np.uint8), np.full(len(at_side), cap, np.int8)
        groups.append((band_rows[at_side], band.corners[at_side][:, beside], *of_all))
    return tuple(np.concatenate(x) for x in zip(*groups, strict=True))
