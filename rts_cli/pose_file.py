"""The file of a pose and its camera, which `rts fit-pose` writes and `rts render --pose` reads."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rts import Camera, Part
from rts.errors import InputError
from rts.plugin_api.arrays import Array
from rts.plugin_api.checks import check_numbers
from rts.tool_api.operations import matmul
from rts.tool_api.scenes import check_pixels, is_invertible


class ModelPose(NamedTuple):
    """The pose of a model, and the camera that sees it.

    Attributes:
        matrix: (4, 4) world from the model as loaded.
        camera: the camera, with its ratio of width to height.
        size: (height, width) of its image, pixels.
    """

    matrix: np.ndarray
    camera: Camera
    size: tuple[int, int]

    @property
    def fov_y(self) -> float:
        """The camera's vertical field of view, degrees."""
        return math.degrees(2 * math.atan(1 / self.camera.projection[1, 1]))

    def numbers(self) -> dict[str, Any]:
        """The entries of a pose in JSON."""
        view, projection = self.camera
        return {
            "matrix": self.matrix.tolist(),
            "size": list(self.size),
            "fov_y": self.fov_y,
            "camera": {"view": view.tolist(), "projection": projection.tolist(), "aspect": self.camera.aspect},
        }


def read_pose(path: Path) -> ModelPose:
    """The pose in a file of JSON with a `matrix`, a `size`, and a `camera` of `view` and `projection`.

    Raises:
        InputError: there is no such file, it is not JSON, or an entry is missing or wrong.
    """
    if not path.is_file():
        raise InputError(f"no file {path}; expected the pose.json that `rts fit-pose` writes")
    try:
        entries = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(f"{path} cannot be read as JSON ({' '.join(str(error).split())[:80]})") from error
    try:
        return _pose(entries)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error


def _pose(entries: Any) -> ModelPose:
    camera = _entry(entries, "camera")
    matrices = {"matrix": _entry(entries, "matrix")}
    matrices |= {name: _entry(camera, name) for name in ("view", "projection")}
    for name, matrix in matrices.items():
        values = check_numbers(name, matrix, (4, 4))
        if values is None or not is_invertible(values):
            raise InputError(f"{name} is singular; expected an invertible matrix")
        matrices[name] = np.asarray(values, np.float64)
    size = check_pixels(_entry(entries, "size"))
    aspect = camera.get("aspect")
    if aspect is not None:
        check_numbers("aspect", aspect, ())
    return ModelPose(matrices["matrix"], Camera(matrices["view"], matrices["projection"], aspect), size)


def _entry(entries: Any, name: str) -> Any:
    if not isinstance(entries, dict) or name not in entries:
        raise InputError(f"there is no entry {name!r}; expected the pose.json that `rts fit-pose` writes")
    return entries[name]


def posed(parts: Sequence[Part], transform: Array, shader: Any = None) -> list[Part]:
    """The parts moved by a transform (4, 4) after their own, in world space; `shader` replaces theirs unless None."""
    return [
        part.replace(
            transform=transform if part.transform is None else matmul(transform, part.transform),
            shader=shader or part.shader,
        )
        for part in parts
    ]
