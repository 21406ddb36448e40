"""A function of arrays on the host as a primitive of jax: eager, in compiled programs, and under `vmap`."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import ShapedArray
from jax.extend.core import Primitive
from jax.interpreters import batching, mlir

from rts.plugin_api.threads import parallel
from rts_backends.jax_engine import host

# jax reuses what a cacheable rule gave for an equation alike; such a rule does not see where operands come from.
_SEEING_OPERANDS = {"cacheable": False} if "cacheable" in inspect.signature(mlir.register_lowering).parameters else {}


NUMBER = 10
"""Rough time in which an operation computes a number of its result, nanoseconds."""


class HostPrimitive:
    """The value, pushforward or pullback of an operation as a primitive: for eager arrays, the compiler and `vmap`.

    Args:
        name: the name of the primitive.
        ranks: the number of axes of each of its operands, without the axis B of a batch.
        samples: number of operands before tangents or gradients.
        shapes: gives the shapes of the results, from those of the operands, both without B, and the parameters.
        host: (operands, results, **params), fills the results for one item, in NumPy.
        specified: (*operands, **params) → the results, in array code.
        noted: True if the last result is a note, () int32 (see `operations.py`).
        some: True if the operands after the samples are only those that a parameter `wanted` marks.
            Operands after the samples, tangents or gradients, have an axis T first, which a true parameter `single`
            leaves out.
        in_place: indices of operands whose gradients may take over their memory: then `host` gets an operand and a
            result that share memory. Only for pullbacks, whose results are the gradients (T, ·) that the parameter
            `wanted` marks.
    """

    def __init__(
        self,
        name: str,
        ranks: tuple[int, ...],
        samples: int,
        shapes: Callable,
        on_host: Callable,
        specified: Callable,
        *,
        noted: bool = False,
        some: bool = False,
        in_place: tuple[int, ...] = (),
    ):
        self.name, self.ranks, self.samples, self._noted = name, ranks, samples, noted
        self._shapes, self._host, self._specified = shapes, on_host, specified
        self._some, self._in_place = some, in_place
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
        """The primitive's results, also of tracers."""
        return self.primitive.bind(*operands, **params)

    def specification(self, *operands: jax.Array, **params: Any) -> list[jax.Array]:
        """The results by array code, which is differentiable; of a batch, if operands have the axis B."""
        axes = tuple(0 if b else None for b in self._by_item(operands, params))
        function = functools.partial(self._specified, **params)
        return (function if not any(a == 0 for a in axes) else jax.vmap(function, axes))(*operands)

    def _own_ranks(self, params: dict) -> list[int]:
        """Ranks of the operands of one call: with `some`, tangents that `wanted` does not mark are left out."""
        samples, rest = self.ranks[: self.samples], self.ranks[self.samples :]
        if self._some:
            rest = (r for r, wish in zip(rest, params["wanted"], strict=True) if wish)
        return [*samples, *(r - params["single"] for r in rest)]

    def _by_item(self, operands: Sequence[Any], params: dict) -> list[bool]:
        """A mark for each operand: True if it has the axis B."""
        return [x.ndim > rank for x, rank in zip(operands, self._own_ranks(params), strict=True)]

    def _results(self, operands: Sequence[Any], params: dict) -> list[jax.ShapeDtypeStruct]:
        """Shapes and dtypes of the results, with the axis B if any operand has it."""
        by_item = self._by_item(operands, params)
        lead = next(((x.shape[0],) for x, b in zip(operands, by_item, strict=True) if b), ())
        shapes = (x.shape[1:] if b else x.shape for x, b in zip(operands, by_item, strict=True))
        shapes = [(*lead, *shape) for shape in self._shapes(*shapes, **params)]
        dtypes = [operands[0].dtype] * (len(shapes) - self._noted) + [np.int32] * self._noted
        return list(map(jax.ShapeDtypeStruct, shapes, dtypes))

    def _on_host(self, operands: Sequence[np.ndarray], results: Sequence[np.ndarray], params: dict) -> None:
        """Fill the results in place; if operands have the axis B, items share all cores, and all results have it."""
        by_item = self._by_item(operands, params)
        if not any(by_item):
            self._host(operands, results, **params)
            return

        def items(start: int, stop: int) -> None:
            for b in range(start, stop):
                item = [x[b] if by else x for x, by in zip(operands, by_item, strict=True)]
                self._host(item, [x[b, ...] for x in results], **params)

        numbers = sum(x.size for x in (*operands, *results))
        parallel(items, len(results[0]), work=NUMBER * numbers, off_caller_core=False)

    def _lowered(self, ctx: Any, *operands: Any, **params: Any) -> Any:
        """The host call in a program for the CPU."""
        shapes = tuple(jax.ShapeDtypeStruct(aval.shape, aval.dtype) for aval in ctx.avals_out)
        places = {}
        for i in self._in_place:
            at = sum(params["wanted"][:i])
            if params["wanted"][i] and shapes[at].shape == (1, *ctx.avals_in[i].shape) and _read_once(operands[i]):
                places[i] = at
        alike = set(places.values())
        result_shapes = [jax.ShapeDtypeStruct(x.shape[1:], x.dtype) if i in alike else x for i, x in enumerate(shapes)]

        def call(*arrays: jax.Array) -> list[jax.Array]:
            results = host.filled(filler, result_shapes, *arrays, in_place=places)
            return [x[None] if i in alike else x for i, x in enumerate(results)]

        def filler(operands: Sequence[np.ndarray], results: Sequence[np.ndarray]) -> None:
            self._on_host(operands, [x[None] if i in alike else x for i, x in enumerate(results)], params)

        return mlir.lower_fun(call, multiple_results=True)(ctx, *operands)

    def _eager(self, *operands: Any, **params: Any) -> list[jax.Array]:
        device = _cpu_of(operands)
        if device is None:
            return _compiled(self.primitive, tuple(params.items()))(*operands)
        results = [np.empty(result.shape, result.dtype) for result in self._results(operands, params)]
        self._on_host([np.asarray(x) for x in operands], results, params)
        if any(x.committed for x in operands if isinstance(x, jax.Array)):
            return jax.device_put(results, device)
        with jax.default_device(device):
            return jax.device_put(results)

    def _batched(self, operands: Sequence[Any], dims: Sequence, **params: Any) -> tuple[list[jax.Array], list[int]]:
        mapped = [d is not None for d in dims]
        operands = [jnp.moveaxis(x, d, 0) if m else x for x, d, m in zip(operands, dims, mapped, strict=True)]
        size = next(x.shape[0] for x, m in zip(operands, mapped, strict=True) if m)
        ranks = self._own_ranks(params)
        if any(mapped[: self.samples]):
            return self._over_samples(operands, mapped, size, ranks, params)
        # The batch is more tangents or gradients of the same samples: one sweep for all.
        folded, by_item, single = [], False, params.get("single", False)
        for x, m, rank in zip(operands, mapped, ranks, strict=True):
            by_item |= x.ndim - m > rank
            if len(folded) >= self.samples:
                x = x if m else jnp.broadcast_to(x, (size, *x.shape))
                at = x.ndim - 1 - rank
                x = jnp.moveaxis(x, 0, at)
                if not single:
                    x = x.reshape(*x.shape[:at], size * x.shape[at + 1], *x.shape[at + 2 :])
            folded.append(x)
        if single:
            results = self(*folded, **{**params, "single": False})
            return results, [int(by_item)] * len(results)
        results, at = self(*folded, **params), int(by_item)
        return [x.reshape(*x.shape[:at], size, -1, *x.shape[at + 1 :]) for x in results], [at] * len(results)

    def _over_samples(
        self, operands: list, mapped: list[bool], size: int, ranks: Sequence[int], params: dict
    ) -> tuple[list, list[int]]:
        """Compute a batch whose items differ in samples, item by item; operands may have an axis B already."""
        inner = [x.shape[m] for x, m, r in zip(operands, mapped, ranks, strict=True) if x.ndim - m > r]
        if not inner:
            results = self(*operands, **params)
            return results, [0] * len(results)
        lead = size, inner[0]
        for i, (x, m, rank) in enumerate(zip(operands, mapped, ranks, strict=True)):
            if m or x.ndim > rank:
                item_shape = x.shape[x.ndim - rank :]
                x = x[:, None] if m and x.ndim == rank + 1 else x
                operands[i] = jnp.broadcast_to(x, (*lead, *item_shape)).reshape(size * inner[0], *item_shape)
        results = self(*operands, **params)
        return [x.reshape(*lead, *x.shape[1:]) for x in results], [0] * len(results)


def _read_once(value: Any) -> bool:
    """True for an array whose memory a result may take over.

    The program about to be compiled computes it, and exactly one operation reads it so far. False for constants, and
    for arguments of the program.
    """
    name = getattr(value.owner, "name", "stablehlo.constant")  # An argument's owner has no name.
    return name != "stablehlo.constant" and sum(1 for _ in value.uses) == 1


def _cpu_of(operands: Sequence[jax.Array]) -> Any:
    """The device of the jax arrays among `operands` if it is one CPU, else None."""
    devices = set().union(*(x.devices() for x in operands if isinstance(x, jax.Array)))
    return next(iter(devices)) if len(devices) == 1 and all(d.platform == "cpu" for d in devices) else None


@functools.cache
def _compiled(primitive: Primitive, params: tuple) -> Callable:
    return jax.jit(functools.partial(primitive.bind, **dict(params)))
