"""From samples to splats: samples evaluated, shaded and projected."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from operator import attrgetter

import numpy as np

from rts.arrays.engines import Context, context_of, engine_of, namespace
from rts.arrays.trees import Array, Tree
from rts.contracts.checked_parts import CheckedPart
from rts.contracts.records import ON_RAYS, Cells, Sampled, Samples, Splats, Stencil
from rts.contracts.result_checks import check_splats
from rts.errors import InputError
from rts.operations.projection import projective_map
from rts.rendering.shade import add_footprint, evaluate, shade, theta_of
from rts.sampling.scene import Grid
from rts.scene.camera import Camera

_OPAQUE = attrgetter("shader.opaque")


def to_splats(sampled: Sampled, parts: Sequence[CheckedPart], camera: Camera, grid: Grid, context: Context) -> Splats:
    """Evaluate, shade and project samples into splats, which keep the border. Fine samples are left out.

    Args:
        sampled: the samples.
        parts: checked parts.
        camera: the camera of the whole image, which shaders see.
        grid: the cells of the samples: those of the image, or a window of it, through the same view.
        context: the engine to compute with, and an exemplar of its constants and of the splats.
    """
    inputs, engine = of_inputs(context), context.engine
    sampled, projection = owned(sampled, sampled.row, context), context.constants(camera.projection)
    camera = camera.replace(view=context.constants(grid.camera.view), projection=projection)
    positions, colors, first = [], [], 0
    for index, (part, samples) in enumerate(zip(parts, sampled.samples, strict=True)):
        theta, transform = theta_of(part, inputs), inputs.constants(part.transform)
        local = evaluate(part, samples, inputs)
        local_camera = grid.cameras[index]
        if not engine.owns(local_camera.view):  # The context's engine is that of the background, or of a shader.
            local_camera = local_camera.replace(view=inputs.constants(local_camera.view))
        rows = local_camera.pixel_rows(grid.size)
        add_footprint(part, samples, local, rows, inputs)
        padded = sampled.stencil is not None and engine.padded(samples.row) and not _has_own_rows(samples)
        used = all_in_use(samples, inputs, sampled.stencil, first) if padded else samples
        world, rgba = shade(part, theta, transform, used, local, camera, engine)
        position = local["position"] if samples.centered else on_rays(samples, local["position"])
        placed = projective_map(rows, position)
        positions.append(context.constants(placed))
        check_splats(index, part, world, positions[-1], rgba, sampled.row, first)
        colors.append(context.constants(rgba))
        first += samples.ids.shape[-2]
    if not engine.owns(colors[0]) or (len(parts) > 1 and engine_of(colors) is not engine):
        # A shader may close over arrays of an engine that the scene has none of.
        positions, colors = context_of(positions, colors).constants((positions, colors))
    placed, rgba = concatenated(positions, colors)
    return splats_of(sampled, parts, placed, rgba, context, border=sampled.border, supersample=sampled.supersample)


def owned(tree: Tree, row: Array, context: Context) -> Tree:
    """Samples in arrays of the context's engine; `row` is one of their arrays."""
    return tree if context.engine.owns(row) else of_inputs(context).constants(tree)


def of_inputs(context: Context) -> Context:
    """The context that converts inputs; for an engine without derivatives, they keep their dtypes."""
    return context if context.engine.differentiates else context._replace(like=None)


def splats_of(
    sampled: Sampled, parts: Sequence[CheckedPart], positions: Array, rgba: Array, context: Context, **more: int
) -> Splats:
    """The splats of samples with these positions and colours; `more` are their `border` and `supersample`."""
    cells, stencil = Cells(sampled.row), sampled.stencil
    if not context.engine.owns(rgba):
        cells, stencil = context_of(positions, rgba).constants((cells, stencil))
    opaque = all(map(_OPAQUE, parts))
    return Splats(positions, rgba, cells, opaque=opaque, stencil=stencil, **more)


def _has_own_rows(samples: Samples) -> bool:
    """True if samples have a cell (1, 1, N) for each row, −1 where it is not used, not those (K, H, W) of the image."""
    return samples.row.shape[-2:] == (1, samples.ids.shape[-2])


def all_in_use(samples: Samples, context: Context, stencil: Stencil | None, first: int) -> Samples:
    """The samples with cells of their own, one a row, so that no row passes for unused; or all do, if none is in use.

    Args:
        samples: the samples of a part.
        context: of their arrays.
        stencil: names the samples beside outlines, behind those of cells; None if some row is in use.
        first: the index of the part's first sample.
    """
    xp, count = namespace(samples.row), samples.ids.shape[-2]
    every = context.constants(np.arange(count, dtype=np.int32)[None, None])
    if stencil is None:
        return replace(samples, cells=replace(samples.cells, row=every))
    there = xp.any(samples.row >= 0)
    known: Stencil = context.constants(stencil)
    # Entries of weight 0 fill up the room.
    named = [(known.motion_sample, xp.any(known.motion_weight != 0, axis=1))]
    weighed = known.color_weight != 0
    if known.stacks is None:
        named.append((known.color_sample, weighed))
    elif known.stacks.shape[0]:  # Colours are composites: of cells, and then of stacks, of which some fill up room.
        stack = known.color_sample - known.joined.shape[1] * known.joined.shape[2]
        shares = xp.where((weighed & (stack >= 0))[:, None], xp.abs(known.color_weight[:, None]), 0.0)
        sums = context.engine.segment_sum(shares, xp.clip(stack, 0), known.stacks.shape[0])
        named.append((known.stacks, sums > 0))
    for rows, counts in named:
        there = there | xp.any((rows >= first) & (rows < first + count) & counts)
    return replace(samples, cells=replace(samples.cells, row=xp.where(there, every, -1)))


def on_rays(samples: Samples, position: Array) -> Array:
    """Positions (N, 3) of samples that are not centred, moved onto the rays of their cells; derivatives stay.

    Splatters need samples whose motion starts at their cells' centres. On the rays, projections are finite, too.
    """
    if ON_RAYS not in samples.tables:
        raise InputError(
            f"samples are not centered, and have no table {ON_RAYS!r}: expected (N, 3), where their cells' rays are at "
            f"their depth"
        )
    context = context_of(position)
    place = namespace(position).astype(context.constants(samples.tables[ON_RAYS]), position.dtype, copy=False)
    return place + (position - context.engine.stop_gradient(position))


def concatenated(*kinds: Sequence[Array]) -> list[Array]:
    """One concatenated array of each kind, such as positions and colours."""
    return [arrays[0] if len(arrays) == 1 else namespace(arrays[0]).concat(list(arrays)) for arrays in kinds]
