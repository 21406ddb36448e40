"""`sampler="auto"`: which sampler a part needs, and why."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from typing import NamedTuple

from rts import registry
from rts.camera import Camera
from rts.checks import check_sampler, check_scene
from rts.engines import engine_of, is_constant
from rts.errors import PluginError
from rts.interfaces import Part, Sampler, TriangleSurface
from rts.records import Samples
from rts.sampling.prepared import PreparedParts

STATIC_FACES = 4_000_000
"""From so many triangles on, rays at a kept structure are faster than drawing all (benchmarks/speed/samplers.py)."""

_log = logging.getLogger("rts")


class Choice(NamedTuple):
    """A sampler, by name, and the reason for it."""

    sampler: str
    reason: str


def choose(part: Part, *, static: bool) -> Choice:
    """The sampler for a part whose triangles stay the same from call to call (`static`), or may not."""
    surface = part.surface
    if not isinstance(surface, TriangleSurface):
        return Choice("rays", f"{surface!r} intersects rays itself and has no triangles")
    if not static:
        reason = "its triangles may change with every call, so nothing is built for them"
        return Choice("raster", f"{reason} (they count as fixed where only other things are differentiated)")
    faces = surface.face_count
    if faces is None:
        return Choice("raster", f"{surface!r} does not say how many triangles it has (`face_count`)")
    if faces < STATIC_FACES:
        return Choice("raster", f"{faces} triangles are drawn faster than rays find them (below {STATIC_FACES})")
    try:
        registry.plugin("rts.samplers", "embree")
    except PluginError as error:
        return Choice("raster", f"{faces} static triangles would suit embree, but {error}")
    return Choice("embree", f"{faces} triangles stay the same: their structure is built once, and only rays move")


def is_static(part: Part, camera: Camera) -> bool:
    """Whether something is differentiated, but not what the surface reads: so calls repeat, and triangles stay."""
    constant = is_constant([part.theta[name] for name in part.surface.reads(part.theta)])
    return constant and engine_of(part, camera).differentiates


def explain(parts: Part | Sequence[Part] | PreparedParts, camera: Camera) -> list[Choice]:
    """What `sampler="auto"` takes for each part of a scene, and why.

    Args:
        parts: as in `rts.render`.
        camera: as in `rts.render`.

    Returns:
        For each part the name of the `sampler`, and the `reason`.
    """
    parts, camera = check_scene(parts.parts if isinstance(parts, PreparedParts) else parts, camera)
    return [choose(part, static=is_static(part, camera)) for part in parts]


class Auto(Sampler):
    """The sampler that suits each part."""

    def suited(self, part: Part, camera: Camera | None) -> Sampler:
        """See `rts.Sampler`."""
        choice = choose(part, static=camera is None or is_static(part, camera))
        _log.debug("%s for %r: %s", choice.sampler, part.surface, choice.reason)
        return check_sampler(choice.sampler)

    def sample(
        self, part: Part, camera: Camera, size: tuple[int, int], layers: int, *, capacity: int | None = None
    ) -> Samples:
        """See `rts.Sampler`."""
        return self.suited(part, camera).sample(part, camera, size, layers, capacity=capacity)
