"""Packed samples as splatters get them, and noise."""

import numpy as np


def cells(layers, size=(9, 11), seed=0, dtype=np.float64, holes=0.2, spare=5):
    """Positions, colours and row: off-centre samples, equal depths, cut-outs, empty cells and rows of no cell."""
    rng = np.random.default_rng(seed)
    depth = np.sort(rng.integers(4, 16, (layers, *size)) / 4, axis=0)  # Quarters: ties are exact.
    depth = np.where(rng.random(size) < 0.1, depth[:1], depth)
    filled = np.logical_and.accumulate(rng.random(depth.shape) >= holes, axis=0)
    k, y, x = np.nonzero(filled)
    total = len(k) + spare
    place = rng.permutation(total)[: len(k)]
    row = np.full(filled.shape, -1, np.int32)
    row[k, y, x] = place
    positions = rng.normal(size=(total, 3))
    positions[place] = np.stack([x + 0.5, y + 0.5, depth[k, y, x]], axis=-1)
    positions[place, :2] += rng.uniform(-0.4, 0.4, (len(k), 2))
    alpha = rng.choice([0.0, 0.5, 1.0], total, p=[0.2, 0.2, 0.6])
    rgba = np.concatenate([rng.random((total, 3)), np.ones((total, 1))], axis=1) * alpha[:, None]
    return positions.astype(dtype), rgba.astype(dtype), row


def noise(*shape, dtype=np.float64, seed=7):
    return np.random.default_rng(seed).normal(size=shape).astype(dtype)
