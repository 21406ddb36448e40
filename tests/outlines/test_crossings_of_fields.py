"""Crossings that are found by samples of the gap, as of fields: where surfaces intersect, and which of two ends."""

import numpy as np
import pytest

import rts

torch = pytest.importorskip("torch")

pytestmark = pytest.mark.splatting

HEIGHT, WIDTH, TILT = 6, 16, 0.3
CAMERA = rts.Camera.orthographic((0.03, 0, 5), (0.03, 0, 0), height=HEIGHT / 8, aspect=WIDTH / HEIGHT, near=1, far=9)
"""A cell is an eighth of a unit."""


def plane(theta, points):
    """Below z = slope · x + level."""
    return (points[:, 2] - theta["slope"] * points[:, 0] - theta["level"]) / 1.1


def tilted(slope, level, shader):
    theta = {"slope": torch.tensor(slope, dtype=torch.float64), "level": level}
    return rts.Part(rts.Sdf(plane, 3.0), theta, shader)


def color(red, green):
    def shader(theta, gbuffer, camera):
        one = gbuffer["position"][:, :1] * 0 + 1
        return rts.namespace(one).concat([red * one, green * one, 0 * one, one], axis=1)

    return shader


@pytest.mark.parametrize("rising", [0, 1])
def test_the_line_where_fields_cross_moves_as_they_rise(rising):
    """Where z = 0.3 x + a and z = −0.3 x + b, x = (b − a) / 0.6; the first is seen on the right of it."""
    parts = color(1.0, 0.0), color(0.0, 1.0)

    def image(t):
        levels = [t if i == rising else 0 * t for i in (0, 1)]
        scene = [tilted(sign * TILT, level, own) for sign, level, own in zip((1, -1), levels, parts, strict=True)]
        return rts.render(scene, CAMERA, (HEIGHT, WIDTH), splatter="edges")

    zero = torch.zeros((), dtype=torch.float64)
    value, along = torch.func.jvp(image, (zero,), (torch.ones_like(zero),))
    # The line x = 0 is 0.24 cells left of the middle.
    np.testing.assert_allclose(value[..., 0].sum(), HEIGHT * (WIDTH / 2 + 0.24), rtol=1e-3)
    speed = HEIGHT * 8 / (2 * TILT) * (1 if rising == 0 else -1)
    np.testing.assert_allclose(along.sum((0, 1))[:2], [speed, -speed], rtol=1e-2)
