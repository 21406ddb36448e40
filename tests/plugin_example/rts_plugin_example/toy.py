"""A sampler in plain NumPy: every triangle against every ray."""

import numpy as np

import rts
from rts.plugin_api.records import Fragments


class Toy(rts.TriangleSampler):
    """Slow, and short."""

    def rasterize(self, prepared, camera, size, layers, cull):
        rays = camera.rays(size)
        origins, directions = rays.origins, rays.directions
        clip = camera.projection @ camera.view
        depths = np.full((layers, *size), np.inf)
        ids = np.full((layers, *size), -1, np.int32)
        weights = np.zeros((layers, *size, 2), np.float32)
        for index, corners in enumerate(prepared.vertices[prepared.faces].astype(np.float64)):
            hit, depth, own = hits(corners, origins, directions, cull)
            point = origins + depth[..., None] * directions
            z, w = (point @ row[:3] + row[3] for row in clip[2:])
            depth = np.where(hit & (w > 0) & (np.abs(z) <= w), depth, np.inf)
            # One layer more, sorted by depth, less the last.
            depths = np.concatenate([depths, depth[None]])
            order = np.argsort(depths, axis=0, kind="stable")[:layers]
            depths = np.take_along_axis(depths, order, axis=0)
            ids = np.take_along_axis(np.concatenate([ids, np.full((1, *size), index, np.int32)]), order, axis=0)
            weights = np.take_along_axis(np.concatenate([weights, own[None]]), order[..., None], axis=0)
        covered = depths < np.inf
        return Fragments(
            np.where(covered, ids, -1),
            np.where(covered[..., None], weights, 0).astype(np.float32),
            np.where(covered, depths, 0).astype(np.float32),
        )


def hits(corners, origins, directions, cull):
    """Hits of rays, their depths, and the weights of the first two corners there, by Cramer's rule."""
    a, b, c = corners
    across = np.cross(directions, b - c)
    determinant = across @ (a - c)
    # The determinant has the sign of the outward normal towards the viewer.
    hit = determinant > 0 if cull == "back" else determinant != 0
    determinant = np.where(hit, determinant, 1)
    from_c = origins - c
    first = np.sum(from_c * across, axis=-1) / determinant
    upward = np.cross(from_c, a - c)
    second = np.sum(directions * upward, axis=-1) / determinant
    hit &= (first >= 0) & (second >= 0) & (first + second <= 1)
    return hit, upward @ (b - c) / determinant, np.stack([first, second], axis=-1)
