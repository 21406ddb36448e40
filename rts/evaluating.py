"""Samples evaluated, shaded and projected: what splatters take, differentiably."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cache, partial

from rts.arrays import described, shape_of
from rts.camera import Camera
from rts.checks import check_shaded, check_splats
from rts.engines import Engine, constants, engine_of, is_constant, namespace, suiting
from rts.errors import InputError
from rts.footprints import FOOTPRINT, uv_footprint
from rts.gbuffer import GBuffer
from rts.interfaces import CheckedPart
from rts.operations.linear import affine_map
from rts.operations.take import take, take_shifted
from rts.records import Fine, Sampled, Samples, Splats
from rts.sampling.scenes import Wide
from rts.trees import Array, Tree


def to_splats(
    sampled: Sampled,
    parts: Sequence[CheckedPart],
    camera: Camera,
    window: Camera,
    engine: Engine,
    like: Array | None,
    evaluated: Sequence[GBuffer] | None = None,
) -> Splats:
    """Evaluate, shade and project samples: what splatters take, with the apron as border. Fine ones are left out.

    Args:
        sampled: the samples.
        parts: checked parts.
        camera: the camera of the whole image, which shaders see.
        window: the camera of the samples.
        engine: the engine to compute with.
        like: an array that sets dtype and device of its constants and of the splats.
        evaluated: what `evaluated_together` gave for these samples, if they have been evaluated.
    """
    grid, apron = tuple(sampled.row.shape[1:]), sampled.apron
    wide = Wide(window.with_apron((grid[0] - 2 * apron, grid[1] - 2 * apron), apron), grid)
    if not engine.owns(sampled.row):
        sampled = constants(sampled, engine, like if engine.differentiates else None)
    positions, rgba = _shown(sampled.samples, sampled.row, parts, camera, wide, engine, like, evaluated)
    cells = sampled.row, sampled.part, sampled.facing, sampled.settled, sampled.exit
    if not engine.owns(rgba):
        cells = constants(cells, *suiting(positions, rgba))
    *cells, exits = cells
    return Splats(positions, rgba, *cells, exit=exits, border=apron)


def to_fine_splats(
    fine: Fine, parts: Sequence[CheckedPart], camera: Camera, engine: Engine, like: Array | None
) -> Splats:
    """Evaluate, shade and project fine samples: splats in the places of their layout. Arguments as in `to_splats`."""
    size = tuple(n * fine.supersample for n in fine.pixel.shape)
    wide = Wide(camera.with_apron(size, fine.apron), tuple(n + 2 * fine.apron for n in size))
    if not engine.owns(fine.row):
        fine = constants(fine, engine, like if engine.differentiates else None)
    positions, rgba = _shown(fine.samples, fine.index, parts, camera, wide, engine, like)
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
    evaluated: Sequence[GBuffer] | None = None,
) -> tuple[Array, Array]:
    """Positions (N, 3) in a grid and colours (N, C + 1) of the samples of all parts, in order.

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
        if not part.shader.uniform:
            shade = partial(_colors, part, theta, transform, camera)
            rgba = engine.by_rows_in_use(shade, local.computed, samples.row, rgba)
        colors.append(constants(rgba, engine, dtype))
        first += samples.ids.shape[-2]
    if not engine.owns(colors[0]) or (len(parts) > 1 and engine_of(colors) is not engine):
        # A shader may close over arrays of an engine that the scene has none of.
        positions, colors = constants((positions, colors), *suiting(positions, colors))
    if len(parts) == 1:
        return positions[0], colors[0]
    xp = namespace(positions[0])
    return xp.concat(positions), xp.concat(colors)


def evaluated_together(
    views: Sequence[Sampled], parts: Sequence[CheckedPart], engine: Engine, like: Array | None
) -> list[Sequence[GBuffer] | None]:
    """The G-buffers of all parts at the samples of each of several views, in local space; None where they stay apart.

    A surface is asked once, for the samples of all views: what it computes of the whole of θ serves them all.

    Args:
        views: the samples of each view, in arrays of the engine.
        parts: checked parts.
        engine: the engine to compute with.
        like: an array that sets dtype and device of its constants.
    """
    if not all(_can_be_joined(view, engine) for view in views):
        return [None] * len(views)
    found = []
    for index, part in enumerate(parts):
        own = [view.samples[index] for view in views]
        whole = _evaluate(part, part.surface.reads(part.theta), _joined(own), engine, like)
        found.append(_apart(whole, [samples.ids.shape[0] for samples in own], engine))
    return list(zip(*found, strict=True))


def _can_be_joined(view: Sampled, engine: Engine) -> bool:
    """Whether samples can stand in one table with those of other views: all rows are used, and no table is shared."""
    if not engine.owns(view.row) or engine.padded(view.row):
        return False
    return all(s.gbuffer is None and set(s.by_sample) == set(s.tables) for s in view.samples)


def _joined(views: Sequence[Samples]) -> Samples:
    """The samples of a part in several views as those of one, whose grids lie one above the other."""
    xp, first, rows = namespace(views[0].row), 0, []
    for samples in views:
        rows.append(xp.where(samples.row >= 0, samples.row + first, samples.row))
        first += samples.ids.shape[0]
    return replace(
        views[0],
        ids=xp.concat([s.ids for s in views]),
        params=xp.concat([s.params for s in views]),
        row=xp.concat(rows, axis=1),
        depth=xp.concat([s.depth for s in views], axis=1),
        overflow=sum(s.overflow for s in views),
        tables={name: xp.concat([s.tables[name] for s in views]) for name in views[0].tables},
        facing=None,
        settled=None,
        exit=None,
    )


def _apart(gbuffer: GBuffer, sizes: Sequence[int], engine: Engine) -> list[GBuffer]:
    """The G-buffers of several views, of so many samples each, from one of them all."""
    split = cache(lambda name: engine.split(gbuffer[name], sizes))
    views = []
    for b in range(len(sizes)):
        views.append(GBuffer(position=split("position")[b]))
        for name in set(gbuffer) - {"position"}:
            views[b].defer(name, lambda name=name, b=b: split(name)[b])
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


def _colors(
    part: CheckedPart,
    theta: Mapping[str, Tree],
    transform: Array | None,
    camera: Camera,
    attributes: Mapping[str, Array],
) -> Array:
    """What the shader of a part returns for attributes in local space."""
    return _shaded(part, theta, _to_world(GBuffer(attributes), transform), camera)


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
