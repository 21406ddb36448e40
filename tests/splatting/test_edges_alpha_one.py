"""Layers whose alpha is exactly 1, though their shader promises nothing: what is behind them counts in derivatives."""

import numpy as np
import pytest
from cards import SIZE, TWO, flat, in_pixels
from helpers import DIFFERENTIABLE, arrays, derivative, gradient

import rts

pytestmark = pytest.mark.splatting

EVERYWHERE = flat(np.array([[-9.0, -9], [40, -9], [40, 40], [-9, 40]]), 3.0)
LEFT = flat(np.array([[-9.0, -9], [12.3, -9], [12.3, 40], [-9, 40]]), 3.0)
FRONT, BACK = np.array([0.9, 0.2, 0.3]), np.array([0.1, 0.6, 0.8])


def drawn(alpha, front, layers):
    """A sheet of some alpha, which multiplies its colour, before another one of alpha 1."""
    xp, shader, parts = rts.namespace(alpha), rts.plugin("shaders", "unlit")(opaque=False), []
    for vertices, color, own in ((front, FRONT, alpha), (EVERYWHERE - np.float32([0, 0, 2]), BACK, 0 * alpha + 1)):
        rgba = xp.stack([*(0 * alpha + float(c) for c in color), own])
        parts.append(rts.Part(rts.Mesh(TWO), {"vertices": vertices, "color": rgba}, shader))
    return rts.render(parts, in_pixels(), SIZE, splatter="edges", layers=layers)


@pytest.mark.parametrize("layers", ["auto", 2, 3])
@pytest.mark.parametrize("target", DIFFERENTIABLE)
def test_what_is_behind_an_alpha_of_1_is_in_its_derivative(target, layers):
    """The image is α a + (1 − α) b: its derivative is a − b, of alpha 0."""
    one, expected = arrays(target, np.ones(())), np.array([*(FRONT - BACK), 0])
    image, slope = derivative(target, lambda a: drawn(a, EVERYWHERE, layers), one, one)
    np.testing.assert_allclose(image[12, 12], [*FRONT, 1], atol=1e-6)
    np.testing.assert_allclose(slope, np.broadcast_to(expected, slope.shape), atol=1e-5)
    weights = np.arange(1.0, 5)
    weighed = arrays(target, weights)
    by_reverse = gradient(target, lambda a: (drawn(a, EVERYWHERE, layers)[12, 12] * weighed).sum(), one)
    assert by_reverse == pytest.approx(weights @ expected, rel=1e-5)


@pytest.mark.parametrize("target", DIFFERENTIABLE)
def test_pixels_that_a_sheet_of_alpha_1_covers_in_part_have_their_share(target):
    """It ends at x = 12.3."""
    one = arrays(target, np.ones(()))
    _, slope = derivative(target, lambda a: drawn(a, LEFT, "auto"), one, one)
    share = np.clip(12.3 - np.arange(SIZE[1]), 0, 1)
    expected = share[:, None] * np.array([*(FRONT - BACK), 0])
    np.testing.assert_allclose(slope[3:-3], np.broadcast_to(expected, slope[3:-3].shape), atol=1e-3)
