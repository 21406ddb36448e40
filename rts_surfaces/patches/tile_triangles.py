"""How finely tiles are cut, and triangles that meet along the edges of tiles."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from rts import InputError
from rts.plugin_api.records import Proxy
from rts.plugin_api.threads import parallel
from rts_surfaces.patches.tiles import CORNERS, Points, Tiles
from rts_surfaces.patches.view_cells import ViewCell

MOST_TRIANGLES = 2**27
"""The largest number of triangles; their arrays take 8 GiB."""
LEAST = {4: 2, 3: 3}
"""Number of sides → the least rate within a tile that is cut at all, so that vertices lie inside it."""
AT_ONCE = 2048
"""Tiles whose shapes are computed together."""
GRID = {4: 3, 3: 5}
"""Number of sides → points along each side of a tile, at which its shape is measured."""


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
    corners = CORNERS[width]
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


class Cut(NamedTuple):
    """How tiles are cut, and where what they are cut into begins. int32.

    Attributes:
        edges: (E,), into how many pieces each edge is cut.
        edge_first: (E + 1,), the first of the vertices within each edge.
        inner: (n, 2), into how many pieces each tile is cut along s and t.
        inner_first: (n + 1,), the first of the vertices within each tile.
        first: (n + 1,), the first triangle of each tile.
    """

    edges: np.ndarray
    edge_first: np.ndarray
    inner: np.ndarray
    inner_first: np.ndarray
    first: np.ndarray


def allowed_in(view: ViewCell, tile_shapes: Shapes, fine: float, coarse: float) -> Allowed:
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
    arguments = tile_shapes, view, (math.sin(angle), math.cos(angle)), (fine, coarse), allowed
    parallel(tile_rates_loops.outlines, count, *arguments, work=500 * count)
    return allowed


def by_error(tiles: Tiles, tile_shapes: Shapes, allowed: Allowed) -> tuple[np.ndarray, np.ndarray]:
    """Rates of edges (E,) and of tiles (n, 2), int32, at which triangles keep allowed distances, by estimate.

    No rate is above `tiles.MOST`, even if distances are then exceeded.
    """
    from rts_surfaces.patches import tile_rates_loops

    inner, edges = np.empty((len(tiles.patch), 2), np.int32), np.empty(len(tiles.edge_tiles), np.int32)
    tile_rates_loops.rates(tile_shapes, allowed, tiles.sides, LEAST[tiles.sides.shape[1]], inner, edges)
    return edges, inner


def uniform(tiles: Tiles, rate: int) -> tuple[np.ndarray, np.ndarray]:
    """Rates of edges (E,) and of tiles (n, 2), int32: `rate` everywhere, but in tiles `LEAST` if that is more.

    A `rate` of 1 stays 1 in tiles, too: they are not cut at all.
    """
    edges = np.full(len(tiles.edge_tiles), rate, np.int32)
    least = 1 if rate == 1 else max(rate, LEAST[tiles.corners.shape[1]])
    return edges, np.full((len(tiles.patch), 2), least, np.int32)


def triangles(tiles: Tiles, points: Points, edges: np.ndarray, inner: np.ndarray) -> Proxy:
    """Triangles of tiles, without cracks, in the winding of the tiles.

    Args:
        tiles: the tiles.
        points: the function that evaluates the surface.
        edges: (E,) int32, into how many pieces each edge is cut.
        inner: (n, 2) int32, into how many pieces each tile is cut along s and t; triangular tiles use the first alone.
            Where a tile or an edge of it is cut at all, the tile's numbers are at least `LEAST` of its number of sides.

    Returns:
        Vertices (V, 3), as `points` gives them: the tiles' corners, by their numbers, then the points within edges,
        then those within tiles. Faces (T, 3); ids (T, 1), the patch of each triangle; corner parameters (T, 3, 2),
        (u, v) in that patch.

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
    vertices = points(*_places(tiles, edges, edge_first, inner, inner_first), 0)[:, 0]
    first = np.zeros(count + 1, np.int32)
    tiles_loops.counts(inner, tiles.sides, edges, first)
    out = np.empty((total, 3), np.int32), np.empty((total, 1), np.int32), np.empty((total, 3, 2), np.float32)
    loop = tiles_loops.quadrilaterals if width == 4 else tiles_loops.triangles
    parallel(loop, count, tiles, Cut(edges, edge_first, inner, inner_first, first), out, work=30 * total)
    return Proxy(vertices, *out)


def _places(
    tiles: Tiles, edges: np.ndarray, edge_first: np.ndarray, inner: np.ndarray, inner_first: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Patches (V,) int32 and parameters (V, 2) float64 of vertices: those at corners, within edges, within tiles.

    `edges` (E,) and `inner` (n, 2) are rates. `edge_first` (E + 1,) and `inner_first` (n + 1,) are the first vertex
    within each edge and each tile, and one after the last.
    """
    from rts_surfaces.patches import tiles_loops

    shape = CORNERS[tiles.corners.shape[1]]
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
