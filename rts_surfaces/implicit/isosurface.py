"""Isosurfaces of values on a lattice, and of functions: sampled on the triangles of marching cubes (paper §3.1.3).

A sample lies on a triangle whose corners lie on three edges of the lattice. Only the values at the ends of these edges
are differentiated: nothing knows of the triangles, so that the topology may change.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from rts.arguments import check_numbers, check_positive, quoted
from rts.arrays import is_finite, shape_of
from rts.checks import is_count
from rts.engines import engine_of, exemplar, namespace, value_of
from rts.errors import InputError
from rts.gbuffer import GBuffer
from rts.interfaces import Part, RaySurface, TriangleSurface
from rts.operations.take import take
from rts.records import ArraySpec, Proxy, RayHits, Rays, Samples
from rts.threads import parallel
from rts.trees import Array, Tree, leaves
from rts_surfaces.implicit import marching_cubes
from rts_surfaces.implicit.casting import box, cast, moving
from rts_surfaces.implicit.field import SIDES, Field, Implicit
from rts_surfaces.implicit.lattice import Lattice, check_bounds
from rts_surfaces.implicit.lattice_field import LatticeField
from rts_surfaces.implicit.marching_cubes import Triangles
from rts_surfaces.implicit.motion import ALONG, PLACE, WEIGHTS, along_normal
from rts_surfaces.implicit.narrow_band import Band, NarrowBand

NEAR_SINGULAR = 1e-3
"""An edge is near-singular if its ends differ by less than this share of the median over the edges that are crossed."""

CHUNK = 2**15
"""Lattice points at which a function is evaluated at a time."""

BESIDE = 1e-3
"""How far before the bounds rays begin where the surface is capped, as a share of the bounds: they meet the caps."""

MOTIONS, ENDS, SINGULAR = ("normal", "edge"), ("capped", "open"), ("bound", "drop", "keep")


class Extracted(NamedTuple):
    """An isosurface as triangles, and what it took to find them.

    Attributes:
        vertices: (V, 3) float32, on edges of the lattice.
        faces: (T, 3) int32, counter-clockwise seen from outside.
        near_singular: how many of the edges that are crossed are near-singular.
        evaluations: at how many points the function was evaluated; 0 where values are given.
    """

    vertices: np.ndarray
    faces: np.ndarray
    near_singular: int
    evaluations: int


class Isosurface(Implicit, TriangleSurface, RaySurface):
    """Where a field has one value: θ["values"] (X, Y, Z) at the points of a lattice, or a function of θ and points.

    A sample's ids are the numbers of six lattice points, the ends of three edges; point (x, y, z) has the number
    (x Y + y) Z + z. The first three of its parameters are the barycentrics in the triangle between these edges.
    Nothing but the field at these six points moves it. Values equal to the isovalue are outside.

    Samplers of triangles see the triangles of marching cubes; the sampler "rays" meets the field itself, for given
    values interpolated along each axis.

    Args:
        bounds: two corners ((x0, y0, z0), (x1, y1, z1)) of the lattice, the lower one first.
        isovalue: the value.
        f: (θ, points (M, 3)) → (M,), in array code or for one engine; None for θ["values"].
        shape: (X, Y, Z), lattice points along each axis. Needed with `f`; else that of the values.
        motion: how samples move with the field. "normal": along its gradient, by its change there. "edge": their
            triangle's corners slide along the edges of the lattice, as in the paper.
        inside: "below" or "above" the isovalue.
        at_bounds: "capped": where the inside reaches the bounds, it is closed there; or "open".
        near_singular: what is done where an edge's ends are so much alike that its corner would move without bound.
            "bound": derivatives are bounded. "drop": there is no surface, as in the paper. "keep": nothing.
        table: for a costly `f`. It is called once for each lattice point, not once for each sample that has it. A
            number says for how many to allot room where shapes must be known, as in `jax.jit`; else there is room for
            twice as many as for samples.
        band: a `NarrowBand`: `f` is evaluated at no more of the lattice than needed. θ must have known values, then.
        lipschitz: the most that `f` changes over a unit of length, for the sampler "rays"; None if unknown.
        reads: the entries of θ that `f` reads; None for all.
        attributes: name → function (θ, positions (N, 3)) → (N, C), further entries of the G-buffer.

    Raises:
        InputError: something of another kind than these.
    """

    refine_moves = False
    hit_widths = (0, 6)
    field: Field | LatticeField

    def __init__(
        self,
        bounds: Any,
        isovalue: float = 0.0,
        f: Callable[[Any, Array], Array] | None = None,
        shape: Any = None,
        *,
        motion: str = "normal",
        inside: str = "below",
        at_bounds: str = "capped",
        near_singular: str = "bound",
        table: bool | int = False,
        band: NarrowBand | None = None,
        lipschitz: float | None = None,
        reads: Sequence[str] | None = None,
        attributes: Mapping[str, Callable[[Any, Array], Array]] | None = None,
    ):
        for name, given, names in (
            ("motion", motion, MOTIONS),
            ("inside", inside, tuple(SIDES)),
            ("at_bounds", at_bounds, ENDS),
            ("near_singular", near_singular, SINGULAR),
        ):
            if given not in names:
                raise InputError(f"{name} is {quoted(given)}; expected {' or '.join(map(repr, names))}")
        check_bounds(bounds)
        check_numbers("isovalue", isovalue, ())
        if lipschitz is not None:
            check_positive("lipschitz", lipschitz)
        self.bounds, self.isovalue, self.motion = bounds, float(isovalue), motion
        self.closed, self.near_singular, self.lipschitz = at_bounds == "capped", near_singular, lipschitz
        self.sign = SIDES[inside]
        if f is None:
            if table is not False or band is not None:
                raise InputError("a table or band needs a function f; values that are given need no evaluation")
            field = LatticeField(bounds, self.isovalue, self.sign, shape)
            self._lattice = None
        else:
            if shape is None:
                raise InputError("shape is None; expected (X, Y, Z), how finely to look at f")
            field = Field(f, isovalue, inside, reads)
            self._lattice = Lattice(bounds, shape)
        if not isinstance(table, bool) and not is_count(table):
            raise InputError(f"table is {quoted(table)}; expected True, False or a number of lattice points")
        if band is not None and not isinstance(band, NarrowBand):
            raise InputError(f"band is {quoted(band)}; expected a NarrowBand, or None")
        self.table, self.band = table, band
        self.sample_widths = (6, 15 if motion == "normal" else 4)
        super().__init__(field, attributes)

    def __repr__(self) -> str:
        of = "values" if self._lattice is None else self.field.name
        return f"Isosurface(of {of}, {self.motion!r})"

    @classmethod
    def example(cls) -> Part:
        """A torus, of values on a lattice."""
        axes = [np.linspace(-1.5, 1.5, 31), np.linspace(-0.7, 0.7, 15), np.linspace(-1.5, 1.5, 31)]
        x, y, z = np.meshgrid(*axes, indexing="ij")
        values = np.hypot(np.hypot(x - 0.03, z + 0.02) - 0.9, y - 0.01) - 0.4
        surface = cls(((-1.5, -0.7, -1.5), (1.5, 0.7, 1.5)))
        return Part(surface, {"values": values.astype(np.float32)}, "normals")

    def check(self, theta: Mapping[str, Tree]) -> None:
        """Refuse θ without what the field reads."""
        if isinstance(self.field, LatticeField):
            self.field.check(theta)
        else:
            super().check(theta)

    # ------------------------------------------------------------------------------------------- the lattice

    def lattice(self, theta: Mapping[str, Tree]) -> Lattice:
        """The lattice that the field is looked at on."""
        return self.field.lattice(theta) if isinstance(self.field, LatticeField) else self._lattice

    def proxy_inputs(self, theta: Mapping[str, Tree]) -> Tree:
        """Values at the lattice points: those of θ, or levels of the function, in a band or everywhere."""
        if isinstance(self.field, LatticeField):
            return {"values": theta["values"]}
        if self.band is not None:
            band = self._band(theta)
            return {"values": band.values, "numbers": band.numbers, "corners": band.corners, "cells": band.cells}
        like = exemplar(theta)
        engine = engine_of(theta)
        numbers = engine.constant(np.arange(self._lattice.count, dtype=np.int32), like)

        def level(some: Array) -> Array:
            return self._level_of(theta, some, self._lattice)

        return {"values": engine.namespace.reshape(engine.map_rows(level, numbers, CHUNK), self._lattice.shape)}

    def _band(self, theta: Mapping[str, Tree]) -> Band:
        known = [value_of(x) for x in leaves(theta)]
        if any(v is None or v.shape != shape_of(x) for v, x in zip(known, leaves(theta), strict=True)):
            raise InputError(
                "a narrow band decides on values of f, and theta is traced; sample outside of jit and vmap (by "
                "rts.sample, and rts.render_samples inside), or leave out the band"
            )
        engine, like = engine_of(theta), exemplar(theta)

        def level(places: np.ndarray) -> np.ndarray:
            count = len(places)
            if engine.padded(like) if like is not None else False:  # Few shapes, lest each be compiled.
                places = np.resize(places, (1 << max(0, count - 1).bit_length(), 3))
            points = self.field.suited(theta, engine.constant(places.astype(np.float32), like))
            return engine.to_numpy(engine.stop_gradient(self.field.level(theta, points)))[:count]

        return self.band.find(level, self._lattice, self.closed)

    def extract(self, theta: Mapping[str, Tree]) -> Extracted:
        """The triangles that samplers see, and what they cost.

        Args:
            theta: θ, with values that are known.

        Raises:
            InputError: the field is NaN or infinite somewhere.
        """
        engine, evaluations = engine_of(theta), 0
        self.check(theta)
        if self.band is not None:
            band = self._band(theta)
            inputs = {"values": band.values, "numbers": band.numbers, "corners": band.corners, "cells": band.cells}
            evaluations = band.evaluations
        else:
            given = self.proxy_inputs(theta)["values"]
            inputs = {"values": engine_of(given).to_numpy(engine.stop_gradient(given))}
            evaluations = 0 if self._lattice is None else self._lattice.count
        found = self._triangles(inputs)
        return Extracted(found.vertices, found.faces, int(_singular(found).sum()), evaluations)

    # ----------------------------------------------------------------------------------- triangles and samples

    def _level(self) -> tuple[float, float]:
        """Isovalue and sign of what `proxy_inputs` gives."""
        return (self.isovalue, self.sign) if self._lattice is None else (0.0, 1.0)

    def _triangles(self, inputs: Mapping[str, np.ndarray]) -> Triangles:
        lattice = self._lattice or Lattice(self.bounds, inputs["values"].shape)
        self._check_finite(inputs, lattice)
        if "corners" in inputs:
            return marching_cubes.of_band(_as_band(inputs), lattice, self.closed)
        return marching_cubes.of_lattice(inputs["values"], lattice, *self._level(), self.closed)

    def _check_finite(self, inputs: Mapping[str, np.ndarray], lattice: Lattice) -> None:
        values = inputs["values"]
        if is_finite(values):
            return
        flat = int(np.flatnonzero(~np.isfinite(values.reshape(-1)))[0])
        number = int(inputs["numbers"][flat]) if "numbers" in inputs else flat
        at = ", ".join(str(i) for i in np.unravel_index(number, lattice.shape))
        what = "theta['values']" if self._lattice is None else "f"
        raise InputError(f"{what} is {values.reshape(-1)[flat]} at lattice point [{at}]; expected finite numbers")

    def why_no_triangles(self, inputs: Mapping[str, np.ndarray]) -> str:
        """Where the field lies beside the isovalue."""
        values = inputs["values"]
        if not values.size:
            return f"the field of {{}} crosses the isovalue {self.isovalue:g} nowhere that its band was looked for"
        ends = (float(values.min()), float(values.max()))
        if self._lattice is not None:
            ends = sorted(self.sign * level + self.isovalue for level in ends)
        least, most = ends
        return f"the field of {{}} is {least:.4g} to {most:.4g}, and crosses the isovalue {self.isovalue:g} nowhere"

    def proxy(self, inputs: Mapping[str, np.ndarray], camera: Any, size: tuple[int, int]) -> Proxy:
        """The triangles of marching cubes, each with the ends of its edges, its cell, and where it is capped."""
        found = self._triangles(inputs)
        faces, cells, caps = found.faces, found.cells, found.caps
        if self.near_singular == "drop":
            kept = ~_singular(found)[faces].any(axis=1)
            faces, cells, caps = faces[kept], cells[kept], caps[kept]
        ids = np.empty((len(faces), 8), np.int32)
        for k in range(3):
            np.take(found.ends, faces[:, k], axis=0, out=ids[:, 2 * k : 2 * k + 2], mode="clip")
        ids[:, 6], ids[:, 7] = cells, caps
        return Proxy(found.vertices, faces, ids)

    def refine(self, inputs: Mapping[str, np.ndarray], samples: Samples, rays: Rays) -> Samples:
        """What samples carry: weights of the six values, their place, and how they move; and lattice points merged."""
        from rts_surfaces.implicit import lattice_samples_kernels

        lattice = self._lattice or Lattice(self.bounds, inputs["values"].shape)
        values = np.ascontiguousarray(inputs["values"]).reshape(-1)
        none = np.empty(0, np.int64), np.empty((0, 8), np.int32)
        numbers, corners = (inputs["numbers"], inputs["corners"]) if "corners" in inputs else none
        count = len(samples.ids)
        points, carried = np.empty((count, 6), np.int32), np.empty((count, 12), np.float32)
        slopes, apart = np.empty((count, 3)), np.empty((count, 3))
        given = values, *self._level(), numbers, corners, lattice.shape, lattice.low, lattice.step
        made = points, carried, slopes, apart
        parallel(lattice_samples_kernels.fill, count, *given, samples.ids, samples.params, *made, work=300 * count)
        if self.motion == "edge":
            crossed = apart[apart > 0]
            least = NEAR_SINGULAR * np.median(crossed) if len(crossed) and self.near_singular == "bound" else 0.0
            params = np.concatenate([carried[:, :3], np.full((count, 1), least, np.float32)], axis=1)
        else:
            params = np.concatenate([carried, _per_level(slopes, self.near_singular)], axis=1)
        return self._merged(replace(samples, ids=points, params=params))

    def table_specs(self, rows: int, capacity: int | None) -> Mapping[str, ArraySpec]:
        """The lattice points that samples share, by number."""
        if not self.table:
            return {}
        room = 6 * rows if capacity is None else 2 * capacity if self.table is True else int(self.table)
        return {"points": ArraySpec((min(room, self._lattice.count),), np.int32, packed=capacity is None)}

    def _merged(self, samples: Samples) -> Samples:
        """Samples whose ids are rows of a table of lattice points, if there is to be one."""
        if not self.table:
            return samples
        from rts_surfaces.implicit.distinct_kernels import distinct

        points, rows = distinct(samples.ids.reshape(-1).astype(np.int64))
        room = len(samples.tables["points"])
        ids = rows.reshape(-1, 6).astype(np.int32, copy=False)
        row, overflow = samples.row, samples.overflow
        if len(points) > room:
            # Points are in the order of samples, which is that of layers: the deepest find no room.
            lost = (ids >= room).any(axis=1)
            gone = (row >= 0) & lost[row]
            row, overflow = np.where(gone, -1, row), overflow + gone.sum()
            ids = np.minimum(ids, room - 1)
        table = points[:room].astype(np.int32)
        return replace(samples, ids=ids, row=row, overflow=overflow, tables={"points": table})

    # ------------------------------------------------------------------------------------ evaluation and rays

    def intersect(self, theta: Mapping[str, Tree], origins: Array, directions: Array, layers: int) -> RayHits:
        """Where rays meet the field itself within the bounds, and the caps; see `rts.RaySurface`."""
        lattice = self.lattice(theta)
        low, high = lattice.low, lattice.low + (np.array(lattice.shape) - 1) * lattice.step
        margin = BESIDE * (high - low) if self.closed else 0.0
        level = self._level_in_bounds(theta)
        return cast(
            level,
            partial(moving, level),
            self.field.suited(theta, origins),
            self.field.suited(theta, directions),
            layers,
            within=box(low - margin, high + margin),
            lipschitz=self.lipschitz,
            steps=2 * max(lattice.shape) if self.lipschitz is None else None,
        )

    def _level_in_bounds(self, theta: Mapping[str, Tree]) -> Callable[[Array], Array]:
        """The level as a function of points, with the caps."""
        return partial(self._capped if self.closed else self.field.level, theta)

    def _capped(self, theta: Mapping[str, Tree], points: Array) -> Array:
        """The level, and beyond the bounds no less than the distance to them."""
        xp, lattice = namespace(points), self.lattice(theta)
        level = self.field.level(theta, points)
        for axis in range(3):
            low, step = float(lattice.low[axis]), float(lattice.step[axis])
            at, last = points[:, axis], low + (lattice.shape[axis] - 1) * step
            level = xp.maximum(level, xp.maximum(low - at, at - last))
        return level

    def evaluate(self, theta: Mapping[str, Tree], samples: Samples) -> GBuffer:
        """Positions, normals along the field's gradient, and attributes."""
        if samples.ids.shape[1] == 0:
            return self.at_hits(theta, samples, self._level_in_bounds(theta))
        lattice = self.lattice(theta)
        moved = self._on_edges if self.motion == "edge" else self._along_normal
        return self.gbuffer(theta, moved(theta, samples, lattice))

    def _along_normal(self, theta: Mapping[str, Tree], samples: Samples, lattice: Lattice) -> Array:
        """Positions (N, 3) of samples that have moved along the gradient, by the six values of each."""
        if isinstance(self.field, LatticeField):
            values = namespace(theta["values"]).reshape(theta["values"], (-1,))
            return along_normal(values, samples, *self._level())
        if "points" in samples.tables:
            return along_normal(self._table_levels(theta, samples, lattice), samples, *self._level())
        levels = self._six_levels(theta, samples, lattice)
        xp = namespace(levels)
        params = xp.astype(samples.params, levels.dtype, copy=False)
        level = xp.sum(levels * params[:, WEIGHTS], axis=1)
        return params[:, PLACE] - level[:, None] * params[:, ALONG]

    def _six_levels(self, theta: Mapping[str, Tree], samples: Samples, lattice: Lattice) -> Array:
        """The level (N, 6) at the lattice points of samples."""
        xp = namespace(samples.ids)
        flat = xp.reshape(samples.ids, (-1,))
        if isinstance(self.field, LatticeField):
            values = take(namespace(theta["values"]).reshape(theta["values"], (-1, 1)), flat)
            levels = self.sign * (values - self.isovalue)
        elif "points" in samples.tables:
            levels = take(self._table_levels(theta, samples, lattice)[:, None], flat)
        else:
            levels = self._level_of(theta, flat, lattice)
        return namespace(levels).reshape(levels, (-1, 6))

    def _table_levels(self, theta: Mapping[str, Tree], samples: Samples, lattice: Lattice) -> Array:
        return self._level_of(theta, samples.tables["points"], lattice)

    def _level_of(self, theta: Mapping[str, Tree], numbers: Array, lattice: Lattice) -> Array:
        """The level (M,) of the function at lattice points by number."""
        places = lattice.places(numbers, namespace(numbers).float32)
        return self.field.level(theta, self.field.suited(theta, places))

    def _on_edges(self, theta: Mapping[str, Tree], samples: Samples, lattice: Lattice) -> Array:
        """Positions (N, 3) in triangles whose corners slide along the edges of the lattice."""
        levels = self._six_levels(theta, samples, lattice)
        xp, engine, params = (
            namespace(levels),
            engine_of(levels),
            namespace(levels).astype(samples.params, levels.dtype),
        )
        numbers = samples.ids
        if "points" in samples.tables:
            numbers = xp.reshape(xp.take(samples.tables["points"], xp.reshape(numbers, (-1,)), axis=0), (-1, 6))
        position = None
        for k in range(3):
            a, b = (lattice.places(numbers[:, 2 * k + i], levels.dtype) for i in range(2))
            along = _crossing(engine, levels[:, 2 * k], levels[:, 2 * k + 1], params[:, 3])
            corner = params[:, k : k + 1] * (a + along[:, None] * (b - a))
            position = corner if position is None else position + corner
        return position


def _crossing(engine: Any, f_a: Array, f_b: Array, least: Array) -> Array:
    """How far along an edge the level is zero (N,); its derivative as if the ends differed by `least` or more."""
    xp = engine.namespace
    apart = f_b - f_a
    same = apart == 0
    exact = -f_a / xp.where(same, xp.ones_like(apart), apart)
    exact = xp.where(same, xp.zeros_like(exact), exact)
    known = engine.stop_gradient(apart)
    singular = xp.abs(known) < least
    bounded = xp.where(known < 0, -least, least)
    along = engine.stop_gradient(exact)
    change = (1 - along) * (f_a - engine.stop_gradient(f_a)) + along * (f_b - engine.stop_gradient(f_b))
    # Neither branch may divide by nothing, chosen or not.
    return xp.where(singular, along - change / xp.where(singular, bounded, xp.ones_like(bounded)), exact)


def _per_level(slopes: np.ndarray, near_singular: str) -> np.ndarray:
    """By what vector (N, 3) float32 samples move for each unit of level: the gradient over its square, bounded."""
    square = (slopes * slopes).sum(axis=1)
    usual = square[square > 0]
    least = NEAR_SINGULAR**2 * np.median(usual) if len(usual) and near_singular != "keep" else 0.0
    divisor = np.maximum(square, least)
    return np.divide(slopes, divisor[:, None], out=np.zeros_like(slopes), where=divisor[:, None] > 0).astype(np.float32)


def _singular(found: Triangles) -> np.ndarray:
    """Which vertices lie on near-singular edges (V,) bool."""
    crossed = found.differences[found.differences > 0]
    if not len(crossed):
        return np.zeros(len(found.differences), bool)
    return (found.differences > 0) & (found.differences < NEAR_SINGULAR * np.median(crossed))


def _as_band(inputs: Mapping[str, np.ndarray]) -> Band:
    return Band(**{name: inputs[name] for name in ("numbers", "values", "corners", "cells")}, evaluations=0)
