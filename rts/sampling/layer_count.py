"""The number of layers that a scene needs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from rts.arrays.engines import value_of
from rts.contracts.records import Sampled
from rts.errors import LayersWarning, warn

LAYER_LIMIT = 16
"""The largest number of layers that `layers="auto"` takes."""
TRACED_LAYERS = {True: 2, False: 4}
"""The number of layers that it takes where values are traced, if all is opaque, or not."""


def with_all_layers(taken: Callable[[int], Sampled], opaque: bool) -> Sampled:
    """A scene sampled with all layers that `taken` gives, up to `LAYER_LIMIT`; a LayersWarning if that is too few.

    Traced values cannot decide; the number is then of `TRACED_LAYERS`.

    If parts are translucent, an empty layer is added: it says that nothing lies behind the others. Samples beyond the
    limit are counted in `overflow`.

    Args:
        taken: samples the scene with a number of layers.
        opaque: whether all shaders promise to be opaque.
    """
    count = 3
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
    cells = sampled.cells.first(min(most + (not opaque), LAYER_LIMIT))
    return replace(sampled, cells=cells, overflow=sampled.overflow + missing)


def _may_have_more(sampled: Sampled) -> bool:
    """True if triangles ran out in some cells before a refined surface had all its layers: there may be more."""
    counts = (None if s.incomplete_cells is None else value_of(s.incomplete_cells) for s in sampled.samples)
    return any(bool(x) for x in counts if x is not None)
