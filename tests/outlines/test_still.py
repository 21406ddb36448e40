"""Scenes in which nothing moves: samples beside outlines tell colours alone, and there are half as many."""

import numpy as np
import pytest
from found_outlines import sampled_with_outlines
from helpers import icosphere

import rts
from rts.outlines.required import Required
from rts.sampling.scene import Scene
from rts_surfaces.implicit.narrow_band import NarrowBand

torch = pytest.importorskip("torch")

pytestmark = pytest.mark.splatting

SIZE = (32, 32)
CAMERA = rts.Camera.look_at((0.3, 0.5, 3), (0, 0, 0), fov_y=40)
CAMERAS = [CAMERA, rts.Camera.look_at((-1, 0.2, 3), (0, 0, 0), fov_y=40)]
VERTICES, FACES = icosphere(2, 0.7)


class Counted(rts.Shader):
    """Colours that change along x and with the normal, and the number of samples shaded so far."""

    opaque, takes_views = True, True
    reads = ("normal", "tint")

    def __init__(self):
        self.rows = 0

    def __call__(self, theta, gbuffer, camera):
        shade = 1.5 + gbuffer["position"][:, :1] + 0.5 * gbuffer["normal"][:, 1:2]
        self.rows += shade.shape[0]
        xp = rts.namespace(shade)
        color = shade * theta["tint"] if "tint" in theta else xp.concat([shade] * 3, axis=1)
        xp = rts.namespace(color)
        return xp.concat([color, xp.ones_like(color[:, :1])], axis=1)


def sphere(theta, points):
    return ((points - theta["center"]) ** 2).sum(-1) ** 0.5 - 0.6


def rows_and_gradient(kind, geometry, draw):
    """The number of shaded samples, the images, and their gradient in a tint; `geometry` makes the arrays of shapes."""
    tint = torch.tensor([0.2, 0.5, 0.7], requires_grad=True)
    shader = Counted()
    near = geometry((VERTICES * 0.6 + [0.3, 0.2, 0.9]).astype(np.float32))
    second = rts.Part(rts.Mesh(FACES), {"vertices": near, "tint": tint}, shader)
    if kind == "mesh":
        first = rts.Part(rts.Mesh(FACES), {"vertices": geometry(VERTICES), "tint": tint}, shader)
    else:
        axis = np.linspace(-1, 1, 13, dtype=np.float32)
        values = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1)
        values = np.linalg.norm(values, axis=-1).astype(np.float32)
        first = rts.Part(rts.Isosurface(((-1,) * 3, (1,) * 3), 0.7), {"values": geometry(values)}, shader)
    images = draw([first, second])
    weights = torch.as_tensor(np.random.default_rng(0).random(images.shape), dtype=images.dtype)
    (images * weights).sum().backward()
    return shader.rows, images.detach().numpy(), tint.grad.numpy()


@pytest.mark.parametrize("kind", ["mesh", "isosurface"])
@pytest.mark.parametrize(
    "draw",
    [
        lambda parts: rts.render(parts, CAMERA, SIZE),
        lambda parts: rts.render(parts, CAMERA, SIZE, supersample=2),
        lambda parts: rts.render_views(parts, CAMERAS, SIZE),
    ],
)
def test_where_nothing_moves_colours_alone_are_told(kind, draw):
    still, image, slopes = rows_and_gradient(kind, np.asarray, draw)
    moving, same_image, same_slopes = rows_and_gradient(kind, torch.as_tensor, draw)
    assert still < moving
    np.testing.assert_allclose(image, same_image, atol=2e-5)
    np.testing.assert_allclose(slopes, same_slopes, rtol=1e-5)


def test_half_of_the_samples_beside_outlines_are_left():
    def rows(geometry):
        return rows_and_gradient("mesh", geometry, lambda parts: rts.render(parts, CAMERA, SIZE))[0]

    part = rts.Part(rts.Mesh(FACES), {"vertices": VERTICES}, "normals")
    near = part.replace(theta={"vertices": (VERTICES * 0.6 + [0.3, 0.2, 0.9]).astype(np.float32)})
    sampled, outlines = sampled_with_outlines([part, near], CAMERA, SIZE)
    required = sampled.row, outlines.rows[:, :2], outlines.rows[:, 2:4]
    seen = [np.count_nonzero(np.asarray(x) >= 0) for x in required]
    assert rows(torch.as_tensor) == sum(seen)
    assert rows(np.asarray) == seen[0] + seen[2]


def test_samples_that_are_kept_tell_motions():
    """`rts.sample` does not know what will move."""
    part = rts.Part(rts.Mesh(FACES), {"vertices": VERTICES}, "lambert")
    sampled = rts.sample(part, CAMERA, SIZE)
    pose = torch.zeros(6, requires_grad=True)
    rts.render_samples(sampled, part.replace(transform=rts.rigid(pose)), CAMERA)[..., 3].mean(0)[0:10].sum().backward()
    assert np.abs(pose.grad[3].numpy()) > 0.01


BOUNDS = (-1.5,) * 3, (1.5,) * 3


@pytest.mark.parametrize(
    ("surface", "theta"),
    [
        (rts.Isosurface(BOUNDS, 0.0, sphere, (9,) * 3, reads=["center"]), {"center": torch.zeros(3)}),
        # Its lattice is made by NumPy.
        (
            rts.Isosurface(BOUNDS, 0.0, sphere, (9,) * 3, reads=["center"], band=NarrowBand()),
            {"center": torch.zeros(3)},
        ),
        # Rays that graze it tell badly where it is, and its function may close over what moves it.
        (rts.Sdf(sphere, 1.0), {"center": np.zeros(3, np.float32)}),
        (rts.Mesh(FACES), {"vertices": torch.as_tensor(VERTICES)}),
    ],
)
def test_other_scenes_have_motions_told(surface, theta):
    still = rts.Part(rts.Mesh(FACES), {"vertices": VERTICES, "color": torch.ones(3)}, "lambert")
    assert Required.of([Scene.of([still], CAMERA, "auto", None)], False) == Required(motions=False)
    assert (
        Required.of([Scene.of([still, rts.Part(surface, theta, "lambert")], CAMERA, "auto", None)], False) == Required()
    )


def test_a_program_whose_tint_is_traced_tells_colours_alone():
    jax = pytest.importorskip("jax")
    rows = []

    def image(tint, vertices):
        shader = Counted()
        drawn = rts.render(rts.Part(rts.Mesh(FACES), {"vertices": vertices, "tint": tint}, shader), CAMERA, SIZE)
        rows.append(shader.rows)
        return drawn

    tint = jax.numpy.asarray([0.2, 0.5, 0.7])
    still = jax.jit(lambda t: image(t, VERTICES))(tint)
    moving = jax.jit(image)(tint, VERTICES)
    np.testing.assert_allclose(still, moving, atol=2e-5)
    assert rows[0] < rows[1]
