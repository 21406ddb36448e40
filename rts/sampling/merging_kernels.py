"""Layers of several parts interleaved by depth, compiled."""

from __future__ import annotations

import numpy as np

from rts.compiling import kernel
from rts.threads import parallel


def interleave(rows: tuple[np.ndarray, ...], depths: tuple[np.ndarray, ...], layers: int) -> tuple[np.ndarray, ...]:
    """The nearest layers of several parts: part and row within it, −1 where empty, and depth, (K, H, W) each.

    Args:
        rows: `row` of each part, (L, H, W) int32, front to back.
        depths: depths of each part, (L, H, W).
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


@kernel
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
