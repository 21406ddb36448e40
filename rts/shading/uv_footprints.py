"""The footprint of a cell on the texture: changes of uv from sample to sample, by derivatives of the surface."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from rts.arrays.engine_base import Engine
from rts.arrays.engines import constants, namespace, stopped
from rts.arrays.trees import Array, Tree
from rts.compiling.threads import parallel, read_only
from rts.contracts.gbuffer import FOOTPRINT, STEPS
from rts.contracts.records import Samples
from rts.contracts.surface import Surface
from rts.operations.linear import affine_map, affine_map_of_views
from rts.operations.operation import known_value
from rts.shading.parameter_steps import check_two_parameters, steps_beside

LEAST = 1e-30
"""Smallest divisor; numbers of smaller absolute value are replaced by it."""


def uv_footprint(
    surface: Surface,
    theta: Mapping[str, Tree],
    samples: Samples,
    gbuffer: Mapping[str, Array],
    rows: Array,
    view: Array | None,
    engine: Engine,
    like: Array | None,
) -> Array:
    """∂u/∂x, ∂v/∂x, ∂u/∂y, ∂v/∂y (N, 4) for one cell to the right and one cell down; without derivative.

    The derivative is taken on the tangent plane of each sample, without other samples: outlines and seams of uv have no
    effect. Where the surface does not give "uv_steps", it is evaluated once for each parameter, `Surface.param_step`
    away from the sample's. The projection is differentiated exactly.

    Args:
        surface: a surface of two parameters a sample.
        theta: the entries that the surface reads.
        samples: the samples.
        gbuffer: "position" (N, 3), local space, and "uv" (N, 2) of the samples.
        rows: (R, 4), R at least 3, `Camera.pixel_rows` of the grid of cells, by the camera in the surface's local
            space; or (B, R, 4), those of several views.
        view: (N,) int32, the view of each sample; see `rts.operations.by_view`. None for one view.
        engine: the engine to compute with.
        like: an array that sets dtype and device of its constants.

    Raises:
        InputError: samples have another number of parameters than two.
    """
    check_two_parameters(surface, samples, FOOTPRINT, "mipmaps")
    arrays = theta, rows, gbuffer["position"], gbuffer["uv"], samples.params
    theta, rows, position, uv, params = (stopped(constants(x, engine, like)) for x in arrays)
    known, samples = gbuffer, replace(samples, params=params)
    if STEPS not in gbuffer and samples.gbuffer is not None:  # Of a constant surface, with what the shader reads alone.
        known = surface.evaluate(theta, samples)
    if STEPS in known:
        steps = stopped(constants(known[STEPS], engine, like))
    else:
        moves, changes = zip(*steps_beside(surface, theta, samples, position, uv), strict=True)
        steps = namespace(position).concat([*moves, *changes], axis=1)
    found = _on_host(rows, view, position, steps)
    return engine.constant(found, uv) if found is not None else _specified(rows[..., :3, :], view, position, steps)


def _on_host(rows: Array, view: Array | None, position: Array, steps: Array) -> np.ndarray | None:
    """The footprints in NumPy, where all that they depend on is at hand; else None."""
    given = (rows, position, steps) if view is None else (rows, position, steps, view)
    arrays = [known_value(x) for x in given]
    # Where a transform maps over several, values have an axis more.
    if any(x is None or x.ndim != len(y.shape) for x, y in zip(arrays, given, strict=True)):
        return None
    from rts.shading.uv_footprints_loops import footprints

    of_rows, host, beside, *numbers = (np.asarray(x) for x in arrays)
    out = np.empty((len(host), 4), host.dtype)
    of_views = of_rows.astype(np.float64).reshape(-1, *of_rows.shape[-2:])[:, :3]
    views = np.concatenate([np.empty(0, np.int32), *numbers], dtype=np.int32, casting="unsafe")
    operands = map(read_only, (of_views, views, host, beside.astype(host.dtype, copy=False)))
    parallel(footprints, len(host), *operands, out, work=40 * len(host))
    return out


def _specified(rows: Array, view: Array | None, position: Array, steps: Array) -> Array:
    """The footprints in array code."""
    xp = namespace(position)
    linear = xp.concat([rows[..., :3], xp.zeros_like(rows[..., 3:])], axis=-1)

    def mapped(rows: Array, points: Array) -> Array:
        return affine_map(rows, points) if view is None else affine_map_of_views(rows, points, view)

    pixel, moves = mapped(rows, position), []
    for moved in (steps[:, 0:3], steps[:, 3:6]):
        offset = mapped(linear, moved)
        # The derivative of (p₀, p₁) / p₂.
        moves.append((offset[:, :2] * pixel[:, 2:3] - pixel[:, :2] * offset[:, 2:3]) / _safe(pixel[:, 2:3] ** 2))
    first, second, (ax, ay), (bx, by) = steps[:, 6:8], steps[:, 8:10], *((m[:, 0:1], m[:, 1:2]) for m in moves)
    # Where the surface is seen edge-on, the determinant is zero, and uv changes without bound.
    determinant = _safe(ax * by - ay * bx)
    along_x, along_y = first * by - second * ay, second * ax - first * bx
    return xp.astype(xp.concat([along_x, along_y], axis=1) / determinant, position.dtype)


def _safe(x: Array) -> Array:
    xp = namespace(x)
    return xp.where(xp.abs(x) < LEAST, LEAST, x)
