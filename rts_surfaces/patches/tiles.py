"""Tiles of patches, and their triangles, which meet without cracks at any rates.

A tile is a quadrilateral or a triangle, with local coordinates (s, t): the unit square, or the triangle (0, 0), (1, 0),
(0, 1). Rates are numbers of pieces: those into which a tile is cut along s and along t, and those into which an edge
is cut. Tiles that share an edge share its points.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from rts.plugin_api.threads import read_only

MOST = 256
"""The largest rate: the number of pieces into which a side of a tile is cut."""
ENOUGH, FINEST = 500, 4
"""Each of n quadrilateral patches is split into k × k tiles, with k = √(`ENOUGH` / n) rounded down, at least 1 and at
most `FINEST`. So only tiles at outlines need to be fine."""

Points = Callable[[np.ndarray, np.ndarray, int], np.ndarray]
"""(patches (N,) int32, parameters (N, 2) float64, order 0 or 2) → float64 (N, 1, 3), points; or, for order 2,
(N, 6, 3), points and derivatives in u, v, uu, uv, vv."""

CORNERS = {4: np.array([(0, 0), (1, 0), (1, 1), (0, 1)], np.float64), 3: np.array([(0, 0), (1, 0), (0, 1)], float)}


class Tiles(NamedTuple):
    """The tiles of a surface, with k sides each, 4 or 3. Host arrays, read-only.

    Attributes:
        patch: (n,) int32, the patch of which each tile is a part.
        frames: (n, 3, 2) float64: (s, t) has the patch parameters `frames[:, 0] + s * frames[:, 1] + t * frames[:, 2]`.
        corners: (n, k) int32, the numbers of the tile's corners, counter-clockwise from (0, 0).
        sides: (n, k) int32, the number of the edge from each corner to the next.
        flips: (n, k) bool, whether a side, which runs around the tile, runs against its edge.
        corner_tiles: (C, 2) int32, for each corner a tile that has it, and its index among this tile's corners.
        edge_tiles: (E, 2) int32, for each edge a tile that has it, and its index among this tile's sides.
    """

    patch: np.ndarray
    frames: np.ndarray
    corners: np.ndarray
    sides: np.ndarray
    flips: np.ndarray
    corner_tiles: np.ndarray
    edge_tiles: np.ndarray

    @classmethod
    def of(
        cls, patch: np.ndarray, frames: np.ndarray, corners: np.ndarray, sides: np.ndarray, flips: np.ndarray
    ) -> Tiles:
        """Tiles from tables as in the attributes, where any integers name corners and edges.

        Names in `corners` and in `sides` are equal where tiles share a corner or an edge. They become numbers from 0
        on, in increasing order of the names.
        """
        corners, corner_tiles = _numbered(corners)
        sides, edge_tiles = _numbered(sides)
        patch, frames, flips = patch.astype(np.int32), frames.astype(np.float64), np.array(flips, bool)
        return cls(*(read_only(x) for x in (patch, frames, corners, sides, flips, corner_tiles, edge_tiles)))

    def params(self, tiles: np.ndarray, local: np.ndarray) -> np.ndarray:
        """Parameters (N, 2) in the patches of tiles, by their numbers (N,), at local coordinates `local` (N, 2)."""
        frames = self.frames[tiles]
        return frames[:, 0] + local[:, :1] * frames[:, 1] + local[:, 1:] * frames[:, 2]


def _numbered(names: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Names (n, k), any integers, as numbers (n, k) int32 from 0 on, in increasing order of the names.

    Also returns, for each number, the row and column (·, 2) int32 of its first occurrence in `names`.
    """
    _, place, numbers = np.unique(names, return_index=True, return_inverse=True)
    where = np.stack(np.divmod(place, names.shape[1]), axis=1).astype(np.int32)
    return numbers.reshape(names.shape).astype(np.int32), where


def split(tiles: Tiles) -> Tiles:
    """Quadrilateral tiles, each cut into k × k smaller ones, with k as `ENOUGH` says.

    Returns `tiles` itself if they are triangles, or so many that k is 1.
    """
    count, width = tiles.corners.shape
    cuts = int(np.clip(np.sqrt(ENOUGH / count), 1, FINEST))
    if width == 3 or cuts == 1:
        return tiles
    corners, pieces, backwards = _pieces(tiles, cuts)
    i, j = (x.reshape(-1) for x in np.meshgrid(np.arange(cuts), np.arange(cuts), indexing="ij"))
    frames = np.repeat(tiles.frames[:, None] / [[1.0], [cuts], [cuts]], len(i), axis=1)
    frames[:, :, 0] += i[:, None] * frames[:, :, 1] + j[:, None] * frames[:, :, 2]
    return Tiles.of(np.repeat(tiles.patch, len(i)), frames.reshape(-1, 3, 2), corners, pieces, backwards)


def _pieces(tiles: Tiles, cuts: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Corners, sides and flips (n cuts², 4), as `Tiles.of` takes them, of n quadrilaterals cut into cuts² tiles each.

    The cuts² tiles of one quadrilateral follow one another, in the order of s, then of t.
    """
    count, points, edges, steps = len(tiles.corners), len(tiles.corner_tiles), len(tiles.edge_tiles), np.arange(cuts)
    # Points: the corners, those within edges, those within tiles.
    corner = points + edges * (cuts - 1) + np.arange(count * (cuts + 1) ** 2).reshape(count, cuts + 1, cuts + 1)
    corner[:, ::cuts, ::cuts] = tiles.corners[:, [[0, 3], [1, 2]]]
    # Pieces of edges, then lines within tiles, along s and along t.
    first = edges * cuts + np.arange(count)[:, None, None] * 2 * cuts * (cuts + 1)
    along_s = first + np.arange(cuts * (cuts + 1)).reshape(cuts, cuts + 1)
    along_t = first + cuts * (cuts + 1) + np.arange(cuts * (cuts + 1)).reshape(cuts + 1, cuts)
    against_s, against_t = np.zeros(along_s.shape, bool), np.zeros(along_t.shape, bool)
    for side in range(4):
        # In the order of s or t, which sides 2 and 3 run against.
        edge, against = tiles.sides[:, side, None], tiles.flips[:, side, None] ^ (side >= 2)
        piece = np.where(against, cuts - 1 - steps, steps) + edge * cuts
        within = np.where(against, cuts - 2 - steps[:-1], steps[:-1]) + edge * (cuts - 1)
        end = cuts if side in (1, 2) else 0
        if side % 2 == 0:
            along_s[:, :, end], against_s[:, :, end], corner[:, 1:-1, end] = piece, against, points + within
        else:
            along_t[:, end, :], against_t[:, end, :], corner[:, end, 1:-1] = piece, against, points + within
    corners = np.stack([corner[:, :-1, :-1], corner[:, 1:, :-1], corner[:, 1:, 1:], corner[:, :-1, 1:]], axis=-1)
    pieces = np.stack([along_s[:, :, :-1], along_t[:, 1:, :], along_s[:, :, 1:], along_t[:, :-1, :]], axis=-1)
    # Sides 2 and 3 of a tile run against s and t.
    backwards = [against_s[:, :, :-1], against_t[:, 1:, :], ~against_s[:, :, 1:], ~against_t[:, :-1, :]]
    return corners.reshape(-1, 4), pieces.reshape(-1, 4), np.stack(backwards, axis=-1).reshape(-1, 4)


# ----------------------------------------------------------------------------------------------- how fine


# ----------------------------------------------------------------------------------------------- triangles
