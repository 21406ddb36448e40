"""Arguments of fits: residuals, stages, losses and limits, refused where they are wrong."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rts.arrays.argument_checks import quoted
from rts.arrays.engine_base import Engine
from rts.arrays.trees import Array, Tree, leaves
from rts.contracts.checks import checked_plugin, is_count, is_real
from rts.contracts.residuals import Residuals
from rts.errors import InputError
from rts.fitting.dependence import differentiable
from rts.fitting.losses import SQUARE, Loss
from rts.fitting.schedule import checked_schedule
from rts.plugin_base import overrides

STEPS = {"adam": 200, "sgd": 200, "lm": 50}


def check_functions(residuals: Any, loss: Any, callback: Any) -> Residuals:
    """The residuals as `rts.Residuals`; loss and callback are checked, too."""
    known = checked_residuals(residuals, "residuals")
    if loss is not None and not callable(loss):
        raise InputError(
            f"loss is {quoted(loss)}; expected a function of the residuals, such as rts.Loss('huber', f_scale=0.1), or "
            f"leave it out"
        )
    if callback is not None and not callable(callback):
        raise InputError(f"callback is {quoted(callback)}; expected a function of step, parameters and loss, or None")
    return known


def stages_of(residuals: Residuals, schedule: Any) -> list[Residuals]:
    """The residuals at each stage of a schedule; without one, as they are."""
    if schedule is None:
        return [residuals]
    schedule = checked_schedule(schedule)
    if not overrides(residuals, "at_stage", Residuals):
        raise InputError(
            f"residuals is {quoted(residuals)}, whose resolution nobody knows; with a schedule pass "
            f"rts.ImageResiduals, or subclass rts.Residuals and give it a method at_stage(stage)"
        )
    return [checked_residuals(residuals.at_stage(stage), "what at_stage gave") for stage in schedule]


class _Function(Residuals):
    """Residuals that are a plain function of the parameters."""

    def __init__(self, function: Callable[[Tree], Array]):
        self._function = function

    def __call__(self, parameters: Tree) -> Array:
        """See `rts.Residuals`."""
        return self._function(parameters)

    def __repr__(self) -> str:
        return quoted(self._function)


def checked_residuals(value: Any, what: str) -> Residuals:
    """An object as `rts.Residuals`; functions are wrapped. `what` names it in errors."""
    function = callable(value) and not isinstance(value, (Residuals, type))
    residuals = _Function(value) if function else value
    return checked_plugin(residuals, what, Residuals, "a function of the parameters, ")


def stage_loss_of(stage: Residuals, whole: Residuals, loss: Callable | None) -> tuple[Callable[[Array], Array], bool]:
    """The loss at a stage of the residuals `whole`, and True if the stage's `normal_equations` are for it."""
    if loss is not None and not overrides(stage, "normal_equations", Residuals):
        return loss, False
    stage_loss = declared_loss(stage)
    taken = (stage_loss or declared_loss(whole) or SQUARE) if loss is None else loss
    return taken, (stage_loss or SQUARE) == taken


def declared_loss(residuals: Residuals) -> Loss | None:
    """The loss that residuals declare; None if they declare none."""
    loss = residuals.loss
    if loss is None or isinstance(loss, Loss):
        return loss
    raise InputError(f"the residuals' loss is {quoted(loss)}; expected an rts.Loss, or None")


def check_method(title: str, method: Any, loss: Callable | None, steps: int | None, validation: Any) -> None:
    """Refuse methods by other names, and arguments that do not go with the method. `title` is its name."""
    if (method is title and method not in STEPS) or isinstance(method, (type, type(None), bool, int, float)):
        raise InputError(f"method is {quoted(method)}; expected one of {', '.join(STEPS)}, or an optimiser object")
    if title == "lm" and not (loss is None or isinstance(loss, Loss)):
        raise InputError(
            f'method "lm" takes no loss but an rts.Loss, such as rts.Loss("huber", f_scale=0.1); it is {quoted(loss)}: '
            f'use "adam", or leave it out'
        )
    if title == "lm" and validation is not None:
        raise InputError('method "lm" takes no validation, since its loss decides; use "adam", or leave it out')
    if steps is not None:
        check_count("steps", steps)


def check_limits(tolerance: float, patience: int | None, validate_every: int | None) -> None:
    """Refuse limits of a fit that are no numbers, or out of range."""
    if not (is_real(tolerance) and tolerance >= 0):
        raise InputError(f"tolerance is {quoted(tolerance)}; expected a number, at least 0")
    for name, value in (("patience", patience), ("validate_every", validate_every)):
        if value is not None:
            check_count(name, value)


def check_count(name: str, value: Any) -> None:
    """Refuse anything but a whole number of at least 1."""
    if not is_count(value):
        raise InputError(f"{name} is {quoted(value)}; expected a whole number, at least 1")


def checked_engine(parameters: Tree) -> Engine:
    """The engine of the parameters, which must be differentiable arrays."""
    engine = differentiable(parameters, " to optimise")
    if any(engine.traced(x) for x in leaves(parameters)):
        raise InputError("parameters holds traced arrays; call rts.fit outside jit and other transforms")
    return engine
