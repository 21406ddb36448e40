"""Packing fragments into samples, compiled."""

from __future__ import annotations

import numpy as np

from rts.compiling import kernel
from rts.records import Fragments
from rts.threads import parallel


def pack(
    fragments: Fragments, kept: np.ndarray, table: np.ndarray, corner_params: np.ndarray | None, capacity: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, int]:
    """Ids (N, I), params (N, P), row and depth (K, H, W) of some cells, layer by layer; and how many there are in all.

    Args:
        fragments: what was sampled.
        kept: (K, H, W) bool, which of them to take; covered ones.
        table: (T, I) int32, ids of each triangle.
        corner_params: (T, 3, P) float32, or None for the barycentrics themselves.
        capacity: rows to allot, or 0 for as many as are covered, at least one.
    """
    layers, height, width = kept.shape
    lines = layers * height
    triangle_ids = np.ascontiguousarray(fragments.triangle_ids, np.int32).reshape(lines, width)
    barycentrics = np.ascontiguousarray(fragments.barycentrics, np.float32).reshape(lines, width, 2)
    depths = np.ascontiguousarray(fragments.depth, np.float32).reshape(lines, width)
    kept = np.ascontiguousarray(kept).reshape(lines, width)
    counts = np.zeros(lines, np.int64)
    parallel(_count, lines, kept, counts, work=kept.size // 8)
    offsets = np.cumsum(counts) - counts
    total = int(counts.sum())
    rows = capacity or max(1, total)
    make = np.zeros if rows > total else np.empty
    ids = make((rows, table.shape[1]), np.int32)
    params = make((rows, 2 if corner_params is None else corner_params.shape[2]), np.float32)
    row, depth = np.empty((lines, width), np.int32), np.empty((lines, width), np.float32)
    # Without any, the barycentrics themselves are taken.
    corners = np.empty((0, 3, 0), np.float32) if corner_params is None else corner_params
    given = kept, triangle_ids, barycentrics, depths, table, corners, offsets
    parallel(_pack, lines, *given, ids, params, row, depth, work=2 * kept.size)
    shape = layers, height, width
    return ids, params, row.reshape(shape), depth.reshape(shape), total


@kernel
def _count(start, stop, kept, counts):
    for y in range(start, stop):
        count = 0
        for x in range(kept.shape[1]):
            count += kept[y, x]
        counts[y] = count


@kernel
def _pack(start, stop, kept, triangle_ids, barycentrics, depths, table, corners, offsets, ids, params, row, depth):
    for y in range(start, stop):
        n = offsets[y]
        for x in range(kept.shape[1]):
            if not kept[y, x] or n >= len(ids):
                row[y, x], depth[y, x] = -1, 0
                continue
            t, a, b = triangle_ids[y, x], barycentrics[y, x, 0], barycentrics[y, x, 1]
            for i in range(ids.shape[1]):
                ids[n, i] = table[t, i]
            if len(corners) == 0:
                params[n, 0], params[n, 1] = a, b
            else:
                for i in range(params.shape[1]):
                    c = corners[t, 2, i]
                    params[n, i] = c + a * (corners[t, 0, i] - c) + b * (corners[t, 1, i] - c)
            row[y, x], depth[y, x] = n, depths[y, x]
            n += 1
