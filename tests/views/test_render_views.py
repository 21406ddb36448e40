"""Several views of a scene: what a loop gives, image by image and derivative by derivative; and what misuse is told."""

import threading
import time

import numpy as np
import pytest
from helpers import ALL, DIFFERENTIABLE, TORCH, arrays, box, icosphere, mesh_part, to_numpy

import rts
from rts import Camera
from rts.errors import EmptyImageWarning, InputError
from rts.sampling import picture as side_by_side
from rts.sampling import side_by_side as side_by_side_scenes
from rts.sampling.picture import Picture
from rts.scene.row_cameras import RowCameras
from rts.shading.shaders import Lambert

pytestmark = pytest.mark.rendering

SIZE = (20, 27)
EYES = ((0.7, 0.9, 3.2), (-2.0, 0.4, 2.5), (0.3, -1.5, -3.0))
CAMERAS = [Camera.look_at(eye, (0, 0, 0), fov_y=45) for eye in EYES]
OPTIONS = (
    {},
    {"layers": "auto"},
    {"supersample": 2},
    {"background": (0.2, 0.4, 1.0)},
    {"splatter": "multi", "sampler": "reference"},
)
WEIGHTS = np.random.default_rng(0).normal(size=(3, *SIZE, 4)).astype(np.float32)


def scene(shader="lambert"):
    """A sphere that a box passes through, and behind it another: several parts, hidden layers, crossings."""
    vertices, faces = box(0.6)
    behind = mesh_part(icosphere(1, 0.5, (0.5, 0.3, -0.9)), shader="silhouette")
    return [mesh_part(icosphere(1), shader=shader), mesh_part((vertices + 0.5, faces), shader="normals"), behind]


SCENES = pytest.mark.parametrize(
    "parts",
    [
        *(scene(), [part.replace(cull="back") for part in scene()], scene()[0]),
        *(scene("silhouette")[0], scene("silhouette")[0].replace(cull="back")),
    ],
    ids=["three", "three culled", "lambert", "silhouette", "culled"],
)


def looped(parts, cameras=CAMERAS, size=SIZE, **options):
    return np.stack([to_numpy(rts.render(parts, camera, size, **options)) for camera in cameras])


def batched(target, f):
    """`f` over a stack of its argument, by torch or in a program of jax."""
    if target == "jax":
        jax = pytest.importorskip("jax")
        return jax.jit(jax.vmap(f))
    return pytest.importorskip("torch").vmap(f)


# ------------------------------------------------------------------------------------------- what a loop gives


@pytest.mark.parametrize("options", OPTIONS, ids=str)
@SCENES
def test_numpy_views_are_those_of_a_loop_but_for_rounding(parts, options):
    found = rts.render_views(parts, CAMERAS, SIZE, **options)
    assert found.shape == (3, *SIZE, 4) and found.dtype == np.float32
    np.testing.assert_allclose(found, looped(parts, **options), rtol=0, atol=1e-5)


@pytest.mark.parametrize("options", OPTIONS, ids=str)
@SCENES
def test_torch_views_and_their_gradients_are_those_of_a_loop(parts, options):
    torch = pytest.importorskip("torch")
    weights, found = torch.tensor(WEIGHTS), []
    for together in (True, False):
        leaves = [torch.tensor(part.theta["vertices"], requires_grad=True) for part in parts_of(parts)]
        moved = [p.replace(theta={**p.theta, "vertices": v}) for p, v in zip(parts_of(parts), leaves, strict=True)]
        if together:
            images = rts.render_views(moved, CAMERAS, SIZE, **options)
        else:
            images = torch.stack([rts.render(moved, camera, SIZE, **options) for camera in CAMERAS])
        found.append((images.detach(), *torch.autograd.grad((images * weights).sum(), leaves)))
    for a, b in zip(*found, strict=True):
        assert b.abs().max() > 0.5
        torch.testing.assert_close(a, b, rtol=0, atol=1e-4 * float(b.abs().max()))


def parts_of(parts):
    return parts if isinstance(parts, list) else [parts]


def test_derivatives_along_cameras_and_poses_are_those_of_a_loop_but_for_rounding():
    torch = pytest.importorskip("torch")
    part = scene()[0]

    def images(x, together):
        cameras = [Camera.look_at(x[b], torch.zeros(3, dtype=x.dtype), fov_y=45) for b in range(3)]
        moved = part.replace(transform=rts.rigid(x[3:].reshape(-1)))
        if together:
            return rts.render_views(moved, Camera.stack(cameras), SIZE)
        return torch.stack([rts.render(moved, camera, SIZE) for camera in cameras])

    x = torch.tensor([*EYES, (0.1, 0.2, 0.0), (0.0, 0.1, -0.1)], dtype=torch.float64)
    along = torch.ones_like(x)
    found, expected = (torch.func.jvp(lambda x, t=t: images(x, t), (x,), (along,)) for t in (True, False))
    weights = torch.tensor(WEIGHTS, dtype=torch.float64)
    pulled = []
    for together in (True, False):  # Plain autograd takes the way on which views are put together.
        x = x.detach().requires_grad_(True)
        pulled.append(torch.autograd.grad((images(x, together) * weights).sum(), x)[0])
    for a, b in (*zip(found, expected, strict=True), pulled):
        assert b.abs().max() > 0.5
        torch.testing.assert_close(a, b, rtol=0, atol=1e-6 * float(b.abs().max()))


@pytest.mark.thorough
def test_numpy_scenes_whose_shaders_hold_traced_arrays_are_differentiated():
    jax = pytest.importorskip("jax")

    def loss(w):
        def shader(theta, gbuffer, camera):
            return jax.numpy.concatenate(
                [w * gbuffer["position"], jax.numpy.ones_like(gbuffer["position"][:, :1])], axis=1
            )

        return (rts.render_views(scene()[0].replace(shader=shader), CAMERAS, SIZE) * WEIGHTS).sum()

    w = jax.numpy.ones(3)
    found, step = jax.grad(loss)(w), 2.0
    expected = [(loss(w + step * d) - loss(w - step * d)) / (2 * step) for d in np.eye(3, dtype=np.float32)]
    np.testing.assert_allclose(found, expected, rtol=1e-3, atol=1e-2)


@pytest.mark.filterwarnings("ignore:.* samples find no room:rts.errors.InputWarning")
def test_what_does_not_fit_is_left_out_of_its_own_view():
    jax = pytest.importorskip("jax")
    part = mesh_part(icosphere(1), shader="normals")
    cameras = [CAMERAS[0], *(Camera.look_at(np.array(eye) * 2, (0, 0, 0), fov_y=45) for eye in EYES[1:])]

    def images(vertices):
        return rts.render_views(part.replace(theta={"vertices": vertices}), cameras, SIZE, capacity=90)

    found = np.asarray(jax.jit(images)(jax.numpy.asarray(part.theta["vertices"])))
    whole = looped(part, cameras)
    assert 0.1 < found[0, ..., 3].sum() / whole[0, ..., 3].sum() < 0.9
    np.testing.assert_allclose(found[1:], whole[1:], atol=2e-5)


@pytest.mark.filterwarnings("ignore::rts.errors.InputWarning")  # A telephoto lens.
def test_views_are_the_same_on_any_number_of_threads_and_in_any_company(monkeypatch):
    found = []
    for threads in ("1", "2", "2"):
        monkeypatch.setenv("RTS_NUM_THREADS", threads)
        found.append(rts.render_views(scene(), CAMERAS, SIZE))
    for other in found[1:]:
        np.testing.assert_array_equal(found[0], other)
    # A view that is empty, and another that is far, are none of the others' business.
    away = Camera.look_at((0, 0, 3), (0, 0, 6), fov_y=45)
    far = Camera.look_at(np.array(EYES[0]) * 300, (0, 0, 0), fov_y=0.15, far=5000)
    with pytest.warns(EmptyImageWarning, match="view 1"):
        more = rts.render_views(scene(), [CAMERAS[0], away, far, *CAMERAS[1:]], SIZE)
    np.testing.assert_allclose(more[[0, 3, 4]], found[0], rtol=0, atol=1e-5)


@pytest.mark.parametrize("target", TORCH)
def test_functions_of_users_are_called_by_one_thread_at_a_time(target, monkeypatch):
    monkeypatch.setenv("RTS_NUM_THREADS", "2")
    inside, most = set(), 0

    def ball(theta, points):
        nonlocal most
        inside.add(threading.get_ident())
        most = max(most, len(inside))
        time.sleep(0.01)
        distance = (points**2).sum(1) ** 0.5 - theta["radius"]
        inside.discard(threading.get_ident())
        return distance

    theta = arrays(target, {"radius": np.full((), 0.8)})
    surface = rts.Isosurface(((-1, -1, -1), (1, 1, 1)), f=ball, shape=(9, 9, 9))
    rts.render_views(rts.Part(surface, theta, "silhouette"), CAMERAS, SIZE)
    assert most == 1


def test_a_prepared_scene_and_samplers_that_take_views_in_turn():
    pytest.importorskip("embreex")
    part = scene()[0]
    expected = looped(part, sampler="embree")
    for found in (
        rts.render_views(rts.prepare(part, "embree"), CAMERAS, SIZE),
        rts.render_views(part, CAMERAS, SIZE, sampler="embree"),
    ):
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-5)
    found = rts.render_views(rts.prepare(part), CAMERAS, SIZE)
    np.testing.assert_allclose(found, looped(part), rtol=0, atol=1e-5)


# ------------------------------------------------------------------------------------------ shaders of several views

LIGHT = {"direction": np.float32([[0, 1, 1], [1, 0, 0.5]]), "ambient": np.float32(0.1)}


@pytest.mark.parametrize("target", ALL)
def test_cameras_of_rows_are_those_of_their_views(target):
    flat = Camera.orthographic((0, 2, 3), (0, 0, 0), height=3, near=1, far=8)
    # Planes that float32 tells apart; to it the default far plane is at infinity.
    first, last = (Camera.look_at(eye, (0, 0, 0), fov_y=45, far=30) for eye in EYES[:2])
    cameras = [camera.for_size(SIZE) for camera in (first, flat, last)]
    number = np.array([1, 1, 3, 3, 3, 0], np.int32)  # Nothing is seen in the second, and one row is not used.
    points, direction = np.random.default_rng(1).normal(size=(6, 3)).astype(np.float32), (0.3, -0.2, 0.9)
    rows = RowCameras.of(arrays(target, cameras), arrays(target, number))
    found = [rows.toward(arrays(target, points)), rows.to_world(direction), rows.depth(arrays(target, points))]
    found = [to_numpy(x) for x in (*found, *rows.depth_range())]
    for n in range(5):
        camera, point = cameras[number[n] - 1], points[n : n + 1]
        eye = np.linalg.inv(camera.view)[:3, 3]
        near, far = camera.depth_range()
        expected = eye - point[0], camera.view[:3, :3].T @ direction, camera.project(point, SIZE)[0, 2], near, far
        np.testing.assert_allclose(found[1][n], expected[1] / np.linalg.norm(expected[1]), atol=1e-6)
        np.testing.assert_allclose(camera.to_world(direction), found[1][n], atol=1e-6)
        np.testing.assert_allclose(camera.depth(point)[0], expected[2])
        for i in (0, 2, 3, 4):
            np.testing.assert_allclose(found[i][n], expected[i], rtol=1e-4, atol=1e-5)
    rows = RowCameras.of(arrays(target, cameras), arrays(target, np.full(6, 2, np.int32)))
    np.testing.assert_allclose(to_numpy(rows.toward(arrays(target, points))), flat.toward(points), atol=1e-5)


@pytest.mark.parametrize("shader", ["depth", "blinn_phong", "lambert"])
def test_shaded_views_move_with_cameras_and_lights_as_in_a_loop(shader):
    torch = pytest.importorskip("torch")
    found = []
    for together in (True, False):
        eyes, light = (torch.tensor(x, requires_grad=True) for x in (np.float32(EYES), LIGHT["direction"]))
        theta = scene()[0].theta if shader == "depth" else scene()[0].theta | {"light": LIGHT | {"direction": light}}
        cameras = [Camera.look_at(eye, torch.zeros(3), fov_y=45) for eye in eyes]
        part = scene(shader)[0].replace(theta=theta)
        if together:
            images = rts.render_views(part, cameras, SIZE)
        else:
            images = torch.stack([rts.render(part, camera, SIZE) for camera in cameras])
        leaves = [eyes] if shader == "depth" else [eyes, light]
        found.append((images.detach(), *torch.autograd.grad((images * torch.tensor(WEIGHTS)).sum(), leaves)))
    for a, b in zip(*found, strict=True):
        torch.testing.assert_close(a, b, rtol=0, atol=1e-4 * float(b.abs().max()))


@pytest.mark.parametrize("capacity", [None, 700])
@pytest.mark.thorough
def test_compiled_views_are_shaded_together_in_pieces_of_rows_in_use(capacity, monkeypatch):
    jax = pytest.importorskip("jax")
    torch = pytest.importorskip("torch")
    rows_in_use = pytest.importorskip("rts_backends.jax_engine.row_blocks")
    monkeypatch.setattr(rows_in_use, "LEAST", 1)
    monkeypatch.setattr(rows_in_use, "PIECE", 128)
    calls, part = [], mesh_part(icosphere(1))

    class Counted(Lambert):
        takes_views, reads = True, Lambert.reads

        def __call__(self, theta, gbuffer, camera):
            calls.append(type(camera))
            return super().__call__(theta, gbuffer, camera)

    def loss(vertices, pose, weights, **options):
        moved = part.replace(theta={"vertices": vertices}, transform=rts.rigid(pose), shader=Counted())
        images = rts.render_views(moved, CAMERAS, SIZE, **options)
        return (images * weights).sum()

    pose = np.float32([0.1, 0.2, 0.0, 0.0, 0.1, 0.0])
    given = [torch.tensor(x, requires_grad=True) for x in (part.theta["vertices"], pose)]
    expected = torch.autograd.grad(loss(*given, torch.tensor(WEIGHTS)), given)
    gradient_of = jax.jit(jax.grad(lambda v, p: loss(v, p, WEIGHTS, capacity=capacity), (0, 1)))
    found = gradient_of(*arrays("jax", [part.theta["vertices"], pose]))
    assert set(calls) == {RowCameras}
    for a, b in zip(found, expected, strict=True):
        np.testing.assert_allclose(a, b, atol=1e-4 * float(b.abs().max()))


def test_several_parts_are_one_picture_in_programs_of_jax_too():
    jax = pytest.importorskip("jax")
    torch = pytest.importorskip("torch")

    def loss(vertices, weights):
        moved = [p.replace(theta=p.theta | {"vertices": v}) for p, v in zip(scene(), vertices, strict=True)]
        return (rts.render_views(moved, CAMERAS, SIZE) * weights).sum()

    given = [part.theta["vertices"] for part in scene()]
    leaves = [torch.tensor(x, requires_grad=True) for x in given]
    expected = torch.autograd.grad(loss(leaves, torch.tensor(WEIGHTS)), leaves)
    found = jax.jit(jax.grad(lambda x: loss(x, WEIGHTS)))(arrays("jax", given))
    for a, b in zip(found, expected, strict=True):
        np.testing.assert_allclose(a, b, atol=1e-4 * float(b.abs().max()))


@pytest.mark.parametrize("target", DIFFERENTIABLE)
def test_several_parts_in_a_batch_are_those_of_a_loop(target):
    parts, sizes = scene()[:2], np.float32([1.0, 0.7])

    def images(size):
        own = [part.replace(theta={"vertices": size * arrays(target, part.theta["vertices"])}) for part in parts]
        return rts.render_views(own, CAMERAS, SIZE)

    found = to_numpy(batched(target, images)(arrays(target, sizes)))
    for size, own in zip(sizes, found, strict=True):
        expected = looped([part.replace(theta={"vertices": size * part.theta["vertices"]}) for part in parts])
        np.testing.assert_allclose(own, expected, atol=2e-5)


def test_shaders_are_given_one_camera_unless_they_take_views_and_say_what_they_read():
    calls = []

    def shader(theta, gbuffer, camera):
        calls.append(type(camera))
        position = gbuffer["position"]
        return np.concatenate([np.abs(position) / 2, np.ones_like(position[:, :1])], axis=1)

    expected = looped(part := mesh_part(icosphere(1), shader=shader), layers=2)
    for promises, kinds in (
        ({}, [Camera] * 3),
        ({"takes_views": True}, [Camera] * 3),
        ({"takes_views": True, "reads": ("uv_footprint",)}, [RowCameras]),
        ({"takes_views": True, "reads": ()}, [RowCameras]),
    ):
        vars(shader).update(promises)
        calls.clear()
        np.testing.assert_allclose(rts.render_views(part, CAMERAS, SIZE, layers=2), expected, rtol=0, atol=1e-5)
        assert calls == kinds


class Dimmed(rts.plugin("rts.shaders", "lambert")):
    """A shader that reads what only one camera has."""

    def __call__(self, theta, gbuffer, camera):
        return super().__call__(theta, gbuffer, camera) * np.float32(1 / (1 + abs(camera.view[2, 3])))


def test_promises_of_a_call_that_is_overridden_hold_no_more():
    part = mesh_part(icosphere(1), shader=Dimmed())
    np.testing.assert_allclose(rts.render_views(part, CAMERAS, SIZE), looped(part), rtol=0, atol=1e-5)
    again = type("Again", (Dimmed,), {"takes_views": True, "reads": Dimmed.reads})
    with pytest.raises(AttributeError, match="view of a camera was asked for by a shader that takes_views"):
        rts.render_views(part.replace(shader=again()), CAMERAS, SIZE)


# ----------------------------------------------------------------------------------------------- how it is done


def test_the_surface_is_evaluated_once_for_all_views_and_threads_share_the_sampling(monkeypatch):
    torch = pytest.importorskip("torch")
    monkeypatch.setenv("RTS_NUM_THREADS", "2")
    monkeypatch.setattr(side_by_side_scenes, "MOST", 0)  # Small meshes are drawn at once.
    part = scene()[0]
    part = part.replace(theta={"vertices": torch.tensor(part.theta["vertices"])})
    surface, sampler = type(part.surface), rts.plugin("samplers", "raster")
    calls, threads, both = [], set(), threading.Barrier(2, timeout=30)
    evaluate, rasterize = surface.evaluate, sampler.rasterize

    def drawn(self, *given):
        if len(threads) < 2 and threading.get_ident() not in threads:
            threads.add(threading.get_ident())
            both.wait()  # It is broken if one thread draws them all.
        return rasterize(self, *given)

    monkeypatch.setattr(surface, "evaluate", lambda *given: calls.append(given) or evaluate(*given))
    monkeypatch.setattr(sampler, "rasterize", drawn)
    rts.render_views(part, CAMERAS, SIZE)
    assert len(calls) == 1 and len(threads) == 2


def test_an_error_is_that_of_the_first_view_that_fails():
    part = scene()[0]
    broken = [CAMERAS[0], *(c.replace(view=c.view * np.nan) for c in CAMERAS[1:])]
    with pytest.raises(InputError) as alone:
        rts.render(part, broken[1], SIZE)
    with pytest.raises(InputError) as together:
        rts.render_views(part, broken, SIZE)
    assert str(together.value) == str(alone.value)


# ---------------------------------------------------------------------------------------------- cameras, vmap


@pytest.mark.parametrize("target", DIFFERENTIABLE)
def test_vmap_over_cameras_is_what_render_views_gives(target):
    part = arrays(target, mesh_part(icosphere(1), shader="normals"))
    stacked = arrays(target, Camera.stack([camera.for_size(SIZE) for camera in CAMERAS]))
    found = batched(target, lambda camera: rts.render(part, camera, SIZE))(stacked)
    np.testing.assert_allclose(to_numpy(found), to_numpy(rts.render_views(part, stacked, SIZE)), atol=2e-5)


@pytest.mark.parametrize("target", ALL)
def test_a_stack_of_cameras_comes_apart_again(target):
    cameras = arrays(target, CAMERAS)
    stacked = Camera.stack(cameras)
    assert stacked.is_stacked and stacked.view.shape == stacked.projection.shape == (3, 4, 4)
    assert stacked.unstack() == cameras and not cameras[0].is_stacked
    one = stacked.replace(projection=cameras[0].projection)
    assert all(np.array_equal(to_numpy(c.projection), to_numpy(cameras[0].projection)) for c in one.unstack())


# ---------------------------------------------------------------------------------------- what users are told


def test_each_view_may_have_a_background_and_an_empty_one_is_named():
    part = scene()[0]
    backgrounds = np.random.default_rng(1).random((3, *SIZE, 3)).astype(np.float32)
    found = rts.render_views(part, CAMERAS, SIZE, background=backgrounds)
    for b, camera in enumerate(CAMERAS):
        expected = rts.render(part, camera, SIZE, background=backgrounds[b])
        np.testing.assert_allclose(found[b], expected, rtol=0, atol=1e-5)
    away = Camera.look_at((0, 0, 3), (0, 0, 6), fov_y=45)
    with pytest.warns(EmptyImageWarning, match="nothing is seen in view 1: .*behind the camera"):
        rts.render_views(part, [CAMERAS[0], away], SIZE)


def test_misuse_is_told_what_to_call():
    part, stacked = scene()[0], Camera.stack(CAMERAS)
    for camera, words in ((CAMERAS, "rts.render_views"), (stacked, r"\(3, 4, 4\).*rts.render_views")):
        with pytest.raises(InputError, match=words):
            rts.render(part, camera, SIZE)
    with pytest.raises(InputError, match="the transform of part 0.*rts.render_views"):
        rts.render(part.replace(transform=np.stack([np.eye(4)] * 3)), CAMERAS[0], SIZE)
    with pytest.raises(InputError, match="one view"):
        rts.render_views(part, CAMERAS[0], SIZE)
    for wrong in ([], [CAMERAS[0], None], None, [stacked]):
        with pytest.raises(InputError, match="cameras"):
            rts.render_views(part, wrong, SIZE)
    with pytest.raises(InputError, match="for_size"):
        Camera.stack([CAMERAS[0], CAMERAS[1].for_size(SIZE)])
    with pytest.raises(InputError, match="background"):
        rts.render_views(part, CAMERAS, SIZE, background=np.zeros((2, *SIZE, 3)))


# --------------------------------------------------------------------------------------------- residuals of views


def posed(pose):
    part = scene()[0]
    return part.replace(transform=rts.rigid(pose))


@pytest.mark.parametrize("kind", ["alpha", "color", "list"])
def test_residuals_of_views_are_those_of_each_and_so_are_normal_equations(kind):
    torch = pytest.importorskip("torch")
    images = rts.render_views(scene()[0], CAMERAS, SIZE)
    target = {"alpha": images[..., 3], "color": images[..., :3], "list": list(images)}[kind]
    weights = np.random.default_rng(2).random((3, *SIZE)).astype(np.float32)
    several = rts.ImageResiduals(posed, CAMERAS, SIZE, target, weights=weights)
    pose = torch.tensor([0.05, -0.03, 0.02, 0.01, 0.02, -0.03])
    one = [rts.ImageResiduals(posed, c, SIZE, target[b], weights=weights[b]) for b, c in enumerate(CAMERAS)]
    expected = torch.stack([r(pose) for r in one])
    torch.testing.assert_close(several(pose), expected, rtol=0, atol=2e-5)
    sums = [sum(x) / 3 for x in zip(*(r.normal_equations(pose) for r in one), strict=True)]
    for a, b in zip(several.normal_equations(pose), sums, strict=True):
        torch.testing.assert_close(a, b)
    value, _, slope = several.normal_equations(pose)
    assert float(value) == pytest.approx(float((expected**2).mean()), rel=1e-4)
    direct = torch.func.grad(lambda p: (several(p) ** 2).mean() / 2)(pose)
    torch.testing.assert_close(slope, direct, rtol=0, atol=1e-4 * float(direct.abs().max()))


def test_a_pose_is_fitted_to_views_with_a_schedule():
    torch = pytest.importorskip("torch")
    part = mesh_part(box(0.7), shader="silhouette")
    part = part.replace(theta={"vertices": part.theta["vertices"] * np.float32([1, 0.6, 0.3])})
    target = rts.render_views(part, CAMERAS, (32, 32), supersample=2)[..., 3]
    fitted = rts.ImageResiduals(
        lambda p: part.replace(transform=rts.rigid(p)), Camera.stack(CAMERAS), (32, 32), target, supersample=2
    )
    start = torch.tensor([0.15, -0.1, 0.1, 0.05, 0.05, -0.05])
    found = rts.fit(fitted, start, method="lm", schedule=rts.pyramid((32, 32)))
    assert float(found.parameters.abs().max()) < 0.02, found.reason


@pytest.mark.parametrize("target", ["numpy", *TORCH])
def test_shaders_are_not_asked_where_a_part_is_out_of_sight(target):
    def shader(theta, gbuffer, camera):
        xp = rts.namespace(position := gbuffer["position"])
        return xp.concat([position * 0 + xp.max(position), xp.ones_like(position[:, :1])], axis=1)

    vertices, faces = icosphere(1)
    parts = [mesh_part((arrays(target, vertices), faces), shader=shader), scene()[2]]
    cameras = [CAMERAS[0], Camera.look_at((0, 0, 3), (0, 0, 9)), CAMERAS[1]]
    with pytest.warns(EmptyImageWarning):
        found, expected = rts.render_views(parts, cameras, SIZE), looped(parts, cameras)
    np.testing.assert_allclose(to_numpy(found), expected, rtol=0, atol=1e-5)


def test_views_whose_shaders_read_other_attributes_may_be_shaded_at_once():
    def shader(theta, gbuffer, camera):
        towards = np.asarray(camera.view)[2, 2] > 0
        colors = 0.5 + 0.5 * gbuffer["normal"] if towards else np.full(gbuffer["position"].shape, 0.5, np.float32)
        return np.concatenate([colors, np.ones((len(colors), 1), np.float32)], axis=1)

    turns = np.linspace(0, 6, 12)
    cameras = [Camera.look_at((3 * np.sin(a), 0.5, -3 * np.cos(a)), (0, 0, 0), fov_y=45) for a in turns]
    part = mesh_part(icosphere(3), shader=shader)
    expected = looped(part, cameras)
    for _ in range(10):
        np.testing.assert_allclose(rts.render_views(part, cameras, SIZE), expected, rtol=0, atol=1e-5)


@pytest.mark.parametrize("view", [(1000, 20), (20, 1000), (1024, 1), (30, 34), (500, 500), (2000, 3)])
def test_no_picture_of_views_is_larger_than_it_may_be(view):
    most = side_by_side.at_once(view)
    for count in {1, 2, most // 3 + 1, most - 1 or 1, most}:
        picture = Picture.of(count, view)
        assert picture.down * picture.across >= count > (picture.down - 1) * picture.across
        assert all(size <= max(side_by_side.SIDE, n) for size, n in zip(picture.size, view, strict=True))
