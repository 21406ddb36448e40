"""Surfaces of patches that are thinner than a pixel, in the image, between their contour and their rim."""

import numpy as np
import pytest
from helpers import pushed

import rts
from rts.outlines.gaps import Hits
from rts.outlines.halving import Hints, Oracle, find_crossings

torch = pytest.importorskip("torch")

pytestmark = pytest.mark.sampling

WHITE = np.ones(3)


def tube(taper):
    """Control points (8, 8, 3) of a tube along z, open at both ends."""
    z, angle = np.linspace(-1, 1, 8), 2 * np.pi * np.arange(8) / 8
    radius = 0.5 * (1 + taper * z)[:, None]
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), z[:, None] + 0 * angle], axis=-1)


@pytest.mark.parametrize(
    ("taper", "aside", "size", "most"),
    [
        (0.0, 0.6, 48, 0.08),
        (0.0, 0.6, 64, 0.15),
        pytest.param(0.0, 0.6, 80, 0.08, marks=pytest.mark.thorough),
        pytest.param(0.2, 1.0, 48, 0.08, marks=pytest.mark.thorough),
        pytest.param(0.2, 1.0, 64, 0.08, marks=pytest.mark.thorough),
    ],
)
def test_an_open_tube_seen_along_its_axis_is_that_of_its_fine_triangles(taper, aside, size, most):
    """Behind its opening the inside is a crescent, whose ends, where the contour runs into the rim, no centre sees."""
    points, camera = tube(taper), rts.Camera.look_at((aside, 0.1 * aside, 4), (0, 0, 0), fov_y=25)
    surface, way = rts.BSpline((8, 8), ("open", "periodic")), np.array([1.0, 0, 0])
    vertices, faces = surface.tessellate({"points": points}, 24)

    def drawn(surface, name, at):
        def scene(t):
            moved = torch.as_tensor(at, dtype=torch.float64) + t * torch.as_tensor(way)
            part = rts.Part(surface, {name: moved, "color": WHITE}, "silhouette")
            return rts.render(part, camera, (size, size), splatter="edges")[..., 3]

        return pushed(scene)

    (image, slope), (expected, rate) = drawn(surface, "points", points), drawn(rts.Mesh(faces), "vertices", vertices)
    # Of the crescent's tip, a line of a third of a pixel and less.
    assert np.abs(image - expected).max() < 0.08
    assert np.linalg.norm(slope - rate) < most * np.linalg.norm(rate)


@pytest.mark.parametrize("place", [[0.5], [0.5, 0.5], [0.5, 0.50005], [0.00005], [0.99995]])
@pytest.mark.parametrize("part", [0, -1])
def test_nothing_ends_at_hints_where_nothing_changes(place, part):
    """Hints of neighbouring triangles are close to one another, as intervals are in which something ends."""

    def seen(*shape):
        return Hits(np.full(shape, part, np.int32), np.full(shape, -1, np.int32), np.full(shape, 2.0 * (part >= 0)))

    hints = Hints(np.array([[1, 1, 1]] * len(place), np.int32), np.array(place))
    oracle = Oracle(lambda points: seen(1, len(points)), np.array([0.0, 0.01]))
    crossings, _ = find_crossings(seen(1, 4, 4), oracle, hints)
    assert not len(crossings.gap) and crossings.joined[0, 1, 1] == (part >= 0)


@pytest.mark.parametrize("turn", np.linspace(0, 1.8, 7))
def test_where_three_outlines_meet_their_directions_are_known(turn):
    """Sectors of three parts around a point; elsewhere directions are not looked for."""
    middle, ways = np.array([2.1, 1.93]), np.stack([turn, turn + 2.3, turn + 4.0])

    def layers(points):
        x, y = (points - middle).T
        part = np.searchsorted(ways - turn, (np.arctan2(y, x) - turn) % (2 * np.pi), side="right").astype(np.int32) - 1
        return Hits(part[None], np.full((1, len(part)), -1, np.int32), 1.0 + part[None])

    centres = np.stack(np.meshgrid(np.arange(5) + 0.5, np.arange(5) + 0.5), -1).reshape(-1, 2)
    seen = Hits(*(x.reshape(1, 5, 5) for x in layers(centres)))
    crossings, _ = find_crossings(seen, Oracle(layers, np.array([0.0, 0.01])))
    outward = crossings.place - middle
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    near = (np.abs(crossings.place - 2) <= 0.5).all(1)  # On the sides of the square with the point.
    assert near.sum() == 3 and not near.all()
    np.testing.assert_allclose(np.abs((crossings.tangent * outward).sum(1))[near], 1, atol=1e-3)
    assert (crossings.tangent == 0).all(1).any()
