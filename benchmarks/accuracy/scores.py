"""How near the derivative of an image is to the truth."""

from __future__ import annotations

from functools import cache

import numpy as np
from scipy.ndimage import binary_dilation, gaussian_filter

LOW_PASS, RADIUS = 2.0, 6
"""Standard deviation and cut-off of the Gaussian that errors are looked at through, pixels."""
LOSSES, LOSS_SCALE = 16, 8.0
"""How many random losses, and the standard deviation of the Gaussian that smooths their weights, pixels."""


def low_pass(x: np.ndarray) -> np.ndarray:
    """(H, W, 3) after the Gaussian."""
    return gaussian_filter(np.asarray(x, np.float64), (LOW_PASS, LOW_PASS, 0), radius=(RADIUS, RADIUS, 0))


@cache
def loss_weights(height: int, width: int) -> np.ndarray:
    """Weights (L, H, W, 3) of the random losses L = Σ w · image: smooth, of fixed seed and unit variance."""
    noise = np.random.default_rng(0).normal(size=(LOSSES, height, width, 3))
    smooth = gaussian_filter(noise, (0, LOSS_SCALE, LOSS_SCALE, 0))
    weights = smooth / smooth.std(axis=(1, 2, 3), keepdims=True)
    weights.setflags(write=False)
    return weights


def scores(x: np.ndarray, true: np.ndarray) -> dict[str, float]:
    """How near a derivative image (H, W, 3) is to the true one.

    Returns:
        relative_l2, cosine, gain: raw; the gain is ⟨x, truth⟩ / ⟨truth, truth⟩.
        low_relative_l2, low_cosine, low_gain: the same after the low-pass.
        spurious: share of the derivative's energy farther than 3 pixels from where the truth is not zero.
        loss_error: over the random losses, RMS of the error of dL/dt relative to the RMS of dL/dt.
    """
    near = binary_dilation(np.abs(true).max(axis=-1) > 1e-6, iterations=3)
    weights = loss_weights(*true.shape[:2])
    slopes, true_slopes = (np.tensordot(weights, i, axes=3) for i in (x, true))
    return {
        **_compared(x, true, ""),
        **_compared(low_pass(x), low_pass(true), "low_"),
        "spurious": float((x[~near] ** 2).sum() / max((x**2).sum(), 1e-30)),
        "loss_error": relative_l2(slopes, true_slopes, true_slopes),
    }


def _compared(x: np.ndarray, true: np.ndarray, prefix: str) -> dict[str, float]:
    product, square = float((x * true).sum()), float((true**2).sum())
    return {
        f"{prefix}relative_l2": relative_l2(x, true, true),
        f"{prefix}cosine": product / max(float(np.linalg.norm(x) * np.linalg.norm(true)), 1e-30),
        f"{prefix}gain": product / square,
    }


def relative_l2(x: np.ndarray, y: np.ndarray, scale: np.ndarray) -> float:
    """Norm of the difference over that of `scale`."""
    return float(np.linalg.norm(x - y) / np.linalg.norm(scale))
