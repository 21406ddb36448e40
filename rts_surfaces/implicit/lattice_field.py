"""The field of values on a lattice, interpolated linearly along each axis."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import partial
from typing import Any

import numpy as np

from rts import namespace
from rts.plugin_api.arrays import Array, Tree, shape_of
from rts.plugin_api.records import ArraySpec, Samples
from rts_surfaces.implicit.field import ScalarField
from rts_surfaces.implicit.function_on_lattice import Looked, Resampled
from rts_surfaces.implicit.interpolation import differences, interpolated
from rts_surfaces.implicit.lattice import Lattice, check_shape
from rts_surfaces.parameter_checks import check_entry


class LatticeField(ScalarField):
    """θ["values"] (X, Y, Z) at the points of a lattice, as a field.

    Args:
        bounds: two corners ((x0, y0, z0), (x1, y1, z1)) of the lattice, the lower one first.
        isovalue: the value on the surface, where the level is zero.
        sign: 1 if values below the isovalue are inside, −1 if values above it are.
        shape: (X, Y, Z) that the values must have, or None for any.

    Attributes:
        level_of_values: isovalue and sign of the values that `look` returns.
    """

    name = "theta['values']"

    def __init__(self, bounds: Any, isovalue: float, sign: float, shape: Any = None):
        self.bounds, self.isovalue, self.sign = bounds, isovalue, sign
        self.level_of_values = (isovalue, sign)
        self.shape = None if shape is None else check_shape(shape)

    def names(self, theta: Mapping[str, Tree]) -> tuple[str, ...]:
        """The entries of θ that are read."""
        return ("values",)

    def check(self, theta: Mapping[str, Tree]) -> None:
        """Refuse θ without floating "values" of `shape`; if that is None, of three axes of at least two points each."""

        def expected(shape: tuple[int, ...]) -> str | None:
            if len(shape) != 3:
                return "(X, Y, Z)"
            check_shape(shape)
            return None if self.shape in (None, shape) else str(self.shape)

        check_entry("an isosurface", theta, "values", expected)

    def lattice(self, theta: Mapping[str, Tree]) -> Lattice:
        """The lattice of θ's values."""
        return Lattice(self.bounds, shape_of(theta["values"]))

    def resampled(self, theta: Mapping[str, Tree]) -> Iterator[Resampled]:
        """Lattices of every fourth value along each axis, then of every second.

        Yields only those that include the lattice's ends along all axes.
        """
        for stride in (4, 2):
            shape = tuple((n - 1) // stride + 1 for n in shape_of(theta["values"]))
            if min(shape) >= 2 and all((n - 1) % stride == 0 for n in shape_of(theta["values"])):
                field = LatticeField(self.bounds, self.isovalue, self.sign)
                yield Resampled(shape, field, partial(_every, stride))

    def look(self, theta: Mapping[str, Tree], closed: bool, inner: bool) -> Looked:
        """θ["values"] as they are, with 0 evaluations, whatever else is asked for."""
        return Looked({"values": theta["values"]}, 0)

    def table_specs(self, rows: int, capacity: int | None) -> Mapping[str, ArraySpec]:
        """Empty: the ids of samples are indices of the lattice's values, so no table is needed."""
        return {}

    def tabled(self, samples: Samples) -> Samples:
        """The samples unchanged."""
        return samples

    def in_tables(
        self, points: np.ndarray, tables: Mapping[str, np.ndarray]
    ) -> tuple[np.ndarray, Mapping[str, np.ndarray]]:
        """Ids of samples for their lattice points, by number, and the tables: both unchanged."""
        return points, tables

    def six(self, theta: Mapping[str, Tree], samples: Samples) -> tuple[Array, Array]:
        """All values (M,), float32 at least, and the indices (N, 6) among them of the points around each sample."""
        values = self.in_theta_dtype(theta, theta["values"])
        return namespace(values).reshape(values, (-1,)), samples.ids

    def numbers(self, samples: Samples) -> Array:
        """The numbers (N, 6) of the samples' lattice points."""
        return samples.ids

    def in_theta_dtype(self, theta: Mapping[str, Tree], points: Array) -> Array:
        """The points in the dtype of the values, float32 at least."""
        xp = namespace(points)
        wide = namespace(theta["values"]).finfo(theta["values"].dtype).bits == 64
        return xp.astype(points, xp.float64 if wide else xp.float32, copy=False)

    def level(self, theta: Mapping[str, Tree], points: Array) -> Array:
        """Values less the isovalue (M,), negative inside, at points (M, 3) of any dtype; beyond the bounds as on them.

        Differentiable in the values and in the points.
        """
        value = interpolated(theta["values"], points, self.lattice(theta))
        return self.sign * (value - self.isovalue)

    def slope(self, theta: Mapping[str, Tree], points: Array) -> Array:
        """The gradient (M, 3) of the level: central differences at lattice points, interpolated as the values are."""
        return self.sign * differences(theta["values"], points, self.lattice(theta))


def _every(stride: int, theta: Mapping[str, Tree]) -> dict[str, Tree]:
    """θ with the first value along each axis, and every `stride`-th one after it."""
    return {**theta, "values": theta["values"][::stride, ::stride, ::stride]}
