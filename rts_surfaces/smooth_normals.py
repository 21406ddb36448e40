"""Smooth normals of a triangle mesh at samples, differentiable in its vertices."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np

from rts import InputError, engine_of, errors, namespace
from rts.plugin_api.arrays import Array, unit
from rts.plugin_api.operations import Operation, filled_up, interpolate, take

CANCELLED = 1e-3
"""Sums over faces that are shorter than this share of what they add up are no directions; see `smooth_normals`."""

LOOKED_AT, MIXED = 1 << 14, 0.1
"""Faces of a mesh whose edges are looked at, and the share of these, of those that two faces share, from which the
faces count as wound in different ways: a strip with one side only has a few such edges."""


def warn_of_windings(faces: np.ndarray) -> None:
    """Warn of faces (T, 3) many of which are wound against their neighbours, so that sums of normals are no normals."""
    turned = (faces[:LOOKED_AT].argmin(axis=1)[:, None] + np.arange(3)) % 3
    # Those that are there twice, whichever corner comes first, cancel nothing.
    faces = np.unique(np.take_along_axis(faces[:LOOKED_AT], turned, axis=1), axis=0).astype(np.int64)
    start, end = faces, np.roll(faces, -1, axis=1)
    keys = np.minimum(start, end) * (int(faces.max(initial=0)) + 1) + np.maximum(start, end)
    _, edge, count = np.unique(keys.reshape(-1), return_inverse=True, return_counts=True)
    same_way = np.abs(np.bincount(edge.reshape(-1), np.where(start < end, 1, -1).reshape(-1)))[count == 2] == 2
    if same_way.any() and same_way.mean() > MIXED:
        errors.warn(
            f"across {same_way.mean():.0%} of the edges of a mesh its triangles are wound against one another, where "
            "normals cancel, and shading is wrong; turn some of the triangles over, as rts.load does with those of "
            "files, or give theta['normals']",
            errors.InputWarning,
        )


def smooth_normals(vertices: Array, params: Array, ids: Array, faces: np.ndarray) -> Array:
    """Normals (N, 3) interpolated between those of vertices, differentiable in vertices and params.

    Where the faces around a vertex nearly cancel, as both sides of a double face do, the unit normal of the sample's
    own triangle stands for the vertex's.

    Args:
        vertices: (V, 3) float.
        params: (N, 2) float, the weights of the first two vertices of each sample's triangle.
        ids: (N, I) integers; the first three are the triangle's vertices.
        faces: (T, 3) integers, all triangles.
    """
    xp = namespace(vertices, params)
    if params.dtype != vertices.dtype and xp.finfo(params.dtype).bits < xp.finfo(vertices.dtype).bits:
        params = xp.astype(params, vertices.dtype)
    return SMOOTH_NORMALS(vertices, params, ids, table_of(faces, vertices))


def table_of(faces: np.ndarray, vertices: Array) -> Array:
    """Faces (T, 3) as an array of the engine of `vertices`, with room: further faces are points, and add nothing."""
    engine = engine_of(vertices)
    return engine.constant(filled_up(faces, engine.room(len(faces), vertices)), vertices)


def vertex_normals(vertices: Array, faces: Array) -> tuple[Array, Array]:
    """Unit normals (V, 3): directions of the area-weighted sums over the faces (T, 3) around each vertex, or zero.

    With them (V, 1), one where a sum nearly cancels (`CANCELLED`), whose normal is zero, and zero elsewhere.
    """
    xp, engine = namespace(vertices), engine_of(vertices)
    normals = face_normals(vertices, faces)
    sizes = xp.max(abs(engine.stop_gradient(normals)), axis=1, keepdims=True)  # No squares, which may be too small.
    segments = xp.reshape(faces.T, (-1,))
    rows = engine.segment_sum(xp.concat([xp.concat([normals, sizes], axis=1)] * 3), segments, vertices.shape[0])
    sums, sizes = rows[:, :3], engine.stop_gradient(rows[:, 3:])
    largest = xp.max(abs(engine.stop_gradient(sums)), axis=1, keepdims=True)
    cancelled = (sizes > 0) & (largest <= CANCELLED * sizes)
    return unit(xp.where(cancelled, 0 * sums, sums)), xp.astype(cancelled, vertices.dtype)


def face_normals(vertices: Array, ids: Array) -> Array:
    """Normals (N, 3) of the triangles whose vertices are the first three `ids` (N, I), twice their areas long."""
    xp = namespace(vertices, ids)
    corners = xp.reshape(take(vertices, xp.reshape(ids[:, :3], (-1,))), (-1, 3, 3))
    return xp.linalg.cross(corners[:, 1, :] - corners[:, 0, :], corners[:, 2, :] - corners[:, 0, :])


def with_own_normals(normals: Array, cancelled: Array, vertices: Array, params: Array, ids: Array) -> Array:
    """Normals (N, 3) at samples, with those of their own triangles for vertices that are `cancelled` (V, 1)."""
    return normals + interpolate(cancelled, ids, 0, params) * unit(face_normals(vertices, ids))


def _specification(vertices: Array, params: Array, ids: Array, faces: Array) -> Array:
    normals, cancelled = vertex_normals(vertices, faces)
    return with_own_normals(interpolate(normals, ids, 0, params), cancelled, vertices, params, ids)


def _check(vertices: np.ndarray, params: np.ndarray, ids: np.ndarray, faces: np.ndarray, **_: object) -> None:
    if (
        not vertices.shape[1] == faces.shape[1] == 3
        or ids.shape[1] < 3
        or params.shape[1] < 2
        or len(ids) != len(params)
    ):
        shapes = ", ".join(str(x.shape) for x in (vertices, params, ids, faces))
        raise InputError(
            f"vertices, params, ids and faces have shapes {shapes}; expected (V, 3), (N, 2), (N, 3), (T, 3)"
        )


def _shape(vertices: tuple[int, ...], params: tuple[int, ...], *_: tuple[int, ...]) -> tuple[int, ...]:
    return params[0], 3


def _loops() -> tuple[Callable, Callable, Callable]:
    from rts_surfaces import smooth_normals_loops as loops

    forward, push, pull = (partial(f, least=CANCELLED) for f in (loops.forward, loops.push, loops.pull))
    return forward, push, pull


SMOOTH_NORMALS = Operation.of_loops(
    "rts_surfaces.smooth_normals",
    _specification,
    (2, 2, 2, 2),
    _shape,
    _loops,
    _check,
    differentiable=2,
    packed=(1, 2),
    packed_result=True,
    keeps=True,
)
"""The operation of `smooth_normals`. Its loops compute the normals of vertices that samples name, and no others."""
