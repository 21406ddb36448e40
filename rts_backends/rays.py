"""The sampler for surfaces that intersect rays themselves, without any triangles."""

from __future__ import annotations

from typing import Any

import numpy as np

from rts import Camera, InputError, Part, RaySurface, Sampler, engine_of, namespace
from rts.plugin_api.arrays import Array, constants, exemplar, map_leaves, shape_of
from rts.plugin_api.checks import check_camera
from rts.plugin_api.records import ArraySpec, Cells, RayHits, Request, Samples

REACH = 3.0
"""Distance from a ray, in pixels, up to which an outline counts: beyond, deepest points do not tell how it moves."""


class Rays(Sampler):
    """Sampler that casts a ray through each pixel's centre, in array code on the device, which engines can trace."""

    def sample(self, part: Part, camera: Camera, size: tuple[int, int], layers: int, request: Request) -> Samples:
        """See `rts.Sampler`; refuses a surface that is no `RaySurface`, a culled part, and hits of wrong shapes."""
        surface = part.surface
        if not isinstance(surface, RaySurface):
            raise InputError(
                f"{surface!r} does not intersect rays itself; use a sampler of triangles, such as 'raster'"
            )
        if part.cull != "none":
            raise InputError(f"cull is {part.cull!r}, but the sampler 'rays' has no triangles to cull; expected 'none'")
        engine, like = engine_of(part.theta, camera), exemplar(part.theta, camera)
        theta = map_leaves(engine.stop_gradient, constants(part.theta, engine, like))
        camera = map_leaves(engine.stop_gradient, constants(camera, engine, like))
        xp = namespace(camera.view)

        transform = [] if part.transform is None else [engine.stop_gradient(constants(part.transform, engine, like))]
        engine.call_host(_checked, (ArraySpec((), np.int32),), camera.view, camera.projection, *transform)
        near, far = camera.depth_range()
        rays = camera.rays(size, request.points)
        directions = xp.reshape(rays.directions, (-1, 3))
        origins = xp.reshape(rays.origins, (-1, 3))
        if request.points is not None:
            size = 1, request.points.shape[0]
        origins = origins + near * directions
        hits = _checked_hits(surface.intersect(theta, origins, directions, layers), surface, layers, size)
        depth = near + hits.distance
        hit = xp.reshape(hits.hit & (hits.distance >= 0) & (depth <= far), (layers, *size))
        lost = xp.any(hits.hit & (hits.distance != hits.distance))

        every, capacity = layers * size[0] * size[1], request.capacity
        rows = every if capacity is None else capacity

        def pack(hit: np.ndarray, lost: np.ndarray) -> tuple[np.ndarray, ...]:
            if lost.any():
                raise InputError(f"intersect of {surface!r} gave distances that are NaN, of rays that hit")
            hits = np.flatnonzero(hit)
            row = np.full(every, -1, np.int32)
            row[hits[:rows]] = np.arange(min(rows, len(hits)), dtype=np.int32)
            index = np.zeros(max(1, len(hits)) if capacity is None else rows, np.int32)
            index[: len(hits)] = hits[: len(index)]
            return index, row.reshape(hit.shape), np.asarray(max(0, len(hits) - rows), np.int32)

        packed = ArraySpec((rows,), np.int32, packed=capacity is None)
        specs = packed, ArraySpec((layers, *size), np.int32), ArraySpec((), np.int32)
        index, row, overflow = engine.call_host(pack, specs, hit, lost)
        width_i, width_p = surface.hit_widths or surface.sample_widths
        params = xp.take(xp.reshape(hits.params, (every, width_p)), index, axis=0)
        if hits.ids is None:
            ids = xp.zeros_like(params[:, :0], dtype=xp.int32)
        else:
            ids = xp.take(xp.reshape(hits.ids, (every, width_i)), index, axis=0)
        depth = xp.where(row >= 0, xp.reshape(depth, (layers, *size)), 0.0)
        samples = Samples(ids, params, Cells(row, depth), overflow, at_points=request.points is not None)
        entering, wants_pairs = hits.entering, request.pairs and request.points is not None
        if entering is None or not wants_pairs or type(surface).deepest is RaySurface.deepest:
            return samples
        width = xp.reshape(rays.spread[0] + rays.spread[1] * depth[0, ...], (-1,))
        start = origins + xp.reshape(hits.distance[0, ...], (-1, 1)) * directions
        return _with_deepest(samples, surface, theta, entering[0, ...], start, directions, REACH * width)


def _with_deepest(
    samples: Samples, surface: RaySurface, theta: Any, begins: Array, points: Array, directions: Array, reach: Array
) -> Samples:
    """Samples of points with two further rows for each, beside the deepest points of their rays; see `Samples.pair`.

    Args:
        samples: the samples.
        surface: the surface.
        theta: its θ, constant.
        begins: (M,) bool, points whose ray enters a solid at the front.
        points: (M, 3), see `RaySurface.deepest`.
        directions: (M, 3), likewise.
        reach: (M,), likewise.
    """
    xp, engine, rows = namespace(samples.ids), engine_of(samples.ids), samples.ids.shape[0]
    result = surface.deepest(theta, points, directions, reach)
    assert result is not None
    params, there = result
    count = params.shape[0]
    first = engine.constant(np.arange(rows, rows + 2 * count, 2, dtype=np.int32), samples.ids)
    pair = xp.where((there & begins & (samples.row[0, 0, :] >= 0))[None, :], xp.stack([first, first + 1]), -1)
    params = xp.reshape(params, (-1, params.shape[-1]))
    return samples.replace(
        ids=xp.concat([samples.ids, xp.astype(params[:, : samples.ids.shape[1]], samples.ids.dtype)]),
        params=xp.concat([samples.params, xp.astype(params, samples.params.dtype, copy=False)]),
        pair=pair,
    )


def _checked_hits(hits: Any, surface: RaySurface, layers: int, size: tuple[int, int]) -> RayHits:
    """`hits`, the result of `surface.intersect`; raises InputError if its type, shapes or dtype are wrong."""
    if not isinstance(hits, RayHits):
        raise InputError(f"intersect of {surface!r} gave a {type(hits).__name__}; expected RayHits")
    grid, (i, p) = (layers, size[0] * size[1]), surface.hit_widths or surface.sample_widths
    shapes = tuple(map(shape_of, (hits.hit, hits.distance, hits.params, *([] if hits.ids is None else [hits.ids]))))
    expected = grid, grid, (*grid, p), *([] if hits.ids is None and i == 0 else [(*grid, i)])
    if hits.entering is not None:
        shapes, expected = (*shapes, shape_of(hits.entering)), (*expected, grid)
    if shapes != expected:
        raise InputError(
            f"intersect of {surface!r} gave shapes {shapes}; expected {expected}: hit, distance, params, ids, entering"
        )
    for name in ("hit", "entering"):
        marks = getattr(hits, name)
        if marks is not None and not namespace(marks).isdtype(marks.dtype, "bool"):
            raise InputError(f"intersect of {surface!r} gave {name} of dtype {marks.dtype}; expected bool")
    return hits


def _checked(view: np.ndarray, projection: np.ndarray, *transform: np.ndarray) -> tuple[np.ndarray]:
    """Refuse a camera without rays, or a bad transform. A compiled program leaves out this call: its 0 is unused."""
    check_camera(Camera(np.asarray(view, np.float64), np.asarray(projection, np.float64)), *transform)
    return (np.asarray(0, np.int32),)
