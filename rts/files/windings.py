"""Faces of files that are there twice, or wound against their neighbours, made a surface that has one outside.

Normals of vertices are sums over faces. Sums over both sides of a double face cancel, and so do those over faces that
are wound in different ways.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from rts.files.damaged_files import warn

MOST = 0.8
"""The share of a patch's faces from which they tell its sides, even if these are the inside of a closed patch: faces
that are wound anyhow hardly ever agree so well."""


class Wound(NamedTuple):
    """Faces that are kept, and those of them that are to be turned over.

    Attributes:
        kept: (K,) int64, ascending places of faces of the file.
        turned: (K,) bool.
    """

    kept: np.ndarray
    turned: np.ndarray

    def table(self, table: np.ndarray) -> np.ndarray:
        """The table (K, 3) of the corners of the faces that are kept, of one (T, 3) of all faces."""
        rows = table[self.kept]
        rows[self.turned] = rows[self.turned][:, [0, 2, 1]]
        return rows


@dataclass
class Tally:
    """Changes that were made to the faces of a file.

    Attributes:
        faces: how many faces were looked at.
        twice: how many were left out.
        turned: how many were turned over, without those of which the file has the other side as well.
    """

    faces: int = 0
    twice: int = 0
    turned: int = 0

    def warn(self, path: Path) -> None:
        """Warn of what was changed, if anything was."""
        if self.twice:
            warn(
                f"{path}: {self.twice} of {self.faces} faces have the corners of another one, in its direction or the "
                "opposite one, and are left out"
            )
        if self.turned:
            warn(f"{path}: {self.turned} of {self.faces} faces are wound against their neighbours, and are turned over")


def wound_alike(
    vertices: np.ndarray, faces: np.ndarray, tally: Tally, *, both_sides: bool = False, has_normals: bool = False
) -> Wound | None:
    """The faces without repetitions, those of each patch wound alike; None if that changes nothing.

    A patch is what is joined by edges of two faces. One that is wound in different ways, or had faces of both
    directions, is wound as `MOST` of its faces are, unless many have both directions: so a room that is seen from
    inside stays one. Where there is no such majority, it is wound as its outside is, if it is closed, and else as more
    of its faces are. Patches with one side only, as Möbius's strip, and such that are wound alike, also with the inside
    out, stay as they are.

    Args:
        vertices: (V, 3) float.
        faces: (T, 3) integers; vertices that coincide are one only if their numbers are the same.
        tally: is told what was changed.
        both_sides: True to keep faces that differ in their direction, since each is seen from its own side only.
        has_normals: True for a mesh with normals of its own, which tell the sides of faces: none is turned over.
    """
    tally.faces += len(faces)
    faces = faces.astype(np.int64)
    first, other = _repetitions(faces, both_sides)
    kept = np.flatnonzero(first)
    double = other[kept] >= 0
    patch, like_first, closed = _patches(faces[kept])
    if len(kept) == len(faces) and like_first.all():
        return None
    count = int(patch.max(initial=-1)) + 1
    alike = np.bincount(patch, like_first, count)
    size = np.bincount(patch, minlength=count)
    changed = (alike < size) | (np.bincount(patch, double, count) > 0)
    volume = np.bincount(patch, np.where(like_first, 1, -1) * _volumes(vertices, faces[kept], patch, count), count)
    # Faces of which the file has both directions have no vote.
    votes = np.bincount(patch, np.where(double, 0, np.where(like_first, 1, -1)), count)
    agreed = (np.abs(votes) > (2 * MOST - 1) * np.bincount(patch, ~double, count)) & (2 * np.abs(votes) > size)
    sign = np.where(2 * alike >= size, 1.0, -1.0)
    sign = np.where(closed & (volume != 0), np.sign(volume), sign)
    sign = np.where(agreed, np.sign(votes), sign)
    turned = changed[patch] & (like_first != (sign > 0)[patch])
    if has_normals:
        turned &= double
    if len(kept) == len(faces) and not turned.any():
        return None
    tally.twice += len(faces) - len(kept)
    tally.turned += int((turned & ~double).sum())
    # The other side, as the file has it, with its own normals and colours.
    swapped = turned & double
    kept[swapped] = other[kept[swapped]]
    turned &= ~double
    order = np.argsort(kept)
    return Wound(kept[order], turned[order])


def _repetitions(faces: np.ndarray, both_sides: bool) -> tuple[np.ndarray, np.ndarray]:
    """(T,) bool, the first of the faces that have the same corners; and (T,), the first opposite one of each, or −1.

    Faces of the same corners in opposite directions are different with `both_sides`. So are faces with a corner twice.
    """
    ordered = np.sort(faces, axis=1)
    # Which of its rotations is ascending, if any, tells the direction of a face.
    a, b, c = faces.T
    direct = ((a < b) & (b < c)) | ((b < c) & (c < a)) | ((c < a) & (a < b))
    proper = (ordered[:, 0] < ordered[:, 1]) & (ordered[:, 1] < ordered[:, 2])
    keys = [direct, ordered[:, 2], ordered[:, 1], ordered[:, 0]]
    order = np.lexsort(keys)  # Stable: of equal ones the first comes first.
    same = (np.diff(ordered[order], axis=0) == 0).all(axis=1) & proper[order][1:]
    same_way = same & (direct[order][1:] == direct[order][:-1])
    begins = np.append(True, ~same_way)[: len(faces)]
    first, other = np.zeros(len(faces), bool), np.full(len(faces), -1)
    first[order[begins]] = True
    if not both_sides:  # At most two directions stand one after the other.
        heads = order[begins]
        paired = np.flatnonzero((same & ~same_way)[np.flatnonzero(begins)[1:] - 1])
        low, high = np.sort([heads[paired], heads[paired + 1]], axis=0)
        first[high] = False
        other[low] = high
    return first, other


def _patches(faces: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The patch of each face (K,); (K,) bool, True where it is wound as the first of its patch; patches closed (P,).

    Faces of patches with one side only are all said to be wound alike.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    count = len(faces)
    edges = faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    owner = np.repeat(np.arange(count), 3)
    proper = (faces != np.roll(faces, 1, axis=1)).all(axis=1)
    edges, owner = edges[proper[owner]], owner[proper[owner]]
    upward = edges[:, 0] < edges[:, 1]
    key = edges.min(axis=1) * (faces.max(initial=0) + 1) + edges.max(axis=1)
    order = np.argsort(key, kind="stable")
    begins = np.flatnonzero(np.append(True, np.diff(key[order]) != 0)[: len(order)])
    lengths = np.diff(np.append(begins, len(order)))
    pairs = begins[lengths == 2]
    one, two = order[pairs], order[pairs + 1]
    same = upward[one] == upward[two]  # Neighbours that are wound alike go along their edge in opposite directions.
    one, two = owner[one], owner[two]
    # Each face is there twice, as it is and turned over; a patch is two components then, one the other turned over.
    start = np.concatenate([one, one + count])
    end = np.concatenate([two + count * same, two + count * ~same])
    graph = coo_array((np.ones(len(start), bool), (start, end)), shape=(2 * count, 2 * count))
    label = connected_components(graph, directed=False)[1]
    _, first, patch = np.unique(np.minimum(label[:count], label[count:]), return_index=True, return_inverse=True)
    patch = patch.reshape(-1)
    like_first = (label[:count] == label[first[patch]]) | (label[:count] == label[count:])
    joined = np.bincount(one, minlength=count) + np.bincount(two, minlength=count)
    closed = np.bincount(patch, joined < 3, len(first)) == 0
    return patch, like_first, closed


def _volumes(vertices: np.ndarray, faces: np.ndarray, patch: np.ndarray, count: int) -> np.ndarray:
    """Six times the volume (K,) of the tetrahedron below each face, whose tip is the middle of its patch."""
    corners = vertices.astype(np.float64)[faces]
    size = np.maximum(np.bincount(patch, minlength=count), 1)
    middle = np.stack([np.bincount(patch, x, count) for x in corners.mean(axis=1).T], axis=1) / size[:, None]
    a, b, c = np.moveaxis(corners - middle[patch][:, None], 1, 0)
    return (a * np.cross(b, c)).sum(axis=1)
