"""Steps in shaders: colours that jump as a number moves, of which derivatives tell nothing."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from rts import Camera, render_samples, sample
from rts.errors import RtsError
from rts.plugin_api.arrays import Array, leaves
from rts.tool_api.scenes import COLOR_JUMP, STEP_CAUSE, STEP_REMEDY
from rts_diagnostics.gradient_reasons import variants
from rts_diagnostics.gradient_reasons.reasons import Finding
from rts_diagnostics.gradient_reasons.slopes import Number
from rts_diagnostics.gradient_reasons.subject import DEEP, Subject, listed_parts

FINE = 1 / 256
"""The length to which the interval of a jump is halved, in steps of the number, such as pixels."""
REACHES = tuple(4.0**k for k in range(7))
"""How far numbers are moved that change nothing nearby, in steps."""
STAYS = 0.5
"""A jump that keeps more than this share of its size in the last interval is a step; smooth colours keep hardly any."""


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
            if off.max() > COLOR_JUMP:
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
    if abs(after[place] - before[place]) <= max(STAYS * whole, COLOR_JUMP):
        return None
    y, x = (i + sampled.border for i in place[:2])
    seen = sampled.part[:, y, x]
    seen = subject.engine.to_numpy(seen) if subject.engine.owns(seen) else np.asarray(seen)
    parts = variants.names(sorted({int(part) for part in seen if part >= 0}), "or")
    because = f"colours of {parts} step as it changes, {STEP_CAUSE}"
    return Finding("steps", because, f"{STEP_REMEDY.capitalize()}.", off.max(axis=-1) > COLOR_JUMP)
