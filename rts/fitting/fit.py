"""Fitting parameters to images, by gradient descent or Levenberg–Marquardt, on any differentiable render."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from rts.arrays.argument_checks import check_flag
from rts.arrays.array_functions import kind_of
from rts.arrays.engine_base import Engine
from rts.arrays.trees import Array, Tree, map_leaves
from rts.contracts.residuals import Residuals
from rts.errors import InputError
from rts.fitting.checkpoint import Checkpoint
from rts.fitting.descent import Method, Validation, checked_rates, descend
from rts.fitting.fit_arguments import (
    STEPS,
    check_functions,
    check_limits,
    check_method,
    checked_engine,
    checked_residuals,
    declared_loss,
    stage_loss_of,
    stages_of,
)
from rts.fitting.least_squares import levenberg_marquardt
from rts.fitting.losses import Loss
from rts.fitting.parameter_names import named_leaves, names_in_words, one_line
from rts.fitting.processes import Processes
from rts.fitting.run import LONGEST_REASON, Astray, Report, Run, progress_bar
from rts.fitting.saving import Saving
from rts.fitting.schedule import Stage
from rts.fitting.terms import Terms
from rts.plugin_base import overrides

PATIENCE = 50
"""Steps without gain after which a fit stops; where losses are validated, three of these if that is more."""
VALIDATION_SHARE = 4
"""Steps from one validation to the next, in numbers of steps that draw as many terms as a validation has."""


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
        validated: losses that decided which parameters are best, each with the number of its step; empty where the
            losses in `history` did.

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
    validated: list[tuple[int, float]]

    def __repr__(self) -> str:
        # Losses of stages are those of other images.
        first = f"{self.history[-self.stages[-1]]:.4g} → " if self.stages[-1] else ""
        loss, steps = "loss", "1 step" if self.steps == 1 else f"{self.steps} steps"
        if len(self.stages) > 1:
            loss = "loss of the last stage"
            steps += f" ({' + '.join(map(str, self.stages))})"
        held = [f"{name} {tuple(x.shape)}" for name, x in named_leaves(self.parameters)]
        return (
            f"{loss} {first}{self.loss:.4g} in {steps} and {self.seconds:.3g} s\n"
            f"{one_line(self.reason, LONGEST_REASON)}\nparameters: {names_in_words(held, 6)}"
        )


def fit(
    residuals: Callable[[Tree], Array],
    parameters: Tree,
    *,
    method: Any = "adam",
    loss: Callable[[Array], Array] | None = None,
    steps: int | None = None,
    learning_rate: float | dict[str, float] | None = None,
    tolerance: float = 1e-6,
    patience: int | None = None,
    schedule: Sequence[Stage] | None = None,
    validation: Callable[[Tree], Array] | None = None,
    validate_every: int | None = None,
    checkpoint: Any = None,
    checkpoint_every: int = 50,
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

    Residuals of many terms, such as `ViewResiduals`, are computed term by term. In a process that has joined a job by
    `torch.distributed.init_process_group`, each process computes its share of a step's terms. All gather gradients, or
    for "lm" normal equations, of every term, and add them in one order: memory for as many gradients as terms. So every
    process has the same result. The first alone shows progress, calls `callback`, and reads and writes checkpoints.

    Args:
        residuals: parameters → array of any shape, of the parameters' engine, such as an image difference; see
            `ImageResiduals` for residuals with which "lm" needs less time and memory; `rts.Residuals` says why.
        parameters: a torch or jax array, or nested dicts and lists of them; where to start.
        method: "adam" or "sgd" (torch.optim or optax, on the gradient of the loss); or "lm": Levenberg–Marquardt, by
            the forward-mode Jacobian, for up to some hundred unknowns. Or a `torch.optim.Optimizer` of the tensors in
            `parameters`, which a copy of it then steps, or an `optax.GradientTransformation`.
        loss: reduces residuals to a scalar; for "lm" an `rts.Loss`, such as `rts.Loss("huber", f_scale=0.1)`. By
            default the loss that the residuals declare, at each stage (`ImageResiduals(loss=…)`), or else the mean
            square.
        steps: the most losses computed at each stage, that of its start included; default 200, for "lm" 50.
        learning_rate: the rate of Adam (default 0.01) or SGD (default 0.1); or rates by name, such as
            `{"vertices": 0.01, "light": 0.1}`, where "light" is of all arrays within it.
        tolerance: stop when the loss has not fallen by this fraction in `patience` steps ("lm": in an accepted step).
        patience: the number of steps that `tolerance` speaks of; not for "lm". Default 50, or three validations if
            these take more steps.
        schedule: stages, one after the other, each from where the one before ended: the resolutions at which images are
            compared, such as `rts.pyramid(size)`. For `ImageResiduals`, or other `rts.Residuals` with `at_stage`.
        validation: residuals whose loss decides which parameters are best, and when to stop: such as those of views
            that are held out. None for the loss of each step; where steps draw some of many terms, that of all terms.
        validate_every: the number of steps from one such loss to the next. By default validations compute a quarter as
            many terms as the steps.
        checkpoint: the path of a file in which the state is kept, atomically. If it exists, the fit goes on from it and
            takes the same steps, bit for bit, as without a break: give the same arguments; `steps` may be more.
        checkpoint_every: the number of steps from one state to the next. The end of a stage is kept, too.
        callback: called as `callback(step, parameters, loss)`; a true result stops the fit, later stages included.
        progress: show a progress bar with loss and ms/iteration; None for only on a terminal.
        jit: compile with jax (no effect on torch). Turn off if `residuals` cannot be traced.

    Raises:
        InputError: an argument of the wrong kind, residuals that do not depend on the parameters, or a loss or
            derivative that is not finite at the start.
        EngineError: parameters of two engines, or of another than the arrays that `residuals` holds.
    """
    known = check_functions(residuals, loss, callback)
    title = method if isinstance(method, str) else type(method).__name__
    check_method(title, method, loss, steps, validation)
    check_limits(tolerance, patience, validate_every)
    check_flag("jit", jit)
    stages = stages_of(known, schedule)
    taken = [stage_loss_of(stage, known, loss) for stage in stages]
    engine = checked_engine(parameters)
    names = [name for name, _ in named_leaves(parameters)]
    optimizer = Method(method, checked_rates(learning_rate, method, names), parameters)
    # Private copies: neither the caller's later changes nor the graph that made them may reach the result.
    parameters = map_leaves(partial(_copied, engine), parameters)
    if title != "lm":
        optimizer.start(engine, parameters)  # Refused before any work.
    processes = Processes.joined() if overrides(known, "draw", Residuals) else None
    if processes is not None:
        progress = progress if processes.rank == 0 else False
        callback = None if callback is None else partial(_agreed, processes, callback)
    file, state = None, None
    if checkpoint is not None:
        file = Checkpoint(checkpoint, checkpoint_every, parameters, engine, title, processes)
        state = file.read(len(stages))
    start, most = time.perf_counter(), int(steps or STEPS.get(title, STEPS["adam"]))
    runs: list[Run] = []
    for numbers in () if state is None else state.about["stages"]:
        runs.append(Run(most, callback, tolerance, sum(len(r.history) for r in runs)))
        runs[-1].go_on(numbers, None)
    for number in range(len(runs), len(stages)):
        stage, (reduced, fits) = stages[number], taken[number]
        run = Run(most, callback, tolerance, sum(len(r.history) for r in runs))
        saving, state = Saving(file, run, tuple(runs), state), None
        bar = title if len(stages) == 1 else f"{title} {number + 1}/{len(stages)}"
        with progress_bar(progress, run.steps, bar, run):
            try:
                terms = Terms(stage, engine, processes, partial(_checked, engine=engine, run=run))
                judge = _validation(terms, reduced, validation, validate_every, engine, run, processes)
                run.validates = judge is not None
                run.patience = patience or max(PATIENCE, 3 * judge.every if judge else 0)
                if isinstance(reduced, Loss) and title == "lm":
                    own_equations = fits and overrides(stage, "normal_equations", Residuals)
                    supersample = getattr(stage, "supersample", None)
                    levenberg_marquardt(
                        terms,
                        parameters,
                        engine,
                        run,
                        saving,
                        jit=jit,
                        loss=reduced,
                        own_equations=own_equations,
                        supersample=supersample,
                    )
                else:
                    descend(terms, reduced, parameters, engine, optimizer, run, saving, jit=jit, validation=judge)
                saving.write()
            except Astray as stop:
                run.stop(str(stop))
        runs.append(run)
        if run.best is not None:
            parameters = run.best
        if run.stop_requested:
            break
    return _outcome(parameters, runs, runs[-1].summary(names), time.perf_counter() - start)


def _outcome(parameters: Tree, runs: Sequence[Run], reason: str, seconds: float) -> Fit:
    """The result of `fit`, after one run for each stage."""
    history = [value for run in runs for value in run.history]
    counts = tuple(len(run.history) for run in runs)
    lowest = [run.best_loss for run in runs if run.history][-1]
    validated = [pair for run in runs for pair in run.validated]
    return Fit(parameters, lowest, history, len(history), reason, seconds, counts, validated)


def _agreed(processes: Processes, callback: Report, step: int, parameters: Tree, loss: float) -> bool:
    """The result of a callback that the first process alone calls."""
    return processes.agreed(bool(callback(step, parameters, loss)) if processes.rank == 0 else None)


def _validation(
    terms: Terms,
    loss: Callable[[Array], Array],
    validation: Callable[[Tree], Array] | None,
    every: int | None,
    engine: Engine,
    run: Run,
    processes: Processes | None,
) -> Validation | None:
    """The loss that decides; None where the loss of each step does."""
    if validation is None:
        if terms.whole:
            return None
        judges = terms
    else:
        known = checked_residuals(validation, "validation")
        processes = processes if overrides(known, "draw", Residuals) else None
        judges = Terms(known, engine, processes, partial(_checked, engine=engine, run=run))
        loss = stage_loss_of(known, known, None)[0] if declared_loss(known) else loss
    share = -(-len(judges.drawn(None)) // len(terms.drawn(0)))
    return Validation(judges, loss, every or VALIDATION_SHARE * share)


def _copied(engine: Engine, x: Array) -> Array:
    try:
        values = np.array(engine.to_numpy(x))
    except (TypeError, ValueError, RuntimeError) as error:  # Such as a sparse one.
        raise InputError(f"parameters holds an array whose values cannot be read ({one_line(str(error))})") from None
    return engine.namespace.astype(engine.constant(values, x), x.dtype, copy=False)


# -------------------------------------------------------------------------------------------------- checks


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
