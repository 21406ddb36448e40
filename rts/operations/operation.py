"""One idea, one record: a function of arrays, its specification, and its compiled value and derivatives."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from operator import attrgetter
from typing import Any

import numpy as np

from rts.arrays import from_numbers
from rts.engines import OWNERS, constants, engine_of, suiting
from rts.errors import InputError
from rts.trees import Array

_SHAPE = attrgetter("shape")

Arrays = Sequence[np.ndarray]
"""Operands on the host, C-contiguous and read-only."""

Some = Sequence[np.ndarray | None]
"""An array for each operand that has a derivative, or None where it is zero or not wanted."""


@dataclass(frozen=True, eq=False)
class Operation:
    """A function of arrays that every engine can differentiate, in forward and reverse mode, and to second order.

    Where arrays are on the host, and their floats all of one dtype, float32 or float64, its value and first derivatives
    are computed by `forward`, `push` and `pull`. Everywhere else, and for second derivatives, by `specification`. Under
    `vmap` items are computed one after another. An operation is called with its operands, and parameters by name:
    hashable values that are no arrays and are handed on to all of its functions.

    Args of the functions on the host: `operands` (Arrays) are NumPy; `out` and `results` are to be filled in place.

    Attributes:
        name: unique, such as "my_package.warp"; programs that jax keeps on disk find it by this name.
        specification: (*operands, **params) → the result, in array code.
        ranks: of the operands; their number of axes.
        shape: (*shapes of the operands, **params) → the shape of the result; of the floats' dtype.
        forward: (operands, out, **params), the value into `out`. See `keeps`.
        push: (operands, tangents, out, **params), the derivative along tangents of the first operands (JVP); at least
            one is not None. See `sweeps`.
        pull: (operands, gradient, results, **params), the gradients of the first operands from that of the result
            (VJP), into `results`, which are zeros, or None where not wanted.
        differentiable: the first so many operands have derivatives; they are floats.
        packed: operands with a row a sample, of which engines may have allotted more than are used. The functions are
            given the rows in use, as far as the engine knows: of what comes straight from sampling or from another
            operation. The others are zero in the result, and have gradients of zero.
        packed_result: whether the result has a row a sample likewise.
        used: (operands) → how many rows of the packed operands are used; None for as many as the engine knows of.
        even: packed operands whose rows are often all alike, which a compiling engine may make use of.
        keeps: whether `forward` returns an object that helps the derivatives at the same operands: `push` and `pull`
            then take a keyword `kept`, that object or, where it is known no longer, None.
        sweeps: whether `push` takes tangents (T, ·) of T directions at once, and `out` (T, ·); else it is called for
            each.
    """

    name: str
    specification: Callable[..., Array]
    ranks: tuple[int, ...]
    shape: Callable[..., tuple[int, ...]]
    forward: Callable[..., Any]
    push: Callable[..., None]
    pull: Callable[..., None]
    differentiable: int = 1
    packed: tuple[int, ...] = ()
    packed_result: bool = False
    used: Callable[[Arrays], int] | None = None
    even: tuple[int, ...] = ()
    keeps: bool = False
    sweeps: bool = False

    def __post_init__(self):
        object.__setattr__(self, "ranks", tuple(self.ranks))
        count = len(self.ranks)
        if not (isinstance(self.name, str) and self.name):
            raise InputError(f"an operation is named {self.name!r}; expected a name such as 'my_package.warp'")
        if not 1 <= self.differentiable <= count:
            raise InputError(
                f"the operation {self.name} has {count} operands, by its ranks, of which the first "
                f"{self.differentiable} are to have derivatives; expected from 1 to {count}"
            )
        for i in (*self.packed, *self.even):
            if not 0 <= i < count or self.ranks[i] < 1:
                raise InputError(
                    f"the operation {self.name} has no operand {i} of packed rows; its ranks are {self.ranks}"
                )

    def __call__(self, *operands: Array, **params: Any) -> Array:
        """The result, in the engine of the operands; NumPy arrays beside those of another are constants.

        Raises:
            InputError: operands of another number, or with another number of axes.
        """
        if len(operands) != len(self.ranks):
            raise InputError(
                f"the operation {self.name} takes {len(self.ranks)} operands; it was given {len(operands)}"
            )
        kind = type(operands[0])
        for x in operands:
            if type(x) is not kind:
                break
        else:
            if kind in OWNERS or kind is np.ndarray:
                self.check_ranks(operands)
                return engine_of(operands[0]).apply(self, operands, params)
        operands = tuple([from_numbers(x) for x in operands])
        engine, like = suiting(operands)
        operands = constants(operands, engine, like)
        self.check_ranks(operands)
        return engine.apply(self, operands, params)

    def check_ranks(self, operands: Sequence[Array]) -> None:
        """Raise an InputError for operands with another number of axes."""
        for x, rank in zip(operands, self.ranks, strict=True):
            if x.ndim != rank:
                shapes = ", ".join(str(tuple(x.shape)) for x in operands)
                raise InputError(f"the operation {self.name} was given shapes {shapes}; expected ranks {self.ranks}")

    def fits(self, dtypes: Sequence[np.dtype]) -> bool:
        """Whether operands of these NumPy dtypes are of the kind that the functions on the host know."""
        first = dtypes[0]
        if first != np.float32 and first != np.float64:
            return False
        for dtype in dtypes:
            if dtype != first and dtype.kind not in "iub":
                return False
        return True

    # What binders of engines call, with operands of NumPy.

    def value_on_host(self, operands: Arrays, params: dict[str, Any]) -> tuple[np.ndarray, Any]:
        """The result, and what is kept."""
        out = np.empty(self.shape(*map(_SHAPE, operands), **params), operands[0].dtype)
        return out, self.forward(operands, out, **params)

    def push_on_host(self, operands: Arrays, tangents: Some, out: np.ndarray, kept: Any, params: dict) -> None:
        """Fill `out` (T, ·) with the derivatives along tangents (T, ·)."""
        options = {**params, "kept": kept} if self.keeps else params
        if self.sweeps:
            self.push(operands, tangents, out, **options)
            return
        for i, result in enumerate(out):
            self.push(operands, [None if t is None else t[i] for t in tangents], result, **options)

    def pull_on_host(self, operands: Arrays, g: np.ndarray, results: Some, kept: Any, params: dict) -> None:
        """Fill `results`, zeros, with the gradients from that of the result."""
        self.pull(operands, g, results, **({**params, "kept": kept} if self.keeps else params))
