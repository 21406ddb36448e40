"""Found edges in traced programs of jax: jit, vmap, forward over reverse, and the room that they have."""

import numpy as np
import pytest
from example_surfaces import part_of
from found_outlines import noted
from helpers import icosphere
from test_edges_pairs import CAMERA

import rts

jax, torch = pytest.importorskip("jax"), pytest.importorskip("torch")
jnp = jax.numpy

pytestmark = pytest.mark.splatting
thorough = pytest.mark.thorough

SIZE = 24, 28
POSE = np.array([0.1, -0.2, 0.05, 0.03, 0.02, -0.04], np.float32)


def two_parts(pose):
    """A ball before a card, each of which moves, with different surfaces of triangles."""
    vertices, faces = icosphere(2)
    ball = rts.Part(
        rts.Mesh(faces),
        {"vertices": np.float32(0.6 * vertices), "color": np.float32([0.9, 0.3, 0.2])},
        "unlit",
        transform=rts.rigid(pose),
    )
    corners = np.float32([[-1.2, -0.9, -0.5], [1.1, -1, -0.4], [1, 0.9, -0.6], [-0.9, 1, -0.5]])
    theta = {"vertices": corners, "color": np.float32([0.2, 0.5, 0.8])}
    card = rts.Part(rts.Mesh(np.array([[0, 1, 2], [0, 2, 3]])), theta, "unlit", transform=rts.rigid(0.3 * pose[::-1]))
    return [ball, card]


def image(pose, **options):
    return rts.render(two_parts(pose), CAMERA, SIZE, splatter="edges", **options)


def loss(pose):
    picture = image(pose)
    return (picture * jnp.asarray(np.random.default_rng(0).normal(size=picture.shape), picture.dtype)).mean()


@thorough
@pytest.mark.filterwarnings("ignore:second derivatives")
def test_forward_over_reverse_is_the_same_in_a_program():
    pose, way = jnp.asarray(POSE), jnp.ones(6, jnp.float32)

    def twice(pose):
        return jax.jvp(jax.grad(loss), (pose,), (way,))[1]

    found = twice(pose)
    assert np.abs(found).max() > 1e-3
    np.testing.assert_allclose(jax.jit(twice)(pose), found, atol=1e-5)


# In a program NumPy casts the rays between centres: a step of depth at a limb may be a break in one of the two.
@thorough
@pytest.mark.parametrize(
    ("surface", "most"), [("bezier", 1e-4), ("isosurface", 1e-4), ("field", 0.01), ("ellipsoid", 0.03)]
)
def test_every_kind_of_surface_is_found_in_a_program(surface, most):
    part = part_of(surface)

    def drawn(pose):
        return rts.render(part.replace(transform=rts.rigid(pose)), CAMERA, SIZE, splatter="edges")

    pose = np.float32(0.3 * POSE)
    np.testing.assert_allclose(jax.jit(drawn)(jnp.asarray(pose)), drawn(torch.tensor(pose)), atol=most)


@thorough
def test_crossings_beyond_the_room_are_counted():
    """Needles whose outlines have more crossings than a program has room for, unless it is given more."""
    count = 90
    x = np.linspace(1, 27, count) + np.random.default_rng(0).uniform(-0.05, 0.05, count)
    foot = np.column_stack([x, np.full(count, 23.0), np.full(count, -3.0)])
    tip = np.column_stack([x + 0.2, np.full(count, 1.0), np.full(count, -3.0)])
    vertices = np.float32(np.stack([foot, foot + [0.12, 0, 0], tip], 1).reshape(-1, 3))
    faces = np.arange(3 * count).reshape(-1, 3)
    height, width = SIZE
    projection = np.array([[2 / width, 0, 0, -1], [0, -2 / height, 0, 1], [0, 0, -0.02, -1], [0, 0, 0, 1]])
    camera = rts.Camera(np.eye(4), projection)

    def sampled(vertices, **options):
        part = rts.Part(rts.Mesh(faces), {"vertices": vertices}, "silhouette")
        return rts.sample(part, camera, SIZE, splatter="edges", **options)

    vertices = jnp.asarray(vertices)
    with noted() as seen:
        sampled(vertices)
        with pytest.warns(rts.errors.InputWarning, match="edge crossings find no room beside"):
            short = jax.block_until_ready(jax.jit(sampled)(vertices))
    found, *_, room = (len(outlines.place) for outlines, _ in seen)
    assert found > room
    assert abs(int(short.overflow) - (found - room)) <= 2
    enough = jax.jit(lambda v: sampled(v, capacity=4 * found + 40))(vertices)
    assert int(enough.overflow) == 0
