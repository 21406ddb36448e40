"""Operations that move an isosurface's samples with the field: along its gradient, or along the lattice's edges.

Both take values (M,), params (N, P) in their dtype, and rows (N, 6) int32: the six values of each sample.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rts import InputError, engine_of, namespace
from rts.plugin_api.arrays import Array
from rts.plugin_api.operations import Operation, combine, take
from rts.plugin_api.threads import parallel, read_only
from rts_surfaces.implicit.lattice import Lattice

Edges = tuple[tuple[int, ...], tuple[float, ...], tuple[float, ...]]
"""Shape, first point and step of a lattice."""

_WEIGHTS, _PLACE, _ALONG = slice(3, 9), slice(9, 12), slice(12, 15)
"""Parameters of a sample: the weights of the six values, its place, and its motion for a unit of level."""


def _by_level(values: Array, params: Array, rows: Array, *, isovalue: float, sign: float) -> Array:
    xp, weights = namespace(values, params), params[:, _WEIGHTS]
    level = combine(values[:, None], rows, weights)[:, 0] - isovalue * xp.sum(weights, axis=1) - params[:, 15]
    return params[:, _PLACE] - sign * level[:, None] * params[:, _ALONG]


def _shape(values: tuple[int, ...], params: tuple[int, ...], *_: object, **__: object) -> tuple[int, ...]:
    return params[0], 3


def _checked(operands: Sequence[np.ndarray], width: int) -> Sequence[np.ndarray]:
    values, params, *numbers = operands
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
    return operands


def _forward(operands: Sequence[np.ndarray], out: np.ndarray, *, isovalue: float, sign: float) -> None:
    from rts_surfaces.implicit import motion_loops

    values, params, rows = _checked(operands, 16)
    real = values.dtype.type
    parallel(motion_loops.move, len(rows), values, params, rows, real(isovalue), real(sign), out, work=30 * len(rows))


def _push(
    operands: Sequence[np.ndarray], tangents: Sequence[np.ndarray], out: np.ndarray, *, isovalue: float, sign: float
) -> None:
    from rts_surfaces.implicit import motion_loops

    values, params, rows = _checked(operands, 16)
    arguments = read_only(tangents[0]), params, rows, values.dtype.type(sign), out
    parallel(motion_loops.push, len(rows), *arguments, work=30 * len(rows))


def _pull(
    operands: Sequence[np.ndarray], g: np.ndarray, results: Sequence[np.ndarray | None], *, isovalue: float, sign: float
) -> None:
    from rts_surfaces.implicit import motion_loops

    values, params, rows = _checked(operands, 16)
    if results[0] is not None:
        motion_loops.pull(read_only(g), params, rows, values.dtype.type(sign), results[0])


ALONG_NORMAL = Operation(
    "rts_surfaces.along_normal",
    _by_level,
    ranks=(1, 2, 2),
    shape=_shape,
    forward=_forward,
    push=_push,
    pull=_pull,
    packed=(1, 2),
    packed_result=True,
)
"""(N, 3): where samples are, less their vector times the change of the level `sign * (value - isovalue)`, by weights
of six values. A sample's params (16) are barycentrics, these weights, place, vector, and the sum at sampling."""


# ------------------------------------------------------------------------------------------------ along edges


def _by_crossings(
    values: Array, params: Array, rows: Array, numbers: Array, *, isovalue: float, lattice: Edges
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
    """The place (N,) along an edge where the level is zero; its derivative as if the ends differed by `least`."""
    engine = engine_of(f_a)
    xp, apart = engine.namespace, f_b - f_a
    same = apart == 0
    exact = -f_a / xp.where(same, xp.ones_like(apart), apart)
    exact = xp.where(same, xp.zeros_like(exact), exact)
    known = engine.stop_gradient(apart)
    singular = xp.abs(known) < least
    bounded = xp.where(known < 0, -least, least)
    along = engine.stop_gradient(exact)
    change = (1 - along) * (f_a - engine.stop_gradient(f_a)) + along * (f_b - engine.stop_gradient(f_b))
    # Neither branch may divide by nothing, chosen or not.
    return xp.where(singular, along - change / xp.where(singular, bounded, xp.ones_like(bounded)), exact)


def _forward_edges(operands: Sequence[np.ndarray], out: np.ndarray, *, isovalue: float, lattice: Edges) -> None:
    from rts_surfaces.implicit import motion_loops

    values, params, rows, numbers = _checked(operands, 4)
    arguments = values, params, rows, numbers, values.dtype.type(isovalue), *lattice, out
    parallel(motion_loops.cross, len(rows), *arguments, work=60 * len(rows))


def _push_edges(
    operands: Sequence[np.ndarray], tangents: Sequence[np.ndarray], out: np.ndarray, *, isovalue: float, lattice: Edges
) -> None:
    from rts_surfaces.implicit import motion_loops

    values, params, rows, numbers = _checked(operands, 4)
    arguments = values, read_only(tangents[0]), params, rows, numbers, values.dtype.type(isovalue), *lattice, out
    parallel(motion_loops.push_crossings, len(rows), *arguments, work=60 * len(rows))


def _pull_edges(
    operands: Sequence[np.ndarray],
    g: np.ndarray,
    results: Sequence[np.ndarray | None],
    *,
    isovalue: float,
    lattice: Edges,
) -> None:
    from rts_surfaces.implicit import motion_loops

    values, params, rows, numbers = _checked(operands, 4)
    if results[0] is not None:
        arguments = values, read_only(g), params, rows, numbers, values.dtype.type(isovalue), *lattice, results[0]
        motion_loops.pull_crossings(*arguments)


ALONG_EDGES = Operation(
    "rts_surfaces.along_edges",
    _by_crossings,
    ranks=(1, 2, 2, 2),
    shape=_shape,
    forward=_forward_edges,
    push=_push_edges,
    pull=_pull_edges,
    packed=(1, 2, 3),
    packed_result=True,
)
"""(N, 3): the points of triangles whose corners lie where three edges of a lattice cross the isovalue. Its last operand
are the numbers (N, 6) of the lattice points at their ends. A sample's params (4) are barycentrics, and by how much the
ends of an edge are taken to differ at least, in derivatives."""
