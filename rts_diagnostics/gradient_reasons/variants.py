"""Changes of a scene for experiments, each of which removes one obstacle to a derivative."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from typing import Any

import numpy as np

from rts import Camera, Part, engine_of
from rts.plugin_api.arrays import Array
from rts.tool_api.plugins import check_shader
from rts_diagnostics.gradient_reasons.subject import Change

CLEAR = 0.5
"""Factor of the alpha and colours of parts that are made transparent."""


def alone(kept: Collection[int]) -> Change:
    """A change that leaves only the parts with indices `kept`."""
    return lambda parts, camera: ([p for i, p in enumerate(parts) if i in kept], camera)


def unculled(parts: list[Part], camera: Camera) -> tuple[list[Part], Camera]:
    """The scene with both sides of all triangles shown: cull="none"."""
    return [p.replace(cull="none") for p in parts], camera


def transparent(parts: list[Part], camera: Camera) -> tuple[list[Part], Camera]:
    """The scene with all parts made transparent, by the factor `CLEAR`."""

    def through(part: Part) -> Callable[..., Array]:
        shader = check_shader(part.shader, "the shader")
        return lambda theta, gbuffer, camera: CLEAR * shader(theta, gbuffer, camera)

    return [p.replace(shader=through(p)) for p in parts], camera


def unbounded(parts: list[Part], camera: Camera) -> tuple[list[Part], Camera]:
    """The scene with surfaces that do not bound their derivatives."""
    surfaces = [p.surface.unbounded() for p in parts]
    return [p if s is None else p.replace(surface=s) for p, s in zip(parts, surfaces, strict=True)], camera


def wider(size: tuple[int, int], border: int) -> Change:
    """A change to a larger window, for images with `border` more pixels on every side."""
    return lambda parts, camera: (parts, camera.with_border(size, border))


def farther(distance: float) -> Change:
    """A change that moves the camera back along its axis by a distance in world units; ahead if that is negative."""
    change = np.eye(4)
    change[2, 3] = -distance

    def moved(parts: list[Part], camera: Camera) -> tuple[list[Part], Camera]:
        engine = engine_of(camera.view)
        back = engine.constant(change, camera.view) if engine.differentiates else change
        return parts, camera.replace(view=back @ camera.view)

    return moved


def all_of(*changes: Any) -> Change:
    """A change that makes several changes, one after another."""

    def change(parts: list[Part], camera: Camera) -> tuple[list[Part], Camera]:
        for one in changes:
            parts, camera = one(parts, camera)
        return parts, camera

    return change


def names(indices: Sequence[int], word: str = "and") -> str:
    """Parts in words, such as "parts 0 and 2"; of more than three the first three."""
    if len(indices) == 1:
        return f"part {indices[0]}"
    if len(indices) > 3:
        return f"parts {', '.join(map(str, indices[:3]))}, …"
    return f"parts {', '.join(map(str, indices[:-1]))} {word} {indices[-1]}"
