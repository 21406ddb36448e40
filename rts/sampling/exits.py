"""Exits: points where rays leave a closed part. They tell splatters how outlines of culled parts move."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from rts.arrays.trees import Tree
from rts.compiling.threads import parallel, read_only
from rts.contracts.records import ArraySpec, Fragments, Samples
from rts.contracts.surface import TriangleSurface
from rts.scene.rays import Rays

NEIGHBOURS = [(u, v) for v in (-1, 0, 1) for u in (-1, 0, 1) if (u, v) != (0, 0)]
"""Steps (x, y) from a cell to those around it, line by line."""


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


def outline_cells(
    covered: np.ndarray, depth: np.ndarray, cells: np.ndarray | None = None, size: tuple[int, int] = (0, 0)
) -> np.ndarray:
    """Covered cells (M,) int32 whose front ends towards a neighbour, by depths alone, as flat indices.

    A front ends towards an empty cell, and where it does not pair with the neighbour's front: where a hidden layer of
    one is nearer to the front of the other.

    Args:
        covered: (K, H, W) bool; or (K, L, C) for listed cells, and then results are flat indices in this list.
        depth: depths of the samples, of the same shape; anything where nothing is covered.
        cells: (L, C), the listed cells, as flat indices in the grid, −1 for none; None for all. Others count as empty.
        size: (height, width) of the grid, for listed cells.
    """
    return outline_ends(covered, depth, cells, size)[0]


def outline_ends(
    covered: np.ndarray, depth: np.ndarray, cells: np.ndarray | None, size: tuple[int, int]
) -> tuple[np.ndarray, np.ndarray]:
    """The cells (M,) of `outline_cells`, and bits (M,) uint8 of the neighbours of each towards which its front ends.

    Bit i stands for the i-th of `NEIGHBOURS`.
    """
    from rts.sampling import exits_loops

    if cells is not None and cells.ndim == 3:
        # Points are all at outlines; on which side these are is unknown.
        there = np.flatnonzero(covered[0]).astype(np.int32)
        return there, np.full(len(there), 255, np.uint8)
    if cells is not None:
        listed, layers = np.flatnonzero(cells >= 0), len(covered)
        own = cells.reshape(-1)[listed]
        whole, deep = (np.zeros((layers, size[0] * size[1]), x.dtype) for x in (covered, depth))
        whole[:, own], deep[:, own] = (x.reshape(layers, -1)[:, listed] for x in (covered, depth))
        bits = np.zeros(size[0] * size[1], np.uint8)
        marked, ends = outline_ends(whole.reshape(layers, *size), deep.reshape(layers, *size), None, size)
        bits[marked] = ends
        there = bits[own] > 0
        return listed[there].astype(np.int32), bits[own][there]
    near = beside_outlines(covered)[0]
    ends = np.empty(len(near), np.uint8)
    parallel(exits_loops.mark_ends, len(near), near, read_only(covered), read_only(depth), ends, work=80 * len(near))
    return near[ends > 0], ends[ends > 0]


def with_pairs(
    samples: Samples,
    surface: TriangleSurface,
    inputs: Tree,
    rays: Rays,
    steps: Rays,
    listed: np.ndarray | None,
    size: tuple[int, int],
    specs: Mapping[str, ArraySpec],
) -> tuple[Samples, tuple[np.ndarray, np.ndarray] | None]:
    """Samples whose `exit` (2, H, W) names the pairs of a surface's `refine_outlines`, which have no rows yet.

    Until `repack` gives them rows, `exit` holds indices of the returned ids and params, −1 in cells without a pair.

    Args:
        samples: refined samples on the host, a row for each covered cell.
        surface: the surface.
        inputs: the result of its `proxy_inputs`, on the host.
        rays: the rays of the samples' rows.
        steps: (2, 3), changes of rays from a cell to the next one, along x and along y; see `layer_order.steps_of`.
        listed: (L, C), the cells of the samples; or points (L, C, 2), all at outlines; None for all cells. See
            `outline_cells`.
        size: (height, width) of the grid.
        specs: the result of the surface's `table_specs`.

    Returns:
        The samples, and ids (2 M, I) and params (2 M, P) of the pairs, as `repack` takes them. None in place of ids and
        params if no cell is at an outline, the surface has no pairs, or its tables exceed their specs.
    """
    exits = np.full((2, *samples.row.shape[1:]), -1, np.int32)
    cells, ends = outline_ends(samples.row >= 0, samples.depth, listed, size)
    fronts = samples.row[0].reshape(-1)[cells]
    own = Rays(rays.origins[fronts], rays.directions[fronts], rays.spread)
    changed = [_beside(x, step, ends) for x, step in zip(own[:2], steps[:2], strict=True)]
    beside = Rays(changed[0], changed[1], rays.spread)
    depth = samples.depth[0].reshape(-1)[cells]
    result = surface.refine_outlines(inputs, own, beside, depth, samples.tables) if len(cells) else None
    if result is None or any(len(x) > specs[name].shape[0] for name, x in result[3].items()):
        return samples.replace(exit=exits), None
    ids, params, there, tables = result
    count = 2 * np.count_nonzero(there)
    exits.reshape(2, -1)[:, cells[there]] = np.arange(count, dtype=np.int32).reshape(-1, 2).T
    ids, params = (x[there].reshape(count, x.shape[2]) for x in (ids, params))
    return samples.replace(exit=exits, tables=tables), (ids, params)


def _beside(own: np.ndarray, step: np.ndarray, ends: np.ndarray) -> np.ndarray:
    """Vectors (M, 8, 3) of the neighbours towards which fronts end, NaN for others, from those of the cells (M, 3)."""
    changes = np.where((ends[:, None] >> np.arange(8) & 1)[..., None], np.array(NEIGHBOURS) @ step, np.nan)
    return own[:, None] + changes


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
