"""Rows of a tensor by index, whose gradient is added up by compiled code: torch's own takes milliseconds for it."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numba
import numpy as np
import torch
from torch import Tensor

from rts_backends.torch_functions import applied, foreign


def take(rows: Tensor, index: Tensor) -> Tensor:
    """(M, C): the rows of (V, C) that (M,) integers name, on the CPU."""
    if torch.compiler.is_compiling():
        return torch.index_select(rows, 0, index)
    return applied(_Take, rows, index)


class _Take(torch.autograd.Function):
    """The rows."""

    @staticmethod
    def forward(rows, index):
        return torch.index_select(rows, 0, index)

    @staticmethod
    def setup_context(ctx, inputs, output):
        rows, index = inputs
        ctx.count = rows.shape[0]
        ctx.save_for_backward(index)
        ctx.save_for_forward(index)

    @staticmethod
    def backward(ctx, *gradients):
        (g,), (index,) = gradients, ctx.saved_tensors
        if foreign(g):
            rows = g.new_zeros((ctx.count, g.shape[1]))
            return torch.func.vjp(lambda r: torch.index_select(r, 0, index), rows)[1](g)[0], None
        return applied(_Add, g, index, ctx.count), None

    @staticmethod
    def jvp(ctx, *tangents):
        return applied(_Take, tangents[0], ctx.saved_tensors[0])

    @staticmethod
    def vmap(info, in_dims, rows, index):
        return _columns(info, in_dims[:2], (rows, index), partial(applied, _Take))


class _Add(torch.autograd.Function):
    """(V, C): sums of the rows of (M, C) that share an index, added in their order."""

    @staticmethod
    def forward(values, index, count):
        total = np.zeros((count, values.shape[1]), values.detach().numpy().dtype)
        _add(np.ascontiguousarray(values.detach().numpy()), index.detach().numpy(), total)
        return torch.from_numpy(total)

    @staticmethod
    def setup_context(ctx, inputs, output):
        _, index, ctx.count = inputs
        ctx.save_for_backward(index)
        ctx.save_for_forward(index)

    @staticmethod
    def backward(ctx, *gradients):
        return applied(_Take, gradients[0], ctx.saved_tensors[0]), None, None

    @staticmethod
    def jvp(ctx, *tangents):
        return applied(_Add, tangents[0], ctx.saved_tensors[0], ctx.count)

    @staticmethod
    def vmap(info, in_dims, values, index, count):
        return _columns(info, in_dims[:2], (values, index), lambda v, i: applied(_Add, v, i, count))


def _columns(info: Any, in_dims: tuple, given: tuple[Tensor, Tensor], f: Callable) -> tuple[Tensor, int]:
    """A batch of either: as more columns where all items share an index, else one by one."""
    (rows, index), (row_dim, index_dim) = given, in_dims
    if index_dim is None:
        wide = rows.movedim(row_dim, 1)
        return f(wide.flatten(1), index).unflatten(1, wide.shape[1:]).movedim(1, 0), 0
    items = [
        f(rows if row_dim is None else rows.select(row_dim, b), index.select(index_dim, b))
        for b in range(info.batch_size)
    ]
    return torch.stack(items), 0


@numba.njit(cache=True, nogil=True)
def _add(values, index, total):
    for m in range(len(index)):
        for c in range(values.shape[1]):
            total[index[m], c] += values[m, c]
