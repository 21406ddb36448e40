"""Samples of joined parts packed part by part, compiled."""

from __future__ import annotations

import numpy as np

from rts.compiling.loops import loop
from rts.compiling.threads import TASKS_PER_THREAD, parallel, read_only, thread_count
from rts.contracts.records import Fragments
from rts.sampling.packing_loops import middle_of, param_at


def packed_by_part(
    fragments: Fragments, covered: np.ndarray, starts: np.ndarray, table: np.ndarray, corner_params: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """The samples of fragments as `packing.pack_fragments` makes them, but part after part.

    Args:
        fragments: (K, H, W), whose triangles are counted over all parts.
        covered: (K, H, W) bool, the cells in which there is one.
        starts: (P + 1,) int32, where the triangles of each part begin.
        table: (T, I) int32, ids of each triangle.
        corner_params: (T, 3, Q) float32, or None for the barycentrics themselves.

    Returns:
        The number (P,) of samples of each part; ids (N, I) and params (N, Q), with a row for each part that has none,
        in the middle of its first triangle; the cells' rows and depths (K, H, W), −1 and 0 where they have none.
    """
    sizes, count = np.diff(starts), covered.size
    part_of = np.repeat(np.arange(len(sizes), dtype=np.int32), sizes)
    # Each piece of the cells is counted, then packed, by itself: how many there are changes nothing.
    pieces = min(max(1, thread_count() * TASKS_PER_THREAD), max(1, count))
    bounds = np.linspace(0, count, pieces + 1).astype(np.int64)
    triangles, there = read_only(fragments.triangle_ids, np.int32).reshape(-1), read_only(covered).reshape(-1)
    ahead = np.zeros((pieces, len(sizes)), np.int64)
    parallel(_count, pieces, bounds, there, triangles, part_of, ahead, work=2 * count)
    counts = ahead.sum(axis=0)
    rows = np.maximum(counts, 1)
    ahead = np.cumsum(ahead, axis=0) - ahead + np.cumsum(rows) - rows
    corners = np.empty((0, 3, 0), np.float32) if corner_params is None else read_only(corner_params, np.float32)
    width = 2 if corner_params is None else corners.shape[2]
    ids, params = np.empty((rows.sum(), table.shape[1]), np.int32), np.empty((rows.sum(), width), np.float32)
    for empty in np.flatnonzero(counts == 0):
        first = rows[:empty].sum()
        ids[first], params[first] = middle_of(table, corner_params, starts[empty])
    row, depth = np.empty(covered.shape, np.int32), np.empty(covered.shape, np.float32)
    shares, depths = (
        read_only(fragments.barycentrics, np.float32).reshape(-1, 2),
        read_only(fragments.depth, np.float32),
    )
    arrays = there, triangles, shares, depths.reshape(-1), part_of, read_only(table, np.int32), corners
    parallel(_pack, pieces, bounds, ahead, *arrays, ids, params, row.reshape(-1), depth.reshape(-1), work=8 * count)
    return counts, ids, params, row, depth


def parts_of(triangles: np.ndarray, covered: np.ndarray, starts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The part (K, H, W) int32 of each cell, −1 where it is not covered, and the first cell (P,) of each part, or −1.

    Args:
        triangles: (K, H, W), counted over all parts.
        covered: (K, H, W) bool, the cells in which there is one.
        starts: (P + 1,) int32, where the triangles of each part begin.
    """
    sizes = np.diff(starts)
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
    for piece in range(start, stop):
        for m in range(bounds[piece], bounds[piece + 1]):
            if there[m]:
                counts[piece, part_of[triangles[m]]] += 1


@loop
def _pack(
    start, stop, bounds, ahead, there, triangles, shares, depths, part_of, table, corners, ids, params, row, depth
):
    """Pack the samples of pieces [start, stop) of the cells; see `packed_by_part`.

    Args:
        start: the first piece.
        stop: the piece after the last.
        bounds: (pieces + 1,), where each begins.
        ahead: (pieces, P) the next row of each part; counted up.
        there: (M,) bool.
        triangles: (M,) int32.
        shares: (M, 2) barycentrics.
        depths: (M,).
        part_of: (T,) int32.
        table: (T, I).
        corners: (T, 3, Q), or no rows for the barycentrics.
        ids: (N, I) to fill.
        params: (N, Q) to fill.
        row: (M,) to fill.
        depth: (M,) to fill.
    """
    plain = len(corners) == 0
    for piece in range(start, stop):
        for m in range(bounds[piece], bounds[piece + 1]):
            if not there[m]:
                row[m], depth[m] = -1, 0
                continue
            t, a, b = triangles[m], shares[m, 0], shares[m, 1]
            n = ahead[piece, part_of[t]]
            ahead[piece, part_of[t]] = n + 1
            for i in range(ids.shape[1]):
                ids[n, i] = table[t, i]
            if plain:
                params[n, 0], params[n, 1] = a, b
            else:
                for i in range(params.shape[1]):
                    params[n, i] = param_at(corners, t, i, a, b)
            row[m], depth[m] = n, depths[m]
