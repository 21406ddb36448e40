"""The compiled projection in torch: the same as in plain torch, in every transform."""

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from rts.arrays import projective_map  # noqa: E402
from rts_backends.torch_projection import specification  # noqa: E402


def given(*batch, dtype=torch.float64, count=7):
    rng = np.random.default_rng(0)
    rows = rng.normal(size=(*batch, 4, 4))
    rows[..., 2, 3] += 6
    return torch.tensor(rows, dtype=dtype), torch.tensor(rng.normal(size=(*batch, count, 3)), dtype=dtype)


def weighted(f, count=7):
    weights = torch.tensor(np.random.default_rng(1).normal(size=(count, 3)))
    return lambda rows, points: (f(rows, points) ** 2 * weights).sum()


@pytest.mark.parametrize("dtype, tolerance", [(torch.float32, 1e-5), (torch.float64, 1e-12)])
def test_values_and_gradients_of_many_points(dtype, tolerance):
    rows, points = given(dtype=dtype, count=20000)
    torch.testing.assert_close(
        projective_map(rows, points), specification(rows, points), rtol=tolerance, atol=tolerance
    )
    weights = torch.rand(20000, 3, dtype=dtype)
    found, expected = (
        torch.func.grad(lambda r, p, f=f: (f(r, p) * weights).sum(), (0, 1))(rows, points)
        for f in (projective_map, specification)
    )
    for a, b in zip(found, expected, strict=True):
        torch.testing.assert_close(a, b, rtol=100 * tolerance, atol=100 * tolerance * float(b.abs().max()))


def test_both_modes_and_second_derivatives_by_finite_differences():
    rows, points = (x.requires_grad_(True) for x in given())
    assert torch.autograd.gradcheck(projective_map, (rows, points), check_forward_ad=True)
    assert torch.autograd.gradgradcheck(projective_map, (rows, points))
    fixed = points.detach()
    assert torch.autograd.gradcheck(lambda r: projective_map(r, fixed), rows, check_forward_ad=True)
    assert torch.autograd.gradgradcheck(lambda r: projective_map(r, fixed), rows)


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
def test_transforms_agree_with_plain_torch(transform):
    rows, points = given()
    for f in (lambda g: lambda r: g(r, points), lambda g: lambda p: g(rows, p)):
        at = rows if f(lambda r, p: r)(rows) is rows and f(lambda r, p: p)(rows) is points else points
        found, expected = (transform(f(weighted(g)))(at) for g in (projective_map, specification))
        torch.testing.assert_close(found, expected)


def test_batches():
    rows, points = given(3)
    one = given()
    for batch, dims in (((rows, points), (0, 0)), ((rows, one[1]), (0, None)), ((one[0], points), (None, 0))):
        torch.testing.assert_close(torch.vmap(projective_map, dims)(*batch), torch.vmap(specification, dims)(*batch))
        found, expected = (
            torch.vmap(torch.func.grad(weighted(f), (0, 1)), dims)(*batch) for f in (projective_map, specification)
        )
        torch.testing.assert_close(found, expected)


def test_points_without_an_image_are_finite_with_finite_gradients():
    rows, points = given()
    points[0] = 0
    rows[2, 3] = 0
    rows, points = rows.requires_grad_(True), points.requires_grad_(True)
    out = projective_map(rows, points)
    out.sum().backward()
    assert out.isfinite().all() and rows.grad.isfinite().all() and points.grad.isfinite().all()


def test_gradients_do_not_depend_on_the_number_of_threads(monkeypatch):
    rows, points = given(dtype=torch.float32, count=50000)
    found = []
    for threads in ("1", "2"):
        monkeypatch.setenv("RTS_NUM_THREADS", threads)
        found.append(torch.func.grad(lambda r: projective_map(r, points).square().mean())(rows))
    assert torch.equal(*found)
