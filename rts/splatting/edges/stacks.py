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

import functools
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from rts.arrays.engines import engine_of, namespace, stopped
from rts.arrays.trees import Array
from rts.compiling.threads import parallel, read_only
from rts.contracts.records import Outlines, Splats
from rts.operations.operation import Arrays, Operation, Some
from rts.splatting.cells import centres, over, unpack


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
        xp, (height, width), breaks = namespace(rgba), row.shape[1:], outlines.place.shape[0]
        (whole, motion), sides = in_cells(positions, rgba, row, outlines.joined), _Sides.of(splats, outlines)
        numbers = [_numbered(sides.front[i * breaks : (i + 1) * breaks], (height * width) + i * breaks) for i in (0, 1)]
        rows = xp.stack(numbers, axis=-1)
        at = xp.reshape(centres(height, width, rgba), (-1, 2))
        if engine_of(rgba).differentiates:
            motion = motion + sides.motion(splats)
        return cls(
            xp.concat([xp.concat([at, xp.zeros_like(at[:, :1])], axis=-1), sides.ending]),
            xp.concat([xp.reshape(whole, (-1, rgba.shape[1])), sides.stack.whole]),
            xp.reshape(_numbered(xp.reshape(row[0, ...], (-1,)), 0), (height, width)),
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
    """Indices (M,) of the composites of stacks, whose fronts are `row`; −1 for none."""
    numbers = engine_of(row).constant(np.arange(first, first + row.shape[0], dtype=np.int32), row)
    return namespace(row).where(row >= 0, numbers, -1)


def _on_gaps(outlines: Outlines, places: Array) -> Array:
    """Points (B, ..., 2) at places (B, ...) along the gaps of breaks."""
    xp, gap = namespace(places), outlines.gap
    first, along = xp.astype(xp.stack([gap[:, 1], gap[:, 0]], axis=-1), places.dtype) + 0.5, _steps(gap, places)
    if places.ndim == 2:
        first, along = first[:, None, :], along[:, None, :]
    return first + places[..., None] * along


def _steps(gap: Array, like: Array) -> Array:
    """Unit steps (B, 2) along gaps."""
    xp = namespace(gap)
    return xp.astype(xp.stack([gap[:, 2], 1 - gap[:, 2]], axis=-1), like.dtype)


def _stack_of(outlines: Outlines) -> tuple[Array, Array]:
    """`Outlines.stack` and `Outlines.stack_points`, which several layers have."""
    assert outlines.stack is not None and outlines.stack_points is not None
    return outlines.stack, outlines.stack_points


class _Sides(NamedTuple):
    """Both sides of breaks: those before (B), then those behind.

    Attributes:
        outlines: of K layers.
        front: (2 B,), the front of the stack there, or −1.
        stack: (K, 2 B), the layers.
        points: (2 B, 2), of the last samples.
        ending: (2 B, 3), the positions of these samples; the points themselves, at depth 0, where nothing ends.
    """

    outlines: Outlines
    front: Array
    stack: Stack
    points: Array
    ending: Array

    @classmethod
    def of(cls, splats: Splats, outlines: Outlines) -> _Sides:
        """The sides of breaks."""
        positions, rgba, xp = splats.positions, splats.rgba, namespace(splats.rgba)
        stack, places = _stack_of(outlines)
        rows = xp.reshape(xp.permute_dims(stack, (2, 1, 0)), (splats.row.shape[0], -1))
        points = xp.concat([_on_gaps(outlines, places[:, i, :]) for i in (0, 1)])
        layers = Stack.of(positions, rgba, rows, xp.permute_dims(points, (1, 0, 2)))
        ends = xp.concat([outlines.rows[:, i] for i in (0, 1)])
        points = xp.concat([_on_gaps(outlines, outlines.points[:, i]) for i in (0, 1)])
        still = xp.concat([points, xp.zeros_like(points[:, :1])], axis=-1)
        at = xp.take(positions, xp.where(ends >= 0, ends, 0), axis=0)
        return cls(outlines, rows[0, ...], layers, points, xp.where((ends >= 0)[:, None], at, still))

    def _ends(self) -> Array:
        """(K, 2 B) True for layers that the other side of a break has not."""
        xp, (stack, _) = namespace(self.points), _stack_of(self.outlines)
        same = stack[:, 0, :, None] == stack[:, 1, None, :]
        return xp.permute_dims(xp.concat([~xp.any(same, axis=2), ~xp.any(same, axis=1)]), (1, 0))

    def motion(self, splats: Splats) -> Array:
        """The change (H, W, C) as colours move between centres and breaks, layer by layer.

        As `_beside_breaks` of `rts.splatting.edges.splatter` for opaque layers, whose own part of it, of the
        composites and of the motion of breaks, is taken off.
        """
        outlines, stack, row = self.outlines, self.stack, splats.row
        xp, engine, (layers, height, width) = namespace(stack.whole), engine_of(stack.whole), row.shape
        gap, place, unit = outlines.gap, outlines.place, _normals(outlines)
        along = _steps(gap, unit)
        normal, way = xp.concat([unit, unit]), xp.concat([-along, along])
        first, next_ = gap[:, 0] * width + gap[:, 1], xp.where(gap[:, 2] == 1, 1, width)
        cell, beyond = xp.concat([first, first + next_]), xp.concat([first + next_, first])
        centre = xp.concat([_on_gaps(outlines, xp.full_like(place, i)) for i in (0, 1)])
        rows = xp.take(xp.reshape(row, (layers, -1)), cell, axis=1)
        here = Stack.of(splats.positions, splats.rgba, rows, centre[None, ...])
        rise, (through, behind) = stopped(stack.color - here.color), here.weights()
        # What ends there moves along the normal of its outline; other layers know nothing of this.
        across = xp.sum(normal * way, axis=-1)
        moves, ends = (stack.motion + here.motion) / 2, self._ends()
        moves = xp.where(ends, xp.sum(moves * normal, axis=-1) * across, xp.sum(moves * way, axis=-1))[..., None]
        change = xp.sum(through * (rise - rise[..., -1:] * behind) * moves, axis=0)
        # What is added for the composite, as if it moved with the break.
        with_break = xp.sum((self.ending[:, :2] - self.points) / 2 * normal, axis=-1) * across
        change = change - stopped(stack.whole - here.whole) * with_break[:, None]
        counts = xp.concat([outlines.ends[:, i] for i in (0, 1)]) & (self.front >= 0)
        length = xp.clip(xp.concat([place, 1 - place]), 0.0, 1.0)
        share = (xp.clip(length, None, 0.5) / xp.where(length > 1e-6, length, 1.0))[:, None]
        change = xp.where(counts[:, None], change, 0.0)
        parts, cells = xp.concat([share * change, (1 - share) * change]), xp.concat([cell, beyond])
        return xp.reshape(engine.segment_sum(parts, cells, height * width), (height, width, -1))


def _normals(outlines: Outlines) -> Array:
    """Unit normals (B, 2) of outlines at breaks: the mean of their segments'; along the gap for a lone break."""
    xp, ties, place = namespace(outlines.place), outlines.ties, _on_gaps(outlines, outlines.place)
    engine, count = engine_of(place), place.shape[0]
    step = _steps(outlines.gap, place)
    ends = [xp.take(place, xp.where(ties[:, i] >= 0, ties[:, i], 0), axis=0) for i in (0, 1)]
    way, total = ends[1] - ends[0], step * 1e-6
    normal = xp.stack([way[:, 1], -way[:, 0]], axis=-1)
    counts = (ties[:, 1] >= 0) & (ties[:, 0] != ties[:, 1])
    for i in (0, 1):
        at = xp.where(counts, ties[:, i], 0)
        # Two segments at a line of crossing may run in opposite directions.
        forward = xp.sum(normal * xp.take(step, at, axis=0), axis=-1) >= 0
        turned = xp.where(counts[:, None], xp.where(forward[:, None], normal, -normal), 0.0)
        total = total + engine.segment_sum(turned, at, count)
    return total / xp.sqrt(xp.sum(total * total, axis=-1, keepdims=True))
