"""A compiled splatter made outside of the library, of public names alone, against the library's own array code."""

import numpy as np
import pytest
from fast_splatter.rts_fast_splatter import IMAGE, FastSingle
from samples import cells, noise

import rts
from rts import splatting
from rts.plugin_api.records import Cells, Splats
from rts.testing import OperationConformance, SplatterConformance

pytestmark = pytest.mark.plugins

TOLERANCE = {np.float32: 1e-5, np.float64: 1e-10}
SETTINGS = {"sigma": 0.8, "epsilon": 0.2, "calibration": None}


class TestFastSingle(SplatterConformance):
    @pytest.fixture
    def splatter(self):
        return FastSingle()


class TestImage(OperationConformance):
    @pytest.fixture
    def operation(self):
        return IMAGE

    @pytest.fixture
    def operands(self):
        return cells(1, (6, 7))

    @pytest.fixture
    def params(self):
        return {"numbers": (0.5, 0.05, 1.0), "border": 1}


def scenes(dtype):
    """Splats: more than a tile, two layers, a border, a sample in several cells, and nothing."""
    wide, two, empty = (
        Splats(p, c, Cells(r))
        for p, c, r in (cells(1, (13, 75), dtype=dtype), cells(2, dtype=dtype), cells(1, (5, 40), dtype=dtype, holes=2))
    )
    repeated = np.where(np.random.default_rng(0).random(two.row.shape) < 0.2, 1, two.row).astype(np.int32)
    return {
        "wide": wide,
        "border": wide.replace(border=2),
        "two": two,
        "repeated": two.replace(row=repeated),
        "empty": empty,
    }


@pytest.mark.parametrize("dtype", TOLERANCE)
@pytest.mark.parametrize("scene", scenes(np.float32))
@pytest.mark.parametrize("settings", [{}, SETTINGS])
def test_it_is_single(scene, dtype, settings):
    """Image, tangents and gradients are those of the specification."""
    torch, splats = pytest.importorskip("torch"), scenes(dtype)[scene]
    given = [torch.tensor(x) for x in (splats.positions, splats.rgba)]
    along = [torch.tensor(noise(*x.shape, dtype=dtype, seed=n)) for n, x in enumerate(given)]

    def found(splatter):
        row = torch.tensor(splats.row)

        def image(positions, rgba):
            return splatter.cropped(Splats(positions, rgba, Cells(row), border=splats.border))

        value, tangent = torch.func.jvp(image, tuple(given), tuple(along))
        _, pull = torch.func.vjp(image, *given)
        return value, tangent, *pull(torch.tensor(noise(*value.shape, dtype=dtype)))

    ours, numpy = found(FastSingle(**settings)), FastSingle(**settings).cropped(splats)
    np.testing.assert_array_equal(numpy, ours[0])
    for x, y in zip(ours, found(splatting.Single(**settings)), strict=True):
        np.testing.assert_allclose(x, y, atol=TOLERANCE[dtype] * max(1, float(y.abs().max())), rtol=TOLERANCE[dtype])


def test_a_compiled_program_of_jax_renders_with_it():
    """The image of a box that turns, and its gradient in the pose, are those of the library's splatter."""
    jax = pytest.importorskip("jax")
    part = rts.plugin("surfaces", "mesh").example().replace(shader="silhouette")

    def loss(pose, splatter):
        turned = part.replace(transform=rts.rigid(pose))
        image = rts.render(turned, rts.Camera.look_at((0, 1, 4), (0, 0, 0)), (20, 24), splatter=splatter)
        return (image[..., 3] * jax.numpy.linspace(0, 1, 24)).sum()

    pose = jax.numpy.asarray([0.3, 0.2, 0.1, 0.1, 0.0, 0.0])
    ours, theirs = (jax.jit(jax.value_and_grad(lambda x, s=s: loss(x, s)))(pose) for s in (FastSingle(), "single"))
    for x, y in zip(ours, theirs, strict=True):
        np.testing.assert_allclose(x, y, rtol=1e-4, atol=1e-4)
