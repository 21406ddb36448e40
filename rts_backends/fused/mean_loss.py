"""The mean loss of the difference between a splatted image and a target, and its derivatives, in one sweep.

The image is made in an array of its own, in whose place its cotangents are put as it is compared with the target: there
is no other array of the image's size, and the way back starts at what is left in it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from rts import Loss
from rts.plugin_api.arrays import Array
from rts.plugin_api.loops import compiled, kernel
from rts.plugin_api.operations import Operation
from rts.plugin_api.threads import parallel, read_only
from rts_backends.fused.cells import Cells, Choices, Settings
from rts_backends.fused.image import specification, used
from rts_backends.fused.losses import LINEAR, cost_and_weight, in_numbers


class Swept(NamedTuple):
    """What the value leaves to its derivatives.

    Attributes:
        cotangents: (H, W, 4), derivatives of the mean loss by the image over nothing.
        choices: what was decided for each target.
    """

    cotangents: np.ndarray
    choices: Choices


def difference(image: Array, target: Array, weights: Array | None, background: Array | None) -> Array:
    """Weight · (image − target), (H, W, C), of an image (H, W, 4) over a background (H, W, 4), if there is one."""
    if background is not None:
        image = image + (1 - image[..., 3:]) * background
    count = target.shape[2]
    found = (image[..., 3:] if count == 1 else image[..., :count]) - target
    return found if weights is None else found * weights


def _specification(*operands: Array, settings: Settings, loss: Loss) -> Array:
    *splats, target, weights, background = operands
    image = specification(*splats, settings=settings)
    given = (x if x.shape[0] else None for x in (weights, background))
    return loss(difference(image, target, *given))


def _shape(*shapes: tuple[int, ...], settings: Settings, loss: Loss) -> tuple[int, ...]:
    return ()


def _cells(operands: Sequence[np.ndarray], settings: Settings, choices: Choices | None) -> Cells:
    positions, rgba, row, *known = operands[:8]
    return Cells(settings, positions, rgba, row, choices, *known)


def _swept(operands: Sequence[np.ndarray], settings: Settings, loss: Loss) -> tuple[Swept, float]:
    """What is left to the derivatives, and the value."""
    target, weights, background = map(read_only, operands[8:])
    cells, image = _cells(operands, settings, None), np.empty((*target.shape[:2], 4), target.dtype)
    cells.image(image)
    sums = np.zeros(len(image))
    given = image, target, weights, background, in_numbers(loss, image.dtype)
    parallel(_compare, len(image), *given, sums, work=image.size // 2)
    return Swept(read_only(image), cells.choices), float(sums.sum() / max(target.size, 1))


def _forward(operands: Sequence[np.ndarray], out: np.ndarray, *, settings: Settings, loss: Loss) -> Swept:
    swept, out[...] = _swept(operands, settings, loss)
    return swept


def _push(
    operands: Sequence[np.ndarray],
    tangents: Sequence[np.ndarray | None],
    out: np.ndarray,
    *,
    settings: Settings,
    loss: Loss,
    kept: Swept | None,
) -> None:
    swept = kept or _swept(operands, settings, loss)[0]
    images = np.empty((len(out), *swept.cotangents.shape), swept.cotangents.dtype)
    t_positions, t_rgba = tangents
    _cells(operands, settings, swept.choices).jvp(t_positions, t_rgba, images)
    # Targets that nobody looks at hold anything.
    out[:] = [np.where(swept.cotangents != 0, image * swept.cotangents, 0).sum(dtype=np.float64) for image in images]


def _pull(
    operands: Sequence[np.ndarray],
    g: np.ndarray,
    results: Sequence[np.ndarray | None],
    *,
    settings: Settings,
    loss: Loss,
    kept: Swept | None,
) -> None:
    swept = kept or _swept(operands, settings, loss)[0]
    g_positions, g_rgba = results
    _cells(operands, settings, swept.choices).vjp(swept.cotangents, g_positions, g_rgba)
    if g != 1:
        for x in results:
            if x is not None:
                x *= g


@kernel
def _compare(start, stop, image, target, weights, background, loss, sums):
    """Put cotangents in the place of rows [start, stop) of the image, and the sum of losses of each row in (H,)."""
    scale = image.dtype.type(2 / max(target.size, 1))
    plain = target.shape[2] == 1 and len(weights) == 0 and len(background) == 0 and loss[0] == LINEAR
    for y in range(start, stop):
        if plain:
            sums[y] = _compare_alpha(image[y], target[y], scale)
        else:
            at = y if len(weights) > 0 else 0, y if len(background) > 0 else 0
            given = image[y], target[y], weights, background
            if loss[0] == LINEAR:  # A loop that is compiled for the square alone is quicker.
                sums[y] = _compare_row(*given, None, at, scale)
            else:
                sums[y] = _compare_row(*given, loss, at, scale)


@compiled(fastmath={"contract", "reassoc"})
def _compare_alpha(image, target, scale):
    zero, total = image.dtype.type(0), 0.0
    for x in range(len(image)):
        off = image[x, 3] - target[x, 0]
        total += off * off
        image[x, 0] = image[x, 1] = image[x, 2] = zero
        image[x, 3] = scale * off
    return total


@compiled
def _compare_row(image, target, weights, background, loss, at, scale):
    zero, one, total, count = image.dtype.type(0), image.dtype.type(1), 0.0, target.shape[1]
    first = 3 if count == 1 else 0
    for x in range(len(image)):
        through, g_alpha = one - image[x, 3], zero
        for c in range(4):
            if not first <= c < first + count:
                image[x, c] = zero
                continue
            off = image[x, c] - target[x, c - first]
            if len(background) > 0:
                off += through * background[at[1], x, c]
            weight = one
            if len(weights) > 0:
                weight = weights[at[0], x, min(c - first, weights.shape[2] - 1)]
                off = weight * off if weight != zero else zero
            cost, slope = off * off, one
            if loss is not None:
                cost, slope = cost_and_weight(off, loss)
            total += cost
            image[x, c] = scale * weight * off * slope
            if len(background) > 0:
                g_alpha -= image[x, c] * background[at[1], x, c]
        image[x, 3] += g_alpha
    return total


MEAN_LOSS = Operation(
    "rts.image_mean_loss",
    _specification,
    (2, 2, 3, 3, 3, 2, 2, 2, 3, 3, 3),
    _shape,
    _forward,
    _push,
    _pull,
    differentiable=2,
    packed=(0, 1),
    used=used,
    takes_cheap=True,
    even=(1,),
    keeps=True,
    sweeps=True,
)
"""The mean loss () of weight · (image − target) for the operands of `image.IMAGE`, and of a target (H, W, C),
weights (H, W, 1 or C) and a background (H, W, 4), (0, 0, 0) where there are none."""


def mean_loss(
    settings: Settings,
    loss: Loss,
    splats: tuple[Array, ...],
    target: Array,
    weights: Array | None,
    background: Array | None,
) -> Array:
    """See `rts.Splatter.mean_loss`; `splats` are the operands of `image.IMAGE`."""
    none = target[:0, :0, :]
    given: tuple[Any, ...] = tuple(none if x is None else x for x in (weights, background))
    return MEAN_LOSS(*splats, target, *given, settings=settings, loss=loss)
