"""Polygons of model files, cut into triangles."""

from __future__ import annotations

import numpy as np

TOLERANCE = 1e-9
"""A triangle of a fan may be turned over by this share of the area of its polygon, which is rounding."""


def cut(points: np.ndarray, corners: np.ndarray, sizes: np.ndarray) -> tuple[np.ndarray, np.ndarray, int]:
    """Triangles of polygons, n − 2 for a polygon of n corners, wound like the polygon.

    A polygon all of whose corners are seen from its first one, such as any that is convex, becomes the fan about that
    corner. Others, which are concave, are cut as seen along the axis that their Newell normal is nearest to.
    Polygons without area, or which cross themselves so that no triangles fit, become fans. A polygon around the corners
    of an earlier one, in either direction, is cut as that one is.

    Args:
        points: (V, 3) float, one unit for all axes; numbers that are not finite do no harm.
        corners: (C,) int into `points`, the corners of one polygon after those of another.
        sizes: (F,) int, the number of corners of each polygon, at least 3.

    Returns:
        (T, 3) int64 into `corners`, ordered by polygon; (T,) int64, the polygon of each triangle; and the number of
        polygons that are fans only because nothing else fits.
    """
    sizes = np.asarray(sizes, np.int64)
    ends = np.cumsum(sizes)
    first = np.cumsum(sizes - 2) - (sizes - 2)
    owner = np.repeat(np.arange(len(sizes)), sizes - 2)
    step = np.arange(len(owner)) - first[owner]
    start = (ends - sizes)[owner]
    triangles = np.stack([start, start + step + 1, start + step + 2], axis=1)
    forced = 0
    turned = _turned(points, corners[triangles], owner, sizes)
    # A quad has only one other diagonal; there may be many of them.
    quads = turned[sizes[turned] == 4]
    other_fans = (ends - 4)[quads, None, None] + np.array([[1, 2, 3], [1, 3, 0]])
    places = np.repeat(np.arange(len(quads)), 2)
    worse = _turned(points, corners[other_fans.reshape(-1, 3)], places, sizes[quads])
    right = np.setdiff1d(np.arange(len(quads)), worse)
    triangles[first[quads[right]][:, None] + np.arange(2)] = other_fans[right]
    for polygon in np.setdiff1d(turned, quads[right]):
        begin, count = ends[polygon] - sizes[polygon], sizes[polygon]
        ears = _ears(points[corners[begin : begin + count]])
        if ears is None:
            forced += 1
        else:
            triangles[first[polygon] : first[polygon] + count - 2] = begin + ears
    _cut_alike(triangles, corners, sizes)
    return triangles, owner, forced


def _cut_alike(triangles: np.ndarray, corners: np.ndarray, sizes: np.ndarray) -> None:
    """Cut in place polygons that go around the corners of an earlier one, in either direction, as that one is.

    So the triangles on both sides of a double polygon are the same ones. Arguments are those of `cut`, and its result.
    """
    first = np.cumsum(sizes - 2) - (sizes - 2)
    begins = np.cumsum(sizes) - sizes
    for size in np.unique(sizes[sizes > 3]):
        polygons = np.flatnonzero(sizes == size)
        steps = np.arange(size)
        rings = corners[begins[polygons][:, None] + steps]
        # From the lowest corner on, towards the lower one of its neighbours.
        start = rings.argmin(axis=1)
        ahead, back = (np.take_along_axis(rings, (start[:, None] + way) % size, axis=1)[:, 0] for way in (1, -1))
        way = np.where(ahead < back, 1, -1)
        rings = np.take_along_axis(rings, (start[:, None] + way[:, None] * steps) % size, axis=1)
        with np.errstate(over="ignore"):  # Sums that differ, as they nearly always do, are quickly found to differ.
            sums = rings @ np.int64(0x9E3779B97F4A7C1) ** steps
        if len(np.unique(sums)) == len(sums):
            continue
        _, earliest, group = np.unique(rings, axis=0, return_index=True, return_inverse=True)
        model = earliest[group.reshape(-1)]
        distinct = (np.diff(np.sort(rings, axis=1), axis=1) > 0).all(axis=1)
        again = np.flatnonzero((model != np.arange(len(polygons))) & distinct)
        of = model[again]
        rows = np.arange(size - 2)
        theirs = triangles[first[polygons[of]][:, None] + rows] - begins[polygons[of]][:, None, None]
        turn = (way[again] * way[of])[:, None, None]
        ours = (start[again][:, None, None] + turn * (theirs - start[of][:, None, None])) % size
        ours = np.where(turn < 0, ours[:, :, ::-1], ours)
        triangles[first[polygons[again]][:, None] + rows] = ours + begins[polygons[again]][:, None, None]


def _turned(points: np.ndarray, triangles: np.ndarray, owner: np.ndarray, sizes: np.ndarray) -> np.ndarray:
    """Sorted indices of the polygons whose fan has a triangle that faces away from the polygon.

    Args:
        points: (V, 3).
        triangles: (T, 3) into `points`, all fans.
        owner: (T,), the polygon of each triangle.
        sizes: (F,), the number of corners of each polygon.
    """
    several = (sizes > 3)[owner]
    if not several.any():
        return np.zeros(0, np.int64)
    owner = owner[several]
    a, b, c = np.moveaxis(np.asarray(points, np.float64)[triangles[several]], 1, 0)
    with np.errstate(over="ignore", invalid="ignore"):
        normals = np.cross(b - a, c - a)
        # The normals of a fan add up to Newell's normal of the polygon.
        whole = np.stack([np.bincount(owner, n, len(sizes)) for n in normals.T], axis=1)
        away = (normals * whole[owner]).sum(axis=1) < -TOLERANCE * (whole * whole).sum(axis=1)[owner]
    return np.unique(owner[away])


def _ears(ring: np.ndarray) -> np.ndarray | None:
    """Triangles (n − 2, 3) int64, corners from 0 on, of one polygon of corners (n, 3); None if no triangles fit."""
    import mapbox_earcut

    size = np.abs(ring).max()
    ring = (ring - ring[0]) / (size if size > 0 else 1.0)
    normal = np.cross(ring, np.roll(ring, -1, axis=0)).sum(axis=0)
    # Across the axis that the normal is nearest to, so that areas keep their signs.
    axis = int(np.argmax(np.abs(normal)))
    flat = np.ascontiguousarray(ring[:, [(axis + 1) % 3, (axis + 2) % 3]] * [np.sign(normal[axis]), 1])
    ears = mapbox_earcut.triangulate_float64(flat, np.array([len(flat)], np.uint32)).reshape(-1, 3).astype(np.int64)
    if _areas(flat[ears]).sum() < 0:
        ears = ears[:, ::-1]
    ears = _with_slivers(ears, len(flat))
    # Where a polygon crosses itself, triangles overlap, or are too few.
    excess = np.abs(_areas(flat[ears])).sum() - abs(normal[axis]) / 2
    return ears if len(ears) == len(flat) - 2 and abs(excess) <= TOLERANCE * abs(normal[axis]) else None


def _areas(corners: np.ndarray) -> np.ndarray:
    """Signed areas of triangles (T, 3, 2)."""
    (x, y), (z, w) = (corners[:, 1] - corners[:, 0]).T, (corners[:, 2] - corners[:, 0]).T
    return (x * w - y * z) / 2


def _with_slivers(triangles: np.ndarray, count: int) -> np.ndarray:
    """The triangles of a polygon, and triangles without area for corners on a line that were left out.

    Around such corners, edges of the outline or of triangles have no partner. These edges make loops, which are filled.
    If they do not, the triangles stay as they are.

    Args:
        triangles: (T, 3), corners from 0 to `count` − 1.
        count: the number of corners of the polygon.
    """
    if len(triangles) == count - 2:
        return triangles
    rows = triangles.tolist()
    present = {edge for t in rows for edge in zip(t, t[1:] + t[:1], strict=True)}
    outline = {(i, (i + 1) % count) for i in range(count)}
    wanted = outline - present | {(b, a) for a, b in present - outline if (b, a) not in present}
    following: dict[int, list[int]] = {}
    for a, b in sorted(wanted):
        following.setdefault(a, []).append(b)
    while following:
        path = [next(iter(following))]
        while path[-1] not in path[:-1]:
            if path[-1] not in following:
                return triangles
            path.append(following[path[-1]].pop())
            if not following[path[-2]]:
                del following[path[-2]]
        loop = path[path.index(path[-1]) : -1]
        rows += [[loop[0], b, c] for b, c in zip(loop[1:], loop[2:], strict=False)]
        for a, b in zip(path, path[1 : path.index(path[-1]) + 1], strict=False):  # Not yet part of a loop.
            following.setdefault(a, []).append(b)
    return np.array(rows, np.int64)
