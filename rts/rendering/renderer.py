"""`rts.prepare`, and a renderer for loops: what stays is checked, looked up and built once."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

from rts.arrays.engines import context_of_scene, uncompiled
from rts.arrays.trees import Array
from rts.contracts.checks import changed_part, check_background, check_changes, check_channels
from rts.rendering.image import image_over
from rts.rendering.scene import Scene
from rts.rendering.settings import RenderSettings
from rts.sampling.adaptive import Adaptive
from rts.sampling.prepared import Prepared
from rts.scene.camera import Camera
from rts.scene.parts import Part


class PreparedParts(Prepared):
    """Parts with what their samplers have built; `render` and `sample` take it in place of parts.

    Their argument `sampler` has no effect then. Functions given to `jax.jit` close over it.
    """

    def renderer(self, camera: Camera, size: tuple[int, int], **settings: Any) -> Renderer:
        """A function that renders these parts, for loops: `draw(transform=…)`, with what changes at each call.

        Args:
            camera: as in `render`.
            size: as in `render`.
            **settings: `splatter`, `layers`, `supersample`, `background`, `capacity` and `engine`, as in `render`.

        Returns:
            A function `(index=0, **changes)`, which gives the image of `render` with some fields of one part changed.

        Raises:
            InputError: what was given cannot be rendered.
        """
        return Renderer(self, camera, size, **settings)


def prepare(
    parts: Part | Sequence[Part],
    sampler: Any = "auto",
    *,
    camera: Camera | None = None,
    size: tuple[int, int] | None = None,
) -> PreparedParts:
    """Build what a sampler needs of each part, once.

    `raster` puts the triangles of large meshes in order by place, so that it can pass over many at once. That takes 22
    bytes for each triangle of a closed mesh, and as long as to draw them some 5 to 40 times.

    Args:
        parts: one part or several, with values that are known (not traced).
        sampler: as in `rts.render`; "auto" takes the triangles for static.
        camera: needed for surfaces whose triangles depend on the view.
        size: (height, width), needed likewise.

    Returns:
        A handle. Later changes to vertices are not seen; `replace` changes transforms, shaders and the rest of θ.
    """
    return PreparedParts.of(parts, sampler, camera, size)


class Renderer:
    """Renders prepared parts through one camera again and again; made by `PreparedParts.renderer`."""

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
        self._size, self._settings = RenderSettings.checked(size, splatter, layers, supersample, capacity)
        self._scene = scene.at(self._size)
        self._background = check_background(background, self._size, scene.channels)

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
            context = context_of_scene(parts, scene.camera, engine=self._engine)
            scene = scene._replace(parts=parts, context=context)
        return image_over(scene, self._size, self._background, self._settings)
