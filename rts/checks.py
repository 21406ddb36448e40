"""Checks of what users and plugins give."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from numbers import Integral, Real
from typing import Any

from rts import registry
from rts.adapting import adapted
from rts.arrays import described, from_numbers, shape_of
from rts.camera import Camera
from rts.engines import namespace
from rts.errors import InputError
from rts.interfaces import CheckedPart, Part, Sampler, Shader, Splatter, as_surface
from rts.trees import Array

BYTES_PER_CELL = {"forward": 200, "gradient": 700}
"""Rough memory of a cell of a layer through sampling, shading and splatting in array code; compiled, it is less."""


def _memory() -> float:
    """Physical memory in bytes, or infinity where the system does not tell."""
    try:
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (AttributeError, ValueError, OSError):
        return math.inf


MEMORY = _memory()


def check_scene(parts: Part | Sequence[Part], camera: Camera) -> tuple[list[CheckedPart], Camera]:
    """Checked parts, with shaders looked up and plain numbers made arrays; that all suit one engine is not checked."""
    parts = list(parts) if isinstance(parts, Sequence) else [parts]
    if not parts or not all(isinstance(p, Part) for p in parts):
        kinds = ", ".join(type(p).__name__ for p in parts) or "nothing"
        raise InputError(f"parts holds {kinds}; expected an rts.Part or several")
    if not isinstance(camera, Camera):
        raise InputError(f"camera is a {type(camera).__name__}; expected an rts.Camera")
    camera = Camera(*from_numbers(tuple(camera)))
    for name, matrix in zip(camera._fields, camera, strict=True):
        check_matrix(f"the camera's {name}", matrix)
    return [_check_part(index, part) for index, part in enumerate(parts)], camera


def _check_part(index: int, part: Part) -> CheckedPart:
    strange = [key for key in part.theta if not isinstance(key, str)]
    if strange:
        raise InputError(f"theta of part {index} has the key {strange[0]!r}; expected names")
    surface = as_surface(part.surface)
    if surface is None:
        raise InputError(f"the surface of part {index} is {part.surface!r}; expected an object such as a mesh")
    if min(surface.sample_widths) < 0:
        raise InputError(f"{surface!r} has no sample_widths; expected (I, P), the integers and reals of a sample")
    chosen = registry.instance("rts.shaders", part.shader)
    shader = adapted(chosen, Shader)
    if shader is None:
        raise InputError(f"the shader of part {index} is {chosen!r}; expected a name or a function")
    theta, transform = from_numbers(part.theta), from_numbers(part.transform)
    if transform is not None:
        check_matrix(f"the transform of part {index}", transform)
    surface.check(theta)
    reads = surface.reads(theta)
    if isinstance(reads, str) or not set(reads) <= set(theta):
        raise InputError(f"reads of {surface!r} gave {reads!r}; expected names of entries of theta: {sorted(theta)}")
    return CheckedPart(surface, theta, shader, transform, part.cull)


def check_sampler(chosen: Any) -> Sampler:
    """A usable sampler from a name, a class or an object."""
    return _checked_plugin("rts.samplers", chosen, Sampler, "sample")


def suited_sampler(chosen: Sampler, part: Part, camera: Camera | None) -> Sampler:
    """The sampler that `chosen` takes for a part, itself or another."""
    own = chosen.suited(part, camera)
    return own if own is chosen else check_sampler(own)


def check_splatter(chosen: Any) -> Splatter:
    """A usable splatter from a name, a class or an object."""
    found = _checked_plugin("rts.splatters", chosen, Splatter, "image")
    if not (is_count(found.reach)):
        raise InputError(f"reach of {found!r} is {found.reach!r}; expected cells, an integer of at least 1")
    return found


def _checked_plugin(group: str, chosen: Any, base: type, method: str) -> Any:
    instance = registry.instance(group, chosen)
    found = adapted(instance, base)
    if found is None:
        kind = group.removeprefix("rts.").removesuffix("s")
        raise InputError(f"the {kind} is {instance!r}; expected a name or an object with a method {method!r}")
    return found


def check_matrix(name: str, matrix: Any) -> None:
    """Refuse what is not (4, 4)."""
    if shape_of(matrix) != (4, 4):
        raise InputError(f"{name} has shape {shape_of(matrix)}; expected a (4, 4) array")


def check_size(size: Any, layers: Any, capacity: Any, supersample: Any) -> tuple[int, int]:
    """(height, width) as integers, refused where they make no image."""
    try:
        height, width = (int(s) for s in size)
        whole = (height, width) == tuple(size)
    except (TypeError, ValueError, OverflowError):
        height, width, whole = 0, 0, False
    if not whole or height <= 0 or width <= 0:
        given = " ".join(repr(size).split())[:60]
        raise InputError(f"size is {given}; expected (height, width), two positive integers")
    if not (isinstance(layers, str) and layers == "auto") and not is_count(layers):
        raise InputError(f'layers is {layers!r}; expected an integer of at least 1, or "auto"')
    if capacity is not None and not is_count(capacity):
        raise InputError(f"capacity is {capacity!r}; expected an integer of at least 1, or None")
    if not is_count(supersample):
        raise InputError(f"supersample is {supersample!r}; expected an integer of at least 1")
    return height, width


def check_memory(height: int, width: int, layers: int, *, gradient: bool) -> None:
    """Refuse what would not fit into this machine."""
    needed = height * width * layers * BYTES_PER_CELL["gradient" if gradient else "forward"]
    if needed > MEMORY:
        raise InputError(
            f"{height} x {width} pixels with {layers} layers need about {needed / 2**30:.3g} GiB, and this machine has "
            f"{MEMORY / 2**30:.3g} GiB; choose a smaller size, or fewer samples a pixel or layers"
        )


def is_count(value: Any) -> bool:
    """Whether a value is an integer of at least 1, Python's or NumPy's."""
    return isinstance(value, Integral) and not isinstance(value, bool) and int(value) >= 1


def is_real(value: Any) -> bool:
    """Whether a value is a real number, Python's or NumPy's, infinity and NaN included."""
    return isinstance(value, Real) and not isinstance(value, bool)


def check_background(background: Any, size: tuple[int, int]) -> Array | None:
    """The background as an array, refused where it fits no image of this size."""
    if background is None:
        return None
    background = from_numbers(background)
    if shape_of(background) not in ((3,), (4,), (*size, 3), (*size, 4)):
        height, width = size
        raise InputError(
            f"background {described(background)}; expected (3,), (4,), ({height}, {width}, 3) or ({height}, {width}, 4)"
        )
    check_floating("background", background)
    return background


def check_floating(name: str, value: Array) -> None:
    """Refuse integers: some would mean 0 to 255 by them, others 0 to 1."""
    if not namespace(value).isdtype(value.dtype, "real floating"):
        raise InputError(f"{name} has dtype {value.dtype}; expected floating numbers")


def check_shaded(rgba: Any, count: int, shader: Any) -> None:
    """Refuse what a shader should not have returned."""
    if shape_of(rgba) != (count, 4):
        raise InputError(f"what the shader {shader!r} returned {described(rgba)}; expected ({count}, 4)")
