"""Compiled projection and interpolation in torch: the same as in plain torch, in every transform."""

import importlib
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

torch = pytest.importorskip("torch")


import rts  # noqa: E402
from rts.operations.combine import interpolate  # noqa: E402
from rts.operations.projection import projective_map  # noqa: E402

pytestmark = pytest.mark.engines

ROWS, COLUMN = 6, 2


def maps(*batch, dtype=torch.float64, count=7):
    rng = np.random.default_rng(0)
    rows = rng.normal(size=(*batch, 4, 4))
    rows[..., 2, 3] += 6
    return torch.tensor(rows, dtype=dtype), torch.tensor(rng.normal(size=(*batch, count, 3)), dtype=dtype)


def specified_projection(rows, points):
    x, y, w, z = torch.addmm(rows[:, 3], points, rows[:, :3].T).unbind(1)
    safe = torch.where(w == 0, torch.ones_like(w), w)
    return torch.stack([x / safe, y / safe, z], dim=1)


def corners(*batch, dtype=torch.float64, count=7):
    rng = np.random.default_rng(0)
    sizes = (*batch, ROWS, 3), (*batch, count, 2)
    return tuple(torch.tensor(rng.normal(size=size), dtype=dtype) for size in sizes)


def ids(count):
    return torch.tensor(np.random.default_rng(2).integers(0, ROWS, (count, COLUMN + 4)), dtype=torch.int32)


def interpolated(rows, weights):
    return interpolate(rows, ids(weights.shape[-2]), COLUMN, weights)


def plainly_interpolated(rows, weights):
    a, b, c = (rows[ids(weights.shape[-2])[:, COLUMN + i].long()] for i in range(3))
    return c + weights[:, :1] * (a - c) + weights[:, 1:] * (b - c)


@pytest.fixture(params=["projection", "interpolation"])
def case(request):
    """The compiled function, the same in plain torch, and what gives arguments."""
    if request.param == "projection":
        return projective_map, specified_projection, maps
    return interpolated, plainly_interpolated, corners


def weighted(f):
    weights = torch.tensor(np.random.default_rng(1).normal(size=(7, 3)))
    return lambda first, second: (f(first, second) ** 2 * weights).sum()


@pytest.mark.parametrize("dtype, tolerance", [(torch.float32, 1e-5), (torch.float64, 1e-12)])
def test_values_and_gradients_of_many(case, dtype, tolerance):
    f, plain, given = case
    args = given(dtype=dtype, count=20000)
    torch.testing.assert_close(f(*args), plain(*args), rtol=tolerance, atol=tolerance)
    weights = torch.rand(20000, 3, dtype=dtype)
    found, expected = (torch.func.grad(lambda a, b, f=f: (f(a, b) * weights).sum(), (0, 1))(*args) for f in (f, plain))
    for a, b in zip(found, expected, strict=True):
        torch.testing.assert_close(a, b, rtol=100 * tolerance, atol=100 * tolerance * float(b.abs().max()))


def test_both_modes_and_second_derivatives_by_finite_differences(case):
    f, _, given = case
    first, second = (x.requires_grad_(True) for x in given())
    assert torch.autograd.gradcheck(f, (first, second), check_forward_ad=True)
    assert torch.autograd.gradgradcheck(f, (first, second))
    for of_one, x in ((lambda a: f(a, second.detach()), first), (lambda b: f(first.detach(), b), second)):
        assert torch.autograd.gradcheck(of_one, x, check_forward_ad=True, check_batched_forward_grad=True)
        assert torch.autograd.gradgradcheck(of_one, x)


@pytest.mark.parametrize(
    "transform",
    [
        torch.func.grad,
        torch.func.hessian,
        lambda f: torch.func.jacfwd(torch.func.grad(f)),
        lambda f: torch.func.jacrev(torch.func.jacfwd(f)),
        torch.func.jacfwd,
        lambda f: torch.func.jacfwd(torch.func.jacfwd(f)),
    ],
    ids=["grad", "hessian", "jacfwd grad", "jacrev jacfwd", "jacfwd", "jacfwd jacfwd"],
)
def test_transforms_agree_with_plain_torch(case, transform):
    *functions, given = case
    first, second = given()
    for of_one, at in ((lambda g: lambda a: g(a, second), first), (lambda g: lambda b: g(first, b), second)):
        found, expected = (transform(of_one(weighted(g)))(at) for g in functions)
        torch.testing.assert_close(found, expected)


def test_batches(case):
    *functions, given = case
    first, second = given(3)
    one = given()
    for batch, dims in (((first, second), (0, 0)), ((first, one[1]), (0, None)), ((one[0], second), (None, 0))):
        for of in (lambda f: f, lambda f: torch.func.grad(weighted(f), (0, 1))):
            found, expected = (torch.vmap(of(f), dims)(*batch) for f in functions)
            torch.testing.assert_close(found, expected)


def test_the_older_batches_of_gradients(case):
    *functions, given = case
    args = [x.requires_grad_(True) for x in given()]
    along = torch.rand(4, 7, 3, dtype=torch.float64)
    found, expected = (torch.autograd.grad(f(*args), args, along, is_grads_batched=True) for f in functions)
    torch.testing.assert_close(found, expected)


def test_batches_of_ids():
    rows, weights = corners()
    batch = torch.stack([ids(7), ids(7).flip(0)])
    found = torch.vmap(lambda i: torch.func.grad(lambda r: interpolate(r, i, COLUMN, weights).square().sum())(rows))(
        batch
    )
    for one, i in zip(found, batch, strict=True):
        expected = torch.func.grad(lambda r, i=i: interpolate(r, i, COLUMN, weights).square().sum())(rows)
        torch.testing.assert_close(one, expected)


@pytest.mark.parametrize("in_dims", [(0, 0), (0, None), (None, 0)])
def test_rows_are_taken_by_indices_of_32_bits_in_batches(in_dims):
    rows, index = torch.rand(2, 5, 3), torch.tensor([[4, 0, -1], [2, 2, 1]], dtype=torch.int32)
    xp = rts.namespace(rows)

    def gradient(rows, index):
        return torch.func.grad(lambda rows: xp.take(rows, index, axis=0).square().sum())(rows)

    args = [x if dim == 0 else x[0] for x, dim in zip((rows, index), in_dims, strict=True)]
    found = torch.vmap(gradient, in_dims)(*args)
    expected = [gradient(*(x[i] if d == 0 else x for x, d in zip(args, in_dims, strict=True))) for i in range(2)]
    torch.testing.assert_close(found, torch.stack(expected))


def test_points_without_an_image_are_finite_with_finite_gradients():
    rows, points = maps()
    points[0] = 0
    rows[2, 3] = 0
    rows, points = rows.requires_grad_(True), points.requires_grad_(True)
    out = projective_map(rows, points)
    out.sum().backward()
    assert out.isfinite().all() and rows.grad.isfinite().all() and points.grad.isfinite().all()


CALLS = {
    "backward": lambda f, pose: torch.autograd.grad(f(pose).square().mean(), pose),
    "grad": lambda f, pose: torch.func.grad(lambda x: f(x).square().mean())(pose.detach()),
    "jvp": lambda f, pose: torch.func.jvp(f, (pose.detach(),), (pose.detach(),)),
    "vmap": lambda f, pose: torch.vmap(f)(torch.stack([pose, 2 * pose]).detach()),
    "vmap of grad": lambda f, pose: torch.vmap(torch.func.grad(lambda x: f(x).sum()))(pose.detach()[None]),
    "is_grads_batched": lambda f, pose: torch.autograd.grad(
        f(pose)[4:6, 4, 3], pose, torch.eye(2), is_grads_batched=True
    ),
}


@pytest.mark.thorough
@pytest.mark.parametrize("surface", ["mesh", "sdf"])
def test_without_private_names_values_and_gradients_are_the_same(surface, monkeypatch):
    private = pytest.importorskip("rts_backends.torch_engine.torch_internals")
    part = rts.plugin("surfaces", surface).example()

    def image(pose):
        return rts.render(
            part.replace(transform=rts.rigid(pose)), rts.Camera.look_at((1, 2, 3), (0, 0, 0), fov_y=50), (12, 12)
        )

    def found():
        pose = torch.full((6,), 0.1, requires_grad=True)
        return {name: call(image, pose) for name, call in CALLS.items()}

    expected = found()
    with monkeypatch.context() as patch:
        patch.delattr(torch._C._functorch, "is_legacy_batchedtensor")
        importlib.reload(private)
        patch.setattr(private, "forward_level", lambda: 0)
        assert private.current_level() == 0
        less = found()
    importlib.reload(private)
    assert private.current_level() is None
    torch.testing.assert_close(less, expected)


def test_samples_of_another_mesh_are_one_clear_error():
    rows, weights = corners()
    with pytest.raises(rts.InputError, match="refer to row 5 of 3 rows; sample this surface anew"):
        interpolate(rows[:3], torch.full((7, 5), 5), COLUMN, weights)
    with pytest.raises(rts.InputError, match="row -1 of 6 rows"):
        interpolate(rows, torch.full((7, 5), -1), COLUMN, weights)
    with pytest.raises(rts.InputError, match=r"ids of shape \(7, 3\).*expected \(N, 5\)"):
        interpolate(rows, torch.zeros((7, 3), dtype=torch.int32), COLUMN, weights)


def test_double_vertices_take_compiled_code_with_single_weights():
    rows, weights = corners()
    found = interpolated(rows, weights.float())
    assert found.dtype == torch.float64
    torch.testing.assert_close(found, plainly_interpolated(rows, weights.float().double()), rtol=1e-14, atol=1e-14)


def test_gradients_do_not_depend_on_the_number_of_threads(case, monkeypatch):
    f, _, given = case
    args = given(dtype=torch.float32, count=50000)
    found = []
    for threads in ("1", "2"):
        monkeypatch.setenv("RTS_NUM_THREADS", threads)
        found.append(torch.func.grad(lambda a, b: f(a, b).square().mean(), (0, 1))(*args))
    assert all(map(torch.equal, *found))


RESIDUALS = """
import numpy as np, torch, rts
part, camera = rts.Mesh.example(), rts.Camera.look_at((0.4, 0.5, 4), (0, 0, 0))
for target in (np.ones((12, 16), np.float32), torch.ones(12, 16)):
    compare = rts.ImageResiduals(lambda pose: part.replace(transform=rts.rigid(pose)), camera, (12, 16), target)
    found = [compare.loss(compare(pose)) for pose in (torch.zeros(6), np.zeros(6, np.float32))]
    assert abs(float(found[0]) - float(found[1])) < 1e-6, found
    assert compare(np.zeros(6, np.float32)).shape == (12, 16)
    rts.fit(compare, torch.zeros(6), steps=1)
"""
KIT = ["pytest", "-q", "-o", "filterwarnings=", "-p", "no:cacheprovider", "tests/plugin_example/tests", "-k"]


@pytest.mark.parametrize(
    "command", [["-c", RESIDUALS], ["-m", *KIT, "TestHeightfield and frozen"]], ids=["residuals", "a plugin's kit"]
)
@pytest.mark.thorough
def test_what_torch_or_numpy_calls_deprecated_is_not_used(command):
    root = Path(__file__).parents[2]
    given = {"capture_output": True, "text": True, "cwd": root, "env": {**os.environ, "PYTHONPATH": str(root)}}
    done = subprocess.run([sys.executable, "-W", "error::DeprecationWarning", *command], **given)
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-3000:]
    assert not done.stderr and "Warning" not in done.stdout
