"""Layers of each cell sorted, equal ones merged and gaps closed, compiled."""

from __future__ import annotations

import numba


@numba.njit(cache=True, nogil=True)
def settle_lines(start, stop, row, depth, limits, out_row, out_depth):
    """See `rts.sampling.settling.settle`; for lines `start` to `stop` of the image.

    Args:
        start: the first line.
        stop: the line after the last.
        row: (K, H, W) int32.
        depth: (K, H, W) float32.
        limits: (4,) depths of the near and far plane; and by how much the depths of two roots differ at least, the
            second number in units of the depth.
        out_row: (K, H, W), to be filled.
        out_depth: (K, H, W), to be filled.
    """
    layers, _, width = row.shape
    near, far, apart, apart_by_depth = limits
    for y in range(start, stop):
        for x in range(width):
            count = 0
            for k in range(layers):
                i, z = row[k, y, x], depth[k, y, x]
                if i < 0 or z < near or z > far:
                    continue
                at = count
                while at > 0 and out_depth[at - 1, y, x] > z:
                    out_depth[at, y, x], out_row[at, y, x] = out_depth[at - 1, y, x], out_row[at - 1, y, x]
                    at -= 1
                out_depth[at, y, x], out_row[at, y, x] = z, i
                count += 1
            kept = 0
            for k in range(count):
                z = out_depth[k, y, x]
                if kept == 0 or z - out_depth[kept - 1, y, x] > apart + apart_by_depth * abs(z):
                    out_depth[kept, y, x], out_row[kept, y, x] = z, out_row[k, y, x]
                    kept += 1
            for k in range(kept, layers):
                out_depth[k, y, x], out_row[k, y, x] = 0, -1
