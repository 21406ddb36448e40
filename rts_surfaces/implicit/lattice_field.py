"""The field that values on a lattice describe: interpolated linearly along each axis."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from rts.arrays import shape_of
from rts.engines import engine_of, namespace
from rts.operations.combine import combine
from rts.records import ArraySpec, Samples
from rts.trees import Array, Tree
from rts_surfaces.entries import check_entry
from rts_surfaces.implicit.field import ScalarField
from rts_surfaces.implicit.function_on_lattice import Looked
from rts_surfaces.implicit.lattice import Lattice, check_shape


class LatticeField(ScalarField):
    """θ["values"] (X, Y, Z) at the points of a lattice, as a field.

    Args:
        bounds: the corners of the lattice.
        isovalue: where the level is zero.
        sign: 1 where values below the isovalue are inside, −1 where those above it are.
        shape: (X, Y, Z) that the values must have, or None for any.

    Attributes:
        level_of_values: isovalue and sign of what `look` gives.
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
        """Refuse θ without values of three axes, of at least two points each."""

        def expected(shape: tuple[int, ...]) -> str | None:
            if len(shape) != 3:
                return "(X, Y, Z)"
            check_shape(shape)
            return None if self.shape in (None, shape) else str(self.shape)

        check_entry("an isosurface", theta, "values", expected)

    def lattice(self, theta: Mapping[str, Tree]) -> Lattice:
        """The lattice of θ's values."""
        return Lattice(self.bounds, shape_of(theta["values"]))

    def look(self, theta: Mapping[str, Tree], closed: bool) -> Looked:
        """The values."""
        return Looked({"values": theta["values"]}, 0)

    def table_specs(self, rows: int, capacity: int | None) -> Mapping[str, ArraySpec]:
        """None: samples name the values themselves."""
        return {}

    def tabled(self, samples: Samples) -> Samples:
        """The samples."""
        return samples

    def six(self, theta: Mapping[str, Tree], samples: Samples) -> tuple[Array, Array]:
        """All values (M,), and which of them (N, 6) belong to each sample."""
        values = theta["values"]
        return namespace(values).reshape(values, (-1,)), samples.ids

    def numbers(self, samples: Samples) -> Array:
        """The lattice points (N, 6) of samples."""
        return samples.ids

    def suited(self, theta: Mapping[str, Tree], points: Array) -> Array:
        """The points in the dtype of the values, float32 at least."""
        xp = namespace(points)
        wide = namespace(theta["values"]).finfo(theta["values"].dtype).bits == 64
        return xp.astype(points, xp.float64 if wide else xp.float32, copy=False)

    def level(self, theta: Mapping[str, Tree], points: Array) -> Array:
        """Values less the isovalue (M,), negative inside, at points (M, 3) of any dtype; beyond the bounds as on them.

        Differentiable in the values and in the points.
        """
        lattice = self.lattice(theta)
        lowest, shares = self._cell(lattice, points)
        ids, weights = _corners(lattice, lowest, shares)
        return self._combined(theta, ids, weights) - self.sign * self.isovalue

    def slope(self, theta: Mapping[str, Tree], points: Array) -> Array:
        """The gradient (M, 3) of the level: central differences at lattice points, interpolated as the values are."""
        lattice = self.lattice(theta)
        lowest, shares = self._cell(lattice, points)
        xp = namespace(points)
        columns = []
        for axis in range(3):
            ids, weights, strides = [], [], (lattice.shape[1] * lattice.shape[2], lattice.shape[2], 1)
            last = lattice.shape[axis] - 1
            corners, shared = _corners(lattice, lowest, shares)
            for i in range(8):
                at = lowest[axis] + (i >> axis & 1)
                up, down = xp.astype(at < last, at.dtype), xp.astype(at > 0, at.dtype)
                per_step = shared[:, i] / (xp.astype(up + down, points.dtype) * float(lattice.step[axis]))
                ids += [corners[:, i] + strides[axis] * up, corners[:, i] - strides[axis] * down]
                weights += [per_step, -per_step]
            columns.append(self._combined(theta, xp.stack(ids, axis=-1), xp.stack(weights, axis=-1)))
        return xp.stack(columns, axis=-1)

    def _combined(self, theta: Mapping[str, Tree], ids: Array, weights: Array) -> Array:
        """(M,) sums of values with weights, negative inside."""
        values = theta["values"]
        rows = namespace(values).reshape(values, (-1, 1))
        return self.sign * combine(rows, ids, weights)[:, 0]

    @staticmethod
    def _cell(lattice: Lattice, points: Array) -> tuple[list[Array], list[Array]]:
        """The lowest corners of the cells that points lie in, (M,) int32 along each axis; and how far into them."""
        xp, engine = namespace(points), engine_of(points)
        lowest, shares = [], []
        for axis, (low, step) in enumerate(zip(lattice.low.tolist(), lattice.step.tolist(), strict=True)):
            last = lattice.shape[axis] - 1
            at = xp.clip((points[:, axis] - low) / step, 0.0, float(last))
            cell = xp.clip(xp.floor(engine.stop_gradient(at)), 0.0, float(last - 1))
            lowest.append(xp.astype(cell, xp.int32))
            shares.append(at - cell)
        return lowest, shares


def _corners(lattice: Lattice, lowest: Sequence[Array], shares: Sequence[Array]) -> tuple[Array, Array]:
    """Numbers and weights (M, 8) of the corners of cells, for what is interpolated linearly along each axis."""
    xp = namespace(lowest[0])
    first = (lowest[0] * lattice.shape[1] + lowest[1]) * lattice.shape[2] + lowest[2]
    ids, weights = [], []
    for i in range(8):
        x, y, z = i & 1, i >> 1 & 1, i >> 2 & 1
        ids.append(first + (x * lattice.shape[1] + y) * lattice.shape[2] + z)
        factors = [s if bit else 1 - s for s, bit in zip(shares, (x, y, z), strict=True)]
        weights.append(factors[0] * factors[1] * factors[2])
    return xp.stack(ids, axis=-1), xp.stack(weights, axis=-1)
