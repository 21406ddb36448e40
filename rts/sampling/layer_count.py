"""The number of layers that a scene needs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from rts.arrays.engines import value_of
from rts.contracts.records import Sampled
from rts.errors import LayersWarning, warn

LAYER_LIMIT = 16
"""The largest number of layers that `layers="auto"` takes."""
TRACED_LAYERS = {True: 2, False: 4}
"""The number of layers that `layers="auto"` takes in compiled programs, by whether all parts are opaque."""


def with_all_layers(taken: Callable[[int], Sampled], opaque: bool, least: int = 1) -> Sampled:
    """A scene sampled with all layers of centres of cells, up to `LAYER_LIMIT`; a LayersWarning if these are more.

    Traced values cannot decide; the number is then of `TRACED_LAYERS`.

    If parts are translucent, an empty layer is added: it says that nothing lies behind the others. Samples beyond the
    limit are counted in `overflow`.

    Args:
        taken: samples the scene with a number of layers.
        opaque: whether all shaders promise to be opaque.
        least: layers to keep in any case, if the scene has them.
    """
    count = max(3, least)
    while True:
        # At the limit one more is taken, to know what is missing there.
        sampled = taken(min(count, LAYER_LIMIT + 1))
        row = value_of(sampled.row)
        if row is None:
            return taken(TRACED_LAYERS[opaque])
        other_axes = tuple(axis for axis in range(row.ndim) if axis != row.ndim - 3)
        counts = (row[..., 1:, :, :] >= 0).sum(axis=other_axes)
        most = 1 + int(np.flatnonzero(np.append(1, counts)).max())
        if (most < count and not _may_have_more(sampled)) or count > LAYER_LIMIT:
            break
        count *= 2
    missing = int(counts[LAYER_LIMIT - 1 :].sum())
    if missing:
        warn(
            f"{missing} cells where surfaces hide one another have more than the {LAYER_LIMIT} layers of "
            f'layers="auto"; give a larger number if their derivative matters',
            LayersWarning,
        )
    cells = sampled.cells.first(min(max(most + (not opaque), least), LAYER_LIMIT))
    return replace(sampled, cells=cells, overflow=sampled.overflow + missing)


def has_full_stacks(sampled: Sampled, opaque: Sequence[bool]) -> bool:
    """True if light passes through the last layer beside some edge crossing: more may matter than are kept.

    Beside the outline of something opaque there may be more than at any centre of a cell.

    Args:
        sampled: the samples, with a stencil.
        opaque: for each part, whether no light passes through it.
    """
    stencil, layers = sampled.stencil, sampled.row.shape[-3]
    stacks = None if stencil is None or stencil.stacks is None else value_of(stencil.stacks)
    if stacks is None or stacks.ndim != 2 or layers >= LAYER_LIMIT:
        return False
    last = stacks[:, -1]
    passes = ~np.repeat(opaque, [one.ids.shape[-2] for one in sampled.samples])
    return bool(passes[last[last >= 0]].any())


def _may_have_more(sampled: Sampled) -> bool:
    """True if triangles ran out in some cells before a refined surface had all its layers: there may be more."""
    counts = (None if s.incomplete_cells is None else value_of(s.incomplete_cells) for s in sampled.samples)
    return any(bool(x) for x in counts if x is not None)
