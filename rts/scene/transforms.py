"""(4, 4) matrices, differentiable in their arguments: views and projections.

Conventions of space are in `rts.scene.camera`. Arguments may be torch or jax arrays, NumPy arrays or numbers.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from rts.arrays.argument_checks import check_numbers, check_planes, check_positive, quoted
from rts.arrays.array_functions import promote
from rts.arrays.engines import namespace, value_of
from rts.arrays.trees import Array
from rts.errors import InputError, InputWarning, warn
from rts.operations.linear import matmul
from rts.operations.unit import unit


def determinant(matrix: np.ndarray) -> float:
    """The determinant of the first three rows and columns of a host matrix: NumPy's takes ten times as long."""
    (a, b, c), (d, e, f), (g, h, i) = matrix[:3, :3].tolist()
    return a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g)


def matrix_of(xp: Any, rows: list[list[Any]], like: Array) -> Array:
    """A matrix of array scalars and numbers, in the dtype of `like`, a scalar of their engine."""
    zero = xp.zeros_like(like)
    # Forward-mode torch widens products of a number and a scalar tensor; hence the cast.
    return xp.astype(xp.stack([xp.stack([zero + entry for entry in row]) for row in rows]), like.dtype)


def scaled_rows(matrix: Array, row_signs: tuple[float, ...]) -> Array:
    """The matrix (R, ·), its row i multiplied by the number `row_signs[i]`."""
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
        InputError: the angle, the ratio or the planes make no image.
    """
    check_planes(near, far, positive=True)
    value = check_numbers("fov_y", fov_y, ())
    if value is not None and not 0 < value < 180:
        raise InputError(f"fov_y is {quoted(fov_y)}; expected degrees, more than 0 and less than 180")
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
        height: extent of the image from bottom to top, world units.
        aspect: width over height.
        near: depth of the near plane; may be negative.
        far: depth of the far plane.
        principal_point: (2,) where the axis meets the image, NDC.

    Raises:
        InputError: the height, the ratio or the planes make no image.
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

    If the camera looks along `up`, or against it, +x is to the right in the image; +y if `up` is along x.

    Raises:
        InputError: eye and target coincide, `up` is zero, or one of them is no finite vector (3,).
    """
    checked = [check_numbers(name, x, (3,)) for name, x in (("eye", eye), ("target", target), ("up", up))]
    values = None if any(x is None for x in checked) else [np.asarray(x, np.float64) for x in checked]
    if values is not None:
        _check_upright(*values)
    xp, (eye, target, up) = promote(eye, target, up)
    back = unit(eye - target)
    # Known values are mostly not parallel, and then skip the array operations.
    if values is None or _is_parallel(values[2], unit(values[0] - values[1])):
        up = xp.where(_is_parallel(up, back), _level_up(up, back), up)
    right = unit(xp.linalg.cross(up, back))
    linear = xp.stack([right, xp.linalg.cross(back, right), back])
    return affine_matrix(linear, -matmul(linear, eye[:, None])[:, 0])


def _check_upright(eye: np.ndarray, target: np.ndarray, up: np.ndarray) -> None:
    if (eye == target).all() or not up.any():
        raise InputError(
            f"a camera at {eye.tolist()} that looks at {target.tolist()} has no upright with up = {up.tolist()}; "
            f"move the eye or give another up"
        )


def _is_parallel(up: Array, back: Array) -> Any:
    """True if two vectors (3,), the second of unit length, are parallel up to rounding."""
    xp = namespace(up, back)
    sideways, rounding = xp.linalg.cross(up, back), 4 * float(xp.finfo(up.dtype).eps)
    return xp.sum(sideways * sideways) <= rounding**2 * xp.sum(up * up)


def _level_up(up: Array, back: Array) -> Array:
    """(3,) upright of a camera that looks along `up` or against it. To its right is +x, or +y if `up` is along x."""
    xp = namespace(up, back)
    x, y, zero = up * up, back[1:2] * 0 + 1, back[:1] * 0
    along_x = x[0] > 0.5 * xp.sum(x)
    right = xp.where(along_x, xp.concat([zero, y, zero]), xp.concat([y, zero, zero]))
    return xp.linalg.cross(back, right)


PARALLEL = 1e-12
"""Largest slope of clip w, relative to the slopes of clip x and y, of a projection with parallel rays."""
ROUNDING = 1e-5
"""Rounding allowed in matrix entries that should be zero or one."""
RADIANS = 0.3, 2.0
"""A field of view between these limits is probably in radians: 17 to 115 degrees, those of most pictures."""
LEAST_ROUND = 5
"""A smaller field of view is probably in radians if in radians it is a whole number of degrees, at least so many."""


def warn_of_radians(fov_y: Any) -> None:
    """Warn of a known field of view that is probably in radians. Narrower ones are those of telephoto lenses."""
    value = value_of(fov_y)
    if value is None:
        return
    degrees = np.rad2deg(np.asarray(value, np.float64))
    is_round = (degrees > LEAST_ROUND - 0.5) & (np.abs(degrees - np.round(degrees)) < 1e-3)
    if ((value < RADIANS[1]) & ((value >= RADIANS[0]) | is_round)).all():
        warn(
            f"fov_y is {quoted(fov_y)}, and is in degrees: of radians give math.degrees(fov_y); a telephoto lens is "
            f"seen as it is",
            InputWarning,
        )


def check_product(matrix: np.ndarray) -> None:
    """Refuse a matrix (4, 4) that seems to be another product than `projection @ view`.

    In `projection @ view` clip z and w grow along one axis, and both planes of a perspective are in front of the eye.
    """
    # A transposed projection alone may look like a product, but its view would scale.
    rows = _is_product(matrix.T) and _is_unscaled(matrix.T) and not _is_unscaled(matrix)
    if _is_product(matrix) and not rows:
        return
    if _is_product(matrix.T) or (_planes(matrix) is None and _planes(matrix.T) is not None):
        raise InputError("matrix is transposed, for points that are rows; expected projection @ view: give matrix.T")
    if _is_other_order(matrix):
        raise InputError("matrix is view @ projection; expected projection @ view, in this order")
    if (planes := _planes(matrix)) is not None:
        raise InputError(
            f"matrix has a near or far plane behind the camera, at the depth {min(planes):.3g}; expected projection @ "
            f"view, in this order, with depths from -1 to 1 as in OpenGL"
        )


def is_parallel_product(matrix: np.ndarray) -> bool:
    """True if a matrix (4, 4) from the world to clip space has parallel rays."""
    return bool(np.linalg.norm(matrix[3, :3]) <= PARALLEL * np.linalg.norm(matrix[:2, :3]))


def _is_product(matrix: np.ndarray) -> bool:
    """True if a matrix may be `projection @ view`."""
    return is_parallel_product(matrix) or min(_planes(matrix) or (0.0,)) > 0


def _is_unscaled(matrix: np.ndarray) -> bool:
    """True if clip w grows as fast as depth, or is 1 everywhere."""
    w = matrix[3, 3:] if is_parallel_product(matrix) else matrix[3, :3]
    return bool(abs(np.linalg.norm(w) - 1) < ROUNDING)


def _planes(matrix: np.ndarray) -> tuple[float, float] | None:
    """World depths of the planes where clip z is −w and w; None if z and w do not grow along one axis."""
    z, w = matrix[2], matrix[3]
    length = np.linalg.norm(w[:3])
    if not length or np.linalg.norm(np.cross(z[:3], w[:3])) > ROUNDING * np.linalg.norm(z[:3]) * length:
        return None
    slope = z[:3] @ w[:3] / length**2
    offset = z[3] - slope * w[3]

    def depth(sign: int) -> float:
        infinite = abs(slope - sign) <= 1e-6
        return math.inf if infinite else float(-offset / (slope - sign) / length)

    return depth(-1), depth(1)


def _is_other_order(matrix: np.ndarray) -> bool:
    """True if a matrix may be `view @ projection` with a perspective projection."""
    columns = matrix[:, [0, 1, 3]]
    products = columns[:3].T @ columns[:3]
    lengths = np.sqrt(np.diag(products))
    orthogonal = np.abs(products - np.diag(lengths**2)) <= ROUNDING * np.outer(lengths, lengths)
    return bool((np.abs(columns[3]) <= ROUNDING * np.abs(matrix[3, 2])).all() and orthogonal.all())


def is_affine(matrix: np.ndarray) -> bool:
    """True for a (3, 4) matrix, and for a (4, 4) one whose last row is (0, 0, 0, 1)."""
    return matrix.shape[0] == 3 or bool(np.abs(matrix[3] - [0, 0, 0, 1]).max() <= ROUNDING)


def in_one_engine(view: Array, projection: Array) -> tuple[Array, Array]:
    """View and projection in one engine; if only one is a constant, in the other's dtype, too."""
    _, (view, projection) = promote(view, projection)
    return view, projection
