"""Preview of a rendering: the sampler of each part, and the number of samples."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from rts.advice.unread_entries import likely_name, shaded_by, unread
from rts.advice.winding import INSIDE_OUT, is_inside_out
from rts.arrays.engines import engine_of
from rts.arrays.trees import Array, Tree
from rts.contracts.checked_parts import CheckedPart, check_scene
from rts.contracts.gbuffer import GBuffer
from rts.contracts.records import Samples
from rts.contracts.shader import FunctionShader, Shader
from rts.diagnostics.shader_steps import STEP_CAUSE, STEP_REMEDY, steps_inside
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
        number of `samples`, which includes those around the image and beside outlines, and a remark on a shader of
        your own whose colours jump where nothing moves, such as by rounding: a jump has no derivative.

    Raises:
        InputError: the scene cannot be sampled.
    """
    checked, seen = check_scene(parts.parts if isinstance(parts, Prepared) else parts, camera)
    sampled = None
    watched: list[Any] = [None] * len(checked)
    if size is not None:
        sampled = sample(parts, camera, size, splatter=splatter, layers=layers, supersample=supersample)
        if any(_is_own(part.shader) for part in checked):
            watched = _watched(checked, camera, size)
    if isinstance(parts, Prepared):
        choices = [Choice(name_of("rts.samplers", sampler), PREPARED) for sampler in parts.samplers]
    else:
        choices = [choose(part, static=is_static(part, seen)) for part in checked]
    remarks = [tuple(_remarks(part, seen, shader)) for part, shader in zip(checked, watched, strict=True)]
    choices = [choice._replace(remarks=lines) for choice, lines in zip(choices, remarks, strict=True)]
    if sampled is None:
        return choices
    return [choice._replace(samples=n) for choice, n in zip(choices, map(_count, sampled.samples), strict=True)]


class _Watched(Shader):
    """A wrapper of a shader that records the entries of θ that it reads, and whether its colours step on a surface.

    Attributes:
        read: the names of entries read so far.
        steps: whether colours have stepped so far.
    """

    def __init__(self, shader: Shader):
        self._shader, self.channels = shader, shader.channels
        self.read: set[str] = set()
        self.steps = False

    def __call__(self, theta: Mapping[str, Tree], gbuffer: GBuffer, camera: Any) -> Array:
        """The colours of the wrapped shader."""
        colors = self._shader(_Noting(theta, self.read), gbuffer, camera)
        if _is_own(self._shader):
            self.steps |= steps_inside(lambda between: self._shader(theta, between, camera), gbuffer, camera)
        return colors


class _Noting(dict):
    """A dict that adds to `read` every name looked up, present or not; iteration adds all names."""

    def __init__(self, entries: Mapping[str, Any], read: set[str]):
        super().__init__(entries)
        self._read = read

    def __getitem__(self, name: str) -> Any:
        self._read.add(name)
        return super().__getitem__(name)

    def __contains__(self, name: object) -> bool:
        self._read.add(str(name))
        return super().__contains__(name)

    def get(self, name: str, default: Any = None) -> Any:
        return self[name] if name in self else default

    def __iter__(self) -> Iterator[str]:
        self._read.update(super().__iter__())
        return super().__iter__()

    def keys(self) -> Any:
        return dict.fromkeys(self).keys()

    def items(self) -> Any:
        return {name: self[name] for name in self}.items()

    def values(self) -> Any:
        return dict(self.items()).values()


def _is_own(shader: Shader) -> bool:
    """True for a shader that is a function, or of another package; colours of built-in ones do not step."""
    return not type(shader).__module__.startswith("rts.shading.")


def _watched(parts: Sequence[CheckedPart], camera: Camera, size: tuple[int, int]) -> list[_Watched]:
    """The shaders of parts, watched as they shade a few samples."""
    shaders = [_Watched(part.shader) for part in parts]
    watched = [part.replace(shader=shader) for part, shader in zip(parts, shaders, strict=True)]
    small, camera = (min(size[0], FEW), min(size[1], FEW)), camera.for_size(size).replace(aspect=None)
    render_samples(sample(watched, camera, small, splatter=None, layers=1), watched, camera, splatter="none")
    return shaders


def _remarks(part: CheckedPart, camera: Camera, watched: _Watched | None) -> Iterator[str]:
    """Likely mistakes in a part; `watched` is its shader, None if it was not watched."""
    shaded = shaded_by(part)
    if shaded is None and watched is not None:
        shaded = watched.read
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
    if watched is not None and watched.steps:
        yield f"its colours step inside the surface, {STEP_CAUSE}; {STEP_REMEDY}"


def _count(samples: Samples) -> int:
    """The number of samples that cells refer to."""
    return int(np.count_nonzero(engine_of(samples).to_numpy(samples.row) >= 0))
