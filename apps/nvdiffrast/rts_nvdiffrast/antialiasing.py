"""`antialias`: outlines as area averages, which move with their surface.

nvdiffrast blends pairs of pixels across edges that it finds by triangles' corners, and differentiates the weights. Here
the geometry is drawn again, and the splatter `edges` finds its outlines. A pixel at an outline is the area average of
the colours beside it. Each sample has the colour of one of the 3 × 3 shaded pixels around it.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
import torch

import rts
from rts import InputError
from rts.plugin_api.operations import take
from rts_nvdiffrast.checks import (
    check_corners,
    check_devices,
    check_finite,
    check_floats,
    check_rast,
    check_triangles,
    described,
)
from rts_nvdiffrast.rasterizing import DRAWN, SAMPLES, Drawn
from rts_nvdiffrast.triangles import Image, Topology, images

NEAR = 1e-6
"""Difference of z/w that counts as much as a distance of one pixel, so that rounding does not choose among pixels."""
PEELED = 3
"""The fewest samples along each side of a pixel of a layer behind the front."""
CALIBRATION = (1 + 2 * math.exp(-2)) / (8 * math.exp(-2))
"""The factor with which splats of 0.5 cells that move a ramp of colour have its true derivative."""
AROUND = [(0, 0), (-1, 0), (1, 0), (0, -1), (0, 1), (-1, -1), (1, -1), (-1, 1), (1, 1)]
"""Steps (x, y) to the pixels that may colour a sample, the sample's own first."""


def antialias(
    color: torch.Tensor,
    rast: torch.Tensor,
    pos: torch.Tensor,
    tri: torch.Tensor,
    topology_hash: Topology | None = None,
    pos_gradient_boost: float = 1.0,
) -> torch.Tensor:
    """Antialias outlines, with a derivative in positions; any number of channels.

    **Motion counts once.** The derivative of this image in `pos` is complete: it has outlines, creases and colours that
    move with their surface. If `color` depends on u and v of `rast`, these carry the motion of colours, too. So the
    share of u and v in the derivative of *this* image is taken off `rast` again. Gradients of other images that come
    from the same `rast` keep theirs, and so do attributes, textures and other calls of `antialias`. An image that is
    antialiased twice, one call after the other, has its outlines counted twice. The share is found by going backwards
    from this image to `rast`; so shading runs backwards twice. Where `pos` has no gradient, nothing is taken off.

    Args:
        color: (B, H, W, C), shaded at the pixels of `rast`; float32 or float64.
        rast: (B, H, W, 4), the first result of `rasterize`, which also tells how many samples its context wants: the
            very tensor that `interpolate` got. With a copy, a slice or `rast.detach()` motion counts twice.
        pos: as in `rasterize`.
        tri: as in `rasterize`.
        topology_hash: the result of `antialias_construct_topology_hash` for `tri`; None to look for one.
        pos_gradient_boost: factor on the derivative in `pos`, of outlines and of colours that move.

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
    drawn = getattr(rast, DRAWN, None) or Drawn(SAMPLES, _shown_ranges(rast), 0)
    if pos.ndim == 3:
        drawn = drawn._replace(ranges=None)
    elif drawn.ranges is None:
        drawn = drawn._replace(ranges=np.tile([[0, len(tri)]], (len(rast), 1)))
    moving = pos.detach() + pos_gradient_boost * (pos - pos.detach())
    every = images(moving, topology_hash, drawn.ranges)
    value = torch.stack([_image(color[b], rast[b].detach(), image, drawn) for b, image in enumerate(every)])
    if pos.requires_grad and rast.requires_grad:
        value = _WithoutMotion.apply(value, rast)
    return value


def _shown_ranges(rast: torch.Tensor) -> np.ndarray:
    """Ranges (B, 2) of triangles, for each image from the lowest to the highest that it shows."""
    numbers = rast[..., 3].detach().flatten(1).long()
    last = numbers.amax(dim=1)
    first = torch.where(numbers > 0, numbers, last[:, None]).amin(dim=1)
    return torch.stack([(first - 1).clamp_min(0), (last - first + 1) * (last > 0)], dim=1).cpu().numpy()


def antialias_construct_topology_hash(tri: torch.Tensor) -> Topology:
    """The topology of triangles that stay, for `antialias`.

    Args:
        tri: as in `rasterize`.

    Raises:
        InputError: another shape or dtype.
    """
    return Topology.of(check_triangles(tri))


class _WithoutMotion(torch.autograd.Function):
    """An image itself, whose gradient takes its own share off that of `rast`, which it gets by way of colours."""

    @staticmethod
    def forward(ctx: Any, value: torch.Tensor, rast: torch.Tensor) -> torch.Tensor:
        ctx.save_for_backward(value, rast)
        return value.view_as(value)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, g: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor | None]:  # pyright: ignore[reportIncompatibleMethodOverride]
        value, rast = ctx.saved_tensors
        with torch.enable_grad():
            (share,) = torch.autograd.grad(value, rast, g, retain_graph=True, allow_unused=True)
        return g, None if share is None else -share


class _Shaded(NamedTuple):
    """Colours of one image's pixels, and the triangles that they show.

    Attributes:
        triangle: (H, W) int64, −1 for none.
        depth: (H, W), z/w.
        image: the geometry.
    """

    triangle: torch.Tensor
    depth: torch.Tensor
    image: Image

    def pixels(self, position: torch.Tensor, triangle: torch.Tensor, camera: rts.Camera) -> torch.Tensor:
        """The pixels (N,), as flat indices, that colour samples at some positions (N, 3), of triangles (N,).

        Of the 3 × 3 pixels around a sample those that show its triangle come first, then those that are nearest in
        depth, then those that are nearest in the image.
        """
        height, width = self.triangle.shape
        at = camera.project(position, (height, width))[:, :2]
        limit = torch.tensor([width - 1, height - 1]).to(at.device)
        own = torch.minimum(at.floor().long().clamp_min(0), limit)
        chosen = own[:, 1] * width + own[:, 0]
        rest = (self.triangle.reshape(-1)[chosen] != triangle).nonzero()[:, 0]
        if not len(rest):
            return chosen
        steps = torch.tensor(AROUND).to(at.device)
        near = own[rest, None] + steps
        inside = ((near >= 0) & (near <= limit)).all(dim=2)
        near = torch.minimum(near.clamp_min(0), limit)
        index = near[..., 1] * width + near[..., 0]
        shown = self.triangle.reshape(-1)[index]
        depth = self.image.seen.normalized_depth(position[rest])
        score = (self.depth.reshape(-1)[index] - depth[:, None]).abs().to(at.dtype)
        score = score + NEAR * (near + 0.5 - at[rest, None]).square().sum(dim=2)
        score = torch.where(shown == triangle[rest, None], score - 10, score)
        score = torch.where(inside & (shown >= 0), score, torch.full_like(score, torch.inf))
        best = score.argmin(dim=1, keepdim=True)
        return chosen.index_put((rest,), index.gather(1, best)[:, 0])


class _Colors(rts.Shader):
    """A shader that takes colours (H, W, C) from the pixels of `shaded`."""

    opaque = True
    reads = ("triangle",)

    def __init__(self, shaded: _Shaded, colors: torch.Tensor):
        self.shaded, self.colors, self.channels = shaded, colors.flatten(0, 1), colors.shape[-1]

    def __call__(self, theta: Any, gbuffer: Any, camera: rts.Camera) -> torch.Tensor:
        """See `rts.Shader`."""
        position = gbuffer["position"].detach()
        pixel = self.shaded.pixels(position, gbuffer["triangle"][:, 0].detach().round().long(), camera)
        rgb = take(self.colors, pixel)
        return torch.cat([rgb, torch.ones_like(rgb[:, :1])], dim=1)


def _image(color: torch.Tensor, rast: torch.Tensor, image: Image, drawn: Drawn) -> torch.Tensor:
    """An image (H, W, C) with antialiased outlines, differentiable in colours and in positions."""
    shaded = _Shaded(rast[..., 3].long() - 1, rast[..., 2], image)
    vertices, camera = image.seen.vertices, image.seen.camera
    if not image.surface.face_count:
        return color + 0 * vertices.sum()
    background = _background(color, shaded.triangle < 0)
    part = rts.Part(image.surface, {"vertices": vertices}, _Colors(shaded, color))
    if drawn.layer:
        still = part.replace(shader=_Colors(shaded, color.detach()))
        return _peeled(part, still, camera, background, drawn)
    size, samples = (color.shape[0], color.shape[1]), drawn.samples
    sampled = rts.sample(part, camera, size, sampler="raster", splatter="edges", supersample=samples)
    return _over(rts.render_samples(sampled, part, camera, splatter="edges"), background)


def _peeled(
    part: rts.Part, still: rts.Part, camera: rts.Camera, background: torch.Tensor, drawn: Drawn
) -> torch.Tensor:
    """The image (H, W, C) of a layer behind the front, whose outlines are not found: means of samples, and splats.

    The value, and the derivative in colours, are means of samples in each pixel. The derivative in positions is that of
    the same samples splatted, with the colours of `still`, which are constants.
    """
    more, first = max(PEELED, drawn.samples), drawn.layer
    options = {"sampler": "raster", "splatter": None, "supersample": more, "layers": first + 2}
    sampled = rts.sample(part, camera, (background.shape[0], background.shape[1]), **options)
    layers = {n: x[first:] for n in ("row", "depth", "facing") if (x := getattr(sampled, n, None)) is not None}
    sampled = sampled.replace(**layers)
    value = _over(rts.render_samples(sampled, part, camera, splatter="none"), background)
    motion = _over(rts.render_samples(sampled, still, camera, splatter="multi"), background.detach())
    return value + CALIBRATION * (motion - motion.detach()).nan_to_num()  # Infinite colours do not move.


def _over(image: torch.Tensor, background: torch.Tensor) -> torch.Tensor:
    """An image (H, W, C + 1) composited over a background (H, W, C)."""
    return image[..., :-1] + (1 - image[..., -1:]) * background


def _background(color: torch.Tensor, empty: torch.Tensor) -> torch.Tensor:
    """Colours (H, W, C) behind everything: of `empty` pixels their own, of others the mean of empty ones beside them.

    Pixels without empty ones beside them keep their own.
    """
    weight = empty.to(color.dtype)[..., None]
    sums = torch.cat([color * weight, weight], dim=2).permute(2, 0, 1)
    sums = torch.nn.functional.avg_pool2d(sums[None], 3, stride=1, padding=1)[0].permute(1, 2, 0)
    beside = sums[..., -1:] > 0
    mean = sums[..., :-1] / torch.where(beside, sums[..., -1:], torch.ones_like(sums[..., -1:]))
    return torch.where(beside & ~empty[..., None], mean, color)
