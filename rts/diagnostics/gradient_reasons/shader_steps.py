"""Steps in shaders: colours that jump as a number moves, or from place to place, of which derivatives tell nothing."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from rts.arrays.engines import namespace, value_of
from rts.arrays.trees import Array, leaves
from rts.contracts.gbuffer import GBuffer
from rts.diagnostics.gradient_reasons import variants
from rts.diagnostics.gradient_reasons.reasons import Finding
from rts.diagnostics.gradient_reasons.slopes import Number
from rts.diagnostics.gradient_reasons.subject import DEEP, Subject, listed_parts
from rts.errors import RtsError
from rts.rendering.image import render_samples
from rts.rendering.samples import sample
from rts.scene.camera import Camera
from rts.shading.shaders import is_behind

JUMP = 0.02
"""The least change of a colour that counts as a jump."""
FINE = 1 / 256
"""The length to which the interval of a jump is halved, in steps of the number, such as pixels."""
REACHES = tuple(4.0**k for k in range(7))
"""How far numbers are moved that change nothing nearby, in steps."""
STAYS = 0.5
"""A jump that keeps more than this share of its size in the last interval is a step; smooth colours keep hardly any."""
CLOSE = 4
"""Samples are close together up to so many times the median distance from one to the next."""
HALVINGS = 20
"""How often the way from one sample to the next is halved."""

STEP = "by a comparison, where or rounding: a step has no derivative"
REMEDY = "make it a ramp of about a pixel, such as a sigmoid, or an outline: triangles of two colours"
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
    return bool((goes_on & (_known(change(before, after))[:, 0] > JUMP)).any())


def _known(x: Array) -> np.ndarray:
    """The value of an array that is not traced."""
    value = value_of(x)
    assert value is not None
    return value


def why_stepped(subject: Subject, number: Number, connect: bool = False, far: bool = False) -> Finding | None:
    """A finding if colours of samples step as a number moves; the samples stay where they are on surfaces.

    Its mask are the pixels whose samples change otherwise than by their derivative.

    Args:
        subject: the scene under test.
        number: the number.
        connect: see `Subject.push`.
        far: True to move it farther than a step, too, by `REACHES`.

    Returns:
        The finding; None if colours are smooth, or samples do not outlast a change of the number.
    """
    layers = subject.options.get("layers", "auto")
    layers = 1 if subject.opaque else max(DEEP, 0 if isinstance(layers, str) else layers)
    length = number.slope.step
    try:
        parts, camera = subject.shown(subject.parameters)
        sampled = sample(listed_parts(parts), camera, subject.size, splatter="none", layers=layers)

        def drawn(scene: tuple[Any, Camera]) -> Array:
            image = render_samples(sampled, listed_parts(scene[0]), scene[1], splatter="none")
            owned = subject.engine.owns(image)
            return image if owned else subject.engine.constant(image, next(leaves(subject.parameters)))

        def at(by: float) -> np.ndarray:
            scene = subject.shown(subject.moved(number.direction, by * length))
            return subject.engine.to_numpy(drawn(scene)).astype(np.float64)

        slope = subject.pushed(drawn, number.direction, connect) * length
        for reach in REACHES if far else REACHES[:1]:
            low, high, before, after = -reach, reach, at(-reach), at(reach)
            off = np.abs(after - before - 2 * reach * slope)
            if off.max() > JUMP:
                break
        else:
            return None
        place = tuple(map(int, np.unravel_index(np.argmax(off), off.shape)))
        whole = abs(after[place] - before[place])
        for _ in range(math.ceil(math.log2(2 * reach / FINE))):
            middle = (low + high) / 2
            between = at(middle)
            if abs(between[place] - before[place]) >= abs(after[place] - between[place]):
                high, after = middle, between
            else:
                low, before = middle, between
    except RtsError:  # Arrays of a surface change in length, say.
        return None
    if abs(after[place] - before[place]) <= max(STAYS * whole, JUMP):
        return None
    y, x = (i + sampled.apron for i in place[:2])
    seen = sampled.part[:, y, x]
    seen = subject.engine.to_numpy(seen) if subject.engine.owns(seen) else np.asarray(seen)
    parts = variants.names(sorted({int(part) for part in seen if part >= 0}), "or")
    because = f"colours of {parts} step as it changes, {STEP}"
    return Finding("steps", because, f"{REMEDY.capitalize()}.", off.max(axis=-1) > JUMP)
