"""Perspective projection in torch on the CPU, in one compiled pass and one for its gradient.

Written in torch it takes a dozen passes over the points, and twice as many back.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from rts_backends import projection_kernels
from rts_backends.torch_functions import along, applied, foreign


def specification(rows: Tensor, points: Tensor) -> Tensor:
    """The same in torch."""
    x, y, w, z = torch.addmm(rows[:, 3], points, rows[:, :3].T).unbind(1)
    safe = torch.where(w == 0, torch.ones_like(w), w)
    return torch.stack([x / safe, y / safe, z], dim=1)


def project(rows: Tensor, points: Tensor) -> Tensor:
    """(N, 3): of the four affine maps (4, 4) of points (N, 3), the first two over the third, and the fourth."""
    if torch.compiler.is_compiling():
        return specification(rows, points)
    return applied(_Project, rows, points)


def _pulled(wanted: bool) -> Callable:
    """The specification's pullback of rows, points and the gradient; of no points where these are not wanted."""

    def pull(rows: Tensor, points: Tensor, g: Tensor) -> tuple[Tensor, Tensor]:
        g_rows, g_points = torch.func.vjp(specification, rows, points)[1](g)
        return g_rows, g_points if wanted else g_points[:0]

    return pull


class _Project(torch.autograd.Function):
    """The projection."""

    @staticmethod
    def forward(rows, points):
        out = torch.empty(points.shape, dtype=points.dtype)
        projection_kernels.project(rows.detach().numpy(), points.detach().numpy(), out.numpy())
        return out

    @staticmethod
    def setup_context(ctx, inputs, output):
        ctx.save_for_backward(*inputs)
        ctx.save_for_forward(*inputs)

    @staticmethod
    def backward(ctx, *gradients):
        wanted = ctx.needs_input_grad[1]
        if foreign(*gradients):
            found = _pulled(wanted)(*ctx.saved_tensors, gradients[0])
        else:
            found = applied(_Pull, *ctx.saved_tensors, gradients[0], wanted)
        return found[0], found[1] if wanted else None

    @staticmethod
    def jvp(ctx, *tangents):
        if foreign(*tangents):
            return along(specification, ctx.saved_tensors, tangents)
        t_rows, t_points = (None if t is None else t[None] for t in tangents)
        return applied(_Push, *ctx.saved_tensors, t_rows, t_points)[0]

    @staticmethod
    def vmap(info, in_dims, rows, points):
        return torch.vmap(specification, in_dims)(rows, points), 0


def _pushed(rows: Tensor, points: Tensor, t_rows: Tensor | None, t_points: Tensor | None) -> Tensor:
    """Tangents (T, N, 3) along those of rows (T, 4, 4) and points (T, N, 3), or None for zeros, in torch."""
    x, y, w, _ = torch.addmm(rows[:, 3], points, rows[:, :3].T).unbind(1)
    safe = torch.where(w == 0, torch.ones_like(w), w)
    moved = 0.0 if t_points is None else t_points @ rows[:, :3].T
    turned = 0.0 if t_rows is None else points @ t_rows[:, :, :3].mT + t_rows[:, None, :, 3]
    tx, ty, tw, tz = (moved + turned).unbind(2)  # pyright: ignore[reportAttributeAccessIssue]
    tw = torch.where(w == 0, torch.zeros_like(tw), tw)
    return torch.stack([(tx - x / safe * tw) / safe, (ty - y / safe * tw) / safe, tz], dim=2)


class _Push(torch.autograd.Function):
    """Tangents along T directions."""

    @staticmethod
    def forward(rows, points, t_rows, t_points):
        count = next(len(t) for t in (t_rows, t_points) if t is not None)
        out = torch.empty((count, *points.shape), dtype=points.dtype)
        given = [x.detach().numpy() for x in (rows, points)]
        along_rows, along_points = ([None] * count if t is None else t.detach().numpy() for t in (t_rows, t_points))
        for turn, move, result in zip(along_rows, along_points, out.numpy(), strict=True):
            projection_kernels.push(*given, turn, move, result)
        return out

    @staticmethod
    def setup_context(ctx, inputs, output):
        ctx.present = [t is not None for t in inputs]
        given = [t for t in inputs if t is not None]
        ctx.save_for_backward(*given)
        ctx.save_for_forward(*given)

    @staticmethod
    def _function(ctx):
        """The specification, of those that are present."""

        def push(*given: Tensor) -> Tensor:
            it = iter(given)
            return _pushed(*(next(it) if there else None for there in ctx.present))  # pyright: ignore[reportArgumentType]

        return push

    @staticmethod
    def backward(ctx, *gradients):
        found = iter(torch.func.vjp(_Push._function(ctx), *ctx.saved_tensors)[1](gradients[0]))
        return tuple(next(found) if there else None for there in ctx.present)

    @staticmethod
    def jvp(ctx, *tangents):
        given = [t for t, there in zip(tangents, ctx.present, strict=True) if there]
        return along(_Push._function(ctx), ctx.saved_tensors, given)

    @staticmethod
    def vmap(info, in_dims, rows, points, t_rows, t_points):
        if in_dims[0] is not None or in_dims[1] is not None:
            return torch.vmap(_pushed, in_dims)(rows, points, t_rows, t_points), 0
        # The batch is more tangents of the same points: one sweep for all.
        folded = (
            t if t is None else (t.expand(info.batch_size, *t.shape) if d is None else t.movedim(d, 0)).flatten(0, 1)
            for t, d in zip((t_rows, t_points), in_dims[2:], strict=True)
        )
        return applied(_Push, rows, points, *folded).unflatten(0, (info.batch_size, -1)), 0


class _Pull(torch.autograd.Function):
    """Gradients of rows and, where wanted, of points (else of none) from that of the projection."""

    @staticmethod
    def forward(rows, points, g, wanted):
        g_points = torch.empty(points.shape if wanted else (0, 3), dtype=points.dtype)
        given = (x.detach().numpy() for x in (rows, points, g))
        g_rows = projection_kernels.pull(*given, g_points.numpy() if wanted else None)
        return torch.from_numpy(g_rows), g_points

    @staticmethod
    def setup_context(ctx, inputs, output):
        *tensors, ctx.wanted = inputs
        ctx.save_for_backward(*tensors)
        ctx.save_for_forward(*tensors)

    @staticmethod
    def backward(ctx, *gradients):
        return *torch.func.vjp(_pulled(ctx.wanted), *ctx.saved_tensors)[1](gradients), None

    @staticmethod
    def jvp(ctx, *tangents):
        return along(_pulled(ctx.wanted), ctx.saved_tensors, tangents[:3])

    @staticmethod
    def vmap(info, in_dims, rows, points, g, wanted):
        return torch.vmap(_pulled(wanted), in_dims[:3])(rows, points, g), (0, 0)
