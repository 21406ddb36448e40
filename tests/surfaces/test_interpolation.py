"""Values on a lattice as functions of space, and what moves samples along the gradient: compiled and specified."""

import numpy as np
import pytest
from helpers import ALL, arrays, to_numpy

from rts.testing import OperationConformance
from rts_surfaces.implicit.interpolation import DIFFERENCES, differences, interpolated
from rts_surfaces.implicit.lattice import Lattice
from rts_surfaces.implicit.motion import ALONG_EDGES, ALONG_NORMAL

pytestmark = pytest.mark.sampling

LATTICE = Lattice(((-1.0, 0.5, -2.0), (1.0, 1.5, 1.0)), (5, 4, 7))
RNG = np.random.default_rng(0)
VALUES = RNG.standard_normal(LATTICE.shape)
POINTS = RNG.uniform((-1.3, 0.3, -2.4), (1.3, 1.7, 1.4), (60, 3))
"""Some lie beyond the bounds."""
STEPS = {"low": tuple(LATTICE.low.tolist()), "step": tuple(LATTICE.step.tolist())}


def on_lattice(f):
    return f(LATTICE.points(np.arange(LATTICE.count))).reshape(LATTICE.shape)


@pytest.mark.parametrize("target", ALL)
def test_what_is_linear_along_each_axis_is_interpolated_exactly(target):
    def f(p):
        return 2 - p[:, 0] + 3 * p[:, 1] * p[:, 2] + 0.5 * p[:, 0] * p[:, 1] * p[:, 2]

    values, points = arrays(target, (on_lattice(f), POINTS), np.float64 if target != "jax" else np.float32)
    expected = f(np.clip(POINTS, (-1, 0.5, -2), (1, 1.5, 1)))
    np.testing.assert_allclose(to_numpy(interpolated(values, points, LATTICE)), expected, atol=1e-5)


@pytest.mark.parametrize("target", ALL)
def test_central_differences_are_exact_for_squares_within_the_bounds(target):
    values = on_lattice(lambda p: p[:, 0] ** 2 - 3 * p[:, 1] * p[:, 2] + p[:, 2])
    # One-sided differences at the bounds are not exact.
    points = RNG.uniform((-0.5, 0.84, -1.5), (0.5, 1.16, 0.5), (40, 3))
    expected = np.stack([2 * points[:, 0], -3 * points[:, 2], 1 - 3 * points[:, 1]], axis=1)
    found = differences(*arrays(target, (values, points)), LATTICE)
    np.testing.assert_allclose(to_numpy(found), expected, atol=2e-5)


def samples():
    """Rows of 40 values (N, 6), and params (N, 16)."""
    return RNG.integers(0, 40, (30, 6)).astype(np.int32), RNG.standard_normal((30, 16))


ROWS, PARAMS = samples()


def edges():
    """Ends of edges of the lattice (N, 6), some of them one point; and params (N, 4) that bound some of them."""
    count = 30
    low = RNG.integers(0, (4, 3, 6), (count, 3, 3))
    high = low + np.eye(3, dtype=int)[RNG.integers(0, 3, (count, 3))] * RNG.choice([0, 1, 1, 1], (count, 3, 1))
    numbers = np.stack([np.ravel_multi_index(tuple(x.transpose(2, 0, 1)), LATTICE.shape) for x in (low, high)], axis=-1)
    least = np.where(np.arange(count) % 3 == 0, 0.5, 0.0)[:, None]
    return numbers.reshape(count, 6).astype(np.int32), np.concatenate([RNG.random((count, 3)), least], axis=1)


NUMBERS, BOUNDED = edges()
CASES = {
    "differences": (DIFFERENCES, [VALUES, POINTS], STEPS),
    "along the normal": (ALONG_NORMAL, [RNG.standard_normal(40), PARAMS, ROWS], {"isovalue": 0.3, "sign": -1.0}),
    "along edges": (
        ALONG_EDGES,
        [VALUES.reshape(-1), BOUNDED, NUMBERS, NUMBERS],
        {"isovalue": 0.1, "lattice": LATTICE.fixed},
    ),
}
"""An operation, operands, and parameters."""


class TestCompiled(OperationConformance):
    @pytest.fixture(params=CASES)
    def case(self, request):
        return CASES[request.param]

    @pytest.fixture
    def operation(self, case):
        return case[0]

    @pytest.fixture
    def operands(self, case):
        return case[1]

    @pytest.fixture
    def params(self, case):
        return case[2]


def test_samples_of_another_surface_are_refused():
    values = RNG.standard_normal(10)
    with pytest.raises(ValueError, match="sample this surface anew"):
        ALONG_NORMAL(values, PARAMS, ROWS, isovalue=0.0, sign=1.0)
