"""Parts of triangles as one table, so that samples and outlines of all are found at once.

Each part has samples of its own, behind one another: the table says which part a triangle belongs to. A part costs a
transform of its vertices, into the camera's space, and a call of its shader; those of few triangles that are culled
alike share a pass over the image, too.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from rts.compiling.threads import parallel, read_only
from rts.contracts.checked_parts import CheckedPart
from rts.contracts.records import Cells, Fragments, Proxy, Sampled, Samples
from rts.sampling.sample_checks import check_fragments
from rts.sampling.scene import Grid, Scene
from rts.sampling.triangle_sampler import TriangleSampler, is_drawn, rasterized
from rts.scene.camera import Camera

MOST = 2**15
"""Triangles of a part that is drawn along with others: a larger one takes longer to prepare than a pass over the image.
"""


class Draw(NamedTuple):
    """The triangles that a sampler draws in one pass.

    Attributes:
        sampler: the sampler.
        prepared: what it has prepared of the triangles.
        camera: float64 matrices on the host, in the space of the triangles.
        cull: of the triangles.
        triangles: (T,) int32, their indices in the table of all; None where these are all, in order.
    """

    sampler: TriangleSampler
    prepared: Any
    camera: Camera
    cull: str
    triangles: np.ndarray | None


@dataclass(frozen=True)
class Joint:
    """The triangles of all parts of a scene.

    Attributes:
        parts: the parts.
        starts: (P + 1,) int32, where the triangles of each part begin.
        proxies: those of the parts, in their local spaces.
        proxy: all triangles, in the space of `camera`; its `ids` and `corner_params` are those of the parts, in tables
            as wide as the widest.
        camera: float64 matrices on the host.
        signs: (T,) int8, `Camera.kept_sign` of triangles.
        draws: the passes in which they are drawn.
    """

    parts: Sequence[CheckedPart]
    starts: np.ndarray
    proxies: Sequence[Proxy]
    proxy: Proxy
    camera: Camera
    signs: np.ndarray
    draws: Sequence[Draw]

    @classmethod
    def of(cls, scene: Scene, grid: Grid) -> Joint:
        """The parts of a scene on the host, all of which are suited."""
        proxies = [entry.proxy for entry in scene.entries]
        cameras = [proxy.seen_by(scene.local_camera(i, grid)) for i, proxy in enumerate(proxies)]
        vertices, camera = [proxy.vertices for proxy in proxies], cameras[0]
        if not all(np.array_equal(other.view, camera.view) for other in cameras[1:]):
            camera = Camera(np.eye(4), camera.projection)
            vertices = [_moved(x, other.view) for x, other in zip(vertices, cameras, strict=True)]
        return cls.seen_from(camera, scene, proxies, vertices, cameras)

    @classmethod
    def seen_from(
        cls,
        camera: Camera,
        scene: Scene,
        proxies: Sequence[Proxy],
        vertices: Sequence[np.ndarray],
        cameras: Sequence[Camera],
    ) -> Joint:
        """The parts of a scene, given where their vertices are in the space of a camera.

        Args:
            camera: the camera.
            scene: the scene.
            proxies: of its parts.
            vertices: for each part (V, 3).
            cameras: the camera in the space of each proxy.
        """
        sizes = [len(proxy.faces) for proxy in proxies]
        starts = np.array([0, *itertools.accumulate(sizes)], np.int32)
        kept = [seen.kept_sign(part.cull) for part, seen in zip(scene.parts, cameras, strict=True)]
        same = len(proxies) == 1 and vertices[0] is proxies[0].vertices  # Nothing moves, and nothing is copied.
        proxy = proxies[0]._replace(ids=_ids(proxies[0])) if same else _in_one(proxies, vertices)
        signs = np.array(kept, np.int8).repeat(sizes)
        groups: dict[Any, list[int]] = {}
        for i, part in enumerate(scene.parts):
            alone = sizes[i] > MOST or not joins(scene.samplers[i]) or kept[i] != camera.kept_sign(part.cull)
            if sizes[i]:
                groups.setdefault(i if alone else (part.cull, id(scene.samplers[i])), []).append(i)
        draws = []
        for group in groups.values():
            first, cull, whole = group[0], scene.parts[group[0]].cull, len(group) == sum(map(bool, sizes))
            sampler, own = scene.samplers[first], (cameras[first], scene.entries[first].prepared)
            assert isinstance(sampler, TriangleSampler)
            if len(group) > 1 or own[1] is None:
                several = proxy if whole else _in_one([proxies[i] for i in group], [vertices[i] for i in group])
                own = camera, sampler.prepare(several)
            triangles = [np.arange(starts[i], starts[i + 1], dtype=np.int32) for i in group]
            draws.append(Draw(sampler, own[1], own[0], cull, None if whole else np.concatenate(triangles)))
        return cls(scene.parts, starts, proxies, proxy, camera, signs, draws)

    def drawn(self, size: tuple[int, int], layers: int) -> Fragments:
        """The fragments (K, H, W) at the centres of cells, whose triangles are counted over the parts."""
        passes, shape = [], (layers, *size)
        for sampler, prepared, camera, cull, triangles in self.draws:
            count = len(self.proxy.faces) if triangles is None else len(triangles)
            fragments = rasterized(sampler, prepared, camera, size, layers, cull)
            check_fragments(fragments, shape, count, sampler)
            ids, shares, depth = (read_only(x, y) for x, y in zip(fragments, _DTYPES, strict=True))
            if triangles is not None:  # −1 takes the last.
                ids = read_only(np.append(triangles, np.int32(-1)).take(ids))
            passes.append(Fragments(ids, shares, depth))
        if len(passes) == 1:
            return passes[0]
        from rts.sampling import merging_loops

        merged = Fragments(np.full(shape, -1, np.int32), np.zeros((*shape, 2), np.float32), np.zeros(shape, np.float32))
        for fragments in passes:
            parallel(merging_loops.insert_fragments, size[0], *fragments, *merged, work=5 * merged.depth.size)
        return merged

    def of_parts(self, counts: np.ndarray, ids: np.ndarray, params: np.ndarray, cells: Cells) -> Sampled:
        """The samples of a table, part after part, of which those with a count (P,) of 0 have one unused row.

        A single part has the cells of the image; several have a cell for each row.
        """
        samples, none, stop = [], np.zeros((), np.int32), 0
        for part, proxy, count in zip(self.parts, self.proxies, counts.tolist(), strict=True):
            start, stop = stop, stop + max(count, 1)
            if len(counts) == 1:
                own = Cells(cells.row, cells.depth)
            else:
                own = Cells(np.arange(stop - start, dtype=np.int32)[None, None] - np.int32(not count))
            i, p = _ids(proxy).shape[1], 2 if proxy.corner_params is None else proxy.corner_params.shape[2]
            own_ids, own_params = (np.ascontiguousarray(x[start:stop, :n]) for x, n in ((ids, i), (params, p)))
            samples.append(Samples(own_ids, own_params, own, none, gbuffer_names=part.reads))
        return Sampled(tuple(samples), cells, none)


_DTYPES = np.int32, np.float32, np.float32


def _ids(proxy: Proxy) -> np.ndarray:
    """The ids (T, I) of a proxy's triangles."""
    return proxy.faces if proxy.ids is None else proxy.ids


def _in_one(proxies: Sequence[Proxy], vertices: Sequence[np.ndarray]) -> Proxy:
    """Several proxies as one, whose vertices are given; tables are as wide as the widest, filled up with 0."""
    from rts.sampling.packing_loops import in_one

    shifts, params = [0, *itertools.accumulate(map(len, vertices))][:-1], None
    faces = in_one([proxy.faces for proxy in proxies], shifts)
    if any(proxy.corner_params is not None for proxy in proxies):
        params = _wide(
            [
                _BARYCENTRICS.repeat(len(proxy.faces), 0) if proxy.corner_params is None else proxy.corner_params
                for proxy in proxies
            ]
        )
    return Proxy(np.concatenate(vertices), faces, _wide([_ids(proxy) for proxy in proxies]), params)


_BARYCENTRICS = np.array([[[1, 0], [0, 1], [0, 0]]], np.float32)
"""The parameters of corners that are interpolated to the first two barycentrics."""


def _wide(tables: Sequence[np.ndarray]) -> np.ndarray:
    """Several tables (N, ..., Q) as one, as wide as the widest."""
    most = max(x.shape[-1] for x in tables)
    return np.concatenate(
        [x if x.shape[-1] == most else np.pad(x, [*[(0, 0)] * (x.ndim - 1), (0, most - x.shape[-1])]) for x in tables]
    )


def is_suited(part: CheckedPart, sampler: Any) -> bool:
    """True if a part can be sampled along with others."""
    surface: Any = part.surface
    drawn = is_drawn(type(surface), type(sampler))
    return drawn and surface.centered and not surface.refines and not surface.depends_on_view


def joins(sampler: object) -> bool:
    """True if a sampler of triangles draws those of several parts in one pass."""
    return isinstance(sampler, TriangleSampler) and sampler.joins_parts and sampler.concurrent


def _moved(vertices: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    """Vertices (V, 3), moved by a matrix (4, 4), float64."""
    return vertices @ matrix[:3, :3].T + matrix[:3, 3]
