"""Functions of packed rows, computed on about as many of the allotted rows as are in use.

A compiled program allots rows for the worst case, and learns how many are in use when it runs. Here it takes a piece of
some thousand rows at a time, in a loop that ends after the last row in use.

There are three primitives, as for operations: the value, its pushforward and its pullback. jax cannot pull back through
a loop of a length that it does not know; here derivatives are taken within each piece, for which the value is computed
once more. Second derivatives are those of loops over all rows, whose length jax knows.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from typing import Any, cast

import jax
import jax.numpy as jnp
from jax.core import ShapedArray, Tracer, eval_jaxpr
from jax.extend.core import Jaxpr, Primitive
from jax.interpreters import ad, batching, mlir

from rts_backends.jax_engine.columns import part, summed_by_columns, variables

PIECE = 1 << 11
"""Rows of a piece: enough to be worth XLA's calls, and few enough that intermediate arrays stay in caches, and that XLA
does not wake its other threads for each."""

LEAST = 1 << 15
"""Below this number of rows all are computed: a loop would cost as much as it saves."""

CLOSED = 1 << 16
"""The most numbers that a function may close over: each piece has a gradient of their size."""


def apply(f: Callable[..., jax.Array], used: jax.Array, rows: Sequence[jax.Array]) -> jax.Array | None:
    """The value (N, ·) of a function that treats each row by itself; anything in rows that are not in use.

    Args:
        f: arrays (n, ·) → (n, ·), for any n.
        used: the number of rows in use, () int32.
        rows: arrays (N, ·).

    Returns:
        The value, or None where all rows may as well be computed: they are few, or the function closes over much, does
        not read rows, or has effects, which must happen once.
    """
    if rows[0].shape[0] < max(LEAST, PIECE):
        return None
    traced = jax.make_jaxpr(f)(*(jax.ShapeDtypeStruct((PIECE, *x.shape[1:]), x.dtype) for x in rows))
    if traced.effects:
        return None
    jaxpr, closed = _of_rows_alone(traced.jaxpr, traced.consts)
    if variables(jaxpr.eqns, jaxpr.outvars).keys().isdisjoint(jaxpr.invars[len(closed) :]):
        return None
    if sum(x.size for x in closed if isinstance(x, Tracer)) > CLOSED:
        return None
    return _value.bind(used, used, *closed, *rows, jaxpr=jaxpr, fixed=len(closed))[0]


def _of_rows_alone(jaxpr: Jaxpr, consts: Sequence[Any]) -> tuple[Jaxpr, list[Any]]:
    """Compute the part of a function that does not depend on its arguments.

    Returns the function of the other equations, and the values, computed here, that it takes as its first arguments.
    """
    varying, before, rest = set(jaxpr.invars), [], []
    for equation in jaxpr.eqns:
        # To keep a number spread over the rows of a piece costs no less than to compute it.
        if equation.primitive.name in _SPREADING or not variables([equation]).keys().isdisjoint(varying):
            rest.append(equation)
            varying.update(equation.outvars)
        else:
            before.append(equation)
    read = variables(rest, jaxpr.outvars)
    known = [*jaxpr.constvars, *(x for equation in before for x in equation.outvars)]
    known = [x for x in known if x in read]
    values = eval_jaxpr(part(jaxpr, invars=[], outvars=known, eqns=before), consts)
    return part(jaxpr, constvars=[], invars=[*known, *jaxpr.invars], eqns=rest), values


_SPREADING = {"broadcast_in_dim", "iota"}

# --------------------------------------------------------------------------------------------------- three functions


class _Pieces:
    """A function of rows, computed piece by piece.

    Args:
        jaxpr: the function of a piece: arrays that are the same for all pieces, and arrays (n, ·) → (n, ·).
        operands: arrays that are the same for all pieces, then arrays of all rows (N, ·).
        fixed: the number of operands that are the same for all pieces.
        most: the largest number of rows in use over the items of a batch; None to go through all rows.
        used: the number of rows in use of this item.
    """

    def __init__(self, jaxpr: Jaxpr, operands: Sequence[Any], fixed: int, most: Any, used: Any):
        self._jaxpr, self._most, self._used, self.fixed = jaxpr, most, used, fixed
        self._closed, self._rows = operands[:fixed], operands[fixed:]
        first: Any = jaxpr.invars[fixed].aval
        self._total, self._size = self._rows[0].shape[0], first.shape[0]

    def zeros(self) -> jax.Array:
        """Zeros in the shape of the value of all rows, (N, ·)."""
        out: Any = self._jaxpr.outvars[0].aval
        return jnp.zeros((self._total, *out.shape[1:]), out.dtype)

    def repeat(self, step: Callable[[Any, Any, Any], Any], state: Any) -> Any:
        """Do `state = step(start, first, state)` for each piece, and return the last state.

        A piece has the rows from `start` on. The last piece may overlap the one before: rows before `first` were in
        that.
        """
        size = self._size

        def body(i: Any, state: Any) -> Any:
            return step(jnp.minimum(i * size, self._total - size), i * size, state)

        count = -(-(self._total if self._most is None else self._most) // size)
        if self._most is None or isinstance(count, Tracer):
            return jax.lax.fori_loop(0, count, body, state)
        for i in range(int(count)):  # jax would compile a loop anew whenever it is called.
            state = body(i, state)
        return state

    def cut(self, x: Any, start: Any) -> Any:
        """The rows of `x` (N, ·) in the piece that begins at `start`."""
        return jax.lax.dynamic_slice_in_dim(x, start, self._size)

    def among(self, x: Any, in_use: jax.Array, other: Any) -> Any:
        """`x` with `other` in place of the rows that `in_use` (n,) does not mark."""
        return jnp.where(in_use.reshape(-1, *[1] * (x.ndim - 1)), x, other)

    def index(self, start: Any) -> jax.Array:
        """Indices, among all N rows, of the rows in the piece that begins at `start`."""
        return start + jnp.arange(self._size)

    def varying(self, start: Any, wanted: Sequence[bool]) -> tuple[Callable[..., jax.Array], list[Any]]:
        """The value of a piece as a function of the wanted operands alone; and these operands, rows cut to it.

        The function replaces rows that are not in use by the first row of all, or by ones if none is in use.
        """
        operands = [*self._closed, *(self.cut(x, start) for x in self._rows)]
        in_use = self.index(start) < self._used

        def function(*varied: Any) -> jax.Array:
            it = iter(varied)
            values = [next(it) if wish else x for x, wish in zip(operands, wanted, strict=True)]
            filled = []
            for x, whole in zip(values[self.fixed :], self._rows, strict=True):
                # Unused rows may hold values at which there are no derivatives.
                other = jnp.where(self._used > 0, jax.lax.stop_gradient(whole[:1]), jnp.ones((), x.dtype))
                filled.append(self.among(x, in_use, other))
            return eval_jaxpr(self._jaxpr, [], *values[: self.fixed], *filled)[0]

        return function, [x for x, wish in zip(operands, wanted, strict=True) if wish]


def _computed(most: Any, used: Any, *operands: Any, jaxpr: Jaxpr, fixed: int) -> list[jax.Array]:
    """The value (N, ·), computed piece by piece, see `_Pieces`; rows that are not in use get anything."""
    pieces = _Pieces(jaxpr, operands, fixed, most, used)

    def step(start: Any, first: Any, out: jax.Array) -> jax.Array:
        function, _ = pieces.varying(start, [False] * len(operands))
        return jax.lax.dynamic_update_slice_in_dim(out, summed_by_columns(function)(), start, 0)

    return [pieces.repeat(step, pieces.zeros())]


def _pushed(most: Any, used: Any, *arrays: Any, jaxpr: Jaxpr, fixed: int, wanted: tuple[bool, ...]) -> list[jax.Array]:
    """The value's derivative (N, ·) along tangents of the wanted operands; rows that are not in use get anything.

    `arrays` are operands, then the tangents; see `_Pieces`.
    """
    operands, tangents = arrays[: len(wanted)], arrays[len(wanted) :]
    pieces = _Pieces(jaxpr, operands, fixed, most, used)
    same = sum(wanted[:fixed])

    def step(start: Any, first: Any, out: jax.Array) -> jax.Array:
        function, varied = pieces.varying(start, wanted)
        along = *tangents[:same], *(pieces.cut(t, start) for t in tangents[same:])
        push = summed_by_columns(lambda *along: jax.jvp(function, tuple(varied), along)[1])
        return jax.lax.dynamic_update_slice_in_dim(out, push(*along), start, 0)

    return [pieces.repeat(step, pieces.zeros())]


def _pulled(most: Any, used: Any, *arrays: Any, jaxpr: Jaxpr, fixed: int, wanted: tuple[bool, ...]) -> list[jax.Array]:
    """Gradients of the wanted operands, each in its operand's shape.

    `arrays` are operands, then the value's gradient; see `_Pieces`.
    """
    *operands, g = arrays
    pieces = _Pieces(jaxpr, operands, fixed, most, used)
    same = sum(wanted[:fixed])

    def step(start: Any, first: Any, totals: list[jax.Array]) -> list[jax.Array]:
        function, varied = pieces.varying(start, wanted)
        # The last piece may begin with rows of the one before.
        gradient = pieces.among(pieces.cut(g, start), pieces.index(start) >= first, 0)
        gradients = summed_by_columns(lambda g: jax.vjp(function, *varied)[1](g))(gradient)
        sums = [a + b for a, b in zip(totals[:same], gradients[:same], strict=True)]
        for whole, x in zip(totals[same:], gradients[same:], strict=True):
            sums.append(jax.lax.dynamic_update_slice_in_dim(whole, pieces.cut(whole, start) + x, start, 0))
        return sums

    varied = [x for x, wish in zip(operands, wanted, strict=True) if wish]
    return pieces.repeat(step, [jnp.zeros_like(x) for x in varied])


# --------------------------------------------------------------------------------------------------- as primitives


def _primitive(name: str, function: Callable, results: Callable) -> Primitive:
    """A primitive of one of the functions. Its first operands are `most` and `used`, see `_Pieces`.

    Args:
        name: the end of its name.
        function: computes it.
        results: shapes and dtypes of the operands after these two, and parameters → those of the results.
    """
    primitive = Primitive(f"rts_rows_in_use_{name}")
    primitive.multiple_results = True
    primitive.def_impl(function)
    primitive.def_abstract_eval(lambda most, used, *avals, **params: results(*avals, **params))
    mlir.register_lowering(primitive, mlir.lower_fun(function, multiple_results=True))

    def batched(operands: Sequence, dims: Sequence, **params: Any) -> tuple[list, list[int]]:
        # One loop serves all items, as long as the longest.
        most = operands[0] if dims[0] is None else jnp.max(operands[0])
        results = jax.vmap(functools.partial(function, most, **params), tuple(dims[1:]))(*operands[1:])
        return results, [0] * len(results)

    def along(primals: Sequence, tangents: Sequence, **params: Any) -> tuple[list, list]:
        present = _present(tangents)
        varied, moves = (tuple(x for x, t in zip(xs, present, strict=True) if t) for xs in (primals, tangents))

        def whole(*varied: Any) -> list[jax.Array]:
            it = iter(varied)
            _, *operands = (next(it) if t else x for x, t in zip(primals, present, strict=True))
            return function(None, *operands, **params)

        return primitive.bind(*primals, **params), jax.jvp(whole, varied, moves)[1]

    batching.primitive_batchers[primitive] = batched
    ad.primitive_jvps[primitive] = along
    return primitive


def _present(tangents: Sequence[Any]) -> tuple[bool, ...]:
    """A mark for each tangent: True if it is not zero; integers have none."""
    return tuple(type(t) is not ad.Zero and t.dtype != jax.dtypes.float0 for t in tangents)


def _like_value(*avals: Any, jaxpr: Jaxpr, fixed: int, **_: Any) -> list[ShapedArray]:
    rows, out = avals[fixed], cast(Any, jaxpr.outvars[0].aval)
    return [ShapedArray((rows.shape[0], *out.shape[1:]), out.dtype)]


def _like_operands(*avals: Any, wanted: tuple[bool, ...], **_: Any) -> list[ShapedArray]:
    return [ShapedArray(x.shape, x.dtype) for x, wish in zip(avals, wanted, strict=False) if wish]


_value = _primitive("value", _computed, _like_value)
_push = _primitive("push", _pushed, _like_value)
_pull = _primitive("pull", _pulled, _like_operands)


def _value_jvp(primals: Sequence, tangents: Sequence, **params: Any) -> tuple[list, list]:
    results, wanted = _value.bind(*primals, **params), _present(tangents[2:])
    along = [t for t, wish in zip(tangents[2:], wanted, strict=True) if wish]
    if not along:
        return results, [ad.Zero(ShapedArray(x.shape, x.dtype).to_tangent_aval()) for x in results]
    return results, _push.bind(*primals, *along, wanted=wanted, **params)


def _push_transpose(gradients: Sequence, *operands_and_tangents: Any, wanted: tuple[bool, ...], **params: Any) -> list:
    (g,), operands, tangents = (
        gradients,
        operands_and_tangents[: 2 + len(wanted)],
        operands_and_tangents[2 + len(wanted) :],
    )
    if type(g) is ad.Zero:
        return [None] * len(operands) + [ad.Zero(t.aval) for t in tangents]
    return [None] * len(operands) + _pull.bind(*operands, g, wanted=wanted, **params)


ad.primitive_jvps[_value] = _value_jvp
ad.primitive_transposes[_push] = _push_transpose
