"""Small cages of subdivision surfaces, and places on their limits."""

from __future__ import annotations

import helpers
import numpy as np

import rts
from rts_surfaces.subdivision.binding import Limit, Rules
from rts_surfaces.subdivision.cage_checks import checked_cage
from rts_surfaces.subdivision.face_tiles import tiles_of


def cube():
    vertices = np.array([(x, y, z) for z in (-1, 1) for y in (-1, 1) for x in (-1, 1)], float)
    return vertices, [[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [1, 3, 7, 5], [3, 2, 6, 7], [2, 0, 4, 6]]


def sheet(nu, nv, seed=0):
    """A wavy grid of quadrilaterals."""
    place = np.stack(np.meshgrid(np.arange(nu), np.arange(nv), indexing="ij"), axis=-1).reshape(-1, 2)
    first = np.add.outer(nv * np.arange(nu - 1), np.arange(nv - 1)).reshape(-1, 1)
    height = 0.3 * np.random.default_rng(seed).normal(size=len(place))
    return np.column_stack([place, height]), (first + [0, nv, nv + 1, 1]).tolist()


def ball():
    part = rts.plugin("surfaces", "mesh").example()
    return np.asarray(part.theta["vertices"], float), part.surface.faces.tolist()


def prism(corners):
    """Two polygons of so many corners, joined by quadrilaterals."""
    turn = np.arange(corners) * 2 * np.pi / corners
    ring = np.stack([np.cos(turn), np.sin(turn)], axis=1)
    vertices = np.concatenate([np.column_stack([ring, np.full(corners, z)]) for z in (-0.7, 0.7)])
    around = [[i, (i + 1) % corners, corners + (i + 1) % corners, corners + i] for i in range(corners)]
    return vertices, [list(range(corners))[::-1], list(range(corners, 2 * corners)), *around]


CAGES = {
    "cube": (*cube(), "catmark", {}),
    "creased": (*cube(), "catmark", {"creases": [(4, 5, 10), (5, 7, 10), (7, 6, 10), (6, 4, 10), (0, 1, 2.5)]}),
    "soft creases": (*cube(), "catmark", {"creases": [(4, 5, 0.5), (5, 7, 1.5), (7, 6, 3), (0, 1, 2.25)]}),
    "corner": (*cube(), "catmark", {"corners": [(0, 10), (7, 1.5)]}),
    "sheet": (*sheet(5, 4), "catmark", {}),
    "sheet without corners": (*sheet(5, 4), "catmark", {"boundary": "edge_only"}),
    "five corners": (*prism(5), "catmark", {"creases": [(0, 1, 2)]}),
    "eleven corners": (*prism(11), "catmark", {}),
    "triangles": (*prism(3), "catmark", {}),
    "loop": (*ball(), "loop", {}),
    "loop creased": (ball()[0], ball()[1], "loop", {"creases": [(*ball()[1][0][:2], 2.5)], "corners": [(3, 1.5)]}),
    "loop open": (ball()[0], ball()[1][:15], "loop", {}),
    "loop open without corners": (ball()[0], ball()[1][:11], "loop", {"boundary": "edge_only"}),
}


def limit_of(name, **levels):
    vertices, faces, scheme, tags = CAGES[name]
    cage = checked_cage(faces, scheme, tags.get("creases", ()), tags.get("corners", ()))
    return vertices, Limit(cage, Rules(tags.get("boundary", "edge_and_corner"), **levels))


def somewhere(limit, count, seed=0, margin=0.0):
    """Random faces and parameters within them, away from their edges."""
    rng = np.random.default_rng(seed)
    tiles = tiles_of(limit)
    tile, local = rng.integers(0, len(tiles.patch), count), margin + (1 - 2 * margin) * rng.random((count, 2))
    if tiles.corners.shape[1] == 3:
        local = np.sort(local, axis=1)
        local = np.stack([local[:, 0], 1 - local[:, 1]], axis=1)
    return tiles.patch[tile], tiles.params(tile, local)


def samples_at(face, params):
    """Samples on faces (N,) in single precision, which no cell refers to."""
    return helpers.samples_at(face, np.asarray(params, np.float32))
