"""A scene's triangles handed to samplers once, so that later renders need not check them for changes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Self

import numpy as np

from rts.arrays.argument_checks import check_pixels
from rts.arrays.array_functions import shape_of
from rts.arrays.engines import value_of
from rts.contracts.checked_parts import CheckedPart, check_changes, check_scene
from rts.contracts.checks import check_sampler, sampler_for_part
from rts.contracts.surface import TriangleSurface
from rts.errors import InputWarning, warn
from rts.sampling.cache import Entry
from rts.scene.camera import Camera
from rts.scene.parts import Part

LOOKED_AT = 4096
"""Vertices of a part that are compared, evenly spaced: what moves a mesh moves most of it."""


class Prepared:
    """Parts, with the structures that their samplers have built.

    Attributes:
        parts: the parts.
        samplers: the sampler of each.
        entries: the sampler's entry for each part, or None where it builds nothing.
    """

    def __init__(self, parts: Sequence[Part], samplers: Sequence[Any], entries: Sequence[Any]):
        self.parts, self.samplers, self.entries = tuple(parts), tuple(samplers), tuple(entries)

    @classmethod
    def of(
        cls, parts: Part | Sequence[Part], sampler: Any, camera: Camera | None, size: tuple[int, int] | None
    ) -> Self:
        """The parts, with the structures that their samplers build now; arguments as in `rts.prepare`."""
        identity = Camera.look_at((0, 0, 1), (0, 0, 0))
        checked, _ = check_scene(parts, identity if camera is None else camera)
        size = None if size is None else check_pixels(size)
        sampler_object = check_sampler(sampler)
        samplers = [sampler_for_part(sampler_object, part, None) for part in checked]
        entries = [
            part_sampler.prepare_part(part, camera, size) for part_sampler, part in zip(samplers, checked, strict=True)
        ]
        return cls(checked, samplers, entries)

    def __getstate__(self) -> dict[str, Any]:
        """All but the samplers' structures, which can be built again from the triangles."""
        kept = [e._replace(prepared=None) if isinstance(e, Entry) else e for e in self.entries]
        return {**self.__dict__, "entries": kept}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Build the samplers' structures again."""
        pairs = zip(state["samplers"], state["entries"], strict=True)
        entries = tuple(_built(sampler, kept) if isinstance(kept, Entry) else kept for sampler, kept in pairs)
        self.__dict__.update(state, entries=entries)

    def replace(self, index: int = 0, **changes: Any) -> Self:
        """A copy with some fields of one part changed, such as its `transform`; the triangles stay as prepared."""
        check_changes(index, changes, len(self.parts))
        parts = list(self.parts)
        parts[index] = parts[index].replace(**changes)
        return type(self)(parts, self.samplers, self.entries)


def _built(sampler: Any, kept: Entry) -> Entry:
    return sampler.arranged(kept._replace(prepared=sampler.prepare(kept.proxy))) if len(kept.proxy.faces) else kept


def warn_of_moved_vertices(parts: Sequence[CheckedPart], entries: Sequence[object]) -> None:
    """Warn of a prepared mesh whose vertices have changed since: samples stay where they were. Traced ones pass."""
    for index, (part, entry) in enumerate(zip(parts, entries, strict=True)):
        if not (isinstance(entry, Entry) and isinstance(part.surface, TriangleSurface) and part.surface.proxy_is_cheap):
            continue
        vertices, before = part.surface.proxy_inputs(part.theta), entry.proxy.vertices
        if shape_of(vertices) != before.shape or (now := value_of(vertices)) is None:
            continue
        step = max(1, len(before) // LOOKED_AT)
        origin = 0 if entry.proxy.origin is None else entry.proxy.origin
        if not np.array_equal(np.asarray(now[::step] - origin, before.dtype), before[::step]):
            warn(
                f"the vertices of part {index} have changed since rts.prepare, whose samples stay where they were: "
                f"image and gradient are wrong; prepare the part anew, or render it without",
                InputWarning,
            )
