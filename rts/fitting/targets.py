"""Targets and weights of images whose values are likely to mean something else: refused, or warned of."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from rts.arrays.engines import namespace, value_of
from rts.arrays.trees import Array
from rts.errors import InputError, InputWarning, warn

LARGEST = 2.0
"""Largest number to expect in a picture from 0 to 1 that was filtered or interpolated."""


def check_range(target: Array, count: int, channels: int, name: str = "target") -> None:
    """Refuse alpha far above 1, and warn of such colours. Unless `channels` is 3, they may have any value.

    Args:
        target: (H, W) or (H, W, count), floating.
        count: the target's channels: 1 is alpha, `channels` has no alpha, and `channels + 1` has alpha last.
        channels: the number of channels of the image besides alpha.
        name: the target, in words.

    Raises:
        InputError: an alpha above 2.

    Warns:
        InputWarning: a colour above 2.
    """
    alpha = target if count == 1 else target[..., -1:] if count == channels + 1 else None
    most = 0.0 if alpha is None else largest(alpha)
    if most > LARGEST:
        raise InputError(f"{name}'s alpha goes up to {most:g}; expected 0 to 1: divide one from 0 to 255 by 255")
    if channels == 3 and count > 1 and (most := largest(target[..., :3])) > LARGEST:
        warn(
            f"{name}'s colours go up to {most:g}, and those of shaders from 0 to 1: divide a picture from 0 to 255 by "
            f"255, or let rts.load_image read it",
            InputWarning,
        )


def largest(values: Array) -> float:
    """The largest of an array's values, at least one; 0 if they are traced."""
    known = value_of(namespace(values).max(values))
    return 0.0 if known is None else float(known.max())


def warn_of_gradients(images: Mapping[str, Any]) -> None:
    """Warn of torch arrays that require a gradient, but are taken as constants."""
    for name, value in images.items():
        if any(getattr(x, "requires_grad", False) for x in (value if isinstance(value, (list, tuple)) else [value])):
            warn(f"{name} requires a gradient, and is taken as a constant; give {name}.detach()", InputWarning)


def refuse_zero(weights: Sequence[Array | None]) -> None:
    """Refuse weights that are zero in all views, so that nothing is compared. None means ones; traced ones pass."""
    known = [
        None if view_weights is None else value_of(namespace(view_weights).any(view_weights != 0))
        for view_weights in weights
    ]
    if not any(nonzero is None or nonzero.any() for nonzero in known):
        raise InputError(
            "weights are all zero, so that nothing is compared; expected some above zero. A depth or a normal of zero "
            "was not measured, and has a weight of zero"
        )


def as_mask(x: Array) -> Array:
    """A mask of True and False in float32, as 1 and 0; all else as it is."""
    if not hasattr(x, "dtype"):
        return x
    xp = namespace(x)
    return xp.astype(x, xp.float32) if xp.isdtype(x.dtype, "bool") else x
