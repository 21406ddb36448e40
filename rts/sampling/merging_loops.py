"""Layers of several parts interleaved by depth, compiled."""

from __future__ import annotations

import numpy as np

from rts.compiling.loops import compiled, loop
from rts.compiling.threads import parallel, read_only


def interleave(
    rows: tuple[np.ndarray, ...], depths: tuple[np.ndarray, ...], triangles: tuple[np.ndarray, ...], layers: int
) -> tuple[np.ndarray, ...]:
    """The nearest layers of several parts: part, row within it, and depth, (K, H, W) each; −1, −1 and 0 where empty.

    If parts have triangles, those of the merged layers are a fourth result.

    Args:
        rows: `row` of each part, (L, H, W) int32, front to back.
        depths: depths of each part, (L, H, W).
        triangles: triangles of each part, (L, H, W) int32; or empty.
        layers: K; fewer layers are returned if all parts together have fewer.
    """
    (_, height, width), kind = rows[0].shape, np.result_type(*depths)
    shape = (min(layers, sum(r.shape[0] for r in rows)), height, width)
    told = shape if triangles else (0, height, width)
    of_parts = triangles or [r[:0] for r in rows]
    given = [
        (read_only(r, np.int32), read_only(d, kind), read_only(t, np.int32))
        for r, d, t in zip(rows, depths, of_parts, strict=True)
    ]
    # One part after the other: earlier parts are merged already.
    before: tuple[np.ndarray, ...] = (np.empty((0, height, width), np.int32), *given[0])
    given += [tuple(x[:0] for x in given[0])] * (len(rows) == 1)  # A single part is merged with no layers.
    for number, own in enumerate(given[1:], start=1):
        merged = *(np.empty(shape, dtype) for dtype in (np.int32, np.int32, kind)), np.empty(told, np.int32)
        parallel(_merge, height, *map(read_only, before), *own, number, *merged, work=4 * merged[0].size)
        before = merged
    return before if triangles else before[:3]


@loop
def _merge(
    start,
    stop,
    part,
    row,
    depth,
    triangle,
    own_row,
    own_depth,
    own_triangle,
    number,
    merged_part,
    merged_row,
    merged_depth,
    merged_triangle,
):
    """Fill lines [start, stop) of `merged_*` (K, H, W) with a part and the parts before it, which are merged already.

    Args:
        start: first line.
        stop: end of the lines.
        part: (L, H, W) int32, of the parts before; no layers if part 0 alone came before.
        row: (L, H, W) int32, within its part, or −1.
        depth: (L, H, W) float.
        triangle: (L, H, W) int32; no layers if triangles are not told, and then none have any.
        own_row: (M, H, W), of the part to merge.
        own_depth: (M, H, W).
        own_triangle: (M, H, W).
        number: the part to merge, counted from 0.
        merged_part: to be filled; −1 in empty layers.
        merged_row: to be filled; −1 in empty layers.
        merged_depth: to be filled; 0 in empty layers.
        merged_triangle: to be filled; −1 in empty layers.
    """
    for y in range(start, stop):
        for x in range(row.shape[2]):
            known, own = (part[:, y, x], row[:, y, x], depth[:, y, x], triangle[:, y, x]), own_row[:, y, x]
            made = merged_part[:, y, x], merged_row[:, y, x], merged_depth[:, y, x], merged_triangle[:, y, x]
            _merge_cell(known, own, own_depth[:, y, x], own_triangle[:, y, x], number, made)


@compiled
def _merge_cell(known, own_row, own_depth, own_triangle, number, made):
    """`_merge` of one cell: `known` are the arrays of the parts before, and `made` those to be filled."""
    part, row, depth, triangle = known
    merged_part, merged_row, merged_depth, merged_triangle = made
    before, deepest, tells, a, b = len(row), len(own_row), len(merged_triangle) > 0, 0, 0
    for k in range(len(merged_part)):
        while a < before and row[a] < 0:
            a += 1
        while b < deepest and own_row[b] < 0:
            b += 1
        told = -1
        if b < deepest and (a == before or own_depth[b] < depth[a]):
            merged_part[k], merged_row[k], merged_depth[k] = number, own_row[b], own_depth[b]
            if tells:
                told = own_triangle[b]
            b += 1
        elif a < before:
            merged_part[k] = part[a] if len(part) > 0 else 0
            merged_row[k], merged_depth[k] = row[a], depth[a]
            if tells:
                told = triangle[a]
            a += 1
        else:
            merged_part[k] = merged_row[k] = -1
            merged_depth[k] = 0
        if tells:
            merged_triangle[k] = told
