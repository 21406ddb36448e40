"""Layers of several parts interleaved by depth, compiled."""

from __future__ import annotations

import numpy as np

from rts.compiling.loops import compiled, loop
from rts.compiling.threads import parallel, read_only


def interleave(
    rows: tuple[np.ndarray, ...],
    depths: tuple[np.ndarray, ...],
    facing: tuple[np.ndarray, ...],
    layers: int,
    more: int,
) -> tuple[np.ndarray, ...]:
    """The nearest layers of several parts: part, row within it, and depth, (K, H, W) each; −1, −1 and 0 where empty.

    If parts have `facing`, that of the merged layers is a fourth result, its pieces numbered among those of all parts.

    Args:
        rows: `row` of each part, (L, H, W) int32, front to back.
        depths: depths of each part, (L, H, W).
        facing: `facing` of each part, (L, H, W) int16; or empty.
        layers: K; fewer layers are returned if all parts together have fewer.
        more: `Cells.MORE_BEHIND`.
    """
    (_, height, width), kind = rows[0].shape, np.result_type(*depths)
    shape = (min(layers, sum(r.shape[0] for r in rows)), height, width)
    told = shape if facing else (0, height, width)
    given = [
        (read_only(r, np.int32), read_only(d, kind), read_only(facing[i] if facing else r[:0], np.int16))
        for i, (r, d) in enumerate(zip(rows, depths, strict=True))
    ]
    # One part after the other: earlier parts are merged already.
    before: tuple[np.ndarray, ...] = (np.empty((0, height, width), np.int32), *given[0])
    given += [tuple(x[:0] for x in given[0])] * (len(rows) == 1)  # A single part is merged with no layers.
    for number, own in enumerate(given[1:], start=1):
        merged = *(np.empty(shape, dtype) for dtype in (np.int32, np.int32, kind)), np.empty(told, np.int16)
        numbers = number, len(rows), more
        parallel(_merge, height, *map(read_only, before), *own, *numbers, *merged, work=4 * merged[0].size)
        before = merged
    return before if facing else before[:3]


@loop
def _merge(
    start,
    stop,
    part,
    row,
    depth,
    facing,
    own_row,
    own_depth,
    own_facing,
    number,
    count,
    more,
    merged_part,
    merged_row,
    merged_depth,
    merged_facing,
):
    """Fill lines [start, stop) of `merged_*` (K, H, W) with a part and the parts before it, which are merged already.

    Args:
        start: first line.
        stop: end of the lines.
        part: (L, H, W) int32, of the parts before; no layers if part 0 alone came before.
        row: (L, H, W) int32, within its part, or −1.
        depth: (L, H, W) float.
        facing: (L, H, W) int16; no layers if sides are not recorded, and then all facings have none.
        own_row: (M, H, W), of the part to merge.
        own_depth: (M, H, W).
        own_facing: (M, H, W), its pieces as the part numbers them.
        number: the part to merge, counted from 0.
        count: number of parts. With the last one, `more` is added where layer K − 1 has a piece.
        more: `Cells.MORE_BEHIND`.
        merged_part: to be filled; −1 in empty layers.
        merged_row: to be filled; −1 in empty layers.
        merged_depth: to be filled; 0 in empty layers.
        merged_facing: to be filled; 0 in empty layers.
    """
    before, deepest, layers, tells = len(row), len(own_row), len(merged_part), len(facing) > 0
    for y in range(start, stop):
        for x in range(row.shape[2]):
            a = b = 0
            for k in range(layers):
                while a < before and row[a, y, x] < 0:
                    a += 1
                while b < deepest and own_row[b, y, x] < 0:
                    b += 1
                if b < deepest and (a == before or own_depth[b, y, x] < depth[a, y, x]):
                    merged_part[k, y, x], merged_row[k, y, x] = number, own_row[b, y, x]
                    merged_depth[k, y, x] = own_depth[b, y, x]
                    told = _of_part(own_facing[b, y, x], number, count, more) if tells else 0
                    b += 1
                elif a < before:
                    merged_part[k, y, x] = part[a, y, x] if len(part) > 0 else 0
                    merged_row[k, y, x], merged_depth[k, y, x] = row[a, y, x], depth[a, y, x]
                    known = np.int64(facing[a, y, x]) if tells else 0
                    told = known if len(part) > 0 else _of_part(known, 0, count, more)
                    a += 1
                else:
                    merged_part[k, y, x] = merged_row[k, y, x] = -1
                    merged_depth[k, y, x] = told = 0
                if tells:
                    merged_facing[k, y, x] = told
            if tells and number >= count - 1:
                told = merged_facing[layers - 1, y, x]
                if 0 < abs(told) < more:
                    merged_facing[layers - 1, y, x] = told + more if told > 0 else told - more


@compiled
def _of_part(facing, part, count, more):
    """`Cells.facing` with the part's piece numbered among those of all parts; 0 if the number would be too large."""
    size = abs(np.int64(facing))
    beyond = more if size >= more else 0
    number = (size - beyond) * count + part
    if size == 0 or number >= more:
        return 0
    return number + beyond if facing > 0 else -number - beyond
