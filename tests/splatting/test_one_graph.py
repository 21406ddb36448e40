"""The splatters' array code as compilers take it: one graph, whatever the sizes, and no question about a value."""

from dataclasses import replace

import numpy as np
import pytest
from helpers import icosphere

import rts
from rts.arrays.trees import map_leaves
from rts.contracts.checks import check_splatter
from rts.rendering.splats import to_splats
from rts.sampling.scene import Grid, Scene

torch = pytest.importorskip("torch")
pytestmark = pytest.mark.splatting
thorough = pytest.mark.thorough

SIZES = (22, 26), (24, 20), (30, 34)
BALL, FACES = icosphere(2)


def splats(splatter, size):
    """Splats of a ball that a card passes through, as tensors without derivative."""
    camera = rts.Camera.look_at((1.0, 1.5, 3.2), (0, 0, 0), fov_y=45, aspect=size[1] / size[0])
    corners = np.array([[-1.2, -0.9, 0.5], [1.1, -1, 0.4], [1, 0.9, -0.6]])
    parts = [
        rts.Part(rts.Mesh(f), {"vertices": torch.tensor(np.float32(v)), "color": torch.tensor(color)}, "lambert")
        for f, v, color in ((FACES, BALL, [0.9, 0.3, 0.2]), (np.array([[0, 1, 2]]), corners, [0.1, 0.3, 0.8]))
    ]
    layers = 1 if splatter == "edges" else 2
    sampled = rts.sample(parts, camera, size, splatter=splatter, layers=layers)
    scene = Scene.of(parts, camera, "auto", None).at(size)
    context = scene.context_with(sampled)
    grid = Grid.of_samples(sampled, scene.parts, scene.camera, context)
    found = to_splats(sampled, scene.parts, scene.camera, grid, context)
    return map_leaves(lambda x: x.detach(), found)


def image_of(splatter):
    """The image as a function of positions, colours and splats."""
    splatter_object = check_splatter(splatter)
    return lambda positions, rgba, whole: splatter_object.image(replace(whole, positions=positions, rgba=rgba))


def with_gradients(image, found):
    """The image, and the gradients of a sum of it in positions and colours."""
    positions, rgba = (x.clone().requires_grad_() for x in (found.positions, found.rgba))
    picture = image(positions, rgba, found)
    weights = torch.linspace(-1, 1, picture.numel(), device=picture.device).reshape(picture.shape)
    return picture.detach(), *torch.autograd.grad((picture * weights).sum(), (positions, rgba))


@thorough
@pytest.mark.parametrize("splatter", ["edges", "multi"])
def test_it_is_one_graph_for_three_sizes(splatter):
    torch._dynamo.reset()
    image, graphs = image_of(splatter), []

    def backend(graph, inputs):
        graphs.append(graph)
        return graph

    compiled = torch.compile(image, fullgraph=True, dynamic=True, backend=backend)
    for size in SIZES:
        found = splats(splatter, size)
        for mine, other in zip(with_gradients(compiled, found), with_gradients(image, found), strict=True):
            np.testing.assert_allclose(mine, other, atol=2e-5)
    assert len(graphs) == 1


@thorough
def test_inductor_computes_what_the_loops_compute():
    """It compiles the default splatter, `edges`, in `tests/rendering/test_program.py`."""
    torch._dynamo.reset()
    found, image = splats("multi", SIZES[0]), image_of("multi")
    compiled = torch.compile(image, fullgraph=True, dynamic=True)
    for mine, other in zip(with_gradients(compiled, found), with_gradients(image, found), strict=True):
        np.testing.assert_allclose(mine, other, atol=2e-5)


@pytest.mark.parametrize("splatter", ["edges", "multi"])
def test_shapes_follow_without_values(splatter):
    """On torch's device "meta", whose tensors have shapes alone, nothing asks for a value."""
    found = map_leaves(lambda x: x.to("meta"), splats(splatter, SIZES[0]))
    picture, *gradients = with_gradients(image_of(splatter), found)
    assert picture.is_meta and picture.shape == (*found.row.shape[1:], 4)
    assert [x.shape for x in gradients] == [found.positions.shape, found.rgba.shape]
