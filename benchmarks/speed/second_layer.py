"""The cost of a second layer in a pose iteration, and the saving by dropping its hidden samples."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import rts
from benchmarks.speed.pose_iteration import ENGINES, Task
from benchmarks.timing import in_turn
from rts.plugin_api.records import Splats

SHADERS = ("silhouette", "lambert")


class Unpruned(rts.Splatter):
    """The default splatter, which does not say what it needs."""

    def __init__(self) -> None:
        self._splatter = rts.plugin("rts.splatters", "auto")()

    def image(self, splats: Splats) -> Any:
        """See `rts.Splatter`."""
        return self._splatter.image(splats)

    def cropped(self, splats: Splats) -> Any:
        """See `rts.Splatter`."""
        return self._splatter.cropped(splats)


def measure(tasks: Iterable[Task], engines: tuple[str, ...], rounds: int, done: Callable[[], None]) -> list[dict]:
    """Rows of the results: iterations with one layer, with two, and with two none of which is dropped."""
    rows = []
    for task in tasks:
        for shader in SHADERS:
            kinds = {"K = 1": (1, "auto"), "K = 2": (2, "auto"), "K = 2, nothing dropped": (2, Unpruned())}
            for engine in engines:
                functions = {
                    name: ENGINES[engine](
                        Task(task.name, task.vertices, task.faces, task.side, shader, layers, splatter)
                    )
                    for name, (layers, splatter) in kinds.items()
                }
                row = {"mesh": task.name, "faces": len(task.faces), "side": task.side, "shader": shader}
                rows.append(row | {"engine": engine, "times": in_turn(functions, rounds)})
                done()
    return rows
