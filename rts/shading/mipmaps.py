"""Mipmaps: the pyramid of a texture's averages, and the levels in which footprints are averaged."""

from __future__ import annotations

import numpy as np

from rts.arrays.array_functions import shape_of
from rts.arrays.engines import engine_of, namespace, stopped
from rts.arrays.trees import Array

TEXELS = 2.5
"""How many texels of its level in the pyramid a footprint is wide, along its shorter axis."""


def mip_levels(texture: Array) -> list[Array]:
    """The texture (h, w, C) and its averages, each of half the previous height and width, down to a single texel.

    An odd number n > 1 of rows or columns becomes (n − 1) / 2; one stays one. Each new row or column averages
    2 n / (n − 1) old ones, by the shares that it covers, so that all levels have the texture's mean. Differentiable.
    """
    levels = [texture]
    while max(shape_of(levels[-1])[:2]) > 1:
        xp = namespace(texture)
        halved = _halved(levels[-1])
        levels.append(xp.permute_dims(_halved(xp.permute_dims(halved, (1, 0, 2))), (1, 0, 2)))
    return levels


def level_of(footprint: Array, size: tuple[int, int]) -> Array:
    """The levels (N,) of `mip_levels` to average footprints in, real numbers, without derivative.

    0 is the texture itself, the last a single texel. A footprint is 2.5 of a level's texels along its shorter axis, if
    it has at most eight along the longer one: the mean of lookups then spreads about as widely as the footprint.

    Args:
        footprint: (N, 4), see `sample_texture`.
        size: (height, width) of the texture.
    """
    xp, (height, width), f = namespace(footprint), size, stopped(footprint)
    coarsest = max(height, width).bit_length() - 1
    f = xp.clip(xp.where(f == f, f, 0.0), -8.0, 8.0)  # Wider ones are of many whole textures; NaN is none.
    u, v = f[:, 0::2] * width, f[:, 1::2] * height
    square_u, product, square_v = (xp.sum(x, axis=1) for x in (u * u, u * v, v * v))
    middle, half = 0.5 * (square_u + square_v), 0.5 * (square_u - square_v)
    radius = xp.sqrt(half * half + product * product)
    # The squares of the longer and of the shorter axis.
    longer, shorter = middle + radius, xp.clip(middle - radius, 0.0, None)
    texel = xp.maximum(xp.maximum(shorter / TEXELS**2, longer / (3.2 * TEXELS) ** 2), xp.ones_like(middle))
    return xp.clip(0.5 * xp.log2(texel), 0.0, float(coarsest))


def _halved(x: Array) -> Array:
    """An array (n, a, b) with half as many rows, max(n // 2, 1): a single row stays.

    For even n each new row is the mean of two old ones. For odd n it is that of the n / (n // 2) old rows that it
    covers, three of them in part, so that the mean over all rows stays.
    """
    n = shape_of(x)[0]
    if n == 1:
        return x
    if n % 2 == 0:
        return 0.5 * (x[0::2, ...] + x[1::2, ...])
    # New row j covers the old rows from j n / m to (j + 1) n / m.
    xp, m = namespace(x), n // 2
    part = xp.reshape(engine_of(x).constant(np.arange(m) / n, x), (m, 1, 1))
    return (m / n - part) * x[0:-1:2, ...] + m / n * x[1::2, ...] + (part + 1 / n) * x[2::2, ...]
