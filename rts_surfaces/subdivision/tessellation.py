"""Faces of a cage as tiles, and triangles of these whose vertices lie on the limit surface.

A tile is a quadrilateral, or for Loop a triangle, with local coordinates (s, t): the unit square, or the triangle
(0, 0), (1, 0), (0, 1). Where any face is subdivided into sub-faces, whose parameters have gaps, all faces are: so each
side of a tile is one edge, and tiles that share it share its points.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rts.records import Proxy
from rts.threads import parallel
from rts.topology import fixed
from rts_surfaces.subdivision.binding import NONE, QUAD, SUBFACES, Limit, Points

GRID = 5
"""Points along each side of a tile at which its shape is looked at."""
LEAST = {4: 2, 3: 3}
"""How often a tile of so many sides is cut at least, where it is cut at all: so that points lie within it."""
BESIDE = 1 / 16
"""How far from the border of a tile it is looked at how it bends. At extraordinary vertices second derivatives have no
bound, and at creases they are large, but both on so little of a tile that triangles are off by less than that."""
AT_ONCE = 2048
"""Tiles whose shapes are looked at together."""

_SQUARE = np.array([(0, 0), (1, 0), (1, 1), (0, 1)], np.float64)
_TRIANGLE = np.array([(0, 0), (1, 0), (0, 1)], np.float64)


class Tiles(NamedTuple):
    """The tiles of a limit surface; k is 4, or 3 for Loop. Host arrays, read-only.

    Attributes:
        faces: (n,) int32, the face of each tile.
        frames: (n, 3, 2) float64: face parameters are `frames[:, 0] + s * frames[:, 1] + t * frames[:, 2]`.
        corners: (n, k) int32, the numbers of the tile's corners, counter-clockwise from (0, 0).
        sides: (n, k) int32, the edge from each corner to the next.
        flips: (n, k) bool, whether a side, which runs around the tile, runs against its edge.
        corner_tiles: (C, 2) int32, for each corner a tile, and which of its corners it is.
        edge_tiles: (E, 2) int32, for each edge a tile, and which of its sides it is.
    """

    faces: np.ndarray
    frames: np.ndarray
    corners: np.ndarray
    sides: np.ndarray
    flips: np.ndarray
    corner_tiles: np.ndarray
    edge_tiles: np.ndarray

    def params(self, tiles: np.ndarray, local: np.ndarray) -> np.ndarray:
        """Face parameters (N, 2) at local coordinates (N, 2) of tiles (N,)."""
        frames = self.frames[tiles]
        return frames[:, 0] + local[:, :1] * frames[:, 1] + local[:, 1:] * frames[:, 2]


def tiles_of(limit: Limit) -> Tiles:
    """The tiles of all faces that have a limit surface."""
    cage = limit.cage
    owner, start, end = cage.faces(), cage.indices.astype(np.int64), cage.indices[cage.next()].astype(np.int64)
    count = int(start.max()) + 1
    against = start > end
    _, edge = np.unique(np.minimum(start, end) * count + np.maximum(start, end), return_inverse=True)
    there = limit.kinds[owner] != NONE
    if (limit.kinds == SUBFACES).any():
        faces, frames = owner[there].astype(np.int32), _quarters(limit)[there]
        before = np.empty(len(owner), np.int64)
        before[cage.next()] = np.arange(len(owner))
        # Corners: a vertex, the middle of the edge after it, that of the face, the middle of the edge before it.
        edges, total = edge.max() + 1, len(owner)
        corners = np.stack([start, count + edge, count + edges + owner, count + edge[before]], axis=1)[there]
        # Edges: half k of edge e is 2 e + k, the first at the lesser vertex; then those to the middles of faces.
        first, last = 2 * edge + against, (2 * edge + ~against)[before]
        inner = 2 * edges + np.arange(total)
        sides = np.stack([first, inner, inner[before], last], axis=1)[there]
        no = np.zeros(total, bool)
        flips = np.stack([against, no, ~no, against[before]], axis=1)[there]
    else:
        width = 3 if cage.scheme == "loop" else 4
        faces = np.flatnonzero(limit.kinds != NONE).astype(np.int32)
        frames = np.broadcast_to(np.array([(0.0, 0), (1, 0), (0, 1)]), (len(faces), 3, 2)).copy()
        corners, sides, flips = (x[there].reshape(-1, width) for x in (start, edge, against))
    corners, corner_tiles = _numbered(corners)
    sides, edge_tiles = _numbered(sides)
    return Tiles(*(fixed(x) for x in (faces, frames, corners, sides, flips.copy(), corner_tiles, edge_tiles)))


def _quarters(limit: Limit) -> np.ndarray:
    """Frames (H, 3, 2) of the quarter of a face at each of its corners."""
    cage = limit.cage
    frames = np.zeros((len(cage.indices), 3, 2))
    frames[:, 0] = limit.corners
    frames[:, 1, 0] = frames[:, 2, 1] = 0.5
    # In a face of four corners the quarters share its parameters; their axes turn with them.
    h = np.flatnonzero((limit.kinds == QUAD)[cage.faces()])
    turn = h - cage.first[cage.faces()[h]]
    along = np.array([(0.5, 0), (0, 0.5), (-0.5, 0), (0, -0.5)])
    frames[h, 1], frames[h, 2] = along[turn], along[(turn + 1) % 4]
    return frames


def _numbered(names: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Names (n, k) as numbers from 0 on, and for each number a place (row, column) where it is."""
    _, place, numbers = np.unique(names, return_index=True, return_inverse=True)
    where = np.stack(np.divmod(place, names.shape[1]), axis=1).astype(np.int32)
    return numbers.reshape(names.shape).astype(np.int32), where


# ----------------------------------------------------------------------------------------------- triangles


def uniform(tiles: Tiles, rate: int) -> tuple[np.ndarray, np.ndarray]:
    """Rates of edges (E,) and of tiles (n, 2), both int32, where all is cut alike."""
    edges = np.full(len(tiles.edge_tiles), rate, np.int32)
    least = 1 if rate == 1 else max(rate, LEAST[tiles.corners.shape[1]])
    return edges, np.full((len(tiles.faces), 2), least, np.int32)


def rates(
    tiles: Tiles, bends: np.ndarray, curves: np.ndarray, allowed: np.ndarray, most: int
) -> tuple[np.ndarray, np.ndarray]:
    """How often edges (E,) and tiles (n, 2) are cut, int32, so that triangles are close to the surface.

    Args:
        tiles: the tiles.
        bends: (n, 3), see `shapes`.
        curves: (n, k), see `shapes`.
        allowed: (n,), how far triangles may be off.
        most: the largest rate.
    """
    width = tiles.corners.shape[1]
    fine, second = np.full(len(tiles.edge_tiles), np.inf), np.zeros(len(tiles.edge_tiles))
    np.minimum.at(fine, tiles.sides, allowed[:, None])
    np.maximum.at(second, tiles.sides, curves)
    edges = np.ceil(np.sqrt(second / (8 * fine)))
    (ss, st, tt), least = bends.T, LEAST[width]
    if width == 4:
        along = np.maximum(np.sqrt(np.stack([ss, tt], axis=1) / (4 * allowed[:, None])), 1)
        # The error of a triangle's chord (Filip, Magedson, Markot 1986).
        error = (ss / along[:, 0] ** 2 + 2 * st / along.prod(axis=1) + tt / along[:, 1] ** 2) / 8
        along *= np.sqrt(np.maximum(error / allowed, 1))[:, None]
    else:
        along = np.repeat(np.sqrt((ss + 2 * st + tt) / (8 * allowed))[:, None], 2, axis=1)
    inner = np.clip(np.ceil(along), 1, most).astype(np.int32)
    # Cut alike, a side and what lies within make no long triangles.
    np.maximum.at(edges, tiles.sides, inner[:, np.arange(width) % 2])
    edges = np.clip(edges, 1, most).astype(np.int32)
    cut = (inner > 1).any(axis=1) | (edges[tiles.sides] > 1).any(axis=1)
    inner[cut] = np.maximum(inner[cut], least)
    return edges, inner


def triangles(tiles: Tiles, points: Points, edges: np.ndarray, inner: np.ndarray) -> Proxy:
    """Triangles of tiles, without cracks, counter-clockwise where the cage is.

    Args:
        tiles: the tiles.
        points: the limit surface.
        edges: (E,) int32, into how many pieces each edge is cut.
        inner: (n, 2) int32, into how many each tile is cut along s and t; of triangles the first counts. Where an edge
            of a tile is cut they are at least 2, of triangles 3; also where one of the two is more than 1.

    Returns:
        Vertices; ids (T, 1) are faces of the cage, parameters (T, 3, 2) those of the face.
    """
    from rts_surfaces.subdivision import tessellation_kernels as kernels

    count, width = tiles.corners.shape
    within = (inner[:, 0] - 1) * (inner[:, 1] - 1) if width == 4 else (inner[:, 0] - 1) * (inner[:, 0] - 2) // 2
    edge_first = len(tiles.corner_tiles) + np.concatenate([[0], np.cumsum(edges - 1)]).astype(np.int32)
    inner_first = edge_first[-1] + np.concatenate([[0], np.cumsum(within)]).astype(np.int32)
    vertices = _vertices(tiles, points, edges, edge_first, inner, inner_first)
    first = np.zeros(count + 1, np.int32)
    kernels.counts(inner, tiles.sides, edges, first)
    total = int(first[-1])
    out = np.empty((total, 3), np.int32), np.empty((total, 1), np.int32), np.empty((total, 3, 2), np.float32)
    tables = tiles.faces, tiles.frames, tiles.corners, tiles.sides, tiles.flips
    kernel = kernels.quadrilaterals if width == 4 else kernels.triangles
    parallel(kernel, count, *tables, edges, edge_first, inner, inner_first, first, out, work=30 * total)
    return Proxy(vertices, *out)


def _vertices(
    tiles: Tiles,
    points: Points,
    edges: np.ndarray,
    edge_first: np.ndarray,
    inner: np.ndarray,
    inner_first: np.ndarray,
) -> np.ndarray:
    """Points (V, 3) float32: of corners, within edges, within tiles."""
    from rts_surfaces.subdivision import tessellation_kernels as kernels

    shape = _SQUARE if tiles.corners.shape[1] == 4 else _TRIANGLE
    total = int(inner_first[-1])
    faces, params = np.empty(total, np.int32), np.empty((total, 2))
    tile, corner = tiles.corner_tiles.T
    faces[: len(tile)], params[: len(tile)] = tiles.faces[tile], tiles.params(tile, shape[corner])
    # From one end of an edge to the other, in its own direction.
    tile, side = tiles.edge_tiles.T
    back = tiles.flips[tile, side][:, None]
    ends = tiles.params(tile, shape[side]), tiles.params(tile, np.roll(shape, -1, axis=0)[side])
    ends = np.where(back, ends[1], ends[0]), np.where(back, ends[0], ends[1])
    kernels.within_edges(tiles.faces[tile], *ends, edges, edge_first, faces, params)
    kernel = kernels.within_quadrilaterals if len(shape) == 4 else kernels.within_triangles
    kernel(tiles.faces, tiles.frames, inner, inner_first, faces, params)
    return points.evaluate(faces, params)[:, 0].astype(np.float32)


# ----------------------------------------------------------------------------------------------- shapes


def shapes(tiles: Tiles, points: Points) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """What triangles by error need to know of tiles.

    Of triangles the grid is drawn together into the corner (1, 0): its points are (s, t (1 − s)).

    Args:
        tiles: the tiles.
        points: the limit surface.

    Returns:
        Normals (n, GRID, GRID, 3) of unit length, or zero; places (n, GRID, GRID, 3), where these are; bends (n, 3),
        the largest second derivatives along the normal, in s, in s and t, in t, of tiles in local coordinates; curves
        (n, k), the largest second derivatives of the sides across themselves. All float64.
    """
    from rts_surfaces.subdivision import tessellation_kernels as kernels

    count, width = tiles.corners.shape
    shape, even = (_SQUARE if width == 4 else _TRIANGLE), np.linspace(0, 1, GRID)
    along = np.roll(shape, -1, axis=0) - shape
    sides = shape[:, None] + even.clip(BESIDE, 1 - BESIDE)[:, None] * along[:, None]
    local, within = _grid(even, width), _grid(even.clip(BESIDE, 1 - BESIDE), width)
    looked = np.concatenate([within, sides.reshape(-1, 2)])
    normals, places = np.empty((2, count, GRID, GRID, 3))
    bends, curves = np.empty((count, 3)), np.empty((count, width))
    for start in range(0, count, AT_ONCE):
        tile = np.arange(start, min(start + AT_ONCE, count))
        some = slice(start, start + len(tile))
        first, second = (
            points.evaluate(np.repeat(tiles.faces[tile], len(at)), _everywhere(tiles, tile, at), order)
            for at, order in ((local, 1), (looked, 2))
        )
        frames = tiles.frames[tile]
        first, second = first.reshape(len(tile), -1, 3, 3), second.reshape(len(tile), -1, 6, 3)
        parallel(kernels.normals, len(tile), first, frames, normals[some], places[some], work=1000 * len(tile))
        out = bends[some], curves[some]
        parallel(kernels.bends, len(tile), second, frames, along, GRID, *out, work=2000 * len(tile))
    return normals, places, bends, curves


def _grid(steps: np.ndarray, width: int) -> np.ndarray:
    """Local coordinates (GRID², 2) of a grid in a tile of so many sides."""
    s, t = np.meshgrid(steps, steps, indexing="ij")
    return np.stack([s, t if width == 4 else t * (1 - s)], axis=-1).reshape(-1, 2)


def _everywhere(tiles: Tiles, tile: np.ndarray, local: np.ndarray) -> np.ndarray:
    """Face parameters of all the same local coordinates in some tiles."""
    return tiles.params(np.repeat(tile, len(local)), np.tile(local, (len(tile), 1)))
