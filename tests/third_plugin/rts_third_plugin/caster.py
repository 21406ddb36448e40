"""A ray caster in plain NumPy, for some hundred triangles."""

import numpy as np

from rts.plugin_api.bases import TriangleSampler
from rts.plugin_api.records import Fragments

TURN = np.array([0.5377, 0.3186, 0.7806])  # A direction along which no edge of a model is likely to lie.


class Caster(TriangleSampler):
    """Casts every ray at every triangle. A ray through an edge counts as turned a little, all rays in the same way."""

    def rasterize(self, prepared, camera, size, layers, cull):
        vertices, faces = prepared.vertices.astype(np.float64), prepared.faces
        rays, (near, far) = camera.rays(size), camera.depth_range()
        a, b, c = (vertices[faces[:, i], None, None] - rays.origins for i in range(3))
        edges = np.stack([np.cross(b, c), np.cross(c, a), np.cross(a, b)], axis=-2)  # (T, H, W, 3, 3)
        sides = (edges @ rays.directions[..., None])[..., 0]  # On which side of each edge the ray passes.
        left, total = np.where(sides == 0, edges @ TURN, sides) > 0, sides.sum(axis=-1)
        weights = sides / np.where(total == 0, 1, total)[..., None]  # Perspective-correct barycentrics.
        depth = (weights * camera.depth(vertices)[faces][:, None, None]).sum(axis=-1)
        facing = total < 0 if cull == "back" else total != 0
        hit = facing & (left.all(axis=-1) | ~left.any(axis=-1)) & (depth >= near) & (depth <= far)
        depth = np.concatenate([np.where(hit, depth, np.inf), np.full((layers, *size), np.inf)])
        order = np.argsort(depth, axis=0, kind="stable")[:layers]
        depth = np.take_along_axis(depth, order, axis=0)
        met, triangle = depth < np.inf, np.where(depth < np.inf, order, 0)
        weights = np.take_along_axis(weights[..., :2], triangle[..., None], axis=0)
        return Fragments(
            triangle_ids=np.where(met, triangle, -1).astype(np.int32),
            barycentrics=np.where(met[..., None], weights, 0).astype(np.float32),
            depth=np.where(met, depth, 0).astype(np.float32),
        )
