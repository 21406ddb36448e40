"""Several views of one scene."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any, Literal

import numpy as np

from rts.arrays import described, shape_of
from rts.camera import Camera
from rts.channels import cropped_image
from rts.checks import check_background, check_cameras, check_size, check_splatter, suited_sampler
from rts.engines import Engine, is_constant, namespace, suiting_scene, uncompiled
from rts.errors import InputError
from rts.evaluating import evaluated_together, to_splats
from rts.interfaces import Part, Splatter
from rts.operations.inset import averaged
from rts.records import Splats
from rts.rendering import bands_of, image_of, over_background, seen, splatted
from rts.sampling.adaptive import Adaptive, finest
from rts.sampling.prepared import PreparedParts
from rts.sampling.scenes import Scene, sampled_scene
from rts.splatting.side_by_side import Picture, at_once
from rts.threads import each
from rts.trees import Array


@uncompiled
def render_views(
    parts: Part | Sequence[Part] | PreparedParts,
    cameras: Sequence[Camera] | Camera,
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
    """Render several views of a scene; they are those of a loop of `render`, but for rounding.

    NumPy scenes are rendered a view to each core. With torch views are sampled so, and the surface is evaluated once
    for the samples of all: what it computes of the whole of θ, such as smooth normals, serves all views. With jax, with
    `layers="auto"`, under `torch.func`, in bands, and wherever a sampler is not `concurrent`, one view follows the
    other. With torch memory is that of all views at once, with a gradient or without.

    Args:
        parts: as in `render`.
        cameras: B cameras, or what `Camera.stack` made of them.
        size: (height, width) of each view, in pixels.
        sampler: as in `render`.
        splatter: as in `render`.
        layers: as in `render`.
        supersample: as in `render`.
        background: as in `render`, of every view; or (B, H, W, ·), one for each.
        capacity: as in `render`; of each view.
        engine: as in `render`.

    Returns:
        (B, H, W, 4), as in `render`.

    Raises:
        InputError: what was given cannot be rendered.
        EngineError: torch and jax arrays in one scene.

    Warns:
        EmptyImageWarning: nothing is seen in a view; it says why.
        AspectWarning: a camera is for images of another ratio of width to height.
    """
    listed = check_cameras(cameras)
    scene, size = Scene.of(parts, listed[0], sampler, engine), check_size(size, layers, capacity, finest(supersample))
    suited = suiting_scene(scene.parts, listed, engine=engine)
    scenes = [scene._replace(camera=camera, suited=suited).at(size) for camera in listed]
    background = _check_backgrounds(background, len(listed), size, scene.channels)
    if not is_constant(background):
        suited = scene.suiting(listed, background)
    options: dict[str, Any] = dict(
        splatter=check_splatter(splatter), layers=layers, supersample=supersample, capacity=capacity
    )
    images = _images(scenes, size, suited, **options)
    images = [seen(image, own, f"view {b}") for b, (image, own) in enumerate(zip(images, scenes, strict=True))]
    return over_background(namespace(*images).stack(images), background)


def _check_backgrounds(background: Any, count: int, size: tuple[int, int], channels: int) -> Array | None:
    """One background for all views, or one for each."""
    if background is None or len(shape_of(background)) < 4:
        return check_background(background, size, channels)
    if shape_of(background)[0] != count:
        raise InputError(f"background {described(background)}; expected ({count}, ...), one for each view, or one")
    return namespace(background).stack([check_background(background[b, ...], size, channels) for b in range(count)])


def _images(
    scenes: Sequence[Scene], size: tuple[int, int], suited: tuple[Engine, Array | None], **options: Any
) -> list[Array]:
    """The images of several views of one scene, over nothing."""
    draw = partial(image_of, size=size, suited=suited, **options)
    if not _concurrent(scenes[0]) or options["layers"] == "auto":  # The latter may warn, which is for this thread.
        return [draw(scene) for scene in scenes]
    if not suited[0].differentiates:
        # A shader may close over arrays of an engine whose transforms belong to this thread.
        image = draw(scenes[0])
        rest = scenes[1:]
        return [image, *(each(draw, rest) if type(image) is np.ndarray else map(draw, rest))]
    supersample: Any = options["supersample"]
    whole = len(bands_of(*size, options["layers"], supersample)) == 1
    if not whole or (isinstance(supersample, Adaptive) and supersample.contrast is not None):
        return [draw(scene) for scene in scenes]

    views = each(lambda own: sampled_scene(own, own.camera, size, settles=True, **options), scenes)
    evaluated = evaluated_together(views, scenes[0].parts, *suited)
    splats = [
        to_splats(sampled, own.parts, own.camera, own.camera, *suited, known)
        for own, sampled, known in zip(scenes, views, evaluated, strict=True)
    ]
    splatter = options["splatter"]
    if evaluated[0] is None or views[0].fine is not None:
        shown = zip(scenes, views, splats, strict=True)
        return [splatted(sampled, own, own.camera, suited, splatter, given) for own, sampled, given in shown]
    most = at_once(splats[0].row.shape[1:])
    images = []
    for first in range(0, len(splats), most):
        images += _side_by_side(splats[first : first + most], splatter, int(options["supersample"]))
    return images


def _side_by_side(splats: Sequence[Splats], splatter: Splatter, side: int) -> list[Array]:
    """The images of several views, by one splat."""
    picture = Picture.of(len(splats), splats[0].row.shape[1:])
    cells = picture.apart(cropped_image(splatter, picture.joined(splats)), splats[0].border)
    xp, (count, height, width, channels) = namespace(cells), cells.shape
    image = cells if side == 1 else averaged(xp.reshape(cells, (count * height, width, channels)), side)
    return list(xp.unstack(xp.reshape(image, (count, height // side, width // side, channels))))


def _concurrent(scene: Scene) -> bool:
    """Whether several threads may sample the scene at once."""
    chosen = (suited_sampler(s, part, scene.camera) for s, part in zip(scene.samplers, scene.parts, strict=True))
    engine, like = scene.suited
    # On devices work is queued by thread.
    on_host = like is None or engine.on_host(like)
    return on_host and engine.concurrent() and all(sampler.concurrent for sampler in chosen)
