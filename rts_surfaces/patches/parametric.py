"""Surfaces of parametric patches: triangles as fine as the view needs, samples moved onto the true surface.

A sample is the number of a patch and (u, v) in this patch.
"""

from __future__ import annotations

import abc
import copy
from collections.abc import Hashable, Mapping, Sequence
from typing import Any

import numpy as np

from rts import Camera, InputError, TriangleSurface, engine_of
from rts.plugin_api.arrays import Array, Tree
from rts.plugin_api.checks import check_positive, is_count
from rts.plugin_api.records import Proxy, Rate, Rays, Samples
from rts_surfaces.patches.tile_triangles import Allowed, Shapes, allowed_in, by_error, shapes, triangles, uniform
from rts_surfaces.patches.tiles import MOST, Tiles, split
from rts_surfaces.patches.view_cells import view_key, view_of

TOLERANCE = 0.1
"""The largest distance of a triangle from the surface where there may be an outline, pixels."""

TOLERANCES = (0.8, 0.3, 0.1, 0.05)
"""Tolerances, in pixels, that `Parametric.rates` offers."""

RESIDUAL, STEPS, LARGEST_STEP, BEYOND, CROSSINGS = 1e-4, 6, 0.25, 0.02, 8
"""Newton's method: distance in pixels that a sample may be off its ray; largest number of steps; largest step, and
largest distance of a sample beyond the edge of its patch, both in parameters; and how many edges may be crossed."""
LIMITS = np.array([RESIDUAL, STEPS, LARGEST_STEP, BEYOND, CROSSINGS])


class Geometry(abc.ABC):
    """The patches of a surface for some control points, on the host, in float64."""

    @abc.abstractmethod
    def points(self, patch: np.ndarray, params: np.ndarray, order: int) -> np.ndarray:
        """Points of the surface, with derivatives if `order` is 2; see `rts_surfaces.patches.tiles.Points`."""

    @abc.abstractmethod
    def meet(self, samples: Samples, rays: Rays) -> Samples:
        """Samples moved onto their rays, by Newton's method with `LIMITS`; they may change patch.

        Args:
            samples: ids (N, 1), params (N, 2), row and depth (K, H, W), from which the method starts; not changed.
            rays: the ray of each of the N samples, float64.

        Returns:
            The samples, in the same N rows. Where a ray does not meet the surface, `row` is −1, the depth is zero, and
            so are the sample's params.
        """


class Parametric(TriangleSurface):
    """Base of surfaces of parametric patches.

    Args:
        tiles: all patches.
        tolerance: the largest distance of triangles from the surface near outlines, pixels.
        used: rows of the control points that patches use; None for all rows.

    Attributes:
        whole: the patches as tiles.
        tiles: the patches in smaller tiles, if there are few patches.
        coarse: how many times the tolerance triangles may be off the surface away from outlines: there they only give
            Newton's method its start.
        beside: distance from the border of a tile, as a share of its size, from which on its shape is measured. More
            than 0 if second derivatives have no bound at the border, or are large on very little of a tile.
    """

    sample_widths = (1, 2)
    coarse = 10.0
    beside = 0.0

    def __init__(self, tiles: Tiles, tolerance: float, used: np.ndarray | None = None):
        check_positive("tolerance", tolerance)
        self.whole, self.tiles, self.tolerance, self.used = tiles, split(tiles), float(tolerance), used

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Make a copy's tables read-only, too."""
        vars(self).update(state)
        for value in state.values():
            for array in value if isinstance(value, tuple) else (value,):
                if isinstance(array, np.ndarray):
                    array.flags.writeable = False

    def rates(self, theta: Mapping[str, Tree]) -> Sequence[Rate]:
        """The surface at each of `TOLERANCES` but its own."""
        offered = []
        for tolerance in TOLERANCES:
            if tolerance != self.tolerance:
                other = copy.copy(self)
                other.tolerance = tolerance
                offered.append(Rate(f"tolerance={tolerance:g}", self.tolerance / tolerance, other))
        return offered

    def uniform(self, rate: int) -> tuple[np.ndarray, np.ndarray]:
        """Rates of the edges (E,) and the insides (n, 2) of `whole`, for sides of patches cut into `rate` pieces."""
        return uniform(self.whole, rate)

    @abc.abstractmethod
    def control_points(self, theta: Mapping[str, Tree]) -> Array:
        """The control points (..., 3)."""

    @abc.abstractmethod
    def geometry(self, points: np.ndarray) -> Geometry:
        """The patches for control points (..., 3) float64, which are finite."""

    def proxy_inputs(self, theta: Mapping[str, Tree]) -> Array:
        """The control points."""
        return self.control_points(theta)

    def proxy_key(self, inputs: np.ndarray, camera: Camera, size: tuple[int, int]) -> Hashable:
        """The cell of views that holds the camera: all views in it have the same triangles.

        Raises:
            InputError: control points that are NaN or infinite.
        """
        return view_key(camera, size, self._center(self.finite(inputs)))

    def proxy(self, inputs: np.ndarray, camera: Camera, size: tuple[int, int]) -> Proxy:
        """Triangles that are off the surface by about `tolerance` pixels at most near outlines.

        Elsewhere they may be off by `coarse` times as much. They fit all views of the camera's cell, see `proxy_key`.

        Raises:
            InputError: control points that are NaN or infinite, or too many triangles.
        """
        points = self.finite(inputs)
        geometry, center = self.geometry(points), self._center(points)
        tile_shapes = self.shapes(geometry)
        view = view_of(view_key(camera, size, center), center)
        allowed = allowed_in(view, tile_shapes, self.tolerance, self.coarse * self.tolerance)
        return triangles(self.tiles, geometry.points, *by_error(self.tiles, tile_shapes, allowed))

    def shapes(self, geometry: Geometry) -> Shapes:
        """The shapes of the smaller tiles, `tiles`."""
        return shapes(self.tiles, geometry.points, self.beside)

    def tessellate(self, theta: Mapping[str, Tree], rate: int | float) -> tuple[np.ndarray, np.ndarray]:
        """A mesh whose vertices lie on the surface.

        Args:
            theta: θ, not traced.
            rate: an integer, the number of pieces into which each side of a patch is cut, at most `tiles.MOST`: more
                count as that; or a float, the largest distance of triangles from the surface, in the units of θ.

        Returns:
            Vertices (V, 3) float32 and faces (T, 3) int32, without cracks between patches that share control points.
            Faces of no area are left out.

        Raises:
            InputError: a rate of zero or less, θ of another shape, control points that are not finite, or too many
                triangles.
        """
        self.check(theta)
        points = self.control_points(theta)
        geometry = self.geometry(self.finite(np.asarray(engine_of(points).to_numpy(points))))
        if is_count(rate):
            tiles, cuts = self.whole, self.uniform(min(int(rate), MOST))
        else:
            check_positive("rate", rate)
            tiles, tile_shapes = self.tiles, self.shapes(geometry)
            cuts = by_error(tiles, tile_shapes, Allowed.everywhere(len(tile_shapes.bends), float(rate)))
        proxy = triangles(tiles, geometry.points, *cuts)
        vertices = np.asarray(proxy.vertices, np.float32)
        a, b, c = (vertices[proxy.faces[:, i]] for i in range(3))
        return vertices, proxy.faces[(np.cross(b - a, c - a) != 0).any(axis=1)]

    def refine(self, inputs: np.ndarray, samples: Samples, rays: Rays) -> Samples:
        """Samples moved to where their rays meet the patches, by Newton's method; `row` is −1 where a ray misses.

        Raises:
            InputError: control points that are NaN or infinite.
        """
        return self.geometry(self.finite(inputs)).meet(samples, rays)

    def finite(self, inputs: np.ndarray) -> np.ndarray:
        """The control points in float64; an InputError if one is NaN or infinite."""
        points = np.asarray(inputs, np.float64)
        if not np.isfinite(points).all():
            bad = np.argwhere(~np.isfinite(points).all(axis=-1))
            raise InputError(
                f"{len(bad)} control points of {self!r} are NaN or infinite, the first is {tuple(bad[0].tolist())}; "
                f"check the input, or lower the step size if an optimisation led here"
            )
        return points

    def _center(self, points: np.ndarray) -> np.ndarray:
        rows = points.reshape(-1, 3)
        rows = rows if self.used is None else rows[self.used]
        return (rows.min(axis=0) + rows.max(axis=0)) / 2
