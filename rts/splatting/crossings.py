"""How lines move where two surfaces pass through one another: there the derivative follows their depths.

On the line the depths of two sheets a and b are equal: g = z_a − z_b = 0. With ġ the difference of the rates at which
their depths change at the fixed pixel, it moves as

    v̂ = −ġ ∇g / |∇g|²,    ż = dP_z − ∇z · dP_xy.

Beside it the sheets are layers 0 and 1 of the cells, in one order on either side. With q a cell, m one of the eight
steps to its neighbours and p = q + m, both with two layers z0 and z1 and gaps h = z1 − z0,

    R = |z0(q − m) − 2 z0(q) + z1(p)| + |z1(q − m) − 2 z1(q) + z0(p)| + the two of p, seen from the other side,
    D = |z0(q − m) − 2 z0(q) + z0(p)| + |z1(q − m) − 2 z1(q) + z1(p)| + ...

is by how much slopes change if the line runs between q and p, and if it does not. Of a side that lacks two layers the
other's terms count twice. (q, p) is a pair where R < D / 2, R < (h(q) + h(p)) / 2, and R / (h(q) + h(p)) is least along
m. On planes R is zero.

The sources of a covered target q of a pair are of b where they form a pair with q, and else of a where they are paired
front to front with it. ∇z_a and ∇z_b are differences over q's neighbours in its row and column. A source of neither, if
it has two layers, is of the sheet whose plane is nearer. Where all nine are of a sheet the image's derivative in
positions is that of

    (Ŵ_a c_a + Ŵ_b c_b) / (Ŵ_a + Ŵ_b),    c = Σ w rgba / Σ w over the fronts of one sheet:

coverage Ŵ moves with the line, mean colours with their samples. Its value, and its derivative in colours, are what they
were.
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
"""R in terms of h(q) + h(p), below which the sheets are straight enough."""
DIRECT = 0.5
"""R in terms of D, below which the sheets are in another order."""
FIT = 0.5
"""How far a source may be from the planes of both sheets, in terms of the change of g on the way."""
KEPT = 2
"""Cells around what may be a pair whose first two layers are kept."""
SLACK = 0.01
"""Rounding of depths, in terms of the least sum of gaps of a pair."""

HALF = [(1, 0), (0, 1), (1, 1), (1, -1)]
"""Steps from one cell of each pair to the other."""


class Lines(NamedTuple):
    """Targets whose derivative in positions follows a line, and what is decided for them.

    Attributes:
        target: (H, W) bool, which these are.
        other: for each offset from source to target but (0, 0), where the source is of sheet b (H, W).
        slopes: (∂x, ∂y) of the sheets a and b, (H, W) each.
    """

    target: Array
    other: dict[Steps, Array]
    slopes: list[tuple[Array, Array]]

    def sums(self, values: Callable[[int, int], Array]) -> list[Array]:
        """The sum over each sheet of values (H, W, ·) of sources, which are given by the offset from them."""
        found: list[Any] = [0.0, 0.0]
        for n in NEIGHBOURS:
            given, other = values(*n), self.other[n] if n in self.other else self.target & False
            for i, here in enumerate((self.target & ~other, self.target & other)):
                found[i] = found[i] + namespace(given).where(here[..., None], given, 0.0)
        return found


def motion(kernel: Kernel, layers: Layers, lines: Lines) -> Array:
    """How lines move the image: zeros (H, W, 4) with derivatives in positions.

    Args:
        kernel: the splatter.
        layers: its samples, of at least two layers.
        lines: see `targets`.
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
    given = lines.sums(lambda u, v: stopped(layers.color(0, u, v)) * layers.weight(0, u, v)[..., None])
    means = [g[..., :4] / xp.where(target[..., None], g[..., 4:], 1.0) for g in given]
    total = xp.where(target[..., None], coverage[0] + coverage[1], 1.0)
    mixed = sum(w / total * mean for w, mean in zip(coverage, means, strict=True))
    return xp.where(target[..., None], mixed - stopped(mixed), 0.0)


def targets(layers: Layers, shift: dict[Steps, Array], crosses: dict[Steps, Array]) -> Lines:
    """The targets whose derivative in positions follows a line.

    Args:
        layers: the samples, of at least two layers.
        shift: for each offset (u, v) from source to target, the targets' number s; 0 at empty targets.
        crosses: see `pairs`.
    """
    xp, (z, two) = layers.xp, _depths(layers)
    # By the step from the target to the source.
    swapped = dict(crosses)
    same = {m: ~crosses[m] & (shift[opposite(m)] == 0) & layers.covers(*opposite(m)) for m in AROUND}
    slopes, known = [], two & functools.reduce(operator.or_, crosses.values())
    for first, second in (z, reversed(z)):
        found = [_slope(first, second, m, two, same, swapped) for m in ((1, 0), (0, 1))]
        slopes.append(tuple(s for s, _ in found))
        known = known & found[0][1] & found[1][1]
    (ax, ay), (bx, by) = slopes
    square = (ax - bx) * (ax - bx) + (ay - by) * (ay - by)
    target = known & (square > 0)
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
    # Weights may vanish, of samples that are not where they were cast.
    a, b = lines.sums(lambda u, v: stopped(layers.color(0, u, v)[..., 4:] * layers.weight(0, u, v)[..., None]))
    return lines._replace(target=target & (a[..., 0] > 0) & (b[..., 0] > 0))


def pairs_of(layers: Layers) -> dict[Steps, Array]:
    """`pairs` of samples of at least two layers."""
    z, two = _depths(layers)
    return pairs(z[0], z[1], two, stopped(layers.extent))


def pairs(z0: Array, z1: Array, two: Array, extent: Array | float) -> dict[Steps, Array]:
    """Between which cells lines of crossing run: for each step m, cells q (H, W) of pairs (q, q + m).

    Args:
        z0: depths of the first layer (H, W), finite.
        z1: of the second.
        two: where there are both.
        extent: of the fronts' depths, the camera's included.
    """
    xp, found = namespace(two, z0), {}
    ratios = {m: _ratio(z0, z1, two, TIE * extent, m) for m in HALF}
    for m, ratio in ratios.items():
        back = opposite(m)
        least = (ratio < ahead(ratio, back, xp.inf)) & (ratio <= ahead(ratio, m, xp.inf))
        found[m] = least & (ratio < LARGEST)
        found[back] = ahead(found[m], back, False)
    return {m: found[m] for m in AROUND}


def sheets(covered: np.ndarray, depth: np.ndarray) -> np.ndarray:
    """The first two layers (K, H, W) near what may be pairs, of covered (K, H, W) bool and depth (K, H, W).

    Whatever other hidden layers are left out, `pairs` finds the same.
    """
    if len(covered) < 2 or not covered[1].any():
        return covered & False
    seen = depth[0][covered[0]]
    extent = max(seen.max(), 0) - min(seen.min(), 0)
    two = covered[0] & covered[1]
    first, second = np.where(two, depth[:2], 0)
    near = two & False
    for m in HALF:
        found = _candidates(first, second, two, TIE * extent, m)
        near = near | found | ahead(found, opposite(m), False)
    for _ in range(KEPT):
        near = near | np.logical_or.reduce([ahead(near, m, False) for m in AROUND])
    return covered & near & (np.arange(len(covered)) < 2)[:, None, None]


def ahead(cells: Array, steps: Steps, value: float) -> Array:
    """For each cell of (H, W), the one that lies some steps (x, y) farther on; a value outside of the array."""
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
    """Depths (H, W) of the first two layers without derivative, and where there are both."""
    two = layers.at(layers.covered[1], 0, 0)
    return [stopped(layers.xp.where(two, layers.target[k], 0.0)) for k in (0, 1)], two


class _Step(NamedTuple):
    """Two cells of two layers each, q and the one p a step farther on, with what lies beyond them.

    Attributes:
        both: (H, W) bool, where these are.
        gaps: h(q) + h(p), (H, W).
        before: where the cell before q has two layers, too.
        after: where the one after p does.
        changes: q's share of R, and p's.
        directs: q's share of D, and p's.
    """

    both: Array
    gaps: Array
    before: Array
    after: Array
    changes: tuple[Array, Array]
    directs: tuple[Array, Array]


def _step(z0: Array, z1: Array, two: Array, m: Steps) -> _Step:
    """All cells and those a step m farther on."""
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
    """R / (h(q) + h(p)) of cells and those a step m farther on; infinity where they are no pair."""
    xp, step = namespace(two, z0), _step(z0, z1, two, m)
    before, after = step.before, step.after

    def both(sides: tuple[Array, Array]) -> Array:
        here, there = sides
        return xp.where(before & after, here + there, xp.where(before, here + here, there + there))

    change, direct = both(step.changes), both(step.directs)
    here = step.both & (before | after) & (step.gaps > least) & (change < DIRECT * direct)
    return xp.where(here, change / xp.where(here, step.gaps, 1.0), xp.inf)


def _candidates(z0: np.ndarray, z1: np.ndarray, two: np.ndarray, least: float, m: Steps) -> np.ndarray:
    """Cells q (H, W) that may form a pair with q + m, whichever of the cells beyond these two have two layers.

    Rounding decides nothing: pairs are found among depths of another precision.
    """
    step, slack = _step(z0, z1, two, m), SLACK * least
    (change0, change1), (direct0, direct1) = step.changes, step.directs
    found = two & False
    for known, change, direct in (
        (step.before, change0 + change0, direct0 + direct0),
        (step.after, change1 + change1, direct1 + direct1),
        (step.before & step.after, change0 + change1, direct0 + direct1),
    ):
        found = found | (known & (change < DIRECT * direct + slack) & (change < LARGEST * step.gaps + slack))
    return found & step.both & (step.gaps > least - slack)


def _slope(
    first: Array, second: Array, m: Steps, two: Array, same: dict[Steps, Array], swapped: dict[Steps, Array]
) -> tuple[Array, Array]:
    """Slope along a step of a sheet that is `first` at the target and `second` beyond the line; and where it is known.

    It is that of both sides' differences, or of the one there is.
    """
    xp, changes, known = namespace(two, first), [], []
    for sign in (1, -1):
        n = sign * m[0], sign * m[1]
        there = xp.where(swapped[n], ahead(second, n, 0.0), ahead(first, n, 0.0))
        changes.append(sign * (there - first))
        known.append((same[n] | swapped[n]) & ahead(two, n, False))
    mean = (changes[0] + changes[1]) / 2
    slope = xp.where(known[0] & known[1], mean, xp.where(known[0], changes[0], changes[1]))
    return slope, known[0] | known[1]
