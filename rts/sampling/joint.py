"""Parts of triangles as one table, so that a sampler draws all at once: a single part, or neighbours of few triangles.

Each part has samples of its own, behind one another: the table says which part a triangle belongs to. A neighbour costs
a transform of its vertices, into the camera's space, and a call of its shader, but no pass over the image.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from operator import attrgetter
from typing import Any

import numpy as np

from rts.contracts.checked_parts import CheckedPart
from rts.contracts.records import Cells, Fragments, Proxy, Sampled, Samples
from rts.sampling.sample_checks import check_fragments
from rts.sampling.scene import Grid, Scene, has_sheets
from rts.sampling.triangle_sampler import TriangleSampler, is_drawn
from rts.scene.camera import Camera

_VERTICES = attrgetter("vertices")

MOST = 2**15
"""Triangles of a part that is joined to others: moving the vertices of a larger one costs more than a pass over the
image."""


@dataclass(frozen=True)
class Joint:
    """The triangles of neighbouring parts.

    Attributes:
        scene: the scene.
        first: the index of the first part.
        starts: (P + 1,) int32, where the triangles of each part begin.
        proxies: those of the parts, in their local spaces.
        proxy: all triangles, in the space of `camera`; its `ids` are those of the parts.
        camera: float64 matrices on the host.
        cull: of all parts.
        sampler: of all parts.
        prepared: the result of its `prepare` for all triangles.
    """

    scene: Scene
    first: int
    starts: np.ndarray
    proxies: Sequence[Proxy]
    proxy: Proxy
    camera: Camera
    cull: str
    sampler: TriangleSampler
    prepared: Any

    @property
    def parts(self) -> Sequence[CheckedPart]:
        """The parts."""
        return self.scene.parts[self.first : self.stop]

    @property
    def stop(self) -> int:
        """The index after that of the last part."""
        return self.first + len(self.proxies)

    @classmethod
    def of(cls, scene: Scene, first: int, proxies: Sequence[Proxy], cameras: Sequence[Camera]) -> Joint:
        """Join the parts from `first` on, given their proxies and the camera in the space of each, `Proxy.seen_by`."""
        vertices, camera = list(map(_VERTICES, proxies)), cameras[0]
        if len(cameras) > 1 and not all(np.array_equal(other.view, camera.view) for other in cameras[1:]):
            vertices = [_moved(x, other.view) for x, other in zip(vertices, cameras, strict=True)]
            camera = Camera(np.eye(4), camera.projection)
        return cls.seen_from(camera, scene, first, proxies, vertices)

    @classmethod
    def seen_from(
        cls, camera: Camera, scene: Scene, first: int, proxies: Sequence[Proxy], vertices: Sequence[np.ndarray]
    ) -> Joint:
        """Join the parts from `first` on, given their proxies and where their vertices are in the space of a camera."""
        starts, ids = [0], []
        for proxy in proxies:
            starts.append(starts[-1] + len(proxy.faces))
            ids.append(proxy.faces if proxy.ids is None else proxy.ids)
        sampler: Any = scene.samplers[first]
        proxy = proxies[0]
        if len(proxies) == 1 and vertices[0] is proxy.vertices:  # Nothing moves, and nothing is copied.
            proxy = proxy._replace(ids=ids[0]) if proxy.ids is None else proxy
            prepared = scene.entries[first].prepared
        else:
            shifts = np.cumsum([0, *map(len, vertices)], dtype=np.int32)
            faces = np.concatenate([proxy.faces + shift for proxy, shift in zip(proxies, shifts, strict=False)])
            params = [proxy.corner_params for proxy in proxies if proxy.corner_params is not None]
            tables = np.concatenate(vertices), faces, np.concatenate(ids), np.concatenate(params) if params else None
            proxy = Proxy(*tables)
            prepared = sampler.prepare(proxy)
        cull, starts = scene.parts[first].cull, np.array(starts, np.int32)
        return cls(scene, first, starts, proxies, proxy, camera, cull, sampler, prepared)

    def sampled(self, size: tuple[int, int], layers: int, triangles: bool, uniform: bool = False) -> Sampled:
        """The samples at the centres of all cells; with `uniform` one sample stands for all cells of a part.

        With `triangles` there are `Cells.triangle`, which count triangles over the parts.
        """
        grid = layers, *size
        fragments = self.sampler.rasterize(self.prepared, self.camera, size, layers, self.cull)
        covered = check_fragments(fragments, grid, len(self.proxy.faces), self.sampler)
        sampled = self._of_one_row_each(fragments, covered) if uniform else self.lifted(fragments, covered)
        return sampled if triangles else replace(sampled, cells=replace(sampled.cells, triangle=None))

    def lifted(self, fragments: Fragments, covered: np.ndarray | None = None) -> Sampled:
        """The samples of fragments (K, H, W), whose triangles are counted over the parts.

        Args:
            fragments: on the host.
            covered: (K, H, W) bool, the cells in which there is one; None for all.
        """
        from rts.sampling import packing_loops

        ids, proxy = fragments.triangle_ids, self.proxy
        covered = ids >= 0 if covered is None else covered
        assert proxy.ids is not None
        counts, ids_of_parts, params, row, depth = packing_loops.pack(
            fragments, covered, proxy.ids, proxy.corner_params, starts=self.starts
        )
        return self._of_parts(counts, ids_of_parts, params, Cells(row, depth, ids))

    def _of_one_row_each(self, fragments: Fragments, covered: np.ndarray) -> Sampled:
        """Samples of fragments (K, H, W) of which one, at the first of its cells, stands for all cells of a part."""
        from rts.sampling import packing_loops

        row, first = packing_loops.parts_of(fragments.triangle_ids, covered, self.starts)
        table, seen = self.proxy, first[first >= 0]
        assert table.ids is not None
        one = Fragments(*[x.reshape(1, 1, row.size, *x.shape[3:])[:, :, seen] for x in fragments])
        known = np.ones((1, 1, len(seen)), np.bool_), table.ids, table.corner_params
        counts, ids, params, *_ = packing_loops.pack(one, *known, starts=self.starts)
        depth = np.where(covered, fragments.depth, np.float32(0))
        return self._of_parts(counts, ids, params, Cells(row, depth, fragments.triangle_ids))

    def _of_parts(self, counts: np.ndarray, ids: np.ndarray, params: np.ndarray, cells: Cells) -> Sampled:
        """The samples of a table, part after part, of which those with a count (P,) of 0 have one unused row.

        A single part has the cells of the image; several have a cell for each row.
        """
        samples, none, stop, whole = [], np.asarray(0, np.int32), 0, Cells(cells.row, cells.depth)
        for part, count in zip(self.parts, counts.tolist(), strict=True):
            start, stop = stop, stop + max(count, 1)
            used = np.arange(stop - start, dtype=np.int32)[None, None] - np.int32(not count)
            own = whole if len(counts) == 1 else Cells(used)
            samples.append(Samples(ids[start:stop], params[start:stop], own, none, gbuffer_names=part.reads))
        return Sampled(tuple(samples), cells, none)


def with_joints(scene: Scene, grid: Grid) -> Scene:
    """A scene on the host with its `joints`: single parts, and neighbours that can be sampled at once.

    These are parts of meshes and other triangles that are no approximation, of one sampler that `joins_parts`.
    """
    suited = list(map(is_suited, scene.parts, scene.samplers))
    if not all(suited) and not (any(suited) and all(map(has_sheets, scene.parts, scene.samplers))):
        return scene
    joints = []
    runs = itertools.groupby(range(len(scene.parts)), lambda i: (suited[i], scene.parts[i].cull, id(scene.samplers[i])))
    for (suits, *_), run in runs:
        if suits:
            joints += _joined(scene, grid, list(run))
    return Scene(*scene[:6], tuple(joints))


def _joined(scene: Scene, grid: Grid, indices: Sequence[int]) -> Iterator[Joint]:
    """Joints of some neighbouring parts: of few triangles, alike in their tables, and not both culled and mirrored.

    Others, but for those without triangles, are joints of their own.
    """
    proxies, cameras = {}, {}
    for index in indices:
        proxies[index] = scene.entries[index].proxy
        cameras[index] = proxies[index].seen_by(scene.local_camera(index, grid))

    def kind(index: int) -> tuple:
        proxy = proxies[index]
        mirrored = scene.parts[index].cull == "back" and np.linalg.det(cameras[index].view[:3, :3]) < 0
        tables = (None if x is None else x.shape[1:] for x in (proxy.ids, proxy.corner_params))
        return 0 < len(proxy.faces) <= MOST and not mirrored, *tables

    groups = [((False,), indices)] if len(indices) == 1 else itertools.groupby(indices, kind)
    for (joins, *_), run in groups:
        numbers = list(run)
        for several in [numbers] if joins else [[number] for number in numbers if len(proxies[number].faces)]:
            yield Joint.of(
                scene, several[0], list(map(proxies.__getitem__, several)), list(map(cameras.__getitem__, several))
            )


def is_suited(part: CheckedPart, sampler: Any) -> bool:
    """True if a part can be sampled along with others."""
    surface: Any = part.surface
    if not (is_drawn(type(surface), type(sampler)) and sampler.joins_parts and sampler.concurrent):
        return False
    return surface.centered and not surface.refines and not surface.depends_on_view


def _moved(vertices: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    """Vertices (V, 3), moved by a matrix (4, 4), float64."""
    return vertices @ matrix[:3, :3].T + matrix[:3, 3]
