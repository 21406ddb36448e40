"""Rendering: sample → evaluate → shade → project → splat, and its two halves."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, Literal, NamedTuple

import numpy as np

from rts.arguments import quoted
from rts.arrays import described, shape_of
from rts.camera import Camera
from rts.checks import (
    check_background,
    check_memory,
    check_ratio,
    check_sampler,
    check_scene,
    check_shaded,
    check_size,
    check_splats,
    check_splatter,
    suited_sampler,
)
from rts.engines import (
    Engine,
    constants,
    engine_of,
    is_constant,
    is_traced,
    namespace,
    suiting,
    suiting_scene,
    uncompiled,
    value_of,
)
from rts.errors import EmptyImageWarning, InputError, warn
from rts.gbuffer import GBuffer
from rts.interfaces import AnyNeeded, CheckedPart, Part, Splatter
from rts.operations.linear import affine_map
from rts.operations.take import take
from rts.records import Fine, Sampled, Samples, Splats
from rts.sampling.adaptive import Adaptive, finest
from rts.sampling.emptiness import why_empty
from rts.sampling.fine import Where, fine_samples
from rts.sampling.merging import merge
from rts.sampling.prepared import PreparedParts
from rts.sampling.pruning import Everything, as_needed, needed_by, planned, prune
from rts.sampling.tiles import Grid, at_cells
from rts.splatting.visible import Visible
from rts.trees import Array, Tree

BAND = 2**20
"""Cells, over all layers, that a supersampled image may have before it is rendered in bands of rows."""


@uncompiled
def render(
    parts: Part | Sequence[Part] | PreparedParts,
    camera: Camera,
    size: tuple[int, int],
    *,
    sampler: Any = "auto",
    splatter: Any = "auto",
    layers: int | Literal["auto"] = 2,
    supersample: int | Adaptive = 1,
    background: Any = None,
    capacity: int | None = None,
    engine: str | None = None,
) -> Array:
    """Render a scene, differentiably in everything that is a torch or jax array.

    Args:
        parts: one part or several, or what `prepare` made of them; NumPy arrays in them are constants.
        camera: the camera.
        size: (height, width) in pixels.
        sampler: name or object of a `Sampler`.
        splatter: name or object of a `Splatter`.
        layers: K, the number of surface layers kept at each pixel; or "auto", as many as count where surfaces hide one
            another, up to 8 (a warning says if there are more).
        supersample: s, for s² samples a pixel, splatted on the finer grid and averaged. Large images are rendered in
            bands of rows, so that memory stays bounded; in a gradient each band is then made once more. Or an
            `rts.Adaptive`, for as many only where outlines are; there are no bands then.
        background: colour (3,) or (4,), or image (H, W, 3 or 4), premultiplied, to composite onto; None for
            transparent.
        capacity: number of rows to allot for the samples of a part inside `jax.jit`, where shapes must be known. None
            for the worst case, layers × cells. If a third of the cells are covered, pass a third of that. What does not
            fit is dropped, deepest layers first, and counted: `overflow` of `rts.sample` is above 0, then. Where the
            image is rendered in bands, it is the capacity of each band. With `rts.Adaptive` the fine samples have as
            many rows again, `layers` for each fine cell of active pixels and their aprons; pixels that find no room
            stay coarse, and are counted.
        engine: name of the engine to compute with, "torch" or "jax", where the scene alone does not tell: its arrays
            are all NumPy, but a shader holds a network. None for the engine of the arrays.

    Returns:
        (H, W, 4) premultiplied linear RGBA, row 0 on top. Its dtype is the widest floating one of the torch or jax
        arrays in parts and camera; in a scene of NumPy arrays, the widest in any θ; at least float32. What else is
        NumPy, such as a camera in float64, does not widen it.

    Raises:
        InputError: what was given cannot be rendered.
        EngineError: torch and jax arrays in one scene.

    Warns:
        EmptyImageWarning: nothing is seen; it says why.
        AspectWarning: the camera is for images of another ratio of width to height.
    """
    scene = _Scene.of(parts, camera, sampler, engine)
    size = check_size(size, layers, capacity, finest(supersample))
    scene = scene.at(size)
    background = check_background(background, size)
    splatter = check_splatter(splatter)
    options = dict(splatter=splatter, layers=layers, supersample=supersample, capacity=capacity)
    bands = _bands(*size, layers, supersample)
    suited = scene.suited if is_constant(background) else scene.suiting(background)
    if isinstance(supersample, Adaptive) and supersample.contrast is not None:
        image = _of_contrast(scene, size, suited, **options)
        return _over_background(_seen(image, scene), background)
    if len(bands) == 1:
        sampled = _sampled(scene, scene.camera, size, **options)
        image = _splatted(sampled, scene, scene.camera, suited, splatter)
        return _over_background(_seen(image, scene), background)
    images = []
    for top, rows in bands:
        window = scene.camera.window(size, (top, 0), (rows, size[1]))
        take = partial(_sampled, scene, window, (rows, size[1]), **options)
        images.append(suited[0].checkpoint(take, lambda s, w=window: _splatted(s, scene, w, suited, splatter)))
    return _over_background(_seen(namespace(*images).concat(images), scene), background)


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

    Returns:
        Samples for `render_samples`, which may be handed to a function under `jax.jit`.

    Raises:
        InputError: what was given cannot be sampled.
        EngineError: torch and jax arrays in one scene.
    """
    scene = _Scene.of(parts, camera, sampler, engine)
    size = check_size(size, layers, capacity, finest(supersample))
    scene = scene.at(size)
    splatter = None if splatter is None else check_splatter(splatter)
    if isinstance(supersample, Adaptive) and supersample.contrast is not None:
        raise InputError(
            f"contrast of Adaptive is {supersample.contrast}; expected None, since rts.sample knows no colours; render "
            f"with it, or leave it out"
        )
    options = dict(splatter=splatter, layers=layers, supersample=supersample, capacity=capacity)
    return _sampled(scene, scene.camera, size, **options)


class _Scene(NamedTuple):
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

    @classmethod
    def of(
        cls,
        parts: Part | Sequence[Part] | PreparedParts,
        camera: Camera,
        sampler: Any,
        engine: str | None,
    ) -> _Scene:
        """The scene of what the user gave."""
        prepared = isinstance(parts, PreparedParts)
        checked, camera = check_scene(parts.parts if prepared else parts, camera)
        chosen = parts.samplers if prepared else [check_sampler(sampler)] * len(checked)
        entries = parts.entries if prepared else [None] * len(checked)
        return cls(checked, camera, chosen, entries, suiting_scene(checked, camera, engine=engine))

    def at(self, size: tuple[int, int]) -> _Scene:
        """The scene for images of a size."""
        check_ratio(self.camera, size)
        return self._replace(camera=self.camera.for_size(size))

    def suiting(self, *others: Tree) -> tuple[Engine, Array | None]:
        """As `suited`, with further arrays in the scene."""
        engine, like = suiting_scene(self.parts, self.camera, *others)
        return (engine, like) if engine.differentiates else self.suited


def _sampled(
    scene: _Scene,
    camera: Camera,
    size: tuple[int, int],
    *,
    splatter: Splatter | None,
    layers: int | Literal["auto"],
    supersample: int | Adaptive,
    capacity: int | None,
) -> Sampled:
    """The samples of a window of the image, through the camera of this window."""
    options: dict[str, Any] = dict(splatter=splatter, layers=layers, capacity=capacity)
    if isinstance(supersample, Adaptive):
        coarse = _sampled(scene, camera, size, supersample=1, **options)
        fine = _fine(scene, camera, size, coarse, adaptive=supersample, **options)
        return replace(coarse, fine=fine, overflow=coarse.overflow + fine.overflow)
    side = int(supersample)
    height, width = side * size[0], side * size[1]
    check_memory(height, width, planned(layers), capacity, gradient=scene.suited[0].differentiates)
    apron = apron_of(splatter)
    needed = None if splatter is None else needed_by(splatter, scene.parts)
    wide = _wide(scene, camera, (height, width), apron)
    taken = partial(_taken, scene, wide, capacity=capacity, facing=_reads_facing(splatter))
    sampled = taken(layers, needed) if layers != "auto" else as_needed(taken, needed)
    return replace(sampled, supersample=side, apron=apron)


class _Wide(NamedTuple):
    """A grid of cells: its camera, constant, and its height and width."""

    camera: Camera
    grid: tuple[int, int]


def _wide(scene: _Scene, camera: Camera, size: tuple[int, int], apron: int) -> _Wide:
    """The grid of an image of cells (height, width) with an apron."""
    # Every part is sampled by the one engine, and by the very views that samples are projected with.
    wide = camera.with_apron(size, apron)
    if scene.suited[0].differentiates:
        wide = constants(wide, *scene.suited)
    return _Wide(wide, (size[0] + 2 * apron, size[1] + 2 * apron))


def _taken(
    scene: _Scene,
    wide: _Wide,
    count: int,
    needed: AnyNeeded | None,
    *,
    capacity: int | None,
    cells: Array | None = None,
    facing: bool = False,
) -> Sampled:
    """The samples of a grid of cells, or of those that are listed; less what is not needed."""
    samples, pruned, listed = [], False, {} if cells is None else {"cells": cells}
    for part, chosen, entry in zip(scene.parts, scene.samplers, scene.entries, strict=True):
        chosen = suited_sampler(chosen, part, scene.camera)
        known: dict[str, Any] = {} if entry is None else {"entry": entry}
        seen = wide.camera.within(part.transform)
        if cells is not None and not chosen.takes_cells:
            samples.append(at_cells(chosen.sample(part, seen, wide.grid, count, **known), cells, capacity))
            continue
        if facing and chosen.tells_facing:
            known["facing"] = True
        if needed is not None and chosen.prunes:
            pruned = len(scene.parts) == 1
            known["needed"] = needed if pruned else Everything(needed)
        samples.append(chosen.sample(part, seen, wide.grid, count, capacity=capacity, **known, **listed))
    sampled = merge(samples, count)
    # Traced arrays have the shape of the worst case, pruned or not.
    return sampled if needed is None or pruned or is_traced(sampled.row) else prune(sampled, needed)


def _fine(
    scene: _Scene,
    camera: Camera,
    size: tuple[int, int],
    coarse: Sampled,
    *,
    adaptive: Adaptive,
    splatter: Splatter | None,
    layers: int | Literal["auto"],
    capacity: int | None,
    colors: np.ndarray | None = None,
) -> Fine:
    """Fine samples where outlines are; `colors` (N, 4) of the coarse ones are to look for contrast."""
    grid = Grid(size, adaptive.samples, apron_of(splatter))
    wide = _wide(scene, camera, (grid.side * size[0], grid.side * size[1]), grid.apron)
    needed = None if splatter is None else needed_by(splatter, scene.parts)
    where = Where(adaptive, adaptive.dilates(scene.parts), colors)
    take = partial(_taken, scene, wide, facing=_reads_facing(splatter))
    return fine_samples(coarse, grid, where, take, needed, layers, capacity)


def _of_contrast(
    scene: _Scene,
    size: tuple[int, int],
    suited: tuple,
    *,
    splatter: Splatter,
    supersample: Adaptive,
    **options: Any,
) -> Array:
    """The image with fine samples also where colours change, which are those of the coarse samples."""
    coarse = _sampled(scene, scene.camera, size, splatter=splatter, supersample=1, **options)
    splats = to_splats(coarse, scene.parts, scene.camera, scene.camera, *suited)
    colors = value_of(splats.rgba)
    if colors is None or colors.ndim != 2 or value_of(coarse.row) is None:
        raise InputError(
            f"contrast of Adaptive is {supersample.contrast}, and colours are traced; give None: what is sampled "
            f"cannot depend on values that are not known yet"
        )
    fine = _fine(scene, scene.camera, size, coarse, adaptive=supersample, splatter=splatter, colors=colors, **options)
    return _splatted(replace(coarse, fine=fine), scene, scene.camera, suited, splatter, splats)


@uncompiled
def render_samples(
    sampled: Sampled,
    parts: Part | Sequence[Part],
    camera: Camera,
    *,
    splatter: Any = "auto",
    background: Any = None,
    engine: str | None = None,
) -> Array:
    """The half of `render` with derivatives: evaluate the parts at the samples, shade, project and splat.

    Args:
        sampled: what `sample` gave for these parts. θ, transform and camera may have other values now, but for one
            case: a surface whose θ is NumPy, beside torch or jax arrays, was evaluated when it was sampled.
        parts: as in `render`.
        camera: as in `render`.
        splatter: as in `render`.
        background: as in `render`.
        engine: as in `render`.

    Returns:
        (H, W, 4) premultiplied linear RGBA, row 0 on top.

    Raises:
        InputError: the samples are not of these parts, or their apron is too narrow for the splatter.
        EngineError: torch and jax arrays in one scene.
    """
    if not isinstance(sampled, Sampled):
        raise InputError(f"sampled is {quoted(sampled)}; expected what rts.sample gave")
    apron, fine = sampled.apron, sampled.supersample
    size = tuple((n - 2 * apron) // fine for n in sampled.row.shape[1:])
    scene = _Scene.of(parts, camera, "auto", engine).at(size)
    if len(scene.parts) != len(sampled.samples):
        raise InputError(
            f"{len(scene.parts)} parts were given for the samples of {len(sampled.samples)}; pass the same parts"
        )
    splatter = check_splatter(splatter)
    if apron < apron_of(splatter):
        raise InputError(
            f"the samples have an apron of {apron} cells, and {splatter!r}, which reaches {splatter.reach}, needs "
            f"{apron_of(splatter)}; give it to rts.sample, too"
        )
    sampled = _narrowed(sampled, apron - apron_of(splatter))
    background = check_background(background, size)
    suited = scene.suiting(sampled, background)
    return _over_background(_splatted(sampled, scene, scene.camera, suited, splatter), background)


def apron_of(splatter: Splatter | None) -> int:
    """How many cells to sample on each side beyond the image: as many as the splatter reaches, and one more.

    Samples within reach have an effect on the image, and pairing looks at one cell beside theirs. None stands for
    `Visible`, which reaches farthest of the built-in ones.
    """
    return (Visible if splatter is None else splatter).reach + 1


def _reads_facing(splatter: Splatter | None) -> bool:
    """Whether to tell what faces the viewer; None stands for `Visible`."""
    return (Visible if splatter is None else splatter).reads_facing


def _narrowed(sampled: Sampled, cells: int) -> Sampled:
    """Samples with an apron that is narrower by some cells."""
    if cells == 0:
        return sampled
    rows, columns = (slice(cells, n - cells) for n in sampled.row.shape[1:])
    row, depth = (x[:, rows, columns] for x in (sampled.row, sampled.depth))
    fine = sampled.fine  # Its own apron may be wider than is needed.
    fine = None if fine is None else replace(fine, coarse=fine.coarse[rows, columns])
    facing = None if sampled.facing is None else sampled.facing[:, rows, columns]
    return replace(sampled, row=row, depth=depth, apron=sampled.apron - cells, fine=fine, facing=facing)


def _splatted(
    sampled: Sampled,
    scene: _Scene,
    window: Camera,
    suited: tuple,
    splatter: Splatter,
    splats: Splats | None = None,
) -> Array:
    """The image (H, W, 4) of what was sampled through a window of the camera's image.

    Args:
        sampled: the samples.
        scene: checked; shaders see the camera of the whole image.
        window: the camera of the samples.
        suited: the engine to compute with, and an array that sets dtype and device of its constants, or None.
        splatter: a splatter.
        splats: of the samples, but for the fine ones, if they are known.
    """
    if splats is None:
        splats = to_splats(sampled, scene.parts, scene.camera, window, *suited)
    if sampled.fine is None:
        return _averaged(splatter, splats, sampled.supersample)
    coarse = constants(sampled.fine.coarse, *suiting(splats.rgba))
    image = _averaged(splatter, splats.replace(wanted=coarse), 1)
    splats = to_fine_splats(sampled.fine, scene.parts, scene.camera, *suited)
    finer = _averaged(splatter, splats, sampled.fine.supersample)
    engine, xp = engine_of(image), namespace(image)
    pixel = constants(sampled.fine.pixel, engine, image)
    rows = take(xp.reshape(finer, (-1, 4)), xp.reshape(xp.where(pixel >= 0, pixel, 0), (-1,)))
    return xp.where((pixel >= 0)[..., None], xp.reshape(rows, image.shape), image)


def _averaged(splatter: Splatter, splats: Splats, side: int) -> Array:
    """The image (h, w, 4) of splats without their border, each pixel the mean of `side`² cells."""
    image = splatter.cropped(splats)
    expected = *(n - 2 * splats.border for n in splats.row.shape[1:]), 4
    if shape_of(image) != expected:
        raise InputError(f"the image of {splatter!r} {described(image)}; expected {expected} without the border")
    if side == 1:
        return image
    # One axis after the other: over both at once, torch takes three times as long.
    xp, (height, width) = namespace(image), (n // side for n in image.shape[:2])
    rows = xp.mean(xp.reshape(image, (height, side, width * side * 4)), axis=1)
    return xp.mean(xp.reshape(rows, (height, width, side, 4)), axis=2)


def to_fine_splats(
    fine: Fine, parts: Sequence[CheckedPart], camera: Camera, engine: Engine, like: Array | None
) -> Splats:
    """Evaluate, shade and project fine samples: splats in the places of their layout. Arguments as in `to_splats`."""
    size = tuple(n * fine.supersample for n in fine.pixel.shape)
    wide = _Wide(camera.with_apron(size, fine.apron), tuple(n + 2 * fine.apron for n in size))
    if not engine.owns(fine.row):
        fine = constants(fine, engine, like if engine.differentiates else None)
    positions, rgba = _shown(fine.samples, fine.index, parts, camera, wide, engine, like)
    arrays = fine.index, fine.shift, fine.row, fine.part, fine.facing, fine.wanted
    index, shift, row, part, facing, wanted = constants(arrays, *suiting(positions, rgba))
    xp = namespace(positions)
    moved = take(positions, index) + xp.astype(shift, positions.dtype)
    return Splats(moved, take(rgba, index), row, part, facing, wanted=wanted, border=fine.apron)


def to_splats(
    sampled: Sampled, parts: Sequence[CheckedPart], camera: Camera, window: Camera, engine: Engine, like: Array | None
) -> Splats:
    """Evaluate, shade and project samples: what splatters take, with the apron as border. Fine ones are left out.

    Args:
        sampled: the samples.
        parts: checked parts.
        camera: the camera of the whole image, which shaders see.
        window: the camera of the samples.
        engine: the engine to compute with.
        like: an array that sets dtype and device of its constants and of the splats.
    """
    grid, apron = tuple(sampled.row.shape[1:]), sampled.apron
    wide = _Wide(window.with_apron((grid[0] - 2 * apron, grid[1] - 2 * apron), apron), grid)
    if not engine.owns(sampled.row):
        sampled = constants(sampled, engine, like if engine.differentiates else None)
    positions, rgba = _shown(sampled.samples, sampled.row, parts, camera, wide, engine, like)
    cells = sampled.row, sampled.part, sampled.facing
    if not engine.owns(rgba):
        cells = constants(cells, *suiting(positions, rgba))
    return Splats(positions, rgba, *cells, border=apron)


def _shown(
    sampled: Sequence[Samples],
    row: Array,
    parts: Sequence[CheckedPart],
    camera: Camera,
    wide: _Wide,
    engine: Engine,
    like: Array | None,
) -> tuple[Array, Array]:
    """Positions (N, 3) in a grid and colours (N, 4) of the samples of all parts, in order.

    Args:
        sampled: the samples of each part.
        row: integers, those of them that are seen.
        parts: checked parts.
        camera: the camera of the whole image, which shaders see.
        wide: the grid, and its camera.
        engine: the engine to compute with.
        like: an array that sets dtype and device of its constants and of what is returned.
    """
    dtype = like
    if not engine.differentiates:
        like = None  # All is constant, and computed in the dtypes that are given.
    seen = wide.camera.replace(view=constants(wide.camera.view, engine, like))
    camera = constants(camera, engine, like)
    positions, colors, first = [], [], 0
    for index, (part, samples) in enumerate(zip(parts, sampled, strict=True)):
        transform = constants(part.transform, engine, like)
        reads = part.surface.reads(part.theta)
        local = _evaluate(part, reads, samples, engine, like)
        theta = {k: v if k in reads else constants(v, engine, like) for k, v in part.theta.items()}
        world = _to_world(_readable(local, samples, engine), transform)
        rgba = _shaded(part, theta, world, camera)
        check_shaded(rgba, local["position"].shape[0], part.shader)
        positions.append(constants(seen.within(transform).project(local["position"], wide.grid), engine, dtype))
        check_splats(index, part, world, positions[-1], rgba, row, first)
        colors.append(constants(rgba, engine, dtype))
        first += samples.ids.shape[-2]
    if not engine.owns(colors[0]) or (len(parts) > 1 and engine_of(colors) is not engine):
        # A shader may close over arrays of an engine that the scene has none of.
        positions, colors = constants((positions, colors), *suiting(positions, colors))
    if len(parts) == 1:
        return positions[0], colors[0]
    xp = namespace(positions[0])
    return xp.concat(positions), xp.concat(colors)


def _shaded(part: CheckedPart, theta: Mapping[str, Tree], gbuffer: GBuffer, camera: Camera) -> Array:
    """What the shader of a part returns."""
    try:
        return part.shader(theta, gbuffer, camera)
    except TypeError as error:
        if is_constant(gbuffer.like):
            error.add_note(
                "All arrays of this scene are NumPy's. If its shader holds a network, call rts.render(…, "
                "engine='torch'), or 'jax'."
            )
        raise


def _bands(
    height: int, width: int, layers: int | Literal["auto"], supersample: int | Adaptive
) -> list[tuple[int, int]]:
    """(first row, number of rows) of the bands in which a supersampled image is rendered."""
    if isinstance(supersample, Adaptive) or supersample == 1:
        return [(0, height)]
    rows = max(1, BAND // (planned(layers) * int(supersample) ** 2 * width))
    count = math.ceil(height / rows)
    edges = [height * i // count for i in range(count + 1)]
    return [(top, end - top) for top, end in itertools.pairwise(edges)]


def _evaluate(part: CheckedPart, reads: Sequence[str], samples: Samples, engine: Engine, like: Array | None) -> GBuffer:
    """The part's G-buffer in local space, of the entries of θ that its surface reads."""
    theta = {name: part.theta[name] for name in reads}
    if samples.gbuffer is not None and is_constant(theta):
        wanted = part.shader.reads
        if samples.asked is None or (wanted is not None and set(wanted) <= set(samples.asked)):
            return GBuffer(samples.gbuffer)
    gbuffer = part.surface.evaluate(constants(theta, engine, like), samples)
    gbuffer = gbuffer if isinstance(gbuffer, GBuffer) else GBuffer(gbuffer)
    if shape_of(gbuffer["position"]) != (samples.ids.shape[0], 3):
        position = described(gbuffer["position"])
        raise InputError(f"'position' of {part.surface!r} {position}; expected ({samples.ids.shape[0]}, 3)")
    return gbuffer


def _readable(gbuffer: GBuffer, samples: Samples, engine: Engine) -> GBuffer:
    """The G-buffer for shaders: rows that no cell refers to hold values at which derivatives are finite, too."""
    if not engine.padded(samples.row):
        return gbuffer
    found = GBuffer()
    found.like = gbuffer["position"]
    for name in gbuffer:
        found.defer(name, lambda name=name: engine.fill_unused(gbuffer[name], samples.row))
    return found


def _to_world(gbuffer: GBuffer, transform: Array | None) -> GBuffer:
    """Positions and normals moved by the part's transform."""
    if transform is None:
        return gbuffer
    world = GBuffer()
    world.like = gbuffer.like
    for name in gbuffer:
        world.defer(name, lambda name=name: gbuffer[name])
    world.defer("position", lambda: affine_map(transform[:3, :], gbuffer["position"]))
    if "normal" in gbuffer:
        world.defer("normal", lambda: _move_normals(transform, gbuffer["normal"]))
    return world


def _move_normals(transform: Array, normals: Array) -> Array:
    """Normals under an affine map: times the cofactor matrix, turned so that a mirror image keeps its outside."""
    xp = namespace(transform)
    a, b, c = (transform[:3, i] for i in range(3))
    cofactors = [xp.linalg.cross(b, c), xp.linalg.cross(c, a), xp.linalg.cross(a, b)]
    volume = xp.sum(a * cofactors[0])
    outside = xp.where(volume < 0, -xp.ones_like(volume), xp.ones_like(volume))
    return sum(normals[:, i : i + 1] * (cofactors[i] * outside) for i in range(3))


def _seen(image: Array, scene: _Scene) -> Array:
    """The image, with a warning if nothing is seen in it."""
    engine, (height, width) = engine_of(image), image.shape[:2]
    if not engine.on_host(image):
        seen = value_of(engine.namespace.any(image[..., 3] > 0))
        if seen is None or seen.any():
            return image
    known = engine.known(image)
    if known is None or known[..., :: max(1, height // 8), :: max(1, width // 8), 3].any() or known[..., 3].any():
        return image
    warn(f"nothing is seen in the image: {why_empty(scene.parts, scene.camera)}", EmptyImageWarning)
    return image


def _over_background(image: Array, background: Array | None) -> Array:
    if background is None:
        return image
    over: Array = constants(background, engine_of(image), image)
    xp = namespace(image)
    if over.shape[-1] == 3:
        over = xp.concat([over, xp.ones_like(over[..., :1])], axis=-1)
    return image + (1 - image[..., 3:]) * over
