"""Ray casting with Embree 4: the structure of a static mesh is built once, and only rays move.

Embree's library is called directly, on shared buffers and from compiled loops on all cores.
"""

from __future__ import annotations

import numpy as np

from rts import Camera, TriangleSampler
from rts.plugin_api.records import Fragments, Proxy
from rts.plugin_api.threads import parallel
from rts_backends.embree.enlarged_triangles import Covers
from rts_backends.embree.library import Scene
from rts_backends.embree.loops import TILE, Eye, Target, cast, keep_nearest_address
from rts_backends.triangles import bounding_sphere, pixel_matrix

REFITS = 32
"""One move of vertices in so many builds the structure anew; the others refit it, which loosens its boxes."""


class Structure:
    """A proxy and Embree's acceleration structure over covers of its triangles, scaled to the unit sphere."""

    def __init__(self, proxy: Proxy):
        self.proxy = _packed(proxy)
        self.sphere = bounding_sphere(self.proxy.vertices, self.proxy.faces)
        self.covers = Covers.of(self.proxy.vertices, self.proxy.faces, self.sphere)
        self.scene = Scene(self.covers.corners, self.covers.faces)
        self.refits = 0

    def move(self, proxy: Proxy) -> bool:
        """Refit to a proxy with the same faces and moved vertices, in place; False if it needs a new structure."""
        proxy = _packed(proxy)
        sphere = bounding_sphere(proxy.vertices, proxy.faces)
        if not self.covers.follow(proxy.vertices, proxy.faces, sphere):
            return False
        self.proxy, self.sphere = proxy, sphere
        self.refits = (self.refits + 1) % REFITS
        self.scene.move(rebuild=self.refits == 0)
        return True


class Embree(TriangleSampler):
    """Sampler that casts rays: K nearest hits a pixel, tested in float64 by the rules of the sampler "raster"."""

    def prepare(self, proxy: Proxy) -> Structure:
        """Build Embree's acceleration structure of a proxy."""
        return Structure(super().prepare(proxy))

    def update(self, prepared: Structure, proxy: Proxy) -> Structure | None:
        """Refit the structure to moved vertices, in place, and return it; None if the proxy must be prepared anew."""
        return prepared if prepared.move(proxy) else None

    def rasterize(
        self, prepared: Structure, camera: Camera, size: tuple[int, int], layers: int, cull: str
    ) -> Fragments:
        """See `TriangleSampler.rasterize`."""
        return _cast(prepared, camera, size, cull, np.empty((0, 2)), (layers, *size))

    def rasterize_points(
        self, prepared: Structure, camera: Camera, size: tuple[int, int], layers: int, cull: str, points: np.ndarray
    ) -> Fragments | None:
        """See `TriangleSampler.rasterize_points`: a ray for each point."""
        if not len(points):
            return None
        return _cast(prepared, camera, size, cull, np.ascontiguousarray(points), (layers, 1, len(points)))


def _cast(
    prepared: Structure, camera: Camera, size: tuple[int, int], cull: str, points: np.ndarray, shape: tuple[int, ...]
) -> Fragments:
    """Fragments of `shape` (K, ·, ·) at `points` (M, 2); at all pixels' centres if there are none."""
    (height, width), count = size, shape[1] * shape[2]
    tiles = -(-len(points) // TILE**2) if len(points) else -(-height // TILE) * -(-width // TILE)
    ids, depth = np.empty((shape[0], count), np.int32), np.empty((shape[0], count), np.float32)
    flat = Fragments(ids, np.empty((shape[0], count, 2), np.float32), depth)
    scene, covers, (vertices, faces, *_) = prepared.scene, prepared.covers, prepared.proxy
    triangles = prepared.sphere, vertices, faces, covers.owners, covers.margins
    target = Target(scene.intersect, keep_nearest_address(), scene.handle, *triangles)
    space = np.concatenate([camera.projection, np.linalg.inv(camera.view)])
    lens = pixel_matrix(camera, size), -camera.view[2], space, _planes(camera.projection)
    parallel(cast, tiles, target, Eye(*lens, camera.kept_sign(cull), size), points, flat)
    return Fragments(ids.reshape(shape), flat.barycentrics.reshape(*shape, 2), depth.reshape(shape))


def _packed(proxy: Proxy) -> Proxy:
    """The proxy with C-contiguous arrays, float32 and int32, as compiled code and Embree read them."""
    vertices = np.ascontiguousarray(proxy.vertices, np.float32)
    return proxy._replace(vertices=vertices, faces=np.ascontiguousarray(proxy.faces, np.int32))


def _planes(p: np.ndarray) -> np.ndarray:
    """(4,) depths: nothing nearer than the first or beyond the second is seen; between the other two no plane clips.

    A slanted plane has no single depth: then every hit is left to the exact test. `p` is the projection.
    """
    if p[2, 0] or p[2, 1] or p[3, 0] or p[3, 1]:
        return np.array([-np.inf, np.inf, np.inf, -np.inf])
    near, far = Camera(np.eye(4), p).depth_range()
    return np.array([near, far, near, far])
