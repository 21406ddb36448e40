"""Isosurfaces of values on a lattice, and of functions: sampled on the triangles of marching cubes (paper §3.1.3).

A sample lies on a triangle whose corners lie on three edges of the lattice. Only the values at the ends of these edges
are differentiated, independently of the triangles, so that the topology may change.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from rts import GBuffer, InputError, Part, RaySurface, TriangleSurface, engine_of, namespace
from rts.plugin_api.arrays import Array, Tree, from_numbers, map_leaves, unit
from rts.plugin_api.checks import check_positive, fingerprint, quoted
from rts.plugin_api.operations import gradient
from rts.plugin_api.records import ArraySpec, Proxy, Rate, RayHits, Rays, Samples
from rts.plugin_api.threads import parallel
from rts_surfaces.implicit import marching_cubes
from rts_surfaces.implicit.casting import cast, per_level
from rts_surfaces.implicit.deepest import deepest
from rts_surfaces.implicit.field import SIDES, Implicit, check_isovalue, known_number
from rts_surfaces.implicit.function_on_lattice import FunctionOnLattice
from rts_surfaces.implicit.lattice import Interpolated, Lattice, check_bounds
from rts_surfaces.implicit.lattice_field import LatticeField
from rts_surfaces.implicit.marching_cubes import Triangles
from rts_surfaces.implicit.motion import ALONG_EDGES, ALONG_NORMAL
from rts_surfaces.implicit.narrow_band import Band, NarrowBand, rows_by_place
from rts_surfaces.implicit.regions import box

NEAR_SINGULAR = 1e-3
"""An edge is near-singular if its ends differ by less than this share of the median over the edges that are crossed."""

BESIDE = 1e-3
"""Distance outside the bounds, as a share of their size, at which rays begin if the surface is capped, to meet caps."""

STEPS_PER_CELL = 2
"""Steps of rays across the narrowest side of a cell, where there is no Lipschitz bound."""

ON_SIDE = 1e-6
"""Largest distance of a cap's points from the bounds' side, as a share of the bounds."""

KEPT = 4
"""The number of fields whose median differences, see `_usual`, are remembered."""

MOTIONS, ENDS, SINGULAR = ("normal", "edge"), ("capped", "open"), ("bound", "drop", "keep")


class Extracted(NamedTuple):
    """An isosurface as triangles, and the cost of their extraction.

    Attributes:
        vertices: (V, 3) float32, on edges of the lattice.
        faces: (T, 3) int32, counter-clockwise seen from outside.
        near_singular: the number of crossed edges that are near-singular.
        evaluations: the number of points at which the function was evaluated; 0 where values are given.
    """

    vertices: np.ndarray
    faces: np.ndarray
    near_singular: int
    evaluations: int


class Isosurface(Implicit, TriangleSurface, RaySurface):
    """The isosurface of a field: θ["values"] (X, Y, Z) at the points of a lattice, or a function of θ and points.

    A sample's ids are the numbers of six lattice points, the ends of three edges; point (x, y, z) has the number
    (x Y + y) Z + z. The first three of its parameters are the barycentrics in the triangle between these edges.
    The field at these six points alone moves the sample. Values equal to the isovalue are outside.

    Samplers of triangles see the triangles of marching cubes; the sampler "rays" meets the field itself, for given
    values interpolated along each axis.

    Args:
        bounds: two corners ((x0, y0, z0), (x1, y1, z1)) of the lattice, the lower one first.
        isovalue: the value of the field on the surface.
        f: (θ, points (M, 3)) → (M,), in array code or for one engine; None for θ["values"].
        shape: (X, Y, Z), lattice points along each axis. Needed with `f`; else None, or the shape of the values.
        motion: how samples move with the field. "normal": along its gradient, by its change there. "edge": their
            triangle's corners slide along the edges of the lattice, as in the paper.
        inside: which values are inside: "below" or "above" the isovalue.
        at_bounds: "capped": where the inside reaches the bounds, it is closed there; or "open".
        near_singular: the rule for edges whose ends have nearly equal values, so that a corner on them would move
            without bound. "bound": derivatives are bounded. "drop": their triangles are dropped, as in the paper.
            "keep": derivatives stay as they are.
        table: True for a costly `f`: it is evaluated once for each lattice point, not once for each sample at the
            point. A number allots room for so many points where shapes must be known, as in `jax.jit`; True allots
            twice as many as samples.
        band: a `NarrowBand`, to evaluate `f` near the surface only; θ must not be traced, then. Where pixels are wider
            than cells, fewer outlines move as exactly as on the whole lattice. None for the whole lattice.
        lipschitz: the most that `f` changes over a unit of length, for the sampler "rays"; None if unknown.
        reads: the entries of θ that `f` reads; None for all.
        attributes: name → function (θ, positions (N, 3)) → (N, C), further entries of the G-buffer.

    Raises:
        InputError: an argument is wrong.
    """

    refine_moves = False
    hit_widths = (0, 7)
    field: LatticeField | FunctionOnLattice

    def __init__(
        self,
        bounds: ArrayLike,
        isovalue: float = 0.0,
        f: Callable[[Any, Array], Array] | None = None,
        shape: Sequence[int] | None = None,
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
        for name, value, names in (
            ("motion", motion, MOTIONS),
            ("inside", inside, tuple(SIDES)),
            ("at_bounds", at_bounds, ENDS),
            ("near_singular", near_singular, SINGULAR),
        ):
            if not isinstance(value, str) or value not in names:
                raise InputError(f"{name} is {quoted(value)}; expected {' or '.join(map(repr, names))}")
        self.bounds, self.isovalue, self.motion = check_bounds(bounds), check_isovalue(isovalue), motion
        self.closed, self.near_singular = at_bounds == "capped", near_singular
        self.lipschitz = (
            None if lipschitz is None else known_number("lipschitz", check_positive("lipschitz", lipschitz))
        )
        self._usual: dict[tuple, float] = {}
        self.sample_widths, self.concurrent = (6, 16), f is None
        if f is not None:
            if shape is None:
                raise InputError("shape is None; expected (X, Y, Z), how finely to look at f")
            field = FunctionOnLattice(f, isovalue, inside, reads, Lattice(self.bounds, shape), table, band)
        else:
            for name, value, none in (("table", table, False), ("band", band, None), ("reads", reads, None)):
                if value is not none:
                    raise InputError(
                        f"{name} is {quoted(value)} without a function f; expected {none}: θ has the values"
                    )
            field = LatticeField(self.bounds, self.isovalue, SIDES[inside], shape)
        super().__init__(field, attributes)

    def __repr__(self) -> str:
        return f"Isosurface(of {self.field.name}, {self.motion!r})"

    @classmethod
    def example(cls) -> Part:
        """A torus, of values on a lattice."""
        axes = [np.linspace(-1.5, 1.5, 31), np.linspace(-0.7, 0.7, 15), np.linspace(-1.5, 1.5, 31)]
        x, y, z = np.meshgrid(*axes, indexing="ij")
        values = np.hypot(np.hypot(x - 0.03, z + 0.02) - 0.9, y - 0.01) - 0.4
        surface = cls(((-1.5, -0.7, -1.5), (1.5, 0.7, 1.5)))
        return Part(surface, {"values": values.astype(np.float32)}, "normals")

    def rates(self, theta: Mapping[str, Tree]) -> Sequence[Rate]:
        """The surface on coarser lattices, and, if it is of a function, on a finer one."""
        count, offered = self.field.lattice(theta).count, []
        for shape, field, change in self.field.resampled(theta):
            other = copy.copy(self)
            other.field, other._usual = field, {}
            offered.append(Rate(f"shape={shape}", float(np.prod(shape)) / count, other, change))
        return offered

    # ----------------------------------------------------------------------------------- triangles and samples

    def proxy_inputs(self, theta: Mapping[str, Tree]) -> Tree:
        """Values at lattice points: θ's, or levels of the function, everywhere or in its band and a cell further in."""
        return self.field.look(theta, self.closed, inner=True).inputs

    def extract(self, theta: Mapping[str, Tree]) -> Extracted:
        """The triangles of marching cubes, dropped ones included, and their cost.

        Args:
            theta: θ, not traced.

        Raises:
            InputError: the field is NaN or infinite somewhere.
        """
        theta = map_leaves(lambda x: engine_of(x).stop_gradient(x), from_numbers(theta, "theta"))
        self.check(theta)
        looked = self.field.look(theta, self.closed, inner=False)
        triangles = self._triangles(map_leaves(lambda x: engine_of(x).to_numpy(x), looked.inputs))
        return Extracted(triangles.vertices, triangles.faces, int(_singular(triangles).sum()), looked.evaluations)

    def _triangles(self, inputs: Mapping[str, np.ndarray]) -> Triangles:
        lattice = self.field.lattice(inputs)
        self._check_finite(inputs, lattice)
        if "corners" in inputs:
            return marching_cubes.of_band(Band(**inputs, evaluations=0), lattice, self.closed)
        return marching_cubes.of_lattice(inputs["values"], lattice, *self.field.level_of_values, self.closed)

    def _check_finite(self, inputs: Mapping[str, np.ndarray], lattice: Lattice) -> None:
        values = inputs["values"]
        if np.isfinite([values.min(initial=0), values.max(initial=0)]).all():  # Faster than to look at each.
            return
        flat = int(np.flatnonzero(~np.isfinite(values.reshape(-1)))[0])
        number = int(inputs["numbers"][flat]) if "numbers" in inputs else flat
        at = ", ".join(str(i) for i in np.unravel_index(number, lattice.shape))
        value = values.reshape(-1)[flat]
        raise InputError(f"{self.field.name} is {value} at lattice point [{at}]; expected finite numbers")

    def why_no_triangles(self, inputs: Mapping[str, np.ndarray]) -> str:
        """The side of the isovalue on which the whole field lies. The text holds no values, so that loops warn once."""
        values, (isovalue, sign) = inputs["values"], self.field.level_of_values
        if "corners" in inputs:
            return f"has no surface: its band found no place where the field crosses the isovalue {self.isovalue:g}"
        side = "inside" if (sign * (values.reshape(-1)[0] - isovalue)) < 0 else "outside"
        return f"has no surface: the field is {side} of the isovalue {self.isovalue:g} all over its bounds"

    def proxy(self, inputs: Mapping[str, np.ndarray], camera: Any, size: tuple[int, int]) -> Proxy:
        """The triangles of marching cubes; the ids of each are the six ends of its edges, its cell, and its caps."""
        from rts_surfaces.implicit import lattice_samples_loops

        triangles = self._triangles(inputs)
        if len(self._usual) >= KEPT:
            self._usual.clear()
        self._usual[fingerprint(inputs["values"])] = _usual(triangles)
        faces, cells, caps = triangles.faces, triangles.cells, triangles.caps
        if self.near_singular == "drop":
            kept = ~_singular(triangles)[faces].any(axis=1)
            faces, cells, caps = faces[kept], cells[kept], caps[kept]
        ids = np.empty((len(faces), 8), np.int32)
        parallel(lattice_samples_loops.hand_on, len(ids), faces, triangles.ends, cells, caps, ids, work=10 * len(ids))
        return Proxy(triangles.vertices, faces, ids)

    def refine(self, inputs: Mapping[str, np.ndarray], samples: Samples, rays: Rays) -> Samples:
        """Samples with their parameters, see `lattice_samples_loops.fill`, and with lattice points as ids."""
        from rts_surfaces.implicit import lattice_samples_loops

        lattice = self.field.lattice(inputs)
        values = np.ascontiguousarray(inputs["values"]).reshape(-1)
        band = (inputs["corners"], inputs["numbers"]) if "corners" in inputs else None
        points = np.zeros((len(samples.ids), 6), np.int32)
        params = np.zeros((len(samples.ids), self.sample_widths[1]), np.float32)
        least = 0.0 if self.near_singular == "keep" else NEAR_SINGULAR * self._usual_difference(inputs)
        along_edges = self.motion == "edge"
        field = self._interpolated(values, lattice)
        # Where no cell is covered there is a row nevertheless, of nothing.
        count = int(samples.row.max(initial=-1)) + 1
        results = points, params, least / lattice.step.max()
        parallel(
            lattice_samples_loops.fill, count, field, band, samples.ids, samples.params, *results, work=300 * count
        )
        if along_edges:
            params[:, 3:] = 0
            params[:, 3] = least if self.near_singular == "bound" else 0.0
        return self.field.tabled(replace(samples, ids=points, params=params))

    def refine_outlines(
        self,
        inputs: Mapping[str, np.ndarray],
        rays: Rays,
        beside: Rays,
        depth: np.ndarray,
        tables: Mapping[str, np.ndarray],
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, Mapping[str, np.ndarray]] | None:
        """See `rts.TriangleSurface`; in a band none where the search leaves its cells and those one further inside."""
        from rts_surfaces.implicit import lattice_outlines_loops

        lattice, count = self.field.lattice(inputs), len(depth)
        values = np.ascontiguousarray(inputs["values"]).reshape(-1)
        results = np.zeros((count, 2, 6), np.int32), np.zeros((count, 2, 16), np.float32), np.zeros(count, np.bool_)
        band = None
        if "corners" in inputs:
            corners = np.concatenate([inputs["corners"], inputs["inner"]])
            band = corners, *rows_by_place(inputs["numbers"][corners[:, 0]], lattice.shape)
        rays, beside = (x._replace(spread=np.asarray(x.spread, np.float64)) for x in (rays, beside))
        arguments = (self._interpolated(values, lattice), band), rays, beside, depth.astype(np.float64), results
        parallel(lattice_outlines_loops.outlines, count, *arguments, work=4000 * count)
        points, params, there = results
        ids, tables = self.field.in_tables(points, tables)
        return ids, params, there, tables

    def _interpolated(self, values: np.ndarray, lattice: Lattice) -> Interpolated:
        isovalue, sign = self.field.level_of_values
        return Interpolated(values, float(values.dtype.type(isovalue)), sign, self.closed, lattice.fixed)

    def _usual_difference(self, inputs: Mapping[str, np.ndarray]) -> float:
        """The median difference of the field between the ends of crossed edges; `proxy` keeps it for `refine`."""
        difference = self._usual.get(fingerprint(inputs["values"]))
        return _usual(self._triangles(inputs)) if difference is None else difference

    def table_specs(self, rows: int, capacity: int | None) -> Mapping[str, ArraySpec]:
        """The tables of the field."""
        return self.field.table_specs(rows, capacity)

    # ------------------------------------------------------------------------------------ evaluation and rays

    def intersect(self, theta: Mapping[str, Tree], origins: Array, directions: Array, layers: int) -> RayHits:
        """Hits of rays with the field itself within the bounds, and with the caps; see `rts.RaySurface`."""
        lattice, (low, high) = self.field.lattice(theta), self.bounds
        values, margin = theta.get("values"), BESIDE * (high - low) if self.closed else 0.0
        known = engine_of(values).known(values) if isinstance(self.field, LatticeField) else None
        if known is not None and known.shape == lattice.shape:
            self._check_finite({"values": known}, lattice)
        steps = np.linalg.norm(high - low) * STEPS_PER_CELL / lattice.step.min()
        return cast(
            partial(self._capped if self.closed else self.field.level, theta),
            partial(self._moving, theta),
            self.field.in_theta_dtype(theta, origins),
            self.field.in_theta_dtype(theta, directions),
            layers,
            within=box(low - margin, high + margin),
            lipschitz=self.lipschitz,
            steps=int(np.ceil(steps)) if self.lipschitz is None else None,
        )

    def deepest(self, theta: Mapping[str, Tree], points: Array, directions: Array, reach: Array) -> tuple[Array, Array]:
        """See `rts.RaySurface`; caps do not move."""
        points, directions, reach = (self.field.in_theta_dtype(theta, x) for x in (points, directions, reach))
        level = partial(self._capped if self.closed else self.field.level, theta)
        return deepest(level, lambda x: level(x) <= self.field.level(theta, x), points, directions, reach)

    def _capped(self, theta: Mapping[str, Tree], points: Array) -> Array:
        """The level (M,), or if larger, the distance beyond the bounds, negative inside, times `lipschitz` or 1."""
        xp, level = namespace(points), self.field.level(theta, points)
        for axis, (low, high) in enumerate(np.stack(self.bounds, axis=1).tolist()):
            beyond = xp.maximum(low - points[:, axis], points[:, axis] - high)
            level = xp.maximum(level, (self.lipschitz or 1.0) * beyond)
        return level

    def _caps(self, points: Array) -> Array:
        """Marks (M, 3) of points in caps: 1 in the upper, −1 in the lower side of the bounds across an axis; else 0."""
        xp, (low, high) = namespace(points), self.bounds
        columns = []
        for axis in range(3):
            near = float(ON_SIDE * (high - low)[axis])
            at = points[:, axis]
            above, below = at > float(high[axis]) - near, at < float(low[axis]) + near
            column = xp.astype(above, points.dtype) - xp.astype(below, points.dtype)
            columns.append(column if self.closed else xp.zeros_like(column))
        return xp.stack(columns, axis=-1)

    def _moving(self, theta: Mapping[str, Tree], points: Array, hit: Array) -> Array:
        """Parameters (M, 7): points; their motion for a unit of level, within its side in a cap; their level in caps.

        `hit` (M,) bool is true for points that are hits of rays.
        """
        engine = engine_of(points)
        xp, level = engine.namespace, partial(self.field.level, theta)
        within = 1 - xp.abs(self._caps(points))
        slope, free = within * gradient(level, points), xp.min(within, axis=-1, keepdims=True)
        return engine.stop_gradient(
            xp.concat([points, per_level(slope, hit), (1 - free) * level(points)[:, None]], axis=-1)
        )

    def unbounded(self) -> Isosurface | None:
        """See `rts.Surface`: the surface with `near_singular` "keep"; None if it bounds no derivatives."""
        if self.near_singular != "bound":
            return None
        surface = copy.copy(self)
        surface.near_singular = "keep"
        return surface

    def normal(self, theta: Mapping[str, Tree], position: Array) -> Array:
        """The normal of the field; in caps that of the bounds' side."""
        xp, caps = namespace(position), self._caps(engine_of(position).stop_gradient(position))
        capped = xp.max(xp.abs(caps), axis=-1, keepdims=True) > 0
        return xp.where(capped, unit(caps), super().normal(theta, position))

    def evaluate(self, theta: Mapping[str, Tree], samples: Samples) -> GBuffer:
        """Positions, normals along the field's gradient, and attributes."""
        if samples.ids.shape[1] == 0:
            return self.at_hits(theta, samples)
        values, rows = self.field.six(theta, samples)
        isovalue, sign = self.field.level_of_values
        xp = namespace(values)
        params = xp.astype(samples.params, values.dtype, copy=False)
        position = ALONG_NORMAL(values, params, rows, isovalue=isovalue, sign=sign)
        if self.motion == "edge":
            lattice, numbers = self.field.lattice(theta), self.field.numbers(samples)
            by_edges = ALONG_EDGES(values, params[:, :4], rows, numbers, isovalue=isovalue, lattice=lattice.fixed)
            # Pairs at outlines have no barycentrics.
            position = xp.where(xp.any(params[:, :3] != 0, axis=1, keepdims=True), by_edges, position)
        return self.gbuffer(theta, position)


def _singular(triangles: Triangles) -> np.ndarray:
    """Marks (V,) bool of vertices on near-singular edges."""
    return (triangles.differences > 0) & (triangles.differences < NEAR_SINGULAR * _usual(triangles))


def _usual(triangles: Triangles) -> float:
    """The median difference of the field between the ends of crossed edges; 0 without any."""
    crossed = triangles.differences[triangles.differences > 0]
    return float(np.median(crossed)) if len(crossed) else 0.0
