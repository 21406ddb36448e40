"""Several views rendered in one call, of one scene or of a scene each, side by side in pictures where possible."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any, TypeVar

import numpy as np

from rts.arrays.array_functions import averaged, described, shape_of
from rts.arrays.engines import Context, context_of_scene, is_constant, namespace, uncompiled
from rts.arrays.trees import Array
from rts.compiling.threads import each
from rts.contracts.checked_parts import check_cameras
from rts.contracts.checks import check_background
from rts.contracts.records import Sampled
from rts.errors import InputError
from rts.rendering.arguments import BackgroundLike, Layers, SamplerLike, SplatterLike
from rts.rendering.image import image_of, outputs_over, over_background, splatted, warned_if_empty
from rts.rendering.outputs import Outputs
from rts.rendering.samples import sampled_scene
from rts.rendering.settings import RenderSettings
from rts.rendering.shade import shaded_at_once
from rts.sampling.host_scenes import in_engine, with_attributes
from rts.sampling.picture import Picture, at_once
from rts.sampling.scene import Grid, Scene
from rts.sampling.side_by_side import DrawnView
from rts.scene.camera import Camera
from rts.splatting.channels import cropped_image
from rts.views.joint_views import sampled_at_once
from rts.views.sampled_views import Views, laid_side_by_side
from rts.views.scenes import SceneParts, check_scene_channels, distinct, scenes_of_views
from rts.views.splats import views_to_splats

_T = TypeVar("_T")


@uncompiled
def render_views(
    parts: SceneParts | Sequence[SceneParts],
    cameras: Sequence[Camera] | Camera,
    size: tuple[int, int],
    *,
    sampler: SamplerLike = "auto",
    splatter: SplatterLike = "auto",
    layers: Layers = "auto",
    supersample: int = 1,
    background: BackgroundLike = None,
    capacity: int | None = None,
    engine: str | None = None,
    outputs: Sequence[str] | None = None,
) -> Array:
    """Render several views, of one scene or of a scene each. Images equal a loop of `render` up to rounding.

    Views lie side by side in pictures of at most 1024² cells. Python's overhead, results for the whole of θ such as
    smooth normals, and one splat then serve all views. So does one call of a shader that `takes_views`, as the built-in
    shaders without mipmaps do, if it reads the same entries of θ in all views.

    Views that show small meshes whole are also sampled at once, outlines included; see the guide "Many parts" for which
    meshes these are. Other views of one scene are sampled one by one. Other scenes are rendered one after another; so
    are all with `layers="auto"`, but not with "edges" where all is opaque, and if images are rendered in bands.

    With jax, and under `torch.func`, scenes are rendered one after another. Views of one scene share a picture only by
    "edges", if all fit into one, and if each shader takes views or gives one colour. NumPy views that are too large for
    a picture, or drawn by another splatter, are rendered one on each core. With torch and jax all views are in memory
    at once, with a gradient or without.

    Args:
        parts: as in `render`, of one scene for all views; or a list of B scenes, each a list of parts or the result of
            `prepare`.
        cameras: B cameras, or one stacked by `Camera.stack`.
        size: (height, width) of each view, in pixels.
        sampler: as in `render`.
        splatter: as in `render`.
        layers: as in `render`.
        supersample: as in `render`.
        background: as in `render`, of every view; or (B, H, W, ·), one for each.
        capacity: as in `render`; of each view.
        engine: as in `render`.
        outputs: as in `render`. With an output of the sample in front, views are rendered one after another.

    Returns:
        (B, H, W, 4), as in `render`; with `outputs` a dict: name → array (B, H, W, ·).

    Raises:
        InputError: an argument is wrong; the scene cannot be rendered.
        EngineError: torch and jax arrays in one scene, or arrays on two devices.
        PluginError: a plugin cannot be imported, such as for want of a package.

    Warns:
        EmptyImageWarning: nothing is seen in a view; the warning says why.
        AspectWarning: a camera is for images of another ratio of width to height.
    """
    wanted, camera_list = None if outputs is None else Outputs(outputs), check_cameras(cameras)
    size, settings = RenderSettings.checked(size, splatter, layers, supersample, capacity)
    scenes = scenes_of_views(parts, camera_list, sampler, engine)
    context = context_of_scene([part for scene in distinct(scenes) for part in scene.parts], camera_list, engine=engine)
    scenes = [scene._replace(context=context).at(size) for scene in scenes]
    channels = check_scene_channels(scenes)
    background = _check_backgrounds(background, len(camera_list), size, channels)
    if not is_constant(background):
        context = scenes[0].context_with([scene.parts for scene in distinct(scenes)], camera_list, background)
    if wanted is not None and wanted.fronts:
        each_view = [outputs_over(view_scene, size, None, settings, wanted) for view_scene in scenes]
        found = {name: namespace(x).stack([view[name] for view in each_view]) for name, x in each_view[0].items()}
    else:
        shown = scenes if wanted is None else wanted.of_scenes(scenes)
        images = _images(shown, size, context, settings)
        for b, view_scene in enumerate(scenes):
            warned_if_empty(images[b], view_scene, f"view {b}")
        if wanted is None:
            return over_background(images, background)
        found = wanted.taken(images, (), channels)
    if "color" in found:
        found["color"] = over_background(found["color"], background)
    return found


def _check_backgrounds(background: Any, count: int, size: tuple[int, int], channels: int) -> Array | None:
    """The background as an array: one for all views, or (B, H, W, ·), one for each view; None stays None."""
    if background is None or len(shape_of(background)) < 4:
        return check_background(background, size, channels)
    if shape_of(background)[0] != count:
        raise InputError(f"background {described(background)}; expected ({count}, ...), one for each view, or one")
    return namespace(background).stack([check_background(background[b, ...], size, channels) for b in range(count)])


def _images(scenes: Sequence[Scene], size: tuple[int, int], context: Context, settings: RenderSettings) -> Array:
    """The images (B, H, W, C + 1) of several views, without a background."""
    of_scene = {id(scene.parts): settings.of(scene) for scene in distinct(scenes)}
    of_views = [of_scene[id(scene.parts)] for scene in scenes]
    views = [_view(scene, size, chosen) for scene, chosen in zip(scenes, of_views, strict=True)]
    kinds: dict[Any, list[int]] = {}
    for b, view in enumerate(views):
        kinds.setdefault(None if view is None else (of_views[b], view.kind), []).append(b)
    if len(of_scene) == 1 and len(kinds) > 1:  # Views of one scene have another way to share a picture.
        kinds = {None: list(range(len(scenes)))}
    images: list[Any] = [None] * len(scenes)
    for kind, indices in kinds.items():
        of_kind = [scenes[b] for b in indices]
        if kind is not None and len(indices) > 1:
            together = [view for b in indices if (view := views[b]) is not None]
            drawn = _drawn_at_once(together, context, of_views[indices[0]])
        elif len(distinct(of_kind)) == 1 and len(of_kind) > 1:
            drawn = _images_of_scene(of_kind, size, context, of_views[indices[0]])
        else:
            drawn = [image_of(scene, size, context, settings) for scene in of_kind]
        if len(indices) == len(scenes) and not isinstance(drawn, list):
            return drawn
        for b, image in zip(indices, drawn, strict=True):
            images[b] = image
    return namespace(*images).stack(images)


def _view(scene: Scene, size: tuple[int, int], settings: RenderSettings) -> DrawnView | None:
    """The view of a scene that can be drawn along with others; None for one that has to be drawn by itself."""
    if settings.layers == "auto" or len(settings.bands(size)) > 1 or settings.capacity is not None:
        return None
    grid = settings.grid(scene, scene.camera, size)
    return DrawnView.of(scene, grid) if at_once(grid.size) > 1 else None


def _drawn_at_once(views: Sequence[DrawnView], context: Context, settings: RenderSettings) -> Array:
    """The images (B, H, W, C + 1) of views of one kind."""
    cells = views[0].grid.size
    chunks = _chunks(views, at_once(cells))
    place = Picture.of(len(chunks[0]), cells)
    pictures = [sampled_at_once(chunk, place._replace(views=len(chunk)), settings) for chunk in chunks]
    return _as_pictures(pictures, [view.scene for view in views], context, settings)


def _images_of_scene(
    scenes: Sequence[Scene], size: tuple[int, int], context: Context, settings: RenderSettings
) -> Array:
    """The images (B, H, W, C + 1) of several views of one scene, without a background."""
    differentiates, (engine, like) = context.engine.differentiates, scenes[0].context
    # With layers="auto" sampling may warn, and warnings belong to this thread.
    several = settings.layers != "auto" and _concurrent(scenes[0])
    if settings.layers != "auto" and len(settings.bands(size)) == 1:
        height, width = (settings.supersample * n + 2 * settings.border for n in size)
        chunks = _chunks(scenes, at_once((height, width)))
        place = Picture.of(len(chunks[0]), (height, width))
        # Which rows are in use is unknown if they are padded, so that one call must serve all views.
        one_call = len(chunks) == 1 and all(shaded_at_once(part) for part in scenes[0].parts)
        outlined = settings.finds_outlines and place.views > 1 and (one_call or not engine.padded(like))
        if (several and differentiates) or outlined:
            views = _sampled(scenes, size, settings)
            pictures = [
                laid_side_by_side(chunk, place._replace(views=len(chunk))) for chunk in _chunks(views, place.views)
            ]
            complete = [_in_engine(picture, scenes[0]) for picture in pictures if picture is not None]
            if len(complete) == len(pictures):
                return _as_pictures(complete, scenes, context, settings)
            return _one_by_one(scenes, views, context, settings)
    draw = partial(image_of, size=size, context=context, settings=settings)
    images = [draw(scene) for scene in (scenes[:1] if several and not differentiates else scenes)]
    if len(images) < len(scenes):
        # A shader may close over arrays of an engine whose transforms belong to this thread.
        images += each(draw, scenes[1:]) if type(images[0]) is np.ndarray else map(draw, scenes[1:])
    return namespace(*images).stack(images)


def _sampled(scenes: Sequence[Scene], size: tuple[int, int], settings: RenderSettings) -> list[Sampled]:
    """The samples of each view, on the host if they are found there; each core samples one at a time, if it may."""

    def sample_view(view_scene: Scene) -> Sampled:
        return sampled_scene(view_scene, settings.grid(view_scene, view_scene.camera, size), settings, stays=True)

    return each(sample_view, scenes) if _concurrent(scenes[0]) else list(map(sample_view, scenes))


def _in_engine(views: Views, scene: Scene) -> Views:
    """Views of a scene in arrays of its engine, with attributes of constant parts, wherever samples were found."""
    on_host = type(views.sampled.row) is np.ndarray
    return views._replace(sampled=in_engine(with_attributes(views.sampled, scene), scene)) if on_host else views


def _chunks(views: Sequence[_T], most: int) -> list[Sequence[_T]]:
    """Views in the fewest groups of at most `most` views, of about equal size."""
    count = -(-len(views) // most)
    size = -(-len(views) // count)
    return [views[first : first + size] for first in range(0, len(views), size)]


def _one_by_one(scenes: Sequence[Scene], views: Sequence[Sampled], context: Context, settings: RenderSettings) -> Array:
    """The images (B, H, W, C + 1) of sampled views, splatted view by view."""
    images, splatter = [], settings.splatter
    assert splatter is not None
    for sampled, scene in zip(views, scenes, strict=True):
        grid = Grid.of_samples(sampled, scene.parts, scene.camera, context)
        images.append(splatted(sampled, scene, grid, context, splatter))
    return namespace(*images).stack(images)


def _as_pictures(
    pictures: Sequence[Views], scenes: Sequence[Scene], context: Context, settings: RenderSettings
) -> Array:
    """The images (B, H, W, C + 1) of sampled views, splatted picture by picture."""
    images, cameras, splatter = [], [scene.camera for scene in scenes], settings.splatter
    parts = [scene.parts for scene in scenes]
    assert splatter is not None
    for views, splats in zip(pictures, views_to_splats(pictures, parts, cameras, context), strict=True):
        cells = views.picture.split(cropped_image(splatter, splats), views.sampled.border)
        xp, (count, height, width, channels), factor = namespace(cells), cells.shape, views.sampled.supersample
        cells = averaged(xp.reshape(cells, (count * height, width, channels)), factor)
        images.append(xp.reshape(cells, (count, height // factor, width // factor, channels)))
    return images[0] if len(images) == 1 else namespace(*images).concat(images)


def _concurrent(scene: Scene) -> bool:
    """True if several threads may sample the scene at once."""
    engine, like = scene.context
    # On devices work is queued by thread.
    on_host = like is None or engine.on_host(like)
    callees = *scene.samplers, *(part.surface for part in scene.parts)
    return on_host and engine.concurrent() and all(callee.concurrent for callee in callees)
