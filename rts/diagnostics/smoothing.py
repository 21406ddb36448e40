"""The Gaussian that derivative images are looked at through."""

from __future__ import annotations

import numpy as np

LOW_PASS, RADIUS = 2.0, 6
"""Standard deviation and cut-off of the Gaussian that errors are looked at through, pixels."""


def low_pass(x: np.ndarray) -> np.ndarray:
    """(H, W, 3) after the Gaussian."""
    from scipy.ndimage import gaussian_filter

    return gaussian_filter(np.asarray(x, np.float64), (LOW_PASS, LOW_PASS, 0), radius=(RADIUS, RADIUS, 0))
