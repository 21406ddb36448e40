"""A radiance field refined as a surface light field, in short: what it takes, what it gives, and that it goes on."""

import signal

import numpy as np
import pytest
from helpers import arrays, relative_error, to_numpy

import rts
from benchmarks.paper import snerf, snerf_scenes
from rts.arrays.trees import leaves

pytestmark = pytest.mark.rendering

WINDOW = 24, 24


@pytest.fixture(scope="module")
def scene(data):
    pytest.importorskip("torch")
    if not (data / "nerf/lego_test_400.npz").is_file():
        pytest.skip(f"no radiance field in {data}")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(snerf_scenes, "DATA", data)
        return snerf_scenes.lego((100,), fineness=0.5, finest=100)


@pytest.fixture(scope="module")
def grid(scene):
    return scene.grid(False)


def refinement(scene, grid, steps=6, **changes):
    settings = snerf.Settings(joint=True, steps=steps, rate=1e5, window=WINDOW)._replace(**changes)
    return snerf.Refinement(scene, settings, grid)


def state(run):
    values, weights = run.found()
    return [values, *leaves(weights), np.array(run.losses)]


def test_steps_move_what_they_are_to_move(scene, grid):
    weights = list(leaves(scene.field.weights["fine"]))
    for joint in (False, True):
        run = refinement(scene, grid, joint=joint)
        run.advance()
        values, *found = state(run)[:-1]
        assert (values != grid).any() == joint and values.min() >= 0 and values.max() <= snerf.HIGHEST
        changed = [not np.array_equal(a, b) for a, b in zip(found, weights, strict=True)]
        assert sum(changed) == len(changed) - 2  # Density has no part in colours.


def test_a_run_that_is_interrupted_goes_on_to_the_same_result(scene, grid, tmp_path):
    whole = refinement(scene, grid)
    assert snerf.refine(whole, tmp_path / "whole.npz")

    path, handler = tmp_path / "run.npz", signal.getsignal(signal.SIGINT)
    first = refinement(scene, grid)

    def interrupt(run):
        if run.step == 2:
            signal.raise_signal(signal.SIGINT)

    assert not snerf.refine(first, path, every=1, watch=interrupt)
    assert first.step == 2 and signal.getsignal(signal.SIGINT) is handler
    assert [p.name for p in tmp_path.iterdir() if "run" in p.name] == ["run.npz"]
    # Without another checkpoint, steps since the last one are made again.
    second = refinement(scene, grid)
    second.restore(path)
    second.advance()
    third = refinement(scene, grid)
    third.restore(path)
    assert snerf.refine(third, path, every=4) and third.step == 6
    last = refinement(scene, grid)
    last.restore(path)
    for run in (third, last):
        for a, b in zip(state(run), state(whole), strict=True):
            np.testing.assert_array_equal(a, b)

    other = refinement(scene, grid, seed=1)
    with pytest.raises(ValueError, match="settings"):
        other.restore(path)


def test_windows_are_parts_of_photographs(scene, grid):
    run = refinement(scene, grid, window=(30, 44))
    camera, image = run._chosen()
    shot = scene.train[np.random.default_rng(0).integers(len(scene.train))]
    tops, lefts = range(100 - 29), range(100 - 43)
    places = [(i, j) for i in tops for j in lefts if np.array_equal(shot.truth()[i : i + 30, j : j + 44], image)]
    assert len(places) == 1
    part = scene.part(grid, scene.field.weights["fine"])
    whole = np.asarray(rts.render(part, shot.camera, (100, 100), splatter="multi", engine="torch"))
    found = np.asarray(rts.render(part, camera, (30, 44), splatter="multi", engine="torch"))
    (top, left), *_ = places
    np.testing.assert_allclose(found, whole[top : top + 30, left : left + 44], atol=2e-3)


def test_a_checkpoint_that_fails_leaves_the_one_before(scene, grid, tmp_path, monkeypatch):
    run, path = refinement(scene, grid), tmp_path / "run.npz"
    run.save(path)
    before = path.read_bytes()

    def broken(file, **arrays):
        file.write(b"half")
        raise OSError("no space")

    monkeypatch.setattr(np, "savez", broken)
    with pytest.raises(OSError, match="no space"):
        run.save(path)
    assert path.read_bytes() == before


def test_a_surface_takes_a_thirtieth_of_the_evaluations(scene, grid):
    shots = scene.tests["100"][:2]
    images, numbers = snerf.drawn(scene, grid, scene.field.weights["fine"], shots)
    assert snerf.FINE * sum(numbers["covered"]) >= 30 * sum(numbers["evaluations"])
    assert images.shape == (2, 100, 100, 3) and min(numbers["psnr"]) > 20.5 and min(numbers["ssim"]) > 0.84
    image = images[0]
    assert np.abs(image[0] - 1).max() < 1e-6  # The background is white.


def test_engines_agree(scene, grid):
    torch, jax = pytest.importorskip("torch"), pytest.importorskip("jax")
    camera = scene.tests["100"][0].camera.window((100, 100), (30, 35), WINDOW)
    factor = np.random.default_rng(0).standard_normal((*WINDOW, 3)).astype(np.float32)
    options = {"splatter": "multi", "background": scene.behind()}
    found, gradients = [], []
    for target in ("torch-cpu", "jax"):
        theta = arrays(target, {"values": grid, "weights": scene.field.weights["fine"]})
        part = scene.part(theta["values"], theta["weights"])
        sampled = rts.sample(part, camera, WINDOW, splatter="multi", layers=snerf.SPLATTERS["multi"]["layers"])

        def product(theta, part=part, sampled=sampled, target=target):
            image = rts.render_samples(sampled, part.replace(theta=theta), camera, **options)[..., :3]
            return (image * arrays(target, factor)).sum(), image

        if target == "jax":
            # One program, which is compiled once.
            (_, image), slopes = jax.jit(jax.value_and_grad(product, has_aux=True))(theta)
        else:
            variables = [x.requires_grad_(True) for x in leaves(theta)]
            total, image = product(theta)
            slopes = torch.autograd.grad(total, variables, materialize_grads=True)
            image = image.detach()
        found.append(to_numpy(image))
        gradients.append(list(leaves(to_numpy(slopes))))
    assert np.abs(found[0] - found[1]).max() < 1e-4 and found[0].min() < 0.5
    for a, b in zip(*gradients, strict=True):
        assert relative_error(a, b) < 1e-3 if np.abs(b).max() > 0 else not np.abs(a).max()


def test_scores_are_those_of_their_definitions():
    rng = np.random.default_rng(0)
    image = rng.uniform(size=(20, 24, 3)).astype(np.float32)
    assert snerf.ssim(image, image) == pytest.approx(1)
    assert snerf.psnr(image, np.clip(image, 0.1, None)) > 20
    flat, other = np.full_like(image, 0.4), np.full_like(image, 0.6)
    assert snerf.psnr(flat, other) == pytest.approx(-20 * np.log10(0.2), abs=1e-4)
    assert snerf.ssim(flat, other) == pytest.approx((2 * 0.24 + 1e-4) / (0.16 + 0.36 + 1e-4), abs=1e-5)
    # One window by hand.
    at = np.arange(11) - 5
    w = np.exp(-(at**2) / (2 * 1.5**2))
    w = np.outer(w, w) / w.sum() ** 2
    small, noisy = image[:11, :11], rng.uniform(size=(11, 11, 3))
    expected = []
    for c in range(3):
        x, y = small[..., c].astype(np.float64), noisy[..., c]
        a, b = (w * x).sum(), (w * y).sum()
        xx, yy, xy = (w * x * x).sum() - a * a, (w * y * y).sum() - b * b, (w * x * y).sum() - a * b
        top = (2 * a * b + 1e-4) * (2 * xy + 9e-4)
        expected.append(top / ((a * a + b * b + 1e-4) * (xx + yy + 9e-4)))
    assert snerf.ssim(small, noisy) == pytest.approx(np.mean(expected), abs=1e-6)


@pytest.mark.thorough
def test_tables_and_pictures_are_written(scene, grid, tmp_path, monkeypatch):
    pytest.importorskip("matplotlib")
    monkeypatch.setattr(snerf.Scene, "grid", lambda self, keep: grid)
    parser = dict(resume=True, steps=2, learning_rate=1e-3, rate=1e5, every=1, views=1, start=None)
    options = snerf.argparse.Namespace(**parser)
    assert snerf.run(scene, tmp_path, ("fixed", "finetuned", "joint"), options)
    assert snerf.run(scene, tmp_path, ("fixed", "joint"), options)  # Nothing is left to do.
    other = snerf.argparse.Namespace(**parser | {"start": tmp_path})
    assert snerf.run(scene, tmp_path / "second", ("joint",), other)
    first, second = (np.load(folder / "joint.npz") for folder in (tmp_path, tmp_path / "second"))
    assert np.abs(first["values"] - second["values"]).max() > 0
    assert '"steps": 4' in (tmp_path / "second" / "joint.json").read_text()
    text = snerf.tables(tmp_path)
    assert "surface and network, joint" in text and "fewer" in text
    snerf.draw(tmp_path / "a.png", scene, tmp_path, "100", [0])
    assert rts.load_image(tmp_path / "a.png").shape[2] == 4
