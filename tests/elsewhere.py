"""A device of torch that is not the CPU, on any machine: tensors whose memory no host code can read.

A GPU refuses what a CPU allows: NumPy's views, operands on two devices, a tensor made on the host by mistake. Here
tensors hold their values on the host, say that they are elsewhere, and refuse the same. What copies values to the host,
or waits for one, is counted by the line that asked for it.
"""

from __future__ import annotations

import traceback
from collections import Counter
from pathlib import Path
from typing import Any

import torch
from torch.utils import _pytree
from torch.utils._python_dispatch import TorchDispatchMode

DEVICE = torch.device("lazy:0")
"""A device type that torch knows and that nothing uses, whose backward passes run on the thread of the caller."""

ROOT = Path(__file__).resolve().parent.parent

copies: Counter[str] = Counter()
"""Copies to the host, by the line of this library that asked for each."""

waits: Counter[str] = Counter()
"""Single numbers that the host asked for, and so waited for, likewise."""


def _line() -> str:
    """The innermost line of the library on the stack."""
    for frame in reversed(traceback.extract_stack()):
        path = Path(frame.filename)
        if path.is_relative_to(ROOT) and path.relative_to(ROOT).parts[0] in ("rts", "rts_backends", "rts_surfaces"):
            return f"{path.relative_to(ROOT)}:{frame.lineno} {frame.name}"
    return "outside of the library"


class Elsewhere(torch.Tensor):
    """A tensor on `DEVICE`.

    Args:
        held: its values, on the CPU.
    """

    held: torch.Tensor

    @staticmethod
    def __new__(cls, held: torch.Tensor) -> Elsewhere:
        return torch.Tensor._make_wrapper_subclass(
            cls,
            held.shape,
            strides=held.stride(),
            storage_offset=held.storage_offset(),
            dtype=held.dtype,
            device="meta",
            dispatch_device=True,
        )

    def __init__(self, held: torch.Tensor):
        self.held = held.detach()

    def __repr__(self, **_: Any) -> str:
        return f"Elsewhere({self.held})"

    __torch_function__ = torch._C._disabled_torch_function_impl

    @classmethod
    def __torch_dispatch__(cls, func: Any, types: Any, args: tuple = (), kwargs: dict | None = None) -> Any:
        return _computed(func, args, dict(kwargs or {}))


class Device(TorchDispatchMode):
    """While it is entered, `DEVICE` can be asked for: as `device=`, and by `Tensor.to`."""

    def __torch_dispatch__(self, func: Any, types: Any, args: tuple = (), kwargs: dict | None = None) -> Any:
        return _computed(func, args, dict(kwargs or {}))


def _computed(func: Any, args: tuple, kwargs: dict) -> Any:
    """The result of an operator of torch where any operand, or the device asked for, is `DEVICE`."""
    if func is torch.ops.prim.device.default:
        return DEVICE if isinstance(args[0], Elsewhere) else func(*args)
    tensors = [x for x in _pytree.tree_leaves((args, kwargs)) if isinstance(x, torch.Tensor)]
    there = [x for x in tensors if isinstance(x, Elsewhere)]
    asked = kwargs.get("device")
    leaves = asked is not None and torch.device(asked).type != DEVICE.type
    made = asked is not None and torch.device(asked).type == DEVICE.type
    if made:
        kwargs["device"] = torch.device("cpu")
        if func is torch.ops.aten._efficientzerotensor.default:
            func = torch.ops.aten.zeros.default  # The former has no memory, and is not known as such in here.
    if not there and not made:
        return func(*args, **kwargs)
    copied = leaves or func in (torch.ops.aten._to_copy.default, torch.ops.aten.copy_.default)
    if not copied and any(x.ndim for x in tensors if not isinstance(x, Elsewhere)):
        raise RuntimeError(
            f"Expected all tensors to be on the same device, but found at least two devices, {DEVICE} and cpu ({func})"
        )
    if func is torch.ops.aten._local_scalar_dense.default:
        waits[_line()] += 1
    held, more = _pytree.tree_map_only(Elsewhere, lambda x: x.held, (args, kwargs))
    result = func(*held, **more)
    if there and (leaves or (func is torch.ops.aten.copy_.default and not isinstance(args[0], Elsewhere))):
        if result.is_cpu:  # Forward mode copies shapes alone, to the device "meta".
            copies[_line()] += 1
        return result
    known = {id(x.held): x for x in there}
    return _pytree.tree_map_only(torch.Tensor, lambda x: known[id(x)] if id(x) in known else Elsewhere(x), result)
