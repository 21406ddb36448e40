"""Rows by index in torch, with a compiled gradient: the same as torch's own in every transform."""

import numpy as np
import pytest

torch = pytest.importorskip("torch")

import rts  # noqa: E402
from rts.operations.take import take  # noqa: E402

pytestmark = pytest.mark.engines

INDEX = torch.tensor([3, 0, 3, 1, 4, 3], dtype=torch.int32)


def rows(*batch):
    return torch.from_numpy(np.random.default_rng(0).normal(size=(*batch, 5, 3)))


def own(x, index=INDEX):
    return torch.index_select(x, 0, index.long())  # torch 2.4 has no second derivatives by indices of 32 bits.


def weighted(f):
    weights = torch.from_numpy(np.random.default_rng(1).normal(size=(6, 3)))
    return lambda x: (f(x) ** 3 * weights).sum()


def test_values_and_both_modes_by_finite_differences():
    x = rows().requires_grad_(True)
    torch.testing.assert_close(take(x, INDEX), own(x))
    assert torch.autograd.gradcheck(lambda x: take(x, INDEX), x, check_forward_ad=True)
    assert torch.autograd.gradgradcheck(lambda x: take(x, INDEX) ** 2, x)


@pytest.mark.parametrize(
    "transform",
    [
        torch.func.grad,
        torch.func.hessian,
        lambda f: torch.func.jacfwd(torch.func.grad(f)),
        lambda f: torch.func.jacrev(torch.func.grad(f)),
        lambda f: lambda x: torch.func.jvp(f, (x,), (torch.ones_like(x),))[1],
    ],
    ids=["grad", "hessian", "jacfwd grad", "jacrev grad", "jvp"],
)
def test_transforms_agree_with_index_select(transform):
    found, expected = (transform(weighted(f))(rows()) for f in (lambda x: take(x, INDEX), own))
    torch.testing.assert_close(found, expected)


def test_batches_of_rows_of_indices_and_of_both():
    many = torch.stack([INDEX, INDEX.flip(0)])
    torch.testing.assert_close(torch.vmap(take, (0, None))(rows(2), INDEX), rows(2)[:, INDEX.long()])
    torch.testing.assert_close(torch.vmap(take, (None, 0))(rows(), many), rows()[many.long()])
    both = torch.vmap(take)(rows(2), many)
    torch.testing.assert_close(both, torch.stack([own(r, i) for r, i in zip(rows(2), many, strict=True)]))
    slopes = torch.vmap(torch.func.grad(lambda x: (take(x, INDEX) ** 2).sum()))(rows(2))
    torch.testing.assert_close(
        slopes, torch.stack([torch.func.grad(lambda x: (own(x) ** 2).sum())(r) for r in rows(2)])
    )


def test_gradients_are_the_same_each_time():
    x = torch.rand(50, 3)
    index = torch.randint(0, 50, (10000,))
    first, second = (torch.func.grad(lambda x: (take(x, index) ** 2).sum())(x) for _ in range(2))
    assert torch.equal(first, second)


def test_an_index_out_of_bounds_is_an_error():
    with pytest.raises(rts.InputError, match="rows from 5 to 5 were asked for; expected 0 to 4"):
        take(rows(), torch.tensor([5]))
