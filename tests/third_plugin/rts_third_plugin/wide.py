"""A splatter of wide Gaussians."""

import math
from dataclasses import dataclass

import numpy as np

import rts
from rts.plugin_api.checks import check_positive
from rts.splatting import exact_calibration


@dataclass(frozen=True)
class Wide(rts.Splatter):
    """Spreads front samples over 5 × 5 cells, whatever hides what.

    Attributes:
        sigma: standard deviation, cells.
        epsilon: excess of the weights' sum over one, so that the interior is always normalised.
    """

    sigma: float = 0.8
    epsilon: float = 0.001

    layers = 1
    reach = 2

    def __post_init__(self):
        check_positive("sigma", self.sigma, ())
        check_positive("epsilon", self.epsilon, ())

    def image(self, splats):
        xp, engine = rts.namespace(splats.positions, splats.rgba), rts.engine_of(splats.positions)
        height, width = splats.row.shape[1:]
        row = splats.row[0]
        if splats.rgba.shape[0] == 0:  # Nothing can be taken by index.
            return xp.stack([xp.zeros_like(row, dtype=splats.rgba.dtype)] * 4, axis=-1)
        index = xp.reshape(xp.where(row >= 0, row, 0), (-1,))
        position = xp.reshape(xp.take(splats.positions, index, axis=0)[:, :2], (height, width, 2))
        rgba = xp.reshape(xp.take(splats.rgba, index, axis=0), (height, width, splats.rgba.shape[1]))
        sources = xp.where((row >= 0)[..., None], xp.concat([rgba, xp.ones_like(rgba[..., :1])], axis=-1), 0.0)

        centers = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1) + 0.5
        off = exact_calibration(self.sigma, self.reach) * (position - engine.constant(centers, position))
        sources, off = (framed(xp, x, self.reach) for x in (sources, off))
        scale, around = 1 / (2 * self.sigma**2), range(-self.reach, self.reach + 1)
        peak = (1 + self.epsilon) / sum(math.exp(-(u * u) * scale) for u in around) ** 2
        total = 0.0
        for u in around:
            for v in around:  # To each cell from the one that it lies u columns right of, and v rows below.
                of = slice(self.reach - v, self.reach - v + height), slice(self.reach - u, self.reach - u + width)
                squared = (u - off[of][..., 0]) ** 2 + (v - off[of][..., 1]) ** 2
                total = total + peak * xp.exp(-scale * squared)[..., None] * sources[of]
        return total[..., :-1] / xp.clip(total[..., -1:], 1.0, None)


def framed(xp, image, by):
    """The image (H, W, C) with `by` rows and columns of zeros on each side."""
    for axis in (0, 1):
        zeros = xp.concat([xp.zeros_like(image[:1] if axis == 0 else image[:, :1])] * by, axis=axis)
        image = xp.concat([zeros, image, zeros], axis=axis)
    return image
