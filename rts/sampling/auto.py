"""`sampler="auto"`: the sampler that suits a part, and the reason."""

from __future__ import annotations

import logging
from typing import NamedTuple

from rts import registry
from rts.arrays.engines import engine_of, is_constant
from rts.contracts.records import Request, Samples
from rts.contracts.sampler import Sampler
from rts.contracts.surface import TriangleSurface
from rts.errors import PluginError
from rts.plugin_base import is_subclass
from rts.scene.camera import Camera
from rts.scene.parts import Part

STATIC_FACES = 4_000_000
"""Number of triangles from which rays cast into a kept structure are faster than drawing all triangles
(benchmarks/speed/samplers.py)."""

_log = logging.getLogger("rts")


class Choice(NamedTuple):
    """The decision for a part: its sampler, the reason, and the number of samples.

    Attributes:
        sampler: the sampler that `sampler="auto"` takes, by name.
        reason: why.
        samples: the number of samples in an image; None if no image was sampled.
        remarks: likely mistakes, a line each: entries of θ that nothing reads, a mesh wound inside out.
    """

    sampler: str
    reason: str
    samples: int | None = None
    remarks: tuple[str, ...] = ()


_MOVING = Choice(
    "raster",
    "its triangles may change with every call, so nothing is built for them (they count as fixed where only other "
    "things are differentiated)",
)


def choose(part: Part, *, static: bool) -> Choice:
    """The sampler for a part.

    Args:
        part: the part.
        static: True if its triangles stay the same from call to call.
    """
    surface = part.surface
    if not is_subclass(type(surface), TriangleSurface):
        return Choice("rays", f"{surface!r} intersects rays itself and has no triangles")
    if not static:
        return _MOVING
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
    """True if the engine differentiates, but the surface reads constants only: calls repeat, and triangles stay."""
    constant = is_constant(tuple(map(part.theta.get, part.surface.reads(part.theta))))
    return constant and engine_of(part, camera).differentiates


class Auto(Sampler):
    """A sampler that passes each part to the sampler that `choose` names."""

    def sampler_for(self, part: Part, camera: Camera | None) -> Sampler:
        """See `rts.Sampler`."""
        choice = choose(part, static=camera is None or is_static(part, camera))
        if _log.isEnabledFor(logging.DEBUG):
            _log.debug("%s for %r: %s", choice.sampler, part.surface, choice.reason)
        return registry.instance("rts.samplers", choice.sampler)

    def sample(self, part: Part, camera: Camera, size: tuple[int, int], layers: int, request: Request) -> Samples:
        """See `rts.Sampler`."""
        return self.sampler_for(part, camera).sample(part, camera, size, layers, request)
