"""The sampler for surfaces that intersect rays themselves, without any triangles."""

from __future__ import annotations

from typing import Any

import numpy as np

from rts import Camera, InputError, Part, RaySurface, Sampler, engine_of, namespace
from rts.plugin_api.arrays import Array, constants, exemplar, map_leaves, shape_of
from rts.plugin_api.checks import check_camera
from rts.plugin_api.records import ArraySpec, Cells, RayHits, Request, Samples
from rts.plugin_api.splats import outline_cells

REACH = 3.0
"""Distance from a ray, in pixels, up to which an outline counts: beyond, deepest points do not tell how it moves."""

ROOM = 16
"""Rows of a capacity for which one pair of rows, at outlines, is allotted beside the capacity."""


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
        listed, view = True, size
        if request.cells is not None:
            index: Array = xp.reshape(constants(request.cells, engine, like), (-1,))
            size, listed = tuple(request.cells.shape), index[None] >= 0
            index = xp.where(index >= 0, index, 0)
            directions, origins = xp.take(directions, index, axis=0), xp.take(origins, index, axis=0)
        elif request.points is not None:
            size = 1, request.points.shape[0]
        origins = origins + near * directions
        hits = _checked_hits(surface.intersect(theta, origins, directions, layers), surface, layers, size)
        depth = near + hits.distance
        hit = xp.reshape(hits.hit & (hits.distance >= 0) & (depth <= far) & listed, (layers, *size))

        every, capacity = layers * size[0] * size[1], request.capacity
        rows = every if capacity is None else capacity

        def pack(hit: np.ndarray) -> tuple[np.ndarray, ...]:
            hits = np.flatnonzero(hit)
            row = np.full(every, -1, np.int32)
            row[hits[:rows]] = np.arange(min(rows, len(hits)), dtype=np.int32)
            index = np.zeros(max(1, len(hits)) if capacity is None else rows, np.int32)
            index[: len(hits)] = hits[: len(index)]
            return index, row.reshape(hit.shape), np.asarray(max(0, len(hits) - rows), np.int32)

        packed = ArraySpec((rows,), np.int32, packed=capacity is None)
        specs = packed, ArraySpec((layers, *size), np.int32), ArraySpec((), np.int32)
        index, row, overflow = engine.call_host(pack, specs, hit)
        width_i, width_p = surface.hit_widths or surface.sample_widths
        params = xp.take(xp.reshape(hits.params, (every, width_p)), index, axis=0)
        if hits.ids is None:
            ids = xp.zeros_like(params[:, :0], dtype=xp.int32)
        else:
            ids = xp.take(xp.reshape(hits.ids, (every, width_i)), index, axis=0)
        depth = xp.where(row >= 0, xp.reshape(depth, (layers, *size)), 0.0)
        followed = tuple(name for name in ("cells", "points") if getattr(request, name) is not None)
        facing = None
        if request.facing and hits.entering is not None:
            facing = _facing(xp.reshape(hits.entering, (layers, *size)), row)
        samples = Samples(ids, params, Cells(row, depth, facing), overflow, followed=followed)
        asked = request.exits and hits.entering is not None
        if not (asked and type(surface).deepest is not RaySurface.deepest):
            return samples
        width = rays.spread[0] + rays.spread[1] * depth[0, ...]
        start = origins + xp.reshape(hits.distance[0, ...], (-1, 1)) * directions
        begins = xp.reshape(hits.entering, hit.shape)[0, ...] & (row[0, ...] >= 0)
        reach = REACH * xp.reshape(width, (-1,))
        cells = None if request.cells is None else constants(request.cells, engine, like)
        if request.points is not None:
            view = None
        return _with_deepest(samples, surface, theta, begins, (start, directions, reach), capacity, cells, view)


def _with_deepest(
    samples: Samples,
    surface: RaySurface,
    theta: Any,
    begins: Array,
    rays: tuple[Array, ...],
    capacity: int | None,
    listed: Array | None,
    view: tuple[int, int] | None,
) -> Samples:
    """Samples with two further rows for cells at outlines, beside the deepest points of their rays; see `Cells.exit`.

    Args:
        samples: the samples.
        surface: the surface.
        theta: its θ, constant.
        begins: (H, W) or (L, C) bool, cells whose ray enters a solid at the front.
        rays: points of the surface (M, 3), directions (M, 3), and reach (M,), of all M cells, as `RaySurface.deepest`
            takes them for some.
        capacity: see `Request`. A sixteenth of it, rounded up, is the room for pairs; cells beyond it have none. None
            for as much room as there are cells.
        listed: (L, C), `Request.cells`; None for all cells of the grid.
        view: (height, width) of the grid; None for points, all of which count as cells at outlines.
    """
    engine, xp, rows = engine_of(samples.ids, begins), namespace(begins), samples.ids.shape[0]
    room = begins.shape[0] * begins.shape[1] if capacity is None else -(-capacity // ROOM)

    def find(row: np.ndarray, depth: np.ndarray, begins: np.ndarray, *own: np.ndarray) -> tuple[np.ndarray, ...]:
        cells = np.flatnonzero(row[0] >= 0) if view is None else outline_cells(row >= 0, depth, *own, size=view)
        cells = cells[begins.reshape(-1)[cells]][:room]
        number = np.full(begins.shape, -1, np.int32)
        number.reshape(-1)[cells] = np.arange(len(cells), dtype=np.int32)
        listed = np.zeros(max(1, len(cells)) if capacity is None else room, np.int32)
        listed[: len(cells)] = cells
        return listed, number

    specs = ArraySpec((room,), np.int32, packed=capacity is None), ArraySpec(tuple(begins.shape), np.int32)
    found, number = engine.call_host(
        find, specs, samples.row, samples.depth, begins, *([] if listed is None else [listed])
    )
    result = surface.deepest(theta, *(xp.take(x, found, axis=0) for x in rays))
    assert result is not None
    params, there = result
    flat = xp.reshape(number, (-1,))
    there = (number >= 0) & xp.reshape(xp.take(there, xp.where(flat >= 0, flat, 0), axis=0), number.shape)
    first = rows + 2 * number
    exits = xp.where(there[None, ...], xp.stack([first, first + 1]), -1)
    params = xp.reshape(params, (-1, params.shape[-1]))
    return samples.replace(
        ids=xp.concat([samples.ids, xp.astype(params[:, : samples.ids.shape[1]], samples.ids.dtype)]),
        params=xp.concat([samples.params, xp.astype(params, samples.params.dtype, copy=False)]),
        exit=xp.astype(exits, xp.int32, copy=False),
    )


def _facing(entering: Array, row: Array) -> Array:
    """`Cells.facing` of a solid of one piece, from `RayHits.entering` and `Cells.row`, all (K, H, W)."""
    xp = namespace(row)
    more = xp.concat([xp.zeros_like(row[:-1]), xp.full_like(row[-1:], Cells.MORE_BEHIND)])
    sides = xp.where(entering, 1 + more, -1 - more)
    return xp.astype(xp.where(row >= 0, sides, xp.zeros_like(sides)), xp.int16)


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
