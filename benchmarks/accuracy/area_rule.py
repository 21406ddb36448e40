"""The rule of found edges, pixel by pixel, in plain NumPy: for readers and tests. `areas_loops` computes the same.

    colour of a cell      Σ over the regions into which outlines cut it: area · mean colour beside the region
    derivative of it      Σ over outlines: ∫ v · n J ds, with v the motion of the outline and J the jump of colour there

A cell is four quarters, each in a dual cell of four neighbouring centres. On the sides of a dual cell lie crossings.
From each crossing a ray leads to a junction inside, the corner of its segment or of the one that this ends at or
crosses. Rays and sides bound regions. The region around the cell's centre has the colour of the centre's sample.

All here is of one layer, without what changes beside crossings as surfaces slide under the outline (`_add_sides`).
"""

from __future__ import annotations

import itertools
from collections import defaultdict
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from rts.outlines.found import Outlines

CORNERS = np.array([(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)])
"""The centres at a dual cell's corners, x and y, clockwise; the cell of each has one quarter of the dual cell."""

Path = list[np.ndarray]
"""Points (x, y), from a dual cell's first centre."""


class Ray(NamedTuple):
    """An outline from a crossing to the junction where it meets others.

    Attributes:
        place: where it starts on the sides of the dual cell, clockwise from the upper left corner: 0 to 4.
        endpoint: the crossing.
        side: the side of the dual cell: 0 top, 1 right, 2 bottom, 3 left.
        junction: the segment at whose corner it ends.
        path: the crossing, a point between, and the junction; and on to another junction, if rays of both alternate.
    """

    place: float
    endpoint: int
    side: int
    junction: int
    path: Path


def rays_of(outlines: Outlines, dual: tuple[int, int]) -> list[Ray]:
    """The rays in a dual cell, whose first corner is the cell (y, x), clockwise by where they start."""
    rays = []
    segments = outlines.segments
    for s in np.flatnonzero((segments.dual == dual).all(axis=1)):
        first, second = segments.endpoints[s]
        for endpoint, side in zip(segments.endpoints[s], segments.dual_sides[s], strict=True):
            if endpoint < 0 or first == second:
                continue
            y, x, along = outlines.gap[endpoint] - [*dual, 0]
            start = np.clip(np.array([x, y]) + outlines.place[endpoint] * np.array([along, 1 - along]), 0.0, 1.0)
            place = (start[0], 1 + start[1], 3 - start[0], 4 - start[1])[side]
            junction = int(s + segments.junction[s])
            path = [start, segments.corner[s], segments.corner[junction]]
            rays.append(Ray(place, int(endpoint), int(side), junction, path))
    rays.sort(key=lambda ray: (ray.side, ray.place, ray.endpoint if ray.side < 2 else -ray.endpoint))
    return _merged(rays, segments.corner)


def _merged(rays: list[Ray], corner: np.ndarray) -> list[Ray]:
    """The rays, where those of junctions that alternate around the dual cell end at one junction."""
    for i, ray in enumerate(rays):
        if ray.junction not in (before := [other.junction for other in rays[:i]]):
            continue
        last = i - 1 - before[::-1].index(ray.junction)
        alternating = {other.junction for other in rays[last + 1 : i]} & {
            other.junction for other in [*rays[:last], *rays[i + 1 :]]
        }
        for junction in alternating - {ray.junction}:
            end = corner[ray.junction]
            rays = [
                x._replace(junction=ray.junction, path=[*x.path, end]) if x.junction == junction else x for x in rays
            ]
    return rays


def regions_of(rays: Sequence[Ray]) -> list[tuple[Path, list[tuple[int, int]]]]:
    """The regions of a dual cell: polygons, clockwise, and the rays that bound them, in pairs from where to where.

    A ray, by its number, comes with the side of its crossing that the region is on: 0 before it on its gap, 1 behind.
    """
    left, regions = set(range(len(rays))), []
    while left:
        first = here = min(left)
        polygon, beside = [], []
        while True:
            left.remove(here)
            ray, after = rays[here], (here + 1) % len(rays)
            polygon += ray.path[::-1] + _corners(ray, rays[after], after <= here) + rays[after].path
            beside += [(here, int(ray.side < 2)), (after, int(rays[after].side >= 2))]
            # From the junction on along the ray before, counterclockwise.
            here = (after - 1) % len(rays)
            while rays[here].junction != rays[after].junction:
                here = (here - 1) % len(rays)
            if here == first:
                break
        regions.append((polygon, beside))
    return regions


def _corners(ray: Ray, after: Ray, around: bool) -> Path:
    """The corners of the dual cell on the way along its sides from one ray's start to the next one's."""
    stop = after.side + (4 if around else 0)
    return [CORNERS[k % 4] for k in range(ray.side + 1, stop + 1)]


def area_in(polygon: Path, corner: int) -> float:
    """The area of a polygon in the quarter at a corner of its dual cell, clockwise positive."""
    low, high = CORNERS[corner] / 2, CORNERS[corner] / 2 + 0.5
    for axis in (0, 1):
        for bound, sign in ((low[axis], 1), (high[axis], -1)):
            inside, clipped = [sign * (p[axis] - bound) for p in polygon], []
            for p, q, a, b in zip(polygon, np.roll(polygon, -1, axis=0), inside, np.roll(inside, -1), strict=True):
                if a >= 0:
                    clipped.append(p)
                if (a < 0) != (b < 0):
                    clipped.append(p + a / (a - b) * (q - p))
            polygon = clipped
            if not polygon:
                return 0.0
    x, y = np.transpose(polygon)
    return float(np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y) / 2)


def length_in(path: Path, corner: int) -> float:
    """The length of the first two pieces of a path in the quarter at a corner."""
    pieces = [(q - p, (p + q) / 2 - CORNERS[corner]) for p, q in _cut(path[:3])]
    return sum(float(np.hypot(*way)) for way, middle in pieces if (np.abs(middle) <= 0.5).all())


def _cut(path: Path) -> list[tuple[np.ndarray, np.ndarray]]:
    """The straight pieces of a path, cut where the dual cell's quarters meet."""
    pieces = []
    for p, q in zip(path[:-1], path[1:], strict=True):
        cuts = [(0.5 - p[a]) / (q[a] - p[a]) for a in (0, 1) if abs(q[a] - p[a]) > 1e-9]
        bounds = [0.0, *sorted(t for t in cuts if 0 < t < 1), 1.0]
        pieces += [(p + s * (q - p), p + t * (q - p)) for s, t in zip(bounds[:-1], bounds[1:], strict=True)]
    return pieces


def areas(outlines: Outlines, shown: np.ndarray, at_centres: np.ndarray, cell: tuple[int, int]) -> dict[int, float]:
    """The weight of each colour in a cell (y, x); −1 for nothing.

    Args:
        outlines: the outlines.
        shown: (B, 2), the colours before and behind crossings, or −1.
        at_centres: (H, W), the colour of each cell's centre, or −1.
        cell: the cell.
    """
    weights, own = defaultdict(float), int(at_centres[cell])
    for corner, (right, down) in enumerate(CORNERS.astype(int)):
        dual = cell[0] - down, cell[1] - right
        rays = rays_of(outlines, dual)
        if not rays:
            weights[own] += 0.25
            continue
        lengths = [length_in(ray.path, corner) for ray in rays]
        around = max(range(len(rays)), key=lambda i: (rays[i].side < corner, i))  # The ray before the corner.
        regions = [(max(area_in(polygon, corner), 0.0), beside) for polygon, beside in regions_of(rays)]
        scale = 0.25 / sum(area for area, _ in regions)
        for area, beside in regions:
            if around in [i for i, _ in beside[::2]]:
                weights[own] += scale * area
                continue
            # Of several outlines around a region each counts by its length.
            of_junctions: dict[int, list[float]] = defaultdict(list)
            for i, _ in beside:
                of_junctions[rays[i].junction].append(lengths[i] + 1e-9)
            whole = sum(map(sum, of_junctions.values()))
            for i, side in beside:
                own_lengths = of_junctions[rays[i].junction]
                share = sum(own_lengths) / whole / len(own_lengths)
                weights[int(shown[rays[i].endpoint, side])] += scale * area * share
    return dict(weights)


def boundary_terms(outlines: Outlines, cell: tuple[int, int]) -> dict[tuple[int, int], np.ndarray]:
    """By how much a cell changes: for pairs of crossings, by the jump of colour at one, per motion (x, y) of the other.

    Jumps count from before a crossing to behind it, along its gap. From the crossing to the junction of its segment
    alone the jump goes over to the mean of both ends.

    Args:
        outlines: the outlines.
        cell: the cell (y, x).
    """
    segments = outlines.segments
    found: dict[tuple[int, int], np.ndarray] = defaultdict(lambda: np.zeros(2))
    for corner, (right, down) in enumerate(CORNERS.astype(int)):
        dual = cell[0] - down, cell[1] - right
        there = (segments.dual == dual).all(axis=1) & (np.diff(segments.endpoints)[:, 0] != 0)
        chosen = np.flatnonzero(there)
        leaders = [s + segments.junction[s] for s in chosen]
        for s in chosen:
            endpoints = [endpoint for endpoint in segments.endpoints[s] if endpoint >= 0]
            alone = len(endpoints) == 2 and leaders.count(s + segments.junction[s]) == 1
            signs = [1 if side < 2 else -1 for side in segments.dual_sides[s]]
            for e, endpoint in enumerate(endpoints):
                for start, end, t, motion in _pieces(outlines, int(s), e, dual):
                    sides = (1 + np.sign((start + end) / 2 - 0.5)) / 2  # An edge along a border belongs to both cells.
                    share = np.prod(np.where(CORNERS[corner] == 1, sides, 1 - sides))
                    normal = share * np.array([end[1] - start[1], start[0] - end[0]])
                    jumps = {endpoint: signs[e] * (1 - t / 2 if alone else 1)}
                    jumps |= {endpoints[1 - e]: -signs[1 - e] * t / 2} if alone else {}
                    _add(found, jumps, motion, normal)
    return dict(found)


def _add(
    found: dict[tuple[int, int], np.ndarray], jumps: dict[int, float], motion: dict[int, float], normal: np.ndarray
) -> None:
    """Add to boundary terms those of a piece, with a normal as long as it, of each pair of a jump and a crossing."""
    for (jump, weight), (b, rate) in itertools.product(jumps.items(), motion.items()):
        found[int(jump), b] += weight * rate * normal


def _pieces(
    outlines: Outlines, s: int, e: int, dual: tuple[int, int]
) -> list[tuple[np.ndarray, np.ndarray, float, dict[int, float]]]:
    """The straight pieces, start and end, of the ray from end `e` of a segment; and two values for the middle of each.

    These are where it lies between crossing and corner, 0 to 1, and its motion, as weights of those of crossings.
    """
    segments = outlines.segments
    h = int(s + segments.junction[s])
    first, second = segments.endpoints[s]
    second = second if second >= 0 else first
    pulling = segments.adjacent[s, 0], *segments.endpoints[s], segments.adjacent[s, 1]

    def at(b: int) -> np.ndarray:
        y, x, along = outlines.gap[b] - [*dual, 0]
        return np.clip(np.array([x, y]) + outlines.place[b] * np.array([along, 1 - along]), 0.0, 1.0)

    last = segments.pull[s]
    if h == s:
        middle = along = last
    else:
        # The ray runs along the segment that it ends at from where it meets that, and moves as that does.
        ends = [at(b if b >= 0 else segments.endpoints[h, 0]) for b in segments.endpoints[h]]
        (t, near), (u, far) = (_nearest(end, segments.corner[h], segments.corner[s]) for end in ends)
        t, own = (t, 0) if near <= far else (u, 3)
        share, _ = _nearest(at(first), at(second), segments.corner[s])
        middle = np.array([0, 1 - share, share, 0])
        along = t * last + (1 - t) * np.eye(4)[own]
    points = at(segments.endpoints[s, e]), segments.corner[s], segments.corner[h]
    found = []
    for i, (before, behind) in enumerate(((np.eye(4)[1 + e], middle), (along, last))):
        way = points[i + 1] - points[i]
        length = float(way @ way)
        for start, end in _cut([points[i], points[i + 1]]):
            t = float(((start + end) / 2 - points[i]) @ way) / length if length else 0.0
            rates = (1 - t) * before + t * behind
            motion: dict[int, float] = defaultdict(float)
            for b, rate in zip(pulling, rates, strict=True):
                if b >= 0:  # Of a loop through two crossings each pulls twice.
                    motion[int(b)] += float(rate)
            found.append((start, end, t if i == 0 else 1.0, motion))
    return found


def _nearest(start: np.ndarray, end: np.ndarray, point: np.ndarray) -> tuple[float, float]:
    """Where on a straight piece a point is nearest, 0 to 1, and its squared distance."""
    way = end - start
    t = float(np.clip((point - start) @ way / (way @ way), 0, 1)) if way.any() else 0.0
    off = start + t * way - point
    return t, float(off @ off)
