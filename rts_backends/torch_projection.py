"""Perspective projection in torch on the CPU, in one compiled pass and one for its gradient.

Written in torch it takes a dozen passes over the points, and twice as many back.
"""

from __future__ import annotations

from collections.abc import Callable

import numba
import numpy as np
import torch
from torch import Tensor

from rts.threads import parallel
from rts_backends.torch_functions import along, quick

CHUNK = 4096
"""Points whose sums are taken together; fixed, so that results do not depend on the number of threads."""


def specification(rows: Tensor, points: Tensor) -> Tensor:
    """The same in torch."""
    x, y, w, z = torch.addmm(rows[:, 3], points, rows[:, :3].T).unbind(1)
    safe = torch.where(w == 0, torch.ones_like(w), w)
    return torch.stack([x / safe, y / safe, z], dim=1)


def project(rows: Tensor, points: Tensor) -> Tensor:
    """(N, 3): of the four affine maps (4, 4) of points (N, 3), the first two over the third, and the fourth."""
    if torch.compiler.is_compiling():
        return specification(rows, points)
    return _Project.apply(rows, points)


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
        out = np.empty(points.shape, points.detach().numpy().dtype)
        parallel(_forward, len(out), *_arrays(rows, points), out, work=10 * len(out))
        return torch.from_numpy(out)

    @staticmethod
    def setup_context(ctx, inputs, output):
        ctx.save_for_backward(*inputs)
        ctx.save_for_forward(*inputs)

    @staticmethod
    def backward(ctx, *gradients):
        found = _Pull.apply(*ctx.saved_tensors, gradients[0], ctx.needs_input_grad[1])
        return found[0], found[1] if ctx.needs_input_grad[1] else None

    @staticmethod
    def jvp(ctx, *tangents):
        (rows, points), (t_rows, t_points) = ctx.saved_tensors, tangents
        x, y, w, _ = torch.addmm(rows[:, 3], points, rows[:, :3].T).unbind(1)
        safe = torch.where(w == 0, torch.ones_like(w), w)
        moved = 0.0 if t_points is None else t_points @ rows[:, :3].T
        turned = 0.0 if t_rows is None else torch.addmm(t_rows[:, 3], points, t_rows[:, :3].T)
        tx, ty, tw, tz = (moved + turned).unbind(1)
        tw = torch.where(w == 0, torch.zeros_like(tw), tw)
        return torch.stack([(tx - x / safe * tw) / safe, (ty - y / safe * tw) / safe, tz], dim=1)

    @staticmethod
    def vmap(info, in_dims, rows, points):
        return torch.vmap(specification, in_dims)(rows, points), 0


class _Pull(torch.autograd.Function):
    """Gradients of rows and, where wanted, of points (else of none) from that of the projection."""

    @staticmethod
    def forward(rows, points, g, wanted):
        matrix, where = _arrays(rows, points)
        sums = np.empty((-(-len(where) // CHUNK), 4, 4))
        g_points = np.empty(where.shape if wanted else (0, 3), where.dtype)
        given = matrix, where, np.ascontiguousarray(g.detach().numpy())
        parallel(_backward, len(sums), *given, sums, g_points, work=20 * len(where))
        return torch.from_numpy(sums.sum(axis=0).astype(where.dtype)), torch.from_numpy(g_points)

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


quick(_Project, _Pull)


def _arrays(rows: Tensor, points: Tensor) -> tuple[np.ndarray, np.ndarray]:
    return np.ascontiguousarray(rows.detach().numpy()), np.ascontiguousarray(points.detach().numpy())


@numba.njit(cache=True, nogil=True)
def _forward(start, stop, m, points, out):
    one = out.dtype.type(1)
    for n in range(start, stop):
        x, y, z = points[n, 0], points[n, 1], points[n, 2]
        w = m[2, 0] * x + m[2, 1] * y + m[2, 2] * z + m[2, 3]
        over = one / (one if w == 0 else w)
        out[n, 0] = (m[0, 0] * x + m[0, 1] * y + m[0, 2] * z + m[0, 3]) * over
        out[n, 1] = (m[1, 0] * x + m[1, 1] * y + m[1, 2] * z + m[1, 3]) * over
        out[n, 2] = m[3, 0] * x + m[3, 1] * y + m[3, 2] * z + m[3, 3]


@numba.njit(cache=True, nogil=True)
def _backward(start, stop, m, points, g, sums, g_points):
    one = points.dtype.type(1)
    for chunk in range(start, stop):
        total = np.zeros((4, 4))
        for n in range(chunk * CHUNK, min(len(points), (chunk + 1) * CHUNK)):
            x, y, z = points[n, 0], points[n, 1], points[n, 2]
            w = m[2, 0] * x + m[2, 1] * y + m[2, 2] * z + m[2, 3]
            over = one / (one if w == 0 else w)
            u = (m[0, 0] * x + m[0, 1] * y + m[0, 2] * z + m[0, 3]) * over
            v = (m[1, 0] * x + m[1, 1] * y + m[1, 2] * z + m[1, 3]) * over
            a, b, d = g[n, 0] * over, g[n, 1] * over, g[n, 2]
            c = points.dtype.type(0) if w == 0 else -(g[n, 0] * u + g[n, 1] * v) * over
            for r, h in enumerate((a, b, c, d)):
                total[r, 0] += h * x
                total[r, 1] += h * y
                total[r, 2] += h * z
                total[r, 3] += h
            if len(g_points):
                for i in range(3):
                    g_points[n, i] = a * m[0, i] + b * m[1, i] + c * m[2, i] + d * m[3, i]
        sums[chunk] = total
