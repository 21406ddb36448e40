"""The sparse product of a stencil with colours, and its derivative, with motions; see `Stencil`."""

from __future__ import annotations

from typing import Any

import numpy as np

from rts.arrays.array_functions import averaged, without_border
from rts.arrays.engines import engine_of, namespace, stopped
from rts.arrays.trees import Array
from rts.compiling.threads import parallel, read_only
from rts.contracts.records import Stencil
from rts.operations.operation import Arrays, Operation, Some
from rts.splatting.cells import check_rows, unpack


def splat(
    positions: Array,
    colors: Array,
    front: Array,
    stencil: Stencil,
    border: int,
    supersample: int = 1,
    joined: Array | None = None,
) -> Array:
    """The image (h, w, C) of pixels, without a `border` of so many cells.

    Args:
        positions: (N, 3) x and y in cells, and depth.
        colors: (M, C) of samples; or composites.
        front: (H, W) int32, the colour of each cell, or −1.
        stencil: the entries.
        border: cells at each side.
        supersample: s; each pixel is the mean of s² cells.
        joined: (2, H, W), in place of `Stencil.joined`.
    """
    of_colors = stencil.color_cell, stencil.color_sample, stencil.color_weight
    of_motions = stencil.motion_cell, stencil.motion_sample, stencil.motion_weight, stencil.motion_colors
    joined = stencil.joined if joined is None else joined
    return SPLAT(positions, colors, front, joined, *of_colors, *of_motions, border=border, supersample=supersample)


def _specification(
    positions: Array,
    colors: Array,
    front: Array,
    joined: Array,
    color_cell: Array,
    color_sample: Array,
    color_weight: Array,
    motion_cell: Array,
    motion_sample: Array,
    motion_weight: Array,
    motion_colors: Array,
    border: int,
    supersample: int,
) -> Array:
    xp, engine, (height, width) = namespace(colors), engine_of(colors), front.shape
    still, motion = stopped(colors), positions - stopped(positions)
    jump = _colors(still, motion_colors[:, 0]) - _colors(still, motion_colors[:, 1])
    rate = xp.sum(motion_weight * xp.take(motion, motion_sample, axis=0), axis=-1)
    terms = color_weight[:, None] * _colors(colors, color_sample), rate[:, None] * jump
    sums = engine.segment_sum(xp.concat(terms), xp.concat([color_cell, motion_cell]), height * width)
    image = _colors(colors, front) - _inside(still, motion, front, joined)
    return averaged(without_border(image + xp.reshape(sums, image.shape), border), supersample)


def _colors(colors: Array, samples: Array) -> Array:
    """Colours (..., C) of samples (...), or 0 for −1."""
    return namespace(colors).where((samples >= 0)[..., None], unpack(colors, samples), 0.0)


def _inside(still: Array, motion: Array, front: Array, joined: Array) -> Array:
    """∇C · m (H, W, C): slopes are means of the differences from and to the next cells of the same surface."""
    xp, color, total = namespace(still), _colors(still, front), 0.0
    # Composites are no samples, and joined to none.
    motion = _colors(motion, xp.where(front < motion.shape[0], front, -1))
    for axis in (0, 1):
        rise = xp.where(joined[axis, ..., None], xp.roll(color, -1, axis=1 - axis) - color, 0.0)
        total = total + (rise + xp.roll(rise, 1, axis=1 - axis)) / 2 * motion[..., axis, None]
    return total


def _shape(
    positions: tuple[int, ...], colors: tuple[int, ...], front: tuple[int, ...], *_: Any, border: int, supersample: int
) -> tuple[int, ...]:
    height, width = max(0, front[0] - 2 * border), max(0, front[1] - 2 * border)
    return height // supersample, width // supersample, colors[1]


def _forward(operands: Arrays, out: np.ndarray, border: int, supersample: int) -> None:
    from rts.splatting import stencil_loops as loops

    positions, colors, *fields = operands
    matrix = loops.Matrix(*fields)
    # Before loops read there.
    check_rows(matrix.front, len(colors))
    check_rows(matrix.color_sample, len(colors), "stencil.color_sample")
    check_rows(matrix.motion_colors, len(colors), "stencil.motion_colors")
    check_rows(matrix.motion_sample, len(positions), "stencil.motion_sample")
    parallel(loops.value, len(out), border, supersample, colors, matrix, out, work=2 * out.size * supersample**2)


def _push(operands: Arrays, tangents: Some, out: np.ndarray, border: int, supersample: int) -> None:
    from rts.splatting import stencil_loops as loops

    t_positions, t_colors = (_or_none(t, width) for t, width in zip(tangents, (3, out.shape[2]), strict=True))
    arrays = operands[1], loops.Matrix(*operands[2:]), t_positions, t_colors, out
    parallel(loops.push, len(out), border, supersample, *arrays, work=4 * out.size * supersample**2)


def _pull(operands: Arrays, g: np.ndarray, results: Some, border: int, supersample: int) -> None:
    from rts.splatting import stencil_loops as loops

    g_positions, g_colors = [np.empty((0, 3), g.dtype) if x is None else x for x in results]
    loops.pull(border, supersample, operands[1], loops.Matrix(*operands[2:]), read_only(g), g_positions, g_colors)


def _or_none(tangent: np.ndarray | None, width: int) -> np.ndarray:
    """A tangent for loops, for which an empty one (0, width) is one of zeros."""
    return read_only(np.empty((0, width)) if tangent is None else tangent)


SPLAT = Operation(
    "rts.splat",
    _specification,
    ranks=(2, 2, 2, 3, 1, 1, 1, 1, 1, 2, 2),
    shape=_shape,
    forward=_forward,
    push=_push,
    pull=_pull,
    differentiable=2,
    second="second derivatives of an image, in what moves, leave out how outlines curve with the splatter 'edges', and "
    'may be many times too small; take Gauss–Newton (rts.fit with method="lm"), or differences of gradients',
)
"""The operation of `splat`, of positions, colours, `front`, and the fields of `Stencil` up to `motion_colors`."""
