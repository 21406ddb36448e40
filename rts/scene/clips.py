"""Clips: how nodes of a model move in time, by key frames."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

INTERPOLATIONS = ("LINEAR", "STEP", "CUBICSPLINE")
PATHS = {"translation": 3, "rotation": 4, "scale": 3}
"""The path of a channel → how many numbers it has; morph targets' "weights" have one a target."""
ALIKE = 0.9995
"""Cosine between quaternions from which on they are interpolated as vectors, since the arc's sine is nearly 0."""


@dataclass(frozen=True, eq=False)
class Channel:
    """The motion of one property of a node.

    Attributes:
        node: the index of the node.
        path: "translation" (3,), "rotation" (4,), a quaternion x, y, z, w; "scale" (3,), or "weights" (M,) of morph
            targets.
        times: (K,) float64, the key frames' seconds, increasing.
        values: (K, C) float64, a row for each time; of "CUBICSPLINE" (K, 3, C): tangent before it, value, tangent
            after it.
        interpolation: between key frames "LINEAR", along the arc for rotations, "STEP" or "CUBICSPLINE".
    """

    node: int
    path: str
    times: np.ndarray
    values: np.ndarray
    interpolation: str = "LINEAR"

    def at(self, time: float) -> np.ndarray:
        """The value (C,) at a time in seconds; before the first key frame the first value, and after the last the last.

        Quaternions have length 1.
        """
        keys = self.values if self.interpolation != "CUBICSPLINE" else self.values[:, 1]
        i = int(np.searchsorted(self.times, time, side="right")) - 1
        if i < 0 or i >= len(keys) - 1:
            return self._normalized(keys[max(i, 0)])
        step = self.times[i + 1] - self.times[i]
        t = (time - self.times[i]) / step
        if self.interpolation == "STEP":
            return self._normalized(keys[i])
        if self.interpolation == "CUBICSPLINE":
            after, before = step * self.values[i, 2], step * self.values[i + 1, 0]
            cubic, square = t * t * t, t * t
            first, last = 2 * cubic - 3 * square + 1, 3 * square - 2 * cubic
            return self._normalized(
                first * keys[i] + (cubic - 2 * square + t) * after + last * keys[i + 1] + (cubic - square) * before
            )
        if self.path == "rotation":
            return _slerp(self._normalized(keys[i]), self._normalized(keys[i + 1]), t)
        return (1 - t) * keys[i] + t * keys[i + 1]

    def _normalized(self, value: np.ndarray) -> np.ndarray:
        return value / max(float(np.linalg.norm(value)), 1e-30) if self.path == "rotation" else value


@dataclass(frozen=True, eq=False)
class Clip:
    """A named motion of a model.

    Attributes:
        name: its name; "" where the file gives none.
        channels: the properties that move.
    """

    name: str
    channels: tuple[Channel, ...]

    @property
    def duration(self) -> float:
        """Seconds up to the last key frame."""
        return max((float(c.times[-1]) for c in self.channels), default=0.0)


def _slerp(a: np.ndarray, b: np.ndarray, t: float) -> np.ndarray:
    """The quaternion a share t along the shorter arc between two of length 1."""
    cosine = float(a @ b)
    if cosine < 0:
        b, cosine = -b, -cosine
    if cosine > ALIKE:
        mixed = (1 - t) * a + t * b
    else:
        angle = np.arccos(cosine)
        mixed = np.sin((1 - t) * angle) * a + np.sin(t * angle) * b
    return mixed / np.linalg.norm(mixed)


def node_matrix(translation: np.ndarray, rotation: np.ndarray, scale: np.ndarray) -> np.ndarray:
    """The matrix (4, 4) that scales, then rotates, then shifts.

    Args:
        translation: (3,).
        rotation: (4,) a quaternion x, y, z, w, of any length but 0.
        scale: (3,).
    """
    x, y, z, w = rotation * np.sqrt(2 / (rotation @ rotation))
    matrix = np.eye(4)
    matrix[:3, :3] = [
        [1 - y * y - z * z, x * y - z * w, x * z + y * w],
        [x * y + z * w, 1 - x * x - z * z, y * z - x * w],
        [x * z - y * w, y * z + x * w, 1 - x * x - y * y],
    ]
    matrix[:3, :3] *= scale
    matrix[:3, 3] = translation
    return matrix
