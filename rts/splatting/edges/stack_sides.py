"""How composites change beside breaks, layer by layer, for `rts.splatting.edges.stacks`."""

from __future__ import annotations

import functools
from typing import NamedTuple

import numpy as np

from rts.arrays.engines import engine_of, namespace, stopped
from rts.arrays.trees import Array
from rts.compiling.threads import read_only
from rts.contracts.records import Outlines
from rts.operations.operation import Arrays, Operation, Some
from rts.splatting.cells import over, unpack
from rts.splatting.edges.gap_places import normals, on_gaps, steps


class Stack(NamedTuple):
    """Layers front to back, in cells or beside breaks.

    Attributes:
        color: (K, ..., C), premultiplied, alpha last; 0 where there is no layer.
        motion: (K, ..., 2), of the layers' samples; 0 where there is no layer.
        whole: (..., C), the composite.
    """

    color: Array
    motion: Array
    whole: Array

    @classmethod
    def of(cls, positions: Array, rgba: Array, rows: Array, points: Array) -> Stack:
        """The stack of samples `rows` (K, ...), −1 for none, which were at `points` (K or 1, ..., 2)."""
        xp, there = namespace(rgba), (rows >= 0)[..., None]
        color = xp.where(there, unpack(rgba, rows), 0.0)
        motion = xp.where(there, unpack(positions, rows)[..., :2] - points, 0.0)
        return cls(color, motion, functools.reduce(lambda back, k: over(color[k, ...], back), *_from_the_back(color)))

    def weights(self) -> tuple[Array, Array]:
        """The light (K, ..., 1) that passes to each layer, and the composite (K, ..., C) behind it; constants."""
        color = stopped(self.color)
        xp, count = namespace(color), color.shape[0]
        through, behind = [xp.ones_like(color[0, ..., -1:])], [xp.zeros_like(color[0, ...])]
        for k in range(count - 1):
            through.append(through[-1] * (1 - color[k, ..., -1:]))
            behind.append(over(color[count - 1 - k, ...], behind[-1]))
        return xp.stack(through), xp.stack(behind[::-1])


def _from_the_back(color: Array) -> tuple[range, Array]:
    """The indices of layers (K, ..., C) before the last, back to front, and the last."""
    return range(color.shape[0] - 2, -1, -1), color[-1, ...]


def motion_beside_breaks(positions: Array, rgba: Array, row: Array, outlines: Outlines) -> Array:
    """The change (H, W, C) as colours move between centres and breaks; no value, but the derivative of motions.

    As `_beside_breaks` of `rts.splatting.edges.specification` for opaque layers, whose own part, of the composites
    and of the motion of breaks, is taken off. `row` is (K, H, W).
    """
    return SIDES(positions, rgba, row, *(getattr(outlines, name) for name in _Known._fields))


class _Known(NamedTuple):
    """Some fields of `Outlines`."""

    rows: Array
    gap: Array
    place: Array
    points: Array
    ends: Array
    ties: Array
    stack: Array
    stack_points: Array

    def both(self, name: str) -> Array:
        """A field (B, 2, ...) of both sides of breaks: those before, then those behind, (2 B, ...)."""
        x = getattr(self, name)
        return namespace(x).concat([x[:, i, ...] for i in (0, 1)])


def _specification(positions: Array, rgba: Array, row: Array, *arrays: Array) -> Array:
    known, xp, engine, (layers, height, width) = _Known(*arrays), namespace(rgba), engine_of(rgba), row.shape
    gap, place, unit = known.gap, known.place, normals(known.gap, known.place, known.ties)
    along, gaps = steps(gap, unit), xp.concat([gap, gap])
    normal, way = xp.concat([unit, unit]), xp.concat([-along, along])
    first, next_ = gap[:, 0] * width + gap[:, 1], xp.where(gap[:, 2] == 1, 1, width)
    cell, beyond = xp.concat([first, first + next_]), xp.concat([first + next_, first])
    rows, places = known.both("stack"), on_gaps(gaps, known.both("stack_points"))
    there = Stack.of(positions, rgba, xp.permute_dims(rows, (1, 0)), xp.permute_dims(places, (1, 0, 2)))
    centre = xp.concat([on_gaps(gap, xp.full_like(place, i)) for i in (0, 1)])
    here = Stack.of(positions, rgba, xp.take(xp.reshape(row, (layers, -1)), cell, axis=1), centre[None, ...])
    rise, (through, behind) = stopped(there.color - here.color), here.weights()
    # What ends there, which the other side has not, moves along the normal of its outline; other layers know nothing
    # of this.
    same = known.stack[:, 0, :, None] == known.stack[:, 1, None, :]
    ends = xp.permute_dims(xp.concat([~xp.any(same, axis=2), ~xp.any(same, axis=1)]), (1, 0))
    across, moves = xp.sum(normal * way, axis=-1), (there.motion + here.motion) / 2
    moves = xp.where(ends, xp.sum(moves * normal, axis=-1) * across, xp.sum(moves * way, axis=-1))[..., None]
    change = xp.sum(through * (rise - rise[..., -1:] * behind) * moves, axis=0)
    # What is added for the composite, as if it moved with the break.
    last = known.both("rows")
    ending = xp.take(positions, xp.where(last >= 0, last, 0), axis=0)[:, :2] - on_gaps(gaps, known.both("points"))
    with_break = xp.where(last >= 0, xp.sum(ending * normal, axis=-1) * across / 2, 0.0)
    change = change - stopped(there.whole - here.whole) * with_break[:, None]
    length = xp.clip(xp.concat([place, 1 - place]), 0.0, 1.0)
    share = (xp.clip(length, None, 0.5) / xp.where(length > 1e-6, length, 1.0))[:, None]
    change = xp.where((known.both("ends") & (rows[:, 0] >= 0))[:, None], change, 0.0)
    parts, cells = xp.concat([share * change, (1 - share) * change]), xp.concat([cell, beyond])
    total = xp.reshape(engine.segment_sum(parts, cells, height * width), (height, width, -1))
    return total - stopped(total)


def _shape(
    positions: tuple[int, ...], rgba: tuple[int, ...], row: tuple[int, ...], *_: tuple[int, ...]
) -> tuple[int, ...]:
    return *row[1:], rgba[1]


def _forward(operands: Arrays, out: np.ndarray) -> None:
    out[...] = 0


def _weights(operands: Arrays) -> Arrays:
    """The tables of `stacks_loops.weigh_sides`."""
    from rts.splatting.edges import stacks_loops as loops

    _, rgba, row, *arrays = operands
    known = _Known(*arrays)
    rows, sides = len(row) + 1, 2 * len(known.gap)
    change, moves = np.empty((sides, rows, rgba.shape[1])), np.empty((sides, rows, 2))
    movers, cells = np.empty((sides, rows, 2), np.int32), np.empty((sides, 2, 2), np.int32)
    tables = change, moves, movers, cells, np.empty(sides)
    of_breaks = known.rows, known.gap, known.place, known.ends, known.ties, known.stack
    loops.weigh_sides(rgba, row, *of_breaks, *tables)
    return tables


def _push(operands: Arrays, tangents: Some, out: np.ndarray) -> None:
    from rts.splatting.edges import stacks_loops as loops

    (t_positions,) = tangents
    out[...] = 0
    if t_positions is not None:
        loops.push_sides(*_weights(operands), read_only(t_positions), out)


def _pull(operands: Arrays, g: np.ndarray, results: Some) -> None:
    from rts.splatting.edges import stacks_loops as loops

    (g_positions,) = results
    if g_positions is not None:
        loops.pull_sides(*_weights(operands), read_only(g), g_positions)


SIDES = Operation(
    "rts.edges_stack_sides", _specification, (2, 2, 3, 2, 2, 1, 2, 2, 2, 3, 3), _shape, _forward, _push, _pull
)
"""The operation of `motion_beside_breaks`: of positions (N, 3), colours (N, C), `row` (K, H, W), and the fields of
`_Known`."""
