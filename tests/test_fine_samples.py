"""Samples at outlines: their cells, their layers, and their overflow."""

import numpy as np
import pytest
from adaptive_scenes import BALL, CAMERA, FACES, MESH, SIZE, activate, random_mask, render, scene
from helpers import DIFFERENTIABLE, TORCH, arrays, gradient, icosphere, to_numpy

import rts
from rts import Adaptive
from rts.sampling import strips

pytestmark = pytest.mark.sampling


@pytest.mark.parametrize("s", [2, 4, 8])
def test_fine_samples_are_those_of_active_pixels_and_their_apron(s, monkeypatch):
    mask = random_mask(10, 0.05)
    activate(monkeypatch, mask)
    part = scene()[0]
    sampled = rts.sample(part, CAMERA, SIZE, supersample=Adaptive(s), layers=1, splatter="visible")
    dense = rts.sample(part, CAMERA, SIZE, supersample=s, layers=1, splatter="visible")
    apron, needed = dense.apron, np.zeros(dense.row.shape[1:], bool)
    for y, x in np.argwhere(mask):
        needed[y * s : (y + 1) * s + 2 * apron, x * s : (x + 1) * s + 2 * apron] = True
    hits = int((dense.row[0] >= 0)[needed].sum())
    (samples,) = sampled.fine.samples
    assert len(samples.ids) == hits == (samples.row >= 0).sum() and int(sampled.fine.overflow) == 0
    assert sampled.fine.index.max() == hits - 1 and (sampled.fine.pixel >= 0).sum() == mask.sum()


def test_hidden_samples_that_cannot_be_seen_are_left_out():
    sampled = rts.sample(scene(), CAMERA, SIZE, supersample=Adaptive(4), layers=3, splatter="visible")
    whole = rts.sample(scene(), CAMERA, SIZE, supersample=Adaptive(4), layers=3, splatter=None)
    count, most = (sum((s.row >= 0).sum() for s in x.fine.samples) for x in (sampled, whole))
    assert count < 0.9 * most


def test_pixels_without_room_stay_coarse_and_are_counted():
    jax = pytest.importorskip("jax")

    def scene(v):
        return rts.Part(MESH(FACES), {"vertices": v})

    parts = scene(BALL)
    plain = render(parts, 1)
    most = (rts.sample(parts, CAMERA, SIZE, supersample=Adaptive(4), layers=3).fine.pixel >= 0).sum()

    def find(v, capacity):
        return rts.sample(scene(v), CAMERA, SIZE, supersample=Adaptive(4), layers=3, capacity=capacity)

    kept = []
    for capacity in (1500, 8000, 60000):
        # One that holds a part of the pixels is compiled, too.
        traced = [jax.jit(find, static_argnums=1)(arrays("jax", BALL), capacity)] if capacity == 8000 else []
        for sampled in (find(BALL, capacity), *traced):
            active = np.asarray(sampled.fine.pixel) >= 0
            assert active.sum() + int(sampled.fine.overflow) == most and sampled.overflow >= sampled.fine.overflow
            image = np.asarray(rts.render_samples(sampled, parts, CAMERA))
            np.testing.assert_allclose(image[~active], plain[~active], atol=1e-5)
        kept.append(active.sum())
    assert kept[0] < kept[1] < kept[2] == most


@pytest.mark.parametrize("target", DIFFERENTIABLE)
def test_batches_give_the_same(target):
    stretched = np.stack([BALL, 0.7 * BALL])

    def scene(v):
        return rts.Part(MESH(FACES), {"vertices": v})

    expected = [render(scene(v), Adaptive(2)) for v in stretched]
    if target == "jax":
        jax = pytest.importorskip("jax")
        batched = jax.vmap(lambda v: render(scene(v), Adaptive(2)))(arrays("jax", stretched))
    else:
        torch = pytest.importorskip("torch")
        batched = torch.vmap(lambda v: render(scene(v), Adaptive(2)))(arrays(target, stretched))
    np.testing.assert_allclose(to_numpy(batched), np.stack(expected), atol=2e-5)


@pytest.mark.thorough
@pytest.mark.parametrize("share", [1, 1e-3])
def test_compiled_programs_have_little_room_for_few_outlines_and_all_for_many(share, monkeypatch):
    jax = pytest.importorskip("jax")
    rooms = []

    def noting(pixels, grid, room, *more):
        rooms.append(room)
        return strips.lay_out(pixels, grid, room, *more)

    monkeypatch.setattr("rts.sampling.fine_samples.FEW", share)
    weights = np.random.default_rng(0).random((*SIZE, 4), np.float32)

    def image(move):
        return render(rts.Part(MESH(FACES), {"vertices": BALL + move}, "lambert"), Adaptive(3))

    def loss(move):
        return (image(move) * weights).sum()

    move = arrays("jax", np.array([0.1, 0.05, 0.2]))
    expected = image(move), jax.grad(loss)(move), jax.jacfwd(image)(move)
    monkeypatch.setattr("rts.sampling.fine_samples.lay_out", noting)
    program = jax.jit(image)
    program(move).block_until_ready()
    # The first layout has little room; a second one has room for all.
    assert len(rooms) == (1 if share == 1 else 2) and rooms[0].cells == np.ceil(share * rooms[-1].cells)
    found = program(move), jax.jit(jax.grad(loss))(move), jax.jit(jax.jacfwd(image))(move)
    for a, b in zip(found, expected, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-4 * np.abs(b).max())
    several = jax.jit(jax.vmap(jax.value_and_grad(loss)))(jax.numpy.stack([move, -move]))
    for n, own in enumerate((move, -move)):
        for a, b in zip(several, jax.value_and_grad(loss)(own), strict=True):
            np.testing.assert_allclose(a[n], b, rtol=1e-4, atol=1e-4 * np.abs(b).max())


def test_as_many_layers_as_count():
    found, expected = (render(scene(), Adaptive(3), layers=k) for k in ("auto", 6))
    np.testing.assert_allclose(found, expected, atol=1e-6)


def test_prepared_parts_and_backgrounds():
    background = np.random.default_rng(11).random((*SIZE, 3))
    found, expected = (render(parts, Adaptive(3), background=background) for parts in (rts.prepare(scene()), scene()))
    np.testing.assert_array_equal(found, expected)
    bare = render(scene(), Adaptive(3))
    np.testing.assert_allclose(expected[..., :3], bare[..., :3] + (1 - bare[..., 3:]) * background, atol=1e-6)


def test_what_is_sampled_is_rendered():
    sampled = rts.sample(scene(), CAMERA, SIZE, supersample=Adaptive(3), layers=3)
    assert sampled.supersample == 1 and sampled.fine.supersample == 3
    for splatter in ("visible", "single"):  # One that reaches as far, and one that does not.
        found = rts.render_samples(sampled, scene(), CAMERA, splatter=splatter)
        np.testing.assert_allclose(found, render(scene(), Adaptive(3), splatter=splatter), atol=1e-6)


def test_an_empty_view_has_a_gradient_of_zero():
    part = rts.Part(MESH(FACES), {"vertices": arrays(TORCH[0], BALL + [0, 0, 90])})
    with pytest.warns(rts.errors.EmptyImageWarning):
        found = gradient(
            TORCH[0],
            lambda v: render(rts.Part(MESH(FACES), {"vertices": v}), Adaptive(3)).sum(),
            part.theta["vertices"],
        )
    assert not found.any()


def test_memory_is_that_of_the_outlines():
    """At 8 × 8 the finer image has fifty times as many samples."""
    vertices, faces = icosphere(3)
    part = rts.Part(MESH(faces), {"vertices": vertices})
    sampled = rts.sample(part, CAMERA, (128, 128), supersample=Adaptive(8), splatter="visible")
    grid = strips.FineGrid((128, 128), 8, sampled.fine.apron).fine
    assert sampled.fine.row[0].size < 0.25 * grid[0] * grid[1]
    assert sum(len(s.ids) for s in sampled.fine.samples) < 0.1 * grid[0] * grid[1]
