"""Gradients of single vertices by found edges, against area-sampled images."""

import pytest

pytest.importorskip("torch")
pytest.importorskip("trimesh")

pytestmark = pytest.mark.splatting

BOUNDS = {
    "silhouette": {"edges 1 × 1": (0.12, 0.04), "edges 4 × 4": (0.12, 0.04)},
    "crease": {"edges 1 × 1": (0.42, 0.3), "edges 4 × 4": (0.11, 0.08)},
    "inside": {"edges 1 × 1": (0.36, 0.22), "edges 4 × 4": (0.11, 0.05)},
}
"""The largest error and difference of the gain from 1, by the kind of vertices."""


@pytest.mark.thorough
@pytest.mark.parametrize("kind", BOUNDS)
def test_gradients_of_vertices_are_those_of_area_sampled_images(kind):
    from benchmarks.edges_vertices import scores

    found = scores(kind, samples=16)
    for method, (error, off) in BOUNDS[kind].items():
        assert found[method][0] < error and abs(found[method][1] - 1) < off
    assert found["multi 1 × 1"][0] > found["edges 1 × 1"][0]


@pytest.mark.thorough
def test_silhouettes_move_vertices_several_times_as_truly_as_with_the_papers_splatter():
    from benchmarks.edges_vertices import scores

    found = scores("silhouette", samples=8)
    assert found["multi 1 × 1"][0] > 4 * found["edges 1 × 1"][0]
