"""Where the near or the far plane cuts a surface: the line stays at its depth, whatever the surface does."""

import numpy as np
import pytest
from helpers import DIFFERENTIABLE, arrays, gradient, to_numpy

import rts

pytestmark = pytest.mark.rendering

SIZE = 24, 20
NEAR, FAR = 2.0, 5.0
FACES = np.array([[0, 1, 2], [0, 2, 3]])
RISING = np.array([(x, 0.5 * (d - 1.8), -d) for x, d in ((-30, 0.5), (30, 0.5), (30, 30.0), (-30, 30.0))])
"""A plane that rises away from the camera, y = (depth − 1.8) / 2, wider and longer than what is seen of it."""
# Pixels a unit of y at depth 1, and depths whose lines are in the image, with the sign of what they add.
PERSPECTIVE = rts.Camera.look_at((0, 0, 0), (0, 0, -1), fov_y=60, near=NEAR, far=FAR), 12 / np.tan(np.radians(30))
ORTHOGRAPHIC = rts.Camera.orthographic((0, 0, 0), (0, 0, -1), height=3.0, near=NEAR, far=FAR), 8.0
CASES = {"perspective": (*PERSPECTIVE, 1 / FAR - 1 / NEAR), "orthographic": (*ORTHOGRAPHIC, -1.0)}


@pytest.mark.parametrize("target", DIFFERENTIABLE)
@pytest.mark.parametrize("case", CASES)
def test_the_line_of_a_cut_stays_at_its_depth(case, target):
    camera, pixels, lines = CASES[case]
    start, color = arrays(target, (RISING, np.ones(3)))

    def covered(move):
        return rts.render(rts.Part(rts.Mesh(FACES), {"vertices": start + move, "color": color}, "unlit"), camera, SIZE)[
            ..., 3
        ].sum()

    found = gradient(target, covered, arrays(target, np.zeros(3)))
    # Moved by (x, y, z), the plane is higher by y + z / 2 at each depth, in all columns.
    expected = SIZE[1] * pixels * lines
    np.testing.assert_allclose(found, [0, expected, expected / 2], rtol=1e-3, atol=0.02)
    # Nothing but a difference of images tells as much.
    ahead, behind = (float(to_numpy(covered(arrays(target, np.float64([0, 0, s]))))) for s in (0.01, -0.01))
    np.testing.assert_allclose((ahead - behind) / 0.02, expected / 2, rtol=5e-3)


def test_an_edge_that_only_comes_near_the_plane_moves_with_the_surface():
    camera, pixels, _ = CASES["orthographic"]
    vertices = np.array([(-30, -0.3, -NEAR - 0.05), (30, -0.3, -NEAR - 0.05), (30, 9, -NEAR - 1), (-30, 9, -NEAR - 1)])
    torch = pytest.importorskip("torch")
    move = torch.zeros(3, dtype=torch.float64, requires_grad=True)
    part = rts.Part(rts.Mesh(FACES), {"vertices": torch.as_tensor(vertices) + move}, "silhouette")
    rts.render(part, camera, SIZE)[..., 3].sum().backward()
    np.testing.assert_allclose(move.grad.numpy(), [0, -SIZE[1] * pixels, 0], atol=1e-3)
