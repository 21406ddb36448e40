"""A ray caster in plain NumPy."""

import numpy as np

import rts
from rts.plugin_api.records import Fragments

TURN = np.array([0.5377, 0.3186, 0.7806])  # Where rays are turned to; no edge of a model is likely to lie along it.


class Caster(rts.TriangleSampler):
    """Casts the rays of cells at triangles, one triangle after the other, at the cells that its projection may cover.

    A ray along d from o passes through a triangle if it passes all three edges on one side. The side of the edge from
    p to q is the sign of d · ((p − o) × (q − o)), which is exactly opposite from q to p, so that no ray slips through
    between neighbours. A ray through an edge is on the side that it would be on if it were turned a little, every ray
    in the same way, so that of the triangles about an edge or a corner one is met.
    """

    concurrent = True

    def rasterize(self, prepared, camera, size, layers, cull):
        vertices = np.asarray(prepared.vertices, np.float64)
        faces, rays = prepared.faces, camera.rays(size)
        origins, directions = (np.broadcast_to(x, (*size, 3)) for x in (rays.origins, rays.directions))
        near, far = camera.depth_range()
        depths, boxes = camera.depth(vertices), covered_cells(camera, vertices, faces, size)
        found = []
        for triangle in np.flatnonzero((boxes[:, 0] < boxes[:, 1]) & (boxes[:, 2] < boxes[:, 3])):
            top, bottom, left, right = boxes[triangle]
            o, d = origins[top:bottom, left:right], directions[top:bottom, left:right]
            a, b, c = (vertices[corner] - o for corner in faces[triangle])
            edges = np.stack([np.cross(b, c), np.cross(c, a), np.cross(a, b)], axis=-2)
            sides = (edges * d[..., None, :]).sum(axis=-1)
            left_of = np.where(sides == 0, edges @ TURN, sides) > 0
            total = sides.sum(axis=-1)  # d · normal: negative where the front is seen.
            hit = (left_of.all(axis=-1) | ~left_of.any(axis=-1)) & (total != 0)
            if cull != "none":
                hit &= total < 0 if cull == "back" else total > 0
            y, x = np.nonzero(hit)
            weights = sides[y, x] / total[y, x, None]
            depth = weights @ depths[faces[triangle]]
            kept = (depth >= near) & (depth <= far)
            cell = (top + y) * size[1] + left + x
            found.append((cell[kept], np.full(kept.sum(), triangle), weights[kept, :2], depth[kept]))
        return nearest(found, size, layers)


def covered_cells(camera, vertices, faces, size):
    """(T, 4) int, the ranges top, bottom, left, right of cells that triangles may cover: all if one is not in front."""
    height, width = size
    pixels = camera.project(vertices, size)[faces]  # (T, 3, 3)
    with np.errstate(invalid="ignore"):
        low = np.floor(pixels[..., :2].min(axis=1)) - 1
        high = np.ceil(pixels[..., :2].max(axis=1)) + 1
    low, high = (np.clip(x, 0, (width, height)).astype(int) for x in (low, high))
    boxes = np.stack([low[:, 1], high[:, 1], low[:, 0], high[:, 0]], axis=-1)
    boxes[pixels[..., 2].min(axis=1) <= 1e-9] = (0, height, 0, width)
    return boxes


def nearest(found, size, layers):
    """The `Fragments` of the nearest hits of each cell, of a list of hits (cell, triangle, barycentrics, depth)."""
    cells = size[0] * size[1]
    triangles = np.full((layers, cells), -1, np.int32)
    barycentrics, depths = np.zeros((layers, cells, 2), np.float32), np.zeros((layers, cells), np.float32)
    if found:
        cell, triangle, weights, depth = (np.concatenate(column) for column in zip(*found, strict=True))
        order = np.lexsort((triangle, depth, cell))
        cell = cell[order]
        layer = np.arange(len(cell)) - np.searchsorted(cell, cell)  # How many hits of the cell are nearer.
        order, place = order[layer < layers], (layer[layer < layers], cell[layer < layers])
        triangles[place], barycentrics[place], depths[place] = triangle[order], weights[order], depth[order]
    shape = (layers, *size)
    return Fragments(triangles.reshape(shape), barycentrics.reshape((*shape, 2)), depths.reshape(shape))
