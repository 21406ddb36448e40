"""Motion of outlines: coverage moves with the outline, whose motion is extrapolated from the samples beside it.

A sample lies up to a pixel or two inside of the outline that its weights represent. Where the surface turns, the sample
moves faster than the outline: on a rim of radius R pixels, a sample δ pixels inside is nearer by √(2Rδ). So coverage
moves as

    P̂ = P in value,    dP̂(p) = dP(p) + β (dP(p) − dP(partner)),

in x and y, where β and the partner of each cell p are decisions without a derivative. Directions n lead from a cell to
its eight neighbours. A direction is off if p + n is empty or not paired front to front with p. It is usable if n is
off, −n is not, and p₁ = p − n is covered. It is deep if it is usable, p₂ = p − 2n continues the surface, too, and the
depths of all three fall off as on a smooth rim. The first rule that applies gives β and the partner:

- Deepest: a direction is off, and p has two samples beside the deepest point of its ray in a field. The partner's
  motion is the mean of theirs, β = −1: an outline is where the least value of the field along a ray is zero.
- Chord: p has an exit, where the ray leaves the closed part that it met, or else a second layer of the same part; and
  the square of the gap behind its front runs to zero along a usable direction. The partner is that exit or layer,
  β = −½: the middle of a quadric's chord moves as its rim does.
- Root: there is a deep direction. The partner is p₁. On a rim depth is z − k √e, with e the distance to the outline in
  steps of n; with r = (z(p) − z(p₁)) / (z(p₁) − z(p₂)) then √e / (√(1 + e) − √e) = (1 + 2r − r²) / 2r (r − 1) = β.
- Line: there is a usable direction. The partner is p₁, β = ½: an edge lies half a pixel beyond its samples, on average.

If several directions qualify, the one that points most along the sum of all off directions is taken.
"""

from __future__ import annotations

import functools
import operator
from typing import Any, NamedTuple

import numpy as np

from rts.arrays.engines import namespace, stopped
from rts.arrays.trees import Array
from rts.splatting.kernel import Kernel
from rts.splatting.layers import AROUND, Layers, Steps, bordered, dilated, opposite

LEAST, LARGEST = 1.23, 2.5
"""The least ratio r of depths beside a smooth rim, 1.5 pixels away; and the largest β."""
FLAT = 1e-5
"""Differences of depth below this share of the farthest depth are rounding."""
CONVERGING = 1.5
"""Ratio of the squares of two gaps, a pixel apart, from which a surface closes within two pixels."""
HALF = 0.5
"""β of the line, and −β of the chord."""
DEEPEST = -1.0
"""β of deepest points, and of no other rule."""


def gains(
    kernel: Kernel, layers: Layers, shift: dict[Steps, Array], part: Array | None, crossed: Array | None = None
) -> tuple[Array, Array]:
    """Changes of coverage where outlines move otherwise than their samples: zeros (H, W) with derivatives.

    Fronts of sources move as their own outlines. At the surface of a covered target, fronts of its part move as the
    target's outline. Beside a line of crossing so do fronts of other parts; otherwise a gap may open.

    Args:
        kernel: the splatter.
        layers: the samples.
        shift: for each offset (u, v) from source to target, the number s of `Visible` at each target; 0 at empty ones.
        part: (K, H, W), the part of each sample, or None where all may be of one.
        crossed: (H, W) bool, true for cells beside lines where surfaces cross; None if unknown.

    Returns:
        The changes (H, W) of coverage in front of the targets' surfaces, and at them.
    """
    xp, motion = layers.xp, _motion(layers, layers.position[0], layers.covered[0])
    outline = outline_motion(layers, shift, part, motion)
    around = bordered(xp.permute_dims(outline, (2, 0, 1)), 0)
    around = xp.permute_dims(around, (1, 2, 0))
    parts = None if part is None else bordered(part[:1, :, :])[0]
    offsets = xp.stack(kernel.offsets(layers.position[0]), axis=-1)
    front, surface = 0.0, 0.0
    for n, s in shift.items():
        own = layers.at(offsets, *n)
        joined = layers.covers(0, 0) & (s == 0)
        if parts is not None:
            same = layers.at(parts, *n) == layers.at(parts, 0, 0)
            joined = joined & (same if crossed is None else same | crossed)
        change = xp.where(joined[..., None], outline, layers.at(around, *n)) - layers.at(motion, *n)
        gain = kernel.weight(own + kernel.gamma * change, *n) - kernel.weight(own, *n)
        front = front + xp.where(layers.covers(*n) & (s > 0), gain, 0.0)
        surface = surface + xp.where(layers.covers(*n) & (s == 0), gain, 0.0)
    return front, surface


def spread(total: Array, gain: Array) -> Array:
    """The change (H, W, 5) of a buffer: `gain` times its mean; 0 where it is empty, or fills the target.

    Args:
        total: the buffer's sums (H, W, 5), colours and weight.
        gain: the change of its coverage (H, W).
    """
    xp, weight = namespace(total), total[..., 4]
    partial = (weight > 0) & (weight < 1)
    return (xp.where(partial, gain, 0.0) / xp.where(partial, weight, 1.0))[..., None] * total


class Back(NamedTuple):
    """Possible far ends of chords.

    Attributes:
        own: (H, W) bool, cells whose chord may end there.
        covered: (h, w) bool, cells that have such an end, with a border of one cell.
        gap: (h, w), distance of the end behind the front, without derivative; None for deepest points.
        position: (h, w, 3), position of the end; for deepest points the mean of two.
    """

    own: Array
    covered: Array
    gap: Array | None
    position: Array


def outline_motion(layers: Layers, shift: dict[Steps, Array], part: Array | None, motion: Array) -> Array:
    """Motion of the outline beside each cell, P̂ without its value: zeros (H, W, 2) with derivatives.

    Args:
        layers: the samples.
        shift: see `gains`.
        part: see `gains`.
        motion: motion of the fronts (h, w, 2), zeros with derivatives, with a border of one cell.
    """
    xp, own = layers.xp, layers.at(motion, 0, 0)
    chord, beta, inward = rules(layers, shift, part)
    partner = sum(xp.where((inward == i)[..., None], layers.at(motion, *n), 0.0) for i, n in enumerate(AROUND))
    for i, back in enumerate(_backs(layers, part)):
        end = layers.at(_motion(layers, back.position, back.covered), 0, 0)
        partner = xp.where((chord == i)[..., None], end, partner)
    return own + beta[..., None] * (own - partner)


def rules(layers: Layers, shift: dict[Steps, Array], part: Array | None) -> tuple[Array, Array, Array]:
    """For each cell the end of its chord, β, and the direction n from its partner's cell, (H, W) each.

    The end is an index into `_backs`, −1 without a chord. The direction is an index into AROUND, −1 where there is no
    partner, or where it is in the cell itself.
    """
    xp, (z, _) = layers.xp, layers.front(0, 0)
    z = stopped(z)
    off = _off(layers, shift)
    usable = {n: off[n] & layers.covers(*n) & ~off[opposite(n)] for n in AROUND}
    outward = tuple(sum(xp.where(o, n[i], 0) for n, o in off.items()) for i in (0, 1))
    best, inward = (xp.full_like(shift[0, 0], x) for x in (-1000, -1))
    deep, beta = inward > 0, xp.zeros_like(z)
    for i, n in enumerate(AROUND):
        ratio = _ratio(layers, z, n, off)
        rim = usable[n] & (ratio > LEAST)
        along = n[0] * outward[0] + n[1] * outward[1]
        # In the order of n · outward / ‖n‖, in whole numbers.
        score = along * xp.abs(along) * (3 - abs(n[0]) - abs(n[1]))
        take = usable[n] & ((rim & ~deep) | ((rim == deep) & (score > best)))
        best, inward, deep = xp.where(take, score, best), xp.where(take, i, inward), deep | (take & rim)
        beta = xp.where(take, xp.where(rim, _root(xp.where(rim, ratio, 2.0), xp), HALF), beta)
    chord = xp.full_like(inward, -1)
    for i, back in enumerate(_backs(layers, part)):
        closes = _closes(layers, off if back.gap is None else usable, back)
        chord, beta = xp.where(closes, i, chord), xp.where(closes, DEEPEST if back.gap is None else -HALF, beta)
    return chord, beta, xp.where(chord >= 0, -1, inward)


def chords(covered: np.ndarray) -> np.ndarray:
    """Second layers (K, H, W) bool, in or beside covered cells that have an empty neighbour."""
    ring = covered[0] & dilated(~covered[0])
    return covered & dilated(ring) & (np.arange(len(covered)) == 1)[:, None, None]


def _motion(layers: Layers, position: Array, covered: Array) -> Array:
    """Zeros (h, w, 2) with the derivatives of positions (h, w, 3) in x and y, where covered (h, w)."""
    xy = position[..., :2]
    return layers.xp.where(covered[..., None], xy - stopped(xy), 0.0)


def _off(layers: Layers, shift: dict[Steps, Array]) -> dict[Steps, Array]:
    """For each direction, (H, W) bool: true where a cell's front ends, and the direction stays in the array."""
    xp, covered = layers.xp, layers.covers(0, 0)
    inside = bordered(xp.zeros_like(shift[0, 0])[None])[0] >= 0
    ends = {}
    for n in AROUND:
        # Pairing is symmetric, so p + n is tested as a source of p.
        back = opposite(n)
        ends[n] = covered & layers.at(inside, *back) & (~layers.covers(*back) | (shift[back] != 0))
    return ends


def _ratio(layers: Layers, z: Array, n: Steps, off: dict[Steps, Array]) -> Array:
    """The ratio r (H, W) along a direction; 0 where p₂ does not continue the surface, or its depth does not fall off.

    Args:
        layers: the samples.
        z: (H, W), depths of the fronts, without derivative.
        n: the direction, from p₁ to p.
        off: the result of `_off`.
    """
    xp, back = layers.xp, opposite(n)
    (z1, _), (z2, there) = layers.front(*n), layers.front(2 * n[0], 2 * n[1])
    z1, z2 = stopped(z1), stopped(z2)
    ends = layers.at(bordered(xp.where(off[back], 1, 0)[None])[0], *n) == 1
    slope = z1 - z2
    falls = there & ~ends & (slope > FLAT * stopped(layers.extent))
    return xp.where(falls, (z - z1) / xp.where(falls, slope, 1.0), 0.0)


def _root(ratio: Array, xp: Any) -> Array:
    """β of a smooth rim, from the ratio r."""
    return xp.clip((1 + 2 * ratio - ratio * ratio) / (2 * ratio * (ratio - 1)), 0.0, LARGEST)


def _backs(layers: Layers, part: Array | None) -> list[Back]:
    """The ends of chords: deepest points, exits, and in cells without these the second layer of the front's part."""
    backs = []
    if layers.exits:
        covered, position = layers.exits[0]
        if len(layers.exits) > 1:
            pairs, second = layers.exits[1]
            backs.append(Back(layers.at(pairs, 0, 0), pairs, None, (position + second) / 2))
            covered = covered & ~pairs
        backs.append(Back(layers.at(covered, 0, 0), covered, stopped(layers.behind(position[..., 2])), position))
    if part is not None and len(layers.position) > 1:
        covered, position = layers.covered[1], layers.position[1]
        own = layers.at(covered, 0, 0) & (part[0] == part[1])
        for back in backs:
            own = own & ~back.own
        backs.append(Back(own, covered, stopped(layers.behind(position[..., 2])), position))
    return backs


def _closes(layers: Layers, directions: dict[Steps, Array], back: Back) -> Array:
    """True (H, W) where fronts and the far ends `back` meet along one of the directions that hold.

    `directions` has a mask (H, W) for each direction: usable ones; for deepest points those that are off, and then any
    of them will do.
    """
    if back.gap is None:
        return functools.reduce(operator.or_, directions.values()) & back.own
    gap, closing = layers.at(back.gap, 0, 0), False
    for n in AROUND:
        inner = layers.at(back.gap, *n)
        closing = closing | (directions[n] & layers.at(back.covered, *n) & (CONVERGING * gap * gap <= inner * inner))
    return closing & back.own
