"""Motion of lines where two surfaces pass through one another, with a derivative that follows the surfaces' depths.

On such a line the depths of two sheets a and b are equal: g = z_a − z_b = 0. Let ġ be the difference of the rates at
which their depths change at a fixed pixel. The line then moves as

    v̂ = −ġ ∇g / |∇g|²,    ż = dP_z − ∇z · dP_xy.

Beside the line the sheets are layers 0 and 1 of the cells, in opposite orders on its two sides. Let q be a cell, m one
of the eight steps to its neighbours and p = q + m. Both have two layers z0 and z1, with gaps h = z1 − z0. Then

    R = |z0(q − m) − 2 z0(q) + z1(p)| + |z1(q − m) − 2 z1(q) + z0(p)| + the two terms of p, from the other side,
    D = |z0(q − m) − 2 z0(q) + z0(p)| + |z1(q − m) − 2 z1(q) + z1(p)| + ...

are the changes of slope if the line runs between q and p (R), and if it does not (D). If one side lacks two layers, the
terms of the other side count twice. (q, p) is a pair where R < D / 2, R < (h(q) + h(p)) / 2, and R / (h(q) + h(p)) is
least along m. On planes R is zero.

Let q be a covered target of a pair. A source belongs to b if it forms a pair with q. Otherwise it belongs to a if it is
paired front to front with q. ∇z_a and ∇z_b are differences over q's neighbours in its row and column. Any other source
with two layers belongs to the sheet whose plane is nearer, if both layers fit the planes. Where all nine sources belong
to a sheet, the image's derivative in positions is that of

    (Ŵ_a c_a + Ŵ_b c_b) / (Ŵ_a + Ŵ_b),    c = Σ w rgba / Σ w over the fronts of one sheet:

coverage Ŵ moves with the line, mean colours with their samples. The image's value, and its derivative in colours, stay
as they are. Where layers are translucent, the layers of each source, composited, stand in for its front's colour.
"""

from __future__ import annotations

import functools
import math
import operator
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from rts.arrays.engines import namespace, stopped
from rts.arrays.trees import Array
from rts.splatting.kernel import TIE, Kernel
from rts.splatting.layers import AROUND, NEIGHBOURS, Layers, Steps, opposite

LARGEST = 0.5
"""Bound of R / (h(q) + h(p)) for sheets that are straight enough."""
DIRECT = 0.5
"""Bound of R / D below which the sheets change their order."""
FIT = 0.5
"""Largest distance of a source from the planes of both sheets, relative to the change of g on the way."""
KEPT = 2
"""Number of cells around a possible pair within which the first two layers are kept."""
SLACK = 0.01
"""Allowance for rounding of depths, relative to the least sum of gaps of a pair."""

HALF = [(1, 0), (0, 1), (1, 1), (1, -1)]
"""Steps from one cell of each pair to the other."""


class Lines(NamedTuple):
    """Targets whose derivative in positions follows a line of crossing, with the sheets of their sources.

    Attributes:
        target: (H, W) bool, true for these targets.
        other: for each offset from source to target but (0, 0), (H, W) bool, true where the source is of sheet b.
        slopes: (∂x, ∂y) of the sheets a and b, (H, W) each.
    """

    target: Array
    other: dict[Steps, Array]
    slopes: list[tuple[Array, Array]]

    def sums(self, values: Callable[[int, int], Array]) -> list[Array]:
        """The sums [a's, b's] over each sheet's sources of `values(u, v)` (H, W, ·); (u, v) leads to the target."""
        totals: list[Any] = [0.0, 0.0]
        for n in NEIGHBOURS:
            value, other = values(*n), self.other[n] if n in self.other else self.target & False
            for i, here in enumerate((self.target & ~other, self.target & other)):
                totals[i] = totals[i] + namespace(value).where(here[..., None], value, 0.0)
        return totals


def motion(kernel: Kernel, layers: Layers, lines: Lines, colors: Callable[[int, int], Array]) -> Array:
    """The change of the image as lines move: zeros (H, W, 4) with derivatives in positions.

    Args:
        kernel: the splatter.
        layers: the samples, of at least two layers.
        lines: see `targets`.
        colors: for offsets (u, v), the colour that each source shows with a 1 appended, (H, W, 5), as `Layers.color`.
    """
    xp, target = layers.xp, lines.target
    moves = [
        xp.where(target[..., None], layers.at(p, 0, 0) - stopped(layers.at(p, 0, 0)), 0.0) for p in layers.position[:2]
    ]
    rates = [m[..., 2] - dx * m[..., 0] - dy * m[..., 1] for m, (dx, dy) in zip(moves, lines.slopes, strict=True)]
    gradient = xp.stack([a - b for a, b in zip(*lines.slopes, strict=True)], axis=-1)
    square = xp.where(target, xp.sum(gradient * gradient, axis=-1), 1.0)
    line = -((rates[0] - rates[1]) / square)[..., None] * xp.where(target[..., None], gradient, 0.0)
    still = stopped(xp.stack(kernel.offsets(layers.position[0]), axis=-1))

    coverage = lines.sums(lambda u, v: kernel.weight(layers.at(still, u, v) + kernel.gamma * line, u, v)[..., None])
    weighted = lines.sums(lambda u, v: stopped(colors(u, v)) * layers.weight(0, u, v)[..., None])
    means = [g[..., :4] / xp.where(target[..., None], g[..., 4:], 1.0) for g in weighted]
    total = xp.where(target[..., None], coverage[0] + coverage[1], 1.0)
    mixed = sum(w / total * mean for w, mean in zip(coverage, means, strict=True))
    return xp.where(target[..., None], mixed - stopped(mixed), 0.0)


def targets(layers: Layers, shift: dict[Steps, Array], crosses: dict[Steps, Array]) -> Lines:
    """The targets whose derivative in positions follows a line of crossing.

    Args:
        layers: the samples, of at least two layers.
        shift: for each offset (u, v) from source to target, the number s of `Visible` at each target; 0 at empty ones.
        crosses: the result of `pairs`.
    """
    xp, (z, two) = layers.xp, _depths(layers)
    # By the step from the target to the source.
    swapped = dict(crosses)
    same = {m: ~crosses[m] & (shift[opposite(m)] == 0) & layers.covers(*opposite(m)) for m in AROUND}
    slopes, has_slope = [], two & functools.reduce(operator.or_, crosses.values())
    for first, second in (z, reversed(z)):
        along_x, along_y = (_slope(first, second, m, two, same, swapped) for m in ((1, 0), (0, 1)))
        slopes.append((along_x[0], along_y[0]))
        has_slope = has_slope & along_x[1] & along_y[1]
    (ax, ay), (bx, by) = slopes
    square = (ax - bx) * (ax - bx) + (ay - by) * (ay - by)
    target = has_slope & (square > 0)
    for m in AROUND:
        near, far = ahead(z[0], m, 0.0), ahead(z[1], m, 0.0)
        a, b = z[0] + ax * m[0] + ay * m[1], z[1] + bx * m[0] + by * m[1]
        straight, crossed = xp.abs(a - near) + xp.abs(b - far), xp.abs(a - far) + xp.abs(b - near)
        reach = xp.sqrt(square) * math.hypot(*m)
        free = ~same[m] & ~swapped[m] & ahead(two, m, False) & (xp.minimum(straight, crossed) < FIT * reach)
        same[m] = same[m] | (free & (straight <= crossed))
        swapped[m] = swapped[m] | (free & (crossed < straight))
        target = target & (same[m] | swapped[m])
    lines = Lines(target, {opposite(m): b for m, b in swapped.items()}, slopes)
    # Samples that moved far from their cells may have zero weights.
    a, b = lines.sums(lambda u, v: stopped(layers.color(0, u, v)[..., 4:] * layers.weight(0, u, v)[..., None]))
    return lines._replace(target=target & (a[..., 0] > 0) & (b[..., 0] > 0))


def pairs_of(layers: Layers) -> dict[Steps, Array]:
    """The result of `pairs` for samples in at least two layers."""
    z, two = _depths(layers)
    return pairs(z[0], z[1], two, stopped(layers.extent))


def pairs(z0: Array, z1: Array, two: Array, extent: Array | float) -> dict[Steps, Array]:
    """Pairs of cells between which lines of crossing run: for each step m, (H, W) bool, true at q of pairs (q, q + m).

    Args:
        z0: depths of the first layer (H, W), finite.
        z1: depths of the second layer (H, W), finite.
        two: (H, W) bool, true where both layers are covered.
        extent: range of the fronts' depths and the camera's, 0.
    """
    xp, starts = namespace(two, z0), {}
    ratios = {m: _ratio(z0, z1, two, TIE * extent, m) for m in HALF}
    for m, ratio in ratios.items():
        back = opposite(m)
        least = (ratio < ahead(ratio, back, xp.inf)) & (ratio <= ahead(ratio, m, xp.inf))
        starts[m] = least & (ratio < LARGEST)
        starts[back] = ahead(starts[m], back, False)
    return {m: starts[m] for m in AROUND}


def sheets(covered: np.ndarray, depth: np.ndarray) -> np.ndarray:
    """Samples (K, H, W) bool of the first two layers near possible pairs, from covered (K, H, W) bool and depth.

    There are none without a second layer. `pairs` gives the same result if other hidden layers are left out.
    """
    if len(covered) < 2 or not covered[1].any():
        return covered & False
    seen = depth[0][covered[0]]
    extent = max(seen.max(), 0) - min(seen.min(), 0)
    two = covered[0] & covered[1]
    first, second = np.where(two, depth[:2], 0)
    near = two & False
    for m in HALF:
        starts = _candidates(first, second, two, TIE * extent, m)
        near = near | starts | ahead(starts, opposite(m), False)
    for _ in range(KEPT):
        near = near | np.logical_or.reduce([ahead(near, m, False) for m in AROUND])
    return covered & near & (np.arange(len(covered)) < 2)[:, None, None]


def ahead(cells: Array, steps: Steps, value: float) -> Array:
    """For each cell of (H, W), the value of the cell at `steps` (x, y) from it; `value` outside of the array."""
    xp = namespace(cells)
    for axis, step in ((1, steps[0]), (0, steps[1])):
        if step:
            cut = [slice(None)] * 2
            cut[axis] = slice(step, None) if step > 0 else slice(None, step)
            end = [slice(None)] * 2
            end[axis] = slice(None, abs(step))
            both = cells[tuple(cut)], xp.full_like(cells[tuple(end)], value)
            cells = xp.concat(both if step > 0 else both[::-1], axis=axis)
    return cells


def _depths(layers: Layers) -> tuple[list[Array], Array]:
    """Depths (H, W) of the first two layers without derivative, 0 unless a cell has both; and a mask of such cells."""
    two = layers.at(layers.covered[1], 0, 0)
    return [stopped(layers.xp.where(two, layers.target[k], 0.0)) for k in (0, 1)], two


class _Step(NamedTuple):
    """Two cells of two layers each, q and p one step farther on, and the cells on either side of them.

    Attributes:
        both: (H, W) bool, true for q where q and p have two layers.
        gaps: h(q) + h(p), (H, W).
        before: (H, W) bool, true where the cell before q has two layers, too.
        after: (H, W) bool, true where the cell after p has two layers, too.
        changes: the share of q in R, and that of p.
        directs: the share of q in D, and that of p.
    """

    both: Array
    gaps: Array
    before: Array
    after: Array
    changes: tuple[Array, Array]
    directs: tuple[Array, Array]


def _step(z0: Array, z1: Array, two: Array, m: Steps) -> _Step:
    """The `_Step` of all cells q and the cells p = q + m."""
    xp, back, twice = namespace(two, z0), opposite(m), (2 * m[0], 2 * m[1])
    (b0, b1), (p0, p1), (f0, f1) = ((ahead(z0, n, 0.0), ahead(z1, n, 0.0)) for n in (back, m, twice))
    gap = z1 - z0
    return _Step(
        both=two & ahead(two, m, False),
        gaps=gap + ahead(gap, m, 0.0),
        before=ahead(two, back, False),
        after=ahead(two, twice, False),
        changes=(
            xp.abs(b0 - 2 * z0 + p1) + xp.abs(b1 - 2 * z1 + p0),
            xp.abs(f0 - 2 * p0 + z1) + xp.abs(f1 - 2 * p1 + z0),
        ),
        directs=(
            xp.abs(b0 - 2 * z0 + p0) + xp.abs(b1 - 2 * z1 + p1),
            xp.abs(f0 - 2 * p0 + z0) + xp.abs(f1 - 2 * p1 + z1),
        ),
    )


def _ratio(z0: Array, z1: Array, two: Array, least: Array | float, m: Steps) -> Array:
    """R / (h(q) + h(p)) (H, W) for all cells q and p = q + m; infinity where these cannot be a pair.

    `z0`, `z1` and `two` are as in `pairs`. Sums of gaps up to `least` are rounding.
    """
    xp, step = namespace(two, z0), _step(z0, z1, two, m)
    before, after = step.before, step.after

    def both(sides: tuple[Array, Array]) -> Array:
        here, there = sides
        return xp.where(before & after, here + there, xp.where(before, here + here, there + there))

    change, direct = both(step.changes), both(step.directs)
    here = step.both & (before | after) & (step.gaps > least) & (change < DIRECT * direct)
    return xp.where(here, change / xp.where(here, step.gaps, 1.0), xp.inf)


def _candidates(z0: np.ndarray, z1: np.ndarray, two: np.ndarray, least: float, m: Steps) -> np.ndarray:
    """Cells q (H, W) bool that may form a pair with q + m, whether or not the cells beyond these two have two layers.

    Arguments are as in `_ratio`. `SLACK` allows for rounding, since pairs are computed from depths of another
    precision.
    """
    step, slack = _step(z0, z1, two, m), SLACK * least
    (change0, change1), (direct0, direct1) = step.changes, step.directs
    candidates = two & False
    for complete, change, direct in (
        (step.before, change0 + change0, direct0 + direct0),
        (step.after, change1 + change1, direct1 + direct1),
        (step.before & step.after, change0 + change1, direct0 + direct1),
    ):
        straight = (change < DIRECT * direct + slack) & (change < LARGEST * step.gaps + slack)
        candidates = candidates | (complete & straight)
    return candidates & step.both & (step.gaps > least - slack)


def _slope(
    first: Array, second: Array, m: Steps, two: Array, same: dict[Steps, Array], swapped: dict[Steps, Array]
) -> tuple[Array, Array]:
    """Slope along a step, of the sheet that is `first` at the target and `second` beyond the line; and where it exists.

    The slope is the mean of the differences on both sides, or the one that exists.

    Args:
        first: (H, W), depths of the layer that is the sheet's at the target.
        second: (H, W), depths of the other layer.
        m: the step, along x or y.
        two: (H, W) bool, true for cells with both layers.
        same: for each step from the target, (H, W) bool: the cell there has the sheets in the target's order.
        swapped: for each step, (H, W) bool: the cell there has them in the opposite order.
    """
    xp, changes, exists = namespace(two, first), [], []
    for sign in (1, -1):
        n = sign * m[0], sign * m[1]
        there = xp.where(swapped[n], ahead(second, n, 0.0), ahead(first, n, 0.0))
        changes.append(sign * (there - first))
        exists.append((same[n] | swapped[n]) & ahead(two, n, False))
    mean = (changes[0] + changes[1]) / 2
    slope = xp.where(exists[0] & exists[1], mean, xp.where(exists[0], changes[0], changes[1]))
    return slope, exists[0] | exists[1]
