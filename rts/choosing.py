"""`sampler="auto"`: which sampler a part needs, and why."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from typing import Any, NamedTuple

from rts import registry
from rts.arrays import engine_of, is_constant
from rts.camera import Camera
from rts.checks import check_scene
from rts.errors import PluginError
from rts.protocols import Part, Samples
from rts.sampling import reads_of

STATIC_FACES = 4_000_000
"""From so many triangles on, rays at a structure that is kept are faster than drawing all (benchmarks/samplers.py)."""

_log = logging.getLogger("rts")


class Choice(NamedTuple):
    """A sampler, by name, and the reason for it."""

    sampler: str
    reason: str


def choose(part: Part, *, static: bool) -> Choice:
    """The sampler for a part whose triangles stay the same from call to call (`static`), or may not."""
    surface = part.surface
    if not hasattr(surface, "proxy"):
        return Choice("rays", f"{surface!r} intersects rays itself and has no triangles")
    if not static:
        reason = "triangles that may change each call are drawn at once, with nothing to build"
        return Choice("raster", f"{reason} (they count as unchanging where something is differentiated, but not they)")
    if not hasattr(surface, "faces"):
        return Choice("raster", f"{surface!r} does not say how many triangles it has (an attribute `faces`)")
    faces = len(surface.faces)
    if faces < STATIC_FACES:
        return Choice("raster", f"{faces} triangles are drawn faster than rays find them (below {STATIC_FACES})")
    try:
        registry.plugin("rts.samplers", "embree")
    except PluginError as error:
        return Choice("raster", f"{faces} static triangles would suit embree, but {error}")
    return Choice("embree", f"{faces} triangles stay the same: their structure is built once, and only rays move")


def is_static(part: Part, camera: Camera) -> bool:
    """Whether something is differentiated, but not what the surface reads: so calls repeat, and triangles stay."""
    constant = is_constant({name: part.theta[name] for name in reads_of(part)})
    return constant and engine_of(part, camera).name != "numpy"


def explain(parts: Part | Sequence[Part], camera: Camera) -> list[Choice]:
    """What `sampler="auto"` takes for each part of a scene, and why."""
    parts, camera = check_scene(getattr(parts, "parts", parts), camera)
    return [choose(part, static=is_static(part, camera)) for part in parts]


class Auto:
    """The sampler that suits each part."""

    def of(self, part: Part, camera: Camera) -> Any:
        """The sampler of a part."""
        choice = choose(part, static=is_static(part, camera))
        _log.debug("%s for %r: %s", choice.sampler, part.surface, choice.reason)
        return registry.instance("rts.samplers", choice.sampler)

    def sample(
        self, part: Part, camera: Camera, size: tuple[int, int], layers: int, *, capacity: int | None = None
    ) -> Samples:
        """See `rts.protocols.Sampler`."""
        return self.of(part, camera).sample(part, camera, size, layers, capacity=capacity)
