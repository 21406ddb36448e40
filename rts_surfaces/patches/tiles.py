"""Tiles of patches, and their triangles, which meet without cracks at any rates.

A tile is a quadrilateral or a triangle, with local coordinates (s, t): the unit square, or the triangle (0, 0), (1, 0),
(0, 1). Rates are numbers of pieces: those into which a tile is cut along s and along t, and those into which an edge
is cut. Tiles that share an edge share its points.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from rts import InputError
from rts.plugin_api.records import Proxy
from rts.plugin_api.threads import parallel, read_only
from rts_surfaces.patches.view_cells import View

MOST = 256
"""The largest rate: the number of pieces into which a side of a tile is cut."""
MOST_TRIANGLES = 2**27
"""The largest number of triangles; their arrays take 8 GiB."""
LEAST = {4: 2, 3: 3}
"""Number of sides → the least rate within a tile that is cut at all, so that vertices lie inside it."""
AT_ONCE = 2048
"""Tiles whose shapes are computed together."""
GRID = {4: 3, 3: 5}
"""Number of sides → points along each side of a tile, at which its shape is measured."""
ENOUGH, FINEST = 500, 4
"""Each of n quadrilateral patches is split into k × k tiles, with k = √(`ENOUGH` / n) rounded down, at least 1 and at
most `FINEST`. So only tiles at outlines need to be fine."""

Points = Callable[[np.ndarray, np.ndarray, int], np.ndarray]
"""(patches (N,) int32, parameters (N, 2) float64, order 0 or 2) → float64 (N, 1, 3), points; or, for order 2,
(N, 6, 3), points and derivatives in u, v, uu, uv, vv."""

_CORNERS = {4: np.array([(0, 0), (1, 0), (1, 1), (0, 1)], np.float64), 3: np.array([(0, 0), (1, 0), (0, 1)], float)}


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


class Shapes(NamedTuple):
    """Shapes of tiles, float64, by which the distances between their triangles and the surface are estimated.

    Attributes:
        normals: (n, G, G, 3) unit normals at a grid of G points a side; zero where the tile has none.
        places: (n, G, G, 3), the points of the grid.
        bends: (n, 3), absolute values of second derivatives along the normal: in s, in s and t, in t; each the largest
            over the grid. Where there is no normal, the whole length counts.
        curves: (E,), lengths of second derivatives along edges, their parts at right angles to the edge; each the
            largest over G points of the edge.
    """

    normals: np.ndarray
    places: np.ndarray
    bends: np.ndarray
    curves: np.ndarray


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


def shapes(tiles: Tiles, points: Points, beside: float = 0.0) -> Shapes:
    """The shapes of tiles and of their edges.

    In triangles one side of the grid shrinks to the corner (1, 0): its points are (s, t (1 − s)).

    Args:
        tiles: the tiles.
        points: the function that evaluates the surface.
        beside: how far from the border of a tile, and from the ends of an edge, its grid begins, a share of its size.
    """
    from rts_surfaces.patches import tile_rates_loops

    (count, width), edges = tiles.corners.shape, len(tiles.edge_tiles)
    grid = GRID[width]
    steps = np.linspace(0, 1, grid).clip(beside, 1 - beside)
    s, t = np.meshgrid(steps, steps, indexing="ij")
    local = np.stack([s, t if width == 4 else t * (1 - s)], axis=-1).reshape(-1, 2)
    normals, places = np.empty((2, count, grid, grid, 3))
    out = Shapes(normals, places, np.empty((count, 3)), np.empty(edges))
    for some in _slices(count):
        derivatives = _expanded(tiles, points, np.arange(count)[some], local[None])
        part = out.normals[some], out.places[some], out.bends[some]
        work = 100 * len(local) * len(derivatives)
        parallel(tile_rates_loops.shapes, len(derivatives), derivatives, tiles.frames[some], *part, work=work)
    corners = _CORNERS[width]
    along = np.roll(corners, -1, axis=0) - corners
    for some in _slices(edges):
        tile, side = tiles.edge_tiles[some].T
        derivatives = _expanded(tiles, points, tile, corners[side][:, None] + steps[:, None] * along[side][:, None])
        arguments = derivatives, tiles.frames[tile], along[side], out.curves[some]
        parallel(tile_rates_loops.curves, len(derivatives), *arguments, work=100 * grid * len(derivatives))
    return out


def _slices(count: int) -> list[slice]:
    return [slice(start, start + AT_ONCE) for start in range(0, count, AT_ONCE)]


def _expanded(tiles: Tiles, points: Points, tile: np.ndarray, local: np.ndarray) -> np.ndarray:
    """Points and derivatives (n, P, 6, 3) of tiles (n,), by number, at P places in each.

    The places are local coordinates (n, P, 2), or (1, P, 2) for the same in all tiles. Derivatives are in the patch's u
    and v, as in `Points`, not in s and t.
    """
    frames, width = tiles.frames[tile][:, None], local.shape[1]
    params = frames[:, :, 0] + local[..., :1] * frames[:, :, 1] + local[..., 1:] * frames[:, :, 2]
    derivatives = points(np.repeat(tiles.patch[tile], width), params.reshape(-1, 2), 2)
    return derivatives.reshape(len(tile), width, 6, 3)


class Allowed(NamedTuple):
    """Allowed distances of triangles from the surface, in units of space; infinity out of view.

    Attributes:
        chord: (n,), for each tile.
        edge: (n,), for the edges of each tile that are outlines.
        facing: (n,) int8: 1 for a tile that faces the viewer everywhere, −1 for one that faces away everywhere, else 0,
            which also stands for "unknown".
    """

    chord: np.ndarray
    edge: np.ndarray
    facing: np.ndarray

    @classmethod
    def everywhere(cls, count: int, chord: float) -> Allowed:
        """The distance `chord` for all of `count` tiles and their edges, of which no facing is known."""
        return cls(np.full(count, chord), np.full(count, chord), np.zeros(count, np.int8))


def allowed_in(view: View, tile_shapes: Shapes, fine: float, coarse: float) -> Allowed:
    """The allowed distances of triangles from the surface in a view.

    Args:
        view: the camera's view.
        tile_shapes: the shapes of the tiles.
        fine: distance in pixels where a tile or an edge may have an outline.
        coarse: distance in pixels elsewhere.
    """
    from rts_surfaces.patches import tile_rates_loops

    count, angle = len(tile_shapes.bends), min(view.angle, math.pi / 2)
    allowed = Allowed(np.empty(count), np.empty(count), np.empty(count, np.int8))
    cone = np.array([*view.axis, math.sin(angle), math.cos(angle)])
    seen = view.eye, view.toward, view.parallel, view.aside, view.along, view.spread, cone, np.array([fine, coarse])
    arguments = tile_shapes.places, tile_shapes.normals, tile_shapes.bends, *seen
    parallel(tile_rates_loops.outlines, count, *arguments, *allowed, work=500 * count)
    return allowed


def by_error(tiles: Tiles, tile_shapes: Shapes, allowed: Allowed) -> tuple[np.ndarray, np.ndarray]:
    """Rates of edges (E,) and of tiles (n, 2), int32, at which triangles keep allowed distances, by estimate.

    No rate is above `MOST`, even if distances are then exceeded.
    """
    from rts_surfaces.patches import tile_rates_loops

    inner, edges = np.empty((len(tiles.patch), 2), np.int32), np.empty(len(tiles.edge_tiles), np.int32)
    tile_rates_loops.rates(
        tile_shapes.bends, tile_shapes.curves, *allowed, tiles.sides, LEAST[tiles.sides.shape[1]], MOST, inner, edges
    )
    return edges, inner


def uniform(tiles: Tiles, rate: int) -> tuple[np.ndarray, np.ndarray]:
    """Rates of edges (E,) and of tiles (n, 2), int32: `rate` everywhere, but in tiles `LEAST` if that is more.

    A `rate` of 1 stays 1 in tiles, too: they are not cut at all.
    """
    edges = np.full(len(tiles.edge_tiles), rate, np.int32)
    least = 1 if rate == 1 else max(rate, LEAST[tiles.corners.shape[1]])
    return edges, np.full((len(tiles.patch), 2), least, np.int32)


# ----------------------------------------------------------------------------------------------- triangles


def triangles(tiles: Tiles, points: Points, edges: np.ndarray, inner: np.ndarray) -> Proxy:
    """Triangles of tiles, without cracks, in the winding of the tiles.

    Args:
        tiles: the tiles.
        points: the function that evaluates the surface.
        edges: (E,) int32, into how many pieces each edge is cut.
        inner: (n, 2) int32, into how many pieces each tile is cut along s and t; triangular tiles use the first alone.
            Where a tile or an edge of it is cut at all, the tile's numbers are at least `LEAST` of its number of sides.

    Returns:
        Vertices (V, 3) float32: the tiles' corners, by their numbers, then the points within edges, then those within
        tiles. Faces (T, 3); ids (T, 1), the patch of each triangle; corner parameters (T, 3, 2), (u, v) in that patch.

    Raises:
        InputError: more than `MOST_TRIANGLES` triangles.
    """
    from rts_surfaces.patches import tiles_loops

    count, width = tiles.corners.shape
    total = int(tiles_loops.counted(inner, tiles.sides, edges))
    if total > MOST_TRIANGLES:
        raise InputError(f"{count} patches make {total} triangles; expected fewer, so cut them less finely")
    within = (inner[:, 0] - 1) * (inner[:, 1] - 1) if width == 4 else (inner[:, 0] - 1) * (inner[:, 0] - 2) // 2
    edge_first = len(tiles.corner_tiles) + np.concatenate([[0], np.cumsum(edges - 1)]).astype(np.int32)
    inner_first = edge_first[-1] + np.concatenate([[0], np.cumsum(within)]).astype(np.int32)
    vertices = points(*_places(tiles, edges, edge_first, inner, inner_first), 0)[:, 0].astype(np.float32)
    first = np.zeros(count + 1, np.int32)
    tiles_loops.counts(inner, tiles.sides, edges, first)
    out = np.empty((total, 3), np.int32), np.empty((total, 1), np.int32), np.empty((total, 3, 2), np.float32)
    loop = tiles_loops.quadrilaterals if width == 4 else tiles_loops.triangles
    arguments = *tiles[:5], edges, edge_first, inner, inner_first, first
    parallel(loop, count, *arguments, out, work=30 * total)
    return Proxy(vertices, *out)


def _places(
    tiles: Tiles, edges: np.ndarray, edge_first: np.ndarray, inner: np.ndarray, inner_first: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Patches (V,) int32 and parameters (V, 2) float64 of vertices: those at corners, within edges, within tiles.

    `edges` (E,) and `inner` (n, 2) are rates. `edge_first` (E + 1,) and `inner_first` (n + 1,) are the first vertex
    within each edge and each tile, and one after the last.
    """
    from rts_surfaces.patches import tiles_loops

    shape = _CORNERS[tiles.corners.shape[1]]
    total = int(inner_first[-1])
    patch, params = np.empty(total, np.int32), np.empty((total, 2))
    tile, corner = tiles.corner_tiles.T
    patch[: len(tile)], params[: len(tile)] = tiles.patch[tile], tiles.params(tile, shape[corner])
    # From one end of an edge to the other, in the edge's direction.
    tile, side = tiles.edge_tiles.T
    back = tiles.flips[tile, side][:, None]
    ends = tiles.params(tile, shape[side]), tiles.params(tile, np.roll(shape, -1, axis=0)[side])
    ends = np.where(back, ends[1], ends[0]), np.where(back, ends[0], ends[1])
    tiles_loops.within_edges(tiles.patch[tile], *ends, edges, edge_first, patch, params)
    loop = tiles_loops.within_quadrilaterals if len(shape) == 4 else tiles_loops.within_triangles
    loop(tiles.patch, tiles.frames, inner, inner_first, patch, params)
    return patch, params
