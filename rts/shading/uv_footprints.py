"""The footprint of a cell on the texture: changes of uv from sample to sample, by derivatives of the surface."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from rts.arrays.engine_base import Engine
from rts.arrays.engines import constants, namespace, stopped
from rts.arrays.trees import Array, Tree
from rts.contracts.records import Samples
from rts.contracts.surface import Surface
from rts.operations.linear import affine_map, affine_map_of_views
from rts.shading.parameter_steps import check_two_parameters, steps_beside

FOOTPRINT = "uv_footprint"
"""Name of the attribute in the G-buffer."""
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
    effect. The surface is evaluated once for each parameter, `Surface.param_step` away from the sample's. The
    projection is differentiated exactly.

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
    xp, rows = namespace(position), rows[..., :3, :]
    linear = xp.concat([rows[..., :3], xp.zeros_like(rows[..., 3:])], axis=-1)

    def mapped(rows: Array, points: Array) -> Array:
        return affine_map(rows, points) if view is None else affine_map_of_views(rows, points, view)

    pixel, moves, changes = mapped(rows, position), [], []
    for moved, change in steps_beside(surface, theta, replace(samples, params=params), position, uv):
        offset = mapped(linear, moved)
        # The derivative of (p₀, p₁) / p₂.
        moves.append((offset[:, :2] * pixel[:, 2:3] - pixel[:, :2] * offset[:, 2:3]) / _safe(pixel[:, 2:3] ** 2))
        changes.append(change)
    (ax, ay), (bx, by) = ((m[:, 0:1], m[:, 1:2]) for m in moves)
    # Where the surface is seen edge-on, the determinant is zero, and uv changes without bound.
    determinant = _safe(ax * by - ay * bx)
    along_x = changes[0] * by - changes[1] * ay
    along_y = changes[1] * ax - changes[0] * bx
    return xp.astype(xp.concat([along_x, along_y], axis=1) / determinant, uv.dtype)


def _safe(x: Array) -> Array:
    xp = namespace(x)
    return xp.where(xp.abs(x) < LEAST, LEAST, x)
