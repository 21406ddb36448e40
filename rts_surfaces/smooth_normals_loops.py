"""Smooth normals at samples and their derivatives, as compiled loops for arrays on the host.

Only vertices that samples name have a normal. Each has a row of tables that are in float64: `row_of` (V,) tells which,
counted from 1, and 0 for others. A vertex without area around it has the normal 0 and the length 1, so that its
derivative is that of the sum, as `rts.plugin_api.arrays.unit` has it. One whose faces nearly cancel has the normal 0
and an infinite length, so that nothing depends on the sum; `_add_own` and its derivatives put the normals of samples'
own triangles in its place. Sums are added up in the order of the faces.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rts import InputError
from rts.plugin_api.loops import compiled, loop
from rts.plugin_api.threads import parallel


class VertexNormals(NamedTuple):
    """Normals of the vertices that samples name.

    Attributes:
        row_of: (V,) int32, the row of each vertex in the other tables, from 1 on, or 0.
        unit: (U, 3) float64, the normals.
        length: (U,) float64, of the sums of twice the areas around, or 1 where there are none, infinite where they
            cancel.
        cancelled: whether any do.
    """

    row_of: np.ndarray
    unit: np.ndarray
    length: np.ndarray
    cancelled: bool


def forward(
    vertices: np.ndarray, params: np.ndarray, ids: np.ndarray, faces: np.ndarray, out: np.ndarray, *, least: float
) -> VertexNormals:
    """Fill `out` (N, 3) with interpolated normals. An InputError if an id names no vertex.

    Sums cancel if they are shorter than `least` times what they add up, here and below.
    """
    normals = _normals(vertices, ids, faces, least)
    _interpolate_all(normals, normals.unit, params, ids, out, False)
    if normals.cancelled:
        _add_own(vertices, params, ids, normals.row_of, normals.length, False, out)
    return normals


def push(
    vertices: np.ndarray,
    params: np.ndarray,
    ids: np.ndarray,
    faces: np.ndarray,
    t_vertices: np.ndarray | None,
    t_params: np.ndarray | None,
    out: np.ndarray,
    kept: VertexNormals | None,
    *,
    least: float,
) -> None:
    """Fill `out` (N, 3) with the derivative along `t_vertices` (V, 3) and `t_params` (N, 2), each None if zero."""
    normals = kept or _normals(vertices, ids, faces, least)
    out[...] = 0
    if t_vertices is not None:
        moved = np.zeros_like(normals.unit)
        _add_moved(vertices, t_vertices, faces, normals.row_of, moved)
        _turn(normals.unit, normals.length, moved)
        _interpolate_all(normals, moved, params, ids, out, False)
        if normals.cancelled:
            _add_own_moved(vertices, t_vertices, params, ids, normals.row_of, normals.length, out)
    if t_params is not None:
        _interpolate_all(normals, normals.unit, t_params, ids, out, True)
        if normals.cancelled:
            _add_own(vertices, t_params, ids, normals.row_of, normals.length, True, out)


def pull(
    vertices: np.ndarray,
    params: np.ndarray,
    ids: np.ndarray,
    faces: np.ndarray,
    g: np.ndarray,
    g_vertices: np.ndarray | None,
    g_params: np.ndarray | None,
    kept: VertexNormals | None,
    *,
    least: float,
) -> None:
    """Pull back the gradient `g` (N, 3): add to `g_vertices` (V, 3), fill `g_params` (N, 2), unless None."""
    normals = kept or _normals(vertices, ids, faces, least)
    if g_vertices is not None:
        sums = np.zeros_like(normals.unit)
        _scatter(normals.row_of, params, ids, g, sums)
        _turn(normals.unit, normals.length, sums)
        _pull_faces(vertices, faces, normals.row_of, sums, g_vertices)
        if normals.cancelled:
            _pull_own(vertices, params, ids, normals.row_of, normals.length, g, g_vertices)
    if g_params is not None:
        parallel(_weigh, len(ids), normals.row_of, normals.unit, ids, g, g_params, work=10 * len(ids))
        if normals.cancelled:
            _weigh_own(vertices, ids, normals.row_of, normals.length, g, g_params)


def _normals(vertices: np.ndarray, ids: np.ndarray, faces: np.ndarray, least: float) -> VertexNormals:
    """The normals of the vertices that `ids` name. An InputError if an id, or a face, names no vertex."""
    row_of = np.zeros(len(vertices), np.int32)
    count = _number(ids, row_of)
    unit, length = np.zeros((max(count, 0), 3)), np.zeros(max(count, 0))
    if count < 0 or not _add_faces(vertices, faces, row_of, unit, length):
        raise InputError(f"samples or faces refer to vertices that are not among {len(vertices)}; sample the mesh anew")
    return VertexNormals(row_of, unit, length, _normalize(unit, length, least))


def _interpolate_all(
    normals: VertexNormals, rows: np.ndarray, params: np.ndarray, ids: np.ndarray, out: np.ndarray, moved: bool
) -> None:
    """Fill `out` (N, 3) by interpolation of `rows` (U, 3); if weights are `moved`, add what `params` (N, 2) add."""
    parallel(_interpolate, len(ids), normals.row_of, rows, params, ids, moved, out, work=12 * len(ids))


@loop
def _number(ids, row_of):
    """Number in `row_of` (V,) the vertices that the first three `ids` (N, I) name; their count, −1 if one is none."""
    count = 0
    for n in range(len(ids)):
        for k in range(3):
            v = ids[n, k]
            if v < 0 or v >= len(row_of):
                return -1
            if row_of[v] == 0:
                count += 1
                row_of[v] = count
    return count


@compiled
def _sides(vertices, a, b, c):
    """The two sides from a vertex, components as float64."""
    ux = np.float64(vertices[b, 0]) - vertices[a, 0]
    uy = np.float64(vertices[b, 1]) - vertices[a, 1]
    uz = np.float64(vertices[b, 2]) - vertices[a, 2]
    vx = np.float64(vertices[c, 0]) - vertices[a, 0]
    vy = np.float64(vertices[c, 1]) - vertices[a, 1]
    vz = np.float64(vertices[c, 2]) - vertices[a, 2]
    return ux, uy, uz, vx, vy, vz


@compiled
def _add(rows, row, x, y, z):
    """Add to a row of `rows` (U, 3), counted from 1; nothing for 0."""
    if row > 0:
        rows[row - 1, 0] += x
        rows[row - 1, 1] += y
        rows[row - 1, 2] += z


@loop
def _add_faces(vertices, faces, row_of, sums, sizes):
    """Add the faces' normals, twice their areas long, to the `sums` (U, 3) of their vertices; False if one is none.

    Their largest components are added to `sizes` (U,).
    """
    for f in range(len(faces)):
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        if min(a, b, c) < 0 or max(a, b, c) >= len(row_of):
            return False
        i, j, k = row_of[a], row_of[b], row_of[c]
        if i | j | k:
            ux, uy, uz, vx, vy, vz = _sides(vertices, a, b, c)
            x, y, z = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
            size = max(abs(x), abs(y), abs(z))
            for row in (i, j, k):
                if row > 0:
                    _add(sums, row, x, y, z)
                    sizes[row - 1] += size
    return True


@loop
def _add_moved(vertices, t_vertices, faces, row_of, sums):
    """Add the derivatives of the faces' normals along `t_vertices` (V, 3) to the `sums` (U, 3) of their vertices."""
    for f in range(len(faces)):
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        i, j, k = row_of[a], row_of[b], row_of[c]
        if i | j | k:
            ux, uy, uz, vx, vy, vz = _sides(vertices, a, b, c)
            dx, dy, dz, ex, ey, ez = _sides(t_vertices, a, b, c)
            x = dy * vz - dz * vy + uy * ez - uz * ey
            y = dz * vx - dx * vz + uz * ex - ux * ez
            z = dx * vy - dy * vx + ux * ey - uy * ex
            _add(sums, i, x, y, z)
            _add(sums, j, x, y, z)
            _add(sums, k, x, y, z)


@loop
def _normalize(unit, length, least):
    """Scale rows of `unit` (U, 3) to length one, and fill `length` (U,) with what they were, or 1 for zeros.

    `length` holds the sizes of what was added up. Rows that cancel become zeros of infinite length; True if any do.
    """
    cancelled = False
    for r in range(len(unit)):
        largest = max(abs(unit[r, 0]), abs(unit[r, 1]), abs(unit[r, 2]))  # Squares of it may be too small or large.
        if length[r] > 0 and largest <= least * length[r]:
            unit[r], length[r], cancelled = 0.0, np.inf, True
            continue
        scale = largest if largest > 0 else 1.0
        size = np.sqrt((unit[r, 0] / scale) ** 2 + (unit[r, 1] / scale) ** 2 + (unit[r, 2] / scale) ** 2)
        length[r] = size * scale if size > 0 else 1.0
        for i in range(3):
            unit[r, i] /= length[r]
    return cancelled


@loop
def _turn(unit, length, moved):
    """Turn motions of sums, rows of `moved` (U, 3), into those of normals; gradients of normals into those of sums."""
    for r in range(len(unit)):
        along = unit[r, 0] * moved[r, 0] + unit[r, 1] * moved[r, 1] + unit[r, 2] * moved[r, 2]
        for i in range(3):
            moved[r, i] = (moved[r, i] - along * unit[r, i]) / length[r]


@loop
def _interpolate(start, stop, row_of, rows, params, ids, moved, out):
    """Fill rows [start, stop) of `out` (N, 3) by interpolation, or add the change by motions of weights."""
    for n in range(start, stop):
        a, b, c = row_of[ids[n, 0]] - 1, row_of[ids[n, 1]] - 1, row_of[ids[n, 2]] - 1
        u, v = np.float64(params[n, 0]), np.float64(params[n, 1])
        for i in range(3):
            last = rows[c, i]
            change = u * (rows[a, i] - last) + v * (rows[b, i] - last)
            if moved:
                out[n, i] += change
            else:
                out[n, i] = last + change


@loop
def _scatter(row_of, params, ids, g, sums):
    """Add to `sums` (U, 3) the gradients of normals, from `g` (N, 3)."""
    for n in range(len(ids)):
        u, v = np.float64(params[n, 0]), np.float64(params[n, 1])
        x, y, z = np.float64(g[n, 0]), np.float64(g[n, 1]), np.float64(g[n, 2])
        if x != 0 or y != 0 or z != 0:
            w = 1.0 - u - v
            _add(sums, row_of[ids[n, 0]], u * x, u * y, u * z)
            _add(sums, row_of[ids[n, 1]], v * x, v * y, v * z)
            _add(sums, row_of[ids[n, 2]], w * x, w * y, w * z)


@compiled
def _get(rows, row, i):
    """A component of a row of `rows` (U, 3), counted from 1; zero for 0."""
    return rows[row - 1, i] if row > 0 else 0.0


@loop
def _pull_faces(vertices, faces, row_of, sums, g_vertices):
    """Add to `g_vertices` (V, 3) the gradients of faces' vertices, from those of `sums` (U, 3)."""
    for f in range(len(faces)):
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        i, j, k = row_of[a], row_of[b], row_of[c]
        if i | j | k:
            x = _get(sums, i, 0) + _get(sums, j, 0) + _get(sums, k, 0)
            y = _get(sums, i, 1) + _get(sums, j, 1) + _get(sums, k, 1)
            z = _get(sums, i, 2) + _get(sums, j, 2) + _get(sums, k, 2)
            if x == 0 and y == 0 and z == 0:
                continue
            ux, uy, uz, vx, vy, vz = _sides(vertices, a, b, c)
            # Of the normal u × v: gradients v × g of u, and g × u of v.
            bx, by, bz = vy * z - vz * y, vz * x - vx * z, vx * y - vy * x
            cx, cy, cz = y * uz - z * uy, z * ux - x * uz, x * uy - y * ux
            _add(g_vertices, b + 1, bx, by, bz)
            _add(g_vertices, c + 1, cx, cy, cz)
            _add(g_vertices, a + 1, -bx - cx, -by - cy, -bz - cz)


@loop
def _weigh(start, stop, row_of, rows, ids, g, g_params):
    """Fill rows [start, stop) of `g_params` (N, 2) with the gradients of weights, from `g` (N, 3)."""
    for n in range(start, stop):
        a, b, c = row_of[ids[n, 0]] - 1, row_of[ids[n, 1]] - 1, row_of[ids[n, 2]] - 1
        u = v = 0.0
        for i in range(3):
            u += g[n, i] * (rows[a, i] - rows[c, i])
            v += g[n, i] * (rows[b, i] - rows[c, i])
        g_params[n, 0], g_params[n, 1], g_params[n, 2:] = u, v, 0


# ------------------------------------------------------------------------------- triangles' own normals


@compiled
def _own(vertices, ids, n):
    """The unit normal of the triangle of a sample and twice its area, or zeros and 1."""
    ux, uy, uz, vx, vy, vz = _sides(vertices, ids[n, 0], ids[n, 1], ids[n, 2])
    x, y, z = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
    largest = max(abs(x), abs(y), abs(z))
    if not largest > 0:
        return 0.0, 0.0, 0.0, 1.0
    length = largest * np.sqrt((x / largest) ** 2 + (y / largest) ** 2 + (z / largest) ** 2)
    return x / length, y / length, z / length, length


@compiled
def _share(params, ids, n, row_of, length, moved):
    """The sum of the weights of a sample's vertices that cancel; or of the motions of weights, which sum to 0."""
    u, v = np.float64(params[n, 0]), np.float64(params[n, 1])
    share = 0.0
    if length[row_of[ids[n, 0]] - 1] == np.inf:
        share += u
    if length[row_of[ids[n, 1]] - 1] == np.inf:
        share += v
    if length[row_of[ids[n, 2]] - 1] == np.inf:
        share += (0.0 if moved else 1.0) - u - v
    return share


@loop
def _add_own(vertices, params, ids, row_of, length, moved, out):
    """Add to `out` (N, 3) the normals of samples' own triangles, by the weights of vertices that cancel."""
    for n in range(len(ids)):
        share = _share(params, ids, n, row_of, length, moved)
        if share != 0:
            x, y, z, _ = _own(vertices, ids, n)
            out[n, 0] += share * x
            out[n, 1] += share * y
            out[n, 2] += share * z


@loop
def _add_own_moved(vertices, t_vertices, params, ids, row_of, length, out):
    """Add to `out` (N, 3) the derivatives of what `_add_own` adds along `t_vertices` (V, 3)."""
    for n in range(len(ids)):
        share = _share(params, ids, n, row_of, length, False)
        if share != 0:
            x, y, z, size = _own(vertices, ids, n)
            ux, uy, uz, vx, vy, vz = _sides(vertices, ids[n, 0], ids[n, 1], ids[n, 2])
            dx, dy, dz, ex, ey, ez = _sides(t_vertices, ids[n, 0], ids[n, 1], ids[n, 2])
            a = dy * vz - dz * vy + uy * ez - uz * ey
            b = dz * vx - dx * vz + uz * ex - ux * ez
            c = dx * vy - dy * vx + ux * ey - uy * ex
            along = x * a + y * b + z * c
            out[n, 0] += share / size * (a - along * x)
            out[n, 1] += share / size * (b - along * y)
            out[n, 2] += share / size * (c - along * z)


@loop
def _pull_own(vertices, params, ids, row_of, length, g, g_vertices):
    """Add to `g_vertices` (V, 3) the gradients of what `_add_own` adds, from `g` (N, 3)."""
    for n in range(len(ids)):
        share = _share(params, ids, n, row_of, length, False)
        if share != 0:
            x, y, z, size = _own(vertices, ids, n)
            along = x * g[n, 0] + y * g[n, 1] + z * g[n, 2]
            x = share / size * (g[n, 0] - along * x)
            y = share / size * (g[n, 1] - along * y)
            z = share / size * (g[n, 2] - along * z)
            ux, uy, uz, vx, vy, vz = _sides(vertices, ids[n, 0], ids[n, 1], ids[n, 2])
            bx, by, bz = vy * z - vz * y, vz * x - vx * z, vx * y - vy * x
            cx, cy, cz = y * uz - z * uy, z * ux - x * uz, x * uy - y * ux
            _add(g_vertices, ids[n, 1] + 1, bx, by, bz)
            _add(g_vertices, ids[n, 2] + 1, cx, cy, cz)
            _add(g_vertices, ids[n, 0] + 1, -bx - cx, -by - cy, -bz - cz)


@loop
def _weigh_own(vertices, ids, row_of, length, g, g_params):
    """Add to `g_params` (N, 2) the gradients of weights by what `_add_own` adds, from `g` (N, 3)."""
    for n in range(len(ids)):
        a, b, c = (length[row_of[ids[n, 0]] - 1], length[row_of[ids[n, 1]] - 1], length[row_of[ids[n, 2]] - 1])
        if a == np.inf or b == np.inf or c == np.inf:
            x, y, z, _ = _own(vertices, ids, n)
            along = x * g[n, 0] + y * g[n, 1] + z * g[n, 2]
            last = along if c == np.inf else 0.0
            g_params[n, 0] += (along if a == np.inf else 0.0) - last
            g_params[n, 1] += (along if b == np.inf else 0.0) - last
