"""Textures: bilinear lookup, and trilinear lookup in a pyramid of averages (mipmaps)."""

from __future__ import annotations

from typing import Any

import numpy as np

from rts.arrays.array_functions import described, shape_of
from rts.arrays.engines import engine_of, namespace, stopped
from rts.arrays.trees import Array
from rts.errors import InputError

WRAPS = ("repeat", "mirror", "clamp")
"""Continuations of a texture outside [0, 1]."""
FILTERS = ("linear", "nearest")
"""Ways to read between the centres of texels."""
Wrap = str | tuple[str, str]
"""A continuation, or one along u and one along v."""


def sample_texture(
    texture: Array, uv: Array, wrap: Wrap = "repeat", footprint: Array | None = None, filter: str = "linear"
) -> Array:
    """Bilinear texture lookup, or trilinear where a footprint is given; differentiable in texture and uv.

    Args:
        texture: (h, w, C), C = 1, 3 or 4, row 0 on top; texel (i, j) has its centre at u = (j + 0.5) / w,
            v = 1 − (i + 0.5) / h.
        uv: (N, 2), u to the right and v up; (0, 0) is the lower left corner of the image.
        wrap: "repeat" or "mirror" outside [0, 1]; any other text is "clamp". A pair is for u and for v.
        footprint: (N, 4), ∂u/∂x, ∂v/∂x, ∂u/∂y, ∂v/∂y for a step to the next cell, constant. The texture is averaged
            over roughly this area, by `mip_levels` and `level_of`. None for no average.
        filter: "nearest" takes the texel around a point, without derivative in uv; any other text is "linear".

    Returns:
        (N, C).

    Raises:
        InputError: the texture has another shape, or no floating numbers.
    """
    shape = shape_of(texture)
    if len(shape) != 3 or shape[2] not in (1, 3, 4) or 0 in shape:
        raise InputError(f"the texture {described(texture)}; expected (h, w, C) with C = 1, 3 or 4")
    xp = namespace(texture, uv)
    if not xp.isdtype(texture.dtype, "real floating"):
        raise InputError(
            f"the texture has dtype {texture.dtype}; expected floating numbers, linear and from 0 to 1 (rts.load_image)"
        )
    height, width, channels = shape
    if footprint is None:
        return _bilinear(xp.reshape(texture, (height * width, channels)), uv, wrap, height, width, filter=filter)
    levels, engine = mip_levels(texture), engine_of(texture, uv)
    table = xp.concat([xp.reshape(x, (-1, channels)) for x in levels])
    sizes = np.array([x.shape[:2] for x in levels])
    first = engine.constant(np.cumsum(sizes.prod(axis=1)) - sizes.prod(axis=1))
    heights, widths = (engine.constant(x.astype(np.float32), uv) for x in sizes.T)
    level = level_of(footprint, (height, width))
    finer = xp.clip(xp.floor(level), 0, max(len(levels) - 2, 0))
    share, lower = (level - finer)[:, None], xp.astype(finer, xp.int32)

    def at(number: Array) -> Array:
        return _bilinear(
            table, uv, wrap, *(xp.take(x, number, axis=0) for x in (heights, widths, first)), filter=filter
        )

    below = at(lower)
    return below + share * (at(xp.clip(lower + 1, 0, len(levels) - 1)) - below)


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
    """The level (N,) of `mip_levels`, a real number, at which texels are as large as the footprint's longer side.

    Level 0 is the texture itself, for sides of at most a texel, and of NaN. The last is a single texel. Without
    derivative.

    Args:
        footprint: (N, 4), see `sample_texture`.
        size: (height, width) of the texture.
    """
    xp, (height, width), f = namespace(footprint), size, stopped(footprint)
    u, v = f[:, 0::2] * width, f[:, 1::2] * height
    texels = xp.max(u * u + v * v, axis=1)
    texels = xp.where(texels == texels, texels, 1.0)  # NaN is no level.
    coarsest = max(height, width).bit_length() - 1
    return xp.clip(0.5 * xp.log2(xp.clip(texels, 1.0, 4.0**coarsest)), 0.0, float(coarsest))


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


def _bilinear(
    flat: Array, uv: Array, wrap: Wrap, height: Any, width: Any, first: Array | None = None, filter: str = "linear"
) -> Array:
    """Bilinear lookup (N, C) in a table of texels: of one texture, row by row, or of several, one after the other.

    Args:
        flat: (M, C), the texels.
        uv: (N, 2).
        wrap: see `sample_texture`.
        height: height of the texture; for several textures (N,) floats of uv's dtype.
        width: width, in the same form.
        first: (N,) integers, the table row of the texture's first texel; None for a single texture.
        filter: see `sample_texture`.
    """
    xp = namespace(flat, uv)
    columns = width if first is None else xp.astype(width, xp.int32)
    x, y = uv[:, 0] * width - 0.5, (1 - uv[:, 1]) * height - 0.5
    if filter == "nearest":
        x, y = xp.floor(x + 0.5), xp.floor(y + 0.5)  # The centre of the texel.
    x0, y0 = xp.floor(x), xp.floor(y)
    fx, fy = (x - x0)[:, None], (y - y0)[:, None]

    along_u, along_v = (wrap, wrap) if isinstance(wrap, str) else wrap

    def texel(dx: int, dy: int) -> Array:
        index = _wrapped(y0 + dy, height, along_v) * columns + _wrapped(x0 + dx, width, along_u)
        return xp.take(flat, index if first is None else index + first, axis=0)

    top = texel(0, 0) + fx * (texel(1, 0) - texel(0, 0))
    bottom = texel(0, 1) + fx * (texel(1, 1) - texel(0, 1))
    return top + fy * (bottom - top)


def _wrapped(index: Array, count: Any, wrap: str) -> Array:
    """Whole-numbered floats as int32 in [0, count), by `wrap` where they lie outside; 0 for NaN."""
    xp = namespace(index)
    index = xp.where(index == index, index, 0.0)  # NaN has no texel; as an index it would be out of range.
    if wrap == "repeat":
        index = index - xp.floor(index / count) * count
    elif wrap == "mirror":
        index = index - xp.floor(index / (2 * count)) * (2 * count)
        index = xp.where(index >= count, 2 * count - 1 - index, index)
    return xp.astype(xp.clip(index, 0, count - 1), xp.int32)
