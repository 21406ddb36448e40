"""Layers of several parts interleaved by depth, compiled."""

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


def seen_along_rays(row: np.ndarray, blocks: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Which samples (K, H, W) rays meet before they end, and which rows (N,) these are.

    Args:
        row: (K, H, W), front to back, or −1.
        blocks: (N,) bool, whether rays end at a sample.
    """
    reached, used = np.empty(row.shape, np.bool_), np.zeros(len(blocks), np.bool_)
    parallel(_reach, row.shape[1], read_only(row, np.int32), read_only(blocks), reached, used, work=3 * row.size)
    return reached, used


@loop
def _reach(start, stop, row, blocks, reached, used):
    """Fill lines of `reached`, and mark rows as `used`."""
    for y in range(start, stop):
        for x in range(row.shape[2]):
            lit = True
            for k in range(len(row)):
                n = row[k, y, x]
                reached[k, y, x] = lit and n >= 0
                if reached[k, y, x]:
                    used[n], lit = True, not blocks[n]


def kept(
    reached: np.ndarray, place: np.ndarray, row: np.ndarray, depth: np.ndarray, triangle: np.ndarray | None
) -> tuple[np.ndarray, ...]:
    """New rows, depths and, if there are any, triangles of the samples in cells: −1, 0 and −1 in those to be emptied.

    Args:
        reached: (K, H, W) bool, the cells that keep their sample.
        place: (N,) int32, the new index of each row.
        row: (K, H, W), the old rows.
        depth: (K, H, W), their depths.
        triangle: (K, H, W), their triangles; or None.
    """
    triangles = np.empty((0, *row.shape[1:]), np.int32) if triangle is None else triangle
    known = read_only(row, np.int32), read_only(depth), read_only(triangles, np.int32)
    results = np.empty(row.shape, np.int32), np.empty(row.shape, depth.dtype), np.empty(triangles.shape, np.int32)
    parallel(_keep, row.shape[1], reached, read_only(place), *known, *results, work=4 * row.size)
    return results if triangle is not None else results[:2]


@loop
def _keep(start, stop, reached, place, row, depth, triangle, to_row, to_depth, to_triangle):
    """Fill lines of the results of `kept`."""
    for k in range(len(row)):
        for y in range(start, stop):
            for x in range(row.shape[2]):
                there = reached[k, y, x]
                to_row[k, y, x] = place[row[k, y, x]] if there else -1
                to_depth[k, y, x] = depth[k, y, x] if there else 0
            for x in range(row.shape[2] if len(triangle) else 0):
                to_triangle[k, y, x] = triangle[k, y, x] if reached[k, y, x] else -1
