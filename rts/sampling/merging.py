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

    A single part keeps its cells as they are. Of pieces between centres the nearest stays. The result has fewer layers
    if all parts together have fewer, and no settled cells if there are several parts.

    Raises:
        InputError: known cells of one of several parts name a sample that does not exist.
    """
    overflow = samples[0].overflow
    for s in samples[1:]:
        overflow = overflow + s.overflow
    if len(samples) == 1:
        return Sampled(tuple(samples), samples[0].cells, overflow)
    tables = [*(s.row for s in samples), *(s.depth for s in samples)]
    if any(s.facing is not None for s in samples):
        tables += [_nothing_told(s.row) if s.facing is None else s.facing for s in samples]
    sizes = tuple(s.ids.shape[0] for s in samples)
    on_host, elsewhere = (partial(f, layers, sizes) for f in (_interleaved_on_the_host, _interleaved))
    part, row, depth, *facing = engine_of(tables).by_host(on_host, elsewhere, *tables)
    xp, start = namespace(row), 0
    exits = None
    for i, s in enumerate(samples):
        row = xp.where(part == i, row + start, row) if start else row
        if s.exit is not None:
            before = xp.full_like(s.exit, -1) if exits is None else exits
            own, before = _as_many(s.exit, before)
            exits = xp.where((part[0] == i) & (own >= 0), own + start, before)
        start += s.ids.shape[0]
    cells = Cells(row, depth, facing[0] if facing else None, exits, between=_nearest([s.between for s in samples]))
    return Sampled(tuple(samples), cells, overflow)


def _nearest(depths: Sequence[Array | None]) -> Array | None:
    """The least of depths (H, W), of those that are not 0; None if all are None."""
    known = [depth for depth in depths if depth is not None]
    if not known:
        return None
    least = known[0]
    for depth in known[1:]:
        least = namespace(depth).where((depth > 0) & ((least == 0) | (depth < least)), depth, least)
    return least


def _as_many(one: Array, other: Array) -> tuple[Array, Array]:
    """`Cells.exit` of two parts, (E, H, W) each, with as many entries a cell; those appended are −1."""
    xp, more = namespace(one), one.shape[0] - other.shape[0]

    def longer(x: Array, by: int) -> Array:
        return x if by <= 0 else xp.concat([x, *[xp.full_like(x[:1, ...], -1)] * by])

    return longer(one, -more), longer(other, more)


def _nothing_told(row: Array) -> Array:
    """`Cells.facing` (K, H, W) int16 of a part that records no sides: 0 everywhere."""
    xp = namespace(row)
    return xp.zeros_like(row, dtype=xp.int16)


def _interleaved(layers: int, sizes: Sequence[int], *tables: Array) -> tuple[Array, ...]:
    """Part, row within the part, depth and facing (K, H, W), merged from those of all parts; −1 in empty layers.

    Args:
        layers: K; fewer layers are returned if all parts together have fewer.
        sizes: the number of rows of each part.
        *tables: the rows of all parts, then their depths, then their facings. Without facings, none is returned.
    """
    xp, count = namespace(tables[0]), len(sizes)
    rows, facing = tables[:count], tables[2 * count :]
    row, depth = xp.concat(rows), xp.concat(tables[count : 2 * count])
    part = xp.concat([xp.where(r >= 0, i, r) for i, r in enumerate(rows)])
    order = xp.argsort(xp.where(row >= 0, depth, xp.inf), axis=0, stable=True)[:layers]
    part, row, depth = (xp.take_along_axis(x, order, axis=0) for x in (part, row, depth))
    if not facing:
        return part, row, depth
    merged_facing = xp.take_along_axis(xp.concat([_of_part(f, i, count) for i, f in enumerate(facing)]), order, axis=0)
    last, bit = merged_facing[-1:, ...], Cells.MORE_BEHIND
    marked = xp.where((last != 0) & (xp.abs(last) < bit), last + xp.where(last > 0, bit, -bit), last)
    return part, row, depth, xp.concat([merged_facing[:-1, ...], xp.astype(marked, merged_facing.dtype)])


def _of_part(facing: Array, part: int, count: int) -> Array:
    """The `facing` of a part, its pieces numbered among those of all parts; 0 where numbers would be too large."""
    xp = namespace(facing)
    size = xp.abs(facing)
    more = xp.where(size >= Cells.MORE_BEHIND, Cells.MORE_BEHIND, 0)
    number = size - more
    fits = (number > 0) & (number <= (Cells.MORE_BEHIND - 1 - part) // count)
    number = xp.where(fits, number * count + part + more, 0)
    return xp.astype(xp.where(facing > 0, number, -number), facing.dtype)


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
        arguments = arrays[:count], arrays[count : 2 * count], arrays[2 * count :]
        return merging_loops.interleave(*arguments, layers, Cells.MORE_BEHIND)

    specs = ArraySpec(shape, np.int32), ArraySpec(shape, np.int32), ArraySpec(shape, dtype)
    specs = specs if len(tables) == 2 * count else (*specs, ArraySpec(shape, np.int16))
    return engine_of(tables).call_host(host, specs, *tables)
