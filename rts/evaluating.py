"""Samples evaluated, shaded and projected: what splatters take, differentiably."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cache, partial

import numpy as np

from rts.arrays import described, shape_of
from rts.camera import Camera
from rts.checks import check_shaded, check_splats
from rts.engines import Engine, constants, engine_of, is_constant, namespace, suiting
from rts.errors import InputError
from rts.footprints import FOOTPRINT, uv_footprint
from rts.gbuffer import GBuffer
from rts.interfaces import CheckedPart
from rts.operations.linear import affine_map
from rts.operations.take import take
from rts.records import Fine, Sampled, Samples, Splats
from rts.sampling.scenes import Wide
from rts.sampling.several import Views, in_one_table
from rts.trees import Array, Tree


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
    return _splats(sampled, positions, rgba, engine).replace(border=apron)


def views_to_splats(
    pictures: Sequence[Views],
    parts: Sequence[CheckedPart],
    cameras: Sequence[Camera],
    engine: Engine,
    like: Array | None,
) -> list[Splats]:
    """The splats of pictures of several views: those of a picture have no border, but cells that are wanted.

    A surface is asked once, for the samples of all views: what it computes of the whole of θ serves them all. Shaders
    are asked for the samples of each view.

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
    by_part = []
    for index, part in enumerate(parts):
        whole = in_one_table([own.samples[index] for own in sampled])
        gbuffer = _evaluate(part, part.surface.reads(part.theta), whole, engine, like)
        by_part.append(_apart(whole, gbuffer, np.concatenate([p.counts[index] for p in pictures]).tolist(), engine))
    by_view, shown, made = iter(zip(cameras, *by_part, strict=True)), [], []
    for picture, own in zip(pictures, sampled, strict=True):
        view, border = picture.picture.view, own.apron
        size = view[0] - 2 * border, view[1] - 2 * border
        shown = []
        for camera, *tables in itertools.islice(by_view, picture.picture.views):
            wide = Wide(camera.with_apron(size, border), view)
            samples, evaluated = zip(*tables, strict=True)
            # All rows are used.
            every = np.arange(sum(s.ids.shape[0] for s in samples), dtype=np.int32)[None, None]
            shown.append(_shown(samples, every, parts, camera, wide, engine, like, evaluated))
        by_kind = [list(zip(*kind, strict=True)) for kind in zip(*shown, strict=True)]
        positions, rgba = _together(*([x for of_part in kind for x in of_part] for kind in by_kind))
        positions = _placed(positions, picture, [[p.shape[0] for p in of_part] for of_part in by_kind[0]])
        wanted = engine_of(positions).constant(picture.picture.inside(border), positions)
        made.append(_splats(own, positions, rgba, engine).replace(wanted=wanted))
    return made


def _placed(positions: Array, views: Views, counts: Sequence[Sequence[int]]) -> Array:
    """Positions (N, 3) in a picture of views, from those in views; of each part and view there are so many."""
    engine, every = engine_of(positions), np.ravel(counts)
    corners = np.tile(views.picture.corners(), (len(counts), 1))
    shift = np.zeros((len(corners), 3), np.float32)
    shift[:, :2] = corners
    if views.scales is not None:
        factors = np.ones((len(corners), 3))
        factors[:, 2] = np.tile(views.scales, len(counts))
        positions = positions * engine.constant(np.repeat(factors, every, axis=0), positions)
    return positions + engine.constant(np.repeat(shift, every, axis=0), positions)


def _splats(sampled: Sampled, positions: Array, rgba: Array, engine: Engine) -> Splats:
    """The splats of samples whose positions and colours are known."""
    cells = sampled.row, sampled.part, sampled.facing, sampled.settled, sampled.exit
    if not engine.owns(rgba):
        cells = constants(cells, *suiting(positions, rgba))
    *cells, exits = cells
    return Splats(positions, rgba, *cells, exit=exits)


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
    xp = namespace(positions)
    moved = take(positions, index) + xp.astype(shift, positions.dtype)
    return Splats(moved, take(rgba, index), row, part, facing, settled, wanted=wanted, border=fine.apron)


def _shown(
    sampled: Sequence[Samples],
    row: Array,
    parts: Sequence[CheckedPart],
    camera: Camera,
    wide: Wide,
    engine: Engine,
    like: Array | None,
    evaluated: Sequence[GBuffer] | None = None,
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
        evaluated: the G-buffer of each part, if it is known.
    """
    dtype = like
    if not engine.differentiates:
        like = None  # All is constant, and computed in the dtypes that are given.
    seen = wide.camera.replace(view=constants(wide.camera.view, engine, like))
    camera = constants(camera, engine, like)
    positions, colors, first = [], [], 0
    for index, (part, samples) in enumerate(zip(parts, sampled, strict=True)):
        transform = constants(part.transform, engine, like)
        reads = part.surface.reads(part.theta)
        local = _evaluate(part, reads, samples, engine, like) if evaluated is None else evaluated[index]
        own = seen.within(transform)
        if "uv" in local and FOOTPRINT not in local:
            given = part.surface, {k: part.theta[k] for k in reads}, samples, local, own, wide.grid, engine, like
            local.defer(FOOTPRINT, partial(uv_footprint, *given))
        theta = {k: v if k in reads else constants(v, engine, like) for k, v in part.theta.items()}
        world = _to_world(_readable(local, samples, engine), transform)
        rgba = _shaded(part, theta, world, camera)
        check_shaded(rgba, local["position"].shape[0], part.shader)
        positions.append(constants(own.project(local["position"], wide.grid), engine, dtype))
        check_splats(index, part, world, positions[-1], rgba, row, first)
        colors.append(constants(rgba, engine, dtype))
        first += samples.ids.shape[-2]
    if not engine.owns(colors[0]) or (len(parts) > 1 and engine_of(colors) is not engine):
        # A shader may close over arrays of an engine that the scene has none of.
        positions, colors = constants((positions, colors), *suiting(positions, colors))
    return positions, colors


def _together(*kinds: Sequence[Array]) -> list[Array]:
    """One array of each kind, positions and colours, from several."""
    return [arrays[0] if len(arrays) == 1 else namespace(arrays[0]).concat(list(arrays)) for arrays in kinds]


def _apart(samples: Samples, gbuffer: GBuffer, sizes: Sequence[int], engine: Engine) -> list[tuple[Samples, GBuffer]]:
    """The samples of several views, of so many rows each, and their G-buffers, from those of them all."""
    split = cache(lambda name: engine.split(gbuffer[name], sizes))
    rows = [engine.split(x, sizes) for x in (samples.ids, samples.params, *samples.tables.values())]
    views = []
    for b, (ids, params, *tables) in enumerate(zip(*rows, strict=True)):
        own = GBuffer(position=split("position")[b])
        for name in set(gbuffer) - {"position"}:
            own.defer(name, lambda name=name, b=b: split(name)[b])
        tables = dict(zip(samples.tables, tables, strict=True))
        views.append((replace(samples, ids=ids, params=params, tables=tables, gbuffer=None), own))
    return views


def _shaded(part: CheckedPart, theta: Mapping[str, Tree], gbuffer: GBuffer, camera: Camera) -> Array:
    """What the shader of a part returns."""
    try:
        return part.shader(theta, gbuffer, camera)
    except TypeError as error:
        if is_constant(gbuffer.like):
            error.add_note(
                "All arrays of this scene are NumPy's. If its shader holds a network, call rts.render(…, "
                "engine='torch'), or 'jax'."
            )
        raise


def _evaluate(part: CheckedPart, reads: Sequence[str], samples: Samples, engine: Engine, like: Array | None) -> GBuffer:
    """The part's G-buffer in local space, of the entries of θ that its surface reads."""
    theta = {name: part.theta[name] for name in reads}
    if samples.gbuffer is not None and is_constant(theta):
        wanted = part.shader.reads
        if samples.asked is None or (wanted is not None and set(wanted) <= set(samples.asked)):
            return GBuffer(samples.gbuffer)
    gbuffer = part.surface.evaluate(constants(theta, engine, like), samples)
    gbuffer = gbuffer if isinstance(gbuffer, GBuffer) else GBuffer(gbuffer)
    if shape_of(gbuffer["position"]) != (samples.ids.shape[0], 3):
        position = described(gbuffer["position"])
        raise InputError(f"'position' of {part.surface!r} {position}; expected ({samples.ids.shape[0]}, 3)")
    return gbuffer


def _readable(gbuffer: GBuffer, samples: Samples, engine: Engine) -> GBuffer:
    """The G-buffer for shaders: rows that no cell refers to hold values at which derivatives are finite, too."""
    if not engine.padded(samples.row):
        return gbuffer
    found = GBuffer()
    found.like = gbuffer["position"]
    for name in gbuffer:
        found.defer(name, lambda name=name: engine.fill_unused(gbuffer[name], samples.row))
    return found


def _to_world(gbuffer: GBuffer, transform: Array | None) -> GBuffer:
    """Positions and normals moved by the part's transform."""
    if transform is None:
        return gbuffer
    world = GBuffer()
    world.like = gbuffer.like
    for name in gbuffer:
        world.defer(name, lambda name=name: gbuffer[name])
    world.defer("position", lambda: affine_map(transform[:3, :], gbuffer["position"]))
    if "normal" in gbuffer:
        world.defer("normal", lambda: _move_normals(transform, gbuffer["normal"]))
    return world


def _move_normals(transform: Array, normals: Array) -> Array:
    """Normals under an affine map: times the cofactor matrix, turned so that a mirror image keeps its outside."""
    xp = namespace(transform)
    a, b, c = (transform[:3, i] for i in range(3))
    cofactors = [xp.linalg.cross(b, c), xp.linalg.cross(c, a), xp.linalg.cross(a, b)]
    volume = xp.sum(a * cofactors[0])
    outside = xp.where(volume < 0, -xp.ones_like(volume), xp.ones_like(volume))
    return sum(normals[:, i : i + 1] * (cofactors[i] * outside) for i in range(3))
