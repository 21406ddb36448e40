"""Textures: bilinear lookup, at points or over footprints, and trilinear lookup in a pyramid of averages (mipmaps)."""

from __future__ import annotations

from rts.arrays.argument_checks import quoted
from rts.arrays.array_functions import described, shape_of
from rts.arrays.engines import namespace
from rts.arrays.trees import Array
from rts.errors import InputError
from rts.operations.texels import texels

WRAPS = ("repeat", "mirror", "clamp")
"""Continuations of a texture outside [0, 1]."""
FILTERS = ("linear", "nearest")
"""Ways to read between the centres of texels."""
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
        mip: whether wide footprints are averaged in a pyramid of averages, trilinearly; see `rts.shading.mipmaps`.

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
    from rts.shading.mipmaps import level_of, mip_levels

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
