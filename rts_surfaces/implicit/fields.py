"""Ready-made fields f(θ, points (M, 3)) → (M,): signed distances, negative inside, and how fields are joined.

Each reads entries of θ by fixed names. Of two that share a name, give each its own dict:
`union(lambda theta, p: sphere(theta["left"], p), lambda theta, p: sphere(theta["right"], p))`.
All have finite derivatives everywhere, in θ as in points.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import reduce

from rts.arguments import check_positive
from rts.engines import namespace
from rts.errors import InputError
from rts.trees import Array, Tree
from rts_surfaces.entries import check_entry
from rts_surfaces.implicit.field import Function, check_function


def sphere(theta: Mapping[str, Tree], points: Array) -> Array:
    """The distance (M,) of points (M, 3) to a sphere: θ["center"] (3,), θ["radius"] ()."""
    center, radius = _entry(theta, "center", (3,)), _entry(theta, "radius", ())
    return _length(points - center) - radius


def swept_sphere(theta: Mapping[str, Tree], points: Array) -> Array:
    """The distance (M,) of points (M, 3) to a torus: a sphere that is swept along a circle about the origin (§4.5).

    θ["radii"] (2,) are the radius of the circle, which lies in the plane y = 0, and that of the sphere.
    """
    xp, radii = namespace(points), _entry(theta, "radii", (2,))
    out = _length(xp.stack([points[:, 0], points[:, 2]], axis=-1)) - radii[0]
    return _length(xp.stack([out, points[:, 1]], axis=-1)) - radii[1]


def union(*fields: Function) -> Function:
    """The field of all that is inside any of the fields: their least value.

    Raises:
        InputError: there is none, or one is no function.
    """
    _check_fields(fields)

    def joined(theta: Mapping[str, Tree], points: Array) -> Array:
        return reduce(namespace(points).minimum, (f(theta, points) for f in fields))

    return joined


def smooth_union(sharpness: float, *fields: Function) -> Function:
    """The `union` of n fields with a fillet where they meet: −log(Σ exp(−s fᵢ)) / s for a sharpness s.

    It is at most log(n) / s less than the union, and its slope nowhere exceeds the steepest of theirs.

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


def _entry(theta: Mapping[str, Tree], name: str, shape: tuple[int, ...]) -> Array:
    """An entry of θ, refused where it is missing or of another shape."""
    check_entry("the field", theta, name, lambda given: None if given == shape else str(shape or "a number"))
    return theta[name]


def _length(x: Array) -> Array:
    """The lengths (M,) of vectors (M, C); where one is zero, so is its derivative."""
    xp = namespace(x)
    square = xp.sum(x * x, axis=-1)
    positive = square > 0
    return xp.where(positive, xp.sqrt(xp.where(positive, square, 1.0)), 0.0)
