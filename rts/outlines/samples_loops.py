"""Which samples outlines need: of what is seen at centres, and beside breaks. Compiled."""

from __future__ import annotations

from rts.compiling.loops import loop


@loop
def fronts(first, last, triangle, depth, owners, part, deep):
    """Fill in the fields of `Fronts` in lines `first` to `last`, from a layer of fragments.

    Args:
        first: the first line.
        last: the line after the last.
        triangle: (H, W) int32, counted over all parts; −1 where nothing is seen.
        depth: (H, W) float32.
        owners: (T,) int32, the part of each triangle; no rows for a single part.
        part: (H, W) int32 to fill.
        deep: (H, W) float64 to fill with depths; 0 where nothing is seen.
    """
    several = len(owners) > 0
    for y in range(first, last):
        for x in range(part.shape[1]):
            t = triangle[y, x]
            part[y, x] = -1 if t < 0 else (owners[t] if several else 0)
            deep[y, x] = depth[y, x] if t >= 0 else 0.0


@loop
def needed(parts, ends, points, inner, of_breaks, colors, motions, centers, place, triangles, positions):
    """List the samples beside breaks that tell colours and motions; returns their number.

    Args:
        parts: (B, 2), as of `Breaks`.
        ends: (B, 2).
        points: (B, 2, 2).
        inner: (B, 2, 2).
        of_breaks: (B, 4), the triangles of these samples.
        colors: see `Told`.
        motions: likewise.
        centers: likewise.
        place: (4 B,) int32 to fill: places in `Outlines.rows`, of two samples that tell motions and two that tell
            colours; where nothing moves, these are in place of the former.
        triangles: (4 B,) int32 to fill.
        positions: (4 B, 2) to fill.
    """
    n = 0
    for b in range(len(parts)):
        for i in range(4):
            side = i % 2
            # Of one kind alone samples stand in the first two places.
            told = i < 2 or (colors and motions and not centers)
            if not motions and centers:  # What lies behind a break that is not the last.
                told = i == 1 and not ends[b, 1]
            if parts[b, side] < 0 or not told:
                continue
            at_break = i < 2 if motions else centers
            place[n], triangles[n] = 6 * b + i, of_breaks[b, side if at_break else 2 + side]
            for axis in range(2):
                positions[n, axis] = points[b, side, axis] if at_break else inner[b, side, axis]
            n += 1
    return n
