"""The samples of several parts, merged by depth."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import numpy as np

from rts.arrays.engines import engine_of, namespace
from rts.arrays.trees import Array
from rts.contracts.records import ArraySpec, Cells, Sampled, Samples
from rts.errors import InputError


def merge(samples: Sequence[Samples], layers: int) -> Sampled:
    """Interleave the layers of several parts by depth and keep the nearest `layers`; the earlier part is first at ties.

    A single part keeps its cells as they are. The result has fewer layers if all parts together have fewer.

    Raises:
        InputError: known cells of one of several parts name a sample that does not exist.
    """
    overflow = samples[0].overflow
    for s in samples[1:]:
        overflow = overflow + s.overflow
    if len(samples) == 1:
        return Sampled(tuple(samples), samples[0].cells, overflow)
    tables = [*(s.row for s in samples), *(s.depth for s in samples)]
    if all(s.triangle is not None for s in samples):
        tables += [s.triangle for s in samples]
    sizes = tuple(s.ids.shape[0] for s in samples)
    on_host, elsewhere = (partial(f, layers, sizes) for f in (_interleaved_on_the_host, _interleaved))
    part, row, depth, *triangle = engine_of(tables).by_host(on_host, elsewhere, *tables)
    xp, start = namespace(row), 0
    for i, s in enumerate(samples):
        row = xp.where(part == i, row + start, row) if start else row
        start += s.ids.shape[0]
    return Sampled(tuple(samples), Cells(row, depth, *triangle), overflow)


def _interleaved(layers: int, sizes: Sequence[int], *tables: Array) -> tuple[Array, ...]:
    """Part, row within the part, depth, and triangle (K, H, W), merged from those of all parts; −1 in empty layers.

    Args:
        layers: K; fewer layers are returned if all parts together have fewer.
        sizes: the number of rows of each part.
        *tables: the rows of all parts, then their depths, then their triangles. Without these, none are returned.
    """
    xp, count = namespace(tables[0]), len(sizes)
    rows = tables[:count]
    row, depth, *triangle = (xp.concat(tables[first : first + count]) for first in range(0, len(tables), count))
    part = xp.concat([xp.where(r >= 0, i, r) for i, r in enumerate(rows)])
    order = xp.argsort(xp.where(row >= 0, depth, xp.inf), axis=0, stable=True)[:layers]
    return tuple(xp.take_along_axis(x, order, axis=0) for x in (part, row, depth, *triangle))


def _interleaved_on_the_host(layers: int, sizes: Sequence[int], *tables: Array) -> tuple[Array, ...]:
    """`_interleaved`, compiled, for known arrays: sorting many short columns takes array code far longer."""
    count = len(sizes)
    rows, depths = tables[:count], tables[count : 2 * count]
    shape = (min(layers, sum(r.shape[0] for r in rows)), *rows[0].shape[1:])
    dtype = np.float64 if any(namespace(d).finfo(d.dtype).bits == 64 for d in depths) else np.float32

    def host(*arrays: np.ndarray) -> tuple[np.ndarray, ...]:
        from rts.sampling import merging_loops

        for i, (row, size) in enumerate(zip(arrays, sizes, strict=False)):
            if row.max(initial=-1) >= size:
                raise InputError(f"row of part {i} refers to sample {row.max()} of {size}; sample this scene anew")
        return merging_loops.interleave(arrays[:count], arrays[count : 2 * count], arrays[2 * count :], layers)

    specs = ArraySpec(shape, np.int32), ArraySpec(shape, np.int32), ArraySpec(shape, dtype)
    specs = specs if len(tables) == 2 * count else (*specs, ArraySpec(shape, np.int32))
    return engine_of(tables).call_host(host, specs, *tables)
