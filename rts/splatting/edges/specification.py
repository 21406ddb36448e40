"""The rule of found edges in array code: pixels are area averages beside straight edges, which move with samples.

    image of a pixel  =  C − ∇C · m  +  Σ over rays of  (mean share of the rays that it meets − its own share) · J
                                     +  Σ over rays of  ∫ v · n J ds

    C       the colour of the centre's sample; ∇C its slope across the image, from the next centres on the same surface
    m       the motion of this sample in the image: 0 in value, it has the derivative
    ray     an outline from a break on the side of a square to the point inside where it meets others
    share   of the pixel's quarter in the square, what the ray leaves on one side of it; between two rays lies the
            difference of both. Jumps around a point add up to 0, and the mean takes off what they miss it by
    J       the colour on one side of a break less that on the other, from the last samples beside it; in the shares, on
            the side of the cell's own surface, the colour C
    v       the motion of a break, linear to that of the point: that of the last sample of the surface that ends there,
            or the mean of a pair of samples beside the deepest point of its ray
    n ds    along the part of the ray inside the pixel

Beside breaks the colour inside also changes as far as the outline, see `_beside_breaks`. Shares have no derivative,
and the flux ∫ v · n J ds has no value: it is the derivative of the shares. ∇C, n and, in the flux, J are constants.

Where light passes through, C and the colours on both sides of a break are composites of all layers there: see
`rts.splatting.edges.stacks`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from rts.arrays.array_functions import without_border
from rts.arrays.engines import engine_of, namespace, stopped
from rts.arrays.trees import Array
from rts.contracts.records import REACH, Outlines
from rts.splatting.cells import centres, unpack
from rts.splatting.edges.gap_places import normals
from rts.splatting.edges.weights import BORDER

STEPS = tuple(step for step in range(-REACH, REACH + 1) if step)
"""From a segment's row to those of segments that may end at it, or cross it."""

CORNERS = ((0, 0), (1, 0), (1, 1), (0, 1))
"""Steps (x, y) from a square's first corner to all of them, clockwise from the upper left."""


def specification(positions: Array, rgba: Array, row: Array, *arrays: Array, border: int) -> Array:
    """The image (h, w, C) of samples with `row` (H, W), and of outlines, whose fields `arrays` are.

    A `border` of so many cells is left out at each side.
    """
    xp, (height, width), outlines = namespace(rgba), row.shape, Outlines(*arrays)
    color, motion = _on_cells(positions, rgba, row)
    image = color - _inside(color, motion, outlines.joined)
    if outlines.place.shape[0] == 0:
        return without_border(image, border)
    breaks = _Breaks.of(outlines, positions, rgba)
    parts = [*_beside_breaks(breaks, outlines, color, motion), *_Rays.of(outlines, breaks).parts(color)]
    cells = xp.concat([y * width + x for x, y, _ in parts])
    changes = xp.concat([change for *_, change in parts])
    sums = engine_of(changes).segment_sum(changes, cells, height * width)
    # Inductor of torch 2.13, with free sizes, reads sums in another shape before it has made them.
    found = xp.reshape(image, sums.shape) + sums
    # Where many outlines meet, lines for them may cross inside a cell, and take a little of it twice.
    alpha = stopped(found[:, -1:])
    settled = xp.where(sums[:, -1:] != 0, xp.clip(alpha, 0.0, 1.0) - alpha, 0.0)
    found = xp.concat([found[:, :-1], found[:, -1:] + stopped(settled)], axis=-1)
    return without_border(xp.reshape(found, image.shape), border)


def _on_cells(positions: Array, rgba: Array, row: Array) -> tuple[Array, Array]:
    """Colours (H, W, C) of cells, and motions (H, W, 2) of their samples; 0 in empty ones."""
    xp, (height, width) = namespace(rgba), row.shape
    covered, at = (row >= 0)[..., None], centres(height, width, positions)
    color = xp.where(covered, unpack(rgba, row), 0.0)
    return color, xp.where(covered, unpack(positions, row)[..., :2] - at, 0.0)


def _inside(color: Array, motion: Array, joined: Array) -> Array:
    """∇C · m (H, W, C): slopes are means of the differences from and to the next cells of the same surface."""
    xp, still, total = namespace(color), stopped(color), 0.0
    for axis in (0, 1):
        here = joined[axis][..., None]
        rise = xp.where(here, xp.roll(still, -1, axis=1 - axis) - still, 0.0)
        total = total + (rise + xp.roll(rise, 1, axis=1 - axis)) / 2 * motion[..., axis, None]
    return total


def all_joined(covered: Array) -> Array:
    """`Outlines.joined` as if all covered cells showed one surface."""
    xp = namespace(covered)
    right, below = (xp.roll(covered, -1, axis=axis) & covered for axis in (1, 0))
    inside = np.ones((2, *covered.shape), bool)
    inside[0, :, -1], inside[1, -1] = False, False  # Nothing follows the last cells.
    return xp.stack([right, below]) & engine_of(covered).constant(inside, covered)


class _Breaks(NamedTuple):
    """The samples beside breaks, and the motion of breaks.

    Attributes:
        place: (B, 2) x and y.
        step: (B, 2) unit steps along the gaps.
        color: (2, B, C), before and behind each break; 0 where nothing is seen.
        seen: (2, B) bool.
        motion: (2, B, 2) of these samples, in the image.
        moves: (B, 2), the motion of the break.
    """

    place: Array
    step: Array
    color: Array
    seen: Array
    motion: Array
    moves: Array

    @classmethod
    def of(cls, outlines: Outlines, positions: Array, rgba: Array) -> _Breaks:
        """The samples of outlines."""
        xp, rows = namespace(positions), outlines.rows
        seen = xp.stack([rows[:, 0] >= 0, rows[:, 1] >= 0])
        at = [xp.where(rows[:, i] >= 0, rows[:, i], 0) for i in (0, 1)]
        shown = xp.where(outlines.inner >= 0, outlines.inner, rows)
        shown = xp.where(shown >= 0, shown, 0)
        color = xp.stack([xp.where(seen[i][:, None], xp.take(rgba, shown[:, i], axis=0), 0.0) for i in (0, 1)])
        found = [xp.take(positions, at[i], axis=0) for i in (0, 1)]
        row = xp.astype(outlines.gap[:, 2], positions.dtype)
        first = xp.astype(xp.stack([outlines.gap[:, 1], outlines.gap[:, 0]], axis=-1), positions.dtype) + 0.5
        step = xp.stack([row, 1 - row], axis=-1)
        points = [first + outlines.points[:, i, None] * step for i in (0, 1)]
        motion = [xp.where(seen[i][:, None], found[i][:, :2] - points[i], 0.0) for i in (0, 1)]
        # Where surfaces pass through one another, the line moves to where their depths are equal.
        slope = outlines.slope
        depth = [xp.where(seen[i], found[i][:, 2] - stopped(found[i][:, 2]), 0.0) for i in (0, 1)]
        still = [depth[i] - xp.sum(slope[:, i] * motion[i], axis=-1) for i in (0, 1)]
        apart = slope[:, 0] - slope[:, 1]
        square = xp.sum(apart * apart, axis=-1)
        crossing = outlines.near == 2
        along = -(still[0] - still[1]) / xp.where(crossing & (square > 0), square, 1.0)
        moves = xp.where((outlines.near == 0)[:, None], motion[0], motion[1])
        moves = xp.where(crossing[:, None], along[:, None] * apart, moves)
        # A pair lies on the ray of the sample that ends, and its mean moves as the outline.
        pairs = [
            xp.take(positions, xp.where(outlines.pair >= 0, outlines.pair, 0)[:, i], axis=0)[:, :2] for i in (0, 1)
        ]
        origin = xp.where((outlines.near == 0)[:, None], points[0], points[1])
        moves = xp.where(outlines.pair[:, :1] >= 0, (pairs[0] + pairs[1]) / 2 - origin, moves)
        return cls(first + outlines.place[:, None] * step, step, color, seen, xp.stack(motion), moves)


class _Rays(NamedTuple):
    """Outlines from breaks on the sides of squares to points inside, where they meet: R = 2 S, of all starts and ends.

    A ray leads to the corner of its segment, or of the one that this ends at or crosses, its leader.

    Attributes:
        square: (R, 2) int, x and y of the first corner's cell.
        counts: (R,) bool, is there such a ray?
        group: (G, S) int, the rays that meet at the corner of each segment, and (G, S) bool, are there these?
        leader: (R,) int, the segment at whose corner the ray ends.
        side: (R,) int, the side of the square.
        place: (R,) the place of the break on the sides, clockwise from the upper left corner: 0 to 4.
        points: (3, R, 2), the break, a point between and the end, from the first corner's centre.
        moves: the motions (R, 2) of both ends of both pieces.
        jumps: the colours (R, C) on the right of the way less those on the left, at the break and at the end.
        before: (R, C), the colours before the breaks, clockwise.
        after: (R, C), those after.
        next: (4, R) int, the side of the breaks, 0 or 1, that a corner of the square is next to, or −1.
        seen: (R, 2) bool, is there a sample on these sides?
    """

    square: Array
    counts: Array
    group: tuple[Array, Array]
    leader: Array
    side: Array
    place: Array
    points: Array
    moves: Sequence[Sequence[Array]]
    jumps: tuple[Array, Array]
    before: Array
    after: Array
    next: Array
    seen: Array

    @classmethod
    def of(cls, outlines: Outlines, breaks: _Breaks) -> _Rays:
        """The rays of segments between breaks."""
        xp, lone, sides = namespace(breaks.place), outlines.ties[:, 1] < 0, outlines.square_sides
        ties = xp.concat([outlines.ties[:, 0], xp.where(lone, outlines.ties[:, 0], outlines.ties[:, 1])])
        side = xp.concat([sides[:, 0], xp.where(lone, sides[:, 0], sides[:, 1])])
        square = xp.stack([outlines.square[:, 1], outlines.square[:, 0]], axis=-1)
        twice = xp.concat([square, square])
        gap, along = (xp.take(x, ties, axis=0) for x in (outlines.gap, breaks.step))
        first = xp.stack([gap[:, 1] - twice[:, 0], gap[:, 0] - twice[:, 1]], axis=-1)
        start = xp.take(outlines.place, ties)[:, None] * along + xp.astype(first, along.dtype)
        start = xp.clip(start, 0.0, 1.0)
        x, y = start[:, 0], start[:, 1]
        place = xp.where(side == 0, x, xp.where(side == 1, 1 + y, xp.where(side == 2, 3 - x, 4 - y)))
        before, behind = (xp.take(color, ties, axis=0) for color in (breaks.color[0], breaks.color[1]))
        forward = (side < 2)[:, None]  # Clockwise, sides 0 and 1 lead along their gaps.
        before, after = xp.where(forward, before, behind), xp.where(forward, behind, before)
        firsts, lasts = (xp.take(outlines.ends[:, i], ties) for i in (0, 1))
        seen = xp.stack([xp.take(breaks.seen[k], ties) for k in (0, 1)], axis=-1)
        same = (outlines.ties[:, 0] == outlines.ties[:, 1]) & ~lone
        group, alone, leader = _grouped(outlines, ~same, ~same & ~lone)
        points, moves = _ways(outlines, breaks, ties, start, leader)
        # The two jumps of a segment at which no other ends go over into one another.
        jump, (count, half) = before - after, (lone.shape[0], (alone & ~lone)[:, None])
        mean = (jump[:count, ...] - jump[count:, ...]) / 2
        ends = [xp.where(half, x, y) for x, y in ((mean, jump[:count, ...]), (-mean, jump[count:, ...]))]
        return cls(
            twice,
            xp.concat([~same, ~same & ~lone]),
            group,
            xp.concat([leader, leader]),
            side,
            place,
            points,
            moves,
            (jump, xp.concat(ends)),
            before,
            after,
            xp.stack([_next(k, side, firsts, lasts) for k in range(4)]),
            seen,
        )

    def parts(self, color: Array) -> list[tuple[Array, Array, Array]]:
        """Changes that outlines make: cells (x and y) and changes, for each corner of the squares.

        Clockwise around a square, the colour rises by a jump at each break; what is on the way from there to the ray's
        end counts against it. Between the breaks before and after the corner lies the surface that is seen at the
        cell's centre: what is lost of it has the colour there, of `color` (H, W, C).
        """
        xp, parts, (near, there) = namespace(self.points), [], self.group
        flat, count = xp.reshape(color, (-1, color.shape[2])), near.shape[1]

        def of_group(x: Array) -> Array:
            return xp.reshape(xp.take(x, xp.reshape(near, (-1,))), near.shape)

        number = xp.sum(xp.astype(there, self.place.dtype), axis=0)
        columns = xp.astype(engine_of(near).arange(count, self.place), near.dtype)
        for k, (dx, dy) in enumerate(CORNERS):
            x, y = self.square[:, 0] + dx, self.square[:, 1] + dy
            weight, flux = self._onto(k)
            # Jumps around a point add up to 0; those of colours that change along outlines hardly miss it.
            mean = xp.sum(xp.where(there, of_group(weight), 0.0), axis=0) / xp.where(number > 0, number, 1.0)
            share = weight - xp.take(mean, self.leader)
            parts.append((x, y, xp.where(self.counts[:, None], flux - share[:, None] * self.jumps[0], 0.0)))
            # Sides break ties of places in corners, which two of them share.
            keys = xp.where(self.side < k, 8.0, 0.0) + self.place + 1e-5 * xp.astype(self.side, self.place.dtype)
            keys, known, fails, around = of_group(keys), False, False, []
            for clockwise, beyond in ((True, xp.where(there, keys, -1.0)), (False, -xp.where(there, keys, 99.0))):
                best = xp.astype(xp.argmax(beyond, axis=0), near.dtype) * count + columns
                ray = xp.take(xp.reshape(near, (-1,)), best)
                expected = xp.where((xp.take(self.side, ray) < 2) == clockwise, 1, 0)
                found, sees = xp.take(self.next[k, :], ray), xp.take(self.seen, ray, axis=0)
                known = known | (found == expected)
                fails = fails | (found == 1 - expected) | ~xp.where(expected == 0, sees[:, 0], sees[:, 1])
                around.append(ray)
            first, last = around
            beside = (xp.take(self.after, first, axis=0) + xp.take(self.before, last, axis=0)) / 2
            x, y = x[:count], y[:count]
            lost = xp.clip(xp.take(weight, last) - xp.take(weight, first), 0.0, None)
            lost = xp.where((number > 0) & known & ~fails, lost, 0.0)[:, None]
            parts.append((x, y, lost * (beside - xp.take(flat, y * color.shape[1] + x, axis=0))))
        return parts

    def _onto(self, k: int) -> tuple[Array, Array]:
        """By how much the colour of the quarter at corner k rises with the jump, clockwise (R,); the flux (R, C)."""
        xp, (dx, dy), place = namespace(self.points), CORNERS[k], self.place
        low, (first, last) = 2.0 if dx else 2.5, (stopped(jump) for jump in self.jumps)
        weight = 0.5 * xp.clip(low + 0.5 - xp.clip(place, low, None), 0.0, None)
        weight, flux = weight - 0.25 * xp.astype(self.side < k, place.dtype), xp.zeros_like(first)
        for at, way, moves, (i, t) in _cut(self.points, self.moves):
            column = at[:, 0] >= 0.5 if dx else at[:, 0] < 0.5
            height = xp.clip(at[:, 1] - 0.5 * dy, 0.0, 0.5)
            weight = weight + xp.where(column, height * way[:, 0], 0.0)
            right, below = (xp.clip((at[:, a] - 0.5) / BORDER + 0.5, 0.0, 1.0) for a in (0, 1))
            share = (right if dx else 1 - right) * (below if dy else 1 - below)
            rate = moves[:, 0] * way[:, 1] - moves[:, 1] * way[:, 0]
            t = t if i == 0 else xp.ones_like(t)
            flux = flux + (share * rate)[:, None] * ((1 - t) * first + t * last)
        return weight, flux


def _grouped(outlines: Outlines, start: Array, end: Array) -> tuple[tuple[Array, Array], Array, Array]:
    """`_Rays.group`, is each segment alone in it (S,), and the segment (S,) at whose corner each one's rays end.

    `start` and `end` (S,) tell which rays there are.
    """
    xp, steps, count = namespace(start), outlines.hub, outlines.hub.shape[0]
    number = xp.astype(engine_of(steps).arange(count, outlines.corner), steps.dtype)
    leads = steps == 0
    near, there, alone = [number, count + number], [start & leads, end & leads], leads
    # Beside each segment in the list there are those which end at it or cross it.
    for step in STEPS:
        row = xp.clip(number + step, 0, count - 1)
        here = (row == number + step) & (xp.take(steps, row) == -step)
        near, there = [*near, row, count + row], [*there, here, here & xp.take(end, row)]
        alone = alone & ~here
    return (xp.stack(near), xp.stack(there)), alone, number + steps


def _ways(
    outlines: Outlines, breaks: _Breaks, ties: Array, start: Array, leader: Array
) -> tuple[Array, Sequence[Sequence[Array]]]:
    """`_Rays.points` and `_Rays.moves`, given the breaks and points (R, ...) where rays start, and their `leader` (S,).

    A ray runs along the segment that its own one ends at, from where it meets that, and moves there as that does.
    """
    xp, count, alone = namespace(start), leader.shape[0], (outlines.hub == 0)[:, None]
    corner, own = outlines.corner, [xp.take(breaks.moves, x, axis=0) for x in (ties[:count], ties[count:])]
    beyond = [
        xp.take(breaks.moves, xp.where(at >= 0, at, 0), axis=0) for at in (outlines.beyond[:, 0], outlines.beyond[:, 1])
    ]
    at_corner = sum(outlines.pull[:, i, None] * x for i, x in enumerate((beyond[0], own[0], own[1], beyond[1])))
    path = [start[:count, ...], corner, start[count:, ...]]
    others = [xp.take(x, leader, axis=0) for x in path]
    (first, near), (second, far) = (_along(others[i], others[1], corner) for i in (0, 2))
    t, along = xp.where(near <= far, first, second)[:, None], xp.where((near <= far)[:, None], *beyond)
    share = _along(path[0], path[2], corner)[0][:, None]
    there = xp.where(alone, at_corner, (1 - share) * own[0] + share * own[1])
    along = xp.where(alone, at_corner, (1 - t) * along + t * at_corner)
    points = xp.stack([start, *(xp.concat([x, x]) for x in (corner, others[1]))])
    there, along, last = (xp.concat([x, x]) for x in (there, along, at_corner))
    return points, ((xp.concat(own), there), (along, last))


def _cut(
    points: Array, motions: Sequence[Sequence[Array] | Array]
) -> list[tuple[Array, Array, Array, tuple[int, Array]]]:
    """Straight pieces of paths (3, S, 2), cut where pixels meet: middles, ways, motions (S, 2); places on the path.

    `motions` are those of both ends of both pieces.
    """
    xp, pieces = namespace(points), []
    for i in (0, 1):
        start, way = points[i], points[i + 1] - points[i]
        cuts = []
        for a in (0, 1):
            there = xp.abs(way[:, a]) > 1e-9
            cuts.append(xp.where(there, (0.5 - start[:, a]) / xp.where(there, way[:, a], 1.0), 0.0))
        cuts = [xp.clip(c, 0.0, 1.0) for c in (xp.minimum(*cuts), xp.maximum(*cuts))]
        bounds = [xp.zeros_like(cuts[0]), *cuts, xp.ones_like(cuts[0])]
        for low, high in zip(bounds[:-1], bounds[1:], strict=True):
            t = ((low + high) / 2)[:, None]
            moves = (1 - t) * motions[i][0] + t * motions[i][1]
            pieces.append((start + t * way, (high - low)[:, None] * way, moves, (i, t)))
    return pieces


def _along(start: Array, end: Array, point: Array) -> tuple[Array, Array]:
    """Where on straight pieces (S, 2) points lie, 0 to 1; and their squared distances from there."""
    xp, way = namespace(start), end - start
    square = xp.sum(way * way, axis=-1)
    t = xp.sum((point - start) * way, axis=-1) / xp.where(square > 0, square, 1.0)
    t = xp.clip(xp.where(square > 0, t, 0.0), 0.0, 1.0)
    off = start + t[:, None] * way - point
    return t, xp.sum(off * off, axis=-1)


def _next(k: int, side: Array, firsts: Array, lasts: Array) -> Array:
    """`_Rays.next` of the corner k, for breaks that are the first or last of their gaps."""
    begins, stops = ((side == a) | (side == b) for a, b in FIRST_AND_LAST[k])
    xp = namespace(side)
    return xp.where(begins & firsts, 0, xp.where(stops & lasts, 1, -1))


FIRST_AND_LAST = (((0, 3), (9, 9)), ((1, 9), (0, 9)), ((9, 9), (1, 2)), ((2, 9), (3, 9)))
"""For each corner of a square the sides on which it is the first centre of the gap, and the last; 9 for none."""


def _beside_breaks(
    breaks: _Breaks, outlines: Outlines, color: Array, motion: Array
) -> list[tuple[Array, Array, Array]]:
    """Changes in the two cells of each gap: on each surface the colour goes on as far as the break.

    From the centre to the break, at a distance d, the colour changes from C to that of the last sample, X. Of this
    change the share up to the border, at ½, belongs to the centre's cell, and the rest to the next one. It moves along
    the outline's normal n, with the mean motion of both samples. What is left of a cell that the outline cuts has a
    mean colour other than C: the slope from the centre before tells it. The strip in the next cell differs from X by
    half the slope times its width.
    """
    xp, (height, width) = namespace(color), color.shape[:2]
    y, x, row = (outlines.gap[:, i] for i in range(3))
    normal = normals(outlines.gap, outlines.place, outlines.ties)
    ahead = xp.sum(normal * breaks.step, axis=-1)
    flat_color, flat_motion = (xp.reshape(t, (-1, t.shape[-1])) for t in (color, motion))
    joined, parts = xp.reshape(outlines.joined, (2, -1)), []
    for i, way in enumerate((1, -1)):
        cells = [(x, y), (x + row, y + 1 - row)]
        (cx, cy), beyond = cells[i], cells[1 - i]
        index = cy * width + cx
        here, last = xp.take(flat_color, index, axis=0), breaks.color[i]
        counts = (outlines.ends[:, i] & breaks.seen[i])[:, None]
        centre = xp.stack([xp.astype(cx, color.dtype), xp.astype(cy, color.dtype)], axis=-1) + 0.5
        length = xp.clip(xp.sum((breaks.place - centre) * breaks.step, axis=-1) * way, 0.0, 1.0)
        inside, outside = xp.clip(length, None, 0.5), xp.clip(length - 0.5, 0.0, None)
        share = (inside / xp.where(length > 1e-6, length, 1.0))[:, None]
        moves = (breaks.motion[i] + xp.take(flat_motion, index, axis=0)[:, :2]) / 2
        moved = -stopped(last - here) * (way * ahead * xp.sum(moves * normal, axis=-1))[:, None]
        # The centre before tells the slope, where it shows the same surface, since d may be short.
        before = xp.clip(cx - way * row, 0, width - 1), xp.clip(cy - way * (1 - row), 0, height - 1)
        former = before[1] * width + before[0]
        first = former if way == 1 else index
        on = xp.where(row == 1, xp.take(joined[0], first), xp.take(joined[1], first))[:, None]
        beyond_here = xp.take(flat_color, former, axis=0)
        slope = xp.where(
            on, (last - beyond_here) / (1 + length)[:, None], (last - here) / xp.clip(length, 0.5, None)[:, None]
        )
        weight = (ahead**2)[:, None]
        nearer = weight * xp.where(on, beyond_here - here, 0.0) * (0.125 - inside**2 / 2)[:, None]
        farther = -weight * slope * (outside**2 / 2)[:, None]
        parts.append((cx, cy, xp.where(counts, share * moved + nearer, 0.0)))
        parts.append((*beyond, xp.where(counts, (1 - share) * moved + farther, 0.0)))
    return parts
