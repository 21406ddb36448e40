"""Uniform bicubic B-spline surfaces on a grid of control points."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from rts import InputError, Part, engine_of, namespace
from rts.plugin_api.arrays import Array, Tree, from_numbers, shape_of
from rts.plugin_api.checks import check_numbers, is_count, quoted
from rts.plugin_api.threads import read_only
from rts_surfaces.patches.bicubic_patches import Patches
from rts_surfaces.patches.parametric import TOLERANCE

ENDS = ("open", "clamped", "periodic")


class BSpline(Patches):
    """A uniform bicubic B-spline surface.

    θ["points"] (nu, nv, 3) are the control points. "colors" (nu, nv, 1, 3 or 4) and "uv" (nu, nv, 2) are attributes of
    control points, interpolated as they are. The normal is the cross product of the derivatives along u and v, in this
    order.

    Args:
        shape: (nu, nv), the numbers of control points, at least 4 in each direction.
        ends: "open", "clamped" or "periodic", or a pair of these for u and v. An open spline ends between its control
            points, a clamped one at its first and last, and a periodic one is closed.
        tolerance: the largest distance of triangles from the surface near outlines, pixels.

    Raises:
        InputError: fewer than 4 control points, other ends, or a tolerance that is not positive.
    """

    def __init__(self, shape: tuple[int, int], ends: str | tuple[str, str] = "clamped", tolerance: float = TOLERANCE):
        if not (isinstance(shape, (tuple, list)) and len(shape) == 2 and all(map(is_count, shape)) and min(shape) >= 4):
            raise InputError(f"shape is {quoted(shape)}; expected (nu, nv), two integers of at least 4")
        both = (ends, ends) if isinstance(ends, str) else ends
        if not (isinstance(both, (tuple, list)) and len(both) == 2 and all(map(_is_end, both))):
            raise InputError(f"ends is {quoted(ends)}; expected one of {', '.join(ENDS)}, or two of them")
        self.shape, self.ends = (int(shape[0]), int(shape[1])), (both[0], both[1])
        self._along = [read_only(extraction(n, end)) for n, end in zip(self.shape, self.ends, strict=True)]
        (mu, mv), steps = (len(m) for m in self._along), np.arange(4)
        spans = [n if end == "periodic" else n - 3 for n, end in zip(self.shape, self.ends, strict=True)]
        rows, columns = (3 * np.arange(s)[:, None] + steps for s in spans)
        table = (rows % mu)[:, None, :, None] * mv + (columns % mv)[None, :, None, :]
        super().__init__(table.reshape(-1, 16), tolerance)

    def __repr__(self) -> str:
        return f"BSpline({self.shape[0]} x {self.shape[1]} points, {' and '.join(dict.fromkeys(self.ends))})"

    @classmethod
    def example(cls) -> Part:
        """A vase: clamped along its height, periodic around it."""
        radii, heights = np.array([0.5, 0.9, 0.8, 0.3, 0.45, 0.75]), np.linspace(-1, 1, 6)
        angle = 2 * np.pi * np.arange(8) / 8
        around = np.stack([np.cos(angle), 0 * angle, -np.sin(angle)], axis=-1)
        points = radii[:, None, None] * around + heights[:, None, None] * np.array([0, 1, 0])
        points = points[::-1].astype(np.float32)
        colors = 0.5 + 0.4 * np.sin(2 * points + [0, 1, 2])
        return Part(
            cls((6, 8), ("clamped", "periodic")), {"points": points, "colors": colors.astype(np.float32)}, "lambert"
        )

    def bezier_rows(self, controls: Array) -> Array:
        """Values (M, C) at the Bézier control points of all patches, from those at control points, (nu, nv, C).

        They come by knot insertion, whose weights are ≥ 0.
        """
        xp, engine = namespace(controls), engine_of(controls)
        a, b = (engine.constant(m, controls) for m in self._along)
        (nu, nv, width), (mu, mv) = controls.shape, (len(m) for m in self._along)
        rows = xp.reshape(engine.product(a, xp.reshape(controls, (nu, nv * width))), (mu, nv, width))
        rows = xp.reshape(xp.permute_dims(rows, (1, 0, 2)), (nv, mu * width))
        rows = xp.reshape(engine.product(b, rows), (mv, mu, width))
        return xp.reshape(xp.permute_dims(rows, (1, 0, 2)), (mu * mv, width))

    def control_shape(self, shape: tuple[int, ...]) -> str | None:
        """See `Patches`: exactly (nu, nv), the shape of the grid."""
        return None if shape == self.shape else f"({self.shape[0]}, {self.shape[1]}, C)"


class Revolution(BSpline):
    """A profile curve swept around the y axis: a periodic B-spline, which is very nearly a surface of revolution.

    θ["radii"] (n,) are the distances of the profile's control points from the axis. In planes through the axis and
    control points the surface is the B-spline of radii and heights; between these planes it is nearer to the axis, by
    0.12 % with 8 points around, by 0.007 % with 16. "colors" (n, count, 1, 3 or 4) and "uv" (n, count, 2) are
    attributes of control points. Normals point away from the axis where heights grow.

    Args:
        heights: (n,) numbers, the y of the profile's control points, at least 4.
        count: the number of control points around the axis, at least 4.
        ends: "clamped" or "open" for the ends of the profile.
        tolerance: the largest distance of triangles from the surface near outlines, pixels.

    Raises:
        InputError: fewer than 4 control points, other ends, or a tolerance that is not positive.
    """

    shaped_by = ("radii",)

    def __init__(self, heights: ArrayLike, count: int = 8, ends: str = "clamped", tolerance: float = TOLERANCE):
        if not is_count(count) or count < 4:
            raise InputError(f"count is {quoted(count)}; expected an integer of at least 4")
        shape = shape_of(from_numbers(heights, "heights"))
        if len(shape) != 1 or shape[0] < 4:
            raise InputError(f"heights is {quoted(heights)}; expected (n,), at least 4 numbers")
        heights = np.asarray(check_numbers("heights", heights, shape), np.float64)
        super().__init__((len(heights), count), (ends, "periodic"), tolerance)
        angle = 2 * np.pi * np.arange(count) / count
        # A closed spline runs inside its control points; at a control point's angle it must have that point's radius.
        reach = 3 / (2 + np.cos(2 * np.pi / count))
        around = np.stack([np.cos(angle), np.zeros(count), np.sin(angle)], axis=-1) * reach
        self._around, self._up = (
            read_only(around[None]),
            read_only(heights[:, None, None] * np.array([[[0.0, 1.0, 0.0]]])),
        )

    def __repr__(self) -> str:
        return f"Revolution({self.shape[0]} radii)"

    @classmethod
    def example(cls) -> Part:
        """A pawn."""
        radii = np.array([0.7, 0.75, 0.3, 0.25, 0.2, 0.55, 0.5, 0.0], np.float32)
        return Part(cls(np.linspace(-1, 1, 8)), {"radii": radii}, "normals")

    def control_points(self, theta: Mapping[str, Tree]) -> Array:
        """Control points (n, count, 3) of the surface, from the radii in θ."""
        radii = theta["radii"]
        engine = engine_of(radii)
        return radii[:, None, None] * engine.constant(self._around, radii) + engine.constant(self._up, radii)

    def expected(self, name: str, shape: tuple[int, ...]) -> str | None:
        """See `Patches`; for "radii" the shape is (n,)."""
        if name != "radii":
            return super().expected(name, shape)
        return None if shape == self.shape[:1] else f"({self.shape[0]},)"


def _is_end(end: Any) -> bool:
    return isinstance(end, str) and end in ENDS


def extraction(count: int, ends: str) -> np.ndarray:
    """Weights (M, count) that make the control points of cubic Bézier pieces from those of a uniform cubic B-spline.

    Pieces share their end points: M is three times the number of pieces, and one more unless periodic.

    Args:
        count: the number of control points.
        ends: "open", "clamped" or "periodic".
    """
    if ends == "periodic":
        rows = np.zeros((3 * count, count))
        for k in range(count):
            a, b, c = k, (k + 1) % count, (k + 2) % count
            for row, weights in ((3 * k, (1, 4, 1)), (3 * k + 1, (0, 4, 2)), (3 * k + 2, (0, 2, 4))):
                np.add.at(rows[row], [a, b, c], np.array(weights) / 6)
        return rows
    spans = count - 3
    knots = np.arange(-3.0, spans + 4)
    if ends == "clamped":
        knots = knots.clip(0, spans)
    rows = np.empty((3 * spans + 1, count))
    for k in range(spans):
        for i in range(4):
            rows[3 * k + i] = _blossom(knots, k, [k] * (3 - i) + [k + 1] * i, count)
    return rows


def _blossom(knots: np.ndarray, span: int, arguments: list[int], count: int) -> np.ndarray:
    """The weights (count,) of control points in the polar form (blossom) of one piece, by de Boor's recursion.

    Args:
        knots: (count + 4,), the knots, in increasing order.
        span: the number of the piece, from 0 on: it lies between knots `span + 3` and `span + 4`.
        arguments: the three arguments of the polar form; (t, t, t) gives the point at t.
        count: the number of control points.
    """
    points = np.zeros((4, count))
    points[np.arange(4), span + np.arange(4)] = 1
    for level, t in enumerate(arguments, start=1):
        for i in range(4 - level):
            low, high = knots[span + i + level], knots[span + i + 4]
            w = (t - low) / (high - low)
            points[i] = (1 - w) * points[i] + w * points[i + 1]
    return points[0]
