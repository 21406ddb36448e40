"""From samples to splats: evaluate, shade and project the samples of one view, or of several."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from rts.arrays.engines import Context, context_of, engine_of, namespace
from rts.arrays.trees import Array, Tree
from rts.compiling.threads import each
from rts.contracts.checks import CheckedPart, check_splats
from rts.contracts.records import ON_RAYS, Sampled, Samples, Splats
from rts.errors import InputError
from rts.operations.projection import projective_map_of_views
from rts.rendering.sampled_views import Views, in_one_table
from rts.rendering.scene import Grid
from rts.rendering.shade import add_footprint, apart, evaluate, shade, shaded_at_once, theta_of
from rts.scene.camera import Camera
from rts.scene.row_cameras import RowCameras


def to_splats(
    sampled: Sampled,
    parts: Sequence[CheckedPart],
    camera: Camera,
    window: Camera,
    context: Context,
) -> Splats:
    """Evaluate, shade and project samples into splats, with the apron as border. Fine samples are left out.

    Args:
        sampled: the samples.
        parts: checked parts.
        camera: the camera of the whole image, which shaders see.
        window: the camera of the samples.
        context: the engine to compute with, and an exemplar of its constants and of the splats.
    """
    height, width, apron = *sampled.row.shape[1:], sampled.apron
    grid = Grid.around(window, (height - 2 * apron, width - 2 * apron), apron)
    sampled = _owned(sampled, sampled.row, context)
    beside = None if sampled.outlines is None else sampled.outlines.rows
    positions, rgba = _together(*_shown(sampled.samples, sampled.row, parts, camera, grid, context, beside))
    return _splats(sampled, parts, positions, rgba, context, border=apron)


def _owned(tree: Tree, row: Array, context: Context) -> Tree:
    """Samples in arrays of the context's engine; `row` is one of their arrays."""
    return tree if context.engine.owns(row) else _of_inputs(context).constants(tree)


def _of_inputs(context: Context) -> Context:
    """The context that converts inputs; for an engine without derivatives, they keep their dtypes."""
    return context if context.engine.differentiates else context._replace(like=None)


def views_to_splats(
    pictures: Sequence[Views],
    parts: Sequence[CheckedPart],
    cameras: Sequence[Camera],
    context: Context,
) -> list[Splats]:
    """The splats of pictures of several views. They have no border: each view keeps its apron.

    A surface is evaluated once, at the samples of all views, so that results for the whole of θ serve all. Shaders that
    take views are called once, too; others are called view by view.

    Args:
        pictures: the samples of the views; pictures are of one size.
        parts: checked parts.
        cameras: the camera of each view, in order, which shaders see.
        context: as in `to_splats`.
    """
    sampled = [picture.sampled for picture in pictures]
    sampled = _owned(sampled, sampled[0].row, context)
    (height, width), border = pictures[0].picture.view, sampled[0].apron
    grids = [Grid.around(camera, (height - 2 * border, width - 2 * border), border) for camera in cameras]
    shown = [
        _shown_in_views(index, part, pictures, sampled, cameras, grids, context) for index, part in enumerate(parts)
    ]
    splats, start = [], 0
    for picture, whole in zip(pictures, sampled, strict=True):
        here = slice(start, start := start + picture.picture.views)
        of_parts = [_of_views(tables, pictures, index, here) for index, tables in enumerate(shown)]
        positions, rgba = _together(*zip(*of_parts, strict=True))
        splats.append(_splats(whole, parts, positions, rgba, context))
    return splats


def _of_views(tables: Sequence[Array], pictures: Sequence[Views], part: int, views: slice) -> Sequence[Array]:
    """The rows of some views, in tables of a part for all pictures."""
    if len(pictures) == 1:
        return tables
    counts = _counts_of(pictures, part)
    assert counts is not None
    first, rows = int(counts[: views.start].sum()), int(counts[views].sum())
    return [x[first : first + rows, ...] for x in tables]


def _counts_of(pictures: Sequence[Views], part: int) -> np.ndarray | None:
    """(B,) number of samples of a part in each view of all pictures; None if unknown."""
    counts = [picture.counts[part] for picture in pictures if picture.counts is not None]
    return np.concatenate(counts) if len(counts) == len(pictures) else None


def _places_of(pictures: Sequence[Views], context: Context) -> Array:
    """(B, 2) for each view its offsets along x and y in its picture, in cells."""
    return context.constants(np.concatenate([own.picture.corners() for own in pictures]).astype(np.float32))


def _splats(
    sampled: Sampled, parts: Sequence[CheckedPart], positions: Array, rgba: Array, context: Context, border: int = 0
) -> Splats:
    """The splats of samples with these positions and colours."""
    cells = replace(sampled.cells, depth=None)
    outlines = context_of(positions, rgba).constants(sampled.outlines)
    if not context.engine.owns(rgba):
        cells = context_of(positions, rgba).constants(cells)
    opaque = all(p.shader.opaque for p in parts)
    return Splats(positions, rgba, cells, border, opaque, outlines)


def _shown(
    sampled: Sequence[Samples],
    row: Array,
    parts: Sequence[CheckedPart],
    camera: Camera,
    grid: Grid,
    context: Context,
    beside: Array | None = None,
) -> tuple[list[Array], list[Array]]:
    """Positions (N, 3) and colours (N, C + 1) of the samples of each part, all of one engine.

    Args:
        sampled: the samples of each part.
        row: integers, the indices of the visible samples, counted over all parts; −1 for none.
        parts: checked parts.
        camera: the camera of the whole image, which shaders see.
        grid: the cells of the samples, and their camera.
        context: the engine to compute with, and an exemplar of the results.
        beside: integers, the indices of samples beside outlines, behind those of cells; None without outlines.
    """
    inputs, engine = _of_inputs(context), context.engine
    seen = grid.camera.replace(view=inputs.constants(grid.camera.view))
    camera = context.constants(camera)
    positions, colors, first = [], [], 0
    for index, (part, samples) in enumerate(zip(parts, sampled, strict=True)):
        theta, transform = theta_of(part, inputs), inputs.constants(part.transform)
        local = evaluate(part, samples, inputs)
        own = seen.within(transform)
        add_footprint(part, samples, local, own, grid.size, inputs)
        used = samples if beside is None else _all_in_use(samples, inputs, beside, first)
        world, rgba = shade(part, theta, transform, used, local, camera, engine)
        positions.append(context.constants(own.project(_on_rays(samples, local["position"]), grid.size)))
        check_splats(index, part, world, positions[-1], rgba, row, first)
        colors.append(context.constants(rgba))
        first += samples.ids.shape[-2]
    if not engine.owns(colors[0]) or (len(parts) > 1 and engine_of(colors) is not engine):
        # A shader may close over arrays of an engine that the scene has none of.
        positions, colors = context_of(positions, colors).constants((positions, colors))
    return positions, colors


def _all_in_use(samples: Samples, context: Context, beside: Array | None, first: int) -> Samples:
    """The samples with cells of their own, one a row, so that no row passes for unused; or all do, if none is in use.

    Args:
        samples: the samples of a part.
        context: of their arrays.
        beside: see `_shown`; None if some row is in use.
        first: the index of the part's first sample.
    """
    xp, count = namespace(samples.row), samples.ids.shape[-2]
    every = context.constants(np.arange(count, dtype=np.int32)[None, None])
    if beside is None:
        return replace(samples, cells=replace(samples.cells, row=every))
    rows: Array = context.constants(beside)
    there = xp.any(samples.row >= 0) | xp.any((rows >= first) & (rows < first + count))
    return replace(samples, cells=replace(samples.cells, row=xp.where(there, every, -1)))


def _shown_in_views(
    index: int,
    part: CheckedPart,
    pictures: Sequence[Views],
    sampled: Sequence[Sampled],
    cameras: Sequence[Camera],
    grids: Sequence[Grid],
    context: Context,
) -> tuple[Array, Array]:
    """Positions (N, 3) in their pictures and colours (N, C + 1) of the samples of a part in several views.

    Args:
        index: the index of the part.
        part: the part; it must be `shaded_at_once` if the number of samples in each view is unknown.
        pictures: the views.
        sampled: their samples, in arrays of the engine.
        cameras: the camera of the whole image of each view.
        grids: the cells of each view, and their camera.
        context: as in `_shown`.
    """
    inputs, engine = _of_inputs(context), context.engine
    whole = in_one_table([own.samples[index] for own in sampled])
    used, outlines = whole, sampled[0].outlines
    if outlines is not None:
        before = sum(own.ids.shape[-2] for own in sampled[0].samples[:index])
        # Engines that pad rows have all views in one picture.
        used = _all_in_use(whole, inputs, outlines.rows if len(sampled) == 1 else None, before)
    counts, size = _counts_of(pictures, index), grids[0].size
    theta, transform = theta_of(part, inputs), inputs.constants(part.transform)
    gbuffer = evaluate(part, whole, inputs)
    view, first = [], 0
    for picture in pictures:
        view.append(picture.view[index] + first if first else picture.view[index])
        first += picture.picture.views
    (view,) = _together([inputs.constants(own) for own in view])
    seen = [g.camera.replace(view=inputs.constants(g.camera.view)).within(transform) for g in grids]
    rows = namespace(seen[0].view).stack([own.pixel_rows(size) for own in seen])
    points = _on_rays(whole, gbuffer["position"])
    rows, points = context_of(rows, points).constants((rows, points))
    places = _places_of(pictures, Context(engine_of(points), points))
    positions = context.constants(projective_map_of_views(rows, points, view, places))
    cameras = context.constants(cameras)
    if shaded_at_once(part):
        camera = cameras[0] if part.uniform else RowCameras.of(cameras, view)
        rgba = shade(part, theta, transform, used, gbuffer, camera, engine)[1]
    else:
        assert counts is not None
        shaded = []
        for own, (samples, local) in zip(seen, apart(whole, gbuffer, counts.tolist(), engine), strict=True):
            add_footprint(part, samples, local, own, size, inputs)
            shaded.append((samples, local))

        def colored(pair: tuple) -> Array:
            camera, (samples, local) = pair
            if not local["position"].shape[0]:
                # Shaders may expect a row at least.
                none = namespace(local["position"]).broadcast_to(
                    local["position"][:, :1], (0, part.shader.channels + 1)
                )
                return context.constants(none)
            return context.constants(shade(part, theta, transform, samples, local, camera, engine)[1])

        views = list(zip(cameras, shaded, strict=True))
        colors = [colored(views[0])]
        colors += each(colored, views[1:]) if type(colors[0]) is np.ndarray else map(colored, views[1:])
        (rgba,) = _together(colors)
    rgba = context.constants(rgba)
    if engine_of(rgba) is not engine:
        positions, rgba = context_of(rgba).constants((positions, rgba))
    # Values in unused rows are not checked.
    every = np.arange(gbuffer["position"].shape[0], dtype=np.int32)[None, None] if counts is not None else whole.row
    check_splats(index, part, gbuffer, positions, rgba, every, 0)
    return positions, rgba


def _on_rays(samples: Samples, position: Array) -> Array:
    """Positions (N, 3) of samples, moved onto the rays of their cells unless they are centred; derivatives stay.

    Splatters need samples whose motion starts at their cells' centres. On the rays, projections are finite, too.
    """
    if samples.centered:
        return position
    if ON_RAYS not in samples.tables:
        raise InputError(
            f"samples are not centered, and have no table {ON_RAYS!r}: expected (N, 3), where their cells' rays are at "
            f"their depth"
        )
    own = context_of(position)
    place = namespace(position).astype(own.constants(samples.tables[ON_RAYS]), position.dtype, copy=False)
    return place + (position - own.engine.stop_gradient(position))


def _together(*kinds: Sequence[Array]) -> list[Array]:
    """One concatenated array of each kind, such as positions and colours."""
    return [arrays[0] if len(arrays) == 1 else namespace(arrays[0]).concat(list(arrays)) for arrays in kinds]
