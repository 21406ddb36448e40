"""Functions of packed samples as jax primitives: eager, `jit`, `grad`, `jvp`, `vmap` and what is made of them.

Three primitives a function: its value, its pushforward and its pullback. Each of the last two is linear in the
tangents or the gradients, and the transpose of the other; their derivatives by the operands, which are second
derivatives of the function, are taken of its specification. So is everything on devices other than the CPU.

Tangents and gradients have a leading axis T, of as many as one sweep takes. Before that, `vmap` gives those operands
that differ by item an axis B.
"""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import ShapedArray
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir
from jaxlib.mlir.dialects import stablehlo as hlo

from rts_backends import jax_host

Wanted = tuple[bool, bool]
"""Whether the first, and whether the second operand has a tangent or wants a gradient."""

# Rules whose results are kept for the next equation alike do not see what operands come from.
_SEEING_OPERANDS = {"cacheable": False} if "cacheable" in inspect.signature(mlir.register_lowering).parameters else {}

Arrays = Sequence[np.ndarray]
Some = Sequence[np.ndarray | None]


class Kernels(NamedTuple):
    """A function on the host. Results are arrays to be filled, each whole; parameters are handed on as keywords.

    Attributes:
        value: (operands, result), and where there is a note, that as a third.
        push: (operands, tangents of the first two with axis T or None for zeros, result with axis T).
        pull: (operands, gradients with axis T, gradients of the first two with axis T or None where not wanted).
    """

    value: Callable[..., None]
    push: Callable[..., None]
    pull: Callable[..., None]


class Differentiable:
    """A function of arrays, in the first two of which it is differentiable; all floats of one dtype.

    Args:
        name: of the primitives.
        ranks: of the operands; the result has that of a gradient of either less the axis T.
        shape: of the result, from the shapes of the operands and the parameters.
        kernels: by which it is computed on the host.
        specification: the function in jax, of operands and parameters.
        even: operands whose rows are often all alike; where a program says so, kernels are given one row of them.
        noted: whether `value` also leaves a note () int32, which `push` and `pull` of the same operands are given as
            the last of these: it may tell them what has been worked out already.
    """

    def __init__(
        self,
        name: str,
        ranks: tuple[int, ...],
        shape: Callable[..., tuple],
        kernels: Kernels,
        specification: Callable,
        even: tuple[int, ...] = (),
        noted: bool = False,
    ):
        self.kernels, self._specification, self.rank = kernels, specification, len(shape(*((1,) * r for r in ranks)))
        self._inputs, self.count = len(ranks), len(ranks) + noted
        inputs, count = self._inputs, self.count

        def pulled(*shapes: tuple, wanted: Wanted, **_: Any) -> list[tuple]:
            return [(shapes[count][0], *x) for x, wish in zip(shapes[:2], wanted, strict=True) if wish]

        def pushed(*shapes: tuple, wanted: Wanted, **params: Any) -> list[tuple]:
            return [(shapes[count][0], *shape(*shapes[:inputs], **params))]

        def valued(*shapes: tuple, **params: Any) -> list[tuple]:
            return [shape(*shapes, **params), *[()] * noted]

        self._value = _Operation(name, ranks, inputs, valued, self._host_value, self._plain, even, noted)
        ranks = *ranks, *[0] * noted
        swept, given = (*ranks, *(r + 1 for r in ranks[:2])), (*ranks, self.rank + 1)
        self._push = _Operation(f"{name}_push", swept, count, pushed, self._host_push, self._specified_push, even)
        self._pull = _Operation(f"{name}_pull", given, count, pulled, self._host_pull, self._specified_pull, even)
        ad.primitive_jvps[self._value.primitive] = self._value_jvp
        ad.primitive_jvps[self._push.primitive] = self._push_jvp
        ad.primitive_jvps[self._pull.primitive] = self._pull_jvp
        ad.primitive_transposes[self._push.primitive] = self._push_transpose
        ad.primitive_transposes[self._pull.primitive] = self._pull_transpose

    def __call__(self, *operands: jax.Array, **params: Any) -> jax.Array:
        """The result."""
        return self._value(*operands, **params)[0]

    # ------------------------------------------------------------------------------------------ by compiled kernels

    def _host_value(self, operands: Arrays, results: Arrays, **params: Any) -> None:
        self.kernels.value(operands, *results, **params)

    def _host_push(self, operands: Arrays, results: Arrays, wanted: Wanted, **params: Any) -> None:
        self.kernels.push(operands[: self.count], _spread(operands[self.count :], wanted), results[0], **params)

    def _host_pull(self, operands: Arrays, results: Arrays, wanted: Wanted, **params: Any) -> None:
        self.kernels.pull(operands[: self.count], operands[-1], _spread(results, wanted), **params)

    # --------------------------------------------------------------------------------------------- by specification

    def _plain(self, *operands: jax.Array, **params: Any) -> list[jax.Array]:
        note = [jnp.zeros((), np.int32)] * (self.count - self._inputs)
        return [self._specification(*operands, **params), *note]

    def _specified_push(self, *operands: jax.Array, wanted: Wanted, **params: Any) -> list[jax.Array]:
        function, given = self._among(wanted, operands[: self.count], params)
        return [jax.vmap(jax.linearize(function, *given)[1])(*operands[self.count :])]

    def _specified_pull(self, *operands: jax.Array, wanted: Wanted, **params: Any) -> list[jax.Array]:
        function, given = self._among(wanted, operands[: self.count], params)
        return list(jax.vmap(jax.vjp(function, *given)[1])(operands[-1]))

    def _among(self, wanted: Wanted, operands: Sequence, params: dict) -> tuple[Callable, list[jax.Array]]:
        """The specification as a function of the wanted operands, and these."""

        def function(*given: jax.Array) -> jax.Array:
            both = (x if g is None else g for x, g in zip(operands[:2], _spread(given, wanted), strict=True))
            return self._specification(*both, *operands[2 : self._inputs], **params)

        return function, [x for x, wish in zip(operands[:2], wanted, strict=True) if wish]

    # -------------------------------------------------------------------------------------------------- derivatives

    def _value_jvp(self, primals: Sequence, tangents: Sequence, **params: Any) -> tuple[list, list]:
        found = self._value(*primals, **params)
        given, wanted = _present(tangents[:2])
        if not given:
            return found, _zeros(found)
        at = 1 if found[0].ndim > self.rank else 0
        # Of operands by item, tangents have B before T; of the others T alone.
        ranks = (r for r, wish in zip(self._value.ranks, wanted, strict=False) if wish)
        swept = [jnp.expand_dims(t, t.ndim - rank) for t, rank in zip(given, ranks, strict=True)]
        (pushed,) = self._push(*primals, *found[1:], *swept, wanted=wanted, **params)
        return found, [jax.lax.squeeze(pushed, (at,)), *_zeros(found[1:])]

    def _push_jvp(self, primals: Sequence, tangents: Sequence, *, wanted: Wanted, **params: Any) -> tuple[list, list]:
        found = self._push(*primals, wanted=wanted, **params)
        along = self._along_operands(self._push, primals, tangents, {**params, "wanted": wanted})
        given, moved = _present(tangents[self.count :], wanted)
        if given:
            linear = self._push(*primals[: self.count], *given, wanted=moved, **params)
            along = linear if along is None else [a + b for a, b in zip(along, linear, strict=True)]
        return found, _zeros(found) if along is None else along

    def _pull_jvp(self, primals: Sequence, tangents: Sequence, **params: Any) -> tuple[list, list]:
        found = self._pull(*primals, **params)
        along = self._along_operands(self._pull, primals, tangents, params)
        if not _is_zero(tangents[self.count]):
            linear = self._pull(*primals[: self.count], tangents[self.count], **params)
            along = linear if along is None else [a + b for a, b in zip(along, linear, strict=True)]
        return found, _zeros(found) if along is None else along

    @staticmethod
    def _along_operands(operation: _Operation, primals: Sequence, tangents: Sequence, params: dict) -> list | None:
        """Derivatives of an operation's results along tangents of the first two operands, by specification; or None."""
        _, moved = _present(tangents[:2])
        if not any(moved):
            return None
        fixed = [x for x, m in zip(primals[:2], moved, strict=True) if not m]

        def function(*given: jax.Array) -> list[jax.Array]:
            it, rest = iter(given), iter(fixed)
            both = [next(it) if m else next(rest) for m in moved]
            return _whole(operation, tuple(params.items()))(*both, *primals[2:])

        varied = [x for x, m in zip(primals[:2], moved, strict=True) if m]
        along = [t for t, m in zip(tangents[:2], moved, strict=True) if m]
        return jax.jvp(function, tuple(varied), tuple(along))[1]

    def _push_transpose(self, gradients: Sequence, *operands: Any, wanted: Wanted, **params: Any) -> list:
        (g,), samples, tangents = gradients, operands[: self.count], operands[self.count :]
        if _is_zero(g):
            return [None] * self.count + [ad.Zero(t.aval) for t in tangents]
        found = self._pull(*samples, g, wanted=wanted, **params)
        return [None] * self.count + [_summed(x, t.aval.ndim) for x, t in zip(found, tangents, strict=True)]

    def _pull_transpose(self, tangents: Sequence, *operands: Any, wanted: Wanted, **params: Any) -> list:
        *samples, g = operands
        given, moved = _present(tangents, wanted)
        if not given:
            return [None] * self.count + [ad.Zero(g.aval)]
        (found,) = self._push(*samples, *given, wanted=moved, **params)
        return [None] * self.count + [_summed(found, g.aval.ndim)]


class _Operation:
    """One of the three as a primitive: what it is to eager arrays, to the compiler and to `vmap`.

    Args:
        name: of the primitive.
        ranks: of its operands without the axis B.
        samples: number of operands before tangents or gradients.
        shapes: of the results without it, from the shapes of the operands without it and the parameters.
        host: fills the results for one item.
        specified: the same by specification.
        even: see `Differentiable`.
        noted: whether the last result is a note.
    """

    def __init__(
        self,
        name: str,
        ranks: tuple[int, ...],
        samples: int,
        shapes: Callable,
        host: Callable,
        specified: Callable,
        even: tuple[int, ...],
        noted: bool = False,
    ):
        self.name, self.ranks, self.samples, self._even, self._noted = name, ranks, samples, even, noted
        self._shapes, self._host, self._specified = shapes, host, specified
        self.primitive = primitive = Primitive(f"rts_{name}")
        primitive.multiple_results = True
        primitive.def_impl(self._eager)
        primitive.def_abstract_eval(
            lambda *avals, **params: [ShapedArray(r.shape, r.dtype) for r in self._results(avals, params)]
        )
        mlir.register_lowering(primitive, mlir.lower_fun(self.specification, multiple_results=True))
        mlir.register_lowering(primitive, self._lowered, platform="cpu", **_SEEING_OPERANDS)
        batching.primitive_batchers[primitive] = self._batched

    def __call__(self, *operands: jax.Array, **params: Any) -> list[jax.Array]:
        """The results."""
        return self.primitive.bind(*operands, **params)

    def specification(self, *operands: jax.Array, **params: Any) -> list[jax.Array]:
        """The results by specification, which is differentiable."""
        axes = tuple(0 if b else None for b in self._by_item(operands, params))
        function = functools.partial(self._specified, **params)
        return (function if not any(a == 0 for a in axes) else jax.vmap(function, axes))(*operands)

    def _own_ranks(self, params: dict) -> list[int]:
        """Ranks of those operands that there are: tangents may be of one alone."""
        samples, rest = self.ranks[: self.samples], self.ranks[self.samples :]
        if len(rest) == 2:
            rest = (r for r, wish in zip(rest, params["wanted"], strict=True) if wish)
        return [*samples, *rest]

    def _by_item(self, operands: Sequence[Any], params: dict) -> list[bool]:
        """Which operands have the axis B."""
        return [x.ndim > rank for x, rank in zip(operands, self._own_ranks(params), strict=True)]

    def _results(self, operands: Sequence[Any], params: dict) -> list[jax.ShapeDtypeStruct]:
        """Shapes and dtypes of the results."""
        by_item = self._by_item(operands, params)
        lead = next(((x.shape[0],) for x, b in zip(operands, by_item, strict=True) if b), ())
        shapes = (x.shape[1:] if b else x.shape for x, b in zip(operands, by_item, strict=True))
        shapes = [(*lead, *shape) for shape in self._shapes(*shapes, **params)]
        dtypes = [operands[0].dtype] * (len(shapes) - self._noted) + [np.int32] * self._noted
        return list(map(jax.ShapeDtypeStruct, shapes, dtypes))

    def _on_host(self, operands: Arrays, results: Arrays, params: dict) -> None:
        """Fill the results."""
        by_item = self._by_item(operands, params)
        if not any(by_item):
            self._host(operands, results, **params)
            return
        for b in range(len(results[0])):
            item = [x[b] if by else x for x, by in zip(operands, by_item, strict=True)]
            self._host(item, [x[b, ...] for x in results], **params)

    def _lowered(self, ctx: Any, *operands: Any, **params: Any) -> Any:
        """In a program for the CPU."""
        shapes = tuple(jax.ShapeDtypeStruct(aval.shape, aval.dtype) for aval in ctx.avals_out)
        operands, avals = list(operands), list(ctx.avals_in)
        for i in self._even:
            row = _only_row(operands[i]) if avals[i].ndim == self.ranks[i] and avals[i].shape[0] else None
            if row is not None:
                operands[i], avals[i] = row, avals[i].update(shape=(1, *avals[i].shape[1:]))

        def call(*given: jax.Array) -> list[jax.Array]:
            name = f"{self.name} {sorted(params.items())}"
            return jax_host.call_named(name, lambda i, o: self._on_host(i, o, params), shapes, *given)

        return mlir.lower_fun(call, multiple_results=True)(ctx.replace(avals_in=avals), *operands)

    def _eager(self, *operands: Any, **params: Any) -> list[jax.Array]:
        device = _cpu_of(operands)
        if device is None:
            return _compiled(self.primitive, tuple(params.items()))(*operands)
        found = [np.empty(result.shape, result.dtype) for result in self._results(operands, params)]
        self._on_host([np.asarray(x) for x in operands], found, params)
        if any(x.committed for x in operands if isinstance(x, jax.Array)):
            return jax.device_put(found, device)
        with jax.default_device(device):
            return jax.device_put(found)

    def _batched(self, operands: Sequence[Any], dims: Sequence, **params: Any) -> tuple[list[jax.Array], list[int]]:
        mapped = [d is not None for d in dims]
        operands = [jnp.moveaxis(x, d, 0) if m else x for x, d, m in zip(operands, dims, mapped, strict=True)]
        size = next(x.shape[0] for x, m in zip(operands, mapped, strict=True) if m)
        ranks = self._own_ranks(params)
        if any(mapped[: self.samples]):
            return self._over_samples(operands, mapped, size, ranks, params)
        # The batch is more tangents or gradients of the same samples: one sweep for all.
        folded, by_item = [], False
        for x, m, rank in zip(operands, mapped, ranks, strict=True):
            by_item |= x.ndim - m > rank
            if len(folded) >= self.samples:
                x = x if m else jnp.broadcast_to(x, (size, *x.shape))
                at = x.ndim - 1 - rank
                x = jnp.moveaxis(x, 0, at)
                x = x.reshape(*x.shape[:at], size * x.shape[at + 1], *x.shape[at + 2 :])
            folded.append(x)
        found, at = self(*folded, **params), int(by_item)
        return [x.reshape(*x.shape[:at], size, -1, *x.shape[at + 1 :]) for x in found], [at] * len(found)

    def _over_samples(
        self, operands: list, mapped: list[bool], size: int, ranks: Sequence[int], params: dict
    ) -> tuple[list, list[int]]:
        """Each item with samples of its own."""
        inner = [x.shape[m] for x, m, r in zip(operands, mapped, ranks, strict=True) if x.ndim - m > r]
        if not inner:
            found = self(*operands, **params)
            return found, [0] * len(found)
        lead = size, inner[0]
        for i, (x, m, rank) in enumerate(zip(operands, mapped, ranks, strict=True)):
            if m or x.ndim > rank:
                own = x.shape[x.ndim - rank :]
                x = x[:, None] if m and x.ndim == rank + 1 else x
                operands[i] = jnp.broadcast_to(x, (*lead, *own)).reshape(size * inner[0], *own)
        found = self(*operands, **params)
        return [x.reshape(*lead, *x.shape[1:]) for x in found], [0] * len(found)


def _only_row(value: Any) -> Any:
    """The first row of an array in a program that is about to be compiled, if it plainly equals all others, or None."""
    ir, operation = mlir.ir, value.owner
    name = getattr(operation, "name", "")  # Of the owner of an argument there is none.
    kind = ir.RankedTensorType(value.type)
    shape = ir.RankedTensorType.get([1, *kind.shape[1:]], kind.element_type)
    if name == "stablehlo.broadcast_in_dim":
        operand, dims = operation.operands[0], [int(d) for d in operation.attributes["broadcast_dimensions"]]
        if 0 in dims and ir.RankedTensorType(operand.type).shape[dims.index(0)] != 1:
            return None
        return hlo.broadcast_in_dim(shape, operand, mlir.dense_int_array(dims))
    if name == "stablehlo.concatenate" and ir.IntegerAttr(operation.attributes["dimension"]).value > 0:
        rows = [_only_row(operand) for operand in operation.operands]
        if all(row is not None for row in rows):
            return hlo.concatenate(rows, operation.attributes["dimension"])
    return None


def _cpu_of(operands: Sequence[jax.Array]) -> Any:
    """The device of the arrays if it is one CPU, else None."""
    devices = set().union(*(x.devices() for x in operands if isinstance(x, jax.Array)))
    return next(iter(devices)) if len(devices) == 1 and all(d.platform == "cpu" for d in devices) else None


@functools.cache
def _compiled(primitive: Primitive, params: tuple) -> Callable:
    return jax.jit(functools.partial(primitive.bind, **dict(params)))


@functools.cache
def _whole(operation: _Operation, params: tuple) -> Callable:
    """The specification of an operation, compiled as a whole: operation by operation, each would be compiled alone."""
    return jax.jit(functools.partial(operation.specification, **dict(params)))


def _spread(given: Sequence, wanted: Wanted) -> list:
    """Those given, in the places that are wanted, and None in the others."""
    it = iter(given)
    return [next(it) if wish else None for wish in wanted]


def _is_zero(x: Any) -> bool:
    return type(x) is ad.Zero


def _zeros(like: Sequence[jax.Array]) -> list:
    return [ad.Zero(ShapedArray(x.shape, x.dtype).to_tangent_aval()) for x in like]


def _present(tangents: Sequence, wanted: Wanted = (True, True)) -> tuple[list, Wanted]:
    """Tangents that are not zeros, and of what they are."""
    places = _spread(tangents, wanted)
    given = tuple(t is not None and not _is_zero(t) for t in places)
    return [t for t, g in zip(places, given, strict=True) if g], (given[0], given[1])


def _summed(x: jax.Array, rank: int) -> jax.Array:
    """The sum over items, for what they share."""
    return x.sum(0) if x.ndim > rank else x
