"""The samples of all parts of a scene, merged by depth; without those behind opaque ones."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from rts.arrays.engines import engine_of, namespace
from rts.arrays.trees import Array
from rts.contracts.records import ArraySpec, Cells, Request, Sampled, Samples
from rts.errors import InputError
from rts.sampling.sample_checks import check_samples
from rts.sampling.scene import Grid, Scene


def sampled_parts(scene: Scene, grid: Grid, request: Request, layers: int, of_opaque: int | None = None) -> Sampled:
    """The samples of all parts at the centres of a grid of cells.

    Args:
        scene: the scene.
        grid: the cells.
        request: what samplers are asked for.
        layers: K.
        of_opaque: the most layers to take of an opaque part; None for K.
    """
    tables = []
    parts = zip(scene.parts, scene.samplers, scene.entries, scene.opaque, strict=True)
    for number, (part, sampler, entry, opaque) in enumerate(parts):
        most = min(of_opaque or layers, layers) if opaque else layers
        camera, asked = scene.local_camera(number, grid), replace(request, entry=entry)
        sampled = sampler.sample(part, camera, grid.size, most, asked)
        tables.append(check_samples(sampled, grid.size, sampler))
    return merge(tables, layers)


def merge(tables: Sequence[Samples], layers: int) -> Sampled:
    """Interleave the layers of several parts by depth and keep the nearest `layers`; the earlier part is first at ties.

    A single table keeps its cells as they are. The result has fewer layers if all tables together have fewer.

    Args:
        tables: the samples of each part.
        layers: K.

    Raises:
        InputError: known cells of one of several parts name a sample that does not exist.
    """
    overflow = tables[0].overflow
    for own in tables[1:]:
        overflow = overflow + own.overflow
    samples = tuple(tables)
    if len(tables) == 1:
        return Sampled(samples, tables[0].cells, overflow)
    sizes = tuple(own.ids.shape[0] for own in tables)
    arrays = [*(own.row for own in tables), *(own.depth for own in tables)]
    if all(own.triangle is not None for own in tables):
        arrays += [own.triangle for own in tables]
    on_host, elsewhere = (partial(f, layers, sizes) for f in (_interleaved_on_the_host, _interleaved))
    return Sampled(samples, Cells(*engine_of(arrays).by_host(on_host, elsewhere, *arrays)), overflow)


def _interleaved(layers: int, sizes: Sequence[int], *tables: Array) -> tuple[Array, ...]:
    """Row, counted over all parts, depth, and triangle (K, H, W), merged from those of all parts; −1 in empty layers.

    Args:
        layers: K; fewer layers are returned if all parts together have fewer.
        sizes: the number of rows of each part.
        *tables: the rows of all parts, then their depths, then their triangles. Without these, none are returned.
    """
    xp, count = namespace(tables[0]), len(sizes)
    firsts = np.cumsum(sizes) - sizes
    rows = [xp.where(r >= 0, r + int(first), r) for r, first in zip(tables, firsts, strict=False)]
    row, depth, *triangle = (
        xp.concat(x) for x in (rows, *(tables[n : n + count] for n in range(count, len(tables), count)))
    )
    order = xp.argsort(xp.where(row >= 0, depth, xp.inf), axis=0, stable=True)[:layers]
    return tuple(xp.take_along_axis(x, order, axis=0) for x in (row, depth, *triangle))


def _interleaved_on_the_host(layers: int, sizes: Sequence[int], *tables: Array) -> tuple[Array, ...]:
    """`_interleaved`, compiled, for known arrays: sorting many short columns takes array code far longer."""
    count = len(sizes)
    rows, depths = tables[:count], tables[count : 2 * count]
    shape = (min(layers, sum(r.shape[0] for r in rows)), *rows[0].shape[1:])
    dtype = np.float64 if any(namespace(d).finfo(d.dtype).bits == 64 for d in depths) else np.float32
    firsts = (np.cumsum(sizes) - sizes).tolist()

    def host(*arrays: np.ndarray) -> tuple[np.ndarray, ...]:
        from rts.sampling import merging_loops

        for i, (row, size) in enumerate(zip(arrays, sizes, strict=False)):
            if row.max(initial=-1) >= size:
                raise InputError(f"row of part {i} refers to sample {row.max()} of {size}; sample this scene anew")
        own_rows, own_depths, triangles = (arrays[n : n + count] for n in (0, count, 2 * count))
        return merging_loops.interleave(own_rows, own_depths, triangles, firsts, layers)

    specs = ArraySpec(shape, np.int32), ArraySpec(shape, dtype)
    specs = specs if len(tables) == 2 * count else (*specs, ArraySpec(shape, np.int32))
    return engine_of(tables).call_host(host, specs, *tables)
