"""Faces of a cage as tiles.

If any face has sub-faces, whose parameters have gaps, all faces are cut into quarters, one a corner. So each side of a
tile is one edge, and tiles that share an edge share its points.
"""

from __future__ import annotations

import numpy as np

from rts_surfaces.patches.tiles import Tiles
from rts_surfaces.subdivision.binding import NONE, QUAD, SUBFACES, Limit


def tiles_of(limit: Limit) -> Tiles:
    """The tiles of all faces that have a limit surface, one a face, or one at each corner where faces are quartered."""
    cage = limit.cage
    owner, start, end = cage.faces(), cage.indices.astype(np.int64), cage.indices[cage.next()].astype(np.int64)
    count = int(start.max()) + 1
    against = start > end
    _, edge = np.unique(np.minimum(start, end) * count + np.maximum(start, end), return_inverse=True)
    has_limit = limit.kinds[owner] != NONE
    if (limit.kinds == SUBFACES).any():
        faces, frames = owner[has_limit].astype(np.int32), _quarters(limit)[has_limit]
        before = np.empty(len(owner), np.int64)
        before[cage.next()] = np.arange(len(owner))
        # Corners: a vertex, the middle of the edge after it, that of the face, the middle of the edge before it.
        edges, total = edge.max() + 1, len(owner)
        corners = np.stack([start, count + edge, count + edges + owner, count + edge[before]], axis=1)[has_limit]
        # Edges: half k of edge e is 2 e + k, the first at the lesser vertex; then those to the middles of faces.
        first, last = 2 * edge + against, (2 * edge + ~against)[before]
        inner = 2 * edges + np.arange(total)
        sides = np.stack([first, inner, inner[before], last], axis=1)[has_limit]
        no = np.zeros(total, bool)
        flips = np.stack([against, no, ~no, against[before]], axis=1)[has_limit]
    else:
        width = 3 if cage.scheme == "loop" else 4
        faces = np.flatnonzero(limit.kinds != NONE).astype(np.int32)
        frames = np.broadcast_to(np.array([(0.0, 0), (1, 0), (0, 1)]), (len(faces), 3, 2)).copy()
        corners, sides, flips = (x[has_limit].reshape(-1, width) for x in (start, edge, against))
    return Tiles.of(faces, frames, corners, sides, flips)


def _quarters(limit: Limit) -> np.ndarray:
    """`Tiles.frames` (H, 3, 2) of the quarters of faces, one at each corner of each face.

    At a quarter's (0, 0) is the corner; at (1, 1) is the middle of the face.
    """
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
