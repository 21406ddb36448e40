"""Poses from silhouettes of several views by DEODR's anti-aliased edges and Adam, for `benchmarks.basin`."""

from __future__ import annotations

from collections.abc import Sequence
from types import SimpleNamespace

import numpy as np

from benchmarks.camera import DISTANCE
from benchmarks.speed.other_renderers import Adam, Deodr, rotation


class DeodrViews:
    """A mesh that moves before some cameras which look at the origin from `DISTANCE`.

    Args:
        vertices: (V, 3).
        faces: (T, 3), counter-clockwise from outside.
        views: (4, 4) camera from world, one a view.
        goals: (S, S) silhouettes, one a view.
    """

    def __init__(
        self, vertices: np.ndarray, faces: np.ndarray, views: Sequence[np.ndarray], goals: Sequence[np.ndarray]
    ):
        self.vertices = vertices.astype(np.float64)
        self.turns = [view[:3, :3] for view in views]
        for view in views:
            np.testing.assert_allclose(view[:3, 3], [0, 0, -DISTANCE], atol=1e-9)
        tasks = [
            SimpleNamespace(vertices=vertices, faces=faces, side=goal.shape[0], target=goal[..., None])
            for goal in goals
        ]
        self.scenes = [Deodr(task, full=True) for task in tasks]  # pyright: ignore[reportArgumentType]

    def value_and_gradient(self, pose: np.ndarray) -> tuple[float, np.ndarray]:
        """Mean of the mean squares of the views, and its gradient in the pose (6,)."""
        matrix, slopes = rotation(pose[:3])
        moved, value, g_moved = self.vertices @ matrix.T + pose[3:], 0.0, np.zeros_like(self.vertices)
        for turn, scene in zip(self.turns, self.scenes, strict=True):
            # What the camera does to the world, the world does before a camera that stands still.
            scene.vertices = moved @ turn.T
            value += scene.value_and_gradient(np.zeros(6))[0] / len(self.scenes)
            g_moved += scene.vertex_gradient @ turn / len(self.scenes)
        turning = np.tensordot(slopes, g_moved.T @ self.vertices, 2)
        return value, np.concatenate([turning, g_moved.sum(axis=0)])

    def fit(self, pose: np.ndarray, steps: int, rate: float) -> tuple[np.ndarray, float, int]:
        """The best pose of some steps of Adam, its loss, and their number."""
        adam, best, lowest = Adam(rate), pose, np.inf
        for _ in range(steps):
            value, gradient = self.value_and_gradient(pose)
            if value < lowest:
                best, lowest = pose, value
            pose = adam.step(pose, gradient)
        return best, float(lowest), steps
