"""Translucent layers: the rule of `Visible`, applied again behind each layer that lets light through.

At a target, the layers of the nine sources around it are taken level by level. Level t is the target's own layer t.
Sources pair with it as `Visible` pairs them, on the layers that they have left. Each level has three buffers:

    F     layers in front of the level, composited a source;
    S     layers at the level, with coverage W (the sum of weights) and alpha A;
    gap   layers that show where S ends, each source composited from there on.

Buffers are normalised by the weights of the sources that take part. The image of a level is

    F over [S + (W − A) · through + (1 − W) · gap],

where `through` is the image of the next level. The sources of S take part there, each with its layers behind S. A
source that lacks the level joins at its own front layer's level. Where all layers are opaque W = A, and the image is
that of opaque layers, continuously in alpha.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from rts.arrays.trees import Array
from rts.splatting.layers import NEIGHBOURS, Layers, Steps, first_minimum, opposite_sides, over


@dataclass(frozen=True)
class Source:
    """The stack of the source at one offset from each target.

    Attributes:
        depth: of its layers, K times (H, W).
        facing: `Splats.facing` of its layers, K times (H, W); or None.
        covered: of its layers, K times (H, W) bool.
        splats: of its layers, K times (H, W, 5): weighted premultiplied colours, and the weight.
        alpha: of its layers, K times (H, W); 0 where not covered.
    """

    depth: list[Array]
    facing: list[Array] | None
    covered: list[Array]
    splats: list[Array]
    alpha: list[Array]

    @classmethod
    def at(cls, layers: Layers, n: Steps, still: Array | None) -> Source:
        """The source from which steps `n` lead to the target; weights have no derivative at targets `still` (H, W)."""
        every = range(len(layers.target))
        return cls(
            layers.source(*n),
            layers.sides(*n),
            [layers.at(layers.covered[k], *n) for k in every],
            layers.splats(*n, still=still),
            [layers.color(k, *n)[..., 3] for k in every],
        )

    def composited(self, first: Array, last: Array, xp: Any) -> Array:
        """Layers first ≤ k < last over one another, with the weight of the first one, (H, W, 5); 0 if there is none.

        `first` and `last` are (H, W) integers.
        """
        total = xp.zeros_like(self.splats[0])
        for k in reversed(range(len(self.splats))):
            inside = ((first <= k) & (k < last))[..., None]
            own = self.splats[k]
            whole = xp.concat([own[..., :4] + (1 - self.alpha[k])[..., None] * total[..., :4], own[..., 4:]], axis=-1)
            total = xp.where(inside, whole, total)
        return total


@dataclass(frozen=True)
class Left:
    """The layers that a source has left.

    Attributes:
        start: (H, W) int, the first layer that is left.
        joins: (H, W) int, the level from which on the source takes part; K if it does not.
    """

    start: Array
    joins: Array


def picked(values: list[Array], index: Array, xp: Any) -> Array:
    """For each target the value with an index (H, W) out of K, (H, W) or (H, W, ·); 0 where there is no such value."""
    total = xp.zeros_like(values[0])
    for k, value in enumerate(values):
        chosen = index == k
        total = xp.where(chosen[..., None] if value.ndim > 2 else chosen, value, total)
    return total


def composites(layers: Layers) -> Callable[[int, int], Array]:
    """A function that gives all layers of each source at (u, v), composited: (H, W, 5), as `Layers.color`."""

    def composite(u: int, v: int) -> Array:
        front, total = layers.color(0, u, v), 0.0
        for k in reversed(range(len(layers.target))):
            total = over(layers.color(k, u, v)[..., :4], total)
        return layers.xp.concat([total, front[..., 4:]], axis=-1)

    return composite


def image(layers: Layers, shift: dict[Steps, Array], sigma: float, gains: Any, still: Array | None = None) -> Array:
    """The image (H, W, 4) of stacks of translucent layers.

    Args:
        layers: the samples.
        shift: for each offset the number s of `Visible` at the first level.
        sigma: of the kernel, cells.
        gains: function of the two sums (H, W, 5) of F and S at the first level. It returns the changes (H, W, 5) of
            these buffers, once normalised, as outlines move; or 0.0 for no change.
        still: (H, W) bool, targets whose image has no derivative in positions; None for none.
    """
    xp, count = layers.xp, len(layers.target)
    sources = {n: Source.at(layers, n, still) for n in NEIGHBOURS}
    zero = xp.zeros_like(shift[NEIGHBOURS[0]])
    left = dict.fromkeys(NEIGHBOURS, Left(zero, zero))
    levels = []
    for t in range(count):
        if t:
            shift = {n: pairing(source, sources[0, 0], left[n], t, xp) for n, source in sources.items()}
        present = {n: left[n].joins <= t for n in NEIGHBOURS}
        least = 1.0
        if t:
            share = sum(xp.where(p, nominal(*n, sigma), 0.0) for n, p in present.items())
            least = xp.where(share > 0, share, 1.0)[..., None]
        totals = buffers(sources, left, shift, present, t, xp)
        front, surface, behind = (total / xp.clip(total[..., 4:], least, None) for total in totals)
        if t == 0:
            front, surface = (c + change for c, change in zip((front, surface), gains(totals[:2]), strict=True))
        levels.append((front[..., :4], surface, behind[..., :4]))
        left = {n: advanced(sources[n], left[n], shift[n], t, xp) for n in NEIGHBOURS}
    through = 0.0
    for front, surface, behind in reversed(levels):
        coverage, alpha = surface[..., 4:], surface[..., 3:4]
        through = over(front, surface[..., :4] + (coverage - alpha) * through + (1 - coverage) * behind)
    return through


def nominal(u: int, v: int, sigma: float) -> float:
    """The weight of a sample on its cell's centre at an offset, as a share of all nine."""
    e = [math.exp(-(k**2) / (2 * sigma**2)) for k in (0, 1)]
    return e[abs(u)] * e[abs(v)] / (e[0] + 2 * e[1]) ** 2


def pairing(source: Source, target: Source, left: Left, level: int, xp: Any) -> Array:
    """The number s (H, W) of a source at a level; 0 where the target lacks this level.

    s ≥ 0: the source's layer start + s is at the level. s < 0: its layer start pairs with the target's layer level − s.

    Args:
        source: the source.
        target: the source at (0, 0).
        left: the layers that the source has left.
        level: the level, counted from 0.
        xp: the array namespace.
    """
    count, start, own = len(source.depth), left.start, target.depth[level]
    z = picked(source.depth, start, xp)
    beyond = xp.full_like(own, xp.inf)
    ahead = [xp.where(k >= start, xp.abs(source.depth[k] - own), beyond) for k in range(count)]
    below = [xp.abs(target.depth[k] - z) for k in range(level, count)]
    if source.facing is not None and target.facing is not None:
        front, side = picked(source.facing, start, xp), target.facing[level]
        for k in range(1, count):
            other = (k > start) & opposite_sides(source.facing[k], side, own > source.depth[k])
            ahead[k] = xp.where(other, beyond, ahead[k])
        for k in range(level + 1, count):
            other = opposite_sides(target.facing[k], front, z > target.depth[k])
            below[k - level] = xp.where(other, beyond, below[k - level])
    a, best_a = first_minimum(ahead, xp)
    b, best_b = first_minimum(below, xp)
    s = xp.where(best_b < best_a, -b, a - start)
    return xp.where(target.covered[level], s, 0)


def buffers(
    sources: dict[Steps, Source],
    left: dict[Steps, Left],
    shift: dict[Steps, Array],
    present: dict[Steps, Array],
    level: int,
    xp: Any,
) -> list[Array]:
    """The sums (H, W, 5) of F, S and gap at a level, over the sources that take part.

    Args:
        sources: the source at each offset.
        left: the layers that each has left.
        shift: the number s (H, W) of each, see `pairing`.
        present: (H, W) bool for each, true where it takes part.
        level: the level, counted from 0.
        xp: the array namespace.
    """
    own, count = sources[0, 0], len(sources[0, 0].depth)
    least = xp.full_like(shift[0, 0], count)
    for n, s in shift.items():
        shown = present[n] & (s < 0) & picked(sources[n].covered, left[n].start, xp)
        least = xp.where(shown & (-s < least), -s, least)
    revealed = picked(own.depth, least + level, xp)
    totals = [0.0, 0.0, 0.0]
    for n, source in sources.items():
        start, at = left[n].start, left[n].start + shift[n]
        end = xp.full_like(at, count)
        in_front = source.composited(start, xp.where(shift[n] > 0, at, start), xp)
        last = end if level == count - 1 else at + 1
        surface = source.composited(xp.where(shift[n] >= 0, at, end), last, xp)
        hidden = xp.where(shift[n] < 0, start, _nearest(source.depth, revealed, at, xp))
        behind = source.composited(xp.where(least < count, hidden, end), end, xp)
        for i, total in enumerate((in_front, surface, behind)):
            totals[i] = totals[i] + xp.where(present[n][..., None], total, 0.0)
    return totals


def _nearest(depth: list[Array], level: Array, at: Array, xp: Any) -> Array:
    """Index of each source's layer beyond `at` that is nearest to the depth `level` (H, W); K where none is beyond."""
    best, index = xp.full_like(level, xp.inf), xp.full_like(at, len(depth))
    for k, z in enumerate(depth):
        distance = xp.abs(z - level)
        nearer = (k > at) & (distance < best)
        best, index = xp.where(nearer, distance, best), xp.where(nearer, k, index)
    return index


def advanced(source: Source, left: Left, s: Array, level: int, xp: Any) -> Left:
    """The layers that a source has left behind `level`, where it has the number s (H, W), see `pairing`.

    Where it takes part with s ≥ 0, its layers up to start + s are used up. It joins at the next level, or never (K) if
    its layer start + s is not covered. Where it takes part with s < 0, nothing is used up, and it joins at level − s,
    or never if its layer start is not covered. Where it does not take part yet, nothing changes.
    """
    count, never = len(source.depth), xp.full_like(s, len(source.depth))
    here, at = left.joins <= level, left.start + s
    taken = here & (s >= 0)
    covered, ahead = (picked(source.covered, index, xp) for index in (at, left.start))
    joins = xp.where(covered, level + 1, never)
    waits = xp.where(ahead, xp.clip(level - s, None, count), never)
    return Left(
        xp.where(taken, at + 1, left.start),
        xp.where(taken, joins, xp.where(here, waits, left.joins)),
    )
