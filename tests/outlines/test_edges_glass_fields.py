"""Found edges of layers that light passes through, of fields by rays: balls, whose images have a closed form."""

from dataclasses import replace

import numpy as np
import pytest
from helpers import icosphere, pushed

import rts
from rts_diagnostics.smoothing import low_pass

torch = pytest.importorskip("torch")
forward = pytest.importorskip("torch.autograd.forward_ad")

pytestmark = pytest.mark.splatting

SIZE, DISTANCE, BACK = 24, 4.0, -1.5
CAMERA = rts.Camera.look_at((0, 0, DISTANCE), (0, 0, 0), fov_y=30)
FOCAL = SIZE / 2 / np.tan(np.radians(15))
WALL = np.array([0.2, 0.3, 1, 1])
PINK, GREEN, SOLID = np.array([0.5, 0.15, 0.1, 0.5]), np.array([0.1, 0.5, 0.2, 0.6]), np.array([0.2, 0.9, 0.3, 1])
APART = {"center": (0.13, 0.07, 0.4), "radius": 0.5}, {"center": (-0.25, -0.1, -0.7), "radius": 0.55}
CROSSING = {"center": (0.13, 0.07, 0.3), "radius": 0.5}, {"center": (-0.25, -0.1, -0.5), "radius": 0.55}
STEP = 0.006
SHIFT, GROW = {"center": (1.0, 0.3, 0.5), "radius": 0.0}, {"center": (0.0, 0.0, 0.0), "radius": 1.0}


class Flat(rts.Shader):
    """One colour (4,), premultiplied."""

    def __init__(self, color):
        self.color, self.opaque = color, color[3] == 1

    def __call__(self, theta, gbuffer, camera):
        xp, one = rts.namespace(gbuffer["position"]), gbuffer["position"][:, :1] * 0 + 1
        return xp.concat([one * float(c) for c in self.color], axis=1)


def outside(theta, points):
    return ((points - theta["center"]) ** 2).sum(-1) ** 0.5 - theta["radius"]


def mesh(ball, color):
    vertices, faces = icosphere(4)
    vertices = torch.as_tensor(vertices, dtype=torch.float32) * ball["radius"] + ball["center"]
    return rts.Part(rts.Mesh(np.asarray(faces)), {"vertices": vertices}, Flat(color))


def field(ball, color):
    return rts.Part(rts.Sdf(outside, 3.0), ball, Flat(color))


def wall():
    corners = np.array([[-9, -9, BACK], [9, -9, BACK], [9, 9, BACK], [-9, 9, BACK]], np.float32)
    return rts.Part(rts.Mesh(np.array([[0, 1, 2], [0, 2, 3]])), {"vertices": corners}, Flat(WALL))


def drawn(balls, colors, kind=field, **options):
    parts = [*map(kind, balls, colors), wall()]
    return rts.render(parts, CAMERA, (SIZE, SIZE), splatter="edges", layers=2 * len(balls) + 1, **options)


def plain(ball):
    return {name: np.asarray(x, np.float64) for name, x in ball.items()}


def tensors(ball):
    return {name: torch.tensor(x, dtype=torch.float32) for name, x in ball.items()}


def moved(ball, t, motion, of=tensors):
    """A ball of arrays that `of` makes."""
    ball, motion = of(ball), of(motion)
    return {name: x + t * motion[name] for name, x in ball.items()}


def area(balls, colors, fine=40):
    """The area-sampled image (H, W, 4) of balls before the wall, by the roots of rays."""
    x, y = np.meshgrid(*[(np.arange(SIZE * fine) + 0.5) / fine - SIZE / 2] * 2)
    ways = np.stack([x / FOCAL, -y / FOCAL, -np.ones_like(x)], -1)
    depths, own = [np.full(x.shape, DISTANCE - BACK)], [WALL]
    for ball, color in zip(balls, colors, strict=True):
        to = np.array([0, 0, DISTANCE]) - ball["center"]
        square, half = (ways**2).sum(-1), ways @ to
        root = half**2 - square * (to @ to - ball["radius"] ** 2)
        for sign in (-1, 1):
            depth = (sign * np.sqrt(np.maximum(root, 0)) - half) / square
            depths.append(np.where(root > 0, depth, np.inf))
            own.append(color)
    image, own = np.zeros((*x.shape, 4)), np.array(own)
    for layer, depth in zip(np.argsort(depths, 0)[::-1], np.sort(depths, 0)[::-1], strict=True):
        image = np.where(np.isfinite(depth)[..., None], own[layer] + (1 - own[layer][..., 3:]) * image, image)
    return image.reshape(SIZE, fine, SIZE, fine, 4).mean((1, 3))


SCENES = {
    "before a wall": (APART[:1], [PINK]),
    "before glass": (APART, [PINK, GREEN]),
    "before a ball": (APART, [PINK, SOLID]),
    "through glass": (CROSSING, [PINK, GREEN]),
    "through a ball": (CROSSING, [PINK, SOLID]),
}


def error(name, moves, motion, kind=field):
    """The low-passed relative L2 error of the derivative as one ball moves."""
    balls, colors = SCENES[name]

    def scene(t, of):
        return [moved(ball, t, motion, of) if i == moves else of(ball) for i, ball in enumerate(balls)]

    image, derivative = pushed(lambda t: drawn(scene(t, tensors), colors, kind))
    assert np.sqrt(((image - area(scene(0, plain), colors)) ** 2).mean()) < 0.01
    true = low_pass(area(scene(STEP, plain), colors) - area(scene(-STEP, plain), colors)) / (2 * STEP)
    return np.linalg.norm(low_pass(derivative) - true) / np.linalg.norm(true)


@pytest.mark.parametrize(("name", "moves"), [("before a wall", 0), ("before a ball", 1), ("through a ball", 1)])
def test_a_ball_of_glass_has_the_motion_of_its_area(name, moves):
    """About as good as balls of triangles."""
    for motion in (SHIFT, GROW):
        assert error(name, moves, motion) <= 0.04


@pytest.mark.thorough
@pytest.mark.parametrize("name", SCENES)
def test_balls_of_glass_are_as_good_as_those_of_triangles(name):
    for moves, motion in zip(range(len(SCENES[name][0])), (SHIFT, GROW), strict=False):
        found = error(name, moves, motion)
        assert found <= 0.04 or found <= 1.5 * error(name, moves, motion, mesh)


@pytest.mark.parametrize("size", [32, 36])
def test_two_lines_of_intersection_that_are_close_are_told_apart(size):
    """Where first hits cross, and where backs do, in a plane that is seen nearly from its edge."""
    ball, other = {"center": (-0.2, 0.02, 0), "radius": 0.5}, {"center": (0.2, 0.1, 0), "radius": 0.5}

    def derivative(kind):
        def scene(t):
            parts = kind(moved(ball, t, GROW), PINK), kind(tensors(other), GREEN)
            return rts.render(parts, CAMERA, (size, size), splatter="edges", layers=5)

        return pushed(scene)[1]

    true = derivative(mesh)
    assert np.linalg.norm(derivative(field) - true) < 0.05 * np.linalg.norm(true)


def test_a_ball_of_half_light_gains_by_its_radius_what_its_area_does():
    """Two layers of alpha 1/2, on a circle of focal · r / √(D² − r²) pixels."""
    ball = {"center": (0.03, 0.02, 0), "radius": 0.7}

    def scene(t):
        part = field(moved(ball, t, GROW), PINK)
        return rts.render(part, CAMERA, (SIZE, SIZE), splatter="edges")

    image, derivative = (x[..., 3].sum() for x in pushed(scene))
    square = DISTANCE**2 - 0.7**2
    assert image == pytest.approx(0.75 * np.pi * FOCAL**2 * 0.7**2 / square, rel=2e-3)
    assert derivative == pytest.approx(0.75 * 2 * np.pi * FOCAL**2 * 0.7 * DISTANCE**2 / square**2, rel=0.01)


def both_moved(t, as_array=tensors):
    ball, other = CROSSING
    return [moved(ball, t, {**SHIFT, "radius": 0.3}, as_array), moved(other, t, GROW, as_array)]


def test_forward_mode_and_reverse_mode_agree():
    weights = torch.as_tensor(np.random.default_rng(0).normal(size=(SIZE, SIZE, 4)), dtype=torch.float32)

    def loss(t):
        return (drawn(both_moved(t), [PINK, SOLID]) * weights).sum()

    with forward.dual_level():
        by_forward = float(forward.unpack_dual(loss(forward.make_dual(torch.zeros(()), torch.ones(())))).tangent)
    t = torch.zeros((), requires_grad=True)
    loss(t).backward()
    assert t.grad is not None
    assert float(t.grad) == pytest.approx(by_forward, rel=1e-3)


class OfWholeImages(rts.Sampler):
    """Casts rays through centres of pixels alone."""

    def sample(self, part, camera, size, layers, request):
        return rts.plugin("samplers", "rays")().sample(part, camera, size, layers, replace(request, points=None))


def test_a_sampler_without_single_points_has_outlines_of_glass_between_centres():
    with pytest.warns(rts.errors.InputWarning, match="does not sample single points"):
        image = rts.render(field(tensors(APART[0]), PINK), CAMERA, (SIZE, SIZE), sampler=OfWholeImages(), layers=2)
    np.testing.assert_allclose(image[10:13, 11:14, 3], 0.75, atol=1e-6)


@pytest.mark.parametrize("distance", [6.0, 0.5])
def test_a_ball_of_numpy_arrays_is_drawn_from_outside_and_from_inside(distance):
    part = rts.Part(rts.Sdf(outside, 3.0), {"center": np.zeros(3), "radius": np.float32(0.8)}, Flat(PINK))
    image = rts.render(part, rts.Camera.look_at((0, 0, distance), (0, 0, 0)), (SIZE, SIZE), splatter="edges")
    assert image[12, 12, 3] == pytest.approx(0.75 if distance > 1 else 0.5)
