"""Cells amid one colour are known without samples: image and derivatives are those of all samples."""

import itertools
import re
from functools import partial

import numpy as np
import pytest
from helpers import DIFFERENTIABLE, arrays, box, derivative, gradient, icosphere, mesh_part, quad, to_numpy

import rts
from rts import splatting
from rts.contracts.records import Cells
from rts.plugin_api.records import Splats
from rts.plugin_base import promised
from rts.rendering.samples import sample
from rts.sampling.interiors_loops import settle
from rts.splatting.layers import dilated
from rts_backends.fused import splatters as fused

pytestmark = pytest.mark.sampling

MESH = rts.plugin("rts.surfaces", "mesh")
CAMERA = rts.Camera.look_at((0.3, 0.4, 4.0), (0, 0, 0), fov_y=40)
SIZE = (60, 52)


def joined(*meshes):
    """One mesh of several."""
    first = np.cumsum([0, *(len(vertices) for vertices, _ in meshes)])
    faces = [triangles + n for (_, triangles), n in zip(meshes, first, strict=False)]
    return np.concatenate([vertices for vertices, _ in meshes]), np.concatenate(faces)


def at(*place):
    """The transform that moves a part there."""
    move = np.eye(4)
    move[:3, 3] = place
    return move


SCENES = {
    "sphere": icosphere(3, 0.9),
    "box before a card": joined(box(0.5), quad(-1.0, 1.0, -1.0, 1.0, -0.8)),
    "spheres that cross": joined(icosphere(2, 0.8), (icosphere(2, 0.8)[0] + np.float32((0.5, 0, 0)), icosphere(2)[1])),
    "cut by the frame": icosphere(3, 1.6),
}


class Twice(splatting.Visible):
    """A splatter with an image of its own."""

    def image(self, splats):
        return super().image(splats)


class Whole(fused.Visible):
    """A splatter that does not read which cells are settled."""

    fills_interiors = False


class Painted(rts.Shader):
    """One colour, an entry of θ."""

    opaque = uniform = True
    reads = ("color",)

    def __call__(self, theta, gbuffer, camera):
        xp, color = rts.namespace(theta["color"]), theta["color"]
        return xp.broadcast_to(xp.concat([color, xp.ones_like(color[:1])]), (gbuffer["position"].shape[0], 4))


def part_of(vertices, name, color=None, **options):
    theta = {"vertices": vertices} if color is None else {"vertices": vertices, "color": color}
    return rts.Part(MESH(SCENES[name][1]), theta, "silhouette" if color is None else Painted(), **options)


def sampled_image(part, settles, splatter="visible", **options):
    sampled = sample(part, CAMERA, SIZE, splatter=splatter, settles=settles, **options)
    return rts.render_samples(sampled, part, CAMERA, splatter=splatter), sampled


@pytest.mark.parametrize(("layers", "reach"), [(1, 3), (3, 3), (2, 1), (2, 2), (2, 4)])
def test_settled_cells_are_amid_fronts_and_what_is_left_out_is_far_from_all_others(layers, reach):
    rng = np.random.default_rng(layers)
    for shape in ((30, 41), (1, 9), (70, 3)):
        front = ~dilated(rng.random(shape) < 0.01)
        covered = np.logical_and.accumulate(np.stack([front, *(rng.random((layers - 1, *shape)) < 0.5)]), axis=0)
        kept = covered & np.stack([front, *(dilated(rng.random(shape) < 0.01) for _ in range(layers - 1))])
        depth = np.sort(rng.random(covered.shape).astype(np.float32), axis=0)
        loose = np.pad(~front | kept[1:].any(axis=0), 9, constant_values=True)
        loose = dilated(loose)
        expected = ~loose[9:-9, 9:-9]
        for _ in range(reach):
            loose = dilated(loose)
        left = kept & loose[9:-9, 9:-9]
        if kept.any():  # The farthest front stays, which sets the scale of depths.
            left[0].flat[np.where(kept[0], depth[0], -1).argmax()] = True
        found = settle(covered, depth, kept, reach)
        np.testing.assert_array_equal(found, expected)
        np.testing.assert_array_equal(kept, left)


@pytest.mark.parametrize("reach", [1, 4])
def test_only_cells_that_are_wanted_need_samples(reach):
    rng = np.random.default_rng(reach)
    for shape in ((30, 41), (1, 9), (70, 3)):
        covered = ~dilated(rng.random(shape) < 0.01)[None]
        wanted, depth = dilated(rng.random(shape) < 0.01), rng.random((1, *shape)).astype(np.float32)
        kept, expected = covered.copy(), ~dilated(np.pad(~covered[0], 1, constant_values=True))[1:-1, 1:-1]
        loose = np.pad(wanted & ~expected, 9)
        for _ in range(reach):
            loose = dilated(loose)
        left = covered & loose[9:-9, 9:-9]
        left.flat[np.where(covered, depth, -1).argmax()] = covered.any()
        np.testing.assert_array_equal(settle(covered, depth, kept, reach, wanted), expected)
        np.testing.assert_array_equal(kept, left)


@pytest.mark.parametrize("name", ["box before a card", "spheres that cross"])
@pytest.mark.parametrize(
    ("splatter", "layers"),
    [("single", 2), ("visible", 2), (splatting.Visible(), 2), ("single", 1), ("visible", 1)],
)
def test_so_are_those_of_active_pixels(name, splatter, layers):
    import torch

    results, counts = [], []
    for settles in (False, True):
        vertices = torch.tensor(SCENES[name][0], dtype=torch.float64, requires_grad=True)
        color = torch.tensor([0.3, 0.6, 0.2], dtype=torch.float64, requires_grad=True)
        part = part_of(vertices, name, color)
        image, sampled = sampled_image(part, settles, splatter, supersample=rts.Adaptive(4), layers=layers)
        weights = torch.from_numpy(np.random.default_rng(2).normal(size=(*SIZE, 4)))
        (image * weights).sum().backward()
        results.append((image.detach().numpy(), vertices.grad.numpy(), color.grad.numpy()))
        counts.append(len(sampled.fine.samples[0].ids))
    assert (sampled.fine.settled >= 0).any()
    assert counts[1] < counts[0]
    for whole, settled in zip(*results, strict=True):
        np.testing.assert_allclose(settled, whole, rtol=0, atol=1e-10 * max(1, np.abs(whole).max()))


def test_pixels_that_are_not_active_are_flat_where_hidden_samples_have_no_effect_on_them():
    part, behind = (part_of(SCENES["sphere"][0], "sphere", transform=at(*place)) for place in ((0, 0, 0), (0.5, 0, -2)))
    cases = {
        "visible": {},
        "single": {},
        "no room": {"capacity": 1500},
        "two": {"parts": [part, behind]},
        "shaded": {"parts": part.replace(shader="normals")},
    }
    flat = {}
    for case, given in cases.items():
        options = {"splatter": case if case == "single" else "visible", "supersample": rts.Adaptive(4), **given}
        sampled = sample(options.pop("parts", part), CAMERA, SIZE, settles=True, **options)
        flat[case] = sampled.fine.flat
    assert flat == {case: case in ("visible", "single") for case in cases}


@pytest.mark.parametrize("layers", [1, 2])
def test_the_farthest_front_stays_amid_one_colour(layers):
    # A card with a hole, through which another one is seen.
    sides, ends = [(-1.2, -0.4), (0.4, 1.2)], [(-1.2, 1.2), (-0.4, 0.4)]
    card = [quad(*x, *ends[0], 0.0) for x in sides] + [quad(*ends[1], *y, 0.0) for y in sides]
    vertices, faces = joined(*card, quad(-2.5, 2.5, -2.5, 2.5, -9.0))
    part = rts.Part(MESH(faces), {"vertices": vertices}, "silhouette")
    sampled = sample(part, CAMERA, SIZE, splatter="visible", settles=True, layers=layers)
    assert (sampled.settled >= 0).any() and sampled.depth.max() > 10


@pytest.mark.parametrize("target", DIFFERENTIABLE)
@pytest.mark.parametrize("splatter", ["single", "visible"])
@pytest.mark.parametrize("name", ["sphere", "box before a card"])
def test_the_image_and_its_derivatives_are_those_of_all_samples(name, splatter, target):
    vertices = SCENES[name][0].astype(np.float32)
    along = np.random.default_rng(1).normal(size=vertices.shape).astype(np.float32)
    weights = arrays(target, np.random.default_rng(0).normal(size=(*SIZE, 4)).astype(np.float32))
    found, counts, inner = [], [], slice(2, -2) if splatter != "visible" else slice(4, -4)
    for settles in (False, True):
        sampled = sampled_image(part_of(arrays(target, vertices), name), settles, splatter)[1]
        counts.append(int((to_numpy(sampled.row) >= 0).sum()))

        def image(v, sampled=sampled):
            return rts.render_samples(sampled, part_of(v, name), CAMERA, splatter=splatter)

        def loss(v, image=image):
            return (image(v) * weights).sum()

        v, t = arrays(target, vertices), arrays(target, along)
        found.append([*derivative(target, image, v, t), gradient(target, loss, v)])
    assert counts[1] < counts[0]
    (image, push, pull), (image_settled, push_settled, pull_settled) = [[to_numpy(x) for x in f] for f in found]
    # Sums of weights over their sum are one but for rounding, and do not change but for rounding.
    np.testing.assert_allclose(image_settled, image, rtol=0, atol=3e-7)
    np.testing.assert_allclose(push_settled, push, rtol=0, atol=1e-6 * np.abs(push).max())
    np.testing.assert_array_equal(push_settled[to_numpy(sampled.settled)[inner, inner] >= 0], 0)
    np.testing.assert_array_equal(pull_settled, pull)


@pytest.mark.parametrize("name", SCENES)
@pytest.mark.parametrize("make", [splatting.Visible, partial(splatting.Visible, rims=False)])
def test_the_specification_agrees(name, make):
    import torch

    results = []
    for settles in (False, True):
        vertices = torch.tensor(SCENES[name][0], dtype=torch.float64, requires_grad=True)
        color = torch.tensor([0.3, 0.6, 0.2], dtype=torch.float64, requires_grad=True)
        image, sampled = sampled_image(part_of(vertices, name, color), settles, make())
        weights = torch.from_numpy(np.random.default_rng(2).normal(size=(*SIZE, 4)))
        (image * weights).sum().backward()
        results.append((image.detach().numpy(), vertices.grad.numpy(), color.grad.numpy()))
    assert (sampled.settled >= 0).any()
    for whole, settled in zip(*results, strict=True):
        np.testing.assert_allclose(settled, whole, rtol=0, atol=1e-10 * max(1, np.abs(whole).max()))


SPHERE = icosphere(2, 0.8)


def test_fine_samples_see_a_gap_between_parts_that_coarse_ones_do_not():
    parts = [mesh_part(quad(*ends, -1.0, 1.0, 0.0)) for ends in ((-1.0, -0.02), (0.02, 1.0))]
    seen = rts.Camera.look_at((0, 0, 4.0), (0, 0, 0), fov_y=40)
    dense, adaptive = (
        rts.render(parts, seen, (40, 40), supersample=s, splatter="visible", layers=2) for s in (4, rts.Adaptive(4))
    )
    assert (dense[20, 18:22, 3] < 0.9).any()
    np.testing.assert_allclose(adaptive[5:-5, 15:25], dense[5:-5, 15:25], rtol=0, atol=1e-5)


class Stripes:
    def __call__(self, theta, gbuffer, camera):
        return np.concatenate([np.abs(gbuffer["position"]) / 2, np.ones_like(gbuffer["position"][:, :1])], axis=1)


@pytest.mark.parametrize("base", ["silhouette", "unlit"])
def test_what_has_its_call_from_elsewhere_promises_no_colour(base):
    kind = rts.plugin("rts.shaders", base)
    body = vars(Stripes)["__call__"]
    for shader in (type("Mixed", (Stripes, kind), {})(), type("Own", (kind,), {"__call__": body})()):
        assert not promised(shader, "uniform") and not promised(shader, "takes_views")
        alone = mesh_part(SPHERE, shader=shader)
        sampled = sample(alone, CAMERA, SIZE, splatter="visible", settles=True)
        assert sampled.settled is None


@pytest.mark.parametrize("target", DIFFERENTIABLE)
def test_parts_of_one_colour_are_settled_and_their_colour_has_its_gradient(target):
    weights = arrays(target, np.random.default_rng(0).normal(size=(*SIZE, 4)).astype(np.float32))
    start, found = arrays(target, np.array([0.3, 0.6, 0.2, 0.02, -0.01, 0.03], np.float32)), []
    for splatter in (fused.Visible(), Whole()):

        def loss(x, splatter=splatter):
            xp = rts.namespace(x)
            pose = xp.concat([x[3:], 0 * x[3:]])
            theta = {"vertices": SPHERE[0], "color": x[:3]}
            part = rts.Part(MESH(SPHERE[1]), theta, Painted(), rts.rigid(pose))
            return xp.sum(rts.render(part, CAMERA, SIZE, splatter=splatter) * weights)

        if target == "jax" and not found:
            import jax

            loss = jax.jit(loss)
        found.append(to_numpy(gradient(target, loss, start)))
    assert np.abs(found[0]).max() > 1
    np.testing.assert_allclose(found[0], found[1], rtol=0, atol=1e-5 * np.abs(found[1]).max())


@pytest.mark.parametrize(
    ("color", "supersample"), [*itertools.product([None, (0.3, 0.6, 0.2)], [1, 2, rts.Adaptive(3)])]
)
def test_normal_equations_are_those_of_all_samples(color, supersample, monkeypatch):
    import torch

    from rts.fitting import image_residuals

    parameters = {"pose": torch.tensor([0.1, 0.2, 0.0, 0.02, 0.0, 0.0], dtype=torch.float64)}
    if color:
        parameters["color"] = torch.tensor(color, dtype=torch.float64)

    def scene(p):
        return part_of(SCENES["sphere"][0], "sphere", p.get("color"), transform=rts.rigid(p["pose"]))

    target = np.random.default_rng(3).random((*SIZE, 4 if color else 1))
    sampled = sample(scene(parameters), CAMERA, SIZE, splatter="visible", supersample=supersample, settles=True)
    assert ((sampled.fine or sampled).settled >= 0).any()
    residuals = rts.ImageResiduals(scene, CAMERA, SIZE, target, supersample=supersample)
    found = residuals.normal_equations(parameters)
    monkeypatch.setattr(image_residuals, "sample", lambda *a, settles, **k: sample(*a, **k))
    for settled, whole in zip(found, residuals.normal_equations(parameters), strict=True):
        np.testing.assert_allclose(settled, whole, rtol=1e-9, atol=1e-12)


def test_where_all_is_covered_the_image_is_that_colour_and_nothing_moves():
    import torch

    vertices = torch.tensor(quad(-9, 9, -9, 9, 0.0)[0], requires_grad=True)
    part = rts.Part(MESH(quad(-9, 9, -9, 9, 0.0)[1]), {"vertices": vertices})
    image = rts.render(part, CAMERA, SIZE)
    image.sum().backward()
    assert (image == 1).all() and (vertices.grad == 0).all()


def test_the_number_of_threads_changes_nothing(monkeypatch):
    found = []
    for threads in ("1", "2"):
        monkeypatch.setenv("RTS_NUM_THREADS", threads)
        image, sampled = sampled_image(part_of(SCENES["box before a card"][0], "box before a card"), True)
        found.append([image, sampled.settled, sampled.row])
    for one, two in zip(*found, strict=True):
        np.testing.assert_array_equal(one, two)


def test_samples_are_left_out_only_where_nothing_can_depend_on_them():
    vertices = SCENES["sphere"][0]
    part, painted = part_of(vertices, "sphere"), part_of(vertices, "sphere", np.array([1.0, 0.0, 0.0]))
    normals = part.replace(shader="normals")
    settled = [
        sampled_image(scene, True, splatter)[1].settled is not None
        for scene, splatter in (
            (part, "visible"),
            (painted, "multi"),
            (normals, "visible"),
            ([part, part], "visible"),
            ([part, normals], "visible"),
            (part, Twice()),
            (part, "none"),
            (part, splatting.Visible(epsilon=0.0)),
        )
    ]
    assert settled == [True, False, False, False, False, False, False, False]


def test_what_needs_the_samples_that_were_left_out_is_refused():
    part = part_of(SCENES["sphere"][0], "sphere")
    sampled = sampled_image(part, True)[1]
    for given, splatter in ((part, "none"), (part, Twice()), (part.replace(shader="normals"), "visible")):
        with pytest.raises(rts.InputError, match="were left out"):
            rts.render_samples(sampled, given, CAMERA, splatter=splatter)


@pytest.mark.parametrize("make", [splatting.Visible, fused.Visible])
def test_settled_of_the_wrong_kind_is_refused(make):
    y, x = np.indices((6, 7))
    positions = np.stack([x + 0.5, y + 0.5, np.full(x.shape, 2.0)], -1).reshape(-1, 3)
    splats = Splats(positions, np.ones((42, 4)), Cells(np.arange(42, dtype=np.int32).reshape(1, 6, 7)))
    none = np.full((6, 7), -1, np.int32)
    wrong = {
        "settled has shape (6, 6); expected (6, 7)": none[:, :-1],
        "settled is bool; expected signed integers": none < 0,
        "settled is uint8; expected signed integers": (none + 1).astype(np.uint8),
        "settled refers to sample 42 of 42": none + 43,
        "settled refers to sample -2": none - 1,
    }
    for message, settled in wrong.items():
        with pytest.raises(rts.InputError, match=re.escape(message)):
            make().image(splats.replace(settled=settled))


def test_the_gradient_of_many_colors_is_that_of_the_specification():
    """Each of some hundred settled cells shows the colour of its own sample."""
    import torch

    y, x = np.indices((18, 20))
    positions = torch.from_numpy(np.stack([x + 0.5, y + 0.5, np.full(x.shape, 2.0)], -1).reshape(-1, 3))
    row = np.arange(360, dtype=np.int32).reshape(1, 18, 20)
    weights = torch.from_numpy(np.random.default_rng(0).normal(size=(14, 16, 4)))
    found = []
    for make in (splatting.Visible, fused.Visible):
        rgba = torch.ones((360, 4), dtype=torch.float64, requires_grad=True)
        splats = Splats(positions, rgba, Cells(torch.from_numpy(row), settled=torch.from_numpy(row[0])), border=2)
        found.append(torch.autograd.grad((make().cropped(splats) * weights).sum(), rgba)[0])
    expected = torch.zeros((18, 20, 4), dtype=torch.float64)
    expected[2:-2, 2:-2] = weights
    for gradient_of_colors in found:
        torch.testing.assert_close(gradient_of_colors, expected.reshape(360, 4))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"exit": np.array(10**8, np.int32)}, "exit refers to sample 100000000"),
        ({"facing": np.ones((2, 3, 3), np.int16)}, "facing has shape (2, 3, 3)"),
        ({"depth": np.ones((1, 64, 56), np.float32)}, "depth has shape (1, 64, 56)"),
        ({"exit": np.array(0, np.uint8)}, "exit is uint8; expected signed integers"),
        ({"settled": np.array(False)}, "settled is bool; expected signed integers"),
    ],
)
@pytest.mark.parametrize("supersample", [1, rts.Adaptive(2)])
def test_samples_that_do_not_fit_are_refused(changes, message, supersample):
    raster = type(rts.plugin("rts.samplers", "raster")())

    class Odd(raster):
        def sample(self, part, camera, size, layers, request):
            found = super().sample(part, camera, size, layers, request)
            shapes = {"exit": (1, *size)}
            odd = {k: np.broadcast_to(v, shapes.get(k, size)) if v.ndim == 0 else v for k, v in changes.items()}
            return found.replace(**odd)

    parts = [mesh_part(mesh) for mesh in (box(0.5), quad(-1.0, 1.0, -1.0, 1.0, -0.8))]
    with pytest.raises(rts.InputError, match=re.escape(message)):
        rts.render(parts, CAMERA, SIZE, sampler=Odd(), supersample=supersample, splatter="visible", layers=2)


@pytest.mark.parametrize("kind", ["single", "multi", "visible"])
def test_what_has_no_cotangent_is_not_pulled_and_what_has_no_weight_not_swept(kind):
    import torch

    vertices = torch.tensor(SCENES["sphere"][0], requires_grad=True)
    image = sampled_image(part_of(vertices, "sphere"), True, kind)[0]
    weights = torch.zeros((*SIZE, 4))
    weights[20:33, 5:20] = torch.from_numpy(np.random.default_rng(4).normal(size=(13, 15, 4)).astype(np.float32))
    (whole,) = torch.autograd.grad((image * (weights + 0)).sum(), vertices, retain_graph=True)
    # A gradient that is tiny instead of zero elsewhere is pulled there.
    tiny = torch.where(weights == 0, 1e-30, weights)
    (pulled,) = torch.autograd.grad((image * tiny).sum(), vertices)
    assert whole.abs().max() > 0
    np.testing.assert_allclose(whole, pulled, rtol=0, atol=1e-6 * float(whole.abs().max()))

    def scene(p):
        return part_of(SCENES["sphere"][0], "sphere", transform=rts.rigid(p["pose"]))

    parameters = {"pose": torch.tensor([0.1, 0.2, 0.0, 0.02, 0.0, 0.0], dtype=torch.float64)}
    target, mask = np.random.default_rng(3).random((*SIZE, 1)), weights[..., 3:].abs().numpy().astype(float)
    found = [
        rts.ImageResiduals(scene, CAMERA, SIZE, target, weights=w, splatter=kind).normal_equations(parameters)
        for w in (mask, np.where(mask == 0, 1e-30, mask))
    ]
    for masked, every in zip(*found, strict=True):
        np.testing.assert_allclose(masked, every, rtol=1e-9, atol=1e-15)


def test_a_class_with_its_own_sums_says_anew_whether_it_fills_interiors():
    class Wide(splatting.Single):
        def accumulate(self, splats):
            return super().accumulate(splats)

    class Sharp(Wide):
        fills_interiors = True

        def accumulate(self, splats):
            return super().accumulate(splats)

    kinds = splatting.Single, fused.Single, splatting.Visible, fused.Visible, Sharp
    assert all(promised(kind(), "fills_interiors") for kind in kinds)
    assert not any(promised(kind(), "fills_interiors") for kind in (Wide, splatting.Multi, fused.Multi))


@pytest.mark.filterwarnings("ignore:capacity is:rts.errors.InputWarning")
@pytest.mark.parametrize("capacity", [60, 100])
def test_where_samples_were_dropped_only_outlines_that_are_known_are_read(capacity, monkeypatch):
    """A settled cell without a sample beside a cell whose sample was dropped has no outline of its own."""
    torch = pytest.importorskip("torch")
    from rts_backends.fused import cells, outlines

    read = []

    class Poisoned:
        """NumPy whose new arrays hold NaN."""

        def __getattr__(self, name):
            return getattr(np, name)

        def empty(self, shape, dtype):
            return np.full(shape, np.nan, dtype) if np.dtype(dtype).kind == "f" else np.empty(shape, dtype)

    def pull(row, found, border, g, g_positions):
        for y in range(row.shape[1]):
            for d in range(found.offsets[y], found.offsets[y + 1]):
                for n in np.flatnonzero((found.gives[d] != outlines.NOTHING) & (found.gives[d] != outlines.JOINED)):
                    read.append(found.beta[y + 1 - n // 3, found.columns[d] + 1 - n % 3])

    monkeypatch.setattr(outlines, "pull", pull)
    monkeypatch.setattr(cells, "np", Poisoned())
    vertices, faces = icosphere(2)
    moved = torch.tensor(vertices, requires_grad=True)
    part = rts.Part(MESH(faces), {"vertices": moved}, "silhouette")
    rts.render(
        part,
        rts.Camera.look_at((0, 0.5, 3), (0, 0, 0), fov_y=45),
        (20, 27),
        capacity=capacity,
        splatter="visible",
        layers=2,
    ).sum().backward()
    assert len(read) > 20 and np.isfinite(read).all()
