"""Functions of space evaluated on a lattice: everywhere, or in a narrow band."""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from rts import InputError, engine_of, namespace
from rts.plugin_api.arrays import Array, Tree, exemplar, leaves, shape_of
from rts.plugin_api.checks import is_count, quoted
from rts.plugin_api.records import ArraySpec, Samples
from rts_surfaces.implicit.field import Field, Function
from rts_surfaces.implicit.lattice import Lattice
from rts_surfaces.implicit.narrow_band import NarrowBand

CHUNK = 2**15
"""The number of lattice points at which a function is evaluated at a time, about."""


class Looked(NamedTuple):
    """Values of a field at lattice points.

    Attributes:
        inputs: the result of `TriangleSurface.proxy_inputs`: "values" (X, Y, Z); or "values" (M,), "numbers" (M,),
            "corners" (C, 8), "cells" (C, 3) and "inner" (D, 8) of a `Band`.
        evaluations: the number of points at which a function was evaluated.
    """

    inputs: dict[str, Array]
    evaluations: int


class Resampled(NamedTuple):
    """A field on another lattice.

    Attributes:
        shape: (X, Y, Z) of the lattice.
        field: the field.
        theta: a function from the old lattice's θ to this one's; None if θ stays.
    """

    shape: tuple[int, ...]
    field: Any
    theta: Callable[[Mapping[str, Tree]], Mapping[str, Tree]] | None


class FunctionOnLattice(Field):
    """A field that is evaluated at the points of a lattice; see `Field`, and `Isosurface` for the arguments.

    Attributes:
        level_of_values: isovalue and sign of the values that `look` gives, which are levels already.
    """

    level_of_values = (0.0, 1.0)

    def __init__(
        self,
        f: Function,
        isovalue: float,
        inside: str,
        reads: Sequence[str] | None,
        lattice: Lattice,
        table: bool | int,
        band: NarrowBand | None,
    ):
        super().__init__(f, isovalue, inside, reads)
        if not isinstance(table, bool) and not is_count(table):
            raise InputError(f"table is {quoted(table)}; expected True, False or a number of lattice points")
        if band is not None and not isinstance(band, NarrowBand):
            raise InputError(f"band is {quoted(band)}; expected a NarrowBand, or None")
        self._lattice, self.table, self.band = lattice, table, band

    def lattice(self, theta: Mapping[str, Tree]) -> Lattice:
        """The lattice."""
        return self._lattice

    def resampled(self, theta: Mapping[str, Tree]) -> Iterator[Resampled]:
        """The function on coarser lattices, and on one that is finer."""
        for factor in (1 / 4, 1 / 2, 2):
            shape = tuple(max(2, round(factor * (n - 1)) + 1) for n in self._lattice.shape)
            other = copy.copy(self)
            other._lattice = self._lattice.of_shape(shape)
            yield Resampled(shape, other, None)

    def at(self, theta: Mapping[str, Tree], numbers: Array) -> Array:
        """The level (M,) at lattice points by number (M,) int32."""
        places = self._lattice.places(numbers, namespace(numbers).float32)
        return self.level(theta, self.in_theta_dtype(theta, places))

    def look(self, theta: Mapping[str, Tree], closed: bool, inner: bool) -> Looked:
        """The level at all lattice points, or at the band's; without derivative. For `inner` see `NarrowBand.find`."""
        read = {name: theta[name] for name in self.names(theta)}
        engine, like, count = engine_of(read), exemplar(read), self._lattice.count
        if self.band is None:
            across, *rest = self._lattice.shape
            planes = engine.constant(np.arange(across, dtype=np.int32), like)
            levels = engine.map_rows(partial(self._in_planes, theta), planes, max(1, CHUNK // (rest[0] * rest[1])))
            return Looked({"values": levels}, count)
        known = [(engine_of(x).known(x), shape_of(x)) for x in leaves(read)]
        if any(value is None or value.shape != shape for value, shape in known):
            raise InputError(
                "a narrow band decides on values of f, and theta is traced; sample outside of jit and vmap (by "
                "rts.sample, and rts.render_samples inside), or leave out the band"
            )
        few_shapes = like is not None and engine.padded(like)

        def level(places: np.ndarray) -> np.ndarray:
            count = len(places)
            if few_shapes:  # Lest each be compiled.
                places = np.resize(places, (1 << max(0, count - 1).bit_length(), 3))
            points = self.in_theta_dtype(theta, engine.constant(places.astype(np.float32), like))
            return np.asarray(engine.known(engine.stop_gradient(self.level(theta, points))))[:count]

        band = self.band.find(level, self._lattice, closed, inner)
        return Looked({k: v for k, v in band._asdict().items() if k != "evaluations"}, band.evaluations)

    def _in_planes(self, theta: Mapping[str, Tree], planes: Array) -> Array:
        """The level (P, Y, Z) in planes of the lattice across its first axis, (P,) int32."""
        xp, engine, shape = namespace(planes), engine_of(planes), self._lattice.shape
        low, step = self._lattice.low, self._lattice.step
        axes = [float(low[0]) + float(step[0]) * xp.astype(planes, xp.float32)]
        axes += [engine.constant((low[i] + step[i] * np.arange(shape[i])).astype(np.float32), axes[0]) for i in (1, 2)]
        places = xp.stack(xp.meshgrid(*axes, indexing="ij"), axis=-1)
        levels = self.level(theta, self.in_theta_dtype(theta, xp.reshape(places, (-1, 3))))
        return xp.reshape(levels, (-1, *shape[1:]))

    # ------------------------------------------------------------------------------------------------ samples

    def table_specs(self, rows: int, capacity: int | None) -> Mapping[str, ArraySpec]:
        """The table "points" of the numbers of lattice points, which samples share; empty without `table`.

        Args:
            rows: the number of samples.
            capacity: the largest number of samples, where shapes must be known; else None.
        """
        if not self.table:
            return {}
        # One sample has room at least.
        room = 6 * rows if capacity is None else 2 * capacity if self.table is True else max(6, int(self.table))
        return {"points": ArraySpec((min(room, self._lattice.count),), np.int32, packed=capacity is None)}

    def tabled(self, samples: Samples) -> Samples:
        """Samples whose ids are rows of the table "points" instead of lattice points; unchanged without `table`."""
        if not self.table:
            return samples
        from rts_surfaces.implicit.distinct_loops import distinct

        points, rows = distinct(samples.ids.reshape(-1).astype(np.int64))
        room = len(samples.tables["points"])
        ids = rows.reshape(-1, 6).astype(np.int32, copy=False)
        row, overflow = samples.row, samples.overflow
        if len(points) > room:
            # Points are in the order of samples, front layers first: the deepest samples find no room.
            gone = (row >= 0) & (ids.max(axis=1) >= room)[row]
            row, overflow = np.where(gone, -1, row), np.asarray(overflow + gone.sum(), np.int32)
            ids = np.minimum(ids, room - 1)
        return samples.replace(ids=ids, row=row, overflow=overflow, tables={"points": points[:room].astype(np.int32)})

    def in_tables(
        self, points: np.ndarray, tables: Mapping[str, np.ndarray]
    ) -> tuple[np.ndarray, Mapping[str, np.ndarray]]:
        """Ids of samples with these lattice points, as in `tabled`, and the tables, with the points that they lack."""
        if not self.table:
            return points, tables
        known = tables["points"]
        whole = np.concatenate([known, np.setdiff1d(points, known)])
        order = np.argsort(whole, kind="stable")
        ids = order[np.searchsorted(whole, points, sorter=order)]
        return ids.astype(np.int32), {"points": whole.astype(np.int32)}

    def six(self, theta: Mapping[str, Tree], samples: Samples) -> tuple[Array, Array]:
        """Levels (M,), differentiable, and the indices (N, 6) int32 among them of the points around each sample."""
        if self.table:
            if "points" not in samples.tables:
                raise InputError("the samples have no table of lattice points, and the surface has one; sample it anew")
            return self.at(theta, samples.tables["points"]), samples.ids
        count = samples.ids.shape[0]
        levels = self.at(theta, namespace(samples.ids).reshape(samples.ids, (-1,)))
        rows = np.arange(6 * count, dtype=np.int32).reshape(count, 6)
        return levels, engine_of(levels).constant(rows, levels)

    def numbers(self, samples: Samples) -> Array:
        """The numbers (N, 6) of the samples' lattice points."""
        if not self.table:
            return samples.ids
        xp = namespace(samples.ids)
        flat = xp.take(samples.tables["points"], xp.reshape(samples.ids, (-1,)), axis=0)
        return xp.reshape(flat, (-1, 6))
