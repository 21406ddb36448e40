"""When a fit writes its state to a checkpoint, and what it goes on from."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from rts.arrays.trees import Tree
from rts.errors import InputError
from rts.fitting.checkpoint import Checkpoint, State
from rts.fitting.run import Run


class Saving:
    """The states of one stage of a fit, between its steps.

    Args:
        checkpoint: the file; None to keep nothing.
        run: the record of the stage.
        before: the records of earlier stages.
        state: the state to go on from; None to start afresh.
    """

    def __init__(self, checkpoint: Checkpoint | None, run: Run, before: Sequence[Run], state: State | None):
        self._checkpoint, self._run, self._before, self._state = checkpoint, run, before, state
        self._last: tuple[dict[str, Any], Tree, Tree, Callable[[], bytes]] | None = None
        self._resumed = -1

    @property
    def resumes(self) -> bool:
        """True if there is a state to go on from."""
        return self._state is not None

    def resumed(self, parameters: Tree, restore: Callable[[bytes, Tree], None]) -> Tree:
        """The parameters to go on from; the run and the method are set to the state, too.

        Raises:
            InputError: the state is not one of the method.
        """
        state = self._state
        if state is None or self._checkpoint is None:
            return parameters
        try:
            restore(state.method, state.parameters)
        except InputError as error:
            raise self._checkpoint.refused(str(error)) from None
        self._run.go_on(state.about["run"], state.best)
        self._resumed = len(self._run.history)
        return state.parameters

    def note(self, parameters: Tree, method: Callable[[], bytes]) -> None:
        """Note the state before a step, and write it where that is due."""
        if self._checkpoint is None:
            return
        about = {"stages": [run.numbers() for run in self._before], "run": self._run.numbers()}
        self._last = about, parameters, self._run.best, method
        count = len(self._run.history)
        if count and count != self._resumed and count % self._checkpoint.every == 0:
            self.write()

    def write(self) -> None:
        """Write the last state noted. It lacks the last loss, which is computed again where a fit goes on."""
        if self._checkpoint is not None and self._last is not None:
            about, parameters, best, method = self._last
            self._checkpoint.write(State(about, parameters, best, method()))
