"""Antialiasing by pairs of pixels in plain torch, a yardstick for `rts_nvdiffrast.torch.antialias`.

After Laine et al. 2020, "Modular Primitives for High-Performance Differentiable Rendering".

Two pixels side by side, or one above the other, show different triangles. The nearer triangle has an edge between the
pixels' centres. If this edge is a silhouette (of one triangle, or of two on the same side of it in the image), then one
pixel takes a share of the other's colour: as much as the edge is beyond, or short of, the middle between the centres.
Upright edges count for pairs along x, others for pairs along y: an oblique edge would count twice.
"""

from __future__ import annotations

from collections import defaultdict

import torch


def opposites(tri: torch.Tensor) -> torch.Tensor:
    """(T, 3): for edge i of a triangle, from corner i on, the third corner of the triangle beyond; −1 for none."""
    edges, faces = defaultdict(list), tri.tolist()
    for t, face in enumerate(faces):
        for i in range(3):
            edges[frozenset((face[i], face[(i + 1) % 3]))].append((t, face[(i + 2) % 3]))
    beyond = [
        [next((c for other, c in edges[frozenset((f[i], f[(i + 1) % 3]))] if other != t), -1) for i in range(3)]
        for t, f in enumerate(faces)
    ]
    return torch.tensor(beyond)


def antialias(
    color: torch.Tensor, rast: torch.Tensor, pos: torch.Tensor, tri: torch.Tensor, beyond: torch.Tensor
) -> torch.Tensor:
    """The antialiased image (1, H, W, C); arguments as those of nvdiffrast, for one image, and `opposites`."""
    height, width = rast.shape[1:3]
    size = pos.new_tensor([width, height])
    screen = (pos[0, :, :2] / pos[0, :, 3:] + 1) * size / 2  # Pixels, row 0 at the bottom.
    triangle = rast[0, ..., 3].detach().long() - 1
    depth = torch.where(triangle >= 0, rast[0, ..., 2].detach(), 2.0)
    image = color[0].reshape(-1, color.shape[-1])
    added = torch.zeros_like(image)
    index = torch.arange(height * width).reshape(height, width)
    for axis in (0, 1):  # Pairs along x, then along y.
        a, b = (index[:, :-1], index[:, 1:]) if axis == 0 else (index[:-1], index[1:])
        a, b = a.reshape(-1), b.reshape(-1)
        differ = triangle.reshape(-1)[a] != triangle.reshape(-1)[b]
        a, b = a[differ], b[differ]
        swap = depth.reshape(-1)[b] < depth.reshape(-1)[a]
        near, far = torch.where(swap, b, a), torch.where(swap, a, b)
        toward = torch.where(swap, -1.0, 1.0)
        at, crosses = _crossing(near, axis, toward, width, triangle, screen, tri, beyond)
        near, far, at = near[crosses], far[crosses], at[crosses]
        share = (at - 0.5)[:, None]
        change = share * (image[near] - image[far])  # Beyond the middle the far pixel takes of the near one's colour.
        target = torch.where(at.detach() > 0.5, far, near)
        added = added.index_add(0, target, change)
    return (image + added).reshape(color.shape)


def _crossing(
    near: torch.Tensor,
    axis: int,
    toward: torch.Tensor,
    width: int,
    triangle: torch.Tensor,
    screen: torch.Tensor,
    tri: torch.Tensor,
    beyond: torch.Tensor,
) -> tuple[torch.Tensor, torch.Tensor]:
    """Where a silhouette edge of the near pixels' triangles lies on the way to the far pixels, and whether one does.

    The way is 1 long.
    """
    shown = triangle.reshape(-1)[near]
    corners = tri.long()[shown]  # (P, 3)
    center = torch.stack([near % width, near // width], dim=1) + 0.5
    points = screen[corners] - center[:, None]
    along, across = points[..., axis] * toward[:, None], points[..., 1 - axis]
    result, crosses = torch.zeros_like(toward), torch.zeros_like(toward, dtype=torch.bool)
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        cut = (across[:, i] < 0) != (across[:, j] < 0)
        step = torch.where(cut, across[:, j] - across[:, i], 1.0)
        at = along[:, i] - across[:, i] * (along[:, j] - along[:, i]) / step
        edge = points[:, j] - points[:, i]
        other = beyond[shown, i]
        there = screen[other.clamp_min(0)] - center
        sides = [edge[:, 0] * (p - points[:, i])[:, 1] - edge[:, 1] * (p - points[:, i])[:, 0]
                 for p in (points[:, k], there)]  # fmt: skip
        upright = edge[:, 1 - axis].abs() > edge[:, axis].abs()
        outline = (other < 0) | (sides[0] * sides[1] > 0)
        here = (cut & upright & outline & (at >= 0) & (at <= 1) & (shown >= 0)).detach()
        result, crosses = torch.where(here, at, result), crosses | here
    return result, crosses
