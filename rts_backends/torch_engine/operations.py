"""Operations as torch functions: autograd, `torch.func` transforms, forward mode and `torch.compile`.

Three functions: the value, its pullback (gradients) and its pushforward (tangents), each by compiled code. The
derivatives of the last two, which are second derivatives of the value, are taken of the specification: array code.
"""

from __future__ import annotations

import inspect
import threading
from collections.abc import Callable, Mapping, Sequence
from operator import attrgetter
from typing import Any, TypeVar

import numpy as np
import torch
from torch import Tensor

from rts.plugin_api.operations import Operation
from rts.plugin_api.threads import read_only
from rts_backends.torch_engine.functions import along, foreign, is_zero
from rts_backends.torch_engine.torch_internals import differentiated, is_asked_for, is_legacy_batchedtensor

_DTYPES = {torch.float32: np.dtype(np.float32), torch.float64: np.dtype(np.float64)}
_T = TypeVar("_T", Tensor, np.ndarray)
_REQUIRES_GRAD = attrgetter("requires_grad")
_INTEGERS = {torch.int32, torch.int64, torch.int16, torch.int8, torch.uint8, torch.bool}


def apply(operation: Operation, operands: Sequence[Tensor], params: Mapping[str, Any]) -> Tensor:
    """The result of an operation: by compiled code if it takes the operands, else by the operation's array code.

    It takes floats that are all float32 or all float64, and integers, on the host. The array code also runs under
    `torch.compile`, and while other array code is differentiated.
    """
    real = operands[0].dtype
    compiled = real in _DTYPES and not _specifying.on and not torch.compiler.is_compiling()
    for x in operands:
        compiled = compiled and x.is_cpu and (x.dtype == real or x.dtype in _INTEGERS)
    if not compiled:
        return operation.specification(*operands, **params)
    # Repeated rows are written out once, and not for each derivative anew.
    operands, count = tuple(map(Tensor.contiguous, operands)), operation.differentiable
    if differentiated():
        return _Value.apply(_Call(operation, params), *operands)
    if not (torch.is_grad_enabled() and any(map(_REQUIRES_GRAD, operands[:count]))):
        return torch.from_numpy(operation.value_on_host(_host(operands), params)[0])
    return _Eager.apply((_Call(operation, params), operands[count:]), *operands[:count])


class _Specifying(threading.local):
    """A flag `on` for each thread: True while an operation's specification, its array code, is differentiated.

    Operations called inside it then run as array code, too: torch cannot nest its transforms in `Function`s.
    """

    on = False


_specifying = _Specifying()


class _Call:
    """A call of an operation, and the arrays that its value keeps for the derivatives.

    The operands themselves are torch's to keep, or not, as under `torch.utils.checkpoint`. Under `vmap` each item has a
    call of its own.
    """

    __slots__ = ("count", "kept", "operation", "params")

    def __init__(self, operation: Operation, params: Mapping[str, Any]):
        self.operation, self.params = operation, params
        self.count, self.kept = operation.differentiable, None

    def another(self) -> _Call:
        """A call of this operation with these parameters, at other operands."""
        return _Call(self.operation, self.params)

    def split(self, operands: Sequence[Any]) -> tuple[Sequence[Any], Sequence[Any]]:
        """The differentiable operands at the head of `operands`, and the rest."""
        return operands[: self.count], operands[self.count :]

    def specification(self, *fixed: Tensor) -> Callable[..., Tensor]:
        """The operation's array code as a function of the differentiable operands; `fixed` are the others."""
        # Some batched derivatives of torch before 2.9 take indices of 64 bits alone.
        fixed = tuple(x.long() if x.dtype is torch.int32 else x for x in fixed)

        def specified(*varied: Tensor) -> Tensor:
            before, _specifying.on = _specifying.on, True
            try:
                return self.operation.specification(*varied, *fixed, **self.params)
            finally:
                _specifying.on = before

        return specified

    def warn_of_second(self, asked: Callable[[int], bool], before: Callable[[], bool]) -> None:
        """Warn of second derivatives in which the first operand has a part, if the operation has a warning.

        Args:
            asked: k → whether this derivative is by operand k.
            before: whether the one before was by the first operand, among others.
        """
        if not self.operation.second:
            return
        if asked(0) or (any(asked(k) for k in range(1, self.count)) and before()):
            self.operation.warn_of_second()

    def pulled(self, wanted: Sequence[bool], fixed: Sequence[Tensor]) -> Callable[..., tuple[Tensor, ...]]:
        """The pullback of the array code, as a function of the differentiable operands and the result's gradient.

        It returns a gradient for each differentiable operand, empty if not wanted.
        """

        def pull(*varied_and_gradient: Tensor) -> tuple[Tensor, ...]:
            found = torch.func.vjp(self.specification(*fixed), *varied_and_gradient[:-1])[1](varied_and_gradient[-1])
            return tuple(x if wish else x.new_empty(0) for x, wish in zip(found, wanted, strict=True))

        return pull

    def pushed(self, present: Sequence[bool], fixed: Sequence[Tensor]) -> Callable[..., Tensor]:
        """The pushforward of the array code, as a function of the differentiable operands and present tangents (T, ·).

        It returns the result's tangents (T, ·).
        """

        def push(*varied_and_tangents: Tensor) -> Tensor:
            varied, tangents = self.split(varied_and_tangents)

            def one(*moves: Tensor) -> Tensor:
                return along(self.specification(*fixed), varied, _spread(moves, present))

            return torch.stack([one(*moves) for moves in zip(*tangents, strict=True)])

        return push


def _spread(items: Sequence[_T], present: Sequence[bool]) -> list[_T | None]:
    """A list as long as `present`: the items of `items`, in order, where `present` is True, and None elsewhere."""
    it = iter(items)
    return [next(it) if there else None for there in present]


def _host(tensors: Sequence[Tensor]) -> list[np.ndarray]:
    """The values of tensors as loops take them: read-only, and one line after the other."""
    arrays = []
    for x in tensors:
        # Forward mode makes up zeros without memory, which NumPy gets by force alone.
        array = (x if x.is_cpu else x.cpu()).numpy(force=True)
        if array.flags.c_contiguous:
            array.flags.writeable = False  # Of this view of the memory.
        arrays.append(array if array.flags.c_contiguous else read_only(array))
    return arrays


def _items(info: Any, in_dims: Sequence, args: Sequence) -> list[tuple]:
    """For each item of a `torch.vmap` batch, the tuple of its arguments."""
    return [
        tuple(a if d is None else a.select(d, b) for a, d in zip(args, in_dims, strict=True))
        for b in range(info.batch_size)
    ]


class _Derivatives(torch.autograd.Function):
    """The first derivatives of the value of an operation."""

    @staticmethod
    def backward(ctx, *gradients):
        call, operands, (g,) = ctx.call, ctx.saved_tensors, gradients
        wanted = ctx.needs_input_grad[1 : 1 + call.count]
        if is_legacy_batchedtensor(g):
            varied, fixed = call.split(operands)
            found = call.pulled(wanted, fixed)(*varied, g)
        elif torch.is_grad_enabled() or differentiated():
            found = _Pull.apply(call, wanted, *operands, g)
        else:
            found = _Pull.forward(call, wanted, *operands, g)
        found = [x if wish else None for x, wish in zip(found, wanted, strict=True)]
        return None, *found, *[None] * (len(ctx.needs_input_grad) - 1 - call.count)

    @staticmethod
    def jvp(ctx, *input_tangents):
        call, operands = ctx.call, ctx.saved_tensors
        tangents = input_tangents[1 : 1 + call.count]
        present = tuple(t is not None for t in tangents)
        if not any(present):
            return None
        there = [t[None] for t in tangents if t is not None]
        if foreign(*tangents):
            varied, fixed = call.split(operands)
            return call.pushed(present, fixed)(*varied, *there)[0]
        return _Push.apply(call, present, *operands, *there)[0]


class _Eager(_Derivatives):
    """The value of an operation, by compiled code, outside of transforms: in half as many calls of Python.

    Operands without derivatives come along with the call, since torch takes time for each argument.
    """

    @staticmethod
    def forward(ctx, call_and_fixed, *varied):
        call, fixed = call_and_fixed
        ctx.call, operands = call, (*varied, *fixed)
        ctx.save_for_backward(*operands)
        out, call.kept = call.operation.value_on_host(_host(operands), call.params)
        return torch.from_numpy(out)


class _Value(_Derivatives):
    """The value of an operation, by compiled code, also under transforms."""

    @staticmethod
    def forward(call, *operands):
        out, call.kept = call.operation.value_on_host(_host(operands), call.params)
        return torch.from_numpy(out)

    @staticmethod
    def setup_context(ctx, inputs, output):
        ctx.call, *operands = inputs
        ctx.save_for_backward(*operands)
        ctx.save_for_forward(*operands)

    # torch's own signature has no named arguments, though its manual has.
    @staticmethod
    def vmap(info, in_dims, call, *operands):  # pyright: ignore[reportIncompatibleMethodOverride]  # torch's has *args.
        items = _items(info, in_dims[1:], operands)
        return torch.stack([_Value.apply(call.another(), *item) for item in items]), 0


class _Pull(torch.autograd.Function):
    """Gradients of the differentiable operands, from the result's gradient; empty where not wanted."""

    @staticmethod
    def forward(call, wanted, *arrays):
        (*operands, g), found, results = _host(arrays), [], []
        for x, wish in zip(operands, wanted, strict=False):
            found.append(np.zeros(x.shape if wish else 0, x.dtype))
            results.append(found[-1] if wish else None)
        call.operation.pull_on_host(operands, g, results, call.kept, call.params)
        return tuple(map(torch.from_numpy, found))

    @staticmethod
    def setup_context(ctx, inputs, output):
        ctx.call, ctx.wanted, *arrays = inputs
        ctx.save_for_backward(*arrays)
        ctx.save_for_forward(*arrays)

    @staticmethod
    def _differentiable(ctx):
        """The pullback by array code, its arguments that have derivatives, and the number of the other operands."""
        *operands, g = ctx.saved_tensors
        varied, fixed = ctx.call.split(operands)
        return ctx.call.pulled(ctx.wanted, fixed), (*varied, g), len(fixed)

    @staticmethod
    def backward(ctx, *gradients):
        ctx.call.warn_of_second(lambda k: is_asked_for(ctx, k), lambda: not is_zero(gradients[0]))
        pull, primals, fixed = _Pull._differentiable(ctx)
        *found, g = torch.func.vjp(pull, *primals)[1](gradients)
        return None, None, *found, *[None] * fixed, g

    @staticmethod
    def jvp(ctx, *tangents):
        ctx.call.warn_of_second(lambda k: not is_zero(tangents[2 + k]), lambda: ctx.wanted[0])
        pull, primals, _ = _Pull._differentiable(ctx)
        return along(pull, primals, (*tangents[2 : 2 + ctx.call.count], tangents[-1]))

    # torch's own signature has no named arguments, though its manual has.
    @staticmethod
    def vmap(info, in_dims, call, wanted, *arrays):  # pyright: ignore[reportIncompatibleMethodOverride]  # torch's has *args.
        same = all(d is None for d in in_dims[2:-1])
        items = [
            _Pull.apply(call if same else call.another(), wanted, *item) for item in _items(info, in_dims[2:], arrays)
        ]
        return tuple(torch.stack(x) for x in zip(*items, strict=True)), (0,) * len(wanted)


class _Push(torch.autograd.Function):
    """Tangents (T, ·) of the result along the present tangents of the differentiable operands."""

    @staticmethod
    def forward(call, present, *arrays):
        count = sum(present)
        operands, tangents = _host(arrays[:-count]), _host(arrays[-count:])
        shape = call.operation.result_shape(*(x.shape for x in operands), **call.params)
        out = np.empty((len(tangents[0]), *shape), operands[0].dtype)
        call.operation.push_on_host(operands, _spread(tangents, present), out, call.kept, call.params)
        return torch.from_numpy(out)

    @staticmethod
    def setup_context(ctx, inputs, output):
        ctx.call, ctx.present, *arrays = inputs
        ctx.save_for_backward(*arrays)
        ctx.save_for_forward(*arrays)

    @staticmethod
    def _differentiable(ctx):
        """The pushforward by array code, its arguments that have derivatives, and the number of the other operands."""
        arrays, count = ctx.saved_tensors, sum(ctx.present)
        varied, fixed = ctx.call.split(arrays[:-count])
        return ctx.call.pushed(ctx.present, fixed), (*varied, *arrays[-count:]), len(fixed)

    @staticmethod
    def _moves_first(ctx):
        """True if the first operand has a tangent."""
        return ctx.present[0] and not is_zero(ctx.saved_tensors[-sum(ctx.present)])

    @staticmethod
    def backward(ctx, *gradients):
        ctx.call.warn_of_second(lambda k: is_asked_for(ctx, k), lambda: _Push._moves_first(ctx))
        push, primals, fixed = _Push._differentiable(ctx)
        found, n = torch.func.vjp(push, *primals)[1](gradients[0]), ctx.call.count
        return None, None, *found[:n], *[None] * fixed, *found[n:]

    @staticmethod
    def jvp(ctx, *tangents):
        ctx.call.warn_of_second(lambda k: not is_zero(tangents[2 + k]), lambda: _Push._moves_first(ctx))
        push, primals, _ = _Push._differentiable(ctx)
        return along(push, primals, (*tangents[2 : 2 + ctx.call.count], *tangents[-sum(ctx.present) :]))

    # torch's own signature has no named arguments, though its manual has.
    @staticmethod
    def vmap(info, in_dims, call, present, *arrays):  # pyright: ignore[reportIncompatibleMethodOverride]  # torch's has *args.
        count, dims = sum(present), in_dims[2:]
        if any(d is not None for d in dims[:-count]):
            items = _items(info, dims, arrays)
            return torch.stack([_Push.apply(call.another(), present, *item) for item in items]), 0
        # The batch is more tangents of the same operands: one sweep for all.
        folded = (
            (t.expand(info.batch_size, *t.shape) if d is None else t.movedim(d, 0)).flatten(0, 1)
            for t, d in zip(arrays[-count:], dims[-count:], strict=True)
        )
        out = _Push.apply(call, present, *arrays[:-count], *folded)
        return out.unflatten(0, (info.batch_size, -1)), 0


for _function in (_Value, _Pull, _Push):
    # torch asks for it in every call.
    _function.forward.__signature__ = inspect.signature(_function.forward)
