"""Marching cubes, compiled: cells whose corners differ in sign, the vertices on their edges, their triangles.

Cells are processed layer by layer along x. Each cell owns the three edges that begin at its lowest corner, so that
threads can work on different layers: the first loop counts, the second writes. So that every edge has an owner, there
is one more cell along each axis than fit between the points; for a closed surface one lies before the first point, too.
`of_lattice` and the records are in `rts_surfaces.implicit.marching_cubes`.
"""

from __future__ import annotations

import numpy as np

from rts.plugin_api.loops import compiled, loop


@compiled(inline="always")
def _signs(values, isovalue, sign, closed, x, out):
    """Fill `out` uint8 with 1 for each point of plane x of `values` (X, Y, Z) that is inside, else 0.

    If closed, `out` is (Y + 2, Z + 2), with a frame of zeros around the points, and all zero for x of −1 or X. If not,
    it is (Y + 1, Z + 1): one row and one column more, which repeat the last ones, as plane X repeats the one before.
    """
    shape_x, shape_y, shape_z = values.shape
    outside = x < 0 or x >= shape_x
    if closed and outside:
        out[:] = 0
        return
    x = min(x, shape_x - 1)
    shift = 1 if closed else 0
    for y in range(shape_y):
        row, line = out[y + shift], values[x, y]
        for z in range(shape_z):
            row[z + shift] = sign * (line[z] - isovalue) < 0
        if closed:
            row[0], row[shape_z + 1] = 0, 0
        else:  # Beyond an open end all stays as it is, which crosses no edge.
            row[shape_z] = row[shape_z - 1]
    if closed:
        out[0], out[shape_y + 1] = 0, 0
    else:
        out[shape_y] = out[shape_y - 1]


@compiled(inline="always")
def _codes(low, high, y, cells, out):
    """Write the cases, see `marching_cubes.cases`, of row y of cells to the first `cells` places of `out` uint8.

    The cells lie between the planes `low` and `high`, results of `_signs` for one x and the next.
    """
    a, b, c, d = low[y], high[y], low[y + 1], high[y + 1]
    for z in range(cells):
        below = a[z] | b[z] << 1 | c[z] << 2 | d[z] << 3
        above = a[z + 1] | b[z + 1] << 1 | c[z + 1] << 2 | d[z + 1] << 3
        out[z] = below | above << 4


@compiled
def _mixed(codes, cells, found):
    """List in `found[:n]` the places, along a row, of the n cells whose corners differ in sign. Returns n.

    `codes` uint8 holds the cases of `cells` cells, and zeros up to a multiple of eight: eight are tested at once. The
    rest of `found`, which has `cells` places, may be overwritten.
    """
    words, full, many = codes.view(np.uint64), np.uint64(0xFFFFFFFFFFFFFFFF), 0
    for w in range(len(words)):
        if words[w] == 0 or words[w] == full:
            continue
        for z in range(8 * w, min(8 * w + 8, cells)):
            found[many] = z
            many += codes[z] != 0 and codes[z] != 255
    return many


@compiled
def _room(shape, closed):
    """Room for the signs of two planes, see `_signs`, and for the cases and the mixed cells of a row of cells."""
    border = 2 if closed else 1
    planes, cells = np.zeros((2, shape[1] + border, shape[2] + border), np.uint8), shape[2] + border - 1
    return planes, np.zeros((cells + 7) // 8 * 8, np.uint8), np.empty(cells, np.int64)


@compiled
def _crossed(code):
    """The crossed ones of the three edges that a cell owns, as bits 0 to 2 for x, y, z; from the cell's case `code`."""
    lowest = code & 1
    return (lowest != code >> 1 & 1) | np.int64(lowest != code >> 2 & 1) << 1 | np.int64(lowest != code >> 4 & 1) << 2


@compiled(inline="always")
def _is_real(x, y, z, shape, closed):
    """True if a cell, counted with the border, may have triangles; those of an open surface's border have none."""
    return closed or (x < shape[0] - 1 and y < shape[1] - 1 and z < shape[2] - 1)


@loop
def count(start, stop, levels, triangles_of, tally):
    """Fill `tally` (layers, 3) with the numbers of mixed cells, vertices and triangles of layers `start` to `stop` − 1.

    A mixed cell is one whose corners differ in sign. A layer's vertices are those on the edges that its cells own.

    Args:
        start: the first layer.
        stop: the layer after the last.
        levels: `Levels`.
        triangles_of: (256,), the number of triangles of each case.
        tally: (layers, 3) to be filled.
    """
    values, isovalue, sign, closed = levels
    shape = values.shape
    planes, codes, mixed_places = _room(shape, closed)
    cells_y, cells_z = planes.shape[1] - 1, len(mixed_places)
    first = -1 if closed else 0
    _signs(values, isovalue, sign, closed, start + first, planes[0])
    for x in range(start, stop):
        low, high = planes[(x - start) % 2], planes[(x - start + 1) % 2]
        _signs(values, isovalue, sign, closed, x + first + 1, high)
        mixed = crossed = triangles = 0
        for y in range(cells_y):
            _codes(low, high, y, cells_z, codes)
            for z in mixed_places[: _mixed(codes, cells_z, mixed_places)]:
                mixed += 1
                crossed += _bit_count(_crossed(codes[z]))
                if _is_real(x, y, z, shape, closed):
                    triangles += triangles_of[codes[z]]
        tally[x, 0], tally[x, 1], tally[x, 2] = mixed, crossed, triangles


@loop
def vertices(start, stop, levels, lattice, mixed, found):
    """List the mixed cells of layers `start` to `stop` − 1, and the vertices on the edges that they own.

    Args:
        start: the first layer.
        stop: the layer after the last.
        levels: `Levels`.
        lattice: `Lattice.fixed`.
        mixed: `Mixed`, of which all but `offsets` is to be filled.
        found: `Triangles`, of which `vertices`, `ends` and `differences` are to be filled.
    """
    (values, isovalue, sign, closed), (offsets, cells, codes_of, first_of) = levels, mixed
    shape = values.shape
    planes, codes, mixed_places = _room(shape, closed)
    cells_y, cells_z = planes.shape[1] - 1, len(mixed_places)
    shift = 1 if closed else 0
    _signs(values, isovalue, sign, closed, start - shift, planes[0])
    for x in range(start, stop):
        low, high = planes[(x - start) % 2], planes[(x - start + 1) % 2]
        _signs(values, isovalue, sign, closed, x - shift + 1, high)
        cell, vertex = offsets[x, 0], offsets[x, 1]
        for y in range(cells_y):
            _codes(low, high, y, cells_z, codes)
            for z in mixed_places[: _mixed(codes, cells_z, mixed_places)]:
                crossed = _crossed(codes[z])
                cells[cell], codes_of[cell] = y * cells_z + z, codes[z]
                cell += 1
                first_of[x, y, z] = 8 * vertex + crossed
                corner = x - shift, y - shift, z - shift
                vertex = _place(vertex, crossed, corner, values, isovalue, lattice, found)


@compiled
def _place(vertex, crossed, corner, values, isovalue, lattice, found):
    """Fill the rows of `found` for the vertices on the edges of a cell, from `vertex` on.

    `crossed` are the bits of `_crossed`; `corner` is the point (x, y, z) of the cell's lowest corner, −1 along an axis
    before the lattice. Other arguments are those of `vertices`. Returns the next free row.
    """
    (shape, origin, step), places, ends, differences = lattice, found.vertices, found.ends, found.differences
    ax, ay, az = max(corner[0], 0), max(corner[1], 0), max(corner[2], 0)
    for axis in range(3):
        if not crossed >> axis & 1:
            continue
        bx, by = min(corner[0] + (axis == 0), shape[0] - 1), min(corner[1] + (axis == 1), shape[1] - 1)
        bz = min(corner[2] + (axis == 2), shape[2] - 1)
        ends[vertex, 0], ends[vertex, 1] = (ax * shape[1] + ay) * shape[2] + az, (bx * shape[1] + by) * shape[2] + bz
        f_a, f_b = np.float64(values[ax, ay, az]), np.float64(values[bx, by, bz])
        differences[vertex] = abs(f_b - f_a)
        along = (isovalue - f_a) / (f_b - f_a) if f_a != f_b else 0.0
        places[vertex, 0] = origin[0] + step[0] * (ax + along * (bx - ax))
        places[vertex, 1] = origin[1] + step[1] * (ay + along * (by - ay))
        places[vertex, 2] = origin[2] + step[2] * (az + along * (bz - az))
        vertex += 1
    return vertex


@compiled(inline="always")
def _bit_count(x):
    return (x & 1) + (x >> 1 & 1) + (x >> 2 & 1)


@loop
def faces(start, stop, levels, mixed, cases, found):
    """Fill the faces, cells and caps of the triangles `found` in some layers.

    `mixed` is filled by `vertices`, which must have seen all layers. Other arguments are those of `vertices`, and
    `Cases`.
    """
    shape, closed, out, owners, caps = levels.values.shape, levels.closed, found.faces, found.cells, found.caps
    (offsets, cells, codes_of, first_of), (triangles_of, edges_of, edges) = mixed, cases
    cells_z = first_of.shape[2]
    shift = 1 if closed else 0
    for x in range(start, stop):
        t = offsets[x, 2]
        last = offsets[x + 1, 0] if x + 1 < len(offsets) else len(cells)
        for c in range(offsets[x, 0], last):
            y, z = cells[c] // cells_z, cells[c] % cells_z
            code = codes_of[c]
            if not _is_real(x, y, z, shape, closed):
                continue
            cap, number = 0, 0
            for axis in range(3):
                at = (x, y, z)[axis] - shift
                if at < 0 or at > shape[axis] - 2:
                    cap |= 1 << axis
                number = number * shape[axis] + min(max(at, 0), shape[axis] - 2)
            for i in range(triangles_of[code]):
                for k in range(3):
                    edge = edges_of[code, i, k]
                    corner, axis = edges[edge, 0], edge // 4
                    packed = first_of[x + (corner & 1), y + (corner >> 1 & 1), z + (corner >> 2 & 1)]
                    out[t, k] = packed // 8 + _bit_count(packed & 7 & ((1 << axis) - 1))
                owners[t], caps[t] = number, cap
                t += 1


@loop
def edges_of_cells(corners, virtual, codes, cases, keys, pairs):
    """Fill `keys` and `pairs`: the edges on which corners of triangles lie, cell by cell.

    Args:
        corners: (C, 8) int32, the rows of each cell's corners in a table of points; cells are in any order.
        virtual: (C,) uint8, a bit for each corner that lies beyond the lattice, next to the point in `corners`.
        codes: (C,) uint8, the case of each cell.
        cases: `Cases`.
        keys: (3 T,) to be filled, T triangles: a number for each edge, the same in all cells that share the edge.
        pairs: (3 T, 2) to be filled: the rows of the edge's ends; twice the same row if one end is virtual.
    """
    n, (triangles_of, edges_of, edges) = 0, cases
    for c in range(len(codes)):
        for i in range(triangles_of[codes[c]]):
            for k in range(3):
                edge = edges_of[codes[c], i, k]
                a, b, axis = edges[edge, 0], edges[edge, 1], edge // 4
                row_a, row_b = corners[c, a], corners[c, b]
                if virtual[c] >> a & 1:
                    keys[n], row_a = 9 * np.int64(row_b) + 3 + axis, row_b
                elif virtual[c] >> b & 1:
                    keys[n], row_b = 9 * np.int64(row_a) + 6 + axis, row_a
                else:
                    keys[n] = 9 * np.int64(row_a) + axis
                pairs[n, 0], pairs[n, 1] = row_a, row_b
                n += 1
