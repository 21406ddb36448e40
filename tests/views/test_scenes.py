"""Scenes of their own in one call of `rts.render_views`: images and gradients of a loop."""

import dataclasses

import numpy as np
import pytest
from helpers import TORCH, arrays, box, gradient, icosphere, relative_error, rigid, to_numpy

import rts
from rts import Camera, InputError
from rts.views import render_views as module

pytestmark = pytest.mark.rendering

torch = pytest.importorskip("torch")
pytest.importorskip("numba")

SIZE = 30, 36
EYES = ((0.7, 0.9, 3.2), (-2.0, 0.4, 2.5), (0.3, -1.5, -3.0), (2.9, 0.3, 0.2))
CAMERAS = [Camera.look_at(eye, (0, 0, 0), fov_y=50) for eye in EYES]


@pytest.fixture
def drawn(monkeypatch):
    """The numbers of views that were drawn at once."""
    counts, draw = [], module._drawn_at_once

    def counted(views, *given):
        counts.append(len(views))
        return draw(views, *given)

    monkeypatch.setattr(module, "_drawn_at_once", counted)
    return counts


def pieces(shader="lambert", large=()):
    """Four scenes of two, one, three and two meshes, as a function of a matrix for each mesh (8, 4, 4)."""
    random, meshes = np.random.default_rng(3), []
    for index in range(8):
        vertices, faces = (icosphere(1, 0.4), box(0.3), icosphere(2, 0.35))[index % 3]
        vertices = vertices * (6 if index in large else 1)
        theta = {"vertices": vertices.astype(np.float32), "tint": np.float32(random.uniform(0.2, 0.9, 4))}
        meshes.append((rts.Mesh(faces), theta if callable(shader) else {"vertices": theta["vertices"]}))
    matrices = np.stack([rigid(random.normal(size=3), 40 * i, random.uniform(-0.3, 0.3, 3)) for i in range(8)])

    def scenes(transforms):
        parts = [rts.Part(*own, shader, transform=m) for own, m in zip(meshes, transforms, strict=True)]
        return [parts[:2], parts[2:3], parts[3:6], parts[6:]]

    return matrices.astype(np.float32), scenes


def glass(theta, gbuffer, camera):
    """One colour and alpha for all samples of a part."""
    return theta["tint"] + 0 * gbuffer["position"][:, :1]


def pair(transforms, scenes, **options):
    """Images of one call, and of a loop."""
    once = rts.render_views(scenes(transforms), CAMERAS, SIZE, **options)
    loop = [rts.render(own, camera, SIZE, **options) for own, camera in zip(scenes(transforms), CAMERAS, strict=True)]
    if isinstance(once, dict):
        return once, {name: rts.namespace(x).stack([own[name] for own in loop]) for name, x in once.items()}
    return once, rts.namespace(once).stack(loop)


@pytest.mark.parametrize(
    ("shader", "options"),
    [
        ("lambert", {}),
        ("silhouette", {"supersample": 2}),
        (glass, {"layers": 4}),
        ("depth", {"splatter": "multi", "layers": 2}),
    ],
)
def test_images_and_gradients_are_those_of_a_loop(drawn, shader, options):
    transforms, scenes = pieces(shader)
    weights = torch.as_tensor(np.random.default_rng(0).normal(size=(4, *SIZE, 4)))

    def loss(which):
        return lambda x: (pair(x, scenes, **options)[which] * weights).sum()

    transforms = arrays(TORCH[0], transforms, np.float64)
    once, loop = pair(transforms, scenes, **options)
    np.testing.assert_allclose(to_numpy(once), to_numpy(loop), rtol=0, atol=2e-5)
    assert drawn == [4]
    assert relative_error(gradient(TORCH[0], loss(0), transforms), gradient(TORCH[0], loss(1), transforms)) < 1e-5


def test_views_that_cut_their_scene_are_drawn_by_themselves(drawn):
    transforms, scenes = pieces(large=(2,))
    once, loop = pair(arrays(TORCH[0], transforms, np.float64), scenes)
    np.testing.assert_allclose(to_numpy(once), to_numpy(loop), rtol=0, atol=2e-5)
    assert drawn == [3]


def test_scenes_of_numpy_and_of_surfaces_that_share_no_pass_are_those_of_a_loop(drawn):
    transforms, scenes = pieces()
    once, loop = pair(transforms, scenes)
    np.testing.assert_allclose(once, loop, rtol=0, atol=2e-5)
    assert drawn == [4]
    ball = rts.Part(rts.plugin("surfaces", "sdf")(lambda theta, p: (p**2).sum(-1) ** 0.5 - 0.5), {}, "normals")
    mixed = [[ball], *scenes(transforms)[1:]]
    images = rts.render_views(mixed, CAMERAS, SIZE)
    expected = [rts.render(own, camera, SIZE) for own, camera in zip(mixed, CAMERAS, strict=True)]
    np.testing.assert_allclose(images, np.stack(expected), rtol=0, atol=2e-5)


def test_residuals_of_several_views_take_scenes():
    transforms, scenes = pieces("silhouette")
    targets = [rts.render(own, camera, SIZE)[..., 3] for own, camera in zip(scenes(transforms), CAMERAS, strict=True)]

    def moved(shift):
        matrices = [torch.as_tensor(m) + shift * torch.eye(4)[:, :1] @ torch.eye(4)[3:] for m in transforms]
        return scenes(matrices)

    residuals = rts.ImageResiduals(moved, CAMERAS, SIZE, targets)
    assert np.abs(to_numpy(residuals(torch.zeros(())))).max() < 1e-5
    value, matrix, slope = residuals.normal_equations(torch.tensor(0.05))
    assert value > 1e-4 and matrix > 0 and slope > 0


@pytest.mark.parametrize("engine", ["numpy", *TORCH])
def test_outputs_of_scenes_are_those_of_a_loop(drawn, engine):
    transforms, scenes = pieces()
    transforms[1, 0] *= -1  # A mirror.
    uv = np.float32([[1, 0.3], [0.2, -1], [0.4, 0.5]])

    def with_uv(transforms):
        return [
            [part.replace(theta={**part.theta, "uv": part.theta["vertices"] @ uv}) for part in parts]
            for parts in scenes(transforms)
        ]

    for names in (("color", "depth", "normal", "tangent", "alpha"), ("part", "depth", "depth_front")):
        once, loop = pair(arrays(engine, transforms, np.float64), with_uv, outputs=names)
        assert list(once) == [*names]
        for name in names:
            np.testing.assert_allclose(to_numpy(once[name]), to_numpy(loop[name]), rtol=0, atol=3e-5, err_msg=name)
    assert drawn == [4]


def test_wrong_scenes_are_refused():
    transforms, scenes = pieces()
    own = scenes(transforms)
    with pytest.raises(InputError, match="4 scenes came with 3 cameras"):
        rts.render_views(own, CAMERAS[:3], SIZE)
    with pytest.raises(InputError, match="both parts and scenes"):
        rts.render_views([own[0], own[1][0]], CAMERAS[:2], SIZE)
    with pytest.raises(InputError, match="scene 1: parts holds nothing"):
        rts.render_views([own[0], []], CAMERAS[:2], SIZE)


@pytest.mark.filterwarnings("ignore::rts.errors.EmptyImageWarning")
def test_views_that_see_nothing_take_the_kind_of_the_others():
    weight = torch.tensor(0.5, requires_grad=True)

    def shader(theta, gbuffer, camera):
        rows = torch.as_tensor(np.asarray(gbuffer["position"]))
        return torch.cat([(rows * 0 + 1) * weight, rows[:, :1] * 0 + 1], 1)

    quad = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], np.float32)
    part = rts.Part(rts.Mesh([[0, 1, 2], [0, 2, 3]]), {"vertices": quad}, shader)
    here, away = (rts.Camera.look_at((0, 0, 5), (0, 0, z)) for z in (0, 20))
    for cameras in ([here, here, away], [away, here, here]):
        images = rts.render_views(part, cameras, (24, 24), layers=1)
        for image, camera in zip(images, cameras, strict=True):
            torch.testing.assert_close(
                image, torch.as_tensor(rts.render(part, camera, (24, 24), layers=1)).to(image.dtype)
            )
        images.sum().backward()


def test_shaders_that_hold_arrays_are_those_of_their_scenes():
    @dataclasses.dataclass
    class Tint(rts.Shader):
        tint: np.ndarray
        opaque: bool = True
        reads: tuple = ("normal",)
        channels: int = 3

        def __call__(self, theta, gbuffer, camera):
            return np.concatenate([0 * gbuffer["position"] + self.tint, np.ones((len(gbuffer["position"]), 1))], 1)

    quad = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], np.float32)
    mesh, camera = rts.Mesh([[0, 1, 2], [0, 2, 3]]), rts.Camera.look_at((0, 0, 5), (0, 0, 0))
    colors = np.eye(3)[:2]
    scenes = [[rts.Part(mesh, {"vertices": quad}, Tint(color))] for color in colors]
    images = rts.render_views(scenes, [camera] * 2, (24, 24))
    np.testing.assert_allclose(images[:, 12, 12, :3], colors, atol=1e-6)
