"""Cameras from and to the conventions of other libraries: OpenCV, OpenGL, nvdiffrast, PyTorch3D and Blender."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from rts.arrays.argument_checks import (
    check_numbers,
    check_pixels,
    check_planes,
    check_positive,
    check_rotation,
    is_invertible,
)
from rts.arrays.array_functions import promote
from rts.arrays.engines import is_constant, namespace, uncompiled, value_of
from rts.arrays.trees import Array
from rts.errors import InputError
from rts.operations.linear import matmul
from rts.operations.unit import unit
from rts.scene.transforms import (
    ROUNDING,
    affine_matrix,
    check_product,
    in_one_engine,
    is_affine,
    is_parallel_product,
    matrix_of,
    perspective,
    scaled_rows,
)


class CameraConverters:
    """Base of `Camera`: constructors from matrices of other libraries, and the matrices that these take."""

    view: Array
    projection: Array

    if TYPE_CHECKING:

        def __init__(self, view: Array, projection: Array, aspect: float | None = None): ...
        def __iter__(self) -> Iterator[Array]: ...
        def for_size(self, size: tuple[int, int]) -> Any: ...  # noqa: D102
        def _flipped(self) -> Any: ...

    @classmethod
    @uncompiled
    def from_opencv(
        cls,
        K: Any,
        R: Any,
        t: Any,
        size: tuple[int, int],
        *,
        near: Any = 0.01,
        far: Any = 1e6,
        pixel_center: float = 0.0,
    ) -> Self:
        """A camera from OpenCV's x = K (R X + t): camera axes x right, y down, z forward.

        Args:
            K: (3, 3) intrinsics, pixels; skew is kept.
            R: (3, 3) rotation, camera-from-world.
            t: (3,) translation, or (3, 1), world units.
            size: (height, width).
            near: depth of the near plane, positive.
            far: depth of the far plane.
            pixel_center: where K puts the centre of the first pixel: 0 in OpenCV, 0.5 in COLMAP and most data sets
                whose principal point is exactly (width / 2, height / 2).

        Raises:
            InputError: K is no matrix of intrinsics, or in units of the image, not in pixels; R is no rotation, planes
                are out of order, or `t` or `size` is wrong.
        """
        check_planes(near, far, positive=True)
        _check_intrinsics(K)
        check_rotation("R", R)
        check_numbers("t", t, (3,), (3, 1))
        check_numbers("pixel_center", pixel_center, ())
        height, width = check_pixels(size)
        _check_in_pixels(K, (height, width))
        xp, (K, R, t, near, far) = promote(K, R, t, near, far)
        view = scaled_rows(affine_matrix(R, xp.reshape(t, (3,))), (1, -1, -1, 1))
        cx, cy = K[0, 2] + (0.5 - pixel_center), K[1, 2] + (0.5 - pixel_center)
        depth = far - near
        projection = matrix_of(
            xp,
            [
                [2 * K[0, 0] / width, -2 * K[0, 1] / width, 1 - 2 * cx / width, 0],
                [0, 2 * K[1, 1] / height, 2 * cy / height - 1, 0],
                [0, 0, -(far + near) / depth, -2 * far * near / depth],
                [0, 0, -1, 0],
            ],
            cx,
        )
        return cls(view, projection, width / height)

    @classmethod
    @uncompiled
    def from_mvp(cls, matrix: Any) -> Self:
        """A camera from one matrix: model-view-projection, the product that takes the world to clip space.

        For users of nvdiffrast and diffren, which take vertices in clip space: give vertices in the world, and the
        matrix that took them to clip space. The image is the same. Depth is linear, in units of the world, if the
        matrix is the product of any projection, perspective or parallel, and of a view that does not scale.

        A matrix that is transposed (for row vectors), or multiplied in the other order, is refused where it shows. It
        does not show in a view without rotation, or of rotation alone. Depths from 0 to 1, as in Direct3D and Vulkan,
        are read as those of a near plane at about half its depth; pictures are the same. Depths from 1 to 0 are
        refused. A traced matrix is not checked, and taken for perspective.

        Args:
            matrix: (4, 4) OpenGL clip space from world space, acting on column vectors; `projection @ view`.

        Raises:
            InputError: the matrix is singular, transposed, in the other order, or has a plane behind the camera.
        """
        value = check_numbers("matrix", matrix, (4, 4))
        if value is not None and not is_invertible(value):
            raise InputError("matrix is singular; expected an invertible product projection @ view")
        if value is not None:
            check_product(value)
        xp, (m,) = promote(matrix)
        x, y, z, w = (m[i, :3] for i in range(4))
        parallel = value is not None and is_parallel_product(value)
        if parallel:  # Depth grows along the rays, from the near plane on.
            along = xp.linalg.cross(x, y)
            axis, start = unit(along * xp.sign(xp.sum(along * z))), m[2, :] + m[3, :]
        else:
            axis, start = unit(w), m[3, :]
        rows = xp.stack([m[0, :], m[1, :], start])
        eye = -matmul(xp.linalg.inv(rows[:, :3]), rows[:, 3:])
        right = unit(x - axis * xp.sum(axis * x))
        linear = xp.stack([right, xp.linalg.cross(right, axis), -axis])
        view = affine_matrix(linear, -matmul(linear, eye)[:, 0])
        projection = matmul(m, affine_matrix(xp.linalg.matrix_transpose(linear), eye[:, 0]))
        # The last row, without its rounding.
        last = [[0, 0, 0, m[3, 3]]] if parallel else [[0, 0, -xp.sum(axis * w), 0]]
        return cls(view, xp.concat([projection[:3, :], matrix_of(xp, last, m[3, 3])]))

    @classmethod
    @uncompiled
    def from_opengl(cls, modelview: Any, projection: Any) -> Self:
        """A camera from OpenGL's matrices, which have the conventions of this library.

        Args:
            modelview: (4, 4) camera-from-world.
            projection: (4, 4) clip space from camera space.

        Raises:
            InputError: a matrix has another shape, or is not finite.
        """
        check_numbers("modelview", modelview, (4, 4))
        check_numbers("projection", projection, (4, 4))
        _, (view, projection) = promote(modelview, projection)
        return cls(view, projection)

    @classmethod
    @uncompiled
    def from_nvdiffrast(cls, modelview: Any, projection: Any, *, top_down: bool = False) -> Self:
        """A camera from the matrices whose product feeds `nvdiffrast`.

        nvdiffrast's row 0 is NDC y = −1, the bottom. With plain OpenGL matrices its image is ours upside down. The
        matrices stay unchanged unless `top_down`.

        Args:
            modelview: (4, 4) camera-from-world.
            projection: (4, 4) clip space from camera space.
            top_down: whether the projection has its y negated, so that nvdiffrast's row 0 is the top already.
        """
        camera = cls.from_opengl(modelview, projection)
        return camera._flipped() if top_down else camera

    @classmethod
    @uncompiled
    def from_pytorch3d(
        cls,
        R: Any,
        T: Any,
        *,
        focal_length: Any,
        principal_point: Any = (0.0, 0.0),
        size: tuple[int, int],
        near: Any = 0.01,
        far: Any = 1e6,
    ) -> Self:
        """A camera from PyTorch3D's `PerspectiveCameras` in NDC, whose x is left, y up and z forward.

        Points are row vectors: X_camera = X R + T.

        Args:
            R: (3, 3), acting on row vectors.
            T: (3,) translation, world units.
            focal_length: number or (2,), NDC; 1 / tan(fov / 2) of a `FoVPerspectiveCameras`.
            principal_point: (2,) NDC, x left and y up; the shorter side of the image spans [−1, 1].
            size: (height, width).
            near: depth of the near plane, positive.
            far: depth of the far plane.

        Raises:
            InputError: R is no rotation, a focal length is not positive, planes are out of order, or another argument
                has a wrong shape.
        """
        check_planes(near, far, positive=True)
        check_rotation("R", R)
        check_numbers("T", T, (3,))
        check_positive("focal_length", focal_length, (), (1,), (2,))
        check_numbers("principal_point", principal_point, (2,))
        height, width = check_pixels(size)
        xp, (R, T, focal, point, near, far) = promote(R, T, focal_length, principal_point, near, far)
        sx, sy = min(height, width) / width, min(height, width) / height
        focal = focal + xp.zeros_like(point)
        view = scaled_rows(affine_matrix(xp.linalg.matrix_transpose(R), T), (-1, 1, -1, 1))
        depth = far - near
        projection = matrix_of(
            xp,
            [
                [focal[0] * sx, 0, point[0] * sx, 0],
                [0, focal[1] * sy, -point[1] * sy, 0],
                [0, 0, -(far + near) / depth, -2 * far * near / depth],
                [0, 0, -1, 0],
            ],
            far,
        )
        return cls(view, projection, width / height)

    @classmethod
    @uncompiled
    def from_blender(
        cls, camera_to_world: Any, size: tuple[int, int], *, focal: Any, near: Any = 0.01, far: Any = 1e6
    ) -> Self:
        """A camera from the camera-to-world matrix of Blender and of NeRF's data sets; their camera axes are ours.

        Args:
            camera_to_world: (4, 4) or (3, 4).
            size: (height, width).
            focal: focal length, pixels: 0.5 width / tan(0.5 camera_angle_x).
            near: depth of the near plane, positive.
            far: depth of the far plane.

        Raises:
            InputError: the matrix is singular or not affine, `focal` is not positive, planes are out of order, or
                `size` is wrong.
        """
        value = check_numbers("camera_to_world", camera_to_world, (4, 4), (3, 4))
        if value is not None and not (is_affine(value) and is_invertible(value[:3, :3])):
            raise InputError(
                "camera_to_world is singular, or its last row is not (0, 0, 0, 1); expected a rotation and a position"
            )
        check_positive("focal", focal)
        height, width = check_pixels(size)
        xp, (c2w, focal) = promote(camera_to_world, focal)
        c2w = affine_matrix(c2w[:3, :3], c2w[:3, 3])
        fov_y = xp.atan(height / (2 * focal)) * (360 / math.pi)
        fov_y = fov_y if not is_constant(fov_y) else float(fov_y)
        return cls(*in_one_engine(xp.linalg.inv(c2w), perspective(fov_y, width / height, near, far)), width / height)

    def to_opencv(self, size: tuple[int, int], *, pixel_center: float = 0.0) -> tuple[Array, Array, Array]:
        """OpenCV's K (3, 3), R (3, 3) and t (3,) of a perspective camera; arguments are as in `from_opencv`.

        Raises:
            InputError: the camera is orthographic, or `size` is wrong.
        """
        xp, p = self._perspective("to_opencv", size)
        height, width = size
        scale = -1 / p[3, 2]
        shift = pixel_center - 0.5
        K = matrix_of(
            xp,
            [
                [
                    p[0, 0] * scale * width / 2,
                    -p[0, 1] * scale * width / 2,
                    (1 - p[0, 2] * scale) * width / 2 + shift,
                ],
                [0, p[1, 1] * scale * height / 2, (1 + p[1, 2] * scale) * height / 2 + shift],
                [0, 0, 1],
            ],
            scale,
        )
        view = scaled_rows(self.view, (1, -1, -1, 1))
        return K, view[:3, :3], view[:3, 3]

    def to_opengl(self, size: tuple[int, int] | None = None) -> tuple[Array, Array]:
        """OpenGL's modelview and projection, (4, 4) each: the camera's own matrices.

        Args:
            size: (height, width) of the image; needed where the camera leaves its ratio open.

        Raises:
            InputError: the ratio is open, and there is no size.
        """
        view, projection = self if size is None else self.for_size(size)
        return view, projection

    def to_nvdiffrast(self, *, top_down: bool = False, size: tuple[int, int] | None = None) -> tuple[Array, Array]:
        """Matrices (modelview, projection), (4, 4) each, for nvdiffrast; multiply projection @ modelview.

        Args:
            top_down: whether row 0 of nvdiffrast's image is to be the top, as in this library: y of the projection is
                then negated. Otherwise the matrices are the camera's own, and nvdiffrast's image is ours upside down.
            size: as in `to_opengl`.

        Raises:
            InputError: the ratio is open, and there is no size.
        """
        camera = self if size is None else self.for_size(size)
        return (camera._flipped() if top_down else camera).to_opengl()

    def to_pytorch3d(self, size: tuple[int, int]) -> tuple[Array, Array, Array, Array]:
        """PyTorch3D's R (3, 3), T (3,), focal_length (2,) and principal_point (2,); the inverse of `from_pytorch3d`.

        Raises:
            InputError: the camera is orthographic, or `size`, (height, width), is wrong.
        """
        xp, p = self._perspective("to_pytorch3d", size)
        sx, sy, scale = min(size) / size[1], min(size) / size[0], -1 / p[3, 2]
        view = scaled_rows(self.view, (-1, 1, -1, 1))
        focal = xp.stack([p[0, 0] / sx, p[1, 1] / sy]) * scale
        return (
            xp.linalg.matrix_transpose(view[:3, :3]),
            view[:3, 3],
            focal,
            xp.stack([p[0, 2] / sx, -p[1, 2] / sy]) * scale,
        )

    def to_blender(self, size: tuple[int, int]) -> tuple[Array, Array]:
        """Blender's camera-to-world matrix (4, 4), and the focal length in pixels; the inverse of `from_blender`.

        Raises:
            InputError: the camera is orthographic, or `size`, (height, width), is wrong.
        """
        _, p = self._perspective("to_blender", size)
        return namespace(self.view).linalg.inv(self.view), p[1, 1] * size[0] / 2

    def _perspective(self, converter: str, size: tuple[int, int]) -> tuple[Any, Array]:
        """Namespace and projection for a size. Cameras known to be orthographic are refused."""
        height, width = check_pixels(size)
        projection = self.for_size((height, width)).projection
        last = value_of(projection[3, 2])
        if last is not None and (last == 0).any():
            raise InputError(f"the camera is orthographic; {converter} needs a perspective one")
        return namespace(projection), projection


def _check_intrinsics(K: Any) -> None:
    value = check_numbers("K", K, (3, 3))
    if value is None:
        return
    rest = np.abs(value[[1, 2, 2, 2], [0, 0, 1, 2]] - [0, 0, 0, 1])
    if rest.max() > ROUNDING or min(value[0, 0], value[1, 1]) <= 0:
        raise InputError(
            f"K is {value.tolist()}; expected [[fx, skew, cx], [0, fy, cy], [0, 0, 1]] in pixels, with positive fx and "
            f"fy"
        )


NORMALISED = 0.1
"""Focal lengths below this share of the image, with a principal point in the first pixels, are not in pixels."""


def _check_in_pixels(K: Any, size: tuple[int, int]) -> None:
    """Refuse known intrinsics that seem to be in units of the image, whose width and height are 1."""
    value, (height, width) = value_of(K), size
    if value is None or value.shape != (3, 3):
        return
    point, focal = value[:2, 2], (value[0, 0] / width, value[1, 1] / height)
    if max(focal) < NORMALISED and (point >= 0).all() and (point <= 2).all():
        raise InputError(
            f"K looks normalised, in units of the image: fx = {value[0, 0]:.4g}, fy = {value[1, 1]:.4g}, cx = "
            f"{point[0]:.4g}, cy = {point[1]:.4g} for an image of {width} x {height} pixels; expected pixels: multiply "
            f"its first row by the width and its second by the height, np.diag([{width}, {height}, 1]) @ K, with "
            f"pixel_center=0.5"
        )
