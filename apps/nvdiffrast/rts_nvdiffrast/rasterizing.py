"""`rasterize`: which triangle each pixel shows, and where on it."""

from __future__ import annotations

import operator
from typing import Any

import numpy as np
import torch

import rts
from rts import InputError
from rts.plugin_api.operations import take
from rts_nvdiffrast.checks import check_corners, check_devices, check_finite, check_floats, check_triangles, described
from rts_nvdiffrast.interpolation import scattered
from rts_nvdiffrast.triangles import Image, Topology, images

LEVELS = 0, 1, 2, 3
_level = [1]


class RasterizeCudaContext:
    """Settings of images; a context holds no memory here, and needs no GPU.

    Args:
        device: accepted and ignored: tensors stay on the device that they are on.
    """

    def __init__(self, device: Any = None):
        """Take nothing."""

    def set_context(self) -> None:
        """Do nothing: there is no OpenGL context."""

    def release_context(self) -> None:
        """Do nothing: there is no OpenGL context."""


class RasterizeGLContext(RasterizeCudaContext):
    """Another name of `RasterizeCudaContext`, with the arguments of nvdiffrast's class.

    Args:
        output_db: accepted and ignored: image-space derivatives are always there.
        mode: accepted and ignored.
        device: accepted and ignored.
    """

    def __init__(self, output_db: bool = True, mode: str = "automatic", device: Any = None):
        super().__init__(device)


def rasterize(
    glctx: RasterizeCudaContext,
    pos: torch.Tensor,
    tri: torch.Tensor,
    resolution: Any,
    ranges: torch.Tensor | None = None,
    grad_db: bool = True,
) -> tuple[torch.Tensor, torch.Tensor]:
    """Find the triangle at each pixel's centre; row 0 is the bottom.

    Args:
        glctx: a context.
        pos: (B, V, 4) clip space, or (V, 4) with `ranges`; float32 or float64.
        tri: (T, 3) int32, corners as rows of `pos`.
        resolution: (height, width), pixels.
        ranges: (B, 2) int32, for each image the first triangle and the number of triangles; used where `pos` is (V, 4).
        grad_db: whether the second result has a derivative.

    Returns:
        `rast` and `rast_db`, (B, H, W, 4) each, in the dtype of `pos`; 0 where there is no triangle. `rast` has u and
        v, the perspective-correct weights of the first two corners; z/w; and the triangle's number plus one. u and v
        have a derivative in `pos`. `rast_db` has ∂u/∂X, ∂u/∂Y, ∂v/∂X, ∂v/∂Y, per pixel, with a derivative in `pos`.

    Raises:
        InputError: an argument is of another type, shape or dtype, a triangle names no vertex, a range no triangles,
            positions are NaN or infinite, or tensors are on several devices.
    """
    return _layer(_checked(glctx, pos, tri, resolution, ranges), 0, grad_db)


class DepthPeeler:
    """The layers of surfaces at each pixel, one after the other, front to back. Arguments are those of `rasterize`.

    Use it as `with DepthPeeler(glctx, pos, tri, resolution) as peeler:`. Other calls may use the context meanwhile.
    """

    def __init__(
        self,
        glctx: RasterizeCudaContext,
        pos: torch.Tensor,
        tri: torch.Tensor,
        resolution: Any,
        ranges: torch.Tensor | None = None,
        grad_db: bool = True,
    ):
        self._geometry = _checked(glctx, pos, tri, resolution, ranges)
        self._grad_db, self._next, self._open = grad_db, 0, False

    def __enter__(self) -> DepthPeeler:
        self._open, self._next = True, 0
        return self

    def __exit__(self, *_: Any) -> None:
        self._open = False

    def rasterize_next_layer(self) -> tuple[torch.Tensor, torch.Tensor]:
        """The results of `rasterize` for the next layer.

        Two triangles at one depth are two layers.

        Raises:
            InputError: the call is not inside of `with`.
        """
        if not self._open:
            raise InputError("rasterize_next_layer was called outside of `with DepthPeeler(...) as peeler`")
        self._next += 1
        return _layer(self._geometry, self._next - 1, self._grad_db)


class _Geometry:
    """Checked arguments of `rasterize`."""

    def __init__(self, pos: torch.Tensor, tri: torch.Tensor, size: Any, ranges: np.ndarray | None):
        self.pos, self.tri, self.size, self.ranges = pos, tri, size, ranges
        self.images = list(images(pos.detach(), Topology.of(tri), ranges))


def _checked(glctx: Any, pos: Any, tri: Any, resolution: Any, ranges: Any) -> _Geometry:
    """The geometry of checked arguments."""
    if not isinstance(glctx, RasterizeCudaContext):
        raise InputError(f"glctx is {type(glctx).__name__}; expected a RasterizeCudaContext or RasterizeGLContext")
    pos = check_floats("pos", pos, ("images", "vertices", 4), ("vertices", 4))
    tri = check_triangles(tri)
    check_devices(pos=pos, tri=tri)
    check_corners(tri, pos.shape[-2], "pos")
    check_finite(pos)
    try:
        height, width = (operator.index(n) for n in resolution)
    except (TypeError, ValueError):
        height = width = 0
    if height < 1 or width < 1:
        raise InputError(f"resolution is {resolution!r}; expected (height, width), two positive integers")
    return _Geometry(pos, tri, (height, width), _ranges(ranges, len(tri)) if pos.ndim == 2 else None)


def _ranges(ranges: Any, count: int) -> np.ndarray:
    """Ranges (B, 2) of `count` triangles, on the host."""
    integers = isinstance(ranges, torch.Tensor) and not ranges.is_floating_point() and ranges.dtype != torch.bool
    if not integers or ranges.ndim != 2 or ranges.shape[1] != 2 or not len(ranges):
        raise InputError(f"pos is (vertices, 4) and ranges {described(ranges)}; expected a tensor (images, 2) of int32")
    checked = ranges.cpu().numpy()
    if checked.min() < 0 or checked.sum(axis=1).max() > count:
        raise InputError(f"ranges are {checked.tolist()}; expected first triangles and counts within {count} triangles")
    return checked


def _layer(given: _Geometry, layer: int, grad_db: bool) -> tuple[torch.Tensor, torch.Tensor]:
    """`rast` and `rast_db` of one layer of surfaces."""
    shown = torch.stack([_triangles(image, given.size, layer) for image in given.images]).to(given.pos.device)
    (height, width), pixels = given.size, (shown.reshape(-1) >= 0).nonzero()[:, 0]
    triangle = shown.reshape(-1)[pixels].long()
    rows = given.tri.T.index_select(1, triangle).long()
    if given.ranges is None:
        rows = rows + pixels // (height * width) * given.pos.shape[1]
    corners = take(given.pos.reshape(-1, 4), rows.reshape(-1)).reshape(3, -1, 4)
    uv, db, depth = _barycentrics(corners, pixels % width, pixels // width % height, given.size)
    values = torch.cat([uv, depth[:, None], triangle[:, None].to(uv.dtype) + 1], dim=1)
    rast, rast_db = (scattered(x, pixels, shown.shape) for x in (values, db if grad_db else db.detach()))
    return rast, rast_db


def _triangles(image: Image, size: tuple[int, int], layer: int) -> torch.Tensor:
    """(H, W) int32, the triangle that a layer shows at each pixel, or −1."""
    part = rts.Part(image.surface, {"vertices": image.seen.vertices}, "silhouette")
    # A splatter that needs only fronts has hidden samples left out.
    needs = "none" if layer == 0 else None
    sampled = rts.sample(part, image.seen.camera, size, sampler="raster", layers=layer + 1, splatter=needs)
    border = sampled.border
    row = sampled.row[layer, border : border + size[0], border : border + size[1]]
    ids = sampled.samples[0].ids[:, 0]
    return torch.cat([ids, torch.full_like(row[0, :1], -1)])[row.long()]  # Row −1, for none, is the last.


def _barycentrics(
    corners: torch.Tensor, column: torch.Tensor, row: torch.Tensor, size: tuple[int, int]
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """U and v (P, 2), their changes from pixel to pixel (P, 4), and z/w (P,) of corners (3, P, 4) at some pixels.

    Edge functions in homogeneous coordinates relative to the pixel, so that few digits cancel; in float64 where the
    device has it.
    """
    dtype = corners.dtype
    # Each component of each corner (P,) by itself: that takes half the time of columns.
    x, y, z, w = (corners if corners.device.type == "mps" else corners.double()).permute(2, 0, 1).contiguous()
    height, width = size
    px, py = (2 * column + 1).to(x.dtype) / width - 1, (2 * row + 1).to(x.dtype) / height - 1
    x, y = x - px * w, y - py * w
    following = (1, 2), (2, 0), (0, 1)
    weight = [x[i] * y[j] - y[i] * x[j] for i, j in following]
    along_x = [y[i] * w[j] - w[i] * y[j] for i, j in following]
    along_y = [w[i] * x[j] - x[i] * w[j] for i, j in following]
    total, total_x, total_y = (a + b + c for a, b, c in (weight, along_x, along_y))
    inverse = 1 / torch.where(total == 0, 1.0, total)
    u, v = weight[0] * inverse, weight[1] * inverse
    across, up = inverse * (2 / width), inverse * (2 / height)
    changes = [
        (along[k] - b * of) * by
        for k, b in enumerate((u, v))
        for along, of, by in ((along_x, total_x, across), (along_y, total_y, up))
    ]
    uv, db = torch.stack([u, v], dim=1), torch.stack(changes, dim=1)
    a, b = u.detach(), v.detach()
    c = weight[2].detach() * inverse.detach()
    depth = (z[0] * a + z[1] * b + z[2] * c).detach() / (w[0] * a + w[1] * b + w[2] * c).detach()
    return uv.to(dtype), db.to(dtype), depth.clamp(-1, 1).to(dtype)


def set_log_level(level: int) -> None:
    """Set the level of messages, from 0 to 3. There are none here.

    Raises:
        InputError: another level.
    """
    if level not in LEVELS:
        raise InputError(f"level is {level!r}; expected one of {LEVELS}")
    _level[0] = level


def get_log_level() -> int:
    """The level that `set_log_level` set; 1 at first."""
    return _level[0]
