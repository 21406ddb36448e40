"""Normalised device coordinates of forward-facing data sets, in which their radiance fields are trained.

A camera at the origin that looks along −z sees the world beyond its near plane. NDC map the visible space into the cube
[−1, 1]³, infinity to z = 1 (Mildenhall et al. 2020, appendix C). Straight lines stay straight.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from rts import InputError, engine_of, namespace
from rts.plugin_api.arrays import Array, constants, exemplar, from_numbers, shape_of
from rts.plugin_api.checks import check_positive, is_count, quoted

NEAREST, FARTHEST = 1e-6, 1e6
"""Depths, in multiples of the near plane's: nearer points, such as those behind the camera, are placed at the first;
farther ones, such as those at infinity, at the second."""


@dataclass(frozen=True)
class Ndc:
    """The map between the world and NDC; NumPy, torch and jax, differentiable.

    Attributes:
        scale: (x, y), focal length over half the width and half the height of the image.
        near: depth of the near plane, 1 in the frame of NeRF's forward-facing data sets
            (`rts.load_views(frame="nerf")`).

    Raises:
        InputError: a number is not positive.
    """

    scale: tuple[float, float]
    near: float = 1.0

    def __post_init__(self):
        check_positive("scale", self.scale, (2,))
        check_positive("near", self.near)

    @classmethod
    def of_images(cls, size: tuple[int, int], focal: float, near: float = 1.0) -> Ndc:
        """NDC of images of a size (height, width) in pixels, with a focal length in pixels.

        Raises:
            InputError: an argument is not positive, or the size is not two integers.
        """
        height, width = checked_size(size)
        check_positive("focal", focal)
        check_positive("near", near)
        return cls((2 * float(focal) / width, 2 * float(focal) / height), float(near))

    def from_world(self, points: Array) -> Array:
        """NDC (N, 3) of world points (N, 3); depths less than `NEAREST` near planes count as that."""
        points = _checked("points", points)
        xp = namespace(points)
        depth = _at_least(-points[:, 2], NEAREST * self.near)
        x, y = (s * points[:, i] / depth for i, s in enumerate(self.scale))
        return xp.stack([x, y, 1 - 2 * self.near / depth], axis=1)

    def to_world(self, points: Array) -> Array:
        """World points (N, 3) of NDC (N, 3); depths of more than `FARTHEST` near planes, and z ≥ 1, count as that."""
        points = _checked("points", points)
        xp = namespace(points)
        depth = 2 * self.near / _at_least(1 - points[:, 2], 2 / FARTHEST)
        x, y = (points[:, i] * depth / s for i, s in enumerate(self.scale))
        return xp.stack([x, y, -depth], axis=1)

    def rays(self, origins: Array, directions: Array) -> tuple[Array, Array]:
        """Rays in NDC of world rays: t = 0 at the near plane, t = 1 at infinity.

        Args:
            origins: (N, 3) world, on either side of the near plane.
            directions: (N, 3) world, towards −z, of any length.

        Returns:
            Origins and directions, (N, 3) each; equal steps of t are equal steps of disparity.

        Raises:
            InputError: arrays that are not (N, 3), or of different shapes.
        """
        origins, directions = _checked("origins", origins), _checked("directions", directions)
        if origins.shape != directions.shape:
            raise InputError(
                f"origins have shape {shape_of(origins)} and directions {shape_of(directions)}; expected one shape"
            )
        engine = engine_of(origins, directions)
        origins, directions = constants((origins, directions), engine, exemplar(origins, directions))
        xp = engine.namespace
        at_near = origins - directions * ((self.near + origins[:, 2:]) / directions[:, 2:])
        start = self.from_world(at_near)
        x, y = (-s * directions[:, i] / directions[:, 2] for i, s in enumerate(self.scale))
        return start, xp.stack([x, y, xp.ones_like(x)], axis=1) - start


def checked_size(size: Any) -> tuple[int, int]:
    """(height, width) as Python's integers, from a tuple, list or array of two positive integers.

    Raises:
        InputError: the size is anything else.
    """
    sides = tuple(size) if isinstance(size, (tuple, list, np.ndarray)) else ()
    if len(sides) != 2 or not all(map(is_count, sides)):
        raise InputError(f"size is {quoted(size)}; expected (height, width), two positive integers")
    return int(sides[0]), int(sides[1])


def _checked(name: str, points: Any) -> Array:
    """The array (N, 3) of points, from an array or nested lists of numbers; an InputError for another shape."""
    points = from_numbers(points, name)
    if len(shape_of(points)) != 2 or points.shape[1] != 3:
        raise InputError(f"{name} has shape {shape_of(points)}; expected (N, 3)")
    return points


def _at_least(x: Array, low: float) -> Array:
    xp = namespace(x)
    return xp.maximum(x, low * xp.ones_like(x[:1]))
