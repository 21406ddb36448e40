"""The yardstick of the other samplers: float64 NumPy, every triangle against every pixel of its bounding box."""

from __future__ import annotations

import numpy as np

from rts import Camera, TriangleSampler
from rts.plugin_api.records import Fragments, Proxy

CANDIDATES_AT_ONCE = 1 << 20
"""About how many pairs of a triangle and a pixel are tested at once, which bounds memory."""


class Reference(TriangleSampler):
    """Sampler that tests each triangle against each pixel near it: slow and obvious.

    A pixel's ray meets a triangle where Σ bᵢ (xᵢ − X wᵢ, yᵢ − Y wᵢ) = 0 with Σ bᵢ = 1 and bᵢ ≥ 0: (x, y, w) are the
    corners in clip space and (X, Y) the pixel's centre in NDC. So with gᵢ = (xᵢ − X wᵢ, yᵢ − Y wᵢ), the b are in the
    ratio g₁ × g₂ : g₂ × g₀ : g₀ × g₁. This needs no division by w, hence no clipping.
    """

    def rasterize(self, prepared: Proxy, camera: Camera, size: tuple[int, int], layers: int, cull: str) -> Fragments:
        """See `TriangleSampler.rasterize`."""
        height, width = size
        homogeneous = np.concatenate([prepared.vertices.astype(np.float64), np.ones((len(prepared.vertices), 1))], 1)
        in_camera = homogeneous @ camera.view.T
        clip = in_camera @ camera.projection.T
        corners, depth = clip[prepared.faces], -in_camera[prepared.faces, 2]

        first, last, kept = _pixel_boxes(corners, size)
        if cull == "back":
            kept &= _faces_viewer(in_camera[prepared.faces], camera)
        hits = []
        counts = np.where(kept, (last - first + 1).clip(0).prod(axis=1), 0)
        for chunk in _chunks(counts):
            triangle = np.repeat(chunk, counts[chunk])
            within = np.arange(len(triangle)) - np.repeat(np.cumsum(counts[chunk]) - counts[chunk], counts[chunk])
            columns = (last - first + 1)[triangle, 0]
            x, y = first[triangle, 0] + within % columns, first[triangle, 1] + within // columns
            hits.append(_hits(triangle, y * width + x, x + 0.5, y + 0.5, corners, depth, size))
        if not hits:
            return _empty(size, layers)
        triangle, pixel, barycentrics, depth = map(np.concatenate, zip(*hits, strict=True))
        return _nearest(triangle, pixel, barycentrics, depth, size, layers)

    def rasterize_points(
        self, prepared: Proxy, camera: Camera, size: tuple[int, int], layers: int, cull: str, points: np.ndarray
    ) -> Fragments:
        """See `TriangleSampler.rasterize_points`: every triangle against every point."""
        homogeneous = np.concatenate([prepared.vertices.astype(np.float64), np.ones((len(prepared.vertices), 1))], 1)
        in_camera = homogeneous @ camera.view.T
        corners, depth = (in_camera @ camera.projection.T)[prepared.faces], -in_camera[prepared.faces, 2]
        kept = np.ones(len(corners), bool)
        if cull == "back":
            kept = _faces_viewer(in_camera[prepared.faces], camera)
        triangles, hits = np.flatnonzero(kept), []
        for chunk in _chunks(np.full(len(points), len(triangles))):
            triangle, place = np.tile(triangles, len(chunk)), np.repeat(chunk, len(triangles))
            hits.append(_hits(triangle, place, points[place, 0], points[place, 1], corners, depth, size))
        line = 1, len(points)
        if not hits:
            return _empty(line, layers)
        triangle, place, barycentrics, depth = map(np.concatenate, zip(*hits, strict=True))
        return _nearest(triangle, place, barycentrics, depth, line, layers)


def _chunks(counts: np.ndarray) -> list[np.ndarray]:
    """Indices of non-zero counts, split where their running total passes a multiple of `CANDIDATES_AT_ONCE`."""
    indices = np.flatnonzero(counts)
    if not len(indices):
        return []
    breaks = np.flatnonzero(np.diff(np.cumsum(counts[indices]) // CANDIDATES_AT_ONCE)) + 1
    return np.split(indices, breaks)


def _pixel_boxes(corners: np.ndarray, size: tuple[int, int]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """First and last pixel (T, 2), each (x, y), that a triangle may cover (none if first > last), and marks (T,).

    Marked are triangles that reach between the near and far planes, ahead of the eye. `corners` (T, 3, 4) are in clip
    space. A triangle with a corner whose w is not positive gets the whole image.
    """
    height, width = size
    w = corners[..., 3]
    whole = np.all(w > 0, axis=1)
    safe = np.where(w > 0, w, 1.0)
    with np.errstate(over="ignore"):
        x, y = (corners[..., 0] / safe + 1) * width / 2, (1 - corners[..., 1] / safe) * height / 2
    pixels = np.stack([x, y], -1).clip(-1, [width + 1, height + 1])
    limits = np.array([width - 1, height - 1])
    first = np.where(whole[:, None], np.floor(pixels.min(axis=1) - 0.5), 0).astype(np.int64).clip(0, limits + 1)
    last = np.where(whole[:, None], np.ceil(pixels.max(axis=1) - 0.5), limits).astype(np.int64).clip(-1, limits)
    inside_near, inside_far = np.any(corners[..., 2] >= -w, axis=1), np.any(corners[..., 2] <= w, axis=1)
    return first, last, inside_near & inside_far & np.any(w > 0, axis=1)


def _faces_viewer(corners: np.ndarray, camera: Camera) -> np.ndarray:
    """Marks (T,) of triangles whose outward normal points to the viewer's side; corners (T, 3, 4) in camera space."""
    a, b, c = corners[:, 0, :3], corners[:, 1, :3], corners[:, 2, :3]
    toward = a * camera.projection[3, 2] + [0, 0, camera.projection[3, 3]]
    outward = np.cross(b - a, c - a) * np.sign(np.linalg.det(camera.view[:3, :3]))
    return (outward * toward).sum(axis=1) > 0


def _hits(triangle, place, x, y, corners, depth, size):
    """Triangles, places, first two barycentrics and depths of those candidates that hit.

    Candidate n is triangle `triangle[n]` at the position (x[n], y[n]), in pixels, of place `place[n]`; `corners`
    (T, 3, 4) are in clip space, `depth` (T, 3) are linear depths of corners.
    """
    height, width = size
    ndc_x, ndc_y = x * 2 / width - 1, 1 - y * 2 / height
    c = corners[triangle]
    gx, gy = c[..., 0] - ndc_x[:, None] * c[..., 3], c[..., 1] - ndc_y[:, None] * c[..., 3]
    edges = np.stack([_cross(gx[:, i], gy[:, i], gx[:, j], gy[:, j]) for i, j in ((1, 2), (2, 0), (0, 1))], -1)
    total = edges.sum(axis=1)
    sign = np.sign(total)
    # Derivatives of each edge function along x and down y decide ties: top and left edges own their pixels.
    slope_x, slope_down = _edge_slopes(c)
    owned = np.where(slope_x * sign[:, None] != 0, slope_x * sign[:, None] > 0, slope_down * sign[:, None] > 0)
    oriented = edges * sign[:, None]
    hit = ((oriented > 0) | ((oriented == 0) & owned)).all(axis=1) & (total != 0)
    triangle, place, c = triangle[hit], place[hit], c[hit]
    b = edges[hit] / total[hit, None]
    near, far = (b * (c[..., 2] + c[..., 3])).sum(1) >= 0, (b * (c[..., 3] - c[..., 2])).sum(1) >= 0
    # Σ bᵢ wᵢ > 0 tells a point in front of the viewer from one behind that projects to the same pixel.
    seen = near & far & ((b * c[..., 3]).sum(1) > 0)
    z = (b * depth[triangle]).sum(axis=1)
    return triangle[seen], place[seen], b[seen, :2], z[seen]


def _cross(ax, ay, bx, by):
    return ax * by - ay * bx


def _edge_slopes(c: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Derivatives of gᵢ × gⱼ (see `Reference`) along +x of NDC, and along −y: (n, 3) each, for the three edges.

    `c` (n, 3, 4) are the corners in clip space.
    """
    pairs = ((1, 2), (2, 0), (0, 1))
    along_x = [c[:, i, 1] * c[:, j, 3] - c[:, i, 3] * c[:, j, 1] for i, j in pairs]
    down = [c[:, i, 0] * c[:, j, 3] - c[:, i, 3] * c[:, j, 0] for i, j in pairs]
    return np.stack(along_x, -1), np.stack(down, -1)


def _nearest(triangle, pixel, barycentrics, depth, size, layers) -> Fragments:
    """Fragments of the first `layers` hits of each pixel, by depth, then by triangle."""
    order = np.lexsort((triangle, depth, pixel))
    triangle, pixel, barycentrics, depth = triangle[order], pixel[order], barycentrics[order], depth[order]
    starts = np.flatnonzero(np.diff(pixel, prepend=-1))
    layer = np.arange(len(pixel)) - np.repeat(starts, np.diff(starts, append=len(pixel)))
    keep = layer < layers
    fragments = _empty(size, layers)
    at = layer[keep], *np.divmod(pixel[keep], size[1])
    fragments.triangle_ids[at] = triangle[keep]
    fragments.barycentrics[at] = barycentrics[keep]
    fragments.depth[at] = depth[keep]
    return fragments


def _empty(size: tuple[int, int], layers: int) -> Fragments:
    return Fragments(
        np.full((layers, *size), -1, np.int32),
        np.zeros((layers, *size, 2), np.float32),
        np.zeros((layers, *size), np.float32),
    )
