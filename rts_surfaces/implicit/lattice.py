"""Lattices: points at equal distances along three axes, numbered."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from rts import InputError, namespace
from rts.plugin_api.arrays import Array
from rts.plugin_api.checks import check_numbers, is_count, quoted

MOST_POINTS = 2**31 - 1
"""The largest number of points, which int32 must number."""


class Spacing(NamedTuple):
    """How the points of a lattice lie; hashable.

    Attributes:
        shape: (X, Y, Z).
        low: the first point.
        step: the distance of neighbours along each axis.
    """

    shape: tuple[int, ...]
    low: tuple[float, ...]
    step: tuple[float, ...]


class Interpolated(NamedTuple):
    """A field between the points of a lattice, as compiled loops take it.

    Attributes:
        values: (M,), of all lattice points, indexed by number, or of a band's points, indexed by row.
        isovalue: see `marching_cubes.of_lattice`.
        sign: see `marching_cubes.of_lattice`.
        capped: whether the surface is closed at the bounds.
        lattice: how its points lie.
    """

    values: np.ndarray
    isovalue: float
    sign: float
    capped: bool
    lattice: Spacing


class Lattice:
    """X × Y × Z points from one corner of a box to the opposite one. Point (x, y, z) has the number (x Y + y) Z + z.

    Args:
        bounds: two corners ((x0, y0, z0), (x1, y1, z1)) of the box, the lower one first.
        shape: (X, Y, Z), at least 2 each, at most `MOST_POINTS` in all.

    Attributes:
        shape: (X, Y, Z).
        low: (3,) float64, the first point.
        step: (3,) float64, the distance of neighbours along each axis.

    Raises:
        InputError: bounds that are traced, not finite, or not lower in each coordinate of the first; a wrong shape.
    """

    def __init__(self, bounds: Any, shape: Any):
        self.low, high = check_bounds(bounds)
        self.shape = check_shape(shape)
        self.step = (high - self.low) / (np.array(self.shape) - 1)

    @classmethod
    def of(cls, shape: tuple[int, ...], low: tuple[float, ...], step: tuple[float, ...]) -> Lattice:
        """The lattice with these attributes, in the form that `fixed` returns; unchecked."""
        self = cls.__new__(cls)
        self.shape, self.low, self.step = shape, np.array(low), np.array(step)
        return self

    def of_shape(self, shape: tuple[int, ...]) -> Lattice:
        """A lattice of another shape, checked, with the same first and last point."""
        extent = self.step * (np.array(self.shape) - 1)
        return Lattice((self.low, self.low + extent), shape)

    @property
    def fixed(self) -> Spacing:
        """Shape, first point and step, as Python's numbers."""
        return Spacing(self.shape, tuple(self.low.tolist()), tuple(self.step.tolist()))

    @property
    def count(self) -> int:
        """The number of points."""
        x, y, z = self.shape
        return x * y * z

    def points(self, numbers: np.ndarray) -> np.ndarray:
        """The coordinates (M, 3) float64 of the points with these numbers (M,)."""
        return self.low + self.step * np.stack(np.unravel_index(numbers, self.shape), axis=-1)

    def places(self, numbers: Array, dtype: Any) -> Array:
        """The coordinates (M, 3), in `dtype`, of the points with these numbers (M,) int32, in array code."""
        xp = namespace(numbers)
        _, y, z = self.shape
        steps = numbers // (y * z), numbers // z % y, numbers % z
        low, step = self.low.tolist(), self.step.tolist()
        return xp.stack([low[i] + step[i] * xp.astype(steps[i], dtype) for i in range(3)], axis=-1)


def check_bounds(bounds: Any) -> tuple[np.ndarray, np.ndarray]:
    """The lower and the upper corner (3,) float64 of a box, from two rows of three finite numbers.

    Raises:
        InputError: bounds of another shape, traced ones, or a coordinate of the first corner that is not lower.
    """
    known = check_numbers("bounds", bounds, (2, 3))
    if known is None:
        raise InputError("bounds are traced; expected known numbers ((x0, y0, z0), (x1, y1, z1))")
    low, high = np.asarray(known, np.float64)
    if not (low < high).all():
        raise InputError(f"bounds are {quoted(bounds)}; expected ((x0, y0, z0), (x1, y1, z1)) with each x0 < x1")
    return low, high


def check_shape(shape: Any) -> tuple[int, int, int]:
    """(X, Y, Z) as Python's integers; an InputError unless each is at least 2, and their product ≤ `MOST_POINTS`."""
    try:
        counts = () if isinstance(shape, (str, bytes)) else tuple(shape)
    except TypeError:
        counts = ()
    if len(counts) != 3 or not all(is_count(n) and n >= 2 for n in counts):
        raise InputError(
            f"the lattice has shape {quoted(shape)}; expected (X, Y, Z), at least 2 points along each axis"
        )
    x, y, z = (int(n) for n in counts)
    if x * y * z > MOST_POINTS:
        raise InputError(f"a lattice has {x} × {y} × {z} points; expected at most 2**31 − 1, 1290 along each axis")
    return x, y, z
