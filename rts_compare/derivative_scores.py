"""How near the derivative of an image is to the truth."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from rts.diagnostics.smoothing import low_pass

LOSSES, LOSS_SCALE = 16, 8.0
"""How many random losses, and the standard deviation of the Gaussian that smooths their weights, pixels."""


def relative_l2(x: np.ndarray, y: np.ndarray, scale: np.ndarray) -> float:
    """Norm of the difference over that of `scale`."""
    return float(np.linalg.norm(x - y) / max(float(np.linalg.norm(scale)), 1e-30))


@lru_cache(2)
def loss_weights(height: int, width: int, count: int = LOSSES) -> np.ndarray:
    """Weights (count, H, W, 3) float32 of random losses L = Σ w · image: smooth, of fixed seed and unit variance."""
    from scipy.ndimage import gaussian_filter

    noise = np.random.default_rng(0).normal(size=(count, height, width, 3))
    smooth = gaussian_filter(noise, (0, LOSS_SCALE, LOSS_SCALE, 0), output=np.float32)
    weights = smooth / smooth.std(axis=(1, 2, 3), keepdims=True)
    weights.setflags(write=False)
    return weights


def scores(x: np.ndarray, true: np.ndarray) -> dict[str, float]:
    """How near a derivative image (H, W, 3) is to the true one.

    Returns:
        error: relative L2 of the two through the low-pass; what charts show.
        gain: ⟨x, truth⟩ / ⟨truth, truth⟩, through the low-pass: 1 where the derivative is neither too long nor too
            short.
        loss_error: over the random losses, RMS of the error of dL/dt relative to the RMS of dL/dt.
    """
    low, low_true = low_pass(x), low_pass(true)
    slopes, true_slopes = (np.tensordot(loss_weights(*true.shape[:2]), i, axes=3) for i in (x, true))
    return {
        "error": relative_l2(low, low_true, low_true),
        "gain": float((low * low_true).sum() / max(float((low_true**2).sum()), 1e-30)),
        "loss_error": relative_l2(slopes, true_slopes, true_slopes),
    }
