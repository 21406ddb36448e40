"""Ready-made fields f(θ, points (M, 3)) → (M,): signed distances, negative inside, and unions of fields.

Each field reads entries of θ by fixed names. If two fields share a name, give each its own dict:
`union(lambda theta, p: sphere(theta["left"], p), lambda theta, p: sphere(theta["right"], p))`.
All have finite derivatives everywhere, both in θ and in points; unions have them if their fields do.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import reduce

from rts import InputError, engine_of, namespace
from rts.plugin_api.arrays import Array, Tree
from rts.plugin_api.checks import check_positive
from rts.plugin_api.operations import take
from rts_surfaces.implicit.field import Function, check_function
from rts_surfaces.parameter_checks import check_entry

BLOCK = 2048
"""The number of points whose distances to all spheres are in memory at once."""


def sphere(theta: Mapping[str, Tree], points: Array) -> Array:
    """The signed distance (M,) of points (M, 3) to a sphere: θ["center"] (3,), θ["radius"] ()."""
    center, radius = _entry(theta, "center", (3,)), _entry(theta, "radius", ())
    return _length(points - center) - radius


def swept_sphere(theta: Mapping[str, Tree], points: Array) -> Array:
    """The signed distance (M,) of points (M, 3) to a torus: a sphere swept along a circle about the origin (§4.5).

    θ["radii"] (2,) are the radius of the circle, which lies in the plane y = 0, and that of the sphere.
    """
    xp, radii = namespace(points), _entry(theta, "radii", (2,))
    out = _length(xp.stack([points[:, 0], points[:, 2]], axis=-1)) - radii[0]
    return _length(xp.stack([out, points[:, 1]], axis=-1)) - radii[1]


def spheres(theta: Mapping[str, Tree], points: Array) -> Array:
    """The least signed distance (M,) of points (M, 3) to n spheres, whose centres lie in the plane y = 0.

    θ["centers"] (n, 2) are x and z, θ["radii"] (n,) the radii. The derivative is that of the nearest sphere. The search
    for it has no derivatives, and goes by blocks of `BLOCK` points, so its memory is of the order of n.
    """
    xp, centers = namespace(points), _entry(theta, "centers", ("n", 2))
    radii = _entry(theta, "radii", (centers.shape[0],))
    stop = engine_of(points).stop_gradient
    table = xp.concat([centers, radii[:, None]], axis=1)
    nearest = take(table, _nearest(stop(points), stop(centers), stop(radii)))
    x, y, z = (points[:, i] for i in range(3))
    return _length(xp.stack([x - nearest[:, 0], y, z - nearest[:, 1]], axis=1)) - nearest[:, 2]


def union(*fields: Function) -> Function:
    """The field whose inside is all that is inside any of the fields: their least value.

    Raises:
        InputError: there is no field, or one is no function.
    """
    _check_fields(fields)

    def joined(theta: Mapping[str, Tree], points: Array) -> Array:
        return reduce(namespace(points).minimum, (f(theta, points) for f in fields))

    return joined


def smooth_union(sharpness: float, *fields: Function) -> Function:
    """The `union` of n fields with a fillet where they meet: −log(Σ exp(−s fᵢ)) / s for a sharpness s.

    It is less than the union by at most log(n) / s, and its slope nowhere exceeds that of the steepest field.

    Args:
        sharpness: s, in units of one over those of the fields; positive.
        *fields: the fields.

    Raises:
        InputError: s is not positive, there is no field, or one is no function.
    """
    check_positive("sharpness", sharpness)
    _check_fields(fields)

    def joined(theta: Mapping[str, Tree], points: Array) -> Array:
        xp = namespace(points)
        values = xp.stack([f(theta, points) for f in fields])
        least = xp.min(values, axis=0)
        return least - xp.log(xp.sum(xp.exp(sharpness * (least - values)), axis=0)) / sharpness

    return joined


def _check_fields(fields: tuple[Function, ...]) -> None:
    if not fields:
        raise InputError("no fields are given; expected one or more functions of theta and points (M, 3)")
    for i, f in enumerate(fields):
        check_function(f"field {i}", f)


def _nearest(points: Array, centers: Array, radii: Array) -> Array:
    """The index (M,) int32 of the sphere with the least signed distance to each point (M, 3).

    `centers` (n, 2) are x and z in the plane y = 0, `radii` is (n,).
    """
    engine = engine_of(points)
    xp = engine.namespace
    # |p − c|² = (−2 c, 1, |c|²) · (p, |p|², 1), in blocks that stay in the cache.
    of_points, of_centers = (xp.sum(x * x, axis=1, keepdims=True) for x in (points, centers))
    rows = xp.concat([points[:, :1], points[:, 2:], of_points, xp.ones_like(of_points)], axis=1)
    columns = xp.concat([-2 * centers, xp.ones_like(of_centers), of_centers], axis=1).T

    def nearest(rows: Array) -> Array:
        return xp.argmin(xp.sqrt(xp.clip(engine.product(rows, columns), 0, None)) - radii, axis=1)

    return xp.astype(engine.map_rows(nearest, rows, BLOCK), xp.int32)


def _entry(theta: Mapping[str, Tree], name: str, shape: tuple[int | str, ...]) -> Array:
    """The entry of θ; refused if missing or of another shape, in which a letter is for any length but 0."""

    def expected(actual: tuple[int, ...]) -> str | None:
        pairs = zip(actual, shape, strict=False)
        fits = len(actual) == len(shape) and all(g == s or (isinstance(s, str) and g > 0) for g, s in pairs)
        return None if fits else f"({', '.join(map(str, shape))}{',' * (len(shape) == 1)})"

    check_entry("the field", theta, name, expected)
    return theta[name]


def _length(x: Array) -> Array:
    """The lengths (M,) of vectors (M, C); where one is zero, so is its derivative."""
    xp = namespace(x)
    square = xp.sum(x * x, axis=-1)
    positive = square > 0
    return xp.where(positive, xp.sqrt(xp.where(positive, square, 1.0)), 0.0)
