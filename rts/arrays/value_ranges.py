"""Extreme values of an array, and the non-negative indices among integers."""

from __future__ import annotations

import numpy as np


def largest_absolute(x: np.ndarray) -> float:
    """The largest absolute value in an array of floats; 0 if it is empty, NaN if any value is NaN."""
    # Not of |x|, which would be a copy.
    return float(np.maximum(np.maximum.reduce(x, axis=None, initial=0), -np.minimum.reduce(x, axis=None, initial=0)))


def value_range(x: np.ndarray) -> tuple[int, int]:
    """The least and the largest number in a non-empty array of integers."""
    return int(np.minimum.reduce(x, axis=None)), int(np.maximum.reduce(x, axis=None))


def nonnegative(x: np.ndarray) -> tuple[np.ndarray, int, int]:
    """A bool mask, true where integers `x` are not negative; and the least and the largest number in `x` and −1."""
    return x >= 0, int(x.min(initial=-1)), int(x.max(initial=-1))
