"""The plugin of `second_plugin`, written from docs/plugins.md alone, by the conformance kit."""

import numpy as np
import pytest
from second_plugin.gauss5 import Gauss5
from second_plugin.net import Net, random_net
from second_plugin.softplus import SOFTPLUS, specification
from second_plugin.torus import Torus

from rts.testing import ShaderConformance, SplatterConformance, SurfaceConformance

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


def operands(dtype=np.float64):
    rng = np.random.default_rng(1)
    return rng.normal(size=(7, 4)).astype(dtype), rng.uniform(0.5, 5, size=4).astype(dtype)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_value(dtype):
    value = SOFTPLUS(*operands(dtype))
    assert value.dtype == dtype
    np.testing.assert_allclose(value, specification(*operands(dtype)), rtol=1e-6, atol=1e-7)


def test_torch():
    torch = pytest.importorskip("torch")
    x, s = (torch.tensor(a, requires_grad=True) for a in operands())
    assert torch.autograd.gradcheck(SOFTPLUS, (x, s), check_forward_ad=True)
    assert torch.autograd.gradgradcheck(SOFTPLUS, (x, s))


@pytest.mark.parametrize("jit", [False, True])
def test_jax(jit):
    jax = pytest.importorskip("jax")
    from jax.test_util import check_grads

    function = jax.jit(SOFTPLUS) if jit else SOFTPLUS
    with jax.enable_x64(True):
        check_grads(function, tuple(map(jax.numpy.asarray, operands())), order=2, modes=("fwd", "rev"))


@pytest.mark.parametrize("jit", [False, True])
def test_jax_float32(jit):
    """As in renders: the compiled derivatives against those of the specification."""
    jax = pytest.importorskip("jax")

    def both(function):
        g = jax.grad(lambda x, s: (function(x, s) ** 2).sum(), argnums=(0, 1))
        return (jax.jit(g) if jit else g)(*map(jax.numpy.asarray, operands(np.float32)))

    for a, b in zip(both(SOFTPLUS), both(specification), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-5)


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
