"""Composites of the layers that light passes through, for the splatter of found edges.

    composite         =  Σ_k T_k c_k
    d composite       =  Σ_k T_k (d c_k − d α_k B_k),  and for cells  −Σ_k T_k (∇c_k − ∇α_k B_k) · d position_k

The sums are over layers, front to back. T_k is the light that passes to layer k, B_k the composite behind it, ∇c_k the
slope of its colour, as in `rts.splatting.stencil`. What is multiplied by d position is constant.
"""

from __future__ import annotations

import math

import numpy as np

from rts.arrays.engines import engine_of, namespace, stopped
from rts.arrays.trees import Array
from rts.compiling.threads import parallel, read_only
from rts.contracts.records import Stencil
from rts.operations.operation import Arrays, Operation, Some
from rts.splatting.cells import over, unpack


def composites(positions: Array, rgba: Array, row: Array, stencil: Stencil) -> tuple[Array, Array, Array]:
    """Composites as the colours that a stencil with stacks is for.

    Args:
        positions: (N, 3) of samples.
        rgba: (N, C).
        row: (K, H, W), the samples in cells.
        stencil: with `stacks` (R, K).

    Returns:
        Composites (H · W + R, C) of cells, then of stacks; the composite (H, W) of each cell, or −1; and (H, W, C),
        without a value, the derivative of the motions of layers inside.
    """
    _, height, width = row.shape
    engine, cells, stacks = engine_of(rgba), height * width, stencil.stacks
    assert stacks is not None
    whole = LAYERS(positions, rgba, row, stencil.joined, stacks)
    # Cut, since the derivative of a slice is an array as large as both.
    colors, motion = engine.split(whole, [cells + stacks.shape[0], cells])
    numbers = engine_of(row).constant(np.arange(cells, dtype=np.int32).reshape(height, width), row)
    front = namespace(row).where(row[0, ...] >= 0, numbers, -1)
    return colors, front, namespace(rgba).reshape(motion, (height, width, -1))


def _specification(positions: Array, rgba: Array, row: Array, joined: Array, stacks: Array) -> Array:
    xp, (layers, height, width), channels = namespace(rgba), row.shape, rgba.shape[1]
    rows = xp.concat([xp.reshape(row, (layers, -1)), xp.permute_dims(stacks, (1, 0))], axis=1)
    color = xp.where((rows >= 0)[..., None], unpack(rgba, rows), 0.0)
    whole = xp.zeros_like(color[0, ...])
    for k in reversed(range(layers)):
        whole = over(color[k, ...], whole)
    still = stopped(color)[:, : height * width, :]
    still, total = xp.reshape(still, (layers, height, width, channels)), 0.0
    motion = xp.where((row >= 0)[..., None], unpack(positions, row)[..., :2], 0.0)
    motion, behind = motion - stopped(motion), [xp.zeros_like(still[0, ...])]
    for k in reversed(range(1, layers)):
        behind.append(over(still[k, ...], behind[-1]))
    light = xp.ones_like(still[0, ..., -1:])
    for k in range(layers):
        for axis in (0, 1):
            there = row[k, ...] >= 0
            here = (joined[axis, ...] & there & xp.roll(there, -1, axis=1 - axis))[..., None]
            rise = xp.where(here, xp.roll(still[k, ...], -1, axis=1 - axis) - still[k, ...], 0.0)
            slope = (rise + xp.roll(rise, 1, axis=1 - axis)) / 2
            total = total - light * (slope - slope[..., -1:] * behind[-1 - k]) * motion[k, ..., axis, None]
        light = light * (1 - still[k, ..., -1:])
    return xp.concat([whole, xp.reshape(total, (-1, channels))])


def _shape(
    positions: tuple[int, ...],
    rgba: tuple[int, ...],
    row: tuple[int, ...],
    joined: tuple[int, ...],
    stacks: tuple[int, ...],
) -> tuple[int, ...]:
    return 2 * math.prod(row[1:]) + stacks[0], rgba[1]


def _forward(operands: Arrays, out: np.ndarray) -> None:
    from rts.splatting import layers_loops as loops

    _, rgba, row, _, stacks = operands
    parallel(loops.value, math.prod(row.shape[1:]) + len(stacks), rgba, row, stacks, out, work=2 * row.size)


def _push(operands: Arrays, tangents: Some, out: np.ndarray) -> None:
    from rts.splatting import layers_loops as loops

    _, rgba, row, joined, stacks = operands
    t_positions, t_rgba = (read_only(np.empty((0, 3), out.dtype) if t is None else t) for t in tangents)
    arrays = rgba, row, joined, stacks, t_positions, t_rgba, out
    parallel(loops.push, math.prod(row.shape[1:]) + len(stacks), *arrays, work=10 * row.size)


def _pull(operands: Arrays, g: np.ndarray, results: Some) -> None:
    from rts.splatting import layers_loops as loops

    row, stacks = operands[2], operands[4]
    g_positions, g_rgba = (np.empty((0, 3), g.dtype) if x is None else x for x in results)
    arrays, cells = (*operands[1:], read_only(g), g_positions, g_rgba), math.prod(row.shape[1:])
    # Cells that share a sample add to it one after the other.
    apart = loops.distinct(row.reshape(-1), np.zeros(len(operands[0]), np.bool_))
    parallel(loops.pull, cells, *arrays, work=15 * row.size if apart else 0)
    loops.pull(cells, cells + len(stacks), *arrays)


LAYERS = Operation("rts.layers", _specification, (2, 2, 3, 3, 2), _shape, _forward, _push, _pull, differentiable=2)
"""The operation of `composites`: of positions, colours, `row`, `Stencil.joined` and `stacks`, the composites of cells
and stacks, and the motion of cells, one after the other (2 H · W + R, C)."""
