"""Textures and cube maps, sampled with and without mipmaps, in plain torch: autograd gives all derivatives.

Texels of all mipmaps stand in one table. So each pixel reads its own mipmaps, without a loop over pixels or mipmaps.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from rts import InputError
from rts_nvdiffrast.cube_maps import neighbours, on_faces
from rts_nvdiffrast.mipmaps import (
    MipStack,
    check_texture,
    checked_limit,
    halved_size,
    level_of,
    texture_construct_mip,
)

FILTERS = ("nearest", "linear", "linear-mipmap-nearest", "linear-mipmap-linear")
BOUNDARIES = ("cube", "wrap", "clamp", "zero")


def texture(
    tex: Tensor,
    uv: Tensor,
    uv_da: Tensor | None = None,
    mip_level_bias: Tensor | None = None,
    mip: MipStack | Sequence[Tensor] | None = None,
    filter_mode: str = "auto",
    boundary_mode: str = "wrap",
    max_mip_level: int | None = None,
) -> Tensor:
    """Sample a texture at each pixel.

    Gradients flow to `tex`, `uv`, `uv_da`, `mip_level_bias` and `mip`. The nearest texel has none for `uv`, the nearest
    mipmap none for `uv_da` and `mip_level_bias`. All tensors have one dtype, and are on one device.

    Args:
        tex: (B or 1, H, W, C) float32 or float64, row 0 at t = 0; a cube map is (B or 1, 6, H, H, C), with faces in the
            order +x, −x, +y, −y, +z, −z and as OpenGL lays them.
        uv: (B, h, w, 2), coordinates (s, t): the texture lies from 0 to 1. For a cube map (B, h, w, 3), directions of
            any length.
        uv_da: (B, h, w, 4), the derivatives (ds/dX, ds/dY, dt/dX, dt/dY) by pixels, as `interpolate` gives them; six
            for a cube map. They choose the mipmap whose texels are as long as the longer axis of a pixel's footprint.
        mip_level_bias: (B, h, w), added to the mipmap so chosen. Without `uv_da`, it is the mipmap itself.
        mip: Mipmaps from `texture_construct_mip`, or a list of mipmaps 1, 2, … of your own, like `tex` but each half
            as high and wide as the one before. By default, they are made from `tex`.
        filter_mode: "nearest", "linear", "linear-mipmap-nearest" (bilinear on one mipmap, the level rounded down),
            "linear-mipmap-linear" (on two mipmaps), or "auto". That is the last with `uv_da` or `mip_level_bias`, and
            "linear" without.
        boundary_mode: Beyond the texture, "wrap" repeats it, "clamp" repeats its outer texels, "zero" is 0. "cube" is
            for cube maps: filters reach across edges, and a corner of the cube has the mean of its three texels.
        max_mip_level: Greatest mipmap to make and to use; all by default.

    Returns:
        (B, h, w, C) like `tex`. A cube map gives 0 where a direction is zero or not finite.

    Raises:
        InputError: If a name is unknown, if shapes or dtypes do not fit, if a filter with mipmaps has neither `uv_da`
            nor `mip_level_bias`, or if a side to be halved is odd.
    """
    _check(tex, uv, uv_da, mip_level_bias, boundary_mode)
    limit = checked_limit(max_mip_level)
    if filter_mode == "auto":
        filter_mode = "linear" if uv_da is None and mip_level_bias is None else "linear-mipmap-linear"
    if filter_mode not in FILTERS:
        raise InputError(f"filter_mode is {filter_mode!r}; expected one of {', '.join(('auto', *FILTERS))}")
    levels = [tex]
    if "mipmap" in filter_mode:
        if uv_da is None and mip_level_bias is None:
            raise InputError(f"filter_mode {filter_mode!r} needs uv_da or mip_level_bias, to choose mipmaps")
        levels += _mipmaps(tex, mip, limit, boundary_mode == "cube")

    st, st_da, faces, valid = uv, None, None, None
    if uv_da is not None and len(levels) > 1:
        st_da = uv_da.reshape(*uv.shape, 2)
    if boundary_mode == "cube":
        valid = (uv.isfinite().all(-1) & (uv != 0).any(-1))[..., None]
        uv = torch.where(valid, uv, 1.0)
        st_da = None if st_da is None else torch.where(valid[..., None], st_da, 0.0)
        faces, st, st_da = on_faces(uv, st_da)
    level = mip_level_bias
    if st_da is not None:
        level = level_of(st_da, *tex.shape[-3:-1]) + (0.0 if mip_level_bias is None else mip_level_bias)
    chosen, share = _chosen(level, len(levels) - 1, filter_mode == "linear-mipmap-nearest", tex.device)
    table = _Table.of(levels, boundary_mode == "cube")
    sampled = _sampled(table, st, faces, chosen, share, boundary_mode, filter_mode == "nearest")
    return sampled if valid is None else torch.where(valid, sampled, 0.0)


def _mipmaps(tex: Tensor, mip: MipStack | Sequence[Tensor] | None, limit: int | None, cube: bool) -> Sequence[Tensor]:
    """Mipmaps to use: the given ones, checked, or new ones."""
    if mip is None:
        return texture_construct_mip(tex, limit, cube).levels
    if not isinstance(mip, (MipStack, list, tuple)):
        raise InputError(f"mip is a {type(mip).__name__}; expected a list of tensors, or texture_construct_mip(tex)")
    levels = list(mip.levels if isinstance(mip, MipStack) else mip)[:limit]
    height, width = tex.shape[-3:-1]
    for i, level in enumerate(levels):
        height, width = halved_size(height, width, i)
        expected = (*tex.shape[:-3], height, width, tex.shape[-1])
        if not isinstance(level, Tensor) or tuple(level.shape) != expected or level.dtype != tex.dtype:
            given = f"{level.dtype} {tuple(level.shape)}" if isinstance(level, Tensor) else type(level).__name__
            raise InputError(f"mip[{i}] is {given}; expected {tex.dtype} {expected}, half of the one before")
    return levels


def _chosen(level: Tensor | None, last: int, nearest: bool, device: torch.device) -> tuple[Tensor, Tensor | None]:
    """Mipmaps to sample for a level (B, h, w), int64 (B, h, w, K), and the share of each, or None where K = 1."""
    if level is None or last == 0:
        return torch.zeros((1, 1, 1, 1), dtype=torch.int64, device=device), None
    level = level.clamp(0, last)[..., None]
    if nearest:
        return level.detach().floor().long().clamp(0, last), None
    lower = level.detach().floor().long().clamp(0, last - 1)
    upper_share = level - lower
    return torch.cat([lower, lower + 1], -1), torch.cat([1 - upper_share, upper_share], -1)


@dataclass(frozen=True, eq=False)
class _Table:
    """The texels of a texture and of its mipmaps, one after the other.

    Attributes:
        texels: (B or 1, N, C) float.
        sizes: (L, 2) int64, width and height of each mipmap.
        starts: (L,) int64, where each mipmap begins: in `borders` for cube maps, else in `texels`.
        borders: (M,) int64, for cube maps: indices of texels with a border around each face, as `neighbours` has them.
    """

    texels: Tensor
    sizes: Tensor
    starts: Tensor
    borders: Tensor | None

    @classmethod
    def of(cls, levels: Sequence[Tensor], cube: bool) -> _Table:
        """The table of a texture and its mipmaps."""
        device = levels[0].device
        parts, borders, starts, count = [], [], [], 0
        for tex in levels:
            part = tex.flatten(1, -2)
            starts.append(sum(map(len, borders)) if cube else count)
            if cube:
                indices, nearest = (x.to(device) for x in neighbours(tex.shape[-2]))
                part = torch.cat([part, part[:, nearest].mean(-2)], dim=1)
                borders.append(indices.flatten() + count)
            parts.append(part)
            count += part.shape[1]
        texels = torch.cat(parts, dim=1) if len(parts) > 1 else parts[0]
        sizes = torch.tensor([(tex.shape[-2], tex.shape[-3]) for tex in levels]).to(device)
        return cls(texels, sizes, torch.tensor(starts).to(device), torch.cat(borders) if cube else None)

    def rows(self, column: Tensor, row: Tensor, level: Tensor, faces: Tensor | None) -> Tensor:
        """Indices (…) into `texels`, from columns, rows, mipmaps and faces (…)."""
        start, width, height = self.starts[level], self.sizes[level, 0], self.sizes[level, 1]
        if self.borders is None or faces is None:
            return start + row * width + column
        return self.borders[start + (faces * (height + 2) + row + 1) * (width + 2) + column + 1]

    def sum(self, rows: Tensor, weights: Tensor) -> Tensor:
        """Weighted sums (B, h, w, C) of texels, from indices and weights (B, h, w, T)."""
        batch, count, channels = self.texels.shape
        if batch > 1:
            rows = rows + count * torch.arange(batch, device=rows.device)[:, None, None, None]
        values = self.texels.reshape(-1, channels).index_select(0, rows.flatten())
        return (values.reshape(*rows.shape, channels) * weights[..., None]).sum(-2)


def _sampled(
    table: _Table, st: Tensor, faces: Tensor | None, level: Tensor, share: Tensor | None, boundary: str, nearest: bool
) -> Tensor:
    """Samples (B, h, w, C) at coordinates (B, h, w, 2) on mipmaps (…, K), which have shares (…, K)."""
    sizes = table.sizes[level]
    if boundary == "wrap":
        st = st - st.detach().floor()
    place = st[..., None, :] * sizes
    if boundary == "clamp":
        place = torch.minimum(place.clamp_min(0.5), sizes - 0.5)
    # Along each axis the one or two texels to read, and their weights: (B, h, w, K, 2, 1 or 2).
    if nearest:
        texel = place.detach().floor().long()[..., None]
        weights = torch.ones_like(place)[..., None]
    else:
        place = place - 0.5
        lower = place.detach().floor()
        texel = torch.stack([lower.long(), lower.long() + 1], dim=-1)
        weights = torch.stack([1 - (place - lower), place - lower], dim=-1)
    if boundary != "cube" or nearest:
        beyond, sizes = texel, sizes[..., None]
        if boundary == "wrap":
            texel = torch.where(texel < 0, texel + sizes, torch.where(texel < sizes, texel, texel - sizes))
        texel = torch.minimum(texel.clamp_min(0), sizes - 1)
        if boundary == "zero":
            weights = weights * (texel == beyond)
    if share is not None:
        weights = torch.cat([weights[..., :1, :] * share[..., None, None], weights[..., 1:, :]], dim=-2)
    faces = None if faces is None else faces[..., None, None, None]
    rows = table.rows(texel[..., 0, None, :], texel[..., 1, :, None], level[..., None, None], faces)
    return table.sum(rows.flatten(-3), (weights[..., 0, None, :] * weights[..., 1, :, None]).flatten(-3))


def _check(tex: Tensor, uv: Tensor, uv_da: Tensor | None, bias: Tensor | None, boundary: str) -> None:
    """Check names, shapes and dtypes of all but mipmaps."""
    if boundary not in BOUNDARIES:
        raise InputError(f"boundary_mode is {boundary!r}; expected one of {', '.join(BOUNDARIES)}")
    check_texture(tex, boundary == "cube")
    across = 3 if boundary == "cube" else 2
    shape = tuple(uv.shape) if isinstance(uv, Tensor) else ()
    if len(shape) != 4 or shape[-1] != across:
        given = f"has the shape {shape}" if isinstance(uv, Tensor) else f"is a {type(uv).__name__}"
        raise InputError(f"uv {given}; expected (B, h, w, {across}) with boundary_mode={boundary!r}")
    if tex.shape[0] not in (1, shape[0]):
        raise InputError(f"tex has {tex.shape[0]} textures for {shape[0]} images of uv; expected 1 or {shape[0]}")
    others = [("uv", uv, shape), ("uv_da", uv_da, (*shape[:3], 2 * across)), ("mip_level_bias", bias, shape[:3])]
    for name, x, expected in others:
        if x is None:
            continue
        given = f"{x.dtype} {tuple(x.shape)}" if isinstance(x, Tensor) else f"a {type(x).__name__}"
        if given != f"{tex.dtype} {expected}":
            raise InputError(f"{name} is {given}; expected {tex.dtype} {expected}, as tex and uv have it")
        if x.device != tex.device:
            raise InputError(f"{name} is on {x.device}, and tex on {tex.device}; move one of them")
