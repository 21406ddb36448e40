"""`rts.sample`, the half of `rts.render` without derivative: all parts of a scene sampled on one grid."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np

from rts.arrays.argument_checks import check_flag
from rts.arrays.engines import is_traced, uncompiled
from rts.arrays.trees import Array
from rts.contracts.checks import check_memory
from rts.contracts.records import Hidden, Request, Sampled
from rts.contracts.splatter import Splatter
from rts.contracts.surface import TriangleSurface
from rts.errors import InputError, InputWarning, warn
from rts.plugin_base import promised
from rts.registry import name_of
from rts.rendering.arguments import Layers, SamplerLike, SplatterLike, Supersample
from rts.rendering.outlines import with_entries, with_outlines
from rts.rendering.scene import Grid, Scene
from rts.rendering.settings import RenderSettings
from rts.sampling.adaptive import Adaptive
from rts.sampling.fine_samples import Where, few_laid_out, fine_samples
from rts.sampling.hidden import HiddenRule, with_layers_that_count, without_hidden
from rts.sampling.merging import merge
from rts.sampling.prepared import Prepared
from rts.sampling.sample_checks import check_samples
from rts.sampling.strips import FineGrid, Layout, at_cells
from rts.scene.camera import Camera
from rts.scene.parts import Part


@uncompiled
def sample(
    parts: Part | Sequence[Part] | Prepared,
    camera: Camera,
    size: tuple[int, int],
    *,
    sampler: SamplerLike = "auto",
    splatter: SplatterLike | None = "auto",
    layers: Layers = "auto",
    supersample: Supersample = 1,
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
        splatter: the splatter for these samples: the apron suits its reach, outlines are found if it reads them, and
            hidden samples that it does not need are dropped. None keeps all samples of all layers, without outlines,
            and an apron that suits every built-in splatter.
        layers: as in `render`; with no splatter "auto" is the number of layers that there are, up to 16.
        supersample: as in `render`.
        capacity: as in `render`.
        engine: as in `render`.
        settles: whether to leave out samples of cells whose colour cannot change, inside a single part of one colour.
            Render the samples with the same values of θ, transform and camera, as `render` does. See `Cells.settled`.

    Returns:
        Samples for `render_samples`, which may be handed to a function under `jax.jit`.

    Raises:
        InputError: an argument is wrong; the scene cannot be sampled.
        EngineError: torch and jax arrays in one scene, or arrays on two devices.
        PluginError: a plugin cannot be imported, such as for want of a package.
    """
    scene = Scene.of(parts, camera, sampler, engine)
    check_flag("settles", settles)
    size, settings = RenderSettings.checked(
        size, "auto" if splatter is None else splatter, layers, supersample, capacity
    )
    scene, settings = scene.at(size), replace(settings, splatter=None) if splatter is None else settings
    if settings.contrast is not None:
        raise InputError(
            f"contrast of Adaptive is {settings.contrast}; expected None, since rts.sample knows no colours; render "
            f"with it, or leave it out"
        )
    return sampled_scene(scene, scene.camera, size, settings, settles)


def sampled_scene(
    scene: Scene, camera: Camera, size: tuple[int, int], settings: RenderSettings, settles: bool = False
) -> Sampled:
    """The samples of a window of the image, through the camera of this window.

    See `sample`. With `settles`, samples of cells whose colour cannot change may be left out.
    """
    settings = settings.of(scene)
    hidden, side = scene.hidden_by(settings.splatter, settles), settings.side
    if side is not None:
        return _on_one_grid(scene, camera, size, settings, side, hidden)
    return finer(scene, camera, size, settings, settles).sampled()


def finer(
    scene: Scene, camera: Camera, size: tuple[int, int], settings: RenderSettings, settles: bool = False
) -> Finer:
    """The coarse samples of an `Adaptive`, to which fine ones are to be added; see `sampled_scene`."""
    hidden = scene.hidden_by(settings.splatter, settles)
    # Outlines lie on the fine grid alone, unless its capacity is exceeded.
    coarse = _on_one_grid(scene, camera, size, settings, 1, hidden, exits=settings.capacity is not None)
    return Finer(scene, camera, size, coarse, settings, hidden)


def coarse_scene(scene: Scene, camera: Camera, size: tuple[int, int], settings: RenderSettings) -> Sampled:
    """One sample a pixel of a window of the image, including cells whose colour cannot change."""
    return _on_one_grid(scene, camera, size, settings, 1, scene.hidden_by(settings.splatter))


def _on_one_grid(
    scene: Scene,
    camera: Camera,
    size: tuple[int, int],
    settings: RenderSettings,
    side: int,
    hidden: HiddenRule | None,
    exits: bool = True,
) -> Sampled:
    """The samples of side² cells a pixel; with `exits`, also exits where the splatter reads them."""
    height, width = side * size[0], side * size[1]
    gradient, capacity, reader = scene.context.engine.differentiates, settings.capacity, settings.reader
    check_memory(height, width, settings.most_layers, capacity, gradient=gradient)
    grid = Grid.sampled(scene, camera, (height, width), settings.apron)
    exits = exits and "exit" in reader.reads and gradient
    outlines, facing = settings.finds_outlines, "facing" in reader.reads
    scene = with_entries(scene, grid) if outlines else scene
    request = Request(capacity, facing=facing, exits=exits, between=settings.thin, triangles=outlines)
    taken = partial(_taken, scene.telling(settings.thin), grid, request)
    if settings.layers == "auto":
        sampled = with_layers_that_count(taken, hidden, scene.opaque)
    else:
        sampled = taken(settings.layers, hidden)
    if outlines:
        sampled = with_outlines(sampled, scene, grid, capacity)
    return replace(sampled, supersample=side, apron=settings.apron)


def _taken(scene: Scene, grid: Grid, request: Request, count: int, hidden: Hidden | None) -> Sampled:
    """The samples of all parts, `count` layers of a grid of cells or of the cells listed in the request.

    `hidden` tells which samples to drop; traced ones may stay.
    """
    samples, alone, listed = [], len(scene.parts) == 1, request.cells
    for part, sampler, entry in zip(scene.parts, scene.chosen(), scene.entries, strict=True):
        camera = grid.camera.within(part.transform)
        own_request = replace(request, entry=entry, hidden=hidden if alone else None)
        own = sampler.sample(part, camera, grid.size, count, own_request)
        if listed is None or "cells" in own.followed:
            check_samples(own, grid.size if listed is None else tuple(listed.shape), sampler)
        else:
            own = at_cells(check_samples(own, grid.size, sampler), listed, request.capacity)
        if request.between and listed is None and own.between is None and isinstance(part.surface, TriangleSurface):
            warn(
                f"thin of Adaptive is True, and the sampler {name_of('rts.samplers', sampler)} does not tell what lies "
                f"between samples of {part.surface!r}; give sampler='raster' (to rts.prepare, if it built the parts)",
                InputWarning,
            )
        samples.append(own)
    sampled = merge(samples, count)
    # Traced arrays have the shape of the worst case anyway.
    if hidden is None or "hidden" in samples[0].followed or is_traced(sampled.row):
        return sampled
    return without_hidden(sampled, hidden.decide)


class Finer(NamedTuple):
    """Coarse samples, with what is needed to add fine ones at outlines and, with colours, at contrasts.

    Attributes:
        scene: the scene.
        camera: the camera of the window of the image.
        size: (height, width) of the window.
        coarse: one sample a pixel.
        settings: the settings, with an `Adaptive`.
        hidden: the rule for hidden samples; None to keep all.
        colors: (N, 4) of the coarse samples, to measure contrast; None to ignore it.
    """

    scene: Scene
    camera: Camera
    size: tuple[int, int]
    coarse: Sampled
    settings: RenderSettings
    hidden: HiddenRule | None
    colors: np.ndarray | None = None

    @property
    def adaptive(self) -> Adaptive:
        """The user's settings of outlines."""
        assert isinstance(self.settings.supersample, Adaptive)
        return self.settings.supersample

    @property
    def cells(self) -> FineGrid:
        """The sizes of the image and of its fine cells."""
        return FineGrid(self.size, self.adaptive.samples, self.settings.apron)

    @property
    def where(self) -> Where:
        """The rule by which pixels are active."""
        return Where(self.adaptive, self.adaptive.dilates(self.scene.parts), self.scene.opaque, self.colors)

    def few(self) -> Layout | None:
        """The layout of traced samples in little room, see `few_laid_out`; None with a capacity, or layers "auto"."""
        given = self.settings.capacity is not None or self.settings.layers == "auto"
        return None if given else few_laid_out(self.coarse, self.cells, self.where)

    def sampled(self, layout: Layout | None = None) -> Sampled:
        """The coarse samples with fine ones; `layout` as in `fine_samples`."""
        scene, settings, coarse, cells = self.scene, self.settings, self.coarse, self.cells
        height, width = self.size
        grid = Grid.sampled(scene, self.camera, (cells.side * height, cells.side * width), cells.apron)
        reads, gradient = settings.reader.reads, scene.context.engine.differentiates
        splatter = settings.splatter
        flat = coarse.settled is not None and isinstance(splatter, Splatter) and promised(splatter, "fills_interiors")

        def taken(count: int, hidden: Hidden | None, listed: Array, capacity: int | None) -> Sampled:
            request = Request(capacity, listed, facing="facing" in reads, exits="exit" in reads and gradient)
            return _taken(scene.telling(settings.thin), grid, request, count, hidden)

        given = settings.layers, settings.capacity, flat, layout
        fine = fine_samples(coarse, cells, self.where, taken, self.hidden, *given)
        return replace(coarse, fine=fine, overflow=coarse.overflow + fine.overflow)
