"""The splatter of found edges: pixels are area averages beside straight edges, which move with the samples at them.

    image of a pixel  =  C − ∇C · m  +  Σ over segments of  (share beside the segment − share of the centre) · J
                                     +  Σ over segments of  ∫ v · n J ds

    C       the colour of the centre's sample; ∇C its slope across the image, from the next centres on the same surface
    m       the motion of this sample in the image: 0 in value, it has the derivative
    J       the colour on one side of a segment less that on the other, from the last samples beside its two breaks
    v       the motion of a break, linear between the two: that of the last sample of the nearer surface, which ends there
    n ds    along the part of the segment inside the pixel

Shares have no derivative, and the flux ∫ v · n J ds has no value: it is the derivative of the shares. ∇C, n and, in the
flux, J are constants.
"""

from __future__ import annotations

from typing import NamedTuple

from rts.arrays.engines import engine_of, namespace, stopped
from rts.arrays.trees import Array
from rts.contracts.records import Outlines, Splats
from rts.contracts.splatter import Splatter
from rts.splatting.layers import check_rows, nothing, unpack

CORNERS = ((0, 0), (1, 0), (1, 1), (0, 1))
"""Steps (x, y) from a square's first corner to all of them, clockwise from the upper left."""

STARTS = ((0, 0), (1, 0), (1, 1), (0, 1))
"""Where each side of a square begins, clockwise: top, right, bottom, left."""

BORDER = 2e-4
"""Width, in cells, of the strip along a border of two pixels in which an edge belongs to both."""

UPRIGHT = 1e-3
"""The least ratio of a normal's components, so that shares of squares beside upright edges have no division by 0."""


class Edges(Splatter):
    """Found edges: sharp inside, area averages at outlines. One layer suffices where all is opaque."""

    layers = 1
    reads = frozenset({"outlines"})

    def image(self, splats: Splats) -> Array:
        """See `rts.Splatter`; without `Splats.outlines`, an image without edges."""
        positions, rgba, row = splats.positions, splats.rgba, splats.row
        if rgba.shape[0] == 0:
            return nothing(rgba, row)
        check_rows(row, rgba.shape[0])
        xp, (height, width) = namespace(rgba), row.shape[1:]
        covered = row[0] >= 0
        x = xp.arange(width, dtype=positions.dtype, device=positions.device) + 0.5
        y = xp.arange(height, dtype=positions.dtype, device=positions.device) + 0.5
        centres = xp.stack([*xp.meshgrid(x, y, indexing="xy"), xp.zeros((height, width), dtype=x.dtype)], axis=-1)
        color = xp.where(covered[..., None], unpack(rgba, row[0]), 0.0)
        motion = xp.where(covered[..., None], unpack(positions, row[0]) - centres, 0.0)
        outlines = splats.outlines
        if outlines is None:
            return color - _inside(color, motion, _all_joined(covered))
        image = color - _inside(color, motion, outlines.joined)
        if outlines.place.shape[0] == 0:
            return image
        breaks = _Breaks.of(outlines, positions, rgba)
        segments = _Segments.of(outlines, breaks)
        parts = [*_beside_breaks(breaks, segments, outlines, color, motion), *segments.parts()]
        cells = xp.concat([y * width + x for x, y, _ in parts])
        changes = xp.concat([change for *_, change in parts])
        engine = engine_of(changes)
        sums = engine.segment_sum(changes, engine.to_numpy(cells), height * width)
        return image + xp.reshape(sums, image.shape)


def _inside(color: Array, motion: Array, joined: Array) -> Array:
    """∇C · m (H, W, C): slopes are means of the differences from and to the next cells of the same surface."""
    xp, still, total = namespace(color), stopped(color), 0.0
    for axis in (0, 1):
        here = joined[axis][..., None]
        rise = xp.where(here, xp.roll(still, -1, axis=1 - axis) - still, 0.0)
        total = total + (rise + xp.roll(rise, 1, axis=1 - axis)) / 2 * motion[..., axis, None]
    return total


def _all_joined(covered: Array) -> Array:
    """`Outlines.joined` as if all covered cells showed one surface."""
    xp = namespace(covered)
    right, below = (xp.roll(covered, -1, axis=axis) & covered for axis in (1, 0))
    x, y = xp.arange(covered.shape[1], device=covered.device), xp.arange(covered.shape[0], device=covered.device)
    return xp.stack([right & (x < covered.shape[1] - 1), below & (y < covered.shape[0] - 1)[:, None]])


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
        check_rows(rows, rgba.shape[0], "outlines.rows")
        seen = xp.stack([rows[:, 0] >= 0, rows[:, 1] >= 0])
        at = [xp.where(rows[:, i] >= 0, rows[:, i], 0) for i in (0, 1)]
        color = xp.stack([xp.where(seen[i][:, None], xp.take(rgba, at[i], axis=0), 0.0) for i in (0, 1)])
        found = [xp.take(positions, at[i], axis=0) for i in (0, 1)]
        points = xp.astype(outlines.points, positions.dtype)
        motion = [xp.where(seen[i][:, None], found[i][:, :2] - points[:, i], 0.0) for i in (0, 1)]
        # Where surfaces pass through one another, the line moves to where their depths are equal.
        slope = xp.astype(outlines.slope, positions.dtype)
        still = [
            found[i][:, 2] - stopped(found[i][:, 2]) - xp.sum(slope[:, i] * motion[i], axis=-1) for i in (0, 1)
        ]
        apart = slope[:, 0] - slope[:, 1]
        square = xp.sum(apart * apart, axis=-1)
        crossing = outlines.near == 2
        along = -(still[0] - still[1]) / xp.where(crossing & (square > 0), square, 1.0)
        moves = xp.where((outlines.near == 0)[:, None], motion[0], motion[1])
        moves = xp.where(crossing[:, None], along[:, None] * apart, moves)
        row = xp.astype(outlines.gap[:, 2], positions.dtype)
        place, step = xp.astype(outlines.place, positions.dtype), xp.stack([row, 1 - row], axis=-1)
        return cls(place, step, color, seen, xp.stack(motion), moves)


class _Segments(NamedTuple):
    """Segments, each from a break to another; or from a lone break straight across its square, of which half counts.

    Attributes:
        square: (S, 2) int, x and y of the first corner's cell.
        lone: (S,) bool.
        start: (S, 2) x and y.
        way: (S, 2) from start to end.
        side: (S, 2) int, the sides of the square that start and end lie on.
        place: (S, 2), where start and end lie on the sides, clockwise from the upper left corner: 0 to 4.
        ties: (S, 2) int, the breaks at start and end.
        jump: (2, S, C), at start and end, the colour on the right of the way less that on the left.
        moves: (2, S, 2), the motion of start and end.
    """

    square: Array
    lone: Array
    start: Array
    way: Array
    side: Array
    place: Array
    ties: Array
    jump: Array
    moves: Array

    @classmethod
    def of(cls, outlines: Outlines, breaks: _Breaks) -> _Segments:
        """The segments between breaks."""
        xp = namespace(breaks.place)
        lone, square = outlines.ties[:, 1] < 0, xp.stack([outlines.square[:, 1], outlines.square[:, 0]], axis=-1)
        ties = xp.stack([outlines.ties[:, 0], xp.where(lone, outlines.ties[:, 0], outlines.ties[:, 1])], axis=-1)
        side = xp.stack([outlines.side[:, 0], xp.where(lone, (outlines.side[:, 0] + 2) % 4, outlines.side[:, 1])], axis=-1)
        start, end = (xp.take(breaks.place, ties[:, i], axis=0) for i in (0, 1))
        first = xp.astype(square, start.dtype) + 0.5
        middle = 2 * first + 1 - start  # The point opposite: mirrored, along the gap put back.
        along = xp.take(breaks.step, ties[:, 0], axis=0)
        end = xp.where(lone[:, None], along * start + (1 - along) * middle, end)
        local = xp.clip(xp.stack([start - first, end - first]), 0.0, 1.0)
        place = [_on_sides(local[i], side[:, i]) for i in (0, 1)]
        jump, moves = [], []
        for i in (0, 1):
            before, behind = (xp.take(breaks.color[k], ties[:, i], axis=0) for k in (0, 1))
            # Clockwise, sides 0 and 1 lead along their gaps; what lies before a start is on the right of the way.
            forward = (side[:, i] < 2) if i == 0 else (side[:, i] >= 2)
            jump.append(xp.where(forward[:, None], before - behind, behind - before))
            moves.append(xp.take(breaks.moves, ties[:, i], axis=0))
        jump[1] = xp.where(lone[:, None], jump[0], jump[1])
        return cls(square, lone, start, end - start, side, xp.stack(place, axis=-1), ties, xp.stack(jump), xp.stack(moves))

    def parts(self) -> list[tuple[Array, Array, Array]]:
        """What segments change: cells (x and y) and changes (S, C), for each corner of the square."""
        xp, parts = namespace(self.start), []
        normal = xp.stack([self.way[:, 1], -self.way[:, 0]], axis=-1)
        mean = (self.jump[0] + self.jump[1]) / 2
        pieces = self._pieces(normal)
        for k, (dx, dy) in enumerate(CORNERS):
            x, y = self.square[:, 0] + dx, self.square[:, 1] + dy
            corner = xp.astype(xp.stack([x, y], axis=-1), self.start.dtype) + 0.5
            low = corner - 0.5 * xp.asarray([dx, dy], dtype=corner.dtype, device=corner.device)
            share = _share_of_quarter(low - self.start, normal)
            share = share - xp.where(self._on_the_right(k), 0.25, 0.0)
            beside = (self.side[:, 0] == k) | (self.side[:, 0] == (k + 3) % 4)
            change = xp.where(self.lone & ~beside, 0.0, share)[:, None] * mean
            for at, flux in pieces:
                right, below = (
                    xp.clip((at[:, a] - xp.astype(self.square[:, a], at.dtype) - 1) / BORDER + 0.5, 0.0, 1.0)
                    for a in (0, 1)
                )
                share = (right if dx else 1 - right) * (below if dy else 1 - below)
                change = change + share[:, None] * flux
            parts.append((x, y, change))
        return parts

    def normals(self, breaks: _Breaks) -> Array:
        """Unit normals (B, 2) of outlines at breaks: the mean of their segments'; along the gap for a lone break."""
        xp = namespace(self.start)
        engine, count = engine_of(self.start), breaks.place.shape[0]
        normal, total = xp.stack([self.way[:, 1], -self.way[:, 0]], axis=-1), breaks.step * 1e-6
        for i in (0, 1):
            # Two segments at a line of crossing may run in opposite directions.
            ahead = xp.sum(normal * xp.take(breaks.step, self.ties[:, i], axis=0), axis=-1) >= 0
            turned = xp.where((self.lone)[:, None], 0.0, xp.where(ahead[:, None], normal, -normal))
            total = total + engine.segment_sum(turned, engine.to_numpy(self.ties[:, i]), count)
        return total / xp.sqrt(xp.sum(total * total, axis=-1, keepdims=True))

    def _on_the_right(self, k: int) -> Array:
        """(S,) True where a corner lies on the right of the way: clockwise between the end and the start."""
        # Clockwise, corner k begins side k, so all that lies on sides from k on comes after it.
        start, end = self.side[:, 0] >= k, self.side[:, 1] >= k
        return namespace(start).where(self.place[:, 0] < self.place[:, 1], start | ~end, start & ~end)

    def _pieces(self, normal: Array) -> list[tuple[Array, Array]]:
        """The middles (S, 2) and the fluxes (S, C) of three pieces of each segment, cut where pixels meet."""
        xp = namespace(normal)
        cuts = []
        for a in (0, 1):
            border, way = xp.astype(self.square[:, a], normal.dtype) + 1 - self.start[:, a], self.way[:, a]
            there = xp.abs(way) > 1e-9
            cuts.append(xp.clip(xp.where(there, border / xp.where(there, way, 1.0), 0.0), 0.0, 1.0))
        last = xp.where(self.lone, 0.5, 1.0)
        cuts = [xp.minimum(c, last) for c in (xp.minimum(*cuts), xp.maximum(*cuts))]
        bounds, pieces = [xp.zeros_like(last), *cuts, last], []
        jump = stopped(self.jump)
        for low, high in zip(bounds[:-1], bounds[1:], strict=True):
            t = ((low + high) / 2)[:, None]
            moves, jumps = ((1 - t) * x[0] + t * x[1] for x in (self.moves, jump))
            flux = xp.sum(moves * normal, axis=-1) * (high - low)
            pieces.append((self.start + t * self.way, flux[:, None] * jumps))
        return pieces


def _on_sides(local: Array, side: Array) -> Array:
    """Places (S,) on the sides of squares, 0 to 4, of points (S, 2) in units of the square."""
    xp = namespace(local)
    x, y = local[:, 0], local[:, 1]
    return xp.where(side == 0, x, xp.where(side == 1, 1 + y, xp.where(side == 2, 3 - x, 4 - y)))


def _share_of_quarter(low: Array, normal: Array) -> Array:
    """The area of half a cell by half a cell, with its least corner at `low` (S, 2), where `normal` · x is below 0."""
    xp = namespace(low)
    size = xp.sum(xp.abs(normal), axis=-1)
    flat = size <= 1e-12
    normal = normal / xp.where(flat, 1.0, size)[:, None]
    # From the corner where n · x is least, the area grows as squares of the distance.
    spans = 0.5 * xp.maximum(xp.abs(normal), UPRIGHT * xp.ones_like(normal))
    a, b = spans[:, 0], spans[:, 1]
    middle = xp.sum((low + 0.25) * normal, axis=-1)
    depth = (a + b) / 2 - middle

    def square(x: Array) -> Array:
        return xp.maximum(x, xp.zeros_like(x)) ** 2

    area = (square(depth) - square(depth - a) - square(depth - b) + square(depth - a - b)) / (8 * a * b)
    return xp.where(flat, 0.0, area)


def _beside_breaks(
    breaks: _Breaks, segments: _Segments, outlines: Outlines, color: Array, motion: Array
) -> list[tuple[Array, Array, Array]]:
    """What changes in the cells on both sides of gaps: colours there change on up to the break, and no farther."""
    xp = namespace(color)
    y, x, row = (outlines.gap[:, i] for i in range(3))
    parts = []
    normal = segments.normals(breaks)
    flat_color, flat_motion = (xp.reshape(t, (-1, t.shape[-1])) for t in (color, motion))
    for i in (0, 1):
        cx, cy = (x, y) if i == 0 else (x + row, y + 1 - row)
        index = cy * color.shape[1] + cx
        counts = (outlines.ends[:, i] & breaks.seen[i])[:, None]
        rise = stopped(breaks.color[i] - xp.take(flat_color, index, axis=0)) * (1 if i == 0 else -1)
        moves = (breaks.motion[i] + xp.take(flat_motion, index, axis=0)[:, :2]) / 2
        if PROJECT:
            own = xp.sum(moves * normal, axis=-1) * xp.sum(normal * breaks.step, axis=-1)
        else:
            own = xp.sum(moves * breaks.step, axis=-1)
        parts.append((cx, cy, xp.where(counts, -rise * own[:, None], 0.0)))
    return parts


PROJECT = True
