"""Functions of packed rows, computed on about as many of the allotted rows as are in use.

A compiled program allots rows for the worst case, and learns how many are in use when it runs. Here it takes a piece of
so many rows at a time, in a loop that ends with those in use.

There are three primitives, as of operations: the value, its pushforward and its pullback. jax cannot pull back through
a loop of a length that it does not know; here derivatives are taken within each piece, for which the value is computed
once more. Derivatives of derivatives are those of the function of all rows.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.core import ShapedArray, Tracer, eval_jaxpr
from jax.extend.core import Jaxpr, Primitive
from jax.interpreters import ad, batching, mlir

from rts_backends.jax_engine.columns import summed_by_columns, variables

LEAST = 1 << 15
"""Rows, below which all are computed: a loop would take as long as it saves."""

PIECE = 1 << 12
"""Rows of a piece: so many that a call of XLA's is worth it, and so few that intermediate arrays stay in caches."""


class _Program(NamedTuple):
    """A function of rows (n, ·), which also takes what it closes over.

    Attributes:
        rows: n.
        jaxpr: arrays (n, ·) → (n, ·).
        closed: where among the operands the arrays are that it closes over.
    """

    rows: int
    jaxpr: Jaxpr
    closed: tuple[int, ...]


def apply(f: Callable[..., jax.Array], used: jax.Array, rows: Sequence[jax.Array]) -> jax.Array | None:
    """The value (N, ·) of a function that treats each row by itself; anything in rows that are not in use.

    Args:
        f: arrays (n, ·), for some n up to N → (n, ·).
        used: how many rows are in use, () int32.
        rows: arrays (N, ·).

    Returns:
        The value, or None where the whole of it may as well be computed: of few rows; of a function that does not read
        them, or that has effects, which must happen once.
    """
    count = rows[0].shape[0]
    if count < LEAST:
        return None
    closed: list[Any] = []
    programs = []
    for n in (min(PIECE, count), count):
        traced = jax.make_jaxpr(f)(*(jax.ShapeDtypeStruct((n, *x.shape[1:]), x.dtype) for x in rows))
        if traced.effects:
            return None
        jaxpr, consts = _of_rows_alone(traced.jaxpr, traced.consts)
        if variables(jaxpr.eqns, jaxpr.outvars).keys().isdisjoint(jaxpr.invars):
            return None
        programs.append(_Program(n, jaxpr, tuple(_places(consts, closed))))
    return _value.bind(used, used, *closed, *rows, programs=tuple(programs))[0]


def _of_rows_alone(jaxpr: Jaxpr, consts: Sequence[Any]) -> tuple[Jaxpr, list[Any]]:
    """A function without what does not depend on its arguments, which is computed here, and what it now closes over."""
    varying, before, rest = set(jaxpr.invars), [], []
    for equation in jaxpr.eqns:
        if variables([equation]).keys().isdisjoint(varying):
            before.append(equation)
        else:
            rest.append(equation)
            varying.update(equation.outvars)
    read = variables(rest, jaxpr.outvars)
    known = [*jaxpr.constvars, *(x for equation in before for x in equation.outvars)]
    known = [x for x in known if x in read]
    first = jaxpr.replace(invars=[], outvars=known, eqns=before, debug_info=jaxpr.debug_info.with_unknown_names())
    found = eval_jaxpr(first, consts)
    return jaxpr.replace(constvars=known, eqns=rest), found


def _places(arrays: Sequence[Any], known: list[Any]) -> Iterator[int]:
    """Where each of some arrays is in a list, to which those are added that are not."""
    for x in arrays:
        at = next((i for i, other in enumerate(known) if other is x), len(known))
        if at == len(known):
            known.append(x)
        yield at


# --------------------------------------------------------------------------------------------------- three functions


class _Pieces(NamedTuple):
    """How a function of rows is computed.

    Attributes:
        program: the function of a piece.
        total: the number of all rows.
        most: how many rows are in use, at most.
        used: how many are.
        closed: arrays that the program closes over.
        rows: arrays (N, ·).
    """

    program: _Program
    total: int
    most: Any
    used: Any
    closed: Sequence[Any]
    rows: Sequence[Any]

    def repeat(self, step: Callable[[Any, Any, Any], Any], state: Any) -> Any:
        """Do `state = step(start, first, state)` for the pieces in use: rows from `start`, new ones from `first` on."""
        size = self.program.rows
        if size == self.total:
            return step(0, 0, state)

        def body(i: Any, state: Any) -> Any:
            return step(jnp.minimum(i * size, self.total - size), i * size, state)

        count = (self.most + (size - 1)) // size
        if isinstance(count, Tracer):
            return jax.lax.fori_loop(0, count, body, state)
        for i in range(int(count)):
            state = body(i, state)
        return state

    def cut(self, x: Any, start: Any) -> Any:
        """The rows of a piece."""
        size = self.program.rows
        return x if size == self.total else jax.lax.dynamic_slice_in_dim(x, start, size)

    def varying(self, start: Any, wanted: Sequence[bool]) -> tuple[Callable[..., jax.Array], list[Any]]:
        """The value of a piece as a function of those operands that are wanted, closed ones and pieces, and these."""
        operands = [*self.closed, *(self.cut(x, start) for x in self.rows)]
        there = start + jnp.arange(self.program.rows) < self.used

        def function(*varied: Any) -> jax.Array:
            it = iter(varied)
            given = [next(it) if wish else x for x, wish in zip(operands, wanted, strict=True)]
            own = []
            for x, whole in zip(given[len(self.closed) :], self.rows, strict=True):
                # What is not in use may hold values at which there are no derivatives.
                other = jnp.where(self.used > 0, jax.lax.stop_gradient(whole[:1]), jnp.ones((), x.dtype))
                own.append(jnp.where(there.reshape(-1, *[1] * (x.ndim - 1)), x, other))
            return eval_jaxpr(self.program.jaxpr, [given[i] for i in self.program.closed], *own)[0]

        return function, [x for x, wish in zip(operands, wanted, strict=True) if wish]


def _pieces(most: Any, used: Any, operands: Sequence[Any], programs: Sequence[_Program], few: int) -> _Pieces:
    """How a function of operands is computed: by the program of a piece, or that of all rows."""
    last = len(operands) - len(programs[0].jaxpr.invars)
    return _Pieces(programs[few], programs[1].rows, most, used, operands[:last], operands[last:])


def _computed(most: Any, used: Any, *operands: Any, programs: Sequence[_Program], few: int = 0) -> list[jax.Array]:
    pieces = _pieces(most, used, operands, programs, few)

    def step(start: Any, first: Any, out: jax.Array) -> jax.Array:
        function, _ = pieces.varying(start, [False] * len(operands))
        return jax.lax.dynamic_update_slice_in_dim(out, summed_by_columns(function)(), start, 0)

    return [pieces.repeat(step, jnp.zeros(*_result(programs)))]


def _pushed(
    most: Any, used: Any, *given: Any, programs: Sequence[_Program], wanted: tuple[bool, ...], few: int = 0
) -> list[jax.Array]:
    """The derivative along tangents of those operands that are wanted, which follow the operands."""
    operands, tangents = given[: len(wanted)], given[len(wanted) :]
    pieces = _pieces(most, used, operands, programs, few)
    fixed = sum(wanted[: len(pieces.closed)])

    def step(start: Any, first: Any, out: jax.Array) -> jax.Array:
        function, varied = pieces.varying(start, wanted)
        along = *tangents[:fixed], *(pieces.cut(t, start) for t in tangents[fixed:])
        pushed = summed_by_columns(lambda: jax.jvp(function, tuple(varied), along)[1])()
        return jax.lax.dynamic_update_slice_in_dim(out, pushed, start, 0)

    return [pieces.repeat(step, jnp.zeros(*_result(programs)))]


def _pulled(
    most: Any, used: Any, *given: Any, programs: Sequence[_Program], wanted: tuple[bool, ...], few: int = 0
) -> list[jax.Array]:
    """The gradients of those operands that are wanted; that of the value follows the operands."""
    *operands, g = given
    pieces = _pieces(most, used, operands, programs, few)
    fixed = sum(wanted[: len(pieces.closed)])

    def step(start: Any, first: Any, found: list[jax.Array]) -> list[jax.Array]:
        function, varied = pieces.varying(start, wanted)
        fresh = start + jnp.arange(pieces.program.rows) >= first  # The others were in the piece before.
        own = jnp.where(fresh.reshape(-1, *[1] * (g.ndim - 1)), pieces.cut(g, start), 0)
        gradients = summed_by_columns(lambda g: jax.vjp(function, *varied)[1](g))(own)
        sums = [a + b for a, b in zip(found[:fixed], gradients[:fixed], strict=True)]
        for total, x in zip(found[fixed:], gradients[fixed:], strict=True):
            sums.append(jax.lax.dynamic_update_slice_in_dim(total, pieces.cut(total, start) + x, start, 0))
        return sums

    return pieces.repeat(step, [jnp.zeros_like(x) for x, wish in zip(operands, wanted, strict=True) if wish])


def _result(programs: Sequence[_Program]) -> tuple[tuple[int, ...], Any]:
    """Shape and dtype of the value."""
    aval = programs[1].jaxpr.outvars[0].aval
    return aval.shape, aval.dtype


# --------------------------------------------------------------------------------------------------- as primitives


def _primitive(name: str, function: Callable, shapes: Callable) -> Primitive:
    """A primitive of one of the functions, whose first operands say how many rows are in use, at most and truly.

    Args:
        name: its name.
        function: computes it.
        shapes: operands but for the first two, and parameters → the results' shapes and dtypes.
    """
    made = Primitive(f"rts_rows_in_use_{name}")
    made.multiple_results = True
    made.def_impl(function)
    made.def_abstract_eval(lambda most, used, *avals, **params: shapes(*avals, **params))
    mlir.register_lowering(made, mlir.lower_fun(function, multiple_results=True))

    def batched(operands: Sequence, dims: Sequence, **params: Any) -> tuple[list, list[int]]:
        # One loop serves all items, as long as the longest; rows that are not in use are harmless.
        most = operands[0] if dims[0] is None else jnp.max(operands[0])
        found = jax.vmap(functools.partial(function, most, **params), tuple(dims[1:]))(*operands[1:])
        return found, [0] * len(found)

    def along(primals: Sequence, tangents: Sequence, **params: Any) -> tuple[list, list]:
        present = _present(tangents)

        def whole(*varied: Any) -> list[jax.Array]:
            it = iter(varied)
            return function(*(next(it) if t else x for x, t in zip(primals, present, strict=True)), few=1, **params)

        varied, moves = (tuple(x for x, t in zip(xs, present, strict=True) if t) for xs in (primals, tangents))
        return made.bind(*primals, **params), jax.jvp(whole, varied, moves)[1]

    batching.primitive_batchers[made] = batched
    ad.primitive_jvps[made] = along
    return made


def _present(tangents: Sequence[Any]) -> tuple[bool, ...]:
    """Which tangents there are; integers have none."""
    return tuple(type(t) is not ad.Zero and t.dtype != jax.dtypes.float0 for t in tangents)


def _rows(*avals: Any, programs: Sequence[_Program], **_: Any) -> list[ShapedArray]:
    return [ShapedArray(*_result(programs))]


def _operands(*avals: Any, wanted: tuple[bool, ...], **_: Any) -> list[ShapedArray]:
    return [ShapedArray(x.shape, x.dtype) for x, wish in zip(avals, wanted, strict=False) if wish]


_value = _primitive("value", _computed, _rows)
_push = _primitive("push", _pushed, _rows)
_pull = _primitive("pull", _pulled, _operands)


def _value_jvp(primals: Sequence, tangents: Sequence, **params: Any) -> tuple[list, list]:
    found, wanted = _value.bind(*primals, **params), _present(tangents[2:])
    along = [t for t, there in zip(tangents[2:], wanted, strict=True) if there]
    if not along:
        return found, [ad.Zero(ShapedArray(x.shape, x.dtype).to_tangent_aval()) for x in found]
    return found, _push.bind(*primals, *along, wanted=wanted, **params)


def _push_transpose(gradients: Sequence, *given: Any, wanted: tuple[bool, ...], **params: Any) -> list:
    (g,), operands, tangents = gradients, given[: 2 + len(wanted)], given[2 + len(wanted) :]
    if type(g) is ad.Zero:
        return [None] * len(operands) + [ad.Zero(t.aval) for t in tangents]
    return [None] * len(operands) + _pull.bind(*operands, g, wanted=wanted, **params)


ad.primitive_jvps[_value] = _value_jvp
ad.primitive_transposes[_push] = _push_transpose
