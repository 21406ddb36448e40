"""Schedules: the resolutions at which residuals of images are made small, one after the other."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from rts.arrays.argument_checks import check_pixels, quoted
from rts.arrays.engines import constants, engine_of, namespace
from rts.arrays.trees import Array
from rts.contracts.checks import is_count, is_real
from rts.errors import InputError

COARSEST, BLUR = 16, 1 / 16
"""A pyramid's first stage has at least so many pixels along the longer side, and this share of them as σ."""
SAMPLES, FEWER_SAMPLES = 4, 2
"""Samples a pixel along each axis: at the coarsest stage, where outlines jump over samples; and at stages
between it and the last."""


@dataclass(frozen=True)
class Stage:
    """A stage of a fit, with the resolution at which images are compared; see `fit`.

    Attributes:
        scale: the share of the residuals' own resolution along each axis, in (0, 1].
        supersample: samples a pixel along each axis; None for the residuals' own.
        sigma: standard deviation of the Gaussian that blurs the differences, pixels of this stage; 0 for none.

    Raises:
        InputError: a number out of its range.
    """

    scale: float = 1.0
    supersample: int | None = None
    sigma: float = 0.0

    def __post_init__(self):
        if not (is_real(self.scale) and 0 < self.scale <= 1):
            raise InputError(f"scale is {quoted(self.scale)}; expected a share of the resolution, in (0, 1]")
        if self.supersample is not None and not is_count(self.supersample):
            raise InputError(
                f"supersample is {quoted(self.supersample)}; expected an integer of at least 1, or None for as before"
            )
        if not (is_real(self.sigma) and 0 <= self.sigma < math.inf):
            raise InputError(f"sigma is {quoted(self.sigma)}; expected a number of pixels, at least 0")

    def size(self, full: tuple[int, int]) -> tuple[int, int]:
        """(height, width) of images that are (height, width) in full: rounded, at least one pixel."""
        height, width = (max(1, round(self.scale * n)) for n in full)
        return height, width


def pyramid(size: tuple[int, int], *, coarsest: int = COARSEST, largest: int | None = None) -> tuple[Stage, ...]:
    """A schedule for a start that is far off: from coarse and blurred images to fine ones.

    An outline is pulled over one pixel only, to whichever outline is nearest, the right one or not. Blurred images
    show where most of an object is. So the first stage is of few pixels, with many samples each, and blurred by a
    sixteenth of the longer side. Later stages double the resolution; the last is the image itself, or as `largest`
    says. From how far off poses are found: docs/results/basin.md.

    Args:
        size: (height, width) of the residuals.
        coarsest: the longer side of the first stage has this many pixels, or up to twice as many; fewer only if the
            last stage has.
        largest: the longer side of the last stage has at most this many pixels; None for all.

    Returns:
        Two stages or more.

    Raises:
        InputError: an argument that is no count of pixels.
    """
    longer = max(check_pixels(size))
    for name, value in (("coarsest", coarsest), ("largest", largest)):
        if not is_count(value) and not (name == "largest" and value is None):
            raise InputError(f"{name} is {quoted(value)}; expected a number of pixels, at least 1")
    sides = [longer if largest is None else min(largest, longer)]
    while sides[0] >= 2 * coarsest:
        sides.insert(0, sides[0] // 2)
    return (
        Stage(sides[0] / longer, SAMPLES, BLUR * sides[0]),
        *(Stage(side / longer, FEWER_SAMPLES) for side in sides[1:-1]),
        Stage(sides[-1] / longer),
    )


def checked_schedule(schedule: Any) -> Sequence[Stage]:
    """The stages, a tuple, of a schedule that a user gave: a list or tuple of at least one `Stage`. Refuses others."""
    stages = tuple(schedule) if isinstance(schedule, (list, tuple)) else ()
    if not stages or not all(isinstance(stage, Stage) for stage in stages):
        raise InputError(
            f"schedule is {quoted(schedule)}; expected a list of rts.Stage, such as rts.pyramid(size), or None"
        )
    return stages


# -------------------------------------------------------------------------------------------------- images


def box_filtered(image: Array, size: tuple[int, int]) -> Array:
    """An image (H, W, C) in fewer pixels (h, w, C): each the mean over its area, also where pixels overlap in part."""
    return _along_axes(image, *(_box(few, many) for few, many in zip(size, image.shape[:2], strict=True)))


def blurred(image: Array, sigma: float) -> Array:
    """An image (H, W, C) blurred by a Gaussian, as if it were zero beyond its edges; `sigma` > 0 is in pixels."""
    return _along_axes(image, *(_gaussian(n, sigma) for n in image.shape[:2]))


def _along_axes(image: Array, down: np.ndarray, across: np.ndarray) -> Array:
    """The image (h, w, C): columns of (H, W, C) multiplied by the matrix `down` (h, H), rows by `across` (w, W)."""
    xp = namespace(image)
    down, across = (xp.astype(x, image.dtype, copy=False) for x in constants((down, across), engine_of(image), image))
    height, width, channels = image.shape
    columns = xp.reshape(down @ xp.reshape(image, (height, -1)), (-1, width, channels))
    return across @ columns


def _box(few: int, many: int) -> np.ndarray:
    """Weights (few, many) of the `many` pixels of a row in each of fewer pixels over the same length; rows sum to 1."""
    edges, cells = np.arange(few + 1) * (many / few), np.arange(many + 1.0)
    shared = np.minimum(edges[1:, None], cells[1:]) - np.maximum(edges[:-1, None], cells[:-1])
    return shared.clip(0) * (few / many)


def _gaussian(count: int, sigma: float) -> np.ndarray:
    """Weights (count, count) by which each blurred pixel, a row, takes the pixels of a line; `sigma` > 0 is in pixels.

    Weights end at 4 σ, rounded up. They sum to less than 1 nearer to the ends of the line.
    """
    reach = math.ceil(4 * sigma)
    taps = np.exp(-0.5 * (np.arange(-reach, reach + 1) / sigma) ** 2)
    taps /= taps.sum()
    offset = np.arange(count) - np.arange(count)[:, None]
    return np.where(abs(offset) <= reach, taps[np.clip(offset + reach, 0, 2 * reach)], 0.0)
