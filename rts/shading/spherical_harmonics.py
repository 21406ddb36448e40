"""Real spherical harmonics up to order 3, and light that they describe."""

from __future__ import annotations

import numpy as np

from rts.arrays.engines import engine_of, namespace
from rts.arrays.trees import Array

COUNTS = (1, 4, 9, 16)
"""Numbers of harmonics up to the orders 0 to 3."""
DIFFUSE = np.array([1, 2 / 3, 1 / 4])
"""Factors of the orders 0, 1 and 2 by which a cosine, divided by π, blurs light (Ramamoorthi and Hanrahan 2001)."""


def harmonics(directions: Array, count: int) -> Array:
    """Orthonormal real spherical harmonics (N, count) of unit vectors (N, 3), in the order l² + l + m.

    The pole is z, and there is no Condon–Shortley phase: 1, y, z, x, xy, yz, 3z² − 1, xz, x² − y², and so on, times
    positive constants.

    Args:
        directions: (N, 3), of unit length.
        count: 1, 4, 9 or 16, for the orders up to 0, 1, 2 or 3.
    """
    xp = namespace(directions)
    x, y, z = (directions[:, i] for i in range(3))
    values = [0.28209479177387814 * xp.ones_like(x)]
    if count > 1:
        values += [0.4886025119029199 * c for c in (y, z, x)]
    if count > 4:
        values += [1.0925484305920792 * c for c in (x * y, y * z)]
        values += [0.31539156525252005 * (3 * z * z - 1), 1.0925484305920792 * x * z]
        values += [0.5462742152960396 * (x * x - y * y)]
    if count > 9:
        a, b, c = 0.5900435899266435, 2.890611442640554, 0.4570457994644658
        values += [a * y * (3 * x * x - y * y), b * x * y * z, c * y * (5 * z * z - 1)]
        values += [0.3731763325901154 * z * (5 * z * z - 3), c * x * (5 * z * z - 1)]
        values += [0.5 * b * z * (x * x - y * y), a * x * (x * x - 3 * y * y)]
    return xp.stack(values, axis=1)


def radiance(sh: Array, directions: Array, factors: Array) -> Array:
    """Light (N, 3) from unit directions (N, 3), for coefficients (n, 3) of `harmonics`; never below zero.

    Args:
        sh: (n, 3), n = 1, 4, 9 or 16.
        directions: (N, 3).
        factors: (k,) or (N, k), of the first k orders; others have no part in the result.
    """
    engine, count = engine_of(sh, directions), min(sh.shape[0], factors.shape[-1] ** 2)
    xp = engine.namespace
    orders = engine.constant(np.repeat(np.arange(4), [1, 3, 5, 7])[:count], directions)
    sh, basis = sh[:count, ...], harmonics(directions, count) * xp.take(factors, orders, axis=-1)
    total = engine.product(basis, sh)
    return xp.where(total > 0, total, 0 * total)


def irradiance(sh: Array, normals: Array) -> Array:
    """The irradiance / π (N, 3) of surfaces with unit normals (N, 3), for coefficients (n, 3) of radiance."""
    return radiance(sh, normals, engine_of(sh, normals).constant(DIFFUSE, normals))
