"""Rasterizer for the CPU: the K nearest triangles of each pixel, drawn at once, on all cores (numba).

Most triangles of a large mesh cover no pixel's centre. A first pass (`rts_backends.raster.selection`) reads only
rounded positions of their corners on screen, and lists the triangles that may cover a centre.

A second pass draws the image in bands of rows, each by one thread. For blocks of listed triangles it computes, in
float64 and homogeneous coordinates, the numbers of `rts_backends.triangles`. It finds the pixels that these triangles
cover, and inserts the triangles into the pixels' layers. Those seen from behind come last: most lie behind full layers,
where they are left out before their pixels are looked at. The result depends neither on the number of threads nor on
the order of the list.
"""

from __future__ import annotations

from typing import Any, Self

import numpy as np

from rts import Camera, TriangleSampler
from rts.plugin_api.records import Fragments, Proxy
from rts.plugin_api.threads import parallel, read_only
from rts_backends.raster.drawing import BAND_ROWS, LISTED, draw
from rts_backends.raster.selection import BLOCK, LIMIT, PER_CHUNK, Projected, project, select, sorted_list
from rts_backends.triangles import pixel_matrix


class Raster(TriangleSampler):
    """K-buffer rasterization with a top-left fill rule; of triangles at one depth, the lower index comes first."""

    concurrent = True
    joins_parts = True
    _scratch: tuple[tuple, list[tuple]]

    def __new__(cls, *args: Any, **kwargs: Any) -> Self:
        """Create an instance with an empty store of scratch memory, whatever `__init__` a subclass has."""
        self = super().__new__(cls, *args, **kwargs)
        self._scratch = (), []  # Memory of one size. A thread that draws takes a piece out, so threads never share.
        return self

    def __getstate__(self) -> dict[str, Any]:
        """The state of `TriangleSampler.__getstate__` without scratch memory, of which each copy makes its own."""
        return {name: value for name, value in super().__getstate__().items() if name != "_scratch"}

    def rasterize(self, prepared: Proxy, camera: Camera, size: tuple[int, int], layers: int, cull: str) -> Fragments:
        """See `TriangleSampler.rasterize`.

        Drawn repeatedly, a mesh touches the same pages of memory, which the system clears only once. The memory has
        room for every vertex and triangle, but unused pages are never touched.
        """
        key = len(prepared.vertices), len(prepared.faces)
        scratch = self._scratch
        if scratch[0] != key:
            scratch = self._scratch = key, []
        try:
            memory = scratch[1].pop()
        except IndexError:
            memory = np.empty(key[0], np.int32), np.empty((key[1], LISTED), np.int32)
        fragments = _drawn(prepared, camera, size, layers, camera.kept_sign(cull), *memory)
        scratch[1].append(memory)
        return fragments


def _drawn(
    mesh: Proxy,
    camera: Camera,
    size: tuple[int, int],
    layers: int,
    keep: float,
    screen: np.ndarray,
    rows: np.ndarray,
) -> Fragments:
    """Fragments (layers, H, W) of a mesh.

    Args:
        mesh: the mesh.
        camera: the camera.
        size: (height, width).
        layers: K.
        keep: sign of the determinants of triangles to draw; 0 for both signs.
        screen: (V,) int32, memory for positions on screen.
        rows: (T, LISTED) int32, memory for a list of triangles.
    """
    # With unsigned indices compiled code need not check for negative ones, which count from the end.
    vertices, faces = read_only(mesh.vertices), read_only(mesh.faces, np.int32).view(np.uint32)
    matrix, (height, width) = pixel_matrix(camera, size), size
    used, blocks = -(-len(vertices) // BLOCK), -(-len(faces) // BLOCK)
    step = (max(size) / 2 + 2) / float(LIMIT)
    to_steps = np.diag([1 / step, 1 / step, 1, 1])
    to_steps[:2, 3] = -width / 2 / step, -height / 2 / step
    parallel(project, used, vertices, to_steps @ matrix, screen, work=4 * len(vertices))

    chunks, bands = -(-blocks // PER_CHUNK), -(-height // BAND_ROWS)
    # Threads should not write to neighbouring memory.
    spans, counts = np.empty((chunks, 2), np.int64), np.zeros((chunks, 2 * bands), np.int64)
    numbers = np.float32(step), np.float32(keep), np.float32(camera.kept_sign("back"))
    projected = Projected(faces, vertices, screen, matrix, size, *numbers)
    parallel(select, chunks, projected, (rows, spans, counts), work=10 * len(faces))
    triangles = sorted_list(keep, rows, spans, counts)

    numbers = np.empty((4, layers, height * width), np.float32)  # One array, not three: the system clears fewer pages.
    ids, barycentrics, depth = numbers[0].view(np.int32), numbers[1:3].reshape(layers, -1, 2), numbers[3]
    parallel(draw, bands, triangles, vertices, matrix, -camera.view[2], size, (ids, barycentrics, depth))
    shape = layers, height, width
    return Fragments(ids.reshape(shape), barycentrics.reshape(*shape, 2), depth.reshape(shape))
