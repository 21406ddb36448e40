"""Rates at which tiles are cut, from their shapes and from where outlines may be. Compiled.

Tiles, their tables and their local coordinates are those of `rts_surfaces.patches.tiles.Tiles`. It imports numba.
"""

from __future__ import annotations

import math

import numpy as np

from rts.plugin_api.loops import compiled, loop
from rts_surfaces.patches.tiles import MOST

COLLAPSED = 1e-6
"""Derivatives along s and t have no normal if the sine of their angle is at most this."""


@compiled
def _dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


# ---------------------------------------------------------------------------------------------------- shapes


@compiled
def _slopes(found, frame, slopes):
    """Fill `slopes` (2, 3) with derivatives in s and in t, for a tile's `frame` (3, 2).

    `found` (6, 3) are a point of the tile and its derivatives in u, v, uu, uv and vv.
    """
    for k in range(2):
        for c in range(3):
            slopes[k, c] = frame[1 + k, 0] * found[1, c] + frame[1 + k, 1] * found[2, c]


@compiled
def _second(found, a, b, c):
    """Coordinate c, 0 to 2, of the second derivative along a (2,) and b (2,), directions in (u, v).

    `found` (6, 3) as in `_slopes`.
    """
    return a[0] * b[0] * found[3, c] + (a[0] * b[1] + a[1] * b[0]) * found[4, c] + a[1] * b[1] * found[5, c]


@compiled
def _normal(slopes, out):
    """Fill `out` (3,) with the unit normal to `slopes` (2, 3). If there is none, see `COLLAPSED`, fill zeros.

    Returns True if there is one.
    """
    for c in range(3):
        x, y = (c + 1) % 3, (c + 2) % 3
        out[c] = slopes[0, x] * slopes[1, y] - slopes[0, y] * slopes[1, x]
    length = math.sqrt(_dot(out, out))
    there = length > COLLAPSED * math.sqrt(_dot(slopes[0], slopes[0]) * _dot(slopes[1], slopes[1])) and length > 0
    for c in range(3):
        out[c] = out[c] / length if there else 0.0
    return there


@loop
def shapes(start, stop, found, frames, normals, places, bends):
    """Fill normals, places and bends of tiles `start` to before `stop`.

    Args:
        start: first tile.
        stop: one after the last.
        found: (n, G G, 6, 3) float64, on a grid of G points a side: the point, and its derivatives in u, v, uu, uv and
            vv, the parameters of the patch.
        frames: (n, 3, 2) float64, as in `Tiles`.
        normals: (n, G, G, 3) to be filled, of unit length, or zero where there is none.
        places: (n, G, G, 3) to be filled with the points of the grid.
        bends: (n, 3) to be filled with the largest absolute second derivatives along the normal: in s, in s and t, in
            t; where there is no normal, their lengths. Triangles leave the surface by these components alone; the
            others move points within it.
    """
    grid, slopes = normals.shape[1], np.empty((2, 3))
    for n in range(start, stop):
        frame = frames[n]
        bends[n] = 0
        for k in range(grid * grid):
            normal = normals[n, k // grid, k % grid]
            _slopes(found[n, k], frame, slopes)
            there = _normal(slopes, normal)
            for c in range(3):
                places[n, k // grid, k % grid, c] = found[n, k, 0, c]
            for m in range(3):
                a, b = frame[1 if m < 2 else 2], frame[1 if m < 1 else 2]
                size, straight = 0.0, 0.0
                for c in range(3):
                    x = _second(found[n, k], a, b, c)
                    size, straight = size + x * x, straight + x * normal[c]
                bends[n, m] = max(bends[n, m], abs(straight) if there else math.sqrt(size))


@loop
def curves(start, stop, found, frames, along, out):
    """Fill `out` (E,): the largest part, at right angles to the edge, of second derivatives along each edge.

    Args:
        start: first edge.
        stop: one after the last.
        found: (E, G, 6, 3) float64, at G points along each edge: the point, and its derivatives in u, v, uu, uv and vv,
            the parameters of the patch of a tile beside the edge.
        frames: (E, 3, 2) float64, the frame of that tile.
        along: (E, 2) float64, the direction of the edge in the tile's local coordinates.
        out: (E,) float64.
    """
    tangent, bend, way = np.empty(3), np.empty(3), np.empty(2)
    for e in range(start, stop):
        for i in range(2):
            way[i] = along[e, 0] * frames[e, 1, i] + along[e, 1] * frames[e, 2, i]
        out[e] = 0
        for k in range(found.shape[1]):
            for c in range(3):
                tangent[c] = way[0] * found[e, k, 1, c] + way[1] * found[e, k, 2, c]
                bend[c] = _second(found[e, k], way, way, c)
            square, across_squared = _dot(tangent, tangent), _dot(bend, bend)
            if square > 0:
                across_squared -= _dot(tangent, bend) ** 2 / square
            out[e] = max(out[e], math.sqrt(max(across_squared, 0.0)))


# ----------------------------------------------------------------------------------------------- how fine


@loop
def outlines(start, stop, shapes, view, cone, wanted, allowed):
    """Fill `allowed`: allowed distances of triangles from the surface, in units of space.

    Out of a perspective view distances are infinite, and `facing` is 0. No distance is below 1e-4 of the tile's radius.

    Args:
        start: first tile.
        stop: one after the last.
        shapes: `tile_triangles.Shapes`.
        view: `view_cells.ViewCell`.
        cone: sine and cosine of the view's angle; not used where rays are parallel.
        wanted: (2,), the allowed distance in pixels where a tile may have an outline, and elsewhere.
        allowed: `tile_triangles.Allowed`.
    """
    (normals, places, bends, _), (chord, edge, facing), (sine, cosine) = shapes, allowed, cone
    eye, parallel, aside, depth, toward, spread, axis, _ = view
    grid, move = places.shape[1], aside + depth
    faces, way, middle = np.empty((grid, grid)), np.empty(3), np.empty(3)
    for t in range(start, stop):
        for c in range(3):
            middle[c] = places[t, :, :, c].mean()
        radius = 0.0
        for i in range(grid):
            for j in range(grid):
                for c in range(3):
                    way[c] = places[t, i, j, c] - middle[c]
                radius = max(radius, _dot(way, way))
        # Between points of the grid the surface bulges by less than over the whole tile.
        radius = math.sqrt(radius) + (bends[t, 0] + 2 * bends[t, 1] + bends[t, 2]) / 8
        nearest = np.inf
        if not parallel:
            for c in range(3):
                way[c] = middle[c] - eye[c]
            distance = math.sqrt(_dot(way, way))
            if distance > radius + move:
                along = _dot(way, axis)
                across = math.sqrt(max(distance * distance - along * along, 0.0))
                # Out of the cone by more than its own size, and that of the cell of views.
                if across * cosine - along * sine > radius + move:
                    chord[t], edge[t], facing[t] = np.inf, np.inf, 0
                    continue
        least, most, jump = np.inf, -np.inf, 0.0
        for i in range(grid):
            for j in range(grid):
                far, slack = 1.0, aside
                for c in range(3):
                    way[c] = eye[c] if parallel else eye[c] - places[t, i, j, c]
                if not parallel:
                    far = math.sqrt(_dot(way, way))
                    nearest = min(nearest, far - move)
                    # Movement along the line of sight does not turn it.
                    ahead = _dot(way, toward)
                    slack += depth * math.sqrt(max(far * far - ahead * ahead, 0.0)) / far if far > 0 else depth
                faces[i, j] = _dot(normals[t, i, j], way) / far if far > 0 else 0.0
                slack = 1.0 if far <= move and not parallel else min(1.0, slack / far)
                least, most = min(least, faces[i, j] - slack), max(most, faces[i, j] + slack)
        for i in range(grid):
            for j in range(grid - 1):
                jump = max(jump, abs(faces[i, j] - faces[i, j + 1]), abs(faces[j, i] - faces[j + 1, i]))
        facing[t] = 1 if least - 0.25 * jump > 0 else -1 if most + 0.25 * jump < 0 else 0
        width = spread[0] if parallel else abs(spread[1] * max(nearest, 0.0))
        # The eye may be at the tile: then as fine as its size asks for.
        edge[t] = max(width * wanted[0], 1e-4 * radius)
        chord[t] = edge[t] if facing[t] == 0 else max(width * wanted[1], 1e-4 * radius)


@loop
def rates(shapes, allowed, sides, least, inner, edges):
    """Fill the numbers of pieces into which tiles and edges are cut: inner (n, 2) along s and t, edges (E,).

    All are 1 to `MOST`. Tiles out of view have 1, or `least` if a neighbour cuts one of their edges.

    Args:
        shapes: `tile_triangles.Shapes`.
        allowed: `tile_triangles.Allowed`.
        sides: (n, k) int32, the edge of each side.
        least: the least rate within a tile that is cut.
        inner: (n, 2) int32, to be filled.
        edges: (E,) int32, to be filled.
    """
    bends, curvature, (chord, edge, facing) = shapes.bends, shapes.curves, allowed
    fine, finest, width = np.full(len(edges), np.inf), np.full(len(edges), np.inf), sides.shape[1]
    beside, front, back = np.zeros(len(edges), np.int32), np.zeros(len(edges), np.bool_), np.zeros(len(edges), np.bool_)
    for t in range(len(bends)):
        for s in range(width):
            e = sides[t, s]
            fine[e], finest[e] = min(fine[e], chord[t]), min(finest[e], edge[t])
            beside[e] += 1
            front[e] |= facing[t] > 0
            back[e] |= facing[t] < 0
    for e in range(len(edges)):
        # Where the surface ends, and at creases between front and back, the edge itself is an outline.
        if beside[e] == 1 or (front[e] and back[e]):
            fine[e] = min(fine[e], finest[e])
        edges[e] = 1
        if fine[e] < np.inf and curvature[e] > 0:
            edges[e] = int(min(MOST, max(1.0, math.ceil(math.sqrt(curvature[e] / (8 * fine[e]))))))
    for t in range(len(bends)):
        allowed = chord[t]
        ru, rv = 1.0, 1.0
        if allowed < np.inf:
            uu, uv, vv = bends[t, 0], bends[t, 1], bends[t, 2]
            ru, rv = max(1.0, math.sqrt(uu / (4 * allowed))), max(1.0, math.sqrt(vv / (4 * allowed)))
            # The error of a triangle's chord (Filip, Magedson, Markot 1986).
            error = (uu / (ru * ru) + 2 * uv / (ru * rv) + vv / (rv * rv)) / 8
            if error > allowed:
                grow = math.sqrt(error / allowed)
                ru, rv = ru * grow, rv * grow
        if width == 3:
            ru = rv = max(ru, rv)
        inner[t, 0], inner[t, 1] = int(min(MOST, math.ceil(ru))), int(min(MOST, math.ceil(rv)))
        for s in range(width):
            # Cut alike, a side and what lies within make no long triangles.
            if chord[t] <= fine[sides[t, s]] and allowed < np.inf:
                edges[sides[t, s]] = max(edges[sides[t, s]], inner[t, s % 2])
    for t in range(len(bends)):
        cut = inner[t, 0] > 1 or inner[t, 1] > 1
        for s in range(width):
            cut |= edges[sides[t, s]] > 1
        if cut:
            inner[t, 0], inner[t, 1] = max(inner[t, 0], least), max(inner[t, 1], least)
