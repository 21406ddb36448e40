"""Hidden samples that can reach the image, and the number of layers that a scene needs.

Other hidden samples are dropped before they cost anything.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from rts.arrays.engines import engine_of, is_constant, namespace, value_of
from rts.arrays.extremes import largest
from rts.arrays.trees import leaves
from rts.contracts.checks import CheckedPart
from rts.contracts.records import ArraySpec, Decision, Hidden, Question, Sampled, Samples
from rts.contracts.splatter import Splatter
from rts.contracts.surface import TriangleSurface
from rts.errors import InputError, LayersWarning, warn
from rts.operations.operation import known_value
from rts.plugin_base import overrides, promised
from rts.sampling.exits import beside_outlines
from rts.sampling.packing import too_far

LAYER_LIMIT = 16
"""The largest number of layers that `layers="auto"` takes."""
TRACED_LAYERS = {True: 2, False: 4}
"""The number of layers that it takes where values are traced, if all is opaque, or not."""


def planned(layers: int | Literal["auto"]) -> int:
    """The number of layers to plan memory for: K, or 4 while "auto" has not found a number."""
    return 4 if layers == "auto" else int(layers)


def hidden_by(
    splatter: Splatter, parts: Sequence[CheckedPart], sizes: Sequence[float | None], settles: bool
) -> HiddenRule | None:
    """The rule that drops hidden samples of a scene; None to keep all.

    Samples are dropped only if all parts are opaque: a splatter tells what it needs by depths, and those of opaque
    layers alone say what is hidden. All are kept, too, if the splatter has no `needed`, or if some number of the scene
    is so large that rounding reorders depths. Where these numbers are traced, those of the triangles serve; all samples
    are kept then if a part has no triangles, or refines its samples.

    Args:
        splatter: the splatter.
        parts: checked parts.
        sizes: for each part the largest number that its surface reads, or None where it is still to be looked up.
        settles: True if cells amid the one colour of a scene of one part may go without samples (`Cells.settled`).
            Samples that will be evaluated at other values of θ must all stay.
    """
    if not overrides(splatter, "needed", Splatter) or not all(p.shader.opaque for p in parts):
        return None
    size = _size(parts, sizes)
    if size is None and not all(isinstance(p.surface, TriangleSurface) and not p.surface.refines for p in parts):
        return None
    # Where parts meet, rounding decides which of them a cell shows.
    settles = settles and promised(splatter, "fills_interiors") and len(parts) == 1 and parts[0].uniform
    return HiddenRule(splatter, size or 0.0, settles)


def _size(parts: Sequence[CheckedPart], sizes: Sequence[float | None]) -> float | None:
    """The largest absolute value that surfaces read; None if a value is traced."""
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


@dataclass(frozen=True)
class HiddenRule:
    """The rule of a splatter for the samples of an image: which of them it needs.

    Attributes:
        splatter: the splatter.
        size: the largest absolute value that surfaces read; 0 where it is not known.
        settles: True to mark settled cells: all samples have one colour, and the splatter fills interiors.
    """

    splatter: Splatter
    size: float
    settles: bool

    def unsized(self) -> HiddenRule:
        """The rule with `size` 0, for depths in units of their own."""
        return replace(self, size=0.0)

    def decide(self, question: Question, wanted: np.ndarray | None = None) -> Decision:
        """Decide which samples to keep: those that can reach the image, or its `wanted` cells (H, W); None for all.

        All are kept where numbers are so large that rounding may reorder depths.
        """
        covered, depth, size = question
        too_rough = (self.settles or len(covered) > 1) and too_far(max(size, self.size), depth)
        needed = covered if too_rough or len(covered) == 1 else self._needed(covered, depth)
        if not self.settles:
            return Decision(needed, None, needed)
        if too_rough:
            return Decision(needed, np.full(covered.shape[1:], -1, np.int8), needed)
        from rts.sampling import interiors_loops

        kept = needed.copy()
        # Cells beside unwanted ones still need their samples, and may look at one cell more.
        reach = self.splatter.reach + (wanted is not None)
        amid = interiors_loops.settle(covered, depth, kept, reach, wanted)
        return Decision(kept, numbers_of(amid), needed)

    def _needed(self, covered: np.ndarray, depth: np.ndarray) -> np.ndarray:
        kept = self.splatter.needed(covered, depth)
        if not (isinstance(kept, np.ndarray) and kept.shape == covered.shape and kept.dtype == bool):
            description = f"{kept.dtype} of {kept.shape}" if isinstance(kept, np.ndarray) else type(kept).__name__
            raise InputError(
                f"needed of {self.splatter!r} gave {description}; expected a NumPy array, bool of {covered.shape}"
            )
        return kept & covered


def numbers_of(settled: np.ndarray) -> np.ndarray:
    """`Cells.settled` (H, W) int8 for one part: 0, the first sample, where `settled` (H, W) bool is True; else −1."""
    return settled.view(np.int8) - np.int8(1)


def with_layers_that_count(
    taken: Callable[[int, Hidden | None], Sampled], hidden: Hidden | None, opaque: Sequence[bool]
) -> Sampled:
    """A scene sampled with as many layers as its image needs, up to `LAYER_LIMIT`; a LayersWarning if that is too few.

    Traced values cannot decide; the number is then of `TRACED_LAYERS`.

    If parts are translucent, an empty layer is added: it says that nothing lies behind the others. Samples beyond the
    limit are counted in `overflow`.

    Args:
        taken: samples the scene with a number of layers, without the samples that a rule drops.
        hidden: the rule; None to keep all.
        opaque: for each part, whether its shader promises to be opaque.

    """
    count = 3  # A closed surface before nothing needs two: the second at its outlines.
    while True:
        # At the limit one more is taken, to know what is missing there.
        sampled = taken(min(count, LAYER_LIMIT + 1), hidden)
        row = value_of(sampled.row)
        if row is None:
            return taken(TRACED_LAYERS[all(opaque)], hidden)
        other_axes = tuple(axis for axis in range(row.ndim) if axis != row.ndim - 3)
        counts = (row[..., 1:, :, :] >= 0).sum(axis=other_axes)
        most = 1 + int(np.flatnonzero(np.append(1, counts)).max())
        if (most < count and not _ran_out(sampled)) or count > LAYER_LIMIT:
            break
        count *= 2
    missing = int(counts[LAYER_LIMIT - 1 :].sum())
    if missing:
        warn(
            f"{missing} cells where surfaces hide one another have more than the {LAYER_LIMIT} layers of "
            f'layers="auto"; give a larger number if their derivative matters',
            LayersWarning,
        )
    cells = sampled.cells.first(min(most + (not all(opaque)), LAYER_LIMIT))
    return replace(sampled, cells=cells, overflow=sampled.overflow + missing)


def _ran_out(sampled: Sampled) -> bool:
    """True if triangles ran out in some cells before a refined surface had all its layers: there may be more."""
    known = (None if s.ran_out is None else value_of(s.ran_out) for s in sampled.samples)
    return any(bool(x) for x in known if x is not None)


def without_hidden(sampled: Sampled, decide: Callable[[Question], Decision]) -> Sampled:
    """The scene without the samples that a decision does not need, and without single exits away from outlines.

    One host call. Every part keeps at least one row, which no cell may name.

    Args:
        sampled: the scene; its `depth` is not None.
        decide: the decision, on the host; its `needed` is used.

    Raises:
        InputError: `row` or `exit` names a sample that does not exist.
    """
    sizes = [s.ids.shape[0] for s in sampled.samples]
    total, part = sum(sizes), sampled.part

    def host(row: np.ndarray, depth: np.ndarray, *rest: np.ndarray) -> tuple[np.ndarray, ...]:
        from rts.sampling.hidden_loops import Numbering

        if row.max(initial=-1) >= total:
            raise InputError(f"row refers to sample {row.max()} of {total}; sample this scene anew")
        numbering, covered = Numbering(sizes), row >= 0
        kept = decide(Question(covered, depth)).needed
        own_rows, exits = rest[: len(sizes)], rest[len(sizes) :]
        if exits:
            if (most := exits[0].max(initial=-1)) >= total:
                raise InputError(f"exit refers to sample {most} of {total}; sample this scene anew")
            if len(exits[0]) == 1:  # Pairs are in cells at outlines alone.
                near = np.full((1, kept[0].size), -1, np.int32)
                cells = beside_outlines(kept)[0]
                near[:, cells] = exits[0].reshape(1, -1)[:, cells]
                exits = (near.reshape(exits[0].shape),)
            numbering.use(exits[0], exits[0] >= 0)
        numbering.use(row, kept)
        indices = [index if len(index) else np.zeros(1, np.int32) for index in numbering.indices()]
        own_rows = [numbering.renumbered(own, part=i) for i, own in enumerate(own_rows)]
        return numbering.renumbered(row), *own_rows, *map(numbering.renumbered, exits), *indices

    rows = sampled.row, *(s.row for s in sampled.samples), *([] if sampled.exit is None else [sampled.exit])
    shapes = [ArraySpec(tuple(r.shape), np.int32) for r in rows]
    packed = [ArraySpec((n,), np.int32, packed=True) for n in sizes]
    results = engine_of(sampled).call_host(host, (*shapes, *packed), rows[0], sampled.depth, *rows[1:])
    row, own_rows, indices = results[0], results[1 : 1 + len(sizes)], results[len(rows) :]
    exits = None if sampled.exit is None else results[1 + len(sizes)]
    samples = [_selected(*z) for z in zip(sampled.samples, own_rows, indices, strict=True)]
    xp = namespace(row)
    # Row numbers are within parts up to here, since an engine may have padded what comes before.
    start = indices[0].shape[0]
    for i, index in enumerate(indices[1:], start=1):
        row = xp.where((row >= 0) & (part == i), row + start, row)
        exits = None if exits is None else xp.where((exits >= 0) & (part[0] == i), exits + start, exits)
        start += index.shape[0]
    depth = xp.where(row >= 0, sampled.depth, 0.0)
    cells = replace(sampled.cells, row=row, depth=depth, exit=exits)
    return replace(sampled, samples=tuple(samples), cells=cells)


def _selected(samples: Samples, row: Any, index: Any) -> Samples:
    """The samples of a part with the rows of `index` (N,) only, and the cells' new `row` (K, H, W); without exits."""
    xp = namespace(index)
    gbuffer = samples.gbuffer
    tables = samples.tables.items()
    return replace(
        samples,
        tables={k: xp.take(v, index, axis=0) if k in samples.by_sample else v for k, v in tables},
        ids=xp.take(samples.ids, index, axis=0),
        params=xp.take(samples.params, index, axis=0),
        gbuffer=None if gbuffer is None else {k: xp.take(v, index, axis=0) for k, v in gbuffer.items()},
        cells=replace(samples.cells, row=row, depth=xp.where(row >= 0, samples.depth, 0.0), exit=None),
    )
