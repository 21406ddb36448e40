"""The samples of several parts, merged by depth."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import numpy as np

from rts.engines import engine_of, namespace
from rts.errors import InputError
from rts.records import ArraySpec, Sampled, Samples
from rts.trees import Array


def merge(samples: Sequence[Samples], layers: int) -> Sampled:
    """Interleave the layers of several parts by depth and keep the nearest; equal depths go to the earlier part."""
    overflow = samples[0].overflow
    for s in samples[1:]:
        overflow = overflow + s.overflow
    if len(samples) == 1:
        only = samples[0]
        return Sampled(tuple(samples), only.row, only.depth, overflow, settled=only.settled)
    given = *(s.row for s in samples), *(s.depth for s in samples)
    sizes = tuple(s.ids.shape[0] for s in samples)
    on_host, elsewhere = partial(_interleaved_on_the_host, layers, sizes=sizes), partial(_interleaved, layers)
    part, row, depth = engine_of(given).by_host(on_host, elsewhere, *given)
    xp, start = namespace(row), 0
    for i, s in enumerate(samples):
        row = xp.where(part == i, row + start, row) if start else row
        start += s.ids.shape[0]
    return Sampled(tuple(samples), row, depth, overflow)


def _interleaved(layers: int, *given: Array) -> tuple[Array, ...]:
    """Part, row within it and depth, (K, H, W) each, from the rows of each part and the depths of each."""
    xp, rows = namespace(given[0]), given[: len(given) // 2]
    row, depth = xp.concat(rows), xp.concat(given[len(rows) :])
    part = xp.concat([xp.where(r >= 0, i, r) for i, r in enumerate(rows)])
    order = xp.argsort(xp.where(row >= 0, depth, xp.inf), axis=0, stable=True)[:layers]
    part, row, depth = (xp.take_along_axis(x, order, axis=0) for x in (part, row, depth))
    return part, row, depth


def _interleaved_on_the_host(layers: int, *given: Array, sizes: Sequence[int] = ()) -> tuple[Array, ...]:
    """`_interleaved`, compiled: sorting many short columns takes array code far longer."""
    rows, depths = given[: len(given) // 2], given[len(given) // 2 :]
    shape = (min(layers, sum(r.shape[0] for r in rows)), *rows[0].shape[1:])
    dtype = np.float64 if any(namespace(d).finfo(d.dtype).bits == 64 for d in depths) else np.float32

    def host(*arrays: np.ndarray) -> tuple[np.ndarray, ...]:
        from rts.sampling import merging_kernels

        for i, (row, size) in enumerate(zip(arrays, sizes, strict=False)):
            if row.max(initial=-1) >= size:
                raise InputError(f"row of part {i} refers to sample {row.max()} of {size}; sample this scene anew")
        return merging_kernels.interleave(arrays[: len(rows)], arrays[len(rows) :], layers)

    specs = ArraySpec(shape, np.int32), ArraySpec(shape, np.int32), ArraySpec(shape, dtype)
    return engine_of(given).call_host(host, specs, *given)
