"""Meshes to start from: a ball, the visual hull of masks, or a file."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any, cast

import numpy as np
import scipy.ndimage
import trimesh

import rts
from rts_reconstruct.pictures import Pictures
from rts_reconstruct.points import visible

RADIUS = 0.57
"""The ball's radius, as a share of that of a ball that all cameras see."""
LATTICE, REACH = 64, 1.1
"""Points of a hull's lattice along each axis, and how far it reaches from the origin."""
CLOSED = 5
"""The width of a window, in points of the lattice; gaps of a hull that it does not fit into are filled."""


def start(kind: str | Path | None, pictures: Pictures) -> trimesh.Trimesh:
    """A mesh to start from, in the world of the pictures.

    Args:
        kind: "ball", "hull", "points", or the path of a mesh in the world of the data set; None for "points" where
            these tell a solid, else "ball".
        pictures: the pictures.

    Raises:
        InputError: a hull of pictures that do not tell the object, or whose masks have nothing in common; a file that
            cannot be read; or a mesh that no view sees.
    """
    if kind is None:
        kind = "ball" if pictures.solid is None else "points"
    if str(kind) == "points":
        mesh = _of_points(pictures)
    elif str(kind) == "ball":
        mesh = trimesh.creation.icosphere(4, radius=RADIUS)
    elif str(kind) == "hull":
        mesh = hull(pictures)
    else:
        mesh = _of_file(kind, pictures)
    _check_seen(mesh.vertices, pictures.views)
    return mesh


def _of_points(pictures: Pictures) -> trimesh.Trimesh:
    if pictures.solid is None:
        raise rts.InputError(
            "start is 'points', and there are no points of COLMAP, or too few; expected a folder with sparse/0 (rts "
            "cameras makes one), and the extra photos, that is pycolmap"
        )
    return pictures.solid


def _of_file(path: str | Path, pictures: Pictures) -> trimesh.Trimesh:
    """A mesh of a file, with vertices that coincide as one."""
    parts = rts.load(path)
    if not all(hasattr(part.surface, "faces") for part in parts):
        raise rts.InputError(f"{path} holds other surfaces than triangles; expected a mesh to start from")
    meshes = [trimesh.Trimesh(np.asarray(part.theta["vertices"]), part.surface.faces, process=False) for part in parts]
    mesh: Any = trimesh.util.concatenate(meshes)
    mesh = trimesh.Trimesh(pictures.world.inside(mesh.vertices), mesh.faces, process=False)
    mesh.merge_vertices(merge_tex=True, merge_norm=True)
    mesh.update_faces(mesh.nondegenerate_faces())
    mesh.remove_unreferenced_vertices()
    return mesh


def nothing_in_common() -> rts.InputError:
    """The error of masks whose visual hull is empty."""
    return rts.InputError(
        "the masks have no point in common; expected masks, or alpha, of one object, and cameras that fit them"
    )


def hull(pictures: Pictures) -> trimesh.Trimesh:
    """The largest piece of the space that no mask excludes (Laurentini 1994), by marching cubes.

    Raises:
        InputError: pictures that do not tell the object, or whose masks have nothing in common.
    """
    if not pictures.outlined:
        raise rts.InputError(
            "start is 'hull', which needs to know where the object is; the pictures have neither alpha nor masks: "
            "add masks, or start from 'ball' or a mesh"
        )
    # A mesh whose thin tunnels close has walls that cross, and cannot lose the tunnel.
    least = scipy.ndimage.grey_closing(least_alpha(pictures, LATTICE), size=(CLOSED,) * 3)
    values = scipy.ndimage.gaussian_filter(least, 0.7)
    labels, count = cast(Any, scipy.ndimage.label(values > 0.5))
    if count == 0:
        raise nothing_in_common()
    largest = 1 + int(np.argmax(np.bincount(labels.ravel())[1:]))
    values = np.where(scipy.ndimage.binary_dilation(labels == largest), values, 0)
    bounds = (-REACH,) * 3, (REACH,) * 3
    surface = rts.plugin("surfaces", "isosurface")(bounds, 0.5, inside="above")
    found = surface.extract({"values": values.astype(np.float32)})
    mesh = trimesh.Trimesh(found.vertices, found.faces)
    return max(mesh.split(only_watertight=False), key=lambda piece: len(piece.faces))


def lattice_points(count: int) -> np.ndarray:
    """The points (count³, 3) of a lattice that reaches as far as a hull's."""
    axis = np.linspace(-REACH, REACH, count)
    return np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)


def least_alpha(pictures: Pictures, count: int) -> np.ndarray:
    """The least alpha (count, count, count) of the views that see a lattice's points; 0 where fewer than two do."""
    points = lattice_points(count)
    least, seen = np.ones(len(points)), np.zeros(len(points), int)
    for view in pictures.views:
        alpha = view.image[..., 3]
        if view.mask is not None:
            alpha = np.where(view.mask < 0.5, 1, alpha)  # Pixels that do not count exclude nothing.
        x, y = np.moveaxis(np.asarray(view.camera.project(points, view.size)), -1, 0)[:2]
        inside = visible(view, points)
        found = scipy.ndimage.map_coordinates(alpha, [y[inside] - 0.5, x[inside] - 0.5], order=1, mode="nearest")
        least[inside] = np.minimum(least[inside], found)
        seen += inside
    least[seen < 2] = 0  # Space that nobody looks into is no object.
    return least.reshape((count,) * 3)


def _check_seen(vertices: np.ndarray, views: Sequence[rts.View]) -> None:
    """Refuse a start that no view sees; warn of views that see nothing of it."""
    blind = [i for i, view in enumerate(views) if not visible(view, np.asarray(vertices)).any()]
    if len(blind) == len(views):
        low, high = np.asarray(vertices).min(axis=0), np.asarray(vertices).max(axis=0)
        raise rts.InputError(
            f"none of {len(views)} views sees anything of the start, which lies between {np.round(low, 2).tolist()} "
            f"and {np.round(high, 2).tolist()} (1 is what all cameras see); check the cameras, or give another start"
        )
    if blind:
        names = ", ".join(str(views[i].name or i) for i in blind[:3]) + (", …" if len(blind) > 3 else "")
        warnings.warn(f"{len(blind)} of {len(views)} views see nothing of the start: {names}", rts.errors.RtsWarning, 3)
