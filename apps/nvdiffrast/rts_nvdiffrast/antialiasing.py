"""`antialias`: pairs of pixels blended across outlines, by the areas on both sides of them.

As in nvdiffrast (Laine et al. 2020), two neighbouring pixels on both sides of a silhouette edge take a share of each
other's colour, and the shares move with the edge. Two things are finer. Edges are found by walks over triangles from
centre to centre, so that triangles may be smaller than pixels. A share is the area of the pixel beyond a straight
line, not a length.
"""

from __future__ import annotations

import numpy as np
import torch

from rts import InputError
from rts.plugin_api.operations import take
from rts.plugin_api.threads import parallel, read_only
from rts_nvdiffrast.checks import (
    check_corners,
    check_devices,
    check_finite,
    check_floats,
    check_rast,
    check_triangles,
    described,
)
from rts_nvdiffrast.triangles import Topology

LEVEL = 1e-2
"""The least slope of a line against its way, so that nothing is divided by 0."""


def antialias(
    color: torch.Tensor,
    rast: torch.Tensor,
    pos: torch.Tensor,
    tri: torch.Tensor,
    topology_hash: Topology | None = None,
    pos_gradient_boost: float = 1.0,
) -> torch.Tensor:
    """Antialias outlines, with a derivative in positions; any number of channels.

    The derivative in `pos` is that of outlines alone. Colours that move with their surface have theirs by way of u and
    v of `rast`, as in nvdiffrast.

    Args:
        color: (B, H, W, C), shaded at the pixels of `rast`; float32 or float64.
        rast: (B, H, W, 4), the first result of `rasterize`; only the numbers of triangles are read.
        pos: as in `rasterize`.
        tri: as in `rasterize`.
        topology_hash: the result of `antialias_construct_topology_hash` for `tri`; None to look for one.
        pos_gradient_boost: factor on the derivative in `pos`.

    Returns:
        (B, H, W, C). Pixels away from outlines are those of `color`.

    Raises:
        InputError: an argument is of another type, shape or dtype, images differ in number, positions are NaN
            or infinite, or tensors are on several devices.
    """
    color = check_floats("color", color, ("images", "height", "width", "channels"))
    rast, tri = check_rast(rast), check_triangles(tri)
    pos = check_floats("pos", pos, ("images", "vertices", 4), ("vertices", 4))
    check_devices(color=color, rast=rast, pos=pos, tri=tri)
    check_corners(tri, pos.shape[-2], "pos")
    check_finite(pos)
    if color.shape[:3] != rast.shape[:3] or (pos.ndim == 3 and len(pos) != len(rast)):
        shapes = ", ".join(f"{n} {tuple(x.shape)}" for n, x in (("color", color), ("rast", rast), ("pos", pos)))
        raise InputError(f"shapes are {shapes}; expected as many images, and color and rast of one size")
    if topology_hash is None:
        topology_hash = Topology.of(tri)
    elif not isinstance(topology_hash, Topology) or len(topology_hash.faces) != len(tri):
        given = described(topology_hash) if not isinstance(topology_hash, Topology) else "is of other triangles"
        raise InputError(f"topology_hash {given}; expected what antialias_construct_topology_hash gave for tri")
    moving = pos if pos_gradient_boost == 1 else pos.detach() + pos_gradient_boost * (pos - pos.detach())
    near, far, lines = _outlines(rast, moving, topology_hash)
    beyond, short = (x.to(color.dtype)[:, None] for x in _areas(lines))
    flat = color.reshape(-1, color.shape[-1])
    jump = take(flat, near) - take(flat, far)
    return flat.index_add(0, far, beyond * jump).index_add(0, near, -short * jump).reshape(color.shape)


def antialias_construct_topology_hash(tri: torch.Tensor) -> Topology:
    """The topology of triangles that stay, for `antialias`.

    Args:
        tri: as in `rasterize`.

    Raises:
        InputError: another shape or dtype.
    """
    return Topology.of(check_triangles(tri))


def _outlines(
    rast: torch.Tensor, pos: torch.Tensor, topology: Topology
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Outlines between the centres of neighbouring pixels.

    Returns:
        The pixels (M,) whose surface ends, and those (M,) behind, as flat indices; and lines (3, M), differentiable in
        `pos`: the a, b and c of a s + b r + c = 0, where s and r are pixels from the first centre towards the second,
        and across this way.
    """
    size, device = (rast.shape[1], rast.shape[2]), rast.device
    found = torch.from_numpy(_found(rast, pos, topology)).to(device).T.long()
    near, far, column, first, second = found
    image = near // (size[0] * size[1]) * pos.shape[1] if pos.ndim == 3 else 0
    ends = take(pos.reshape(-1, 4), torch.cat([first + image, second + image]))
    x, y, _, w = (ends if device.type == "mps" else ends.double()).T.reshape(4, 2, -1)
    x = (x + w) * (size[1] / 2) - (near % size[1] + 0.5) * w
    y = (y + w) * (size[0] / 2) - (near // size[1] % size[0] + 0.5) * w
    down = column > 0
    s, r = torch.where(down, y, x) * (far - near).sign(), torch.where(down, x, y)
    lines = r[0] * w[1] - w[0] * r[1], w[0] * s[1] - s[0] * w[1], s[0] * r[1] - r[0] * s[1]
    return near, far, torch.stack(lines)


def _found(rast: torch.Tensor, pos: torch.Tensor, topology: Topology) -> np.ndarray:
    """(M, 5) int32 of outlines, on the host: see `outlines_loops.find`."""
    from rts_nvdiffrast import outlines_loops as loops

    shown = read_only(rast[..., 3].detach().cpu().numpy(), np.int32)
    count, height, width = shown.shape
    corners = pos.detach().cpu().numpy().astype(np.float64).reshape(-1, pos.shape[-2], 4)
    corners[..., 0] = (corners[..., 0] + corners[..., 3]) * (width / 2)
    corners[..., 1] = (corners[..., 1] + corners[..., 3]) * (height / 2)
    begins = np.zeros(count * height + 1, np.int64)
    parallel(loops.count, count * height, shown, begins[1:], work=2 * shown.size)
    begins = begins.cumsum()
    found = np.empty((begins[-1], 5), np.int32)
    mesh = read_only(corners), read_only(topology.faces), read_only(topology.beyond)
    parallel(loops.find, count * height, *mesh, shown, read_only(begins), found, work=100 * len(found))
    return found[found[:, 2] >= 0]


def _areas(lines: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Areas (M,), of the pixel behind on the near side of each of some `lines`, and of the near one beyond it.

    A slanted line crosses ways along x and along y. Weights of both, which are the more unequal the less it is slanted,
    have the sum 1 and count it once. Slopes are constants.
    """
    a, b, c = lines
    slope, at = (b / a).detach().abs().clamp(LEVEL, 1 / LEVEL), -c / a
    weight = 1 / (1 + slope**4)
    return weight * _beside(at - 1, slope), weight * _beside(-at, slope)


def _beside(at: torch.Tensor, slope: torch.Tensor) -> torch.Tensor:
    """The share of the unit square around 0 beside lines x = at + slope · y, on the side of small x."""

    def integral(x: torch.Tensor) -> torch.Tensor:
        return torch.where(x < 1, x.clamp_min(0).square() / 2, x - 0.5)

    return (integral(at + 0.5 + slope / 2) - integral(at + 0.5 - slope / 2)) / slope
