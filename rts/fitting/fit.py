"""Fitting parameters to images: Adam, SGD and Levenberg–Marquardt on any differentiable render."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from rts.arrays.argument_checks import check_flag, quoted
from rts.arrays.array_functions import kind_of
from rts.arrays.engines import Engine
from rts.arrays.trees import Array, Tree, leaves, map_leaves
from rts.contracts.checks import checked_plugin, is_count, is_real
from rts.contracts.residuals import Residuals
from rts.errors import InputError
from rts.fitting.dependence import differentiable, refuse_independent
from rts.fitting.least_squares import levenberg_marquardt
from rts.fitting.losses import SQUARE, Loss
from rts.fitting.parameter_names import listed, named_leaves, one_line
from rts.fitting.run import LONGEST_REASON, NO_GRADIENT, Astray, Report, Run, progress_bar, require
from rts.fitting.schedule import Stage, checked_schedule
from rts.plugin_base import overrides
from rts.sampling.adaptive import finest

STEPS = {"adam": 200, "sgd": 200, "lm": 50}
LEARNING_RATES = {"adam": 1e-2, "sgd": 1e-1}


class Fit(NamedTuple):
    """The outcome of `fit`.

    Attributes:
        parameters: the parameters with the lowest loss met.
        loss: the loss of these parameters.
        history: the loss at the start and after each update; for Levenberg–Marquardt of each trial, accepted or not.
            With a schedule those of all stages, one after the other.
        steps: number of losses computed, the one at the start included.
        reason: why it stopped, in one line; and the parameters that the residuals do not determine: arrays whose
            gradient was zero throughout and, for Levenberg–Marquardt, combinations of parameters that change nothing,
            such as "light.direction along (0.30, 0.50, 0.81)". These stay as they were.
        seconds: wall time, compilation included.
        stages: the number of steps at each stage of the schedule; one number without a schedule.

    With a schedule, parameters, loss and reason are those of the last stage.

    Printed, it is three lines, without history and values; of losses the first and the lowest of the last stage.
    """

    parameters: Tree
    loss: float
    history: list[float]
    steps: int
    reason: str
    seconds: float
    stages: tuple[int, ...]

    def __repr__(self) -> str:
        # Losses of stages are those of other images.
        first = f"{self.history[-self.stages[-1]]:.4g} → " if self.stages[-1] else ""
        steps = "1 step" if self.steps == 1 else f"{self.steps} steps"
        if len(self.stages) > 1:
            steps += f" ({' + '.join(map(str, self.stages))})"
        held = [f"{name} {tuple(x.shape)}" for name, x in named_leaves(self.parameters)]
        return (
            f"loss {first}{self.loss:.4g} in {steps} and {self.seconds:.3g} s\n"
            f"{one_line(self.reason, LONGEST_REASON)}\nparameters: {listed(held, 6)}"
        )


def fit(
    residuals: Callable[[Tree], Array],
    parameters: Tree,
    *,
    method: str = "adam",
    loss: Callable[[Array], Array] | None = None,
    steps: int | None = None,
    learning_rate: float | None = None,
    tolerance: float = 1e-6,
    patience: int = 50,
    schedule: Sequence[Stage] | None = None,
    callback: Report | None = None,
    progress: bool | None = None,
    jit: bool = True,
) -> Fit:
    """Find parameters that make residuals small.

    Where parameters go astray on the way, so that a loss or derivative is not finite or `residuals` raises an
    InputError, the fit stops, says so in its `reason`, and returns the best parameters met before.

    "lm" takes the numbers of one array to be of like units. A number that changes the residuals a million times less
    than another of its array, in float32, stays as it is. Parameters of very different units belong in arrays
    of their own.

    Args:
        residuals: parameters → array of any shape, of the parameters' engine, such as an image difference; see
            `ImageResiduals` for residuals with which "lm" needs less time and memory; `rts.Residuals` says why.
        parameters: a torch or jax array, or nested dicts and lists of them; where to start.
        method: "adam" or "sgd" (torch.optim or optax, on the gradient of the loss), or "lm": Levenberg–Marquardt, by
            the forward-mode Jacobian, for up to some hundred unknowns.
        loss: reduces residuals to a scalar; for "lm" an `rts.Loss`, such as `rts.Loss("huber", f_scale=0.1)`. By
            default the loss that the residuals declare, at each stage (`ImageResiduals(loss=…)`), or else the mean
            square.
        steps: the most losses computed at each stage, that of its start included; default 200, for "lm" 50.
        learning_rate: the rate of Adam (default 0.01) or SGD (default 0.1).
        tolerance: stop when the loss has not fallen by this fraction in `patience` steps ("lm": in an accepted step).
        patience: the number of steps that `tolerance` speaks of; not for "lm".
        schedule: stages, one after the other, each from where the one before ended: the resolutions at which images are
            compared, such as `rts.pyramid(size)`. For `ImageResiduals`, or other `rts.Residuals` with `at_stage`.
        callback: called as `callback(step, parameters, loss)`; a true result stops the fit, later stages included.
        progress: show a progress bar with loss and ms/iteration; None for only on a terminal.
        jit: compile with jax (no effect on torch). Turn off if `residuals` cannot be traced.

    Raises:
        InputError: an argument of the wrong kind, residuals that do not depend on the parameters, or a loss or
            derivative that is not finite at the start.
        EngineError: parameters of two engines, or of another than the arrays that `residuals` holds.
    """
    known = _check_functions(residuals, loss, callback)
    _check_method(method, loss, steps, learning_rate)
    _check_limits(tolerance, patience)
    check_flag("jit", jit)
    stages = _stages(known, schedule)
    taken = [_taken(stage, known, loss) for stage in stages]
    engine = _checked_engine(parameters)
    names = [name for name, _ in named_leaves(parameters)]
    # Private copies: neither the caller's later changes nor the graph that made them may reach the result.
    parameters = map_leaves(partial(_copied, engine), parameters)
    rate = LEARNING_RATES.get(method, 0.0) if learning_rate is None else float(learning_rate)
    start = time.perf_counter()
    runs: list[Run] = []
    for number, (stage, (reduced, fits)) in enumerate(zip(stages, taken, strict=True), 1):
        run = Run(int(steps or STEPS[method]), callback, tolerance, patience, sum(len(r.history) for r in runs))
        bar = method if len(stages) == 1 else f"{method} {number}/{len(stages)}"
        with progress_bar(progress, run.steps, bar, run):
            try:
                checked = _checked(stage, engine, run)
                if isinstance(reduced, Loss) and method == "lm":
                    own = stage.normal_equations if fits and overrides(stage, "normal_equations", Residuals) else None
                    supersample = finest(getattr(stage, "supersample", None))
                    levenberg_marquardt(checked, parameters, engine, run, jit, reduced, own, supersample)
                else:
                    _descend(checked, reduced, parameters, engine, method, rate, run, jit)
            except Astray as stop:
                run.stop(str(stop))
        runs.append(run)
        if run.best is not None:
            parameters = run.best
        if run.asked:
            break
    history = [value for run in runs for value in run.history]
    counts = tuple(len(run.history) for run in runs)
    lowest = [run.best_loss for run in runs if run.history][-1]
    reason = runs[-1].told(names)
    return Fit(parameters, lowest, history, len(history), reason, time.perf_counter() - start, counts)


def _copied(engine: Engine, x: Array) -> Array:
    try:
        values = np.array(engine.to_numpy(x))
    except (TypeError, ValueError, RuntimeError) as error:  # Such as a sparse one.
        raise InputError(f"parameters holds an array whose values cannot be read ({one_line(str(error))})") from None
    return engine.namespace.astype(engine.constant(values, x), x.dtype, copy=False)


def _descend(
    residuals: Callable,
    loss: Callable,
    parameters: Tree,
    engine: Engine,
    method: str,
    rate: float,
    run: Run,
    jit: bool,
) -> None:
    """Run Adam or SGD on the loss of residuals."""
    xp = engine.namespace
    value_and_grad = engine.value_and_grad(_scalar(lambda p: loss(residuals(p)), engine))

    def evaluate(p: Tree) -> tuple[Array, Tree, list[Array], list[Array]]:
        value, gradient = value_and_grad(p)
        gradients = list(leaves(gradient))
        return value, gradient, [xp.all(xp.isfinite(g)) for g in gradients], [xp.any(g != 0) for g in gradients]

    evaluate = engine.jit(evaluate) if jit else evaluate
    step = engine.optimizer(method, rate, parameters)
    while True:
        start = run.fresh
        value, gradient, finite, mattered = run.attempt(engine, evaluate, parameters)
        require(math.isfinite(value), f"the loss is {float(value)}", start)
        run.note_gradient([*map(bool, mattered)])
        if not run.history and not any(run.mattered):
            refuse_independent(residuals, _scalar(loss, engine), parameters, engine)
        if not run.record(parameters, float(value)):
            return
        require(all(map(bool, finite)), "the gradient is not finite", start)
        if run.stalled():
            run.stop(f"no gain in {run.patience} steps" + ("" if any(run.mattered) else f": {_flat(run.best_loss)}"))
            return
        parameters = run.attempt(engine, step, parameters, gradient)


def _flat(loss: float) -> str:
    """The reason, in words, of a gradient that was zero throughout."""
    return "the loss is zero" if loss == 0 else NO_GRADIENT


# -------------------------------------------------------------------------------------------------- checks


def _check_functions(residuals: Any, loss: Any, callback: Any) -> Residuals:
    """The residuals as `rts.Residuals`; loss and callback are checked, too."""
    known = _residuals(residuals, "residuals")
    if loss is not None and not callable(loss):
        raise InputError(
            f"loss is {quoted(loss)}; expected a function of the residuals, such as rts.Loss('huber', f_scale=0.1), or "
            f"leave it out"
        )
    if callback is not None and not callable(callback):
        raise InputError(f"callback is {quoted(callback)}; expected a function of step, parameters and loss, or None")
    return known


def _stages(residuals: Residuals, schedule: Any) -> list[Residuals]:
    """The residuals at each stage of a schedule; without one, as they are."""
    if schedule is None:
        return [residuals]
    schedule = checked_schedule(schedule)
    if not overrides(residuals, "at_stage", Residuals):
        raise InputError(
            f"residuals is {quoted(residuals)}, whose resolution nobody knows; with a schedule pass "
            f"rts.ImageResiduals, or subclass rts.Residuals and give it a method at_stage(stage)"
        )
    return [_residuals(residuals.at_stage(stage), "what at_stage gave") for stage in schedule]


class _Function(Residuals):
    """Residuals that are a plain function of the parameters."""

    def __init__(self, function: Callable[[Tree], Array]):
        self._function = function

    def __call__(self, parameters: Tree) -> Array:
        """See `rts.Residuals`."""
        return self._function(parameters)

    def __repr__(self) -> str:
        return quoted(self._function)


def _residuals(value: Any, what: str) -> Residuals:
    """An object as `rts.Residuals`; functions are wrapped. `what` names it in errors."""
    function = callable(value) and not isinstance(value, (Residuals, type))
    residuals = _Function(value) if function else value
    return checked_plugin(residuals, what, Residuals, "a function of the parameters, ")


def _taken(stage: Residuals, whole: Residuals, loss: Callable | None) -> tuple[Callable[[Array], Array], bool]:
    """The loss at a stage of the residuals `whole`, and True if the stage's `normal_equations` are for it."""
    if loss is not None and not overrides(stage, "normal_equations", Residuals):
        return loss, False
    own = _own_loss(stage)
    taken = (own or _own_loss(whole) or SQUARE) if loss is None else loss
    return taken, (own or SQUARE) == taken


def _own_loss(residuals: Residuals) -> Loss | None:
    """The loss that residuals declare; None if they declare none."""
    loss = residuals.loss
    if loss is None or isinstance(loss, Loss):
        return loss
    raise InputError(f"the residuals' loss is {quoted(loss)}; expected an rts.Loss, or None")


def _check_method(method: str, loss: Callable | None, steps: int | None, learning_rate: float | None) -> None:
    if not isinstance(method, str) or method not in STEPS:
        raise InputError(f"method is {quoted(method)}; expected one of {', '.join(STEPS)}")
    if method == "lm" and not (loss is None or isinstance(loss, Loss)):
        raise InputError(
            f'method "lm" takes no loss but an rts.Loss, such as rts.Loss("huber", f_scale=0.1); it is {quoted(loss)}: '
            f'use "adam", or leave it out'
        )
    if steps is not None:
        _check_count("steps", steps)
    if learning_rate is not None and not (is_real(learning_rate) and 0 < learning_rate < math.inf):
        raise InputError(f"learning_rate is {quoted(learning_rate)}; expected a positive number")


def _check_limits(tolerance: float, patience: int) -> None:
    if not (is_real(tolerance) and tolerance >= 0):
        raise InputError(f"tolerance is {quoted(tolerance)}; expected a number, at least 0")
    _check_count("patience", patience)


def _check_count(name: str, value: Any) -> None:
    if not is_count(value):
        raise InputError(f"{name} is {quoted(value)}; expected a whole number, at least 1")


def _checked_engine(parameters: Tree) -> Engine:
    """The engine of the parameters, which must be differentiable arrays."""
    engine = differentiable(parameters, " to optimise")
    if any(engine.traced(x) for x in leaves(parameters)):
        raise InputError("parameters holds traced arrays; call rts.fit outside jit and other transforms")
    return engine


def _checked(residuals: Callable[[Tree], Array], engine: Engine, run: Run) -> Callable[[Tree], Array]:
    """A function like `residuals` that refuses a result which is no floating array of the engine."""

    def call(parameters: Tree) -> Array:
        result = residuals(parameters)
        run.residuals = math.prod(getattr(result, "shape", ()))
        if not engine.owns(result):
            raise InputError(
                f"residuals gave {kind_of(result)}; expected one {engine.name} array, as the parameters are"
            )
        if not engine.namespace.isdtype(result.dtype, "real floating") or 0 in result.shape:
            raise InputError(
                f"residuals gave an array of shape {tuple(result.shape)} and dtype {result.dtype}; "
                f"expected floats, and at least one"
            )
        return result

    return call


def _scalar(loss: Callable, engine: Engine) -> Callable[[Array], Array]:
    """A function like `loss` that refuses a result which is no floating scalar of the engine."""

    def call(residuals: Array) -> Array:
        value = loss(residuals)
        if not engine.owns(value) or tuple(value.shape) != ():
            what = f"an array of shape {tuple(value.shape)}" if engine.owns(value) else kind_of(value)
            raise InputError(f"loss gave {what}; expected a {engine.name} scalar, of shape ()")
        if not engine.namespace.isdtype(value.dtype, "real floating"):
            raise InputError(f"loss gave a number of dtype {value.dtype}; expected a floating one")
        return value

    return call
