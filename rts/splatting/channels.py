"""Images of any number of channels, from splatters that take three channels and alpha."""

from __future__ import annotations

import math

import numpy as np

from rts.arrays.array_functions import averaged, described, shape_of
from rts.arrays.engines import namespace, value_of
from rts.arrays.trees import Array
from rts.contracts.records import Splats
from rts.contracts.splatter import Splatter
from rts.errors import InputError, LayersWarning, warn
from rts.plugin_base import promised

GROUP = 3
"""Number of channels, besides alpha, in one call of a splatter."""

LOST = 0.01
"""The share of light that may be lost behind a sample, or behind the last layer, without a warning."""


def cropped_image(splatter: Splatter, splats: Splats) -> Array:
    """The image (h, w, C + 1) of splats, the border cut off, of pixels, `Splats.supersample`² cells each.

    Channels depend on alpha, but not on one another. So a splatter that takes no others makes one image of every three
    channels and alpha, filled up with zeros. The alpha of the first image is returned. Warns of light that translucent
    samples lose.

    Args:
        splatter: a splatter.
        splats: shaded samples; `rgba` is (N, C + 1), alpha last.

    Raises:
        InputError: the splatter returned an image of another shape.
    """
    rgba = splats.rgba
    if not splats.opaque:
        _warn_of_lost_light(splatter, splats)
    count = rgba.shape[1] - 1
    if count == GROUP or promised(splatter, "any_channels"):
        return _cropped(splatter, splats)
    xp, alpha, images = namespace(rgba), rgba[:, count:], []
    for first in range(0, count, GROUP):
        channels = rgba[:, first : min(first + GROUP, count)]
        missing = [xp.zeros_like(alpha)] * (GROUP - shape_of(channels)[1])
        images.append(_cropped(splatter, splats.replace(rgba=xp.concat([channels, *missing, alpha], axis=1))))
    left = count - GROUP * (len(images) - 1)
    alpha = images[0][..., GROUP:]
    return xp.concat([*(image[..., :GROUP] for image in images[:-1]), images[-1][..., :left], alpha], axis=-1)


def _warn_of_lost_light(splatter: Splatter, splats: Splats) -> None:
    """Warn if light is lost: behind samples that a splatter takes to be opaque, or behind the last layer."""
    alpha, row = value_of(splats.rgba[:, -1]), value_of(splats.row)
    if alpha is None or row is None or row.ndim > 3 or not len(alpha):
        return  # Values are not known, or those of several scenes, under `torch.vmap`.
    if not promised(splatter, "translucent"):
        if alpha.min() < 1 - LOST:
            warn(
                f"samples are translucent, and {splatter!r} leaves out some of the light that passes through them; "
                f"use splatter='edges'",
                LayersWarning,
            )
        return
    full = row.reshape(len(row), -1).take(np.flatnonzero(row[-1] >= 0), axis=1)
    light = (1 - alpha.take(full)).prod(axis=0).max(initial=0)
    if light > LOST:
        # In tens, so that a loop does not repeat the warning in other words.
        warn(
            f"up to {10 * math.ceil(10 * light)} % of the light passes through the last of {len(row)} layers, and "
            f"surfaces farther back, if any, are left out; give a larger number of layers ('auto' takes up to 16)",
            LayersWarning,
        )


def _cropped(splatter: Splatter, splats: Splats) -> Array:
    """The image (h, w, C + 1) of splats with colours (N, C + 1), the border cut off, of pixels."""
    image, side = splatter.cropped(splats), splats.supersample
    _, height, width = splats.row.shape
    cells, shape = (height - 2 * splats.border, width - 2 * splats.border, splats.rgba.shape[1]), shape_of(image)
    if shape == (cells[0] // side, cells[1] // side, cells[2]):
        return image
    if shape != cells:
        raise InputError(f"the image of {splatter!r} {described(image)}; expected {cells} without the border")
    return averaged(image, side)
