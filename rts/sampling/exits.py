"""Exits: points where rays leave a closed part. They tell splatters how outlines of culled parts move."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rts.compiling.threads import parallel, read_only
from rts.contracts.records import Fragments


class Exits(NamedTuple):
    """The exits of rays through some cells.

    Attributes:
        cells: (1, M) int32, flat indices of cells in the grid.
        fragments: (1, 1, M), triangles seen from behind in these cells.
        there: (1, 1, M) bool, True where the ray leaves the part.
    """

    cells: np.ndarray
    fragments: Fragments
    there: np.ndarray

    @classmethod
    def of(cls, fragments: Fragments, cells: np.ndarray, backs: Fragments) -> Exits:
        """The exits among `backs` (1, 1, M), triangles seen from behind: those not nearer than their cell's front."""
        front = fragments.depth[0].reshape(-1)[cells]
        return cls(cells, backs, (backs.triangle_ids >= 0) & (backs.depth >= front))


def outline_cells(covered: np.ndarray, depth: np.ndarray) -> np.ndarray:
    """Covered cells (M,) int32 whose front ends towards a neighbour, by depths alone, as flat indices.

    A front ends towards an empty cell, and where it does not pair with the neighbour's front: where a hidden layer of
    one is nearer to the front of the other.

    Args:
        covered: (K, H, W) bool.
        depth: (K, H, W), depths of the samples; anything where nothing is covered.
    """
    from rts.sampling import exits_loops

    marks = np.zeros(covered.shape[1:], np.bool_)
    arguments = read_only(covered), read_only(depth), marks
    parallel(exits_loops.mark_ends, len(marks), *arguments, work=20 * covered.size)
    return np.flatnonzero(marks).astype(np.int32)


def beside_outlines(kept: np.ndarray) -> np.ndarray:
    """Cells (1, M) int32 whose front may end towards a neighbour, and covered cells beside these, as flat indices.

    A front may end where the 3 × 3 cells around it include an empty cell or a kept hidden sample.

    Args:
        kept: (K, H, W) bool, the samples that splatters need.
    """
    from rts.sampling import exits_loops

    cells = np.empty(kept[0].size, np.int32)
    count = exits_loops.find(read_only(kept), cells)
    return cells[None, :count]
