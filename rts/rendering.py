"""Rendering: sample → evaluate → shade → project → splat, and its half with derivatives."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any, Literal

from rts.arguments import quoted
from rts.camera import Camera
from rts.channels import cropped_image
from rts.checks import changed_part, check_background, check_changes, check_channels, check_size, check_splatter
from rts.engines import (
    Engine,
    constants,
    engine_of,
    is_constant,
    namespace,
    suiting,
    suiting_scene,
    uncompiled,
    value_of,
)
from rts.errors import EmptyImageWarning, InputError, InputWarning, warn
from rts.evaluating import to_fine_splats, to_splats
from rts.interfaces import Splatter
from rts.operations.inset import averaged, painted_inset, with_inset
from rts.parts import Part
from rts.plugin_base import promised
from rts.records import Sampled, Splats
from rts.sampling.adaptive import Adaptive, finest
from rts.sampling.emptiness import why_empty
from rts.sampling.prepared import PreparedParts
from rts.sampling.pruning import planned
from rts.sampling.scenes import Scene, apron_of, sampled_scene, with_fine
from rts.trees import Array

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
            transparent. Of C or C + 1 channels where the image has C and alpha.
        capacity: number of rows to allot for the samples of a part inside `jax.jit`, where shapes must be known. None
            for the worst case, layers × cells. If a third of the cells are covered, pass a third of that. What does not
            fit is dropped, deepest layers first, and counted: `overflow` of `rts.sample` is above 0, then. Where the
            image is rendered in bands, it is the capacity of each band. With `rts.Adaptive` the fine samples have as
            many rows again, `layers` for each fine cell of active pixels and their aprons; pixels that find no room
            stay coarse, and are counted.
        engine: name of the engine to compute with, "torch" or "jax", where the scene alone does not tell: its arrays
            are all NumPy, but a shader holds a network. None for the engine of the arrays.

    Returns:
        (H, W, 4) premultiplied linear RGBA, row 0 on top; (H, W, C + 1), alpha last, where shaders say that they give
        C `channels`. Its dtype is the widest floating one of the torch or jax
        arrays in parts and camera; in a scene of NumPy arrays, the widest in any θ; at least float32. What else is
        NumPy, such as a camera in float64, does not widen it.

    Raises:
        InputError: what was given cannot be rendered.
        EngineError: torch and jax arrays in one scene.

    Warns:
        EmptyImageWarning: nothing is seen; it says why.
        AspectWarning: the camera is for images of another ratio of width to height.
        InputWarning: samples in front find no room in `capacity`, outside of `jax.jit`.
    """
    scene = Scene.of(parts, camera, sampler, engine)
    size = check_size(size, layers, capacity, finest(supersample))
    options: dict[str, Any] = dict(
        splatter=check_splatter(splatter), layers=layers, supersample=supersample, capacity=capacity
    )
    return _image(scene.at(size), size, check_background(background, size, scene.channels), **options)


class Renderer:
    """Renders prepared parts through one camera again and again; made by `PreparedParts.renderer`.

    What stays is checked and looked up once, and what changes at each call.
    """

    def __init__(
        self,
        parts: PreparedParts,
        camera: Camera,
        size: tuple[int, int],
        *,
        splatter: Any = "auto",
        layers: int | Literal["auto"] = 2,
        supersample: int | Adaptive = 1,
        background: Any = None,
        capacity: int | None = None,
        engine: str | None = None,
    ):
        scene, self._engine = Scene.of(parts, camera, "auto", engine), engine
        self._size = check_size(size, layers, capacity, finest(supersample))
        self._scene = scene.at(self._size)
        self._background = check_background(background, self._size, scene.channels)
        self._options: dict[str, Any] = dict(
            splatter=check_splatter(splatter), layers=layers, supersample=supersample, capacity=capacity
        )

    @uncompiled
    def __call__(self, index: int = 0, **changes: Any) -> Array:
        """The image, as `render` gives it, with some fields of one part changed.

        Args:
            index: the part.
            **changes: its `transform`, `theta`, `shader` or `cull`; they hold for this call alone.

        Returns:
            (H, W, 4) premultiplied linear RGBA.

        Raises:
            InputError: there is no such part or field, or what is given does not suit.
        """
        scene = self._scene
        check_changes(index, changes, len(scene.parts))
        if changes:
            parts = list(scene.parts)
            parts[index] = changed_part(index, parts[index], changes)
            if "shader" in changes:
                check_background(self._background, self._size, check_channels(parts))
            suited = suiting_scene(parts, scene.camera, engine=self._engine)
            scene = scene._replace(parts=parts, suited=suited)
        return _image(scene, self._size, self._background, **self._options)


PreparedParts._made = Renderer


def _image(scene: Scene, size: tuple[int, int], background: Array | None, **options: Any) -> Array:
    """The image of a scene for images of a size; see `render`."""
    suited = scene.suited if is_constant(background) else scene.suiting(background)
    return over_background(seen(image_of(scene, size, suited, **options), scene), background)


def image_of(
    scene: Scene,
    size: tuple[int, int],
    suited: tuple[Engine, Array | None],
    *,
    splatter: Splatter,
    layers: int | Literal["auto"],
    supersample: int | Adaptive,
    capacity: int | None,
) -> Array:
    """The image of a scene for images of a size, over nothing; `suited` is for the half with derivatives."""
    options: dict[str, Any] = dict(splatter=splatter, layers=layers, supersample=supersample, capacity=capacity)
    bands = bands_of(*size, layers, supersample)
    if isinstance(supersample, Adaptive) and supersample.contrast is not None:
        return _of_contrast(scene, size, suited, **options)
    if len(bands) == 1:
        sampled = _sampled(scene, scene.camera, size, **options)
        return splatted(sampled, scene, scene.camera, suited, splatter)
    images = []
    for top, rows in bands:
        window = scene.camera.window(size, (top, 0), (rows, size[1]))
        take = partial(_sampled, scene, window, (rows, size[1]), **options)
        images.append(suited[0].checkpoint(take, lambda s, w=window: splatted(s, scene, w, suited, splatter)))
    return namespace(*images).concat(images)


def _sampled(scene: Scene, window: Camera, size: tuple[int, int], *, capacity: int | None, **options: Any) -> Sampled:
    """The samples of a window of the image, with a warning if some that are in front find no room."""
    sampled = sampled_scene(scene, window, size, settles=True, capacity=capacity, **options)
    if capacity is not None:
        left_out, row = value_of(sampled.overflow), value_of(sampled.row)
        # Layers are left out from the deepest on.
        if left_out is not None and left_out.any() and row is not None and not (row[..., 1:, :, :] >= 0).any():
            warn(
                f"capacity is {capacity}, and {int(left_out.max())} samples find no room, some of them in front: the "
                f"image has holes; give a larger capacity, or None",
                InputWarning,
            )
    return sampled


def _of_contrast(
    scene: Scene,
    size: tuple[int, int],
    suited: tuple,
    *,
    splatter: Splatter,
    supersample: Adaptive,
    **options: Any,
) -> Array:
    """The image with fine samples also where colours change, which are those of the coarse samples."""
    options = dict(options, splatter=splatter)
    coarse = sampled_scene(scene, scene.camera, size, supersample=1, **options)
    splats = to_splats(coarse, scene.parts, scene.camera, scene.camera, *suited)
    colors = value_of(splats.rgba)
    if colors is None or colors.ndim != 2 or value_of(coarse.row) is None:
        raise InputError(
            f"contrast of Adaptive is {supersample.contrast}, and colours are traced; give None: what is sampled "
            f"cannot depend on values that are not known yet"
        )
    options |= {"adaptive": supersample, "colors": colors, "needed": scene.needed_by(splatter)}
    sampled = with_fine(scene, scene.camera, size, coarse, **options)
    return splatted(sampled, scene, scene.camera, suited, splatter, splats)


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
        InputError: the samples are not of these parts, their apron is too narrow for the splatter, or some that it
            needs were left out.
        EngineError: torch and jax arrays in one scene.
    """
    if not isinstance(sampled, Sampled):
        raise InputError(f"sampled is {quoted(sampled)}; expected what rts.sample gave")
    apron, fine = sampled.apron, sampled.supersample
    size = tuple((n - 2 * apron) // fine for n in sampled.row.shape[1:])
    scene = Scene.of(parts, camera, "auto", engine).at(size)
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
    if sampled.settled is not None and not (promised(splatter, "settles") and scene.parts[0].uniform):
        shaders = ", ".join(dict.fromkeys(repr(part.shader) for part in scene.parts))
        raise InputError(
            f"samples of cells amid one colour were left out (settles=True), which {splatter!r} and "
            f"{shaders} need; give rts.sample this splatter and these parts, or leave it out"
        )
    sampled = _narrowed(sampled, apron - apron_of(splatter))
    background = check_background(background, size, scene.channels)
    suited = scene.suiting(sampled, background)
    return over_background(splatted(sampled, scene, scene.camera, suited, splatter), background)


def _narrowed(sampled: Sampled, cells: int) -> Sampled:
    """Samples with an apron that is narrower by some cells."""
    if cells == 0:
        return sampled
    rows, columns = (slice(cells, n - cells) for n in sampled.row.shape[1:])
    row, depth = (x[:, rows, columns] for x in (sampled.row, sampled.depth))
    settled = None if sampled.settled is None else sampled.settled[rows, columns]
    fine = sampled.fine  # Its own apron may be wider than is needed.
    fine = None if fine is None else replace(fine, coarse=fine.coarse[rows, columns])
    facing = None if sampled.facing is None else sampled.facing[:, rows, columns]
    exits = None if sampled.exit is None else sampled.exit[rows, columns]
    known = {"fine": fine, "facing": facing, "settled": settled, "exit": exits}
    return replace(sampled, row=row, depth=depth, apron=sampled.apron - cells, **known)


def splatted(
    sampled: Sampled,
    scene: Scene,
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
    fine = sampled.fine
    if fine is None or not fine.flat:
        splats = splats or to_splats(sampled, scene.parts, scene.camera, window, *suited)
    if fine is None:
        assert splats is not None
        image = cropped_image(splatter, splats)
        return image if sampled.supersample == 1 else averaged(image, sampled.supersample)
    finer = to_fine_splats(fine, scene.parts, scene.camera, *suited)
    small = cropped_image(splatter, finer)
    if splats is None:
        told = fine.pixel, sampled.row[0], sampled.settled
        pixel, row, settled = constants(told, engine_of(small), small)
        return painted_inset(finer.rgba[0, ...], small, pixel, row, settled, fine.supersample)
    image = cropped_image(splatter, splats.replace(wanted=constants(fine.coarse, *suiting(splats.rgba))))
    return with_inset(image, small, constants(fine.pixel, engine_of(image), image), fine.supersample)


def bands_of(
    height: int, width: int, layers: int | Literal["auto"], supersample: int | Adaptive
) -> list[tuple[int, int]]:
    """(first row, number of rows) of the bands in which a supersampled image is rendered."""
    if isinstance(supersample, Adaptive) or supersample == 1:
        return [(0, height)]
    rows = max(1, BAND // (planned(layers) * int(supersample) ** 2 * width))
    count = math.ceil(height / rows)
    edges = [height * i // count for i in range(count + 1)]
    return [(top, end - top) for top, end in itertools.pairwise(edges)]


def seen(image: Array, scene: Scene, name: str = "the image") -> Array:
    """The image, with a warning if nothing is seen in it, which calls it by a name."""
    engine, (height, width) = engine_of(image), image.shape[:2]
    if not engine.on_host(image):
        seen = value_of(engine.namespace.any(image[..., -1] > 0))
        if seen is None or seen.any():
            return image
    known = engine.known(image)
    if known is None or known[..., :: max(1, height // 8), :: max(1, width // 8), -1].any() or known[..., -1].any():
        return image
    warn(f"nothing is seen in {name}: {why_empty(scene.parts, scene.camera)}", EmptyImageWarning)
    return image


def over_background(image: Array, background: Array | None) -> Array:
    """Images (..., H, W, 4) composited onto a background."""
    if background is None:
        return image
    over: Array = constants(background, engine_of(image), image)
    xp = namespace(image)
    if over.shape[-1] < image.shape[-1]:
        over = xp.concat([over, xp.ones_like(over[..., :1])], axis=-1)
    return image + (1 - image[..., -1:]) * over
