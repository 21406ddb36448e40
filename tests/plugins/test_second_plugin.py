"""The plugin of `second_plugin`, written from docs/plugins.md alone, by the conformance kit."""

import numpy as np
import pytest
from second_plugin.gauss5 import Gauss5
from second_plugin.net import Net, random_net
from second_plugin.softplus import SOFTPLUS
from second_plugin.torus import Torus

from rts.testing import OperationConformance, ShaderConformance, SplatterConformance, SurfaceConformance

pytestmark = pytest.mark.plugins


class TestTorus(SurfaceConformance):
    @pytest.fixture
    def part(self):
        return Torus.example()


class TestGauss5(SplatterConformance):
    @pytest.fixture
    def splatter(self):
        return Gauss5()


class TestNet(ShaderConformance):
    @pytest.fixture
    def shader(self):
        return Net()

    @pytest.fixture
    def theta(self):
        return {"net": random_net()}


class TestSoftplus(OperationConformance):
    @pytest.fixture
    def operation(self):
        return SOFTPLUS

    @pytest.fixture
    def operands(self):
        rng = np.random.default_rng(1)
        return rng.normal(size=(7, 4)), rng.uniform(0.5, 5, size=4)


@pytest.mark.parametrize("sigma", [0.4, 0.5, 0.7])
def test_calibration(sigma):
    """A ramp of colour that moves has its true derivative: the kit asks for the sign only."""
    torch = pytest.importorskip("torch")
    size, slope = 11, 0.05
    row = torch.arange(size * size, dtype=torch.int32).reshape(1, size, size)
    y, x = (g.reshape(-1) + 0.5 for g in torch.meshgrid(torch.arange(size), torch.arange(size), indexing="ij"))
    rgba = torch.stack([slope * x, slope * y, 0 * x, 0 * x + 1], -1).double()
    splatter = Gauss5(sigma)

    def image(by):
        positions = torch.stack([x.double() + by, y.double(), 0 * x.double() + 1], -1)
        return splatter.splat(positions, rgba, row)

    _, change = torch.func.jvp(image, (torch.tensor(0.0).double(),), (torch.tensor(1.0).double(),))
    np.testing.assert_allclose(change[3:-3, 3:-3, 0], -slope, rtol=2e-3)
    np.testing.assert_allclose(change[3:-3, 3:-3, 1:], 0, atol=1e-9)
