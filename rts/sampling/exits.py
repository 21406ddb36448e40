"""Where rays leave the closed parts that they met: what tells splatters how outlines of culled parts move."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rts.camera import Camera
from rts.records import Fragments, Proxy
from rts.sampling.facing import eye
from rts.threads import parallel, read_only


class Exits(NamedTuple):
    """Some cells, and where rays leave the part in them.

    Attributes:
        cells: (1, M) int32, flat indices of cells in the grid.
        fragments: (1, 1, M), what lies behind the front in them.
        there: (1, 1, M) bool, whether the ray leaves there.
    """

    cells: np.ndarray
    fragments: Fragments
    there: np.ndarray


def beside_outlines(kept: np.ndarray) -> np.ndarray:
    """Cells (1, M) int32 of fronts that may end beside them, and of fronts beside those, as flat indices.

    Fronts end before nothing, and where hidden layers are in play.

    Args:
        kept: (K, H, W) bool, the samples that splatters need.
    """
    from rts.sampling import exits_kernels

    _, height, width = kept.shape
    kept, counts = np.ascontiguousarray(kept), np.empty(height, np.int64)
    marks = np.empty((2, height, width), np.uint8)
    parallel(exits_kernels.find, height, kept, marks[0], work=kept.size)
    parallel(exits_kernels.widen, height, kept[0], *marks, counts, work=kept[0].size)
    cells, offsets = np.empty((1, counts.sum()), np.int32), np.cumsum(counts) - counts
    parallel(exits_kernels.gather, height, marks[1], offsets, cells[0], work=kept[0].size)
    return cells


def exits(cells: np.ndarray, front: np.ndarray, both: Fragments, proxy: Proxy, camera: Camera) -> Exits:
    """The exits among what lies behind fronts.

    Args:
        cells: (1, M) int32, flat indices of cells in the grid.
        front: (H, W) int32, the triangle in front in each cell.
        both: (2, 1, M), the two nearest triangles of these cells, whichever side they show.
        proxy: the triangles.
        camera: host matrices.
    """
    from rts.sampling import exits_kernels

    there = np.empty(cells.shape[1], bool)
    triangles = read_only(proxy.vertices), read_only(proxy.faces, np.int32), eye(camera)
    ids = np.ascontiguousarray(both.triangle_ids).reshape(2, -1)
    exits_kernels.choose(cells[0], front.reshape(-1), ids, *triangles, there)
    return Exits(cells, Fragments(*(x[1:] for x in both)), there[None, None])
