"""Compiled operations in torch: the same as their specifications, in every transform."""

import importlib
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

torch = pytest.importorskip("torch")


import rts  # noqa: E402
from rts.operations.combine import COMBINE, interpolate  # noqa: E402
from rts.operations.projection import PROJECTION, projective_map  # noqa: E402
from rts.operations.take import take  # noqa: E402
from rts.scene.rigid import RIGID  # noqa: E402

pytestmark = pytest.mark.engines

ROWS, COLUMN = 6, 2
INDEX = torch.tensor([3, 0, 3, 1, 4, 3, 5])
"""64 bits: by indices of 32, torch 2.4 has no second derivatives of its own."""


def numbers(*shape, batch=(), dtype=torch.float64, seed=0):
    return torch.tensor(np.random.default_rng(seed).normal(size=(*batch, *shape)), dtype=dtype)


def maps(count=7, **of):
    rows = numbers(4, 4, **of)
    rows[..., 2, 3] += 6
    return rows, numbers(count, 3, seed=1, **of)


def corners(count=7, **of):
    return numbers(ROWS, 3, **of), numbers(count, 2, seed=1, **of)


def ids(count):
    return torch.tensor(np.random.default_rng(2).integers(0, ROWS, (count, COLUMN + 4)), dtype=torch.int32)


def interpolated(rows, weights):
    return interpolate(rows, ids(weights.shape[-2]), COLUMN, weights)


def plainly_interpolated(rows, weights):
    return COMBINE.specification(rows, weights, ids(weights.shape[-2]), column=COLUMN, count=3, affine=True)


CASES = {
    "projection": (projective_map, PROJECTION.specification, maps),
    "interpolation": (interpolated, plainly_interpolated, corners),
    "take": (lambda x: take(x, INDEX), lambda x: x[INDEX], lambda **of: (numbers(ROWS, 3, **of),)),
    "rigid": (rts.rigid, RIGID.specification, lambda **of: (0.2 * numbers(6, **of), numbers(3, seed=1, **of))),
    "rigid, hardly turned": (
        rts.rigid,
        RIGID.specification,
        lambda **of: (1e-5 * numbers(6, **of), numbers(3, seed=1, **of)),
    ),
}


@pytest.fixture(params=CASES)
def case(request):
    """The compiled function, its specification, and what gives arguments."""
    return CASES[request.param]


@pytest.fixture(params=["projection", "interpolation"])
def many(request):
    """Those of functions of many rows."""
    return CASES[request.param]


def weighted(f):
    def total(*args):
        out = f(*args)
        return (out**3 * numbers(*out.shape[-2:], seed=3).to(out.dtype)).sum()

    return total


def by_each(given):
    """For each argument, what makes a function one of it alone, and its value."""

    def of_one(i):
        return lambda f: lambda x: f(*given[:i], x, *given[i + 1 :])

    return [(of_one(i), x) for i, x in enumerate(given)]


def test_both_modes_and_second_derivatives_by_finite_differences(case):
    f, _, given = case
    args = [x.requires_grad_(True) for x in given()]
    assert torch.autograd.gradcheck(f, args, check_forward_ad=True)
    assert torch.autograd.gradgradcheck(f, args)
    for of_one, x in by_each([x.detach() for x in args]):
        x = x.requires_grad_(True)
        assert torch.autograd.gradcheck(of_one(f), x, check_forward_ad=True, check_batched_forward_grad=True)
        assert torch.autograd.gradgradcheck(of_one(f), x)


@pytest.mark.parametrize(
    "transform",
    [
        torch.func.grad,
        torch.func.hessian,
        lambda f: torch.func.jacfwd(torch.func.grad(f)),
        lambda f: torch.func.jacrev(torch.func.grad(f)),
        lambda f: torch.func.jacrev(torch.func.jacfwd(f)),
        torch.func.jacfwd,
        lambda f: torch.func.jacfwd(torch.func.jacfwd(f)),
        lambda f: lambda x: torch.func.jvp(f, (x,), (torch.ones_like(x),))[1],
    ],
    ids=["grad", "hessian", "jacfwd grad", "jacrev grad", "jacrev jacfwd", "jacfwd", "jacfwd jacfwd", "jvp"],
)
def test_transforms_agree_with_plain_torch(case, transform):
    *functions, given = case
    for of_one, at in by_each(given()):
        found, expected = (transform(of_one(weighted(f)))(at) for f in functions)
        torch.testing.assert_close(found, expected)


def test_batches(case):
    *functions, given = case
    batch, one = given(batch=(3,)), given()
    for dims in [(0,)] if len(one) == 1 else [(0, 0), (0, None), (None, 0)]:
        args = [many if dim == 0 else own for many, own, dim in zip(batch, one, dims, strict=True)]
        every = tuple(range(len(args)))
        for of in (lambda f: f, lambda f: torch.func.grad(weighted(f), every), lambda f: torch.func.jacfwd(f)):  # noqa: B023
            found, expected = (torch.vmap(of(f), dims)(*args) for f in functions)
            torch.testing.assert_close(found, expected)


def test_the_older_batches_of_gradients(case):
    *functions, given = case
    args = [x.requires_grad_(True) for x in given()]
    along = torch.rand(4, *functions[0](*args).shape, dtype=torch.float64)
    found, expected = (torch.autograd.grad(f(*args), args, along, is_grads_batched=True) for f in functions)
    torch.testing.assert_close(found, expected)


@pytest.mark.parametrize("strategy", ["reverse-mode", "forward-mode"])
def test_the_older_batches_of_jacobians(case, strategy):
    f, plain, given = case
    for of_one, at in by_each(given()):
        found = torch.autograd.functional.jacobian(of_one(f), at, vectorize=True, strategy=strategy)
        torch.testing.assert_close(found, torch.func.jacrev(of_one(plain))(at))


def test_dual_numbers_of_torch_are_pushed(case):
    f, plain, given = case
    given = given()
    along = tuple(map(torch.ones_like, given))
    with torch.autograd.forward_ad.dual_level():
        found = f(*map(torch.autograd.forward_ad.make_dual, given, along))
        tangent = torch.autograd.forward_ad.unpack_dual(found).tangent
    torch.testing.assert_close(tangent, torch.func.jvp(plain, given, along)[1])


def test_batches_of_indices():
    rows, both = numbers(ROWS, 3, batch=(2,)), torch.stack([INDEX, INDEX.flip(0)])
    torch.testing.assert_close(torch.vmap(take, (None, 0))(rows[0], both), rows[0][both])
    torch.testing.assert_close(torch.vmap(take)(rows, both), torch.stack([rows[i][both[i]] for i in range(2)]))


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


def test_double_vertices_take_compiled_code_with_single_weights():
    rows, weights = corners()
    found = interpolated(rows, weights.float())
    assert found.dtype == torch.float64
    torch.testing.assert_close(found, plainly_interpolated(rows, weights.float().double()), rtol=1e-14, atol=1e-14)


def test_gradients_of_rows_that_are_taken_often_are_the_same_each_time():
    rows, index = torch.rand(50, 3), torch.randint(0, 50, (10000,))
    first, second = (torch.func.grad(lambda x: (take(x, index) ** 2).sum())(rows) for _ in range(2))
    assert torch.equal(first, second)


def test_gradients_do_not_depend_on_the_number_of_threads(many, monkeypatch):
    f, _, given = many
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
