"""Normalised device coordinates of forward-facing scenes, in which their radiance fields are trained.

A camera at the origin that looks along −z sees the world beyond its near plane; NDC bring that into the cube [−1, 1]³,
infinity to z = 1 (Mildenhall et al. 2020, appendix C). Straight lines stay straight.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from rts.arrays.argument_checks import check_pixels, check_positive
from rts.arrays.array_functions import described, from_numbers, shape_of
from rts.arrays.engines import constants, context_of, namespace
from rts.arrays.trees import Array
from rts.errors import InputError

NEAREST, FARTHEST = 1e-6, 1e6
"""Depths, over that of the near plane, to which points behind the camera and at infinity are brought."""


@dataclass(frozen=True)
class Ndc:
    """The map between the world and NDC; NumPy, torch and jax, differentiable.

    Attributes:
        scale: (x, y), focal length over half the width and half the height of the image.
        near: depth of the near plane, 1 in the frame of NeRF's forward-facing scenes (`rts.load_views(frame="nerf")`).
    """

    scale: tuple[float, float]
    near: float = 1.0

    def __post_init__(self):
        check_positive("scale", self.scale, (2,))
        check_positive("near", self.near)

    @classmethod
    def of_images(cls, size: tuple[int, int], focal: float, near: float = 1.0) -> Ndc:
        """NDC of images of a size (height, width) and a focal length in their pixels.

        Raises:
            InputError: no positive numbers.
        """
        height, width = check_pixels(size)
        check_positive("focal", focal)
        check_positive("near", near)
        return cls((2 * float(focal) / width, 2 * float(focal) / height), float(near))

    def from_world(self, points: Array) -> Array:
        """NDC (N, 3) of world points (N, 3); those behind the camera as if they were just before it."""
        points = _checked("points", points)
        xp = namespace(points)
        depth = _at_least(-points[:, 2], NEAREST * self.near)
        x, y = (s * points[:, i] / depth for i, s in enumerate(self.scale))
        return xp.stack([x, y, 1 - 2 * self.near / depth], axis=1)

    def to_world(self, points: Array) -> Array:
        """World points (N, 3) of NDC (N, 3); those at infinity and beyond at a depth of a million near planes."""
        points = _checked("points", points)
        xp = namespace(points)
        depth = 2 * self.near / _at_least(1 - points[:, 2], 2 / FARTHEST)
        x, y = (points[:, i] * depth / s for i, s in enumerate(self.scale))
        return xp.stack([x, y, -depth], axis=1)

    def rays(self, origins: Array, directions: Array) -> tuple[Array, Array]:
        """Rays in NDC of world rays: t = 0 at the near plane, t = 1 at infinity.

        Args:
            origins: (N, 3) world, before or behind the near plane.
            directions: (N, 3) world, towards −z, of any length.

        Returns:
            Origins and directions, (N, 3) each; equal steps of t are equal steps of disparity.
        """
        origins, directions = _checked("origins", origins), _checked("directions", directions)
        if origins.shape != directions.shape:
            raise InputError(f"origins {described(origins)} and directions {described(directions)}; expected one shape")
        engine, like = context_of(origins, directions)
        origins, directions = constants((origins, directions), engine, like)
        xp = engine.namespace
        at_near = origins - directions * ((self.near + origins[:, 2:]) / directions[:, 2:])
        start = self.from_world(at_near)
        x, y = (-s * directions[:, i] / directions[:, 2] for i, s in enumerate(self.scale))
        return start, xp.stack([x, y, xp.ones_like(x)], axis=1) - start


def _checked(name: str, points: Any) -> Array:
    """Rows of three numbers, refused where they are something else."""
    points = from_numbers(points, name)
    if len(shape_of(points)) != 2 or points.shape[1] != 3:
        raise InputError(f"{name} {described(points)}; expected (N, 3)")
    return points


def _at_least(x: Array, low: float) -> Array:
    xp = namespace(x)
    return xp.maximum(x, low * xp.ones_like(x[:1]))
