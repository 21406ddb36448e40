"""Stacks of layers that light passes through, for the splatter of found edges.

    image of a pixel  =  C − Σ_k D_k · m_k  +  what segments add, as for opaque layers

    C       the composite of the cell's K layers, front to back
    D_k     its slope where layer k alone shifts: T_k (∇c_k − ∇α_k B_k), of colour and alpha of the layer, the light T_k
            that passes to it, and the composite B_k behind it
    m_k     the motion of the layer's sample: 0 in value, it has the derivative

At a break the one layer that ends there moves it, or the two that cross. The colours on its sides are composites of the
stacks there. The composites are further rows of the tables of samples; so the rest is that of opaque layers.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from rts.arrays.engines import engine_of, namespace, stopped
from rts.arrays.trees import Array
from rts.compiling.threads import parallel, read_only
from rts.contracts.records import Outlines, Splats
from rts.operations.operation import Arrays, Operation, Some
from rts.splatting.cells import centres
from rts.splatting.edges.gap_places import on_gaps
from rts.splatting.edges.stack_sides import Stack, motion_beside_breaks


class Operands(NamedTuple):
    """Composites in place of stacks, for `rts.splatting.edges`: one for each cell, and for each side of a break.

    Attributes:
        positions: (M, 3), of cells, which stand still; then of both sides of breaks, of the layer that ends there.
        rgba: (M, C), the composites.
        row: (H, W), those of cells.
        outlines: whose samples are composites.
        motion: (H, W, C), to be added to the image: without value, with the derivative of motions inside.
    """

    positions: Array
    rgba: Array
    row: Array
    outlines: Outlines
    motion: Array

    @classmethod
    def of(cls, splats: Splats, outlines: Outlines) -> Operands:
        """The operands for splats of K layers."""
        positions, rgba, row = splats.positions, splats.rgba, splats.row
        xp, engine, (height, width), stack = namespace(rgba), engine_of(rgba), row.shape[1:], outlines.stack
        assert stack is not None
        # Those before breaks, then those behind.
        sides = xp.reshape(xp.permute_dims(stack, (2, 1, 0)), (len(row), 1, -1))
        alone = engine.constant(np.zeros((2, *sides.shape[1:]), bool), row)
        whole, motion = in_cells(positions, rgba, row, outlines.joined)
        beside, _ = in_cells(positions, rgba, sides, alone)
        if engine.differentiates:
            motion = motion + motion_beside_breaks(positions, rgba, row, outlines)
        at = xp.reshape(centres(height, width, rgba), (-1, 2))
        at = xp.concat([at, xp.zeros_like(at[:, :1])], axis=-1)
        numbers = _numbered(xp.reshape(sides[0, ...], (2, -1)), height * width)
        rows = xp.permute_dims(numbers, (1, 0))
        return cls(
            xp.concat([at, _ending(positions, outlines)]),
            xp.concat([xp.reshape(whole, (-1, rgba.shape[1])), beside[0, ...]]),
            _numbered(row[0, ...], 0),
            replace(outlines, rows=rows, inner=rows),
            motion,
        )


def in_cells(positions: Array, rgba: Array, row: Array, joined: Array) -> tuple[Array, Array]:
    """Composites (H, W, C) of cells, and −Σ D_k · m_k (H, W, C): no value, but the derivative of motions."""
    shape = *row.shape[1:], rgba.shape[1]
    # Cut, since the derivative of a slice is an array as large as both.
    whole, motion = engine_of(rgba).split(CELLS(positions, rgba, row, joined), [1, 1])
    reshape = namespace(rgba).reshape
    return reshape(whole, shape), reshape(motion, shape)


def _specification(positions: Array, rgba: Array, row: Array, joined: Array) -> Array:
    """See `in_cells`; both in one array (2, H, W, C).

    Slopes are means of the differences from and to the next cells of the same layers.
    """
    xp, there, (height, width) = namespace(rgba), row >= 0, row.shape[1:]
    cells = Stack.of(positions, rgba, row, centres(height, width, rgba)[None, ...])
    color, total, (through, behind) = stopped(cells.color), 0.0, cells.weights()
    for axis in (0, 1):
        here = (joined[axis, ...][None, ...] & there & xp.roll(there, -1, axis=2 - axis))[..., None]
        rise = xp.where(here, xp.roll(color, -1, axis=2 - axis) - color, 0.0)
        slope = (rise + xp.roll(rise, 1, axis=2 - axis)) / 2
        change = through * (slope - slope[..., -1:] * behind)
        total = total - xp.sum(change * cells.motion[..., axis, None], axis=0)
    return xp.stack([cells.whole, total - stopped(total)])


def _shape(positions: tuple[int, ...], rgba: tuple[int, ...], row: tuple[int, ...], *_: Any) -> tuple[int, ...]:
    return 2, *row[1:], rgba[1]


def _forward(operands: Arrays, out: np.ndarray) -> None:
    from rts.splatting.edges import stacks_loops as loops

    _, rgba, row, _ = operands
    parallel(loops.cells, row.shape[1], rgba, row, out, work=2 * row.size)


def _push(operands: Arrays, tangents: Some, out: np.ndarray) -> None:
    from rts.splatting.edges import stacks_loops as loops

    positions, rgba, row, joined = operands
    none = read_only(np.empty((0, 3), out.dtype))
    t_positions, t_rgba = (none if t is None else read_only(t) for t in tangents)
    arrays = rgba, row, joined, t_positions, t_rgba, out
    parallel(loops.push_cells, row.shape[1], *arrays, work=10 * row.size)


def _pull(operands: Arrays, g: np.ndarray, results: Some) -> None:
    from rts.splatting.edges import stacks_loops as loops

    positions, rgba, row, joined = operands
    g_positions, g_rgba = (np.empty((0, 3), g.dtype) if x is None else x for x in results)
    loops.pull_cells(rgba, row, joined, read_only(g), g_positions, g_rgba)


CELLS = Operation("rts.edges_stacks", _specification, (2, 2, 3, 3), _shape, _forward, _push, _pull, differentiable=2)
"""(2, H, W, C) of positions (N, 3), colours (N, C), `row` (K, H, W) and `Outlines.joined`: see `in_cells`."""


def _numbered(row: Array, first: int) -> Array:
    """The indices, `first` and on, of the composites of stacks whose fronts are `row` (...); −1 for none."""
    xp, engine, count = namespace(row), engine_of(row), math.prod(row.shape)
    numbers = engine.constant(np.arange(first, first + count, dtype=np.int32).reshape(row.shape), row)
    return xp.where(row >= 0, numbers, -1)


def _ending(positions: Array, outlines: Outlines) -> Array:
    """(2 B, 3) the positions of the last samples beside breaks; where none is, the points themselves, at depth 0."""
    xp, rows = namespace(positions), outlines.rows
    rows = xp.concat([rows[:, 0], rows[:, 1]])
    points = xp.concat([on_gaps(outlines.gap, outlines.points[:, i]) for i in (0, 1)])
    still = xp.concat([points, xp.zeros_like(points[:, :1])], axis=-1)
    return xp.where((rows >= 0)[:, None], xp.take(positions, xp.where(rows >= 0, rows, 0), axis=0), still)
