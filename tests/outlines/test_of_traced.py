"""Traced scenes: one call to the host samples all parts, and under `vmap` all items, as if one were taken at a time."""

import numpy as np
import pytest
from found_outlines import sampled_with_outlines
from helpers import box, icosphere, quick, relative_error, rigid

import rts
from rts.outlines import of_traced

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
    """For each call the number of items that were sampled at once."""
    counts, find = [], of_traced._Call._several

    def counted(self, given):
        found = find(self, given)
        counts.append(sum(one is not None for one in found))
        return found

    monkeypatch.setattr(of_traced._Call, "_several", counted)
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


class Tinted(Glass):
    """One colour for all samples of opaque surfaces, so that none need tell it."""

    opaque, uniform = True, True


def crowd(shader, count=5, kinds=2, **options):
    """Poses (P, 6) of overlapping meshes, the last one out of sight; and a function of these that gives parts."""
    random, pieces = np.random.default_rng(7), []
    for index in range(count):
        vertices, faces = (icosphere(2, 0.6), box(0.4))[index % kinds]
        theta = {"vertices": vertices.astype(np.float32)}
        if isinstance(shader, Glass):
            theta["tint"] = random.uniform(0.1, 0.5, 4).astype(np.float32)
        pieces.append((rts.Mesh(faces), theta))
    poses = random.uniform(-0.7, 0.7, (count, 6)).astype(np.float32)
    poses[-1, 3:] = 50.0

    def parts(poses):
        return [
            rts.Part(surface, theta, shader, transform=rts.rigid(pose), **options)
            for (surface, theta), pose in zip(pieces, poses, strict=True)
        ]

    return poses, parts


WAYS = [
    ("lambert", {}, {}),
    ("silhouette", {}, {}),
    (Tinted(), {}, {}),
    (Glass(), {"layers": 4}, {}),
    ("lambert", {"capacity": 1500}, {}),
    ("lambert", {"supersample": 2}, {}),
    ("lambert", {}, {"cull": "back"}),
]


@pytest.mark.parametrize(("shader", "options", "of_parts"), quick(WAYS, 4))
def test_programs_of_jax_give_the_image_and_gradient_of_known_values(shader, options, of_parts):
    jax = pytest.importorskip("jax")
    poses, parts = crowd(shader, **of_parts)
    weights = np.random.default_rng(1).normal(size=(*SIZE, 4)).astype(np.float32)

    def loss(poses, **further):
        image = rts.render(parts(poses), CAMERA, SIZE, **{**options, **further})
        return (image * weights).sum(), image

    (_, image), slope = jax.jit(jax.value_and_grad(loss, has_aux=True))(jax.numpy.asarray(poses))
    known = torch.tensor(poses, requires_grad=True)
    total, expected = loss_with_torch(parts, known, weights, options)
    total.backward()
    np.testing.assert_allclose(np.asarray(image), expected.detach().numpy(), rtol=0, atol=2e-5)
    assert relative_error(np.asarray(slope), known.grad.numpy()) < 2e-4


def loss_with_torch(parts, poses, weights, options):
    """The weighed sum of an image, and the image, without a capacity."""
    known = {name: value for name, value in options.items() if name != "capacity"}
    image = rts.render(parts(poses), CAMERA, SIZE, **known)
    return (image * torch.as_tensor(weights)).sum(), image


def host_calls(f, *arguments):
    """How many times a program calls the host for samples and outlines."""
    jax = pytest.importorskip("jax")
    return str(jax.make_jaxpr(f)(*arguments)).count("rts_host_call[")


def test_a_program_samples_all_parts_in_one_call():
    jax = pytest.importorskip("jax")
    poses, parts = crowd("lambert")
    poses = jax.numpy.asarray(poses)
    assert host_calls(lambda p: rts.render(parts(p), CAMERA, SIZE), poses) == 1
    ball = rts.Part(rts.Sdf(lambda theta, p: (p**2).sum(-1) ** 0.5 - theta["radius"]), {"radius": np.float32(0.3)})
    assert host_calls(lambda p: rts.render([*parts(p), ball], CAMERA, SIZE), poses) > 1


@pytest.mark.parametrize("shader", ["lambert", "silhouette"])
def test_parts_that_nothing_is_seen_of_have_no_row_in_use(shader):
    jax = pytest.importorskip("jax")
    poses, parts = crowd(shader)
    sampled = jax.jit(lambda p: rts.sample(parts(p), CAMERA, SIZE))(jax.numpy.asarray(poses))
    rows = [np.asarray(own.row).reshape(-1) for own in sampled.samples]
    assert (rows[-1] == -1).all() and int(sampled.overflow) == 0
    starts = np.cumsum([0, *map(len, rows)])
    named = np.concatenate([np.asarray(x).reshape(-1) for x in (sampled.row, *sampled.stencil.samples())])
    for first, own in zip(starts, rows, strict=False):
        here = named[(named >= first) & (named < first + len(own))] - first
        used = own[own >= 0]
        np.testing.assert_array_equal(used, np.arange(len(used)))
        assert (here < len(used)).all()


def test_samples_and_crossings_without_room_are_counted(monkeypatch):
    jax = pytest.importorskip("jax")
    poses, parts = crowd("lambert")
    poses = jax.numpy.asarray(poses)
    counts = [own.ids.shape[0] for own in rts.sample(parts(torch.tensor(np.asarray(poses))), CAMERA, SIZE).samples]
    whole, outlines = sampled_with_outlines(parts(torch.tensor(np.asarray(poses))), CAMERA, SIZE)
    cells = np.bincount(np.searchsorted(np.cumsum(counts), np.asarray(whole.row)[np.asarray(whole.row) >= 0], "right"))
    with pytest.warns(rts.errors.InputWarning, match="samples find no room in capacity=50"):
        few = jax.block_until_ready(jax.jit(lambda p: rts.sample(parts(p), CAMERA, SIZE, capacity=50))(poses))
    assert int(few.overflow) == np.maximum(cells - 50, 0).sum() > 0
    assert np.isfinite(np.asarray(rts.render_samples(few, parts(poses), CAMERA))).all()
    crossings = len(outlines.place)
    monkeypatch.setattr(of_traced, "most_crossings", lambda grid, capacity: 30)
    message = f"{crossings - 30} edge crossings find no room beside 30, .* program capacity={4 * crossings}"
    with pytest.warns(rts.errors.InputWarning, match=message):
        few = jax.block_until_ready(jax.jit(lambda p: rts.sample(parts(p), CAMERA, SIZE))(poses))
    assert int(few.overflow) == crossings - 30
    with pytest.warns(rts.errors.InputWarning, match=message):
        several = jax.jit(jax.vmap(lambda p: rts.sample(parts(p), CAMERA, SIZE).overflow))(
            jax.numpy.stack([poses, poses])
        ).block_until_ready()
    assert several.tolist() == [crossings - 30] * 2


def test_prepared_parts_are_sampled_in_one_call(items):
    jax = pytest.importorskip("jax")
    (ball, faces), camera = icosphere(2, 0.7), rts.Camera.look_at((0.1, 0.2, 4), (0, 0, 0), fov_y=50)
    prepared = rts.prepare(rts.Part(rts.Mesh(faces), {"vertices": ball}, "lambert"))

    def image(pose):
        moved = rts.Camera(camera.view @ rts.rigid(pose), camera.projection)
        return rts.render(prepared, moved, SIZE)

    poses = jax.numpy.asarray(POSES, "float32")
    assert host_calls(image, poses[0]) == 1
    several = np.asarray(jax.jit(jax.vmap(image))(poses))
    assert items == [5]
    for pose, one in zip(POSES, several, strict=True):
        view = np.asarray(camera.view) @ np.asarray(rts.rigid(pose))
        known = rts.render(prepared, rts.Camera(view, camera.projection), SIZE)
        np.testing.assert_allclose(one, known, rtol=0, atol=2e-5)


def test_transforms_that_make_no_image_are_blamed():
    jax = pytest.importorskip("jax")
    (ball, faces), good = icosphere(1, 0.7), rigid((0, 0, 1), 20, (0, 0, 0)).astype(np.float32)

    def image(matrix):
        part = rts.Part(rts.Mesh(faces), {"vertices": ball}, "lambert", transform=matrix)
        return rts.render(part, CAMERA, SIZE)

    with pytest.raises(Exception, match="the transform of a part holds NaN or infinity"):
        jax.block_until_ready(jax.jit(image)(jax.numpy.asarray(good * np.nan)))


class Facing(rts.Shader):
    """Colours from normals that it makes unit vectors itself: NaN where a normal is zero."""

    opaque = True

    def __call__(self, theta, gbuffer, camera):
        """Scale normals, and append an alpha of 1."""
        normal = gbuffer["normal"]
        xp = normal.__array_namespace__() if hasattr(normal, "__array_namespace__") else torch
        scaled = normal / (normal * normal).sum(-1)[:, None] ** 0.5
        return xp.concatenate([0.5 + 0.5 * scaled, 1 + 0 * scaled[:, :1]], -1)


@pytest.mark.parametrize("engine", ["torch", "torch vmap", "jax jit"])
def test_what_no_centre_sees_is_shaded_at_its_own_samples_alone(engine):
    # No face names the first vertex, so that its normal is zero; the sliver lies between two columns of centres.
    vertices = np.array([[0, 0, 0], [0, -1, 0], [0.01, 1, 0], [0, 1, 0]], np.float32) + np.float32([0.12326552, 0, 0])
    camera, pose = rts.Camera.look_at((0, 0, 3.4), (0, 0, 0), fov_y=50), np.full(6, 1e-4, np.float32)
    sliver = rts.Mesh([[1, 2, 3]])

    def loss(pose):
        part = rts.Part(sliver, {"vertices": vertices}, Facing(), transform=rts.rigid(pose))
        return (rts.render(part, camera, SIZE) ** 2).sum()

    sampled = rts.sample(rts.Part(sliver, {"vertices": vertices}, Facing()), camera, SIZE)
    assert (sampled.row < 0).all() and (sampled.stencil.color_sample >= 0).any()
    assert not sampled.samples[0].at_points and sampled.samples[0].ids.tolist()[0] == [1, 2, 3]
    if engine == "jax jit":
        jax = pytest.importorskip("jax")
        slope = np.asarray(jax.jit(jax.grad(loss))(jax.numpy.asarray(pose)))
    elif engine == "torch":
        slope = torch.func.grad(loss)(torch.tensor(pose)).numpy()
    else:
        slope = torch.func.vmap(torch.func.grad(loss))(torch.tensor(pose)[None])[0].numpy()
    assert np.isfinite(slope).all() and np.abs(slope).max() > 1


def test_rows_are_counted_past_parts_that_no_centre_sees():
    (ball, faces), hidden = (
        icosphere(2, 0.7),
        rts.Part(rts.Mesh([[0, 1, 2]]), {"vertices": 50 + 10 * np.eye(3)}, "lambert"),
    )
    vertices = np.array([[0, -1, 0], [0.01, 1, 0], [0, 1, 0]]) + [0.12326552, 0, 1]
    camera, mesh = rts.Camera.look_at((0, 0, 3.4), (0, 0, 0), fov_y=50), rts.Mesh([[0, 1, 2]])
    slivers = [rts.Part(mesh, {"vertices": vertices + [x, 0, 0]}, "lambert") for x in (0.0, 0.4)]
    middle = rts.Part(rts.Mesh(faces), {"vertices": ball}, "lambert")
    seen = [slivers[0], middle, slivers[1]]
    whole = [hidden, slivers[0], middle, slivers[1], hidden]
    image = rts.render(whole, camera, SIZE)
    np.testing.assert_array_equal(image, rts.render(seen, camera, SIZE))
    np.testing.assert_allclose(rts.render_samples(rts.sample(whole, camera, SIZE), whole, camera), image, atol=1e-6)


def test_parts_whose_tables_differ_in_width_are_taken_one_by_one(items):
    (ball, faces), random = icosphere(1, 0.4), np.random.default_rng(0)
    ball, texture = ball.astype(np.float32), random.random((8, 8, 3)).astype(np.float32)
    uv, index = random.random((7, 2)).astype(np.float32), random.integers(0, 7, faces.shape)

    def image(pose):
        theta = {"vertices": ball, "uv": uv, "texture": texture}
        first = rts.Part(rts.Mesh(faces, {"uv": index}), theta, "textured", transform=rts.rigid(pose))
        second = rts.Part(rts.Mesh(faces), {"vertices": ball + np.float32([0.5, 0, 0])}, "lambert")
        return rts.render([first, second], CAMERA, SIZE)

    poses = torch.tensor(POSES[:2], dtype=torch.float32)
    together = torch.func.vmap(image)(poses)
    assert items == [0]
    # By rounding, a pixel may average its texture at more places, or at fewer.
    torch.testing.assert_close(together, torch.stack([image(p) for p in poses]), rtol=0, atol=1e-3)


@pytest.mark.parametrize("shader", [Facing(), "lambert"])
def test_the_row_of_a_part_that_is_not_seen_has_no_effect_on_the_gradient(shader):
    # No face names the first vertex, so that its normal is zero.
    ball, faces = icosphere(1, 0.7)
    vertices, mesh = np.concatenate([[[0.0, 0.0, 0.0]], ball]), rts.Mesh(np.asarray(faces) + 1)

    def slope_of(*places):
        pose = torch.zeros(6, dtype=torch.float64, requires_grad=True)
        thetas = [{"vertices": vertices + [x, 0, 0]} for x in places]
        image = rts.render([rts.Part(mesh, theta, shader, transform=rts.rigid(pose)) for theta in thetas], CAMERA, SIZE)
        return torch.autograd.grad(image.square().sum(), pose)[0]

    slope = slope_of(0, 50)
    assert torch.isfinite(slope).all() and (slope != 0).any()
    with pytest.warns(rts.errors.EmptyImageWarning):
        assert (slope_of(50) == 0).all()
