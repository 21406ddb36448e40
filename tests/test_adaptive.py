"""Samples where outlines are: active pixels are those of the finer image, the others those of the plain one."""

import itertools

import numpy as np
import pytest
from helpers import DIFFERENTIABLE, TORCH, arrays, derivative, gradient, icosphere, quad, to_numpy
from loops import STEPS, Pairing

import rts
from rts import Adaptive
from rts.fitting.least_squares import normal_equations
from rts.interfaces import Sampler
from rts.sampling import fine, tiles
from rts.sampling.adaptive import outlines
from rts.splatting import Multi
from rts.splatting.layers import dilated

pytestmark = pytest.mark.splatting

MESH = rts.plugin("rts.surfaces", "mesh")
CAMERA = rts.Camera.look_at((0.4, 0.5, 3.2), (0, 0, 0))
SIZE = (21, 26)
BALL, FACES = icosphere(2, 0.8)
CARD, CARD_FACES = quad(-0.9, 0.7, -0.2, 1.1, -0.4)
FAR, FAR_FACES = quad(-40.0, 40.0, -30.0, -9.0, -60.0)


def scene(vertices=BALL, shader="unlit"):
    """A ball before a card before a far card; colours vary."""
    part = rts.Part(MESH(FACES), {"vertices": vertices, "colors": (BALL + 1) / 2}, shader)
    cards = [(CARD, CARD_FACES, (0.2, 0.9, 0.4)), (FAR, FAR_FACES, (0.9, 0.3, 0.1))]
    return [part, *(rts.Part(MESH(f), {"vertices": v, "color": np.array(c)}, shader) for v, f, c in cards)]


def render(parts, supersample, **options):
    return rts.render(parts, CAMERA, SIZE, supersample=supersample, **{"layers": 3, **options})


def activate(monkeypatch, mask):
    """Make a mask of pixels (H, W) the active ones."""
    monkeypatch.setattr(fine, "active", lambda *_: np.ascontiguousarray(mask))


def random_mask(seed=0, share=0.3):
    return np.random.default_rng(seed).random(SIZE) < share


def apart(parts, mask, s, atol=1e-6, **options):
    """Compare an adaptive image with the finer one at active pixels, and with the plain one at the others."""
    found = to_numpy(render(parts, Adaptive(s), **options))
    finer, plain = (to_numpy(render(parts, n, **options)) for n in (s, 1))
    np.testing.assert_allclose(found[mask], finer[mask], rtol=0, atol=atol)
    np.testing.assert_allclose(found[~mask], plain[~mask], rtol=0, atol=atol)


# ------------------------------------------------------------------------------------------ two images, put together


@pytest.mark.parametrize("target", ["numpy", *TORCH])
@pytest.mark.parametrize("s", [2, 3, 4])
def test_active_pixels_are_those_of_the_finer_image_and_others_of_the_plain_one(target, s, monkeypatch):
    parts = scene(arrays(target, BALL, np.float64 if target in TORCH else np.float32))
    for mask in (random_mask(), np.ones(SIZE, bool), np.zeros(SIZE, bool)):
        activate(monkeypatch, mask)
        apart(parts, mask, s, 1e-9 if target in TORCH else 2e-6)


@pytest.mark.parametrize("target", TORCH)
@pytest.mark.parametrize("splatter", ["visible", "multi", "single", Multi(0.6)])
def test_gradients_are_those_of_either_image(target, splatter, monkeypatch):
    weights = np.random.default_rng(1).normal(size=(*SIZE, 4))
    vertices = arrays(target, BALL)
    for mask in (random_mask(2), np.ones(SIZE, bool)):
        activate(monkeypatch, mask)

        def slope(supersample, where):
            weigh = arrays(target, weights * where[..., None])
            return gradient(
                target, lambda v: (render(scene(v), supersample, splatter=splatter) * weigh).sum(), vertices
            )

        for supersample, where in ((3, mask), (1, ~mask)):
            found, expected = slope(Adaptive(3), where), slope(supersample, where)
            np.testing.assert_allclose(found, expected, rtol=0, atol=2e-3 * max(1, np.abs(expected).max()))


def test_engines_agree():
    jax, weights = pytest.importorskip("jax"), np.random.default_rng(1).normal(size=(*SIZE, 4))

    def loss(target):
        weigh = arrays(target, weights)
        return lambda v: (render(scene(v)[:2], Adaptive(3)) * weigh).sum()

    found, expected = (
        jax.jit(jax.grad(loss("jax")))(arrays("jax", BALL)),
        gradient(TORCH[0], loss(TORCH[0]), arrays(TORCH[0], BALL)),
    )
    np.testing.assert_allclose(found, expected, rtol=0, atol=2e-3 * np.abs(expected).max())


def test_aprons_are_as_wide_as_a_splatter_reaches(monkeypatch):
    class Wide(rts.Splatter):
        """Means over 7 × 7 cells."""

        reach = 3

        def image(self, splats):
            xp = rts.namespace(splats.rgba)
            color = xp.where((splats.row[0] >= 0)[..., None], splats.rgba[splats.row[0]], 0.0)
            steps = itertools.product(range(-3, 4), repeat=2)
            return sum(xp.roll(color, step, axis=(0, 1)) for step in steps) / 49

    mask = random_mask(3, 0.1)
    activate(monkeypatch, mask)
    for s in (2, 5):
        apart(scene(), mask, s, splatter=Wide())


@pytest.mark.parametrize("sampler", ["raster", "embree", "opengl", "reference"])
def test_samplers_of_triangles_take_only_what_is_asked_for(sampler, monkeypatch):
    if sampler in ("embree", "opengl"):
        pytest.importorskip("embreex" if sampler == "embree" else "moderngl")
    mask = random_mask(4)
    activate(monkeypatch, mask)
    apart(scene(), mask, 3, sampler=sampler)


def test_samplers_that_know_no_lists_serve_too(monkeypatch):
    class Whole(Sampler):
        """Samples all cells."""

        def sample(self, part, camera, size, layers, *, capacity=None):
            return rts.plugin("rts.samplers", "raster")().sample(part, camera, size, layers, capacity=capacity)

    mask = random_mask(5)
    activate(monkeypatch, mask)
    found = rts.sample(scene(), CAMERA, SIZE, sampler=Whole(), supersample=Adaptive(3), layers=3)
    listed = rts.sample(scene(), CAMERA, SIZE, sampler="raster", supersample=Adaptive(3), layers=3)
    for a, b in zip(found.fine.samples, listed.fine.samples, strict=True):
        np.testing.assert_array_equal(a.row, b.row)
        np.testing.assert_allclose(a.params, b.params)
    apart(scene(), mask, 3, sampler=Whole())


@pytest.mark.parametrize("name", rts.plugins("rts.surfaces"))
def test_every_surface_is_that_of_the_finer_image(name, monkeypatch):
    target = TORCH[0]
    part = rts.plugin("rts.surfaces", name).example()
    if part is None:
        pytest.skip(f"{name} has no example")
    mask = np.random.default_rng(6).random((12, 14)) < 0.6
    activate(monkeypatch, mask)
    theta, weights = arrays(target, part.theta), np.random.default_rng(7).normal(size=(12, 14, 4)) * mask[..., None]
    camera = rts.Camera.look_at((0.3, 0.4, 5.0), (0, 0, 0))

    def image(theta, supersample):
        return rts.render(part.replace(theta=theta), camera, (12, 14), supersample=supersample)

    images = [to_numpy(image(theta, n)) for n in (Adaptive(2), 2)]
    np.testing.assert_allclose(images[0][mask], images[1][mask], atol=2e-5)
    key = part.surface.reads(part.theta)[0]
    found = [
        gradient(
            target,
            lambda x, n=n: (image({**theta, key: x}, n) * arrays(target, weights)).sum(),
            arrays(target, part.theta[key]),
        )
        for n in (Adaptive(2), 2)
    ]
    np.testing.assert_allclose(found[0], found[1], rtol=0, atol=2e-3 * np.abs(found[1]).max())


# ---------------------------------------------------------------------------------------------- which pixels are active


def two_sheets(seed):
    """Rows and depths (K, H, W) of rough sheets with holes, in two layers."""
    rng = np.random.default_rng(seed)
    height, width = 9, 11
    y, x = np.indices((height, width))
    sheets = np.stack([3 + 0.2 * x + 0 * y, 3.9 + 0.1 * y, 5 - 0.15 * x])
    sheets = np.where(rng.random(sheets.shape) < 0.4, np.inf, sheets)
    depth = np.sort(sheets, axis=0)[:2]
    covered = np.isfinite(depth)
    row = np.where(covered, np.cumsum(covered).reshape(covered.shape) - 1, -1).astype(np.int32)
    return row, np.where(covered, depth, 0)


@pytest.mark.parametrize("seed", range(4))
def test_active_are_cells_at_either_side_of_where_fronts_end(seed):
    row, depth = two_sheets(seed)
    positions = np.zeros((row.max() + 1, 3))
    positions[row[row >= 0], 2] = depth[row >= 0]
    pairing = Pairing(positions, row, visible=True)
    expected = np.zeros(row.shape[1:], bool)
    for (y, x), (u, v) in itertools.product(pairing.cells, STEPS):
        if (u, v) != (0, 0) and pairing.ends((y, x), (u, v)):
            expected[y, x] = expected[y + v, x + u] = True
    found = outlines(row, depth, [positions.shape[0]])
    np.testing.assert_array_equal(found, expected)
    assert 0.2 < found.mean() < 1


def test_where_another_part_is_seen_both_sides_are_active():
    row = np.arange(30, dtype=np.int32).reshape(1, 5, 6)
    found = outlines(row, np.ones(row.shape), [15, 15])
    np.testing.assert_array_equal(np.flatnonzero(found), np.arange(8, 22))  # It changes amid the third row.
    assert not outlines(row, np.ones(row.shape), [30]).any()


def test_dilation_reaches_the_eight_neighbours():
    cells = np.zeros((5, 6), bool)
    cells[2, 1] = True
    expected = np.zeros((5, 6), bool)
    expected[1:4, :3] = True
    np.testing.assert_array_equal(dilated(cells), expected)


def test_masks_are_dilated_for_shaders_of_more_than_one_colour_a_part():
    def active(shader, adaptive):
        sampled = rts.sample(scene(shader=shader), CAMERA, SIZE, supersample=adaptive, layers=3)
        return sampled.fine.pixel >= 0

    bare = active("silhouette", Adaptive(4))
    np.testing.assert_array_equal(active("unlit", Adaptive(4)), active("silhouette", Adaptive(4, dilated=True)))
    np.testing.assert_array_equal(active("unlit", Adaptive(4, dilated=False)), bare)
    inner = dilated(bare)[1:-1, 1:-1]
    np.testing.assert_array_equal(active("unlit", Adaptive(4))[1:-1, 1:-1], inner)


def steps_of_colour():
    """A card whose left half is dark and whose right half is bright, over all of the image."""
    vertices, faces = quad(-9, 9, -9, 9)

    def shader(theta, gbuffer, camera):
        xp = rts.namespace(gbuffer["position"])
        grey = xp.where(gbuffer["position"][:, :1] < 0.13, 0.1, 0.9)
        return xp.concat([grey, grey, grey, xp.ones_like(grey)], axis=1)

    return rts.Part(MESH(faces), {"vertices": vertices}, shader)


def test_contrast_finds_edges_of_colour():
    part = steps_of_colour()
    images = [render(part, n) for n in (1, 4, Adaptive(4), Adaptive(4, contrast=0.2))]
    plain, fine, by_outlines, by_contrast = images
    np.testing.assert_array_equal(by_outlines, plain)
    changed = np.abs(by_contrast - plain).max(axis=-1) > 0
    assert changed.any() and np.abs(by_contrast - fine).max() < np.abs(plain - fine).max() / 3


def test_contrast_is_refused_where_colours_are_not_known():
    with pytest.raises(rts.InputError, match="rts.sample knows no colours"):
        rts.sample(scene(), CAMERA, SIZE, supersample=Adaptive(4, contrast=0.2))
    jax = pytest.importorskip("jax")
    with pytest.raises(rts.InputError, match="colours are traced"):
        jax.jit(lambda v: render(scene(v), Adaptive(4, contrast=0.2)))(arrays("jax", BALL))


# --------------------------------------------------------------------------------------------------- derivatives


def edge(target, supersample, x=0.3):
    """Each row's change of alpha as a card's right edge moves by a pixel: one, if all of the edge is felt."""
    vertices, faces = quad(-100, x, -100, 100)
    camera = rts.Camera.orthographic((0, 0, 10), (0, 0, 0), height=16)
    along = arrays(target, np.broadcast_to([1.0, 0, 0], vertices.shape))

    def alpha(v):
        return rts.render(rts.Part(MESH(faces), {"vertices": v}), camera, (16, 16), supersample=supersample)[..., 3]

    return derivative(target, alpha, arrays(target, vertices), along)


@pytest.mark.parametrize("target", TORCH)
@pytest.mark.parametrize("s", [2, 4, 8])
def test_a_straight_edge_is_everywhere_that_of_the_finer_image(target, s):
    for x in (0.3, 0.02, -0.49):
        for found, expected in zip(edge(target, Adaptive(s), x), edge(target, s, x), strict=True):
            np.testing.assert_allclose(found, expected, rtol=0, atol=2e-6)


def test_half_of_an_edge_activated_is_not_felt_whole(monkeypatch):
    """The trap: coarse samples give half of an edge's derivative to each of two pixels, fine ones all to one."""
    np.testing.assert_allclose(edge(TORCH[0], Adaptive(4))[1].sum(axis=1), 1, atol=2e-3)
    columns = np.flatnonzero(np.abs(edge(TORCH[0], 1)[1]).max(axis=0) > 0.1)
    assert len(columns) == 2
    mask = np.zeros((16, 16), bool)
    mask[:, columns[0]] = True
    activate(monkeypatch, mask)
    assert np.abs(edge(TORCH[0], Adaptive(4))[1].sum(axis=1) - 1).min() > 0.3


@pytest.mark.parametrize("target", TORCH)
def test_a_ramp_that_moves_is_exact_whatever_is_active(target, monkeypatch):
    vertices, faces = quad(-30, 30, -30, 30)
    camera = rts.Camera.orthographic((0, 0, 10), (0, 0, 0), height=16)
    colors = np.repeat(0.5 + vertices[:, :1] / 100, 3, axis=1)
    along = arrays(target, np.broadcast_to([1.0, 0, 0], vertices.shape))
    activate(monkeypatch, np.random.default_rng(8).random((16, 16)) < 0.4)

    def image(v):
        part = rts.Part(MESH(faces), {"vertices": v, "colors": colors}, "unlit")
        return rts.render(part, camera, (16, 16), supersample=Adaptive(3))[..., 0]

    found, slope = derivative(target, image, arrays(target, vertices), along)
    ramp = 0.5 + (np.arange(16) - 7.5) / 100
    np.testing.assert_allclose(found, np.broadcast_to(ramp, (16, 16)), atol=1e-5)
    np.testing.assert_allclose(slope, -0.01, atol=1e-5)


def test_the_outline_of_a_sphere_that_turns_stands_still():
    vertices, faces = icosphere(5, 0.7)
    camera, size = rts.Camera.look_at((0, 0, 3.2), (0, 0, 0), fov_y=40), (96, 96)

    def norm(motion, supersample):
        def alpha(t):
            zero = 0 * t
            pose = rts.namespace(t).stack([t if m else zero for m in motion])
            part = rts.Part(MESH(faces), {"vertices": vertices}, transform=rts.rigid(pose))
            return rts.render(part, camera, size, supersample=supersample)[..., 3]

        slope = derivative(TORCH[0], alpha, *arrays(TORCH[0], (np.zeros(()), np.ones(()))))[1]
        blur = np.exp(-(np.subtract.outer(np.arange(96), np.arange(96)) ** 2) / 8) / np.sqrt(8 * np.pi)
        return np.linalg.norm(blur @ slope @ blur)

    turn, move = (0, 1, 0, 0, 0, 0), (0, 0, 0, 1, 0, 0)
    assert norm(turn, 1) > 2.5 * norm(turn, Adaptive(4))
    assert norm(turn, Adaptive(4)) < 0.01 * norm(move, Adaptive(4))
    np.testing.assert_allclose(norm(move, Adaptive(4)), norm(move, 4), rtol=1e-3)


def test_derivatives_are_differences_at_fixed_samples():
    """For a splatter whose derivative is that of its image."""
    vertices, along = arrays(TORCH[0], (BALL, np.random.default_rng(9).normal(size=BALL.shape)), np.float64)
    sampled = rts.sample(scene(vertices), CAMERA, SIZE, supersample=Adaptive(3), layers=3, splatter=Multi())

    def image(v):
        return rts.render_samples(sampled, scene(v), CAMERA, splatter=Multi())

    step = 1e-6
    expected = to_numpy((image(vertices + step * along) - image(vertices - step * along)) / (2 * step))
    np.testing.assert_allclose(derivative(TORCH[0], image, vertices, along)[1], expected, atol=1e-5)


def test_depths_beyond_active_pixels_make_no_difference():
    """The trap: what stands for empty layers depends on the depths of a scene, and tiles do not hold the farthest."""
    near, vertices = scene()[:2], arrays(TORCH[0], BALL, np.float64)
    parts = [
        rts.Part(p.surface, {**p.theta, "vertices": x}, "unlit") for p, x in zip(near, (vertices, CARD), strict=True)
    ]
    slope = np.array([(-20, -40, -4), (80, -40, -60), (80, 40, -60), (-20, 40, -4)], float)
    behind = rts.Part(MESH(FAR_FACES), {"vertices": slope}, "silhouette")
    for scene_ in (parts, [*parts, behind]):
        found, fine = (to_numpy(render(scene_, n)) for n in (Adaptive(4), 4))
        sampled = rts.sample(scene_, CAMERA, SIZE, supersample=Adaptive(4), layers=3)
        mask = to_numpy(sampled.fine.pixel) >= 0
        np.testing.assert_allclose(found[mask], fine[mask], rtol=0, atol=1e-9)
    deepest = [max(float(s.depth.max()) for s in x) for x in (sampled.samples, sampled.fine.samples)]
    assert 0.1 < mask.mean() < 0.9 and deepest[0] > 1.2 * deepest[1]


# ------------------------------------------------------------------------------------------------ what is sampled


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
    whole = rts.sample(scene(), CAMERA, SIZE, supersample=Adaptive(4), layers=3)
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
    with pytest.warns(rts.EmptyImageWarning):
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
    grid = tiles.Grid((128, 128), 8, sampled.fine.apron).fine
    assert sampled.fine.row[0].size < 0.25 * grid[0] * grid[1]
    assert sum(len(s.ids) for s in sampled.fine.samples) < 0.1 * grid[0] * grid[1]


# ------------------------------------------------------------------------------------------------- where it is used


def posed_residuals(channels, shader, s):
    """Residuals of the scene as the ball moves, and a pose."""
    rng = np.random.default_rng(12)
    goal, weights = rng.random((*SIZE, channels)), rng.random((*SIZE, 1))

    def posed(pose):
        ball, *others = scene(shader=shader)
        return [ball.replace(transform=rts.rigid(pose)), *others]

    options = dict(weights=weights, supersample=Adaptive(s), background=rng.random(3), layers=3)
    pose = np.array([0.1, 0.2, -0.1, 0.05, 0.02, 0.1])
    return rts.ImageResiduals(posed, CAMERA, SIZE, goal, **options), pose


@pytest.mark.parametrize("target", TORCH)
@pytest.mark.parametrize("channels, shader, s", [(1, "silhouette", 2), (3, "unlit", 3), (4, "unlit", 4)])
def test_normal_equations_are_those_of_the_jacobian(target, channels, shader, s):
    residuals, pose = posed_residuals(channels, shader, s)
    pose = arrays(target, pose)
    found, expected = residuals.normal_equations(pose), normal_equations(residuals, pose, rts.engine_of(pose))
    for a, b in zip(found, expected, strict=True):
        np.testing.assert_allclose(to_numpy(a), to_numpy(b), rtol=1e-3, atol=1e-5)


def test_normal_equations_in_a_compiled_program():
    jax = pytest.importorskip("jax")
    residuals, pose = posed_residuals(1, "silhouette", 2)
    found = jax.jit(residuals.normal_equations)(arrays("jax", pose))
    for a, b in zip(found, residuals.normal_equations(arrays(TORCH[0], pose)), strict=True):
        np.testing.assert_allclose(to_numpy(a), to_numpy(b), rtol=1e-3, atol=1e-5)


def test_fits_take_fewer_samples():
    vertices = 0.9 * BALL * [1, 0.7, 0.5]

    def posed(pose):
        return rts.Part(MESH(FACES), {"vertices": vertices}, transform=rts.rigid(pose))

    goal = rts.render(posed(np.array([0.2, 0.1, 0.3, 0.05, 0, 0])), CAMERA, (48, 48), supersample=8)[..., 3]
    losses = []
    for s in (1, 4, Adaptive(4)):
        residuals = rts.ImageResiduals(posed, CAMERA, (48, 48), goal, supersample=s)
        start = arrays(TORCH[0], np.array([0.1, 0, 0.2, 0, 0.05, 0]))
        losses.append(float(rts.fit(residuals, start, method="lm", progress=False).loss))
    assert losses[2] < 1.5 * losses[1] < 0.1 * losses[0]


def test_explain_counts_pixels_and_samples():
    part = scene(shader="silhouette")[0]
    (choice,) = rts.explain(part, CAMERA, SIZE, supersample=Adaptive(4))
    sampled = rts.sample(part, CAMERA, SIZE, supersample=Adaptive(4), splatter="visible")
    assert choice.active == (sampled.fine.pixel >= 0).sum() > 0
    assert choice.fine == len(sampled.fine.samples[0].ids)
    assert choice.samples == choice.fine + len(sampled.samples[0].ids)
    (plain,) = rts.explain(part, CAMERA, SIZE)
    assert plain.samples == len(sampled.samples[0].ids) and plain.active is plain.fine is None


@pytest.mark.parametrize(
    "wrong, told",
    [
        ({"samples": 1}, "samples of Adaptive is 1; expected an integer of at least 2"),
        ({"samples": 2.5}, "samples of Adaptive is 2.5"),
        ({"samples": 4, "dilated": 1}, "dilated of Adaptive is 1; expected True, False or None"),
        ({"samples": 4, "contrast": 0}, "contrast of Adaptive is 0; expected a positive number"),
    ],
)
def test_what_cannot_be_is_refused(wrong, told):
    with pytest.raises(rts.InputError, match=told):
        Adaptive(**wrong)


def test_it_is_a_static_value():
    assert Adaptive(4) == Adaptive(np.int64(4)) != Adaptive(4, dilated=True) and len({Adaptive(4), Adaptive(4)}) == 1
