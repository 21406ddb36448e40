"""Functions of tensors on the host whose values and first derivatives are compiled.

Autograd, `torch.func` and forward mode take the derivatives by compiled code; derivatives of these, and batches of
`vmap` other than of tangents, are of the specification, which is the same function in torch.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from rts_backends.torch_functions import along, applied, foreign

Arrays = Sequence[np.ndarray]
Some = Sequence[np.ndarray | None]


class Operation(NamedTuple):
    """A function of tensors, in the first two of which it is differentiable; all floats are of one dtype.

    Attributes:
        specification: the function in torch.
        value: the result of the operands.
        shape: of the result, from the operands.
        push: (operands, tangents, out), to fill `out` with the tangent along those of the first two, or None for zeros.
        pull: (operands, gradient, results), to fill the results, zeros at first, with the gradients of the first two;
            None where not wanted.
    """

    specification: Callable[..., Tensor]
    value: Callable[[Arrays], np.ndarray]
    shape: Callable[[Arrays], tuple[int, ...]]
    push: Callable[[Arrays, Some, np.ndarray], None]
    pull: Callable[[Arrays, np.ndarray, Some], None]

    def __call__(self, *operands: Tensor) -> Tensor:
        """The result."""
        if torch.compiler.is_compiling():
            return self.specification(*operands)
        return applied(_Value, self, *operands)

    def pulled(self, wanted: Sequence[bool]) -> Callable[..., tuple[Tensor, ...]]:
        """The specification's pullback as a function of operands and gradient; no rows of what is not wanted."""

        def pull(*given: Tensor) -> tuple[Tensor, ...]:
            (first, second, *rest), g = given[:-1], given[-1]
            found = torch.func.vjp(lambda a, b: self.specification(a, b, *rest), first, second)[1](g)
            return tuple(x if wish else x[:0] for x, wish in zip(found, wanted, strict=True))

        return pull

    def pushed(self, present: Sequence[bool]) -> Callable[..., Tensor]:
        """The specification's pushforward as a function of operands and those tangents (T, ·) that there are."""

        def push(*given: Tensor) -> Tensor:
            (first, second, *rest), tangents = given[: -sum(present)], given[-sum(present) :]

            def one(*moves: Tensor) -> Tensor:
                it = iter(moves)
                changes = [next(it) if there else None for there in present]
                return along(lambda a, b: self.specification(a, b, *rest), (first, second), changes)

            return torch.stack([one(*moves) for moves in zip(*tangents, strict=True)])

        return push


def _on_host(tensors: Sequence[Tensor]) -> list[np.ndarray]:
    return [t.detach().numpy() for t in tensors]


class _Value(torch.autograd.Function):
    """The result."""

    @staticmethod
    def forward(operation, *operands):
        return torch.from_numpy(operation.value(_on_host(operands)))

    @staticmethod
    def setup_context(ctx, inputs, output):
        ctx.operation, *operands = inputs
        ctx.save_for_backward(*operands)
        ctx.save_for_forward(*operands)

    @staticmethod
    def backward(ctx, *gradients):
        wanted, operands = ctx.needs_input_grad[1:3], ctx.saved_tensors
        if foreign(*gradients):
            found = ctx.operation.pulled(wanted)(*operands, gradients[0])
        else:
            found = applied(_Pull, ctx.operation, wanted, *operands, gradients[0])
        found = (x if wish else None for x, wish in zip(found, wanted, strict=True))
        return None, *found, *[None] * (len(operands) - 2)

    @staticmethod
    def jvp(ctx, *given):
        tangents, operands = given[1:3], ctx.saved_tensors
        present = [t is not None for t in tangents]
        if not any(present):
            return None
        there = [t[None] for t in tangents if t is not None]
        if foreign(*tangents):
            return ctx.operation.pushed(present)(*operands, *there)[0]
        return applied(_Push, ctx.operation, present, *operands, *there)[0]

    @staticmethod
    def vmap(info, in_dims, operation, *operands):
        return torch.vmap(operation.specification, in_dims[1:])(*operands), 0


class _Push(torch.autograd.Function):
    """Tangents (T, ·) of the result."""

    @staticmethod
    def forward(operation, present, *given):
        count = sum(present)
        arrays, tangents = _on_host(given[:-count]), iter(_on_host(given[-count:]))
        some = [next(tangents) if there else None for there in present]
        out = np.empty((len(given[-1]), *operation.shape(arrays)), arrays[0].dtype)
        for i, result in enumerate(out):
            operation.push(arrays, [None if t is None else t[i] for t in some], result)
        return torch.from_numpy(out)

    @staticmethod
    def setup_context(ctx, inputs, output):
        ctx.operation, ctx.present, *given = inputs
        ctx.save_for_backward(*given)
        ctx.save_for_forward(*given)

    @staticmethod
    def _differentiable(ctx):
        """The specification's pushforward of what has a derivative, and that; all but the operands after the second."""
        given, count = ctx.saved_tensors, sum(ctx.present)
        fixed, push = given[2:-count], ctx.operation.pushed(ctx.present)
        return lambda a, b, *tangents: push(a, b, *fixed, *tangents), (*given[:2], *given[-count:])

    @staticmethod
    def backward(ctx, *gradients):
        push, primals = _Push._differentiable(ctx)
        first, second, *tangents = torch.func.vjp(push, *primals)[1](gradients[0])
        return None, None, first, second, *[None] * (len(ctx.saved_tensors) - len(primals)), *tangents

    @staticmethod
    def jvp(ctx, *given):
        push, primals = _Push._differentiable(ctx)
        return along(push, primals, (*given[2:4], *given[-sum(ctx.present) :]))

    @staticmethod
    def vmap(info, in_dims, operation, present, *given):
        count, dims = sum(present), in_dims[2:]
        if any(d is not None for d in dims[:-count]):
            return torch.vmap(operation.pushed(present), dims)(*given), 0
        # The batch is more tangents of the same operands: one sweep for all.
        folded = (
            (t.expand(info.batch_size, *t.shape) if d is None else t.movedim(d, 0)).flatten(0, 1)
            for t, d in zip(given[-count:], dims[-count:], strict=True)
        )
        out = applied(_Push, operation, present, *given[:-count], *folded)
        return out.unflatten(0, (info.batch_size, -1)), 0


class _Pull(torch.autograd.Function):
    """Gradients of the first two operands from that of the result; of no rows where not wanted."""

    @staticmethod
    def forward(operation, wanted, *given):
        *arrays, g = _on_host(given)
        found = [
            np.zeros((len(x) if wish else 0, *x.shape[1:]), x.dtype) for x, wish in zip(arrays, wanted, strict=False)
        ]
        operation.pull(arrays, g, [x if wish else None for x, wish in zip(found, wanted, strict=True)])
        return tuple(map(torch.from_numpy, found))

    @staticmethod
    def setup_context(ctx, inputs, output):
        ctx.operation, ctx.wanted, *given = inputs
        ctx.save_for_backward(*given)
        ctx.save_for_forward(*given)

    @staticmethod
    def _differentiable(ctx):
        """The specification's pullback of what has a derivative, and that."""
        first, second, *fixed, g = ctx.saved_tensors
        pull = ctx.operation.pulled(ctx.wanted)
        return lambda a, b, h: pull(a, b, *fixed, h), (first, second, g)

    @staticmethod
    def backward(ctx, *gradients):
        pull, primals = _Pull._differentiable(ctx)
        first, second, g = torch.func.vjp(pull, *primals)[1](gradients)
        return None, None, first, second, *[None] * (len(ctx.saved_tensors) - 3), g

    @staticmethod
    def jvp(ctx, *given):
        pull, primals = _Pull._differentiable(ctx)
        return along(pull, primals, (*given[2:4], given[-1]))

    @staticmethod
    def vmap(info, in_dims, operation, wanted, *given):
        return torch.vmap(operation.pulled(wanted), in_dims[2:])(*given), (0, 0)
