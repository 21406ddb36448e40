"""From samples to splats, for several views: each part evaluated once, at the samples of all."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np

from rts.arrays.engines import Context, context_of, engine_of, namespace
from rts.arrays.trees import Array
from rts.compiling.threads import each
from rts.contracts.checked_parts import CheckedPart
from rts.contracts.records import Sampled, Splats
from rts.contracts.result_checks import check_splats
from rts.operations.projection import projective_map_of_views
from rts.rendering.part_transforms import ViewTransforms
from rts.rendering.shade import add_footprint, shade, shaded_at_once, theta_of
from rts.rendering.splats import all_in_use, concatenated, of_inputs, on_rays, owned, splats_of
from rts.sampling.scene import Grid
from rts.sampling.tables import in_one_table
from rts.scene.camera import Camera
from rts.scene.row_cameras import RowCameras
from rts.views.evaluated import Evaluated
from rts.views.sampled_views import Views


def views_to_splats(
    pictures: Sequence[Views],
    parts: Sequence[Sequence[CheckedPart]],
    cameras: Sequence[Camera],
    context: Context,
) -> list[Splats]:
    """The splats of pictures of several views. They have no border around all views: each view keeps its own.

    A part that all views share is evaluated once, at the samples of all, so that results for the whole of θ serve all.
    Shaders that take views are called once, if θ has the same entries for them in every view; others are called view by
    view.

    Args:
        pictures: the samples of the views; pictures are of one size.
        parts: checked parts of each view. The first parts of all views share a table of samples, and so on.
        cameras: the camera of each view, in order, which shaders see.
        context: as in `to_splats`.
    """
    sampled = [picture.sampled for picture in pictures]
    sampled = owned(sampled, sampled[0].row, context)
    (height, width), border = pictures[0].picture.view, sampled[0].border
    cells = height - 2 * border, width - 2 * border
    grids = [Grid.of_parts(*one, cells, border, context) for one in zip(parts, cameras, strict=True)]
    shown = [
        _positions_and_colors(index, places, pictures, sampled, cameras, grids, context)
        for index, places in enumerate(itertools.zip_longest(*parts))
    ]
    splats, start = [], 0
    for picture, whole in zip(pictures, sampled, strict=True):
        here = slice(start, start := start + picture.picture.views)
        of_parts = [_of_views(tables, pictures, index, here) for index, tables in enumerate(shown)]
        positions, rgba = concatenated(*zip(*of_parts, strict=True))
        splats.append(splats_of(whole, [table for several in parts for table in several], positions, rgba, context))
    return splats


def _positions_and_colors(
    index: int,
    parts: Sequence[CheckedPart | None],
    pictures: Sequence[Views],
    sampled: Sequence[Sampled],
    cameras: Sequence[Camera],
    grids: Sequence[Grid],
    context: Context,
) -> tuple[Array, Array]:
    """Positions (N, 3) in their pictures and colours (N, C + 1) of the samples of a part in several views.

    Args:
        index: the index of the part.
        parts: the part of each view; None where a view has fewer. If the number of samples in each view is unknown, it
            must be one part, which is `shaded_at_once`.
        pictures: the views.
        sampled: their samples, in arrays of the engine.
        cameras: the camera of the whole image of each view.
        grids: the cells of each view, and their camera.
        context: as in `to_splats`.
    """
    inputs, engine = of_inputs(context), context.engine
    whole = in_one_table([sampled_picture.samples[index] for sampled_picture in sampled])
    used, stencil = whole, sampled[0].stencil
    if stencil is not None and engine.padded(whole.row):
        before = sum(sampled_picture.ids.shape[-2] for sampled_picture in sampled[0].samples[:index])
        # Engines that pad rows have all views in one picture.
        used = all_in_use(whole, inputs, stencil if len(sampled) == 1 else None, before)
    counts, size = _counts_of(pictures, index), grids[0].size
    shown = Evaluated.of(parts, whole, counts, inputs)
    view, first = [], 0
    for picture in pictures:
        view.append(picture.view[index] + first if first else picture.view[index])
        first += picture.picture.views
    (view,) = concatenated([inputs.constants(numbers) for numbers in view])
    local_cameras = [g.camera if part is None else g.cameras[index] for g, part in zip(grids, parts, strict=True)]
    rows = namespace(*(camera.view for camera in local_cameras)).stack(
        context_of(*(c.view for c in local_cameras)).constants([camera.pixel_rows(size) for camera in local_cameras])
    )
    points = shown.gbuffer["position"] if whole.centered else on_rays(whole, shown.gbuffer["position"])
    rows, points = context_of(rows, points).constants((rows, points))
    places = _places_of(pictures, Context(engine_of(points), points))
    positions = context.constants(projective_map_of_views(rows, points, view, places))
    cameras = context.constants(cameras)
    part = shown.part
    if part is not None and shaded_at_once(part):
        shown.add_footprints(parts, whole, rows, view, inputs)
        camera = cameras[0] if part.uniform else RowCameras.of(cameras, view)
        moved = shown.transforms[0] if shown.one else ViewTransforms.of(shown.transforms, view)
        rgba = shade(part, theta_of(part, inputs), moved, used, shown.gbuffer, camera, engine)[1]
    else:
        assert counts is not None

        def colored(view: tuple) -> Array:
            seen, transform, grid_camera, camera, (samples, local) = view
            add_footprint(seen, samples, local, grid_camera.pixel_rows(size), inputs)
            theta = theta_of(seen, inputs)
            return context.constants(shade(seen, theta, transform, samples, local, camera, engine)[1])

        split = shown.split(whole, counts, engine)
        views = list(zip(parts, shown.transforms, local_cameras, cameras, split, strict=True))
        # Shaders may expect a row at least. Rows of other views are none.
        views = [view for view in views if view[0] is not None and view[-1][1]["position"].shape[0]]
        channels = next(p for p in parts if p is not None).shader.channels
        colors = [colored(views[0]) if views else context.constants(np.zeros((0, channels + 1), np.float32))]
        colors += each(colored, views[1:]) if type(colors[0]) is np.ndarray else map(colored, views[1:])
        (rgba,) = concatenated(colors)
    rgba = context.constants(rgba)
    if engine_of(rgba) is not engine:
        positions, rgba = context_of(rgba).constants((positions, rgba))
    # Values in unused rows are not checked.
    count = shown.gbuffer["position"].shape[0]
    every = np.arange(count, dtype=np.int32)[None, None] if counts is not None else whole.row
    seen = next(p for p in parts if p is not None)
    check_splats(index, seen, shown.gbuffer, positions, rgba, every, 0)
    return positions, rgba


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
    return context.constants(np.concatenate([views.picture.corners() for views in pictures]).astype(np.float32))
