"""A calibrated 5 × 5 Gaussian of the first layer."""

import math
from dataclasses import dataclass

import numpy as np

import rts
from rts.plugin_api.arrays import engine_of, namespace
from rts.plugin_api.bases import Splatter


@dataclass(frozen=True)
class Gauss5(Splatter):
    """Spreads front samples over 5 × 5 cells, whatever hides what."""

    sigma: float = 0.5

    layers, reach = 1, 2

    def image(self, splats):
        xp, engine = namespace(splats.positions), engine_of(splats.positions)
        reach, (height, width) = self.reach, splats.row.shape[1:]
        if splats.rgba.shape[0] == 0:  # Nothing can be taken by index.
            return xp.stack([xp.zeros_like(splats.row[0], dtype=splats.rgba.dtype)] * 4, axis=-1)
        row = xp.concat([xp.full_like(splats.row[0, :1], -1)] * reach, axis=0)
        row = xp.concat([row, splats.row[0], row], axis=0)
        side = xp.concat([xp.full_like(row[:, :1], -1)] * reach, axis=1)
        row = xp.concat([side, row, side], axis=1)  # (H + 4, W + 4)
        covered, index = row >= 0, xp.reshape(xp.where(row >= 0, row, 0), (-1,))
        xy = xp.reshape(xp.take(splats.positions, index, axis=0), (*row.shape, 3))[..., :2]
        rgba = xp.reshape(xp.take(splats.rgba, index, axis=0), (*row.shape, 4))
        rgba = xp.where(covered[..., None], xp.concat([rgba, xp.ones_like(rgba[..., :1])], axis=-1), 0.0)
        centers = np.stack(np.meshgrid(*map(np.arange, row.shape[::-1])), axis=-1) + (0.5 - reach)
        off = rts.splatting.exact_calibration(self.sigma, reach) * (xy - engine.constant(centers, xy))
        off = xp.where(covered[..., None], off, 0.0)
        scale, steps = 1 / (2 * self.sigma**2), range(-reach, reach + 1)
        peak, total = 1.001 / sum(math.exp(-(u * u) * scale) for u in steps) ** 2, 0.0
        for u in steps:
            for v in steps:  # Each cell takes from the one u columns to its right and v rows below.
                at = slice(reach + v, reach + v + height), slice(reach + u, reach + u + width)
                square = (u + off[(*at, 0)]) ** 2 + (v + off[(*at, 1)]) ** 2
                total = total + (peak * xp.exp(-scale * square))[..., None] * rgba[at]
        return total[..., :4] / xp.clip(total[..., 4:], 1.0, None)
