"""The loss of a fit as a mean of terms: one term, or one for each view; computed here, or by several processes."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np

from rts.arrays.argument_checks import quoted
from rts.arrays.engine_base import Engine
from rts.arrays.trees import Array, Tree
from rts.contracts.residuals import Residuals
from rts.errors import InputError
from rts.fitting.processes import Processes
from rts.plugin_base import overrides


class Terms:
    """The terms of residuals.

    Args:
        residuals: the residuals of all terms.
        engine: the engine of the parameters.
        processes: the job that shares the terms; None for a single process.
        checked: makes a function like one of a term's residuals that refuses wrong results.

    Attributes:
        several: True for residuals with `Residuals.draw`. Others are one term, whose data are None.
    """

    def __init__(
        self,
        residuals: Residuals,
        engine: Engine,
        processes: Processes | None,
        checked: Callable[[Callable[[Tree], Array]], Callable[[Tree], Array]],
    ):
        self.residuals, self._engine, self._checked = residuals, engine, checked
        self.several = overrides(residuals, "draw", Residuals)
        missing = [name for name in ("load", "of") if self.several and not overrides(residuals, name, Residuals)]
        if missing:
            raise InputError(f"{residuals!r} has draw without {' and '.join(missing)}; terms need all three")
        self._processes = processes if self.several else None

    def unchecked(self, data: Tree) -> Residuals:
        """The residuals of one term; `of` checks what they return, too."""
        term = self.residuals.of(data) if self.several else self.residuals
        if not callable(term):
            raise InputError(f"of of {self.residuals!r} gave {quoted(term)}; expected residuals of one term")
        return term

    def of(self, data: Tree) -> Callable[[Tree], Array]:
        """The residuals of one term, as a function that refuses results of another kind."""
        return self._checked(self.unchecked(data))

    def first(self) -> Tree:
        """The data of a term of the first step."""
        return self.load(self.drawn(0)[0])

    @property
    def whole(self) -> bool:
        """True if all terms count at every step."""
        return not self.several or list(self.drawn(0)) == list(self.drawn(None))

    def drawn(self, step: int | None) -> Sequence[Any]:
        """Keys of the terms that count at a step; None for all."""
        if not self.several:
            return [None]
        keys: Any = self.residuals.draw(step)
        try:
            keys = None if isinstance(keys, (str, bytes)) else list(keys)
        except TypeError:
            keys = None
        if keys is None:
            raise InputError(f"draw of {self.residuals!r} gave no list of keys of terms")
        if not keys:
            raise InputError(f"residuals drew no term at step {step}; expected at least one")
        return keys

    def mean(self, compute: Callable[[Any], Sequence[Array]], step: int | None) -> list[Array]:
        """Means over the terms of a step.

        Terms are added in the order in which they were drawn, so that the number of processes makes no difference but
        for rounding.

        Args:
            compute: key of a term → arrays, of equal shapes for all terms.
            step: see `drawn`.
        """
        keys = self.drawn(step)
        if self._processes is None:
            return self._added((compute(key) for key in keys), len(keys))
        vectors, like, failure = [], None, None
        try:
            for key in self._processes.share(keys):
                like = compute(key)
                vectors.append(_flat([self._engine.to_numpy(x) for x in like]))
        except Exception as error:
            failure = error
        gathered = self._processes.in_order(vectors, len(keys), failure)
        if like is None:  # There are more processes than terms. The first term tells shapes and dtypes.
            like = compute(keys[0])
        return self._added((self._split(row, like) for row in gathered), len(keys))

    def load(self, key: Any) -> Tree:
        """The data of a term."""
        return self.residuals.load(key) if self.several else None

    def _added(self, terms: Iterable[Sequence[Array]], count: int) -> list[Array]:
        total: list[Array] = []
        for arrays in terms:
            total = [a + b for a, b in zip(total, arrays, strict=True)] if total else list(arrays)
        return total if count == 1 else [x / count for x in total]

    def _split(self, row: np.ndarray, like: Sequence[Array]) -> list[Array]:
        """Arrays with the shapes and dtypes of `like`, from the numbers of `_flat`."""
        pieces = np.split(row, np.cumsum([math.prod(x.shape) for x in like])[:-1])
        xp = self._engine.namespace
        return [
            xp.astype(self._engine.constant(piece.reshape(tuple(x.shape)), x), x.dtype, copy=False)
            for piece, x in zip(pieces, like, strict=True)
        ]


def _flat(arrays: Sequence[np.ndarray]) -> np.ndarray:
    return np.concatenate([x.reshape(-1).astype(np.float64) for x in arrays])
