"""The time of a step of Levenberg–Marquardt, beside a loss with its gradient."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import numpy as np

import rts
from benchmarks.speed.pose_iteration import Task
from benchmarks.timing import START, in_turn
from rts.arrays.engines import engine_of, namespace
from rts.fitting.normal_equations import normal_equations

UNKNOWNS = (6, 12)


def transform(x: Any) -> Any:
    """(4, 4) of six unknowns, a rigid pose, or twelve, the entries of an affine map less the identity's."""
    if x.shape[0] == 6:
        return rts.rigid(x)
    xp = namespace(x)
    return xp.concat([xp.reshape(x, (3, 4)), xp.zeros_like(x[None, :4])]) + engine_of(x).constant(np.eye(4), x)


def levenberg_marquardt(task: Task, engine: str, unknowns: int) -> dict[str, Callable[[], object]]:
    """A loss with its gradient, and a step: solution, loss and normal equations at the trial, which is accepted."""
    x = np.zeros(unknowns, np.float32)
    x[:6] = np.multiply(START, 0.2)
    start: Any
    if engine == "torch":
        import torch

        start = torch.from_numpy(x)
    else:
        import jax.numpy as jnp

        start = jnp.asarray(x)
    library = engine_of(start)

    def scene(v: Any) -> rts.Part:
        return task.part.replace(transform=transform(v))

    options = {"loss": task.reduction.name, "f_scale": task.reduction.f_scale}
    residuals = rts.ImageResiduals(
        scene, task.view, task.size, task.target, splatter=task.splatter, layers=task.layers, **options
    )
    descend = library.jit(library.value_and_grad(lambda v: task.reduction(residuals(v))))

    def step_of(equations: Callable) -> Callable[[], object]:
        linearize = library.jit(equations)

        def at(v: Any) -> list[np.ndarray]:
            return [library.to_numpy(a).astype(np.float64) for a in linearize(v)]

        _, matrix, gradient = at(start)

        def step() -> object:
            delta = -np.linalg.solve(matrix + 1e-3 * np.diag(np.diag(matrix)), gradient)
            return at(start + library.constant(delta, start))

        return step

    return {
        "forward and gradient": lambda: library.block(descend(start)),
        "step": step_of(residuals.normal_equations),
        "step by the Jacobian": step_of(lambda v: normal_equations(residuals, v, library, task.reduction)),
    }


def measure(tasks: Iterable[Task], engines: tuple[str, ...], rounds: int, done: Callable[[], None]) -> list[dict]:
    """Rows of the results: with 6 and 12 unknowns."""
    rows = []
    for task in tasks:
        for engine in engines:
            for unknowns in UNKNOWNS:
                times = in_turn(levenberg_marquardt(task, engine, unknowns), rounds)
                row = {"mesh": task.name, "faces": len(task.faces), "side": task.side, "engine": engine}
                rows.append(row | {"unknowns": unknowns, "times": times})
                done()
    return rows
