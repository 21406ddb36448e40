"""Sums along short axes, such as over the components of vectors, as sums of columns.

XLA's loops over an axis of two to four numbers take ten times as long on CPUs as adding the columns does, which becomes
vector code. Array code asks for such sums in scalar products; and derivatives do, wherever a number (n, 1) is applied
to vectors (n, 3).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import jax
from jax.core import eval_jaxpr
from jax.extend.core import Jaxpr, JaxprEqn, Literal

SHORT = 4
"""The longest axis that is summed by columns."""


def summed_by_columns(f: Callable[..., Any]) -> Callable[..., Any]:
    """`f`, a function from arrays to a tree of arrays, with its short sums (`_is_short`) computed by columns.

    Sums inside of loops and other control flow stay as they are.
    """

    def call(*arrays: Any) -> Any:
        traced, shapes = jax.make_jaxpr(f, return_shape=True)(*arrays)
        results = _evaluated(traced.jaxpr, traced.consts, arrays)
        return jax.tree.unflatten(jax.tree.structure(shapes), results)

    return call


def _evaluated(jaxpr: Jaxpr, consts: Sequence[Any], arguments: Sequence[Any]) -> list[Any]:
    """The results of a program: jax evaluates all equations but the short sums, which are computed by columns."""
    known = dict(zip([*jaxpr.constvars, *jaxpr.invars], [*consts, *arguments], strict=True))
    rest = list(jaxpr.eqns)
    while rest:
        count = next((i for i, equation in enumerate(rest) if _is_call(equation) or _is_short(equation)), len(rest))
        run, rest = rest[:count], rest[count:]
        outputs = {x for equation in run for x in equation.outvars}
        needed, inputs = [x for x in variables(rest, jaxpr.outvars) if x in outputs], [*known]
        kept = part(jaxpr, constvars=[], invars=inputs, outvars=needed, eqns=run)
        known.update(zip(needed, eval_jaxpr(kept, [], *known.values()), strict=True))
        if rest:
            equation, *rest = rest
            values = [x.val if isinstance(x, Literal) else known[x] for x in equation.invars]
            if _is_call(equation):
                inner = equation.params["jaxpr"]
                results = _evaluated(inner.jaxpr, inner.consts, values)
            else:
                results = [sum(values[0][..., i] for i in range(values[0].shape[-1]))]
            known.update(zip(equation.outvars, results, strict=True))
    return [x.val if isinstance(x, Literal) else known[x] for x in jaxpr.outvars]


def part(jaxpr: Jaxpr, **fields: Any) -> Jaxpr:
    """A program with other variables and equations; jax 0.6 and later check arguments against names, unless unknown."""
    names: Any = jaxpr.debug_info
    unnamed = getattr(names, "with_unknown_names", lambda: names)
    return jaxpr.replace(debug_info=unnamed(), **fields)


def variables(equations: Sequence[JaxprEqn], more: Sequence[Any] = ()) -> dict[Any, None]:
    """The variables that equations read, and the variables among `more`, in this order."""
    read = [*(x for equation in equations for x in equation.invars), *more]
    return dict.fromkeys(x for x in read if not isinstance(x, Literal))


def _is_call(equation: JaxprEqn) -> bool:
    """True if an equation calls a function under a `jit` inside the program."""
    return equation.primitive.name in ("jit", "pjit")


def _is_short(equation: JaxprEqn) -> bool:
    """True for a sum over at most `SHORT` numbers along the last axis alone, where the first axis is longer."""
    if equation.primitive.name != "reduce_sum":
        return False
    aval: Any = equation.invars[0].aval
    shape = aval.shape
    return equation.params["axes"] == (len(shape) - 1,) and len(shape) > 1 and 0 < shape[-1] <= SHORT < shape[0]
