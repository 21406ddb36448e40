"""Steps in shaders: colours that jump from place to place, of which derivatives tell nothing."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from rts.arrays.engines import namespace, value_of
from rts.arrays.trees import Array
from rts.contracts.gbuffer import GBuffer
from rts.shading.shaders import is_behind

COLOR_JUMP = 0.02
"""The least change of a colour that counts as a jump."""
CLOSE = 4
"""Samples are close together up to so many times the median distance from one to the next."""
HALVINGS = 20
"""How often the way from one sample to the next is halved."""

STEP_CAUSE = "by a comparison, where or rounding: a step has no derivative"
STEP_REMEDY = "make it a ramp of about a pixel, such as a sigmoid, or an outline: triangles of two colours"
"""The origin of a step, and the remedy, in words."""


def steps_inside(shade: Callable[[GBuffer], Array], gbuffer: GBuffer, camera: Any) -> bool:
    """True if the colours that `shade` gives step on the way from a sample to the next one in the G-buffer.

    Attributes change evenly on the way. Only samples that lie close together have one, and not those of the two sides
    of a surface, or whose normals point away from one another: the surface does not go on evenly between them.
    """
    xp, place = namespace(gbuffer.like), 0 * gbuffer.like[:, :1]
    position, normal = gbuffer["position"], {"normal", "face_normal"} & {*gbuffer.computed}
    apart = _known(xp.sum((xp.roll(position, -1, axis=0) - position) ** 2, axis=1))
    moves = apart > 0  # Not so where a sample is repeated, to fill up the rows.
    goes_on = moves & (apart <= CLOSE**2 * np.median(apart[moves])) if moves.any() else moves
    if normal:
        behind, normals = _known(is_behind(gbuffer, camera))[:, 0], _known(gbuffer["normal"])
        goes_on &= (behind == np.roll(behind, -1)) & ((normals * np.roll(normals, -1, axis=0)).sum(1) > 0)

    def at(place: Array) -> Array:
        between = GBuffer()
        for name in gbuffer:
            between.defer(name, lambda x=name: gbuffer[x] + place * (xp.roll(gbuffer[x], -1, axis=0) - gbuffer[x]))
        return shade(between)

    def change(a: Array, b: Array) -> Array:
        return xp.max(abs(a - b), axis=1, keepdims=True)

    before, after = at(place), at(place + 1)
    for k in range(HALVINGS):
        between = at(place + 0.5 ** (k + 1))
        first = change(before, between) >= change(between, after)
        place = xp.where(first, place, place + 0.5 ** (k + 1))
        before, after = xp.where(first, before, between), xp.where(first, between, after)
    return bool((goes_on & (_known(change(before, after))[:, 0] > COLOR_JUMP)).any())


def _known(x: Array) -> np.ndarray:
    """The value of an array that is not traced."""
    value = value_of(x)
    assert value is not None
    return value
