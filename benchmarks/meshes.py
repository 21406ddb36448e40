"""The meshes of the benchmarks: files of the test data, normalised and rotated, some subdivided.

The files are in the folder that the variable RTS_DATA names, default ../shared/data beside the repository. Nothing here
imports rts, since processes that use another commit of it need meshes too.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

DATA = Path(os.environ.get("RTS_DATA", Path(__file__).resolve().parents[2] / "shared" / "data"))
BASE_ROTATIONS = {"teapot": (0.35, 0.5), "bunny": (0.1, 0.4)}
OTHER_ROTATION = (0.2, 0.4)

MESHES = {
    "teapot_2464": ("teapot_2464", 0),
    "teapot": ("teapot", 0),
    "bunny": ("bunny", 0),
    "spot": ("spot/spot_triangulated", 3),
    "nefertiti": ("nefertiti", 2),
}
"""What time is measured on: file and number of midpoint subdivisions: 2.5K, 6K, 69K, 375K and 1.6M faces."""


def rotation_xy(ax: float, ay: float) -> np.ndarray:
    """R_x(ax) · R_y(ay) (3, 3), radians."""
    cx, sx, cy, sy = np.cos(ax), np.sin(ax), np.cos(ay), np.sin(ay)
    return np.array([[1, 0, 0], [0, cx, -sx], [0, sx, cx]]) @ np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]])


def normalised(vertices: np.ndarray) -> np.ndarray:
    """Vertices about the centre of their bounding box, the farthest at distance 1."""
    vertices = vertices - (vertices.min(0) + vertices.max(0)) / 2
    return vertices / np.linalg.norm(vertices, axis=1).max()


def mesh(name: str) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V, 3), normalised and base-rotated, and faces (T, 3) of a file of the test data."""
    import trimesh

    path = DATA / "meshes" / f"{name}.obj"
    if not path.exists():
        raise SystemExit(f"{path} is missing; set RTS_DATA to the folder of the test data")
    loaded: Any = trimesh.load(path, process=False, force="mesh")
    rotation = rotation_xy(*BASE_ROTATIONS.get(name.split("_")[0], OTHER_ROTATION))
    return normalised(np.asarray(loaded.vertices)) @ rotation.T, np.asarray(loaded.faces)


def subdivided(vertices: np.ndarray, faces: np.ndarray, times: int) -> tuple[np.ndarray, np.ndarray]:
    """The mesh with each triangle cut into four at its edges' midpoints, some times over."""
    import trimesh

    for _ in range(times):
        vertices, faces = trimesh.remesh.subdivide(vertices, faces)
    return vertices, faces


def welded(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The mesh with one vertex a place, in their order: a seam of textures is no edge of the surface."""
    _, first, inverse = np.unique(vertices, axis=0, return_index=True, return_inverse=True)
    order = np.argsort(first)
    rank = np.empty(len(order), np.int64)
    rank[order] = np.arange(len(order))
    return vertices[first[order]], rank[inverse.reshape(-1)][faces]


def kept_mesh(name: str, folder: Path, weld: Callable = welded) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V, 3) float32 and faces (T, 3) int32 of one of MESHES, without seams; kept in the folder.

    Args:
        name: of the mesh.
        folder: of files that were made before, and of this one.
        weld: vertices and faces → the same with one vertex a place.
    """
    path = folder / f"{name}.npz"
    if not path.exists():
        file, times = MESHES[name]
        vertices, faces = subdivided(*weld(*mesh(file)), times)
        folder.mkdir(parents=True, exist_ok=True)
        np.savez(path, vertices=np.asarray(vertices, np.float32), faces=np.asarray(faces, np.int32))
    kept = np.load(path)
    return kept["vertices"], kept["faces"]
