"""Cameras, and the conventions of space that hold everywhere.

- The world is right-handed. `view` maps world to camera space; the camera looks along −z with +y up and +x right, as in
  OpenGL. `projection` maps camera space to OpenGL clip space: NDC x right, y up, z from −1 (near) to 1 (far).
- Image row 0 is on top; the centre of pixel (x, y) is (x + 0.5, y + 0.5). `size` is (height, width) everywhere.
- Depth is linear: the distance along the camera's axis, −z in camera space.

Matrices act on column vectors. Constructors such as `Camera.look_at` are differentiable in their arguments: give torch
or jax arrays, and the camera's matrices are of that kind; give numbers or NumPy arrays, and they are float64 NumPy.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from numbers import Real
from typing import Any, Literal

import numpy as np

from rts.arrays.argument_checks import check_numbers, check_pixels, is_invertible, quoted
from rts.arrays.array_functions import described, from_numbers, promote, shape_of
from rts.arrays.engines import engine_of, is_constant, load_engines, namespace, uncompiled, value_of
from rts.arrays.trees import Array, map_leaves, record
from rts.errors import InputError
from rts.operations.linear import affine, affine_map, matmul
from rts.operations.projection import projective_map
from rts.operations.unit import unit
from rts.scene.camera_converters import CameraConverters
from rts.scene.rays import Rays
from rts.scene.transforms import (
    determinant,
    in_one_engine,
    is_affine,
    look_at,
    orthographic,
    perspective,
    scaled_rows,
    warn_of_radians,
)

NEAR_OVER_DISTANCE = 1e-2
FAR_OVER_DISTANCE = 1e6
"""So far that a floor seems to reach the horizon: nothing is lost by it, as no sampler rounds depths between planes."""


@record(static=("aspect",))
class Camera(CameraConverters):
    """A camera: two matrices, and the ratio of width to height that they are made for.

    `Camera(view, projection)` takes matrices as they are. Linear depth is read off `view`, so the product of both
    matrices, as used for nvdiffrast, is no `projection`: `Camera.from_mvp` factors it.

    Attributes:
        view: (4, 4) camera-from-world, affine.
        projection: (4, 4) OpenGL clip space from camera space; its last row is (0, 0, ±c, d).
        aspect: width over height of the image that the projection is for. "open" if it is for a square image, and is
            to be widened by `for_size`. None if unknown.
    """

    view: Array
    projection: Array
    aspect: float | Literal["open"] | None = None

    def __post_init__(self):
        load_engines()  # So that cameras may be arguments of their transforms.

    def __iter__(self) -> Iterator[Array]:
        """View and projection, for `view, projection = camera`; refused while `aspect` is "open"."""
        self._check_closed("unpacked")
        return iter((self.view, self.projection))

    def __eq__(self, other: Any) -> bool:
        """True if both cameras have matrices of equal values, and the same ratio; traced ones equal only themselves."""
        if not isinstance(other, Camera):
            return NotImplemented
        pairs = (self.view, other.view), (self.projection, other.projection)
        return self.aspect == other.aspect and all(a is b or _equal(a, b) for a, b in pairs)

    __hash__ = None  # pyright: ignore[reportAssignmentType]  # Arrays change.

    def replace(self, **changes: Any) -> Camera:
        """A copy with some fields changed."""
        if not changes.keys() <= self.__dict__.keys():
            raise TypeError(f"a camera has the fields {', '.join(self.__dict__)}, not {', '.join(changes)}")
        camera = object.__new__(Camera)  # Skips __init__: cameras are copied often, and these fields are checked.
        camera.__dict__.update({**self.__dict__, **changes})
        return camera

    # ------------------------------------------------------------------------------------------ several views

    @classmethod
    def stack(cls, cameras: Sequence[Camera]) -> Camera:
        """The cameras of several views as one, for `rts.render_views`: both matrices are (B, 4, 4).

        The stack is a tree of two arrays, as any camera: `jax.vmap` and `torch.vmap` map over its views.
        `unstack()[b]` is the camera of view b, but for ratios that differ from view to view: they become None.

        Args:
            cameras: at least one, each of one view.

        Raises:
            InputError: no list of cameras of one view each, or some leave the ratio of width to height open, and some
                do not.
        """
        cameras = list(cameras) if isinstance(cameras, (list, tuple)) else []
        if not cameras or not all(isinstance(camera, Camera) and not camera.is_stacked for camera in cameras):
            raise InputError("Camera.stack was not given a list of cameras of one view each")
        aspects: set[Any] = {camera.aspect for camera in cameras}
        if "open" in aspects and len(aspects) > 1:
            raise InputError(
                "some cameras know their ratio of width to height and some leave it open; call "
                "for_size((height, width)) of each first"
            )
        xp, both = promote(*(m for camera in cameras for m in (camera.view, camera.projection)))
        return cls(xp.stack(both[::2]), xp.stack(both[1::2]), aspects.pop() if len(aspects) == 1 else None)

    def unstack(self) -> list[Camera]:
        """The cameras of the single views of a stack. A matrix of shape (4, 4) is shared by all views.

        Raises:
            InputError: this is a camera of one view, or the matrices have other shapes.
        """
        shapes = [shape_of(m) for m in (self.view, self.projection)]
        counts = {shape[0] for shape in shapes if len(shape) == 3}
        if len(counts) != 1 or 0 in counts or any(shape[-2:] != (4, 4) or len(shape) > 3 for shape in shapes):
            raise InputError(f"view and projection have shapes {shapes[0]} and {shapes[1]}; expected (B, 4, 4)")
        return [self.map(lambda m, b=b: m[b, ...] if len(shape_of(m)) == 3 else m) for b in range(counts.pop())]

    @property
    def is_stacked(self) -> bool:
        """True for a camera of several views."""
        return 3 in (getattr(self.view, "ndim", 0), getattr(self.projection, "ndim", 0))

    # ---------------------------------------------------------------------------------------- constructors

    @classmethod
    @uncompiled
    def look_at(
        cls,
        eye: Any,
        target: Any,
        up: Any = (0.0, 1.0, 0.0),
        *,
        fov_y: Any = 45.0,
        aspect: Any = None,
        near: Any = None,
        far: Any = None,
        principal_point: Any = (0.0, 0.0),
    ) -> Camera:
        """A perspective camera at `eye` that faces `target`.

        Args:
            eye: (3,) world.
            target: (3,) world.
            up: (3,) direction that is up in the image. Where the camera looks along it, +x is to the right instead.
            fov_y: vertical field of view, degrees.
            aspect: width over height of the image; None for the ratio of the rendered size.
            near: depth of the near plane; default 1/100 of the distance to the target.
            far: depth of the far plane; default a million times the distance to the target.
            principal_point: (2,) where the axis meets the image, NDC.

        Raises:
            InputError: eye and target coincide, `up` is zero, an angle or ratio makes no image, planes are out of
                order, or an argument has another shape or is not finite.

        Warns:
            InputWarning: a field of view that is likely to be in radians: from 0.3 to 2, or that of whole degrees.
        """
        view = look_at(eye, target, up)
        if near is None or far is None:
            xp, (eye, target) = promote(eye, target)
            distance = xp.sqrt(xp.sum((eye - target) ** 2))
            near = NEAR_OVER_DISTANCE * distance if near is None else near
            far = FAR_OVER_DISTANCE * distance if far is None else far
        projection = perspective(fov_y, 1.0 if aspect is None else aspect, near, far, principal_point)
        warn_of_radians(fov_y)
        return cls(*in_one_engine(view, projection), _known_ratio(aspect))

    @classmethod
    @uncompiled
    def perspective(
        cls,
        fov_y: Any = 45.0,
        *,
        view: Any = None,
        aspect: Any = None,
        near: Any = 0.01,
        far: Any = 1e6,
        principal_point: Any = (0.0, 0.0),
    ) -> Camera:
        """A perspective camera whose pose is a matrix; without one it is at the origin and looks along −z, +y up.

        The default suits objects whose pose is relative to the camera: they lie at negative z.

        Args:
            fov_y: vertical field of view, degrees.
            view: (4, 4) camera-from-world, affine; None for the identity.
            aspect: width over height of the image; None for the ratio of the rendered size.
            near: depth of the near plane, positive.
            far: depth of the far plane.
            principal_point: (2,) where the axis meets the image, NDC.

        Raises:
            InputError: a field of view, ratio or view makes no image, planes are out of order, or an argument has
                another shape or is not finite.

        Warns:
            InputWarning: a field of view that is likely to be in radians: from 0.3 to 2, or that of whole degrees.
        """
        value = None if view is None else check_numbers("view", view, (4, 4))
        if value is not None and not (is_affine(value) and is_invertible(value[:3, :3])):
            raise InputError("view is singular, or its last row is not (0, 0, 0, 1); expected a camera-from-world map")
        _, (view,) = promote(np.eye(4) if view is None else view)
        projection = perspective(fov_y, 1.0 if aspect is None else aspect, near, far, principal_point)
        warn_of_radians(fov_y)
        return cls(*in_one_engine(view, projection), _known_ratio(aspect))

    @classmethod
    @uncompiled
    def orthographic(
        cls,
        eye: Any,
        target: Any,
        up: Any = (0.0, 1.0, 0.0),
        *,
        height: Any,
        aspect: Any = None,
        near: Any = 0.0,
        far: Any = 100.0,
        principal_point: Any = (0.0, 0.0),
    ) -> Camera:
        """An orthographic camera at `eye` that faces `target`.

        Args:
            eye: (3,) world.
            target: (3,) world.
            up: (3,) direction that is up in the image. Where the camera looks along it, +x is to the right instead.
            height: extent of the image from bottom to top, world units.
            aspect: width over height of the image; None for the ratio of the rendered size.
            near: depth of the near plane; may be negative.
            far: depth of the far plane.
            principal_point: (2,) where the axis meets the image, NDC.

        Raises:
            InputError: eye and target coincide, `up` is zero, a height or ratio makes no image, planes are out of
                order, or an argument has another shape or is not finite.
        """
        view = look_at(eye, target, up)
        projection = orthographic(height, 1.0 if aspect is None else aspect, near, far, principal_point)
        return cls(*in_one_engine(view, projection), _known_ratio(aspect))

    # ----------------------------------------------------------------------------------------------- use

    def for_size(self, size: tuple[int, int]) -> Camera:
        """The camera for images of a size (height, width): itself, or a copy of that ratio if `aspect` is "open"."""
        aspect, projection = self.aspect, self.projection
        if aspect is None or type(aspect) is float or (type(aspect) is not str and isinstance(aspect, Real)):
            return self
        if not (isinstance(aspect, str) and aspect == "open"):
            raise InputError(f"aspect is {quoted(aspect)}; expected width over height, 'open' or None")
        height, width = check_pixels(size)
        aspect, known = width / height, type(projection) is np.ndarray
        columns = np.array([1 / aspect, 1, 1, 1], projection.dtype if known else None)
        columns = columns if known else engine_of(projection).constant(columns, projection)
        return self.replace(projection=projection * columns, aspect=aspect)

    def map(self, f: Callable[[Array], Array]) -> Camera:
        """A copy with `f` applied to both matrices."""
        return map_leaves(f, self)

    def within(self, transform: Array | None) -> Camera:
        """This camera in the local space of a part with a world-from-local transform (4, 4); None is the identity."""
        if transform is None:
            return self
        if getattr(transform, "shape", ()) != (4, 4):
            check_numbers("transform", transform, (4, 4))
        view = self.view
        if type(view) is not type(transform) or type(view) is np.ndarray:
            _, (view, transform) = promote(view, transform)
        return self.replace(view=matmul(view, transform))

    def with_border(self, size: tuple[int, int], border: int) -> Camera:
        """The camera of the image with `border` more pixels on every side."""
        height, width = size
        return self.window(size, (-border, -border), (height + 2 * border, width + 2 * border))

    def window(self, size: tuple[int, int], corner: tuple[int, int], extent: tuple[int, int]) -> Camera:
        """The camera of a rectangle of the image, which may reach beyond it.

        Args:
            size: (height, width) of the image, pixels.
            corner: (top, left) of the window in the image, pixels.
            extent: (height, width) of the window, pixels.
        """
        (height, width), (top, left), (rows, columns) = size, corner, extent
        self = self.for_size(size)
        change = np.array(
            [
                [width / columns, 0, 0, (width - 2 * left) / columns - 1],
                [0, height / rows, 0, 1 - (height - 2 * top) / rows],
                [0, 0, 1, 0],
                [0, 0, 0, 1],
            ]
        )
        aspect = self.aspect
        if isinstance(aspect, float):
            aspect *= (columns * height) / (rows * width)
        return self.replace(projection=matmul(change, self.projection), aspect=aspect)

    def project(self, points: Array, size: tuple[int, int]) -> Array:
        """Pixel x, pixel y and linear depth of world points.

        Args:
            points: (N, 3) world.
            size: (height, width).

        Returns:
            (N, 3). Points on the plane of the camera's centre have no image; their values are finite.

        Raises:
            InputError: another shape of points, or a wrong size.
        """
        size, points = check_pixels(size), from_numbers(points, "points")
        if shape_of(points)[-1:] != (3,):
            raise InputError(f"points {described(points)}; expected (N, 3)")
        return projective_map(self.pixel_rows(size), points)

    def pixel_rows(self, size: tuple[int, int]) -> Array:
        """Four affine maps (4, 4) of world points: pixel x times clip w, pixel y times w, w, and linear depth."""
        (x, y), p = (size[1] / 2, size[0] / 2), self.for_size(size).projection
        from_clip = np.array([[x, 0, 0, x], [0, -y, 0, y], [0, 0, 0, 1], [0, 0, 0, 0]])
        depth = np.zeros((4, 4))
        depth[3, 2] = -1
        # Products of constant matrices are computed in NumPy.
        return matmul(matmul(from_clip, p) + engine_of(p).constant(depth, p), self.view)

    def toward(self, points: Array) -> Array:
        """(N, 3) world vectors from points towards the viewer, not normalised; parallel where orthographic."""
        return affine_map(toward_rows(self.view, self.projection), points)

    def depth(self, points: Array) -> Array:
        """Linear depth (...) of world points (..., 3)."""
        xp = namespace(points)
        return xp.reshape(affine_map(-self.view[2:3, :], xp.reshape(points, (-1, 3))), tuple(points.shape[:-1]))

    def to_world(self, direction: Sequence[float]) -> Array:
        """(3,) the unit vector, in the world, of a direction (3,) in camera space."""
        return world_vectors(self.view, direction)

    def kept_sign(self, cull: str) -> float:
        """Sign of the determinant on screen of the triangles that `Part.cull` keeps; 0 for both. Host matrices.

        A mirroring view, or an image upside down, reverses it.
        """
        if cull != "back":
            return 0.0
        (a, b, *_), (c, d, *_) = self.projection[:2].tolist()
        return -float(np.sign(determinant(self.view) * (a * d - b * c)))

    def turned(self) -> Camera:
        """An equivalent camera that looks along −z, for a camera that looks along +z."""
        columns = engine_of(self.projection).constant(np.array([1.0, 1, -1, 1]), self.projection)
        return self.replace(view=scaled_rows(self.view, (1, 1, -1, 1)), projection=self.projection * columns)

    def _flipped(self) -> Camera:
        """The camera of the image upside down."""
        self._check_closed("flipped")
        return self.replace(projection=scaled_rows(self.projection, (1, -1, 1, 1)))

    def _check_closed(self, what: str) -> None:
        if self.aspect == "open":
            raise InputError(
                f"a camera that leaves the ratio of width to height open cannot be {what}; call "
                f"for_size((height, width)) first, or give `aspect` to its constructor"
            )

    def depth_range(self) -> tuple[Array, Array]:
        """Linear depths () of the near and the far plane, whichever way clip z runs; infinity for a missing plane."""
        xp, (p,) = promote(self.projection)
        depths = []
        for a, b in ((p[2, 3] + p[3, 3], p[2, 2] + p[3, 2]), (p[2, 3] - p[3, 3], p[2, 2] - p[3, 2])):
            # Clip z = ∓w at the planes, with z = −depth. Rounding must not give an infinite plane a sign.
            none = xp.abs(b) <= 1e-12 * (xp.abs(p[2, 2]) + xp.abs(p[3, 2]))
            depths.append(xp.where(none, xp.ones_like(b) * math.inf, a / xp.where(none, xp.ones_like(b), b)))
        return xp.minimum(*depths), xp.maximum(*depths)

    def rays(self, size: tuple[int, int], points: Array | None = None) -> Rays:
        """Rays through pixels' centres: `origins` and `directions` (H, W, 3), world, and `spread`; differentiable.

        Args:
            size: (height, width) in pixels.
            points: (M, 2), x and y in pixels of other points to cast rays through: the result is then (M, 3). None for
                the centres.
        """
        size = check_pixels(size)
        self = self.for_size(size)
        xp, (view, p) = promote(self.view, self.projection)
        engine = engine_of(view)
        height, width = size
        if points is None:
            x = engine.constant((np.arange(width) + 0.5) * 2 / width - 1, view)[None, :]
            y = engine.constant(1 - (np.arange(height) + 0.5) * 2 / height, view)[:, None]
        else:
            at: Array = engine.constant(points, view)
            x, y = at[:, 0] * (2 / width) - 1, 1 - at[:, 1] * (2 / height)
        # A camera-space point (X, Y, −z) is seen at NDC (x, y) where two linear equations hold; Cramer's rule solves
        # them for (X, Y) = start + z step.
        a, b = p[0, 0] - x * p[3, 0], p[0, 1] - x * p[3, 1]
        c, d = p[1, 0] - y * p[3, 0], p[1, 1] - y * p[3, 1]
        determinant = a * d - b * c

        def solved(u: Array, v: Array, z: float) -> Array:
            right, up = (d * u - b * v) / determinant, (a * v - c * u) / determinant
            return xp.stack([right, up, z * xp.ones_like(right)], axis=-1)

        start = solved(x * p[3, 3] - p[0, 3], y * p[3, 3] - p[1, 3], 0.0)
        step = solved(p[0, 2] - x * p[3, 2], p[1, 2] - y * p[3, 2], -1.0)
        inverse = xp.linalg.inv(view)
        linear = xp.concat([inverse[:3, :3], xp.zeros_like(inverse[:3, :1])], axis=1)
        origins = xp.stack([affine(inverse[i, :], start) for i in range(3)], axis=-1)
        directions = xp.stack([affine(linear[i, :], step) for i in range(3)], axis=-1)
        return Rays(origins, directions, self._spread(inverse, (height, width)))

    def spread(self, size: tuple[int, int]) -> Array:
        """The `spread` (2,) of `Rays`: a pixel at depth z is `spread[0] + spread[1] * z` wide, world units."""
        return self.for_size(size)._spread(namespace(self.view).linalg.inv(self.view), size)

    def _spread(self, inverse: Array, size: tuple[int, int]) -> Array:
        """The `spread` (2,) of `Rays`; `inverse` is the inverse of the view."""
        xp, (inverse, p) = promote(inverse, self.projection)
        # A pixel at clip w spans 4 w² / (height width) of the area that the first two columns of the projection span.
        area = 4 / (size[0] * size[1] * xp.abs(p[0, 0] * p[1, 1] - p[0, 1] * p[1, 0]))
        a, b, c = (inverse[:3, i] for i in range(3))
        # If the view scales, widths are in its local units; a geometric mean if it scales axes differently.
        scale = xp.abs(xp.sum(a * xp.linalg.cross(b, c))) ** (1 / 3)
        return xp.sqrt(area) * scale * xp.stack([p[3, 3], -p[3, 2]])


def toward_rows(view: Array, projection: Array) -> Array:
    """The affine maps (…, 3, 4) from world points to `Camera.toward` there, for matrices (…, 4, 4)."""
    xp, rotation = namespace(view), view[..., :3, :3]
    at = xp.sum(rotation[..., :, :, None] * view[..., :3, None, :], axis=-3) * projection[..., 3:, 2:3]
    axis = projection[..., 3, 3:] * rotation[..., 2, :]
    return xp.concat([at[..., :3], at[..., 3:] + axis[..., None]], axis=-1)


def world_vectors(view: Array, direction: Sequence[float]) -> Array:
    """Unit vectors (…, 3) in the world of a direction (3,) in the space of cameras with these views (…, 4, 4)."""
    return unit(sum([c * view[..., i, :3] for i, c in enumerate(direction)]))


def _known_ratio(aspect: Any) -> float | Literal["open"] | None:
    """`Camera.aspect` for a constructor's `aspect`: "open" if None was given, None for an array of an engine."""
    if aspect is None:
        return "open"
    return float(aspect) if is_constant(aspect) else None


def _equal(a: Array, b: Array) -> bool:
    """True if two arrays, perhaps of two engines, have equal values; False if one is traced."""
    a, b = value_of(a), value_of(b)
    return a is not None and b is not None and np.array_equal(a, b)
