"""`rts.prepare`: a scene's triangles handed to a sampler once, for loops that want no check of them at all."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, ClassVar

from rts.arguments import check_pixels
from rts.camera import Camera
from rts.checks import check_changes, check_sampler, check_scene, suited_sampler
from rts.parts import Part
from rts.sampling.cache import Entry
from rts.trees import Array


class PreparedParts:
    """Parts with what their samplers have built; `render` and `sample` take it in place of parts.

    Their argument `sampler` has no effect then. Functions given to `jax.jit` close over it.

    Attributes:
        parts: the parts.
        samplers: the sampler of each.
        entries: what the sampler has built of each, or None where it builds nothing.
    """

    _made: ClassVar[Callable[..., Callable[..., Array]]]
    """Makes a renderer; set by `rts.rendering`, which builds on this module."""

    def __init__(self, parts: Sequence[Part], samplers: Sequence[Any], entries: Sequence[Any]):
        self.parts, self.samplers, self.entries = tuple(parts), tuple(samplers), tuple(entries)

    def __getstate__(self) -> dict[str, Any]:
        """Everything but what samplers have built, of which the triangles are enough."""
        kept = [e._replace(prepared=None) if isinstance(e, Entry) else e for e in self.entries]
        return {**self.__dict__, "entries": kept}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Build it again."""
        pairs = zip(state["samplers"], state["entries"], strict=True)
        entries = tuple(_built(sampler, kept) if isinstance(kept, Entry) else kept for sampler, kept in pairs)
        self.__dict__.update(state, entries=entries)

    def replace(self, index: int = 0, **changes: Any) -> PreparedParts:
        """A copy with some fields of one part changed, such as its `transform`; the triangles are not looked at."""
        check_changes(index, changes, len(self.parts))
        parts = list(self.parts)
        parts[index] = parts[index].replace(**changes)
        return PreparedParts(parts, self.samplers, self.entries)

    def renderer(self, camera: Camera, size: tuple[int, int], **settings: Any) -> Callable[..., Array]:
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
        return self._made(self, camera, size, **settings)


def _built(sampler: Any, kept: Entry) -> Entry:
    return sampler.arranged(kept._replace(prepared=sampler.prepare(kept.proxy))) if len(kept.proxy.faces) else kept


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
    identity = Camera.look_at((0, 0, 1), (0, 0, 0))
    checked, _ = check_scene(parts, identity if camera is None else camera)
    size = None if size is None else check_pixels(size)
    chosen = check_sampler(sampler)
    samplers = [suited_sampler(chosen, part, None) for part in checked]
    entries = [own.hold(part, camera, size) for own, part in zip(samplers, checked, strict=True)]
    return PreparedParts(checked, samplers, entries)
