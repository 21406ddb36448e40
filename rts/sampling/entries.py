"""Structures that samplers build for the parts of a scene, and the inputs of triangles, on the host."""

from __future__ import annotations

from typing import Any

from rts.arrays.engines import CONSTANT_TYPES, engine_of, host_value, is_constant, stopped
from rts.arrays.trees import Array, Tree, collected, map_leaves
from rts.contracts.checked_parts import CheckedPart
from rts.contracts.surface import TriangleSurface
from rts.plugin_base import is_subclass
from rts.sampling.cache import Entry
from rts.sampling.scene import Grid, Scene, lies_on_triangles
from rts.sampling.triangle_sampler import TriangleSampler
from rts.scene.camera import Camera


def is_known(scene: Scene, grid: Grid) -> bool:
    """False if samples depend on traced values, or on several values at once."""
    arrays = collected((scene.read, [part.transform for part in scene.parts], grid.camera))
    return scene.context.engine.are_known([x for x in arrays if not isinstance(x, CONSTANT_TYPES)])


def is_still(scene: Scene) -> bool:
    """True if no derivative moves samples: all lie on triangles, and surfaces, transforms and camera are constant.

    Such surfaces are evaluated where they are sampled, so that what a function of theirs closes over has no derivative
    either. False for an engine without derivatives, by which `render` and `render_samples` of `sample` are equal to the
    bit.
    """
    if not scene.context.engine.differentiates or not all(map(lies_on_triangles, scene.parts, scene.samplers)):
        return False
    return is_constant((scene.camera, scene.read, [part.transform for part in scene.parts]))


def is_batched(x: Array) -> bool:
    """True for an array, or a number, of which a transform maps over several values."""
    return not (isinstance(x, CONSTANT_TYPES) or engine_of(x).traced(x) or engine_of(x).are_known([x]))


def inputs_of(scene: Scene) -> list[Tree]:
    """The inputs of the proxies of all parts, on the host; None for those with entries. None of them is traced."""
    pairs = zip(scene.parts, scene.entries, strict=True)
    return [map_leaves(host_value, proxy_inputs(part)) if entry is None else None for part, entry in pairs]


def proxy_inputs(part: CheckedPart) -> Tree:
    """The inputs of a part's proxy, without derivatives; None if it has no triangles."""
    surface: Any = part.surface
    return stopped(surface.proxy_inputs(stopped(part.theta))) if is_subclass(type(surface), TriangleSurface) else None


def entry_of(part: CheckedPart, sampler: TriangleSampler, inputs: Tree, camera: Camera, size: tuple[int, int]) -> Entry:
    """The part's prepared entry, with the inputs of its proxy, on the host."""
    surface: Any = part.surface
    return sampler.working_on(surface, inputs, camera, size, None, lambda known: Entry(*known[:2], inputs))
