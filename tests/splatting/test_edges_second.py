"""Second derivatives of found edges leave out how outlines curve: they warn, and first derivatives do not."""

import numpy as np
import pytest
from cards import SIZE, in_pixels
from helpers import arrays, quick, to_numpy

import rts

pytestmark = pytest.mark.splatting

ANGLES = 2 * np.pi * np.arange(64) / 64
ROUND = np.column_stack([np.cos(ANGLES), np.sin(ANGLES), 0 * ANGLES])
FAN = np.column_stack([np.zeros(62), np.arange(1, 63), np.arange(2, 64)]).astype(np.int32)
START = np.array([7.3, 0.5])
"""A radius in pixels, and a grey."""


def disk(radius, grey):
    """The image of a disk, nearly round."""
    xp, engine = rts.namespace(radius, grey), rts.engine_of(radius, grey)
    like = grey if engine.owns(grey) else radius
    vertices = ROUND.astype(np.float32) * START[0] + np.float32([12.2, 11.7, -3])
    if engine.owns(radius):
        vertices = engine.constant(ROUND, like) * radius + engine.constant(np.array([12.2, 11.7, -3]), like)
    theta = {"vertices": vertices, "color": xp.stack([grey] * 3)}
    return rts.render(rts.Part(rts.Mesh(FAN), theta, "unlit"), in_pixels(), SIZE)


def image(p):
    """The disk whose radius and grey the parameters (2,) are."""
    return disk(p[0], p[1])


def area(p):
    return image(p)[..., 3].sum()


def loss(p):
    return (image(p) ** 2).sum()


def loss_in_grey(grey):
    """The loss of a disk that stays."""
    return (disk(START[0], grey) ** 2).sum()


def torch_twice():
    """Ways to second derivatives in the radius."""
    import torch
    from torch.func import grad, hessian, jacfwd, jacrev, jvp

    def by_hand(f):
        def second(p):
            p = p.detach().clone().requires_grad_(True)
            (slope,) = torch.autograd.grad(f(p), p, create_graph=True)
            return torch.stack([torch.autograd.grad(x, p, retain_graph=True)[0] for x in slope])

        return second

    def along(f):
        return lambda p: jvp(grad(f), (p,), (torch.tensor([1.0, 0]),))[1][None]

    return {
        "hessian": hessian,
        "reverse twice": lambda f: jacrev(jacrev(f)),
        "reverse of forward": lambda f: jacrev(jacfwd(f)),
        "by hand": by_hand,
        "functional": lambda f: lambda p: torch.autograd.functional.hessian(f, p),
        "along": along,
    }


def torch_once():
    """Derivatives that are first ones in what moves."""
    import torch
    from torch.func import grad, hessian, jacfwd, jacrev, jvp, vjp, vmap

    def gauss_newton(p):
        along = torch.tensor([1.0, 0.5])
        return vjp(image, p)[1](jvp(image, (p,), (along,))[1])

    def grey_by_hand(p):
        """The second derivative of the grey alone, where the radius has a derivative, too."""
        radius, grey = (x.clone().requires_grad_(True) for x in p)
        (slope,) = torch.autograd.grad((disk(radius, grey) ** 2).sum(), grey, create_graph=True)
        return torch.autograd.grad(slope, grey)

    def forward_by_reverse(p):
        """torch's way to tangents by reverse mode twice."""
        return torch.autograd.functional.jvp(image, p, torch.ones(2))

    return {
        "grad": grad(area),
        "forward": jacfwd(image),
        "reverse": jacrev(lambda p: image(p).mean((0, 1))),
        "batch": lambda p: vmap(grad(loss))(torch.stack([p, p + 0.1])),
        "Gauss-Newton": gauss_newton,
        "forward by reverse": forward_by_reverse,
        "create_graph": lambda p: torch.autograd.functional.jacobian(area, p, create_graph=True),
        "grey": lambda p: hessian(loss_in_grey)(p[1]),
        "grey by hand": grey_by_hand,
    }


WAYS = ["by hand", "along", "functional", "reverse twice", "reverse of forward", "hessian"]
ONCE = [
    "grad",
    "forward",
    "reverse",
    "Gauss-Newton",
    "forward by reverse",
    "create_graph",
    "grey by hand",
    "grey",
    "batch",
]


@pytest.mark.parametrize("way", quick(WAYS, 4))
def test_second_derivatives_of_torch_warn_and_lack_the_curvature_of_outlines(way):
    """The area of a disk, π r², has the second derivative 2 π; a share of it alone is left."""
    pytest.importorskip("torch")
    with pytest.warns(rts.errors.InputWarning, match="second derivatives .* 'edges'.* Gauss–Newton"):
        found = torch_twice()[way](area)(arrays("torch-cpu", START))
    assert abs(float(found[0][0])) < 0.5 * 2 * np.pi


@pytest.mark.parametrize("way", quick(ONCE, 7))
def test_first_derivatives_of_torch_and_second_ones_of_colours_do_not_warn(way):
    pytest.importorskip("torch")
    torch_once()[way](arrays("torch-cpu", START))  # Warnings are errors.


@pytest.mark.thorough
def test_fits_by_gauss_newton_do_not_warn():
    pytest.importorskip("torch")
    target = image(arrays("torch-cpu", START)).detach()
    start = arrays("torch-cpu", START + [0.4, 0.1])
    found = rts.fit(lambda p: (image(p) - target).reshape(-1), start, method="lm", steps=8)
    np.testing.assert_allclose(to_numpy(found.parameters), START, atol=0.01)


@pytest.mark.parametrize("way", quick(["hessian", "reverse of forward", "forward twice", "along"], 0))
def test_second_derivatives_of_jax_warn_as_they_are_traced(way):
    jax = pytest.importorskip("jax")
    ways = {
        "hessian": jax.hessian(area),
        "reverse of forward": jax.jacrev(jax.jacfwd(area)),
        "forward twice": jax.jacfwd(jax.jacfwd(area)),
        "along": lambda p: jax.jvp(jax.grad(area), (p,), (jax.numpy.array([1.0, 0]),))[1],
    }
    with pytest.warns(rts.errors.InputWarning, match="second derivatives"):
        jax.eval_shape(ways[way], arrays("jax", START))


@pytest.mark.parametrize("way", quick(["grad", "batch", "forward", "Gauss-Newton", "linear", "grey"], 0))
def test_first_derivatives_of_jax_do_not_warn(way):
    jax = pytest.importorskip("jax")
    several = jax.numpy.asarray(np.stack([START, START + 0.1]), np.float32)
    along = jax.numpy.array([1.0, 0.5])
    ways = {
        "grad": jax.jit(jax.grad(loss)),
        "batch": lambda p: jax.jit(jax.vmap(jax.grad(loss)))(several),
        "forward": jax.jit(jax.jacfwd(image)),
        "Gauss-Newton": lambda p: jax.vjp(image, p)[1](jax.jvp(image, (p,), (along,))[1]),
        "linear": lambda p: jax.linear_transpose(jax.linearize(image, p)[1], p)(image(p)),
        "grey": lambda p: jax.hessian(loss_in_grey)(p[1]),
    }
    ways[way](arrays("jax", START))
