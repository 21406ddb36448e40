"""Layers of several parts interleaved by depth, compiled."""

from __future__ import annotations

import numpy as np

from rts.compiling import compiled, kernel
from rts.threads import parallel


def interleave(
    rows: tuple[np.ndarray, ...],
    depths: tuple[np.ndarray, ...],
    facing: tuple[np.ndarray, ...],
    layers: int,
    more: int,
) -> tuple[np.ndarray, ...]:
    """The nearest layers of several parts: part and row within it, −1 where empty, and depth, (K, H, W) each.

    With them, where it is told, which piece faces the viewer in each cell.

    Args:
        rows: `row` of each part, (L, H, W) int32, front to back.
        depths: depths of each part, (L, H, W).
        facing: `facing` of each part, (L, H, W) int16; or none.
        layers: K.
        more: `rts.records.MORE`.
    """
    count, (_, height, width) = len(rows), rows[0].shape
    deepest = max(r.shape[0] for r in rows)
    row = np.full((count, deepest, height, width), -1, np.int32)
    depth = np.zeros(row.shape, np.result_type(*depths))
    told = np.zeros(row.shape if facing else (0, deepest, height, width), np.int16)
    for i, (r, d) in enumerate(zip(rows, depths, strict=True)):
        row[i, : len(r)], depth[i, : len(d)] = r, d
    for i, f in enumerate(facing):
        told[i, : len(f)] = f
    shape = (min(layers, sum(r.shape[0] for r in rows)), height, width)
    found = np.empty(shape, np.int32), np.empty(shape, np.int32), np.empty(shape, depth.dtype)
    merged = np.zeros(shape if facing else (0, height, width), np.int16)
    parallel(_interleave, height, row, depth, told, more, *found, merged)
    return (*found, merged) if facing else found


@kernel
def _interleave(start, stop, row, depth, facing, more, part, merged, merged_depth, merged_facing):
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
                    if len(facing) > 0:
                        merged_facing[k, y, x] = _of_part(facing[nearest, at[nearest], y, x], nearest, count, more)
                    at[nearest] += 1
            last = len(part) - 1
            if len(facing) > 0 and 0 < abs(merged_facing[last, y, x]) < more:
                merged_facing[last, y, x] += more if merged_facing[last, y, x] > 0 else -more


@compiled
def _of_part(facing, part, count, more):
    """The number of a part's piece among those of all parts; 0 where it would be too large."""
    size = abs(np.int64(facing))
    beyond = more if size >= more else 0
    number = (size - beyond) * count + part
    if size == 0 or number >= more:
        return 0
    return number + beyond if facing > 0 else -number - beyond
