"""Operations as jax primitives: eager, `jit`, `grad`, `jvp`, `vmap` and their combinations.

Three primitives an operation: its value, its pushforward (tangents) and its pullback (gradients). Each of the last two
is linear in the tangents or the gradients, and the transpose of the other. Their derivatives by the operands, which are
second derivatives of the operation, are taken of its specification, which is array code. On devices other than the CPU,
all is computed by the specification.

Tangents and gradients have a leading axis T: one sweep takes T of them. A call with the parameter `single` takes one of
each, without this axis. Eager derivatives are such calls, since eager jax compiles, for each shape and for ever, what
would add the axis and take it away. Under `vmap`, operands that differ from item to
item have an axis B before that. Two numbers may follow the operands of an operation: how many rows are in use, and a
note, the number under which its value has kept arrays for the derivatives.
"""

from __future__ import annotations

import collections
import contextlib
import contextvars
import functools
import itertools
import secrets
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import ShapedArray, Tracer
from jax.interpreters import ad

from rts.plugin_api.operations import Operation
from rts.plugin_api.threads import read_only
from rts_backends.jax_engine.host import clear
from rts_backends.jax_engine.primitives import HostPrimitive

Wanted = tuple[bool, ...]
"""A mark for each differentiable operand: True if it has a tangent, or its gradient is to be computed."""

MOST_KEPT = 1 << 24
"""The most bytes that values keep for derivatives."""


def apply(operation: Operation, operands: Sequence[jax.Array], params: Mapping[str, Any], used: Any) -> jax.Array:
    """The result of an operation whose operands fit, see `fits`.

    Args:
        operation: the operation.
        operands: its operands.
        params: its parameters.
        used: the number of rows in use of the packed operands, () int32.
    """
    if operation not in _bound:
        _bound[operation] = _Differentiable(operation, _name(operation), params)
    used_rows = () if not _Differentiable.takes_used_rows(operation) else (used,)
    return _bound[operation](*operands, *used_rows, **params)


def fits(operation: Operation, operands: Sequence[jax.Array]) -> bool:
    """True if compiled loops take the operands' dtypes, outside of `by_specification`. Devices are not looked at."""
    return not _specifying.get() and operation.fits([x.dtype for x in operands])


_specifying = contextvars.ContextVar("rts_specifying", default=False)


@contextlib.contextmanager
def by_specification() -> Iterator[None]:
    """A context within which this thread computes all operations by their specifications, in array code."""
    token = _specifying.set(True)
    try:
        yield
    finally:
        _specifying.reset(token)


class _Kept:
    """The latest objects that values have kept for derivatives, each under a number; `MOST_KEPT` bytes in all."""

    def __init__(self):
        # Does not count from 0, so that a number from another process names nothing here.
        self._numbers, self._found = itertools.count(secrets.randbits(30)), collections.OrderedDict()
        self._lock, self._bytes = threading.Lock(), 0

    def add(self, kept: Any) -> int:
        """Keep an object, and return its number; beyond `MOST_KEPT` bytes the oldest objects are dropped."""
        with self._lock:
            number = next(self._numbers) % 2**31
            self._found[number] = kept
            self._bytes += _size(kept)
            while self._bytes > MOST_KEPT:
                self._bytes -= _size(self._found.popitem(last=False)[1])
        return number

    def get(self, number: int) -> Any:
        """The object of a number, or None if it is no longer kept."""
        with self._lock:
            return self._found.get(number)


def _size(kept: Any) -> int:
    """Bytes of all arrays in nested tuples, or of one array; 0 for anything else."""
    return sum(map(_size, kept)) if isinstance(kept, tuple) else getattr(kept, "nbytes", 0)


_kept = _Kept()


class _Differentiable:
    """An operation as a function of jax arrays.

    Args:
        operation: the operation.
        name: the name of its primitives.
        params: any valid parameters, which tell the number of axes of its result, the same for all.
    """

    def __init__(self, operation: Operation, name: str, params: Mapping[str, Any]):
        self.operation, self.varied = operation, operation.differentiable
        self.rank = len(operation.result_shape(*((1,) * r for r in operation.ranks), **params))
        self._inputs = len(operation.ranks)
        self._takes_used_rows = self.takes_used_rows(operation)
        inputs_of_value = self._inputs + self._takes_used_rows
        count = self.count = inputs_of_value + operation.keeps
        varied, shape, inputs = self.varied, operation.result_shape, self._inputs

        def pulled(*shapes: tuple, wanted: Wanted, single: bool, **_: Any) -> list[tuple]:
            lead = () if single else shapes[count][:1]
            return [(*lead, *x) for x, wish in zip(shapes[:varied], wanted, strict=True) if wish]

        def pushed(*shapes: tuple, wanted: Wanted, single: bool, **params: Any) -> list[tuple]:
            lead = () if single else shapes[count][:1]
            return [(*lead, *shape(*shapes[:inputs], **params))]

        def valued(*shapes: tuple, **params: Any) -> list[tuple]:
            return [shape(*shapes[:inputs], **params), *[()] * operation.keeps]

        noted = operation.keeps
        ranks = *operation.ranks, *[0] * self._takes_used_rows
        self._value = HostPrimitive(name, ranks, inputs_of_value, valued, self._host_value, self._plain, noted=noted)
        ranks = *ranks, *[0] * noted
        swept, backward = (*ranks, *(r + 1 for r in ranks[:varied])), (*ranks, self.rank + 1)
        self._push = HostPrimitive(
            f"{name}_push", swept, count, pushed, self._host_push, self._specified_push, some=True
        )
        in_place = tuple(i for i in operation.packed if i < varied)
        self._pull = HostPrimitive(
            f"{name}_pull", backward, count, pulled, self._host_pull, self._specified_pull, in_place=in_place
        )
        ad.primitive_jvps[self._value.primitive] = self._value_jvp
        ad.primitive_jvps[self._push.primitive] = self._push_jvp
        ad.primitive_jvps[self._pull.primitive] = self._pull_jvp
        ad.primitive_transposes[self._push.primitive] = self._push_transpose
        ad.primitive_transposes[self._pull.primitive] = self._pull_transpose

    @staticmethod
    def takes_used_rows(operation: Operation) -> bool:
        """True if the operation's primitives take the number of rows in use: rows are packed, and it has no `used`."""
        return bool(operation.packed) and operation.used is None

    def __call__(self, *operands: jax.Array, **params: Any) -> jax.Array:
        """The operation's result; `operands` include the number of rows in use if `takes_used_rows`."""
        return self._value(*operands, **params)[0]

    # ------------------------------------------------------------------------------------------ by compiled loops

    def _in_use(self, arrays: Sequence[np.ndarray]) -> tuple[list[np.ndarray], int, Any]:
        """Operands, packed ones cut to rows in use; the number of these rows, or 0; what the value has kept, or None.

        The number is 0 if no operand is packed.
        """
        operands = [read_only(x) for x in arrays[: self._inputs]]
        operation, used = self.operation, 0
        if operation.packed:
            used = int(arrays[self._inputs]) if operation.used is None else operation.used(operands)
            for i in operation.packed:
                operands[i] = operands[i][:used]
        kept = _kept.get(int(arrays[self.count - 1])) if operation.keeps and len(arrays) >= self.count else None
        return operands, used, kept

    def _host_value(self, arrays: Sequence[np.ndarray], results: Sequence[np.ndarray], **params: Any) -> None:
        """Fill `results`: the value, zeros in rows not in use; and a note, if the operation `keeps`, −1 for none."""
        operands, used, _ = self._in_use(arrays)
        out = results[0]
        if self.operation.packed_result:
            out = out[:used]
            clear(results[0][used:])
        _, kept = self.operation.value_on_host(operands, params, out)
        if self.operation.keeps:
            results[1][...] = -1 if kept is None else _kept.add(kept)

    def _host_push(
        self, arrays: Sequence[np.ndarray], results: Sequence[np.ndarray], wanted: Wanted, single: bool, **params: Any
    ) -> None:
        """Fill `results`: the value's tangents (T, ·), from those of operands marked `wanted`, last in `arrays`."""
        if single:
            arrays = [*arrays[: self.count], *(t[None] for t in arrays[self.count :])]
            results = [x[None] for x in results]
        operands, used, kept = self._in_use(arrays)
        tangents: list[Any] = _spread(arrays[self.count :], wanted)
        for i in self.operation.packed:
            if i < self.varied and tangents[i] is not None:
                tangents[i] = tangents[i][:, :used]
        out = results[0]
        if self.operation.packed_result:
            out = out[:, :used]
            for result in results[0]:
                clear(result[used:])
        self.operation.push_on_host(operands, tangents, out, kept, params)

    def _host_pull(
        self, arrays: Sequence[np.ndarray], results: Sequence[np.ndarray], wanted: Wanted, single: bool, **params: Any
    ) -> None:
        """Fill `results`, gradients (T, ·) of the operands that `wanted` marks; zeros in rows not in use.

        The last of `arrays` are the value's gradients (T, ·). A result may share the memory of its operand.
        """
        if single:
            arrays, results = [*arrays[:-1], arrays[-1][None]], [x[None] for x in results]
        operands, used, kept = self._in_use(arrays)
        places = _spread(results, wanted)
        for t, g in enumerate(arrays[-1]):
            found: list[Any] = [None if x is None else x[t, ...] for x in places]
            shared = {}
            for i, x in enumerate(found):
                if x is None:
                    continue
                if np.may_share_memory(x, arrays[i]):  # It is to take the place of what is still read.
                    shared[i], found[i] = x, np.zeros((used, *x.shape[1:]), x.dtype)
                    continue
                clear(x)
                if i in self.operation.packed:
                    found[i] = x[:used]
            self.operation.pull_on_host(operands, g[:used] if self.operation.packed_result else g, found, kept, params)
            for i, x in shared.items():
                x[:used] = found[i]
                clear(x[used:])

    # --------------------------------------------------------------------------------------------- by specification

    def _plain(self, *operands: jax.Array, **params: Any) -> list[jax.Array]:
        note = [jnp.zeros((), np.int32)] * self.operation.keeps
        return [self.operation.specification(*operands[: self._inputs], **params), *note]

    def _specified_push(self, *operands: jax.Array, wanted: Wanted, single: bool, **params: Any) -> list[jax.Array]:
        function, varied = self._among(wanted, operands[: self.count], params)
        push = jax.linearize(function, *varied)[1]
        return [(push if single else jax.vmap(push))(*operands[self.count :])]

    def _specified_pull(self, *operands: jax.Array, wanted: Wanted, single: bool, **params: Any) -> list[jax.Array]:
        function, varied = self._among(wanted, operands[: self.count], params)
        pull = jax.vjp(function, *varied)[1]
        return list((pull if single else jax.vmap(pull))(operands[-1]))

    def _among(self, wanted: Wanted, operands: Sequence, params: dict) -> tuple[Callable, list[jax.Array]]:
        """The operation's array code as a function of the wanted operands alone, and the list of these operands."""
        n = self.varied

        def function(*wanted_operands: jax.Array) -> jax.Array:
            varied = (
                x if g is None else g for x, g in zip(operands[:n], _spread(wanted_operands, wanted), strict=True)
            )
            return self.operation.specification(*varied, *operands[n : self._inputs], **params)

        return function, [x for x, wish in zip(operands[:n], wanted, strict=True) if wish]

    # -------------------------------------------------------------------------------------------------- derivatives

    def _value_jvp(self, primals: Sequence, tangents: Sequence, **params: Any) -> tuple[list, list]:
        found = self._value(*primals, **params)
        nonzero, wanted = _present(tangents[: self.varied])
        if not nonzero:
            return found, _zeros(found)
        if not any(isinstance(x, Tracer) for x in primals):
            (pushed,) = self._push(*primals, *found[1:], *nonzero, wanted=wanted, single=True, **params)
            return found, [pushed, *_zeros(found[1:])]
        at = 1 if found[0].ndim > self.rank else 0
        # Tangents of operands by item have the axes B and T, in this order; tangents of others T alone.
        ranks = (r for r, wish in zip(self._value.ranks, wanted, strict=False) if wish)
        swept = [jnp.expand_dims(t, t.ndim - rank) for t, rank in zip(nonzero, ranks, strict=True)]
        (pushed,) = self._push(*primals, *found[1:], *swept, wanted=wanted, single=False, **params)
        return found, [jax.lax.squeeze(pushed, (at,)), *_zeros(found[1:])]

    def _push_jvp(self, primals: Sequence, tangents: Sequence, *, wanted: Wanted, **params: Any) -> tuple[list, list]:
        found = self._push(*primals, wanted=wanted, **params)
        along = self._along_operands(self._push, primals, tangents, {**params, "wanted": wanted})
        nonzero, moved = _present(tangents[self.count :], wanted)
        if nonzero:
            linear = self._push(*primals[: self.count], *nonzero, wanted=moved, **params)
            along = linear if along is None else [a + b for a, b in zip(along, linear, strict=True)]
        return found, _zeros(found) if along is None else along

    def _pull_jvp(self, primals: Sequence, tangents: Sequence, **params: Any) -> tuple[list, list]:
        found = self._pull(*primals, **params)
        along = self._along_operands(self._pull, primals, tangents, params)
        if not _is_zero(tangents[self.count]):
            linear = self._pull(*primals[: self.count], tangents[self.count], **params)
            along = linear if along is None else [a + b for a, b in zip(along, linear, strict=True)]
        return found, _zeros(found) if along is None else along

    def _along_operands(
        self, operation: HostPrimitive, primals: Sequence, tangents: Sequence, params: dict
    ) -> list | None:
        """Derivatives of results along tangents of the differentiable operands, by array code; None if all are zero."""
        n = self.varied
        _, moved = _present(tangents[:n])
        if not any(moved):
            return None
        if moved[0] or params["wanted"][0]:
            self.operation.warn_of_second()
        fixed = [x for x, m in zip(primals[:n], moved, strict=True) if not m]

        def function(*moving: jax.Array) -> list[jax.Array]:
            it, rest = iter(moving), iter(fixed)
            both = [next(it) if m else next(rest) for m in moved]
            return _whole(operation, tuple(params.items()))(*both, *primals[n:])

        varied = [x for x, m in zip(primals[:n], moved, strict=True) if m]
        along = [t for t, m in zip(tangents[:n], moved, strict=True) if m]
        return jax.jvp(function, tuple(varied), tuple(along))[1]

    def _push_transpose(self, gradients: Sequence, *operands: Any, wanted: Wanted, **params: Any) -> list:
        (g,), samples, tangents = gradients, operands[: self.count], operands[self.count :]
        if _is_zero(g):
            return [None] * self.count + [ad.Zero(t.aval) for t in tangents]
        found = self._pull(*samples, g, wanted=wanted, **params)
        return [None] * self.count + [_summed(x, t.aval.ndim) for x, t in zip(found, tangents, strict=True)]

    def _pull_transpose(self, tangents: Sequence, *operands: Any, wanted: Wanted, **params: Any) -> list:
        *samples, g = operands
        nonzero, moved = _present(tangents, wanted)
        if not nonzero:
            return [None] * self.count + [ad.Zero(g.aval)]
        (found,) = self._push(*samples, *nonzero, wanted=moved, **params)
        return [None] * self.count + [_summed(found, g.aval.ndim)]


@functools.cache
def _whole(operation: HostPrimitive, params: tuple) -> Callable:
    """`operation.specification` compiled as a whole; eagerly, jax would compile each of its array functions alone."""
    return jax.jit(functools.partial(operation.specification, **dict(params)))


def _spread(items: Sequence, wanted: Wanted) -> list:
    """A list as long as `wanted`: the items of `items`, in order, where `wanted` is True, and None elsewhere."""
    it = iter(items)
    return [next(it) if wish else None for wish in wanted]


def _is_zero(x: Any) -> bool:
    return type(x) is ad.Zero


def _zeros(like: Sequence[jax.Array]) -> list:
    return [ad.Zero(ShapedArray(x.shape, x.dtype).to_tangent_aval()) for x in like]


def _present(tangents: Sequence, wanted: Wanted | None = None) -> tuple[list, Wanted]:
    """Tangents that are not zero, and a mark for each operand: True if its tangent is among them.

    `tangents` are of all operands, or of those that `wanted` marks; jax's `ad.Zero`, or None, is one of zeros.
    """
    places = tangents if wanted is None else _spread(tangents, wanted)
    present = tuple(t is not None and not _is_zero(t) for t in places)
    return [t for t, g in zip(places, present, strict=True) if g], present


_bound: dict[Operation, _Differentiable] = {}


def _name(operation: Operation) -> str:
    """A name for an operation's primitives, which no other operation has, even if several are named alike."""
    same = sum(1 for other in _bound if other.name == operation.name)
    return f"{operation.name}~{same}" if same else operation.name


def _summed(x: jax.Array, rank: int) -> jax.Array:
    """`x`, summed over its first axis, the items of a batch, if it has more than `rank` axes.

    It is the gradient of an operand that all items share.
    """
    return x.sum(0) if x.ndim > rank else x
