"""How near the derivative of an image is to the truth."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import binary_dilation

from rts.diagnostics.smoothing import low_pass
from rts_compare.derivative_scores import loss_weights, relative_l2


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
