"""The base class of residuals, which `rts.fit` minimises."""

from __future__ import annotations

import abc
from collections.abc import Callable, Sequence
from typing import Any

from rts.arrays.trees import Array, Tree
from rts.plugin_base import Plugin


class Residuals(Plugin):
    """Function of parameters that `rts.fit` minimises. A plain function will do; the other methods are optional.

    Residuals of many terms, such as pictures from many views, also have `draw`, `load` and `of`. Their loss is the mean
    of the losses of the terms that are drawn. `rts.fit` then computes one term after the other, or shares them among
    processes.

    Attributes:
        loss: an `rts.Loss`, applied to each residual before the mean; None for the square. The result of `at_stage`
            has a loss of its own, or where that is None this one.
    """

    loss: Any = None

    @abc.abstractmethod
    def __call__(self, parameters: Tree) -> Array:
        """Residuals, of any shape."""

    def at_stage(self, stage: Any) -> Callable[[Tree], Array]:
        """The residuals at the resolution of an `rts.Stage`, for `rts.fit` with a schedule."""
        raise NotImplementedError

    def normal_equations(self, parameters: Tree) -> tuple[Array, Array, Array]:
        """Mean loss () of the n residuals r, JᵀSJ / n (U, U) and JᵀWr / n (U,) for their Jacobian J.

        W and S are diagonals of `self.loss.weights(r)`, ones for the mean square.
        U is the number of numbers in the parameters, in the order of `rts.plugin_api.arrays.leaves`. All three are
        arrays of the parameters' engine, perhaps traced. A class with this method spares Levenberg–Marquardt the
        Jacobian.
        """
        raise NotImplementedError

    def draw(self, step: int | None) -> Sequence[Any]:
        """Keys of the terms that count at a step, such as a mini-batch of views.

        Args:
            step: the number of the step, from 0 in each stage; None for all terms. A step always gives the same keys.
        """
        raise NotImplementedError

    def load(self, key: Any) -> Tree:
        """Constant arrays of a term, read when needed. Terms whose arrays have equal shapes are compiled once."""
        raise NotImplementedError

    def of(self, data: Tree) -> Residuals:
        """Residuals of one term alone.

        Args:
            data: the result of `load`, whose arrays may be traced.
        """
        raise NotImplementedError
