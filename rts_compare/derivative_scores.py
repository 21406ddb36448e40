"""Scores of derivative images against the true derivative."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from rts_diagnostics.smoothing import low_pass

LOSSES, LOSS_SCALE = 16, 8.0
"""The number of random losses, and the standard deviation of the Gaussian that smooths their weights, pixels."""


def relative_l2(x: np.ndarray, y: np.ndarray, scale: np.ndarray) -> float:
    """The norm of x − y divided by the norm of `scale`."""
    return float(np.linalg.norm(x - y) / max(float(np.linalg.norm(scale)), 1e-30))


@lru_cache(2)
def loss_weights(height: int, width: int, count: int = LOSSES) -> np.ndarray:
    """Weights (count, H, W, 3) float32, read-only, of random losses L = Σ w · image: smooth, fixed seed, variance 1."""
    from scipy.ndimage import gaussian_filter

    noise = np.random.default_rng(0).normal(size=(count, height, width, 3))
    smooth = gaussian_filter(noise, (0, LOSS_SCALE, LOSS_SCALE, 0), output=np.float32)
    weights = smooth / smooth.std(axis=(1, 2, 3), keepdims=True)
    weights.setflags(write=False)
    return weights


def scores(x: np.ndarray, true: np.ndarray) -> dict[str, float]:
    """Score a derivative image (H, W, 3) against the true one.

    Returns:
        error: relative L2 through the low-pass (Gaussian, standard deviation 2 pixels); the error in charts.
        gain: ⟨x, true⟩ / ⟨true, true⟩, both through the low-pass: 1 where the derivative is neither too
            large nor too small as a whole.
        loss_error: over the random losses L, RMS of the error of dL/dt relative to the RMS of dL/dt; t is the
            parameter of the derivative.
    """
    low = _compared(low_pass(x), low_pass(true))
    return {"error": low["relative_l2"], "gain": low["gain"], "loss_error": _loss_error(x, true)}


def all_scores(x: np.ndarray, true: np.ndarray) -> dict[str, float]:
    """Score a derivative image (H, W, 3) against the true one, by more numbers than `scores`.

    Returns:
        relative_l2, cosine, gain: of the images as they are.
        low_relative_l2, low_cosine, low_gain: the same through the low-pass.
        spurious: share of the sum of x² that lies more than 3 steps, along rows and columns, from all pixels where
            `true` is not zero.
        loss_error: as of `scores`.
    """
    from scipy.ndimage import binary_dilation

    far = np.logical_not(binary_dilation(np.abs(true).max(axis=-1) > 1e-6, iterations=3))
    return {
        **_compared(x, true),
        **{f"low_{name}": value for name, value in _compared(low_pass(x), low_pass(true)).items()},
        "spurious": float((x[far] ** 2).sum() / max((x**2).sum(), 1e-30)),
        "loss_error": _loss_error(x, true),
    }


def _compared(x: np.ndarray, true: np.ndarray) -> dict[str, float]:
    product = float((x * true).sum())
    return {
        "relative_l2": relative_l2(x, true, true),
        "cosine": product / max(float(np.linalg.norm(x) * np.linalg.norm(true)), 1e-30),
        "gain": product / max(float((true**2).sum()), 1e-30),
    }


def _loss_error(x: np.ndarray, true: np.ndarray) -> float:
    """Over the random losses, RMS of the error of dL/dt relative to the RMS of dL/dt."""
    slopes, true_slopes = (np.tensordot(loss_weights(*true.shape[:2]), i, axes=3) for i in (x, true))
    return relative_l2(slopes, true_slopes, true_slopes)
