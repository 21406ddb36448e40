"""`rts.sample`, the half of `rts.render` without derivative: all parts of a scene sampled on one grid."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from rts.arrays.engines import uncompiled
from rts.contracts.checks import check_memory
from rts.contracts.records import Request, Sampled
from rts.rendering.arguments import Layers, SamplerLike, SplatterLike
from rts.rendering.settings import RenderSettings
from rts.sampling.host_scenes import in_engine, on_the_host, real_of, with_attributes
from rts.sampling.layer_count import has_full_stacks, with_all_layers
from rts.sampling.prepared import Prepared
from rts.sampling.scene import Grid, Scene
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
    supersample: int = 1,
    capacity: int | None = None,
    engine: str | None = None,
) -> Sampled:
    """Find where the rays through cells' centres meet the surfaces: the half of `render` without derivative.

    Args:
        parts: as in `render`.
        camera: as in `render`.
        size: as in `render`.
        sampler: as in `render`.
        splatter: the splatter for these samples: the border suits its reach, and outlines are found if it reads them.
            None takes all layers, without outlines.
        layers: as in `render`; with no splatter "auto" is the number of layers that there are, up to 16.
        supersample: as in `render`.
        capacity: as in `render`.
        engine: as in `render`.

    Returns:
        Samples for `render_samples`, which may be handed to a function under `jax.jit`.

    Raises:
        InputError: an argument is wrong; the scene cannot be sampled.
        EngineError: torch and jax arrays in one scene, or arrays on two devices.
        PluginError: a plugin cannot be imported, such as for want of a package.
    """
    scene = Scene.of(parts, camera, sampler, engine)
    size, settings = RenderSettings.checked(
        size, "auto" if splatter is None else splatter, layers, supersample, capacity
    )
    scene, settings = scene.at(size), replace(settings, splatter=None) if splatter is None else settings
    settings = settings.of(scene)
    return sampled_scene(scene, settings.grid(scene, scene.camera, size), settings, one_shader=False)


def sampled_scene(
    scene: Scene, grid: Grid, settings: RenderSettings, one_shader: bool = True, stays: bool = False
) -> Sampled:
    """The samples of the cells of an image, or of a window of it; see `sample`, `RenderSettings.grid` and its `of`.

    With `one_shader` they serve the shaders of the scene and derivatives in its values alone, so that cells of one
    colour may name one sample, and samples beside outlines need not tell motions of what is constant. With `stays`,
    samples that were found on the host stay there as they are, without `with_attributes` and `in_engine`.
    """
    factor, capacity = settings.supersample, settings.capacity
    border, outlines = settings.border, settings.finds_outlines
    height, width = grid.size[0] - 2 * border, grid.size[1] - 2 * border
    check_memory(height, width, settings.most_layers, capacity, gradient=scene.context.engine.differentiates)
    given, (scene, grid) = scene, on_the_host(scene, grid)
    required = settings.required([given] if one_shader else None)
    # Inside of one colour nothing depends on where a sample lies.
    same, layers = not required.colors and outlines and settings.layers == 1 and not settings.fronts, settings.layers
    request = Request(capacity, triangles=outlines or settings.fronts)
    sampled = None
    if outlines and layers != "auto" and not settings.fronts and not scene.cameras:
        from rts.outlines.of_traced import sampled_by_one_call

        sampled = sampled_by_one_call(scene, grid, layers, required, same, capacity)
    if sampled is not None:
        return replace(sampled, supersample=factor, border=border)
    at_once, none = None, [False] * len(scene.parts)
    if scene.cameras and capacity is None and not settings.fronts:
        from rts.outlines.of_joint import AtOnce

        # Samples do not spread, so that what lies behind an opaque one has no effect.
        at_once = AtOnce.of(scene, grid, scene.opaque if outlines else none)

    def taken(count: int) -> Sampled:
        if at_once is not None:
            return at_once.centres(count)
        from rts.sampling.merging import sampled_parts

        return sampled_parts(scene, grid, request, count, 1 if outlines and capacity is None else None)

    least = 1
    while True:
        sampled = with_all_layers(taken, all(scene.opaque), least) if layers == "auto" else taken(layers)
        if at_once is not None:
            sampled = at_once.found(sampled, required if outlines else None, real_of(scene), same)
        elif outlines:
            from rts.outlines.of_scene import with_outlines

            triangle, sampled = sampled.triangle, with_outlines(sampled, scene, grid, required, capacity)
            sampled = sampled.replace(triangle=triangle) if settings.fronts else sampled
        if layers != "auto" or not has_full_stacks(sampled, scene.opaque):
            break
        least = 2 * sampled.row.shape[-3]
    sampled = replace(sampled, supersample=factor, border=border)
    return in_engine(with_attributes(sampled, given), given) if scene.cameras and not stays else sampled
