"""One run of a fit: its record, the rule by which it stops, and its progress bar."""

from __future__ import annotations

import contextlib
import math
import time
from collections.abc import Callable, Iterator, Sequence
from copy import copy
from typing import Any

from rts.arrays.engine_base import Engine
from rts.arrays.trees import Tree
from rts.errors import EngineError, InputError, RtsError
from rts.fitting.interrupts import interrupts_held_back
from rts.fitting.parameter_names import names_in_words, one_line
from rts.terminal import shows_bar

Report = Callable[[int, Tree, float], Any]

NO_GRADIENT = (
    "the gradient is exactly zero: nothing changes with the parameters here; is the object in view, and the splatter "
    'other than "none"?'
)


class Astray(Exception):
    """The fit cannot go on from the parameters that it reached; the message says why."""


class Run:
    """The record of a running fit: history, best parameters, and why it stopped.

    Attributes:
        mattered: for each array of the parameters, True once its gradient was other than zero.
        remarks: further remarks on the outcome, beside the reason.
        residuals: the number of residuals, once it is known.
        stop_requested: True if the callback has asked to stop.
        patience: the number of steps after which `stalled` holds, if none gained.
        validates: True if other losses than those of the steps decide which parameters are best, and when to stop.
        validated: these losses, each with the number of its step in all stages.
    """

    def __init__(self, steps: int, callback: Report | None, tolerance: float, before: int = 0):
        self.before, self.stop_requested, self.validates = before, False, False
        self.validated: list[tuple[int, float]] = []
        self.patience = steps
        self.steps, self.callback, self.tolerance = steps, callback, tolerance
        self.history: list[float] = []
        self.best: Tree = None
        self.best_loss = math.inf
        self.reason = f"all {steps} steps made" if steps > 1 else "the one step made"
        self.mattered: list[bool] = []
        self.remarks: list[str] = []
        self.residuals = 0
        self.show: Callable[[float], None] = lambda loss: None
        self._last_gain, self._reference = 0, math.inf

    def record(self, parameters: Tree, loss: float) -> bool:
        """Note the parameters and loss of one step. Returns True if the fit goes on."""
        self.history.append(loss)
        self.show(loss)
        if not self.validates:
            self._judge(parameters, loss)
        if self.callback is not None:
            self.stop_requested = bool(self.callback(self.before + len(self.history) - 1, parameters, loss))
        if self.stop_requested:
            return self.stop("the callback asked to")
        return self.left > 0

    def validate(self, parameters: Tree, loss: float) -> None:
        """Note the deciding loss of the parameters of the last step."""
        self.validated.append((self.before + len(self.history) - 1, loss))
        self._judge(parameters, loss)

    def _judge(self, parameters: Tree, loss: float) -> None:
        margin = self.tolerance * abs(self._reference) if math.isfinite(self._reference) else 0.0
        if loss < self.best_loss:
            self.best, self.best_loss = parameters, loss
        if loss < self._reference - margin:
            self._reference, self._last_gain = loss, len(self.history)

    def numbers(self) -> dict[str, Any]:
        """The numbers of a checkpoint beside the best parameters, as JSON holds them; `go_on` takes them.

        These are the history, the losses and gradients that decide, and when there was a gain. Why the run stopped,
        remarks, and the number of residuals are not among them.
        """
        names = "history", "best_loss", "mattered", "validated", "_last_gain", "_reference"
        return {name: copy(getattr(self, name)) for name in names}

    def go_on(self, numbers: dict[str, Any], best: Tree) -> None:
        """Go on from the `numbers` of an earlier run, and its best parameters."""
        self.__dict__.update(numbers)
        self.validated, self.best = [(step, loss) for step, loss in self.validated], best

    @property
    def fresh(self) -> bool:
        """True before the first loss of the first stage. No result can be saved then: an error goes to the caller."""
        return not self.history and not self.before

    def note_gradient(self, mattered: Sequence[bool]) -> None:
        """Note which arrays of the parameters have a gradient other than zero."""
        self.mattered = [a or b for a, b in zip(mattered, self.mattered or [False] * len(mattered), strict=True)]

    def summary(self, names: Sequence[str]) -> str:
        """The reason why the fit stopped, and further remarks, in one line; arrays go by their names."""
        lost = [name for name, mattered in zip(names, self.mattered, strict=False) if not mattered]
        remarks = self.remarks
        if lost and len(lost) < len(names):
            remarks = [f"the gradient was zero throughout in {names_in_words(lost)}", *remarks]
        elif lost and self.best_loss and NO_GRADIENT not in self.reason:
            remarks = [NO_GRADIENT, *remarks]
        return one_line("; ".join([self.reason, *remarks]), LONGEST_REASON)

    @property
    def left(self) -> int:
        """Steps that are left."""
        return self.steps - len(self.history)

    def stop(self, reason: str) -> bool:
        """Note why the fit stops. Returns False, which tells the caller of `record` to stop."""
        self.reason = reason
        return False

    def stalled(self) -> bool:
        """True if the loss has not fallen enough in the last `patience` steps."""
        return len(self.history) - self._last_gain >= self.patience

    def attempt(self, engine: Engine, call: Callable, *args: Any) -> Any:
        """The result of `call(*args)`, waited for. After the first step an InputError in it becomes `Astray`.

        Ctrl-C takes effect after the call.
        """
        # jax wraps errors of host functions in one of its own; the engine keeps the original.
        engine.take_error()
        try:
            with interrupts_held_back():
                return engine.block(call(*args))
        except Exception as error:
            original = error if isinstance(error, RtsError) else engine.take_error() or untraceable(error, engine)
            if original is None:
                raise
            if not self.fresh and isinstance(original, InputError):
                raise Astray(str(original)) from error
            if original is error:
                raise
            raise original from error


def fault_of(numbers: Any, count: int) -> str:
    """The name of an entry of `Run.numbers` that is missing, or of another kind; "" if they are sound.

    Args:
        numbers: what a file holds in their place.
        count: the number of arrays of the parameters.
    """
    if not isinstance(numbers, dict):
        return "run"
    history, mattered, validated = (numbers.get(name) for name in ("history", "mattered", "validated"))
    sound = {
        "history": isinstance(history, list) and all(type(x) is float for x in history),
        "best_loss": type(numbers.get("best_loss")) is float,
        "mattered": isinstance(mattered, list)
        and len(mattered) in (0, count)
        and all(type(x) is bool for x in mattered),
        "validated": isinstance(validated, list)
        and all(isinstance(x, list) and [type(y) for y in x] == [int, float] and x[0] >= 0 for x in validated),
        "_last_gain": type(numbers.get("_last_gain")) is int and numbers["_last_gain"] >= 0,
        "_reference": type(numbers.get("_reference")) is float,
    }
    return next((name for name, is_sound in sound.items() if not is_sound), "")


LONGEST_REASON = 500
TRACING = ("JAXTypeError", "JAXIndexError")
"""Bases of the errors of jax that say that a value is not known while a function is traced."""


ENGINE_MARKS = {"torch": ("Tensor", "__dlpack"), "jax": ("ArrayImpl", "Tracer", "jit-wrapped")}
"""Names of arrays in errors of the frameworks about arrays of another one."""


def untraceable(error: Exception, engine: Engine) -> RtsError | None:
    """A clearer error for a function that a framework could not trace, or that met arrays of another framework.

    None for any other error.
    """
    names = {c.__name__ for c in type(error).__mro__ if c.__module__.partition(".")[0] == "jax"}
    first = one_line(str(error).strip().split("\n")[0]).rstrip(".")
    if names.intersection(TRACING):
        return InputError(
            f"{engine.name} cannot trace the function ({type(error).__name__}: {first}); use {engine.name} arrays "
            f"throughout and no values of them in Python, or pass jit=False where that is an argument"
        )
    if isinstance(error, RuntimeError) and (first.startswith("vmap: ") or "doesn't have storage" in first):
        return InputError(
            f"{engine.name} cannot take derivatives of the function along all unknowns at once ({first}); use "
            f'no values of arrays in Python or NumPy, or method="adam"'
        )
    if type(error) in (TypeError, AttributeError) and engine.name in ENGINE_MARKS:
        met = [name for name, marks in ENGINE_MARKS.items() if any(m in str(error) for m in marks)]
        if len(met) > 1:
            return EngineError(
                f"{' and '.join(met)} arrays met in the function ({first}); the parameters are {engine.name} arrays: "
                f"convert the others, to NumPy for what is constant in a scene"
            )
    return None


def require(finite: bool, what: str, start: bool) -> None:
    """Refuse numbers that are not finite: at the start these are an error of the caller."""
    if not finite and start:
        raise InputError(f"{what} at the start; check the parameters and the target for NaN")
    if not finite:
        raise Astray(f"{what}; the parameters may have gone too far")


@contextlib.contextmanager
def progress_bar(wanted: bool | None, steps: int, method: str, run: Run) -> Iterator[None]:
    """Show a progress bar on standard error meanwhile, if `wanted`; if that is None, only where it is a terminal."""
    if not shows_bar(wanted):
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
        before, start = len(run.history), time.perf_counter()
        task = bar.add_task(method, total=steps, completed=before, status="")

        def show(loss: float) -> None:
            pace = (time.perf_counter() - start) / (len(run.history) - before) * 1e3
            bar.update(task, advance=1, status=f"loss {loss:.3e}  {pace:.1f} ms/iteration")

        run.show = show
        yield
