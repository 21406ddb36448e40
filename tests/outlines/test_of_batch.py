"""Poses under `vmap`: outlines of all items are found in one picture, and are those of one item at a time."""

import numpy as np
import pytest
from helpers import box, icosphere, relative_error

import rts
from rts.outlines import of_scene

pytestmark = pytest.mark.rendering

torch = pytest.importorskip("torch")
pytest.importorskip("numba")

SIZE = 24, 30
CAMERA = rts.Camera.look_at((0.3, 0.8, 4), (0, 0, 0), fov_y=50)
POSES = 0.2 * np.random.default_rng(5).normal(size=(5, 6))


class Glass(rts.Shader):
    """One colour and alpha for all samples."""

    def __call__(self, theta, gbuffer, camera):
        """Give each row the entry "tint"."""
        return theta["tint"] + 0 * gbuffer["position"][:, :1]


@pytest.fixture
def items(monkeypatch):
    """For each call the number of items whose outlines were found at once."""
    counts, find = [], of_scene.found_in_batch

    def counted(scenes, *given):
        found = find(scenes, *given)
        counts.append(sum(one is not None for one in found))
        return found

    monkeypatch.setattr(of_scene, "found_in_batch", counted)
    return counts


def loss_of(shader, scale=1.0, **options):
    """The weighed sum of an image of two meshes, as a function of the pose of one; and the image."""
    (ball, faces), (cube, sides), tint = icosphere(2, 0.7 * scale), box(0.5), np.array([0.3, 0.2, 0.1, 0.5])
    weights = np.random.default_rng(1).normal(size=(*SIZE, 4))

    def image(pose):
        theta = {"tint": tint} if isinstance(shader, Glass) else {}
        first = rts.Part(rts.Mesh(faces), {"vertices": ball, **theta}, shader, transform=rts.rigid(pose))
        second = rts.Part(rts.Mesh(sides), {"vertices": cube + [0.5, 0.2, -1.6], **theta}, shader)
        return rts.render([first, second], CAMERA, SIZE, **options)

    def loss(pose):
        shown = image(pose)
        like = torch.as_tensor(weights) if isinstance(shown, torch.Tensor) else weights
        return (shown * like).sum()

    return loss, image


@pytest.mark.parametrize(("shader", "options"), [("lambert", {}), (Glass(), {"layers": 3})])
def test_images_and_gradients_of_poses_are_those_of_a_loop(items, shader, options):
    (loss, image), poses = loss_of(shader, **options), torch.tensor(POSES)
    torch.testing.assert_close(torch.vmap(image)(poses), torch.stack([image(p) for p in poses]), rtol=0, atol=2e-6)
    together = torch.func.vmap(torch.func.grad(loss))(poses)
    assert items == [5, 5]
    alone = torch.stack([torch.func.grad(loss)(p) for p in poses])
    assert relative_error(together.numpy(), alone.numpy()) < 1e-5
    nested = torch.func.vmap(torch.func.vmap(torch.func.grad(loss)))(poses[:4].reshape(2, 2, 6))
    assert relative_error(nested.reshape(4, 6).numpy(), alone[:4].numpy()) < 1e-5


def test_poses_that_cut_the_image_are_found_one_by_one(items):
    (_, image), poses = loss_of("silhouette", scale=3.0), torch.tensor(POSES)
    torch.testing.assert_close(torch.vmap(image)(poses), torch.stack([image(p) for p in poses]), rtol=0, atol=2e-6)
    assert items == [0]


def test_one_pose_that_cuts_the_image_leaves_the_others_together(items):
    (_, image), poses = loss_of("lambert"), torch.tensor(POSES)
    poses[3, 3:] += torch.tensor([2.0, 0.0, 0.0])
    torch.testing.assert_close(torch.vmap(image)(poses), torch.stack([image(p) for p in poses]), rtol=0, atol=2e-6)
    assert items == [4]


@pytest.mark.thorough
def test_jax_finds_outlines_of_all_poses_at_once(items):
    jax = pytest.importorskip("jax")
    (loss, _), poses = loss_of("lambert"), jax.numpy.asarray(POSES, "float32")
    together = np.asarray(jax.jit(jax.vmap(jax.grad(loss)))(poses))
    assert items == [5]
    step = jax.jit(jax.grad(loss))
    assert relative_error(together, np.stack([np.asarray(step(p)) for p in poses])) < 1e-3
    nested = jax.jit(jax.vmap(jax.vmap(jax.grad(loss))))(poses[:4].reshape(2, 2, 6))
    assert items == [5, 4]
    assert relative_error(np.asarray(nested).reshape(4, 6), together[:4]) < 1e-3
