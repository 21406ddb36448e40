"""Packing fragments into samples, part by part, compiled."""

from __future__ import annotations

from typing import Any

import numpy as np

from rts.compiling.loops import compiled, loop
from rts.compiling.threads import LITTLE_WORK, TASKS_PER_THREAD, parallel, read_only, thread_count
from rts.contracts.records import Fragments


def pack(
    fragments: Fragments,
    kept: np.ndarray,
    table: np.ndarray,
    corner_params: np.ndarray | None,
    capacity: int = 0,
    starts: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Rows for some cells, part after part, and those of a part layer by layer.

    A part without cells has one row, in the middle of its first triangle; zeros if it has no triangles. Cells without a
    row have −1 and 0. They are those that are not taken, and those beyond the capacity.

    Args:
        fragments: (K, H, W), whose triangles are counted over all parts.
        kept: (K, H, W) bool, the fragments to take; all of them name triangles.
        table: (T, I) int32, ids of each triangle.
        corner_params: (T, 3, Q) float32, or None for the barycentrics themselves.
        capacity: rows to allot to a single part, zeros where they are not used; 0 for as many as are taken.
        starts: (P + 1,) int32, where the triangles of each part begin; None for one part.

    Returns:
        The number (P,) of cells of each part, ids (N, I), params (N, Q), and row and depth (K, H, W).
    """
    count, sizes = kept.size, [len(table)] if starts is None else starts[1:] - starts[:-1]
    part_of = np.empty(0, np.int32) if len(sizes) == 1 else np.repeat(np.arange(len(sizes), dtype=np.int32), sizes)
    # Each piece of the cells is counted, then packed, by itself: how many there are changes nothing.
    pieces = 1 if 8 * count < LITTLE_WORK else min(thread_count() * TASKS_PER_THREAD, count)
    bounds, ahead = count * np.arange(pieces + 1) // pieces, np.zeros((pieces, len(sizes)), np.int64)
    shares, depths = read_only(fragments.barycentrics, np.float32), read_only(fragments.depth, np.float32)
    cells = read_only(kept).reshape(-1), read_only(fragments.triangle_ids, np.int32).reshape(-1)
    parallel(_count, pieces, bounds, *cells, part_of, ahead, work=2 * count)
    counts = ahead.sum(axis=0)
    rows, width = np.maximum(counts, 1), 2 if corner_params is None else corner_params.shape[2]
    total = capacity or int(rows.sum())
    ahead = np.cumsum(ahead, axis=0) - ahead + np.cumsum(rows) - rows
    make = np.zeros if capacity or not len(table) else np.empty
    ids, params = make((total, table.shape[1]), np.int32), make((total, width), np.float32)
    for part in np.flatnonzero(counts == 0) if len(table) and not capacity else ():
        first = rows[:part].sum()
        ids[first], params[first] = middle_of(table, corner_params, 0 if starts is None else starts[part])
    row, depth = np.empty(kept.shape, np.int32), np.empty(kept.shape, np.float32)
    corners = np.empty((0, 3, 0), np.float32) if corner_params is None else read_only(corner_params, np.float32)
    arrays = *cells, shares.reshape(-1, 2), depths.reshape(-1), part_of, read_only(table, np.int32), corners
    parallel(_pack, pieces, bounds, ahead, *arrays, ids, params, row.reshape(-1), depth.reshape(-1), work=8 * count)
    return counts, ids, params, row, depth


def middle_of(table: np.ndarray, corner_params: np.ndarray | None, triangle: int) -> tuple[np.ndarray, Any]:
    """Ids (I,) and params (P,) of the middle of a triangle, for a row that no cell names, but shaders see."""
    return table[triangle], 1 / 3 if corner_params is None else corner_params[triangle].mean(axis=0)


def parts_of(triangles: np.ndarray, covered: np.ndarray, starts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The part (K, H, W) int32 of each cell, −1 where it is not covered, and the first cell (P,) of each part, or −1.

    Args:
        triangles: (K, H, W), counted over all parts.
        covered: (K, H, W) bool, the cells in which there is one.
        starts: (P + 1,) int32, where the triangles of each part begin.
    """
    if len(starts) == 2:
        at = int(covered.argmax())
        return covered.view(np.int8) - np.int32(1), np.array([at if covered.reshape(-1)[at] else -1])
    sizes = starts[1:] - starts[:-1]
    part_of = np.repeat(np.arange(len(sizes), dtype=np.int32), sizes)
    row, first = np.empty(covered.shape, np.int32), np.full(len(sizes), -1, np.int64)
    triangles, there = read_only(triangles, np.int32).reshape(-1), read_only(covered).reshape(-1)
    _parts_of(triangles, there, part_of, row.reshape(-1), first)
    return row, first


@loop
def _parts_of(triangles, there, part_of, row, first):
    """Fill `row` (M,) and `first` (P,), given as −1; see `parts_of`."""
    for m in range(len(row)):
        row[m] = part_of[triangles[m]] if there[m] else -1
        if there[m] and first[row[m]] < 0:
            first[row[m]] = m


@loop
def _count(start, stop, bounds, there, triangles, part_of, counts):
    """Add to rows [start, stop) of `counts` (pieces, P) the samples of each part in these pieces of the cells."""
    several = len(part_of) > 0
    for piece in range(start, stop):
        for m in range(bounds[piece], bounds[piece + 1]):
            if there[m]:
                counts[piece, part_of[triangles[m]] if several else 0] += 1


@compiled
def param_at(corners, t, i, a, b):
    """The parameter i of triangle t, of `corners` (T, 3, P), at the first two barycentrics."""
    c = corners[t, 2, i]
    return c + a * (corners[t, 0, i] - c) + b * (corners[t, 1, i] - c)


@loop
def _pack(
    start, stop, bounds, ahead, there, triangles, shares, depths, part_of, table, corners, ids, params, row, depth
):
    """Pack the samples of pieces [start, stop) of the cells; see `pack`. Those that find no row are left out.

    Args:
        start: the first piece.
        stop: the piece after the last.
        bounds: (pieces + 1,), where each begins.
        ahead: (pieces, P) the next row of each part; counted up.
        there: (M,) bool.
        triangles: (M,) int32.
        shares: (M, 2) barycentrics.
        depths: (M,).
        part_of: (T,) int32; no rows for a single part.
        table: (T, I).
        corners: (T, 3, Q), or no rows for the barycentrics.
        ids: (N, I) to fill.
        params: (N, Q) to fill.
        row: (M,) to fill.
        depth: (M,) to fill.
    """
    plain, several = len(corners) == 0, len(part_of) > 0
    for piece in range(start, stop):
        for m in range(bounds[piece], bounds[piece + 1]):
            row[m], depth[m] = -1, 0
            if not there[m]:
                continue
            t, a, b = triangles[m], shares[m, 0], shares[m, 1]
            part = part_of[t] if several else 0
            n = ahead[piece, part]
            if n >= len(ids):
                continue
            ahead[piece, part] = n + 1
            # A helper with all of these arrays takes seven times as long, for their references.
            for i in range(ids.shape[1]):
                ids[n, i] = table[t, i]
            if plain:
                params[n, 0], params[n, 1] = a, b
            else:
                for i in range(params.shape[1]):
                    params[n, i] = param_at(corners, t, i, a, b)
            row[m], depth[m] = n, depths[m]
