"""The footprint of a cell on the texture: changes of uv from sample to sample, by derivatives of the surface."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from rts.arrays.engine_base import Engine
from rts.arrays.engines import constants, namespace, stopped
from rts.arrays.trees import Array, Tree, leaves, map_leaves
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
    found = _on_host(surface, theta, samples, gbuffer, rows, view)
    if found is not None:
        return engine.constant(found, gbuffer["uv"])
    arrays = theta, rows, gbuffer["position"], gbuffer["uv"], samples.params
    theta, rows, position, uv, params = (stopped(constants(x, engine, like)) for x in arrays)
    xp, rows = namespace(position), rows[..., :3, :]
    linear = xp.concat([rows[..., :3], xp.zeros_like(rows[..., 3:])], axis=-1)

    def mapped(rows: Array, points: Array) -> Array:
        return affine_map(rows, points) if view is None else affine_map_of_views(rows, points, view)

    if STEPS in gbuffer:
        steps = stopped(constants(gbuffer[STEPS], engine, like))
    else:
        steps = _steps(surface, theta, replace(samples, params=params), position, uv)
    pixel, moves = mapped(rows, position), []
    for moved in (steps[:, 0:3], steps[:, 3:6]):
        offset = mapped(linear, moved)
        # The derivative of (p₀, p₁) / p₂.
        moves.append((offset[:, :2] * pixel[:, 2:3] - pixel[:, :2] * offset[:, 2:3]) / _safe(pixel[:, 2:3] ** 2))
    first, second, (ax, ay), (bx, by) = steps[:, 6:8], steps[:, 8:10], *((m[:, 0:1], m[:, 1:2]) for m in moves)
    # Where the surface is seen edge-on, the determinant is zero, and uv changes without bound.
    determinant = _safe(ax * by - ay * bx)
    along_x, along_y = first * by - second * ay, second * ax - first * bx
    return xp.astype(xp.concat([along_x, along_y], axis=1) / determinant, uv.dtype)


def _steps(surface: Surface, theta: Mapping[str, Tree], samples: Samples, position: Array, uv: Array) -> Array:
    """The attribute "uv_steps" (N, 10) of `rts.GBuffer`, by evaluations of the surface beside its samples."""
    moves, changes = zip(*steps_beside(surface, theta, samples, position, uv), strict=True)
    return namespace(position).concat([*moves, *changes], axis=1)


def _on_host(
    surface: Surface,
    theta: Mapping[str, Tree],
    samples: Samples,
    gbuffer: Mapping[str, Array],
    rows: Array,
    view: Array | None,
) -> np.ndarray | None:
    """The footprints in NumPy, where all that they depend on is at hand; else None. Arguments as of `uv_footprint`."""
    arrays = stopped((theta, rows, gbuffer["position"], gbuffer["uv"], samples.ids, samples.params))
    known = list(map(known_value, leaves(arrays)))
    if any(x is None for x in known) or known[-3].ndim != 2:
        return None
    theta, rows, position, uv, ids, params = map_leaves(known_value, arrays)
    if STEPS in gbuffer:
        steps = known_value(stopped(gbuffer[STEPS]))
    else:
        on_host = replace(samples, ids=ids, params=params)
        own = surface.evaluate(theta, on_host)
        steps = own[STEPS] if STEPS in own else _steps(surface, theta, on_host, position, uv)
    from rts.shading.uv_footprints_loops import footprints

    numbers = np.zeros(0, np.int32) if view is None else known_value(view)
    if steps is None or numbers is None:
        return None
    out = np.empty((len(position), 4), position.dtype)
    of_views = np.asarray(rows, np.float64).reshape(-1, *rows.shape[-2:])[:, :3]
    operands = map(read_only, (of_views, numbers.astype(np.int32), position, np.asarray(steps, position.dtype)))
    parallel(footprints, len(position), *operands, out, work=40 * len(position))
    return out


def _safe(x: Array) -> Array:
    xp = namespace(x)
    return xp.where(xp.abs(x) < LEAST, LEAST, x)
