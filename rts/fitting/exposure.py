"""Parts as pictures of different exposure show them: colours with a gain and an offset."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from rts.arrays.array_functions import from_numbers, shape_of
from rts.arrays.engines import constants, engine_of, exemplar, namespace
from rts.arrays.trees import Array, Tree
from rts.contracts.checks import check_shader
from rts.contracts.gbuffer import GBuffer
from rts.contracts.shader import Shader
from rts.errors import InputError
from rts.plugin_base import promised
from rts.scene.camera import Camera
from rts.scene.parts import Part

ENTRY = "exposure"
"""The entry of θ that holds gain and offset."""


class Exposed(Shader):
    """A shader whose colours are multiplied by a gain, and get an offset times alpha; see `ViewResiduals`."""

    def __init__(self, shader: Shader):
        self.shader, self.channels, self.opaque = shader, shader.channels, shader.opaque
        self.uniform = promised(shader, "uniform")
        reads = promised(shader, "reads")
        self.reads = None if reads is None else (*reads, ENTRY)

    def __call__(self, theta: Mapping[str, Tree], gbuffer: GBuffer, camera: Camera) -> Array:
        """See `rts.Shader`."""
        rgba, exposure = self.shader(theta, gbuffer, camera), theta[ENTRY]
        colors, alpha = rgba[..., :-1], rgba[..., -1:]
        if "gain" in exposure:
            colors = colors * exposure["gain"]
        if "offset" in exposure:
            colors = colors + exposure["offset"] * alpha
        return namespace(colors, alpha).concat([colors, alpha], axis=-1)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Exposed) and self.shader == other.shader

    def __hash__(self) -> int:
        return hash((Exposed, self.shader))


def exposed(parts: Any, exposure: Any, view: Array, count: int) -> list[Part]:
    """Parts whose colours have the gain and the offset of a view.

    Args:
        parts: a part, or several.
        exposure: gain and offset, each (B,) or (B, 3) of all views, or None.
        view: the number of the view, perhaps traced.
        count: B.

    Raises:
        InputError: prepared parts, an `exposure` of θ already, or arrays of other shapes.
    """
    if not isinstance(exposure, (tuple, list)) or len(exposure) != 2:
        raise InputError("exposure gave no pair; expected gain and offset, arrays or None")
    entry = {}
    for name, value in zip(("gain", "offset"), exposure, strict=True):
        if value is None:
            continue
        value = from_numbers(value, name)
        shape = shape_of(value)
        if shape[:1] != (count,) or len(shape) > 2:
            raise InputError(f"exposure gave a {name} of shape {shape}; expected ({count},) or ({count}, 3)")
        value, number = constants((value, view), engine_of(value, view), exemplar((value, view)))
        entry[name] = value[number, ...]
    part_list = list(parts) if isinstance(parts, (tuple, list)) else [parts]
    if not all(isinstance(part, Part) for part in part_list):
        raise InputError("scene gave prepared parts; with an exposure it has to give rts.Part, or several")
    if any(ENTRY in part.theta for part in part_list):
        raise InputError(f"θ of a part has an entry {ENTRY!r}, which the exposure of views needs; rename it")
    return [
        replace(part, theta={**part.theta, ENTRY: entry}, shader=Exposed(check_shader(part.shader, "the shader")))
        for part in part_list
    ]
