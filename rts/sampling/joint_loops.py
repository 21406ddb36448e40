"""Samples of joined parts sorted by part, compiled."""

from __future__ import annotations

import numpy as np

from rts.compiling.loops import loop
from rts.compiling.threads import parallel, read_only


def by_part(
    triangles: np.ndarray, starts: np.ndarray, ids: np.ndarray, params: np.ndarray, row: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Samples in the order of their parts; those of one part keep theirs.

    Args:
        triangles: (N,) int32, of samples, counted over all parts.
        starts: (P + 1,) int32, where the triangles of each part begin.
        ids: (N, I) int32, of samples.
        params: (N, P) float32, likewise.
        row: (K, H, W) int32, indices of samples in cells, or −1.

    Returns:
        The number (P,) of samples of each part; ids and params, with a row of zeros for each part that has none; and
        the cells' rows.
    """
    sizes = np.diff(starts)
    part_of, counts = np.repeat(np.arange(len(sizes), dtype=np.int32), sizes), np.zeros(len(sizes), np.int64)
    triangles = read_only(triangles)
    _count(triangles, part_of, counts)
    rows = np.maximum(counts, 1)
    new_ids, new_params = (np.zeros((rows.sum(), x.shape[1]), x.dtype) for x in (ids, params))
    place, moved = np.empty(len(triangles), np.int32), np.empty(row.shape, np.int32)
    ahead = np.cumsum(rows) - rows
    _sort(triangles, part_of, ahead, read_only(ids), read_only(params), place, new_ids, new_params)
    flat = read_only(row.reshape(-1), np.int32)
    parallel(_renumber, row.size, flat, place, moved.reshape(-1), work=2 * row.size)
    return counts, new_ids, new_params, moved


@loop
def _count(triangles, part_of, counts):
    """Add to `counts` (P,) the samples of each part."""
    for n in range(len(triangles)):
        counts[part_of[triangles[n]]] += 1


@loop
def _sort(triangles, part_of, ahead, ids, params, place, new_ids, new_params):
    """Put each sample behind those of its part, of which the next one goes to row `ahead` (P,); fill `place` (N,)."""
    for n in range(len(triangles)):
        part = part_of[triangles[n]]
        to = ahead[part]
        ahead[part], place[n] = to + 1, to
        for c in range(ids.shape[1]):
            new_ids[to, c] = ids[n, c]
        for c in range(params.shape[1]):
            new_params[to, c] = params[n, c]


@loop
def _renumber(start, stop, row, place, moved):
    """Fill entries [start, stop) of `moved` (M,) with the places of samples; −1 for none."""
    for m in range(start, stop):
        moved[m] = place[row[m]] if row[m] >= 0 else -1
