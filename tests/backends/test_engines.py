"""The engines: every transform of torch and jax gives the plain derivative, and all give the same numbers."""

import functools

import numpy as np
import pytest
from helpers import ALL, DIFFERENTIABLE, TORCH, arrays, derivative, gradient, icosphere, relative_error, rigid, to_numpy

import rts
from rts import Camera, Part
from rts.arrays.trees import leaves, map_leaves

pytestmark = pytest.mark.engines

Mesh = rts.plugin("surfaces", "mesh")
SIZE = (24, 32)
VERTICES, FACES = icosphere(1)
MESH = Mesh(FACES)
EYES = np.array([(1.0, 1.5, 4.0), (-1.5, 1.0, 3.5), (0.5, -2.0, 3.0)])
SCENE = {
    "vertices": VERTICES.astype(np.float64),
    "colors": np.random.default_rng(0).uniform(0.2, 0.9, (len(VERTICES), 3)),
    "transform": rigid((1, 2, 3), 30, (0.1, -0.2, 0.3)),
    "eye": EYES[0],
}
SIMPLE = {"splatter": "single", "layers": 1}
"""For what would be slow to compile otherwise."""

DIRECTION = {key: np.random.default_rng(1).normal(size=value.shape) for key, value in SCENE.items()}
WEIGHTS = np.random.default_rng(2).normal(size=(*SIZE, 4))


def camera_at(eye):
    return Camera.look_at(eye, (0.0, 0.0, 0.0), fov_y=40, aspect=SIZE[1] / SIZE[0], near=0.5, far=20)


def part_of(scene):
    theta = {"vertices": scene["vertices"], "colors": scene["colors"]}
    return Part(MESH, theta, "lambert", scene["transform"])


def image_of(scene, **options):
    return rts.render(part_of(scene), camera_at(scene["eye"]), SIZE, **options)


def loss_of(target, dtype=np.float32):
    """A scalar function of the scene; `DIRECTION` and `SCENE` are its plain arguments."""
    weights = arrays(target, WEIGHTS, dtype)
    return lambda scene, **options: (image_of(scene, **options) * weights).sum()


def with_eye(scene, eye):
    return {**scene, "eye": eye}


@functools.cache
def plain_gradient(target):
    """The gradient of the loss by reverse mode, each entry on the host: what every other way must equal."""
    return gradient(target, loss_of(target), arrays(target, SCENE), jit=False)


@functools.cache
def plain_image(target):
    return to_numpy(image_of(arrays(target, SCENE)))


def assert_trees_close(found, expected, tolerance=1e-4):
    for one, other in zip(leaves(found), leaves(expected), strict=True):
        assert relative_error(one, other) < tolerance


# ------------------------------------------------------------------------------------------ across engines


@pytest.mark.parametrize("target", DIFFERENTIABLE)
def test_the_image_is_that_of_numpy(target):
    np.testing.assert_allclose(plain_image(target), plain_image("numpy"), rtol=0, atol=1e-5)
    assert plain_image(target)[..., 3].sum() > 150


@pytest.mark.parametrize("target", DIFFERENTIABLE)
def test_gradient_and_jvp_are_those_of_torch(target):
    assert_trees_close(plain_gradient(target), plain_gradient(TORCH[0]))
    along = [derivative(t, image_of, arrays(t, SCENE), arrays(t, DIRECTION)) for t in dict.fromkeys((target, TORCH[0]))]
    for image, slope in along:
        np.testing.assert_allclose(image, plain_image("numpy"), rtol=0, atol=1e-5)
        assert relative_error(slope, along[-1][1]) < 1e-4


@pytest.mark.parametrize("target", DIFFERENTIABLE)
def test_the_derivative_of_render_is_that_at_frozen_samples(target):
    scene = arrays(target, SCENE)
    sampled = rts.sample(part_of(scene), camera_at(scene["eye"]), SIZE)
    weights = arrays(target, WEIGHTS)
    found = gradient(
        target,
        lambda s: (rts.render_samples(sampled, part_of(s), camera_at(s["eye"])) * weights).sum(),
        scene,
        jit=False,
    )
    assert_trees_close(found, plain_gradient(target), 1e-6)


# Its image of frozen samples has the derivative that it says; shares of pixels beside found edges have no value of it.
STILL = "multi"


@pytest.mark.parametrize("target", TORCH)
def test_gradcheck_passes_in_all_arguments_at_frozen_samples(target):
    torch = pytest.importorskip("torch")
    vertices, faces = icosphere(0)
    mesh, size = Mesh(faces), (6, 7)
    theta = {"vertices": vertices, "color": np.array([0.7, 0.6, 0.5])}
    given = arrays(target, {"theta": theta, "transform": SCENE["transform"], "eye": EYES[0]}, np.float64)

    def parts(tree):
        return Part(mesh, tree["theta"], "blinn_phong", tree["transform"])

    sampled = rts.sample(parts(given), camera_at(given["eye"]), size, splatter=STILL)

    def f(*flat):
        it = iter(flat)
        tree = map_leaves(lambda _: next(it), given)
        return rts.render_samples(sampled, parts(tree), camera_at(tree["eye"]), splatter=STILL)

    inputs = [x.requires_grad_(True) for x in leaves(given)]
    assert torch.autograd.gradcheck(f, inputs, atol=1e-5, check_forward_ad=True)


@pytest.mark.parametrize("target", DIFFERENTIABLE)
def test_float64_numpy_beside_float32_arrays_stays_float32(target):
    scene = {**SCENE, "vertices": arrays(target, SCENE["vertices"])}
    image = image_of(scene)
    assert str(image.dtype).endswith("float32")
    np.testing.assert_allclose(to_numpy(image), plain_image("numpy"), rtol=0, atol=1e-5)


# ---------------------------------------------------------------------------------------- what is constant


@pytest.mark.parametrize("kept", SCENE)
@pytest.mark.parametrize("target", DIFFERENTIABLE)
def test_numpy_entries_are_constants_and_the_rest_keeps_image_and_gradient(target, kept):
    moving = {key: value for key, value in SCENE.items() if key == kept}
    weights = arrays(target, WEIGHTS)

    def f(tree):
        return (image_of({**SCENE, **tree}) * weights).sum()

    given = arrays(target, moving)
    np.testing.assert_allclose(to_numpy(image_of({**SCENE, **given})), plain_image("numpy"), rtol=0, atol=1e-5)
    assert relative_error(gradient(target, f, given)[kept], plain_gradient(target)[kept]) < 1e-4


@pytest.mark.parametrize("target", TORCH)
def test_a_scene_of_numpy_with_a_torch_background_has_no_other_gradient(target):
    torch = pytest.importorskip("torch")
    image = image_of({**SCENE, "eye": arrays(target, SCENE["eye"])})
    assert isinstance(image, torch.Tensor) and not image.requires_grad
    assert isinstance(image_of(SCENE), np.ndarray)


@pytest.mark.parametrize("target", DIFFERENTIABLE)
def test_where_only_the_pose_is_differentiable_the_mesh_is_evaluated_on_the_host(target):
    scene = {**SCENE, "transform": arrays(target, SCENE["transform"])}
    samples = rts.sample(part_of(scene), camera_at(SCENE["eye"]), SIZE, splatter=None).samples[0]
    assert set(samples.gbuffer) == {"position", "normal", "face_normal", "color"}
    assert type(samples.gbuffer["position"]) is type(scene["transform"])
    full = arrays(target, SCENE)
    assert rts.sample(part_of(full), camera_at(full["eye"]), SIZE, splatter=None).samples[0].gbuffer is None


@pytest.mark.parametrize("target", DIFFERENTIABLE)
def test_real_arrays_are_admitted_and_complex_ones_refused(target):
    real = arrays(target, np.ones(2), np.float32)
    engine = rts.engine_of(real)
    assert engine.admitted(real, "radii") is real
    with pytest.raises(rts.InputError, match="^radii has dtype .*complex64; expected real numbers"):
        engine.admitted(arrays(target, np.ones(2), np.complex64), "radii")


def test_arrays_of_no_engine_are_refused_by_type():
    class Strange:
        shape = (4, 4)

    with pytest.raises(
        rts.errors.EngineError, match="transform of part 0 .*Strange belongs to no engine; expected NumPy"
    ):
        rts.render(part_of({**SCENE, "transform": Strange()}), camera_at(SCENE["eye"]), SIZE)


def test_numpy_has_no_derivatives_and_says_what_to_pass():
    engine = rts.plugin("engines", "numpy")()
    with pytest.raises(rts.errors.EngineError, match="torch or jax"):
        engine.value_and_grad(lambda x: x)


# ------------------------------------------------------------------------------------- torch's transforms


@pytest.fixture(params=TORCH)
def on_torch(request):
    return pytest.importorskip("torch"), request.param


def test_torch_func_grad_and_vjp_are_autograd(on_torch):
    torch, target = on_torch
    scene = arrays(target, SCENE)
    found = torch.func.grad(loss_of(target))(scene)
    assert_trees_close(to_numpy(found), plain_gradient(target), 1e-5)
    image, pull = torch.func.vjp(image_of, scene)
    np.testing.assert_array_equal(to_numpy(image), plain_image(target))
    assert_trees_close(to_numpy(pull(arrays(target, WEIGHTS))[0]), plain_gradient(target), 1e-5)


def test_torch_jacfwd_and_jacrev_are_a_loop_of_jvps(on_torch):
    torch, target = on_torch
    scene = arrays(target, SCENE)

    def f(eye):
        return image_of(with_eye(scene, eye))[8:16, 10:20]

    columns = [torch.func.jvp(f, (scene["eye"],), (e,))[1] for e in torch.eye(3, device=scene["eye"].device)]
    expected = to_numpy(torch.stack(columns, dim=-1))
    assert relative_error(to_numpy(torch.func.jacfwd(f)(scene["eye"])), expected) < 1e-4
    assert relative_error(to_numpy(torch.func.jacrev(f)(scene["eye"])), expected) < 1e-4


def test_torch_hessian_is_the_finite_difference_of_the_gradient_at_frozen_samples(on_torch):
    torch, target = on_torch
    scene, weights = arrays(target, SCENE, np.float64), arrays(target, WEIGHTS, np.float64)
    sampled = rts.sample(part_of(scene), camera_at(scene["eye"]), SIZE, splatter=STILL)

    def frozen(eye):
        return (rts.render_samples(sampled, part_of(scene), camera_at(eye), splatter=STILL) * weights).sum()

    step = 1e-5
    columns = []
    for e in step * torch.eye(3, dtype=torch.float64, device=scene["eye"].device):
        above, below = (torch.func.grad(frozen)(scene["eye"] + d) for d in (e, -e))
        columns.append((above - below) / (2 * step))
    expected = to_numpy(torch.stack(columns))
    found = to_numpy(torch.func.hessian(frozen)(scene["eye"]))
    assert relative_error(found, expected) < 1e-5
    np.testing.assert_allclose(found, found.T, rtol=1e-6, atol=1e-6 * np.abs(found).max())


def test_torch_vmap_over_cameras_is_a_loop_for_images_and_gradients(on_torch):
    torch, target = on_torch
    scene, eyes, loss = arrays(target, SCENE), arrays(target, EYES), loss_of(target)
    images = torch.func.vmap(lambda eye: image_of(with_eye(scene, eye)))(eyes)
    assert images.shape == (3, *SIZE, 4)
    gradients = torch.func.vmap(torch.func.grad(lambda eye: loss(with_eye(scene, eye))))(eyes)
    for eye, image, slope in zip(eyes, images, gradients, strict=True):
        expected = with_eye(scene, eye)
        np.testing.assert_allclose(to_numpy(image), to_numpy(image_of(expected)), rtol=0, atol=5e-6)
        assert relative_error(to_numpy(slope), gradient(target, loss, expected)["eye"]) < 1e-4


# torch itself reads .grad of intermediate tensors where it cuts a graph in two.
@pytest.mark.filterwarnings("ignore:The .grad attribute of a Tensor that is not a leaf:UserWarning")
@pytest.mark.thorough
def test_torch_compile_keeps_value_and_gradient(on_torch):
    torch, target = on_torch
    scene, loss = arrays(target, SCENE), functools.partial(loss_of(target), **SIMPLE)
    compiled = torch.compile(loss, backend="aot_eager")
    assert compiled(scene).item() == pytest.approx(loss(scene).item(), rel=1e-4)
    assert_trees_close(gradient(target, compiled, scene), gradient(target, loss, scene))


@pytest.mark.thorough
@pytest.mark.filterwarnings("ignore:The .grad attribute")  # torch's own, where a call that it does not trace begins.
def test_torch_compile_takes_poses_and_cameras(on_torch):
    torch, target = on_torch
    pose = arrays(target, np.full(6, 0.1))

    def numbers(pose):
        eye = pose[:3] + 4.0
        cameras = (
            Camera.look_at(eye, (0.0, 0.0, 0.0)),
            Camera.perspective(50 + pose[0]),
            Camera.orthographic(eye, (0.0, 0.0, 0.0), height=1 + pose[0]),
        )
        return sum((c.projection @ c.view).square().sum() for c in cameras) + rts.rigid(pose).square().sum()

    compiled = torch.compile(numbers, backend="aot_eager")
    assert_trees_close(gradient(target, compiled, pose), gradient(target, numbers, pose))


def test_torch_autocast_leaves_cameras_and_projection_as_exact_as_they_are(on_torch):
    torch, target = on_torch
    scene = arrays(target, SCENE)
    expected = to_numpy(image_of(scene))
    with torch.autocast("cpu", torch.bfloat16):
        found = to_numpy(image_of(scene))
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-4)


def test_torch_updates_in_place_are_seen(on_torch):
    torch, target = on_torch
    scene = arrays(target, SCENE)
    image_of(scene)
    with torch.no_grad():
        scene["vertices"].mul_(0.5)
    smaller = arrays(target, {**SCENE, "vertices": 0.5 * SCENE["vertices"]})
    np.testing.assert_array_equal(to_numpy(image_of(scene)), to_numpy(image_of(smaller)))


def test_torch_records_are_arguments_of_its_transforms(on_torch):
    torch, target = on_torch
    scene, loss_weights = arrays(target, SCENE), arrays(target, WEIGHTS)
    part, camera = part_of(scene), camera_at(scene["eye"])

    def f(part, camera):
        return (rts.render(part, camera, SIZE) * loss_weights).sum()

    by_part, by_camera = torch.func.grad(f, argnums=(0, 1))(part, camera)
    assert isinstance(by_part, Part) and isinstance(by_camera, Camera) and by_part.shader == "lambert"
    assert relative_error(to_numpy(by_part.transform), plain_gradient(target)["transform"]) < 1e-5
    assert relative_error(to_numpy(by_part.theta["vertices"]), plain_gradient(target)["vertices"]) < 1e-5

    sampled = rts.sample(part, camera, SIZE)
    frozen = torch.func.grad(lambda s, p: (rts.render_samples(s, p, camera) * loss_weights).sum(), argnums=1)(
        sampled, part
    )
    assert relative_error(to_numpy(frozen.transform), plain_gradient(target)["transform"]) < 1e-5

    cameras = Camera(*(torch.stack(m) for m in zip(*map(camera_at, arrays(target, EYES)), strict=True)))
    images = torch.func.vmap(lambda camera: rts.render(part, camera, SIZE))(cameras)
    np.testing.assert_allclose(to_numpy(images[0]), plain_image(target), rtol=0, atol=5e-6)


@pytest.mark.parametrize("target", DIFFERENTIABLE)
def test_records_survive_being_taken_apart_and_put_together(target):
    part = part_of(arrays(target, SCENE)).replace(cull="back")
    sampled = rts.sample(part, camera_at(arrays(target, SCENE["eye"])), SIZE, splatter=None)

    def again_from_leaves(record):
        if target == "jax":
            flat, structure = pytest.importorskip("jax").tree.flatten(record)
            return structure.unflatten(flat)
        from torch.utils import _pytree

        return _pytree.tree_unflatten(*_pytree.tree_flatten(record))

    for record in (part, part.replace(transform=None), sampled):
        again = again_from_leaves(record)
        assert type(again) is type(record)
        assert all(x is y for x, y in zip(leaves(again), leaves(record), strict=True))
    assert again.samples[0].centered is True
    again = again_from_leaves(part)
    assert (again.surface, again.shader, again.cull) == (MESH, "lambert", "back")


@pytest.mark.parametrize("target", ALL)
def test_rows_are_exact_or_padded_to_a_bucket(target):
    part, camera = arrays(target, (part_of(SCENE), camera_at(SCENE["eye"])))
    sampled = rts.sample(part, camera, SIZE, splatter=None)
    rows, covered = sampled.samples[0].ids.shape[0], int((sampled.row >= 0).sum())
    if target == "jax":
        powers = {2**n for n in range(10, 16)} | {3 * 2**n for n in range(9, 15)}
        assert rows == min(p for p in powers if p >= covered)
    else:
        assert rows == covered


def test_map_rows_is_the_function_of_all_rows():
    rows = np.arange(23, dtype=np.float32)
    for target in ALL:
        given = arrays(target, rows)
        found = rts.engine_of(given).map_rows(lambda x: 2 * x + 1, given, 5)
        np.testing.assert_array_equal(to_numpy(found), 2 * rows + 1)
