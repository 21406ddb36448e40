"""Checks of arguments that users give, and of results that plugins return."""

from __future__ import annotations

import math
import os
from numbers import Integral, Real
from typing import Any

import numpy as np

from rts import registry
from rts.arrays.argument_checks import check_pixels, quoted
from rts.arrays.array_functions import described, from_numbers, is_finite, shape_of
from rts.arrays.engines import floating_bits
from rts.arrays.trees import Array
from rts.contracts.sampler import Sampler
from rts.contracts.shader import FunctionShader, Shader
from rts.contracts.splatter import Splatter
from rts.contracts.surface import RaySurface, Surface, TriangleSurface
from rts.errors import AspectWarning, InputError, PluginError, warn, warn_deprecated
from rts.plugin_base import check_members, is_subclass
from rts.scene.camera import Camera
from rts.scene.parts import Part

BYTES_PER_CELL = {"forward": 200, "gradient": 700}
"""Rough number of bytes to sample, shade and splat a cell of a layer in array code; compiled code needs less."""


def _memory() -> float:
    """Physical memory in bytes, or infinity where the system does not tell."""
    try:
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (AttributeError, ValueError, OSError):
        return math.inf


MEMORY = _memory()

_REAL = {np.dtype(np.float32), np.dtype(np.float64)}

BRIGHTEST = 1e30
"""The size that colours stay below: derivatives of sums of larger ones overflow float32."""


def check_sampler(sampler: Any) -> Sampler:
    """A usable sampler from a name, a class or an object."""
    return checked_plugin(registry.instance("rts.samplers", sampler), "the sampler", Sampler)


def sampler_for_part(sampler: Sampler, part: Part, camera: Camera | None) -> Sampler:
    """The sampler that `sampler` selects for a part: `sampler` itself or another."""
    selected = sampler.sampler_for(part, camera)
    return selected if selected is sampler else check_sampler(selected)


def check_splatter(splatter: Any) -> Splatter:
    """A usable splatter from a name, a class or an object."""
    if isinstance(splatter, str) and splatter == "visible":
        warn_deprecated("splatter 'visible'", "'edges', which it now is", until="0.4")
        splatter = "edges"
    splatter = checked_plugin(registry.instance("rts.splatters", splatter), "the splatter", Splatter)
    if not is_count(splatter.reach):
        raise InputError(f"reach of {splatter!r} is {splatter.reach!r}; expected cells, an integer of at least 1")
    if splatter.layers is not None and not is_count(splatter.layers):
        raise InputError(f"layers of {splatter!r} is {splatter.layers!r}; expected an integer of at least 1, or None")
    return splatter


def check_shader(shader: Any, what: str) -> Shader:
    """A usable shader from a name, a class, an object or a function; `what` names it."""
    shader = registry.instance("rts.shaders", shader)
    shader = FunctionShader(shader) if not is_subclass(type(shader), Shader) and callable(shader) else shader
    return checked_plugin(shader, what, Shader, "a function, ")


def check_surface(surface: Any, what: str) -> Surface:
    """The surface of a part, refused if its class has no base of surfaces; `what` names it."""
    checked_plugin(surface, what, Surface, "such as a mesh, ")
    for base, method in ((TriangleSurface, "proxy"), (RaySurface, "intersect")):
        if hasattr(surface, method) and not is_subclass(type(surface), base):
            raise PluginError(f"{type(surface).__qualname__} has the methods of rts.{base.__name__}; subclass that")
    return surface


def checked_plugin(plugin: Any, what: str, base: type, others: str = "a name, ") -> Any:
    """The given plugin, after a check of its class and of the spelling of its members.

    Args:
        plugin: the plugin.
        what: its name in error messages, such as "the sampler".
        base: the base class of its kind.
        others: alternatives to an object, for error messages.

    Raises:
        InputError: its class does not subclass `base`.
        PluginError: its class overrides a final method, or has a function named almost like an optional one.
    """
    if not is_subclass(type(plugin), base):
        bases = "rts.TriangleSurface or rts.RaySurface" if base is Surface else f"rts.{base.__name__}"
        raise InputError(f"{what} is {quoted(plugin)}; expected {others}or an object whose class subclasses {bases}")
    check_members(type(plugin))
    return plugin


def check_matrix(name: str, matrix: Any) -> Array:
    """A (4, 4) matrix of floating numbers: lists become float32, NumPy integers float64. Other arrays are refused."""
    if type(matrix) is not np.ndarray or matrix.dtype not in _REAL:
        matrix = from_numbers(matrix, name)
    if getattr(matrix, "shape", ()) != (4, 4):
        several = len(shape_of(matrix)) == 3 and shape_of(matrix)[1:] == (4, 4)
        hint = "; for several views call rts.render_views, for several poses vmap of rts.render" if several else ""
        raise InputError(f"{name} {described(matrix)}; expected a (4, 4) array{hint}")
    if isinstance(matrix, np.ndarray):
        return matrix if matrix.dtype.kind == "f" else matrix.astype(np.float64)
    if not floating_bits(matrix):
        check_floating(name, matrix)
    return matrix


def check_ratio(camera: Camera, size: tuple[int, int]) -> None:
    """Warn if a size (height, width) is off the camera's ratio, if it is known, by more than a pixel."""
    if not isinstance(camera.aspect, float):
        return
    height, width = size
    if abs(width - camera.aspect * height) > 1 and abs(width / camera.aspect - height) > 1:
        warn(
            f"the camera is for images of width / height = {camera.aspect:.4g}, and size is ({height}, {width}), of "
            f"{width / height:.4g}: the image is stretched; give both the same ratio",
            AspectWarning,
        )


def check_size(size: Any, layers: Any, capacity: Any, supersample: Any) -> tuple[int, int]:
    """The image size as (height, width) integers. Refuse a wrong size, or counts that are no integers of at least 1.

    Also allowed are `layers="auto"` and a capacity of None.
    """
    height, width = check_pixels(size)
    if not (isinstance(layers, str) and layers == "auto") and not is_count(layers):
        raise InputError(f'layers is {quoted(layers)}; expected an integer of at least 1, or "auto"')
    if capacity is not None and not is_count(capacity):
        raise InputError(f"capacity is {quoted(capacity)}; expected an integer of at least 1, or None")
    if not is_count(supersample):
        raise InputError(f"supersample is {quoted(supersample)}; expected an integer of at least 1")
    return height, width


def check_memory(height: int, width: int, layers: int, capacity: int | None, *, gradient: bool) -> None:
    """Refuse a render of height × width cells that needs more memory than this machine has, by `BYTES_PER_CELL`."""
    bytes_ = BYTES_PER_CELL["gradient" if gradient else "forward"]
    if capacity is not None and capacity * bytes_ > MEMORY:
        raise InputError(
            f"capacity is {capacity}, rows of about {capacity * bytes_ / 2**30:.3g} GiB, and this machine has "
            f"{MEMORY / 2**30:.3g} GiB; the worst case is layers x cells, {height * width * layers}"
        )
    needed = height * width * layers * bytes_
    if needed > MEMORY:
        raise InputError(
            f"{width} x {height} pixels with {layers} layers need about {needed / 2**30:.3g} GiB, and this machine has "
            f"{MEMORY / 2**30:.3g} GiB; choose a smaller size, or fewer samples a pixel or layers"
        )


def is_count(value: Any) -> bool:
    """True for an integer of at least 1, Python's or NumPy's."""
    whole = type(value) is int or (isinstance(value, Integral) and not isinstance(value, bool))
    return whole and int(value) >= 1


def is_real(value: Any) -> bool:
    """True for a real number, Python's or NumPy's, infinity and NaN included."""
    return isinstance(value, Real) and not isinstance(value, bool)


def check_background(background: Any, size: tuple[int, int], channels: int) -> Array | None:
    """The background as finite floats, (C,), (C + 1,), (H, W, C) or (H, W, C + 1), C `channels`; else refused.

    None stays None.
    """
    if background is None:
        return None
    background = from_numbers(background, "background")
    few, all_ = channels, channels + 1
    if shape_of(background) not in ((few,), (all_,), (*size, few), (*size, all_)):
        height, width = size
        raise InputError(
            f"background {described(background)}; expected ({few},), ({all_},), ({height}, {width}, {few}) or "
            f"({height}, {width}, {all_})"
        )
    check_floating("background", background)
    check_bounded("background", background)
    return background


def check_bounded(name: str, value: Array) -> None:
    """Refuse floats that are NaN or infinite, or not below `BRIGHTEST` in size; traced arrays pass."""
    if not is_finite(value, below=BRIGHTEST):
        fault = f"a number of {BRIGHTEST:g} or more" if is_finite(value) else "NaN or infinity"
        raise InputError(f"{name} holds {fault}; expected finite numbers below {BRIGHTEST:g}")


def check_floating(name: str, value: Array) -> None:
    """Refuse arrays of other numbers than floating ones: the range of integers is ambiguous, 0 to 255 or 0 to 1."""
    if not floating_bits(value):
        raise InputError(f"{name} has dtype {value.dtype}; expected floating numbers")
