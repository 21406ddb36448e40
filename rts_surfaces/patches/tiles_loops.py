"""The triangles of tiles that are cut, compiled.

Tiles, their tables and their local coordinates are those of `rts_surfaces.patches.tiles.Tiles`. It imports numba.
"""

from __future__ import annotations

import numpy as np

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
def _set(faces, params, t, frame, points):
    """Set the corners of triangle t: three points, each a vertex and its local coordinates in a tile's `frame`."""
    for k in range(3):
        vertex, x, y = points[k]
        faces[t, k] = vertex
        for c in range(2):
            params[t, k, c] = frame[0, c] + x * frame[1, c] + y * frame[2, c]


@compiled
def _outer(corners, flips, n, side, k, cuts, base):
    """Point k of a side of tile n.

    Points count around the tile: 0 is corner `side`, `cuts` is the next corner. `corners` and `flips` (n, width) are
    those of all tiles, and `base` is the first vertex within the side's edge.
    """
    width = corners.shape[1]
    if k == 0 or k == cuts:
        vertex = np.int64(corners[n, side if k == 0 else (side + 1) % width])
    else:
        vertex = np.int64(base + (cuts - k if flips[n, side] else k) - 1)
    z = k / cuts
    if width == 3:
        x, y = (z, 0.0) if side == 0 else (1 - z, z) if side == 1 else (0.0, 1 - z)
    else:
        x, y = (z, 0.0) if side == 0 else (1.0, z) if side == 1 else (1 - z, 1.0) if side == 2 else (0.0, 1 - z)
    return vertex, x, y


@compiled
def _square_point(i, j, rs, rt, base):
    return np.int64(base + (i - 1) * (rt - 1) + j - 1), i / rs, j / rt


@compiled
def _square_ring(side, m, rs, rt, base):
    """Point m of those within a tile that lie next to a side.

    Along the side, in its direction around the tile, m counts from 1. `base` is the first vertex within the tile.
    """
    i = m if side == 0 else rs - 1 if side == 1 else rs - m if side == 2 else 1
    j = 1 if side == 0 else m if side == 1 else rt - 1 if side == 2 else rt - m
    return _square_point(i, j, rs, rt, base)


@loop
def quadrilaterals(start, stop, tiles, cut, out):
    """Write the triangles of quadrilateral tiles `start` to before `stop`; two for a tile whose rates are 1.

    Args:
        start: first tile.
        stop: one after the last.
        tiles: `Tiles`.
        cut: `tile_triangles.Cut`.
        out: the arrays to be filled: faces (T, 3) int32, ids (T, 1) int32, params (T, 3, 2) float32, see `Proxy`.
    """
    (faces, ids, params), corners, sides, flips = out, tiles.corners, tiles.sides, tiles.flips
    edges, edge_first, inner, inner_first, first = cut
    for n in range(start, stop):
        rs, rt, t, base, frame = inner[n, 0], inner[n, 1], first[n], inner_first[n], tiles.frames[n]
        ids[t : first[n + 1], 0] = tiles.patch[n]
        if rs == 1:
            a, c = _outer(corners, flips, n, 0, 0, 1, 0), _outer(corners, flips, n, 2, 0, 1, 0)
            _set(faces, params, t, frame, (a, _outer(corners, flips, n, 1, 0, 1, 0), c))
            _set(faces, params, t + 1, frame, (c, _outer(corners, flips, n, 3, 0, 1, 0), a))
            continue
        for i in range(1, rs - 1):
            for j in range(1, rt - 1):
                a, c = _square_point(i, j, rs, rt, base), _square_point(i + 1, j + 1, rs, rt, base)
                _set(faces, params, t, frame, (a, _square_point(i + 1, j, rs, rt, base), c))
                _set(faces, params, t + 1, frame, (c, _square_point(i, j + 1, rs, rt, base), a))
                t += 2
        for side in range(4):
            e, count = sides[n, side], rs if side % 2 == 0 else rt
            cuts = edges[e]
            # Points of the side, 0 to `cuts`, and those of the ring within, 1 to `count` − 1; the nearer goes on.
            k, m = 0, 1
            while k < cuts or m < count - 1:
                outward = m == count - 1 or (k < cuts and (k + 1) * count * 2 <= (2 * m + 1) * cuts)
                here, beside = (
                    _outer(corners, flips, n, side, k, cuts, edge_first[e]),
                    _square_ring(side, m, rs, rt, base),
                )
                if outward:
                    k += 1
                    ahead = _outer(corners, flips, n, side, k, cuts, edge_first[e])
                else:
                    m += 1
                    ahead = _square_ring(side, m, rs, rt, base)
                _set(faces, params, t, frame, (here, ahead, beside))
                t += 1


@compiled
def _triangle_point(i, j, r, base):
    return np.int64(base + (j - 1) * (r - 1) - (j - 1) * j // 2 + i - 1), i / r, j / r


@compiled
def _triangle_ring(side, m, r, base):
    """As `_square_ring`, of a triangular tile with r pieces a side; m is from 1 to r − 2."""
    i = m if side == 0 else r - 1 - m if side == 1 else 1
    j = 1 if side == 0 else m if side == 1 else r - 1 - m
    return _triangle_point(i, j, r, base)


@loop
def triangles(start, stop, tiles, cut, out):
    """Write the triangles of triangular tiles; arguments as for `quadrilaterals`.

    Of `inner` the first column alone is used.
    """
    (faces, ids, params), corners, sides, flips = out, tiles.corners, tiles.sides, tiles.flips
    edges, edge_first, inner, inner_first, first = cut
    for n in range(start, stop):
        r, t, base, frame = inner[n, 0], first[n], inner_first[n], tiles.frames[n]
        ids[t : first[n + 1], 0] = tiles.patch[n]
        if r == 1:
            a, b = _outer(corners, flips, n, 0, 0, 1, 0), _outer(corners, flips, n, 1, 0, 1, 0)
            _set(faces, params, t, frame, (a, b, _outer(corners, flips, n, 2, 0, 1, 0)))
            continue
        for j in range(1, r - 2):
            for i in range(1, r - 1 - j):
                b, c = _triangle_point(i + 1, j, r, base), _triangle_point(i, j + 1, r, base)
                _set(faces, params, t, frame, (_triangle_point(i, j, r, base), b, c))
                t += 1
                if i + j < r - 2:
                    _set(faces, params, t, frame, (b, _triangle_point(i + 1, j + 1, r, base), c))
                    t += 1
        for side in range(3):
            cuts = edges[sides[n, side]]
            base_edge = edge_first[sides[n, side]]
            # The ring's point m lies at (m + 1/2) / r along the side; there are r − 2.
            k, m = 0, 1
            while k < cuts or m < r - 2:
                outward = m == r - 2 or (k < cuts and (k + 1) * r <= (m + 1) * cuts)
                here, beside = _outer(corners, flips, n, side, k, cuts, base_edge), _triangle_ring(side, m, r, base)
                if outward:
                    k += 1
                    ahead = _outer(corners, flips, n, side, k, cuts, base_edge)
                else:
                    m += 1
                    ahead = _triangle_ring(side, m, r, base)
                _set(faces, params, t, frame, (here, ahead, beside))
                t += 1
