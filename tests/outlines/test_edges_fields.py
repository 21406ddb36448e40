"""Found edges of fields by rays: kinks, fields without slope at their surface, and first hits that are smooth."""

import numpy as np
import pytest
from found_outlines import sampled_with_outlines

import rts

torch = pytest.importorskip("torch")

pytestmark = pytest.mark.splatting

SIZE, DISTANCE, FOV = 32, 4.0, 30.0
CAMERA = rts.Camera.look_at((0, 0, DISTANCE), (0, 0, 0), fov_y=FOV)
FOCAL = SIZE / 2 / np.tan(np.radians(FOV / 2))


def length(x):
    return (x * x).sum(-1) ** 0.5


def diamond(theta, points):
    """A prism along y whose cross-section is a square that stands on its corner: its kinks are the outline."""
    xp = rts.namespace(points)
    sides = xp.abs(points[:, 0]) + xp.abs(points[:, 2]) - theta["radius"]
    return xp.maximum(0.7 * sides, xp.abs(points[:, 1]) - 1.5)


def ball(theta, points):
    return length(points) - theta["radius"]


def root_of_ball(theta, points):
    """The signed root of a ball's distance, steep beside the surface; at the surface itself it has no slope."""
    xp, level = rts.namespace(points), length(points) - theta["radius"]
    return xp.sign(level) * xp.sqrt(xp.abs(level) + 1e-6)


def alpha(f, shader="silhouette", **options):
    """A function of the radius: the image's alpha by found edges."""
    surface = rts.Sdf(f, 1.6, **options)

    def image(radius):
        part = rts.Part(surface, {"radius": radius}, shader)
        return rts.render(part, CAMERA, (SIZE, SIZE), splatter="edges")[..., -1]

    return image


def pushed(image):
    """The derivative by the radius 0.7."""
    return torch.func.jvp(image, (torch.tensor(0.7),), (torch.ones(()),))[1].numpy()


@pytest.mark.thorough
def test_an_outline_on_a_kink_moves_as_the_kink():
    """The kinks at x = ±r move by one for each unit of r; either face alone by a half."""
    lines = pushed(alpha(diamond))[10:22].sum(axis=1)
    np.testing.assert_allclose(lines, 2 * FOCAL / DISTANCE, rtol=0.01)


@pytest.mark.thorough
def test_a_field_without_slope_at_its_surface_has_outlines_that_move():
    """The outline of a ball is a circle of focal · r / √(D² − r²) pixels."""
    square = DISTANCE**2 - 0.7**2
    true = 2 * np.pi * FOCAL**2 * 0.7 * DISTANCE**2 / square**2
    assert pushed(alpha(root_of_ball, lipschitz=None)).sum() == pytest.approx(true, rel=0.01)


def test_a_smooth_front_has_no_breaks_beside_its_outline():
    part = rts.Part(rts.Sdf(ball, 1.6), {"radius": np.float32(0.7)}, "silhouette")
    _, outlines = sampled_with_outlines(part, CAMERA, (SIZE, SIZE), splatter="edges")
    assert len(outlines.rows) > 30
    assert ((outlines.rows[:, :2] >= 0).sum(axis=1) == 1).all()


def test_pairs_lie_on_the_rays_of_crossings():
    part = rts.Part(rts.Sdf(diamond, 1.6), {"radius": np.float32(0.7)}, "silhouette")
    sampled, outlines = sampled_with_outlines(part, CAMERA, (SIZE, SIZE), splatter="edges")
    points, pair = sampled.samples[0].params[:, :3].astype(float), outlines.rows[:, 4:]
    ending = outlines.rows[np.arange(len(outlines.kind)), outlines.kind]
    assert (pair >= 0).all()

    def seen(rows):
        return points[rows, :2] / (DISTANCE - points[rows, 2:])

    for side in (0, 1):
        np.testing.assert_allclose(seen(pair[:, side]), seen(ending), atol=1e-5)
