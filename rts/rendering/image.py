"""`rts.render`, sample → evaluate → shade → project → splat, and `rts.render_samples`, its differentiable half."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

from rts.arrays.argument_checks import quoted
from rts.arrays.engines import Context, constants, engine_of, is_constant, namespace, uncompiled, value_of
from rts.arrays.trees import Array
from rts.contracts.checks import check_background, check_splatter
from rts.contracts.records import Sampled
from rts.contracts.splatter import Splatter
from rts.errors import EmptyImageWarning, InputError, InputWarning, warn
from rts.rendering.arguments import BackgroundLike, Layers, SamplerLike, SplatterLike
from rts.rendering.outputs import Outputs, fronts_of
from rts.rendering.samples import sampled_scene
from rts.rendering.settings import RenderSettings
from rts.rendering.splats import to_splats
from rts.sampling.prepared import Prepared, warn_of_moved_vertices
from rts.sampling.scene import Grid, Scene
from rts.scene.camera import Camera
from rts.scene.parts import Part
from rts.splatting.channels import cropped_image


@uncompiled
def render(
    parts: Part | Sequence[Part] | Prepared,
    camera: Camera,
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
    """Render a scene, differentiably in everything that is a torch or jax array.

    Args:
        parts: one part or several, or the result of `prepare`; NumPy arrays in them are constants.
        camera: the camera.
        size: (height, width) in pixels.
        sampler: name or object of a `Sampler`.
        splatter: name or object of a `Splatter`. "auto" is "edges", which finds outlines between the centres of pixels.
        layers: K, the number of surface layers kept at each pixel. "auto" is 1 for "edges" if all parts are opaque;
            else it is the number that the image needs, up to 16 (a warning says if more are needed). Where the places
            of samples are traced, as in `jax.jit`, it is 4 if some part may be translucent, else at most 2.
        supersample: s, for s² samples a pixel, splatted on the finer grid and averaged. Large images are rendered in
            bands of rows, so that memory stays bounded; for a gradient each band is then rendered twice.
        background: colour (3,) or (4,), or image (H, W, 3 or 4), premultiplied, to composite onto; None for
            transparent. It has C or C + 1 channels if the image has C and alpha.
        capacity: number of rows to allot for the samples of a part inside `jax.jit`, where shapes must be known. None
            for the worst case, layers × cells. If a third of the cells are covered, pass a third of layers × cells.
            Samples beyond the capacity are dropped, deepest layers first, and `overflow` of `rts.sample` counts them.
            If the image is rendered in bands, each band has this capacity. For the splatter "edges" there is also room
            for edge crossings: 8 a row and a column of the grid, or `capacity` / 4 if that is more. Those beyond
            come with a warning: pass more where there are many edges.
        engine: name of the engine to compute with, "torch" or "jax". Needed where all arrays are NumPy, but a shader
            holds a network. None for the engine of the arrays.
        outputs: names of what to return, computed together; None for the image alone:

            - "color" (H, W, C + 1): the image, as without `outputs`; the only one with the background in it.
            - "alpha" (H, W, 1): what share of the pixel is covered.
            - "depth" (H, W, 1): linear depth along the camera's axis, in world units.
            - "normal" (H, W, 3): of unit length, world space, on the side that the surface says, not the camera's.
            - "position" (H, W, 3): world space.
            - "uv" (H, W, 2): 0 on parts without.
            - the name of another attribute of the G-buffer, such as "uv_footprint": all parts must have it.
            - "depth_front" (H, W, 1): the depth of the surface in front at the pixel's centre, without edges. With
              another splatter than "edges" its derivative is that of the surface's point, which may leave the centre.
            - "part", "triangle" (H, W, 1) int32: the indices of this part, and of its triangle; −1 where empty.

            "depth", "normal", "position", "uv" and attributes are means over what is covered of a pixel. They have
            derivatives at outlines as colours do, and are 0 in pixels of which less than a thousandth is covered.

    Returns:
        (H, W, 4) premultiplied linear RGBA, row 0 on top; (H, W, C + 1), alpha last, for shaders with C `channels`.
        The dtype is the widest floating one of the torch or jax arrays in parts and camera; in a scene of NumPy
        arrays, the widest in any θ; at least float32. Other NumPy arrays, such as a camera in float64, do not widen it.
        With `outputs` a dict: name → array.

    Raises:
        InputError: an argument is wrong; the scene cannot be rendered; there is no output of this name.
        EngineError: torch and jax arrays in one scene, or arrays on two devices.
        PluginError: a plugin cannot be imported, such as for want of a package.

    Warns:
        EmptyImageWarning: nothing is seen; the warning says why.
        AspectWarning: the camera is for images of another ratio of width to height.
        InputWarning: samples, or edge crossings, find no room in `capacity`; nothing reads an entry of θ; a
            culled part is wound inside out; a sampler cannot sample single points, so that outlines lie midway between
            centres; vertices of prepared parts have changed; coordinates are too large for float32.
        LayersWarning: surfaces or light behind the last layer are left out.
    """
    scene, wanted = Scene.of(parts, camera, sampler, engine), None if outputs is None else Outputs(outputs)
    if isinstance(parts, Prepared):
        warn_of_moved_vertices(scene.parts, scene.entries)
    size, settings = RenderSettings.checked(size, splatter, layers, supersample, capacity)
    background = check_background(background, size, scene.channels)
    scene = scene.at(size)
    return (
        image_over(scene, size, background, settings)
        if wanted is None
        else outputs_over(scene, size, background, settings, wanted)
    )


def image_over(scene: Scene, size: tuple[int, int], background: Array | None, settings: RenderSettings) -> Array:
    """The image (H, W, C + 1) of a checked scene over a checked background; see `render`."""
    context = scene.context if background is None else scene.context_with(background)
    return over_background(warned_if_empty(image_of(scene, size, context, settings), scene), background)


def outputs_over(
    scene: Scene, size: tuple[int, int], background: Array | None, settings: RenderSettings, outputs: Outputs
) -> dict[str, Array]:
    """The outputs of a checked scene, the colours over a checked background; see `render`."""
    context = scene.context if is_constant(background) else scene.context_with(background)
    widened, settings = outputs.of_scene(scene), outputs.of_settings(settings).of(scene)
    splatter = settings.splatter
    assert splatter is not None

    def drawn(sampled: Sampled, grid: Grid) -> tuple[Array, ...]:
        splats = to_splats(sampled, widened.parts, widened.camera, grid, context)
        return cropped_image(splatter, splats), *fronts_of(outputs.fronts, sampled, splats)

    image, *fronts = _by_bands(widened, size, context, settings, drawn)
    found = outputs.taken(warned_if_empty(image, scene), fronts, scene.channels)
    if "color" in found:
        found["color"] = over_background(found["color"], background)
    return found


def image_of(scene: Scene, size: tuple[int, int], context: Context, settings: RenderSettings) -> Array:
    """The image (H, W, C + 1) of a checked scene, without a background; for `context` see `splatted`."""
    settings = settings.of(scene)
    splatter = settings.splatter
    assert splatter is not None

    def drawn(sampled: Sampled, grid: Grid) -> tuple[Array, ...]:
        return (splatted(sampled, scene, grid, context, splatter),)

    return _by_bands(scene, size, context, settings, drawn)[0]


def _by_bands(
    scene: Scene,
    size: tuple[int, int],
    context: Context,
    settings: RenderSettings,
    draw: Callable[[Sampled, Grid], tuple[Array, ...]],
) -> tuple[Array, ...]:
    """The arrays (H, W, ·) that `draw` makes of the samples of the image, drawn whole, or in bands that are joined."""
    bands = settings.bands(size)
    if len(bands) == 1:
        grid = settings.grid(scene, scene.camera, size)
        return draw(_sampled(scene, grid, settings), grid)
    drawn = []
    for top, rows in bands:
        window = scene.camera.window(size, (top, 0), (rows, size[1]))
        grid = settings.grid(scene, window, (rows, size[1]))
        take = partial(_sampled, scene, grid, settings)
        drawn.append(context.engine.checkpoint(take, lambda s, g=grid: draw(s, g)))
    return tuple(namespace(*arrays).concat(arrays) for arrays in zip(*drawn, strict=True))


def _sampled(scene: Scene, grid: Grid, settings: RenderSettings) -> Sampled:
    """The samples of cells of the image, with a warning if front samples exceed the capacity."""
    sampled = sampled_scene(scene, grid, settings)
    if settings.capacity is not None:
        left_out, row = value_of(sampled.overflow), value_of(sampled.row)
        # The deepest layers are left out first.
        if left_out is not None and left_out.any() and row is not None and not (row[..., 1:, :, :] >= 0).any():
            warn(
                f"capacity is {settings.capacity}, and {int(left_out.max())} samples find no room, some of them in "
                f"front: the image has holes; give a larger capacity, or None",
                InputWarning,
            )
    return sampled


@uncompiled
def render_samples(
    sampled: Sampled,
    parts: Part | Sequence[Part],
    camera: Camera,
    *,
    splatter: SplatterLike = "auto",
    background: BackgroundLike = None,
    engine: str | None = None,
) -> Array:
    """The half of `render` with derivatives: evaluate the parts at the samples, shade, project and splat.

    Args:
        sampled: the result of `sample` for these parts. θ, transform and camera may have other values now, with one
            exception: if a part's θ is NumPy, beside torch or jax arrays, `sample` may have evaluated its surface, and
            new values have no effect.
        parts: as in `render`.
        camera: as in `render`.
        splatter: name or object of a `Splatter`. "edges" needs samples with outlines.
        background: as in `render`.
        engine: as in `render`.

    Returns:
        The image (H, W, 4), or (H, W, C + 1), as in `render`.

    Raises:
        InputError: an argument is wrong; the samples are of another number of parts, their border is too narrow for the
            splatter, or samples that it needs were left out.
        EngineError: torch and jax arrays in one scene, or arrays on two devices.
    """
    if not isinstance(sampled, Sampled):
        raise InputError(f"sampled is {quoted(sampled)}; expected what rts.sample gave")
    border, fine = sampled.border, sampled.supersample
    size = tuple((n - 2 * border) // fine for n in sampled.row.shape[1:])
    scene = Scene.of(parts, camera, "auto", engine).at(size)
    if len(scene.parts) != len(sampled.samples):
        raise InputError(
            f"{len(scene.parts)} parts were given for the samples of {len(sampled.samples)}; pass the same parts"
        )
    splatter = check_splatter(splatter)
    if "outlines" in splatter.reads and sampled.stencil is None:
        raise InputError(
            f"the samples have no outlines, which {splatter!r} reads; give it to rts.sample, too, or take another"
        )
    if border < splatter.reach + 1:
        raise InputError(
            f"the samples have a border of {border} cells, and {splatter!r}, which reaches {splatter.reach}, needs "
            f"{splatter.reach + 1}; give it to rts.sample, too"
        )
    if "outlines" not in splatter.reads:
        sampled = _narrowed(replace(sampled, stencil=None), border - splatter.reach - 1)
    background = check_background(background, size, scene.channels)
    context = scene.context_with(sampled, background)
    grid = Grid.of_samples(sampled, scene.parts, scene.camera, context)
    return over_background(splatted(sampled, scene, grid, context, splatter), background)


def _narrowed(sampled: Sampled, count: int) -> Sampled:
    """Samples with a border that is narrower by `count` cells."""
    if count == 0:
        return sampled
    rows, columns = (slice(count, n - count) for n in sampled.row.shape[1:])
    return replace(sampled, cells=sampled.cells.map(lambda x: x[..., rows, columns]), border=sampled.border - count)


def splatted(sampled: Sampled, scene: Scene, grid: Grid, context: Context, splatter: Splatter) -> Array:
    """The image (H, W, C + 1) of cells, those of the camera's image or a window of it, from the samples in them.

    Args:
        sampled: the samples.
        scene: the checked scene; shaders see its camera, that of the whole image.
        grid: the cells.
        context: the engine to compute with, and an exemplar of its constants.
        splatter: a splatter.
    """
    return cropped_image(splatter, to_splats(sampled, scene.parts, scene.camera, grid, context))


def warned_if_empty(image: Array, scene: Scene, name: str = "the image") -> Array:
    """The image (H, W, C + 1) itself; a warning names it if alpha is 0 everywhere. A traced image is not looked at."""
    engine, (height, width) = engine_of(image), image.shape[:2]
    pixels = engine.at_hand(image)
    if pixels is None:
        visible = value_of(engine.namespace.any(image[..., -1] > 0))
        if visible is None or visible.any():
            return image
    elif pixels[..., :: max(1, height // 8), :: max(1, width // 8), -1].any() or pixels[..., -1].any():
        return image
    from rts.advice.empty_images import why_empty

    warn(f"nothing is seen in {name}: {why_empty(scene.parts, scene.camera)}", EmptyImageWarning)
    return image


def over_background(image: Array, background: Array | None) -> Array:
    """Images (..., H, W, C + 1) composited onto a background of C or C + 1 channels, opaque if C; None for none."""
    if background is None:
        return image
    over: Array = constants(background, engine_of(image), image)
    xp = namespace(image)
    if over.shape[-1] < image.shape[-1]:
        over = xp.concat([over, xp.ones_like(over[..., :1])], axis=-1)
    return image + (1 - image[..., -1:]) * over
