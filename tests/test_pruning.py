"""Dropping hidden samples changes nothing; and layers="auto" takes as many as count."""

from dataclasses import replace

import numpy as np
import pytest
from analytic import Ellipsoid
from helpers import ALL, DIFFERENTIABLE, arrays, box, derivative, gradient, icosphere, quad, quick, soup, to_numpy

import rts
from rts import splatting
from rts.arrays.extremes import extent, largest, named
from rts.arrays.trees import map_leaves
from rts.contracts.records import ArraySpec
from rts.rendering.samples import sample
from rts.sampling import hidden

pytestmark = pytest.mark.sampling

MESH = rts.plugin("rts.surfaces", "mesh")
CAMERA = rts.Camera.look_at((0.3, 0.4, 4.0), (0, 0, 0), fov_y=50)
SIZE = (24, 28)
MESH_OF_BOX = box(0.5)
SPLATTERS = ["none", "single", "multi", "visible"]


def part_of(mesh, seed=0, shift=(0.0, 0.0, 0.0), **options):
    vertices, faces = mesh
    colors = np.random.default_rng(seed).random(vertices.shape)
    return rts.Part(MESH(faces), {"vertices": vertices + np.float32(shift), "colors": colors}, "unlit", **options)


def card(z, half=1.0, shift=0.0):
    return part_of(quad(-half + shift, half + shift, -half, half, z), seed=int(10 * z) + 50)


SCENES = {
    "soup": [part_of(soup(30))],
    "sphere before a card": [part_of(icosphere(3, 0.7)), card(-1.0)],
    "closed box": [part_of(box(0.6))],
    "cards": [card(-0.3 * i, 0.5 + 0.1 * i, 0.1 * i) for i in range(4)],
    "interpenetrating": [part_of(icosphere(2, 0.8), shift=(0.3, 0, 0)), part_of(icosphere(2, 0.8), 1)],
}


def with_vertices(parts, vertices):
    return [p.replace(theta={**p.theta, "vertices": v}) for p, v in zip(parts, vertices, strict=True)]


def images(parts, splatter, layers):
    """The image from all samples, and from those that the splatter needs; and how many there are of each."""
    found = []
    for chosen in (None, splatter):
        sampled = sample(parts, CAMERA, SIZE, splatter=chosen, layers=layers)
        found.append((rts.render_samples(sampled, parts, CAMERA, splatter=splatter), int((sampled.row >= 0).sum())))
    return found


@pytest.mark.parametrize("splatter", SPLATTERS)
@pytest.mark.parametrize("name", SCENES)
@pytest.mark.parametrize("layers", [1, 2, 4])
def test_the_image_is_the_same_without_what_is_not_needed(name, splatter, layers):
    (whole, count), (pruned, fewer) = images(SCENES[name], splatter, layers)
    np.testing.assert_allclose(pruned, whole, rtol=0, atol=1e-12)
    assert fewer <= count
    if layers > 1 and name in ("sphere before a card", "closed box"):
        assert fewer < count


@pytest.mark.parametrize("target", DIFFERENTIABLE)
@pytest.mark.parametrize("splatter", ["multi", "visible"])
@pytest.mark.parametrize("name", ["soup", "sphere before a card"])
def test_derivatives_are_the_same_without_what_is_not_needed(name, splatter, target):
    parts = SCENES[name]
    vertices = arrays(target, [p.theta["vertices"] for p in parts])
    weights = arrays(target, np.random.default_rng(0).normal(size=(*SIZE, 4)))
    along = arrays(
        target, [np.random.default_rng(i).normal(size=p.theta["vertices"].shape) for i, p in enumerate(parts)]
    )
    found = []
    for chosen in (None, splatter):
        sampled = sample(with_vertices(parts, vertices), CAMERA, SIZE, splatter=chosen, layers=3)

        def loss(v, sampled=sampled):
            image = rts.render_samples(sampled, with_vertices(parts, v), CAMERA, splatter=splatter)
            return (image * weights).sum()

        found.append([*gradient(target, loss, vertices), derivative(target, loss, vertices, along)[1]])
    for whole, pruned in zip(*found, strict=True):
        np.testing.assert_allclose(pruned, whole, rtol=1e-4, atol=1e-4 * np.abs(whole).max())


@pytest.mark.parametrize("target", ALL)
def test_all_of_what_is_sampled_is_consistent_after_pruning(target):
    parts = map_leaves(lambda x: arrays(target, x), SCENES["sphere before a card"])
    sampled = to_numpy(sample(parts, CAMERA, SIZE, splatter="visible", layers=4))
    whole = to_numpy(sample(parts, CAMERA, SIZE, splatter=None, layers=4))
    kept = sampled.row >= 0
    np.testing.assert_array_equal(sampled.part, np.where(kept, whole.part, -1))
    np.testing.assert_array_equal(sampled.depth, np.where(kept, whole.depth, 0))
    offsets = np.cumsum([0, *(len(s.ids) for s in sampled.samples)])
    for i, (own, all_of_them) in enumerate(zip(sampled.samples, whole.samples, strict=True)):
        np.testing.assert_array_equal((own.row >= 0).sum(), (kept & (sampled.part == i)).sum())
        cells = kept & (sampled.part == i)
        local = sampled.row[cells] - offsets[i]
        before = whole.row[cells] - np.cumsum([0, *(len(s.ids) for s in whole.samples)])[i]
        np.testing.assert_array_equal(own.ids[local], all_of_them.ids[before])
        np.testing.assert_array_equal(own.params[local], all_of_them.params[before])


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("name", ["multi", "visible", "single"])
def test_the_compiled_choice_is_that_of_the_specification(name, dtype):
    specification = {"multi": splatting.Multi, "visible": splatting.Visible, "single": splatting.Single}[name]
    compiled = rts.plugin("rts.splatters", name)
    for seed in range(20):
        rng = np.random.default_rng(seed)
        layers, height, width = rng.integers(1, 6), *rng.integers(1, 14, 2)
        x, y = np.arange(width), np.arange(height)[:, None]
        slope = rng.normal(0, 0.3, (layers, 2, 1, 1))
        depth = 5 + slope[:, 0] * x + slope[:, 1] * y + np.where(rng.random((layers, 1, 1)) < 0.5, 2.0, 0.0)
        depth = np.sort(np.abs(depth) + 0.1, axis=0).astype(dtype)
        covered = np.logical_and.accumulate(rng.random(depth.shape) < 0.93, axis=0)
        for options in ({}, {"epsilon": 0.0}):
            expected = specification(**options).needed(covered, depth)
            np.testing.assert_array_equal(compiled(**options).needed(covered, depth), expected)


def test_nothing_is_dropped_that_may_be_seen_through():
    def glass(theta, gbuffer, camera):
        return 0.5 * rts.namespace(gbuffer["position"]).ones_like(gbuffer["position"][:, :1]) * np.ones((1, 4))

    parts = [p.replace(shader=glass) for p in SCENES["closed box"]]
    (whole, count), (same, same_count) = images(parts, "visible", 4)
    assert count == same_count
    np.testing.assert_array_equal(same, whole)


@pytest.mark.parametrize("name", ["sphere before a card", "closed box"])
@pytest.mark.parametrize("options", [{"layers": 3}, {"layers": 3, "supersample": rts.Adaptive(2)}, {"layers": "auto"}])
def test_scenes_with_a_translucent_part_keep_all_samples(options, name):
    def count(parts, splatter):
        sampled = sample(parts, CAMERA, SIZE, splatter=splatter, **options)
        fine = () if sampled.fine is None else sampled.fine.samples
        return sum(len(s.ids) for s in (*sampled.samples, *fine))

    solid, glass = card(0.9), card(0.9).replace(shader=rts.plugin("shaders", "unlit")(opaque=False))
    kept, every = (count([glass, *SCENES[name]], s) for s in ("visible", Keeping("visible")))
    assert kept == every
    assert count([solid, *SCENES[name]], "visible") < every


def test_constant_surfaces_are_evaluated_only_where_needed():
    calls = []

    class Watched(MESH):
        def evaluate(self, theta, samples):
            calls.append(len(samples.ids))
            return super().evaluate(theta, samples)

    torch = pytest.importorskip("torch")
    vertices, faces = icosphere(3)
    part = rts.Part(Watched(faces), {"vertices": vertices}, "silhouette", torch.eye(4))
    sizes = []
    for splatter in (None, "visible"):
        calls.clear()
        sample(part, CAMERA, (96, 112), splatter=splatter, layers=2)
        sizes.append(max(calls))
    assert sizes[1] < 0.7 * sizes[0]


def test_a_splatter_that_does_not_say_what_it_needs_gets_everything():
    class Own(rts.Splatter):
        reach = splatting.Visible.reach

        def image(self, splats):
            return rts.plugin("splatters", "visible")().image(splats)

    (whole, count), (same, same_count) = images(SCENES["closed box"], Own(), 3)
    assert count == same_count
    np.testing.assert_array_equal(same, whole)


def test_tables_with_a_row_a_sample_stay_in_step():
    class Tabled(MESH):
        """A mesh that evaluates from a table of its own instead of the barycentrics."""

        def table_specs(self, rows, capacity):
            return {"weights": ArraySpec((rows, 2), np.float32, packed=True, by_sample=True)}

        def refine(self, inputs, samples, rays):
            return replace(samples, tables={"weights": samples.params.copy()}, params=samples.params * 0)

        def evaluate(self, theta, samples):
            return super().evaluate(theta, replace(samples, params=samples.tables["weights"]))

    parts = [p.replace(surface=Tabled(p.surface.faces)) for p in SCENES["sphere before a card"]]
    for target in ("numpy", "torch-cpu"):
        moving = with_vertices(parts, arrays(target, [p.theta["vertices"] for p in parts]))
        (whole, count), (pruned, fewer) = images(moving, "visible", 4)
        assert fewer < count
        np.testing.assert_allclose(to_numpy(pruned), to_numpy(whole), rtol=0, atol=1e-6)


@pytest.mark.parametrize(
    "given, said", [(np.ones, "float64 of"), (lambda shape: np.ones(shape[1:], bool), "bool of"), (list, "list")]
)
def test_what_a_splatter_says_it_needs_is_checked(given, said):
    class Odd(splatting.Visible):
        def needed(self, covered, depth):
            return given(covered.shape)

    with pytest.raises(rts.InputError, match=f"gave {said}.*expected a NumPy array, bool of"):
        rts.render(SCENES["closed box"], CAMERA, SIZE, splatter=Odd())


def test_a_splatter_that_needs_what_is_not_there_gets_no_ghosts():
    class Greedy(splatting.Visible):
        def needed(self, covered, depth):
            return np.ones_like(covered)

    (whole, _), (same, _) = images(SCENES["closed box"], Greedy(), 2)
    np.testing.assert_array_equal(same, whole)


# ---------------------------------------------------------------------------------------------- layers="auto"


def test_auto_layers_of_a_surface_that_the_automatic_sampler_casts_rays_at():
    part = rts.Part(Ellipsoid(), {"center": np.zeros(3), "radii": np.array([0.8, 0.6, 0.7])})
    sampled = sample(part, CAMERA, SIZE, splatter="visible", layers="auto")
    assert sampled.row.shape[0] == 2
    rays = sample(part, CAMERA, SIZE, sampler="rays", splatter="visible", layers=2)
    assert (sample(part, CAMERA, SIZE, splatter="visible", layers=2).row >= 0).sum() == (rays.row >= 0).sum()


def test_auto_layers_with_a_sampler_that_leaves_hidden_samples_to_the_core():
    class Deaf(rts.plugin("rts.samplers", "raster")):
        def sample(self, part, camera, size, layers, request):
            return super().sample(part, camera, size, layers, replace(request, hidden=None))

    scene = SCENES["closed box"], CAMERA, SIZE
    found = sample(*scene, sampler=Deaf(), splatter="visible", layers="auto")
    expected = sample(*scene, sampler="raster", splatter="visible", layers="auto")
    np.testing.assert_array_equal(found.row, expected.row)


@pytest.mark.parametrize("target", ALL)
@pytest.mark.parametrize(
    "name, expected", [("closed box", 2), ("cards", 4), ("sphere before a card", 3), ("interpenetrating", 4)]
)
def test_auto_takes_the_layers_that_count(name, expected, target):
    parts = map_leaves(lambda x: arrays(target, x), SCENES[name])
    sampled = sample(parts, CAMERA, SIZE, splatter="visible", layers="auto")
    assert sampled.row.shape[0] == expected
    found = to_numpy(rts.render(parts, CAMERA, SIZE, layers="auto"))
    np.testing.assert_allclose(found, to_numpy(rts.render(parts, CAMERA, SIZE, layers=8)), rtol=0, atol=1e-6)


def test_auto_without_a_splatter_takes_every_layer():
    assert rts.sample(SCENES["closed box"], CAMERA, SIZE, layers="auto", splatter=None).row.shape[0] == 2


@pytest.mark.filterwarnings("ignore::rts.errors.EmptyImageWarning")
def test_auto_of_an_empty_view_takes_one_layer():
    image = rts.render(card(50.0), CAMERA, SIZE, layers="auto")
    np.testing.assert_array_equal(image, 0)


def test_auto_says_what_is_beyond_its_limit(monkeypatch):
    parts = [card(-0.1 * i, 0.5 + 0.02 * i, 0.02 * i) for i in range(12)]
    monkeypatch.setattr(hidden, "LAYER_LIMIT", 8)
    with pytest.warns(rts.errors.LayersWarning, match="more than the 8 layers") as warned:
        sampled = rts.sample(parts, CAMERA, SIZE, splatter="visible", layers="auto")
    assert warned[0].filename == __file__
    assert sampled.row.shape[0] == 8 and int(sampled.overflow) > 0
    monkeypatch.setattr(hidden, "LAYER_LIMIT", 16)
    sampled = sample(parts, CAMERA, SIZE, splatter="visible", layers="auto")
    assert sampled.row.shape[0] == 12 and int(sampled.overflow) == 0


def test_auto_works_under_gradients_and_takes_a_number_under_jit():
    jax = pytest.importorskip("jax")
    parts = SCENES["closed box"]

    def loss(vertices):
        return rts.render(with_vertices(parts, [vertices]), CAMERA, SIZE, layers="auto", splatter="visible").sum()

    vertices = arrays("jax", parts[0].theta["vertices"])
    assert np.abs(jax.grad(loss)(vertices)).max() > 0
    # Traced values cannot decide: opaque parts then have two layers.
    two = rts.render(parts, CAMERA, SIZE, layers=2, splatter="visible").sum()
    np.testing.assert_allclose(float(jax.jit(loss)(vertices)), two, rtol=1e-5)
    torch = pytest.importorskip("torch")
    assert torch.func.grad(loss)(arrays("torch-cpu", parts[0].theta["vertices"])).abs().max() > 0


@pytest.mark.parametrize("wrong", ["all", 0, None, 1.5])
def test_other_layers_are_refused(wrong):
    with pytest.raises(rts.InputError, match='expected an integer of at least 1, or "auto"'):
        rts.render(card(0.0), CAMERA, SIZE, layers=wrong)


# ------------------------------------------------------------------------------------- far from the origin


def far_scene(seed, offset, count):
    """Parts of a soup, some of it doubled at nearly its depth, so far off that float32 rounds depths; and a camera."""
    rng = np.random.default_rng(seed)
    place = offset * np.array([0.6, -0.64, 0.48])
    parts = []
    for i in range(count):
        vertices, faces = soup(6, 10 * seed + i, size=0.6)
        behind = rng.uniform(1, 20) * 1e-7 * (1000 + offset)
        vertices = np.concatenate([vertices, vertices - np.float32([0, 0, behind])])
        faces = np.concatenate([faces, faces + len(vertices) // 2])
        theta = {"vertices": (vertices + place).astype(np.float32)}
        theta["colors"] = rng.random(vertices.shape).astype(np.float32)
        parts.append(rts.Part(MESH(faces.astype(np.int32)), theta, "unlit"))
    return parts, rts.Camera.look_at(place + (0.3, 0.4, 4.0), place, fov_y=50, aspect=1.0)


class Keeping(rts.Splatter):
    """Needs all samples, out to where another splatter looks."""

    def __init__(self, splatter):
        self.reach = rts.plugin("rts.splatters", splatter).reach

    def image(self, splats):
        raise NotImplementedError


def both_ways(parts, camera, splatter):
    """Images and gradients of the vertices, by torch, of all samples and of those that are needed; and their counts."""
    torch = pytest.importorskip("torch")
    weights = torch.tensor(np.random.default_rng(0).normal(size=(16, 16, 4)), dtype=torch.float32)
    found = []
    for chosen in (Keeping(splatter), splatter):
        vertices = [torch.tensor(p.theta["vertices"], requires_grad=True) for p in parts]
        moving = with_vertices(parts, vertices)
        sampled = sample(moving, camera, (16, 16), splatter=chosen, layers=3)
        image = rts.render_samples(sampled, moving, camera, splatter=splatter)
        grads = torch.autograd.grad((image * weights).sum(), vertices)
        found.append((to_numpy(image), to_numpy(grads), int((sampled.row >= 0).sum())))
    return found


@pytest.mark.parametrize("count", [1, 2])
@pytest.mark.parametrize("splatter", ["multi", "visible"])
@pytest.mark.parametrize("offset", quick([10.0, 0.0, 1e2, 1e3, 1e4, 1e5]))
def test_nothing_that_counts_is_dropped_however_far_off_the_origin(offset, splatter, count):
    fewer = 0
    for seed in range(40):
        (whole, gradients, every), (pruned, others, kept) = both_ways(*far_scene(seed, offset, count), splatter)
        np.testing.assert_allclose(pruned, whole, rtol=0, atol=1e-6)
        for found, expected in zip(others, gradients, strict=True):
            np.testing.assert_allclose(found, expected, rtol=0, atol=1e-6 * max(1, np.abs(expected).max()))
        fewer += every - kept
    assert fewer > 0 if offset <= 10 and splatter == "visible" else offset <= 100 or fewer == 0


def test_nothing_that_counts_is_dropped_far_off_the_origin_inside_jit():
    jax = pytest.importorskip("jax")
    parts, camera = far_scene(3, 1e4, 1)

    def image(vertices, splatter):
        moving = with_vertices(parts, [vertices])
        sampled = sample(moving, camera, (16, 16), splatter=splatter, layers=3)
        return rts.render_samples(sampled, moving, camera, splatter="visible"), (sampled.row >= 0).sum()

    vertices = jax.numpy.asarray(parts[0].theta["vertices"])
    (whole, every), (pruned, kept) = (jax.jit(lambda v, s=s: image(v, s))(vertices) for s in (None, "visible"))
    np.testing.assert_allclose(pruned, whole, rtol=0, atol=1e-6)
    assert every == kept


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_the_largest_number_of_an_array_is_that_of_its_sizes(dtype):
    x = np.random.default_rng(0).normal(size=(20_000, 3)).astype(dtype)
    x[12_345, 1] = -77
    assert largest(x) == largest(x[:, ::-1]) == 77
    assert largest(x[:0]) == 0
    assert largest(np.append(x, dtype(-np.inf))) == np.inf
    assert np.isnan(largest(np.append(x, dtype(-np.nan))))


@pytest.mark.parametrize("dtype", [np.int32, np.int64, np.int8])
def test_indices_are_told_from_what_is_none_with_the_least_and_the_largest(dtype):
    x = np.full((2, 150, 123), -1, dtype)
    assert named(x)[1:] == extent(x) == (-1, -1) and not named(x)[0].any()
    x[1, 149, 120:] = 7, 0, 99
    there, *ends = named(x[:, ::-1])
    assert ends == [-1, 99] and extent(x) == (-1, 99)
    np.testing.assert_array_equal(there, x[:, ::-1] >= 0)
    x[0, 0, 0] = -5
    assert named(x)[1:] == extent(x) == (-5, 99)
    assert named(x[:0])[1:] == (-1, -1) and named(x[1, 149:, 120:])[1:] == (-1, 99)
    assert extent(x[1, 149:, 120:]) == (0, 99)


def test_indices_without_a_sign_are_all_named():
    there, *ends = named(np.array([0, 2**32 - 1], np.uint32))
    assert there.all() and ends == [-1, 2**32 - 1]
