"""Rigid poses: the matrix of a rotation vector and a translation."""

from __future__ import annotations

from typing import Any

import numpy as np

from rts.arrays.argument_checks import check_numbers
from rts.arrays.array_functions import is_finite, promote, shape_of
from rts.arrays.engines import engine_of, is_constant, namespace, uncompiled
from rts.arrays.trees import Array
from rts.errors import InputError
from rts.operations.operation import Arrays, Operation, Some
from rts.scene.transforms import affine_matrix

ORIGIN = 0.0, 0.0, 0.0


@uncompiled
def rigid(pose: Any, center: Any = ORIGIN) -> Array:
    """World-from-local transform of a rigid pose; differentiable everywhere, at zero rotation too.

    Args:
        pose: (6,) rotation vector (axis times angle, radians) about `center`, then translation.
        center: (3,) local space.

    Returns:
        (4, 4), usable as `Part.transform`.

    Raises:
        InputError: `pose` or `center` has another shape, or is not finite.
    """
    if shape_of(pose) != (6,):
        if shape_of(pose)[1:] == (6,):
            several = f"pose has shape {shape_of(pose)}; expected (6,), one pose"
            raise InputError(f"{several}: stack the results of rts.rigid, or take torch.vmap or jax.vmap of it")
        check_numbers("pose", pose, (6,))
        if is_constant(pose):
            pose = np.asarray(pose, np.float64)
    if center is ORIGIN:
        center = engine_of(pose).constant(np.zeros(3, np.float32), pose)
    elif shape_of(center) != (3,):
        check_numbers("center", center, (3,))
    _, (pose, center) = promote(pose, center)
    matrix = RIGID(pose, center)
    if not is_finite(matrix) and not is_finite(pose, center):
        name = "center" if is_finite(pose) else "pose"
        raise InputError(f"{name} of rts.rigid holds NaN or infinity; expected finite numbers")
    return matrix


def _specification(pose: Array, center: Array) -> Array:
    xp = namespace(pose, center)
    x, y, z = pose[0], pose[1], pose[2]
    square = x * x + y * y + z * z
    # Below a tenth of a radian the series are accurate to 3e-14. The square root stays away from zero, where its
    # derivative is infinite.
    small = square < 1e-2
    angle = xp.sqrt(xp.where(small, xp.ones_like(square), square))
    a = xp.where(small, 1 - square / 6 * (1 - square / 20 * (1 - square / 42)), xp.sin(angle) / angle)
    b = xp.where(small, 0.5 - square / 24 * (1 - square / 30 * (1 - square / 56)), (1 - xp.cos(angle)) / angle**2)
    one = xp.ones_like(square)
    rotation = xp.stack(
        [
            xp.stack([one - b * (y * y + z * z), b * x * y - a * z, b * x * z + a * y]),
            xp.stack([b * x * y + a * z, one - b * (x * x + z * z), b * y * z - a * x]),
            xp.stack([b * x * z - a * y, b * y * z + a * x, one - b * (x * x + y * y)]),
        ]
    )
    moved = center + pose[3:] - xp.sum(rotation * center, axis=1)
    return affine_matrix(rotation, moved)


def _shape(pose: tuple[int, ...], center: tuple[int, ...]) -> tuple[int, ...]:
    return 4, 4


def _computed(operands: Arrays) -> tuple[np.ndarray, np.ndarray]:
    """The matrix (4, 4), and its entries' Jacobian (16, 9) by pose (6,) and centre (3,); float64."""
    from rts.scene import rigid_loops

    pose, center = operands
    if pose.shape != (6,) or center.shape != (3,):
        raise InputError(f"pose and center have shapes {pose.shape} and {center.shape}; expected (6,) and (3,)")
    return rigid_loops.rigid(*operands)


def _forward(operands: Arrays, out: np.ndarray) -> None:
    out[...] = _computed(operands)[0]


def _push(operands: Arrays, tangents: Some, out: np.ndarray) -> None:
    pose, center = (np.zeros_like(x) if t is None else t for x, t in zip(operands, tangents, strict=True))
    out[...] = (_computed(operands)[1] @ np.concatenate([pose, center])).reshape(4, 4)


def _pull(operands: Arrays, g: np.ndarray, results: Some) -> None:
    gradient = g.reshape(-1) @ _computed(operands)[1]
    for result, part in zip(results, (gradient[:6], gradient[6:]), strict=True):
        if result is not None:
            result[...] = part


RIGID = Operation("rts.rigid", _specification, (1, 1), _shape, _forward, _push, _pull, differentiable=2)
