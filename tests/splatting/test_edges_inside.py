"""Outlines where the camera stands inside the scene: triangles reach behind it."""

import itertools

import numpy as np
import pytest
from cards import covered
from helpers import pushed, quick

import rts
from rts.contracts.records import Proxy
from rts.outlines.seen_mesh import SeenMesh
from rts.outlines.silhouettes_loops import ANY_SIZE

pytestmark = pytest.mark.splatting

CAMERA = rts.Camera.look_at((0, 0, 0), (-1.5, -1.3, -3), fov_y=40)
SIZE = (24, 24)
CORNERS = np.array([(-1, -1, -20), (-1, -1, 20), (9, -1, -20), (9, -1, 20), (-1, 9, -20), (-1, 9, 20)], np.float32)
"""The first two are the ends of the line, ahead and behind, in which two walls meet."""
WALLS = np.array([(0, 1, 3), (0, 3, 2), (0, 1, 5), (0, 5, 4)])
COLORS = (0.9, 0.1, 0.2), (0.1, 0.8, 0.3)
TURNS = [(0, 1, 2), (1, 2, 0), (2, 0, 1)]


def room(turns, parts, vertices=CORNERS, colors=((1.0, 1, 1), (1.0, 1, 1))):
    """Both walls, one part or two, whose triangles name their corners in these orders."""
    faces = np.array([face[list(turn)] for face, turn in zip(WALLS, turns, strict=True)])
    theta = [{"vertices": vertices, "color": np.array(color)} for color in colors]
    if parts == 1:
        return [rts.Part(rts.Mesh(faces), theta[0], "unlit")]
    halves = zip((faces[:2], faces[2:]), theta, strict=True)
    return [rts.Part(rts.Mesh(own), entries, "unlit") for own, entries in halves]


@pytest.mark.parametrize("parts", [1, 2])
def test_white_walls_fill_the_image_whatever_the_order_of_corners(parts):
    for one, other, last in itertools.product(TURNS, repeat=3):
        turns = one, one, other, last
        image = rts.render(room(turns, parts), CAMERA, SIZE, splatter="edges")
        np.testing.assert_allclose(image, np.ones((*SIZE, 4)), atol=1e-6, err_msg=str(turns))


@pytest.mark.parametrize("turn", TURNS)
def test_triangles_that_reach_behind_the_camera_are_large(turn):
    """One triangle of the first wall has one corner ahead, and the other has two."""
    faces = WALLS[:, list(turn)].astype(np.int32)
    sides = SeenMesh.of(Proxy(CORNERS, faces), CAMERA, SIZE, "none").sides
    np.testing.assert_array_equal(np.abs(sides[:4]), ANY_SIZE)


def floor(shift):
    """Share (H, W) of each pixel on the side of the line where the first wall is, once both walls have moved."""
    ends = np.array([(-1, -1, -20), (-1, -1, -2)]) + shift
    to_clip = CAMERA.projection @ CAMERA.view
    x, y, _, w = to_clip @ np.column_stack([ends, np.ones(2)]).T
    points = (np.column_stack([x / w, -y / w]) + 1) * 12
    way = points[1] - points[0]
    # Points of the wall lie to the right of the way from ahead to the viewer, in an image whose y goes down.
    aside, far = np.array([way[1], -way[0]]), 100
    first, last = points[0] - far * way, points[1] + far * way
    return covered(np.array([first, last, last + far * aside, first + far * aside]), SIZE)


@pytest.mark.parametrize(("one", "other"), quick(list(itertools.product(TURNS, repeat=2)), 3))
def test_the_line_where_walls_of_two_colours_meet_moves_as_its_areas(one, other):
    torch = pytest.importorskip("torch")
    order, way = [one, one, other, other], np.array([0.3, 1.0, 0], np.float32)

    def scene(t):
        return rts.render(room(order, 2, torch.as_tensor(CORNERS) + t * torch.as_tensor(way), COLORS), CAMERA, SIZE)

    image, slope = pushed(scene)
    first, second = (np.array([*color, 1]) for color in COLORS)
    np.testing.assert_allclose(image, second + floor(0)[..., None] * (first - second), atol=1e-4)
    truth = (floor(1e-5 * way) - floor(-1e-5 * way))[..., None] / 2e-5 * (first - second)
    assert np.linalg.norm(slope - truth) < 0.02 * np.linalg.norm(truth)
