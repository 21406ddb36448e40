"""Calls of host functions with torch's tensors."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from functools import partial
from typing import Any

import numpy as np
import torch

from rts.plugin_api.records import ArraySpec
from rts_backends.torch_engine.functions import foreign, transformed


def to_tensor(value: Any, device: torch.device | None = None) -> torch.Tensor:
    """A tensor of an array or a number, without a copy where torch can share its memory."""
    array = np.asarray(value)
    if not (array.flags.c_contiguous and array.flags.writeable):
        array = array.copy("C")  # torch warns of read-only memory, since it cannot mark a tensor so.
    tensor = torch.from_numpy(array)
    return tensor if device is None or device.type == "cpu" else tensor.to(device)


def to_tensors(values: Iterable[Any], device: torch.device | None) -> list[torch.Tensor]:
    """A tensor of each array or number; see `to_tensor`."""
    tensors, here = [], device is None or device.type == "cpu"
    for x in values:
        # Most are arrays of the host's, made for this call.
        ready = here and type(x) is np.ndarray and x.flags.c_contiguous and x.flags.writeable
        tensors.append(torch.from_numpy(x) if ready else to_tensor(x, device))
    return tensors


def to_host(x: torch.Tensor) -> np.ndarray:
    """The detached value as NumPy, without a copy where it is on the host; both half precisions as float32."""
    x = x.detach().cpu().resolve_neg()
    return (x.float() if x.dtype in (torch.bfloat16, torch.float16) else x).numpy()


class _HostCall(torch.autograd.Function):
    """A call of a host function, without derivative, that works under every torch transform."""

    @staticmethod
    def forward(fn, specs, *args):
        device, values = None, []
        for a in args:
            tensor = isinstance(a, torch.Tensor)
            device = a.device if tensor and device is None else device
            values.append(to_host(a) if tensor else a)
        return tuple(to_tensors(fn(*values), device))

    @staticmethod
    def setup_context(ctx, inputs, output):
        ctx.mark_non_differentiable(*output)
        ctx.counts = len(inputs), len(output)

    @staticmethod
    def backward(ctx, *_):
        return (None,) * ctx.counts[0]

    @staticmethod
    def jvp(ctx, *_):
        return (None,) * ctx.counts[1]

    # torch's own signature has no named arguments, though its manual has.
    @staticmethod
    def vmap(info, in_dims, fn, specs, *args):  # pyright: ignore[reportIncompatibleMethodOverride]  # torch's has *args.
        def select(b):
            return [a if d is None else a.select(d, b) for a, d in zip(args, in_dims[2:], strict=True)]

        if hasattr(fn, "many"):
            whole = [a if d is None else a.movedim(d, 0) for a, d in zip(args, in_dims[2:], strict=True)]
            batch = partial(_of_batch, fn.many, [d is not None for d in in_dims[2:]])
            return _HostCall.apply(batch, specs, *whole), (0,) * len(specs)
        items = [_HostCall.apply(fn, specs, *select(b)) for b in range(info.batch_size)]
        outputs = []
        for spec, values in zip(specs, zip(*items, strict=True), strict=True):
            if spec.packed:
                values = _alike(values)
            outputs.append(torch.stack(tuple(values)))
        return tuple(outputs), (0,) * len(outputs)


def _of_batch(many: Callable, mapped: Sequence[bool], *args: Any) -> list[np.ndarray]:
    """The results of a host function of `many` items, stacked; shorter ones are padded with zeros.

    `mapped` marks the arguments that have an axis of items first.
    """
    count = next(len(a) for a, m in zip(args, mapped, strict=True) if m)
    items = [[a[b, ...] if m else a for a, m in zip(args, mapped, strict=True)] for b in range(count)]
    stacked = []
    for values in zip(*many(items), strict=True):
        most = np.array([np.shape(value) for value in values], int).max(axis=0)
        out = np.zeros((count, *most), np.asarray(values[0]).dtype)
        for b, value in enumerate(values):
            out[(b, *map(slice, np.shape(value)))] = value
        stacked.append(out)
    return stacked


def _alike(values: Sequence[torch.Tensor]) -> list[torch.Tensor]:
    """Tensors of several items, padded with zeros to the longest along every axis."""
    for axis in range(values[0].ndim):
        most = max(v.shape[axis] for v in values)
        values = [
            torch.cat([v, v.new_zeros([most - n if i == axis else n for i, n in enumerate(v.shape)])], axis)
            for v in values
        ]
    return list(values)


def call_host(fn: Callable, specs: Sequence[ArraySpec], *args: Any) -> tuple[torch.Tensor, ...]:
    """The results of a host function, as tensors without derivative; see `Engine.call_host`.

    Under `torch.vmap` it is called once for each item, and packed results are padded with zeros to the longest.
    """
    if torch.compiler.is_compiling():
        # torch annotates nothing of what `disable` returns.
        return torch.compiler.disable(_HostCall.apply)(fn, specs, *args)  # pyright: ignore[reportCallIssue]
    if transformed() or foreign(*[a for a in args if isinstance(a, torch.Tensor)]):
        return _HostCall.apply(fn, specs, *args)
    with torch.no_grad():
        return _HostCall.forward(fn, specs, *args)
