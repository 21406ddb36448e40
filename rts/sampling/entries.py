"""What samplers build for the parts of a scene, and the inputs of triangles, on the host."""

from __future__ import annotations

from typing import Any

import numpy as np

from rts.arrays.engines import is_traced, stopped, value_of
from rts.arrays.trees import Array, Tree, leaves, map_leaves
from rts.contracts.checked_parts import CheckedPart
from rts.contracts.surface import TriangleSurface
from rts.sampling.cache import Entry
from rts.sampling.scene import Grid, Scene
from rts.sampling.triangle_sampler import TriangleSampler
from rts.scene.camera import Camera


def with_entries(scene: Scene, grid: Grid) -> Scene:
    """The scene with prepared entries of parts whose triangles are not cheap, so that nothing makes them twice.

    The scene itself where values are traced, or several at once.
    """
    if not any(map(_is_dear, scene.parts)) or not is_known(scene, grid):
        return scene
    entries = []
    for part, sampler, entry in zip(scene.parts, scene.samplers, scene.entries, strict=True):
        if entry is None and isinstance(sampler, TriangleSampler) and _is_dear(part):
            camera = on_host(grid.camera.within(part.transform).for_size(grid.size))
            entry = entry_of(part, sampler, map_leaves(host_value, proxy_inputs(part)), camera, grid.size)
        entries.append(entry)
    return scene._replace(entries=entries)


def is_known(scene: Scene, grid: Grid) -> bool:
    """False if samples depend on traced values, or on several values at once."""
    inputs = stopped((scene.read, [part.transform for part in scene.parts], grid.camera))
    return not any(is_traced(x) or is_batched(x) for x in leaves(inputs))


def is_batched(x: Array) -> bool:
    """True for an array of which a transform maps over several values."""
    value = value_of(x)
    return value is not None and value.ndim != x.ndim


def _is_dear(part: CheckedPart) -> bool:
    """True if making a part's triangles costs more than to compare their inputs."""
    return isinstance(part.surface, TriangleSurface) and not part.surface.proxy_is_cheap


def host_value(x: Array) -> np.ndarray:
    """The value of an array, which is not traced."""
    value = value_of(x)
    assert value is not None
    return value


def on_host(camera: Camera) -> Camera:
    """A camera that is not traced, with matrices on the host."""
    return camera.map(lambda m: np.asarray(host_value(m), np.float64))


def inputs_of(scene: Scene) -> list[Tree]:
    """The inputs of the proxies of all parts, on the host; none of them is traced."""
    return [map_leaves(host_value, proxy_inputs(part)) for part in scene.parts]


def proxy_inputs(part: CheckedPart) -> Tree:
    """The inputs of a part's proxy, without derivatives; None if it has no triangles."""
    surface = part.surface
    return stopped(surface.proxy_inputs(stopped(part.theta))) if isinstance(surface, TriangleSurface) else None


def entry_of(part: CheckedPart, sampler: TriangleSampler, inputs: Tree, camera: Camera, size: tuple[int, int]) -> Entry:
    """The part's prepared entry, with the inputs of its proxy, on the host."""
    surface: Any = part.surface
    return sampler.working_on(surface, inputs, camera, size, None, lambda known: known._replace(inputs=inputs))
