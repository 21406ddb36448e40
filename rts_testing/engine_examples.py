"""Examples to try engines on: the library's operations with operands, and functions of the array API."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from rts import LargeSteps, engine_of, rigid
from rts.plugin_api.operations import combine, interpolate, take
from rts.tool_api.operations import affine_map, matmul, projective_map, texels

N = 6


def numbers(*shape: int, seed: int = 0) -> np.ndarray:
    """Random float32 numbers from −1 to 1, an array of this shape."""
    return np.random.default_rng(seed).uniform(-1, 1, shape).astype(np.float32)


IDS = np.array([(0, 2, 1), (3, 3, 0), (1, 2, 3), (2, 0, 1), (0, 1, 3), (3, 2, 2)], np.int32)
WITH_DIVISOR = numbers(4, 4)
WITH_DIVISOR[2, 3] += 6
STEPS = LargeSteps(np.zeros((4, 3)), IDS, 0.3)

OPERATIONS: dict[str, tuple[Callable, list[np.ndarray]]] = {
    "matmul": (matmul, [numbers(4, 4), numbers(4, 4, seed=1)]),
    "affine_map": (affine_map, [numbers(4, 4), numbers(N, 3, seed=1)]),
    "projective_map": (projective_map, [WITH_DIVISOR, numbers(N, 3, seed=1)]),
    "take": (lambda rows: take(rows, _index(rows)), [numbers(4, 3)]),
    "interpolate": (lambda rows, w: interpolate(rows, _ids(rows), 0, w), [numbers(4, 3), numbers(N, 2, seed=1)]),
    "combine": (lambda rows, w: combine(rows, _ids(rows), w), [numbers(4, 3), numbers(N, 3, seed=1)]),
    "large_steps": (STEPS.decode, [numbers(4, 3)]),
    "rigid": (rigid, [numbers(6), numbers(3, seed=1)]),
    "texels": (lambda table, uv: texels(table, uv, [(2, 3)]), [numbers(6, 3), numbers(N, 2, seed=1)]),
}
"""The library's own operations, with operands."""

NAMESPACE: dict[str, Callable] = {
    "arithmetic": lambda xp, x: (x * x + 2 - x / 3) ** 2,
    "where": lambda xp, x: xp.where(x > 0, x, xp.zeros_like(x)),
    "sum and mean": lambda xp, x: xp.sum(x, axis=0) + xp.mean(x),
    "stack and concat": lambda xp, x: xp.concat([xp.stack([x[:, 0], x[:, 1]], axis=-1), x], axis=1),
    "reshape": lambda xp, x: xp.reshape(x, (-1, 2)),
    "broadcast_to": lambda xp, x: xp.broadcast_to(x[:1, :], (3, 4)),
    "functions": lambda xp, x: xp.exp(x) + xp.sin(x) * xp.cos(x) + xp.sqrt(xp.abs(x) + 1) + xp.floor(x),
    "clip, minimum, maximum": lambda xp, x: xp.clip(x, -0.5, 0.5) + xp.minimum(x, 0 * x) - xp.maximum(x, 0 * x),
    "cross": lambda xp, x: xp.linalg.cross(x[:, :3], x[:, 1:]),
    "inverse": lambda xp, x: xp.linalg.inv(x[:4, :] @ xp.linalg.matrix_transpose(x[:4, :]) + 4 * _eye(xp, x)),
    "argsort": lambda xp, x: xp.take_along_axis(x, xp.argsort(x, axis=0, stable=True), axis=0),
    "any and all": lambda xp, x: xp.astype(xp.any(x > 0, axis=0) & ~xp.all(x > 0, axis=0), x.dtype),
}
"""Functions of the array API that the core and plugins use, each as a function of x (6, 4)."""


def _ids(like: Any) -> Any:
    return engine_of(like).constant(IDS)


def _index(like: Any) -> Any:
    return engine_of(like).constant(IDS[:, 0])


def _eye(xp: Any, like: Any) -> Any:
    return engine_of(like).constant(np.eye(4), like)
