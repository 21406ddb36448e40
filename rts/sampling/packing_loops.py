"""Packing fragments into samples, compiled."""

from __future__ import annotations

from typing import Any

import numpy as np

from rts.compiling.loops import compiled, loop
from rts.compiling.threads import parallel
from rts.contracts.records import Fragments


def pack(
    fragments: Fragments,
    kept: np.ndarray,
    table: np.ndarray,
    corner_params: np.ndarray | None,
    capacity: int,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, int]:
    """Ids (N, I), params (N, P), row and depth (K, H, W) of some cells, layer by layer; and the number of these cells.

    Cells without a row have −1 and 0. They are those that are not taken, and those beyond the capacity.

    Args:
        fragments: the fragments of all layers.
        kept: (K, H, W) bool, the fragments to take; all of them name triangles.
        table: (T, I) int32, ids of each triangle.
        corner_params: (T, 3, P) float32, or None for the barycentrics themselves.
        capacity: rows to allot, or 0 for as many as are taken; for none, one in the middle of the first triangle.
    """
    (layers, height, width), lines = kept.shape, kept.shape[0] * kept.shape[1]
    taken, counts = np.ascontiguousarray(kept).reshape(lines, width), np.zeros(lines, np.int64)
    parallel(_count, lines, taken, counts, work=kept.size // 8)
    total = int(counts.sum())
    rows = capacity or max(1, total)
    make = np.zeros if rows > total else np.empty
    ids = make((rows, table.shape[1]), np.int32)
    params = make((rows, 2 if corner_params is None else corner_params.shape[2]), np.float32)
    # Without corner parameters, the barycentrics themselves are taken.
    corners = np.empty((0, 3, 0), np.float32) if corner_params is None else corner_params
    row, depth = np.empty((lines, width), np.int32), np.empty((lines, width), np.float32)
    dtypes = np.int32, np.float32, np.float32
    of_lines = [
        np.ascontiguousarray(x, dtype).reshape(lines, width, *x.shape[3:])
        for x, dtype in zip(fragments, dtypes, strict=True)
    ]
    arrays = taken, *of_lines, table, corners, np.cumsum(counts) - counts, ids, params, row, depth
    parallel(_pack, lines, *arrays, work=2 * row.size)
    if not total and not capacity and len(table):
        ids[0], params[0] = middle_of(table, corner_params, 0)
    return ids, params, row.reshape(layers, height, width), depth.reshape(layers, height, width), total


def middle_of(table: np.ndarray, corner_params: np.ndarray | None, triangle: int) -> tuple[np.ndarray, Any]:
    """Ids (I,) and params (P,) of the middle of a triangle, for a row that no cell names, but shaders see."""
    return table[triangle], 1 / 3 if corner_params is None else corner_params[triangle].mean(axis=0)


@loop
def _count(start, stop, kept, counts):
    """Write to `counts` (L,) the number of True entries in each of the lines [start, stop) of `kept` (L, W)."""
    for y in range(start, stop):
        count = 0
        for x in range(kept.shape[1]):
            count += kept[y, x]
        counts[y] = count


@compiled
def param_at(corners, t, i, a, b):
    """The parameter i of triangle t, of `corners` (T, 3, P), at the first two barycentrics."""
    c = corners[t, 2, i]
    return c + a * (corners[t, 0, i] - c) + b * (corners[t, 1, i] - c)


@loop
def _pack(start, stop, kept, triangle_ids, barycentrics, depths, table, corners, offsets, ids, params, row, depth):
    """Pack the kept fragments of lines [start, stop), of L lines of cells, layer by layer.

    Args:
        start: first line.
        stop: end of the lines.
        kept: (L, W) bool.
        triangle_ids: (L, W).
        barycentrics: (L, W, 2).
        depths: (L, W).
        table: (T, I) int32, ids of each triangle.
        corners: (T, 3, P) float32; no rows for the barycentrics themselves.
        offsets: (L,), the first row of each line.
        ids: (N, I) int32. Rows from a line's offset on are written; fragments that find none are left out.
        params: (N, P) float32, likewise.
        row: (L, W) int32, to be filled; −1 for cells without a row.
        depth: (L, W) float32, to be filled; 0 for cells without a row.
    """
    plain = len(corners) == 0
    for y in range(start, stop):
        n = offsets[y]
        for x in range(kept.shape[1]):
            if not kept[y, x] or n >= len(ids):
                row[y, x], depth[y, x] = -1, 0
                continue
            t, a, b = triangle_ids[y, x], barycentrics[y, x, 0], barycentrics[y, x, 1]
            # As in `joint_loops`: a helper with all of these arrays takes seven times as long, for their references.
            for i in range(ids.shape[1]):
                ids[n, i] = table[t, i]
            if plain:
                params[n, 0], params[n, 1] = a, b
            else:
                for i in range(params.shape[1]):
                    params[n, i] = param_at(corners, t, i, a, b)
            row[y, x], depth[y, x] = n, depths[y, x]
            n += 1
