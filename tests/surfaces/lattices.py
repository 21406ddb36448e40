"""Fields that tests of isosurfaces share."""

import numpy as np

import rts

BOUNDS = ((-1.1, -1.0, -1.05), (1.0, 1.1, 1.15))
"""No lattice point lies where anything is symmetric."""


def BALL(points):
    """The distance of points (..., 3) to a ball."""
    return np.linalg.norm(points, axis=-1) - 0.7


def TORUS(points):
    """The distance to a torus about the y-axis."""
    return np.hypot(np.hypot(points[..., 0], points[..., 2]) - 0.6, points[..., 1]) - 0.25


def torus(theta, points):
    """The distance (M,) to a torus about the y-axis, of θ["radii"] (2,), in array code."""
    xp = rts.namespace(points)
    x, y, z = (points[:, i] for i in range(3))
    from_axis = xp.sqrt(x * x + z * z + 1e-12) - theta["radii"][0]
    return xp.sqrt(from_axis * from_axis + y * y + 1e-12) - theta["radii"][1]


def ball(theta, points):
    """The distance (M,) to a ball of θ["radius"] ()."""
    xp = rts.namespace(points)
    return xp.sqrt(xp.sum(points * points, axis=-1) + 1e-12) - theta["radius"]


def on_lattice(field, count, bounds=BOUNDS):
    """The values (n, n, n) float32 of a field, and the bounds of the lattice."""
    shape = (count,) * 3 if isinstance(count, int) else count
    axes = [np.linspace(a, b, n) for a, b, n in zip(*bounds, shape, strict=True)]
    return field(np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)).astype(np.float32), bounds
