"""Poses from silhouettes of several views by DEODR's anti-aliased edges and Adam, for `benchmarks.basin`.

Its edges widen what they surround. So its targets are its own images of the truth: area-sampled ones would have their
best pose elsewhere, for the bunny 2° to 3° off, which is not what a basin is about.
"""

from __future__ import annotations

from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np

from benchmarks.camera import DISTANCE
from benchmarks.speed.other_renderers import SIGMA, Adam, Deodr, rotation


class DeodrViews:
    """A mesh that moves before some cameras which look at the origin from `DISTANCE`.

    Args:
        vertices: (V, 3).
        faces: (T, 3), counter-clockwise from outside.
        views: (4, 4) camera from world, one a view.
        side: pixels of the square images.
    """

    def __init__(self, vertices: np.ndarray, faces: np.ndarray, views: Sequence[np.ndarray], side: int):
        from deodr.differentiable_renderer_cython import renderSceneCpp

        self.vertices = vertices.astype(np.float64)
        self.turns = [view[:3, :3] for view in views]
        for view in views:
            np.testing.assert_allclose(view[:3, 3], [0, 0, -DISTANCE], atol=1e-9)
        task: Any = SimpleNamespace(vertices=vertices, faces=faces, side=side, target=np.zeros((side, side, 1)))
        self.scenes = [Deodr(task, full=True) for _ in views]
        self.value_and_gradient(np.zeros(6))  # Which puts the meshes in their places.
        for view in self.scenes:
            renderSceneCpp(view.scene, SIGMA, view.image, view.depth, False, None, None, False)
            view.target = view.image.copy()

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
