"""Preview of a rendering: the sampler of each part, and the number of samples."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from typing import Any

import numpy as np

from rts.advice.unread_entries import Observed, likely_name, shaded_by, unread
from rts.advice.winding import INSIDE_OUT, is_inside_out
from rts.arrays.engines import engine_of
from rts.contracts.checked_parts import CheckedPart, check_scene
from rts.contracts.records import Samples
from rts.contracts.shader import FunctionShader
from rts.fitting.targets import BRIGHTEST, largest
from rts.registry import name_of
from rts.rendering.arguments import Layers, SplatterLike
from rts.rendering.image import render_samples
from rts.rendering.samples import sample
from rts.sampling.auto import Choice, choose, is_static
from rts.sampling.prepared import Prepared
from rts.scene.camera import Camera
from rts.scene.parts import Part

NO_PROMISE = (
    "its shader, a function, does not say whether light passes through it: all layers are kept, which takes two to "
    "four times as long; set its attribute opaque to True if alpha is 1, else to False"
)
"""The remark on a part whose shader is a function without the attribute."""
FEW = 32
"""Pixels along each side of the image that shows what shaders read."""

PREPARED = "parts of rts.prepare keep the sampler that they were prepared with"
"""The reason for the sampler of prepared parts."""


def explain(
    parts: Part | Sequence[Part] | Prepared,
    camera: Camera,
    size: tuple[int, int] | None = None,
    *,
    splatter: SplatterLike = "auto",
    layers: Layers = "auto",
    supersample: int = 1,
) -> list[Choice]:
    """Explain which sampler `sampler="auto"` chooses for each part, and count samples if a size is given.

    Args:
        parts: as in `rts.render`; parts of `rts.prepare` have the sampler that they were prepared with.
        camera: as in `rts.render`.
        size: (height, width) in pixels; None to count nothing.
        splatter: as in `rts.render`.
        layers: as in `rts.render`.
        supersample: as in `rts.render`.

    Returns:
        For each part the name of the `sampler`, the `reason`, and `remarks` on likely mistakes. With a size also the
        number of `samples`, apron and those beside outlines included.

    Raises:
        InputError: the scene cannot be sampled.
    """
    checked, seen = check_scene(parts.parts if isinstance(parts, Prepared) else parts, camera)
    sampled = None
    shaded: list[Any] = [shaded_by(part) for part in checked]
    if size is not None:
        sampled = sample(parts, camera, size, splatter=splatter, layers=layers, supersample=supersample)
        if None in shaded:
            seen_to_read = _observed(checked, camera, size)
            shaded = [b if a is None else a for a, b in zip(shaded, seen_to_read, strict=True)]
    if isinstance(parts, Prepared):
        choices = [Choice(name_of("rts.samplers", sampler), PREPARED) for sampler in parts.samplers]
    else:
        choices = [choose(part, static=is_static(part, seen)) for part in checked]
    remarks = [tuple(_remarks(part, seen, entries)) for part, entries in zip(checked, shaded, strict=True)]
    choices = [choice._replace(remarks=lines) for choice, lines in zip(choices, remarks, strict=True)]
    if sampled is None:
        return choices
    return [choice._replace(samples=n) for choice, n in zip(choices, map(_count, sampled.samples), strict=True)]


def _observed(parts: Sequence[CheckedPart], camera: Camera, size: tuple[int, int]) -> list[set[str]]:
    """The entries of θ that the shader of each part reads, as it shades a few samples."""
    shaders = [Observed(part.shader) for part in parts]
    watched = [part.replace(shader=shader) for part, shader in zip(parts, shaders, strict=True)]
    small = min(size[0], FEW), min(size[1], FEW)
    sampled = sample(watched, camera.for_size(size).replace(aspect=None), small, splatter=None, layers=1)
    render_samples(sampled, watched, camera.for_size(size).replace(aspect=None), splatter="none")
    return [shader.read for shader in shaders]


def _remarks(part: CheckedPart, camera: Camera, shaded: Collection[str] | None) -> Iterator[str]:
    """Likely mistakes in a part; `shaded` are the entries of θ that its shader reads, None if unknown."""
    for name in unread(part, shaded):
        meant = likely_name(part, name, shaded or ())
        yield f"theta[{name!r}] is not read" + ("" if meant is None else f"; did you mean {meant!r}?")
    if is_inside_out(part, camera):
        yield INSIDE_OUT
    for name in ("texture", "color", "colors"):
        value = part.theta.get(name)
        if value is not None and (most := largest(value)) > BRIGHTEST:
            yield f"theta[{name!r}] goes up to {most:g}, where white is 1: divide colours from 0 to 255 by 255"
    if isinstance(part.shader, FunctionShader) and not hasattr(part.shader.function, "opaque"):
        yield NO_PROMISE


def _count(samples: Samples) -> int:
    """The number of samples that cells refer to."""
    return int(np.count_nonzero(engine_of(samples).to_numpy(samples.row) >= 0))
