"""Mipmaps: smaller copies of a texture, and the copy that the footprint of a pixel asks for."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from rts import InputError


@dataclass(frozen=True, eq=False)
class MipStack:
    """Mipmaps of a texture, as `texture_construct_mip` makes them and `texture` takes them.

    Attributes:
        levels: Mipmaps 1, 2, … without the texture itself: (B, h, w, C) float, or (B, 6, h, w, C) of a cube map.
    """

    levels: tuple[Tensor, ...]


def texture_construct_mip(tex: Tensor, max_mip_level: int | None = None, cube_mode: bool = False) -> MipStack:
    """Average a texture 2 × 2 again and again, until one texel is left.

    Gradients of the mipmaps flow to `tex`. Build the stack once for a texture that stays as it is.

    Args:
        tex: (B, H, W, C) float32 or float64, or (B, 6, H, H, C) for a cube map.
        max_mip_level: Mipmaps to make at most; all by default. A side of one texel stays. Another odd side cannot be
            halved: 160 × 32 texels have five mipmaps, the last of 5 × 1 texels.
        cube_mode: True for a cube map.

    Raises:
        InputError: If `tex` has another shape or dtype, or a side to be halved is odd.
    """
    check_texture(tex, cube_mode)
    limit = checked_limit(max_mip_level)
    levels = [tex]
    while max(levels[-1].shape[-3:-1]) > 1 and (limit is None or len(levels) <= limit):
        levels.append(_halved(levels[-1], len(levels) - 1))
    return MipStack(tuple(levels[1:]))


def _halved(tex: Tensor, level: int) -> Tensor:
    """The texture (…, H, W, C), averaged 2 × 2; a side of one texel stays."""
    height, width, channels = tex.shape[-3:]
    rows, columns = halved_size(height, width, level)
    blocks = tex.reshape(*tex.shape[:-3], rows, height // rows, columns, width // columns, channels)
    return blocks.mean(dim=(-4, -2))


def halved_size(height: int, width: int, level: int) -> tuple[int, int]:
    """Height and width of the mipmap after `level`, which has `height` × `width` texels."""
    if any(side > 1 and side % 2 for side in (height, width)):
        raise InputError(
            f"mipmap {level} of the texture has {height} × {width} texels, and an odd side cannot be halved: "
            f"give max_mip_level={level}, or a texture whose sides are powers of two"
        )
    return max(height // 2, 1), max(width // 2, 1)


def checked_limit(max_mip_level: int | None) -> int | None:
    """The greatest mipmap to use, an integer from 0, or None for all."""
    if max_mip_level is not None and int(max_mip_level) < 0:
        raise InputError(f"max_mip_level is {max_mip_level}; expected None (all), or an integer from 0")
    return None if max_mip_level is None else int(max_mip_level)


def check_texture(tex: Tensor, cube: bool) -> None:
    """Check shape and dtype of a texture."""
    form = "(B, 6, H, H, C), a cube map" if cube else "(B, H, W, C)"
    if not isinstance(tex, Tensor):
        raise InputError(f"tex is a {type(tex).__name__}; expected a torch tensor {form}")
    shape = tuple(tex.shape)
    fits = tex.ndim == 5 and shape[1] == 6 and shape[2] == shape[3] if cube else tex.ndim == 4
    if not fits or 0 in shape:
        hint = "; a cube map needs boundary_mode='cube', or cube_mode=True" if not cube and tex.ndim == 5 else ""
        raise InputError(f"tex has the shape {shape}; expected {form}{hint}")
    if tex.dtype not in (torch.float32, torch.float64):
        raise InputError(f"tex is {tex.dtype}; expected torch.float32 or torch.float64")


def level_of(st_da: Tensor, height: int, width: int) -> Tensor:
    """The mipmap on which the footprint of a pixel is one texel long.

    A pixel covers an ellipse of the texture. Its longer half axis, squared, is the greater eigenvalue of JᵀJ, where J
    is the derivative of texels by pixels.

    Args:
        st_da: (…, 2, 2) float, derivatives of texture coordinates, [s or t, by X or by Y].
        height: Rows of the texture.
        width: Columns of the texture.

    Returns:
        Levels (…), float, not yet limited to those that exist. Zero derivatives give a very negative one.
    """
    texels = st_da * torch.tensor([[width], [height]], dtype=st_da.dtype).to(st_da.device)
    xx, yy = (texels * texels).sum(-2).unbind(-1)
    half, xy = (xx - yy) / 2, texels.prod(-1).sum(-1)
    circle = (half == 0) & (xy == 0)  # There the root has no derivative.
    root = torch.where(circle, 0.0, torch.hypot(torch.where(circle, 1.0, half), xy))
    greatest = (xx + yy) / 2 + root
    return 0.5 * greatest.clamp_min(torch.finfo(greatest.dtype).tiny).log2()
