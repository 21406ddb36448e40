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


def looked_up(row: np.ndarray, table: np.ndarray) -> np.ndarray:
    """The entry of a table (N,) int32 for each cell of `row` (K, H, W) int32; −1 where that is −1."""
    found = np.empty(row.size, np.int32)
    parallel(_look_up, row.size, read_only(row, np.int32).reshape(-1), read_only(table, np.int32), found, work=row.size)
    return found.reshape(row.shape)


@loop
def _look_up(start, stop, row, table, found):
    """`looked_up`, of some cells."""
    for i in range(start, stop):
        found[i] = table[np.uint32(row[i])] if row[i] >= 0 else -1


def seen_along_rays(row: np.ndarray, blocks: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The samples (K, H, W) that rays meet before they end, and the rows (N,) that these have; both bool.

    Args:
        row: (K, H, W), front to back, or −1.
        blocks: (N,) bool, whether rays end at a sample.
    """
    seen, used = np.empty(row.shape, np.bool_), np.zeros(len(blocks), np.bool_)
    parallel(_look, row.shape[1], read_only(row, np.int32), read_only(blocks), seen, used, work=3 * row.size)
    return seen, used


@loop
def _look(start, stop, row, blocks, seen, used):
    """Fill lines of `seen`, and mark rows as `used`."""
    for y in range(start, stop):
        for x in range(row.shape[2]):
            goes_on = True
            for k in range(len(row)):
                n = row[k, y, x]
                seen[k, y, x] = goes_on and n >= 0
                if seen[k, y, x]:
                    used[n], goes_on = True, not blocks[n]


def keep(seen: np.ndarray, place: np.ndarray, row: np.ndarray, depth: np.ndarray, triangle: np.ndarray) -> None:
    """Empty the cells whose sample is not seen, and renumber the other rows; all but `seen` and `place` are changed.

    Args:
        seen: (K, H, W) bool.
        place: (N,) int32, the new index of each row.
        row: (K, H, W) int32, or −1.
        depth: (K, H, W) of the samples; 0 where there is none.
        triangle: (K, H, W) int32, likewise, −1 where there is none; or (0, H, W).
    """
    parallel(_keep, row.shape[1], seen, read_only(place), row, depth, triangle, work=4 * row.size)


@loop
def _keep(start, stop, seen, place, row, depth, triangle):
    """`keep`, of some lines."""
    for k in range(len(row)):
        for y in range(start, stop):
            for x in range(row.shape[2]):
                there = seen[k, y, x]
                row[k, y, x] = place[row[k, y, x]] if there else -1
                depth[k, y, x] = depth[k, y, x] if there else 0
            for x in range(row.shape[2] if len(triangle) else 0):
                triangle[k, y, x] = triangle[k, y, x] if seen[k, y, x] else -1
