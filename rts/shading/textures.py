"""Textures: bilinear lookup, at points or over footprints, and trilinear lookup in a pyramid of averages (mipmaps)."""

from __future__ import annotations

import numpy as np

from rts.arrays.argument_checks import quoted
from rts.arrays.array_functions import described, shape_of
from rts.arrays.engines import engine_of, namespace, stopped
from rts.arrays.trees import Array
from rts.errors import InputError
from rts.operations.texels import texels

WRAPS = ("repeat", "mirror", "clamp")
"""Continuations of a texture outside [0, 1]."""
FILTERS = ("linear", "nearest")
"""Ways to read between the centres of texels."""
TEXELS = 2.5
"""How many texels of its level in the pyramid a footprint is wide, along its shorter axis."""
MAPS = ("metallic", "roughness", "normal_map", "occlusion", "emissive", "specular")
"""Entries of θ that may be maps, beside the texture."""
Wrap = str | tuple[str, str]
"""A continuation, or one along u and one along v."""


def own_uv(name: str) -> str:
    """The attribute that holds the coordinates of a map, θ[name], where they are others than "uv"."""
    return f"uv_{name}"


def check_sampler(wrap: object, filter: object) -> None:
    """Refuse what is no continuation, or no way to read."""
    pair = wrap if isinstance(wrap, tuple) and len(wrap) == 2 else (wrap,)
    if not all(isinstance(one, str) and one in WRAPS for one in pair):
        raise InputError(f"wrap is {quoted(wrap)}; expected {', '.join(WRAPS)}, or two of them: u's and v's")
    if not isinstance(filter, str) or filter not in FILTERS:
        raise InputError(f"filter is {quoted(filter)}; expected one of {', '.join(FILTERS)}")


def sample_texture(
    texture: Array,
    uv: Array,
    wrap: Wrap = "repeat",
    footprint: Array | None = None,
    filter: str = "linear",
    mip: bool = False,
) -> Array:
    """Bilinear texture lookup, or the mean over a footprint where one is given; differentiable in texture and uv.

    Args:
        texture: (h, w, C), C = 1, 3 or 4, row 0 on top; texel (i, j) has its centre at u = (j + 0.5) / w,
            v = 1 − (i + 0.5) / h.
        uv: (N, 2), u to the right and v up; (0, 0) is the lower left corner of the image.
        wrap: "repeat" or "mirror" outside [0, 1]; any other text is "clamp". A pair is for u and for v.
        footprint: (N, 4), ∂u/∂x, ∂v/∂x, ∂u/∂y, ∂v/∂y for a step to the next cell, constant. The texture is averaged
            over this area, by up to four lookups along each side, and its derivative in uv is that of the mean (see
            `rts.operations.texels`). None for points.
        filter: "nearest" takes the texel around a point, without derivative in uv; any other text is "linear".
        mip: whether footprints that are wide are averaged in a pyramid of averages, trilinearly; see `level_of`.

    Returns:
        (N, C).

    Raises:
        InputError: the texture or uv has another shape, or the texture no floating numbers.
    """
    shape = shape_of(texture)
    if len(shape) != 3 or shape[2] not in (1, 3, 4) or 0 in shape:
        raise InputError(f"the texture {described(texture)}; expected (h, w, C) with C = 1, 3 or 4")
    if shape_of(uv)[1:] != (2,) or len(shape_of(uv)) != 2:
        raise InputError(f"uv {described(uv)}; expected (N, 2)")
    xp = namespace(texture, uv)
    if not xp.isdtype(texture.dtype, "real floating"):
        raise InputError(
            f"the texture has dtype {texture.dtype}; expected floating numbers, linear and from 0 to 1 (rts.load_image)"
        )
    height, width, channels = shape
    wrap = (wrap, wrap) if isinstance(wrap, str) else wrap
    if footprint is None or not mip:
        table = xp.reshape(texture, (height * width, channels))
        return texels(table, uv, [(height, width)], None, wrap, filter, footprint)
    levels = mip_levels(texture)
    table = xp.concat([xp.reshape(x, (-1, channels)) for x in levels])
    level = level_of(footprint, (height, width))
    finer = xp.clip(xp.floor(level), 0, max(len(levels) - 2, 0))
    coarser = xp.clip(finer + 1, 0, len(levels) - 1)
    # One lookup of both: engines make an array as large as the table for the gradient of each.
    number = xp.astype(xp.concat([finer, coarser]), xp.int32)
    sizes = [shape_of(x)[:2] for x in levels]
    found = texels(table, xp.concat([uv, uv]), sizes, number, wrap, filter, xp.concat([footprint, footprint]))
    found = xp.reshape(found, (2, -1, channels))
    return found[0, ...] + (level - finer)[:, None] * (found[1, ...] - found[0, ...])


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
