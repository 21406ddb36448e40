"""Evaluating and shading a part at samples: its G-buffer in world space, and its colours."""

from __future__ import annotations

import threading
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import cache, partial
from typing import Any

from rts.arrays.array_functions import kind_of
from rts.arrays.engine_base import Engine
from rts.arrays.engines import Context, is_constant
from rts.arrays.trees import Array, Tree
from rts.contracts.checked_parts import CheckedPart
from rts.contracts.gbuffer import FOOTPRINT, GBuffer
from rts.contracts.records import Samples
from rts.contracts.result_checks import check_attribute, check_shaded
from rts.errors import InputError
from rts.rendering.part_transforms import OneTransform, ViewTransforms
from rts.scene.camera import Camera
from rts.scene.row_cameras import RowCameras
from rts.shading.tangents import OWN_UV, TANGENT, tangents


def evaluate(part: CheckedPart, samples: Samples, context: Context) -> GBuffer:
    """The part's G-buffer at the samples, local space, with deferred tangents if it has coordinates but no "tangent".

    The samples' own G-buffer is taken, if they have one, where the surface's θ is constant and the G-buffer has all
    that the shader reads.
    """
    gbuffer = _evaluated(part, samples, context)
    if ("uv" in gbuffer or OWN_UV in gbuffer) and "normal" in gbuffer and TANGENT not in gbuffer:
        gbuffer.defer(TANGENT, lambda: tangents(part.surface, context.constants(part.read), samples, gbuffer, context))
    return gbuffer


def _evaluated(part: CheckedPart, samples: Samples, context: Context) -> GBuffer:
    """The G-buffer of the part's surface at the samples; see `evaluate`."""
    theta = part.read
    if samples.gbuffer is not None and is_constant(theta):
        wanted = part.reads
        if samples.gbuffer_names is None or (wanted is not None and set(wanted) <= set(samples.gbuffer_names)):
            return _checked(GBuffer(samples.gbuffer), part, samples)
    gbuffer = part.surface.evaluate(context.constants(theta), samples)
    known = type(gbuffer) is GBuffer or isinstance(gbuffer, Mapping)
    if not known or "position" not in gbuffer:
        what = f"one with {sorted(gbuffer)}" if known else kind_of(gbuffer)
        raise InputError(f"evaluate of {part.surface!r} gave {what}; expected an rts.GBuffer with 'position'")
    return _checked(gbuffer if isinstance(gbuffer, GBuffer) else GBuffer(gbuffer), part, samples)


def _checked(gbuffer: GBuffer, part: CheckedPart, samples: Samples) -> GBuffer:
    """A G-buffer of a part whose attributes are refused where they are wrong."""
    gbuffer.check(partial(check_attribute, part.surface, samples.ids.shape[0]))
    return gbuffer


def shaded_at_once(part: CheckedPart) -> bool:
    """True if a part's shader takes the samples of several views in one call, or gives one colour."""
    return part.uniform or (part.takes_views and part.reads is not None)


def theta_of(part: CheckedPart, context: Context) -> dict[str, Tree]:
    """The θ that a part's shader sees: NumPy entries are the engine's constants, but those of the surface alone."""
    left = set() if part.reads is None else set(part.read) - set(part.reads)
    return {k: v if k in left else context.constants(v) for k, v in part.theta.items()}


def add_footprint(
    part: CheckedPart, samples: Samples, local: GBuffer, rows: Array, context: Context, view: Array | None = None
) -> None:
    """Add a deferred "uv_footprint" to the G-buffer `local` of samples, if it has "uv" but no footprint.

    Samples of another number of parameters than two have none. Other arguments are as in `uv_footprint`.
    """
    if "uv" in local and FOOTPRINT not in local and samples.params.shape[-1] == 2:

        def footprint() -> Array:
            from rts.shading.uv_footprints import uv_footprint

            return uv_footprint(part.surface, part.read, samples, local, rows, view, *context)

        local.defer(FOOTPRINT, footprint)


def shade(
    part: CheckedPart,
    theta: Mapping[str, Tree],
    transform: Array | ViewTransforms | None,
    samples: Samples,
    local: GBuffer,
    camera: Camera | RowCameras,
    engine: Engine,
) -> tuple[GBuffer, Array]:
    """The G-buffer of a part in world space, and the colours (N, C + 1) of its shader.

    Args:
        part: the part.
        theta: the result of `theta_of`.
        transform: the part's transform, in arrays of the engine; or that of each sample.
        samples: the samples.
        local: their G-buffer, in local space.
        camera: the camera of the whole image, or of each sample.
        engine: the engine to compute with.
    """
    padded = engine.padded(samples.row)
    # Unused rows hold values with finite derivatives for the shader, too.
    changes = dict.fromkeys(local, lambda x: engine.fill_unused(x, samples.row)) if padded else {}
    world = _to_world(local.changed(changes) if padded else local, transform)
    rgba = _shaded(part, theta, world, camera)
    check_shaded(rgba, samples.ids.shape[-2], part.shader)
    if part.uniform or not padded:  # One colour, however many rows are in use; or all are.
        return world, rgba
    rows, names = local.computed, [*local]
    if isinstance(camera, RowCameras):
        rows[NUMBER] = camera.number

    def few(rows: dict[str, Array]) -> Array:
        """The colours of some rows of the attributes that the shader has read in its first call, in local space."""
        row_cameras = camera.of_rows(rows.pop(NUMBER)) if isinstance(camera, RowCameras) else camera
        few_local = GBuffer(rows)
        for name in set(names) - set(rows):
            few_local.defer(name, _unread)
        return _shaded(part, theta, _to_world(few_local, transform), row_cameras)

    with suppress(_UnreadError):
        rgba = engine.by_rows_in_use(few, rows, samples.row, rgba)
    return world, rgba


NUMBER = "the numbers of views"
"""The key of `RowCameras.number` among attributes; no attribute has this name."""


def split_by_view(
    samples: Samples, gbuffer: GBuffer, sizes: Sequence[int], engine: Engine
) -> list[tuple[Samples, GBuffer]]:
    """The samples and G-buffer of each view, cut from the arrays of all views; `sizes` are numbers of rows."""
    pieces_of, lock = cache(lambda name: engine.split(gbuffer[name], sizes)), threading.Lock()

    def split(name: str) -> Sequence[Array]:
        with lock:  # Views are shaded by several threads.
            return pieces_of(name)

    split_tables = [samples.tables[name] for name in samples.by_sample]
    rows = [engine.split(x, sizes) for x in (samples.ids, samples.params, *split_tables)]
    views = []
    for b, (ids, params, *tables) in enumerate(zip(*rows, strict=True)):
        view_gbuffer = GBuffer(position=split("position")[b])
        for name in set(gbuffer) - {"position"}:
            view_gbuffer.defer(name, lambda name=name, b=b: split(name)[b])
        tables = {**samples.tables, **dict(zip(samples.by_sample, tables, strict=True))}
        views.append((replace(samples, ids=ids, params=params, tables=tables, gbuffer=None), view_gbuffer))
    return views


def _shaded(part: CheckedPart, theta: Mapping[str, Tree], gbuffer: GBuffer, camera: Any) -> Array:
    """The result of a part's shader."""
    try:
        return part.shader(theta, gbuffer, camera)
    except TypeError as error:
        if is_constant(gbuffer.like):
            error.add_note(
                "All arrays of this scene are NumPy's. If its shader holds a network, call rts.render(…, "
                "engine='torch'), or 'jax'."
            )
        raise


class _UnreadError(Exception):
    """A shader reads an attribute that it did not read in its first call."""


def _unread() -> Array:
    raise _UnreadError


def _to_world(gbuffer: GBuffer, transform: Array | ViewTransforms | None) -> GBuffer:
    """The G-buffer with positions, normals and tangents moved by the part's transform."""
    if transform is None:
        return gbuffer
    moves = transform if isinstance(transform, ViewTransforms) else OneTransform(transform)
    changes = {"position": moves.points, "normal": moves.normals, TANGENT: moves.tangents}
    return gbuffer.changed({**changes, "face_normal": partial(moves.normals, moving=False)})
