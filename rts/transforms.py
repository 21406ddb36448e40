"""(4, 4) matrices, differentiable in their arguments: views and projections.

Conventions of space are in `rts.camera`. Arguments may be torch or jax arrays, NumPy arrays or numbers.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from rts.arguments import check_numbers, check_planes, check_positive, quoted
from rts.arrays import promote, unit
from rts.engines import namespace
from rts.errors import InputError
from rts.operations.linear import matmul
from rts.trees import Array


def matrix_of(xp: Any, rows: list[list[Any]], like: Array) -> Array:
    """A matrix of array scalars and numbers, in the dtype of `like`."""
    zero = xp.zeros_like(like)
    # Forward-mode torch widens products of a number and a scalar tensor; hence the cast.
    return xp.astype(xp.stack([xp.stack([zero + entry for entry in row]) for row in rows]), like.dtype)


def scaled_rows(matrix: Array, row_signs: tuple[float, ...]) -> Array:
    """The matrix with its rows multiplied by signs."""
    xp = namespace(matrix)
    return xp.stack([matrix[i, :] * s for i, s in enumerate(row_signs)])


def affine_matrix(linear: Array, translation: Array) -> Array:
    """(4, 4) from a (3, 3) linear map and a (3,) translation."""
    xp = namespace(linear)
    last = xp.zeros_like(translation)
    bottom = xp.concat([last, xp.ones_like(translation[:1])])
    return xp.concat([xp.concat([linear, translation[:, None]], axis=1), bottom[None, :]], axis=0)


def perspective(
    fov_y: Any, aspect: Any = 1.0, near: Any = 0.1, far: Any = 100.0, principal_point: Any = (0.0, 0.0)
) -> Array:
    """(4, 4) perspective projection.

    Args:
        fov_y: vertical field of view, degrees.
        aspect: width over height.
        near: depth of the near plane, positive.
        far: depth of the far plane.
        principal_point: (2,) where the axis meets the image, NDC; (0, 0) is the middle.

    Raises:
        InputError: an angle, ratio or planes that make no image.
    """
    check_planes(near, far, positive=True)
    known = check_numbers("fov_y", fov_y, ())
    if known is not None and not 0 < known < 180:
        raise InputError(f"fov_y is {quoted(fov_y)}; expected degrees between 0 and 180")
    check_positive("aspect", aspect)
    check_numbers("principal_point", principal_point, (2,))
    xp, (fov, aspect, near, far, point) = promote(fov_y, aspect, near, far, principal_point)
    scale = 1 / xp.tan(fov * (math.pi / 360))
    depth = far - near
    return matrix_of(
        xp,
        [
            [scale / aspect, 0, -point[0], 0],
            [0, scale, -point[1], 0],
            [0, 0, -(far + near) / depth, -2 * far * near / depth],
            [0, 0, -1, 0],
        ],
        fov,
    )


def orthographic(
    height: Any, aspect: Any = 1.0, near: Any = 0.1, far: Any = 100.0, principal_point: Any = (0.0, 0.0)
) -> Array:
    """(4, 4) orthographic projection.

    Args:
        height: what the image shows from bottom to top, world units.
        aspect: width over height.
        near: depth of the near plane; may be negative.
        far: depth of the far plane.
        principal_point: (2,) where the axis meets the image, NDC.

    Raises:
        InputError: a height, ratio or planes that make no image.
    """
    check_planes(near, far, positive=False)
    check_positive("height", height)
    check_positive("aspect", aspect)
    check_numbers("principal_point", principal_point, (2,))
    xp, (height, aspect, near, far, point) = promote(height, aspect, near, far, principal_point)
    scale, depth = 2 / height, far - near
    return matrix_of(
        xp,
        [
            [scale / aspect, 0, 0, point[0]],
            [0, scale, 0, point[1]],
            [0, 0, -2 / depth, -(far + near) / depth],
            [0, 0, 0, 1],
        ],
        height,
    )


def look_at(eye: Any, target: Any, up: Any = (0.0, 1.0, 0.0)) -> Array:
    """(4, 4) view matrix of a camera at `eye` (3,) that faces `target` (3,), world space.

    Raises:
        InputError: eye and target coincide, or the direction of view is parallel to `up`.
    """
    known = [check_numbers(name, x, (3,)) for name, x in (("eye", eye), ("target", target), ("up", up))]
    if not any(x is None for x in known):
        _check_upright(*(np.asarray(x, np.float64) for x in known))
    xp, (eye, target, up) = promote(eye, target, up)
    back = unit(eye - target)
    right = unit(xp.linalg.cross(up, back))
    linear = xp.stack([right, xp.linalg.cross(back, right), back])
    return affine_matrix(linear, -matmul(linear, eye[:, None])[:, 0])


def _check_upright(eye: np.ndarray, target: np.ndarray, up: np.ndarray) -> None:
    sideways = np.linalg.norm(np.cross(target - eye, up))
    if not sideways > 1e-12 * np.linalg.norm(target - eye) * np.linalg.norm(up):
        raise InputError(
            f"a camera at {eye.tolist()} that looks at {target.tolist()} has no upright with up = {up.tolist()}; "
            f"move the eye or give another up"
        )
