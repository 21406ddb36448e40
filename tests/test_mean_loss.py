"""The mean loss of image residuals as one operation: closed forms, and what is made of the residuals themselves."""

import numpy as np
import pytest
from helpers import DIFFERENTIABLE, arrays, quad, to_numpy

import rts
from rts.engines import engine_of
from rts_backends.fused import mean_loss as fused

pytestmark = pytest.mark.fitting

SIZE = (18, 23)
CAMERA = rts.Camera.look_at((0.7, 0.9, 3.2), (0, 0, 0), fov_y=40, aspect=23 / 18)
POSE = np.float32([0.2, -0.3, 0.1, 0.05, -0.07, 0.1])
targets = pytest.mark.parametrize("target", DIFFERENTIABLE)


@pytest.fixture
def sweeps(monkeypatch):
    """Counts calls of the compiled operation."""
    calls, whole = [], fused.mean_loss

    def counted(*given):
        calls.append(given)
        return whole(*given)

    monkeypatch.setattr(fused, "mean_loss", counted)
    return calls


def goal(channels, seed=0):
    rng = np.random.default_rng(seed)
    weights = rng.random((*SIZE, channels)) * (rng.random((*SIZE, channels)) > 0.3)
    return rng.random((*SIZE, channels)).astype(np.float32), weights.astype(np.float32)


def moving(pose, shader="silhouette"):
    wall = rts.Part(rts.Mesh(quad()[1]), {"vertices": quad(-0.9, 0.8, -1.1, 0.6, -0.8)[0]}, shader)
    return [rts.Mesh.example().replace(transform=rts.rigid(pose), shader=shader), wall]


def residuals(shader="silhouette", channels=1, **options):
    image, weights = goal(channels)
    given = {"weights": weights, **options}
    return rts.ImageResiduals(lambda pose: moving(pose, shader), CAMERA, SIZE, image, **given)


def gradient(f, x):
    return to_numpy(engine_of(x).value_and_grad(f)(x)[1])


@targets
def test_of_one_colour_all_over_it_is_the_mean_square_of_that_colour(target, sweeps):
    vertices, faces = quad(-9, 9, -9, 9, 0)
    image, weights = goal(3)
    part = rts.Part(rts.Mesh(faces), {"vertices": vertices}, "unlit")
    swept = rts.ImageResiduals(
        lambda color: part.replace(theta={"vertices": vertices, "color": color}), CAMERA, SIZE, image, weights=weights
    )
    color = np.float32([0.2, 0.5, 0.9])
    value, found = engine_of(arrays(target, color)).value_and_grad(swept.mean_loss)(arrays(target, color))
    np.testing.assert_allclose(to_numpy(value), np.mean((weights * (color - image)) ** 2), 1e-5)
    expected = 2 * (weights**2 * (color - image)).sum((0, 1)) / image.size
    np.testing.assert_allclose(to_numpy(found), expected, 1e-5)
    assert sweeps


CASES = [
    *(("silhouette", 1, None, "linear"), ("lambert", 3, 3, "linear"), ("lambert", 4, 4, "linear")),
    *(("silhouette", 1, 4, "linear"), ("silhouette", 1, None, "huber"), ("lambert", 3, 3, "soft_l1")),
    *(("lambert", 4, 4, "cauchy"), ("silhouette", 1, 4, "huber")),
]


@pytest.mark.parametrize(("shader", "channels", "background", "loss"), CASES)
def test_value_and_derivatives_are_those_of_the_residuals(shader, channels, background, loss, sweeps):
    torch = pytest.importorskip("torch")
    over = None if background is None else np.random.default_rng(2).random((*SIZE, background)).astype(np.float32)
    swept = residuals(shader, channels, background=over, loss=loss, f_scale=0.2)
    pose, along = torch.tensor(POSE), torch.tensor(POSE[::-1].copy())

    def of_image(pose):
        return swept.loss(swept(pose))

    np.testing.assert_allclose(swept.mean_loss(pose), of_image(pose), 1e-5)
    np.testing.assert_allclose(swept.mean_loss(POSE), of_image(POSE), 1e-5)
    expected = gradient(of_image, pose)
    assert np.abs(expected).max() > 3e-4
    tolerance = 1e-5 * np.abs(expected).max()
    for found in (gradient(swept.mean_loss, pose), gradient(lambda p: 2 * swept.mean_loss(p), pose) / 2):
        np.testing.assert_allclose(found, expected, rtol=0, atol=tolerance)
    for f in (torch.func.grad, torch.func.jacfwd):
        np.testing.assert_allclose(f(swept.mean_loss)(pose), expected, rtol=0, atol=tolerance)
    pushed = torch.func.jvp(swept.mean_loss, (pose,), (along,))[1]
    np.testing.assert_allclose(pushed, expected @ along.numpy(), rtol=0, atol=3 * tolerance)
    assert len(sweeps) >= 6


@pytest.mark.parametrize("loss", ["linear", "cauchy"])
def test_in_jax_it_is_the_same_compiled_or_not(loss, sweeps):
    jax = pytest.importorskip("jax")
    swept, pose = residuals("lambert", 4, loss=loss, f_scale=0.2), arrays("jax", POSE)
    expected = gradient(lambda p: swept.loss(swept(p)), pose)
    tolerance = 1e-5 * np.abs(expected).max()
    eager, compiled = jax.grad(swept.mean_loss)(pose), jax.jit(jax.value_and_grad(swept.mean_loss))(pose)
    np.testing.assert_allclose(compiled[0], swept.mean_loss(pose), 1e-5)
    for found in (eager, compiled[1]):
        np.testing.assert_allclose(found, expected, rtol=0, atol=tolerance)
    pushed = jax.jit(lambda p: jax.jvp(swept.mean_loss, (p,), (p,))[1])(pose)
    np.testing.assert_allclose(pushed, expected @ POSE, rtol=0, atol=3 * tolerance)
    assert sweeps


@pytest.mark.parametrize("loss", ["linear", "soft_l1"])
def test_of_the_specification_it_is_that_of_the_residuals(loss):
    torch = pytest.importorskip("torch")
    swept, pose = residuals("lambert", 3, background=goal(3, 5)[0], loss=loss, f_scale=0.2), torch.tensor(POSE)
    own = torch.func.jacrev(torch.func.grad(swept.mean_loss))(pose)  # Second derivatives are array code's.
    expected = torch.func.jacrev(torch.func.grad(lambda p: swept.loss(swept(p))))(pose)
    np.testing.assert_allclose(own, expected, rtol=0, atol=1e-4 * float(expected.abs().max()))


@pytest.mark.parametrize("loss", ["linear", "huber"])
def test_the_number_of_threads_changes_no_bit(loss, monkeypatch):
    torch = pytest.importorskip("torch")
    found = []
    for threads in ("1", "2", "3"):
        monkeypatch.setenv("RTS_NUM_THREADS", threads)
        # A picture whose rows are shared between threads.
        image = np.random.default_rng(0).random((144, 184, 4)).astype(np.float32)
        large = rts.ImageResiduals(lambda pose: moving(pose, "lambert"), CAMERA, (144, 184), image, loss=loss)
        value, g = engine_of(torch.tensor(POSE)).value_and_grad(large.mean_loss)(torch.tensor(POSE))
        found.append(np.concatenate([[float(value)], g.numpy()]))
    for other in found[1:]:
        np.testing.assert_array_equal(other, found[0])


@pytest.mark.parametrize(
    "options",
    [{"supersample": 2}, {"supersample": rts.Adaptive(2)}, {"splatter": rts.plugin("rts.splatters", "none")()}],
    ids=["finer", "adaptive", "unknown"],
)
def test_elsewhere_it_is_made_of_the_residuals(options, sweeps):
    torch = pytest.importorskip("torch")
    for loss in ("linear", "huber"):
        plain = residuals(**options, loss=loss, f_scale=0.2)
        assert float(plain.mean_loss(torch.tensor(POSE))) == float(plain.loss(plain(torch.tensor(POSE))))
    assert not sweeps


def test_a_fit_by_adam_goes_the_same_way(sweeps):
    torch = pytest.importorskip("torch")
    swept = residuals("lambert", 4)
    options = {"method": "adam", "steps": 5, "progress": False}
    own = rts.fit(swept, torch.tensor(POSE), **options)
    assert len(sweeps) == 5
    plain = rts.fit(lambda pose: swept(pose), torch.tensor(POSE), **options)
    np.testing.assert_allclose(own.history, plain.history, 1e-5)
    robust = rts.fit(swept, torch.tensor(POSE), loss=lambda r: r.abs().mean(), **options)
    assert len(sweeps) == 5 and robust.history[0] == float(swept(torch.tensor(POSE)).abs().mean())


def test_it_warns_where_nothing_is_seen():
    swept = residuals()
    away = rts.Camera.look_at((0, 0, 3), (0, 0, 6), fov_y=40, aspect=23 / 18)
    swept._camera = away
    with pytest.warns(rts.errors.EmptyImageWarning, match="nothing is seen"):
        value = swept.mean_loss(POSE)
    image, weights = goal(1)
    np.testing.assert_allclose(value, np.mean((image * weights) ** 2), 1e-5)


def test_residuals_of_a_subclass_are_its_own(sweeps):
    class Shifted(rts.ImageResiduals):
        def __call__(self, parameters):
            return super().__call__(parameters) + 5

    torch = pytest.importorskip("torch")
    own = Shifted(lambda pose: moving(pose), CAMERA, SIZE, goal(1)[0])
    pose, plain = torch.tensor(POSE), rts.ImageResiduals(lambda pose: moving(pose), CAMERA, SIZE, goal(1)[0])
    expected = float(((plain(pose) + 5) ** 2).mean())
    assert float(own.mean_loss(pose)) == pytest.approx(expected, rel=1e-5)
    for method in ("adam", "lm"):
        assert rts.fit(own, pose, method=method, steps=1, progress=False).history[0] == pytest.approx(
            expected, rel=1e-5
        )
    assert not sweeps
