"""`rts.prepare`, and a renderer for loops: fixed parts of a scene are checked, looked up and built once."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from rts.arrays.engines import context_of_scene, uncompiled
from rts.arrays.trees import Array
from rts.contracts.checked_parts import changed_part, check_changes, check_channels
from rts.contracts.checks import check_background
from rts.rendering.arguments import BackgroundLike, Layers, SamplerLike, SplatterLike
from rts.rendering.image import image_over
from rts.rendering.settings import RenderSettings
from rts.sampling.prepared import Prepared, warn_of_moved_vertices
from rts.sampling.scene import Scene
from rts.scene.camera import Camera
from rts.scene.parts import Part


class PreparedParts(Prepared):
    """Parts with structures that their samplers built, for `render` and `sample` in place of parts.

    The argument `sampler` of these functions has no effect then. Let a function under `jax.jit` close over this object
    rather than take it as an argument.
    """

    def renderer(self, camera: Camera, size: tuple[int, int], **settings: Any) -> Renderer:
        """A function that renders these parts, for loops: `draw(transform=…)`, with the changes of each call.

        Args:
            camera: as in `render`.
            size: as in `render`.
            **settings: `splatter`, `layers`, `supersample`, `background`, `capacity` and `engine`, as in `render`.

        Returns:
            A function `(index=0, **changes)`, which returns the image of `render` with some fields of one part changed.

        Raises:
            InputError: an argument is wrong; the scene cannot be rendered.
        """
        return Renderer(self, camera, size, **settings)


def prepare(
    parts: Part | Sequence[Part],
    sampler: SamplerLike = "auto",
    *,
    camera: Camera | None = None,
    size: tuple[int, int] | None = None,
) -> PreparedParts:
    """Build the structures that a sampler needs of each part, once.

    `raster` sorts the triangles of large meshes by place, so that it can skip many at once. Sorting takes as long as
    drawing them some 5 to 40 times; the order takes 22 bytes for each triangle of a closed mesh.

    Args:
        parts: one part or several, not traced.
        sampler: as in `rts.render`; "auto" assumes that the triangles are static.
        camera: needed for surfaces whose triangles depend on the view.
        size: (height, width); needed for the same surfaces.

    Returns:
        The parts with their structures. `replace` changes transforms, shaders, colours and the like. Vertices must
        stay: samples do not follow them, and a render warns where they have changed.

    Raises:
        InputError: an argument is wrong or traced, or a surface's triangles depend on a view that is not given.
        PluginError: the sampler cannot be imported, such as for want of a package.
    """
    return PreparedParts.of(parts, sampler, camera, size)


class Renderer:
    """A function that renders prepared parts through one camera; made by `PreparedParts.renderer`."""

    def __init__(
        self,
        parts: PreparedParts,
        camera: Camera,
        size: tuple[int, int],
        *,
        splatter: SplatterLike = "auto",
        layers: Layers = "auto",
        supersample: int = 1,
        background: BackgroundLike = None,
        capacity: int | None = None,
        engine: str | None = None,
    ):
        scene, self._engine = Scene.of(parts, camera, "auto", engine), engine
        self._size, self._settings = RenderSettings.checked(size, splatter, layers, supersample, capacity)
        self._scene = scene.at(self._size)
        self._background = check_background(background, self._size, scene.channels)

    @uncompiled
    def __call__(self, index: int = 0, **changes: Any) -> Array:
        """The image of `render`, with some fields of one part changed.

        Args:
            index: the index of the part.
            **changes: its `transform`, `theta`, `shader` or `cull`, for this call alone.

        Returns:
            (H, W, 4) or (H, W, C + 1), as in `render`.

        Raises:
            InputError: there is no such part or field, or its value is wrong.

        Warns:
            InputWarning: vertices have changed since `prepare`.
        """
        scene = self._scene
        check_changes(index, changes, len(scene.parts))
        if changes:
            parts = list(scene.parts)
            parts[index] = changed_part(index, parts[index], changes)
            if "shader" in changes:
                check_background(self._background, self._size, check_channels(parts))
            context = context_of_scene(parts, scene.camera, engine=self._engine)
            scene = scene._replace(parts=parts, context=context)
        warn_of_moved_vertices(scene.parts, scene.entries)
        return image_over(scene, self._size, self._background, self._settings)
