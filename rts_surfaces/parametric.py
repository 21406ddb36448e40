"""Surfaces of bicubic patches: triangles as fine as the view asks for, samples moved onto the true surface.

A sample is the number of its patch and (u, v) in it. The patches are in Bézier form: 16 control points each, rows of a
table that is linear in θ.
"""

from __future__ import annotations

import abc
import math
from collections.abc import Hashable, Mapping
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np

from rts.arguments import check_positive
from rts.arrays import described, shape_of, unit
from rts.camera import Camera
from rts.checks import is_count
from rts.engines import constants, engine_of, namespace
from rts.errors import InputError
from rts.gbuffer import GBuffer
from rts.interfaces import TriangleSurface
from rts.operations.combine import combine
from rts.records import Proxy, Rays, Samples
from rts.threads import parallel
from rts.topology import fixed
from rts.trees import Array, Tree

TOLERANCE = 0.1
"""Pixels that a triangle may be off the surface where there may be an outline. Elsewhere samples find the surface from
afar: Newton's method needs no better start than `COARSE` times as much."""
COARSE = 10.0
MOST = 256
"""The largest number of cuts along a side of a patch."""

RESIDUAL, STEPS, LARGEST_STEP, BEYOND = 1e-4, 6, 0.25, 0.02
"""Newton's method: pixels a sample may be off its ray, the number of steps, the largest one, and how far a sample may
lie beyond the edge of its patch, in units of the patch."""

COLLAPSED = 1e-4
"""A derivative is taken for zero, and the normal from the mixed one, where it is less than this share of the other."""

STEP, CELLS = 1.1, 8
"""Views whose distances and widths of pixels differ by less than this factor, and whose directions are in one cell of a
cube's sides (`CELLS` from the middle of a side to its edge), have the same triangles."""

ATTRIBUTES = {"colors": ("color", (1, 3, 4)), "uv": ("uv", (2,))}
"""Entries of θ for control points: what the G-buffer calls them, and how wide they may be."""


class View(NamedTuple):
    """What triangles depend on: a cell of views, by its middle and how far a view may be off it.

    Attributes:
        eye: (3,), or where rays are parallel the direction towards the viewer.
        parallel: whether they are.
        move: how far the eye may be off, local units; where parallel, how far the direction.
        spread: (2,), width of a pixel at depth z, at its least.
        axis: (3,) what the camera looks along.
        angle: half the angle of a cone around the axis that holds the view, radians.
    """

    eye: np.ndarray
    parallel: bool
    move: float
    spread: np.ndarray
    axis: np.ndarray
    angle: float


def view_key(camera: Camera, size: tuple[int, int], center: np.ndarray) -> tuple:
    """The cell of views that a camera belongs to, as whole numbers.

    Args:
        camera: NumPy, in the surface's local space.
        size: (height, width).
        center: (3,), of the surface.
    """
    inverse = np.linalg.inv(camera.view)
    spread, axis = camera.spread(size), -inverse[:3, 2]
    corner = math.hypot(*size) / 2
    if camera.projection[3, 2] == 0:
        return True, _cell(-axis), 0, _power(spread[0]), _cell(axis), 0
    off = inverse[:3, 3] - center
    distance = float(np.linalg.norm(off))
    # The principal point may be beside the image: as wide a cone as reaches its farthest corner.
    shift = float(np.hypot(*(camera.projection[:2, 2])))
    wide = _power(spread[1] * corner * (1 + shift))
    return False, _cell(off), _power(distance), _power(spread[1]), _cell(axis), wide


def view_of(key: tuple, center: np.ndarray) -> View:
    """The view in the middle of a cell."""
    parallel, toward, distance, width, axis, wide = key
    direction, half = _direction(toward), 0.75 / CELLS  # Of a cell's diagonal, the tangent at most.
    narrow = STEP ** (width - 0.5)
    if parallel:
        return View(direction, True, half, np.array([narrow, 0.0]), _direction(axis), math.pi)
    length = STEP**distance
    move = length * (half + math.log(STEP) / 2)
    angle = math.atan(STEP ** (wide + 0.5)) + half
    return View(center + length * direction, False, move, np.array([0.0, narrow]), _direction(axis), angle)


def _power(x: float) -> int:
    return round(math.log(max(x, 1e-300)) / math.log(STEP))


def _cell(vector: np.ndarray) -> tuple[int, int, int]:
    """The cell of a direction on the sides of a cube."""
    largest = float(np.abs(vector).max())
    x, y, z = (round(CELLS * c / largest) for c in vector.tolist()) if largest > 0 else (0, 0, CELLS)
    return x, y, z


def _direction(cell: tuple[int, int, int]) -> np.ndarray:
    vector = np.array(cell, np.float64)
    return vector / np.linalg.norm(vector)


class Patches(TriangleSurface):
    """Base of surfaces of bicubic patches.

    Args:
        table: (n, 16) integers, the control points of each Bézier patch, first along u, then along v; they name rows of
            what `bezier_rows` gives.
        tolerance: pixels that triangles may be off the surface near outlines.

    Attributes:
        shaped_by: the entries of θ that control points are made of.
    """

    sample_widths = (1, 2)
    shaped_by: tuple[str, ...] = ("points",)

    def __init__(self, table: np.ndarray, tolerance: float = TOLERANCE):
        check_positive("tolerance", tolerance)
        self.tolerance = float(tolerance)
        self.table = fixed(np.array(table, np.int32))
        self._sides, self._flips, self._edges = _edges_of(self.table)
        corners = self.table[:, [0, 12, 15, 3]]
        used, place = np.unique(corners, return_inverse=True)
        self._corners, self._corner_rows = fixed(place.reshape(-1, 4).astype(np.int32)), used

    @abc.abstractmethod
    def bezier_rows(self, values: Array) -> Array:
        """Rows of an entry of θ for the control points of the Bézier patches: (M, C), linear in the values.

        It is asked of NumPy arrays in float64, too.
        """

    @abc.abstractmethod
    def control_shape(self, shape: tuple[int, ...]) -> str | None:
        """What is wrong with the shape of an entry of θ but for its last axis, in words; None for nothing."""

    def control_points(self, theta: Mapping[str, Tree]) -> Array:
        """The control points, as `bezier_rows` takes them."""
        return theta["points"]

    def expected(self, name: str, shape: tuple[int, ...]) -> str | None:
        """What shape an entry of θ is to have, in words; None if it has it."""
        wrong = self.control_shape(shape[:-1]) if shape else "an array"
        widths = (3,) if name == "points" else ATTRIBUTES[name][1]
        if wrong is None and shape[-1] not in widths:
            return f"a last axis of {' or '.join(map(str, widths))}"
        return wrong

    def check(self, theta: Mapping[str, Tree]) -> None:
        """Refuse θ whose entries have wrong shapes or dtypes."""
        for name in self.reads(theta):
            if name not in theta:
                raise InputError(f"theta of {self!r} has no {name!r}; it has {sorted(theta)}")
            value, wrong = theta[name], self.expected(name, shape_of(theta[name]))
            if wrong is not None:
                raise InputError(f"theta[{name!r}] of {self!r} {described(value)}; expected {wrong}")
            if not namespace(value).isdtype(value.dtype, "real floating"):
                raise InputError(f"theta[{name!r}] of {self!r} has dtype {value.dtype}; expected a floating one")

    def reads(self, theta: Mapping[str, Tree]) -> tuple[str, ...]:
        """The entries of θ that `evaluate` needs."""
        return *self.shaped_by, *(name for name in ATTRIBUTES if name in theta)

    def proxy_inputs(self, theta: Mapping[str, Tree]) -> Array:
        """The control points."""
        return self.control_points(theta)

    def nets(self, inputs: np.ndarray) -> np.ndarray:
        """(n, 4, 4, 3) float64 control points of the Bézier patches."""
        points = self._finite(inputs)
        return self.bezier_rows(points)[self.table].reshape(-1, 4, 4, 3)

    def _finite(self, inputs: np.ndarray) -> np.ndarray:
        """The control points in float64, refused where one is no number."""
        points = np.asarray(inputs, np.float64)
        if not np.isfinite(points).all():
            bad = np.argwhere(~np.isfinite(points).all(axis=-1))
            raise InputError(
                f"{len(bad)} control points of {self!r} are NaN or infinite, the first is {tuple(bad[0].tolist())}; "
                f"check the input, or lower the step size if an optimisation led here"
            )
        return points

    # ------------------------------------------------------------------------------------------------ sampling

    def proxy_key(self, inputs: np.ndarray, camera: Camera, size: tuple[int, int]) -> Hashable:
        """The cell of views: so images do not depend on what was rendered before."""
        return view_key(camera, size, _center(self._finite(inputs)))

    def proxy(self, inputs: np.ndarray, camera: Camera, size: tuple[int, int]) -> Proxy:
        """Triangles that are off the surface by less than `tolerance` pixels near outlines, and coarse elsewhere."""
        from rts_surfaces import parametric_kernels

        nets = self.nets(inputs)
        center = _center(inputs)
        view = view_of(view_key(camera, size, center), center)
        allowed = np.empty(len(nets))
        cone = np.array([*view.axis, math.sin(min(view.angle, math.pi / 2)), math.cos(min(view.angle, math.pi / 2))])
        shapes = _shapes(nets)
        options = view.eye, view.parallel, view.move, view.spread, cone, self.tolerance, COARSE * self.tolerance
        parallel(parametric_kernels.outlines, len(nets), nets, *shapes[:2], *options, allowed, work=500 * len(nets))
        return self._triangles(nets, shapes, allowed)

    def tessellate(self, theta: Mapping[str, Tree], rate: int | float) -> tuple[np.ndarray, np.ndarray]:
        """A mesh whose vertices lie on the surface.

        Args:
            theta: θ, with values that are known.
            rate: a whole number, of cuts along each side of a patch; or a float, the distance in the units of θ that
                triangles may be off the surface.

        Returns:
            Vertices (V, 3) float32 and faces (T, 3) int32, without cracks between patches that share control points.

        Raises:
            InputError: a rate of zero or less, or θ of another shape.
        """
        self.check(theta)
        points = self.control_points(theta)
        nets = self.nets(np.asarray(engine_of(points).to_numpy(points)))
        if is_count(rate):
            inner = np.full((len(nets), 2), min(int(rate), MOST), np.int32)
            proxy = self._cut(nets, inner, np.full(self._edges.shape[0], inner[0, 0], np.int32))
        else:
            check_positive("rate", rate)
            proxy = self._triangles(nets, _shapes(nets), np.full(len(nets), float(rate)))
        a, b, c = (proxy.vertices[proxy.faces[:, i]] for i in range(3))
        return proxy.vertices, proxy.faces[(np.cross(b - a, c - a) != 0).any(axis=1)]

    def _triangles(self, nets: np.ndarray, shapes: tuple[np.ndarray, ...], allowed: np.ndarray) -> Proxy:
        from rts_surfaces import parametric_kernels

        count, (bends, curves) = self._edges.shape[0], shapes[2:]
        inner, edges = np.empty((len(nets), 2), np.int32), np.empty(count, np.int32)
        parametric_kernels.rates(bends, curves, allowed, self._sides, count, MOST, inner, edges)
        return self._cut(nets, inner, edges)

    def _cut(self, nets: np.ndarray, inner: np.ndarray, edges: np.ndarray) -> Proxy:
        """Triangles of patches that are cut so often within, and along their edges."""
        from rts_surfaces import parametric_kernels

        corners = len(self._corner_rows)
        edge_first = corners + np.concatenate([[0], np.cumsum(edges - 1)]).astype(np.int32)
        within = (inner[:, 0] - 1) * (inner[:, 1] - 1)
        inner_first = edge_first[-1] + np.concatenate([[0], np.cumsum(within)]).astype(np.int32)
        first = np.empty(len(nets) + 1, np.int32)
        parametric_kernels.counts(inner, self._sides, edges, first)
        flat = nets.reshape(-1, 3)
        rows = np.empty((int(self.table.max()) + 1, 3))
        rows[self.table.reshape(-1)] = flat
        vertices = np.empty((inner_first[-1], 3), np.float32)
        vertices[:corners] = rows[self._corner_rows]
        parametric_kernels.edge_points(rows[self._edges], edges, edge_first, vertices)
        total = int(first[-1])
        out = (
            vertices,
            np.empty((total, 3), np.int32),
            np.empty((total, 1), np.int32),
            np.empty((total, 3, 2), np.float32),
        )
        tables = self._corners, self._sides, self._flips, edges, edge_first, inner, inner_first, first, out
        parallel(parametric_kernels.triangles, len(nets), nets, *tables, work=30 * total)
        return Proxy(*out)

    def refine(self, inputs: np.ndarray, samples: Samples, rays: Rays) -> Samples:
        """(u, v) and depth where rays meet the patches, by Newton's method; what does not meet is dropped."""
        from rts_surfaces import parametric_kernels

        nets, count = self.nets(inputs), len(samples.ids)
        patch, params = samples.ids[:, 0].astype(np.int64), samples.params.astype(np.float64)
        depth, met = np.zeros(count), np.zeros(count, bool)
        ends = (np.ascontiguousarray(x, np.float64) for x in (rays.origins, rays.directions))
        limits = np.array([RESIDUAL, STEPS, LARGEST_STEP, BEYOND])
        spread = np.asarray(rays.spread, np.float64)
        parallel(
            parametric_kernels.newton, count, nets, patch, params, *ends, spread, limits, depth, met, work=600 * count
        )
        kept = samples.row >= 0
        kept &= met[samples.row]
        row = np.where(kept, samples.row, -1)
        params[~met] = 0
        return replace(samples, params=params, row=row, depth=np.where(kept, depth[samples.row], 0))

    # ---------------------------------------------------------------------------------------------- evaluation

    def evaluate(self, theta: Mapping[str, Tree], samples: Samples) -> GBuffer:
        """Positions, normals, and the attributes of control points."""
        points = self.control_points(theta)
        engine = engine_of(points, samples.params)
        xp = engine.namespace
        if not engine.owns(points):
            points = engine.constant(points, samples.params)
        params, patch = constants((samples.params, samples.ids[:, 0]), engine, points)
        params = xp.astype(params, points.dtype, copy=False)
        ids = xp.take(engine.constant(self.table, points), patch, axis=0)
        (a, da), (b, db) = (bernstein(params[:, i]) for i in range(2))
        rows = self.bezier_rows(points)
        gbuffer = GBuffer(position=combine(rows, ids, _products(a, b)))

        def normal() -> Array:
            along_u, along_v, mixed = (combine(rows, ids, _products(*w)) for w in ((da, b), (a, db), (da, db)))
            return _normal(along_u, along_v, mixed, params)

        gbuffer.defer("normal", normal)
        for name, (entry, _) in ATTRIBUTES.items():
            if name in theta:
                gbuffer.defer(entry, partial(self._attribute, theta[name], ids, a, b))
        return gbuffer

    def _attribute(self, values: Array, ids: Array, a: Array, b: Array) -> Array:
        return combine(self.bezier_rows(values), ids, _products(a, b))


def bernstein(t: Array) -> tuple[Array, Array]:
    """The four cubic Bernstein polynomials (N, 4) at (N,), and their derivatives."""
    xp, s = namespace(t), 1 - t
    value = xp.stack([s * s * s, 3 * s * s * t, 3 * s * t * t, t * t * t], axis=-1)
    slope = xp.stack([-3 * s * s, 3 * s * (s - 2 * t), 3 * t * (2 * s - t), 3 * t * t], axis=-1)
    return value, slope


def _products(a: Array, b: Array) -> Array:
    """(N, 16) weights of a patch's points from those along u (N, 4) and along v (N, 4)."""
    return namespace(a).reshape(a[:, :, None] * b[:, None, :], (-1, 16))


def _normal(along_u: Array, along_v: Array, mixed: Array, params: Array) -> Array:
    """Unit normals (N, 3).

    Where one side of a patch is a single point, one derivative is zero there, and rounding beside it. It grows as the
    mixed derivative: that has its direction.
    """
    xp = namespace(along_u)
    uu, vv = (xp.sum(x * x, axis=-1, keepdims=True) for x in (along_u, along_v))
    sign_u = xp.where(params[:, 0:1] < 0.5, xp.ones_like(uu), -xp.ones_like(uu))
    sign_v = xp.where(params[:, 1:2] < 0.5, xp.ones_like(vv), -xp.ones_like(vv))
    # Along a side v = 0 that is a point, the derivative in u is zero; along u = 0, that in v.
    first = xp.where(uu < COLLAPSED**2 * vv, sign_v * mixed, along_u)
    second = xp.where(vv < COLLAPSED**2 * uu, sign_u * mixed, along_v)
    return unit(xp.linalg.cross(first, second))


def _shapes(nets: np.ndarray) -> tuple[np.ndarray, ...]:
    """Normals and places (n, 5, 5, 3), bends (n, 3) and curves (n, 4) of patches."""
    from rts_surfaces import parametric_kernels

    count, grid = len(nets), parametric_kernels.GRID
    shapes = *np.empty((2, count, grid, grid, 3)), np.empty((count, 3)), np.empty((count, 4))
    parallel(parametric_kernels.shapes, count, nets, *shapes, work=8000 * count)
    return shapes


def _center(inputs: np.ndarray) -> np.ndarray:
    points = np.asarray(inputs, np.float64).reshape(-1, 3)
    return (points.min(axis=0) + points.max(axis=0)) / 2


def _edges_of(table: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Sides of patches (n, 4): which edge each is, whether it runs against it; and the edges' control points (E, 4).

    Sides run around the patch: v = 0, u = 1, v = 1 backwards, u = 0 backwards.
    """
    net = table.reshape(-1, 4, 4)
    sides = np.stack([net[:, :, 0], net[:, 3, :], net[:, ::-1, 3], net[:, 0, ::-1]], axis=1).reshape(-1, 4)
    # One direction for both patches beside an edge: that of the lesser control point first.
    back = sides[:, ::-1]
    differ = sides != back
    place = differ.argmax(axis=1)[:, None]
    flips = np.take_along_axis(sides, place, 1)[:, 0] > np.take_along_axis(back, place, 1)[:, 0]
    edges, index = np.unique(np.where(flips[:, None], back, sides), axis=0, return_inverse=True)
    return fixed(index.reshape(-1, 4).astype(np.int32)), fixed(flips.reshape(-1, 4).copy()), fixed(edges.copy())
