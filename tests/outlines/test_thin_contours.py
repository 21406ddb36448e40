"""Surfaces of patches that are thinner than a pixel, in the image, between their contour and their rim."""

import numpy as np
import pytest
from helpers import pushed

import rts
from rts.outlines.gaps import Fronts, Hints, Oracle, find_breaks

torch = pytest.importorskip("torch")

pytestmark = pytest.mark.sampling

SIZE = (64, 64)
WHITE = np.ones(3)


def tube(taper):
    """Control points (8, 8, 3) of a tube along z, open at both ends."""
    z, angle = np.linspace(-1, 1, 8), 2 * np.pi * np.arange(8) / 8
    radius = 0.5 * (1 + taper * z)[:, None]
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), z[:, None] + 0 * angle], axis=-1)


@pytest.mark.parametrize(("taper", "aside"), [(0.0, 0.6), pytest.param(0.2, 1.0, marks=pytest.mark.thorough)])
def test_an_open_tube_seen_along_its_axis_is_that_of_its_fine_triangles(taper, aside):
    """Behind its opening the inside is a crescent, whose ends, where the contour runs into the rim, no centre sees."""
    points, camera = tube(taper), rts.Camera.look_at((aside, 0.1 * aside, 4), (0, 0, 0), fov_y=25)
    surface, way = rts.BSpline((8, 8), ("open", "periodic")), np.array([1.0, 0, 0])
    vertices, faces = surface.tessellate({"points": points}, 24)

    def drawn(surface, name, at):
        def scene(t):
            moved = torch.as_tensor(at, dtype=torch.float64) + t * torch.as_tensor(way)
            part = rts.Part(surface, {name: moved, "color": WHITE}, "silhouette")
            return rts.render(part, camera, SIZE, splatter="edges")[..., 3]

        return pushed(scene)

    (image, slope), (expected, rate) = drawn(surface, "points", points), drawn(rts.Mesh(faces), "vertices", vertices)
    # Of the crescent's tip, a line of a third of a pixel and less.
    assert np.abs(image - expected).max() < 0.08
    assert np.linalg.norm(slope - rate) < 0.15 * np.linalg.norm(rate)


@pytest.mark.parametrize("place", [[0.5], [0.5, 0.5], [0.5, 0.50005], [0.00005], [0.99995]])
@pytest.mark.parametrize("part", [0, -1])
def test_nothing_ends_at_hints_where_nothing_changes(place, part):
    """Hints of neighbouring triangles are close to one another, as intervals are in which something ends."""

    def seen(*shape):
        return Fronts(np.full(shape, part, np.int32), np.full(shape, -1, np.int32), np.full(shape, 2.0 * (part >= 0)))

    hints = Hints(np.array([[1, 1, 1]] * len(place), np.int32), np.array(place))
    oracle = Oracle(lambda points: seen(1, len(points)), np.array([0.0, 0.01]))
    breaks, _ = find_breaks(seen(1, 4, 4), oracle, hints)
    assert not len(breaks.gap) and breaks.joined[0, 1, 1] == (part >= 0)
