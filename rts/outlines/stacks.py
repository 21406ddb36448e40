"""Crossings between stacks of layers that let light through: where a layer that is seen ends, or two intersect.

As `rts.outlines.spans`, of all layers that are seen in place of the first hits alone. Each change of the stack along a
gap is a crossing of its own, which moves with the one layer that ends there, or with the two that intersect.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rts.compiling.threads import parallel, read_only
from rts.outlines import spans_loops
from rts.outlines import stacks_loops as loops
from rts.outlines.gaps import Crossings, Gaps, Hits, Stacks
from rts.outlines.seen_mesh import SeenMesh
from rts.outlines.spans import moving_edges, spans_on
from rts.outlines.tolerances import BESIDE

ROOM = 2
"""Changes for each span, for which there is room at first: it starts and ends. More are found where many intersect."""


def crossings_of_stacks(
    layers: Hits, opaque: np.ndarray, meshes: Sequence[SeenMesh], width: np.ndarray, seams: bool
) -> tuple[Crossings, Stacks]:
    """The crossings between the stacks at the centres of all cells, and the layers there.

    Args:
        layers: what is seen at centres, arrays (K, H, W), read-only, front to back; nothing behind an opaque layer.
        opaque: (P,) bool, the parts that let no light through.
        meshes: the triangles of all parts.
        width: the width of a cell at a depth: `width[0] + width[1] * depth`.
        seams: as of `crossings_of_triangles`; at each there are two crossings in one place.
    """
    marks, joined = _gaps_to_search(layers, opaque, meshes, width)
    gaps = Gaps.of(marks)
    whole, place, samples, places, sides = _changes(gaps, layers, opaque, meshes, seams)
    gap, kind = gaps.gap[whole[:, 0]], whole[:, 1].copy()
    joined[1 - gap[:, 2], gap[:, 0], gap[:, 1]] = False
    along, first = np.column_stack([gap[:, 2], 1 - gap[:, 2]]), gap[:, 1::-1] + 0.5
    at = first + place[:, None] * along
    points = np.stack([first[:, k : k + 1] + places * along[:, k : k + 1] for k in (0, 1)], axis=-1)
    last, stack = samples[:, :2], samples[:, 2:]
    ended = last[..., 0].copy(), last[..., 1].copy()
    slope, tangent, away = moving_edges(kind, *ended, at, meshes, width)
    triangles = np.concatenate([last[..., 1], last[..., 1]], 1)
    ends, last_points = whole[:, 4:] == 1, points[:, :2]
    samples_of = last_points, last_points, whole[:, 2:4], joined, triangles
    crossings = Crossings(gap, at, kind, slope, ends, *samples_of, tangent, away)
    numbers = np.zeros(samples.shape[:2], np.int32)
    return crossings, Stacks(last[..., 0], stack[..., 0], stack[..., 1], points[:, 2:], sides, numbers)


def _gaps_to_search(
    layers: Hits, opaque: np.ndarray, meshes: Sequence[SeenMesh], width: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Marks (2, H, W) of the gaps in which a layer may change: a silhouette meets them, or no patch joins a layer.

    And of those with the same parts, which are some, at both centres.
    """
    count, *size = layers.part.shape
    ends = Hits(np.full(size, -1, np.int32), np.full(size, -1, np.int32), np.zeros(size))
    for part, _, depth in zip(*layers, strict=True) if opaque.any() else ():
        solid = (part >= 0) & opaque[part]
        ends.part[solid], ends.depth[solid] = part[solid], depth[solid]
    met, joined = np.zeros((2, *size), np.uint8), np.zeros((2, count * size[0], size[1]), np.bool_)
    ends = Hits(*map(read_only, ends))
    for mesh in meshes:
        mesh.mark_silhouettes(ends, width, met)
    below = Hits(*(x.reshape(-1, size[1]) for x in layers))  # One layer after the other.
    for mesh in meshes:
        mesh.join(below, met, joined, colors=True)
    marks, same = np.empty(met.shape, np.bool_), np.empty(met.shape, np.bool_)
    parallel(spans_loops.wanted, size[0], layers.part, joined, met, marks, same, work=2 * layers.part.size)
    return marks, same


def _changes(
    gaps: Gaps, layers: Hits, opaque: np.ndarray, meshes: Sequence[SeenMesh], seams: bool
) -> tuple[np.ndarray, ...]:
    """The changes of stacks along gaps; see `stacks_loops.changes`."""
    gap, count, most = gaps.gap, len(gaps.gap), len(layers.part)
    begins, names, spans, parts = spans_on(gaps, meshes, seams)
    rows, counts, size = np.empty(count, np.int64), np.empty(count, np.int32), most + 3
    room = ROOM * (begins + 2 * np.arange(count + 1))
    while True:
        total = int(room[-1])
        numbers = np.empty(total), np.empty((total, size, 2), np.int32), np.empty((total, size))
        found = np.empty((total, 6), np.int32), *numbers, np.empty((total, 2, most), np.int32)
        known = gap, begins, spans, names, parts, opaque, *layers[::2], room, rows, counts
        parallel(loops.changes, count, *known, BESIDE, *found, work=600 * count)
        if not (rows < 0).any():
            break
        room = np.append(0, np.cumsum(counts))  # Many surfaces pass through one another.
    at = np.repeat(rows - np.cumsum(counts) + counts, counts) + np.arange(counts.sum())
    return tuple(x.take(at, 0) for x in found)
