"""Targets and weights of images as users give them: checked, in views, and in fewer pixels."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from rts.arrays.array_functions import described, from_numbers, is_finite, kind_of, shape_of
from rts.arrays.engines import constants, engine_of, exemplar, namespace, value_of
from rts.arrays.trees import Array
from rts.contracts.checks import check_floating, is_real
from rts.errors import InputError, InputWarning, warn
from rts.fitting.schedule import box_filtered

LARGEST = 2.0
"""Largest number to expect in a picture from 0 to 1 that was filtered or interpolated."""
BRIGHTEST = 64.0
"""Brightest colour to expect of lights, where white is 1."""
ZERO_UNMEASURED = ("depth", "normal")
"""Outputs of which a target of 0 is not measured."""
NOT_MEASURED = "; put 0 where nothing was measured"
NOTHING_THERE = "; where there is nothing to compare with, put any number and give it a weight of 0"


def by_name(of_views: Any, missing: Any = None) -> Any:
    """A dict of lists for a list of dicts, one for each view; all else as it is.

    Their names are the same, unless there is something to put in place of those that are `missing`.
    """
    if not isinstance(of_views, (list, tuple)) or not any(isinstance(x, Mapping) for x in of_views):
        return of_views
    if missing is not None and all(x is None or isinstance(x, Mapping) for x in of_views):
        names = dict.fromkeys(name for x in of_views for name in x or ())
        return {name: [(x or {}).get(name, missing) for x in of_views] for name in names}
    kinds = sorted({", ".join(sorted(x)) if isinstance(x, Mapping) else kind_of(x) for x in of_views})
    if len(kinds) > 1:
        raise InputError(f"views have targets or weights of unlike names: {'; '.join(kinds)}; expected the same in all")
    return {name: [x[name] for x in of_views] for name in of_views[0]}


def view_count(target: Any, size: tuple[int, int], several: bool) -> int | None:
    """The number of views of a target; None for a target of one view, without an axis of views.

    Args:
        target: as the user gave it. A list is of views if one of its entries has the size of the image.
        size: (height, width).
        several: True for several cameras. It decides where (H, W, ·) might be (B, H, W).
    """
    if isinstance(target, (list, tuple)):
        return len(target) if any(shape_of(x)[:2] == size for x in target) else None
    shape: Any = shape_of(target)
    return shape[0] if len(shape) > 3 or (shape[1:3] == size and (several or shape[:2] != size)) else None


def weights_of_views(weights: Any, count: int) -> Sequence[Any]:
    """The weights of each of `count` views: an array or list of as many as given; or None, or one number, for each."""
    if weights is None or is_real(weights):
        return [weights] * count
    weight_count = len(weights) if isinstance(weights, (list, tuple)) else (shape_of(weights) or (0,))[0]
    if weight_count != count:
        raise InputError(f"weights are of {weight_count} views; expected {count}, as many as targets")
    return weights


def checked_target(target: Any, size: tuple[int, int], channels: int) -> tuple[Array, int]:
    """The target, checked, its shape kept; and its own number of channels. Images have `channels` besides alpha."""
    if target is None:
        raise InputError("target is None; expected an array, such as what rts.load_image gives")
    target = as_mask(from_numbers(target, "target"))
    shape = shape_of(target)
    if shape[:2] != size or shape[2:] not in ((), (1,), (channels,), (channels + 1,)):
        height, width = size
        raise InputError(
            f"target {described(target)}; expected ({height}, {width}) or ({height}, {width}, 1) to compare with "
            f"alpha, ({height}, {width}, {channels}) with colours, or ({height}, {width}, {channels + 1}) with both"
        )
    check_floating("target", target)
    _check_finite("target", target, NOTHING_THERE)
    count = shape[2] if len(shape) > 2 else 1
    check_range(target, count, channels)
    return target, count


def checked_output(name: str, target: Any, size: tuple[int, int], channels: int) -> Array:
    """The target (H, W) or (H, W, ·) of an output, checked; `channels` of colours besides alpha."""
    if name in ("part", "triangle"):
        raise InputError(f"target has {name!r}, and indices have no derivative; compare 'depth', 'alpha' or 'color'")
    target = as_mask(from_numbers(target, f"target[{name!r}]"))
    shape = shape_of(target)
    if shape[:2] != size or len(shape) not in (2, 3):
        height, width = size
        raise InputError(
            f"target[{name!r}] {described(target)}; expected real numbers ({height}, {width}) or ({height}, {width}, ·)"
        )
    check_floating(f"target[{name!r}]", target)
    _check_finite(f"target[{name!r}]", target, NOT_MEASURED if name in ZERO_UNMEASURED else NOTHING_THERE)
    count = shape[2] if len(shape) > 2 else 1
    if name == "alpha" or (name == "color" and count == channels == 3):  # Four numbers may be features.
        check_range(target, count, channels, f"target[{name!r}]")
    return target


def checked_weights(weights: Any, shape: tuple[int, ...], size: tuple[int, int]) -> Array | None:
    """Weights of a target of this shape, checked: an array, or one number for all pixels; None stays None."""
    if weights is None:
        return None
    weights = as_mask(from_numbers(np.full(size, weights, np.float32) if is_real(weights) else weights, "weights"))
    allowed = dict.fromkeys((size, (*size, 1), tuple(shape)))
    if shape_of(weights) not in allowed:
        raise InputError(f"weights {described(weights)}; expected {' or '.join(map(str, allowed))}")
    check_floating("weights", weights)
    _check_finite("weights", weights)
    if (least := -largest(-weights)) < 0:
        raise InputError(f"weights go down to {least:g}; expected none below zero: only their squares count")
    return weights


def measured(target: Array, weights: Array | None) -> Array:
    """Weights (H, W, 1 or ·) of a target (H, W) or (H, W, ·), and 0 where it is 0."""
    xp = namespace(target)
    there = xp.reshape(target, (*target.shape[:2], -1)) != 0
    there = xp.astype(xp.any(there, axis=-1, keepdims=True), target.dtype)
    if weights is None:
        return there
    weights, there = constants((weights, there), engine_of(target, weights), exemplar((target, weights)))
    return xp.reshape(weights, (*target.shape[:2], -1)) * there


def shrunk(target: Array, weights: Array | None, size: tuple[int, int]) -> tuple[Array, Array | None]:
    """Target (H, W, …) and weights in fewer pixels `size` (h, w), with as many axes and channels as before.

    A pixel of the target is the mean over its area by squared weights, or the plain mean where weights are all zero. A
    weight is the root of the mean square; None stays None.
    """
    xp, kind = namespace(target, weights), target.shape
    weights, target = constants((weights, target), engine_of(target, weights), exemplar((target, weights)))
    target = xp.reshape(target, (*kind[:2], -1))
    if weights is None:
        return xp.reshape(box_filtered(target, size), (*size, *kind[2:])), None
    shape = weights.shape
    counts = xp.reshape(weights, (*kind[:2], -1)) ** 2
    total = box_filtered(counts, size)
    known = total > 0
    mean = box_filtered(counts * target, size) / xp.where(known, total, xp.ones_like(total))
    small = xp.where(known, mean, box_filtered(target, size))
    return xp.reshape(small, (*size, *kind[2:])), xp.reshape(xp.sqrt(total), (*size, *shape[2:]))


def _check_finite(name: str, value: Array, hint: str = "") -> None:
    """Refuse NaN and infinity, where values are known; a hint says what to do."""
    if not is_finite(value):
        raise InputError(f"{name} holds NaN or infinity; expected finite numbers{hint}")


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
        InputWarning: a colour that no light explains.
    """
    alpha = target if count == 1 else target[..., -1:] if count == channels + 1 else None
    most = 0.0 if alpha is None else largest(alpha)
    if most > LARGEST:
        raise InputError(f"{name}'s alpha goes up to {most:g}; expected 0 to 1: divide one from 0 to 255 by 255")
    if channels == 3 and count > 1 and (most := largest(target[..., :3])) > BRIGHTEST:
        warn(
            f"{name}'s colours go up to {most:g}, where white is 1: divide a picture from 0 to 255 by 255, or let "
            f"rts.load_image read it",
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
