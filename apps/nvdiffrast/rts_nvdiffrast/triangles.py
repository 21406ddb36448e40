"""The triangles of each image, as parts of rts that know the number of the triangle at each sample."""

from __future__ import annotations

import functools
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np
import torch

from rts import GBuffer, TriangleSurface
from rts.plugin_api.arrays import Tree
from rts.plugin_api.operations import interpolate
from rts.plugin_api.records import Proxy, Samples
from rts_nvdiffrast.clip_space import Seen, seen


class Topology:
    """A table of triangles on the host.

    `antialias_construct_topology_hash` gives it.
    """

    def __init__(self, faces: np.ndarray):
        self.faces = faces

    @staticmethod
    def of(tri: torch.Tensor) -> Topology:
        """The topology of `tri` (T, 3); of the last few tables it is kept."""
        return _topology(tri.detach().cpu().numpy().astype(np.int32, copy=False).tobytes())

    @functools.cached_property
    def beyond(self) -> np.ndarray:
        """(T, 3) int32: the triangle beyond the edge opposite each corner; −1 for none, or several."""
        edges = np.sort(self.faces[:, [[1, 2], [2, 0], [0, 1]]].reshape(-1, 2), axis=1)
        order = np.lexsort((edges[:, 1], edges[:, 0]))
        alike = np.append((edges[order[1:]] == edges[order[:-1]]).all(1), False)
        pairs = np.flatnonzero(alike & ~np.roll(alike, 1) & ~np.roll(alike, -1))
        found = np.full(3 * len(self.faces), -1, np.int32)
        found[order[pairs]], found[order[pairs + 1]] = order[pairs + 1] // 3, order[pairs] // 3
        return found.reshape(-1, 3)


@functools.lru_cache(maxsize=8)
def _topology(table: bytes) -> Topology:
    return Topology(np.frombuffer(table, np.int32).reshape(-1, 3))


class Triangles(TriangleSurface):
    """Some triangles of a table; θ["vertices"] (V, 3). A sample is a triangle's number and two barycentrics.

    Args:
        topology: the table.
        kept: the numbers of the triangles, integers; None for all.
    """

    sample_widths = (1, 2)
    proxy_is_cheap = True

    def __init__(self, topology: Topology, kept: np.ndarray | None = None):
        self.topology = topology
        count = len(topology.faces)
        self._ids = np.arange(count, dtype=np.int32) if kept is None else np.asarray(kept, np.int32)
        self._all = kept is None
        self.face_count = len(self._ids)

    def proxy_inputs(self, theta: Mapping[str, Tree]) -> Any:
        """The vertices."""
        return theta["vertices"]

    def proxy(self, inputs: Any, camera: Any, size: tuple[int, int]) -> Proxy:
        """The triangles, each with its number."""
        faces = self.topology.faces if self._all else self.topology.faces[self._ids]
        return Proxy(np.ascontiguousarray(inputs, np.float32), faces, self._ids[:, None])

    def evaluate(self, theta: Mapping[str, Tree], samples: Samples) -> GBuffer:
        """Positions."""
        vertices: Any = theta["vertices"]
        faces = torch.as_tensor(self.topology.faces, device=vertices.device)
        corners = faces[samples.ids[:, 0].long()]
        return GBuffer(position=interpolate(vertices, corners, 0, samples.params))


class Image(NamedTuple):
    """The geometry of one image of a batch.

    Attributes:
        surface: its triangles.
        seen: its vertices and camera.
    """

    surface: Triangles
    seen: Seen


def images(pos: torch.Tensor, topology: Topology, ranges: np.ndarray | None) -> Iterator[Image]:
    """The geometry of each image, from `pos` (B, V, 4), or (V, 4) with `ranges` (B, 2) into the triangles."""
    everything = np.arange(len(topology.faces))
    for b in range(len(pos) if ranges is None else len(ranges)):
        kept = None if ranges is None else everything[ranges[b, 0] : ranges[b, 0] + ranges[b, 1]]
        faces = topology.faces if kept is None else topology.faces[kept]
        own = seen(pos[b] if ranges is None else pos, faces)
        if own.behind is not None:
            kept = everything if kept is None else kept
            kept = kept[~own.behind[topology.faces[kept]].any(axis=1)]
        yield Image(Triangles(topology, kept), own)
