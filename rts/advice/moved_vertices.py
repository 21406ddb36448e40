"""Prepared parts whose vertices have changed."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rts.arrays.array_functions import shape_of
from rts.arrays.engines import value_of
from rts.contracts.checked_parts import CheckedPart
from rts.contracts.surface import TriangleSurface
from rts.errors import InputWarning, warn
from rts.sampling.cache import Entry

LOOKED_AT = 4096
"""Vertices of a part that are compared, evenly spaced: what moves a mesh moves most of it."""


def warn_of_moved_vertices(parts: Sequence[CheckedPart], entries: Sequence[object]) -> None:
    """Warn of a prepared mesh whose vertices have changed since: samples stay where they were. Traced ones pass."""
    for index, (part, entry) in enumerate(zip(parts, entries, strict=True)):
        if not (isinstance(entry, Entry) and isinstance(part.surface, TriangleSurface) and part.surface.proxy_is_cheap):
            continue
        vertices, before = part.surface.proxy_inputs(part.theta), entry.proxy.vertices
        if shape_of(vertices) != before.shape or (now := value_of(vertices)) is None:
            continue
        step = max(1, len(before) // LOOKED_AT)
        if not np.array_equal(np.asarray(now[::step], before.dtype), before[::step]):
            warn(
                f"the vertices of part {index} have changed since rts.prepare, whose samples stay where they were: "
                f"image and gradient are wrong; prepare the part anew, or render it without",
                InputWarning,
            )
