"""`interpolate`: attributes of vertices at the pixels of `rast`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch

from rts import InputError
from rts.plugin_api.operations import take
from rts_nvdiffrast.checks import check_corners, check_devices, check_floats, check_rast, check_triangles


def interpolate(
    attr: torch.Tensor,
    rast: torch.Tensor,
    tri: torch.Tensor,
    rast_db: torch.Tensor | None = None,
    diff_attrs: str | Sequence[int] | None = None,
) -> tuple[torch.Tensor, torch.Tensor]:
    """Interpolate attributes of vertices at the pixels of `rast`; differentiable in `attr`, `rast` and `rast_db`.

    Args:
        attr: (B, V, A), (1, V, A) for all images, or (V, A) for all images, as in range mode; float32 or float64.
        rast: (B, H, W, 4), the first result of `rasterize`.
        tri: (T, 3) int32, corners as rows of `attr`; not necessarily those of positions.
        rast_db: (B, H, W, 4), the second result of `rasterize`; needed for `diff_attrs`.
        diff_attrs: the attributes whose image-space derivatives are wanted, as indices; "all"; or None.

    Returns:
        The attributes (B, H, W, A), 0 where there is no triangle, and derivatives (B, H, W, 2 D) of D attributes, each
        ∂/∂X and ∂/∂Y, per pixel; D is 0 unless both `rast_db` and `diff_attrs` are given.

    Raises:
        InputError: an argument is of another type, shape or dtype, an index names no attribute, a triangle no row, or
            tensors are on several devices.
    """
    rast, tri = check_rast(rast), check_triangles(tri)
    attr = check_floats("attr", attr, ("images", "vertices", "attributes"), ("vertices", "attributes"))
    check_devices(attr=attr, rast=rast, tri=tri, rast_db=rast_db)
    check_corners(tri, attr.shape[-2], "attr")
    if attr.ndim == 3 and len(attr) not in (1, len(rast)):
        raise InputError(f"attr has {len(attr)} images and rast {len(rast)}; expected as many, or 1")
    wanted = _wanted(diff_attrs, attr.shape[-1]) if rast_db is not None else []
    pixels, u, v, corners = _at_pixels(attr, rast, tri)
    values = u * corners[:, 0] + v * corners[:, 1] + (1 - u - v) * corners[:, 2]
    shape = rast.shape[:3]
    if rast_db is None or not wanted:
        return scattered(values, pixels, shape), values.new_zeros((*shape, 0))
    if check_floats("rast_db", rast_db, ("images", "height", "width", 4)).shape != rast.shape:
        raise InputError(f"rast_db has shape {tuple(rast_db.shape)} and rast {tuple(rast.shape)}; expected the same")
    db = take(rast_db.reshape(-1, 4), pixels).reshape(-1, 2, 2)
    sides = torch.stack([corners[:, :2, i] - corners[:, 2:, i] for i in wanted], dim=2)
    changes = (sides[..., None] * db[:, :, None, :]).sum(dim=1)
    return scattered(values, pixels, shape), scattered(changes.flatten(1), pixels, shape)


def _at_pixels(
    attr: torch.Tensor, rast: torch.Tensor, tri: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
    """The covered pixels (P,), u and v (P, 1) there, and the attributes (P, 3, A) of the triangles' corners."""
    flat = rast.reshape(-1, 4)
    pixels = (flat[:, 3].detach() > 0).nonzero()[:, 0]
    at = take(flat, pixels)
    triangle = at[:, 3].detach().long() - 1
    if len(triangle) and int(triangle.max()) >= len(tri):
        raise InputError(
            f"rast shows triangle {int(triangle.max())} and tri has {len(tri)}; expected that of rasterize"
        )
    rows = tri.index_select(0, triangle).long()
    if attr.ndim == 3 and len(attr) > 1:
        rows = rows + (pixels // (rast.shape[1] * rast.shape[2]) * attr.shape[1])[:, None]
    corners = take(attr.reshape(-1, attr.shape[-1]), rows.reshape(-1))
    return pixels, at[:, :1], at[:, 1:2], corners.reshape(len(pixels), 3, attr.shape[-1])


def _wanted(diff_attrs: Any, count: int) -> list[int]:
    """Indices of attributes, from `diff_attrs`."""
    if diff_attrs is None:
        return []
    if isinstance(diff_attrs, str):
        wanted = list(range(count)) if diff_attrs == "all" else None
    elif isinstance(diff_attrs, (Sequence, np.ndarray, torch.Tensor)):
        wanted = [int(i) for i in diff_attrs]
    else:
        wanted = None
    if wanted is None or not all(0 <= i < count for i in wanted):
        raise InputError(f"diff_attrs is {diff_attrs!r}; expected 'all', None or indices from 0 to {count - 1}")
    return wanted


def scattered(values: torch.Tensor, pixels: torch.Tensor, shape: torch.Size) -> torch.Tensor:
    """An image (B, H, W, C) that has `values` (P, C) at `pixels`, and is 0 elsewhere."""
    flat = values.new_zeros((shape.numel(), values.shape[1]))
    return flat.index_copy(0, pixels, values).reshape(*shape, -1)
