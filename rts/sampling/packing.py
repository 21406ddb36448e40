"""Fragments packed into samples, a row for each covered cell; and samples packed anew."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rts.arrays.value_ranges import nonnegative
from rts.contracts.records import Cells, Fragments, Proxy, Samples
from rts.errors import InputError


def covered_cells(triangle_ids: np.ndarray) -> tuple[np.ndarray, int]:
    """Cells (bool) where `Fragments.triangle_ids` name a triangle, and the largest index among these, or −1.

    Raises:
        InputError: an entry is neither an index nor −1.
    """
    covered, least, last = nonnegative(np.asarray(triangle_ids))
    if least < -1:
        raise InputError(f"the sampler gave triangle {least} to a cell; expected indices, or -1 where it is empty")
    return covered, last


def pack_fragments(
    fragments: Fragments,
    proxy: Proxy,
    capacity: int | None = None,
    kept: np.ndarray | None = None,
) -> Samples:
    """Packed samples from fragments: the triangle's ids, and its corner parameters interpolated.

    Samples are numbered layer by layer, and line by line in each. There is always at least one row, so that later
    steps stay connected to θ; a row that no cell refers to has no effect.

    Args:
        fragments: (K, H, W), on the host.
        proxy: the triangles.
        capacity: rows to allot; samples beyond are dropped, and counted in `overflow`. None for as many as are taken.
        kept: (K, H, W) bool, the `covered_cells` to take; None for all.
    """
    from rts.sampling import packing_loops

    if kept is None:
        kept, _ = covered_cells(fragments.triangle_ids)
    table = np.ascontiguousarray(proxy.faces if proxy.ids is None else proxy.ids, np.int32)
    corner_params = None if proxy.corner_params is None else np.ascontiguousarray(proxy.corner_params, np.float32)
    (total,), ids, params, row, depth, _ = packing_loops.pack(fragments, kept, table, corner_params, capacity or 0)
    return Samples(ids, params, Cells(row, depth), np.asarray(max(0, total - len(ids)), np.int32))


def repack(samples: Samples, kept: np.ndarray, capacity: int | None) -> Samples:
    """Samples of the cells that are kept, packed anew and numbered layer by layer.

    Args:
        samples: on the host.
        kept: (K, H, W) bool; covered cells only.
        capacity: rows to allot, zeros where they are not used; None for as many as are kept, at least one.
    """
    index = samples.row[kept]
    rows = max(1, len(index)) if capacity is None else capacity
    number = np.full(samples.row.shape, -1, np.int32)
    number[kept] = np.where(np.arange(len(index)) < rows, np.arange(len(index)), -1)
    index, overflow = index[:rows], np.asarray(samples.overflow + max(0, len(index) - rows), np.int32)

    def packed(x: np.ndarray) -> np.ndarray:
        rows_kept = np.zeros((rows, *x.shape[1:]), x.dtype)
        rows_kept[: len(index)] = x[index]
        return rows_kept

    return replace(
        samples,
        ids=packed(samples.ids),
        params=packed(samples.params),
        cells=Cells(number, np.where(number >= 0, samples.depth, np.float32(0))),
        overflow=overflow,
        tables={name: packed(x) if name in samples.by_sample else x for name, x in samples.tables.items()},
    )
