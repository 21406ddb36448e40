"""Checks of the colours and positions of samples that plugins return."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from rts.arrays.argument_checks import quoted
from rts.arrays.array_functions import described, is_finite, shape_of
from rts.arrays.engines import floating_bits, value_of
from rts.arrays.trees import Array, placed_leaves
from rts.contracts.checked_parts import CheckedPart
from rts.contracts.checks import BRIGHTEST, check_floating
from rts.contracts.gbuffer import GBuffer
from rts.contracts.shader import Shader
from rts.errors import InputError

ATTRIBUTE_WIDTHS = {"position": 3, "normal": 3, "face_normal": 3, "tangent": 4, "uv": 2, "uv_footprint": 4}
"""Columns of attributes that the library itself reads."""


def check_attribute(surface: Any, count: int, name: str, value: Any) -> None:
    """Refuse an attribute of a surface's G-buffer that has no row for each of `count` samples, or not its columns."""
    shape, width = getattr(value, "shape", ()), ATTRIBUTE_WIDTHS.get(name)
    if len(shape) == 2 and shape[0] == count and (width is None or (shape[1] == width and floating_bits(value))):
        return
    expected = f"({count}, {'any number' if width is None else width})"
    raise InputError(f"{name!r} of {surface!r} {described(value)}; expected a floating array of shape {expected}")


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
    if is_finite(positions, rgba, below=BRIGHTEST):
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
