"""The scenes that figures are compared on: real meshes, normalised and rotated, one camera.

Meshes are found in the folder that the variable RTS_DATA names, default ../shared/data.
"""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

import rts

DATA = Path(os.environ.get("RTS_DATA", Path(__file__).resolve().parents[2] / "shared" / "data"))
BASE_ROTATIONS = {"teapot": (0.35, 0.5), "bunny": (0.1, 0.4)}
OTHER_ROTATION = (0.2, 0.4)
FOV, DISTANCE = 40.0, 3.2


def rotation_xy(ax: float, ay: float) -> np.ndarray:
    """R_x(ax) · R_y(ay) (3, 3), radians."""
    cx, sx, cy, sy = np.cos(ax), np.sin(ax), np.cos(ay), np.sin(ay)
    return np.array([[1, 0, 0], [0, cx, -sx], [0, sx, cx]]) @ np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]])


def normalised(vertices: np.ndarray) -> np.ndarray:
    """Vertices about the centre of their bounding box, the farthest at distance 1."""
    vertices = vertices - (vertices.min(0) + vertices.max(0)) / 2
    return vertices / np.linalg.norm(vertices, axis=1).max()


def mesh(name: str) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V, 3), normalised and base-rotated, and faces (T, 3) of a mesh of the data folder."""
    import trimesh

    path = DATA / "meshes" / f"{name}.obj"
    if not path.exists():
        raise SystemExit(f"{path} is missing; set RTS_DATA to the folder of the test data")
    loaded = trimesh.load(path, process=False, force="mesh")
    rotation = rotation_xy(*BASE_ROTATIONS.get(name.split("_")[0], OTHER_ROTATION))
    return normalised(np.asarray(loaded.vertices)) @ rotation.T, np.asarray(loaded.faces)


def camera(eye=(0.0, 0.0, DISTANCE)) -> rts.Camera:
    """40° at distance 3.2, near 0.5, far 10."""
    return rts.Camera.look_at(eye, (0, 0, 0), fov_y=FOV, near=0.5, far=10.0)


def pixel(depth: float, size: int) -> float:
    """World width of one pixel at a depth."""
    return 2 * depth * np.tan(np.radians(FOV / 2)) / size


def translation(offset) -> np.ndarray:
    """(4, 4) of a translation."""
    matrix = np.eye(4)
    matrix[:3, 3] = offset
    return matrix


def regular_grid(samples: int) -> np.ndarray:
    """`samples`² points (S, 2) of a pixel, from its centre, in pixels: the centres of equal cells."""
    steps = (np.arange(samples) + 0.5) / samples - 0.5
    return np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)


def supersampled(parts, view: rts.Camera, size: tuple[int, int], samples: int | np.ndarray, **options) -> np.ndarray:
    """Hard render, the mean over points of each pixel (H, W, 4); NumPy parts only.

    `samples` are the points (S, 2), x right and y down of the pixel's centre in pixels, or the side of a regular grid.
    """
    total = 0.0
    points = regular_grid(samples) if isinstance(samples, int) else samples
    for dx, dy in points:
        shift = np.eye(4)
        # Moving the image by −dx pixels puts the point at +dx under the pixel's centre.
        shift[0, 3], shift[1, 3] = -2 * dx / size[1], 2 * dy / size[0]
        moved = view._replace(projection=shift @ view.projection)
        total = total + rts.render(parts, moved, size, splatter="none", layers=1, **options)
    return total / len(points)


def bunny_and_square() -> tuple[rts.Part, rts.Part]:
    """The green bunny and the red square behind it, both unlit."""
    surface = rts.plugin("rts.surfaces", "mesh")
    vertices, faces = mesh("bunny")
    bunny = surface(faces)
    green = 0.25 + 0.7 * np.maximum(0, bunny.vertex_normals(vertices) @ [0.4, 0.5, 0.77])
    colors = np.stack([np.zeros_like(green), green, np.zeros_like(green)], axis=-1)
    c, s = np.cos(0.03), np.sin(0.03)
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * 0.62 @ np.array([[c, s], [-s, c]])
    square = np.concatenate([corners + [0.35, 0.15], np.full((4, 1), -1.1)], axis=1)
    red = np.tile([0.8, 0.1, 0.1], (4, 1))
    return (
        rts.Part(bunny, {"vertices": vertices, "colors": colors}, "unlit"),
        rts.Part(surface([[0, 1, 2], [0, 2, 3]]), {"vertices": square, "colors": red}, "unlit"),
    )
