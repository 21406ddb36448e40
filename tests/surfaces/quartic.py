"""Rays at a torus about the y axis, which they meet where a quartic is zero."""

import numpy as np

RADII = np.array([0.9, 0.35])


def some_rays(count=400):
    """Rays from about the torus and from within its tube, of any length; none of which almost touches it."""
    rng = np.random.default_rng(0)
    origins = rng.normal(size=(count, 3))
    origins *= 3 / np.linalg.norm(origins, axis=1, keepdims=True)
    origins[: count // 8] = RADII[0] * np.array([0.6, 0, 0.8]) + rng.uniform(-0.15, 0.15, (count // 8, 3))
    toward = rng.uniform(-1.1, 1.1, (count, 3)) * (1, 0.35, 1)
    directions = (toward - origins) * rng.uniform(0.2, 2, (count, 1))
    roots = [quartic(o, d) for o, d in zip(origins, directions, strict=True)]
    plain = np.array([apart(r, np.linalg.norm(d)) for r, d in zip(roots, directions, strict=True)])
    return origins[plain], directions[plain], [r for r, good in zip(roots, plain, strict=True) if good]


def quartic(o, d):
    """The roots of |p|² + R² − r² = 2 R √(x² + z²), squared, along a ray."""
    large, small = RADII
    a = np.array([d @ d, 2 * o @ d, o @ o + large**2 - small**2])
    flat = [0, 2]
    b = np.array([d[flat] @ d[flat], 2 * o[flat] @ d[flat], o[flat] @ o[flat]])
    return np.roots(np.polymul(a, a) - 4 * large**2 * np.pad(b, (2, 0)))


def apart(roots, length):
    """True if all roots, complex ones too, are at least a hundredth of a unit apart, and as far from 0."""
    gaps = np.abs(roots[:, None] - roots[None]) + np.eye(4)
    return gaps.min() * length > 1e-2 and np.abs(roots).min() * length > 1e-2


def closed_form(roots, layers=4):
    """Distances (K, R) of at least 0, nearest first; infinite where there is no root."""
    distances = np.full((layers, len(roots)), np.inf)
    for i, r in enumerate(roots):
        real = np.sort(r.real[(np.abs(r.imag) < 1e-6) & (r.real >= 0)])[:layers]
        distances[: len(real), i] = real
    return distances
