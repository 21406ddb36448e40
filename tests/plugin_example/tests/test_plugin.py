"""The conformance kit on both plugins, by the names under which they are registered, and what is theirs alone."""

import numpy as np
import pytest

import rts
from rts.plugin_api.records import Samples
from rts.testing import SamplerConformance, SurfaceConformance

pytest.importorskip("rts_plugin_example", reason="not installed: pip install -e ./tests/plugin_example")
Heightfield = rts.plugin("surfaces", "heightfield")


class TestHeightfield(SurfaceConformance):
    @pytest.fixture
    def part(self):
        return Heightfield.example()


class TestToy(SamplerConformance):
    @pytest.fixture
    def sampler(self):
        return "toy"


def test_equal_heights_are_a_level_sheet():
    part = rts.Part(Heightfield(), {"heights": np.full((5, 6), 0.25, np.float32)}, shader="normals")
    camera = rts.Camera.orthographic((0, 3, 0), (0, 0, 0), (0, 0, -1), height=3)
    image = rts.render(part, camera, (12, 12), splatter="none")
    sheet = np.zeros((12, 12, 4), np.float32)
    sheet[2:10, 2:10] = (0.5, 1, 0.5, 1)  # Two of three units, and upward.
    np.testing.assert_allclose(image, sheet, atol=1e-6)
    np.testing.assert_allclose(rts.sample(part, camera, (12, 12)).depth[0, 6, 6], 2.75, rtol=1e-6)


def test_a_control_height_moves_only_its_own_four_by_four_patches():
    heights = np.zeros((9, 9), np.float32)
    heights[4, 4] = 1
    at = np.array([(3.0, 3.0), (1.0, 3.0), (5.01, 3.0), (2.0, 3.0)], np.float32)
    samples = Samples(None, at, None, None)
    y = Heightfield().evaluate({"heights": heights}, samples)["position"][:, 1]
    np.testing.assert_allclose(y, [4 / 9, 0, 0, 1 / 9], atol=1e-6)


def test_a_fit_finds_the_heights_of_a_picture():
    torch = pytest.importorskip("torch")
    part = Heightfield.example().replace(shader="normals")
    camera = rts.Camera.look_at((0.4, 2.5, 1.5), (0, 0, 0))
    target = torch.as_tensor(rts.render(part, camera, (24, 24)))

    def residuals(heights):
        return rts.render(part.replace(theta={"heights": heights}), camera, (24, 24)) - target

    fit = rts.fit(residuals, torch.tensor(part.theta["heights"] * 0.7), steps=30, learning_rate=0.02)
    assert fit.loss < 0.1 * fit.history[0]
