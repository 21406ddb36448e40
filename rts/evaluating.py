"""Samples of scenes evaluated, shaded and projected: what splatters take of one view, or of several."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from rts.appearance import add_footprint, apart, evaluate, shade, shaded_at_once, theta_of
from rts.camera import Camera
from rts.checks import check_splats
from rts.engines import Engine, constants, engine_of, namespace, suiting
from rts.errors import InputError
from rts.operations.projection import projective_map_of_views
from rts.operations.take import take, take_shifted
from rts.parts import CheckedPart
from rts.records import ON_RAYS, Fine, Sampled, Samples, Splats
from rts.row_cameras import RowCameras
from rts.sampling.scenes import Wide
from rts.sampling.several import Views, in_one_table
from rts.threads import each
from rts.trees import Array


def to_splats(
    sampled: Sampled,
    parts: Sequence[CheckedPart],
    camera: Camera,
    window: Camera,
    engine: Engine,
    like: Array | None,
) -> Splats:
    """Evaluate, shade and project samples: what splatters take, with the apron as border. Fine ones are left out.

    Args:
        sampled: the samples.
        parts: checked parts.
        camera: the camera of the whole image, which shaders see.
        window: the camera of the samples.
        engine: the engine to compute with.
        like: an array that sets dtype and device of its constants and of the splats.
    """
    grid, apron = tuple(sampled.row.shape[1:]), sampled.apron
    wide = Wide(window.with_apron((grid[0] - 2 * apron, grid[1] - 2 * apron), apron), grid)
    if not engine.owns(sampled.row):
        sampled = constants(sampled, engine, like if engine.differentiates else None)
    positions, rgba = _together(*_shown(sampled.samples, sampled.row, parts, camera, wide, engine, like))
    return _splats(sampled, positions, rgba, engine, border=apron)


def views_to_splats(
    pictures: Sequence[Views],
    parts: Sequence[CheckedPart],
    cameras: Sequence[Camera],
    engine: Engine,
    like: Array | None,
) -> list[Splats]:
    """The splats of pictures of several views: those of a picture have no border, but cells that are wanted.

    A surface is asked once, for the samples of all views: what it computes of the whole of θ serves them all. So are
    shaders that take views; others are asked view by view.

    Args:
        pictures: the samples of the views; pictures are of one size.
        parts: checked parts.
        cameras: the camera of each view, in order, which shaders see.
        engine: the engine to compute with.
        like: an array that sets dtype and device of its constants and of the splats.
    """
    sampled = [picture.sampled for picture in pictures]
    if not engine.owns(sampled[0].row):
        sampled = constants(sampled, engine, like if engine.differentiates else None)
    grid, border = pictures[0].picture.view, sampled[0].apron
    wides = [Wide(c.with_apron((grid[0] - 2 * border, grid[1] - 2 * border), border), grid) for c in cameras]
    shown = [
        _shown_in_views(index, part, pictures, sampled, cameras, wides, engine, like)
        for index, part in enumerate(parts)
    ]
    made, start = [], 0
    for picture, whole in zip(pictures, sampled, strict=True):
        here = slice(start, start := start + picture.picture.views)
        of_parts = [_of_views(tables, pictures, index, here) for index, tables in enumerate(shown)]
        positions, rgba = _together(*zip(*of_parts, strict=True))
        wanted = engine_of(positions).constant(picture.picture.inside(border), positions)
        made.append(_splats(whole, positions, rgba, engine, wanted=wanted))
    return made


def _of_views(tables: Sequence[Array], pictures: Sequence[Views], part: int, views: slice) -> Sequence[Array]:
    """The rows of some views in tables of a part in all pictures."""
    if len(pictures) == 1:
        return tables
    counts = _counts_of(pictures, part)
    assert counts is not None
    first, rows = int(counts[: views.start].sum()), int(counts[views].sum())
    return [x[first : first + rows, ...] for x in tables]


def _counts_of(pictures: Sequence[Views], part: int) -> np.ndarray | None:
    """(B,) how many samples of a part there are in each view of all pictures; None where that is not known."""
    known = [picture.counts[part] for picture in pictures if picture.counts is not None]
    return np.concatenate(known) if len(known) == len(pictures) else None


def _places_of(pictures: Sequence[Views], engine: Engine, like: Array) -> Array:
    """(B, 3) of each view what is added to columns and lines in its picture, and by what depth is multiplied."""
    corners = np.concatenate([picture.picture.corners() for picture in pictures]).astype(np.float32)
    scales = [constants(picture.scales, engine, like) for picture in pictures]
    xp = namespace(*scales)
    return xp.concat([constants(corners, engine, like), xp.concat(scales)[:, None]], axis=1)


def _splats(sampled: Sampled, positions: Array, rgba: Array, engine: Engine, **more: Any) -> Splats:
    """The splats of samples whose positions and colours are known; `more` of their fields are given."""
    part = None if sampled.one_part else sampled.part
    cells = sampled.row, part, sampled.facing, sampled.settled, sampled.exit
    if not engine.owns(rgba):
        cells = constants(cells, *suiting(positions, rgba))
    *cells, exits = cells
    return Splats(positions, rgba, *cells, exit=exits, one_part=sampled.one_part, **more)


def to_fine_splats(
    fine: Fine, parts: Sequence[CheckedPart], camera: Camera, engine: Engine, like: Array | None
) -> Splats:
    """Evaluate, shade and project fine samples: splats in the places of their layout. Arguments as in `to_splats`."""
    size = tuple(n * fine.supersample for n in fine.pixel.shape)
    wide = Wide(camera.with_apron(size, fine.apron), tuple(n + 2 * fine.apron for n in size))
    if not engine.owns(fine.row):
        fine = constants(fine, engine, like if engine.differentiates else None)
    positions, rgba = _together(*_shown(fine.samples, fine.index, parts, camera, wide, engine, like))
    arrays = fine.index, fine.shift, fine.row, fine.part, fine.facing, fine.settled, fine.wanted
    index, shift, row, part, facing, settled, wanted = constants(arrays, *suiting(positions, rgba))
    moved = take_shifted(positions, index, namespace(positions).astype(shift, positions.dtype))
    return Splats(moved, take(rgba, index), row, part, facing, settled, wanted=wanted, border=fine.apron)


def _shown(
    sampled: Sequence[Samples],
    row: Array,
    parts: Sequence[CheckedPart],
    camera: Camera,
    wide: Wide,
    engine: Engine,
    like: Array | None,
) -> tuple[list[Array], list[Array]]:
    """Positions (N, 3) in a grid and colours (N, C + 1) of the samples of each part.

    Args:
        sampled: the samples of each part.
        row: integers, those of them that are seen.
        parts: checked parts.
        camera: the camera of the whole image, which shaders see.
        wide: the grid, and its camera.
        engine: the engine to compute with.
        like: an array that sets dtype and device of its constants and of what is returned.
    """
    dtype = like
    if not engine.differentiates:
        like = None  # All is constant, and computed in the dtypes that are given.
    seen = wide.camera.replace(view=constants(wide.camera.view, engine, like))
    camera = constants(camera, engine, dtype)
    positions, colors, first = [], [], 0
    for index, (part, samples) in enumerate(zip(parts, sampled, strict=True)):
        theta, transform = theta_of(part, engine, like), constants(part.transform, engine, like)
        local = evaluate(part, samples, engine, like)
        own = seen.within(transform)
        add_footprint(part, samples, local, own, wide.grid, engine, like)
        world, rgba = shade(part, theta, transform, samples, local, camera, engine)
        positions.append(constants(own.project(_on_rays(samples, local["position"]), wide.grid), engine, dtype))
        check_splats(index, part, world, positions[-1], rgba, row, first)
        colors.append(constants(rgba, engine, dtype))
        first += samples.ids.shape[-2]
    if not engine.owns(colors[0]) or (len(parts) > 1 and engine_of(colors) is not engine):
        # A shader may close over arrays of an engine that the scene has none of.
        positions, colors = constants((positions, colors), *suiting(positions, colors))
    return positions, colors


def _shown_in_views(
    index: int,
    part: CheckedPart,
    pictures: Sequence[Views],
    sampled: Sequence[Sampled],
    cameras: Sequence[Camera],
    wides: Sequence[Wide],
    engine: Engine,
    like: Array | None,
) -> tuple[Array, Array]:
    """Positions (N, 3) in their pictures and colours (N, C + 1) of the samples of a part in several views.

    Args:
        index: the part's.
        part: the part; `shaded_at_once`, where the number of samples in each view is not known.
        pictures: the views.
        sampled: their samples, in arrays of the engine.
        cameras: of the whole image of each view.
        wides: the grid of each view, and its camera.
        engine: the engine to compute with.
        like: as in `_shown`.
    """
    dtype = like
    if not engine.differentiates:
        like = None
    whole = in_one_table([own.samples[index] for own in sampled])
    counts, grid = _counts_of(pictures, index), wides[0].grid
    theta, transform = theta_of(part, engine, like), constants(part.transform, engine, like)
    gbuffer = evaluate(part, whole, engine, like)
    view, first = [], 0
    for picture in pictures:
        view.append(picture.view[index] + first if first else picture.view[index])
        first += picture.picture.views
    (view,) = _together([constants(own, engine, like) for own in view])
    seen = [w.camera.replace(view=constants(w.camera.view, engine, like)).within(transform) for w in wides]
    rows = namespace(seen[0].view).stack([own.pixel_rows(grid) for own in seen])
    points = _on_rays(whole, gbuffer["position"])
    rows, points = constants((rows, points), *suiting(rows, points))
    places = _places_of(pictures, engine_of(points), points)
    positions = constants(projective_map_of_views(rows, points, view, places), engine, dtype)
    cameras = constants(cameras, engine, dtype)
    if shaded_at_once(part):
        camera = cameras[0] if part.uniform else RowCameras.of(cameras, view)
        rgba = shade(part, theta, transform, whole, gbuffer, camera, engine)[1]
    else:
        assert counts is not None
        shaded = []
        for own, (samples, local) in zip(seen, apart(whole, gbuffer, counts.tolist(), engine), strict=True):
            add_footprint(part, samples, local, own, grid, engine, like)
            shaded.append((samples, local))

        def colored(given: tuple) -> Array:
            camera, (samples, local) = given
            if not local["position"].shape[0]:
                # Shaders may expect a row at least.
                none = namespace(local["position"]).broadcast_to(
                    local["position"][:, :1], (0, part.shader.channels + 1)
                )
                return constants(none, engine, dtype)
            return constants(shade(part, theta, transform, samples, local, camera, engine)[1], engine, dtype)

        views = list(zip(cameras, shaded, strict=True))
        colors = [colored(views[0])]
        colors += each(colored, views[1:]) if type(colors[0]) is np.ndarray else map(colored, views[1:])
        (rgba,) = _together(colors)
    rgba = constants(rgba, engine, dtype)
    if engine_of(rgba) is not engine:
        positions, rgba = constants((positions, rgba), *suiting(rgba))
    # Where rows are not used, values are not looked at.
    every = np.arange(gbuffer["position"].shape[0], dtype=np.int32)[None, None] if counts is not None else whole.row
    check_splats(index, part, gbuffer, positions, rgba, every, 0)
    return positions, rgba


def _on_rays(samples: Samples, position: Array) -> Array:
    """Positions (N, 3) of samples, put on the rays of their cells where they are not, with the derivative they have.

    Splatters can only tell how samples move from the centres of their cells. There, too, a projection is finite.
    """
    if samples.centered:
        return position
    if ON_RAYS not in samples.tables:
        raise InputError(
            f"samples are not centered, and have no table {ON_RAYS!r}: expected (N, 3), where their cells' rays are at "
            f"their depth"
        )
    engine, like = suiting(position)
    place = namespace(position).astype(constants(samples.tables[ON_RAYS], engine, like), position.dtype, copy=False)
    return place + (position - engine.stop_gradient(position))


def _together(*kinds: Sequence[Array]) -> list[Array]:
    """One array of each kind, positions and colours, from several."""
    return [arrays[0] if len(arrays) == 1 else namespace(arrays[0]).concat(list(arrays)) for arrays in kinds]
