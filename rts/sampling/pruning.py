"""Layers that cannot be seen are dropped before they cost anything; and how many layers a scene needs."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, Literal

import numpy as np

from rts.engines import engine_of, is_constant, is_traced, namespace
from rts.errors import InputError, LayersWarning, warn
from rts.interfaces import AnyNeeded, Needed, Splatter, TriangleSurface
from rts.operations.operation import known_value
from rts.parts import CheckedPart
from rts.plugin_base import overrides, promised
from rts.records import ArraySpec, Sampled, Samples
from rts.sampling.exits import beside_outlines
from rts.sampling.extremes import largest
from rts.sampling.packing import too_far
from rts.trees import leaves

LAYER_LIMIT = 8
"""The largest number of layers that `layers="auto"` takes."""


def planned(layers: int | Literal["auto"]) -> int:
    """Layers to count with before they are known."""
    return 4 if layers == "auto" else int(layers)


def needed_by(
    splatter: Splatter,
    parts: Sequence[CheckedPart],
    sizes: Sequence[float | None] | None = None,
    settles: bool = False,
) -> Needed | None:
    """What says which samples of a scene the splatter needs; None to keep all.

    Hidden samples are only without effect if all samples are opaque and lie on cells' centres; and only if numbers of
    the scene are not so large that rounding reorders depths. Where these are not known, since they are traced, `lift`
    looks at the triangles, unless samples are refined.

    Args:
        splatter: the splatter.
        parts: checked parts.
        sizes: of each part the largest number of those that its surface reads, or None where it is to be looked for.
        settles: whether samples of a scene of one part may be left out that only cells amid its one colour need. Where
            samples are to be evaluated at other values of θ than they were found for, they may not.
    """
    if not overrides(splatter, "needed", Splatter) or not all(p.shader.opaque for p in parts):
        return None
    size = _size(parts, sizes or [None] * len(parts))
    if size is None and not all(isinstance(p.surface, TriangleSurface) and not p.surface.refines for p in parts):
        return None
    # Where parts meet, rounding decides which of them a cell shows.
    settles = settles and promised(splatter, "settles") and len(parts) == 1 and parts[0].uniform
    return _BySplatter(splatter, size, settles)


def _size(parts: Sequence[CheckedPart], sizes: Sequence[float | None]) -> float | None:
    """The largest number of those that surfaces read; None where one is traced."""
    size = 0.0
    for part, known in zip(parts, sizes, strict=True):
        read = {name: part.theta[name] for name in part.surface.reads(part.theta)}
        if known is not None and is_constant(read):
            size = max(size, known)
            continue
        for x in leaves(read):
            value = known_value(x)
            if value is None:
                return None
            if value.dtype in (np.float32, np.float64):
                size = max(size, largest(value))
    return size


class _BySplatter(Needed):
    """What a splatter needs of a scene.

    Args:
        splatter: the splatter.
        size: of the largest number that surfaces read, if it is known.
        settles: whether all samples have one colour, and the splatter makes use of it.
    """

    def __init__(self, splatter: Splatter, size: float | None, settles: bool):
        self._splatter, self.size, self.settles = splatter, size, settles

    def __call__(self, covered: np.ndarray, depth: np.ndarray) -> np.ndarray:
        """See `Needed`."""
        if len(covered) == 1 or (self.size is not None and too_far(self.size, depth)):
            return covered
        kept = self._splatter.needed(covered, depth)
        if not (isinstance(kept, np.ndarray) and kept.shape == covered.shape and kept.dtype == bool):
            given = f"{kept.dtype} of {kept.shape}" if isinstance(kept, np.ndarray) else type(kept).__name__
            raise InputError(
                f"needed of {self._splatter!r} gave {given}; expected a NumPy array, bool of {covered.shape}"
            )
        return kept & covered

    def settled(
        self,
        covered: np.ndarray,
        depth: np.ndarray,
        kept: np.ndarray,
        size: float,
        wanted: np.ndarray | None = None,
    ) -> np.ndarray:
        """See `Needed`."""
        if too_far(max(size, self.size or 0.0), depth):
            return np.zeros(covered.shape[1:], bool)
        from rts.sampling import interiors_kernels

        # Beside cells that are not wanted, what decides for others is not settled, and may look at one cell more.
        reach = self._splatter.reach + (wanted is not None)
        return interiors_kernels.settle(covered, depth, kept, reach, wanted)


class Inspection(Needed):
    """Takes note of how many layers there are where hidden ones count.

    Attributes:
        most: the largest number of layers that a cell needs, at least 1; None before a call.
        beyond: (L,) number of cells that need an l-th layer.
        short: number of cells whose layers ran out as they were refined: there may be more behind.
    """

    def __init__(self, needed: Needed | None):
        self._needed, self._lock = needed, threading.Lock()
        self.settles = self._needed is not None and self._needed.settles
        self.size = None if self._needed is None else self._needed.size
        self.short = 0
        self.most: int | None = None
        self.beyond = np.zeros(0, np.int64)

    def __call__(self, covered: np.ndarray, depth: np.ndarray) -> np.ndarray:
        """See `Needed`."""
        kept = covered if self._needed is None else self._needed(covered, depth)
        counted = kept[1:].reshape(len(covered) - 1, -1).sum(axis=1)
        counted = np.append(max(1, covered.shape[1] * covered.shape[2]), counted)
        with self._lock:
            if len(self.beyond) == len(counted):
                counted = counted + self.beyond
            self.beyond = counted
            self.most = int(np.flatnonzero(counted).max()) + 1
        return kept

    def settled(
        self,
        covered: np.ndarray,
        depth: np.ndarray,
        kept: np.ndarray,
        size: float,
        wanted: np.ndarray | None = None,
    ) -> np.ndarray:
        """See `Needed`."""
        assert self._needed is not None
        return self._needed.settled(covered, depth, kept, size, wanted)

    def ran_out(self, cells: int) -> None:
        """See `Needed`."""
        with self._lock:
            self.short += cells


class ByFunction(Needed):
    """What a function says."""

    def __init__(self, function: AnyNeeded):
        self._function = function

    def __call__(self, covered: np.ndarray, depth: np.ndarray) -> np.ndarray:
        """See `Needed`."""
        return self._function(covered, depth)


class Everything(Needed):
    """Keeps all samples of one part of several, which are pruned once they are merged; hands on what ran out."""

    def __init__(self, needed: Needed):
        self._needed, self.size = needed, needed.size

    def __call__(self, covered: np.ndarray, depth: np.ndarray) -> np.ndarray:
        """See `Needed`."""
        return covered

    def ran_out(self, cells: int) -> None:
        """See `Needed`."""
        self._needed.ran_out(cells)


def as_needed(taken: Callable[[int, Needed], Sampled], needed: Needed | None) -> Sampled:
    """The scene with as many layers as count.

    Args:
        taken: samples the scene with a number of layers, less what a `Needed` drops.
        needed: says which samples the splatter needs.
    """
    count = 3  # A closed surface before nothing needs two: the second at its outlines.
    while True:
        # At the limit one more is taken, to know what is missing there.
        inspection = Inspection(needed)
        sampled = taken(min(count, LAYER_LIMIT + 1), inspection)
        if inspection.most is None:
            traced, deaf = "the values that decide are traced", "the sampler did not ask which samples are needed"
            why = traced if is_traced(sampled.row) else deaf
            raise InputError(f'layers is "auto", but {why}; give a number of layers')
        if (inspection.most < count and not inspection.short) or count > LAYER_LIMIT:
            break
        count *= 2
    kept = min(inspection.most, LAYER_LIMIT)
    missing = int(inspection.beyond[LAYER_LIMIT:].sum())
    if missing:
        warn(
            f"{missing} cells where surfaces hide one another have more than the {LAYER_LIMIT} layers of "
            f'layers="auto"; give a larger number if their derivative matters',
            LayersWarning,
        )
    row, depth, facing = (None if x is None else x[:kept, ...] for x in (sampled.row, sampled.depth, sampled.facing))
    return replace(sampled, row=row, depth=depth, facing=facing, overflow=sampled.overflow + missing)


def prune(sampled: Sampled, needed: AnyNeeded) -> Sampled:
    """The scene without the samples that are not needed; one host call."""
    sizes = [s.ids.shape[0] for s in sampled.samples]
    total, part = sum(sizes), sampled.part

    def host(row: np.ndarray, depth: np.ndarray, *rest: np.ndarray) -> tuple[np.ndarray, ...]:
        from rts.sampling.pruning_kernels import Numbering

        if row.max(initial=-1) >= total:
            raise InputError(f"row refers to sample {row.max()} of {total}; sample this scene anew")
        numbering, covered = Numbering(sizes), row >= 0
        kept = needed(covered, depth)
        own_rows, exits = rest[: len(sizes)], rest[len(sizes) :]
        if exits:
            if (most := exits[0].max(initial=-1)) >= total:
                raise InputError(f"exit refers to sample {most} of {total}; sample this scene anew")
            near = np.full(exits[0].size, -1, np.int32)
            cells = beside_outlines(kept)[0]
            near[cells] = exits[0].reshape(-1)[cells]
            exits = (near.reshape(exits[0].shape),)
            numbering.use(exits[0], exits[0] >= 0)
        numbering.use(row, kept)
        indices = [index if len(index) else np.zeros(1, np.int32) for index in numbering.indices()]
        own_rows = [numbering.renumbered(own, part=i) for i, own in enumerate(own_rows)]
        return numbering.renumbered(row), *own_rows, *map(numbering.renumbered, exits), *indices

    rows = sampled.row, *(s.row for s in sampled.samples), *([] if sampled.exit is None else [sampled.exit])
    shapes = [ArraySpec(tuple(r.shape), np.int32) for r in rows]
    packed = [ArraySpec((n,), np.int32, packed=True) for n in sizes]
    found = engine_of(sampled).call_host(host, (*shapes, *packed), rows[0], sampled.depth, *rows[1:])
    row, own_rows, indices = found[0], found[1 : 1 + len(sizes)], found[len(rows) :]
    exits = None if sampled.exit is None else found[1 + len(sizes)]
    samples = [_selected(*z) for z in zip(sampled.samples, own_rows, indices, strict=True)]
    xp = namespace(row)
    # Row numbers are within parts up to here, since an engine may have padded what comes before.
    start = indices[0].shape[0]
    for i, index in enumerate(indices[1:], start=1):
        row = xp.where((row >= 0) & (part == i), row + start, row)
        exits = None if exits is None else xp.where((exits >= 0) & (part[0] == i), exits + start, exits)
        start += index.shape[0]
    depth = xp.where(row >= 0, sampled.depth, 0.0)
    return replace(sampled, samples=tuple(samples), row=row, depth=depth, exit=exits)


def _selected(samples: Samples, row: Any, index: Any) -> Samples:
    """Some of the rows of the samples of a part."""
    xp = namespace(index)
    gbuffer = samples.gbuffer
    tables = samples.tables.items()
    return replace(
        samples,
        tables={k: xp.take(v, index, axis=0) if k in samples.by_sample else v for k, v in tables},
        ids=xp.take(samples.ids, index, axis=0),
        params=xp.take(samples.params, index, axis=0),
        gbuffer=None if gbuffer is None else {k: xp.take(v, index, axis=0) for k, v in gbuffer.items()},
        row=row,
        depth=xp.where(row >= 0, samples.depth, 0.0),
        exit=None,
    )
