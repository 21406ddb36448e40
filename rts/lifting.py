"""Packing fragments into samples, compiled. Imported when first needed, since it imports numba."""

from __future__ import annotations

import numba
import numpy as np

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


@numba.njit(cache=True, nogil=True)
def _count(start, stop, kept, counts):
    for y in range(start, stop):
        count = 0
        for x in range(kept.shape[1]):
            count += kept[y, x]
        counts[y] = count


@numba.njit(cache=True, nogil=True)
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


def interleave(rows: tuple[np.ndarray, ...], depths: tuple[np.ndarray, ...], layers: int) -> tuple[np.ndarray, ...]:
    """The nearest layers of several parts: part and row within it, −1 where empty, and depth, (K, H, W) each.

    Args:
        rows: of each part (L, H, W) int32, front to back.
        depths: of each part (L, H, W).
        layers: K.
    """
    count, (_, height, width) = len(rows), rows[0].shape
    deepest = max(r.shape[0] for r in rows)
    row = np.full((count, deepest, height, width), -1, np.int32)
    depth = np.zeros(row.shape, np.result_type(*depths))
    for i, (r, d) in enumerate(zip(rows, depths, strict=True)):
        row[i, : len(r)], depth[i, : len(d)] = r, d
    shape = (min(layers, sum(r.shape[0] for r in rows)), height, width)
    found = np.empty(shape, np.int32), np.empty(shape, np.int32), np.empty(shape, depth.dtype)
    parallel(_interleave, height, row, depth, *found)
    return found


@numba.njit(cache=True, nogil=True)
def _interleave(start, stop, row, depth, part, merged, merged_depth):
    count, deepest, _, width = row.shape
    at = np.empty(count, np.int64)
    for y in range(start, stop):
        for x in range(width):
            at[:] = 0
            for k in range(len(part)):
                nearest, best = -1, depth.dtype.type(0)
                for i in range(count):
                    while at[i] < deepest and row[i, at[i], y, x] < 0:
                        at[i] += 1
                    if at[i] < deepest and (nearest < 0 or depth[i, at[i], y, x] < best):
                        nearest, best = i, depth[i, at[i], y, x]
                if nearest < 0:
                    part[k, y, x], merged[k, y, x], merged_depth[k, y, x] = -1, -1, 0
                else:
                    part[k, y, x], merged[k, y, x] = nearest, row[nearest, at[nearest], y, x]
                    merged_depth[k, y, x] = best
                    at[nearest] += 1
