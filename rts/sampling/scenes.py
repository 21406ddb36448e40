"""Scenes sampled: all parts on one grid, without derivative, the half of `rts.render` that knows no colours."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any, Literal, NamedTuple

import numpy as np

from rts.arguments import check_flag
from rts.camera import Camera
from rts.checks import check_memory, check_ratio, check_sampler, check_scene, check_size, check_splatter, suited_sampler
from rts.engines import Engine, constants, is_traced, suiting_scene, uncompiled
from rts.errors import InputError
from rts.interfaces import Needed, Sampler, Splatter
from rts.parts import CheckedPart, Part
from rts.plugin_base import overrides, promised
from rts.records import Sampled, Samples
from rts.sampling.adaptive import Adaptive, finest
from rts.sampling.cache import Entry
from rts.sampling.fine import Where, fine_samples
from rts.sampling.merging import merge
from rts.sampling.prepared import PreparedParts
from rts.sampling.pruning import Everything, as_needed, needed_by, planned, prune
from rts.sampling.strips import Grid, at_cells
from rts.sampling.triangle_sampler import TriangleSampler
from rts.sampling.validation import check_samples
from rts.sampling.winding import warn_of_winding
from rts.splatting.visible import Visible
from rts.trees import Array, Tree
from rts.unread import warn_of_unread


@uncompiled
def sample(
    parts: Part | Sequence[Part] | PreparedParts,
    camera: Camera,
    size: tuple[int, int],
    *,
    sampler: Any = "auto",
    splatter: Any = None,
    layers: int | Literal["auto"] = 2,
    supersample: int | Adaptive = 1,
    capacity: int | None = None,
    engine: str | None = None,
    settles: bool = False,
) -> Sampled:
    """Find where the rays through cells' centres meet the surfaces: the half of `render` without derivative.

    Args:
        parts: as in `render`.
        camera: as in `render`.
        size: as in `render`.
        sampler: as in `render`.
        splatter: the splatter that the samples are for: the apron suits its reach, and hidden samples that it does not
            need are dropped. None keeps all, with an apron that suits every built-in splatter.
        layers: as in `render`.
        supersample: as in `render`.
        capacity: as in `render`.
        engine: as in `render`.
        settles: leave out samples of a single part of one colour that only cells amid it need, which show this colour
            whatever moves. What renders them must be given the values of θ, transform and camera that are given here.
            `render` does so.

    Returns:
        Samples for `render_samples`, which may be handed to a function under `jax.jit`.

    Raises:
        InputError: what was given cannot be sampled.
        EngineError: torch and jax arrays in one scene.
    """
    scene = Scene.of(parts, camera, sampler, engine)
    check_flag("settles", settles)
    size = check_size(size, layers, capacity, finest(supersample))
    scene = scene.at(size)
    splatter = None if splatter is None else check_splatter(splatter)
    if isinstance(supersample, Adaptive) and supersample.contrast is not None:
        raise InputError(
            f"contrast of Adaptive is {supersample.contrast}; expected None, since rts.sample knows no colours; render "
            f"with it, or leave it out"
        )
    options = dict(splatter=splatter, layers=layers, supersample=supersample, capacity=capacity, settles=settles)
    return sampled_scene(scene, scene.camera, size, **options)


class Scene(NamedTuple):
    """A scene that is checked, once for sampling and shading.

    Attributes:
        parts: checked parts.
        camera: the camera of the whole image.
        samplers: the sampler of each part.
        entries: what each sampler has built for its part, or None.
        suited: the engine of parts and camera, and an array that sets dtype and device of its constants, or None.
    """

    parts: list[CheckedPart]
    camera: Camera
    samplers: Sequence[Any]
    entries: Sequence[Any]
    suited: tuple[Engine, Array | None]

    @property
    def channels(self) -> int:
        """The number of channels that its shaders give, besides alpha."""
        return self.parts[0].shader.channels

    @classmethod
    def of(
        cls,
        parts: Part | Sequence[Part] | PreparedParts,
        camera: Camera,
        sampler: Any,
        engine: str | None,
    ) -> Scene:
        """The scene of what the user gave."""
        prepared = isinstance(parts, PreparedParts)
        checked, camera = check_scene(parts.parts if prepared else parts, camera)
        warn_of_unread(checked)
        warn_of_winding(checked, camera)
        chosen = parts.samplers if prepared else [check_sampler(sampler)] * len(checked)
        entries = parts.entries if prepared else [None] * len(checked)
        return cls(checked, camera, chosen, entries, suiting_scene(checked, camera, engine=engine))

    def at(self, size: tuple[int, int]) -> Scene:
        """The scene for images of a size."""
        check_ratio(self.camera, size)
        return self._replace(camera=self.camera.for_size(size))

    def needed_by(self, splatter: Splatter | None, settles: bool = False) -> Needed | None:
        """What says which samples a splatter needs; None to keep all. See `rts.sampling.pruning.needed_by`."""
        sizes = [entry.size if isinstance(entry, Entry) else None for entry in self.entries]
        return None if splatter is None else needed_by(splatter, self.parts, sizes, settles)

    def suiting(self, *others: Tree) -> tuple[Engine, Array | None]:
        """As `suited`, with further arrays in the scene."""
        engine, like = suiting_scene(self.parts, self.camera, *others)
        return (engine, like) if engine.differentiates else self.suited


def sampled_scene(
    scene: Scene,
    camera: Camera,
    size: tuple[int, int],
    *,
    splatter: Splatter | None,
    layers: int | Literal["auto"],
    supersample: int | Adaptive,
    capacity: int | None,
    settles: bool = False,
) -> Sampled:
    """The samples of a window of the image, through the camera of this window.

    See `sample`; where `settles`, samples that only cells of one colour need may be left out.
    """
    options: dict[str, Any] = dict(splatter=splatter, layers=layers, capacity=capacity)
    needed = scene.needed_by(splatter, settles)
    if not isinstance(supersample, Adaptive):
        return _on_one_grid(scene, camera, size, int(supersample), needed=needed, **options)
    # Outlines move on the fine grid alone, unless there is no room for some.
    coarse = _on_one_grid(scene, camera, size, needed=needed, exits=capacity is not None, **options)
    return with_fine(scene, camera, size, coarse, adaptive=supersample, needed=needed, **options)


def _on_one_grid(
    scene: Scene,
    camera: Camera,
    size: tuple[int, int],
    side: int = 1,
    *,
    splatter: Splatter | None,
    layers: int | Literal["auto"],
    capacity: int | None,
    needed: Needed | None,
    exits: bool = True,
) -> Sampled:
    """The samples of side² cells a pixel; with exits where somebody reads them, if asked for."""
    height, width = side * size[0], side * size[1]
    check_memory(height, width, planned(layers), capacity, gradient=scene.suited[0].differentiates)
    apron = apron_of(splatter)
    wide = widened(scene, camera, (height, width), apron)
    reader = splatter or Visible()
    exits = exits and reader.reads_exits and scene.suited[0].differentiates
    taken = partial(_taken, scene, wide, capacity=capacity, facing=reader.reads_facing, exits=exits)
    sampled = taken(layers, needed) if layers != "auto" else as_needed(taken, needed)
    return replace(sampled, supersample=side, apron=apron)


class Wide(NamedTuple):
    """A grid of cells: its camera, constant, and its height and width."""

    camera: Camera
    grid: tuple[int, int]


def widened(scene: Scene, camera: Camera, size: tuple[int, int], apron: int) -> Wide:
    """The grid of an image of cells (height, width) with an apron."""
    # Every part is sampled by the one engine, and by the very views that samples are projected with.
    wide = camera.with_apron(size, apron)
    if scene.suited[0].differentiates:
        wide = constants(wide, *scene.suited)
    return Wide(wide, (size[0] + 2 * apron, size[1] + 2 * apron))


def _taken(
    scene: Scene,
    wide: Wide,
    count: int,
    needed: Needed | None,
    *,
    capacity: int | None,
    cells: Array | None = None,
    facing: bool = False,
    exits: bool = False,
) -> Sampled:
    """The samples of a grid of cells, or of those that are listed; less what is not needed."""
    samples, pruned, listed = [], False, {} if cells is None else {"cells": cells}
    for part, chosen, entry in zip(scene.parts, scene.samplers, scene.entries, strict=True):
        chosen = suited_sampler(chosen, part, scene.camera)
        known: dict[str, Any] = {} if entry is None else {"entry": entry}
        seen = wide.camera.within(part.transform)
        if facing and chosen.tells_facing:
            known["facing"] = True
        if exits and chosen.tells_exits:
            known["exits"] = True
        if cells is not None and not chosen.takes_cells:
            samples.append(at_cells(_found(chosen, part, seen, wide.grid, count, **known), cells, capacity))
            continue
        if needed is not None and chosen.prunes:
            pruned = len(scene.parts) == 1
            known["needed"] = needed if pruned else Everything(needed)
        samples.append(_found(chosen, part, seen, wide.grid, count, capacity=capacity, **known, **listed))
    sampled = merge(samples, count)
    # Traced arrays have the shape of the worst case, pruned or not.
    return sampled if needed is None or pruned or is_traced(sampled.row) else prune(sampled, needed)


def _found(sampler: Sampler, part: Part, camera: Camera, grid: tuple[int, int], count: int, **options: Any) -> Samples:
    """What `sample` of a sampler gives, refused where it does not fit; arguments as there."""
    found = sampler.sample(part, camera, grid, count, **options)
    if isinstance(sampler, TriangleSampler) and not overrides(sampler, "sample", TriangleSampler):
        return found  # It has made them of fragments that are checked.
    cells = options.get("cells")
    return check_samples(found, grid if cells is None else tuple(cells.shape), sampler)


def with_fine(
    scene: Scene,
    camera: Camera,
    size: tuple[int, int],
    coarse: Sampled,
    *,
    adaptive: Adaptive,
    splatter: Splatter | None,
    layers: int | Literal["auto"],
    capacity: int | None,
    needed: Needed | None,
    colors: np.ndarray | None = None,
) -> Sampled:
    """Coarse samples, and fine ones where outlines are; `colors` (N, 4) of the coarse ones are to look for contrast."""
    grid = Grid(size, adaptive.samples, apron_of(splatter))
    wide = widened(scene, camera, (grid.side * size[0], grid.side * size[1]), grid.apron)
    where = Where(adaptive, adaptive.dilates(scene.parts), colors)
    take = partial(_taken, scene, wide, facing=(splatter or Visible()).reads_facing)
    flat = coarse.settled is not None and splatter is not None and promised(splatter, "follows_outlines")
    fine = fine_samples(coarse, grid, where, take, needed, layers, capacity, flat)
    return replace(coarse, fine=fine, overflow=coarse.overflow + fine.overflow)


def apron_of(splatter: Splatter | None) -> int:
    """How many cells to sample on each side beyond the image: as many as the splatter reaches, and one more.

    Samples within reach have an effect on the image, and pairing looks at one cell beside theirs. None stands for
    `Visible`, which reaches farthest of the built-in ones.
    """
    return (Visible if splatter is None else splatter).reach + 1
