"""The compiled splatters as torch functions: autograd, `torch.func` transforms, forward mode and `torch.compile`.

Three functions: the image, its pullback and its pushforward. Each is the derivative of the one before by compiled
kernels; the derivatives of the last two, which are second derivatives of the image, are taken of the specification.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from rts_backends.fused_kernels import Choices, Settings, Splats
from rts_backends.torch_functions import along, applied, foreign


def fits(*tensors: Tensor) -> bool:
    """Whether positions, rgba and row are on the host, and of the kernels' dtypes."""
    positions, rgba, _ = tensors
    known = positions.dtype == rgba.dtype and positions.dtype in (torch.float32, torch.float64)
    return known and all(t.device.type == "cpu" for t in tensors)


def splat(settings: Settings, specification: Callable, positions: Tensor, rgba: Tensor, row: Tensor) -> Tensor:
    """The image (H, W, 4) of positions (N, 3), rgba (N, 4) and row (K, H, W)."""
    work = _Work(settings, specification)
    if torch.compiler.is_compiling():
        return torch.compiler.disable(applied)(_Image, work, positions, rgba, row)  # pyright: ignore[reportCallIssue]
    return applied(_Image, work, positions, rgba, row)


class _Work:
    """What is to be computed, and the decisions of its forward pass, for the derivatives.

    The samples themselves are torch's to keep, or not, as under `torch.utils.checkpoint`. Under `vmap` each item has
    its own work, since samples differ.
    """

    def __init__(self, settings: Settings, specification: Callable):
        self.settings, self.specification = settings, specification
        self._choices: Choices | None = None

    def splats(self, positions: Tensor, rgba: Tensor, row: Tensor) -> Splats:
        """Those of these tensors, which must be the same each time."""
        splats = Splats(self.settings, *(x.detach().numpy() for x in (positions, rgba, row)), self._choices)
        self._choices = splats.choices
        return splats

    def another(self) -> _Work:
        """The same work, for other samples."""
        return _Work(self.settings, self.specification)

    def pulled(self, row: Tensor, wanted: tuple[bool, bool]) -> Callable:
        """The specification's pullback, as a function of positions, rgba and the image's gradient."""

        def pull(positions: Tensor, rgba: Tensor, g: Tensor) -> tuple[Tensor, ...]:
            found = torch.func.vjp(lambda p, c: self.specification(p, c, row), positions, rgba)[1](g)
            return tuple(x if wish else x[:0] for x, wish in zip(found, wanted, strict=True))

        return pull

    def pushed(self, row: Tensor) -> Callable:
        """The specification's pushforward, as a function of positions, rgba and tangents of them (T, N, ·)."""

        def push(positions: Tensor, rgba: Tensor, t_positions: Tensor, t_rgba: Tensor) -> Tensor:
            def one(tp: Tensor, tc: Tensor) -> Tensor:
                image = lambda p, c: self.specification(p, c, row)  # noqa: E731
                return along(image, (positions, rgba), (tp, tc))

            return torch.stack([one(tp, tc) for tp, tc in zip(t_positions, t_rgba, strict=True)])

        return push


def _items(info: Any, in_dims: Sequence, args: Sequence) -> list[tuple]:
    """Arguments of each item of a batch."""
    return [
        tuple(a if d is None else a.select(d, b) for a, d in zip(args, in_dims, strict=True))
        for b in range(info.batch_size)
    ]


class _Image(torch.autograd.Function):
    """The image."""

    @staticmethod
    def forward(work, positions, rgba, row):
        return torch.from_numpy(work.splats(positions, rgba, row).image())

    @staticmethod
    def setup_context(ctx, inputs, output):
        ctx.work, *tensors = inputs
        ctx.save_for_backward(*tensors)
        ctx.save_for_forward(*tensors)

    @staticmethod
    def backward(ctx, *gradients):
        (g,) = gradients
        wanted = ctx.needs_input_grad[1:3]
        if foreign(g):
            positions, rgba, row = ctx.saved_tensors
            found = ctx.work.pulled(row, wanted)(positions, rgba, g)
        else:
            found = applied(_Pull, ctx.work, wanted, *ctx.saved_tensors, g)
        return None, *(x if wish else None for x, wish in zip(found, wanted, strict=True)), None

    @staticmethod
    def jvp(ctx, *given):
        _, t_positions, t_rgba, _ = given
        if foreign(t_positions) or foreign(t_rgba):
            *primals, row = ctx.saved_tensors
            return along(lambda p, c: ctx.work.specification(p, c, row), primals, (t_positions, t_rgba))
        t_positions, t_rgba = (None if t is None else t[None] for t in (t_positions, t_rgba))
        return applied(_Push, ctx.work, *ctx.saved_tensors, t_positions, t_rgba)[0]

    @staticmethod
    def vmap(info, in_dims, *args):
        work, *tensors = args
        items = _items(info, in_dims[1:], tensors)
        return torch.stack([applied(_Image, work.another(), *item) for item in items]), 0


class _Pull(torch.autograd.Function):
    """Gradients of positions and rgba from that of the image; of no rows where not wanted."""

    @staticmethod
    def forward(work, wanted, positions, rgba, row, g):
        found = work.splats(positions, rgba, row).vjp(g.detach().numpy(), wanted)
        nothing = positions.new_empty((0, 3)), rgba.new_empty((0, 4))
        return tuple(n if x is None else torch.from_numpy(x) for x, n in zip(found, nothing, strict=True))

    @staticmethod
    def setup_context(ctx, inputs, output):
        ctx.work, ctx.wanted, *tensors = inputs
        ctx.save_for_backward(*tensors)
        ctx.save_for_forward(*tensors)

    @staticmethod
    def backward(ctx, *h):
        positions, rgba, row, g = ctx.saved_tensors
        g_positions, g_rgba, g_g = torch.func.vjp(ctx.work.pulled(row, ctx.wanted), positions, rgba, g)[1](h)
        return None, None, g_positions, g_rgba, None, g_g

    @staticmethod
    def jvp(ctx, *given):
        _, _, t_positions, t_rgba, _, t_g = given
        positions, rgba, row, g = ctx.saved_tensors
        primals = positions, rgba, g
        return along(ctx.work.pulled(row, ctx.wanted), primals, (t_positions, t_rgba, t_g))

    @staticmethod
    def vmap(info, in_dims, *args):
        work, wanted, *tensors = args
        same = all(d is None for d in in_dims[2:5])
        items = [
            applied(_Pull, work if same else work.another(), wanted, *item)
            for item in _items(info, in_dims[2:], tensors)
        ]
        return tuple(torch.stack(x) for x in zip(*items, strict=True)), (0, 0)


class _Push(torch.autograd.Function):
    """Tangents (T, H, W, 4) of the image along those of positions (T, N, 3) and rgba (T, N, 4); None for zeros."""

    @staticmethod
    def forward(work, positions, rgba, row, t_positions, t_rgba):
        tangents = (None if t is None else t.detach().numpy() for t in (t_positions, t_rgba))
        return torch.from_numpy(work.splats(positions, rgba, row).jvp(*tangents))

    @staticmethod
    def setup_context(ctx, inputs, output):
        ctx.work, positions, rgba, row, t_positions, t_rgba = inputs
        count = output.shape[0]
        t_positions, t_rgba = (
            x.new_zeros((1, 1, 1)).expand(count, *x.shape) if t is None else t
            for x, t in ((positions, t_positions), (rgba, t_rgba))
        )
        ctx.save_for_backward(positions, rgba, row, t_positions, t_rgba)
        ctx.save_for_forward(positions, rgba, row, t_positions, t_rgba)

    @staticmethod
    def backward(ctx, *gradients):
        (g,) = gradients
        positions, rgba, row, *tangents = ctx.saved_tensors
        found = torch.func.vjp(ctx.work.pushed(row), positions, rgba, *tangents)[1](g)
        wanted = ctx.needs_input_grad[4:]  # Nothing for absent tangents.
        return None, *found[:2], None, *(x if wish else None for x, wish in zip(found[2:], wanted, strict=True))

    @staticmethod
    def jvp(ctx, *given):
        _, t_positions, t_rgba, _, *t_tangents = given
        positions, rgba, row, *tangents = ctx.saved_tensors
        primals = positions, rgba, *tangents
        return along(ctx.work.pushed(row), primals, (t_positions, t_rgba, *t_tangents))

    @staticmethod
    def vmap(info, in_dims, *args):
        work, positions, rgba, row, *tangents = args
        if any(d is not None for d in in_dims[1:4]):
            items = _items(info, in_dims[1:], (positions, rgba, row, *tangents))
            return torch.stack([applied(_Push, work.another(), *item) for item in items]), 0
        # The batch is more tangents of the same samples: one sweep for all.
        flat = [
            t if t is None else (t.expand(info.batch_size, *t.shape) if d is None else t.movedim(d, 0)).flatten(0, 1)
            for t, d in zip(tangents, in_dims[4:], strict=True)
        ]
        out = applied(_Push, work, positions, rgba, row, *flat)
        return out.unflatten(0, (info.batch_size, -1)), 0
