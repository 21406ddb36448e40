"""Adam, SGD and other optimisers of the frameworks, on the gradient of a loss."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

from rts.arrays.argument_checks import quoted
from rts.arrays.array_functions import kind_of
from rts.arrays.engine_base import Engine
from rts.arrays.trees import Array, Tree, leaves, map_leaves
from rts.contracts.checks import is_real
from rts.errors import InputError
from rts.fitting.dependence import refuse_independent
from rts.fitting.parameter_names import names_in_words
from rts.fitting.run import NO_GRADIENT, Run, require
from rts.fitting.saving import Saving
from rts.fitting.terms import Terms

LEARNING_RATES = {"adam": 1e-2, "sgd": 1e-1}


class Method(NamedTuple):
    """An optimiser, as the caller named or gave it.

    Attributes:
        optimizer: "adam", "sgd", or an optimiser object of the framework.
        rates: the learning rate, or a list of one for each array of the parameters.
        original: the caller's parameters, whose arrays an optimiser object may hold.
    """

    optimizer: Any
    rates: float | list[float]
    original: Tree

    def start(self, engine: Engine, parameters: Tree) -> Any:
        """The step function, from these parameters on; see `Engine.optimizer`."""
        return engine.optimizer(self.optimizer, self.rates, parameters, self.original)


class Validation(NamedTuple):
    """The loss that decides which parameters are best.

    Attributes:
        terms: its terms, all of which count.
        loss: the loss of a term's residuals.
        every: the number of steps from one such loss to the next.
    """

    terms: Terms
    loss: Callable[[Array], Array]
    every: int


def descend(
    terms: Terms,
    loss: Callable[[Array], Array],
    parameters: Tree,
    engine: Engine,
    method: Method,
    run: Run,
    saving: Saving,
    *,
    jit: bool,
    validation: Validation | None,
) -> None:
    """Minimise the loss by a first-order optimiser.

    Args:
        terms: the terms of the loss.
        loss: the loss of a term's residuals.
        parameters: where to start; private copies.
        engine: their engine.
        method: the optimiser.
        run: takes note of each step, and says when to stop.
        saving: keeps checkpoints, and gives the state to go on from.
        jit: True to compile.
        validation: the loss that decides; None where that of each step does.
    """
    xp = engine.namespace

    def term(p: Tree, data: Tree) -> list[Array]:
        value, gradient = engine.value_and_grad(scalar(lambda q: loss(terms.of(data)(q)), engine))(p)
        gradients = list(leaves(gradient))
        # As numbers: flags of several terms are added.
        wrong = [xp.astype(~xp.all(xp.isfinite(g)), xp.float32) for g in gradients]
        mattered = [xp.astype(xp.any(g != 0), xp.float32) for g in gradients]
        return [value, *gradients, *wrong, *mattered]

    term = engine.jit(term) if jit else term

    def at(p: Tree, key: Any) -> list[Array]:
        return term(p, terms.load(key))

    judge = None if validation is None else _judge(validation, engine, run, jit)
    step = method.start(engine, parameters)
    parameters = saving.resumed(parameters, step.restore) if saving.resumes else parameters
    while True:
        saving.note(parameters, lambda: step.state())
        start, number = run.fresh, len(run.history)
        value, *rest = terms.mean(lambda key, p=parameters: run.attempt(engine, at, p, key), number)
        count = len(rest) // 3
        gradients, wrong, mattered = rest[:count], rest[count : 2 * count], rest[2 * count :]
        require(math.isfinite(value), f"the loss is {float(value)}", start)
        run.note_gradient([*map(bool, mattered)])
        if not run.history and not any(run.mattered):
            data = terms.first()
            refuse_independent(terms.of(data), scalar(loss, engine), parameters, engine)
        going = run.record(parameters, float(value))
        judged = judge is None or not going or number % (validation.every if validation else 1) == 0
        if judge is not None and judged:
            run.validate(parameters, judge(parameters))
        if not going:
            return
        require(not any(map(bool, wrong)), "the gradient is not finite", start)
        if judged and run.stalled():
            run.stop(f"no gain in {run.patience} steps" + ("" if any(run.mattered) else f": {_flat(run.best_loss)}"))
            return
        it = iter(gradients)
        parameters = run.attempt(engine, step, parameters, map_leaves(lambda _, it=it: next(it), parameters))


def _judge(validation: Validation, engine: Engine, run: Run, jit: bool) -> Callable[[Tree], float]:
    """A function of parameters: the deciding loss."""
    terms = validation.terms

    def term(p: Tree, data: Tree) -> list[Array]:
        return [scalar(validation.loss, engine)(terms.of(data)(p))]

    term = engine.jit(term) if jit else term

    def at(p: Tree, key: Any) -> list[Array]:
        return term(p, terms.load(key))

    def judge(parameters: Tree) -> float:
        (value,) = terms.mean(lambda key: run.attempt(engine, at, parameters, key), None)
        require(math.isfinite(value), f"the validation's loss is {float(value)}", run.fresh)
        return float(value)

    return judge


def _flat(loss: float) -> str:
    """The reason, in words, of a gradient that was zero throughout."""
    return "the loss is zero" if loss == 0 else NO_GRADIENT


def scalar(loss: Callable, engine: Engine) -> Callable[[Array], Array]:
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


def checked_rates(learning_rate: Any, method: Any, names: Sequence[str]) -> float | list[float]:
    """The learning rate, or a list of one for each array of the parameters.

    Args:
        learning_rate: a number; a mapping of names, each of an array or of all arrays whose names it begins, such as
            "light" for "light.direction"; or None for the method's default.
        method: the method's name, or an optimiser object, which has rates of its own.
        names: the names of the arrays.

    Raises:
        InputError: something else, names of no array, or an array without a rate.
    """
    if not isinstance(method, str):
        if learning_rate is not None:
            raise InputError("learning_rate is given beside an optimiser object, which has its own; leave it out")
        return 0.0
    if learning_rate is None:
        return LEARNING_RATES.get(method, 0.0)
    if method == "lm":
        raise InputError('learning_rate is given, and method "lm" has none; leave it out')
    if not isinstance(learning_rate, dict):
        return _checked_rate("learning_rate", learning_rate)
    rates: dict[str, float] = {}
    for key in sorted(learning_rate, key=lambda key: len(str(key))):  # The longer, the more particular.
        named = [name for name in names if name == key or name.startswith(f"{key}.")]
        if not named:
            raise InputError(
                f"learning_rate names {quoted(key)}; expected names of parameters: {names_in_words(names, 8)}"
            )
        rates |= dict.fromkeys(named, _checked_rate(f"learning_rate[{key!r}]", learning_rate[key]))
    if missing := [name for name in names if name not in rates]:
        raise InputError(f"learning_rate has no rate for {names_in_words(missing, 8)}; expected one for each array")
    return [rates[name] for name in names]


def _checked_rate(what: str, rate: Any) -> float:
    if not (is_real(rate) and 0 < rate < math.inf):
        raise InputError(f"{what} is {quoted(rate)}; expected a positive number")
    return float(rate)
