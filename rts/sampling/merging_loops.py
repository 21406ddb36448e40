"""Layers of several parts interleaved by depth, and emptied behind opaque ones, compiled."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rts.compiling.loops import compiled, loop
from rts.compiling.threads import parallel, read_only


def interleave(
    rows: Sequence[np.ndarray],
    depths: Sequence[np.ndarray],
    triangles: Sequence[np.ndarray],
    firsts: Sequence[int],
    layers: int,
) -> tuple[np.ndarray, ...]:
    """The nearest layers of several parts: row, counted over all parts, and depth, (K, H, W); −1 and 0 where empty.

    If parts have triangles, those of the merged layers are a third result.

    Args:
        rows: `row` of each part, (L, H, W) int32, front to back.
        depths: depths of each part, (L, H, W).
        triangles: triangles of each part, (L, H, W) int32; or empty.
        firsts: the first row of each part.
        layers: K; fewer layers are returned if all parts together have fewer.
    """
    (_, height, width), kind = rows[0].shape, np.result_type(*depths)
    shape = (min(layers, sum(r.shape[0] for r in rows)), height, width)
    row, depth = np.full(shape, -1, np.int32), np.zeros(shape, kind)
    triangle = np.full(shape if triangles else (0, height, width), -1, np.int32)
    for part_row, part_depth, first, part_triangle in zip(
        rows, depths, firsts, triangles or [r[:0] for r in rows], strict=True
    ):
        arrays = read_only(part_row, np.int32), read_only(part_depth, kind), read_only(part_triangle, np.int32)
        parallel(_insert, height, *arrays, first, row, depth, triangle, work=3 * part_row.size)
    return (row, depth, triangle) if triangles else (row, depth)


@loop
def _insert(start, stop, part_row, part_depth, part_triangle, first, row, depth, triangle):
    """Insert a part into lines [start, stop) of the layers of the parts before it.

    Args:
        start: first line.
        stop: end of the lines.
        part_row: (L, H, W), of the part.
        part_depth: (L, H, W).
        part_triangle: (L, H, W) int32; no layers if triangles are not told.
        first: the part's first row.
        row: (K, H, W) int32, counted over all parts; −1 in empty layers, which are the last ones.
        depth: (K, H, W).
        triangle: (K, H, W) int32; no layers if triangles are not told.
    """
    for y in range(start, stop):
        for x in range(row.shape[2]):
            k = 0
            for layer in range(len(part_row)):
                if part_row[layer, y, x] >= 0:
                    t = part_triangle[layer, y, x] if len(part_triangle) > 0 else -1
                    k = 1 + _put(
                        first + part_row[layer, y, x], part_depth[layer, y, x], t, y, x, k, row, depth, triangle
                    )


@compiled
def _put(index, z, t, y, x, k, row, depth, triangle):
    """Put a sample into a cell, behind all that are not deeper, from layer k on; returns its layer, or the last."""
    layers = len(row)
    while k < layers and row[k, y, x] >= 0 and not z < depth[k, y, x]:
        k += 1
    if k == layers:
        return k - 1
    for n in range(layers - 1, k, -1):
        row[n, y, x], depth[n, y, x] = row[n - 1, y, x], depth[n - 1, y, x]
        if len(triangle) > 0:
            triangle[n, y, x] = triangle[n - 1, y, x]
    row[k, y, x], depth[k, y, x] = index, z
    if len(triangle) > 0:
        triangle[k, y, x] = t
    return k


@loop
def insert_fragments(start, stop, more, more_shares, more_depths, triangles, shares, depths):
    """Insert fragments into lines [start, stop) of others, by depth, and of equal ones by triangle.

    Args:
        start: first line.
        stop: end of the lines.
        more: (K, H, W) int32, the triangles to insert, front to back; −1 for none.
        more_shares: (K, H, W, 2) float32.
        more_depths: (K, H, W) float32.
        triangles: (K, H, W) int32, those to insert them into; −1 in empty layers, which are the last ones.
        shares: (K, H, W, 2) float32.
        depths: (K, H, W) float32.
    """
    layers = len(triangles)
    for y in range(start, stop):
        for x in range(triangles.shape[2]):
            k = 0
            for n in range(layers):
                t, z = more[n, y, x], more_depths[n, y, x]
                if t < 0:
                    break
                while k < layers and 0 <= triangles[k, y, x] and (depths[k, y, x], triangles[k, y, x]) < (z, t):
                    k += 1
                if k == layers:
                    break
                for m in range(layers - 1, k, -1):
                    triangles[m, y, x], depths[m, y, x] = triangles[m - 1, y, x], depths[m - 1, y, x]
                    shares[m, y, x, 0], shares[m, y, x, 1] = shares[m - 1, y, x, 0], shares[m - 1, y, x, 1]
                triangles[k, y, x], depths[k, y, x] = t, z
                shares[k, y, x, 0], shares[k, y, x, 1] = more_shares[n, y, x, 0], more_shares[n, y, x, 1]
                k += 1
