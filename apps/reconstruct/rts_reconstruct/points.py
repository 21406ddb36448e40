"""COLMAP's points of a scene: where the object is, how far cameras go around it, how far a mesh is from them."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import scipy.sparse
from scipy.spatial import KDTree

import rts
from rts_reconstruct.world import World

SHARE = 0.5
"""The share of cameras in whose pictures a point must lie to be looked at."""
NEIGHBOUR, REACH = 8, 3
"""Points are joined that are nearer than so many times the median distance of a point's eighth neighbour."""
MARGIN = 1.05
"""The radius of the region, in those of the points."""
FEWEST = 100
"""Fewer points tell no object."""
RIM = 0.97
"""Points beyond this share of the region's radius are not measured: the mesh is cut there."""


class Points(NamedTuple):
    """Points (N, 3) of a scene; `rows` (M,) of those that cameras see, and `eyes` (M, 3), places of these cameras."""

    positions: np.ndarray
    rows: np.ndarray
    eyes: np.ndarray

    def inside(self, world: World) -> Points:
        """The points in another world."""
        return Points(world.inside(self.positions), self.rows, world.inside(self.eyes))


def read(path: Any) -> Points | None:
    """The points of a data set of COLMAP; None for other data sets, and where pycolmap is missing."""
    model = _model_of(path)
    if model is None:
        return None
    try:
        import pycolmap

        scene = pycolmap.Reconstruction(model)
    except ImportError:
        return None
    except (ValueError, RuntimeError, OSError) as error:
        warnings.warn(f"{model} has points that cannot be read ({error!s:.80})", rts.errors.RtsWarning, 3)
        return None
    eyes = {number: image.projection_center() for number, image in scene.images.items() if image.has_pose}
    seen = [
        (row, eyes[element.image_id])
        for row, point in enumerate(scene.points3D.values())
        for element in point.track.elements
    ]
    if not seen:
        return None
    positions = np.array([point.xyz for point in scene.points3D.values()])
    return Points(positions, np.array([row for row, _ in seen]), np.array([eye for _, eye in seen]))


def check_readable(path: Any) -> None:
    """Refuse a data set whose points are needed, and that COLMAP's Python package, which is missing, would read.

    Raises:
        PluginError: pycolmap is missing (extra `photos`).
    """
    if _model_of(path) is None:
        return
    try:
        import pycolmap  # noqa: F401
    except ImportError:
        raise rts.errors.PluginError(
            f"{path} has points that tell the object, as neither alpha nor masks do; pycolmap reads them: pip install "
            "-c constraints.txt './apps/reconstruct[photos]' (or give --background)"
        ) from None


def _model_of(path: Any) -> Path | None:
    """The folder with the points of a data set of COLMAP; None if there is none."""
    if not isinstance(path, (str, Path)):
        return None
    folder = Path(path) if Path(path).is_dir() else Path(path).parent
    places = (folder / "sparse" / "0", folder / "sparse", folder)
    return next((p for p in places if (p / "points3D.bin").is_file() or (p / "points3D.txt").is_file()), None)


def region(points: Points, views: Sequence[rts.View]) -> World | None:
    """The ball about the densest points that half of the cameras or more look at; None if there are too few."""
    seen = np.zeros(len(points.positions))
    for view in views:
        seen += visible(view, points.positions)
    known = points.positions[seen >= SHARE * len(views)]
    if len(known) < FEWEST:
        return None
    tree = KDTree(known)
    reach = REACH * float(np.median(tree.query(known, k=NEIGHBOUR + 1)[0][:, -1]))
    pairs = tree.query_pairs(reach, output_type="ndarray")
    graph = scipy.sparse.coo_array((np.ones(len(pairs)), tuple(pairs.T)), (len(known),) * 2)
    labels = scipy.sparse.csgraph.connected_components(graph, directed=False)[1]
    known = known[labels == np.bincount(labels).argmax()]
    if len(known) < FEWEST:
        return None
    center = np.percentile(known, [1, 99], axis=0).mean(axis=0)
    return World(center, MARGIN * float(np.percentile(np.linalg.norm(known - center, axis=1), 98)))


def visible(view: rts.View, points: np.ndarray) -> np.ndarray:
    """True for points (N, 3) that lie before the camera, within its picture."""
    pixels = np.asarray(view.camera.project(points, view.size))[..., :2]
    height, width = view.size
    before = np.asarray(view.camera.depth(points)) > 0
    return before & ((pixels >= 0) & (pixels <= (width, height))).all(axis=-1)


def span(views: Sequence[rts.View], center: np.ndarray) -> float:
    """The largest angle between two cameras as a point (3,) sees them, degrees."""
    ways = np.array([np.linalg.inv(np.asarray(view.camera.view, np.float64))[:3, 3] for view in views]) - center
    ways /= np.maximum(np.linalg.norm(ways, axis=1, keepdims=True), 1e-12)
    return float(np.degrees(np.arccos(np.clip(ways @ ways.T, -1, 1)).max()))


def distances(points: Points, region: World, vertices: np.ndarray, faces: np.ndarray) -> tuple[float, float] | None:
    """Median and 90th percentile of the distances of a region's points from a mesh, % of the mesh's diagonal.

    All are in the world of the data set. None where fewer than `FEWEST` points are in the region.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # Its import takes old names of SciPy.
        from gpytoolbox import squared_distance
    known, corners = (region.inside(x) for x in (points.positions, vertices))
    known = known[np.linalg.norm(known, axis=1) < RIM]
    if len(known) < FEWEST:
        return None
    away = np.sqrt(squared_distance(known, corners, faces, use_cpp=True)[0])
    median, most = np.percentile(away, [50, 90]) / np.linalg.norm(np.ptp(corners, axis=0))
    return 100 * float(median), 100 * float(most)
