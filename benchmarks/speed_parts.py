"""Parts of the work by themselves: the splatters, what pruning saves, a step of Levenberg–Marquardt."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
from speed_tasks import ENGINES, START, Task, in_turn

import rts
from rts import splatting
from rts.engines import engine_of, namespace
from rts.fitting.least_squares import normal_equations

SPLATTERS = {"single": splatting.Single, "multi": splatting.Multi, "visible": splatting.Visible}
"""The specification of each registered name."""
SHADERS, UNKNOWNS = ("silhouette", "lambert"), (6, 12)
BUDGET = 2.0
"""Seconds of timed calls after which a splatter has had enough turns."""


# ----------------------------------------------------------------------------------------------------------- splatters


class Capture(rts.Splatter):
    """A splatter that keeps what it is given, of all layers."""

    def image(self, splats: rts.Splats) -> Any:
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

    positions, rgba, row, g = (torch.from_numpy(x) for x in (*given, g))

    def call() -> object:
        variables = positions.requires_grad_(True), rgba.requires_grad_(True)
        return torch.autograd.grad(splatter.splat(*variables, row), variables, g)

    return call


def jax_splat(splatter: Any, given: tuple[np.ndarray, ...], g: np.ndarray) -> Callable[[], object]:
    """The same, compiled."""
    import jax
    import jax.numpy as jnp

    @jax.jit
    def function(positions: Any, rgba: Any, row: Any, g: Any) -> Any:
        image, pull = jax.vjp(lambda p, c: splatter.splat(p, c, row), positions, rgba)
        return image, pull(g)

    arrays = [jnp.asarray(x) for x in (*given, g)]
    return lambda: jax.block_until_ready(function(*arrays))


def splat_rows(tasks: Iterable[Task], layers: tuple[int, ...], rounds: int, done: Callable[[], None]) -> list[dict]:
    """Forward and pullback of each splatter, specified and compiled, with torch and jax."""
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


# ------------------------------------------------------------------------------------------------------------- pruning


class Unpruned(rts.Splatter):
    """The default splatter, which does not say what it needs."""

    def __init__(self) -> None:
        self._splatter = rts.plugin("rts.splatters", "auto")()

    def image(self, splats: rts.Splats) -> Any:
        """See `rts.Splatter`."""
        return self._splatter.image(splats)

    def cropped(self, splats: rts.Splats) -> Any:
        """See `rts.Splatter`."""
        return self._splatter.cropped(splats)


def pruning_rows(tasks: Iterable[Task], engines: tuple[str, ...], rounds: int, done: Callable[[], None]) -> list[dict]:
    """Iterations with one layer, with two, and with two none of which is dropped."""
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


# ------------------------------------------------------------------------------------------------- Levenberg–Marquardt


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

    residuals = rts.ImageResiduals(scene, task.view, task.size, task.target, splatter=task.splatter, layers=task.layers)
    descend = library.jit(library.value_and_grad(lambda v: (residuals(v) ** 2).mean()))

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
        "step by the Jacobian": step_of(lambda v: normal_equations(residuals, v, library)),
    }


def lm_rows(tasks: Iterable[Task], engines: tuple[str, ...], rounds: int, done: Callable[[], None]) -> list[dict]:
    """With 6 and 12 unknowns."""
    rows = []
    for task in tasks:
        for engine in engines:
            for unknowns in UNKNOWNS:
                times = in_turn(levenberg_marquardt(task, engine, unknowns), rounds)
                row = {"mesh": task.name, "faces": len(task.faces), "side": task.side, "engine": engine}
                rows.append(row | {"unknowns": unknowns, "times": times})
                done()
    return rows
