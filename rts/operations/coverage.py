"""How much of a point is covered by the surfaces that lie in front of it in a picture: shadow maps with derivatives.

A picture of depth is a grid of cells with a sample each. Cells in front of a point cover it with the weights of a cubic
B-spline, which sum to one. The region that these cells fill has sides, from cell to cell. It changes as its sides
move: each side moves with the sample of the surface in front there, and what happens inside has no effect.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable

from rts.arrays.engines import namespace, stopped
from rts.arrays.trees import Array
from rts.operations.combine import combine
from rts.operations.depth_limits import BIAS, FAR, OWN, REACH
from rts.operations.depth_planes import even_depth
from rts.operations.operation import Operation


def coverage(samples: Array, points: Array, row: Array, planes: Array, lens: Array, opaque: bool) -> Array:
    """The covered share of points (N, 1), 0 to 1, differentiable in samples and points, to first order.

    Points beside the picture or before the near plane are not covered.

    A cell is in front of a point if its plane is, and if it is in front of the plane of the point's own surface, where
    some cell around shows that. So neither slopes nor edges of solids shade themselves, if they are two cells wide:
    the slope of a surface across a single cell is not known.

    Args:
        samples: (M, 3) x and y of samples, of which only derivatives count; then alpha, or anything if they are opaque.
        points: (N, 3) x and y from the picture's upper left corner, and linear depth, which has no derivative.
        row: (H, W) the sample in each cell, or −1.
        planes: (9, H, W) of the sample in each cell, see `depth_planes`; the picture is `REACH` cells smaller on every
            side. Depths in it are `even_depth`.
        lens: (5,), see `depth_planes`.
        opaque: whether samples let no light through.
    """
    return COVERAGE(samples, points, row, planes, lens, opaque=opaque)


def is_inside(points: Array, size: tuple[int, int], lens: Array) -> Array:
    """True for points (N, 3) in a picture (height, width), behind its near plane; see `coverage`."""
    x, y, depth = (points[:, i] for i in range(3))
    return (x >= 0) & (x <= size[1]) & (y >= 0) & (y <= size[0]) & (depth >= lens[3])


def cubic(d: Array) -> Array:
    """The cubic B-spline at distances in cells."""
    xp, d = namespace(d), abs(d)
    tail = xp.clip(2 - d, 0.0, None)
    return xp.where(d < 1, 2 / 3 - d * d * (1 - d / 2), tail * tail * tail / 6)


def quadratic(d: Array) -> Array:
    """The quadratic B-spline at distances in cells: how the share of a half-plane changes as its side moves."""
    xp, d = namespace(d), abs(d)
    tail = xp.clip(1.5 - d, 0.0, None)
    return xp.where(d < 0.5, 0.75 - d * d, tail * tail / 2)


def _specification(samples: Array, points: Array, row: Array, planes: Array, lens: Array, *, opaque: bool) -> Array:
    xp, at = namespace(samples), stopped(points)
    height, width = planes.shape[1:]
    inside = is_inside(at, (height - 2 * REACH, width - 2 * REACH), lens)
    x, y = (REACH + xp.where(inside, at[:, i], 0.0) for i in range(2))
    # Beside the picture, nothing lies in front.
    depth = xp.where(inside, even_depth(xp.where(inside, at[:, 2], lens[2]), lens), -FAR)
    corner = [xp.floor(xp.clip(c - 1.5, 0, n - 4)) for c, n in ((x, width), (y, height))]
    dx, dy = ([c - k - (i + 0.5) for i in range(4)] for c, k in zip((x, y), corner, strict=True))
    first = xp.astype(corner[1], xp.int32) * width + xp.astype(corner[0], xp.int32)
    flat, row = xp.reshape(planes, (9, -1)), xp.reshape(xp.clip(row, 0, None), (-1,))
    around, closest, surface = {}, xp.ones_like(x) * OWN, [xp.zeros_like(x)] * 3
    for j, i in itertools.product(range(4), range(4)):
        index = first + (j * width + i)
        z, unit, a, b = (xp.take(flat[k, ...], index) for k in range(4))
        there, steep = unit > 0, unit + abs(a) + abs(b)
        seen = xp.where(there, z + a * dx[i] + b * dy[j], FAR)
        around[j, i] = index, z, seen, there & (seen < depth - BIAS * steep)
        off = xp.where(there, abs(seen - depth) / xp.where(there, steep, 1.0), FAR)
        surface = [xp.where(off < closest, new, old) for new, old in zip((a, b, steep), surface, strict=True)]
        closest = xp.where(off < closest, off, closest)
    covers, weights = {}, {}
    for (j, i), (index, z, _, front) in around.items():
        rise_x, rise_y, steep = surface
        front = front & ((closest >= OWN) | (z < depth - rise_x * dx[i] - rise_y * dy[j] - BIAS * steep))
        weights[j, i] = xp.where(front, cubic(dx[i]) * cubic(dy[j]), 0.0)
        alpha = xp.ones_like(x) if opaque else xp.take(stopped(samples)[:, 2], xp.take(row, index))
        covers[j, i] = xp.where(front, alpha, 0.0)
    covered = sum(weights[cell] * covers[cell] for cell in covers)
    change = xp.zeros_like(covered)[:, None]
    if not opaque:
        alphas, ids = samples[:, 2:] - stopped(samples[:, 2:]), [xp.take(row, index) for index, *_ in around.values()]
        change = combine(alphas, *_stacked(ids, [*weights.values()]))
    for axis, (across, along) in enumerate(((dx, dy), (dy, dx))):
        ids, flows = [], []
        for i, j in itertools.product(range(3), range(4)):
            before, behind = ((j, i), (j, i + 1)) if axis == 0 else ((i, j), (i + 1, j))
            nearer = around[before][2] < around[behind][2]
            cell = xp.where(nearer, around[before][0], around[behind][0])
            flow = (covers[before] - covers[behind]) * quadratic(across[i] - 0.5) * cubic(along[j])
            # The side at the end of the cell before, or at the start of the cell behind; motions from within.
            side = 2 * axis + 4 + xp.astype(nearer, cell.dtype)
            beyond = flow * xp.take(xp.reshape(planes, (-1,)), side * height * width + cell)
            within = cell + xp.where(nearer, -1, 1) * (1, width)[axis]
            ids += [xp.take(row, cell), xp.take(row, xp.clip(within, 0, height * width - 1))]
            flows += [flow + beyond, -beyond]
        moved = (points - at)[:, axis : axis + 1] * xp.sum(xp.stack(flows, axis=1), axis=1, keepdims=True)
        motions = samples[:, axis : axis + 1] - stopped(samples[:, axis : axis + 1])
        change = change - moved + combine(motions, *_stacked(ids, flows))
    return xp.clip(covered, 0.0, 1.0)[:, None] + change


def _stacked(ids: list[Array], weights: list[Array]) -> tuple[Array, Array]:
    """Columns as arrays (N, I)."""
    xp = namespace(ids[0])
    return xp.stack(ids, axis=1), xp.stack(weights, axis=1)


def _shape(samples: tuple[int, ...], points: tuple[int, ...], *_: tuple[int, ...], opaque: bool) -> tuple[int, int]:
    return points[0], 1


def _loops() -> tuple[Callable, Callable, Callable]:
    from rts.operations import coverage_loops as loops

    return loops.forward, loops.push, loops.pull


COVERAGE = Operation.of_loops(
    "rts.coverage",
    _specification,
    (2, 2, 2, 3, 1),
    _shape,
    _loops,
    differentiable=2,
    packed=(1,),
    packed_result=True,
    keeps=True,
)
"""The operation of `coverage`; `opaque` is a parameter."""
