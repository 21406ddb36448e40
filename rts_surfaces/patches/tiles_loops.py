"""The triangles of tiles that are cut, compiled.

Tiles, their tables and their local coordinates are those of `rts_surfaces.patches.tiles.Tiles`. It imports numba.
"""

from __future__ import annotations

from rts.plugin_api.loops import compiled, loop

# ------------------------------------------------------------------------------------------ points and counts


@loop
def within_edges(owner, starts, ends, edges, edge_first, patch, params):
    """Write the points within edges, ends excluded, to their rows of `patch` (V,) and `params` (V, 2).

    Args:
        owner: (E,) int32, the patch on which each edge is evaluated.
        starts: (E, 2) float64, the patch's parameters at the start of the edge.
        ends: (E, 2) float64, at its end.
        edges: (E,) int32, into how many pieces each edge is cut.
        edge_first: (E + 1,) int32, the row of the first of the points within each edge.
        patch: (V,) int32, written in these rows alone.
        params: (V, 2) float64, written in these rows alone.
    """
    for e in range(len(edges)):
        for k in range(1, edges[e]):
            v, x = edge_first[e] + k - 1, k / edges[e]
            patch[v] = owner[e]
            for c in range(2):
                params[v, c] = starts[e, c] + x * (ends[e, c] - starts[e, c])


@compiled
def _put(frame, s, t, out):
    for c in range(2):
        out[c] = frame[0, c] + s * frame[1, c] + t * frame[2, c]


@loop
def within_quadrilaterals(owner, frames, inner, inner_first, patch, params):
    """Write the points within tiles, border excluded, to `patch` (V,) int32 and `params` (V, 2) float64.

    Points of tile n have the rows from `inner_first[n]` on; t changes fastest. Other rows stay. Arguments are those of
    `quadrilaterals`.
    """
    for n in range(len(inner)):
        v, rs, rt = inner_first[n], inner[n, 0], inner[n, 1]
        for i in range(1, rs):
            for j in range(1, rt):
                patch[v] = owner[n]
                _put(frames[n], i / rs, j / rt, params[v])
                v += 1


@loop
def within_triangles(owner, frames, inner, inner_first, patch, params):
    """As `within_quadrilaterals`, of triangular tiles, cut into `inner[n, 0]` along each side; s changes fastest."""
    for n in range(len(inner)):
        v, r = inner_first[n], inner[n, 0]
        for j in range(1, r):
            for i in range(1, r - j):
                patch[v] = owner[n]
                _put(frames[n], i / r, j / r, params[v])
                v += 1


@compiled
def _count(rates, sides, edges):
    """The number of triangles of a tile with these rates (2,); its sides (k,) are numbers of edges.

    `edges` (E,) are the rates of all edges. A tile whose first rate is 1 must have edges of rate 1.
    """
    width, rs, rt = len(sides), rates[0], rates[1]
    if rs == 1:
        return width - 2
    total = 2 * (rs - 2) * (rt - 2) if width == 4 else (rs - 3) * (rs - 3)
    for s in range(width):
        total += edges[sides[s]] + ((rs if s % 2 == 0 else rt) - 2 if width == 4 else rs - 3)
    return total


@loop
def counted(inner, sides, edges):
    """The total number of triangles of n tiles with k sides.

    `inner` (n, 2) and `edges` (E,) are rates as in `tile_triangles.triangles`; `sides` (n, k) are indices into `edges`.
    """
    total = 0
    for n in range(len(inner)):
        total += _count(inner[n], sides[n], edges)
    return total


@loop
def counts(inner, sides, edges, first):
    """Fill `first` (n + 1,): the index of the first triangle of each tile, and last the number of all triangles.

    Other arguments are those of `counted`.
    """
    first[0] = 0
    for n in range(len(inner)):
        first[n + 1] = first[n] + _count(inner[n], sides[n], edges)


# ------------------------------------------------------------------------------------------------- triangles


@compiled
def _set(faces, params, t, place, vertex, frame, x, y):
    faces[t, place] = vertex
    for c in range(2):
        params[t, place, c] = frame[0, c] + x * frame[1, c] + y * frame[2, c]


@compiled
def _outer(faces, params, t, place, n, side, k, cuts, frame, corners, flips, base):
    """Set corner `place` of triangle t, in `faces` and `params`, to point k of a side of tile n.

    Points count around the tile: 0 is corner `side`, `cuts` is the next corner. `frame` (3, 2) is the tile's, `corners`
    and `flips` (n, width) are those of all tiles, and `base` is the first vertex within the side's edge.
    """
    width = corners.shape[1]
    if k == 0 or k == cuts:
        vertex = corners[n, side if k == 0 else (side + 1) % width]
    else:
        vertex = base + (cuts - k if flips[n, side] else k) - 1
    z = k / cuts
    if width == 3:
        x, y = (z, 0.0) if side == 0 else (1 - z, z) if side == 1 else (0.0, 1 - z)
    else:
        x, y = (z, 0.0) if side == 0 else (1.0, z) if side == 1 else (1 - z, 1.0) if side == 2 else (0.0, 1 - z)
    _set(faces, params, t, place, vertex, frame, x, y)


@compiled
def _square_point(faces, params, t, place, i, j, rs, rt, frame, base):
    _set(faces, params, t, place, base + (i - 1) * (rt - 1) + j - 1, frame, i / rs, j / rt)


@compiled
def _square(faces, params, t, i, j, rs, rt, frame, base):
    """Set both triangles, t and t + 1, of a cell between points within a tile. Returns t + 2.

    The cell's lowest point is (i, j), counted along s and t from (1, 1); border points of the tile have 0, rs or rt.
    `base` is the first of the vertices within the tile.
    """
    for half in range(2):
        for k in range(3):
            # (0, 0), (1, 0), (1, 1) and (1, 1), (0, 1), (0, 0) of the cell.
            c = (k + 2 * half) % 4
            x, y = i + (1 if c == 1 or c == 2 else 0), j + (1 if c >= 2 else 0)
            _square_point(faces, params, t + half, k, x, y, rs, rt, frame, base)
    return t + 2


@compiled
def _square_ring(faces, params, t, place, side, m, rs, rt, frame, base):
    """Set corner `place` of triangle t to point m of those within a tile that lie next to a side.

    Along the side, in its direction around the tile, m counts from 1. `base` is the first vertex within the tile.
    """
    i = m if side == 0 else rs - 1 if side == 1 else rs - m if side == 2 else 1
    j = 1 if side == 0 else m if side == 1 else rt - 1 if side == 2 else rt - m
    _square_point(faces, params, t, place, i, j, rs, rt, frame, base)


@loop
def quadrilaterals(
    start, stop, owner, frames, corners, sides, flips, edges, edge_first, inner, inner_first, first, out
):
    """Write the triangles of quadrilateral tiles `start` to before `stop`; two for a tile whose rates are 1.

    Args:
        start: first tile.
        stop: one after the last.
        owner: (n,) int32, the patch of each tile.
        frames: (n, 3, 2) float64, as in `Tiles`.
        corners: (n, 4) int32, as in `Tiles`.
        sides: (n, 4) int32, as in `Tiles`.
        flips: (n, 4) bool, as in `Tiles`.
        edges: (E,) int32, into how many pieces each edge is cut.
        edge_first: (E + 1,) int32, the first of the vertices within each edge.
        inner: (n, 2) int32, into how many pieces each tile is cut along s and t.
        inner_first: (n + 1,) int32, the first of the vertices within each tile.
        first: (n + 1,) int32, the first triangle of each tile.
        out: the arrays to be filled: faces (T, 3) int32, ids (T, 1) int32, params (T, 3, 2) float32, see `Proxy`.
    """
    faces, ids, params = out
    for n in range(start, stop):
        rs, rt, t, base, frame = inner[n, 0], inner[n, 1], first[n], inner_first[n], frames[n]
        ids[t : first[n + 1], 0] = owner[n]
        if rs == 1:
            for half in range(2):
                for k in range(3):
                    _outer(faces, params, t + half, k, n, (k + 2 * half) % 4, 0, 1, frame, corners, flips, 0)
            continue
        for i in range(1, rs - 1):
            for j in range(1, rt - 1):
                t = _square(faces, params, t, i, j, rs, rt, frame, base)
        for side in range(4):
            e, count = sides[n, side], rs if side % 2 == 0 else rt
            cuts = edges[e]
            # Points of the side, 0 to `cuts`, and those of the ring within, 1 to `count` − 1; the nearer goes on.
            k, m = 0, 1
            while k < cuts or m < count - 1:
                outward = m == count - 1 or (k < cuts and (k + 1) * count * 2 <= (2 * m + 1) * cuts)
                _outer(faces, params, t, 0, n, side, k, cuts, frame, corners, flips, edge_first[e])
                if outward:
                    _outer(faces, params, t, 1, n, side, k + 1, cuts, frame, corners, flips, edge_first[e])
                    k += 1
                else:
                    _square_ring(faces, params, t, 1, side, m + 1, rs, rt, frame, base)
                _square_ring(faces, params, t, 2, side, m, rs, rt, frame, base)
                if not outward:
                    m += 1
                t += 1


@compiled
def _triangle_point(faces, params, t, place, i, j, r, frame, base):
    row = (j - 1) * (r - 1) - (j - 1) * j // 2
    _set(faces, params, t, place, base + row + i - 1, frame, i / r, j / r)


@compiled
def _triangle_ring(faces, params, t, place, side, m, r, frame, base):
    """As `_square_ring`, of a triangular tile with r pieces a side; m is from 1 to r − 2."""
    i = m if side == 0 else r - 1 - m if side == 1 else 1
    j = 1 if side == 0 else m if side == 1 else r - 1 - m
    _triangle_point(faces, params, t, place, i, j, r, frame, base)


@loop
def triangles(start, stop, owner, frames, corners, sides, flips, edges, edge_first, inner, inner_first, first, out):
    """Write the triangles of triangular tiles; arguments as for `quadrilaterals`, but (n, 3) corners, sides, flips.

    Of `inner` the first column alone is used.
    """
    faces, ids, params = out
    for n in range(start, stop):
        r, t, base, frame = inner[n, 0], first[n], inner_first[n], frames[n]
        ids[t : first[n + 1], 0] = owner[n]
        if r == 1:
            for k in range(3):
                _outer(faces, params, t, k, n, k, 0, 1, frame, corners, flips, 0)
            continue
        for j in range(1, r - 2):
            for i in range(1, r - 1 - j):
                _triangle_point(faces, params, t, 0, i, j, r, frame, base)
                _triangle_point(faces, params, t, 1, i + 1, j, r, frame, base)
                _triangle_point(faces, params, t, 2, i, j + 1, r, frame, base)
                t += 1
                if i + j < r - 2:
                    _triangle_point(faces, params, t, 0, i + 1, j, r, frame, base)
                    _triangle_point(faces, params, t, 1, i + 1, j + 1, r, frame, base)
                    _triangle_point(faces, params, t, 2, i, j + 1, r, frame, base)
                    t += 1
        for side in range(3):
            cuts = edges[sides[n, side]]
            base_edge = edge_first[sides[n, side]]
            # The ring's point m lies at (m + 1/2) / r along the side; there are r − 2.
            k, m = 0, 1
            while k < cuts or m < r - 2:
                outward = m == r - 2 or (k < cuts and (k + 1) * r <= (m + 1) * cuts)
                _outer(faces, params, t, 0, n, side, k, cuts, frame, corners, flips, base_edge)
                if outward:
                    _outer(faces, params, t, 1, n, side, k + 1, cuts, frame, corners, flips, base_edge)
                    k += 1
                else:
                    _triangle_ring(faces, params, t, 1, side, m + 1, r, frame, base)
                _triangle_ring(faces, params, t, 2, side, m, r, frame, base)
                if not outward:
                    m += 1
                t += 1
