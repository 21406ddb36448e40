"""Packing fragments into samples, part by part, compiled."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from rts.compiling.loops import compiled, loop
from rts.compiling.threads import LITTLE_WORK, TASKS_PER_THREAD, parallel, read_only, thread_count
from rts.contracts.records import Fragments


class Packed(NamedTuple):
    """Rows of samples, and the tables of triangles that they are filled from.

    Attributes:
        part_of: (T,) int32; no rows for a single part.
        table: (T, I) int32.
        corners: (T, 3, Q) float32, or no rows for the barycentrics.
        ids: (N, I) int32, to fill.
        params: (N, Q) float32, to fill.
    """

    part_of: np.ndarray
    table: np.ndarray
    corners: np.ndarray
    ids: np.ndarray
    params: np.ndarray


def pack(
    fragments: Fragments,
    kept: np.ndarray,
    table: np.ndarray,
    corner_params: np.ndarray | None,
    capacity: int = 0,
    starts: np.ndarray | None = None,
    beside: Fragments | None = None,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Rows for some cells, part after part, and those of a part layer by layer; then for fragments beside.

    A part without samples has one row, in the middle of its first triangle; zeros if it has no triangles. Cells that
    are not taken, or are beyond the capacity, have row −1 and depth 0.

    Args:
        fragments: (K, H, W), whose triangles are counted over all parts.
        kept: (K, H, W) bool, the fragments to take; all of them name triangles.
        table: (T, I) int32, ids of each triangle.
        corner_params: (T, 3, Q) float32, or None for the barycentrics themselves.
        capacity: rows to allot to a single part, zeros where they are not used; 0 for as many as are taken.
        starts: (P + 1,) int32, where the triangles of each part begin; None for one part.
        beside: (1, 1, M), further fragments, all taken: rows of each part that follow those of its cells.

    Returns:
        The number (P,) of rows in use of each part, ids (N, I), params (N, Q), row and depth (K, H, W), and the rows
        (M,) of `beside`.
    """
    count, parts = kept.size, 1 if starts is None else len(starts) - 1
    owners = _NO_PARTS if starts is None or parts == 1 else owners_of(starts)
    corners = _NONE if corner_params is None else read_only(corner_params, np.float32)
    table, width = read_only(table, np.int32), 2 if corner_params is None else corners.shape[2]
    # Each piece of the cells is counted, then packed, by itself: how many there are changes nothing.
    pieces = 1 if 8 * count < LITTLE_WORK else min(thread_count() * TASKS_PER_THREAD, count)
    bounds, ahead = count * np.arange(pieces + 1) // pieces, np.zeros((pieces + 1, parts), np.int64)
    (there, cells), row, depth = (
        _listed(fragments, kept),
        np.empty(kept.shape, np.int32),
        np.empty(kept.shape, np.float32),
    )
    parallel(_count, pieces, bounds, there, cells.triangle_ids, owners, ahead, work=2 * count)
    beside = _NOTHING if beside is None else beside
    all_there, others = _listed(beside, np.ones(beside.depth.shape, np.bool_))
    more, last = len(all_there), ahead[pieces:]
    of_more, rows, depths = np.array([0, more]), np.empty(more, np.int32), np.empty(more, np.float32)
    _count(0, 1, of_more, all_there, others.triangle_ids, owners, last)
    counts, firsts = np.empty(parts, np.int64), np.empty(parts, np.int64)
    used = _number(ahead, counts, firsts)
    total = capacity or used
    make = np.zeros if capacity or not len(table) else np.empty
    ids, params = make((total, table.shape[1]), np.int32), make((total, width), np.float32)
    if len(table) and not capacity and 0 in counts.tolist():
        for part in np.flatnonzero(counts == 0):
            triangle, stop = (0, len(table)) if starts is None else starts[part : part + 2]
            ids[firsts[part]], params[firsts[part]] = middle_of(table[:stop], corner_params, triangle)
    packed = Packed(owners, table, corners, ids, params)
    parallel(_pack, pieces, bounds, ahead, there, cells, packed, row.reshape(-1), depth.reshape(-1), work=8 * count)
    _pack(0, 1, of_more, last, all_there, others, packed, rows, depths)
    return counts, ids, params, row, depth, rows


_NO_PARTS, _NONE = np.empty(0, np.int32), read_only(np.empty((0, 3, 0), np.float32))
"""The parts of triangles where there is one; and parameters of corners where barycentrics are taken."""

_NOTHING = Fragments(np.empty(0, np.int32), np.empty((0, 2), np.float32), np.empty(0, np.float32))


def in_one(tables: Sequence[np.ndarray], shifts: Sequence[int]) -> np.ndarray:
    """Several tables (T, 3) int32 of indices as one; to those of each, but −1, its shift is added."""
    whole, start = np.empty((sum(map(len, tables)), 3), np.int32), 0
    for table, shift in zip(tables, shifts, strict=True):
        own = whole[start : start + len(table)]
        parallel(_shift, len(table), read_only(table, np.int32), np.int32(shift), own, work=3 * len(table))
        start += len(table)
    return whole


@loop
def _shift(first, last, table, shift, shifted):
    """`in_one`, of some rows of a table."""
    for t in range(first, last):
        for c in range(3):
            shifted[t, c] = table[t, c] + shift if table[t, c] >= 0 else table[t, c]


def owners_of(starts: np.ndarray) -> np.ndarray:
    """The part (T,) int32 of each triangle, given where those of each part begin, `starts` (P + 1,)."""
    return np.arange(len(starts) - 1, dtype=np.int32).repeat(starts[1:] - starts[:-1])


def _listed(fragments: Fragments, kept: np.ndarray) -> tuple[np.ndarray, Fragments]:
    """Which fragments are kept, and the fragments, one after the other."""
    triangles, shares, depths = fragments
    arrays = read_only(triangles, np.int32), read_only(shares, np.float32), read_only(depths, np.float32)
    flat = Fragments(arrays[0].reshape(-1), arrays[1].reshape(-1, 2), arrays[2].reshape(-1))
    return read_only(kept).reshape(-1), flat


def middle_of(table: np.ndarray, corner_params: np.ndarray | None, triangle: int) -> tuple[np.ndarray, Any]:
    """Ids (I,) and params (P,) of the middle of a triangle, for a row that no cell names, but shaders see.

    Zeros if the table has no such triangle.
    """
    if triangle >= len(table):
        return np.zeros(table.shape[1], np.int32), 0.0
    return table[triangle], 1 / 3 if corner_params is None else corner_params[triangle].mean(axis=0)


@loop
def firsts_of(part, count):
    """(P,) int64: the first cell of each of `count` parts, among those seen in cells (K, H, W), or −1."""
    first, left, cells = np.full(count, -1), count, part.reshape(-1)
    for m in range(len(cells)):
        if left == 0:
            break
        if cells[m] >= 0 and first[cells[m]] < 0:
            first[cells[m]] = m
            left -= 1
    return first


@loop
def _count(start, stop, bounds, there, triangles, part_of, counts):
    """Add to rows [start, stop) of `counts` (pieces, P) the samples of each part in these pieces of the cells."""
    several = len(part_of) > 0
    for piece in range(start, stop):
        for m in range(bounds[piece], bounds[piece + 1]):
            if there[m]:
                counts[piece, part_of[triangles[m]] if several else 0] += 1


@loop
def _number(ahead, counts, firsts):
    """Make the counts `ahead` (pieces, P) the first rows of each piece in each part. Returns the number of all rows.

    It fills in the number `counts` (P,) of each part, at least one of which is allotted, and its first row, `firsts`.
    """
    total = 0
    for part in range(len(counts)):
        firsts[part], n = total, total
        for piece in range(len(ahead)):
            count = ahead[piece, part]
            ahead[piece, part] = n
            n += count
        counts[part] = n - total
        total = max(n, total + 1)
    return total


@compiled
def param_at(corners, t, i, a, b):
    """The parameter i of triangle t, of `corners` (T, 3, P), at the first two barycentrics."""
    c = corners[t, 2, i]
    return c + a * (corners[t, 0, i] - c) + b * (corners[t, 1, i] - c)


@loop
def _pack(start, stop, bounds, ahead, there, fragments, packed, row, depth):
    """Pack the samples of pieces [start, stop) of the cells; see `pack`. Those that find no row are left out.

    Args:
        start: the first piece.
        stop: the piece after the last.
        bounds: (pieces + 1,), where each begins.
        ahead: (pieces, P) the next row of each part; counted up.
        there: (M,) bool, which fragments are taken.
        fragments: M of them, one after the other.
        packed: see `Packed`.
        row: (M,) to fill.
        depth: (M,) to fill.
    """
    (triangles, shares, depths), (part_of, table, corners, ids, params) = fragments, packed
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
