"""The time of a splatter by itself: image and gradients, the specification beside the compiled one."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import numpy as np

import rts
from benchmarks.speed.pose_iteration import Task
from benchmarks.timing import START, in_turn
from rts import splatting
from rts.arrays.engines import namespace
from rts.plugin_api.records import Splats

SPLATTERS = {"single": splatting.Single, "multi": splatting.Multi, "visible": splatting.Visible}
"""The specification of each registered name."""
BUDGET = 2.0
"""Seconds of timed calls after which a splatter has had enough turns."""


class Capture(rts.Splatter):
    """A splatter that keeps what it is given, of all layers."""

    def image(self, splats: Splats) -> Any:
        """See `rts.Splatter`."""
        self.given = splats.positions, splats.rgba, splats.row
        return namespace(splats.positions).zeros((*splats.row.shape[1:], 4), dtype=splats.positions.dtype)


def splats(task: Task, layers: int) -> tuple[np.ndarray, ...]:
    """Positions, rgba and row of the task's mesh at the start, with shades of grey for colours."""
    capture = Capture()
    part = task.posed(np.array(START, np.float32)).replace(shader="lambert")
    rts.render(part, task.view, task.size, splatter=capture, layers=layers, sampler="raster")
    positions, rgba, row = (np.array(x) for x in capture.given)
    return positions.astype(np.float32), rgba.astype(np.float32), row


def torch_splat(splatter: Any, given: tuple[np.ndarray, ...], g: np.ndarray) -> Callable[[], object]:
    """Image and both gradients."""
    import torch

    positions, rgba, row, weights = (torch.from_numpy(x) for x in (*given, g))

    def call() -> object:
        variables = positions.requires_grad_(True), rgba.requires_grad_(True)
        return torch.autograd.grad(splatter.splat(*variables, row), variables, weights)

    return call


def jax_splat(splatter: Any, given: tuple[np.ndarray, ...], g: np.ndarray) -> Callable[[], object]:
    """The image of splats in jax, compiled."""
    import jax
    import jax.numpy as jnp

    @jax.jit
    def function(positions: Any, rgba: Any, row: Any, g: Any) -> Any:
        image, pull = jax.vjp(lambda p, c: splatter.splat(p, c, row), positions, rgba)
        return image, pull(g)

    arrays = [jnp.asarray(x) for x in (*given, g)]
    return lambda: jax.block_until_ready(function(*arrays))


def measure(tasks: Iterable[Task], layers: tuple[int, ...], rounds: int, done: Callable[[], None]) -> list[dict]:
    """Rows of the results: forward and pullback of each splatter, specified and compiled, with torch and jax."""
    rows = []
    for task in tasks:
        for k in layers:
            given = splats(task, k)
            g = np.random.default_rng(0).normal(size=(*given[2].shape[1:], 4)).astype(np.float32)
            for name, specification in SPLATTERS.items():
                kinds = {"specification": specification(), "compiled": rts.plugin("rts.splatters", name)()}
                functions = {
                    f"{engine}, {kind}": make(splatter, given, g)
                    for kind, splatter in kinds.items()
                    for engine, make in (("torch", torch_splat), ("jax", jax_splat))
                }
                row = {"mesh": task.name, "side": task.side, "layers": k, "splatter": name, "samples": len(given[0])}
                rows.append(row | {"times": in_turn(functions, rounds, budget=BUDGET)})
                done()
    return rows
