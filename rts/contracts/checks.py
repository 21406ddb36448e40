"""Checks of arguments that users give, and of results that plugins return."""

from __future__ import annotations

import functools
import math
import os
from collections.abc import Mapping, Sequence
from numbers import Integral, Real
from typing import Any

import numpy as np

from rts import registry
from rts.arrays.argument_checks import check_pixels, quoted
from rts.arrays.array_functions import described, from_numbers, is_finite, shape_of
from rts.arrays.engines import floating_bits, value_of
from rts.arrays.trees import Array, Tree, placed_leaves, record
from rts.contracts.gbuffer import GBuffer
from rts.contracts.sampler import Sampler
from rts.contracts.shader import FunctionShader, Shader
from rts.contracts.splatter import Splatter
from rts.contracts.surface import RaySurface, Surface, TriangleSurface
from rts.errors import AspectWarning, InputError, PluginError, warn, warn_deprecated
from rts.plugin_base import check_members, promised
from rts.scene.camera import Camera
from rts.scene.parts import Part


@record(static=("surface", "shader", "cull"))
class CheckedPart(Part):
    """A part that passed the checks: its surface and its shader are instances of `rts.Surface` and `rts.Shader`."""

    surface: Surface
    theta: Mapping[str, Tree]
    shader: Shader  # pyright: ignore[reportGeneralTypeIssues]  # It is always given.
    transform: Array | None = None
    cull: str = "none"

    @functools.cached_property
    def read(self) -> dict[str, Tree]:
        """The entries of θ that the surface reads."""
        return {name: self.theta[name] for name in self.surface.reads(self.theta)}

    @functools.cached_property
    def uniform(self) -> bool:
        """True if the shader promises one colour for all samples."""
        return promised(self.shader, "uniform")

    @functools.cached_property
    def takes_views(self) -> bool:
        """True if the shader promises to take samples of several views in one call."""
        return promised(self.shader, "takes_views")

    @functools.cached_property
    def reads(self) -> tuple[str, ...] | None:
        """The only entries of the G-buffer and of θ that the shader promises to need; None for all."""
        return promised(self.shader, "reads")


BYTES_PER_CELL = {"forward": 200, "gradient": 700}
"""Rough number of bytes to sample, shade and splat a cell of a layer in array code; compiled code needs less."""


def _memory() -> float:
    """Physical memory in bytes, or infinity where the system does not tell."""
    try:
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (AttributeError, ValueError, OSError):
        return math.inf


MEMORY = _memory()

BRIGHTEST = 1e30
"""The size that colours stay below: derivatives of sums of larger ones overflow float32."""


def check_scene(parts: Part | Sequence[Part], camera: Camera) -> tuple[list[CheckedPart], Camera]:
    """A list of the parts, checked, and the camera, turned to look along −z; wrong ones raise an `InputError`.

    Shaders are looked up by name, and lists of numbers become arrays. Arrays of several engines are not detected here.
    """
    part_list: list[Any] = list(parts) if isinstance(parts, (list, tuple)) else [parts]
    if not part_list or not all(isinstance(p, Part) for p in part_list):
        kinds = ", ".join(sorted({type(p).__name__ for p in part_list})) or "nothing"
        raise InputError(f"parts holds {kinds}; expected an rts.Part or several")
    if not isinstance(camera, Camera):
        several = isinstance(camera, (list, tuple)) and any(isinstance(c, Camera) for c in camera)
        hint = "; rts.render_views takes several" if several else ""
        raise InputError(f"camera is {quoted(camera)}; expected an rts.Camera{hint}")
    if camera.is_stacked:
        raise InputError(
            f"camera is of several views, its view {described(camera.view)}; expected that of one: rts.render_views "
            f"takes several, and camera.unstack() gives them one by one"
        )
    camera = _check_camera(camera)
    checked = [_check_part(index, part) for index, part in enumerate(part_list)]
    check_channels(checked)
    return checked, camera


def check_cameras(cameras: Any) -> list[Camera]:
    """Checked cameras, one for each view, from a list or from a stacked camera."""
    if isinstance(cameras, Camera):
        if not cameras.is_stacked:
            raise InputError("cameras is the camera of one view; expected several, or what Camera.stack made of them")
        camera_list = cameras.unstack()
    else:
        camera_list = list(cameras) if isinstance(cameras, (list, tuple)) else []
        if not camera_list or not all(isinstance(camera, Camera) for camera in camera_list):
            raise InputError(f"cameras is {quoted(cameras)}; expected a list of rts.Camera, or what Camera.stack made")
        if any(camera.is_stacked for camera in camera_list):
            raise InputError("cameras holds a stack; expected cameras of one view each, or one stack")
    return [_check_camera(camera) for camera in camera_list]


def _check_camera(camera: Camera) -> Camera:
    """The camera with arrays for matrices, turned to look along −z if it looks along +z; a traced one stays."""
    view, projection = (check_matrix(f"the camera's {n}", getattr(camera, n)) for n in ("view", "projection"))
    if view is not camera.view or projection is not camera.projection:
        camera = camera.replace(view=view, projection=projection)
    sign = projection[3, 2] if isinstance(projection, np.ndarray) else value_of(projection[3, 2])
    return camera.turned() if sign is not None and (sign > 0).all() else camera


def _check_part(index: int, part: Part) -> CheckedPart:
    """The part at an index of the scene, if its fields pass the checks; else an InputError. Lists become arrays."""
    surface = _check_surface(part.surface, f"the surface of part {index}")
    if min(surface.sample_widths) < 0:
        raise InputError(f"{surface!r} has no sample_widths; expected (I, P), the integers and reals of a sample")
    shader = check_shader(part.shader, f"the shader of part {index}")
    theta, transform = from_numbers(part.theta, f"part {index}'s theta"), part.transform
    if transform is not None:
        transform = check_matrix(f"the transform of part {index}", transform)
    surface.check(theta)
    reads = surface.reads(theta)
    if isinstance(reads, str) or not set(reads) <= set(theta):
        raise InputError(f"reads of {surface!r} gave {reads!r}; expected names of entries of theta: {sorted(theta)}")
    return CheckedPart(surface, theta, shader, transform, part.cull)


def check_channels(parts: Sequence[CheckedPart]) -> int:
    """The number of channels besides alpha, which must be the same for the shaders of all parts."""
    count = parts[0].shader.channels
    for index, part in enumerate(parts):
        if not is_count(part.shader.channels):
            raise InputError(
                f"channels of the shader {quoted(part.shader)} is {quoted(part.shader.channels)}; expected an integer "
                f"of at least 1"
            )
        if part.shader.channels != count:
            raise InputError(
                f"the shader of part 0 gives {count} channels and that of part {index} gives {part.shader.channels}; "
                f"expected the same number for all parts of a scene"
            )
    return count


def check_colors(channels: int) -> None:
    """Refuse another number of channels than three, where an image of colours is needed."""
    if channels != 3:
        raise InputError(
            f"the scene's shaders give {channels} channels besides alpha; expected 3: look at three of them at a "
            f"time, by a shader that gives those"
        )


def check_changes(index: int, changes: Mapping[str, Any], count: int) -> None:
    """Refuse changes of a prepared part: of fields that are fixed, or with an index outside of `count` parts."""
    if "surface" in changes:
        raise InputError("a prepared part keeps its surface; call rts.prepare for another one")
    unknown = set(changes) - {"theta", "shader", "transform", "cull"}
    if unknown or not -count <= index < count:
        raise InputError(
            f"part {index} with {sorted(changes)} was asked for; expected theta, shader, transform or cull of "
            f"one of {count} parts"
        )


def changed_part(index: int, part: CheckedPart, changes: Mapping[str, Any]) -> CheckedPart:
    """A checked part with changed fields, which are checked; an error names it by `index`.

    `changes` has passed `check_changes`, and is not empty.

    Raises:
        InputError: a field's value is wrong.
    """
    if set(changes) - {"transform"}:
        return _check_part(index, part.replace(**changes))
    transform = changes["transform"]
    if transform is not None:
        transform = check_matrix(f"the transform of part {index}", transform)
    return CheckedPart(part.surface, part.theta, part.shader, transform, part.cull)


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
    return splatter


def is_auto(value: Any) -> bool:
    """True for the name "auto"."""
    return isinstance(value, str) and value == "auto"


def check_shader(shader: Any, what: str) -> Shader:
    """A usable shader from a name, a class, an object or a function; `what` names it."""
    shader = registry.instance("rts.shaders", shader)
    shader = FunctionShader(shader) if callable(shader) and not isinstance(shader, Shader) else shader
    return checked_plugin(shader, what, Shader, "a function, ")


def _check_surface(surface: Any, what: str) -> Surface:
    checked_plugin(surface, what, Surface, "such as a mesh, ")
    for base, method in ((TriangleSurface, "proxy"), (RaySurface, "intersect")):
        if hasattr(surface, method) and not isinstance(surface, base):
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
    if not isinstance(plugin, base):
        bases = "rts.TriangleSurface or rts.RaySurface" if base is Surface else f"rts.{base.__name__}"
        raise InputError(f"{what} is {quoted(plugin)}; expected {others}or an object whose class subclasses {bases}")
    check_members(type(plugin))
    return plugin


def check_matrix(name: str, matrix: Any) -> Array:
    """A (4, 4) matrix of floating numbers: lists become float32, NumPy integers float64. Other arrays are refused."""
    matrix = from_numbers(matrix, name)
    if shape_of(matrix) != (4, 4):
        several = len(shape_of(matrix)) == 3 and shape_of(matrix)[1:] == (4, 4)
        hint = "; for several views call rts.render_views, for several poses vmap of rts.render" if several else ""
        raise InputError(f"{name} {described(matrix)}; expected a (4, 4) array{hint}")
    if isinstance(matrix, np.ndarray):
        return matrix if matrix.dtype.kind == "f" else matrix.astype(np.float64)
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
    if not is_auto(layers) and not is_count(layers):
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
            f"{height} x {width} pixels with {layers} layers need about {needed / 2**30:.3g} GiB, and this machine has "
            f"{MEMORY / 2**30:.3g} GiB; choose a smaller size, or fewer samples a pixel or layers"
        )


def is_count(value: Any) -> bool:
    """True for an integer of at least 1, Python's or NumPy's."""
    return isinstance(value, Integral) and not isinstance(value, bool) and int(value) >= 1


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


def check_shaded(rgba: Any, count: int, shader: Shader) -> None:
    """Refuse a shader's result unless it is (count, C + 1), C its channels, and its numbers are floating."""
    expected, shape = (count, shader.channels + 1), shape_of(rgba)
    if shape != expected:
        other = len(shape) == 2 and shape[0] == count and shape[1] > 4
        hint = f": {shader.channels} channels and alpha, as its attribute `channels` says" if other else ""
        raise InputError(f"what the shader {quoted(shader)} returned {described(rgba)}; expected {expected}{hint}")
    if not floating_bits(rgba):  # Only then is the message put together, which takes time.
        check_floating(f"what the shader {quoted(shader)} returned", rgba)


def check_splats(
    index: int, part: CheckedPart, gbuffer: GBuffer, positions: Array, rgba: Array, row: Array, first: int
) -> None:
    """Refuse samples whose position or colour is NaN or infinite, and colours of `BRIGHTEST` or more; name the cause.

    Traced values are skipped, and rows that no cell refers to. No shader or splatter of the library turns NaN into a
    number.

    Args:
        index: the index of the part.
        part: the part.
        gbuffer: the G-buffer that its shader was given, in world space.
        positions: (N, 3) pixel x, pixel y, depth.
        rgba: (N, C + 1).
        row: (K, H, W) int32, the row of each cell's sample, counted over all parts.
        first: the first row of this part.
    """
    if is_finite(positions) and is_finite(rgba, below=BRIGHTEST):
        return
    rows = value_of(row)
    if rows is None:
        return
    count = positions.shape[-2]
    used = np.unique(rows[(rows >= first) & (rows < first + count)]) - first

    def wrong(x: Any, below: float = math.inf) -> bool:
        """True if a number is not `below` in size; if there is a row for each sample, only visible rows are checked."""
        array = value_of(x)
        if array is None or array.dtype.kind != "f":
            return False
        return not (np.abs(array[..., used, :] if array.shape[-2:-1] == (count,) else array) < below).all()

    if not (wrong(positions) or wrong(rgba)):  # Unused rows may hold anything.
        if wrong(rgba, BRIGHTEST):
            raise InputError(
                f"what the shader {quoted(part.shader)} returned of part {index} holds a number of {BRIGHTEST:g} or "
                f"more; expected smaller colours"
            )
        return
    for place, value in placed_leaves(part.theta):
        if wrong(value):
            name = "theta" + "".join(f"[{key!r}]" for key in place)
            raise InputError(f"{name} of part {index} holds NaN or infinity; expected finite numbers")
    for name in gbuffer:
        if dict.__contains__(gbuffer, name) and wrong(gbuffer[name]):
            raise InputError(f"{name!r} of {part.surface!r} is NaN or infinite at samples of part {index}")
    what = "the positions of samples" if wrong(positions) else f"what the shader {quoted(part.shader)} returned"
    raise InputError(f"{what} of part {index} holds NaN or infinity, where θ and the surface are finite")
