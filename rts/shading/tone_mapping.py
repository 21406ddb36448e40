"""Bright colours brought into the range of a display."""

from __future__ import annotations

from typing import Any

from rts.arrays.argument_checks import quoted
from rts.arrays.array_functions import described, from_numbers, shape_of
from rts.arrays.engines import namespace
from rts.arrays.trees import Array
from rts.contracts.checks import check_floating, is_real
from rts.errors import InputError

START, FADE, OFFSET = 0.8 - 0.04, 0.15, 0.04
"""Where compression starts, how fast bright colours become white, and the reflection of a dielectric."""
EXPOSURES = 100
"""The size that an exposure stays below."""


def tonemap(image: Array, exposure: float = 0.0) -> Array:
    """Linear colours from 0 to 1 of linear colours of any brightness: Khronos' PBR Neutral tone mapper.

    Base colours up to 0.8 in light of brightness 1 keep hue and contrast; brighter ones are compressed, and fade to
    white. Differentiable.

    Args:
        image: (…, 3), or (…, 4) premultiplied RGBA, whose alpha stays; floating numbers, an array of any engine.
        exposure: stops: colours are multiplied by 2 to this power before.

    Returns:
        The same shape and engine.

    Raises:
        InputError: another shape, no floating numbers, or an exposure that is no number between −100 and 100.
    """
    check_exposure(exposure)
    image = from_numbers(image, "the image")
    if shape_of(image)[-1:] not in ((3,), (4,)):
        raise InputError(f"the image {described(image)}; expected (…, 3) or (…, 4)")
    check_floating("the image", image)
    xp = namespace(image)
    if image.shape[-1] == 4:
        alpha = image[..., 3:]
        straight = image[..., :3] / xp.where(alpha > 0, alpha, xp.ones_like(alpha))
        return xp.concat([tonemap(straight, exposure) * alpha, alpha], axis=-1)
    color = xp.clip(image, 0.0, None) * 2.0**exposure
    least = xp.min(color, axis=-1, keepdims=True)
    # The reflection of dielectrics, which only brightens, is taken off.
    color = color - xp.where(least < 2 * OFFSET, least - least * least / (4 * OFFSET), OFFSET + 0 * least)
    peak = xp.max(color, axis=-1, keepdims=True)
    high = xp.where(peak > START, peak, START + 0 * peak)
    room = 1 - START
    low = 1 - room * room / (high + room - START)
    white = 1 - 1 / (FADE * (high - low) + 1)
    bright = color * (low / high) * (1 - white) + low * white
    return xp.where(peak > START, bright, color)


def check_exposure(exposure: Any) -> None:
    """Refuse an exposure that is no number between −`EXPOSURES` and `EXPOSURES`."""
    if not is_real(exposure) or not abs(exposure) < EXPOSURES:
        raise InputError(f"exposure is {quoted(exposure)}; expected a number of stops, such as 1 for twice as bright")
