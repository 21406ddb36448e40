"""Functions that the torch engine and its operations share."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor
from torch.autograd import forward_ad
from torch.utils import _pytree

from rts_backends.torch_engine import torch_internals


def transformed() -> bool:
    """True under a `torch.func` transform, in forward mode, or while `torch.compile` traces."""
    return torch_internals.differentiated() or torch.compiler.is_compiling()


_loaded: list[bool] = []


def quiet_forward_mode() -> None:
    """Have torch load the modules of its forward mode, once, and hide its warning of `torch.jit.script`."""
    if not _loaded:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "`torch.jit")  # A FutureWarning from torch 2.15 on.
            torch.func.jvp(torch.clone, (torch.zeros(()),), (torch.ones(()),))
        _loaded.append(True)


def foreign(*tensors: Tensor | None) -> bool:
    """True if any tensor is a batch of `torch.autograd.grad(..., is_grads_batched=True)`, which hides its values."""
    for t in tensors:
        if t is not None and torch_internals.is_legacy_batchedtensor(t):
            return True
    return False


def is_zero(x: Tensor | None) -> bool:
    """True if a gradient or a tangent is 0 throughout, in all items of a batch; False where it hides its values."""
    if x is None or foreign(x):
        return x is None
    return not torch_internals.value_within(x, lambda value: bool((value != 0).any()))


def tangent_alike(x: Tensor) -> Tensor:
    """`x` with its tangent, if it has one, in the dtype of `x`.

    Products and quotients of a scalar tensor in float32 and a number of Python's have tangents in float64, which
    products of matrices refuse.
    """
    try:
        tangent = forward_ad.unpack_dual(x).tangent
    except RuntimeError:  # Batches within forward mode: torch has no rule to unpack them.
        tangent = torch.zeros((), dtype=torch.float64)
    if not x.is_floating_point() or tangent is None or tangent.dtype == x.dtype:
        return x
    return x.to(torch.float64).to(x.dtype)  # One cast alone, to the dtype it has, would be skipped.


def filled(primals: Sequence[Tensor], tangents: Sequence[Tensor | None]) -> tuple[Tensor, ...]:
    """`tangents`, with zeros in place of None."""
    return tuple(torch.zeros_like(p) if t is None else t for p, t in zip(primals, tangents, strict=True))


def along(f: Callable, primals: Sequence[Tensor], tangents: Sequence[Tensor | None]) -> Any:
    """The derivative of `f` at `primals` along `tangents`, by reverse mode twice: torch cannot nest forward mode."""
    value, pull = torch.func.vjp(f, *primals)[:2]
    zeros = _pytree.tree_map(torch.zeros_like, value)
    return torch.func.vjp(pull, zeros)[1](filled(primals, tangents))[0]
