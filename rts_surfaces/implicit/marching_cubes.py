"""Marching cubes: the edges of a cell on which its triangles' corners lie, by the signs at the cell's corners.

The sizes of the values at lattice points decide only the place of a corner on its edge.
"""

from __future__ import annotations

import functools
from typing import NamedTuple

import numpy as np

from rts.plugin_api.threads import parallel
from rts_surfaces.implicit.lattice import Lattice
from rts_surfaces.implicit.narrow_band import Band

CORNERS = np.array([[i & 1, i >> 1 & 1, i >> 2 & 1] for i in range(8)])
"""Corner i of a cell, in steps from its lowest one along x, y and z."""

EDGES = np.array([(i, i | 1 << axis) for axis in range(3) for i in range(8) if not i >> axis & 1], np.int8)
"""(12, 2) the corners that each edge of a cell joins, the lower one first; four edges along x, along y, along z."""

CASES = """
- 048 095 548958 41a 01a80a 40949a5191a9 51a5a99a8 5b1 14818b0585b8 9b1091 14818bb89 45ba4b 05b0b88ba 40949aa9b 9b8ba8
286 204624 295256085865 295256654 a62a21842412 a62a21120 9629a695a1a5084 2a69a291a951 5b1862 46b4b162b5b020b
9b6962b16860106 19b169146629 4524285b262aba2 5ba5a252062a 0842969a69ba 2a629a9ba 927 827874907047 027507 827874475
9271a4 0170791a7278a87 02a0a427a1a575a 1751871a8278 7b1712591921 4b147b487278059 7b1712210 17b471427482
ba2b27a42925452 05982b8bab27 7027a07baa40 7827b8ba8 986796 904947746 086065567 547467 67161a791418981 9679169011a6
08451656761a a51a65675 981915861b17671 9057b47464b1 810871867b17 17b147467 b67ba6985845 7a67ba590 a7ba67840 a7b67a 6a3
6806034a0a30 095a36 893836953a34543 641361 680603301 139195369094649 513538589836 a15a56b35365 5805685b636b14a
10616a09636b9b6 14ab38b89836 b36b65564 b365b6568580 0640b609b36b 6b368b89b 328a38 4a3430032 8a5850a35952325
932943954a34 841812213 012213 408519129132 529512132 32535b28515a8a5 4a105303235b 08118a29b2b3 b29b32a14 84585383235b
b05b30320 2b329b084 b2932b 37939a2696a9 079037043a34826 75a7a350a6a202a 8264a74757a3 649692419793139 826907037013
517713402426 351375268 9159a192a6a27b3 05926814a7b3 7b326121016a 4a1682b37 b37596564692 5907b3826 24026437b 7b3268
37939aa98 4a3043037079 08a0a70757a3 34a374754 798781713418 937903013 537513408 537135 7b35919a198a 05914a7b3 a08a10b37
14ab37 5845987b3 9057b3 0847b3 b37 b73 04873b b50b03970730 54353b483739893 3a43471b4b74 a87a73807b71017
0a403a09373951b 51b97a9a8a73 573153 578580738481318 973930031 789718731481 3a4347745 0a807a05773a 43a034073097
3973a9a89 63b6b872b28b 20b2b704b3b646b 53b563506860972 972b53563546 428472417b71a63 63a72b21b201 3a651b084297
972b5163a 318386158287578 431463570720 972083031386 614631729 a63842472457 70572063a 084297a63 29763a b923b2
2342483b4049b94 b50b03302 8548358233b5 b94b41924a43234 2a823a0191b9 51b40a03a023 3823a81b5 592521123 590142123248
021231 814821231 923934945a43 83a823905 43a403023 382a83 63b6b88b9 04606b0b93b6 b6356b586508 b63b56546 3a61b4b84b98
1901b93a6 51b4083a6 b513a6 531583598863 163146059 608630310 614316 859845a63 059a63 408a63 63a ab76a7 ab0a04b70806760
7607096a050bab0 978876b54b4a 1b7174476 801817876b71 b51970740764 968976b51 a15a56657 14a058568576 97696191016a
6976894a1 574476 068056576 940974764 968769 72878bb8a 72070a7aba04 2970858b58ab b4ab54972 1b7417472428 71b721201
40851b297 51b972 15717818a287 07205714a 0a108a297 97214a 872847457 072570 972084 972 26a2a99ab 26890a9aba04
5ab52a5026a2 4b54ab682 1b9196164692 91b901826 42640251b 51b826 26a92a9a1915 90582614a a26a12102 8264a1 259265645
059826 240642 268 98bb8a 4904a9ab9 0b508b8ab 4b5ab4 1841b8b98 91b019 08451b 51b 5a159a98a 59014a 0a18a0 4a1 584985 059
084 -
"""
"""The triangles of each case, three edges each, as hexadecimal digits; as PyMCubes has them."""


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


class Levels(NamedTuple):
    """Values at the points of a lattice, and which of these are inside; see `of_lattice`.

    Attributes:
        values: (X, Y, Z) float32 or float64.
        isovalue: in the dtype of the values.
        sign: 1 or −1, also.
        closed: whether the surface is capped at the lattice's boundary.
    """

    values: np.ndarray
    isovalue: np.floating
    sign: np.floating
    closed: bool


class Mixed(NamedTuple):
    """The cells whose corners differ in sign, layer by layer.

    Attributes:
        offsets: (layers, 3) int64, the numbers of mixed cells, vertices and triangles in the layers before.
        cells: (C,) int64: y * (number of cells along z) + z within its layer.
        codes: (C,) uint8, the case of each cell.
        first: (layers, cells along y, cells along z) int32, set at mixed cells alone: eight times the number of the
            first vertex that the cell owns, plus the bits of `marching_cubes_loops._crossed`.
    """

    offsets: np.ndarray
    cells: np.ndarray
    codes: np.ndarray
    first: np.ndarray


class Cases(NamedTuple):
    """For each case, its triangles. Bit i of the number of a case says whether corner i is inside.

    Attributes:
        counts: (256,) uint8, the number of triangles.
        edges: (256, 5, 3) int8, the edges that their corners lie on; −1 where there is no triangle.
        ends: `EDGES`.
    """

    counts: np.ndarray
    edges: np.ndarray
    ends: np.ndarray


@functools.cache
def cases() -> Cases:
    """The triangles of all cases."""
    counts, edges = np.zeros(256, np.uint8), np.full((256, 15), -1, np.int8)
    for case, word in enumerate(CASES.split()):
        corners = [int(edge, 16) for edge in word.strip("-")]
        counts[case], edges[case, : len(corners)] = len(corners) // 3, corners
    return Cases(counts, edges.reshape(256, 5, 3), EDGES)


def of_lattice(values: np.ndarray, lattice: Lattice, isovalue: float, sign: float, closed: bool) -> Triangles:
    """The isosurface of a field whose values are known at all points of a lattice.

    Args:
        values: (X, Y, Z) float32 or float64.
        lattice: the lattice.
        isovalue: points are inside where `sign * (value - isovalue)` is below zero.
        sign: 1 or −1.
        closed: True to cap the inside at the bounds; else the surface ends there.
    """
    from rts_surfaces.implicit import marching_cubes_loops as loops

    values = np.ascontiguousarray(values)
    layers, work = lattice.shape[0] + closed, (lattice.shape[0] + closed) * values[0].size
    tally = np.zeros((layers, 3), np.int64)
    levels = Levels(values, values.dtype.type(isovalue), values.dtype.type(sign), closed)
    parallel(loops.count, layers, levels, cases().counts, tally, work=work)
    count, vertices, triangles = (int(n) for n in tally.sum(axis=0))
    # Pages of it that lie away from the surface are never touched.
    first = np.empty((layers, lattice.shape[1] + closed, lattice.shape[2] + closed), np.int32)
    mixed = Mixed(np.cumsum(tally, axis=0) - tally, np.empty(count, np.int64), np.empty(count, np.uint8), first)
    found = Triangles(
        np.empty((vertices, 3), np.float32),
        np.empty((triangles, 3), np.int32),
        np.empty((vertices, 2), np.int32),
        np.empty(triangles, np.int32),
        np.empty(triangles, np.int8),
        np.empty(vertices, np.float32),
    )
    parallel(loops.vertices, layers, levels, lattice.fixed, mixed, found, work=work)
    parallel(loops.faces, layers, levels, mixed, cases(), found, work=50 * count)
    return found


def of_band(band: Band, lattice: Lattice, closed: bool) -> Triangles:
    """The surface of value 0 in the cells of a band, whose values are negative inside; `closed` as for `of_lattice`.

    `Triangles.ends` are rows of `band.numbers`, and `Triangles.cells` are rows of `band.cells`.
    """
    from rts_surfaces.implicit import marching_cubes_loops as loops
    from rts_surfaces.implicit.distinct_loops import distinct

    counts = cases().counts
    owners, corners, virtual, caps = _with_border(band, lattice, closed)
    inside = (band.values[corners] < 0) & ((virtual[:, None] >> np.arange(8) & 1) == 0)
    codes = (inside << np.arange(8)).sum(axis=1).astype(np.uint8)
    mixed = np.flatnonzero((codes > 0) & (codes < 255))
    owners, corners, virtual, caps, codes = (x[mixed] for x in (owners, corners, virtual, caps, codes))
    per_cell = counts[codes].astype(np.int64)
    total = int(per_cell.sum())
    keys, pairs = np.empty(3 * total, np.int64), np.empty((3 * total, 2), np.int32)
    loops.edges_of_cells(corners, virtual, codes, cases(), keys, pairs)
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
