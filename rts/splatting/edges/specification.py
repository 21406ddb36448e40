"""The rule of found edges in array code: pixels are area averages beside straight edges, which move with samples.

    image of a pixel  =  C − ∇C · m  +  Σ over segments of  (share beside the segment − share of the centre) · J
                                     +  Σ over segments of  ∫ v · n J ds

    C       the colour of the centre's sample; ∇C its slope across the image, from the next centres on the same surface
    m       the motion of this sample in the image: 0 in value, it has the derivative
    J       the colour on one side of a segment less that on the other, from the last samples beside its two breaks;
            in the shares, on the side of the cell's own surface, the colour C
    v       the motion of a break, linear between the two: that of the last sample of the surface that ends there, or
            the mean of a pair of samples beside the deepest point of its ray
    n ds    along the part of the segment inside the pixel

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
    segments = _Segments.of(outlines, breaks)
    parts = [
        *_beside_breaks(breaks, segments, outlines, color, motion),
        *segments.parts(color),
        *segments.meetings(color),
    ]
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


class _Segments(NamedTuple):
    """Segments, each from a break to another; or from a lone break straight across its square, of which half counts.

    Segments may also end at another one, behind its surface, or cross it.

    Attributes:
        square: (S, 2) int, x and y of the first corner's cell.
        lone: (S,) bool.
        path: (3, S, 2), x and y of start, corner and end, from the first corner's centre.
        square_sides: (S, 2) int, the sides of the square that start and end lie on.
        ties: (S, 2) int, the breaks at start and end.
        jump: (2, S, C), at start and end, the colour on the right of the way less that on the left.
        right: (2, S, C), the colour on the right.
        before: (2, S) bool, at start and end, is what lies before the break on the right of the way?
        next: (4, 2, S) int, the side of the breaks, 0 or 1, that a corner of the square is next to, or −1.
        seen: (2, S, 2) bool, is there a sample on these sides?
        moves: (3, S, 2), the motion of start, corner and end.
        beyond: (2, S, 2), the motions of the breaks in `Outlines.beyond`.
        number: (S,) int, the segments' own rows.
        hub: (S,) int, the row of the segment that each ends at, or crosses, in its corner; or −1.
        meets: (S,) bool, do others end at the segment, or cross it?
    """

    square: Array
    lone: Array
    path: Array
    square_sides: Array
    ties: Array
    jump: Array
    right: Array
    before: Array
    next: Array
    seen: Array
    moves: Array
    beyond: Array
    number: Array
    hub: Array
    meets: Array

    @classmethod
    def of(cls, outlines: Outlines, breaks: _Breaks) -> _Segments:
        """The segments between breaks."""
        xp, side = namespace(breaks.place), outlines.square_sides
        lone, first = outlines.ties[:, 1] < 0, outlines.ties[:, 0]
        number = xp.astype(engine_of(side).arange(side.shape[0], outlines.corner), side.dtype)
        hub = xp.where(outlines.hub != 0, number + outlines.hub, -1)
        meets = xp.zeros_like(lone)
        for step in STEPS:
            meets = meets | (xp.roll(hub, -step, axis=0) == number)
        ties = xp.stack([first, xp.where(lone, first, outlines.ties[:, 1])], axis=-1)
        side = xp.stack([side[:, 0], xp.where(lone, (side[:, 0] + 2) % 4, side[:, 1])], axis=-1)
        square = xp.stack([outlines.square[:, 1], outlines.square[:, 0]], axis=-1)
        origin = xp.astype(square, breaks.place.dtype) + 0.5
        start, end = (xp.take(breaks.place, ties[:, i], axis=0) - origin for i in (0, 1))
        along = xp.take(breaks.step, ties[:, 0], axis=0)
        end = xp.where(lone[:, None], along * start + (1 - along) * (1 - start), end)  # On the opposite side.
        start, end = (xp.clip(x, 0.0, 1.0) for x in (start, end))
        corner = xp.where((lone & (hub < 0))[:, None], (start + end) / 2, outlines.corner)
        jump, right, turned, moves = [], [], [], []
        for i in (0, 1):
            before, behind = (xp.take(breaks.color[k], ties[:, i], axis=0) for k in (0, 1))
            # Clockwise, sides 0 and 1 lead along their gaps; what lies before a start is on the right of the way.
            forward = (side[:, i] < 2) if i == 0 else (side[:, i] >= 2)
            jump.append(xp.where(forward[:, None], before - behind, behind - before))
            right.append(xp.where(forward[:, None], before, behind))
            turned.append(forward)
            moves.append(xp.take(breaks.moves, ties[:, i], axis=0))
        jump[1], right[1] = (xp.where(lone[:, None], x[0], x[1]) for x in (jump, right))
        turned[1] = xp.where(lone, turned[0], turned[1])
        beside = xp.stack([_next(k, ties, side, lone, outlines.ends) for k in range(4)])
        seen = xp.stack([xp.stack([xp.take(breaks.seen[k], ties[:, i]) for k in (0, 1)], axis=-1) for i in (0, 1)])
        beyond = [
            xp.take(breaks.moves, xp.where(at >= 0, at, 0), axis=0)
            for at in (outlines.beyond[:, 0], outlines.beyond[:, 1])
        ]
        pulled = (beyond[0], *moves, beyond[1])
        moves.insert(1, sum(outlines.pull[:, i, None] * x for i, x in enumerate(pulled)))
        path = xp.stack([start, corner, end])
        sides = xp.stack(jump), xp.stack(right), xp.stack(turned), beside, seen
        return cls(square, lone, path, side, ties, *sides, xp.stack(moves), xp.stack(beyond), number, hub, meets)

    def parts(self, color: Array) -> list[tuple[Array, Array, Array]]:
        """Changes that segments make: cells (x and y) and changes (S, C), for each corner of the square.

        Beside a segment the cell gets the other side's colour, and loses its own: that of the segment's side, or that
        of the cell's centre, `color` (H, W, C), where this shows the same surface.

        The area of a quarter of the square on the right of the way is minus the integral of y over x around it: along
        the way, in straight pieces, and back along the square's sides, of which only the bottom counts.
        """
        xp, mean, parts = namespace(self.path), (self.jump[0] + self.jump[1]) / 2, []
        flat = xp.reshape(color, (-1, color.shape[2]))
        pieces, bottoms = self._pieces(), [self._right_of_bottom(2.5, 3.0), self._right_of_bottom(2.0, 2.5)]
        for k, (dx, dy) in enumerate(CORNERS):
            area, change = 0.5 * bottoms[dx], xp.zeros_like(mean)
            for at, way, flux in pieces:
                column = at[:, 0] >= 0.5 if dx else at[:, 0] < 0.5
                height = xp.clip(at[:, 1] - 0.5 * dy, 0.0, 0.5)
                area = area - xp.where(column, height * way[:, 0], 0.0)
                right, below = (xp.clip((at[:, a] - 0.5) / BORDER + 0.5, 0.0, 1.0) for a in (0, 1))
                share = (right if dx else 1 - right) * (below if dy else 1 - below)
                change = change + share[:, None] * flux
            on_right, x, y = self._on_the_right(k), self.square[:, 0] + dx, self.square[:, 1] + dy
            share = xp.where(on_right, area - 0.25, area)
            beside = (self.square_sides[:, 0] == k) | (self.square_sides[:, 0] == (k + 3) % 4)
            share = xp.where(self.lone & ~beside, 0.0, share)[:, None]
            beside = xp.where(on_right[:, None], self.right, self.right - self.jump)
            centre = xp.take(flat, y * color.shape[1] + x, axis=0)
            differs = xp.where(self._knows(k, on_right)[:, None], centre - (beside[0] + beside[1]) / 2, 0.0)
            change = change + share * mean - xp.abs(share) * differs
            nothing = (self.ties[:, 0] == self.ties[:, 1]) & ~self.lone | (self.hub >= 0) | self.meets
            parts.append((x, y, xp.where(nothing[:, None], 0.0, change)))
        return parts

    def meetings(self, color: Array) -> list[tuple[Array, Array, Array]]:
        """Changes as of `parts`, of segments at which others end, or which others cross, and of these.

        All these outlines go from their breaks to the segment's corner, and as many surfaces lie between them.
        Clockwise around the square, the colour rises by a jump at each break; what is on the way from there to the
        corner counts against it.
        """
        xp, parts, rays = namespace(self.path), [], self._rays()
        flat, count = xp.reshape(color, (-1, color.shape[2])), self.number.shape[0]
        counts = [self.meets | (self.hub >= 0), self.meets | (self.hub >= 0) & ~self.lone]
        side, place = (xp.concat([getattr(ray, name) for ray in rays]) for name in ("side", "place"))
        before, after = (xp.concat([getattr(ray, name) for ray in rays]) for name in ("before", "after"))
        seen = xp.concat([self.seen[0], self.seen[1]])
        # Both rays of each segment, and of those beside it in the list, of which some end at it or cross it.
        near, there = [self.number, count + self.number], [self.meets, self.meets]
        for step in STEPS:
            row = xp.clip(self.number + step, 0, count - 1)
            here = (xp.take(self.hub, row) == self.number) & (row == self.number + step)
            near, there = [*near, row, count + row], [*there, here, here & ~xp.take(self.lone, row)]
        near, there = xp.stack(near), xp.stack(there)
        for k, (dx, dy) in enumerate(CORNERS):
            x, y = self.square[:, 0] + dx, self.square[:, 1] + dy
            weights, fluxes = zip(*(ray.onto(k) for ray in rays), strict=True)
            changes = [f - w[:, None] * ray.jump for w, f, ray in zip(weights, fluxes, rays, strict=True)]
            change = sum(xp.where(c[:, None], x, 0.0) for c, x in zip(counts, changes, strict=True))
            weight, next_ = xp.concat(list(weights)), xp.concat([self.next[k, 0], self.next[k, 1]])
            # Sides break ties of places in corners, which two of them share.
            keys = xp.where(side < k, 8.0, 0.0) + place + 1e-5 * xp.astype(side, place.dtype)
            keys = xp.reshape(xp.take(keys, xp.reshape(near, (-1,))), near.shape)
            known, fails, around = xp.zeros_like(self.meets), xp.zeros_like(self.meets), []
            for clockwise, beyond in ((True, xp.where(there, keys, -1.0)), (False, -xp.where(there, keys, 99.0))):
                best = xp.astype(xp.argmax(beyond, axis=0), self.number.dtype) * count + self.number
                ray = xp.take(xp.reshape(near, (-1,)), best)
                expected = xp.where((xp.take(side, ray) < 2) == clockwise, 1, 0)
                found, sees = xp.take(next_, ray), xp.take(seen, ray, axis=0)
                known = known | (found == expected)
                fails = fails | (found == 1 - expected) | ~xp.where(expected == 0, sees[:, 0], sees[:, 1])
                around.append(ray)
            beside = (xp.take(after, around[0], axis=0) + xp.take(before, around[1], axis=0)) / 2
            centre = xp.take(flat, y * color.shape[1] + x, axis=0)
            lost = xp.clip(xp.take(weight, around[1]) - xp.take(weight, around[0]), 0.0, None)
            own = xp.where(self.meets & known & ~fails, lost, 0.0)[:, None] * (centre - beside)
            parts.append((x, y, change - own))
        return parts

    def _rays(self) -> list[_Ray]:
        """The outlines from start and end of each segment to its corner, or to that of the one it ends at or crosses.

        They run along that one from where they meet it, and move there as that does.
        """
        xp, places, alone = namespace(self.path), self._places(), (self.hub < 0)[:, None]
        hub = xp.take(self.path, xp.where(self.hub >= 0, self.hub, self.number), axis=1)
        at, until, rays = self.path[1], self.moves[1], []
        (first, near), (second, far) = (_along(hub[i], hub[1], at) for i in (0, 2))
        starts = near <= far
        t, own = xp.where(starts, first, second)[:, None], xp.where(starts[:, None], *self.beyond)
        share = _along(self.path[0], self.path[2], at)[0][:, None]
        share = xp.where(self.lone[:, None], 0.0, share)
        there = (1 - share) * self.moves[0] + share * self.moves[2]
        for e in (0, 1):
            start, move = self.path[2 * e], self.moves[2 * e]
            points = xp.stack([start, xp.where(alone, (start + at) / 2, at), hub[1]])
            middle = (move + until) / 2
            onto, along = xp.where(alone, middle, there), xp.where(alone, middle, (1 - t) * own + t * until)
            jump, left = (self.jump[0] if e == 0 else -self.jump[1]), self.right[e] - self.jump[e]
            after, before = (left, self.right[e]) if e == 0 else (self.right[e], left)
            moves = (move, onto), (along, until)
            rays.append(_Ray(points, moves, jump, self.square_sides[:, e], places[e], before, after))
        return rays

    def _knows(self, k: int, on_right: Array) -> Array:
        """(S,) True where the segment's side towards a corner is the surface that is seen at this corner."""
        xp, found, fails = namespace(self.path), False, False
        for e in (0, 1):
            side = xp.where(self.before[e] == on_right, 0, 1)
            found = found | (self.next[k, e] == side)
            fails = fails | (self.next[k, e] == 1 - side) | ~xp.where(side == 0, self.seen[e, :, 0], self.seen[e, :, 1])
        return found & ~fails

    def normals(self, breaks: _Breaks) -> Array:
        """Unit normals (B, 2) of outlines at breaks: the mean of their segments'; along the gap for a lone break."""
        xp, way = namespace(self.path), self.path[2] - self.path[0]
        engine, count, same = engine_of(self.path), breaks.place.shape[0], self.ties[:, 0] == self.ties[:, 1]
        normal, total = xp.stack([way[:, 1], -way[:, 0]], axis=-1), breaks.step * 1e-6
        for i in (0, 1):
            # Two segments at a line of crossing may run in opposite directions.
            ahead = xp.sum(normal * xp.take(breaks.step, self.ties[:, i], axis=0), axis=-1) >= 0
            turned = xp.where(same[:, None], 0.0, xp.where(ahead[:, None], normal, -normal))
            total = total + engine.segment_sum(turned, self.ties[:, i], count)
        return total / xp.sqrt(xp.sum(total * total, axis=-1, keepdims=True))

    def _places(self) -> list[Array]:
        """Places (S,) of start and end on the square's sides, clockwise from the upper left corner: 0 to 4."""
        xp, places = namespace(self.path), []
        for i in (0, 1):
            x, y, side = self.path[2 * i][:, 0], self.path[2 * i][:, 1], self.square_sides[:, i]
            places.append(xp.where(side == 0, x, xp.where(side == 1, 1 + y, xp.where(side == 2, 3 - x, 4 - y))))
        return places

    def _on_the_right(self, k: int) -> Array:
        """(S,) True where a corner lies on the right of the way: clockwise between the end and the start."""
        # Clockwise, corner k begins side k, so all that lies on sides from k on comes after it.
        start, end = self.square_sides[:, 0] >= k, self.square_sides[:, 1] >= k
        return namespace(start).where(self._clockwise(), start | ~end, start & ~end)

    def _clockwise(self) -> Array:
        """(S,) True where the end comes after the start on the square's sides; these meet in corners."""
        (start, end), sides = self._places(), self.square_sides
        return (start < end) | ((start == end) & (sides[:, 0] < sides[:, 1]))

    def _right_of_bottom(self, low: float, high: float) -> Array:
        """(S,) the length, between two places on the square's sides, of what lies on the right of the way."""
        (start, end), xp = self._places(), namespace(self.path)

        def between(a: Array, b: Array) -> Array:
            return xp.clip(xp.clip(b, low, high) - xp.clip(a, low, high), 0.0, None)

        return xp.where(self._clockwise(), high - low - between(start, end), between(end, start))

    def _pieces(self) -> list[tuple[Array, Array, Array]]:
        """Middles (S, 2), ways (S, 2) and fluxes (S, C) of straight pieces of segments, cut where pixels meet."""
        xp, pieces, jump = namespace(self.path), [], stopped(self.jump)
        chord = self.path[2] - self.path[0]
        length = xp.sum(chord * chord, axis=-1)
        turn = xp.sum((self.path[1] - self.path[0]) * chord, axis=-1) / xp.where(length > 0, length, 1.0)
        shares = xp.zeros_like(turn), turn, xp.ones_like(turn)
        for at, way, moves, (i, t) in _cut(self.path, (self.moves[:2], self.moves[1:])):
            u = (1 - t) * shares[i][:, None] + t * shares[i + 1][:, None]
            flux = moves[:, 0] * way[:, 1] - moves[:, 1] * way[:, 0]
            # A lone break's edge ends amid the square.
            beside = xp.sum(xp.abs(at - self.path[0]), axis=-1) <= 0.5
            flux = xp.where(self.lone & ~beside, 0.0, flux)
            pieces.append((at, way, flux[:, None] * ((1 - u) * jump[0] + u * jump[1])))
        return pieces


class _Ray(NamedTuple):
    """Outlines from breaks on sides of squares to points inside where they meet others.

    Attributes:
        points: (3, S, 2), the break, a point between, and the end.
        moves: the motions (S, 2) of both ends of both pieces.
        jump: (S, C), the colour on the right of the way less that on the left.
        side: (S,) the side of the square.
        place: (S,) the place of the break on the sides, clockwise.
        before: (S, C), the colour before it, clockwise.
        after: (S, C), the colour after it.
    """

    points: Array
    moves: Sequence[Sequence[Array]]
    jump: Array
    side: Array
    place: Array
    before: Array
    after: Array

    def onto(self, k: int) -> tuple[Array, Array]:
        """By how much the colour of the quarter at corner k rises with the jump, clockwise (S,); the flux (S, C)."""
        xp, (dx, dy), jump = namespace(self.points), CORNERS[k], stopped(self.jump)
        low, place = 2.0 if dx else 2.5, self.place
        weight = 0.5 * xp.clip(low + 0.5 - xp.clip(place, low, None), 0.0, None)
        weight = weight - 0.25 * xp.astype(self.side < k, place.dtype)
        flux = xp.zeros_like(jump)
        for at, way, moves, _ in _cut(self.points, self.moves):
            column = at[:, 0] >= 0.5 if dx else at[:, 0] < 0.5
            height = xp.clip(at[:, 1] - 0.5 * dy, 0.0, 0.5)
            weight = weight + xp.where(column, height * way[:, 0], 0.0)
            right, below = (xp.clip((at[:, a] - 0.5) / BORDER + 0.5, 0.0, 1.0) for a in (0, 1))
            share = (right if dx else 1 - right) * (below if dy else 1 - below)
            rate = moves[:, 0] * way[:, 1] - moves[:, 1] * way[:, 0]
            flux = flux + (share * rate)[:, None] * jump
        return weight, flux


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


def _next(k: int, ties: Array, side: Array, lone: Array, ends: Array) -> Array:
    """`_Segments.next` of the corner k."""
    xp, found = namespace(ties), []
    for e in (0, 1):
        first, last = (xp.take(ends[:, i], ties[:, e]) for i in (0, 1))
        begins, stops = ((side[:, e] == a) | (side[:, e] == b) for a, b in FIRST_AND_LAST[k])
        found.append(xp.where(begins & first, 0, xp.where(stops & last, 1, -1)))
    return xp.stack([found[0], xp.where(lone, -1, found[1])])


FIRST_AND_LAST = (((0, 3), (9, 9)), ((1, 9), (0, 9)), ((9, 9), (1, 2)), ((2, 9), (3, 9)))
"""For each corner of a square the sides on which it is the first centre of the gap, and the last; 9 for none."""


def _beside_breaks(
    breaks: _Breaks, segments: _Segments, outlines: Outlines, color: Array, motion: Array
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
    normal = segments.normals(breaks)
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
