"""Faces that cross others are found, and moved apart, by closed forms."""

import numpy as np
import pytest
import trimesh
from rts_reconstruct.crossings import crossing_pairs
from rts_reconstruct.untangling import untangled

TRIANGLE = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])


def beside(other):
    """A triangle and another one, without common corners."""
    return np.concatenate([TRIANGLE, other]), np.arange(6).reshape(2, 3)


@pytest.mark.parametrize(
    ("other", "crosses"),
    [
        ([[0.2, 0.2, -1], [0.3, 0.2, 1], [0.2, 0.3, 1]], True),  # Through the inside.
        ([[0.2, 0.2, 0.1], [0.3, 0.2, 1], [0.2, 0.3, 1]], False),  # Above.
        ([[0.2, 0.2, 0.0], [0.3, 0.2, 1], [0.2, 0.3, 1]], False),  # Touches.
        ([[0.6, 0.6, -1], [0.7, 0.6, 1], [0.6, 0.7, 1]], False),  # Beside the longest side.
        ([[-1, 0.2, -0.1], [2, 0.2, -0.1], [0.5, 0.2, 3]], True),  # Its edges pass by; those of the first do not.
    ],
)
def test_two_triangles(other, crosses):
    vertices, faces = beside(np.array(other, float))
    for order in (faces, faces[::-1]):
        assert len(crossing_pairs(vertices, order)) == crosses


def test_faces_with_a_common_corner_cross_if_they_go_on_through_each_other():
    vertices = np.concatenate([TRIANGLE, [[0.3, 0.3, 0.2], [0.3, 0.3, -0.2], [-0.3, -0.3, 0.2]]])
    assert crossing_pairs(vertices, np.array([[0, 1, 2], [0, 3, 4]])).tolist() == [[0, 1]]
    assert len(crossing_pairs(vertices, np.array([[0, 1, 2], [0, 3, 5]]))) == 0
    assert len(crossing_pairs(vertices, np.array([[0, 1, 2], [0, 1, 4]]))) == 0  # They share an edge.


def ball(count):
    """Vertices and faces of a unit sphere; uneven, since mirrored edges would only touch."""
    mesh = trimesh.creation.icosphere(count)
    vertices = mesh.vertices + 0.02 * np.random.default_rng(0).normal(size=mesh.vertices.shape)
    return vertices / np.linalg.norm(vertices, axis=1, keepdims=True), np.array(mesh.faces)


def volume(vertices, faces):
    return trimesh.Trimesh(vertices, faces, process=False).volume


def test_pairs_among_some_faces_are_those_of_all_with_any_of_them():
    vertices, faces = ball(2)
    vertices, faces = np.concatenate([vertices, vertices + [1, 0.01, 0.02]]), np.concatenate([faces, faces + 162])
    every = {frozenset(pair) for pair in crossing_pairs(vertices, faces).tolist()}
    assert len(every) > 50
    found = crossing_pairs(vertices, faces, np.arange(0, len(faces), 3)).tolist()
    assert len(found) == len({frozenset(pair) for pair in found})
    assert {frozenset(pair) for pair in found} == {pair for pair in every if any(face % 3 == 0 for face in pair)}
    # Along a circle: of two unit spheres at a distance of 1, its radius is √3/2.
    middle = vertices[faces[np.unique([list(pair) for pair in every])]].mean(axis=1)
    np.testing.assert_allclose(middle[:, 0], 0.5, atol=0.2)
    np.testing.assert_allclose(np.linalg.norm(middle[:, 1:], axis=1), 0.75**0.5, atol=0.15)


def test_a_clean_mesh_stays_as_it_is():
    vertices, faces = ball(3)
    np.testing.assert_array_equal(untangled(vertices, faces), vertices.astype(np.float32))


def test_a_sheet_that_went_through_another_is_moved_back():
    vertices, faces = ball(3)
    flat = vertices * [1, 1, 0.1]
    across = np.linalg.norm(flat[:, :2], axis=1)
    flat[(across < 0.5) & (flat[:, 2] > 0), 2] -= 0.25  # The upper sheet is below the lower one.
    assert len(crossing_pairs(flat, faces)) > 20
    found = untangled(flat, faces)
    assert len(crossing_pairs(found, faces)) == 0
    np.testing.assert_array_equal(found[across > 0.9], flat[across > 0.9].astype(np.float32))
    middle = np.linalg.norm(found[:, :2], axis=1) < 0.3
    assert found[middle & (vertices[:, 2] > 0), 2].min() > found[middle & (vertices[:, 2] < 0), 2].max()


def test_an_overlap_is_taken_apart():
    vertices, faces = ball(3)
    vertices = vertices * [1, 0.3, 0.3]
    bent, away = 3.3 * vertices[:, 0], 1 + vertices[:, 1]  # To a ring, whose ends overlap.
    ring = np.stack([away * np.sin(bent), away * np.cos(bent), vertices[:, 2]], axis=1)
    assert volume(ring, faces) > 0 and len(crossing_pairs(ring, faces)) > 5
    found = untangled(ring, faces)
    assert len(crossing_pairs(found, faces)) == 0 and volume(found, faces) > 0.9 * volume(ring, faces)


def test_faces_of_an_open_mesh_are_smoothed_apart():
    vertices, faces = ball(3)
    upper = faces[vertices[faces].mean(axis=1)[:, 2] > -0.2]
    top = np.argmax(vertices[:, 2])
    vertices[top] = (1.3, 0.05, 0.02)  # A spike, from within through the side.
    assert len(crossing_pairs(vertices, upper)) > 0
    assert len(crossing_pairs(untangled(vertices, upper), upper)) == 0
