"""Rays cast by the public interface of the package embreex, where Embree's library cannot be found.

The package gives the first hit of a ray, on one core. So rays are cast again, each from just beyond its last hit, until
every pixel has its layers. Each hit is decided in float64 as the rasterizer decides, along with all triangles around
its corners: so edges are hit once, and layers that share a corner keep their order however close they are. Layers that
share none, and are closer than `STEP`, may get lost.
"""

from __future__ import annotations

import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene

from rts import Camera
from rts.plugin_api.loops import compiled, loop
from rts.plugin_api.records import Fragments, Proxy
from rts.plugin_api.threads import parallel
from rts_backends.exact_hits import corner_lists, holds, look, places
from rts_backends.triangles import facing, pixel_matrix

STEP = 1e-6
"""Distance from a hit to the next ray's start, a share of the object's radius; float32 resolves a tenth of it."""
REACH = 1.01
"""Square of the radius of the sphere that rays start on, in units of the object's sphere."""


class Scene:
    """Substitute for `rts_backends.embree.library.Scene`.

    Args:
        vertices: (3 M + 1, 3) float32, the corners of `Covers`; the last row is padding.
        faces: (M, 3) int32, the faces of `Covers`.
    """

    def __init__(self, vertices: np.ndarray, faces: np.ndarray):
        self._vertices, self._faces = vertices, faces
        self.move(rebuild=True)

    def move(self, *, rebuild: bool) -> None:
        """Follow vertices that have changed in place; always by building anew, since embreex cannot refit."""
        self._looked_up: Proxy | None = None
        self.handle = EmbreeScene(robust=True)
        TriangleMesh(self.handle, self._vertices[:-1], self._faces)

    def cast(
        self,
        proxy: Proxy,
        owners: np.ndarray,
        sphere: np.ndarray,
        planes: np.ndarray,
        camera: Camera,
        size: tuple[int, int],
        layers: int,
        cull: str,
    ) -> Fragments:
        """Fragments (layers, H, W): the `layers` nearest hits of each pixel.

        Args:
            proxy: the object.
            owners: (M,) int32, the index of each cover's triangle in the proxy.
            sphere: (4,) the object's centre and radius; the scene is the object moved and scaled to the unit sphere.
            planes: (4,) depths; nothing nearer than the first or beyond the second is seen.
            camera: see `TriangleSampler.rasterize`.
            size: see `TriangleSampler.rasterize`.
            layers: see `TriangleSampler.rasterize`.
            cull: see `TriangleSampler.rasterize`.
        """
        if self._looked_up is not proxy:
            self._looked_up, self._places = proxy, places(proxy.vertices, proxy.faces)
            self._around = corner_lists(self._places, len(proxy.vertices))
        rays = camera.rays(size)
        origins = (rays.origins.reshape(-1, 3) - sphere[:3]) / sphere[3]
        directions = rays.directions.reshape(-1, 3) / sphere[3]
        length = np.linalg.norm(directions, axis=1)
        middle = -(origins * directions).sum(axis=1) / length**2
        square = middle**2 - ((origins**2).sum(axis=1) - REACH) / length**2
        half = np.sqrt(square.clip(0))
        reach = np.maximum(middle - half, planes[0] - STEP * sphere[3])
        stop = np.minimum(middle + half, planes[1] + STEP * sphere[3])

        count = size[0] * size[1]
        ids, nearest = np.full((count, layers), -1, np.int32), np.zeros((count, layers, 3))
        last, step = np.full(count, -1, np.int32), np.zeros(count)
        scene = pixel_matrix(camera, size), -camera.view[2], facing(camera, cull), proxy.vertices, proxy.faces
        live = np.flatnonzero((square > 0) & (reach < stop))
        while len(live):
            starts = origins[live] + reach[live, None] * directions[live]
            ways = directions[live] / length[live, None]
            hits = self.handle.run(starts.astype(np.float32), ways.astype(np.float32), query="INTERSECT", output=True)
            hit = hits["primID"] >= 0
            live = live[hit]
            depth = reach[live] + hits["tfar"][hit] / length[live]
            args = live, owners[hits["primID"][hit]], size[1], *scene, self._places, *self._around, ids, nearest
            parallel(_take, len(live), *args)
            again = last[live] == hits["primID"][hit]
            last[live] = hits["primID"][hit]
            step[live] = np.where(again, 2 * step[live], STEP / length[live])
            reach[live] = np.maximum(depth, reach[live]) + step[live]
            full = (ids[live, -1] >= 0) & (nearest[live, -1, 0] <= reach[live])
            live = live[~full & (reach[live] < stop[live])]

        def layered(x: np.ndarray, dtype: type) -> np.ndarray:
            return np.ascontiguousarray(np.moveaxis(x, 1, 0).reshape(layers, *size, *x.shape[2:]), dtype)

        return Fragments(
            layered(ids, np.int32), layered(nearest[..., 1:], np.float32), layered(nearest[..., 0], np.float32)
        )


@loop
def _take(
    first, last, pixels, triangles, width, matrix, row, keep, vertices, faces, around, offsets, members, ids, nearest
):  # fmt: skip
    """Test each pixel's candidate triangle, and all triangles around its corners; put hits among the pixel's nearest.

    Only candidates [first, last) are taken. `ids` (pixels, K) and `nearest` (pixels, K, 3), depths and barycentrics,
    change in place.
    """
    layers = ids.shape[1]
    corners = np.empty((3, 4))
    for n in range(first, last):
        pixel = pixels[n]
        x, y = pixel % width + 0.5, pixel // width + 0.5
        for c in range(3):
            v = around[triangles[n], c]
            for m in range(offsets[v], offsets[v + 1]):
                t = members[m]
                inside, _, z, a, b = look(t, x, y, matrix, row, keep, vertices, faces, corners)
                if inside and not holds(ids[pixel], layers, t):
                    _insert(ids[pixel], nearest[pixel], t, z, a, b)


@compiled
def _insert(ids, nearest, t, z, a, b):
    """Insert a hit among a pixel's nearest, by depth, then by triangle; the farthest of more than K drops out."""
    at = layers = len(ids)
    while at > 0 and (ids[at - 1] < 0 or z < nearest[at - 1, 0] or (z == nearest[at - 1, 0] and t < ids[at - 1])):
        at -= 1
    for k in range(layers - 1, at, -1):
        ids[k] = ids[k - 1]
        for i in range(3):
            nearest[k, i] = nearest[k - 1, i]
    if at < layers:
        ids[at] = t
        nearest[at, 0], nearest[at, 1], nearest[at, 2] = z, a, b
