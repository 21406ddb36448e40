"""The world in which a mesh is fitted: its origin is where cameras look, its unit the radius that all of them see."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

import rts


class World(NamedTuple):
    """A world's origin (3,) and unit in the world of the data set."""

    center: np.ndarray
    unit: float

    def camera(self, camera: rts.Camera) -> rts.Camera:
        """A camera of the data set's world, in this one: it sees the same."""
        view, projection = (np.array(m, np.float64) for m in (camera.view, camera.projection))
        view[:3, 3] = (view[:3, :3] @ self.center + view[:3, 3]) / self.unit
        projection[:, :3] *= self.unit  # Of a point of camera space; clip space has no scale.
        return camera.replace(view=view, projection=projection / self.unit)

    def outside(self, points: np.ndarray) -> np.ndarray:
        """Points (V, 3) of this world in that of the data set, float64."""
        return self.center + self.unit * np.asarray(points, np.float64)

    def inside(self, points: np.ndarray) -> np.ndarray:
        """Points (V, 3) of the data set's world in this one, float64."""
        return (np.asarray(points, np.float64) - self.center) / self.unit

    def motion(self, matrix: np.ndarray) -> np.ndarray:
        """A rigid motion (4, 4) of this world, as one of the data set's."""
        moved = np.array(matrix, np.float64)
        moved[:3, 3] = self.unit * moved[:3, 3] + self.center - moved[:3, :3] @ self.center
        return moved


def around(cameras: Sequence[rts.Camera]) -> World:
    """The world about the point nearest to all optical axes, with the radius of a ball that all cameras see.

    Where axes are almost parallel, as of cameras on a rail, that point is before them, as far as they are apart.

    Raises:
        InputError: all cameras stand in one place, or no camera looks at the point.
    """
    views = np.array([np.asarray(camera.view, np.float64) for camera in cameras])
    to_world = np.linalg.inv(views)
    eyes, axes = to_world[:, :3, 3], -to_world[:, :3, 2]
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    if np.ptp(eyes, axis=0).max() <= 1e-9 * max(np.abs(eyes).max(), 1e-9):
        raise rts.InputError(
            f"the cameras of all {len(eyes)} views stand in one place, {np.round(eyes[0], 3).tolist()}; expected "
            "pictures from several sides"
        )
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    weak = 1e-6 * np.eye(3)  # Along axes that are parallel, the mean of the eyes counts.
    center = np.linalg.solve(
        across.mean(axis=0) + weak, np.einsum("bij,bj->i", across, eyes) / len(eyes) + weak @ eyes.mean(axis=0)
    )
    depths = np.einsum("bi,bi->b", center - eyes, axes)
    seen = depths > 0
    if seen.sum() < 2:
        raise rts.InputError(
            f"the cameras look away from the point nearest to their axes, {np.round(center, 3).tolist()}; expected "
            "cameras that look at one object from several sides (are the poses camera-to-world?)"
        )
    # The angle from the axis to the nearest side of the picture.
    tangents = np.array([1 / max(abs(camera.projection[0, 0]), abs(camera.projection[1, 1])) for camera in cameras])
    radii = depths * np.sin(np.arctan(tangents))
    return World(center, float(np.median(radii[seen])))
