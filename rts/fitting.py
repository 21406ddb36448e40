"""Fitting parameters to images: Adam, SGD and Levenberg–Marquardt on any differentiable render."""

from __future__ import annotations

import contextlib
import math
import sys
import time
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np

from rts.arrays import engine_of, is_constant, leaves, map_leaves, namespace
from rts.errors import InputError
from rts.protocols import Array, Engine, Tree

STEPS = {"adam": 200, "sgd": 200, "lm": 50}
LEARNING_RATES = {"adam": 1e-2, "sgd": 1e-1}
FIRST_DAMPING = 1e-3
LARGEST_DAMPING = 1e12

Report = Callable[[int, Tree, float], Any]


class Fit(NamedTuple):
    """The outcome of `fit`.

    Attributes:
        parameters: those with the lowest loss met.
        loss: their loss.
        history: the loss of each step, before its update; for Levenberg–Marquardt after each trial, accepted or not.
        steps: number of steps made.
        reason: why it stopped.
        seconds: wall time, compilation included.
    """

    parameters: Tree
    loss: float
    history: list[float]
    steps: int
    reason: str
    seconds: float


def mean_square(residuals: Array) -> Array:
    """The default loss."""
    return namespace(residuals).mean(residuals * residuals)


def fit(
    residuals: Callable[[Tree], Array],
    parameters: Tree,
    *,
    method: str = "adam",
    loss: Callable[[Array], Array] = mean_square,
    steps: int | None = None,
    learning_rate: float | None = None,
    tolerance: float = 1e-6,
    patience: int = 50,
    callback: Report | None = None,
    progress: bool | None = None,
    jit: bool = True,
) -> Fit:
    """Find parameters that make residuals small.

    Args:
        residuals: parameters → array of any shape, such as an image difference.
        parameters: a torch or jax array, or nested dicts and lists of them; where to start.
        method: "adam" or "sgd" (torch.optim or optax, on the gradient of the loss), or "lm": Levenberg–Marquardt on the
            sum of squares, by the forward-mode Jacobian, for up to some hundred unknowns.
        loss: reduces residuals to a scalar, for Adam and SGD; Levenberg–Marquardt always takes the mean square.
        steps: at most so many; default 200, for "lm" 50.
        learning_rate: of Adam (default 0.01) and SGD (default 0.1).
        tolerance: stop when the loss has not fallen by this fraction in `patience` steps ("lm": in an accepted step).
        patience: see `tolerance`.
        callback: called as `callback(step, parameters, loss)`; a true result stops the fit.
        progress: show a progress bar with loss and ms/iteration; default only on a terminal.
        jit: compile with jax (no effect on torch). Turn off if `residuals` cannot be traced.

    Raises:
        InputError: unknown method, parameters that cannot be differentiated, or a loss that is not finite at the start.
    """
    if method not in STEPS:
        raise InputError(f"method is {method!r}; expected one of {', '.join(STEPS)}")
    steps = STEPS[method] if steps is None else steps
    if steps < 1:
        raise InputError(f"steps is {steps}; expected at least 1")
    if not any(True for _ in leaves(parameters)) or any(is_constant(x) for x in leaves(parameters)):
        raise InputError("parameters holds NumPy arrays, numbers or nothing; expected torch or jax arrays to optimise")
    engine = engine_of(parameters)
    start = time.perf_counter()
    run = _Run(steps, callback, tolerance, patience)
    with _progress(progress, steps, method, run):
        if method == "lm":
            _levenberg_marquardt(residuals, parameters, engine, run, jit)
        else:
            rate = LEARNING_RATES[method] if learning_rate is None else learning_rate
            _descend(lambda p: loss(residuals(p)), parameters, engine, method, rate, run, jit)
    return Fit(run.best, run.best_loss, run.history, len(run.history), run.reason, time.perf_counter() - start)


class _Run:
    """What a fit keeps as it goes: history, best parameters, and whether to stop."""

    def __init__(self, steps: int, callback: Report | None, tolerance: float, patience: int):
        self.steps, self.callback, self.tolerance, self.patience = steps, callback, tolerance, patience
        self.history: list[float] = []
        self.best: Tree = None
        self.best_loss = math.inf
        self.reason = f"all {steps} steps made"
        self.show: Callable[[float], None] = lambda loss: None
        self._last_gain, self._reference = 0, math.inf

    def record(self, parameters: Tree, loss: float) -> bool:
        """Note one step; True to go on."""
        if not self.history and not math.isfinite(loss):
            raise InputError(f"the loss is {loss} at the start; check the parameters and the target for NaN")
        self.history.append(loss)
        self.show(loss)
        if loss < self.best_loss:
            self.best, self.best_loss = parameters, loss
        if loss < self._reference * (1 - self.tolerance):
            self._reference, self._last_gain = loss, len(self.history)
        if self.callback is not None and self.callback(len(self.history) - 1, parameters, loss):
            return self.stop("the callback asked to")
        return len(self.history) < self.steps

    def stalled(self) -> bool:
        """Whether patience is over."""
        return len(self.history) - self._last_gain >= self.patience

    def stop(self, reason: str) -> bool:
        """Say why; always False."""
        self.reason = reason
        return False


def _descend(
    objective: Callable, parameters: Tree, engine: Engine, method: str, rate: float, run: _Run, jit: bool
) -> None:
    """Adam or SGD."""
    step = engine.optimizer(method, rate, parameters)
    value_and_grad = engine.value_and_grad(objective)
    value_and_grad = engine.jit(value_and_grad) if jit else value_and_grad
    while True:
        value, gradient = value_and_grad(parameters)
        if not run.record(parameters, float(value)):
            return
        if not math.isfinite(run.history[-1]):
            run.stop(f"the loss became {run.history[-1]}; a lower learning rate may help")
            return
        if run.stalled():
            run.stop(f"no gain in {run.patience} steps")
            return
        parameters = step(parameters, gradient)


def _levenberg_marquardt(residuals: Callable, parameters: Tree, engine: Engine, run: _Run, jit: bool) -> None:
    """Normal equations with Marquardt's scaling and Nielsen's control of the damping (Madsen et al. 2004)."""
    from scipy.linalg import LinAlgError, solve

    vector, unflatten = _flatten(parameters)
    xp = namespace(vector)

    def flat(v: Array) -> Array:
        return xp.reshape(residuals(unflatten(v)), (-1,))

    def normal_equations(v: Array) -> tuple[Array, Array, Array]:
        r, jacobian = engine.jacobian(flat)(v)
        transposed = xp.matrix_transpose(jacobian)
        return xp.mean(r * r), transposed @ jacobian / r.shape[0], transposed @ r / r.shape[0]

    def mean_residual(v: Array) -> Array:
        r = flat(v)
        return xp.mean(r * r)

    if jit:
        normal_equations, mean_residual = engine.jit(normal_equations), engine.jit(mean_residual)

    def solved_at(v: Array) -> tuple[float, np.ndarray, np.ndarray]:
        value, *equations = normal_equations(v)
        return float(value), *(engine.to_numpy(x).astype(np.float64) for x in equations)

    value, matrix, gradient = solved_at(vector)
    damping, growth = FIRST_DAMPING, 2.0
    going = run.record(unflatten(vector), value)
    while going:
        scale = np.diag(matrix).clip(1e-12 * max(np.trace(matrix), 1e-300))
        if np.abs(gradient).max() == 0:
            run.stop("the gradient is zero")
            return
        try:
            delta = -solve(matrix + damping * np.diag(scale), gradient, assume_a="pos")
        except LinAlgError:
            damping, growth = damping * growth, growth * 2
            continue
        trial = vector + engine.constant(delta, vector)
        trial_value = float(mean_residual(trial))
        going = run.record(unflatten(trial), trial_value)
        gain = value - trial_value
        if gain > 0:
            small = gain <= run.tolerance * value
            predicted = delta @ (damping * scale * delta - gradient)
            vector = trial
            value, matrix, gradient = solved_at(vector)
            if small:
                run.stop(f"the last step gained less than {run.tolerance:g} of the loss")
                return
            ratio = gain / max(predicted, 1e-300)
            damping *= max(1 / 3, 1 - (2 * ratio - 1) ** 3)
            growth = 2.0
        else:
            damping, growth = damping * growth, growth * 2
            if damping > LARGEST_DAMPING:
                run.stop("no step lowers the loss")
                return


def _flatten(parameters: Tree) -> tuple[Array, Callable[[Array], Tree]]:
    """All leaves as one vector, and the way back."""
    arrays = list(leaves(parameters))
    xp = namespace(*arrays)

    def unflatten(vector: Array) -> Tree:
        at = 0

        def take(x: Array) -> Array:
            nonlocal at
            count = math.prod(x.shape)
            piece = xp.reshape(vector[at : at + count], tuple(x.shape))
            at += count
            return piece

        return map_leaves(take, parameters)

    return xp.concat([xp.reshape(x, (-1,)) for x in arrays]), unflatten


@contextlib.contextmanager
def _progress(wanted: bool | None, steps: int, method: str, run: _Run) -> Iterator[None]:
    """A progress bar on standard error."""
    if wanted is False or (wanted is None and not sys.stderr.isatty()):
        yield
        return
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn

    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("{task.fields[status]}"),
    )
    with Progress(*columns, console=Console(stderr=True)) as bar:
        task, start = bar.add_task(method, total=steps, status=""), time.perf_counter()

        def show(loss: float) -> None:
            pace = (time.perf_counter() - start) / len(run.history) * 1e3
            bar.update(task, advance=1, status=f"loss {loss:.3e}  {pace:.1f} ms/iteration")

        run.show = show
        yield
