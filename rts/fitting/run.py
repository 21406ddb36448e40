"""One run of a fit: what it keeps, when it stops, and its progress bar."""

from __future__ import annotations

import contextlib
import math
import sys
import time
from collections.abc import Callable, Iterator
from typing import Any

from rts.engines import Engine
from rts.errors import InputError, RtsError
from rts.trees import Tree

Report = Callable[[int, Tree, float], Any]


class Astray(Exception):
    """Parameters became such that the fit cannot go on; the message says how."""


class Run:
    """What a fit keeps as it goes: history, best parameters, and why it stopped."""

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
        margin = self.tolerance * abs(self._reference) if self.history else 0.0
        self.history.append(loss)
        self.show(loss)
        if loss < self.best_loss:
            self.best, self.best_loss = parameters, loss
        if loss < self._reference - margin:
            self._reference, self._last_gain = loss, len(self.history)
        if self.callback is not None and self.callback(len(self.history) - 1, parameters, loss):
            return self.stop("the callback asked to")
        return self.left > 0

    @property
    def left(self) -> int:
        """How many more steps there may be."""
        return self.steps - len(self.history)

    def stop(self, reason: str) -> bool:
        """Note why the fit stops. Always False, which `record` returns then."""
        self.reason = reason
        return False

    def stalled(self) -> bool:
        """Whether the loss has not fallen enough in the last `patience` steps."""
        return len(self.history) - self._last_gain >= self.patience

    def attempt(self, engine: Engine, call: Callable, *args: Any) -> Any:
        """The result of `call(*args)`, waited for. After the first step an InputError in it becomes `Astray`."""
        # jax wraps errors of host functions in one of its own; the engine keeps the original.
        engine.take_error()
        try:
            return engine.block(call(*args))
        except Exception as error:
            original = error if isinstance(error, RtsError) else engine.take_error()
            if original is None:
                raise
            if self.history and isinstance(original, InputError):
                raise Astray(str(original)) from error
            if original is error:
                raise
            raise original from error


def require(finite: bool, what: str, start: bool) -> None:
    """Refuse what is not finite: at the start that is an error of the caller."""
    if not finite and start:
        raise InputError(f"{what} at the start; check the parameters and the target for NaN")
    if not finite:
        raise Astray(f"{what}; the parameters may have gone too far")


@contextlib.contextmanager
def progress_bar(wanted: bool | None, steps: int, method: str, run: Run) -> Iterator[None]:
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
