"""The record `Operation`: a function of arrays, its specification, and its compiled value and derivatives."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import repeat
from operator import attrgetter, is_not
from typing import Any

import numpy as np

from rts.arrays.argument_checks import one_line, quoted
from rts.arrays.array_functions import from_numbers, kind_of
from rts.arrays.engines import OWNERS, constants, context_of, engine_of
from rts.arrays.trees import Array
from rts.compiling.threads import read_only
from rts.errors import InputError, InputWarning, RtsError, warn

_SHAPE = attrgetter("shape")
_WHOLE = {int, np.int32, np.int64}


def _in_words(shapes: Iterable[tuple[int, ...]]) -> str:
    return ", ".join(str(tuple(shape)) for shape in shapes)


def known_value(x: Array) -> np.ndarray | None:
    """The value of an array in the host's memory; None if the array is on another device, or traced."""
    return x if type(x) is np.ndarray else (OWNERS.get(type(x)) or engine_of(x)).at_hand(x)


Arrays = Sequence[np.ndarray]
"""Operands on the host, C-contiguous and read-only."""

Some = Sequence[np.ndarray | None]
"""An array for each differentiable operand, or None where it is zero or not wanted."""


@dataclass(frozen=True, eq=False)
class Operation:
    """A function of arrays that torch and jax can differentiate, in forward and reverse mode, and to second order.

    `forward`, `push` and `pull` compute value and first derivatives if arrays are on the host, and all floats have one
    dtype, float32 or float64. Otherwise, and for second derivatives, `specification` runs, on any device. Under `vmap`
    they are called for each item, by several threads perhaps. An operation is called with its operands, and with
    parameters by name. Parameters are hashable values, not arrays, and are passed to all of its functions but `used`.
    Their names are not `kept`, `wanted` or `single`, which engines pass themselves.

    `forward`, `push` and `pull` run on the host. Their `operands` are NumPy arrays, C-contiguous and read-only; they
    fill `out` and `results` in place.

    Attributes:
        name: unique, such as "my_package.warp"; programs that jax keeps on disk look the operation up by this name.
        specification: (*operands, **params) → the result, in array code.
        ranks: the number of axes of each operand.
        shape: (*shapes of the operands, **params) → the shape of the result, whose dtype is that of the floats.
        forward: (operands, out, **params), writes the value to `out`. See `keeps`.
        push: (operands, tangents, out, **params), writes to `out` the derivative along tangents of the differentiable
            operands (JVP); a tangent of zeros is None, but not all are. See `sweeps`.
        pull: (operands, gradient, results, **params), turns the gradient of the result into gradients of the
            differentiable operands (VJP). It writes them to `results`, which are zeros, or None where not wanted.
        differentiable: the number of operands, from the first on, that have derivatives; these are floats.
        packed: the indices of operands that have a row for each sample. Engines may have allotted more rows than are
            used. The functions receive only the rows in use, where the engine knows them: for arrays that come
            straight from sampling or from another operation. Other rows are zero in the result, and so are their
            gradients.
        packed_result: whether the result has a row for each sample, too.
        used: (operands) → number of rows of the packed operands in use; None to rely on the engine.
        keeps: whether `forward` returns an object that helps the derivatives at the same operands. `push` and `pull`
            then take a keyword `kept`: that object, or None if it is lost.
        sweeps: whether `push` takes tangents (T, ·) of T directions at once, and `out` (T, ·). Otherwise it is called
            for each direction.
        second: what to warn of where a derivative of a derivative is asked for in which the first operand has a part;
            for array code whose second derivatives are not those of what its value stands for. Empty for nothing.
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
    keeps: bool = False
    sweeps: bool = False
    second: str = ""

    @classmethod
    def of_loops(
        cls,
        name: str,
        specification: Callable[..., Array],
        ranks: tuple[int, ...],
        shape: Callable[..., tuple[int, ...]],
        loops: Callable[[], tuple[Callable, Callable, Callable]],
        check: Callable[..., None] | None = None,
        **options: Any,
    ) -> Operation:
        """An operation of three functions that take arrays one by one, such as compiled loops.

        Input arrays are C-contiguous and read-only, tangents and the gradient too: each loop is compiled once for each
        dtype of the floats.

        Args:
            name: as the attribute.
            specification: as the attribute.
            ranks: as the attribute.
            shape: as the attribute.
            loops: () → (forward, push, pull); called once, on first use, so that it may import numba then.
                forward(*operands, out, **params) and push(*operands, *tangents, out, **params) fill `out`;
                pull(*operands, gradient, *results, **params) fills the results, of which not all are None.
            check: (*operands, **params), raises an InputError if operands do not fit one another.
            **options: the other attributes, from `differentiable` on.

        Raises:
            InputError: an attribute is not of its kind.
        """
        known, checked = cache(loops), check or (lambda *_, **__: None)

        def forward(operands: Arrays, out: np.ndarray, **params: Any) -> Any:
            checked(*operands, **params)
            return known()[0](*operands, out, **params)

        def push(operands: Arrays, tangents: Some, out: np.ndarray, **params: Any) -> None:
            along = [None if t is None else read_only(t) for t in tangents]
            checked(*operands, **params)
            known()[1](*operands, *along, out, **params)

        def pull(operands: Arrays, gradient: np.ndarray, results: Some, **params: Any) -> None:
            if any(map(is_not, results, repeat(None))):
                checked(*operands, **params)
                known()[2](*operands, read_only(gradient), *results, **params)

        return cls(name, specification, ranks, shape, forward, push, pull, **options)

    def __post_init__(self):
        if not (isinstance(self.name, str) and self.name):
            raise InputError(f"an operation is named {quoted(self.name)}; expected a name such as 'my_package.warp'")
        for name in ("specification", "shape", "forward", "push", "pull", "used"):
            function = getattr(self, name)
            if not callable(function) and not (name == "used" and function is None):
                raise InputError(f"{name} of the operation {self.name} is {quoted(function)}; expected a function")
        for name in ("ranks", "packed"):
            object.__setattr__(self, name, self._integers(name))
        for name in ("packed_result", "keeps", "sweeps"):
            if type(getattr(self, name)) is not bool:
                value = quoted(getattr(self, name))
                raise InputError(f"{name} of the operation {self.name} is {value}; expected True or False")
        if not isinstance(self.second, str):
            raise InputError(f"second of the operation {self.name} is {quoted(self.second)}; expected a text, or ''")
        self._check_indices()

    def _integers(self, name: str) -> tuple[int, ...]:
        """The field `name` as a tuple of integers of at least 0; anything else is refused."""
        indices = getattr(self, name)
        if isinstance(indices, (tuple, list)) and all(type(n) is int and n >= 0 for n in indices):
            return tuple(indices)
        raise InputError(
            f"{name} of the operation {self.name} is {quoted(indices)}; expected a tuple of integers of at least 0, "
            f"one for each operand{'' if name == 'ranks' else ' that is meant'}"
        )

    def _check_indices(self) -> None:
        count = len(self.ranks)
        if type(self.differentiable) is not int or not 1 <= self.differentiable <= count:
            raise InputError(
                f"the operation {self.name} has {count} operands, by its ranks, of which the first "
                f"{quoted(self.differentiable)} are to have derivatives; expected from 1 to {count}"
            )
        for i in self.packed:
            if i >= count or self.ranks[i] < 1:
                raise InputError(
                    f"the operation {self.name} has no operand {i} of packed rows; its ranks are {self.ranks}"
                )

    def __call__(self, *operands: Array, **params: Any) -> Array:
        """The result, in the engine of the operands. NumPy arrays beside arrays of another engine are constants.

        Raises:
            InputError: an operand is no array, the number of operands or of the axes of one is wrong, or the
                operation's functions refuse them.
            EngineError: operands of two engines.
        """
        if len(operands) != len(self.ranks):
            raise InputError(
                f"the operation {self.name} takes {len(self.ranks)} operands; it was given {len(operands)}"
            )
        kind = type(operands[0])
        owner: Any = engine_of() if kind is np.ndarray else OWNERS.get(kind)
        for x, rank in zip(operands, self.ranks, strict=True):
            if type(x) is not kind or owner is None or x.ndim != rank:
                break
        else:
            return owner.apply(self, operands, params)
        operands = tuple([from_numbers(x, f"an operand of {self.name}") for x in operands])
        if any(isinstance(x, (Mapping, list, tuple)) or x is None for x in operands):
            kinds = ", ".join(map(kind_of, operands))
            raise InputError(f"the operation {self.name} was given {kinds} as operands; expected arrays")
        engine, like = context_of(operands)
        operands = constants(operands, engine, like)
        self.check_ranks(operands)
        return engine.apply(self, operands, params)

    def check_ranks(self, operands: Sequence[Array]) -> None:
        """Raise an InputError if the number of axes of an operand is not its rank."""
        for x, rank in zip(operands, self.ranks, strict=True):
            if x.ndim != rank:
                shapes = _in_words(map(_SHAPE, operands))
                raise InputError(f"the operation {self.name} was given shapes {shapes}; expected ranks {self.ranks}")

    def fits(self, dtypes: Sequence[np.dtype]) -> bool:
        """True if compiled code takes operands of these NumPy dtypes."""
        first = dtypes[0]
        if first != np.float32 and first != np.float64:
            return False
        for dtype in dtypes:
            if dtype != first and dtype.kind not in "iub":
                return False
        return True

    def warn_of_second(self) -> None:
        """Warn of `second`, if there is something; engines' binders call it where the first operand has a part."""
        if self.second:
            warn(self.second, InputWarning)

    # Engines' binders call the methods below, with operands in NumPy.

    def result_shape(self, *shapes: tuple[int, ...], **params: Any) -> tuple[int, ...]:
        """The shape of the result for operands of these shapes.

        Raises:
            InputError: `shape` fails, or returns no shape.
        """
        try:
            result = self.shape(*shapes, **params)
        except (TypeError, ValueError, IndexError) as error:
            raise self._refused("shape", shapes, error) from error
        if type(result) is not tuple or not _WHOLE.issuperset(map(type, result)) or min(result, default=0) < 0:
            raise InputError(
                f"shape of the operation {self.name} gives {quoted(result)} for operands of shapes "
                f"{_in_words(shapes)}; expected a tuple of integers of at least 0"
            )
        return result

    def value_on_host(self, operands: Arrays, params: Mapping[str, Any], out: Any = None) -> tuple[np.ndarray, Any]:
        """The result, in `out` if it is given, and the object that `forward` keeps for the derivatives, or None.

        Raises:
            InputError: `forward` cannot take the operands.
        """
        if out is None:
            out = np.empty(self.result_shape(*map(_SHAPE, operands), **params), operands[0].dtype)
        try:
            return out, self.forward(operands, out, **params)
        except (TypeError, ValueError, IndexError) as error:
            raise self._refused("forward", list(map(_SHAPE, operands)), error) from error

    def _refused(self, function: str, shapes: Sequence[tuple[int, ...]], error: Exception) -> Exception:
        """The error to raise after `function` failed: errors of the library as they are, others as `InputError`."""
        if isinstance(error, RtsError):
            return error
        return InputError(
            f"{function} of the operation {self.name} cannot take operands of shapes {_in_words(shapes)}: "
            f"{one_line(error)}; give it operands of shapes that fit"
        )

    def push_on_host(self, operands: Arrays, tangents: Some, out: np.ndarray, kept: Any, params: dict) -> None:
        """Fill `out` (T, ·) with the derivatives along tangents (T, ·) of T directions; None is a tangent of zeros."""
        options = {**params, "kept": kept} if self.keeps else params
        if self.sweeps:
            self.push(operands, tangents, out, **options)
            return
        for i, result in enumerate(out):
            self.push(operands, [None if t is None else t[i] for t in tangents], result, **options)

    def pull_on_host(self, operands: Arrays, g: np.ndarray, results: Some, kept: Any, params: dict) -> None:
        """Fill `results`, given as zeros or None, with the operands' gradients; `g` is the gradient of the result."""
        self.pull(operands, g, results, **({**params, "kept": kept} if self.keeps else params))
