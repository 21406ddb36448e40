"""Targets of translucent layers: the rule of `rts.splatting.stacks`, compiled, and its first derivatives.

Level t of a target is its own layer t, with the layers of its sources that pair with it. Plans are made once: for each
level, the layers that each source gives to the buffers in front, at the level, and in the gap beside it. Layers that a
source gives to one buffer lie over one another, as chains.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from rts.plugin_api.loops import compiled, loop
from rts_backends.fused.layer_pairing import opposite_sides
from rts_backends.fused.mixed_targets import splat


class Stacks(NamedTuple):
    """Plans and sums of M targets with up to K levels; entries behind a target's last level are not filled.

    Attributes:
        levels: (M,) int32, the number of levels of each target.
        plans: (M, K, 9, 3) int16, for each source the first layer that it gives to each buffer, or −1; see `_last`.
        ends: (M, K, 9) int16, for each source the layer behind those that it gives to the buffer in front.
        least: (M, K), the least weight that fills a buffer.
        sums: (M, K, 3, 5), of each buffer the colours over the weight, taken as at least `least`, and the weight.
        images: (M, K + 1, 4), the image from each level on; zeros at the place behind the last level.
        straight: (H, W) uint8, the number of layers of further targets, which need no plan (`straight_stacks.py`); 0 at
            others.
    """

    levels: np.ndarray
    plans: np.ndarray
    ends: np.ndarray
    least: np.ndarray
    sums: np.ndarray
    images: np.ndarray
    straight: np.ndarray

    @classmethod
    def of(cls, count: int, layers: int, kind: np.dtype, straight: np.ndarray) -> Stacks:
        """Memory, not yet filled, for `count` targets with plans of up to `layers` levels, floats of dtype `kind`."""
        return cls(
            np.zeros(count, np.int32),
            np.empty((count, layers, 9, 3), np.int16),
            np.empty((count, layers, 9), np.int16),
            np.empty((count, layers), kind),
            np.empty((count, layers, 3, 5), kind),
            np.empty((count, layers + 1, 4), kind),
            straight,
        )


WEIGHT, ALONG_X, ALONG_Y, DEPTH, SOURCE = 4, 5, 6, 7, 8
"""Indices of the numbers of a source's layer: four of its colour, then its weight, the offset from sample to target (x,
y), its depth. SOURCE is how many there are."""


@compiled
def _load(sources, n, grid, y, x, u, v, beyond):
    """Fill entry n of `sources` (·, K, 8), the layers of the source from which (u, v) leads to target (y, x).

    Layers that are not covered get zeros and the depth `beyond`, as do all outside of the grid. Returns one more than
    the last covered layer; 0 if there is none.
    """
    positions, rgba, row = grid.positions, grid.rgba, grid.row
    layers, height, width = row.shape
    py, px, count = y - v, x - u, 0
    inside = 0 <= py < height and 0 <= px < width
    for k in range(layers):
        i = row[k, py, px] if inside else -1
        if i >= 0:
            weight, along_x, along_y = splat(grid, i, py, px, u, v)
            sources[n, k, 0], sources[n, k, 1], sources[n, k, 2] = rgba[i, 0], rgba[i, 1], rgba[i, 2]
            sources[n, k, 3], sources[n, k, WEIGHT], sources[n, k, DEPTH] = rgba[i, 3], weight, positions[i, 2]
            sources[n, k, ALONG_X], sources[n, k, ALONG_Y], count = along_x, along_y, k + 1
        else:
            sources[n, k, DEPTH] = beyond
            sources[n, k, :DEPTH] = 0
    return count


# ---------------------------------------------------------------------------------------------------------- plans


def reached(covered: np.ndarray) -> np.ndarray:
    """(H, W) uint8, 1 at covered cells (H, W) bool and at the eight cells around each."""
    wide = np.pad(covered, ((1, 1), (0, 0)))
    wide = np.pad(wide[:-2] | wide[1:-1] | wide[2:], ((0, 0), (1, 1)))
    return (wide[:, :-2] | wide[:, 1:-1] | wide[:, 2:]).view(np.uint8)


@loop
def fill(start, stop, grid, facing, beyond, offsets, columns, ranges, stacks):
    """Make the plans, sums and images of the targets of rows [start, stop).

    Args:
        start: first row.
        stop: end of the rows.
        grid: the samples.
        facing: (K, H, W), `Splats.facing`, or no layers.
        beyond: depth of what is not covered.
        offsets: (H + 1,), where the targets of each row begin.
        columns: (M,), their columns.
        ranges: (M, 9, 3, 2) of `layer_pairing.choose`, for the first level.
        stacks: to be filled, but for `straight`.
    """
    row, kind = grid.row, grid.positions.dtype.type
    layers = len(row)
    sources, counts = np.empty((9, layers, SOURCE), grid.positions.dtype), np.empty(9, np.int64)
    sides = np.zeros((9, layers), np.int64)
    first, joins, shift = np.empty(9, np.int64), np.empty(9, np.int64), np.empty(9, np.int64)
    nominal = np.empty(9, grid.positions.dtype)
    for n in range(9):
        u, v = kind(n % 3 - 1), kind(n // 3 - 1)
        nominal[n] = math.exp(-(u * u + v * v) * grid.scale)
    whole = nominal.sum()
    for n in range(9):
        nominal[n] /= whole
    for y in range(start, stop):
        for d in range(offsets[y], offsets[y + 1]):
            for n in range(9):
                counts[n] = _load(sources, n, grid, y, columns[d], n % 3 - 1, n // 3 - 1, beyond)
            if len(facing) > 0:
                _load_sides(sides, facing, counts, y, columns[d])
            first[:], joins[:] = 0, 0
            stacks.levels[d] = layers
            for t in range(layers):
                share = _share(t, counts, first, joins, nominal)
                if share < 0:
                    stacks.levels[d] = t
                    break
                _shift(shift, t, d, ranges, sources, sides, len(facing) > 0, counts, first, joins)
                _plan(stacks, d, t, sources, counts, first, joins, shift)
                stacks.least[d, t] = kind(1) if t == 0 else share
                _sum(stacks, d, t, sources, counts, t == layers - 1)
                _advance(t, layers, counts, first, joins, shift)
            _composite(stacks, d, stacks.levels[d])


@compiled
def _share(t, counts, first, joins, nominal):
    """The share of the weights of sources that take part in level t; −1 if none of these has a layer left.

    Args:
        t: the level.
        counts: (9,), the number of layers of each source.
        first: (9,), the first layer that each source has not yet given.
        joins: (9,), the least level that each source takes part in from now on.
        nominal: (9,), the shares of sources whose samples lie on their cells' centres.
    """
    share, some = nominal.dtype.type(0), False
    for n in range(9):
        if joins[n] <= t:
            share += nominal[n]
            some |= first[n] < counts[n]
    return share if some else -nominal.dtype.type(1)


@compiled
def _shift(shift, t, d, ranges, sources, sides, told, counts, first, joins):
    """Fill `shift` (9,) with the number s of `_pair`, for each source that takes part in level t and has layers left.

    Other entries stay as they are. `ranges` (M, 9, 3, 2) decide for target d at level 0, where they pair; for the rest
    see `_share` and `_pair`.
    """
    for n in range(9):
        if joins[n] > t or first[n] >= counts[n]:
            continue
        if t == 0 and ranges[d, n, 1, 1] > ranges[d, n, 1, 0]:
            shift[n] = ranges[d, n, 1, 0]
        else:
            shift[n] = _pair(sources, sides, told, counts, n, t, first[n], t == 0)


@compiled
def _load_sides(sides, facing, counts, y, x):
    """Fill `sides` (9, K) with the entries of `facing` (K, H, W) of a target's nine sources, up to `counts` (9,)."""
    for n in range(9):
        for k in range(counts[n]):
            sides[n, k] = facing[k, y - n // 3 + 1, x - n % 3 + 1]


@compiled
def _pair(sources, sides, told, counts, n, t, first, behind_only):
    """The number s of source n at level t: s ≥ 0 if its layer `first` + s pairs with the target's layer t.

    For s < 0 its layer `first` pairs with the target's layer t − s. s is 0 if the target has no layer t.

    Args:
        sources: (9, K, 8), see `WEIGHT`; source 4 is the target itself.
        sides: (9, K), `Cells.facing` of these layers.
        told: True if `sides` are known; then opposite sides of a piece of surface do not pair.
        counts: (9,), the number of layers of each source.
        n: the source.
        t: the level.
        first: the first layer that the source has not yet given.
        behind_only: True to have no s above 0.
    """
    layers = sources.shape[1]
    if t >= counts[4]:
        return 0
    own, z = sources[4, t, DEPTH], sources[n, first, DEPTH]
    a, best_a = 0, abs(z - own)
    for k in range(first + 1, layers):
        distance, behind = abs(sources[n, k, DEPTH] - own), own > sources[n, k, DEPTH]
        if distance < best_a and not (told and opposite_sides(sides[n, k], sides[4, t], behind)):
            a, best_a = k - first, distance
    b, best_b = 0, abs(own - z)
    for k in range(t + 1, layers):
        distance, behind = abs(sources[4, k, DEPTH] - z), z > sources[4, k, DEPTH]
        if distance < best_b and not (told and opposite_sides(sides[4, k], sides[n, first], behind)):
            b, best_b = k - t, distance
    return -b if behind_only or best_b < best_a else a


@compiled
def _plan(stacks, d, t, sources, counts, first, joins, shift):
    """Fill the plan of level t of target d: `plans` and `ends` of all nine sources.

    Sources that take no part, or have no layer left, give nothing. `shift` (9,) are the numbers of `_shift`; for the
    rest see `_share`.
    """
    plans, ends, layers = stacks.plans, stacks.ends, sources.shape[1]
    least = layers
    for n in range(9):
        if joins[n] <= t and first[n] < counts[n] and shift[n] < 0:
            least = min(least, -shift[n])
    revealed = sources[4, t + least if least < layers else t, DEPTH]
    for n in range(9):
        plans[d, t, n, 0] = plans[d, t, n, 1] = plans[d, t, n, 2] = -1
        ends[d, t, n] = 0
        if joins[n] > t or first[n] >= counts[n]:
            continue
        at = first[n] + shift[n]
        if shift[n] > 0:
            plans[d, t, n, 0], ends[d, t, n] = first[n], min(at, counts[n])
        if shift[n] >= 0 and at < counts[n]:
            plans[d, t, n, 1] = at
        if least == layers:
            continue
        if shift[n] < 0:
            plans[d, t, n, 2] = first[n]
            continue
        best = np.inf
        for k in range(at + 1, counts[n]):
            distance = abs(sources[n, k, DEPTH] - revealed)
            if distance < best:
                plans[d, t, n, 2], best = k, distance


@compiled
def _advance(t, layers, counts, first, joins, shift):
    """Update, behind level t, the `first` layer (9,) that each source has left, and the level (9,) at which it `joins`.

    A source with no layer left, or with no partner at level t, `joins` at `layers`, that is, never again.
    """
    for n in range(9):
        if joins[n] > t:
            continue
        if first[n] >= counts[n]:
            joins[n] = layers
        elif shift[n] >= 0:
            at = first[n] + shift[n]
            first[n], joins[n] = at + 1, t + 1 if at < counts[n] else layers
        else:
            joins[n] = t - shift[n]


@compiled
def _last(plans, ends, d, t, n, b, whole):
    """The end of the chain of layers that source n gives to buffer b at level t: one more than its last layer.

    It may exceed the number of layers; layers that are not covered count for nothing. `whole` is True at level K − 1.
    """
    if b == 0:
        return ends[d, t, n]
    return plans[d, t, n, 1] + 1 if b == 1 and not whole else 32767


@compiled
def _sum(stacks, d, t, sources, counts, whole):
    """Fill `stacks.sums` (3, 5) of level t of target d, from its plan and from `sources` (9, K, 8) with `counts` (9,).

    If `whole`, at level K − 1, chains at the level itself go on with all layers behind it.
    """
    plans, ends, total = stacks.plans, stacks.ends, stacks.sums
    zero, one = total.dtype.type(0), total.dtype.type(1)
    for b in range(3):
        red, green, blue, alpha, weight = zero, zero, zero, zero, zero
        for n in range(9):
            first, through = plans[d, t, n, b], one
            last = min(_last(plans, ends, d, t, n, b, whole), counts[n]) if first >= 0 else 0
            for k in range(max(first, 0), last):
                w = through * sources[n, k, WEIGHT]
                weight += w if k == first else zero
                red, green, blue = red + w * sources[n, k, 0], green + w * sources[n, k, 1], blue + w * sources[n, k, 2]
                alpha += w * sources[n, k, 3]
                through *= one - sources[n, k, 3]
        over = one / max(weight, stacks.least[d, t])
        total[d, t, b, 0], total[d, t, b, 1], total[d, t, b, 2] = over * red, over * green, over * blue
        total[d, t, b, 3], total[d, t, b, 4] = over * alpha, weight


@compiled
def _composite(stacks, d, levels):
    """Fill `stacks.images` of target d, the images from each of its `levels` levels on, the last first."""
    sums, images = stacks.sums, stacks.images
    one = sums.dtype.type(1)
    for c in range(4):
        images[d, levels, c] = 0
    for t in range(levels - 1, -1, -1):
        coverage = min(sums[d, t, 1, 4] / stacks.least[d, t], one)
        for c in range(4):
            images[d, t, c] = sums[d, t, 0, c] + (one - sums[d, t, 0, 3]) * _under(sums, images, coverage, d, t, c)


@compiled
def _under(sums, images, coverage, d, t, c):
    """Channel c of the image of level t of target d, without the buffer in front.

    `coverage` is the weight at the level over `Stacks.least`, at most 1.
    """
    one = sums.dtype.type(1)
    through = (coverage - sums[d, t, 1, 3]) * images[d, t + 1, c]
    return sums[d, t, 1, c] + through + (one - coverage) * sums[d, t, 2, c]


# ---------------------------------------------------------------------------------------------- value, derivatives


@loop
def recolor(start, stop, own, listed, offsets, columns, stacks, changes):
    """Fill `outlines.Outlines.changes` (L, 2, 4) of listed targets: how colours change with coverage.

    `own` (H + 1,) tells where the listed targets of each row begin, `listed` (L,) their columns; `offsets` and
    `columns` tell so of targets with plans. Listed targets without a plan get zeros.
    """
    sums, images, one = stacks.sums, stacks.images, changes.dtype.type(1)
    for y in range(start, stop):
        d = offsets[y]
        for j in range(own[y], own[y + 1]):
            while d < offsets[y + 1] and columns[d] < listed[j]:
                d += 1
            changes[j] = 0
            if d == offsets[y + 1] or columns[d] != listed[j] or stacks.levels[d] == 0:
                continue
            front, surface = sums[d, 0, 0, 4], sums[d, 0, 1, 4]
            coverage, shown = min(surface, one), one - sums[d, 0, 0, 3]
            for c in range(4):
                if 0 < front < 1:
                    under = _under(sums, images, coverage, d, 0, c)
                    changes[j, 0, c] = (sums[d, 0, 0, c] - sums[d, 0, 0, 3] * under) / front
                if 0 < surface < 1:
                    more = sums[d, 0, 1, c] + (surface - sums[d, 0, 1, 3]) * images[d, 1, c]
                    changes[j, 1, c] = shown * (more / surface - sums[d, 0, 2, c])


@loop
def forward(start, stop, offsets, columns, images, border, image):
    """Fill targets with plans in rows [start, stop) of the image (H, W, 4), which lacks the border of the cells.

    `offsets` and `columns` list these targets by row of cells; `images` are those of `Stacks`.
    """
    for y in range(start + border, stop + border):
        for d in range(offsets[y], offsets[y + 1]):
            x = columns[d] - border
            if 0 <= x < image.shape[1]:
                for c in range(4):
                    image[y - border, x, c] = images[d, 0, c]


@loop
def adjoint(start, stop, offsets, columns, stacks, border, g, adjoints):
    """Fill `adjoints` (M, K, 3, 5), gradients of the sums before normalisation, from the image's `g` (H, W, 4).

    They are zero for targets in the border, and not filled behind a target's last level.
    """
    levels, sums, images, least = stacks.levels, stacks.sums, stacks.images, stacks.least
    zero, own, below = g.dtype.type(0), np.empty(4, g.dtype), np.empty(4, g.dtype)
    for y in range(start, stop):
        for d in range(offsets[y], offsets[y + 1]):
            x = columns[d]
            inside = 0 <= y - border < g.shape[0] and 0 <= x - border < g.shape[1]
            for c in range(4):
                own[c] = g[y - border, x - border, c] if inside else zero
            for t in range(levels[d]):
                _adjoint_level(adjoints[d, t], d, t, sums, images, least, own, below)
                own[:] = below


@compiled
def _adjoint_level(a, d, t, sums, images, least, own, below):
    """Fill the gradients `a` (3, 5) of a level's sums from `own` (4,), the gradient of its image.

    Also fills `below` (4,), the gradient of the next level's image.
    """
    zero, one = own.dtype.type(0), own.dtype.type(1)
    coverage, alpha = min(sums[d, t, 1, 4] / least[d, t], one), sums[d, t, 1, 3]
    shown, front, surface, covered = one - sums[d, t, 0, 3], zero, zero, zero
    for c in range(4):
        h = own[c]
        front += h * _under(sums, images, coverage, d, t, c)
        h *= shown
        surface += h * images[d, t + 1, c]
        covered += h * (images[d, t + 1, c] - sums[d, t, 2, c])
        a[0, c], a[1, c], a[2, c] = own[c], h, (one - coverage) * h
        below[c] = (coverage - alpha) * h
    a[0, 3] -= front
    a[1, 3] -= surface
    for b in range(3):
        full = sums[d, t, b, 4] >= least[d, t]
        over, dot = one / max(sums[d, t, b, 4], least[d, t]), zero
        for c in range(4):
            dot += a[b, c] * sums[d, t, b, c]
            a[b, c] *= over
        a[b, 4] = -dot * over if full else covered * over if b == 1 else zero


@loop
def pull(start, stop, grid, offsets, columns, stacks, adjoints, g_positions, g_rgba):
    """Add to the gradients of the samples of source rows [start, stop), from `adjoints` of targets with plans.

    `g_positions` (N, 3) gets x and y, `g_rgba` (N, 4) colours; one of no rows is not wanted.
    """
    layers, height, _ = grid.row.shape
    kind = grid.positions.dtype
    source, products = np.empty((1, layers, SOURCE), kind), np.empty((layers, 2), kind)
    gradients = np.empty((layers, 5), kind)
    slope = kind.type(2) * grid.scale * grid.gamma
    levels, plans, ends = stacks.levels, stacks.plans, stacks.ends
    for y in range(start, stop):
        for v in range(-1 if y > 0 else 0, 2 if y < height - 1 else 1):
            for d in range(offsets[y + v], offsets[y + v + 1]):
                for u in range(-1, 2):
                    n, count = 3 * (v + 1) + u + 1, _load(source, 0, grid, y + v, columns[d], u, v, kind.type(0))
                    gradients[:] = 0
                    _pull_source(gradients, products, source, count, levels[d], plans, ends, adjoints, d, n)
                    _scatter(g_positions, g_rgba, gradients, source, count, grid.row, y, columns[d] - u, slope)


@compiled
def _pull_source(gradients, products, source, count, levels, plans, ends, adjoints, d, n):
    """Add to `gradients` (K, 5), of colours (4) and weight of each layer of a source (1, K, 8), the n-th of target d.

    `count` is the number of its layers, `levels` that of levels of the target; `products` (K, 2) is working memory.
    """
    for t in range(levels if count > 0 else 0):
        for b in range(3):
            first, last = max(plans[d, t, n, b], 0), 0
            if plans[d, t, n, b] >= 0:
                last = min(_last(plans, ends, d, t, n, b, t == len(gradients) - 1), count)
            _pull_chain(gradients, products, source, first, last, adjoints, d, t, b)


@compiled
def _pull_chain(gradients, products, source, first, last, adjoints, d, t, b):
    """Add to `gradients` (K, 5) those of layers first ≤ k < last of a source (1, K, 8), given to buffer b at level t.

    `products` (K, 2) is working memory: the gradient's products with the colours of each layer, and of those behind.
    """
    red, green, blue, alpha = adjoints[d, t, b, 0], adjoints[d, t, b, 1], adjoints[d, t, b, 2], adjoints[d, t, b, 3]
    behind, through = gradients.dtype.type(0), gradients.dtype.type(1)
    for k in range(last - 1, first - 1, -1):
        own = red * source[0, k, 0] + green * source[0, k, 1] + blue * source[0, k, 2] + alpha * source[0, k, 3]
        products[k, 0], products[k, 1] = own, behind
        behind = source[0, k, WEIGHT] * own + (gradients.dtype.type(1) - source[0, k, 3]) * behind
    for k in range(first, last):
        w = through * source[0, k, WEIGHT]
        gradients[k, 0] += w * red
        gradients[k, 1] += w * green
        gradients[k, 2] += w * blue
        gradients[k, 3] += w * alpha - through * products[k, 1]
        gradients[k, 4] += through * products[k, 0] + (adjoints[d, t, b, 4] if k == first else 0)
        through *= gradients.dtype.type(1) - source[0, k, 3]


@compiled
def _scatter(g_positions, g_rgba, gradients, source, count, row, y, x, slope):
    """Add the gradients (K, 5) of the layers of a source, cell (y, x), to those of their samples.

    `g_positions` (N, 3) gets x and y, `g_rgba` (N, 4) colours; one of no rows gets nothing.
    """
    for k in range(count):
        i = row[k, y, x]
        if i >= 0:
            for c in range(4 if len(g_rgba) > 0 else 0):
                g_rgba[i, c] += gradients[k, c]
            if len(g_positions) > 0:
                h = slope * source[0, k, WEIGHT] * gradients[k, 4]
                g_positions[i, 0] += h * source[0, k, ALONG_X]
                g_positions[i, 1] += h * source[0, k, ALONG_Y]


@loop
def push(start, stop, grid, offsets, columns, stacks, tangents, border, out):
    """Fill targets with plans in rows [start, stop) of `out` (T, H, W, 4).

    `tangents` are those of positions (T, N, 3) and rgba (T, N, 4); no samples stand for zeros.
    """
    layers, kind = len(grid.row), out.dtype
    sources, counts = np.empty((9, layers, SOURCE), kind), np.empty(9, np.int64)
    moves = np.empty((9, layers, 5), kind)
    change, grown = np.empty((3, 5), kind), np.empty(4, kind)
    for y in range(start + border, stop + border):
        for d in range(offsets[y], offsets[y + 1]):
            x = columns[d]
            if not 0 <= x - border < out.shape[2]:
                continue
            for n in range(9):
                counts[n] = _load(sources, n, grid, y, x, n % 3 - 1, n // 3 - 1, kind.type(0))
            for direction in range(len(out)):
                _load_tangents(moves, sources, counts, grid, y, x, tangents[0][direction], tangents[1][direction])
                grown[:] = 0
                for t in range(stacks.levels[d] - 1, -1, -1):
                    _change(change, d, t, sources, counts, moves, stacks, t == layers - 1)
                    _over(grown, change, stacks.sums, stacks.images, stacks.least, d, t)
                for c in range(4):
                    out[direction, y - border, x - border, c] = grown[c]


@compiled
def _load_tangents(moves, sources, counts, grid, y, x, t_positions, t_rgba):
    """Fill `moves` (9, K, 5), the tangents of the colours and weights of a target's sources.

    Tangents of positions (N, 3) and rgba (N, 4) may have no samples: then they are zeros.
    """
    slope = moves.dtype.type(2) * grid.scale * grid.gamma
    moves[:] = 0
    for n in range(9):
        for k in range(counts[n]):
            i = grid.row[k, y - n // 3 + 1, x - n % 3 + 1]
            if i < 0:
                continue
            if len(t_positions) > 0:
                along = sources[n, k, ALONG_X] * t_positions[i, 0] + sources[n, k, ALONG_Y] * t_positions[i, 1]
                moves[n, k, 4] = slope * sources[n, k, WEIGHT] * along
            for c in range(4 if len(t_rgba) > 0 else 0):
                moves[n, k, c] = t_rgba[i, c]


@compiled
def _change(change, d, t, sources, counts, moves, stacks, whole):
    """Fill `change` (3, 5), tangents of the sums of level t: of normalised colours, and of the weight."""
    sums, zero, one = stacks.sums, change.dtype.type(0), change.dtype.type(1)
    change[:] = zero
    for n in range(9):
        for b in range(3):
            first = stacks.plans[d, t, n, b]
            if first < 0:
                continue
            through, d_through = one, zero
            change[b, 4] += moves[n, first, 4]
            for k in range(first, min(_last(stacks.plans, stacks.ends, d, t, n, b, whole), counts[n])):
                weight = sources[n, k, WEIGHT]
                w, dw = through * weight, d_through * weight + through * moves[n, k, 4]
                for c in range(4):
                    change[b, c] += dw * sources[n, k, c] + w * moves[n, k, c]
                d_through = d_through * (one - sources[n, k, 3]) - through * moves[n, k, 3]
                through *= one - sources[n, k, 3]
    for b in range(3):
        over = one / max(sums[d, t, b, 4], stacks.least[d, t])
        more = change[b, 4] if sums[d, t, b, 4] >= stacks.least[d, t] else zero
        for c in range(4):
            change[b, c] = (change[b, c] - more * sums[d, t, b, c]) * over


@compiled
def _over(grown, change, sums, images, least, d, t):
    """Turn `grown` (4,), the tangent of the next level's image, into that of the image of level t, in place."""
    zero, one = grown.dtype.type(0), grown.dtype.type(1)
    part = sums[d, t, 1, 4] / least[d, t]
    coverage, more = min(part, one), change[1, 4] / least[d, t] if part < one else zero
    alpha, hidden, shown = sums[d, t, 1, 3], change[0, 3], one - sums[d, t, 0, 3]
    behind = change[1, 3]
    for c in range(4):
        under = change[1, c] + (more - behind) * images[d, t + 1, c] + (coverage - alpha) * grown[c]
        under += (one - coverage) * change[2, c] - more * sums[d, t, 2, c]
        grown[c] = change[0, c] - hidden * _under(sums, images, coverage, d, t, c) + shown * under
