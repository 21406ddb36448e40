"""The surfaces seen at centres, and the samples that are needed beside crossings. Compiled."""

from __future__ import annotations

import numpy as np

from rts.compiling.loops import loop


@loop
def hits(first, last, seen, depth, owners, opaque, part, triangle, deep):
    """Fill in the fields of `Hits` in lines `first` to `last`, from fragments; nothing behind an opaque part.

    Args:
        first: the first line.
        last: the line after the last.
        seen: (K, H, W) int32, triangles counted over all parts; −1 where nothing is seen.
        depth: (K, H, W) float32.
        owners: (T,) int32, the part of each triangle; no rows for a single part.
        opaque: (P,) bool.
        part: (K, H, W) int32 to fill.
        triangle: (K, H, W) int32 to fill.
        deep: (K, H, W) float32 to fill with depths; 0 where nothing is seen.
    """
    several = len(owners) > 0
    hidden = np.empty(seen.shape[2], np.bool_)
    for y in range(first, last):
        hidden[:] = False
        for k in range(len(seen)):
            for x in range(seen.shape[2]):
                t = np.int32(-1) if hidden[x] else seen[k, y, x]
                own = -1 if t < 0 else (owners[t] if several else 0)
                part[k, y, x], triangle[k, y, x], deep[k, y, x] = own, t, depth[k, y, x] if t >= 0 else np.float32(0)
                hidden[x] |= own >= 0 and opaque[own]


@loop
def needed(crossings, required, place, own, triangles, positions):
    """List the samples beside crossings that tell colours and motions; returns their number.

    Args:
        crossings: the crossings.
        required: what samples have to tell.
        place: (4 B,) int32 to fill: places in `Outlines.rows`, of two samples that tell motions and two that tell
            colours; where nothing moves, these are in place of the former.
        own: (4 B,) int32 to fill: the parts.
        triangles: (4 B,) int32 to fill.
        positions: (4 B, 2) to fill.
    """
    parts, ends, points, inner = crossings.parts, crossings.ends, crossings.points, crossings.inner
    (colors, motions, centers), of_crossings, n = required, crossings.triangles, 0
    for b in range(len(parts)):
        for i in range(4):
            side = i % 2
            # Of one kind alone samples stand in the first two places.
            there = i < 2 or (colors and motions and not centers)
            if not motions and centers:  # What lies behind a crossing that is not the last.
                there = i == 1 and not ends[b, 1]
            if parts[b, side] < 0 or not there:
                continue
            at_crossing = i < 2 if motions else centers
            place[n], own[n] = 6 * b + i, parts[b, side]
            triangles[n] = of_crossings[b, side if at_crossing else 2 + side]
            for axis in range(2):
                positions[n, axis] = points[b, side, axis] if at_crossing else inner[b, side, axis]
            n += 1
    return n
