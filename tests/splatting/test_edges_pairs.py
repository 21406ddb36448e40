"""Found edges of every built-in surface by every sampler: forward mode against reverse mode; second derivatives."""

import numpy as np
import pytest
from example_surfaces import part_of
from helpers import icosphere

import rts
from rts.arrays.trees import map_leaves

torch = pytest.importorskip("torch")
forward = pytest.importorskip("torch.autograd.forward_ad")

pytestmark = pytest.mark.splatting

SIZE = 14, 16
CAMERA = rts.Camera.look_at((1.3, 1.1, 3.4), (0, 0, 0), fov_y=42)
TRIANGLES = ["mesh", "subdivision", "bezier", "bspline", "revolution", "heightfield", "isosurface"]
SAMPLERS = ["raster", "embree", "reference", "opengl"]
PAIRS = [
    *((surface, sampler) for surface in TRIANGLES for sampler in SAMPLERS),
    *((surface, "rays") for surface in ("isosurface", "field", "ellipsoid")),
]
SLOW = {*((surface, "reference") for surface in TRIANGLES[1:]), ("isosurface", "rays"), ("field", "rays")}


def in_double(theta):
    """θ in tensors, floats in float64, and a random direction of each float."""
    rng, floats = np.random.default_rng(0), []

    def tensor(x):
        x = np.asarray(x)
        if not np.issubdtype(x.dtype, np.floating):
            return torch.as_tensor(x)
        floats.append((torch.as_tensor(x, dtype=torch.float64), torch.as_tensor(rng.normal(size=x.shape))))
        return floats[-1][0]

    return map_leaves(tensor, theta), floats


def rebuilt(theta, floats):
    """θ with its floats, in order, replaced."""
    it = iter(floats)
    return map_leaves(lambda x: next(it) if x.is_floating_point() else x, theta)


@pytest.mark.parametrize(
    ("surface", "sampler"), [pytest.param(*p, marks=[pytest.mark.thorough] * (p in SLOW)) for p in PAIRS]
)
def test_forward_mode_and_reverse_mode_agree_for_every_surface_and_sampler(surface, sampler):
    part = part_of(surface)
    theta, floats = in_double(part.theta)
    weights = torch.as_tensor(np.random.default_rng(1).normal(size=(*SIZE, 4)))

    def image(values):
        changed = part.replace(theta=rebuilt(theta, values))
        return rts.render(changed, CAMERA, SIZE, splatter="edges", sampler=sampler)

    try:
        with forward.dual_level():
            pushed = forward.unpack_dual(image([forward.make_dual(x, v) for x, v in floats])).tangent
    except rts.errors.PluginError as error:
        pytest.skip(str(error))
    variables = [x.clone().requires_grad_() for x, _ in floats]
    pulled = torch.autograd.grad((image(variables) * weights).sum(), variables, materialize_grads=True)
    by_reverse = sum(float((g * v).sum()) for g, (_, v) in zip(pulled, floats, strict=True))
    assert torch.isfinite(pushed).all() and float(pushed.abs().max()) > 0.1
    assert by_reverse == pytest.approx(float((pushed * weights).sum()), rel=1e-5)


def hexagonal(shader):
    """A loss of a ball of 80 triangles, by how far it is shifted; and no shift."""
    vertices, faces = icosphere(1)
    start = torch.as_tensor(vertices * 0.8, dtype=torch.float64)

    def loss(shift):
        part = rts.Part(rts.Mesh(faces), {"vertices": start + shift}, shader)
        return (rts.render(part, CAMERA, SIZE, splatter="edges") ** 2).sum()

    return loss, torch.zeros(3, dtype=torch.float64)


def reversed_twice(loss, at):
    """The Hessian of a loss, by reverse mode twice, without torch.func."""
    at = at.clone().requires_grad_()
    (first,) = torch.autograd.grad(loss(at), at, create_graph=True)
    return torch.stack([torch.autograd.grad(g, at, retain_graph=True)[0] for g in first])


@pytest.mark.parametrize("shader", ["unlit", "normals"])
def test_torch_func_sees_the_loss_that_is_drawn(shader):
    loss, zero = hexagonal(shader)
    value, _ = torch.func.jvp(loss, (zero,), (torch.ones_like(zero),))
    assert float(value) == pytest.approx(float(loss(zero)), rel=1e-9)


@pytest.mark.parametrize(
    "transform",
    [
        torch.func.hessian,
        lambda f: torch.func.jacfwd(torch.func.jacrev(f)),
        lambda f: torch.func.jacrev(torch.func.jacfwd(f)),
        lambda f: torch.func.jacrev(torch.func.jacrev(f)),
        lambda f: (
            lambda x: torch.stack([torch.func.jvp(torch.func.grad(f), (x,), (e,))[1] for e in torch.eye(3).to(x)])
        ),
    ],
    ids=["hessian", "forward over reverse", "reverse over forward", "reverse over reverse", "jvp of grad"],
)
@pytest.mark.thorough
@pytest.mark.filterwarnings("ignore:second derivatives of an image")
def test_second_derivatives_by_torch_func_are_those_of_reverse_mode_twice(transform):
    loss, zero = hexagonal("normals")
    found, expected = transform(loss)(zero), reversed_twice(loss, zero)
    assert float(expected.abs().max()) > 1
    torch.testing.assert_close(found, expected, rtol=1e-8, atol=1e-8)
