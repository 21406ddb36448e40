"""Outlines that pass through the centres of pixels, as those of centred and upright objects do: in closed form."""

import numpy as np
import pytest
from cards import SIZE, card, covered, flat, in_pixels
from helpers import pushed

import rts

torch = pytest.importorskip("torch")

pytestmark = pytest.mark.splatting

PANE = rts.plugin("shaders", "unlit")(opaque=False)
ALPHA = 0.5


def alpha_of(corners, vertices=None, glass=False):
    """Alpha (H, W) of a convex polygon before nothing; of glass, as if it let no light through."""
    faces = np.array([(0, i, i + 1) for i in range(1, len(corners) - 1)])
    part = card(flat(corners) if vertices is None else vertices, faces=faces)
    if glass:
        part = part.replace(theta=part.theta | {"color": np.float32([1, 1, 1, ALPHA])}, shader=PANE)
    image = rts.render(part, in_pixels(), SIZE)
    return image[..., 3] / (ALPHA if glass else 1)


def angles(corners):
    """The angles of a triangle, degrees."""
    ways = [np.roll(corners, -i, axis=0) - corners for i in (1, 2)]
    cosines = np.sum(ways[0] * ways[1], axis=1) / np.prod([np.linalg.norm(w, axis=1) for w in ways], axis=0)
    return np.degrees(np.arccos(cosines))


def triangles(step):
    """Triangles whose corners lie on a lattice: some edges pass through centres, by both ways around."""
    rng, found = np.random.default_rng(5), []
    while len(found) < 40:
        corners = np.round(rng.uniform(2, 22, (3, 2)) / step) * step
        if covered(corners, SIZE).sum() > 20 and angles(corners).min() > 30:
            found.append(corners)
    return found


def meets_a_centre(corners):
    return (corners % 1 == 0.5).all(axis=1).any()


@pytest.mark.parametrize("glass", [False, True])
@pytest.mark.parametrize("size", [16, 15, 7.5])
@pytest.mark.parametrize("place", [12.0, 12.5])
def test_a_square_on_its_corner_has_its_area_in_each_pixel(place, size, glass):
    corners = place + size / 2 * np.array([(1.0, 0), (0, 1), (-1, 0), (0, -1)])
    if glass and meets_a_centre(corners):
        pytest.skip("a corner at a centre meets no gap but in one point")
    np.testing.assert_allclose(alpha_of(corners, glass=glass), covered(corners, SIZE), atol=1e-2)


@pytest.mark.parametrize("glass", [False, True])
@pytest.mark.parametrize("place", [(12.0, 12.0), (12.5, 12.5), (12.0, 12.5)])
def test_an_upright_square_has_its_area_in_each_pixel(place, glass):
    for sides in ((6.0, 6), (5.5, 5.5), (5.5, 6)):
        corners = place + np.array([(-1.0, -1), (1, -1), (1, 1), (-1, 1)]) * sides
        found, expected = alpha_of(corners, glass=glass), covered(corners, SIZE)
        np.testing.assert_allclose(found, expected, atol=2e-3, err_msg=f"{place} {sides}")


@pytest.mark.parametrize("glass", [False, True])
@pytest.mark.parametrize("step", [1.0, 0.5, 0.25])
def test_triangles_on_a_lattice_have_the_area_of_their_polygons(step, glass):
    errors = []
    for corners in triangles(step):
        if not (glass and meets_a_centre(corners)):
            errors.append(np.abs(alpha_of(corners, glass=glass) - covered(corners, SIZE)).max())
    assert len(errors) > 15
    assert np.median(errors) < 2e-3 and max(errors) < 0.05


@pytest.mark.parametrize("step", [1.0, 0.5])
def test_triangles_on_a_lattice_move_as_their_polygons(step):
    errors = []
    for corners in triangles(step)[:12]:
        velocity = np.array([(0.4, 0.1), (-0.2, 0.5), (0.1, -0.3)])
        start = torch.as_tensor(flat(corners))
        way = torch.as_tensor(np.column_stack([velocity, np.zeros(3)]).astype(np.float32))
        _, derivative = pushed(lambda t, c=corners, s=start, w=way: alpha_of(c, s + t * w))
        ends = [covered(corners + sign * 1e-5 * velocity, SIZE) for sign in (1, -1)]
        truth = (ends[0] - ends[1]) / 2e-5
        errors.append(np.linalg.norm(derivative - truth) / np.linalg.norm(truth))
    assert np.median(errors) < 0.02 and max(errors) < 0.1
