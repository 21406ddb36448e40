"""Gaussian low-pass of derivative images, applied before errors are measured."""

from __future__ import annotations

import numpy as np

LOW_PASS, RADIUS = 2.0, 6
"""Standard deviation and cut-off of this Gaussian, pixels."""


def low_pass(x: np.ndarray) -> np.ndarray:
    """The image (H, W, ·) after the Gaussian."""
    from scipy.ndimage import gaussian_filter

    return gaussian_filter(np.asarray(x, np.float64), (LOW_PASS, LOW_PASS, 0), radius=(RADIUS, RADIUS, 0))
