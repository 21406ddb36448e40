"""Checked parts: scenes that users give, and changes of them, refused where they are wrong."""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from itertools import repeat
from typing import Any

import numpy as np

from rts.arrays.argument_checks import quoted
from rts.arrays.array_functions import described, from_numbers
from rts.arrays.engines import value_of
from rts.arrays.trees import Array, Tree, join_record, record
from rts.contracts.checks import check_matrix, check_shader, check_surface, is_count
from rts.contracts.shader import Shader
from rts.contracts.surface import Surface
from rts.errors import InputError
from rts.plugin_base import promised
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


def check_scene(parts: Part | Sequence[Part], camera: Camera) -> tuple[list[CheckedPart], Camera]:
    """A list of the parts, checked, and the camera, turned to look along −z; wrong ones raise an `InputError`.

    Shaders are looked up by name, and lists of numbers become arrays. Arrays of several engines are not detected here.
    """
    part_list = listed_parts(parts)
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
    return check_parts(part_list), camera


def listed_parts(parts: Any) -> list[Part]:
    """A list of one part, or of several; anything else raises an `InputError`."""
    part_list: list[Any] = list(parts) if isinstance(parts, (list, tuple)) else [parts]
    if not part_list or not all(map(isinstance, part_list, repeat(Part))):
        kinds = ", ".join(sorted({type(p).__name__ for p in part_list})) or "nothing"
        raise InputError(f"parts holds {kinds}; expected an rts.Part or several")
    return part_list


def check_parts(parts: Sequence[Part]) -> list[CheckedPart]:
    """The parts, checked as `check_scene` says."""
    checked = [_check_part(index, part) for index, part in enumerate(parts)]
    check_channels(checked)
    return checked


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
    view = check_matrix("the camera's view", camera.view)
    projection = check_matrix("the camera's projection", camera.projection)
    if view is not camera.view or projection is not camera.projection:
        camera = camera.replace(view=view, projection=projection)
    if isinstance(projection, np.ndarray):
        return camera.turned() if projection[3, 2] > 0 else camera
    sign = value_of(projection[3, 2])
    return camera.turned() if sign is not None and (sign > 0).all() else camera


def _check_part(index: int, part: Part) -> CheckedPart:
    """The part at an index of the scene, if its fields pass the checks; else an InputError. Lists become arrays."""
    surface = check_surface(part.surface, f"the surface of part {index}")
    if min(surface.sample_widths) < 0:
        raise InputError(f"{surface!r} has no sample_widths; expected (I, P), the integers and reals of a sample")
    shader = check_shader(part.shader, f"the shader of part {index}")
    theta, transform = from_numbers(part.theta, f"part {index}'s theta"), part.transform
    if transform is not None:
        transform = check_matrix(f"the transform of part {index}", transform)
    surface.check(theta)
    reads = surface.reads(theta)
    if isinstance(reads, str) or not set(reads := tuple(reads)) <= set(theta):
        raise InputError(f"reads of {surface!r} gave {reads!r}; expected names of entries of theta: {sorted(theta)}")
    checked = join_record(CheckedPart, (theta, transform), (surface, shader, part.cull))
    # Known now, and asked for at each stage.
    read = dict(zip(reads, map(theta.get, reads), strict=True))
    checked.__dict__.update(read=read, reads=promised(shader, "reads"), uniform=promised(shader, "uniform"))
    return checked


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
