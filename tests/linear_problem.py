"""Linear least squares whose solution is known, for tests of fits."""

import numpy as np
import pytest
from helpers import arrays

MATRIX = np.random.default_rng(5).normal(size=(9, 3))
SOLUTION = np.array([1.0, -2.0, 0.5])


def line(target):
    """Residuals of linear least squares that vanish at SOLUTION, and where to start."""
    matrix, goal = arrays(target, MATRIX), arrays(target, MATRIX @ SOLUTION)
    return lambda p: matrix @ p - goal, arrays(target, np.zeros(3))


def joined(target, pieces):
    """Rows of several arrays as one array."""
    if target == "jax":
        return pytest.importorskip("jax").numpy.concatenate(pieces)
    return pytest.importorskip("torch").cat(pieces)
