"""Operations that move an isosurface's samples with the field: along its gradient, or along the lattice's edges.

Each takes values (M,), the field's at lattice points; params (N, P) in the values' dtype; and rows (N, 6) int32, the
indices of each sample's six values. The six belong to the ends of three edges of the lattice, edge by edge.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from rts import InputError, engine_of, namespace
from rts.plugin_api.arrays import Array
from rts.plugin_api.operations import Operation, combine, take
from rts_surfaces.implicit.lattice import Lattice, Spacing

_WEIGHTS, _PLACE, _ALONG = slice(3, 9), slice(9, 12), slice(12, 15)
"""Columns of a sample's parameters: the weights of the six values, its position, and its motion for a unit of level."""


def _by_level(values: Array, params: Array, rows: Array, *, isovalue: float, sign: float) -> Array:
    xp, weights = namespace(values, params), params[:, _WEIGHTS]
    level = combine(values[:, None], rows, weights)[:, 0] - isovalue * xp.sum(weights, axis=1) - params[:, 15]
    return params[:, _PLACE] - sign * level[:, None] * params[:, _ALONG]


def _shape(values: tuple[int, ...], params: tuple[int, ...], *_: object, **__: object) -> tuple[int, ...]:
    return params[0], 3


def _check(values: np.ndarray, params: np.ndarray, *numbers: np.ndarray, **_: object) -> None:
    width = 16 if len(numbers) == 1 else 4
    for rows in numbers:
        if rows.shape != (len(params), 6) or params.shape[1] != width:
            raise InputError(
                f"ids and params have shapes {rows.shape} and {params.shape}; expected (N, 6) and (N, {width}): sample "
                f"this surface anew"
            )
    rows = numbers[0]
    if rows.size and not 0 <= rows.min() <= rows.max() < len(values):
        raise InputError(
            f"samples refer to values from {rows.min()} to {rows.max()} of {len(values)}; sample this surface anew"
        )


def _loops_along() -> tuple[Callable, Callable, Callable]:
    from rts_surfaces.implicit import motion_loops as loops

    return loops.along, loops.push_along, loops.pull_along


ALONG_NORMAL = Operation.of_loops(
    "rts_surfaces.along_normal",
    _by_level,
    (1, 2, 2),
    _shape,
    _loops_along,
    _check,
    packed=(1, 2),
    packed_result=True,
)
"""Positions (N, 3) of samples: the position at sampling, less the motion for a unit of level, times the change of the
level `sign * (value - isovalue)`. The value is a weighted sum of six. A sample's params (16) are barycentrics (3), the
weights (6), the position (3), the motion (3), and the weighted sum of the values less the isovalue at sampling."""


# ------------------------------------------------------------------------------------------------ along edges


def _by_crossings(
    values: Array, params: Array, rows: Array, numbers: Array, *, isovalue: float, lattice: Spacing
) -> Array:
    xp = namespace(values)
    six = xp.reshape(take(values[:, None], xp.reshape(rows, (-1,))), (-1, 6)) - isovalue
    placed, corners = Lattice.of(*lattice), []
    for k in range(3):
        a, b = (placed.places(numbers[:, 2 * k + i], values.dtype) for i in range(2))
        along = _crossing(six[:, 2 * k], six[:, 2 * k + 1], params[:, 3])
        corners.append(params[:, k : k + 1] * (a + along[:, None] * (b - a)))
    return corners[0] + corners[1] + corners[2]


def _crossing(f_a: Array, f_b: Array, least: Array) -> Array:
    """The places (N,) along edges where the level is zero, 0 at the first end and 1 at the second.

    `f_a` and `f_b` (N,) are the levels at the ends. The place is 0 if they are equal. Where they differ by less than
    `least` (N,), derivatives are as if they differed by that.
    """
    engine = engine_of(f_a)
    xp, difference = engine.namespace, f_b - f_a
    same = difference == 0
    exact = -f_a / xp.where(same, xp.ones_like(difference), difference)
    exact = xp.where(same, xp.zeros_like(exact), exact)
    known = engine.stop_gradient(difference)
    singular = xp.abs(known) < least
    bounded = xp.where(known < 0, -least, least)
    along = engine.stop_gradient(exact)
    change = (1 - along) * (f_a - engine.stop_gradient(f_a)) + along * (f_b - engine.stop_gradient(f_b))
    # Neither branch may divide by nothing, chosen or not.
    return xp.where(singular, along - change / xp.where(singular, bounded, xp.ones_like(bounded)), exact)


def _loops_crossing() -> tuple[Callable, Callable, Callable]:
    from rts_surfaces.implicit import motion_loops as loops

    return loops.crossing, loops.push_crossing, loops.pull_crossing


ALONG_EDGES = Operation.of_loops(
    "rts_surfaces.along_edges",
    _by_crossings,
    (1, 2, 2, 2),
    _shape,
    _loops_crossing,
    _check,
    packed=(1, 2, 3),
    packed_result=True,
)
"""Positions (N, 3) of samples in triangles whose corners lie where three edges of a lattice cross the isovalue. The
last operand are the numbers (N, 6) of the lattice points at the edges' ends. A sample's params (4) are barycentrics
(3), and the least difference of an edge's ends that derivatives assume. An edge whose ends are one point is a fixed
corner."""
