"""`rts.transforms.rigid` for autograd, compiled: some sixty operations on tensors of a few numbers take far longer."""

from __future__ import annotations

import math

import numba
import numpy as np
import torch
from torch import Tensor

from rts.transforms import rigid_by_arrays
from rts_backends.torch_functions import along, applied, filled, foreign, transformed

SMALL = 1e-2
"""Squared angles below which series are exact to rounding."""


def rigid(pose: Tensor, center: Tensor) -> Tensor:
    """(4, 4) of a pose (6,) about a centre (3,), on the CPU."""
    return applied(_Turn, pose, center) if transformed() else applied(_Rigid, pose, center)[0]


def _computed(pose: Tensor, center: Tensor) -> tuple[Tensor, Tensor]:
    """The matrix, and its Jacobian (16, 9)."""
    matrix, jacobian = np.empty((4, 4)), np.empty((16, 9))
    numbers = (x.detach().numpy().astype(np.float64) for x in (pose, center))
    _rigid(*numbers, matrix, jacobian)
    return torch.from_numpy(matrix).to(pose.dtype), torch.from_numpy(jacobian).to(pose.dtype)


def _specified_slopes(pose: Tensor, center: Tensor) -> Tensor:
    """The Jacobian in torch."""
    return torch.func.jacrev(lambda x: rigid_by_arrays(x[:6], x[6:]).reshape(-1))(torch.cat([pose, center]))


def _pushed(pose: Tensor, center: Tensor, tangents: Tensor) -> Tensor:
    """Tangents (T, 4, 4) along those (T, 9) of pose and centre, in torch."""
    return (tangents @ _specified_slopes(pose, center).T).reshape(-1, 4, 4)


class _Turn(torch.autograd.Function):
    """The matrix, for torch's transforms."""

    @staticmethod
    def forward(pose, center):
        return _computed(pose, center)[0]

    @staticmethod
    def setup_context(ctx, inputs, output):
        ctx.save_for_backward(*inputs)
        ctx.save_for_forward(*inputs)

    @staticmethod
    def backward(ctx, *gradients):
        pose, center = ctx.saved_tensors
        slopes = applied(_Push, pose, center, torch.eye(9, dtype=pose.dtype))
        found = slopes.reshape(9, 16) @ gradients[0].reshape(-1)
        return found[:6], found[6:]

    @staticmethod
    def jvp(ctx, *tangents):
        if foreign(*tangents):
            return along(rigid_by_arrays, ctx.saved_tensors, tangents)
        # A function, since what is computed here carries no derivative of a forward mode around this one.
        joined = torch.cat(filled(ctx.saved_tensors, tangents))
        return applied(_Push, *ctx.saved_tensors, joined[None])[0]

    @staticmethod
    def vmap(info, in_dims, pose, center):
        return torch.vmap(rigid_by_arrays, in_dims)(pose, center), 0


class _Push(torch.autograd.Function):
    """Tangents of the matrix."""

    @staticmethod
    def forward(pose, center, tangents):
        return (tangents.detach() @ _computed(pose, center)[1].T).reshape(-1, 4, 4)

    @staticmethod
    def setup_context(ctx, inputs, output):
        ctx.save_for_backward(*inputs)
        ctx.save_for_forward(*inputs)

    @staticmethod
    def backward(ctx, *gradients):
        return torch.func.vjp(_pushed, *ctx.saved_tensors)[1](gradients[0])

    @staticmethod
    def jvp(ctx, *tangents):
        return along(_pushed, ctx.saved_tensors, tangents)

    @staticmethod
    def vmap(info, in_dims, pose, center, tangents):
        if in_dims[0] is not None or in_dims[1] is not None:
            return torch.vmap(_pushed, in_dims)(pose, center, tangents), 0
        out = applied(_Push, pose, center, tangents.movedim(in_dims[2], 0).flatten(0, 1))
        return out.unflatten(0, (info.batch_size, -1)), 0


class _Rigid(torch.autograd.Function):
    """The matrix and its Jacobian, whose own derivative is that of the specification; one call for plain autograd."""

    @staticmethod
    def forward(pose, center):
        return _computed(pose, center)

    @staticmethod
    def setup_context(ctx, inputs, output):
        ctx.save_for_backward(*inputs, output[1])
        ctx.set_materialize_grads(False)

    @staticmethod
    def backward(ctx, *gradients):
        g_matrix, g_jacobian = gradients
        pose, center, jacobian = ctx.saved_tensors
        found = torch.zeros_like(jacobian[0]) if g_matrix is None else g_matrix.reshape(-1) @ jacobian
        if g_jacobian is not None:
            found = found + torch.cat(torch.func.vjp(_specified_slopes, pose, center)[1](g_jacobian))
        return found[:6], found[6:]


@numba.njit(cache=True)
def _rigid(pose, center, matrix, jacobian):
    r = pose[:3]
    s = r[0] * r[0] + r[1] * r[1] + r[2] * r[2]
    if s < SMALL:
        a = 1 - s / 6 * (1 - s / 20 * (1 - s / 42))
        b = 0.5 - s / 24 * (1 - s / 30 * (1 - s / 56))
        da = -(1 - s / 10 * (1 - s / 28 * (1 - s / 54))) / 6
        db = -(1 - s / 15 * (1 - s / 37.333333333333336 * (1 - s / 67.5))) / 24
    else:
        angle = math.sqrt(s)
        a, b = math.sin(angle) / angle, (1 - math.cos(angle)) / s
        da, db = (math.cos(angle) - a) / (2 * s), (a / 2 - b) / s
    jacobian[:] = 0
    # With the cross product's matrix K, the rotation is 1 + a K + b K² (Rodrigues).
    k = np.zeros((3, 3))
    k[0, 1], k[0, 2], k[1, 2] = -r[2], r[1], -r[0]
    k[1, 0], k[2, 0], k[2, 1] = r[2], -r[1], r[0]
    square, turn = np.empty((3, 3)), np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            square[i, j] = r[i] * r[j] - (s if i == j else 0.0)
            matrix[i, j] = (1.0 if i == j else 0.0) + a * k[i, j] + b * square[i, j]
    for n in range(3):
        turn[:] = 0
        up, down = (n + 1) % 3, (n + 2) % 3
        turn[up, down], turn[down, up] = -1, 1
        for i in range(3):
            for j in range(3):
                d_square = (r[j] if i == n else 0.0) + (r[i] if j == n else 0.0) - (2 * r[n] if i == j else 0.0)
                slope = a * turn[i, j] + b * d_square + 2 * r[n] * (da * k[i, j] + db * square[i, j])
                jacobian[4 * i + j, n] = slope
                jacobian[4 * i + 3, n] -= slope * center[j]
    matrix[3, 0] = matrix[3, 1] = matrix[3, 2] = 0
    matrix[3, 3] = 1
    for i in range(3):
        matrix[i, 3] = center[i] + pose[3 + i]
        jacobian[4 * i + 3, 3 + i] = jacobian[4 * i + 3, 6 + i] = 1
        for j in range(3):
            matrix[i, 3] -= matrix[i, j] * center[j]
            jacobian[4 * i + 3, 6 + j] -= matrix[i, j]
