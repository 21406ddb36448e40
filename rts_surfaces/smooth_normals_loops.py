"""Smooth normals at samples and their derivatives, as compiled loops for arrays on the host.

Only vertices that samples name have a normal. Each has a row of tables that are in float64: `row_of` (V,) tells which,
counted from 1, and 0 for others. A vertex without area around it has the normal 0 and the length 1, so that its
derivative is that of the sum, as `rts.plugin_api.arrays.unit` has it. Sums are added up in the order of the faces.
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
        length: (U,) float64, of the sums of twice the areas around, or 1 where they are zero.
    """

    row_of: np.ndarray
    unit: np.ndarray
    length: np.ndarray


def forward(
    vertices: np.ndarray, params: np.ndarray, ids: np.ndarray, faces: np.ndarray, out: np.ndarray
) -> VertexNormals:
    """Fill `out` (N, 3) with interpolated normals. An InputError if an id names no vertex."""
    normals = _normals(vertices, ids, faces)
    _interpolate_all(normals, normals.unit, params, ids, out, False)
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
) -> None:
    """Fill `out` (N, 3) with the derivative along `t_vertices` (V, 3) and `t_params` (N, 2), each None if zero."""
    normals = kept or _normals(vertices, ids, faces)
    out[...] = 0
    if t_vertices is not None:
        moved = np.zeros_like(normals.unit)
        _add_moved(vertices, t_vertices, faces, normals.row_of, moved)
        _turn(normals.unit, normals.length, moved)
        _interpolate_all(normals, moved, params, ids, out, False)
    if t_params is not None:
        _interpolate_all(normals, normals.unit, t_params, ids, out, True)


def pull(
    vertices: np.ndarray,
    params: np.ndarray,
    ids: np.ndarray,
    faces: np.ndarray,
    g: np.ndarray,
    g_vertices: np.ndarray | None,
    g_params: np.ndarray | None,
    kept: VertexNormals | None,
) -> None:
    """Pull back the gradient `g` (N, 3): add to `g_vertices` (V, 3), fill `g_params` (N, 2), unless None."""
    normals = kept or _normals(vertices, ids, faces)
    if g_vertices is not None:
        sums = np.zeros_like(normals.unit)
        _scatter(normals.row_of, params, ids, g, sums)
        _turn(normals.unit, normals.length, sums)
        _pull_faces(vertices, faces, normals.row_of, sums, g_vertices)
    if g_params is not None:
        parallel(_weigh, len(ids), normals.row_of, normals.unit, ids, g, g_params, work=10 * len(ids))


def _normals(vertices: np.ndarray, ids: np.ndarray, faces: np.ndarray) -> VertexNormals:
    """The normals of the vertices that `ids` name. An InputError if an id, or a face, names no vertex."""
    row_of = np.zeros(len(vertices), np.int32)
    count = _number(ids, row_of)
    unit, length = np.zeros((max(count, 0), 3)), np.empty(max(count, 0))
    if count < 0 or not _add_faces(vertices, faces, row_of, unit):
        raise InputError(f"samples or faces refer to vertices that are not among {len(vertices)}; sample the mesh anew")
    _normalize(unit, length)
    return VertexNormals(row_of, unit, length)


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
def _add_faces(vertices, faces, row_of, sums):
    """Add the faces' normals, twice their areas long, to the `sums` (U, 3) of their vertices; False if one is none."""
    for f in range(len(faces)):
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        if min(a, b, c) < 0 or max(a, b, c) >= len(row_of):
            return False
        i, j, k = row_of[a], row_of[b], row_of[c]
        if i | j | k:
            ux, uy, uz, vx, vy, vz = _sides(vertices, a, b, c)
            x, y, z = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
            _add(sums, i, x, y, z)
            _add(sums, j, x, y, z)
            _add(sums, k, x, y, z)
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
def _normalize(unit, length):
    """Scale rows of `unit` (U, 3) to length one, and fill `length` (U,) with what they were, or 1 for zeros."""
    for r in range(len(unit)):
        largest = max(abs(unit[r, 0]), abs(unit[r, 1]), abs(unit[r, 2]))  # Squares of it may be too small or large.
        scale = largest if largest > 0 else 1.0
        size = np.sqrt((unit[r, 0] / scale) ** 2 + (unit[r, 1] / scale) ** 2 + (unit[r, 2] / scale) ** 2)
        length[r] = size * scale if size > 0 else 1.0
        for i in range(3):
            unit[r, i] /= length[r]


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
