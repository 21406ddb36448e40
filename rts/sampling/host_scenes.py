"""Scenes on the host: of known values, whatever their engine, or of values that a call hands over.

Samples that are found there become arrays of that engine.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from itertools import repeat
from operator import is_not
from typing import Any

import numpy as np

from rts.arrays.engines import Context, engine_of, floating_bits, host_value, is_constant
from rts.arrays.trees import Tree, collected, join_record, map_leaves
from rts.contracts.checked_parts import CheckedPart
from rts.contracts.records import Sampled, Samples
from rts.sampling.camera_checks import check_camera, on_host
from rts.sampling.entries import entry_of, is_known, proxy_inputs
from rts.sampling.scene import Grid, Scene
from rts.sampling.triangle_sampler import is_drawn


def on_the_host(scene: Scene, grid: Grid) -> tuple[Scene, Grid]:
    """A scene of triangles on the host, and its cells: entries and cameras of all parts, in place of θ and transforms.

    Only entries are added for engines that pad; nothing where values are traced, or several at once, or where a sampler
    has a way of its own.
    """
    for part, sampler in zip(scene.parts, scene.samplers, strict=True):
        if not is_drawn(type(part.surface), type(sampler)):
            return scene, grid
    if scene.cameras or not is_known(scene, grid):
        return scene, grid
    here, cells = from_values(scene, grid.size, values_of(scene, grid))
    like = scene.context.like
    if like is not None and scene.context.engine.padded(like):
        return scene._replace(entries=here.entries), grid
    return here, cells


def values_of(scene: Scene, grid: Grid) -> Tree:
    """All that samples of triangles depend on: the camera of the cells; camera, transform and inputs of each part."""
    of_parts = [
        # The product that later projects the samples, to the bit.
        (scene.local_camera(index, grid), part.transform, proxy_inputs(part) if entry is None else None)
        for index, (part, entry) in enumerate(zip(scene.parts, scene.entries, strict=True))
    ]
    return grid.camera, of_parts


def from_values(scene: Scene, size: tuple[int, int], values: Tree) -> tuple[Scene, Grid]:
    """The scene on the host, and its cells, from the values of `values_of`, none of which is traced.

    An InputError if a camera makes no image.
    """
    entries, cameras, (camera, of_parts) = [], [], values
    sampler: Any
    for part, sampler, entry, given in zip(scene.parts, scene.samplers, scene.entries, of_parts, strict=True):
        seen, transform, inputs = given
        seen = check_camera(on_host(seen), None if transform is None else host_value(transform))
        if entry is None:
            entry = entry_of(part, sampler, map_leaves(host_value, inputs), seen, size)
        entries.append(entry)
        cameras.append(seen)
    parts = [join_record(CheckedPart, ({}, None), (part.surface, part.shader, part.cull)) for part in scene.parts]
    context = Context(engine_of(), np.zeros((), real_of(scene)))
    return Scene(parts, scene.camera, scene.samplers, entries, context, cameras), Grid(on_host(camera), size)


def real_of(scene: Scene) -> type:
    """The dtype of a scene's floating arrays."""
    like = scene.context.like
    return np.float64 if like is None or floating_bits(like) == 64 else np.float32


def with_attributes(sampled: Sampled, scene: Scene) -> Sampled:
    """Samples that were found on the host; those of parts with constant θ get the attributes that shaders read.

    A scene of NumPy is left as it is: its attributes are evaluated when it is shaded.
    """
    if not scene.context.engine.differentiates:
        return sampled
    samples = tuple(map(_evaluated, scene.parts, sampled.samples, repeat(real_of(scene))))
    return replace(sampled, samples=samples) if any(map(is_not, samples, sampled.samples)) else sampled


def in_engine(sampled: Sampled, scene: Scene) -> Sampled:
    """Samples that were found on the host, in arrays of the scene's engine."""
    engine, like = scene.context
    if not engine.differentiates:
        return sampled
    leaves = collected(sampled)
    arrays = dict(zip(map(id, leaves), leaves, strict=True))  # Some stand in it twice, as the cells of a single part.
    moved = dict(zip(arrays, engine.placed(list(arrays.values()), like), strict=True))
    return map_leaves(partial(next, map(moved.__getitem__, map(id, leaves))), sampled)


def _evaluated(part: CheckedPart, samples: Samples, real: type) -> Samples:
    """The samples of a part with the attributes that its shader reads, if its θ is constant; see `Samples.gbuffer`."""
    if not is_constant(part.read):
        return samples
    gbuffer = part.surface.evaluate(part.read, replace(samples, gbuffer_names=None))
    names = list(gbuffer) if part.reads is None else ["position", *(n for n in part.reads if n in gbuffer)]
    return replace(samples, gbuffer={name: np.asarray(gbuffer[name], real) for name in dict.fromkeys(names)})
