"""Found edges of bodies whose own backs are the second layer: derivatives beside differences of area-sampled images."""

import numpy as np
import pytest
from helpers import icosphere

import rts
from rts_diagnostics.smoothing import low_pass

torch = pytest.importorskip("torch")
forward = pytest.importorskip("torch.autograd.forward_ad")

pytestmark = pytest.mark.splatting

SIZE, DEPTH, HALF = (64, 64), 3.2, 0.15
PIXEL = 2 * DEPTH * np.tan(np.radians(20)) / SIZE[0]
CAMERA = rts.Camera.look_at((0, 0, DEPTH), (0, 0, 0), fov_y=40)
SPHERE, FACES = icosphere(4)
CARD = np.array([[-0.62, -0.55, 0], [0.55, -0.5, 0], [0.6, 0.47, 0], [-0.58, 0.5, 0]])
TWO = np.array([[0, 1, 2], [0, 2, 3]])
BLUE, ORANGE = (0.2, 0.7, 1.0), (1.0, 0.6, 0.2)


def mesh(vertices, faces, shader="unlit", color=BLUE, moves=None):
    """A part, unculled; shifted by pixels of a tensor ()."""
    theta = {"vertices": np.asarray(vertices, np.float32), "color": np.asarray(color, np.float32)}
    transform = None
    if moves is not None:
        along = torch.zeros(4, 4)
        along[0, 3] = PIXEL
        transform = torch.eye(4) + moves * along
    theta = theta if shader in ("unlit", "lambert") else {"vertices": theta["vertices"]}
    return rts.Part(rts.Mesh(np.asarray(faces)), theta, shader, cull="none", transform=transform)


def in_range(part):
    """The part, whose shader `depth` shows those of the scene from black to white."""
    return part.replace(theta={**part.theta, "depth_range": np.float32([2, 5])})


def turned(points, x, y=0.0):
    (a, b), (c, d) = (np.cos([x, y]), np.sin([x, y]))
    about_x = np.array([[1, 0, 0], [0, a, -c], [0, c, a]])
    return points @ (about_x @ np.array([[b, 0, d], [0, 1, 0], [-d, 0, b]])).T


def bowl(t):
    half = SPHERE[:, 2] < 0.1
    return [mesh(turned(0.7 * SPHERE, 0.5, 0.3), FACES[half[FACES].all(axis=1)], "lambert", moves=t)]


SCENES = {
    "half hidden balls": lambda t: [
        mesh(0.5 * SPHERE + [-0.2, 0, 0.2], FACES),
        mesh(0.5 * SPHERE + [0.3, 0.1, -0.3], FACES, color=ORANGE, moves=t),
    ],
    "bowl": bowl,
    "ball on a plane": lambda t: [
        mesh(0.4 * SPHERE, FACES, "lambert", moves=t),
        mesh(turned(3 * CARD, -1.3) - [0, 0.4, 0], TWO, "lambert", ORANGE),
    ],
    "depth before a wall": lambda t: [
        in_range(mesh(0.5 * SPHERE, FACES, "depth", moves=t)),
        in_range(mesh(3 * CARD - [0, 0, 0.8], TWO, "depth")),
    ],
    "normals before a wall": lambda t: [
        mesh(0.5 * SPHERE, FACES, "normals", moves=t),
        mesh(3 * CARD - [0, 0, 0.8], TWO, "normals"),
    ],
}


def error(name, **options):
    """The low-passed relative L2 error of a scene's derivative."""

    def area(t):
        with torch.no_grad():
            image = rts.render(SCENES[name](torch.tensor(t)), CAMERA, SIZE, splatter="none", layers=1, supersample=32)
        return image.numpy()

    true = low_pass((area(HALF) - area(-HALF)) / (2 * HALF))
    with forward.dual_level():
        t = forward.make_dual(torch.zeros(()), torch.ones(()))
        own = forward.unpack_dual(rts.render(SCENES[name](t), CAMERA, SIZE, **options)).tangent.numpy()
    return np.linalg.norm(low_pass(own) - true) / np.linalg.norm(true)


@pytest.mark.thorough
@pytest.mark.parametrize("name", SCENES)
def test_one_layer_shows_what_outlines_uncover(name):
    assert error(name, splatter="edges") <= 0.04
