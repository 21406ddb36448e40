"""Where outlines cross the ways between neighbouring pixels' centres, by walks over triangles. Compiled.

A corner is (x w, y w, z, w): x and y in pixels from the image's corner, z and w those of clip space. An edge as a line
of the image is the cross product of two corners without z; so corners may lie behind the eye.
"""

from __future__ import annotations

import numpy as np

from rts.plugin_api.loops import compiled, loop

MOST_STEPS = 1000
"""Triangles, at most, on the way from one pixel to the next; beyond them the surface counts as one."""
REACH = 1 + 1e-4
"""Length of a way within which an edge counts: one that passes through the next centre may end either pixel."""
JOINED, BEYOND = -np.inf, np.inf
"""In place of the depth at a walk's end: the sheet joins both centres, or goes on behind the next one."""


@compiled
def _crossing(corners, i, j, place, axis):
    """Where the edge between two corners crosses a way along an axis, at a `place` across it.

    Returns:
        The place along the way, and z/w; NaN where the edge does not cross the way, or behind the eye.
    """
    a = corners[i, 1 - axis] - place * corners[i, 3]
    b = corners[j, 1 - axis] - place * corners[j, 3]
    s = a / (a - b)
    w = corners[i, 3] + s * (corners[j, 3] - corners[i, 3])
    crosses = (a > 0) != (b > 0) and not w <= 0
    at = (corners[i, axis] + s * (corners[j, axis] - corners[i, axis])) / w if crosses else np.nan
    return at, (corners[i, 2] + s * (corners[j, 2] - corners[i, 2])) / w if crosses else np.nan


@compiled
def _turns(corners, i, j, far, axis, way):
    """True if a triangle with a `far` corner does not lie ahead of its edge, on a way along an axis."""
    a = corners[i, 1] * corners[j, 3] - corners[i, 3] * corners[j, 1]
    b = corners[i, 3] * corners[j, 0] - corners[i, 0] * corners[j, 3]
    c = corners[i, 0] * corners[j, 1] - corners[i, 1] * corners[j, 0]
    ahead = way * (a if axis == 0 else b)
    return (a * corners[far, 0] + b * corners[far, 1] + c * corners[far, 3]) * ahead <= 0


@compiled
def _walk(corners, tri, beyond, start, goal, x, y, axis, way, end):
    """Walk from a pixel's centre over the triangles of a sheet, to where it ends.

    Args:
        corners: (V, 4).
        tri: (T, 3).
        beyond: (T, 3), `Topology.beyond`.
        start: the triangle at (x, y).
        goal: the triangle at the next centre, or −1.
        x: of the pixel's centre.
        y: of the pixel's centre.
        axis: 0 for a way along x, 1 along y.
        way: 1 or −1, the direction.
        end: (2,) int32 to fill with the vertices of the edge where the sheet ends, or turns away.

    Returns:
        z/w at this edge; or `JOINED`, or `BEYOND`.
    """
    begin, place = (x, y) if axis == 0 else (y, x)
    at, through, length, depth = start, -1, 0.0, 0.0
    for k in range(3):  # The way leaves the first triangle by one of two edges, the one farther ahead.
        there, z = _crossing(corners, tri[at, (k + 1) % 3], tri[at, (k + 2) % 3], place, axis)
        if through < 0 or way * (there - begin) > length:
            if there == there:
                through, length, depth = k, way * (there - begin), z
    for _ in range(MOST_STEPS):
        if through < 0:
            return JOINED
        if not length < REACH:
            return BEYOND
        i, j, next_ = tri[at, (through + 1) % 3], tri[at, (through + 2) % 3], beyond[at, through]
        far = -1 if next_ < 0 else tri[next_, 0] + tri[next_, 1] + tri[next_, 2] - i - j
        if far < 0 or _turns(corners, i, j, far, axis, way):
            end[0], end[1] = i, j
            return depth
        if next_ == goal:
            return JOINED
        at, through = next_, -1
        for k in range(3):  # It leaves others by the other edge that it crosses.
            if tri[at, k] != far:
                there, z = _crossing(corners, tri[at, (k + 1) % 3], tri[at, (k + 2) % 3], place, axis)
                if there == there:
                    through, length, depth = k, way * (there - begin), z
    return JOINED


@loop
def count(first, last, shown, counts):
    """Fill `counts` (B · H,) with the ways from each line on which the triangle changes; for `shown` see `find`."""
    _, height, width = shown.shape
    for line in range(first, last):
        b, y, n = line // height, line % height, 0
        for x in range(width):
            n += x + 1 < width and shown[b, y, x + 1] != shown[b, y, x]
            n += y + 1 < height and shown[b, y + 1, x] != shown[b, y, x]
        counts[line] = n


@loop
def find(first, last, corners, tri, beyond, shown, begins, found):
    """Fill in the outlines that cross ways to the next pixels, from lines `first` to `last` of all images.

    Args:
        first: the first line, counted over all images.
        last: the line after the last.
        corners: (B, V, 4), or (1, V, 4) for all images.
        tri: (T, 3).
        beyond: (T, 3), `Topology.beyond`.
        shown: (B, H, W) int32, the number plus one of the triangle that each pixel shows, or 0.
        begins: (B · H + 1,), where the ways of each line begin.
        found: (M, 5) int32 to fill: the pixel whose surface ends, and the other one, as flat indices; 0 for a way along
            x, 1 along y, −1 for ways without an outline; and the two vertices of the edge.
    """
    _, height, width = shown.shape
    end, other_end = np.empty(2, np.int32), np.empty(2, np.int32)
    for line in range(first, last):
        b, y, n = line // height, line % height, begins[line]
        own = corners[b if len(corners) > 1 else 0]
        for x in range(width):
            for axis in range(2):
                next_x, next_y = x + 1 - axis, y + axis
                if next_x == width or next_y == height or shown[b, next_y, next_x] == shown[b, y, x]:
                    continue
                here, there = shown[b, y, x] - 1, shown[b, next_y, next_x] - 1
                pixel, next_pixel = line * width + x, (line + axis) * width + next_x
                at, n = n, n + 1
                found[at, 2] = -1
                depth = other = BEYOND
                if here >= 0:
                    depth = _walk(own, tri, beyond, here, there, x + 0.5, y + 0.5, axis, 1, end)
                if there >= 0 and depth != JOINED:
                    other = _walk(own, tri, beyond, there, here, next_x + 0.5, next_y + 0.5, axis, -1, other_end)
                if depth == JOINED or other == JOINED or (depth == BEYOND and other == BEYOND):
                    continue
                ends = depth <= other  # Of two surfaces that end, the nearer one.
                edge = end if ends else other_end
                found[at, 0], found[at, 1] = (pixel, next_pixel) if ends else (next_pixel, pixel)
                found[at, 2], found[at, 3], found[at, 4] = axis, edge[0], edge[1]
