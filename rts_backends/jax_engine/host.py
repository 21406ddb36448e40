"""Host functions inside compiled jax programs, on the CPU without copies of operands and results.

`jax.pure_callback` makes jax arrays of the operands first. That takes a copy of each, and never ends where all of XLA's
threads are already busy with host functions. So it serves only devices other than CPUs, whose memory the host cannot
read.

Shapes in a program are those of the worst case. Unused rows of an array are zero.
"""

from __future__ import annotations

import ctypes
import functools
import mmap
import sys
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import ShapedArray
from jax.extend.core import Primitive
from jax.interpreters import batching, mlir, partial_eval

try:
    from jax.experimental.buffer_callback import buffer_callback
except ImportError:  # jax before 0.6.1.
    buffer_callback = None


HostFunction = Callable[..., Sequence[Any]]
"""A function of NumPy arrays that gives NumPy arrays; or of those of several items."""


class Function(NamedTuple):
    """A function of the host.

    Attributes:
        one: from NumPy arrays, which are read-only and lent for the length of the call, to NumPy arrays.
        many: the same for several items at once, from the operands of each to the results of each; None for none.
    """

    one: HostFunction
    many: HostFunction | None = None

    def of_batch(self, mapped: Sequence[bool]) -> Function:
        """The function of a batch: operands that are `mapped` have an axis of items first, and so have all results.

        A result is the list of its items, which may differ in length.
        """
        many = self.many
        assert many is not None

        def items(operands: Sequence[np.ndarray]) -> list[list[np.ndarray]]:
            count = next(len(x) for x, m in zip(operands, mapped, strict=True) if m)
            return [[x[b, ...] if m else x for x, m in zip(operands, mapped, strict=True)] for b in range(count)]

        def of_batches(batches: Sequence[Sequence[np.ndarray]]) -> list[list[Any]]:
            of_each = [items(operands) for operands in batches]
            results = iter(many([item for of_batch in of_each for item in of_batch]))
            return [list(map(list, zip(*(next(results) for _ in of_batch), strict=True))) for of_batch in of_each]

        return Function(lambda *operands: of_batches([operands])[0], of_batches)


Filler = Callable[[Sequence[np.ndarray], Sequence[np.ndarray]], None]
"""Function of operands, which are read-only, and of results, which it fills; both are lent for the call."""

Shapes = Sequence[jax.ShapeDtypeStruct]


def filled(
    function: Filler, shapes: Shapes, *operands: jax.Array, in_place: dict[int, int] | None = None
) -> list[jax.Array]:
    """The results of a host function in a traced program for the CPU. The program keeps the function alive.

    Args:
        function: fills the results.
        shapes: shapes and dtypes of the results.
        operands: the function's operands.
        in_place: index of an operand → index of the result, alike in shape and dtype, that takes over its memory. XLA
            first copies operands that something else reads later.
    """

    def fill(_: Any, results: Sequence[Any], *operands: Any) -> None:
        read = [np.asarray(x) for x in operands]
        for x in read:
            x.flags.writeable = False
        function(read, [np.asarray(x) for x in results])

    if buffer_callback is None:
        return _filled.bind(*operands, function=function, shapes=tuple(shapes))
    return list(buffer_callback(fill, list(shapes), input_output_aliases=in_place)(*operands))


_filled = Primitive("rts_host_filled")
_filled.multiple_results = True


@_filled.def_abstract_eval
def _filled_results(*operands: Any, function: Filler, shapes: Shapes) -> list[ShapedArray]:
    return [ShapedArray(shape.shape, shape.dtype) for shape in shapes]


def _emitted(ctx: Any, *operands: Any, function: Filler, shapes: Shapes) -> Sequence[Any]:
    """The call in a program of a jax without `buffer_callback`, which copies the results."""

    def results(*operands: Any) -> list[np.ndarray]:
        made = [np.empty(shape.shape, shape.dtype) for shape in shapes]
        function(list(map(np.asarray, operands)), made)
        return made

    emit = mlir.emit_python_callback
    return emit(ctx, results, None, operands, ctx.avals_in, ctx.avals_out, has_side_effect=False)[0]


def call(function: HostFunction, shapes: Shapes, *operands: Any, many: HostFunction | None = None) -> list[jax.Array]:
    """The results of a host function in any traced program, which keeps the function alive.

    Results that the program does not use are not copied. A result that is shorter along an axis than its shape says is
    padded with zeros; a longer one raises a ValueError. Under `vmap` the function is called for each item, or `many`
    once for all, if it is given.
    """
    return _call.bind(
        *operands, function=Function(function, many), shapes=tuple(shapes), used=tuple(range(len(shapes)))
    )


_call = Primitive("rts_host_call")
_call.multiple_results = True


@_call.def_impl
def _run(*operands: Any, **params: Any) -> list[jax.Array]:
    return jax.jit(functools.partial(_call.bind, **params))(*operands)


@_call.def_abstract_eval
def _results(*operands: Any, function: Function, shapes: Shapes, used: Sequence[int]) -> list[ShapedArray]:
    return [ShapedArray(shapes[i].shape, shapes[i].dtype) for i in used]


def _batched(operands: Sequence, dims: Sequence, **params: Any) -> tuple[list, list[int]]:
    mapped = [jnp.moveaxis(x, d, 0) for x, d in zip(operands, dims, strict=True) if d is not None]
    if params["function"].many is not None:
        moved = iter(mapped)
        whole = [x if d is None else next(moved) for x, d in zip(operands, dims, strict=True)]
        params["function"] = params["function"].of_batch([d is not None for d in dims])
        params["shapes"] = tuple(
            jax.ShapeDtypeStruct((mapped[0].shape[0], *s.shape), s.dtype) for s in params["shapes"]
        )
        results = _call.bind(*whole, **params)
        return results, [0] * len(results)

    def item(mapped_items: list) -> list[jax.Array]:
        it = iter(mapped_items)
        return _call.bind(*(x if d is None else next(it) for x, d in zip(operands, dims, strict=True)), **params)

    results = jax.lax.map(item, mapped)
    return results, [0] * len(results)


def _without_unused(wanted: Sequence[bool], *rest: Any) -> tuple[list[bool], Any]:
    """Marks of the operands that the call reads, and the call with only the wanted results, or None if none is wanted.

    A rule for jax's removal of dead code. The equation is the last argument; jax 0.12 gives another before it.
    """
    equation = rest[-1]
    if not any(wanted):
        return [False] * len(equation.invars), None
    used = tuple(i for i, wish in zip(equation.params["used"], wanted, strict=True) if wish)
    outvars = [v for v, wish in zip(equation.outvars, wanted, strict=True) if wish]
    return [True] * len(equation.invars), equation.replace(outvars=outvars, params={**equation.params, "used": used})


def _in_place(*operands: Any, function: Function, shapes: Shapes, used: Sequence[int]) -> list[jax.Array]:
    def fill(operands: Sequence[np.ndarray], results: Sequence[np.ndarray]) -> None:
        arrays = function.one(*operands)
        for i, result in zip(used, results, strict=True):
            _write(result, arrays[i])

    return filled(fill, [shapes[i] for i in used], *operands)


def _copying(*operands: Any, function: Function, shapes: Shapes, used: Sequence[int]) -> list[jax.Array]:
    wanted = [shapes[i] for i in used]

    def whole(*operands: Any) -> list[np.ndarray]:
        arrays, results = (
            function.one(*map(np.asarray, operands)),
            [np.empty(shape.shape, shape.dtype) for shape in wanted],
        )
        for i, result in zip(used, results, strict=True):
            _write(result, arrays[i])
        return results

    return list(jax.pure_callback(whole, wanted, *operands))


def _write(out: np.ndarray, value: Any) -> None:
    """Copy `value` to `out`, with zeros where it is shorter; a ValueError if it is longer, or has other axes.

    A list has a value for each entry of `out`.
    """
    if isinstance(value, list):
        for place, item in zip(range(len(out)), value, strict=True):
            _write(out[place, ...], item)
        return
    value = np.asarray(value)
    if value.shape != out.shape:
        if value.ndim != out.ndim or any(n > size for n, size in zip(value.shape, out.shape, strict=True)):
            raise ValueError(f"a host function returned an array of shape {value.shape}, where {out.shape} was said")
        for axis, n in enumerate(value.shape):
            clear(out[(*map(slice, value.shape[:axis]), slice(n, None))])
    out[tuple(map(slice, value.shape))] = value


def clear(out: np.ndarray) -> None:
    """Fill `out` with zeros.

    On Linux, pages of a large array are handed back: the system gives empty ones at the next touch. Tangents in a
    program are mostly rows that nobody reads: to write them makes a step of Levenberg–Marquardt up to half as long
    again.
    """
    if out.nbytes < _LEAST or not out.flags.c_contiguous or _advise is None:
        out[...] = 0
        return
    data = out.reshape(-1).view(np.uint8)
    start = -data.ctypes.data % mmap.PAGESIZE
    stop = start + (len(data) - start) // mmap.PAGESIZE * mmap.PAGESIZE
    # Shared memory would come back as it was; the mark at `start` tells.
    data[:start], data[stop:], data[start] = 0, 0, 1
    if _advise(data[start:].ctypes.data, stop - start, mmap.MADV_DONTNEED) or data[start]:
        out[...] = 0


_LEAST = 1 << 17
"""The least bytes of an array for which a call to the system takes less time than writing zeros."""

_advise: Callable[[int, int, int], int] | None = None
if sys.platform == "linux":  # Elsewhere `MADV_DONTNEED` promises no zeros.
    _advise = ctypes.CDLL(None).madvise
    _advise.argtypes = ctypes.c_void_p, ctypes.c_size_t, ctypes.c_int


batching.primitive_batchers[_call] = _batched
partial_eval.dce_rules[_call] = _without_unused
mlir.register_lowering(_filled, _emitted, platform="cpu")
mlir.register_lowering(_call, mlir.lower_fun(_copying, multiple_results=True))
mlir.register_lowering(_call, mlir.lower_fun(_in_place, multiple_results=True), platform="cpu")
