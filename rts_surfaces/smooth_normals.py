"""Smooth normals of a triangle mesh at samples, differentiable in its vertices."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from rts import InputError, engine_of, namespace
from rts.plugin_api.arrays import Array, unit
from rts.plugin_api.operations import Operation, filled_up, interpolate, take


def smooth_normals(vertices: Array, params: Array, ids: Array, faces: np.ndarray) -> Array:
    """Normals (N, 3) interpolated between those of vertices, differentiable in vertices and params.

    Args:
        vertices: (V, 3) float.
        params: (N, 2) float, the weights of the first two vertices of each sample's triangle.
        ids: (N, I) integers; the first three are the triangle's vertices.
        faces: (T, 3) integers, all triangles.
    """
    xp = namespace(vertices, params)
    if xp.finfo(params.dtype).bits < xp.finfo(vertices.dtype).bits:
        params = xp.astype(params, vertices.dtype)
    return SMOOTH_NORMALS(vertices, params, ids, table_of(faces, vertices))


def table_of(faces: np.ndarray, vertices: Array) -> Array:
    """Faces (T, 3) as an array of the engine of `vertices`, with room: further faces are points, and add nothing."""
    engine = engine_of(vertices)
    return engine.constant(filled_up(faces, engine.room(len(faces), vertices)), vertices)


def vertex_normals(vertices: Array, faces: Array) -> Array:
    """Unit normals (V, 3): directions of the area-weighted sums over the faces (T, 3) around each vertex, or zero."""
    xp, engine = namespace(vertices), engine_of(vertices)
    a, b, c = (take(vertices, faces[:, i]) for i in range(3))
    face_normals = xp.linalg.cross(b - a, c - a)
    segments = xp.reshape(faces.T, (-1,))
    return unit(engine.segment_sum(xp.concat([face_normals] * 3), segments, vertices.shape[0]))


def _specification(vertices: Array, params: Array, ids: Array, faces: Array) -> Array:
    return interpolate(vertex_normals(vertices, faces), ids, 0, params)


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

    return loops.forward, loops.push, loops.pull


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
