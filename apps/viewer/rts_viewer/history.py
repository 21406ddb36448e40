"""Earlier states of a fit, a bounded number of them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

MOST = 50


class State(NamedTuple):
    """A mesh at a step of a fit.

    Attributes:
        number: the step.
        loss: its loss.
        vertices: (V, 3) float32, world space.
        faces: (T, 3) int32.
        colors: (V, 3) float32, linear, or None.
    """

    number: int
    loss: float
    vertices: np.ndarray
    faces: np.ndarray
    colors: np.ndarray | None


class History:
    """States at equal distances, the first and the newest among them.

    Where there are too many, every second one is dropped, and further states are kept half as often.

    Args:
        most: the greatest number of states, at least 3.
    """

    def __init__(self, most: int = MOST):
        self._most, self._count, self._stride = most, 0, 1
        self._kept: list[State] = []
        self.newest: State | None = None

    def add(self, state: State) -> None:
        """Make a state the newest one."""
        self.newest = state
        if self._count % self._stride == 0:
            if len(self._kept) == self._most - 1:  # One place is the newest's.
                self._kept = self._kept[::2]
                self._stride *= 2
            if self._count % self._stride == 0:
                self._kept.append(state)
        self._count += 1

    @property
    def states(self) -> list[State]:
        """The states, in order."""
        if self.newest is None or (self._kept and self._kept[-1] is self.newest):
            return list(self._kept)
        return [*self._kept, self.newest]

    def nearest(self, number: int) -> State | None:
        """The state whose step is nearest to a number; None if there are none."""
        return min(self.states, key=lambda state: abs(state.number - number), default=None)
