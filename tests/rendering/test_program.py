"""`rts.program`: one program for each kind of arguments, with the values and derivatives of the function itself."""

from dataclasses import replace
from types import MappingProxyType

import numpy as np
import pytest
from helpers import icosphere, to_numpy

import rts

pytestmark = pytest.mark.rendering
BALL, FACES = icosphere(2)
CAMERA = rts.Camera.look_at((0, 0.5, 3), (0, 0, 0), fov_y=40)
SIZE = (20, 20)
COLORS = np.random.default_rng(0).uniform(0.2, 0.9, BALL.shape)
POSES = np.array([[0.0] * 6, [0.1, 0.2, 0, 0.1, -0.1, 0.3], [0.3, 0, 0.1, 2.0, -0.1, 0.3], [0, 0, 0, 9, 0, 0]])
"""The ball in the middle, nearer, across the border of the image, and outside."""
CARD = np.array([[-0.7, -0.9, 0.6], [1.1, -1, 0.4], [1, 0.9, -0.3]])


def torch_with_programs():
    torch = pytest.importorskip("torch")
    if not hasattr(torch.export.Dim, "AUTO"):
        pytest.skip(f"torch {torch.__version__} makes no programs")
    return torch


def listing():
    """A list, and a backend of torch that runs programs as they are and puts them there."""
    programs = []
    return programs, lambda graph, inputs: programs.append(graph) or graph


def engine_arrays(name, tree):
    if name == "numpy":
        return tree
    to = pytest.importorskip(name).asarray if name == "torch" else pytest.importorskip("jax").numpy.asarray
    return {k: to(np.float32(v)) for k, v in tree.items()}


def scene(arrays, part):
    ball = part.replace(theta={"vertices": arrays["vertices"], "colors": arrays["colors"]})
    glass = np.array([0.3, 0.5, 0.8, 0.6], np.float32)
    card = rts.Part(rts.Mesh([(0, 1, 2)]), {"vertices": np.float32(CARD), "color": glass}, "unlit")
    return [ball.replace(transform=rts.rigid(arrays["pose"])), card]


def image(arrays, part, sampled):
    return rts.render_samples(sampled, scene(arrays, part), CAMERA)


def loss(arrays, part, sampled):
    return (image(arrays, part, sampled) ** 2).sum()


def samples(arrays, part):
    return rts.sample(scene(arrays, part), CAMERA, SIZE)


def arrays_of(name, pose):
    return engine_arrays(name, {"vertices": BALL, "colors": COLORS, "pose": pose})


PART = rts.Part(rts.Mesh(FACES), {"vertices": BALL}, "lambert")


def test_numpy_calls_the_function():
    calls = []
    f = rts.program(lambda x: calls.append(x) or 2 * x)
    x = np.ones(3)
    assert (f(x) == 2).all() and calls == [x] and f.__name__ == "<lambda>"


def test_jax_compiles_the_function():
    jax = pytest.importorskip("jax")
    f = rts.program(lambda arrays, sampled: loss(arrays, PART, sampled))
    for pose in POSES[:2]:
        arrays = arrays_of("jax", pose)
        sampled = samples(arrays, PART)
        found, expected = (jax.value_and_grad(g)(arrays, sampled) for g in (f, lambda a, s: loss(a, PART, s)))
        np.testing.assert_allclose(found[0], expected[0], rtol=1e-5)
        for key, slope in expected[1].items():
            np.testing.assert_allclose(found[1][key], slope, atol=1e-4 * float(abs(slope).max()))


@pytest.mark.thorough
def test_torch_makes_one_program_of_any_number_of_samples():
    torch, (programs, backend) = torch_with_programs(), listing()

    # A part and a camera among the arguments, and a tree for a result.
    f = rts.program(lambda *args: {"loss": loss(*args), "image": image(*args)}, backend=backend)
    for number, pose in enumerate(POSES[:3]):
        arrays = {name: x.requires_grad_() for name, x in arrays_of("torch", pose).items()}
        sampled = samples(arrays, PART)
        made = f(arrays, PART, sampled)
        np.testing.assert_allclose(to_numpy(made["image"]), to_numpy(image(arrays, PART, sampled)), atol=1e-5)
        found = torch.autograd.grad(made["loss"], list(arrays.values()))
        expected = torch.autograd.grad(loss(arrays, PART, sampled), list(arrays.values()))
        for mine, other in zip(found, expected, strict=True):
            np.testing.assert_allclose(mine, other, atol=1e-4 * float(other.abs().max()) + 1e-7)
        assert len(programs) == 1, number


def test_torch_makes_a_program_for_each_kind_of_arguments():
    torch, (programs, backend) = torch_with_programs(), listing()

    f = rts.program(lambda x, sampled, factor: factor * x * sampled.samples[0].params.sum(), backend=backend)
    all_samples = [samples(arrays_of("torch", pose), PART) for pose in POSES]
    x = torch.ones(3, requires_grad=True)

    def checked(count, x, sampled, factor=2):
        expected = factor * x.detach() * sampled.samples[0].params.sum()
        found = f(x, sampled, factor)
        assert torch.equal(found.detach(), expected) and found.requires_grad == (
            x.requires_grad and torch.is_grad_enabled()
        )
        assert len(programs) == count

    for sampled in all_samples[:3]:
        checked(1, x, sampled)
    checked(2, x, all_samples[3])  # No sample of the ball: torch takes one row for another kind of length.
    checked(3, x, all_samples[0], factor=3)
    checked(4, torch.ones(4, requires_grad=True), all_samples[0])
    with torch.no_grad():
        checked(5, x, all_samples[0])
    checked(6, torch.ones(3), all_samples[0])
    checked(7, torch.ones(3, dtype=torch.float64), all_samples[0])
    assert f(np.ones(3), all_samples[0], 2).dtype == torch.float32 and len(programs) == 7  # As a tensor of float32.
    for sampled in all_samples:
        checked(7, x, sampled)


def test_torch_compiles_once_for_lengths_that_are_equal_at_first():
    """A stencil with as many entries of motions as of colours, and others."""
    torch, (programs, backend) = torch_with_programs(), listing()

    def total(sampled):
        return (sampled.stencil.color_weight**2).sum() + (sampled.stencil.motion_weight**2).sum()

    f, counts = rts.program(total, backend=backend), []
    for x in (0, 0.1, 0.9):
        sampled = rts.sample(PART.replace(transform=rts.rigid(torch.tensor([0, 0, 0, x, 0, -0.5]))), CAMERA, SIZE)
        stencil = sampled.stencil
        if x == 0:
            most = len(stencil.color_cell)
            names = "motion_cell", "motion_sample", "motion_weight", "motion_colors"
            stencil = replace(stencil, **{name: getattr(stencil, name)[:most].clone() for name in names})
            sampled = replace(sampled, stencil=stencil)
        assert f(sampled).item() == pytest.approx(total(sampled).item(), rel=1e-5)
        counts.append(len(stencil.color_cell) - len(stencil.motion_cell))
    assert counts[0] == 0 != counts[2] and len(programs) == 1


def test_torch_tells_values_that_are_no_tensors_apart():
    torch, (programs, backend) = torch_with_programs(), listing()
    x = torch.ones(2, dtype=torch.int64)
    f = rts.program(lambda tree, k: tree["x"] * k, backend=backend, dynamic=True)
    assert f({"x": x}, 2).dtype == torch.int64 and f({"x": x}, 2.0).dtype == torch.float32
    assert len(programs) == 2
    assert f(MappingProxyType({"x": x}), 2).tolist() == [2, 2] and len(programs) == 2
    for _ in range(2):
        assert f({"x": x}, float("nan")).isnan().all() and len(programs) == 3
    with torch.autocast("cpu", torch.bfloat16):
        f({"x": x}, 2)
    assert len(programs) == 4


def test_torch_traces_anew_where_a_function_asks_how_many_samples_there_are():
    torch = torch_with_programs()

    def doubled(sampled):
        params = sampled.samples[0].params
        return params.sum() * (2 if params.shape[0] > 100 else 1)

    f, counts = rts.program(doubled, backend="eager"), []
    for size in ((30, 30), (4, 4), (5, 5), (20, 20)):
        sampled = rts.sample(PART.replace(transform=rts.rigid(torch.zeros(6))), CAMERA, size)
        # Of one shape of cells, so that nothing else differs.
        (samples_of,), cells = sampled.samples, sampled.cells.map(lambda x: x[..., :8, :8])
        sampled = replace(sampled, cells=cells, samples=(replace(samples_of, cells=cells),), stencil=None)
        assert f(sampled).item() == pytest.approx(doubled(sampled).item(), rel=1e-5)
        counts.append(len(sampled.samples[0].params))
    assert counts[0] > 100 > counts[1]


@pytest.mark.thorough
def test_torch_has_no_gradient_for_what_a_function_closes_over():
    torch_with_programs()
    arrays = arrays_of("torch", POSES[1])
    sampled, pose = samples(arrays, PART), arrays["pose"].clone().requires_grad_()
    f = rts.program(lambda s: loss({**arrays, "pose": pose}, PART, s), backend="eager")
    with pytest.raises(rts.InputError, match=r"closes over a tensor of shape \(6,\) that requires a gradient"):
        f(sampled)


def test_torch_refuses_a_function_that_samples():
    torch_with_programs()
    arrays = arrays_of("torch", POSES[1])
    f = rts.program(lambda a: rts.render(scene(a, PART), CAMERA, SIZE).sum(), backend="eager")
    with pytest.raises(rts.InputError, match="cannot trace the function of rts.program .* call rts.sample before it"):
        f(arrays)


def test_torch_passes_the_library_s_own_errors_on():
    torch_with_programs()
    arrays = arrays_of("torch", POSES[1])
    f = rts.program(lambda a: rts.rigid(a["pose"][:5]), backend="eager")
    with pytest.raises(rts.InputError, match="^pose .*expected"):
        f(arrays)


def test_an_old_torch_is_refused(monkeypatch):
    torch = pytest.importorskip("torch")
    if hasattr(torch.export.Dim, "AUTO"):
        monkeypatch.delattr(torch.export.Dim, "AUTO")
    with pytest.raises(rts.InputError, match=r"rts.program needs torch 2.6 or later, and this is .*: call f itself"):
        rts.program(lambda x: x)(torch.ones(2))


def test_what_is_no_function_is_refused():
    with pytest.raises(rts.InputError, match="rts.program was given 3; expected a function"):
        rts.program(3)


@pytest.mark.parametrize("closed", ["vertices", "vertices and color"])
def test_torch_takes_tensors_that_a_function_closes_over(closed):
    torch = torch_with_programs()
    vertices = torch.tensor([[-1.0, -1, 0], [1, -1, 0], [0, 1, 0]])
    mesh, camera = rts.Mesh(np.array([[0, 1, 2]])), rts.Camera.look_at((0, 0, 3), (0, 0, 0), fov_y=40)
    own = torch.tensor([0.2, 0.4, 0.6])

    def drawn(sampled, color):
        part = rts.Part(mesh, {"vertices": vertices, "color": color if closed == "vertices" else own}, "lambert")
        return rts.render_samples(sampled, part, camera)

    part = rts.Part(mesh, {"vertices": vertices, "color": own}, "lambert")
    sampled = rts.sample(part, camera, (12, 12))
    program = rts.program(drawn, backend="eager")
    torch.testing.assert_close(program(sampled, own), drawn(sampled, own), atol=1e-6, rtol=0)
