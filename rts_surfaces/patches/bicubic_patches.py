"""Surfaces of bicubic patches, in Bézier form: 16 control points each, named by a table, and linear in θ."""

from __future__ import annotations

import abc
from collections.abc import Iterator, Mapping
from functools import partial

import numpy as np

from rts import GBuffer, engine_of
from rts.plugin_api.arrays import Array, Tree, constants
from rts.plugin_api.operations import tangent_along
from rts.plugin_api.records import Rays, Samples
from rts.plugin_api.threads import parallel, read_only
from rts_surfaces.parameter_checks import G_BUFFER_NAMES, WIDTHS, check_entry
from rts_surfaces.patches.bicubic import normals, slopes, values
from rts_surfaces.patches.parametric import LIMITS, Geometry, Parametric
from rts_surfaces.patches.tiles import Tiles

ATTRIBUTES = ("colors", "uv")
"""Entries of θ for control points."""


class Bicubic(Geometry):
    """Bézier patches for given control points.

    Args:
        nets: (n, 4, 4, 3) float64, the control points, first along u, then along v.
        across: (n, 4) int32, the result of `sides_across`.
        flips: (n, 4) bool, the `flips` of the patches as `Tiles`.
    """

    def __init__(self, nets: np.ndarray, across: np.ndarray, flips: np.ndarray):
        from rts_surfaces.patches import bicubic_loops

        self.nets, self.powers = nets, bicubic_loops.powers(nets)
        self.across, self.flips = across, flips

    def points(self, patch: np.ndarray, params: np.ndarray, order: int) -> np.ndarray:
        """See `Geometry`."""
        from rts_surfaces.patches import bicubic_loops

        loop, width = (bicubic_loops.expansions, 6) if order else (bicubic_loops.points, 1)
        out = np.empty((len(patch), width, 3))
        parallel(loop, len(patch), self.powers, patch, params, out, work=40 * width * len(patch))
        return out

    def meet(self, samples: Samples, rays: Rays) -> Samples:
        """See `Geometry`."""
        from rts_surfaces.patches import ray_patch_loops

        bounds = np.empty((len(self.nets), 3))
        ray_patch_loops.bounds(self.nets, bounds)
        ids, params, row, depth = (np.array(x) for x in (samples.ids, samples.params, samples.row, samples.depth))
        lines = row.reshape(-1, row.shape[2]), depth.reshape(-1, row.shape[2])
        rays = Rays(*(np.ascontiguousarray(x, np.float64) for x in rays))
        patches = ray_patch_loops.Joined(self.powers, bounds, self.across, self.flips)
        arguments = patches, ids, params, *lines, rays, LIMITS
        parallel(ray_patch_loops.meet, len(lines[0]), *arguments, work=200 * len(samples.ids))
        return samples.replace(ids=ids, params=params, row=row, depth=depth)


class Patches(Parametric):
    """Base of surfaces of bicubic patches.

    Args:
        table: (n, 16) integers, the control points of each Bézier patch, first along u, then along v, as rows of the
            result of `bezier_rows`.
        tolerance: the largest distance of triangles from the surface near outlines, pixels.
        used: see `Parametric`.

    Attributes:
        shaped_by: the entries of θ from which control points are computed.
    """

    shaped_by: tuple[str, ...] = ("points",)

    def __init__(self, table: np.ndarray, tolerance: float, used: np.ndarray | None = None):
        self.table = read_only(np.array(table, np.int32))
        super().__init__(_tiles(self.table), tolerance, used)
        self.across = read_only(sides_across(self.whole.sides))

    @abc.abstractmethod
    def bezier_rows(self, controls: Array) -> Array:
        """Values (M, C) at the control points of the Bézier patches, linear in `controls`.

        `controls` (…, C) are those of an entry of θ, in any engine, or NumPy in float64.
        """

    @abc.abstractmethod
    def control_shape(self, shape: tuple[int, ...]) -> str | None:
        """The expected shape of an entry of θ, in words; None if `shape`, that of all but its last axis, is right."""

    def control_points(self, theta: Mapping[str, Tree]) -> Array:
        """The control points, as `bezier_rows` takes them."""
        return theta["points"]

    def expected(self, name: str, shape: tuple[int, ...]) -> str | None:
        """The expected shape of the entry `name` of θ, in words; None if `shape` is right."""
        wrong = self.control_shape(shape[:-1]) if shape else "an array"
        if wrong is None and shape[-1] not in WIDTHS[name]:
            return f"a last axis of {' or '.join(map(str, WIDTHS[name]))}"
        return wrong

    def check(self, theta: Mapping[str, Tree]) -> None:
        """Refuse θ that lacks an entry of `reads`, or has one of wrong shape or dtype."""
        for name in self.reads(theta):
            check_entry(repr(self), theta, name, partial(self.expected, name))

    def reads(self, theta: Mapping[str, Tree]) -> tuple[str, ...]:
        """The entries of θ that `evaluate` needs."""
        return *self.shaped_by, *(name for name in ATTRIBUTES if name in theta)

    def nets(self, points: np.ndarray) -> np.ndarray:
        """(n, 4, 4, 3) float64 control points of the Bézier patches, for `points` as `control_points` returns them."""
        return self.bezier_rows(np.asarray(points, np.float64))[self.table].reshape(-1, 4, 4, 3)

    def geometry(self, points: np.ndarray) -> Geometry:
        """See `Parametric`."""
        return Bicubic(self.nets(points), self.across, self.whole.flips)

    def evaluate(self, theta: Mapping[str, Tree], samples: Samples) -> GBuffer:
        """Positions, normals, and those of `ATTRIBUTES` that θ has."""
        points = self.control_points(theta)
        engine = engine_of(points, samples.params)
        if not engine.owns(points):
            points = engine.constant(points, samples.params)
        params, patch = constants((samples.params, samples.ids[:, 0]), engine, points)
        params = engine.namespace.astype(params, points.dtype, copy=False)
        where = engine.constant(self.table, points), patch, params
        rows = self.bezier_rows(points)
        gbuffer = GBuffer(position=values(rows, *where))
        gbuffer.defer("normal", lambda: normals(rows, *where))
        for name in ATTRIBUTES:
            if name in theta:
                gbuffer.defer(G_BUFFER_NAMES.get(name, name), partial(self._attribute, theta[name], where))
        if "uv" in theta:
            pairs = partial(self._slopes, rows, theta["uv"], where)
            gbuffer.defer("tangent", lambda: tangent_along(gbuffer["normal"], *pairs()))
        return gbuffer

    def _slopes(self, rows: Array, uv: Array, where: tuple[Array, Array, Array]) -> Iterator[tuple[Array, Array]]:
        """Derivatives of position and uv, first along the first parameter."""
        return zip(slopes(rows, *where), slopes(self.bezier_rows(uv), *where), strict=True)

    def _attribute(self, attribute: Array, where: tuple[Array, Array, Array]) -> Array:
        return values(self.bezier_rows(attribute), *where)


def sides_across(sides: np.ndarray) -> np.ndarray:
    """The side beyond each side, (n, 4) int32, by its number 4 × patch + side; −1 at the border of the surface.

    Where m > 2 sides share an edge, in order of their numbers, each leads to the one ⌊m / 2⌋ after it, cyclically. So
    a side that is a single point leads to the patch on the other side of the point.

    Args:
        sides: (n, 4), the edge of each side, as in `Tiles`.
    """
    flat = sides.reshape(-1)
    order = np.argsort(flat, kind="stable")
    count = np.bincount(flat)[flat[order]]
    first = np.searchsorted(flat[order], flat[order])
    other = order[first + (np.arange(len(flat)) - first + count // 2) % count]
    beyond = np.empty(len(flat), np.int32)
    beyond[order] = np.where(count > 1, other, -1)
    return beyond.reshape(sides.shape)


def _tiles(table: np.ndarray) -> Tiles:
    """Patches (n, 16) as tiles; sides are one edge if they have the same four control points, forwards or backwards."""
    net, count = table.reshape(-1, 4, 4), len(table)
    # Sides run around the patch: v = 0, u = 1, v = 1 backwards, u = 0 backwards.
    sides = np.stack([net[:, :, 0], net[:, 3, :], net[:, ::-1, 3], net[:, 0, ::-1]], axis=1).reshape(-1, 4)
    # An edge has one direction for both patches beside it: towards the greater control point, by number.
    back = sides[:, ::-1]
    place = (sides != back).argmax(axis=1)[:, None]
    flips = np.take_along_axis(sides, place, 1)[:, 0] > np.take_along_axis(back, place, 1)[:, 0]
    _, edge = np.unique(np.where(flips[:, None], back, sides), axis=0, return_inverse=True)
    frames = np.broadcast_to(np.array([(0.0, 0), (1, 0), (0, 1)]), (count, 3, 2))
    corners = table[:, [0, 12, 15, 3]]
    return Tiles.of(np.arange(count), frames, corners, edge.reshape(count, 4), flips.reshape(count, 4))
