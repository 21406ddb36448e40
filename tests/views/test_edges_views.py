"""Found edges in several views at once: images and gradients of a loop, by one splat."""

import numpy as np
import pytest
from example_surfaces import part_of
from helpers import arrays, box, icosphere, to_numpy

import rts
from rts import Camera
from rts.arrays.engines import engine_of, namespace
from rts.sampling import picture as side_by_side
from rts.sampling.picture import Picture
from rts.splatting.edges import Edges

torch = pytest.importorskip("torch")

pytestmark = pytest.mark.splatting
thorough = pytest.mark.thorough

SIZE = 18, 23
EYES = ((0.7, 0.9, 3.2), (-2.0, 0.4, 2.5), (0.3, -1.5, -3.0), (2.9, 0.3, 0.2))
CAMERAS = [Camera.look_at(eye, (0, 0, 0), fov_y=40) for eye in EYES]
POSE = np.array([0.1, -0.2, 0.05, 0.03, 0.02, -0.04])
WEIGHTS = np.random.default_rng(0).normal(size=(9, *SIZE, 4))


class Counted(Edges):
    """Found edges that count their images."""

    layers = 1
    reads = Edges.reads
    translucent = True

    def __init__(self):
        self.calls = 0

    def image(self, splats):
        self.calls += 1
        return super().image(splats)


def mesh(vertices, faces, shader="lambert", **theta):
    return rts.Part(rts.Mesh(faces), {"vertices": np.float32(vertices), **theta}, shader)


def crossing():
    """A ball that a box passes through, and another behind it."""
    vertices, faces = box(0.5)
    behind, more = icosphere(1, 0.5, (0.5, 0.3, -0.9))
    return [
        mesh(*icosphere(1, 0.8)),
        mesh(vertices + 0.4, faces, "normals"),
        mesh(behind, more, "unlit", color=np.float32([0.9, 0.4, 0.2])),
    ]


def pane(vertices, faces, color, alpha):
    colors = np.tile(np.float32([*color, alpha]), (len(vertices), 1))
    return mesh(vertices, faces, rts.plugin("shaders", "unlit")(opaque=alpha == 1), colors=colors)


def glass():
    """A ball of glass with a card in it, and a pane before both that passes through the ball."""
    card = np.array([[-1.0, -0.9, 0], [0.9, -1.0, 0.1], [1.0, 0.9, 0], [-0.9, 1.0, -0.1]])
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    return [
        pane(*icosphere(1, 0.8), (0.9, 0.8, 0.3), 0.5),
        pane(card / 3, faces, (0.2, 0.5, 0.8), 1.0),
        pane(0.7 * card + np.array([0.2, 0.1, 0.6]), faces, (0.9, 0.2, 0.1), 0.4),
    ]


def plain(theta, gbuffer, camera):
    """A shader that takes one view at a time."""
    xp, normal = namespace(gbuffer["normal"]), gbuffer["normal"]
    return xp.concat([abs(normal), xp.ones_like(normal[:, :1])], axis=-1)


SCENES = {
    "one": (lambda: crossing()[:1], {}),
    "three": (crossing, {}),
    "culled": (lambda: [crossing()[0].replace(cull="back", shader="silhouette")], {}),
    "finer": (crossing, {"supersample": 2}),
    "over": (crossing, {"background": np.float32([0.3, 0.1, 0.9])}),
    "glass": (glass, {"layers": 4}),
    "glass, finer": (lambda: glass()[:2], {"layers": 3, "supersample": 2}),
    "plain": (lambda: [crossing()[0].replace(shader=plain)], {"layers": 2}),
}
FIELDS = {
    "field": (lambda: [part_of("field")], {}),
    "field and mesh": (lambda: [part_of("field"), crossing()[1]], {}),
    "lattice": (lambda: [part_of("isosurface")], {}),
    "patches": (lambda: [part_of("bezier")], {}),
}


def scene_of(name, pose):
    """Parts moved by a pose, in arrays of its engine and precision, and the options of the scene."""
    make, options = {**SCENES, **FIELDS}[name]
    target = "numpy" if type(pose) is np.ndarray else "torch-cpu" if isinstance(pose, torch.Tensor) else "jax"
    dtype = str(pose.dtype).removeprefix("torch.")
    return [p.replace(theta=arrays(target, p.theta, dtype), transform=rts.rigid(pose)) for p in make()], options


def views(name, pose, splatter="edges", cameras=CAMERAS, **more):
    parts, options = scene_of(name, pose)
    return rts.render_views(parts, cameras, SIZE, splatter=splatter, **options, **more)


def looped(name, pose, cameras=CAMERAS, **more):
    parts, options = scene_of(name, pose)
    images = [rts.render(parts, camera, SIZE, splatter="edges", **options, **more) for camera in cameras]
    return namespace(*images).stack(images)


def weighed(images):
    return (images * engine_of(images).constant(WEIGHTS[: len(images)], images)).sum()


def with_gradient(images, pose):
    """Images, and the gradient of their weighed sum along the pose."""
    leaf = pose.clone().requires_grad_(True)
    found = images(leaf)
    return found.detach(), torch.autograd.grad(weighed(found), leaf)[0]


def assert_same(name, dtype=torch.float64, image=1e-12, slope=1e-11, **more):
    """Compare views with a loop; returns the number of images that were splatted."""
    pose, splatter = torch.tensor(POSE, dtype=dtype), Counted()
    found, along = with_gradient(lambda p: views(name, p, splatter, **more), pose)
    expected, slopes = with_gradient(lambda p: looped(name, p, **more), pose)
    assert slopes.abs().max() > 0.1
    torch.testing.assert_close(found, expected, rtol=0, atol=image)
    torch.testing.assert_close(along, slopes, rtol=0, atol=slope * float(slopes.abs().max()))
    return splatter.calls


@pytest.mark.parametrize("name", SCENES)
def test_views_and_gradients_are_those_of_a_loop_by_one_splat(name):
    assert assert_same(name) == 1


@thorough
@pytest.mark.parametrize("name", FIELDS)
def test_surfaces_that_are_sampled_view_by_view_share_a_splat(name):
    assert assert_same(name) == 1


# ------------------------------------------------------------------------------------------ views in the picture


def wall():
    """Two cards, before and behind the eye, each of which fills its view, in different colours."""
    square = np.array([[-9.0, -9], [9, -9], [9, 9], [-9, 9]])
    corners = [np.column_stack([square, np.full(4, z)]) for z in (-2.0, 2.0)]
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    colors = [np.linspace((0.1, 0.9, 0.2), (0.9, 0.3, 0.8), 4), np.linspace((0.9, 0.0, 0.1), (0.2, 0.8, 0.9), 4)]
    return [
        mesh(v, f, "unlit", colors=np.float32(c))
        for v, f, c in zip(corners, (faces, faces[:, ::-1]), colors, strict=True)
    ]


SCENES_THAT_FILL = [Camera.look_at((0, 0, 0), (0.1 * i, 0.2, side), fov_y=50) for i in (-1, 1, 3) for side in (-1, 1)]


def test_views_that_are_filled_to_their_borders_do_not_touch():
    parts = wall()

    def images(pose, together):
        own = [p.replace(theta=arrays("torch-cpu", p.theta, "float64"), transform=rts.rigid(pose)) for p in parts]
        if together:
            return rts.render_views(own, SCENES_THAT_FILL, SIZE, splatter="edges")
        return torch.stack([rts.render(own, c, SIZE, splatter="edges") for c in SCENES_THAT_FILL])

    (found, along), (expected, slopes) = (
        with_gradient(lambda p, t=t: images(p, t), torch.tensor(POSE)) for t in (True, False)
    )
    assert expected[..., 3].min() == 1
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-12)
    torch.testing.assert_close(along, slopes, rtol=0, atol=1e-11 * float(slopes.abs().max()))


def test_no_gap_leads_from_a_view_to_the_next(monkeypatch):
    seen = []

    class Kept(Counted):
        def image(self, splats):
            seen.append(splats)
            return super().image(splats)

    views("three", torch.tensor(POSE), Kept(), cameras=[*CAMERAS, *CAMERAS[:2]])
    (splats,) = seen
    place = Picture.of(6, tuple(n + 2 * 3 for n in SIZE))
    assert place.down > 1 and place.across > 1
    assert splats.row.shape[1:] == place.size
    stencil, (height, width) = to_numpy(splats.stencil), place.view
    joined = stencil.joined.reshape(2, place.down, height, place.across, width)
    assert joined.any() and not joined[0, ..., -1].any() and not joined[1, :, -1].any()
    grid = np.arange(place.size[0])[:, None] // height * place.across + np.arange(place.size[1]) // width
    positions = to_numpy(splats.positions)
    of_row = positions[:, 1].astype(int) // height * place.across + positions[:, 0].astype(int) // width
    # What an entry weighs is of the view of its cell.
    assert stencil.stacks is None
    of_color, of_motion = (grid.reshape(-1)[cells] for cells in (stencil.color_cell, stencil.motion_cell))
    named = [(of_color, stencil.color_sample), (of_motion, stencil.motion_sample)]
    for of_cell, rows in named + [(of_motion, colors) for colors in stencil.motion_colors.T]:
        assert len(np.unique(of_cell[rows >= 0])) == 6
        assert (of_row[rows[rows >= 0]] == of_cell[rows >= 0]).all()
    covered = to_numpy(splats.row)[0] >= 0
    assert (of_row[to_numpy(splats.row)[0][covered]] == grid[covered]).all()


def test_views_lie_in_as_many_pictures_as_are_needed(monkeypatch):
    monkeypatch.setattr(side_by_side, "SIDE", 60)
    assert assert_same("three", cameras=[*CAMERAS, *CAMERAS]) == 2
    monkeypatch.setattr(side_by_side, "SIDE", 30)
    assert assert_same("three") == len(CAMERAS)


@pytest.mark.filterwarnings("ignore::rts.errors.InputWarning")  # A telephoto lens.
@pytest.mark.parametrize("make", [crossing, glass])
def test_lines_of_intersection_move_in_near_views_beside_far_ones(make):
    """Depths of views are scaled by different factors, and slopes of depth with them."""
    cameras = [Camera.look_at(np.array(EYES[1]) * k, (0, 0, 0), fov_y=40 / k, far=5000) for k in (1, 100)]

    def images(pose, together):
        parts = [p.replace(theta=arrays("torch-cpu", p.theta, "float64")) for p in make()]
        options = {"splatter": "edges", "layers": 4}
        parts[0] = parts[0].replace(transform=rts.rigid(pose))
        if together:
            return rts.render_views(parts, cameras, SIZE, **options)
        return torch.stack([rts.render(parts, camera, SIZE, **options) for camera in cameras])

    (_, along), (_, slopes) = (with_gradient(lambda p, t=t: images(p, t), torch.tensor(POSE)) for t in (True, False))
    torch.testing.assert_close(along, slopes, rtol=0, atol=1e-9 * float(slopes.abs().max()))


@pytest.mark.filterwarnings("ignore::rts.errors.EmptyImageWarning")
def test_views_that_see_nothing_lie_beside_others():
    away = Camera.look_at((0, 0, 5), (0, 0, 10), fov_y=40)
    for cameras in ([away, CAMERAS[0], away, CAMERAS[1]], [CAMERAS[0], away]):
        assert assert_same("three", cameras=cameras) == 1
    assert views("three", torch.tensor(POSE), cameras=[away, away]).abs().max() == 0
