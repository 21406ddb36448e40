"""The triangles of each image, as parts of rts that know the number of the triangle at each sample."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np
import torch

from rts import GBuffer, TriangleSurface
from rts.plugin_api.arrays import Tree
from rts.plugin_api.checks import fingerprint
from rts.plugin_api.operations import interpolate
from rts.plugin_api.records import Proxy, Samples
from rts_nvdiffrast.clip_space import Seen, seen

KEPT = 8
"""Tables of triangles whose topology is kept from call to call."""


class Topology:
    """A table of triangles on the host.

    `antialias_construct_topology_hash` gives it.
    """

    _kept: OrderedDict[Any, Topology] = OrderedDict()

    def __init__(self, faces: np.ndarray):
        self.faces = faces

    @classmethod
    def of(cls, tri: torch.Tensor) -> Topology:
        """The topology of `tri` (T, 3); that of the last few tables is kept."""
        faces = np.array(tri.detach().cpu().numpy(), np.int32)
        key = faces.shape, fingerprint(faces)
        if key not in cls._kept:
            cls._kept[key] = cls(faces)
        cls._kept.move_to_end(key)
        while len(cls._kept) > KEPT:
            cls._kept.popitem(last=False)
        return cls._kept[key]


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
        """Positions, and "triangle" (N, 1), the number of the triangle as a float."""
        vertices: Any = theta["vertices"]
        faces = torch.as_tensor(self.topology.faces, device=vertices.device)
        corners = faces[samples.ids[:, 0].long()]
        gbuffer = GBuffer(position=interpolate(vertices, corners, 0, samples.params))
        gbuffer.defer("triangle", lambda: samples.ids.to(vertices.dtype))
        return gbuffer


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
