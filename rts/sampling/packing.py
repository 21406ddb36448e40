"""Fragments packed into samples, a row for each covered cell; and samples packed anew."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rts.arrays.extremes import largest, named
from rts.contracts.records import Cells, Fragments, Proxy, Samples
from rts.errors import InputError
from rts.sampling.exits import Exits

FAR = 20
"""Largest ratio of coordinates to the farthest depth. Up to it, depths computed in float32 differ from sampled ones by
less than splatters allow for."""


EVERY = 16
"""Step between the rows of depths that are looked at first: where anything is in view, these often suffice."""


def too_far(size: float, depth: np.ndarray) -> bool:
    """True if coordinates of this size are so large that rounding may reorder depths (0 in empty cells)."""
    return size > 0 and all(size > FAR * largest(x) for x in (depth[:1, ::EVERY], depth))


def covered_cells(triangle_ids: np.ndarray) -> tuple[np.ndarray, int]:
    """Cells (bool) where `Fragments.triangle_ids` name a triangle, and the largest index among these, or −1.

    Raises:
        InputError: an entry is neither an index nor −1.
    """
    covered, least, last = named(np.asarray(triangle_ids))
    if least < -1:
        raise InputError(f"the sampler gave triangle {least} to a cell; expected indices, or -1 where it is empty")
    return covered, last


def lift(
    fragments: Fragments,
    proxy: Proxy,
    capacity: int | None = None,
    kept: np.ndarray | None = None,
    exits: Exits | None = None,
    views: tuple[int, int] = (1, 1),
) -> Samples:
    """Packed samples from fragments: the triangle's ids, and its corner parameters interpolated.

    Samples are numbered layer by layer, and line by line in each. There is always at least one row, so that later
    steps stay connected to θ; a row that no cell refers to has no effect.

    Args:
        fragments: (K, H, W), on the host.
        proxy: the triangles.
        capacity: rows to allot; samples beyond are dropped, and counted in `overflow`. None for as many as are taken.
        kept: (K, H, W) bool, the `covered_cells` to take; None for all.
        exits: further fragments, for the last rows, as many as find room: in `capacity`, or in K · H · W rows. None
            for none.
        views: number of views in the grid, down and across; each is numbered by itself, one after the other.
    """
    from rts.sampling import packing_loops

    if kept is None:
        kept, _ = covered_cells(fragments.triangle_ids)
    table = np.ascontiguousarray(proxy.faces if proxy.ids is None else proxy.ids, np.int32)
    corner_params = None if proxy.corner_params is None else np.ascontiguousarray(proxy.corner_params, np.float32)
    beside = () if exits is None else ((exits.fragments, exits.there),)
    packed = packing_loops.pack(fragments, kept, table, corner_params, capacity or 0, *beside, views=views)
    exit_rows = None
    if exits is not None:
        exit_rows = np.full((1, *kept[0].shape), -1, np.int32)
        exit_rows.reshape(-1)[exits.cells[0]] = packed[5][0, 0]
    ids, params, row, depth, total = packed[:5]
    return Samples(ids, params, Cells(row, depth, exit=exit_rows), np.asarray(max(0, total - len(ids)), np.int32))


def repack(
    samples: Samples,
    kept: np.ndarray,
    capacity: int | None,
    pairs: tuple[np.ndarray, np.ndarray] | None = None,
    more: int = 0,
) -> Samples:
    """Samples of the cells that are kept, packed anew and numbered layer by layer; pairs at outlines get the last rows.

    Args:
        samples: on the host.
        kept: (K, H, W) bool; covered cells only.
        capacity: rows to allot, zeros where they are not used; None for as many as are kept, at least one.
        pairs: ids (2 M, I) and params (2 M, P) of pairs, for the M cells that have an exit, in order. Those that find
            no room are left out.
        more: without a capacity there is room for a row a cell, and for so many more.
    """
    index = samples.row[kept]
    rows = max(1, len(index)) if capacity is None else capacity
    number = np.full(samples.row.shape, -1, np.int32)
    number[kept] = np.where(np.arange(len(index)) < rows, np.arange(len(index)), -1)
    index, overflow = index[:rows], np.asarray(samples.overflow + max(0, len(index) - rows), np.int32)
    exits, count, last = samples.exit, len(index), len(index)
    if exits is not None and pairs is not None:
        rows = min(rows + len(pairs[0]), max(1, samples.row.size + more)) if capacity is None else rows
        cells = tuple(x[: (rows - count) // 2] for x in np.nonzero(exits[0] >= 0))
        exits, last = np.full_like(exits, -1), count + 2 * len(cells[0])
        exits[:, *cells] = np.arange(count, last, dtype=np.int32).reshape(-1, 2).T

    def packed(x: np.ndarray, further: np.ndarray | None = None) -> np.ndarray:
        rows_kept = np.zeros((rows, *x.shape[1:]), x.dtype)
        rows_kept[:count] = x[index]
        if further is not None:
            rows_kept[count:last] = further[: last - count]
        return rows_kept

    return replace(
        samples,
        ids=packed(samples.ids, pairs and pairs[0]),
        params=packed(samples.params, pairs and pairs[1]),
        cells=replace(samples.cells, row=number, exit=exits, depth=np.where(number >= 0, samples.depth, np.float32(0))),
        overflow=overflow,
        tables={name: packed(x) if name in samples.by_sample else x for name, x in samples.tables.items()},
    )


def triangles_of(fragments: Fragments, samples: Samples) -> np.ndarray:
    """(N,) int32, the triangle of each packed sample of fragments (K, ·, ·); 0 in rows that no cell names."""
    triangles, covered = np.zeros(len(samples.ids), np.int32), samples.row >= 0
    triangles[samples.row[covered]] = fragments.triangle_ids[covered]
    return triangles
