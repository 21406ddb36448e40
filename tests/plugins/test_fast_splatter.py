"""A compiled splatter made outside of the library, of public names alone, against the library's own array code."""

import numpy as np
import pytest
from fast_splatter.rts_fast_splatter import IMAGE, FastSingle
from samples import cells

import rts
from rts import splatting
from rts.testing import OperationConformance, SplatterConformance

pytestmark = pytest.mark.plugins


class TestFastSingle(SplatterConformance):
    @pytest.fixture
    def splatter(self):
        return FastSingle()


def scenes():
    """Splats, and the border: more than a tile, two layers, a border, a sample in several cells, and nothing."""
    wide, two, empty = cells(1, (13, 75)), cells(2), cells(1, (5, 40), holes=2)
    repeated = np.where(np.random.default_rng(0).random(two[2].shape) < 0.2, 1, two[2]).astype(np.int32)
    return {
        "wide": (wide, 0),
        "border": (wide, 2),
        "two": (two, 0),
        "repeated": ((*two[:2], repeated), 0),
        "empty": (empty, 0),
    }


SCENES = scenes()


class TestImage(OperationConformance):
    @pytest.fixture(params=SCENES)
    def scene(self, request):
        return SCENES[request.param]

    @pytest.fixture
    def operation(self):
        return IMAGE

    @pytest.fixture
    def operands(self, scene):
        return scene[0]

    @pytest.fixture(params=[(0.5, 0.05, 1.0), (0.8, 0.2, splatting.exact_calibration(0.8))], ids=["plain", "others"])
    def params(self, request, scene):
        return {"numbers": request.param, "border": scene[1]}


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
