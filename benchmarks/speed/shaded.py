"""The pose iteration with colours: shaded by a light, or of a texture, beside the silhouette's."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import numpy as np

from benchmarks.speed.pose_iteration import ENGINES, Task
from benchmarks.timing import in_turn

LIGHT = (0.4, 0.6, 0.7)
"""Towards the light."""
TEXELS = 256
SHADERS = ("silhouette", "lambert", "textured")


def entries(shader: str, vertices: np.ndarray) -> dict[str, Any]:
    """Entries of θ: a light of no ambient part; or a texture of smooth noise, laid on from the front."""
    if shader == "lambert":
        return {"light": {"direction": np.float32(LIGHT), "ambient": np.float32(0)}}
    if shader == "textured":
        waves = np.add.outer(np.sin(np.arange(TEXELS) / 9), np.cos(np.arange(TEXELS) / 7))
        texture = 0.5 + 0.2 * np.stack([waves, waves.T, -waves], axis=-1)
        return {"texture": texture.astype(np.float32), "uv": (0.5 + 0.5 * vertices[:, :2]).astype(np.float32)}
    return {}


def iterations(name: str, vertices: np.ndarray, faces: np.ndarray, side: int, peers: bool) -> dict[str, Callable]:
    """An iteration of each shader by each engine, and DEODR's of a light."""
    found = {}
    for shader in SHADERS:
        task = Task(name, vertices, faces, side, shader, entries=entries(shader, vertices))
        for engine, make in ENGINES.items():
            found[f"{shader}, {engine}"] = make(task, "pose", "auto")
        if peers and shader != "textured":
            from benchmarks.speed.other_renderers import DeodrScene

            lit = LIGHT if shader == "lambert" else None
            found[f"{shader}, DEODR"] = DeodrScene(task, lit).step
    return found


def measure(tasks: Iterable[Task], rounds: int, peers: bool, done: Callable[[], None], budget: float) -> list[dict]:
    """Times of all methods, in turn, of the meshes and sizes of tasks."""
    rows = []
    for task in tasks:
        methods = iterations(task.name, task.vertices, task.faces, task.side, peers)
        times = in_turn(methods, rounds, done, budget)
        rows.append({"mesh": task.name, "faces": len(task.faces), "side": task.side, "times": times})
    return rows
